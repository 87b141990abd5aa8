"""Banner of the overview: state of the session as text and colour, and values with their limits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rigd.view._gauges import NEAR, Gauge
from rigd.view._session_info import plain
from rigd.view.chart import LABEL_DROP
from rigd.view.plots import GREEN, GREY, ORANGE, RED, SKY_BLUE, TIMELINE, Color

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

    from rigd.view._session_info import Health, Subject

STATE: Final = "/state"
VALUES: Final = "/values"


@dataclass(frozen=True, slots=True)
class BannerState:
    """State of a session in the banner.

    Attributes
    ----------
    word
        State in capitals.
    color
        Colour of the band above the values: red for alarms only.
    reason
        Reason of the state; empty without one.
    over
        Whether the session is over, so that no remaining time is shown.
    """

    word: str
    color: Color
    reason: str = ""
    over: bool = False


RUNNING: Final = BannerState("RUNNING", GREEN)
STOPPING: Final = BannerState("STOPPING", ORANGE)
RETURNING: Final = BannerState("RETURNING", ORANGE, "The record is over.")
FINISHING: Final = BannerState("FINISHING", ORANGE, "The record is over and the torque is off.")
SUPERVISOR_SILENT: Final = BannerState(
    "SUPERVISOR NOT RESPONDING",
    RED,
    "The session cannot be stopped now; it is aborted after 2 s. Check CPU load.",
)
SUPERVISOR_SILENT_TORQUE_OFF: Final = BannerState(
    "SUPERVISOR NOT RESPONDING", RED, "The session has ended and the torque is off. Check CPU load."
)
SUPERVISOR_LOST: Final = BannerState(
    "SUPERVISOR LOST",
    RED,
    "The supervising process ended. The control process ends the session and switches the torque "
    "off.",
    over=True,
)
SUPERVISOR_LOST_TORQUE_OFF: Final = BannerState(
    "SUPERVISOR LOST",
    RED,
    "The supervising process ended; the torque is off.",
    over=True,
)

_COLOR_OF_OUTCOME: Final = {"complete": SKY_BLUE, "stopped": GREY, "fault": RED}


def preparing(doing: str = "") -> BannerState:
    """Return the state of a session before its record.

    Parameters
    ----------
    doing
        Present activity, as text.
    """
    return BannerState("PREPARING", ORANGE, doing)


def ended(outcome: str, reason: str) -> BannerState:
    """Return the state of a session that is over.

    Parameters
    ----------
    outcome, reason
        Outcome of the session and its reason; an empty outcome is unknown.
    """
    word = outcome.upper() or "ENDED"
    return BannerState(word, _COLOR_OF_OUTCOME.get(outcome, ORANGE), reason, over=True)


# State in words


def banner(subject: "Subject", state: BannerState, t_ns: int, health: "Health") -> str:
    """Return the banner as Markdown: state, remaining time, reason and excitation.

    Parameters
    ----------
    subject
        The session.
    state
        State of the session.
    t_ns
        Time since the start of the session.
    health
        Health at that time.
    """
    left_s = subject.ticks / subject.rate_hz - 1e-9 * t_ns
    heading = f"# {'Recorded: ' if subject.recorded else ''}{state.word}"
    if state is RUNNING and left_s > 0.0:
        heading += f" · {math.ceil(left_s)} s left"
    lines = [heading]
    if state.reason:
        lines.append(f"**{plain(state.reason)}**" if state.color == RED else plain(state.reason))
    if not state.over and health.missed_ticks:
        percentage = 100.0 * health.missed_ticks / max(1e-9 * t_ns * subject.rate_hz, 1.0)
        lines.append(
            f"Computer overloaded: {health.missed_ticks:.0f} ticks missed ({percentage:.2g} %)."
        )
    what = f"**{plain(subject.excitation or 'session')}**"
    if subject.sweep_hz is not None:
        start_hz, stop_hz = subject.sweep_hz
        back = "" if subject.back is None else f" → {start_hz:g}"
        what += f" {start_hz:g} → {stop_hz:g}{back} Hz"
    tick = round(1e-9 * t_ns * subject.rate_hz)
    if not state.over and (frequency_hz := subject.frequency_hz(tick)) is not None:
        what += f", now **{frequency_hz:.3g} Hz**"
    if subject.specimen:
        what += f", specimen **{plain(subject.specimen)}**"
    lines.append(f"{what}, session {plain(subject.name)}")
    return "\n\n".join(lines)


def send_banner(
    stream: "RecordingStream", subject: "Subject", state: BannerState, t_ns: int, health: "Health"
) -> None:
    """Show the banner at a time.

    Parameters
    ----------
    stream
        Stream for the drawing.
    subject
        The session.
    state
        Its state.
    t_ns
        Time since its start.
    health
        The readings of that time.
    """
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    text = banner(subject, state, t_ns, health)
    stream.log(STATE, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


# Values with their limits

SIZE: Final = (700.0, 132.0)
"""Width and height of the canvas, in points."""
_BAND_HEIGHT: Final = 14.0
_ROWS: Final = 6
_FIRST_ROW, _ROW_HEIGHT = 32.0, 17.5
_TEXT_WIDTH, _BAR_WIDTH, _BAR_HEIGHT = 225.0, 105.0, 8.0
_TRACK: Color = (75, 75, 75)

_LABELS: Final = {
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
"""Labels of the gauges by name, first the left column and then the right one."""


def missed_gauge(subject: "Subject", t_ns: int, health: "Health") -> Gauge:
    """Return the percentage of missed ticks with its limit.

    Parameters
    ----------
    subject
        The session.
    t_ns
        Time since its start.
    health
        Health at that time.
    """
    scheduled = max(1e-9 * t_ns, 10.0) * subject.rate_hz
    missed = health.missed_ticks
    percentage = None if missed is None else 100.0 * missed / scheduled
    return Gauge(percentage, subject.limits.get("missed"), "%")


def gauge_text(label: str, gauge: Gauge) -> str:
    """Return the text of a gauge: ``speed 1.05 of 15 rad/s``.

    Parameters
    ----------
    label
        Name of the signal.
    gauge
        Its value and limit.
    """
    if gauge.value is None:
        return f"{label} unknown"
    if gauge.limit is None:
        return f"{label} {gauge.value:.3g} {gauge.unit}"
    # To a thousandth of the limit, with a constant number of digits.
    digits = max(0, 3 - math.floor(math.log10(gauge.limit)))
    return f"{label} {gauge.value:.{digits}f} of {gauge.limit:.3g} {gauge.unit}"


def gauge_color(gauge: Gauge) -> Color:
    """Return the colour of a gauge's bar: red at the limit, orange above 80 % of it.

    Parameters
    ----------
    gauge
        Value and limit.
    """
    fraction = gauge.fraction
    if fraction is None:
        return GREY
    return RED if fraction >= 1.0 else ORANGE if fraction >= NEAR else GREEN


def send_values(
    stream: "RecordingStream", state: BannerState, t_ns: int, gauges: Mapping[str, Gauge]
) -> None:
    """Draw the band in the state's colour, and bars of the values relative to their limits.

    Parameters
    ----------
    stream
        Stream for the drawing.
    state
        State of the session.
    t_ns
        Time since its start.
    gauges
        Values and limits by name, from `rigd.view.Gauges`.
    """
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    width, _ = SIZE
    strips, colors, radii = [[[0.0, 8.0], [width, 8.0]]], [state.color], [_BAND_HEIGHT / 2]
    points, labels, label_colors = [], [], []
    for index, (name, label) in enumerate(_LABELS.items()):
        gauge = gauges.get(name)
        if gauge is None:
            continue
        column, row = divmod(index, _ROWS)
        x, y = column * (width / 2 + 10.0), _FIRST_ROW + row * _ROW_HEIGHT
        text, color = gauge_text(label, gauge), gauge_color(gauge)
        # Rerun centres a label, whose width is not known here.
        points.append([x + _TEXT_WIDTH / 2, y - LABEL_DROP])
        labels.append(text)
        label_colors.append(GREY if color == GREEN else color)
        left = x + _TEXT_WIDTH
        if gauge.fraction is not None:
            filled = left + _BAR_WIDTH * min(gauge.fraction, 1.0)
            strips += [[[left, y], [left + _BAR_WIDTH, y]], [[left, y], [filled, y]]]
            colors += [_TRACK, color]
            radii += [_BAR_HEIGHT / 2] * 2
    stream.log(
        f"{VALUES}/bars",
        rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radii)),
    )
    stream.log(
        f"{VALUES}/texts",
        rr.Points2D(points, labels=labels, colors=label_colors, radii=0.0, show_labels=True),
    )


def views() -> "tuple[rrb.View, rrb.View]":
    """Return the views of the state and of the values."""
    import rerun.blueprint as rrb

    width, height = SIZE
    return (
        rrb.TextDocumentView(name="State", origin=STATE),
        rrb.Spatial2DView(
            name="Values and limits",
            origin=VALUES,
            visual_bounds=rrb.VisualBounds2D(x_range=[0.0, width], y_range=[0.0, height]),
        ),
    )
