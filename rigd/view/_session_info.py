"""Description of a session that its display needs, and its log, health and summary in Rerun."""

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


EVENTS_ENTITY: Final = "/events"
"""Entity path in Rerun of the log."""
RECENT_EVENTS_ENTITY: Final = "/recent_events"
"""Entity path in Rerun of the document with the newest events."""
SUMMARY_ENTITY: Final = "/summary"
"""Entity path in Rerun of the table with the session's health."""

_LOG_WIDTH_CHARACTERS: Final = 150
"""Width of the log in characters. Longer lines are wrapped, because the viewer would cut them."""
_MAX_RECENT_EVENTS: Final = 20
"""Largest number of events in the document with the newest events."""
_PREFIXES_BY_LOG_LEVEL: Final = {"warning": "⚠ ", "error": "⚠ **ERROR** ", "fatal": "⚠ **FATAL** "}
"""Markdown prefixes of events in the document with the newest events, by level."""


@dataclass(frozen=True, slots=True)
class SessionDescription:
    """Data of a session that its display needs: length, beam, limits and excitation.

    Attributes
    ----------
    name
        Name of the session, which the viewer shows as the recording's name.
    rate_hz
        Scheduled ticks per second.
    scheduled_ticks
        Scheduled ticks of the whole record.
    sweep
        First tick and end (exclusive) of the sweep; if there are two sweeps, those of the first.
    beam
        Model of the specimen.
    damping
        Nominal damping of the specimen from the profile. None: unknown, and no model of the
        frequency response is drawn.
    tool_inertia_kg_m2
        Inertia between the torque sensor and the beam, about the motor's axis.
    angle_delay_s, torque_delay_s
        Age of the angle or torque at its time stamp. Positive: the reading is older than the time
        stamp.
    excitation
        Name of the excitation; empty if unknown.
    sweep_hz
        Frequencies at the start and end of a linear sweep; None if the excitation has no linear
        sweep.
    return_sweep
        First tick and end (exclusive) of a second sweep, which returns from the last frequency to
        the first; None if there is no second sweep.
    specimen
        Name of the specimen as the operator gave it.
    limits
        Limits by the names of the gauges (`rigd.gauges.Gauges`), and ``missed`` in percent of all
        ticks. A signal that is absent has no limit.
    thermal_time_constant_s
        Time constant of the motor's rms torque.
    absent_components
        Component names of plots for which the session has no values, such as the bus load without a
        bus.
    is_recorded
        Whether the session is read from a file instead of live.
    fitted_mode_count
        Number of modes whose fits are plotted over time. 0: only a table of the last fit is shown.
        None: the record is not fitted.
    """

    name: str
    rate_hz: float
    scheduled_ticks: int
    sweep: tuple[int, int]
    beam: Beam
    damping: Damping | None
    tool_inertia_kg_m2: float = 0.0
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    excitation: str = ""
    sweep_hz: tuple[float, float] | None = None
    return_sweep: tuple[int, int] | None = None
    specimen: str = ""
    limits: Mapping[str, float] = field(default_factory=dict)
    thermal_time_constant_s: float = 10.0
    absent_components: frozenset[str] = frozenset()
    is_recorded: bool = False
    fitted_mode_count: int | None = None

    def frequency_hz(self, tick: int) -> float | None:
        """Return the frequency of the sweep at a tick; None if the tick is in no linear sweep.

        Parameters
        ----------
        tick
            Tick of the record.
        """
        if self.sweep_hz is None:
            return None
        sweep_segments = {"sweep": self.sweep} | (
            {} if self.return_sweep is None else {"back": self.return_sweep}
        )
        return sweep_frequency_hz(sweep_segments, self.sweep_hz, tick)


@dataclass(frozen=True, slots=True)
class Note:
    """Line of the session's log, with its time and level.

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


def outcome_note(t_ns: int, outcome_name: str, outcome_reason: str) -> Note:
    """Return the last log line of a session, which states its outcome.

    Parameters
    ----------
    t_ns
        Time of the last sample since the start of the session.
    outcome_name, outcome_reason
        Outcome of the session ("complete", "stopped", "fault") and the reason for it.
    """
    return Note(
        t_ns,
        _LOG_LEVELS_BY_OUTCOME.get(outcome_name, "warning"),
        f"Outcome: {outcome_name}. {outcome_reason}".rstrip(),
    )


_LOG_LEVELS_BY_OUTCOME = {"complete": "info", "fault": "error"}
"""Level of the log line that states an outcome; "warning" for all other outcomes."""


@dataclass(frozen=True, slots=True)
class Health:
    """Condition of loop, recorder, disk and bus at one time; an unknown value is None.

    Attributes
    ----------
    missed_ticks
        Number of ticks since the start of the session that the loop missed.
    late_ticks
        Number of ticks since the start whose wake-up was late, without the missed ones.
    lost_ticks
        Number of samples lost since the start because the ring buffer was full.
    recorder_lag_ticks
        Number of samples in the ring buffer that the recorder has not written yet.
    disk_free_mb
        Free space on the disk of the session file, in 10⁶ bytes.
    view_dropped
        Number of samples since the start that the viewer could not show in time.
    bus_load_percent
        Load of the CAN bus or the serial line.
    bus_errors
        Number of disturbed, damaged or missing messages since the devices were connected.
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


