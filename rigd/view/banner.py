"""Banner of the overview: the session's state as text and colour, and gauges of its signals."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rigd.gauges import WARNING_FRACTION, Gauge
from rigd.view._session_info import escape_markdown
from rigd.view.chart import LABEL_DROP_PT
from rigd.view.plots import GREEN, GREY, ORANGE, RED, SKY_BLUE, TIMELINE, Color

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

    from rigd.view._session_info import Health, SessionDescription

STATE_ENTITY: Final = "/state"
"""Entity path in Rerun of the text with the session's state."""
GAUGES_ENTITY: Final = "/values"
"""Entity path in Rerun of the gauges."""


@dataclass(frozen=True, slots=True)
class BannerState:
    """State of a session as the banner shows it.

    Attributes
    ----------
    state_name
        Name of the state in capitals.
    color
        Colour of the band above the gauges. Red is for alarms only.
    reason
        Reason for the state; empty if there is none.
    is_over
        Whether the session is over, so that no remaining time is shown.
    """

    state_name: str
    color: Color
    reason: str = ""
    is_over: bool = False


RUNNING: Final = BannerState("RUNNING", SKY_BLUE)
"""State while samples are recorded."""
STOPPING: Final = BannerState("STOPPING", ORANGE)
"""State after a stop was requested."""
RETURNING: Final = BannerState("RETURNING", ORANGE, "The record is over.")
"""State after the record, while the motor returns to its start."""
FINISHING: Final = BannerState("FINISHING", ORANGE, "The record is over and the torque is off.")
"""State after the record, when the drive has shown that it is off."""
SUPERVISOR_SILENT: Final = BannerState(
    "SUPERVISOR NOT RESPONDING",
    RED,
    "The session cannot be stopped now; it is aborted after 2 s. Check CPU load.",
)
"""State while the supervising process does not respond."""
SUPERVISOR_SILENT_TORQUE_OFF: Final = BannerState(
    "SUPERVISOR NOT RESPONDING", RED, "The session has ended and the torque is off. Check CPU load."
)
"""State if the supervising process does not respond after the drive has shown that it is off."""
SUPERVISOR_LOST: Final = BannerState(
    "SUPERVISOR LOST",
    RED,
    "The supervising process ended. The control process ends the session and commands the torque "
    "off; press the wired stop (STO) if anything moves.",
    is_over=True,
)
"""State after the supervising process ended before the session."""
SUPERVISOR_LOST_TORQUE_OFF: Final = BannerState(
    "SUPERVISOR LOST",
    RED,
    "The supervising process ended; the torque is off.",
    is_over=True,
)
"""State if the supervising process ended and the drive has shown that it is off."""

_COLORS_BY_OUTCOME: Final = {"complete": GREEN, "stopped": GREY, "fault": RED}
"""Colour of the band after a session, by its outcome."""


def preparing_state(activity: str = "") -> BannerState:
    """Return the banner's state for a session before its record.

    Parameters
    ----------
    activity
        Text that says what the session does at present.
    """
    return BannerState("PREPARING", ORANGE, activity)


def ended_state(outcome_name: str, end_reason: str) -> BannerState:
    """Return the banner's state for a session that is over.

    Parameters
    ----------
    outcome_name, end_reason
        Outcome of the session and the reason for it. An empty outcome means unknown.
    """
    state_name = outcome_name.upper() or "ENDED"
    return BannerState(
        state_name, _COLORS_BY_OUTCOME.get(outcome_name, ORANGE), end_reason, is_over=True
    )


# State in words


