"""Sentences on modes and damping estimated from all sessions for a beam that may be uneven."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.campaigns.labels import format_p_value
from analysis.campaigns.sentences import describe_single_sessions
from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.identify.sentences import LOSS_NAMES, loss_slope_sentence
from analysis.statistics import NORMAL_95
from rigd.printable import listed
from rigd.units import rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns._modal import ModeInSweeps, OppositeSweeps, PooledModalModel
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._session import SessionAnalysis
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.identify.tolerant_estimate import TolerantEstimate

_ESTIMATE_BASIS_TEXTS: Final = {
    "losses": "damping ratios and residue phases alone",
    "none": "no beam with one order of each damping, which do not explain the losses",
}
"""Phrases for the bases of estimates that do not use the frequencies of a uniform beam."""


def p_value_text(p_value: float) -> str:
    """Format a p-value as an equation or inequality."""
    p_value_number = format_p_value(p_value)
    return f"p {p_value_number}" if p_value_number.startswith("<") else f"p = {p_value_number}"


def describe_tolerance(modal_model: PooledModalModel, estimate: TolerantEstimate) -> str:
    """Describe from what the parameters are estimated, and the tolerated unevenness of the beam."""
    largest_stated_uniformity = modal_model.stated_uniformities[-1]
    tolerance_text = f"{100 * largest_stated_uniformity:g} % as the files state it"
    if len(modal_model.stated_uniformities) > 1:
        stated_percentages = listed(
            [f"{100 * uniformity:g}" for uniformity in modal_model.stated_uniformities]
        )
        tolerance_text = (
            f"{100 * largest_stated_uniformity:g} %, the largest of the {stated_percentages} % "
            "that the files state"
        )
    basis_sentence = (
        f"Parameters are those of a beam with both dampings, from the modal constants of "
        f"{modal_model.sessions} sessions"
    )
    if estimate.basis != "geometry":
        return (
            f"{basis_sentence}, by {_ESTIMATE_BASIS_TEXTS[estimate.basis]}: the frequencies are "
            f"not those of a uniform beam to {tolerance_text}, nor with a wider tolerance."
        )
    used_tolerance_text = tolerance_text
    if estimate.uniformity > largest_stated_uniformity:
        used_tolerance_text = f"{100 * estimate.uniformity:g} % ({tolerance_text} does not suffice)"
    return (
        f"{basis_sentence}; the mode frequencies are those of a uniform beam to "
        f"{used_tolerance_text}. A "
        "non-uniformity of the specimen is common to all sessions and does not average out."
    )


def describe_loss_slope(pooled_order: PooledOrder, modal_model: PooledModalModel) -> str:
    """Describe an order of the damping as the slope of a loss against frequency.

    The order is estimated for a beam that may be uneven; the modal model has the estimate
    `tolerant`.
    """
    estimate = modal_model.tolerant
    assert estimate is not None
    status_counts = {
        f"“{status}”": session_count for status, session_count in pooled_order.alone.items()
    }
    sessions_sentence = describe_single_sessions(status_counts, sum(status_counts.values()))
    if pooled_order.value is None or pooled_order.interval is None:
        return (
            f"The slope of the {LOSS_NAMES[pooled_order.order]} ({pooled_order.order}) is not "
            f"identifiable: {pooled_order.reason}. {sessions_sentence}"
        )
    mode_frequencies_hz = [mode.frequency_hz for mode in modal_model.modes]
    slope_sentence = loss_slope_sentence(
        pooled_order.order,
        pooled_order.value,
        pooled_order.interval,
        mode_frequencies_hz,
        estimate,
        pooled_order.status,
        pooled_order.reason,
    )
    return f"{slope_sentence} {sessions_sentence}"


def describe_orders_if_exact(
    freest_fit: PooledEstimate, orders: Sequence[PooledOrder], modal_model: PooledModalModel | None
) -> list[str]:
    """Describe the orders of the damping on condition that the beam is exactly uniform.

    The list is empty if a uniform beam does not predict the modes.
    """
    if modal_model is None or modal_model.uniform_beam.status == "refused":
        return []
    order_texts = []
    for order in orders:
        exact_order = order.exact
        if (
            exact_order is None
            or exact_order.reason
            or exact_order.value is None
            or exact_order.interval is None
        ):
            continue
        half_width = (exact_order.interval[1] - exact_order.interval[0]) / 2
        value_text, low_text, high_text = rounded_to_uncertainty(
            (exact_order.value, *exact_order.interval), exact_order.std or half_width
        )
        conclusion_by_status = {
            "compatible": "consistent with 1",
            "fractional": "which would exclude 1",
            "open": "1 would be doubtful",
        }
        order_texts.append(
            f"{order.order} {value_text} (95 %: {low_text} to {high_text}; "
            f"{conclusion_by_status[exact_order.status]})"
        )
    return (
        [
            f"{EXACTLY_UNIFORM_CONDITION.capitalize()} (type {freest_fit.name}): "
            f"{'; '.join(order_texts)}."
        ]
        if order_texts
        else []
    )


# Rising and falling sweeps


def describe_sweeps(sweeps: OppositeSweeps | None) -> list[str]:
    """Describe whether rising and falling sweeps show the same modes."""
    if sweeps is None:
        return []
    sweeps_text = f"{sweeps.rising} rising and {sweeps.falling} falling sweeps"
    if not sweeps.changed:
        lowest_p_value = min(mode_change.chance for mode_change in sweeps.modes)
        frequency_limit, damping_limit = (
            max(abs(change) + NORMAL_95 * std for change, std in changes)
            for changes in (
                [(mode.frequency, mode.frequency_std) for mode in sweeps.modes],
                [(mode.damping, mode.damping_std) for mode in sweeps.modes],
            )
        )
        return [
            f"No significant change along the records was found: the modal constants of "
            f"{sweeps_text} agree (lowest {p_value_text(lowest_p_value)}). Not excluded (95 %): "
            f"changes of up to {100 * frequency_limit:.2g} % in a frequency and "
            f"{100 * damping_limit:.2g} % in a damping ratio."
        ]
    changes_text = "; ".join(map(_describe_mode_change, sweeps.changed))
    return [
        f"Something changes along the records, or with the direction of the sweep: {sweeps_text} "
        f"differ in {changes_text}. Each mode is as it was when the sweep passed it."
    ]


def _describe_mode_change(mode_change: ModeInSweeps) -> str:
    """Describe how one mode differs between falling and rising sweeps."""

    def change_text(relative_change: float, std: float) -> str:
        """Format a relative change in per cent, with its 95 % interval and direction."""
        change_size, interval_text = rounded_to_uncertainty(
            (abs(relative_change), NORMAL_95 * std), std, 100.0
        )
        return f"{change_size} ± {interval_text} % {'higher' if relative_change > 0 else 'lower'}"

    return (
        f"mode {mode_change.mode} (falling: frequency "
        f"{change_text(mode_change.frequency, mode_change.frequency_std)}, "
        f"damping ratio {change_text(mode_change.damping, mode_change.damping_std)}; "
        f"{p_value_text(mode_change.chance)})"
    )


def recommend_sweeps(
    sweeps: OppositeSweeps | None,
    modal_model: PooledModalModel | None,
    sessions: Sequence[SessionAnalysis],
) -> list[str]:
    """Recommend further sweeps that show whether the specimen changes during the records."""
    if sweeps is not None and sweeps.changed:
        modes_text = listed([str(mode_change.mode) for mode_change in sweeps.changed])
        return [
            "To distinguish a change in time from one with amplitude, repeat both sweeps with half "
            f"the amplitude: a difference in mode {modes_text} that stays is a change in time. "
            "Then check clamp and temperature."
        ]
    sweep_directions = {session.experiment.is_rising for session in sessions}
    is_beam_refused = modal_model is not None and modal_model.uniform_beam.status == "refused"
    if sweeps is None and is_beam_refused and sweep_directions in ({True}, {False}):
        missing_direction = "falling" if True in sweep_directions else "rising"
        return [
            f"Add {missing_direction} sweeps (start_hz and stop_hz exchanged): in sweeps of one "
            "direction a change along the record looks like a beam that is not uniform."
        ]
    return []
