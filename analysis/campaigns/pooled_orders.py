"""What all sessions together say about the orders of the damping, and what they do not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from analysis.selection.orders import EVEN, STRONG
from analysis.selection.profile import WIDEST_SHARE
from analysis.structures import STRUCTURES
from analysis.unknowns import ORDER_RANGE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns.homogeneity import Homogeneity
    from analysis.campaigns.pooled import PooledEstimate, PooledParameter
    from analysis.selection import Verdict
    from analysis.selection.orders import Status
    from analysis.selection.profile import Order

_ADEQUATE: Final = 0.9
"""Share of the sessions that must leave nothing but noise before a fractional order is reported."""


@dataclass(frozen=True, slots=True)
class PooledOrder:
    """One order of the damping over all sessions.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    status : str
        As of one record: see `analysis.selection.OrderVerdict`.
    value : float or None
        To be used further: 1, the pooled estimate, or none.
    interval : tuple of float or None
        95 % of the pooled estimate with the order free, scatter between sessions included; None if
        no structure that the sessions determine has it free, or they say next to nothing.
    estimate : float or None
        In the middle of that interval, whether it may be used or not.
    alone : mapping of str to int
        How many sessions say what by themselves.
    mixture : bool
        Whether it is withheld because sessions differ in it in kind, or are of different specimens
        and do not all determine it (or, with nothing pooled to go by, say the same).
    """

    order: Order
    status: Status
    value: float | None
    interval: tuple[float, float] | None
    estimate: float | None
    alone: Mapping[Status, int]
    mixture: bool = False


def pooled_order(
    order: Order,
    ranked: Sequence[PooledEstimate],
    verdicts: Sequence[Verdict],
    alike: Homogeneity,
) -> PooledOrder:
    """Judge one order by what all sessions share, as one record is judged by what it shows.

    Parameters
    ----------
    order : str
    ranked : sequence of PooledEstimate
        The lowest BIC first.
    verdicts : sequence of Verdict
        Of the sessions.
    alike : Homogeneity
        Whether they are of one specimen.
    """
    each = [verdict.alpha if order == "alpha" else verdict.lambda_ for verdict in verdicts]
    alone = dict(Counter(one.status for one in each).most_common())
    shared = _where_free(order, ranked)
    free = shared.by_name.get(order) if shared else None
    known = free is not None and _wide(free.interval) <= WIDEST_SHARE
    status = _status(order, ranked, free if known else None, verdicts, alone)
    estimate, interval = (free.value, free.interval) if free and known else (None, None)
    if status in ("not identifiable", "absent"):
        estimate = interval = None
    some = len(alone) > 1 if shared is None else shared.sessions < len(verdicts)
    mixture = status in ("compatible", "fractional", "open") and (
        alike.is_mixed(order) or (alike.mixed and some)
    )
    if mixture:
        status = "open"
    value = {"compatible": 1.0, "fractional": estimate}.get(status)
    return PooledOrder(order, status, value, interval, estimate, alone, mixture)


def _status(
    order: Order,
    ranked: Sequence[PooledEstimate],
    free: PooledParameter | None,
    verdicts: Sequence[Verdict],
    alone: Mapping[Status, int],
) -> Status:
    best = ranked[0]
    structure = STRUCTURES[best.structure]
    several_modes = 2 * sum(len(v.visible_modes) > 1 for v in verdicts) > len(verdicts)
    if ("zeta" if order == "alpha" else "gamma") not in structure.free:
        return "absent" if several_modes else "not identifiable"
    # One mode shows how much damping there is, and nothing of how that goes with frequency.
    if order == "alpha" and not several_modes:
        return "not identifiable"
    if free is None:
        # Nothing pooled to go by: with a stiffness for each mode no structure has alpha free.
        fixed = structure.fixed.get(order) == 1.0
        return "compatible" if fixed and next(iter(alone)) == "compatible" else "not identifiable"
    low, high = free.interval
    if low <= 1 <= high:
        return "compatible"
    if order not in structure.free:
        undecided = any(order in STRUCTURES[r.structure].free for r in rivals(ranked, EVEN))
        return "open" if undecided else "compatible"
    adequate = sum(v.adequate for v in verdicts) >= _ADEQUATE * len(verdicts)
    integer = any(STRUCTURES[r.structure].fixed.get(order) == 1.0 for r in rivals(ranked, STRONG))
    return "fractional" if adequate and not integer else "open"


def rivals(ranked: Sequence[PooledEstimate], within: float) -> tuple[PooledEstimate, ...]:
    """Return those whose BIC is less than so much above the lowest, without the best."""
    return tuple(each for each in ranked[1:] if each.bic < ranked[0].bic + within)


def _where_free(order: Order, ranked: Sequence[PooledEstimate]) -> PooledEstimate | None:
    """Find where the order is estimated: in the best structure, or the simplest beyond it."""
    best = ranked[0]
    wanted = {*STRUCTURES[best.structure].free, order}
    for each in sorted(ranked, key=lambda each: len(STRUCTURES[each.structure].free)):
        if each.uniform == best.uniform and wanted <= set(STRUCTURES[each.structure].free):
            return each
    return None


def _wide(interval: tuple[float, float]) -> float:
    """Share of the range of orders that an interval spans."""
    return (interval[1] - interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])