def banner(session: "SessionDescription", state: BannerState, t_ns: int, health: "Health") -> str:
    """Return the banner's text as Markdown: state, remaining time, reason and excitation.

    Parameters
    ----------
    session
        The session.
    state
        State of the session.
    t_ns
        Time since the start of the session.
    health
        Health reading at that time.
    """
    remaining_s = session.scheduled_ticks / session.rate_hz - 1e-9 * t_ns
    heading = f"# {'Recorded: ' if session.is_recorded else ''}{state.state_name}"
    if state is RUNNING and remaining_s > 0.0:
        heading += f" · {math.ceil(remaining_s)} s left"
    banner_lines = [heading]
    if state.reason:
        banner_lines.append(
            f"**{escape_markdown(state.reason)}**"
            if state.color == RED
            else escape_markdown(state.reason)
        )
    if not state.is_over and health.missed_ticks:
        missed_percent = 100.0 * health.missed_ticks / max(1e-9 * t_ns * session.rate_hz, 1.0)
        banner_lines.append(
            f"Computer overloaded: {health.missed_ticks:.0f} ticks missed ({missed_percent:.2g} %)."
        )
    excitation_text = f"**{escape_markdown(session.excitation or 'session')}**"
    if session.sweep_hz is not None:
        start_hz, stop_hz = session.sweep_hz
        back_sweep_text = "" if session.return_sweep is None else f" → {start_hz:g}"
        excitation_text += f" {start_hz:g} → {stop_hz:g}{back_sweep_text} Hz"
    sweep_tick = round(1e-9 * t_ns * session.rate_hz)
    if not state.is_over and (frequency_hz := session.frequency_hz(sweep_tick)) is not None:
        excitation_text += f", now **{frequency_hz:.3g} Hz**"
    if session.specimen:
        excitation_text += f", specimen **{escape_markdown(session.specimen)}**"
    banner_lines.append(f"{excitation_text}, session {escape_markdown(session.name)}")
    return "\n\n".join(banner_lines)


def send_banner(
    stream: "RecordingStream",
    session: "SessionDescription",
    state: BannerState,
    t_ns: int,
    health: "Health",
) -> None:
    """Send the banner's text to Rerun, for a time of the session.

    Parameters
    ----------
    stream
        Recording to send to.
    session
        The session.
    state
        State of the session.
    t_ns
        Time since the start of the session.
    health
        Health reading at that time.
    """
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    banner_text = banner(session, state, t_ns, health)
    stream.log(STATE_ENTITY, rr.TextDocument(banner_text, media_type=rr.MediaType.MARKDOWN))


# Values with their limits

GAUGES_CANVAS_SIZE: Final = (700.0, 132.0)
"""Width and height of the canvas with the gauges, in points."""
_BAND_HEIGHT_PT: Final = 14.0
"""Height of the coloured band above the gauges, in points."""
_GAUGES_PER_COLUMN: Final = 6
"""Number of gauges in a column."""
_FIRST_ROW_Y_PT, _ROW_HEIGHT_PT = 32.0, 17.5
"""Vertical position of the first row of gauges and distance between rows, in points."""
_GAUGE_TEXT_WIDTH_PT, _BAR_WIDTH_PT, _BAR_HEIGHT_PT = 225.0, 105.0, 8.0
"""Width of a gauge's text, and width and height of its bar, in points."""
_EMPTY_BAR_COLOR: Color = (75, 75, 75)
"""Colour of the empty part of a gauge's bar."""

_GAUGE_LABELS: Final = {
    "angle": "angle",
    "velocity": "speed",
    "tracking_error": "tracking error",
    "torque_command": "torque",
    "i2t": "rms torque (i²t)",
    "missed": "missed ticks",
    "fx": "Fx",
    "fy": "Fy",
    "fz": "Fz",
    "tx": "Tx",
    "ty": "Ty",
    "tz": "Tz",
}
"""Labels of the gauges by signal name: first the left column, then the right one."""


def missed_ticks_gauge(session: "SessionDescription", t_ns: int, health: "Health") -> Gauge:
    """Return the gauge of missed ticks, in percent of the ticks so far, with its limit.

    Parameters
    ----------
    session
        The session.
    t_ns
        Time since the start of the session.
    health
        Health reading at that time.
    """
    scheduled_ticks = max(1e-9 * t_ns, 10.0) * session.rate_hz
    missed_ticks = health.missed_ticks
    missed_percent = None if missed_ticks is None else 100.0 * missed_ticks / scheduled_ticks
    return Gauge(missed_percent, session.limits.get("missed"), "%")


