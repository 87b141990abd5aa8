"""Session information for the viewer: data, log lines, health and summary of the session."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping
from rigd.session import sweep_frequency_hz
from rigd.view.plots import TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream


EVENTS: Final = "/events"
RECENT_EVENTS: Final = "/recent_events"
SUMMARY: Final = "/summary"

_LOG_WIDTH: Final = 150
"""Width of the log in characters: longer lines are wrapped, because the viewer would cut them."""
_MOST_RECENT: Final = 20
"""Number of events in the document of the newest events."""
_SYMBOLS: Final = {"warning": "⚠ ", "error": "⚠ **ERROR** ", "fatal": "⚠ **FATAL** "}


@dataclass(frozen=True, slots=True)
class Subject:
    """Data of a session for its views.

    Attributes
    ----------
    name
        Name of the session, which the viewer shows as the recording's name.
    rate_hz
        Scheduled ticks per second.
    ticks
        Scheduled ticks of the whole record.
    sweep
        First tick and end (exclusive) of the excitation, or of the first of two sweeps.
    beam
        The specimen.
    damping
        Nominal damping of the profile; None: unknown, and no model of the frequency response is
        drawn.
    tool_inertia_kg_m2
        Inertia between the torque sensor and the beam, about the motor's axis.
    angle_delay_s, torque_delay_s
        Age of either value at its time stamp; positive: the value is older.
    excitation
        Name of the excitation; empty if unknown.
    sweep_hz
        Frequencies at the ends of a linear sweep; None: no linear sweep.
    back
        First tick and end (exclusive) of a second sweep, back to the first frequency; None: none.
    specimen
        Name of the specimen as the operator gave it.
    limits
        Limits by the names of the gauges (`rigd.view.Gauges`), and ``missed`` in percent of all
        ticks; an absent one is no limit.
    thermal_time_constant_s
        Time constant of the motor's rms torque.
    absent
        Components of plots without values, such as the bus load without a bus.
    recorded
        Whether the session is played from a file.
    fit_modes
        Number of modes whose fits are plotted over time; 0: only a table of the last fit; None:
        the record is not fitted.
    """

    name: str
    rate_hz: float
    ticks: int
    sweep: tuple[int, int]
    beam: Beam
    damping: Damping | None
    tool_inertia_kg_m2: float = 0.0
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    excitation: str = ""
    sweep_hz: tuple[float, float] | None = None
    back: tuple[int, int] | None = None
    specimen: str = ""
    limits: Mapping[str, float] = field(default_factory=dict)
    thermal_time_constant_s: float = 10.0
    absent: frozenset[str] = frozenset()
    recorded: bool = False
    fit_modes: int | None = None

    def frequency_hz(self, tick: int) -> float | None:
        """Return the frequency of the sweep at a tick; None before, after or without a sweep.

        Parameters
        ----------
        tick
            Tick of the record.
        """
        if self.sweep_hz is None:
            return None
        segments = {"sweep": self.sweep} | ({} if self.back is None else {"back": self.back})
        return sweep_frequency_hz(segments, self.sweep_hz, tick)


def sweep_of(segments: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    """Return the part of a record over which its frequency response is estimated.

    Parameters
    ----------
    segments
        First tick and end (exclusive) of each segment, one of which is the sweep.
    """
    # The segments of a search after its scan do not sweep the band. The first of two sweeps is the
    # one that a chirp without a way back has.
    return next(segments[name] for name in ("scan", "there", "sweep") if name in segments)


def band_of(kind: str, parameters: Mapping[str, float | int | str]) -> tuple[float, float] | None:
    """Return the frequencies at the ends of a linear sweep; None for other excitations.

    Parameters
    ----------
    kind, parameters
        Excitation and its parameters, as numbers or as texts of a session file.
    """
    if kind != "chirp":
        return None
    try:
        return float(parameters["start_hz"]), float(parameters["stop_hz"])
    except (KeyError, ValueError):
        return None


@dataclass(frozen=True, slots=True)
class Note:
    """A log event for the views.

    Attributes
    ----------
    t_ns
        Time since the start of the session.
    level
        "debug", "info", "warning", "error" or "fatal", as in the session file.
    message
        Text for the operator.
    """

    t_ns: int
    level: str
    message: str


def outcome_note(t_ns: int, outcome: str, reason: str) -> Note:
    """Return the last log event of a session: its outcome, at the time of the last sample.

    Parameters
    ----------
    t_ns
        Time of the last sample.
    outcome, reason
        Outcome of the session and its reason.
    """
    return Note(
        t_ns, _LEVEL_OF_OUTCOME.get(outcome, "warning"), f"Outcome: {outcome}. {reason}".rstrip()
    )


_LEVEL_OF_OUTCOME = {"complete": "info", "fault": "error"}


@dataclass(frozen=True, slots=True)
class Health:
    """Health readings at one time; unknown values are None, such as the load without a bus.

    Attributes
    ----------
    missed_ticks
        Ticks that the loop missed since the start of the session.
    late_ticks
        Ticks with a late wake-up that were not missed, since the start.
    lost_ticks
        Ticks whose samples were lost because the ring was full, since the start.
    recorder_lag_ticks
        Samples that wait in the ring for the recorder.
    disk_free_mb
        Free space on the disk of the session file, in 10⁶ bytes.
    view_dropped
        Samples that could not be shown in time, since the start.
    bus_load_percent
        Load of the CAN bus or the serial line.
    bus_errors
        Disturbed, damaged or missing messages, since the devices were connected.
    sensor_status
        Status word of the force-torque sensor; 0: no fault.
    rate_hz
        Measured ticks per second.
    """

    missed_ticks: float | None = None
    late_ticks: float | None = None
    lost_ticks: float | None = None
    recorder_lag_ticks: float | None = None
    disk_free_mb: float | None = None
    view_dropped: float | None = None
    bus_load_percent: float | None = None
    bus_errors: float | None = None
    sensor_status: float | None = None
    rate_hz: float | None = None


HEALTH_DTYPE: Final = np.dtype([("t_ns", "<i8")] + [(each.name, "<f8") for each in fields(Health)])
"""Record of a reading; unknown values are NaN."""


def health_record(t_ns: int, health: Health) -> npt.NDArray[Any]:
    """Return an array (1,) of ``HEALTH_DTYPE`` with the reading of one moment."""
    values = (np.nan if value is None else value for value in astuple(health))
    return np.array([(t_ns, *values)], HEALTH_DTYPE)


_RERUN_LEVELS: Final = {
    "debug": "DEBUG",
    "info": "INFO",
    "warning": "WARN",
    "error": "ERROR",
    "fatal": "CRITICAL",
}
"""Rerun's names of the levels, for which it has colours."""


