"""Profile likelihood of the damping orders: all other parameters are refitted at each value.

The 95 % interval holds all values within the chi-square limit of one degree of freedom. A walk goes
from the minimum in both directions until the record excludes the values beyond. A coarse grid finds
other local minima.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._candidate import FAR_BEHIND
from analysis.identify._refit import MISSED, Refit
from analysis.models import COEFFICIENT_OF, ORDER_RANGE, PARAMETERS, Structure

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._plant import Plant


# Profile

Order = Literal["alpha", "lambda"]

WIDEST_FRACTION: Final = 0.25
"""Fraction of the range 0 to 2: an order with ±0.25 does not distinguish materials."""


@dataclass(frozen=True, slots=True)
class LikelihoodProfile:
    """Deviance of the values of an order, with all other parameters refitted at each.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    structure : str
        Structure in which the order was free.
    values : tuple of float
        Increasing.
    deviance : tuple of float
        Above the lowest.
    estimate : float
        Value of the lowest deviance.
    local_minima : tuple of float
        Values that explain the record equally, the lowest deviance first: local minima within the
        95 % limit, separated by a barrier.
    interval : tuple of float
        95 % interval, by the likelihood ratio, over all local minima; an open interval ends at the
        edge of the range.
    open_below, open_above : bool
        Whether the record excludes no value on that side.
    gain : float
        Reduction of deviance by freeing the order; 0 if it was free.
    """

    order: Order
    structure: str
    values: tuple[float, ...]
    deviance: tuple[float, ...]
    estimate: float
    local_minima: tuple[float, ...]
    interval: tuple[float, float]
    open_below: bool
    open_above: bool
    gain: float

    @classmethod
    def unwalked(cls, candidate: Candidate, order: Order) -> LikelihoodProfile:
        """Return the profile of an order that nothing determines: one value without limits.

        Parameters
        ----------
        candidate : Candidate
        order : str
        """
        at = candidate.fit.parameters[order]
        return cls(order, candidate.name, (at,), (0.0,), at, (at,), ORDER_RANGE, True, True, 0.0)

    @property
    def walked(self) -> bool:
        """Return whether another value was computed."""
        return len(self.values) > 1

    @property
    def relative_width(self) -> float:
        """Return the fraction of the range that the interval spans."""
        return (self.interval[1] - self.interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])

    @property
    def identifiable(self) -> bool:
        """Return whether the record determines this order to a useful precision."""
        narrow = self.relative_width <= WIDEST_FRACTION and not (self.open_below or self.open_above)
        return narrow and len(self.local_minima) < 2

    @property
    def admits_one(self) -> bool:
        """Return whether the interval holds the integer order 1."""
        return self.interval[0] <= 1 <= self.interval[1]


@dataclass(frozen=True, slots=True)
class Profiled:
    """Profile with the plants at its local minima.

    Attributes
    ----------
    profile : Profile
    structure : Structure
        With the order free.
    plants : tuple of Plant
        Plants at the local minima, the lowest first.
    cost : float
        The lowest sum of squares.
    """

    profile: LikelihoodProfile
    structure: Structure
    plants: tuple[Plant, ...]
    cost: float


def profile(
    candidate_set: CandidateSet, candidate: Candidate, order: Order, *, elsewhere: bool = True
) -> Profiled:
    """Walk from the minimum in both directions until the record excludes the values beyond.

    The order is freed in the structure of `candidate`, if it is not free. Each refit starts on the
    tangent of the last, and each step goes to the value at which a parabolic deviance would reach
    the next level. If much of the range is admitted and `elsewhere` is set, the remaining range is
    searched for another local minimum, and a walk starts there as well.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    candidate : Candidate
        Candidate at whose fit the walk begins.
    order : {"alpha", "lambda"}
        Order that is held at each value.
    elsewhere : bool
        Whether to search for further local minima.
    """
    walk = Walk(candidate_set, candidate, order)
    walk.both_ways()
    walk.from_candidates()
    if elsewhere:
        walk.elsewhere()
    values, deviance = walk.curve()
    bottoms = local_minima(values, deviance)
    interval, open_below, open_above = admitted(values, deviance)
    lowest = min(walk.costs.values())
    return Profiled(
        profile=LikelihoodProfile(
            order=order,
            structure=candidate.name,
            values=tuple(values.tolist()),
            deviance=tuple(deviance.tolist()),
            estimate=bottoms[0],
            local_minima=bottoms,
            interval=interval,
            open_below=open_below,
            open_above=open_above,
            gain=0.0
            if order in candidate.structure.free
            else candidate.values * math.log(max(candidate.fit.cost / lowest, 1.0)),
        ),
        structure=walk.structure,
        plants=tuple(walk.plant(value) for value in bottoms),
        cost=lowest,
    )


_ORDERS: Final[tuple[Order, Order]] = ("alpha", "lambda")
_ROUNDS: Final = 3


def profiled(
    candidate_set: CandidateSet, determined: Collection[Order] = (), *, walk: bool = True
) -> tuple[CandidateSet, LikelihoodProfile, LikelihoodProfile]:
    """Profile alpha and lambda in the freest structure.

    If a walk finds a lower cost than the candidates, or another local minimum, all candidates start
    there once more, so that the selected fit and the profile agree.

    Returns the ranked candidates and both profiles.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    determined : collection of str
        Orders that need no search for another local minimum.
    walk : bool
        Whether the orders can be determined; if not, none is profiled.
    """
    for round_ in range(1, _ROUNDS + 1):
        freest = candidate_set.freest
        # The order of an insignificant damping is undetermined: a walk would not help.
        walks = {
            order: profile(candidate_set, freest, order, elsewhere=order not in determined)
            for order in _ORDERS
            if walk and freest.structure.has(order)
        }
        before = [candidate.fit.cost for candidate in candidate_set.candidates]
        if round_ == _ROUNDS:
            break
        for found in walks.values():
            if _may_improve(candidate_set, found):
                for plant in found.plants:
                    candidate_set = candidate_set.restarted_from(plant)
        if [candidate.fit.cost for candidate in candidate_set.candidates] == before:
            break
    of_alpha, of_lambda = (
        walks[order].profile if order in walks else LikelihoodProfile.unwalked(freest, order)
        for order in _ORDERS
    )
    return candidate_set, of_alpha, of_lambda


def _may_improve(candidate_set: CandidateSet, found: Profiled) -> bool:
    """Return whether a candidate may have a lower minimum elsewhere."""
    if len(found.plants) > 1:
        return True
    free = set(found.structure.free)
    as_free = [
        candidate.fit.cost
        for candidate in candidate_set.candidates
        if free <= set(candidate.structure.free)
    ]
    return bool(as_free) and found.cost < min(as_free) * (1 - MISSED)


# Walk along an order

_FAR: Final = 25.0
_BEYOND: Final = 1.04
"""How much further a step goes than to where it should reach a deviance."""

_FIRST_STEP: Final = 0.02
_SHORTEST: Final = 1.2
_LONGEST: Final = 2.6
_MAX_EVALUATIONS: Final = 30
_TOLERANCE: Final = 1e-6
"""Relative tolerance of the sum of squares: a hundredth in the deviance."""

_NARROW: Final = 1.1
"""Between two roots of a deviance: it is straight enough there to say where it is crossed."""

_SHARPENINGS: Final = 2

_DOUBTFUL_FRACTION: Final = 0.025
"""Fraction of the range 0 to 2 within the 95 % limit from which there may be another local
minimum."""

_GRID: Final = 0.2
_TRIAL_EVALUATIONS: Final = 8
"""Spacing of the orders in that search, and evaluations at each."""


def with_order(structure: Structure, order: Order) -> Structure:
    """Return a structure with one order of its damping free.

    A missing damping is added, with a free coefficient.

    Parameters
    ----------
    structure : analysis.models.Structure
        Structure that fixes the order or lacks the damping.
    order : {"alpha", "lambda"}
        Order to be free.
    """
    coefficient = COEFFICIENT_OF[order]
    fixed = {name: at for name, at in structure.fixed.items() if name not in (coefficient, order)}
    free = tuple(name for name in PARAMETERS if name not in fixed)
    return Structure(structure.name, free, MappingProxyType(fixed))


class Walk:
    """Refits with one order held, and their costs.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    candidate : Candidate
        Candidate at whose fit the walk begins.
    order : {"alpha", "lambda"}
        Order that is held.
    """

    def __init__(self, candidate_set: CandidateSet, candidate: Candidate, order: Order) -> None:
        self.order = order
        self.structure = with_order(candidate.structure, order)
        self._field, self._values = candidate_set, candidate.values
        self._unknowns = unknowns = candidate_set.unknowns(self.structure)
        self._index = unknowns.names.index(order)
        first = candidate_set.descent(
            unknowns, unknowns.vector(candidate.fit.plant), _MAX_EVALUATIONS
        )
        self.costs: dict[float, float] = {}
        self._at: dict[float, Refit] = {}
        self._start_at(first)

    def _start_at(self, bottom: Refit) -> None:
        """Start the walk from a minimum with the order free."""
        self._first = bottom
        self._centre = float(bottom.x[self._index])
        self._store_lower(self._centre, bottom)

    def plant(self, value: float) -> Plant:
        """Return the fitted plant at a computed value."""
        return self._at[value].plant

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the values in order, shape (n,), and their deviances above the lowest."""
        values = np.array(sorted(self.costs))
        costs = np.array([self.costs[value] for value in values])
        return values, self._values * np.log(costs / costs.min())

    def both_ways(self) -> None:
        """Walk in both directions from the current minimum."""
        for sign in (-1.0, 1.0):
            self._outwards(sign)

    def from_candidates(self) -> None:
        """Walk from equally good special cases outside of the admitted interval.

        Their order is fixed, mostly to 1. A barrier may separate them from the minimum.
        """
        coefficient, free = COEFFICIENT_OF[self.order], set(self.structure.free)
        for candidate in self._field.candidates:
            special = candidate.structure.has(coefficient) and free > set(candidate.structure.free)
            if not special:
                continue
            (low, high), *_ = admitted(*self.curve())
            behind = self._values * math.log(candidate.fit.cost / min(self.costs.values()))
            if behind < CHI_SQUARE_95 and not low <= candidate.fit.parameters[self.order] <= high:
                start = self._unknowns.vector(candidate.fit.plant)
                self._start_at(self._descend(start, _MAX_EVALUATIONS, hold=(self.order,)))
                self.both_ways()

    def elsewhere(self) -> None:
        """Search for another local minimum if much of the range is admitted, and walk from it."""
        (low, high), open_below, open_above = admitted(*self.curve())
        wide = high - low > _DOUBTFUL_FRACTION * (ORDER_RANGE[1] - ORDER_RANGE[0])
        orders = gaps(list(self.costs), ORDER_RANGE, _GRID)
        if not (wide or open_below or open_above) or not orders:
            return
        # Loss at a mode and order are separate unknowns: the loss stays as the order changes.
        trials = {}
        for value in orders:
            start = self._first.x.copy()
            start[self._index] = value
            trials[value] = self._descend(start, _TRIAL_EVALUATIONS, hold=(self.order,))
        most = min(self.costs.values()) * math.exp(FAR_BEHIND / self._values)
        for value in dips({value: trial.cost for value, trial in trials.items()}):
            bottom = self._descend(
                trials[value].x, _MAX_EVALUATIONS, hopeless=(_TRIAL_EVALUATIONS, most)
            )
            values, deviance = self.curve()
            at = float(bottom.x[self._index])
            here = self._values * math.log(bottom.cost / min(self.costs.values()))
            known = float(np.interp(at, values, deviance, math.inf, math.inf))
            if here < min(CHI_SQUARE_95, known - MIN_BARRIER):
                self._start_at(bottom)
                self.both_ways()

    def _store_lower(self, value: float, found: Refit) -> None:
        """Store the lower of two refits at one value."""
        if found.cost < self.costs.get(value, math.inf):
            self.costs[value], self._at[value] = found.cost, found

    def _outwards(self, sign: float) -> None:
        """Cross the threshold, continue a little, and refine the crossing."""
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
                break  # there is a barrier between
            below, above = self._root(inside), self._root(outside)
            if above - below < _NARROW:
                break
            middle = crossing(inside, outside, below**2, above**2)
            if self._hold(middle, self._at[inside]) ** 2 < CHI_SQUARE_95:
                inside = middle
            else:
                outside = middle

    def _spread(self) -> float:
        """Return the standard deviation of the order, or a substitute."""
        (scaled, scale), index = self._first.equations.scaled_hessian(), self._index
        inverse = np.linalg.inv(scaled + 1e-12 * np.eye(scale.size))
        variance = inverse[index, index] / scale[index] ** 2
        std = math.sqrt(variance * self._first.cost / self._values) if variance > 0 else _FIRST_STEP
        return min(max(std, 1e-4), 0.25)

    def _root(self, value: float) -> float:
        """Return the root of the deviance at a value."""
        lowest = self.costs[self._centre]
        return math.sqrt(max(self._values * math.log(self.costs[value] / lowest), 0.0))

    def _hold(self, value: float, near: Refit) -> float:
        """Fit all other parameters with the order at `value`; return the root of the deviance."""
        hold, most = (self.order,), self.costs[self._centre] * math.exp(FAR_BEHIND / self._values)
        found = self._descend(
            self._tangent(value, near),
            _MAX_EVALUATIONS,
            hold=hold,
            hopeless=(_TRIAL_EVALUATIONS, most),
        )
        if found.cost > most:
            # Near its ends an order turns a loss into inertia or stiffness: the tangent may lead
            # far astray, where no descent ends. All else stays, the loss at a mode too.
            found = self._lower(found, near, value, (_TRIAL_EVALUATIONS, most))
        if found.cost > most:
            # Without the damping its order says nothing.
            found = self._lower(found, self._without_damping, value)
        self._store_lower(value, found)
        return self._root(value)

    def _lower(
        self, found: Refit, other: Refit, value: float, hopeless: tuple[int, float] | None = None
    ) -> Refit:
        """Minimize from another fit at a new value of the order; return the better of both fits."""
        start = other.x.copy()
        start[self._index] = value
        again = self._descend(start, _MAX_EVALUATIONS, hold=(self.order,), hopeless=hopeless)
        return min(found, again, key=lambda refit: refit.cost)

    @cached_property
    def _without_damping(self) -> Refit:
        """Fit without the damping of this order: the cost at any value of the order."""
        coefficient = COEFFICIENT_OF[self.order]
        start = self._first.x.copy()
        index = self._unknowns.names.index(coefficient)
        start[index] = self._unknowns.bounds[0][index]
        return self._descend(start, _MAX_EVALUATIONS, hold=(self.order, coefficient))

    def _descend(
        self,
        start: NDArray[np.float64],
        max_evaluations: int,
        *,
        hold: tuple[str, ...] = (),
        hopeless: tuple[int, float] | None = None,
    ) -> Refit:
        """Fit from a vector of unknowns, some of them held at their start."""
        candidate_set = self._field
        return Refit.descend(
            candidate_set.comparison,
            self._unknowns,
            start,
            candidate_set.noise,
            candidate_set.columns,
            max_evaluations=max_evaluations,
            relative_tolerance=_TOLERANCE,
            hold=hold,
            hopeless=hopeless,
        )

    def _tangent(self, value: float, near: Refit) -> NDArray[np.float64]:
        """Return the first-order estimate of the other unknowns with the order at `value`, (k,)."""
        x, index = near.x.copy(), self._index
        scaled, scale = near.equations.scaled_hessian()
        lower, upper = self._unknowns.bounds
        others = (x > lower) & (x < upper) & (np.arange(x.size) != index)
        block = scaled[np.ix_(others, others)] + 1e-9 * np.eye(int(others.sum()))
        slope = -np.linalg.solve(block, scaled[others, index]) / scale[others] * scale[index]
        x[others] += slope * (value - x[index])
        x[index] = value
        return x


