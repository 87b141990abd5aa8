"""Profile likelihood of an order: how much worse everything else can make up for another value."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.selection.refit import Refit, adapted
from analysis.structures import PARAMETERS, Structure
from analysis.unknowns import ORDER_RANGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.selection.candidates import Candidate, Field

Order = Literal["alpha", "lambda"]

CHI_SQUARE_95: Final = 3.841458820694124
"""Deviance that the true value exceeds once in twenty records (one degree of freedom)."""

WIDEST_SHARE: Final = 0.25
"""Of the range 0 to 2: an order known to no better than ±0.25 tells no material from another."""

_FAR: Final = 25.0
_FIRST_STEP: Final = 0.02
_GROWTH: Final = 2.0
_MAX_EVALUATIONS: Final = 30
_SHARPENINGS: Final = 2


@dataclass(frozen=True, slots=True)
class Profile:
    """Deviance of an order's values, everything else fitted anew at each.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    structure : str
        In which it was free.
    values : tuple of float
        Increasing.
    deviance : tuple of float
        Above the lowest.
    estimate : float
        Value of the lowest deviance.
    interval : tuple of float
        95 %, by the likelihood ratio; where it is open it ends at the edge of the range.
    open_below, open_above : bool
        Whether the record excludes no value on that side.
    """

    order: Order
    structure: str
    values: tuple[float, ...]
    deviance: tuple[float, ...]
    estimate: float
    interval: tuple[float, float]
    open_below: bool
    open_above: bool

    @property
    def share(self) -> float:
        """Part of the range that the interval spans."""
        return (self.interval[1] - self.interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])

    @property
    def identifiable(self) -> bool:
        """Whether the record says anything of use about this order."""
        return self.share <= WIDEST_SHARE and not (self.open_below or self.open_above)

    @property
    def admits_one(self) -> bool:
        """Whether the integer order 1 lies in the interval."""
        return self.interval[0] <= 1 <= self.interval[1]


def with_order(structure: Structure, order: Order, value: float | None) -> Structure:
    """Take a structure's damping with one order free, or held at a value.

    Damping that the structure lacks comes in, its coefficient free.
    """
    coefficient = "zeta" if order == "alpha" else "gamma"
    fixed = {name: at for name, at in structure.fixed.items() if name not in (coefficient, order)}
    if value is not None:
        fixed[order] = value
    free = tuple(name for name in PARAMETERS if name not in fixed)
    return Structure(structure.name, free, MappingProxyType(fixed))


def profile(field: Field, candidate: Candidate, order: Order) -> Profile:
    """Walk away from the minimum both ways until the record excludes what lies beyond.

    The steps double; each refit starts from the last. So the interval is that round the minimum,
    and a second valley beyond a deviance of 25 is not looked for: `Field` has searched the range.

    Parameters
    ----------
    field : Field
    candidate : Candidate
        In whose structure the order is freed, if it is not free.
    order : str
    """
    walk = _Walk(field, candidate, order)
    centre, step = walk.start()
    for sign in (-1.0, 1.0):
        walk.outwards(centre, sign * step)
    values = np.array(sorted(walk.costs))
    costs = np.array([walk.costs[value] for value in values])
    deviance = candidate.values * np.log(costs / costs.min())
    lowest = int(np.argmin(deviance))
    low, open_below = _crossing(values[: lowest + 1][::-1], deviance[: lowest + 1][::-1])
    high, open_above = _crossing(values[lowest:], deviance[lowest:])
    return Profile(
        order=order,
        structure=candidate.name,
        values=tuple(values.tolist()),
        deviance=tuple(deviance.tolist()),
        estimate=float(values[lowest]),
        interval=(low, high),
        open_below=open_below,
        open_above=open_above,
    )


class _Walk:
    """Refits with one order held, and what they cost."""

    def __init__(self, field: Field, candidate: Candidate, order: Order) -> None:
        self.field, self.candidate, self.order = field, candidate, order
        self.costs: dict[float, float] = {}
        self._at: dict[float, Refit] = {}
        self._first: Refit | None = None

    def start(self) -> tuple[float, float]:
        """Minimum with the order free, and its standard deviation or what stands for it."""
        structure = with_order(self.candidate.structure, self.order, None)
        candidate = self.candidate
        unknowns = self.field.unknowns(structure, candidate.uniform)
        seed = adapted(unknowns, candidate.fit.plant, candidate.structure)
        found = self._descend(structure, seed)
        damping = found.plant.damping
        centre = damping.alpha if self.order == "alpha" else damping.lambda_
        std = found.fit().std[self.order]
        self.costs[centre] = found.cost
        self._first = found
        return centre, min(max(std or _FIRST_STEP, 1e-4), 0.25)

    def outwards(self, centre: float, step: float) -> None:
        """Cross the threshold, sharpen the crossing, and go on for a little of the curve."""
        low, high = ORDER_RANGE
        last, here = self._first, centre
        lowest = self.costs[centre]
        inside, outside = centre, None
        while low < here < high:
            here = min(max(here + step, low), high)
            step *= _GROWTH
            last = self._hold(here, last)
            deviance = self._deviance(here, lowest)
            if deviance < CHI_SQUARE_95:
                inside = here
            elif outside is None:
                outside = here
            if deviance > _FAR:
                break
        for _ in range(_SHARPENINGS if outside is not None else 0):
            assert outside is not None
            middle = _between(
                inside,
                outside,
                self._deviance(inside, lowest),
                self._deviance(outside, lowest),
            )
            self._hold(middle, self._at.get(inside, self._first))
            if self._deviance(middle, lowest) < CHI_SQUARE_95:
                inside = middle
            else:
                outside = middle

    def _deviance(self, value: float, lowest: float) -> float:
        return self.candidate.values * math.log(self.costs[value] / lowest)

    def _hold(self, value: float, near: Refit | None) -> Refit:
        """Fit all else with the order at `value`."""
        assert near is not None
        structure = with_order(self.candidate.structure, self.order, value)
        before = near.objective.unknowns
        start = dict(zip(before.names, near.x.tolist(), strict=True))
        unknowns = self.field.unknowns(structure, self.candidate.uniform)
        found = self._descend(structure, np.array([start[name] for name in unknowns.names]))
        self.costs[value], self._at[value] = found.cost, found
        return found

    def _descend(self, structure: Structure, start: NDArray[np.float64]) -> Refit:
        field = self.field
        return Refit.descend(
            field.comparison,
            field.unknowns(structure, self.candidate.uniform),
            start,
            field.noise,
            field.columns,
            _MAX_EVALUATIONS,
        )


def _crossing(values: NDArray[np.float64], deviance: NDArray[np.float64]) -> tuple[float, bool]:
    """Where the deviance passes the threshold, going outwards, and whether it never does."""
    beyond = np.flatnonzero(deviance > CHI_SQUARE_95)
    if beyond.size == 0:
        return float(values[-1]), True
    i = int(beyond[0])
    crossing = _between(
        float(values[i - 1]), float(values[i]), float(deviance[i - 1]), float(deviance[i])
    )
    return crossing, False


def _between(inside: float, outside: float, below: float, above: float) -> float:
    """Crossing between two points; the root of a deviance is all but linear in the value."""
    low, high = math.sqrt(max(below, 0.0)), math.sqrt(max(above, 0.0))
    share = (math.sqrt(CHI_SQUARE_95) - low) / (high - low)
    return inside + share * (outside - inside)
