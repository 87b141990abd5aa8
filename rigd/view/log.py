"""The session's log as Rerun shows it."""

from typing import TYPE_CHECKING, Final

from rigd.view.plots import TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.view.notes import Note

EVENTS: Final = "/events"

_LEVELS: Final = {
    "debug": "DEBUG",
    "info": "INFO",
    "warning": "WARN",
    "error": "ERROR",
    "fatal": "CRITICAL",
}
"""What Rerun calls the levels: it has colours for these."""


def send_note(stream: "RecordingStream", note: "Note") -> None:
    """Add a line to the log."""
    import rerun as rr

    # To the millisecond: more is hard to read.
    stream.set_time(TIMELINE, duration=1e-3 * round(1e-6 * note.t_ns))
    stream.log(EVENTS, rr.TextLog(note.message, level=_LEVELS.get(note.level, "INFO")))
