"""Headline numbers from the modal model, and from a beam with a tolerance of the geometry.

The modes are those of the modal model, which is valid for every antenna. Damping and stiffness are
those of a beam whose mode frequencies may differ from those of a uniform beam by a stated
tolerance: an unevenness of a thousandth changes a frequency as much as an order of the damping
does. The estimates for a beam that is uniform to 1e-5 are reported as conditional estimates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from analysis.identify._uncertainty import pivot_loss_factor
from analysis.identify.headline import (
    DAMPING_PARAMETER_NAMES,
    Estimates,
    non_negative_value,
    reported_loss_factor,
)
from analysis.identify.profile_likelihood import MAX_IDENTIFIABLE_FRACTION
from analysis.identify.uniform_beam import PARAMETERS
from analysis.identify.verdict import (
    EXCLUSION_DEVIANCES,
    ORDER_NOT_DETERMINED_REASON,
    OrderVerdict,
    Status,
)
from analysis.models import ORDER_RANGE, STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import BEAM_PARAMETERS, COEFFICIENT_OF
from rigd.estimates import Estimate, ReportedMode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.identify._explanations import CauseFit
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify.beam_uniformity import UniformBeamTest
    from analysis.identify.headline import Headline, ReportedLossFactor, StructureStatus
    from analysis.identify.profile_likelihood import LikelihoodProfile, OrderName
    from analysis.identify.tolerant_estimate import TolerantEstimate

NOT_UNIFORM_REASON: Final = (
    "the modes are not those of a uniform beam, and the cause of the difference may change this "
    "value"
)
"""Reason for a flag on parameters that a deviation from a uniform beam may change."""

NO_ORDER_REASON: Final = "no beam with one internal and one external order explains the losses"
"""Reason for a flag on damping parameters: no beam with fractional orders explains the losses."""

_EFFECTIVE_PARAMETERS: Final = (*BEAM_PARAMETERS, "delay_s", "gamma", "lambda")
"""Parameters that a deviation from a uniform beam may change by more than the tolerance of the
geometry. External damping is among them: it is relative to the inertia of each mode."""


def uniform_beam_refusal_reason(test: UniformBeamTest) -> str | None:
    """Return why the values for a uniform beam are invalid; None if they may be valid."""
    if test.status != "refused":
        return None
    return f"a uniform beam does not predict the modal constants ({test.summary.chance})"


_CHANGED_BY_DRAG_REASON: Final = "air drag of unknown size would change it"
"""Reason to doubt a damping ratio that depends on a drag of unknown size."""

_CONTRADICTION_STDS: Final = 3.0
"""Distance between the reported value and the value under a possible cause from which the reported
value is doubtful, in standard deviations derived from the side of the 95 % interval towards it."""

_EstimatesT = TypeVar("_EstimatesT", bound=Estimates)
"""Type variable for `Estimates` or a subclass, which `replace_by_modal_model` takes and returns."""


def replace_by_modal_model(
    exact_headline: _EstimatesT,
    modal: ModalEstimate,
    test: UniformBeamTest,
    tolerant: TolerantEstimate | None,
    doubt_reason: str | None,
    mode_doubt_reason: str | None,
    *,
    half_width: float = NORMAL_95,
) -> _EstimatesT:
    """Return the estimates with those of an exactly uniform beam replaced by more general ones.

    Modes come from the modal model. Parameters come from the beam with a tolerance of the geometry.

    Parameters
    ----------
    exact_headline : Estimates
        Estimates for an exactly uniform beam.
    modal : ModalEstimate
        Modal model.
    test : UniformBeamTest
        Test of a uniform beam against the modal model.
    tolerant : TolerantEstimate or None
        Parameters of a beam with a tolerance of the geometry. With None the parameters of
        `exact_headline` are retained: the beam is stated to be uniform, or too few modes are
        visible.
    doubt_reason, mode_doubt_reason : str or None
        Reason against every number of the record, and against every mode.
    half_width : float
        Half width of the modes' 95 % intervals, in standard deviations.
    """
    refusal = uniform_beam_refusal_reason(test)
    exact_estimates = (
        exact_headline if refusal is None else exact_headline.with_flag_on_all(refusal)
    )
    # The effect of drag depends on how a mode decays, which the beam model includes.
    modes_of_beam = test.status == "passed" and (
        tolerant is None or "drag" in exact_headline.parameters
    )
    modes = _reported_modes(
        exact_estimates, modal, mode_doubt_reason, half_width, from_beam=modes_of_beam
    )
    estimates = replace(exact_estimates, modes=modes, uniform_beam=test, modal=modal)
    if tolerant is None:
        return estimates
    return replace(
        estimates,
        parameters={
            **{
                parameter_name: parameter_value
                for parameter_name, parameter_value in exact_estimates.parameters.items()
                if parameter_name not in PARAMETERS
            },
            **_reported_parameters(tolerant, doubt_reason, refused=refusal is not None),
        },
        sizes=tuple(
            loss_factor_found.with_flag(doubt_reason)
            for loss_factor_found in loss_factors_with_geometry_tolerance(test, tolerant)
        ),
        structures=_structure_status(exact_estimates, tolerant),
        simpler=None,
        exact=Estimates(
            name=exact_estimates.name,
            parameters=exact_estimates.parameters,
            sizes=exact_estimates.sizes,
            modes=exact_estimates.modes,
            structures=exact_estimates.structures,
            simpler=exact_estimates.simpler,
            drag_speed_m_s=exact_estimates.drag_speed_m_s,
        ),
        tolerant=tolerant,
    )


def flag_contradicted_damping(headline: Headline, causes: Sequence[CauseFit]) -> Headline:
    """Return the headline with flags on values of internal damping that a cause contradicts.

    The reported numbers are those of a nearly uniform beam. A cause that also explains the modes
    may need another damping. External damping has a flag anyway if the beam is not uniform.

    Parameters
    ----------
    headline : Headline
        Reported numbers.
    causes : sequence of CauseFit
        Simple causes that each explain the modes.
    """
    parameters = {
        name: _flag_contradicted(
            estimate, [(getattr(cause.damping, name), cause.phrase) for cause in causes]
        )
        if name in ("zeta", "alpha")
        else estimate
        for name, estimate in headline.parameters.items()
    }
    sizes = [
        loss_factor
        if loss_factor.damping != "internal" or loss_factor.omega_rad_s is None
        else replace(
            loss_factor,
            size=_flag_contradicted(
                loss_factor.size,
                [
                    (cause.damping.internal_loss_factor(loss_factor.omega_rad_s), cause.phrase)
                    for cause in causes
                ],
            ),
        )
        for loss_factor in headline.sizes
    ]
    return replace(headline, parameters=parameters, sizes=tuple(sizes))


def flag_modes_changed_by_drag(headline: Headline, mode_numbers: Sequence[int]) -> Headline:
    """Return the headline with a flag on the damping ratios of some modes.

    Parameters
    ----------
    headline : Headline
        Reported numbers.
    mode_numbers : sequence of int
        Modes whose damping ratio depends on air drag of unknown size.
    """
    modes = tuple(
        replace(mode, damping_ratio=mode.damping_ratio.with_flag(_CHANGED_BY_DRAG_REASON))
        if mode.number in mode_numbers
        else mode
        for mode in headline.modes
    )
    return replace(headline, modes=modes)


def _flag_contradicted(estimate: Estimate, rivals: Sequence[tuple[float, str]]) -> Estimate:
    """Return an estimate, with a flag if a value of `rivals` (value and phrase) contradicts it."""
    if estimate.interval_95 is None:
        return estimate
    low, high = estimate.interval_95
    for value, phrase in rivals:
        half_width = high - estimate.value if value > estimate.value else estimate.value - low
        if abs(value - estimate.value) > _CONTRADICTION_STDS / NORMAL_95 * half_width:
            return estimate.with_flag(f"{phrase} would explain the modes, too, with {value:.3g}")
    return estimate


def _reported_modes(
    estimates: Estimates,
    modal: ModalEstimate,
    doubt_reason: str | None,
    half_width: float,
    *,
    from_beam: bool,
) -> tuple[ReportedMode, ...]:
    """Return the visible modes from the modal model, and the other modes from the beam.

    With `from_beam`, frequency and damping ratio of visible modes are also those of the beam.
    """
    visible_numbers = modal.visible_mode_numbers
    modes_by_number: dict[int, ReportedMode] = {
        mode_estimate.number: mode_estimate for mode_estimate in estimates.modes
    }
    for mode_number in visible_numbers:
        modal_mode = modal.mode(mode_number)
        inertia_kg_m2, relative_std = modal.effective_inertia(mode_number)
        mode_estimate = ReportedMode(
            mode_number,
            non_negative_value(
                modal_mode.frequency_hz, modal_mode.frequency_std_hz, doubt_reason, half_width
            ),
            non_negative_value(
                modal_mode.damping_ratio, modal_mode.damping_ratio_std, doubt_reason, half_width
            ),
            shown=True,
            source="modal",
            participation=non_negative_value(
                inertia_kg_m2, inertia_kg_m2 * relative_std, doubt_reason, half_width
            ),
        )
        if from_beam and mode_number in modes_by_number:
            beam_mode = modes_by_number[mode_number]
            mode_estimate = replace(
                beam_mode, shown=True, participation=mode_estimate.participation
            )
        modes_by_number[mode_number] = mode_estimate
    return tuple(
        reported_mode
        if reported_mode.number in visible_numbers
        else replace(reported_mode, shown=False)
        for _, reported_mode in sorted(modes_by_number.items())
    )


def _reported_parameters(
    estimate: TolerantEstimate, doubt_reason: str | None, *, refused: bool
) -> dict[str, Estimate]:
    """Return the parameters of the beam with a tolerance of the geometry, flagged if undetermined.

    `doubt_reason` is the reason to doubt every number. With `refused`, stiffness, density, delay
    and external damping are effective values: a tip mass or a compliant clamp changes all modes
    alike, by far more than the tolerance. Internal damping is an effective value if its order was
    fitted to the frequencies.
    """
    return {
        parameter_name: Estimate(
            estimate.values[parameter_name],
            estimate.std[parameter_name],
            estimate.interval[parameter_name],
            doubt_reason
            or effective_reason(estimate, parameter_name, refused=refused)
            or _reason_undetermined(estimate, parameter_name),
        )
        for parameter_name in PARAMETERS
    }


def _reason_undetermined(estimate: TolerantEstimate, parameter_name: str) -> str | None:
    """Return the reason why the modes do not determine a beam or damping parameter, or None."""
    if estimate.basis == "none":
        return NO_ORDER_REASON
    for order_name, coefficient_name in COEFFICIENT_OF.items():
        if parameter_name in (order_name, coefficient_name) and not is_order_identifiable(
            estimate, order_name
        ):
            return ORDER_NOT_DETERMINED_REASON
    return None


def is_order_identifiable(estimate: TolerantEstimate, order_name: str) -> bool:
    """Return whether the modes determine a damping order.

    Its 95 % interval must be narrower than a quarter of its range, and the damping significant.

    Parameters
    ----------
    estimate : TolerantEstimate
        Parameters of a beam with a tolerance of the geometry.
    order_name : str
        "alpha" or "lambda".
    """
    order_low, order_high = estimate.interval[order_name]
    widest_interval = MAX_IDENTIFIABLE_FRACTION * (ORDER_RANGE[1] - ORDER_RANGE[0])
    is_significant = estimate.deviance_without_damping[COEFFICIENT_OF[order_name]] > NORMAL_95**2
    return order_high - order_low <= widest_interval and is_significant


def _structure_status(
    exact: Estimates, estimate: TolerantEstimate
) -> tuple[tuple[str, StructureStatus], ...]:
    """Return names and statuses of the damping structures, assessed by the modes' losses.

    Mode frequencies do not distinguish structures if the beam may deviate from a uniform one.
    """

    def status_of(structure_name: str, exact_status: StructureStatus) -> StructureStatus:
        if exact_status == "selected":
            return exact_status
        structure = STRUCTURES[structure_name.partition(",")[0]]
        for order_name, coefficient_name in COEFFICIENT_OF.items():
            if not structure.has_damping_of(coefficient_name):
                deviance_rise = estimate.deviance_without_damping[coefficient_name]
            elif structure.fixed.get(order_name) == 1.0:
                deviance_rise = estimate.deviance_of_order_one[order_name]
            else:
                continue
            if deviance_rise > EXCLUSION_DEVIANCES[0]:
                return "excluded"
        return "compatible"

    return tuple((name, status_of(name, exact_status)) for name, exact_status in exact.structures)


def loss_factors_with_geometry_tolerance(
    test: UniformBeamTest, estimate: TolerantEstimate
) -> tuple[ReportedLossFactor, ...]:
    """Return the beam's loss factors, each at the frequency where it depends least on its order.

    The loss factor of external damping is relative to the inertia, which is an effective value if
    the test refuses a uniform beam.

    Parameters
    ----------
    test : UniformBeamTest
        Test of a uniform beam against the modal model.
    estimate : TolerantEstimate
        Parameters of a beam with a tolerance of the geometry.
    """
    parameter_values = dict(estimate.values)
    reported_factors = []
    for damping, (coefficient_name, order_name) in DAMPING_PARAMETER_NAMES.items():
        loss_factor = pivot_loss_factor(
            coefficient_name,
            order_name,
            parameter_values,
            PARAMETERS,
            estimate.covariance,
            estimate.first_rad_s,
        )
        if loss_factor is None:
            continue
        flag_reason = NO_ORDER_REASON if estimate.basis == "none" else None
        flag_reason = flag_reason or effective_reason(
            estimate, coefficient_name, refused=test.status == "refused"
        )
        reported_factors.append(reported_loss_factor(damping, loss_factor, flag_reason))
    return tuple(reported_factors)


def effective_reason(
    estimate: TolerantEstimate, parameter_name: str, *, refused: bool
) -> str | None:
    """Return why a parameter is only an effective value; None if it is a property of the beam.

    Parameters
    ----------
    estimate : TolerantEstimate
        Parameters of a beam with a tolerance of the geometry.
    parameter_name : str
        Name of the parameter.
    refused : bool
        Whether the test refused a uniform beam.
    """
    is_effective = parameter_name in _EFFECTIVE_PARAMETERS or estimate.rests_on_frequencies
    return NOT_UNIFORM_REASON if refused and is_effective else None


def order_verdict_with_geometry_tolerance(
    order: OrderName,
    estimate: TolerantEstimate,
    profile: LikelihoodProfile,
    doubt: str | None,
    *,
    refused: bool,
) -> OrderVerdict:
    """Return the verdict on one damping order, with a tolerance of the geometry.

    Parameters
    ----------
    order : str
        "alpha" or "lambda".
    estimate : TolerantEstimate
        Parameters of a beam with a tolerance of the geometry.
    profile : LikelihoodProfile
        Likelihood profile of the order on an exactly uniform beam.
    doubt : str or None
        Reason against every number of the record.
    refused : bool
        Whether a uniform beam does not predict the modes. No order is excluded then, because the
        cause may have a loss of its own.
    """
    status, reason = order_status_with_geometry_tolerance(order, estimate, refused=refused)
    if reason is not None:
        return OrderVerdict(order, status, None, None, reason, profile)
    order_value, order_interval = estimate.values[order], estimate.interval[order]
    doubt = doubt or effective_reason(estimate, order, refused=refused)
    if doubt is not None:
        return OrderVerdict(order, "open", order_value, order_interval, doubt, profile)
    return OrderVerdict(order, status, order_value, order_interval, None, profile)


def order_status_with_geometry_tolerance(
    order: OrderName, estimate: TolerantEstimate, *, refused: bool
) -> tuple[Status, str | None]:
    """Return the status of one damping order, and the reason if it is not identifiable.

    Parameters
    ----------
    order : str
        "alpha" or "lambda".
    estimate : TolerantEstimate
        Parameters of a beam with a tolerance of the geometry.
    refused : bool
        Whether the test refused a uniform beam.
    """
    if estimate.basis == "none":
        return "not identifiable", NO_ORDER_REASON
    if not is_order_identifiable(estimate, order):
        return "not identifiable", ORDER_NOT_DETERMINED_REASON
    order_low, order_high = estimate.interval[order]
    if order_low <= 1 <= order_high:
        return "compatible", None
    is_fractional = estimate.deviance_of_order_one[order] > EXCLUSION_DEVIANCES[0] and not refused
    return ("fractional" if is_fractional else "open"), None