# Limits and local minima of a profile

CHI_SQUARE_95: Final = 3.841458820694124
"""Deviance that the true value exceeds once in twenty records (one degree of freedom)."""

MIN_BARRIER: Final = 0.5
"""Deviance by which a barrier must exceed the higher of two local minima to separate them: far more
than the tolerance of the refits."""


def local_minima(values: NDArray[np.float64], deviance: NDArray[np.float64]) -> tuple[float, ...]:
    """Return the local minima within the 95 % limit, the lowest first.

    `values`, shape (n,), increase; `deviance`, shape (n,), is above the lowest.

    Parameters
    ----------
    values : ndarray of float, shape (n,)
        Values of the order, rising.
    deviance : ndarray of float, shape (n,)
        Deviance at each value, above the lowest.
    """
    padded = np.concatenate([[np.inf], deviance, [np.inf]])
    lows = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    lows = lows[deviance[lows] < CHI_SQUARE_95]
    distinct: list[int] = []
    for low in lows[np.argsort(deviance[lows], kind="stable")].tolist():
        barriers = (deviance[min(low, k) : max(low, k) + 1].max() for k in distinct)
        if all(barrier > deviance[low] + MIN_BARRIER for barrier in barriers):
            distinct.append(low)
    return tuple(values[distinct].tolist())


