"""Headline numbers of a record: from the freest structure that it supports, with flags.

A structure that fixes an order gives narrow intervals, which are valid only if that order is right,
and the criterion that selected the structure tolerates an error of 2.7 standard deviations. So the
reported numbers are those of the structure with every order free: its intervals are valid whichever
simpler structure is true. The numbers of a simpler structure are reported in addition, as a
conditional estimate.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, Self

from analysis.identify._uncertainty import interval_from_zero
from analysis.identify.verdict import (
    EXCLUSION_DEVIANCES,
    SECOND_DAMPING_REASON,
    WITH_DRAG_REASON,
)
from analysis.statistics import BIC_DECISIVE, NORMAL_95
from rigd.beam import BEAM_PARAMETERS, COEFFICIENT_OF
from rigd.estimates import Estimate, ReportedMode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._estimates import ModeEstimate, PivotLossFactor
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify._result import RecordFit
    from analysis.identify.beam_uniformity import UniformBeamTest
    from analysis.identify.tolerant_estimate import TolerantEstimate
    from analysis.identify.verdict import OrderVerdict

EXACTLY_UNIFORM_CONDITION: Final = "if the beam is uniform to 1e-5"
"""Condition of the estimates on an exactly uniform beam."""

UNEXPLAINED_REASON: Final = "part of the record is unexplained"
"""Reason against all numbers if the residual is more than noise."""

TILTED_AXIS_REASON: Final = "the axis is tilted, and fits to the whole record assume a plumb axis"
"""Reason against the estimates on an exactly uniform beam if the axis is tilted."""

HIDDEN_RESPONSE_REASON: Final = (
    "the response to the motor cannot be distinguished from a ringing of the beam when the record "
    "began"
)
"""Reason against all numbers if the motor moves too early in the record, or too little."""

DAMPING_AT_LIMIT_REASON: Final = (
    "the damping ratio of a mode is at the edge of the range searched, 50 %"
)
"""Reason against all numbers if a mode may be damped more than any that is searched for."""

COARSE_ENCODER_REASON: Final = (
    "at a sharp resonance, the steps of the encoder exceed the noise of the torque"
)
"""Reason against all numbers if the rounding of the angle is the largest noise at a mode."""

CONTRADICTED_FILE_REASON: Final = "the record contradicts its file"
"""Reason against all numbers if a sign or unit of the file is wrong."""

_EMPTY_MAPPING: Final[Mapping[str, Any]] = MappingProxyType({})
"""Empty mapping, the default of optional mappings."""

_NOT_IDENTIFIABLE_FLAG: Final = "not identifiable from this record"
"""Flag of a parameter without interval."""

_AT_BOUND_FLAG: Final = "at the edge of the range searched"
"""Flag of a parameter that rests on a bound."""

_DAMPING_ORDER_LIMITS: Final = (0.3, 1.7)
"""Orders beyond which a damping whose order is not determined acts as a stiffness (order 0) or as a
mass (order 2): the values of the beam then are those without it, and can be wrong by any factor."""

_MODES_TO_SEPARATE_DAMPINGS: Final = 2
"""Number of visible modes from which internal and external damping are separable."""

_NOT_SEPARABLE_FLAG: Final = "not separable from a damping of unknown order"
"""Flag of the beam parameters if a damping is not separable from them: damping of a low order acts
as stiffness, damping of an order near 2 as inertia."""

ONE_MODE_REASON: Final = "one mode alone does not separate internal from external damping"
"""Flag of both loss factors if the record shows a single mode."""

_STIFFNESS_LAW_FLAG: Final = (
    "the stiffness depends on the deflection, and only its lowest power was fitted"
)
"""Flag of the parameters that depend on the assumed law of the nonlinear stiffness."""

StructureStatus = Literal["selected", "compatible", "excluded"]
"""Relation of a structure to the record."""

Damping = Literal["internal", "external"]
"""Kind of damping: of the material, or of the surroundings."""

DAMPING_PARAMETER_NAMES: Final[Mapping[Damping, tuple[str, str]]] = {
    "internal": ("zeta", "alpha"),
    "external": ("gamma", "lambda"),
}
"""Names of the coefficient and the order of each damping."""

_DAMPINGS: Final[tuple[Damping, Damping]] = ("internal", "external")
"""Internal damping, then external damping: the order in which loss factors are reported."""


@dataclass(frozen=True, slots=True)
class ReportedLossFactor:
    """Loss factor of one damping at its pivot frequency, where it depends least on the order.

    Attributes
    ----------
    damping : str
        "internal" or "external".
    omega_rad_s : float or None
        Pivot frequency in rad/s. None if the order is fixed: `size` is the coefficient then.
    size : Estimate
        Value of the loss factor, as in `PivotLossFactor`.
    """

    damping: Damping
    omega_rad_s: float | None
    size: Estimate

    @property
    def order(self) -> str:
        """Return the name of the order of this damping: "alpha" or "lambda"."""
        return DAMPING_PARAMETER_NAMES[self.damping][1]

    def with_flag(self, flag: str | None) -> ReportedLossFactor:
        """Return the loss factor with a flag, unless it already has one.

        Parameters
        ----------
        flag : str or None
            Reason why the loss factor is not valid. None changes nothing.
        """
        return replace(self, size=self.size.with_flag(flag))


@dataclass(frozen=True, slots=True)
class ConditionalEstimate:
    """Parameter estimates of a simpler structure, valid if this structure is true.

    Attributes
    ----------
    name : str
        Name of the structure in tables.
    fixed : mapping of str to float
        Assumed values of the orders "alpha" and "lambda".
    parameters : mapping of str to Estimate
        Estimates, by the names of `RecordFit`.
    """

    name: str
    fixed: Mapping[str, float]
    parameters: Mapping[str, Estimate]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates from one record or a campaign, without an assumption on the orders.

    Attributes
    ----------
    name : str
        Name, in tables, of the freest structure that the data support.
    parameters : mapping of str to Estimate
        Parameters of the structure, by the names of `RecordFit`.
    sizes : tuple of ReportedLossFactor
        Loss factors of the dampings, the internal one first.
    modes : tuple of ReportedMode
        Modes of the beam with locked hub.
    structures : tuple of (str, str)
        Name of every fitted structure in tables, and its status: "selected" for the reported one,
        "compatible" or "excluded".
    simpler : ConditionalEstimate or None
        Estimates of the simplest sufficient structure. None if the reported one is the simplest.
    drag_speed_m_s : float or None
        Speed at which the parameter ``drag`` is reported. None without drag.
    exact : Estimates or None
        Estimates on condition that the beam is uniform to 1e-5. None if these estimates assume
        this already.
    uniform_beam : UniformBeamTest or None
        Test of whether a uniform beam predicts the modal constants. None if no mode is visible.
    tolerant : TolerantEstimate or None
        Source of parameters and sizes, if they include a tolerance of the geometry.
    modal : ModalEstimate or None
        Fit of the modal model. None if no mode is visible.
    """

    name: str
    parameters: Mapping[str, Estimate]
    sizes: tuple[ReportedLossFactor, ...]
    modes: tuple[ReportedMode, ...]
    structures: tuple[tuple[str, StructureStatus], ...]
    simpler: ConditionalEstimate | None
    drag_speed_m_s: float | None
    _: KW_ONLY
    exact: Estimates | None = None
    uniform_beam: UniformBeamTest | None = None
    tolerant: TolerantEstimate | None = None
    modal: ModalEstimate | None = None

    def with_flag_on_all(self, flag: str) -> Self:
        """Return the estimates with a given flag on every number that has no flag yet.

        Parameters
        ----------
        flag : str
            Reason why the numbers are not valid.
        """
        return replace(
            self,
            parameters={
                parameter_name: each.with_flag(flag)
                for parameter_name, each in self.parameters.items()
            },
            sizes=tuple(each.with_flag(flag) for each in self.sizes),
            modes=tuple(
                replace(
                    each,
                    frequency_hz=each.frequency_hz.with_flag(flag),
                    damping_ratio=each.damping_ratio.with_flag(flag),
                    participation=each.participation and each.participation.with_flag(flag),
                )
                for each in self.modes
            ),
            simpler=self.simpler
            and replace(
                self.simpler,
                parameters={
                    parameter_name: each.with_flag(flag)
                    for parameter_name, each in self.simpler.parameters.items()
                },
            ),
        )


