"""The state of the session in a few lines, for one look."""

from typing import TYPE_CHECKING, Final

from rigd.view.plots import TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.view.health import Health
    from rigd.view.subject import Subject

SUMMARY: Final = "/summary"


def summary(subject: "Subject", t_ns: int, health: "Health") -> str:
    """Return a Markdown table of how the session is doing; what is not known is left out."""
    elapsed_s = 1e-9 * t_ns
    total_s = subject.ticks / subject.rate_hz
    rows = [
        ("rate", _number(health.rate_hz, "{:.1f} Hz"), True),
        ("missed ticks", _number(health.missed_ticks), not health.missed_ticks),
        ("late ticks", _number(health.late_ticks), not health.late_ticks),
        ("lost ticks", _number(health.lost_ticks), not health.lost_ticks),
        ("waiting for the recorder", _number(health.recorder_lag_ticks, "{:.0f} samples"), True),
        ("not shown here", _number(health.view_dropped, "{:.0f} samples"), True),
        ("bus load", _number(health.bus_load_percent, "{:.0f} %"), True),
        ("bus errors", _number(health.bus_errors), not health.bus_errors),
        ("sensor status", _status(health.sensor_status), not health.sensor_status),
        ("free on the disk", _disk(health.disk_free_mb), True),
    ]
    lines = [
        f"| {name} | {text if well else f'⚠ **{text}**'} |" for name, text, well in rows if text
    ]
    head = f"| session | {elapsed_s:.0f} of {total_s:.0f} s |"
    return "\n".join([head, "|---|---|", *lines])


def send_summary(
    stream: "RecordingStream", subject: "Subject", t_ns: int, health: "Health"
) -> None:
    """Show the summary of one moment."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    text = summary(subject, t_ns, health)
    stream.log(SUMMARY, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _number(value: float | None, form: str = "{:.0f}") -> str:
    return "" if value is None else form.format(value)


def _status(word: float | None) -> str:
    if word is None:
        return ""
    return f"0x{int(word):04x}" if word else "well"


def _disk(free_mb: float | None) -> str:
    return "" if free_mb is None else f"{1e-3 * free_mb:.1f} GB"