def admitted(
    values: NDArray[np.float64], deviance: NDArray[np.float64]
) -> tuple[tuple[float, float], bool, bool]:
    """Return the interval of all values within the 95 % limit, barriers included.

    Parameters
    ----------
    values : ndarray of float, shape (n,)
        Values of the order, rising.
    deviance : ndarray of float, shape (n,)
        Deviance at each value, above the lowest.

    Returns
    -------
    interval : tuple of float
    open_below, open_above : bool
        Whether the limit is never crossed on that side.
    """
    inside = np.flatnonzero(deviance <= CHI_SQUARE_95)
    first, last = int(inside[0]), int(inside[-1])
    low = values[0] if first == 0 else _crossing_at(values, deviance, first, first - 1)
    high = values[-1] if last == values.size - 1 else _crossing_at(values, deviance, last, last + 1)
    return (float(low), float(high)), first == 0, last == values.size - 1


def crossing(inside: float, outside: float, below: float, above: float) -> float:
    """Return the value at which the limit is crossed; the root of a deviance is almost linear.

    `inside` and `outside` are values on either side of the limit, `below` and `above` their
    deviances.

    Parameters
    ----------
    inside, outside : float
        Values on either side of the limit.
    below, above : float
        Their deviances.
    """
    low, high = math.sqrt(max(below, 0.0)), math.sqrt(max(above, 0.0))
    fraction = (math.sqrt(CHI_SQUARE_95) - low) / (high - low)
    return inside + fraction * (outside - inside)


def gaps(known: list[float], span: tuple[float, float], spacing: float) -> list[float]:
    """Return equally spaced values within a span that lie outside of all known ones.

    Parameters
    ----------
    known : list of float
        Values at which the profile is known.
    span : tuple of float
        Ends of the span.
    spacing : float
        Distance between neighbouring values.
    """
    grid = np.arange(span[0] + spacing / 2, span[1], spacing).tolist()
    low, high = min(known), max(known)
    return [value for value in grid if value < low - spacing / 4 or value > high + spacing / 4]


def dips(curve: dict[float, float]) -> list[float]:
    """Return the values on a coarse curve that are lower than both neighbours, ends included."""
    values = sorted(curve)
    heights = [math.inf, *(curve[value] for value in values), math.inf]
    return [
        value
        for value, (before, here, after) in zip(
            values, zip(heights, heights[1:], heights[2:], strict=False), strict=True
        )
        if here <= before and here <= after
    ]


def _crossing_at(
    values: NDArray[np.float64], deviance: NDArray[np.float64], inside: int, outside: int
) -> float:
    return crossing(
        float(values[inside]),
        float(values[outside]),
        float(deviance[inside]),
        float(deviance[outside]),
    )
