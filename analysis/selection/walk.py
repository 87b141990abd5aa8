"""Walks along an order of the damping: everything else fitted anew at each value."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.refit import Refit
from analysis.selection.restart import adapted
from analysis.selection.valleys import CHI_SQUARE_95, RIDGE, admitted, crossing, dips, gaps
from analysis.structures import COEFFICIENT_OF, PARAMETERS, Structure
from analysis.unknowns import ORDER_RANGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field
    from analysis.selection.profile import Order
    from analysis.whole_record import Plant

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

_DOUBTFUL_SHARE: Final = 0.025
"""Of the range 0 to 2 within the 95 % limit, from which there may be another valley somewhere."""

_GRID: Final = 0.2
_LOOKS: Final = 8
"""Spacing of the orders at which it is looked for, and evaluations at each."""


def with_order(structure: Structure, order: Order) -> Structure:
    """Take a structure's damping with one order free.

    Damping that the structure lacks comes in, its coefficient free.
    """
    coefficient = COEFFICIENT_OF[order]
    fixed = {name: at for name, at in structure.fixed.items() if name not in (coefficient, order)}
    free = tuple(name for name in PARAMETERS if name not in fixed)
    return Structure(structure.name, free, MappingProxyType(fixed))


class Walk:
    """Refits with one order held, and what they cost."""

    def __init__(self, field: Field, candidate: Candidate, order: Order) -> None:
        self.order = order
        self.structure = with_order(candidate.structure, order)
        self._field, self._values = field, candidate.values
        self._unknowns = unknowns = field.unknowns(
            self.structure, candidate.uniform, candidate.extras
        )
        self._place = unknowns.names.index(order)
        seed = adapted(unknowns, candidate.fit.plant, candidate.structure)
        first = field.descent(unknowns, seed, _MAX_EVALUATIONS)
        self.costs: dict[float, float] = {}
        self._at: dict[float, Refit] = {}
        self._stand_at(first)

    def _stand_at(self, bottom: Refit) -> None:
        """Walk from a minimum with the order free."""
        self._first = bottom
        self._centre = float(bottom.x[self._place])
        self._keep(self._centre, bottom)

    def plant(self, value: float) -> Plant:
        """Everything that was fitted at a value that was looked at."""
        return self._at[value].plant

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values in order, shape (n,), and their deviances above the lowest."""
        values = np.array(sorted(self.costs))
        costs = np.array([self.costs[value] for value in values])
        return values, self._values * np.log(costs / costs.min())

    def both_ways(self) -> None:
        """Walk from where it stands."""
        for sign in (-1.0, 1.0):
            self._outwards(sign)

    def elsewhere(self) -> None:
        """Look for another valley, if much of the range is admitted, and walk it."""
        (low, high), open_below, open_above = admitted(*self.curve())
        wide = high - low > _DOUBTFUL_SHARE * (ORDER_RANGE[1] - ORDER_RANGE[0])
        places = gaps(list(self.costs), ORDER_RANGE, _GRID)
        if not (wide or open_below or open_above) or not places:
            return
        # Loss at a mode and order are unknowns of their own: the loss stays as the order changes.
        looks = {}
        for value in places:
            start = self._first.x.copy()
            start[self._place] = value
            looks[value] = self._descend(start, _LOOKS, hold=True)
        for value in dips({value: look.cost for value, look in looks.items()}):
            bottom = self._descend(looks[value].x, _MAX_EVALUATIONS, hold=False)
            values, deviance = self.curve()
            at = float(bottom.x[self._place])
            here = self._values * math.log(bottom.cost / min(self.costs.values()))
            known = float(np.interp(at, values, deviance, math.inf, math.inf))
            if here < min(CHI_SQUARE_95, known - RIDGE):
                self._stand_at(bottom)
                self.both_ways()

    def _keep(self, value: float, found: Refit) -> None:
        """Keep the lower of two refits at one value."""
        if found.cost < self.costs.get(value, math.inf):
            self.costs[value], self._at[value] = found.cost, found

    def _outwards(self, sign: float) -> None:
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
            if abs(inside - self._centre) >= abs(outside - self._centre):
                break  # there is a ridge between
            below, above = self._root(inside), self._root(outside)
            if above - below < _NARROW:
                break
            middle = crossing(inside, outside, below**2, above**2)
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
        self._keep(value, self._descend(self._tangent(value, near), _MAX_EVALUATIONS, hold=True))
        return self._root(value)

    def _descend(self, start: NDArray[np.float64], max_evaluations: int, *, hold: bool) -> Refit:
        """Fit from a vector of unknowns, the order held where it starts or free."""
        field = self._field
        return Refit.descend(
            field.comparison,
            self._unknowns,
            start,
            field.noise,
            field.columns,
            max_evaluations=max_evaluations,
            relative_tolerance=_TOLERANCE,
            hold=self.order if hold else None,
        )

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