def gauge_text(gauge_label: str, gauge: Gauge) -> str:
    """Return the text of a gauge, such as ``speed 1.05 of 15 rad/s``.

    Parameters
    ----------
    gauge_label
        Label of the signal.
    gauge
        Value and limit of the signal.
    """
    if gauge.value is None:
        return f"{gauge_label} unknown"
    if gauge.limit is None:
        return f"{gauge_label} {gauge.value:.3g} {gauge.unit}"
    # The resolution is a thousandth of the limit, with a constant number of digits.
    decimal_count = max(0, 3 - math.floor(math.log10(gauge.limit)))
    return f"{gauge_label} {gauge.value:.{decimal_count}f} of {gauge.limit:.3g} {gauge.unit}"


def gauge_color(gauge: Gauge) -> Color:
    """Return the colour of a gauge's bar: red at the limit, orange above 80 % of the limit.

    Parameters
    ----------
    gauge
        Value and limit of the signal.
    """
    fraction_of_limit = gauge.fraction
    if fraction_of_limit is None:
        return GREY
    return (
        RED
        if fraction_of_limit >= 1.0
        else ORANGE
        if fraction_of_limit >= WARNING_FRACTION
        else GREEN
    )


def send_gauges(
    stream: "RecordingStream", state: BannerState, t_ns: int, gauges: Mapping[str, Gauge]
) -> None:
    """Send a band in the state's colour and the bars and texts of the gauges to Rerun.

    Parameters
    ----------
    stream
        Recording to send to.
    state
        State of the session.
    t_ns
        Time since the start of the session.
    gauges
        Values and limits by signal name, from `rigd.gauges.Gauges`.
    """
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    canvas_width, _ = GAUGES_CANVAS_SIZE
    bar_lines, bar_colors, bar_radii = (
        [[[0.0, 8.0], [canvas_width, 8.0]]],
        [state.color],
        [_BAND_HEIGHT_PT / 2],
    )
    label_positions, label_texts, label_colors = [], [], []
    for gauge_index, (signal_name, gauge_label) in enumerate(_GAUGE_LABELS.items()):
        gauge = gauges.get(signal_name)
        if gauge is None:
            continue
        gauge_column, gauge_row = divmod(gauge_index, _GAUGES_PER_COLUMN)
        x, y = (
            gauge_column * (canvas_width / 2 + 10.0),
            _FIRST_ROW_Y_PT + gauge_row * _ROW_HEIGHT_PT,
        )
        value_text, bar_color = gauge_text(gauge_label, gauge), gauge_color(gauge)
        # Rerun centres a label, whose width is not known here.
        label_positions.append([x + _GAUGE_TEXT_WIDTH_PT / 2, y - LABEL_DROP_PT])
        label_texts.append(value_text)
        label_colors.append(GREY if bar_color == GREEN else bar_color)
        bar_left = x + _GAUGE_TEXT_WIDTH_PT
        if gauge.fraction is not None:
            bar_end = bar_left + _BAR_WIDTH_PT * min(gauge.fraction, 1.0)
            bar_lines += [
                [[bar_left, y], [bar_left + _BAR_WIDTH_PT, y]],
                [[bar_left, y], [bar_end, y]],
            ]
            bar_colors += [_EMPTY_BAR_COLOR, bar_color]
            bar_radii += [_BAR_HEIGHT_PT / 2] * 2
    stream.log(
        f"{GAUGES_ENTITY}/bars",
        rr.LineStrips2D(bar_lines, colors=bar_colors, radii=rr.Radius.ui_points(bar_radii)),
    )
    stream.log(
        f"{GAUGES_ENTITY}/texts",
        rr.Points2D(
            label_positions, labels=label_texts, colors=label_colors, radii=0.0, show_labels=True
        ),
    )


def state_and_gauge_views() -> "tuple[rrb.View, rrb.View]":
    """Return Rerun's views of the session's state and of the gauges."""
    import rerun.blueprint as rrb

    canvas_width, canvas_height = GAUGES_CANVAS_SIZE
    return (
        rrb.TextDocumentView(name="State", origin=STATE_ENTITY),
        rrb.Spatial2DView(
            name="Values and limits",
            origin=GAUGES_ENTITY,
            visual_bounds=rrb.VisualBounds2D(
                x_range=[0.0, canvas_width], y_range=[0.0, canvas_height]
            ),
        ),
    )
