"""Sentences of a campaign on modes and damping with a tolerance of the geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.campaigns.sentences import in_single_sessions, probability
from analysis.identify.headline import EXACT_CONDITION
from analysis.identify.sentences import LOSSES, slope_of_loss
from analysis.statistics import NORMAL_95
from rigd.printable import listed
from rigd.units import to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns._modal import ModeInSweeps, OppositeSweeps, PooledModal
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.identify.uniform_beam import TolerantEstimate

_BASES: Final = {
    "losses": "damping ratios and residue phases alone",
    "none": "no beam with one order of each damping, which do not explain the losses",
}


def chance(p_value: float) -> str:
    """Write a p-value."""
    written = probability(p_value)
    return f"p {written}" if written.startswith("<") else f"p = {written}"


def tolerance(modal: PooledModal, estimate: TolerantEstimate) -> str:
    """Describe the basis of the parameters, and their tolerance of the geometry."""
    stated = modal.stated[-1]
    given = f"{100 * stated:g} % as the files state it"
    if len(modal.stated) > 1:
        every = listed([f"{100 * each:g}" for each in modal.stated])
        given = f"{100 * stated:g} %, the largest of the {every} % that the files state"
    sentence = (
        f"Parameters are those of a beam with both dampings, from the modal constants of "
        f"{modal.sessions} sessions"
    )
    if estimate.basis != "geometry":
        return (
            f"{sentence}, by {_BASES[estimate.basis]}: the frequencies are not those of a uniform "
            f"beam to {given}, nor with a wider tolerance."
        )
    used = given
    if estimate.uniformity > stated:
        used = f"{100 * estimate.uniformity:g} % ({given} does not suffice)"
    return (
        f"{sentence}; each mode lies where that of a uniform beam does, to {used}. An unevenness "
        "of the specimen is common to all sessions and does not average out."
    )


def slope(found: PooledOrder, modal: PooledModal) -> str:
    """Describe an order as the slope of a loss over the visible modes.

    Parameters
    ----------
    found : PooledOrder
        The order as `modal.tolerant` has it.
    modal : PooledModal
    """
    estimate = modal.tolerant
    assert estimate is not None
    counts = {f"“{status}”": count for status, count in found.alone.items()}
    alone = in_single_sessions(counts, sum(counts.values()))
    if found.value is None or found.interval is None:
        return (
            f"The slope of the {LOSSES[found.order]} ({found.order}) is not identifiable: "
            f"{found.reason}. {alone}"
        )
    shown_hz = [mode.frequency_hz for mode in modal.modes]
    sentence = slope_of_loss(
        found.order, found.value, found.interval, shown_hz, estimate, found.status, found.reason
    )
    return f"{sentence} {alone}"


def if_exact(
    freest: PooledEstimate, orders: Sequence[PooledOrder], modal: PooledModal | None
) -> list[str]:
    """Describe the orders on condition that the beam is exactly uniform.

    Empty if a uniform beam does not predict the modes.
    """
    if modal is None or modal.uniform_beam.status == "refused":
        return []
    orders_shown = []
    for each in orders:
        exact = each.exact
        if exact is None or exact.reason or exact.value is None or exact.interval is None:
            continue
        half = (exact.interval[1] - exact.interval[0]) / 2
        value, low, high = to_uncertainty((exact.value, *exact.interval), exact.std or half)
        end = {
            "compatible": "consistent with 1",
            "fractional": "which would exclude 1",
            "open": "1 would be doubtful",
        }
        orders_shown.append(f"{each.order} {value} (95 %: {low} to {high}; {end[exact.status]})")
    return (
        [f"{EXACT_CONDITION.capitalize()} (type {freest.name}): {'; '.join(orders_shown)}."]
        if orders_shown
        else []
    )


# Rising and falling sweeps


def sweeps(found: OppositeSweeps | None) -> list[str]:
    """Describe whether rising and falling sweeps show the same modes."""
    if found is None:
        return []
    which = f"{found.rising} rising and {found.falling} falling sweeps"
    if not found.changed:
        least = min(each.chance for each in found.modes)
        most = max(abs(each.frequency) + NORMAL_95 * each.frequency_std for each in found.modes)
        return [
            f"Nothing changed along the records: {which} have the same modal constants (lowest "
            f"{chance(least)}; frequencies to {100 * most:.1g} %)."
        ]
    each = "; ".join(map(_difference, found.changed))
    return [
        f"Something changes along the records, or with the direction of the sweep: {which} differ "
        f"in {each}. Each mode is as it was when the sweep passed it."
    ]


def _difference(each: ModeInSweeps) -> str:
    def percent(value: float, std: float) -> str:
        size, spread = to_uncertainty((abs(value), NORMAL_95 * std), std, 100.0)
        return f"{size} ± {spread} % {'higher' if value > 0 else 'lower'}"

    return (
        f"mode {each.mode} (falling: frequency {percent(each.frequency, each.frequency_std)}, "
        f"damping ratio {percent(each.damping, each.damping_std)}; {chance(each.chance)})"
    )


def experiments(
    found: OppositeSweeps | None, modal: PooledModal | None, sessions: Sequence[SessionAnalysis]
) -> list[str]:
    """Recommend sweeps that decide whether the specimen changes during the records."""
    if found is not None and found.changed:
        modes = listed([str(each.mode) for each in found.changed])
        return [
            "To tell a change in time from one with amplitude, repeat both sweeps with half the "
            f"amplitude: a difference in mode {modes} that stays is a change in time. Then check "
            "clamp and temperature."
        ]
    one_way = {each.experiment.rising for each in sessions}
    refused = modal is not None and modal.uniform_beam.status == "refused"
    if found is None and refused and one_way in ({True}, {False}):
        other = "falling" if True in one_way else "rising"
        return [
            f"Add {other} sweeps (start_hz and stop_hz exchanged): in sweeps of one direction a "
            "change along the record looks like a beam that is not uniform."
        ]
    return []
