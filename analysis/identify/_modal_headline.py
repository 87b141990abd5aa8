"""Headline of a record from its modal model, and from a beam with a tolerance of the geometry.

Modes are those of the modal model, which holds for every antenna. Damping and stiffness are those
of a beam whose mode frequencies may differ from those of a uniform one by a stated tolerance: an
unevenness of a thousandth changes a frequency as much as an order of the damping does. The
estimates for a beam that is uniform to 1e-5 are reported as conditional estimates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from analysis.identify._plant import OF_BEAM
from analysis.identify._uncertainty import damping_size
from analysis.identify.headline import (
    NAMES,
    Estimates,
    ReportedMode,
    ReportedValue,
    size_of,
    symmetric,
)
from analysis.identify.profile_likelihood import WIDEST_FRACTION
from analysis.identify.uniform_beam import PARAMETERS
from analysis.identify.verdict import EXCLUDED, NOT_DETERMINED, OrderVerdict, Status
from analysis.models import COEFFICIENT_OF, ORDER_RANGE, STRUCTURES
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify.headline import ReportedLossFactor, StructureStatus
    from analysis.identify.profile_likelihood import LikelihoodProfile, Order
    from analysis.identify.uniform_beam import TolerantEstimate, UniformBeamTest

NOT_UNIFORM: Final = (
    "the modes are not those of a uniform beam, and what makes them differ may change this value"
)
NO_ORDER: Final = "no beam with one internal and one external order explains the losses"

_EFFECTIVE: Final = (*OF_BEAM, "delay_s", "gamma", "lambda")
"""Parameters that an uneven beam may change by more than the tolerance. External damping is among
them: it is relative to the inertia of each mode."""


def refused_reason(test: UniformBeamTest) -> str | None:
    """Return why values of a uniform beam are not valid; None if they may be."""
    if test.status != "refused":
        return None
    return f"a uniform beam does not predict the modal constants ({test.summary.chance})"


_N = TypeVar("_N", bound=Estimates)


def with_modal_model(
    exact: _N,
    modal: ModalEstimate,
    test: UniformBeamTest,
    tolerant: TolerantEstimate | None,
    doubt: str | None,
    mode_doubt: str | None,
    *,
    half_width: float = NORMAL_95,
) -> _N:
    """Replace modes and parameters of an exactly uniform beam by the tolerant estimates.

    Parameters
    ----------
    exact : Estimates
        Estimates for an exactly uniform beam.
    modal : ModalEstimate
    test : UniformBeamTest
    tolerant : TolerantEstimate or None
        None retains the parameters: the beam is stated to be uniform, or too few modes show.
    doubt, mode_doubt : str or None
        Reason against every number of the record, or against every mode.
    half_width : float
        Half width of the modes' 95 % intervals, in standard deviations.
    """
    refused = refused_reason(test)
    condition = exact if refused is None else exact.doubted(refused)
    # What drag does depends on how a mode decays, which the beam takes into account.
    of_beam = test.status == "passed" and (tolerant is None or "drag" in exact.parameters)
    modes = _modes(condition, modal, mode_doubt, half_width, own=of_beam)
    numbers = replace(condition, modes=modes, uniform_beam=test, modal=modal)
    if tolerant is None:
        return numbers
    return replace(
        numbers,
        parameters={
            **{
                name: quantity
                for name, quantity in condition.parameters.items()
                if name not in PARAMETERS
            },
            **_parameters(tolerant, doubt, refused=refused is not None),
        },
        sizes=tuple(each.flagged(doubt) for each in tolerant_sizes(test, tolerant)),
        structures=_structures(condition, tolerant),
        simpler=None,
        exact=Estimates(
            name=condition.name,
            parameters=condition.parameters,
            sizes=condition.sizes,
            modes=condition.modes,
            structures=condition.structures,
            simpler=condition.simpler,
            drag_speed_m_s=condition.drag_speed_m_s,
        ),
        tolerant=tolerant,
    )


def _modes(
    numbers: Estimates, modal: ModalEstimate, doubt: str | None, half_width: float, *, own: bool
) -> tuple[ReportedMode, ...]:
    """Return the visible modes from the modal model, and the others from the beam."""
    visible = modal.visible
    found: dict[int, ReportedMode] = {mode.number: mode for mode in numbers.modes}
    for number in visible:
        its = modal.mode(number)
        inertia, spread = modal.inertia(number)
        mode = ReportedMode(
            number,
            symmetric(its.frequency_hz, its.frequency_std_hz, doubt, half_width),
            symmetric(its.damping_ratio, its.damping_ratio_std, doubt, half_width),
            shown=True,
            source="modal",
            participation=symmetric(inertia, inertia * spread, doubt, half_width),
        )
        if own and number in found:
            before = found[number]
            mode = replace(before, shown=True, participation=mode.participation)
        found[number] = mode
    return tuple(
        each if each.number in visible else replace(each, shown=False)
        for _, each in sorted(found.items())
    )


def _parameters(
    estimate: TolerantEstimate, doubt: str | None, *, refused: bool
) -> dict[str, ReportedValue]:
    """Return the parameters of the nearly uniform beam, with flags on undetermined ones.

    `doubt` is the reason against every number. With `refused`, stiffness, density, delay and
    external damping are effective values: a tip mass or a compliant clamp changes all modes alike,
    by far more than the tolerance.
    """
    return {
        name: ReportedValue(
            estimate.values[name],
            estimate.std[name],
            estimate.interval[name],
            doubt or effective_reason(name, refused=refused) or _reason(estimate, name),
        )
        for name in PARAMETERS
    }


def _reason(estimate: TolerantEstimate, name: str) -> str | None:
    """Return the reason against a parameter; None if it is valid."""
    if estimate.basis == "none":
        return NO_ORDER
    for order, coefficient in COEFFICIENT_OF.items():
        if name in (order, coefficient) and not identifiable(estimate, order):
            return NOT_DETERMINED
    return None


def identifiable(estimate: TolerantEstimate, order: str) -> bool:
    """Return whether the modes bound an order within less than half of its range."""
    low, high = estimate.interval[order]
    wide = WIDEST_FRACTION * (ORDER_RANGE[1] - ORDER_RANGE[0])
    shows = estimate.deviance_without[COEFFICIENT_OF[order]] > NORMAL_95**2
    return high - low <= wide and shows


def _structures(
    exact: Estimates, estimate: TolerantEstimate
) -> tuple[tuple[str, StructureStatus], ...]:
    """Return the status of the structures by their losses; mode frequencies are no proof."""

    def status(name: str, before: StructureStatus) -> StructureStatus:
        if before == "selected":
            return before
        structure = STRUCTURES[name.partition(",")[0]]
        for order, coefficient in COEFFICIENT_OF.items():
            if not structure.has(coefficient):
                rise = estimate.deviance_without[coefficient]
            elif structure.fixed.get(order) == 1.0:  # type: ignore[call-overload]
                rise = estimate.deviance_of_one[order]
            else:
                continue
            if rise > EXCLUDED[0]:
                return "excluded"
        return "compatible"

    return tuple((name, status(name, before)) for name, before in exact.structures)


def tolerant_sizes(
    test: UniformBeamTest, estimate: TolerantEstimate
) -> tuple[ReportedLossFactor, ...]:
    """Return the loss factors where they depend least on their orders.

    The loss factor of external damping is relative to the inertia, which is an effective value if
    the test refuses a uniform beam.

    Parameters
    ----------
    test : UniformBeamTest
    estimate : TolerantEstimate
    """
    values = dict(estimate.values)
    found = []
    for damping, (coefficient, order) in NAMES.items():
        size = damping_size(
            coefficient, order, values, PARAMETERS, estimate.covariance, estimate.first_rad_s
        )
        if size is None:
            continue
        flag = NO_ORDER if estimate.basis == "none" else None
        if damping == "external" and test.status == "refused":
            flag = flag or NOT_UNIFORM
        found.append(size_of(damping, size, flag))
    return tuple(found)


def effective_reason(name: str, *, refused: bool) -> str | None:
    """Return why a parameter is an effective value; None if it is a property of the beam.

    Parameters
    ----------
    name : str
    refused : bool
        Whether the test refused a uniform beam.
    """
    return NOT_UNIFORM if refused and name in _EFFECTIVE else None


def tolerant_order(
    order: Order,
    estimate: TolerantEstimate,
    profile: LikelihoodProfile,
    doubt: str | None,
    *,
    refused: bool,
) -> OrderVerdict:
    """Assess one order with a tolerance of the geometry.

    `profile` is the profile of the order on an exactly uniform beam, `doubt` the reason against
    every number of the record. With `refused`, a uniform beam does not predict the modes: the cause
    of their difference may have a loss of its own, so no order is excluded.
    """
    status, reason = tolerant_status(order, estimate, refused=refused)
    if reason is not None:
        return OrderVerdict(order, status, None, None, reason, profile)
    value, ends = estimate.values[order], estimate.interval[order]
    doubt = doubt or effective_reason(order, refused=refused)
    if doubt is not None:
        return OrderVerdict(order, "open", value, ends, doubt, profile)
    return OrderVerdict(order, status, value, ends, None, profile)


def tolerant_status(
    order: Order, estimate: TolerantEstimate, *, refused: bool
) -> tuple[Status, str | None]:
    """Assess one order by an estimate, with the reason where it is not identifiable.

    Parameters
    ----------
    order : str
    estimate : TolerantEstimate
    refused : bool
        Whether the test refused a uniform beam.
    """
    if estimate.basis == "none":
        return "not identifiable", NO_ORDER
    if not identifiable(estimate, order):
        return "not identifiable", NOT_DETERMINED
    low, high = estimate.interval[order]
    if low <= 1 <= high:
        return "compatible", None
    fractional = estimate.deviance_of_one[order] > EXCLUDED[0] and not refused
    return ("fractional" if fractional else "open"), None