@dataclass(frozen=True, slots=True)
class Headline(Estimates):
    """Reported numbers of one record, and the fit that provides them.

    Attributes
    ----------
    fit : RecordFit
        Fit of the freest structure that the record supports.
    is_explained : bool
        Whether the residual of this fit is noise only. If not, every number carries a flag.
    with_both : RecordFit
        Fit with internal and external damping, which provides the modes.
    modal : ModalFit or None
        Fit of the modal model. None if no mode is visible.
    """

    fit: RecordFit
    is_explained: bool
    with_both: RecordFit
    modal: ModalFit | None = field(default=None, kw_only=True)

    @property
    def flags(self) -> dict[str, str]:
        """Return the reasons why flagged parameters are not valid, by parameter name."""
        return {name: each.flag for name, each in self.parameters.items() if each.flag}

    @property
    def visible_modes(self) -> tuple[int, ...]:
        """Return the numbers of the modes that the record shows."""
        return tuple(reported_mode.number for reported_mode in self.modes if reported_mode.shown)

    def with_stiffness_law_flag(self) -> Headline:
        """Return the headline with a flag on numbers that depend on the assumed stiffness law."""
        return replace(
            self,
            parameters={
                name: each.with_flag(_STIFFNESS_LAW_FLAG)
                if name == "density_over_stiffness"
                else each
                for name, each in self.parameters.items()
            },
            modes=tuple(
                replace(each, frequency_hz=each.frequency_hz.with_flag(_STIFFNESS_LAW_FLAG))
                for each in self.modes
            ),
        )

    def structures_with_status(self, status: StructureStatus) -> tuple[str, ...]:
        """Return the names of the structures with a given status.

        Parameters
        ----------
        status : str
            "selected", "compatible" or "excluded".
        """
        return tuple(
            structure_name
            for structure_name, structure_status in self.structures
            if structure_status == status
        )


