"""Profile likelihood of an order: how much worse everything else can make up for another value."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.selection.refit import Refit
from analysis.selection.restart import adapted
from analysis.structures import PARAMETERS, Structure
from analysis.unknowns import ORDER_RANGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field

Order = Literal["alpha", "lambda"]

CHI_SQUARE_95: Final = 3.841458820694124
"""Deviance that the true value exceeds once in twenty records (one degree of freedom)."""

WIDEST_SHARE: Final = 0.25
"""Of the range 0 to 2: an order known to no better than ±0.25 tells no material from another."""

_FAR: Final = 25.0
_BEYOND: Final = 1.04
"""How much further a step goes than to where it should reach a deviance."""

_FIRST_STEP: Final = 0.02
_SHORTEST: Final = 1.2
_LONGEST: Final = 2.6
_MAX_EVALUATIONS: Final = 30
_TOLERANCE: Final = 1e-6
"""Of the sum of squares: a hundredth in the deviance."""

_NARROW: Final = 1.1
"""Between two roots of a deviance: it is straight enough there to say where it is crossed."""

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
    gain : float
        Deviance that the structure saves by freeing the order; 0 if it was free.
    """

    order: Order
    structure: str
    values: tuple[float, ...]
    deviance: tuple[float, ...]
    estimate: float
    interval: tuple[float, float]
    open_below: bool
    open_above: bool
    gain: float

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


def with_order(structure: Structure, order: Order) -> Structure:
    """Take a structure's damping with one order free.

    Damping that the structure lacks comes in, its coefficient free.
    """
    coefficient = "zeta" if order == "alpha" else "gamma"
    fixed = {name: at for name, at in structure.fixed.items() if name not in (coefficient, order)}
    free = tuple(name for name in PARAMETERS if name not in fixed)
    return Structure(structure.name, free, MappingProxyType(fixed))


def profile(field: Field, candidate: Candidate, order: Order) -> Profile:
    """Walk away from the minimum both ways until the record excludes what lies beyond.

    Each refit starts on the tangent of the last, and each step goes to where the deviance, were it
    a parabola, would reach the next level. So the interval is that round the minimum, and a second
    valley beyond a deviance of 25 is not looked for: `Field` has searched the range.

    Parameters
    ----------
    field : Field
    candidate : Candidate
        In whose structure the order is freed, if it is not free.
    order : str
    """
    walk = _Walk(field, candidate, order)
    for sign in (-1.0, 1.0):
        walk.outwards(sign)
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
        gain=0.0
        if order in candidate.structure.free
        else candidate.values * math.log(max(candidate.fit.cost / costs.min(), 1.0)),
    )


class _Walk:
    """Refits with one order held, and what they cost."""

    def __init__(self, field: Field, candidate: Candidate, order: Order) -> None:
        self.order = order
        self._field, self._values = field, candidate.values
        structure = with_order(candidate.structure, order)
        self._unknowns = unknowns = field.unknowns(structure, candidate.uniform)
        self._place = unknowns.names.index(order)
        seed = adapted(unknowns, candidate.fit.plant, candidate.structure)
        self._first = first = field.descent(unknowns, seed, _MAX_EVALUATIONS)
        self._centre = float(first.x[self._place])
        self.costs: dict[float, float] = {self._centre: first.cost}
        self._at: dict[float, Refit] = {self._centre: first}

    def outwards(self, sign: float) -> None:
        """Cross the threshold, go on for a little of the curve, and sharpen the crossing."""
        low, high = ORDER_RANGE
        here, distance, root = self._centre, self._spread(), 0.0
        inside, outside = here, None
        while low < here < high and root**2 < _FAR:
            near = self._at[here]
            here = min(max(self._centre + sign * distance, low), high)
            root = self._hold(here, near)
            if root**2 < CHI_SQUARE_95:
                inside, level = here, CHI_SQUARE_95
            else:
                outside, level = outside if outside is not None else here, _FAR
            growth = _BEYOND * math.sqrt(level) / max(root, 1e-3)
            distance *= min(max(growth, _SHORTEST), _LONGEST)
        for _ in range(_SHARPENINGS if outside is not None else 0):
            assert outside is not None
            below, above = self._root(inside), self._root(outside)
            if above - below < _NARROW:
                break
            middle = _between(inside, outside, below**2, above**2)
            if self._hold(middle, self._at[inside]) ** 2 < CHI_SQUARE_95:
                inside = middle
            else:
                outside = middle

    def _spread(self) -> float:
        """Give the standard deviation of the order, or what stands for it."""
        hessian, place = self._first.equations.hessian, self._place
        scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
        scaled = hessian / np.outer(scale, scale) + 1e-12 * np.eye(scale.size)
        variance = np.linalg.inv(scaled)[place, place] / scale[place] ** 2
        std = math.sqrt(variance * self._first.cost / self._values) if variance > 0 else _FIRST_STEP
        return min(max(std, 1e-4), 0.25)

    def _root(self, value: float) -> float:
        """Root of the deviance at a value."""
        lowest = self.costs[self._centre]
        return math.sqrt(max(self._values * math.log(self.costs[value] / lowest), 0.0))

    def _hold(self, value: float, near: Refit) -> float:
        """Fit all else with the order at `value`; give the root of the deviance."""
        field = self._field
        found = Refit.descend(
            field.comparison,
            self._unknowns,
            self._tangent(value, near),
            field.noise,
            field.columns,
            max_evaluations=_MAX_EVALUATIONS,
            relative_tolerance=_TOLERANCE,
            hold=self.order,
        )
        self.costs[value], self._at[value] = found.cost, found
        return self._root(value)

    def _tangent(self, value: float, near: Refit) -> NDArray[np.float64]:
        """Where all else would be with the order at `value`, to first order, shape (k,)."""
        x, hessian, place = near.x.copy(), near.equations.hessian, self._place
        lower, upper = self._unknowns.bounds
        scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
        others = (x > lower) & (x < upper) & (np.arange(x.size) != place)
        scaled = hessian / np.outer(scale, scale)
        block = scaled[np.ix_(others, others)] + 1e-9 * np.eye(int(others.sum()))
        slope = -np.linalg.solve(block, scaled[others, place]) / scale[others] * scale[place]
        x[others] += slope * (value - x[place])
        x[place] = value
        return x


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
