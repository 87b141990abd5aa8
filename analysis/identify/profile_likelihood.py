"""Profile likelihood of the damping orders: all other parameters are refitted at each value.

The 95 % interval contains all values within the chi-square limit of one degree of freedom. The
order is varied from the minimum in both directions until the record excludes the values beyond. A
coarse grid of orders finds other local minima.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._candidate import HOPELESS_BIC_DIFFERENCE
from analysis.identify._refit import MISSED_MINIMUM_COST_FRACTION, Refit
from analysis.identify.deviance_curve import (
    CHI_SQUARE_95,
    MIN_BARRIER_DEVIANCE,
    local_minima,
    order_at_deviance_limit,
    order_interval_95,
    orders_outside_known_range,
    values_at_local_minima,
)
from analysis.models import ORDER_RANGE
from rigd.beam import COEFFICIENT_OF

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.models import Structure
    from rigd.beam import Plant


# Profile

OrderName = Literal["alpha", "lambda"]
"""Name of a damping order: alpha of internal, lambda of external damping."""

MAX_IDENTIFIABLE_FRACTION: Final = 0.25
"""Largest 95 % interval of an identifiable order, as a fraction of the range 0 to 2: an order with
±0.25 does not distinguish materials."""


@dataclass(frozen=True, slots=True)
class LikelihoodProfile:
    """Deviance over the values of one damping order, with all other parameters refitted.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    structure : str
        Name of the structure in which the order was free.
    values : tuple of float
        Values of the order, in increasing order.
    deviance : tuple of float
        Deviance at each value, minus the lowest one.
    estimate : float
        Value with the lowest deviance.
    local_minima : tuple of float
        Values at the local minima within the 95 % limit that a barrier separates, the one with the
        lowest deviance first. They explain the record equally well.
    interval : tuple of float
        95 % interval by the likelihood ratio, over all local minima. An open interval ends at the
        edge of the range.
    open_below, open_above : bool
        Whether the record excludes no smaller value, and no larger value.
    gain : float
        Reduction of deviance by freeing the order. 0 if the order was free in the candidate.
    """

    order: OrderName
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
    def undetermined(cls, candidate: Candidate, order: OrderName) -> LikelihoodProfile:
        """Return the profile of an order that was not varied: one value, and interval 0 to 2.

        Parameters
        ----------
        candidate : Candidate
            Fit that provides the single value.
        order : str
            "alpha" or "lambda".
        """
        fitted = candidate.fit.parameters[order]
        return cls(
            order, candidate.name, (fitted,), (0.0,), fitted, (fitted,), ORDER_RANGE,
            True, True, 0.0,
        )  # fmt: skip

    @property
    def is_computed(self) -> bool:
        """Return whether deviances were computed for more than one value of the order."""
        return len(self.values) > 1

    @property
    def relative_width(self) -> float:
        """Return the width of the 95 % interval as a fraction of the range 0 to 2."""
        return (self.interval[1] - self.interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])

    @property
    def identifiable(self) -> bool:
        """Return whether the 95 % interval is narrow and closed, and contains one local minimum."""
        is_narrow = self.relative_width <= MAX_IDENTIFIABLE_FRACTION and not (
            self.open_below or self.open_above
        )
        return is_narrow and len(self.local_minima) < 2

    @property
    def admits_one(self) -> bool:
        """Return whether the 95 % interval contains the integer order 1."""
        return self.interval[0] <= 1 <= self.interval[1]


@dataclass(frozen=True, slots=True)
class ProfileWithPlants:
    """Likelihood profile of one damping order, with the fitted plants at its local minima.

    Attributes
    ----------
    profile : LikelihoodProfile
        Deviance over the values of the order.
    structure : Structure
        Structure in which the order is free.
    plants : tuple of Plant
        Fitted plants at the local minima, the one with the lowest deviance first.
    cost : float
        Lowest sum of squares of the whitened residual.
    """

    profile: LikelihoodProfile
    structure: Structure
    plants: tuple[Plant, ...]
    cost: float


def profile(
    candidate_set: CandidateSet,
    candidate: Candidate,
    order: OrderName,
    *,
    search_other_minima: bool = True,
) -> ProfileWithPlants:
    """Compute the profile likelihood of one order of a candidate.

    The order is varied from the minimum in both directions until the record excludes the values
    beyond. It is freed in the structure of `candidate`, if it is not free. Each refit starts from
    unknowns extrapolated linearly from the last one, and each step goes to the value at which a
    parabolic deviance would reach the next level. If much of the range is admitted and
    `search_other_minima` is set, the remaining range is searched for another local minimum, from
    which the order is varied as well.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    candidate : Candidate
        Candidate at whose fit the profile begins.
    order : {"alpha", "lambda"}
        Order that is fixed at each value.
    search_other_minima : bool
        Whether to search for further local minima.
    """
    profiler = OrderProfiler(candidate_set, candidate, order)
    profiler.extend_both_ways()
    profiler.extend_from_candidates()
    if search_other_minima:
        profiler.extend_from_other_minima()
    order_values, deviances = profiler.curve()
    minimum_values = local_minima(order_values, deviances)
    order_interval, open_below, open_above = order_interval_95(order_values, deviances)
    lowest_cost = min(profiler.costs.values())
    return ProfileWithPlants(
        profile=LikelihoodProfile(
            order=order,
            structure=candidate.name,
            values=tuple(order_values.tolist()),
            deviance=tuple(deviances.tolist()),
            estimate=minimum_values[0],
            local_minima=minimum_values,
            interval=order_interval,
            open_below=open_below,
            open_above=open_above,
            gain=0.0
            if order in candidate.structure.free
            else candidate.compared_value_count
            * math.log(max(candidate.fit.cost / lowest_cost, 1.0)),
        ),
        structure=profiler.structure,
        plants=tuple(profiler.plant(order_value) for order_value in minimum_values),
        cost=lowest_cost,
    )


_BOTH_ORDERS: Final[tuple[OrderName, OrderName]] = ("alpha", "lambda")
"""Orders of internal and external damping, as they are returned."""

_MAX_PROFILE_ROUNDS: Final = 3
"""Largest number of times that both profiles are computed."""


def profile_both_orders(
    candidate_set: CandidateSet, determined: Collection[OrderName] = (), *, compute: bool = True
) -> tuple[CandidateSet, LikelihoodProfile, LikelihoodProfile]:
    """Compute the profiles of alpha and lambda in the freest structure.

    If a profile finds a lower cost than the candidates, or another local minimum, all candidates
    are refitted from there, so that the selected fit and the profile agree.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    determined : collection of str
        Orders that need no search for another local minimum.
    compute : bool
        Whether to compute the profiles. If not, each has a single value.

    Returns
    -------
    candidate_set : CandidateSet
        Ranked candidates, refitted if a profile found a lower minimum.
    alpha, lambda_ : LikelihoodProfile
        Profiles of both orders.
    """
    for round_index in range(1, _MAX_PROFILE_ROUNDS + 1):
        freest_candidate = candidate_set.freest
        # The order of an insignificant damping is undetermined: no profile would help.
        profiles = {
            order: profile(
                candidate_set, freest_candidate, order, search_other_minima=order not in determined
            )
            for order in _BOTH_ORDERS
            if compute and freest_candidate.structure.has_damping_of(order)
        }
        costs_before = [candidate.fit.cost for candidate in candidate_set.candidates]
        if round_index == _MAX_PROFILE_ROUNDS:
            break
        for profile_fit in profiles.values():
            if _may_improve(candidate_set, profile_fit):
                for minimum_plant in profile_fit.plants:
                    candidate_set = candidate_set.restart_from_plant(minimum_plant)
        if [candidate.fit.cost for candidate in candidate_set.candidates] == costs_before:
            break
    alpha_profile, lambda_profile = (
        profiles[order].profile
        if order in profiles
        else LikelihoodProfile.undetermined(freest_candidate, order)
        for order in _BOTH_ORDERS
    )
    return candidate_set, alpha_profile, lambda_profile


def _may_improve(candidate_set: CandidateSet, profile_fit: ProfileWithPlants) -> bool:
    """Return whether a fit that starts at the minima of a profile may improve a candidate.

    That is so if the profile has other minima, or a lower sum of squares.
    """
    if len(profile_fit.plants) > 1:
        return True
    free_names = set(profile_fit.structure.free)
    candidate_costs = [
        candidate.fit.cost
        for candidate in candidate_set.candidates
        if free_names <= set(candidate.structure.free)
    ]
    return bool(candidate_costs) and profile_fit.cost < min(candidate_costs) * (
        1 - MISSED_MINIMUM_COST_FRACTION
    )


# Profile of one order

_MAX_PROFILE_DEVIANCE: Final = 25.0
"""Deviance up to which the order is varied. The 95 % limit is 3.84."""

_STEP_OVERSHOOT_FACTOR: Final = 1.04
"""Factor by which a step goes beyond the value at which the deviance should reach its level."""

_DEFAULT_ORDER_STD: Final = 0.02
"""Substitute for the standard deviation of the order if the curvature does not give one."""

_MIN_DISTANCE_GROWTH: Final = 1.2
"""Smallest factor by which a step increases the distance from the minimum."""

_MAX_DISTANCE_GROWTH: Final = 2.6
"""Largest factor by which a step increases the distance from the minimum."""

_MAX_EVALUATIONS: Final = 30
"""Largest number of evaluations of the sum of squares in one refit."""

_COST_TOLERANCE: Final = 1e-6
"""Relative tolerance of the sum of squares in a refit, equivalent to 0.01 of the deviance."""

_INTERPOLATION_ROOT_DIFFERENCE: Final = 1.1
"""Difference of the roots of two deviances below which the root is straight enough to interpolate
the limit."""

_MAX_LIMIT_REFITS: Final = 2
"""Largest number of refits that narrow down the value at the 95 % limit."""

_DOUBTFUL_INTERVAL_FRACTION: Final = 0.025
"""Admitted fraction of the range 0 to 2 from which another local minimum is searched for."""

_TRIAL_ORDER_SPACING: Final = 0.2
"""Distance between the orders in the search for another local minimum."""

_TRIAL_EVALUATIONS: Final = 8
"""Evaluations of the sum of squares at each order of this search."""


def with_free_order(structure: Structure, order: OrderName) -> Structure:
    """Return a structure with one order of its damping free.

    A missing damping is added, with a free coefficient.

    Parameters
    ----------
    structure : analysis.models.Structure
        Structure that fixes the order or lacks the damping.
    order : {"alpha", "lambda"}
        Order to be free.
    """
    damping_coefficient = COEFFICIENT_OF[order]
    fixed_values = {
        parameter_name: at
        for parameter_name, at in structure.fixed.items()
        if parameter_name not in (damping_coefficient, order)
    }
    return replace(structure, fixed=fixed_values)


class OrderProfiler:
    """Profile of one damping order under construction: refits at fixed values, and their costs.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    candidate : Candidate
        Candidate at whose fit the profile begins.
    order : {"alpha", "lambda"}
        Order that is fixed at each value.
    """

    def __init__(self, candidate_set: CandidateSet, candidate: Candidate, order: OrderName) -> None:
        self.order = order
        self.structure = with_free_order(candidate.structure, order)
        self._candidate_set, self._value_count = candidate_set, candidate.compared_value_count
        self._unknowns = unknowns = candidate_set.unknowns(self.structure)
        self._order_index = unknowns.names.index(order)
        first_minimum = candidate_set.descend_from_vector(
            unknowns, unknowns.vector(candidate.fit.plant), _MAX_EVALUATIONS
        )
        self.costs: dict[float, float] = {}
        self._refits: dict[float, Refit] = {}
        self._start_at(first_minimum)

    def _start_at(self, free_order_fit: Refit) -> None:
        """Store a fit with free order as the minimum from which the profile is continued."""
        self._minimum = free_order_fit
        self._minimum_order = float(free_order_fit.x[self._order_index])
        self._store_lower(self._minimum_order, free_order_fit)

    def plant(self, order_value: float) -> Plant:
        """Return the fitted plant at a value of the order that has been computed."""
        return self._refits[order_value].plant

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the computed order values, increasing, and their deviances, each of shape (n,)."""
        order_values = np.array(sorted(self.costs))
        order_costs = np.array([self.costs[order_value] for order_value in order_values])
        return order_values, self._value_count * np.log(order_costs / order_costs.min())

    def extend_both_ways(self) -> None:
        """Extend the profile in both directions from the current minimum."""
        for direction in (-1.0, 1.0):
            self._extend(direction)

    def extend_from_candidates(self) -> None:
        """Extend the profile from candidates that fit about as well with a very different order.

        The order is outside of the 95 % interval; most of these candidates fix it at 1. A barrier
        may separate it from the minimum.
        """
        damping_coefficient, free_parameters = COEFFICIENT_OF[self.order], set(self.structure.free)
        for candidate in self._candidate_set.candidates:
            is_special_case = candidate.structure.has_damping_of(
                damping_coefficient
            ) and free_parameters > set(candidate.structure.free)
            if not is_special_case:
                continue
            (lower_end, upper_end), *_ = order_interval_95(*self.curve())
            candidate_deviance = self._value_count * math.log(
                candidate.fit.cost / min(self.costs.values())
            )
            if (
                candidate_deviance < CHI_SQUARE_95
                and not lower_end <= candidate.fit.parameters[self.order] <= upper_end
            ):
                start_unknowns = self._unknowns.vector(candidate.fit.plant)
                self._start_at(
                    self._descend(start_unknowns, _MAX_EVALUATIONS, held_unknowns=(self.order,))
                )
                self.extend_both_ways()

    def extend_from_other_minima(self) -> None:
        """Search for other local minima if the 95 % interval covers much of the range of the order.

        Extend the profile from each of them.
        """
        (lower_end, upper_end), open_below, open_above = order_interval_95(*self.curve())
        is_interval_wide = upper_end - lower_end > _DOUBTFUL_INTERVAL_FRACTION * (
            ORDER_RANGE[1] - ORDER_RANGE[0]
        )
        trial_orders = orders_outside_known_range(
            list(self.costs), ORDER_RANGE, _TRIAL_ORDER_SPACING
        )
        if not (is_interval_wide or open_below or open_above) or not trial_orders:
            return
        # Loss and order are separate unknowns: the loss stays constant as the order changes.
        trial_fits = {}
        for trial_order in trial_orders:
            start_unknowns = self._minimum.x.copy()
            start_unknowns[self._order_index] = trial_order
            trial_fits[trial_order] = self._descend(
                start_unknowns, _TRIAL_EVALUATIONS, held_unknowns=(self.order,)
            )
        highest_cost = min(self.costs.values()) * math.exp(
            HOPELESS_BIC_DIFFERENCE / self._value_count
        )
        for trial_order in values_at_local_minima(
            {trial_order: trial_fit.cost for trial_order, trial_fit in trial_fits.items()}
        ):
            refined_fit = self._descend(
                trial_fits[trial_order].x,
                _MAX_EVALUATIONS,
                hopeless=(_TRIAL_EVALUATIONS, highest_cost),
            )
            order_values, deviances = self.curve()
            order_at_minimum = float(refined_fit.x[self._order_index])
            minimum_deviance = self._value_count * math.log(
                refined_fit.cost / min(self.costs.values())
            )
            known_deviance = float(
                np.interp(order_at_minimum, order_values, deviances, math.inf, math.inf)
            )
            if minimum_deviance < min(CHI_SQUARE_95, known_deviance - MIN_BARRIER_DEVIANCE):
                self._start_at(refined_fit)
                self.extend_both_ways()

    def _store_lower(self, order_value: float, refit: Refit) -> None:
        """Store the fit with the order fixed at a value, unless a stored one has a lower cost."""
        if refit.cost < self.costs.get(order_value, math.inf):
            self.costs[order_value], self._refits[order_value] = refit.cost, refit

    def _extend(self, direction_sign: float) -> None:
        """Extend the profile in one direction until the record excludes the values beyond.

        Then refine the value at which the deviance crosses the 95 % limit.
        """
        smallest_order, largest_order = ORDER_RANGE
        order_value, order_distance, deviance_root = self._minimum_order, self._order_std(), 0.0
        inside_order, outside_order = order_value, None
        while (
            smallest_order < order_value < largest_order
            and deviance_root**2 < _MAX_PROFILE_DEVIANCE
        ):
            nearest_refit = self._refits[order_value]
            order_value = min(
                max(self._minimum_order + direction_sign * order_distance, smallest_order),
                largest_order,
            )
            deviance_root = self._refit_at(order_value, nearest_refit)
            if deviance_root**2 < CHI_SQUARE_95:
                inside_order, target_deviance = order_value, CHI_SQUARE_95
            else:
                outside_order, target_deviance = (
                    outside_order if outside_order is not None else order_value,
                    _MAX_PROFILE_DEVIANCE,
                )
            distance_growth = (
                _STEP_OVERSHOOT_FACTOR * math.sqrt(target_deviance) / max(deviance_root, 1e-3)
            )
            order_distance *= min(max(distance_growth, _MIN_DISTANCE_GROWTH), _MAX_DISTANCE_GROWTH)
        for _ in range(_MAX_LIMIT_REFITS if outside_order is not None else 0):
            assert outside_order is not None
            if abs(inside_order - self._minimum_order) >= abs(outside_order - self._minimum_order):
                break  # there is a barrier between
            inside_root, outside_root = (
                self._deviance_root(inside_order),
                self._deviance_root(outside_order),
            )
            if outside_root - inside_root < _INTERPOLATION_ROOT_DIFFERENCE:
                break
            trial_order = order_at_deviance_limit(
                inside_order, outside_order, inside_root**2, outside_root**2
            )
            if self._refit_at(trial_order, self._refits[inside_order]) ** 2 < CHI_SQUARE_95:
                inside_order = trial_order
            else:
                outside_order = trial_order

    def _order_std(self) -> float:
        """Return the standard deviation of the order at the minimum, limited to 1e-4 to 0.25."""
        (scaled_hessian, hessian_scale), order_index = (
            self._minimum.equations.scaled_hessian(),
            self._order_index,
        )
        inverse_hessian = np.linalg.inv(scaled_hessian + 1e-12 * np.eye(hessian_scale.size))
        variance = inverse_hessian[order_index, order_index] / hessian_scale[order_index] ** 2
        std = (
            math.sqrt(variance * self._minimum.cost / self._value_count)
            if variance > 0
            else _DEFAULT_ORDER_STD
        )
        return min(max(std, 1e-4), 0.25)

    def _deviance_root(self, order_value: float) -> float:
        """Return the square root of the deviance at an order value whose fit is stored."""
        lowest_cost = self.costs[self._minimum_order]
        return math.sqrt(
            max(self._value_count * math.log(self.costs[order_value] / lowest_cost), 0.0)
        )

    def _refit_at(self, order_value: float, nearest_refit: Refit) -> float:
        """Fit all other parameters with the order fixed at a value, and store the fit.

        Return the square root of its deviance.
        """
        fixed_names, highest_cost = (
            (self.order,),
            self.costs[self._minimum_order] * math.exp(HOPELESS_BIC_DIFFERENCE / self._value_count),
        )
        refit = self._descend(
            self._extrapolated_unknowns(order_value, nearest_refit),
            _MAX_EVALUATIONS,
            held_unknowns=fixed_names,
            hopeless=(_TRIAL_EVALUATIONS, highest_cost),
        )
        if refit.cost > highest_cost:
            # Near 0 and 2 damping acts as stiffness or inertia, and the extrapolation may lead to a
            # point from which no descent converges. So all other unknowns keep their values.
            refit = self._better_refit(
                refit, nearest_refit, order_value, (_TRIAL_EVALUATIONS, highest_cost)
            )
        if refit.cost > highest_cost:
            # Without the damping its order has no effect on the cost.
            refit = self._better_refit(refit, self._without_damping, order_value)
        self._store_lower(order_value, refit)
        return self._deviance_root(order_value)

    def _better_refit(
        self,
        first_refit: Refit,
        start_refit: Refit,
        order_value: float,
        hopeless: tuple[int, float] | None = None,
    ) -> Refit:
        """Fit with the order fixed at a value, starting at the unknowns of `start_refit`.

        Return this fit or `first_refit`, whichever has the lower cost.
        """
        start_unknowns = start_refit.x.copy()
        start_unknowns[self._order_index] = order_value
        second_refit = self._descend(
            start_unknowns, _MAX_EVALUATIONS, held_unknowns=(self.order,), hopeless=hopeless
        )
        return min(first_refit, second_refit, key=lambda refit: refit.cost)

    @cached_property
    def _without_damping(self) -> Refit:
        """Return the fit with the smallest damping, for which the cost is the same at any order."""
        damping_coefficient = COEFFICIENT_OF[self.order]
        start_unknowns = self._minimum.x.copy()
        coefficient_index = self._unknowns.names.index(damping_coefficient)
        start_unknowns[coefficient_index] = self._unknowns.bounds[0][coefficient_index]
        return self._descend(
            start_unknowns, _MAX_EVALUATIONS, held_unknowns=(self.order, damping_coefficient)
        )

    def _descend(
        self,
        start_unknowns: NDArray[np.float64],
        max_evaluations: int,
        *,
        held_unknowns: tuple[str, ...] = (),
        hopeless: tuple[int, float] | None = None,
    ) -> Refit:
        """Minimize the sum of squares from a vector of unknowns, with some unknowns fixed."""
        candidate_set = self._candidate_set
        return Refit.descend(
            candidate_set.comparison,
            self._unknowns,
            start_unknowns,
            candidate_set.noise,
            candidate_set.effect_spectra,
            max_evaluations=max_evaluations,
            relative_tolerance=_COST_TOLERANCE,
            fixed_unknowns=held_unknowns,
            give_up_condition=hopeless,
        )

    def _extrapolated_unknowns(
        self, order_value: float, nearest_refit: Refit
    ) -> NDArray[np.float64]:
        """Extrapolate the optimal unknowns linearly to another value of the order, shape (k,)."""
        x, order_index = nearest_refit.x.copy(), self._order_index
        scaled_hessian, hessian_scale = nearest_refit.equations.scaled_hessian()
        lower_bounds, upper_bounds = self._unknowns.bounds
        is_free = (x > lower_bounds) & (x < upper_bounds) & (np.arange(x.size) != order_index)
        free_hessian = scaled_hessian[np.ix_(is_free, is_free)] + 1e-9 * np.eye(int(is_free.sum()))
        unknown_slopes = (
            -np.linalg.solve(free_hessian, scaled_hessian[is_free, order_index])
            / hessian_scale[is_free]
            * hessian_scale[order_index]
        )
        x[is_free] += unknown_slopes * (order_value - x[order_index])
        x[order_index] = order_value
        return x