def headline(
    candidate_set: CandidateSet,
    order_verdicts: tuple[OrderVerdict, OrderVerdict],
    visible_numbers: tuple[int, ...],
    *,
    unexplained_reason: str | None,
) -> Headline:
    """Return the headline from the freest structure of a candidate set.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    order_verdicts : tuple of OrderVerdict
        Verdicts on alpha and lambda.
    visible_numbers : tuple of int
        Numbers of the visible modes.
    unexplained_reason : str or None
        Reason against every number. None if the residual is noise only.
    """
    freest = candidate_set.freest
    fractional_orders = frozenset(
        each.order for each in order_verdicts if each.status == "fractional"
    )
    order_reasons: dict[str, str] = {
        each.order: each.reason for each in order_verdicts if each.reason is not None
    }
    order_intervals: dict[str, tuple[float, float]] = {
        each.order: each.profile.interval
        for each in order_verdicts
        if each.profile.is_computed and each.order in freest.structure.free
    }
    reported_headline = headline_of_fit(
        freest.name, freest.fit, visible_numbers, order_reasons, order_intervals,
        unexplained_reason, candidate_set.fit_with_both_dampings(freest),
    )  # fmt: skip
    if candidate_set.drag is not None:
        drag_estimate = candidate_set.drag
        reported_drag = Estimate(
            drag_estimate.drag_m,
            drag_estimate.std_m,
            drag_estimate.interval_95_m,
            unexplained_reason,
        )
        loss_factors = (
            each.with_flag(WITH_DRAG_REASON) if each.damping == "external" else each
            for each in reported_headline.sizes
        )
        reported_headline = replace(
            reported_headline,
            parameters={**reported_headline.parameters, "drag": reported_drag},
            sizes=tuple(loss_factors),
            drag_speed_m_s=drag_estimate.pivot_speed_m_s,
        )
    conditional_estimate = (
        _conditional_estimate(candidate_set, fractional_orders)
        if unexplained_reason is None
        else None
    )
    return replace(
        reported_headline,
        structures=structures(candidate_set, fractional_orders),
        simpler=conditional_estimate,
    )


