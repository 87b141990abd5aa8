"""Verdict on one record: structure, orders, limits of the data, and clarifying experiments."""

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
    from analysis.identify._drag import DampingAt
    from analysis.identify._finding import Finding
    from analysis.identify.profile_likelihood import LikelihoodProfile, Order
    from analysis.identify.residual_tests import Harmonic, InputRelation, Whiteness
    from analysis.models import Structure

Status = Literal["compatible", "fractional", "open", "not identifiable", "absent"]

BIC_DECISIVE: Final = 10.0
"""Difference of BIC from which the worse structure may be dismissed (Kass and Raftery, J. American
Statistical Association 90 (1995) 773-795); below `BIC_TIE` the data do not distinguish the two."""

BIC_TIE: Final = 6.0

EXCLUDED: Final = (10.828, 13.816, 16.266, 18.467)
"""Deviance above the freest structure's from which a simpler one is excluded, by the number of
parameters that it lacks: chi-square's 0.1 %. A true one is excluded once in a thousand records."""

NOT_DETERMINED: Final = "the record does not determine the order"

WITH_DRAG: Final = "air drag contributes to it, and its law is known to a few per cent only"
"""Why external damping with drag is not a property of the beam: of two records
of one rig, one had lambda four standard deviations off, with a drag that fell with the speed."""


# One order of the damping

_MODES_FOR_AN_ORDER: Final = 2
_MODES_FOR_ONE_DAMPING: Final = 3
"""Number of modes that shows whether there is a second damping: two loss factors are explained by
coefficient and order of one damping as well as by two dampings."""

ANOTHER_DAMPING: Final = "from two modes it cannot be told whether there is another damping as well"


@dataclass(frozen=True, slots=True)
class OrderVerdict:
    """Verdict on one order of the damping.

    Attributes
    ----------
    order : str
        "alpha" (internal damping, of the material) or "lambda" (external, of the surroundings).
    status : str
        "compatible": the 95 % interval holds 1; "fractional": the record excludes 1; "open": 1 is
        doubtful but not excluded, or something else explains as much; "not identifiable": it could
        be almost any value; "absent": such damping is insignificant, though three modes would show
        it.
    value : float or None
        Estimate with the order free, if it is identifiable.
    interval : tuple of float or None
        Its 95 % interval, by the likelihood ratio.
    reason : str or None
        Reason why the number is not a property of the beam; None if it is one.
    profile : Profile
    """

    order: Order
    status: Status
    value: float | None
    interval: tuple[float, float] | None
    reason: str | None
    profile: LikelihoodProfile


def order_verdict(
    candidate_set: CandidateSet,
    profile: LikelihoodProfile,
    visible: tuple[int, ...],
    *,
    doubt: str | None,
) -> OrderVerdict:
    """Assess one order in the freest structure.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    profile : LikelihoodProfile
        Profile of the order on the selected beam.
    visible : tuple of int
        Numbers of the visible modes.
    doubt : str or None
        Reason against the structure; None if it is valid.
    """
    status, reason = _status(candidate_set, profile, visible, doubt=doubt)
    known = status not in ("not identifiable", "absent")
    return OrderVerdict(
        order=profile.order,
        status=status,
        value=profile.estimate if known else None,
        interval=profile.interval if known else None,
        reason=reason,
        profile=profile,
    )


def not_reported_reason(candidate_set: CandidateSet, visible: tuple[int, ...]) -> str | None:
    """Return why a record determines no order, whatever its likelihood; None if it may.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    visible : tuple of int
        Numbers of the visible modes.
    """
    return too_few_modes(candidate_set.freest.structure, len(visible))


def too_few_modes(structure: Structure, modes: int) -> str | None:
    """Return why so many modes determine no order, whatever the likelihood; None if they may.

    Parameters
    ----------
    structure : Structure
        The freest that the data support.
    modes : int
        Number of visible modes.
    """
    # The loss at one frequency is all that one mode shows; what may narrow an order then is how
    # exactly the beam is uniform.
    if modes < _MODES_FOR_AN_ORDER:
        return "a single mode determines the amount of damping, not its order"
    if structure.internal != structure.external and modes < _MODES_FOR_ONE_DAMPING:
        return ANOTHER_DAMPING
    return None


def deviance_of_one(profile: LikelihoodProfile) -> float:
    """Return the deviance of order 1 above the lowest; infinite beyond the end of the walk.

    Parameters
    ----------
    profile : Profile
    """
    return float(np.interp(1.0, profile.values, profile.deviance, left=np.inf, right=np.inf))


def _status(
    candidate_set: CandidateSet,
    profile: LikelihoodProfile,
    visible: tuple[int, ...],
    *,
    doubt: str | None,
) -> tuple[Status, str | None]:
    freest, order = candidate_set.freest, profile.order
    reason = not_reported_reason(candidate_set, visible)
    if reason is not None:
        return "not identifiable", reason
    if not freest.structure.has(order):
        return "absent", "no such damping shows"
    if not profile.identifiable:
        return "not identifiable", NOT_DETERMINED
    if doubt is not None:
        return "open", doubt
    if order == "lambda" and candidate_set.drag is not None:
        return "open", WITH_DRAG
    if profile.admits_one:
        return "compatible", None
    return ("fractional" if deviance_of_one(profile) > EXCLUDED[0] else "open"), None


# Verdict on a record


@dataclass(frozen=True, slots=True)
class CandidateRow:
    """Row of the table of candidates.

    Attributes
    ----------
    structure : str
        "I" to "VII".
    parameters : int
    cost : float
        Sum of squares of the whitened residual.
    delta_bic, delta_aic : float
        Above the lowest of all.
    """

    structure: str
    parameters: int
    cost: float
    delta_bic: float
    delta_aic: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Conclusions on one record.

    Attributes
    ----------
    name : str
        The file.
    structure : str
        Structure of the lowest BIC: "I" to "VII".
    rivals : tuple of str
        Structures that the data do not distinguish from it.
    parameters : mapping of str to float
        Parameters of the freest structure without a flag, as `RecordFit` names them.
    adequate : bool
        Whether the residual of that structure is noise.
    alpha, lambda_ : OrderVerdict
    visible_modes : tuple of int
        Modes significantly above the noise.
    findings : tuple of Finding
        Other effects in the record.
    table : tuple of CandidateRow
        All candidates, the lowest BIC first.
    whiteness : Whiteness
    input_relation : InputRelation
    harmonics : tuple of Harmonic
    sentences : tuple of str
        The verdict in words, the most important first.
    experiments : tuple of str
        Experiments that would clarify the verdict.
    damping_with_amplitude : tuple of DampingAt
        Damping in free vibration with air drag; else empty.
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
    damping_with_amplitude: tuple[DampingAt, ...] = ()

    def as_json(self) -> dict[str, object]:
        """Return the verdict as `json.dumps` accepts it; non-finite numbers become null."""
        plain = _plain(dataclasses.asdict(self))
        assert isinstance(plain, dict)
        for order in ("alpha", "lambda"):
            profile = plain[order]["profile"]
            profile["valleys"] = profile.pop("local_minima")  # the key of the document
        return plain


def rivals(candidate_set: CandidateSet, within: float) -> tuple[Candidate, ...]:
    """Return the candidates whose BIC is within a limit above that of the first.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    within : float
        Largest difference of BIC.
    """
    limit = candidate_set.best.bic + within
    return tuple(c for c in candidate_set.candidates[1:] if c.bic < limit)


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {str(key).rstrip("_"): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