HEALTH_DTYPE: Final = np.dtype(
    [("t_ns", "<i8")] + [(health_field.name, "<f8") for health_field in fields(Health)]
)
"""Data type of a health reading as a record, with its time in ns; unknown values are NaN."""


def health_record(t_ns: int, health: Health) -> npt.NDArray[Any]:
    """Return a health reading as a structured array (1,) of ``HEALTH_DTYPE``."""
    health_values = (
        np.nan if health_value is None else health_value for health_value in astuple(health)
    )
    return np.array([(t_ns, *health_values)], HEALTH_DTYPE)


_RERUN_LEVELS_BY_LEVEL: Final = {
    "debug": "DEBUG",
    "info": "INFO",
    "warning": "WARN",
    "error": "ERROR",
    "fatal": "CRITICAL",
}
"""Rerun's names of the log levels, for which it has colours."""


def send_note(stream: "RecordingStream", note: "Note") -> None:
    """Send a line of the session's log to Rerun."""
    import rerun as rr

    # The time has milliseconds only, because more digits are hard to read.
    stream.set_time(TIMELINE, duration=1e-3 * round(1e-6 * note.t_ns))
    wrapped_text = "\n".join(
        wrapped_line
        for paragraph in note.message.splitlines()
        for wrapped_line in wrap(paragraph, _LOG_WIDTH_CHARACTERS) or [""]
    )
    stream.log(
        EVENTS_ENTITY,
        rr.TextLog(wrapped_text, level=_RERUN_LEVELS_BY_LEVEL.get(note.level, "INFO")),
    )


def send_recent_notes(stream: "RecordingStream", t_ns: int, notes: "Sequence[Note]") -> None:
    """Send the newest lines of the session's log to Rerun as a document with wrapped lines.

    `notes` are in order of time.
    """
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    document_lines = []
    for log_note in reversed(notes[-_MAX_RECENT_EVENTS:]):
        time_s = max(0.0, 1e-9 * log_note.t_ns)  # the first event may come a tick early
        level_prefix = _PREFIXES_BY_LOG_LEVEL.get(log_note.level, "")
        document_lines.append(
            f"**{time_s:.1f} s** {level_prefix}{escape_markdown(log_note.message)}"
        )
    stream.log(
        RECENT_EVENTS_ENTITY,
        rr.TextDocument("\n\n".join(document_lines), media_type=rr.MediaType.MARKDOWN),
    )


def escape_markdown(text: str) -> str:
    """Return a text with Markdown's special characters escaped."""
    escaped_text = "".join(f"\\{c}" if c in r"\`*_{}[]<>#|~$" else c for c in text)
    return escaped_text.replace("\n", "  \n")


def summary_table(session: "SessionDescription", t_ns: int, health: "Health") -> str:
    """Return a Markdown table of the session's progress and health, without unknown values."""
    elapsed_s = 1e-9 * t_ns
    scheduled_duration_s = session.scheduled_ticks / session.rate_hz
    table_rows = [
        ("rate", _number_text(health.rate_hz, "{:.1f} Hz"), True),
        ("missed ticks", _number_text(health.missed_ticks), not health.missed_ticks),
        ("late ticks", _number_text(health.late_ticks), not health.late_ticks),
        ("lost ticks", _number_text(health.lost_ticks), not health.lost_ticks),
        ("recorder backlog", _number_text(health.recorder_lag_ticks, "{:.0f} samples"), True),
        ("dropped by the viewer", _number_text(health.view_dropped, "{:.0f} samples"), True),
        ("bus load", _number_text(health.bus_load_percent, "{:.0f} %"), True),
        ("bus errors", _number_text(health.bus_errors), not health.bus_errors),
        ("sensor status", _sensor_status_text(health.sensor_status), not health.sensor_status),
        ("free on the disk", _disk_space_text(health.disk_free_mb), True),
    ]
    table_lines = [
        f"| {row_name} | {value_text if is_normal else f'⚠ **{value_text}**'} |"
        for row_name, value_text, is_normal in table_rows
        if value_text
    ]
    session_row = f"| session | {elapsed_s:.0f} of {scheduled_duration_s:.0f} s |"
    return "\n".join([session_row, "|---|---|", *table_lines])


def send_summary(
    stream: "RecordingStream", session: "SessionDescription", t_ns: int, health: "Health"
) -> None:
    """Send the table of the session's health to Rerun, for a time of the session."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    summary_text = summary_table(session, t_ns, health)
    stream.log(SUMMARY_ENTITY, rr.TextDocument(summary_text, media_type=rr.MediaType.MARKDOWN))


def _number_text(number: float | None, number_format: str = "{:.0f}") -> str:
    """Return a number as text; an empty text for an unknown one."""
    return "" if number is None else number_format.format(number)


def _sensor_status_text(status_word: float | None) -> str:
    """Return the sensor's status word as text: "OK" or hexadecimal; empty if unknown."""
    if status_word is None:
        return ""
    return f"0x{int(status_word):04x}" if status_word else "OK"


def _disk_space_text(free_mb: float | None) -> str:
    """Return the free disk space in GB as text; empty if unknown."""
    return "" if free_mb is None else f"{1e-3 * free_mb:.1f} GB"