def headline_of_fit(
    name: str,
    fit: RecordFit,
    visible_numbers: Collection[int],
    order_reasons: Mapping[str, str] = _EMPTY_MAPPING,
    order_intervals: Mapping[str, tuple[float, float]] = _EMPTY_MAPPING,
    unexplained_reason: str | None = None,
    fit_with_both_dampings: tuple[RecordFit, bool] | None = None,
) -> Headline:
    """Return the headline of one fit, with flags on the numbers that are not valid.

    Parameters
    ----------
    name : str
        Name of the structure in tables.
    fit : RecordFit
        Fit whose parameters are reported.
    visible_numbers : collection of int
        Numbers of the modes that the record shows.
    order_reasons : mapping of str to str
        Reasons against "alpha" or "lambda", which also apply to the coefficients.
    order_intervals : mapping of str to (float, float)
        95 % intervals of orders, used instead of those of the fit.
    unexplained_reason : str, optional
        Reason against all numbers.
    fit_with_both_dampings : tuple of (RecordFit, bool), optional
        Result of `CandidateSet.fit_with_both_dampings`: the fit with both dampings, for the modes.
    """
    fit_with_both, uses_both = fit_with_both_dampings or (fit, False)
    damping_reason = ONE_MODE_REASON if len(visible_numbers) < _MODES_TO_SEPARATE_DAMPINGS else None
    if SECOND_DAMPING_REASON in order_reasons.values():
        damping_reason = SECOND_DAMPING_REASON
    parameter_flags: dict[str, str] = {
        parameter_name: order_reason
        for order_name, order_reason in order_reasons.items()
        for parameter_name in (order_name, COEFFICIENT_OF[order_name])
    }
    lowest_order, highest_order = _DAMPING_ORDER_LIMITS
    acts_as_stiffness_or_mass = any(
        not lowest_order < fit.parameters[order_name] < highest_order
        for order_name in order_reasons
        if fit.structure.has_damping_of(order_name)
    )
    if (
        damping_reason
        or acts_as_stiffness_or_mass
        or not COEFFICIENT_OF.keys().isdisjoint(fit.at_bounds)
    ):
        # A delay turns the phase of a mode as its damping does.
        parameter_flags |= dict.fromkeys((*BEAM_PARAMETERS, "delay_s"), _NOT_SEPARABLE_FLAG)
    if acts_as_stiffness_or_mass:
        # The other damping is relative to that stiffness or mass.
        parameter_flags = {
            **dict.fromkeys((*COEFFICIENT_OF, *COEFFICIENT_OF.values()), _NOT_SEPARABLE_FLAG),
            **parameter_flags,
        }
    return Headline(
        name=name,
        fit=fit,
        parameters={
            each: _reported_parameter(
                fit,
                each,
                unexplained_reason or parameter_flags.get(each),
                order_intervals.get(each),
            )
            for each in fit.parameters
            if fit.structure.has_damping_of(each)
        },
        sizes=tuple(
            # A loss factor is valid without its order. A coefficient is valid with its order only.
            reported_loss_factor(
                each,
                loss_factor,
                unexplained_reason
                or (
                    order_reasons.get(DAMPING_PARAMETER_NAMES[each][1])
                    if loss_factor.omega_rad_s is None
                    else None
                )
                or damping_reason,
            )
            for each, loss_factor in zip(_DAMPINGS, (fit.internal, fit.external), strict=True)
            if loss_factor is not None
        ),
        modes=tuple(
            _reported_mode(mode_estimate, visible_numbers, unexplained_reason)
            for mode_estimate in (
                _modes_with_wider_uncertainty(fit, fit_with_both)
                if uses_both
                else fit_with_both.modes
            )
        ),
        with_both=fit_with_both,
        structures=((name, "selected"),),
        simpler=None,
        drag_speed_m_s=None,
        is_explained=unexplained_reason is None,
    )


