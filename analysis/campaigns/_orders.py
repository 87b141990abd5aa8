"""Joint result of all sessions on the orders of the damping."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from analysis.campaigns.pooling import freest_estimate
from analysis.identify.modal_headline import effective_reason, order_status_with_geometry_tolerance
from analysis.identify.profile_likelihood import MAX_IDENTIFIABLE_FRACTION
from analysis.identify.verdict import too_few_modes
from analysis.models import ORDER_RANGE, STRUCTURES
from analysis.statistics import BIC_DECISIVE, student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns._homogeneity import Homogeneity
    from analysis.campaigns.pooling import PooledEstimate, PooledParameter
    from analysis.identify.profile_likelihood import OrderName
    from analysis.identify.tolerant_estimate import TolerantEstimate
    from analysis.identify.verdict import Verdict


PooledStatus = Literal["compatible", "fractional", "open", "not identifiable", "absent"]
"""Result of the test whether an order is 1 (see `PooledOrder`)."""

UNEXPLAINED_RECORDS_REASON: Final = "part of the records is unexplained"
"""Reason for doubt, and flag, if too many sessions have a residual that is not noise."""
MIN_ADEQUATE_FRACTION: Final = 0.9
"""Smallest fraction of sessions with a residual of mere noise at which orders are reported and
estimates get no flag."""

_EXCLUSION_CONFIDENCE: Final = 0.999
"""Confidence level at which an order of 1 is excluded: one false exclusion in 1000 campaigns."""


@dataclass(frozen=True, slots=True)
class PooledOrder:
    """One order of the damping, estimated from all sessions in the freest structure.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    status : str
        "compatible": the 95 % interval contains 1; "fractional": 1 is excluded; "open": 1 is
        doubtful but not excluded, or something else explains the records as well; "not
        identifiable": the order could have almost any value; "absent": the sessions show no such
        damping.
    value : float or None
        Pooled estimate; None if the order is not identifiable.
    interval : tuple of float or None
        95 % interval of the order, scatter between sessions included; None also if the order was
        fixed at 1.
    std : float or None
        Standard deviation of the order; None in the same cases as `interval`.
    exact : PooledOrder or None
        The order on condition that the beam is uniform to 1e-5; None if this is that order itself.
    reason : str or None
        Why the value is not a property of the specimen; None if it is.
    alone : mapping of str to int
        Number of sessions by the status that the order has in the session alone.
    mixture : bool
        Whether `reason` is that the sessions differ significantly in this order, or that they are
        of different specimens and do not all determine it.
    """

    order: OrderName
    status: PooledStatus
    value: float | None
    interval: tuple[float, float] | None
    reason: str | None
    alone: Mapping[str, int]
    mixture: bool = False
    std: float | None = None
    exact: PooledOrder | None = None

    def with_doubt(self, reason: str) -> PooledOrder:
        """Return this order with a reason against its interpretation.

        Its status becomes "open" if it has an interval. An order that already has a reason is
        returned unchanged.
        """
        if self.reason is not None:
            return self
        return replace(self, status="open" if self.interval else self.status, reason=reason)


def pooled_order(
    order: OrderName,
    ranked_estimates: Sequence[PooledEstimate],
    verdicts: Sequence[Verdict],
    homogeneity: Homogeneity,
) -> PooledOrder:
    """Assess one order of the damping from all sessions, by the same rules as for one record.

    The pooled estimates, at least one, are in the order of rising BIC.
    """
    session_orders = [
        verdict.alpha if order == "alpha" else verdict.lambda_ for verdict in verdicts
    ]
    session_counts_by_status: dict[str, int] = dict(
        Counter(str(session_order.status) for session_order in session_orders).most_common()
    )
    freest_fit = freest_estimate(ranked_estimates)
    assert freest_fit is not None
    parameter = freest_fit.parameters_by_name.get(order)
    order_status, doubt_reason = _status_and_reason(
        order, ranked_estimates, freest_fit, verdicts, session_counts_by_status
    )
    is_estimated = parameter is not None and order_status not in ("not identifiable", "absent")
    is_mixture = is_estimated and (
        homogeneity.is_mixed(order)
        or (homogeneity.is_mixture and freest_fit.sessions < len(verdicts))
    )
    if is_mixture:
        order_status = "open"
        doubt_reason = "the sessions are not of one specimen, and it differs between them"
    return PooledOrder(
        order=order,
        status=order_status,
        value=parameter.value
        if parameter and is_estimated
        else 1.0
        if order_status == "compatible"
        else None,
        interval=parameter.interval if parameter and is_estimated else None,
        reason=doubt_reason,
        alone=session_counts_by_status,
        mixture=is_mixture,
        std=parameter.std if parameter and is_estimated else None,
    )


def pooled_order_with_tolerance(
    exact_order: PooledOrder,
    estimate: TolerantEstimate,
    verdicts: Sequence[Verdict],
    *,
    is_beam_refused: bool,
) -> PooledOrder:
    """Assess one order of the damping, with a tolerance for deviations from a uniform beam.

    `exact_order` is the same order on an exactly uniform beam, and `estimate` is from the modal
    constants of all sessions. `is_beam_refused` states whether a uniform beam does not predict the
    pooled constants.
    """
    order = exact_order.order
    order_status, doubt_reason = order_status_with_geometry_tolerance(
        order, estimate, refused=is_beam_refused
    )
    tolerant_order = PooledOrder(
        order=order,
        status=order_status,
        value=estimate.values[order] if doubt_reason is None else None,
        interval=estimate.interval[order] if doubt_reason is None else None,
        reason=doubt_reason,
        alone=exact_order.alone,
        std=estimate.std[order] if doubt_reason is None else None,
        exact=exact_order,
    )
    if exact_order.mixture and exact_order.reason is not None:
        return replace(tolerant_order.with_doubt(exact_order.reason), mixture=True)
    if not _nearly_all_adequate(verdicts):
        return tolerant_order.with_doubt(UNEXPLAINED_RECORDS_REASON)
    final_reason = effective_reason(estimate, order, refused=is_beam_refused)
    return tolerant_order if final_reason is None else tolerant_order.with_doubt(final_reason)


def _nearly_all_adequate(verdicts: Sequence[Verdict]) -> bool:
    """Return whether the residual is noise in at least 90 % of the sessions."""
    return sum(verdict.adequate for verdict in verdicts) >= MIN_ADEQUATE_FRACTION * len(verdicts)


def rival_estimates(
    ranked_estimates: Sequence[PooledEstimate], bic_margin: float
) -> tuple[PooledEstimate, ...]:
    """Return the estimates, except the first, whose BIC is close to the lowest BIC.

    Their BIC is less than `bic_margin` above the lowest.
    """
    return tuple(
        estimate
        for estimate in ranked_estimates[1:]
        if estimate.bic < ranked_estimates[0].bic + bic_margin
    )


def _status_and_reason(
    order: OrderName,
    ranked_estimates: Sequence[PooledEstimate],
    freest_fit: PooledEstimate,
    verdicts: Sequence[Verdict],
    session_counts_by_status: Mapping[str, int],
) -> tuple[PooledStatus, str | None]:
    """Return the status of an order of the damping, and the reason to doubt the order or None."""
    structure = STRUCTURES[freest_fit.structure]
    usual_mode_count = Counter(len(verdict.visible_modes) for verdict in verdicts).most_common(1)[
        0
    ][0]
    most_show_several_modes = 2 * sum(len(v.visible_modes) > 1 for v in verdicts) > len(verdicts)
    if few_modes_reason := too_few_modes(
        structure, max(usual_mode_count, 2) if most_show_several_modes else 1
    ):
        return "not identifiable", few_modes_reason
    if not structure.has_damping_of(order):
        return "absent", "no such damping is visible"
    parameter = freest_fit.parameters_by_name.get(order)
    if (
        parameter is None
        and structure.fixed.get(order) == 1.0
        and next(iter(session_counts_by_status)) == "compatible"
    ):
        # The order is free in no fitted structure, so only the sessions' verdicts are available.
        return "compatible", None
    if (
        parameter is None
        or _relative_interval_width(parameter.interval) > MAX_IDENTIFIABLE_FRACTION
    ):
        return "not identifiable", "the sessions do not determine the order"
    if not _nearly_all_adequate(verdicts):
        return "open", UNEXPLAINED_RECORDS_REASON
    rivals_with_order_one = [
        estimate
        for estimate in (ranked_estimates[0], *rival_estimates(ranked_estimates, BIC_DECISIVE))
        if _has_order_one(estimate, order)
    ]
    lower_limit, upper_limit = parameter.interval
    if lower_limit <= 1 <= upper_limit:
        return "compatible", None
    is_one_excluded = not rivals_with_order_one and _excludes_order_one(
        parameter, freest_fit.sessions
    )
    return ("fractional" if is_one_excluded else "open"), None


def _has_order_one(estimate: PooledEstimate, order: OrderName) -> bool:
    """Return whether the damping structure of an estimate fixes an order at 1."""
    return STRUCTURES[estimate.structure].fixed.get(order) == 1.0


def _excludes_order_one(order: PooledParameter, session_count: int) -> bool:
    """Return whether an order differs from 1 at the level `_EXCLUSION_CONFIDENCE`."""
    return (
        abs(order.value - 1)
        > student_t_quantile(_EXCLUSION_CONFIDENCE, session_count - 1) * order.std
    )


def _relative_interval_width(order_interval: tuple[float, float]) -> float:
    """Return the width of an interval as a fraction of the range searched for orders."""
    return (order_interval[1] - order_interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])
