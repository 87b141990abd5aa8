"""Common structure of all sessions, and their joint result on the orders of the damping.

The structure by which all sessions are compared and pooled is the freest that they support. What a
session selects by itself depends on its noise. Sessions compared by what each of them selected
differ by the difference between structures, and forty sessions of one beam then seem to be of two.
Intervals of the freest structure hold whichever simpler one is true.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from analysis.campaigns.pooling import by_structure
from analysis.identify import effective_reason, tolerant_status
from analysis.identify.profile_likelihood import WIDEST_FRACTION
from analysis.identify.verdict import BIC_DECISIVE, too_few_modes
from analysis.models import ORDER_RANGE, STRUCTURES
from analysis.statistics import student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns._estimates import RecordEstimate
    from analysis.campaigns._homogeneity import Homogeneity
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate, PooledParameter
    from analysis.identify.profile_likelihood import Order
    from analysis.identify.uniform_beam import TolerantEstimate
    from analysis.identify.verdict import Verdict


# Common structure

_NEARLY_ALL: Final = 0.9
"""Fraction of the sessions determining the selected structure that must determine a freer one."""


def freest_estimate(pooled: Sequence[PooledEstimate]) -> PooledEstimate | None:
    """Return the freest pooled structure on the beam that all sessions together support.

    The beam is that of the lowest BIC; a structure that far fewer sessions determine does not
    stand for all. None without any.

    Parameters
    ----------
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    """
    if not pooled:
        return None
    best = pooled[0]
    return max(
        (each for each in pooled if each.sessions >= _NEARLY_ALL * best.sessions),
        key=lambda each: len(STRUCTURES[each.structure].free),
    )


def common_structure(sessions: Sequence[SessionAnalysis]) -> str | None:
    """Name the structure by which the modes of all sessions are compared.

    Parameters
    ----------
    sessions : sequence of SessionResult

    Returns
    -------
    str or None
        The freest of those fitted to every session. None without whole-record fits.
    """
    fitted = by_structure(sessions)
    tried = max(map(len, fitted.values()), default=0)
    found = [each[0] for each in fitted.values() if len(each) == tried]
    return max(found, key=_freedom).name if found else None


def _freedom(estimate: RecordEstimate) -> int:
    return len(STRUCTURES[estimate.structure].free)


# Orders

PooledStatus = Literal["compatible", "fractional", "open", "not identifiable", "absent"]

_UNEXPLAINED: Final = "part of the records is unexplained"
_ADEQUATE: Final = 0.9
"""Fraction of the sessions whose residual must be noise before an order is reported."""

_SURE: Final = 0.999
"""Two-sided level at which 1 is excluded: falsely so in one campaign of a thousand."""


@dataclass(frozen=True, slots=True)
class PooledOrder:
    """One order of the damping over all sessions, in the freest structure.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    status : str
        "compatible": the 95 % interval holds 1; "fractional": 1 is excluded; "open": 1 is doubtful
        but not excluded, or something else explains as much; "not identifiable": it could be almost
        anything; "absent": such damping does not show.
    value : float or None
        Pooled estimate, where the order is identifiable.
    interval : tuple of float or None
        Its 95 % interval, scatter between sessions included; None also if it was fixed at 1.
    std : float or None
        Its standard deviation; None as above.
    exact : PooledOrder or None
        The same on condition that the beam is uniform to 1e-5; None where that is what it is.
    reason : str or None
        Why the number is not a property of the specimen; None if it is.
    alone : mapping of str to int
        Number of sessions with each status by themselves.
    mixture : bool
        Whether the reason is that sessions differ in it in kind, or are of different specimens and
        do not all determine it.
    """

    order: Order
    status: PooledStatus
    value: float | None
    interval: tuple[float, float] | None
    reason: str | None
    alone: Mapping[str, int]
    mixture: bool = False
    std: float | None = None
    exact: PooledOrder | None = None

    def doubted(self, reason: str) -> PooledOrder:
        """Return the order with a reason for doubt, unless it has one."""
        if self.reason is not None:
            return self
        return replace(self, status="open" if self.interval else self.status, reason=reason)


def pooled_order(
    order: Order,
    ranked: Sequence[PooledEstimate],
    verdicts: Sequence[Verdict],
    alike: Homogeneity,
) -> PooledOrder:
    """Assess one order by all sessions, by the same rules as for one record.

    Parameters
    ----------
    order : str
    ranked : sequence of PooledEstimate
        The lowest BIC first; not empty.
    verdicts : sequence of Verdict
        Verdicts of the sessions.
    alike : Homogeneity
        Whether they are of one specimen.
    """
    each = [verdict.alpha if order == "alpha" else verdict.lambda_ for verdict in verdicts]
    alone: dict[str, int] = dict(Counter(str(one.status) for one in each).most_common())
    freest = freest_estimate(ranked)
    assert freest is not None
    free = freest.by_name.get(order)
    status, reason = _judged(order, ranked, freest, verdicts, alone)
    known = free is not None and status not in ("not identifiable", "absent")
    mixture = known and (alike.is_mixed(order) or (alike.mixed and freest.sessions < len(verdicts)))
    if mixture:
        status = "open"
        reason = "the sessions are not of one specimen and do not all share it"
    return PooledOrder(
        order=order,
        status=status,
        value=free.value if free and known else 1.0 if status == "compatible" else None,
        interval=free.interval if free and known else None,
        reason=reason,
        alone=alone,
        mixture=mixture,
        std=free.std if free and known else None,
    )


def tolerant_pooled_order(
    exact: PooledOrder,
    estimate: TolerantEstimate,
    verdicts: Sequence[Verdict],
    *,
    refused: bool,
) -> PooledOrder:
    """Assess one order with a tolerance of the geometry.

    Parameters
    ----------
    exact : PooledOrder
        The same order on an exactly uniform beam.
    estimate : TolerantEstimate
        Estimate from the modal constants of all sessions.
    verdicts : sequence of Verdict
        Verdicts of the sessions.
    refused : bool
        Whether a uniform beam does not predict the pooled constants.
    """
    order = exact.order
    status, reason = tolerant_status(order, estimate, refused=refused)
    found = PooledOrder(
        order=order,
        status=status,
        value=estimate.values[order] if reason is None else None,
        interval=estimate.interval[order] if reason is None else None,
        reason=reason,
        alone=exact.alone,
        std=estimate.std[order] if reason is None else None,
        exact=exact,
    )
    if exact.mixture and exact.reason is not None:
        return replace(found.doubted(exact.reason), mixture=True)
    if not _adequate(verdicts):
        return found.doubted(_UNEXPLAINED)
    effective = effective_reason(order, refused=refused)
    return found if effective is None else found.doubted(effective)


def _adequate(verdicts: Sequence[Verdict]) -> bool:
    """Return whether the residuals of nearly all sessions are noise."""
    return sum(each.adequate for each in verdicts) >= _ADEQUATE * len(verdicts)


def rivals(ranked: Sequence[PooledEstimate], within: float) -> tuple[PooledEstimate, ...]:
    """Return those whose BIC is less than so much above the lowest, without the best."""
    return tuple(each for each in ranked[1:] if each.bic < ranked[0].bic + within)


def _judged(
    order: Order,
    ranked: Sequence[PooledEstimate],
    freest: PooledEstimate,
    verdicts: Sequence[Verdict],
    alone: Mapping[str, int],
) -> tuple[PooledStatus, str | None]:
    structure = STRUCTURES[freest.structure]
    modes = Counter(len(verdict.visible_modes) for verdict in verdicts).most_common(1)[0][0]
    several_modes = 2 * sum(len(v.visible_modes) > 1 for v in verdicts) > len(verdicts)
    if few := too_few_modes(structure, max(modes, 2) if several_modes else 1):
        return "not identifiable", few
    if not structure.has(order):
        return "absent", "no such damping shows"
    free = freest.by_name.get(order)
    if free is None and structure.fixed.get(order) == 1.0 and next(iter(alone)) == "compatible":
        # No fitted structure has it free: only the sessions' own verdicts are available.
        return "compatible", None
    if free is None or _wide(free.interval) > WIDEST_FRACTION:
        return "not identifiable", "the sessions do not determine the order"
    if not _adequate(verdicts):
        return "open", _UNEXPLAINED
    integer = [each for each in (ranked[0], *rivals(ranked, BIC_DECISIVE)) if _integer(each, order)]
    low, high = free.interval
    if low <= 1 <= high:
        return "compatible", None
    excluded = not integer and _excludes_one(free, freest.sessions)
    return ("fractional" if excluded else "open"), None


def _integer(estimate: PooledEstimate, order: Order) -> bool:
    """Whether a structure has this damping with an order of 1."""
    return STRUCTURES[estimate.structure].fixed.get(order) == 1.0


def _excludes_one(order: PooledParameter, sessions: int) -> bool:
    """Whether 1 lies outside the interval of the level at which it is called excluded."""
    return abs(order.value - 1) > student_t_quantile(_SURE, sessions - 1) * order.std


def _wide(interval: tuple[float, float]) -> float:
    """Return the fraction of the range of orders that an interval spans."""
    return (interval[1] - interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])