def structures(
    candidate_set: CandidateSet, fractional_orders: frozenset[str]
) -> tuple[tuple[str, StructureStatus], ...]:
    """Return name and status of every structure: which ones the record excludes.

    A special case of the freest structure is excluded if its deviance exceeds that of the freest
    one by `EXCLUSION_DEVIANCES`, or if it fixes an order of `fractional_orders` at 1. Any other
    structure is excluded if its deviance exceeds the first of these limits and its BIC exceeds the
    lowest BIC by 10. So a structure with unnecessary parameters is not excluded.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    fractional_orders : frozenset of str
        Orders for which the record excludes 1.
    """
    return tuple(
        (each.name, _structure_status(candidate_set, each, fractional_orders))
        for each in candidate_set.candidates
    )


def _structure_status(
    candidate_set: CandidateSet, candidate: Candidate, fractional_orders: frozenset[str]
) -> StructureStatus:
    """Return "selected" for the reported structure, otherwise "compatible" or "excluded".

    Excluded structures are those that the record contradicts.
    """
    freest_candidate = candidate_set.freest
    if candidate is freest_candidate:
        return "selected"
    is_special_case = set(candidate.structure.free) < set(freest_candidate.structure.free)
    if not is_special_case:
        has_less_likelihood = (
            candidate.deviance - freest_candidate.deviance > EXCLUSION_DEVIANCES[0]
        )
        has_worse_bic = candidate.bic > candidate_set.best.bic + BIC_DECISIVE
        return "excluded" if has_less_likelihood and has_worse_bic else "compatible"
    if any(candidate.structure.fixed.get(order_name) == 1.0 for order_name in fractional_orders):
        return "excluded"
    missing_parameters = freest_candidate.parameter_count - candidate.parameter_count
    deviance_limit = EXCLUSION_DEVIANCES[min(missing_parameters, len(EXCLUSION_DEVIANCES)) - 1]
    return (
        "excluded"
        if candidate.deviance - freest_candidate.deviance > deviance_limit
        else "compatible"
    )


def _conditional_estimate(
    candidate_set: CandidateSet, fractional_orders: frozenset[str]
) -> ConditionalEstimate | None:
    """Return parameter estimates under the simplest structure that the record does not exclude.

    Return None if no structure is simpler than the reported one.
    """
    freest_candidate = candidate_set.freest
    compatible_candidates = [
        candidate
        for candidate in candidate_set.candidates
        if candidate.parameter_count < freest_candidate.parameter_count
        and _structure_status(candidate_set, candidate, fractional_orders) == "compatible"
    ]
    if not compatible_candidates:
        return None
    simplest_candidate = min(compatible_candidates, key=lambda candidate: candidate.bic)
    fixed_orders = {
        order_name: simplest_candidate.structure.fixed[order_name]
        for order_name, coefficient_name in COEFFICIENT_OF.items()
        if order_name in simplest_candidate.structure.fixed
        and coefficient_name in simplest_candidate.structure.free
    }
    return ConditionalEstimate(
        name=simplest_candidate.name,
        fixed=fixed_orders,
        parameters={
            parameter_name: _reported_parameter(simplest_candidate.fit, parameter_name, None, None)
            for parameter_name in simplest_candidate.fit.parameters
            if simplest_candidate.structure.has_damping_of(parameter_name)
            and parameter_name not in fixed_orders
        },
    )


