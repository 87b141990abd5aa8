"""Verdict on one record: structure, damping orders, limits of the data, clarifying experiments."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._drag import DampingAtAmplitude
    from analysis.identify._finding import Finding
    from analysis.identify.profile_likelihood import LikelihoodProfile, OrderName
    from analysis.identify.residual_tests import Harmonic, InputRelation, Whiteness
    from analysis.models import Structure

Status = Literal["compatible", "fractional", "open", "not identifiable", "absent"]
"""Status of a damping order."""

EXCLUSION_DEVIANCES: Final = (10.828, 13.816, 16.266, 18.467)
"""Deviance above that of the freest structure from which a structure is excluded if it has 1 to 4
fewer parameters: the 0.1 % limit of chi-square. A true structure is excluded once in a thousand
records."""

ORDER_NOT_DETERMINED_REASON: Final = "the record does not determine the order"
"""Reason against an order whose profile is too wide or has several minima."""

WITH_DRAG_REASON: Final = "air drag contributes to it, and its law is known to a few per cent only"
"""Reason against external damping if the record shows air drag: of two records of one rig, one had
lambda four standard deviations off, with a drag that fell with the speed."""


# Verdict on one damping order

_MIN_MODES_FOR_AN_ORDER: Final = 2
"""Number of visible modes from which an order can be determined."""

_MIN_MODES_FOR_A_SINGLE_DAMPING: Final = 3
"""Number of visible modes that show whether there is a second damping: two loss factors are
explained by coefficient and order of one damping as well as by two dampings."""

SECOND_DAMPING_REASON: Final = "two modes do not show whether there is another damping"
"""Reason against the order of a single damping if the record shows two modes."""


@dataclass(frozen=True, slots=True)
class OrderVerdict:
    """Verdict on one damping order: whether it is 1, fractional, open or not identifiable.

    Attributes
    ----------
    order : str
        "alpha" (internal damping, of the material) or "lambda" (external, of the surroundings).
    status : str
        "compatible": the 95 % interval contains 1. "fractional": the record excludes 1. "open": 1
        is doubtful but not excluded, or another effect explains the record as well. "not
        identifiable": almost any value fits. "absent": the damping is insignificant, although three
        modes would show it.
    value : float or None
        Estimate with the order free. None if it is not identifiable or absent.
    interval : tuple of float or None
        95 % interval of the order by the likelihood ratio. None as for `value`.
    reason : str or None
        Reason why the order is not a property of the beam. None if it is one.
    profile : LikelihoodProfile
        Deviance over the values of the order.
    """

    order: OrderName
    status: Status
    value: float | None
    interval: tuple[float, float] | None
    reason: str | None
    profile: LikelihoodProfile


def order_verdict(
    candidate_set: CandidateSet,
    order_profile: LikelihoodProfile,
    visible_numbers: tuple[int, ...],
    *,
    doubt_reason: str | None,
) -> OrderVerdict:
    """Return the verdict on one damping order from its profile in the freest structure.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    order_profile : LikelihoodProfile
        Profile of the order on the selected beam.
    visible_numbers : tuple of int
        Numbers of the visible modes.
    doubt_reason : str or None
        Reason against the structure. None if it is valid.
    """
    order_status, reason_against = _order_status(
        candidate_set, order_profile, visible_numbers, doubt_reason=doubt_reason
    )
    is_reported = order_status not in ("not identifiable", "absent")
    return OrderVerdict(
        order=order_profile.order,
        status=order_status,
        value=order_profile.estimate if is_reported else None,
        interval=order_profile.interval if is_reported else None,
        reason=reason_against,
        profile=order_profile,
    )


def not_reported_reason(
    candidate_set: CandidateSet, visible_numbers: tuple[int, ...]
) -> str | None:
    """Return why a record cannot determine any order, or None if it may.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    visible_numbers : tuple of int
        Numbers of the visible modes.
    """
    return too_few_modes(candidate_set.freest.structure, len(visible_numbers))


def too_few_modes(structure: Structure, mode_count: int) -> str | None:
    """Return why a number of visible modes cannot determine an order, or None if it can.

    Parameters
    ----------
    structure : Structure
        Freest structure that the data support.
    mode_count : int
        Number of visible modes.
    """
    # One mode shows the loss at one frequency only. Its order could follow only from the assumption
    # that the beam is exactly uniform.
    if mode_count < _MIN_MODES_FOR_AN_ORDER:
        return "a single mode determines the amount of damping, not its order"
    if (
        structure.has_internal_damping != structure.has_external_damping
        and mode_count < _MIN_MODES_FOR_A_SINGLE_DAMPING
    ):
        return SECOND_DAMPING_REASON
    return None


def deviance_of_order_one(order_profile: LikelihoodProfile) -> float:
    """Return the deviance at order 1 minus the lowest one; infinity if the profile ends before 1.

    Parameters
    ----------
    order_profile : LikelihoodProfile
        Deviance over the values of the order.
    """
    return float(
        np.interp(1.0, order_profile.values, order_profile.deviance, left=np.inf, right=np.inf)
    )


def _order_status(
    candidate_set: CandidateSet,
    order_profile: LikelihoodProfile,
    visible_numbers: tuple[int, ...],
    *,
    doubt_reason: str | None,
) -> tuple[Status, str | None]:
    """Return the status of a damping order, and the reason if it is doubtful, else None."""
    freest_candidate, order_name = candidate_set.freest, order_profile.order
    reason_against = not_reported_reason(candidate_set, visible_numbers)
    if reason_against is not None:
        return "not identifiable", reason_against
    if not freest_candidate.structure.has_damping_of(order_name):
        return "absent", "no such damping is visible"
    if not order_profile.identifiable:
        return "not identifiable", ORDER_NOT_DETERMINED_REASON
    if doubt_reason is not None:
        return "open", doubt_reason
    if order_name == "lambda" and candidate_set.drag is not None:
        return "open", WITH_DRAG_REASON
    if order_profile.admits_one:
        return "compatible", None
    return (
        "fractional" if deviance_of_order_one(order_profile) > EXCLUSION_DEVIANCES[0] else "open"
    ), None


# Verdict on a record


@dataclass(frozen=True, slots=True)
class CandidateRow:
    """Row of the table that compares the fitted structures by cost, BIC and AIC.

    Attributes
    ----------
    structure : str
        Name of the structure: "I" to "VII".
    parameters : int
        Number of free parameters.
    cost : float
        Sum of squares of the whitened residual.
    delta_bic, delta_aic : float
        BIC and AIC minus the lowest ones of all candidates.
    """

    structure: str
    parameters: int
    cost: float
    delta_bic: float
    delta_aic: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Conclusions on one record: structure, damping orders, findings and advice.

    Attributes
    ----------
    name : str
        Name of the file.
    structure : str
        Structure with the lowest BIC: "I" to "VII".
    rivals : tuple of str
        Structures that the data do not distinguish from this structure.
    parameters : mapping of str to float
        Parameters of the freest structure without a flag, by the names of `RecordFit`.
    adequate : bool
        Whether the residual of the freest structure is noise.
    alpha, lambda_ : OrderVerdict
        Verdicts on the orders of internal and external damping.
    visible_modes : tuple of int
        Numbers of the modes significantly above the noise.
    findings : tuple of Finding
        Other effects in the record.
    table : tuple of CandidateRow
        All candidates, the one with the lowest BIC first.
    whiteness : Whiteness
        Whiteness test of the residual.
    input_relation : InputRelation
        Test of whether the residual still follows the angle.
    harmonics : tuple of Harmonic
        Tests for the second and third harmonic of a sweep.
    sentences : tuple of str
        Sentences of the verdict, the most important first.
    experiments : tuple of str
        Experiments that would clarify the verdict.
    damping_with_amplitude : tuple of DampingAtAmplitude
        Damping in free vibration by amplitude, if the record shows air drag. Empty otherwise.
    """

    name: str
    structure: str
    rivals: tuple[str, ...]
    parameters: Mapping[str, float]
    adequate: bool
    alpha: OrderVerdict
    lambda_: OrderVerdict
    visible_modes: tuple[int, ...]
    findings: tuple[Finding, ...]
    table: tuple[CandidateRow, ...]
    whiteness: Whiteness
    input_relation: InputRelation
    harmonics: tuple[Harmonic, ...]
    sentences: tuple[str, ...]
    experiments: tuple[str, ...]
    damping_with_amplitude: tuple[DampingAtAmplitude, ...] = ()

    def as_json(self) -> dict[str, object]:
        """Return the verdict as a JSON-ready dict, in which non-finite numbers are None."""
        verdict_document = _json_ready(dataclasses.asdict(self))
        assert isinstance(verdict_document, dict)
        for order_document in ("alpha", "lambda"):
            profile = verdict_document[order_document]["profile"]
            profile["valleys"] = profile.pop("local_minima")  # the key of the document
        return verdict_document


def rivals(candidate_set: CandidateSet, max_bic_difference: float) -> tuple[Candidate, ...]:
    """Return the candidates whose BIC exceeds the lowest one by less than a limit.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    max_bic_difference : float
        Limit of the difference of BIC.
    """
    bic_limit = candidate_set.best.bic + max_bic_difference
    return tuple(c for c in candidate_set.candidates[1:] if c.bic < bic_limit)


def _json_ready(json_value: object) -> object:
    """Convert a value for JSON: tuples to lists, non-finite numbers to None."""
    if isinstance(json_value, dict):
        return {
            str(key).rstrip("_"): _json_ready(nested_value)
            for key, nested_value in json_value.items()
        }
    if isinstance(json_value, list | tuple):
        return [_json_ready(nested_value) for nested_value in json_value]
    if isinstance(json_value, float) and not math.isfinite(json_value):
        return None
    return json_value
