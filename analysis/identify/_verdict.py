"""The verdict on one record: structure, orders, what is not known, and what would tell."""

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
    from analysis.identify._profile_likelihood import LikelihoodProfile, Order
    from analysis.identify._residual_tests import Harmonic, InputRelation, Whiteness
    from analysis.models import Structure

Status = Literal["compatible", "fractional", "open", "not identifiable", "absent"]

STRONG: Final = 10.0
"""Difference of BIC from which the worse structure may be dismissed (Kass and Raftery, J. American
Statistical Association 90 (1995) 773-795); below `EVEN` the data do not tell the two apart."""

EVEN: Final = 6.0

EXCLUDED: Final = (10.828, 13.816, 16.266, 18.467)
"""Deviance above the freest structure's from which a simpler one is excluded, by the number of
parameters that it lacks: chi-square's 0.1 %. A true one is excluded once in a thousand records."""

NOT_DETERMINED: Final = "the record does not determine the order"

WITH_DRAG: Final = "air drag contributes to it, and its law is known to a few per cent only"
"""Why external damping beside drag must not be taken for a property of the beam: of two records
of one rig, one had lambda four standard deviations off, with a drag that fell with the speed."""


# One order of the damping

_MODES_FOR_AN_ORDER: Final = 2
_MODES_FOR_ONE_DAMPING: Final = 3
"""Modes from which on it shows that there is no second damping: two loss factors are explained by
coefficient and order of one damping as well as by two dampings."""

ANOTHER_DAMPING: Final = "from two modes it cannot be told whether there is another damping as well"


@dataclass(frozen=True, slots=True)
class OrderVerdict:
    """One order of the damping.

    Attributes
    ----------
    order : str
        "alpha" (internal damping, of the material) or "lambda" (external, of the surroundings).
    status : str
        "compatible": the 95 % interval holds 1; "fractional": the record excludes 1; "open": 1 is
        doubtful but not excluded, or something else explains as much; "not identifiable": it could
        be almost anything; "absent": such damping does not show, though three modes would show it.
    value : float or None
        The estimate with the order free, where the order is identifiable.
    interval : tuple of float or None
        Its 95 % interval, by the likelihood ratio.
    reason : str or None
        Why the number is not a property of the beam; None if it is.
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
    """Judge one order.

    Parameters
    ----------
    field : CandidateSet
    profile : Profile
        Profile of the order, in the freest structure on the beam selected.
    visible : tuple of int
        Modes that the record shows.
    doubt : str or None
        Why nothing that rests on that structure is to be believed; None: it may be.
    """
    status, reason = _judged(candidate_set, profile, visible, doubt=doubt)
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
    """Say why no order can be told from a record, whatever its likelihood says; None if it may.

    Parameters
    ----------
    field : CandidateSet
    visible : tuple of int
        Modes that the record shows.
    """
    return too_few_modes(candidate_set.freest.structure, len(visible))


def too_few_modes(structure: Structure, modes: int) -> str | None:
    """Say why so many modes tell no order, whatever the likelihood says; None if they may.

    Parameters
    ----------
    structure : Structure
        The freest that the data support.
    modes : int
        How many show.
    """
    # The loss at one frequency is all that one mode shows; what may narrow an order then is how
    # exactly the beam is uniform.
    if modes < _MODES_FOR_AN_ORDER:
        return "a single mode determines the amount of damping, not its order"
    if structure.internal != structure.external and modes < _MODES_FOR_ONE_DAMPING:
        return ANOTHER_DAMPING
    return None


def deviance_of_one(profile: LikelihoodProfile) -> float:
    """Deviance of order 1 above the lowest; infinite where the walk along the order ended before.

    Parameters
    ----------
    profile : Profile
    """
    return float(np.interp(1.0, profile.values, profile.deviance, left=np.inf, right=np.inf))


def _judged(
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
    """One line of the table of candidates.

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
    """What can be said of one record.

    Attributes
    ----------
    name : str
        The file.
    structure : str
        Structure of the lowest BIC: "I" to "VII".
    rivals : tuple of str
        Structures that the data cannot tell from it.
    parameters : mapping of str to float
        Those of the freest structure, as `RecordFit` names them, but for those that carry a flag.
    adequate : bool
        Whether what remains of that is noise.
    alpha, lambda_ : OrderVerdict
    visible_modes : tuple of int
        Modes that stand out of the noise.
    findings : tuple of Finding
        What else is in the record.
    table : tuple of Row
        All candidates, the lowest BIC first.
    whiteness : Whiteness
    input_relation : InputRelation
    harmonics : tuple of Harmonic
    sentences : tuple of str
        The verdict in words, the most important first.
    experiments : tuple of str
        What would tell more.
    damping_with_amplitude : tuple of DampingAt
        Damping in free vibration, where the air brakes the beam; else empty.
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
        """As `json.dumps` takes it; what is not finite becomes null."""
        plain = _plain(dataclasses.asdict(self))
        assert isinstance(plain, dict)
        return plain


def rivals(candidate_set: CandidateSet, within: float) -> tuple[Candidate, ...]:
    """Candidates whose BIC is less than so much above that of the first, without the first."""
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