def _reported_parameter(
    fit: RecordFit,
    parameter_name: str,
    doubt_reason: str | None,
    order_interval: tuple[float, float] | None,
) -> Estimate:
    """Return the reported value of one parameter of a fit, with its interval and flag."""
    is_free = parameter_name in fit.interval
    interval_95 = order_interval or fit.interval.get(parameter_name)
    invalid_reason = doubt_reason
    if invalid_reason is None and parameter_name in fit.at_bounds and interval_95 is None:
        invalid_reason = _AT_BOUND_FLAG
    if invalid_reason is None and is_free and interval_95 is None:
        invalid_reason = _NOT_IDENTIFIABLE_FLAG
    return Estimate(
        fit.parameters[parameter_name],
        fit.std[parameter_name] if is_free else 0.0,
        interval_95,
        invalid_reason,
    )


def reported_loss_factor(
    damping: Damping, pivot_loss_factor: PivotLossFactor, invalid_reason: str | None
) -> ReportedLossFactor:
    """Return the loss factor of a damping as reported, with 95 % interval and flag.

    Parameters
    ----------
    damping : str
        "internal" or "external".
    pivot_loss_factor : PivotLossFactor
        Estimated loss factor.
    invalid_reason : str or None
        Flag of the reported value. None if it is valid.
    """
    # A loss factor is positive and uncertain by a factor, so its interval is logarithmic.
    relative_half_width = NORMAL_95 * pivot_loss_factor.std / pivot_loss_factor.value
    interval_95 = (
        pivot_loss_factor.value * math.exp(-relative_half_width),
        pivot_loss_factor.value * math.exp(min(relative_half_width, 300.0)),
    )
    return ReportedLossFactor(
        damping,
        pivot_loss_factor.omega_rad_s,
        Estimate(pivot_loss_factor.value, pivot_loss_factor.std, interval_95, invalid_reason),
    )


def _modes_with_wider_uncertainty(
    fit: RecordFit, fit_with_both: RecordFit
) -> Iterator[ModeEstimate]:
    """Yield the modes of a fit, with the standard deviations of a fit with both dampings.

    These are larger, since the second damping is free.
    """
    modes_with_both = {mode.number: mode for mode in fit_with_both.modes}
    for mode in fit.modes:
        mode_with_both = modes_with_both.get(mode.number, mode)
        yield replace(
            mode,
            frequency_std_hz=mode_with_both.frequency_std_hz,
            damping_ratio_std=mode_with_both.damping_ratio_std,
        )


def _reported_mode(
    mode_estimate: ModeEstimate, visible_numbers: Collection[int], invalid_reason: str | None
) -> ReportedMode:
    """Return the reported frequency and damping ratio of a mode, flagged if it is not visible."""
    is_visible_mode = mode_estimate.number in visible_numbers
    if invalid_reason is None and not is_visible_mode:
        invalid_reason = "computed from the model: the record does not show this mode"
    return ReportedMode(
        mode_estimate.number,
        non_negative_value(
            mode_estimate.frequency_hz, mode_estimate.frequency_std_hz, invalid_reason
        ),
        non_negative_value(
            mode_estimate.damping_ratio, mode_estimate.damping_ratio_std, invalid_reason
        ),
        is_visible_mode,
        "beam",
    )


def non_negative_value(
    estimated_value: float, std: float, invalid_reason: str | None, half_width: float = NORMAL_95
) -> Estimate:
    """Return a reported value that cannot be negative, with its 95 % interval.

    Parameters
    ----------
    estimated_value, std : float
        Estimate and its standard deviation.
    invalid_reason : str or None
        Flag of the reported value. None if it is valid.
    half_width : float
        Half width of the interval, in standard deviations.
    """
    return Estimate(
        estimated_value, std, interval_from_zero(estimated_value, std, half_width), invalid_reason
    )