def send_note(stream: "RecordingStream", note: "Note") -> None:
    """Add a line to the log."""
    import rerun as rr

    # In milliseconds: more digits are hard to read.
    stream.set_time(TIMELINE, duration=1e-3 * round(1e-6 * note.t_ns))
    text = "\n".join(
        line for part in note.message.splitlines() for line in wrap(part, _LOG_WIDTH) or [""]
    )
    stream.log(EVENTS, rr.TextLog(text, level=_RERUN_LEVELS.get(note.level, "INFO")))


def send_recent(stream: "RecordingStream", t_ns: int, notes: "Sequence[Note]") -> None:
    """Show the newest of `notes`, which are in order of time, as a document with wrapped lines."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    lines = []
    for note in reversed(notes[-_MOST_RECENT:]):
        time_s = max(0.0, 1e-9 * note.t_ns)  # the first event may come a tick early
        symbol = _SYMBOLS.get(note.level, "")
        lines.append(f"**{time_s:.1f} s** {symbol}{plain(note.message)}")
    stream.log(RECENT_EVENTS, rr.TextDocument("\n\n".join(lines), media_type=rr.MediaType.MARKDOWN))


def plain(text: str) -> str:
    """Return a text escaped for Markdown.

    Parameters
    ----------
    text
        Any text from an operator or a process.
    """
    escaped = "".join(f"\\{c}" if c in r"\`*_{}[]<>#|~$" else c for c in text)
    return escaped.replace("\n", "  \n")


def summary(subject: "Subject", t_ns: int, health: "Health") -> str:
    """Return a Markdown table of the session's health, without unknown values."""
    elapsed_s = 1e-9 * t_ns
    total_s = subject.ticks / subject.rate_hz
    rows = [
        ("rate", _number(health.rate_hz, "{:.1f} Hz"), True),
        ("missed ticks", _number(health.missed_ticks), not health.missed_ticks),
        ("late ticks", _number(health.late_ticks), not health.late_ticks),
        ("lost ticks", _number(health.lost_ticks), not health.lost_ticks),
        ("recorder backlog", _number(health.recorder_lag_ticks, "{:.0f} samples"), True),
        ("dropped by the viewer", _number(health.view_dropped, "{:.0f} samples"), True),
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
    """Show the summary at a time."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    text = summary(subject, t_ns, health)
    stream.log(SUMMARY, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _number(value: float | None, form: str = "{:.0f}") -> str:
    return "" if value is None else form.format(value)


def _status(word: float | None) -> str:
    if word is None:
        return ""
    return f"0x{int(word):04x}" if word else "OK"


def _disk(free_mb: float | None) -> str:
    return "" if free_mb is None else f"{1e-3 * free_mb:.1f} GB"
