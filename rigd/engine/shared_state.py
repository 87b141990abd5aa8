"""Shared state of a rig's processes: fields that each process reads and writes, and log events.

Fields
    `SharedState` holds a few integers, such as the phase of the session and the heartbeat of each
    process. Each field has one writer. Access takes a fraction of a microsecond and never blocks,
    so the control loop can use it.
Events
    Log lines of the control process, as fixed-size records in a separate ring. The loop must not
    wait for a reader, so it writes to shared memory instead of a pipe. The recorder writes each
    event to the file, and the supervisor shows it to the operator.

The module `channels` lists what is published and lays out the memory. This module imports nothing
heavy, because the processes of a rig start before anything else.
"""

import contextlib
import mmap
import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Literal, Self

from rigd.engine._ring import Ring, reserve

# Fields


class Phase(IntEnum):
    """Phase of the control process, such as taring or recording, as a number."""

    PREPARING = 0
    """Connecting the devices."""
    SETTLING = 1
    """Drive enabled, the motor held at its present angle."""
    TARING = 2
    """Measuring the sensor's zero with the torque off."""
    READY = 3
    """Waiting for the recorder before tick 0."""
    RUNNING = 4
    """Recording the excitation."""
    RETURNING = 5
    """Damping the beam and returning to the start angle after the record."""
    OFF = 6
    """Torque is zero and the drive is disabled: between sessions, and at the end."""
    WAITING = 7
    """Waiting until the beam is at rest, before the tare."""
    PROBING = 8
    """Probing move before a session."""

    @property
    def words(self) -> str:
        """Name of the phase as text for the operator, such as "recording"."""
        return _OPERATOR_NAMES.get(self, self.name.lower())


_OPERATOR_NAMES = {
    Phase.RUNNING: "recording",
    Phase.OFF: "drive off",
    Phase.WAITING: "waiting for the beam to rest",
    Phase.PROBING: "probing move",
}
"""Names of phases for the operator, where they differ from the names in the code."""


class Activity(StrEnum):
    """Stage of a session for the operator, the same in terminal, page and socket documents."""

    PREPARING = "preparing"
    """The record has not begun."""
    RUNNING = "running"
    """The record runs."""
    RETURNING = "returning"
    """The record is over, and the motor returns to its start angle."""
    FINISHING = "finishing"
    """The record is over and the torque off; the file is being completed."""
    STOPPING = "stopping"
    """A stop was requested."""


class StopReason(IntEnum):
    """Reason why the supervisor requests a stop: the values of :attr:`StateField.STOP`."""

    NONE = 0
    """No stop is requested."""
    OPERATOR = 1
    """The operator requested the stop."""
    NO_RECORDER = 2
    """The recorder process has ended."""


class StateField(IntEnum):
    """Index of each field of the :class:`SharedState`."""

    # Written by the supervisor
    STOP = 0
    """Reason for a requested stop, a value of :class:`StopReason`."""
    GO = 1
    """1 once the record may begin, because the recorder is ready."""
    SUPERVISOR_BEAT = 2
    """Heartbeat count of the supervisor. All heartbeats count up several times a second, so a
    process whose count does not increase hangs."""
    # Written by the control process
    PHASE = 3
    """Phase of the control process, a value of :class:`Phase`."""
    START_UTC_NS = 4
    """UTC time of tick 0 in ns since 1970; 0: the record has not begun."""
    SCHEDULED = 5
    """Number of ticks of the record so far, missed and lost ticks included."""
    MISSED = 6
    """Number of ticks of the record that were missed."""
    LATE = 7
    """Number of ticks of the record with a late wake-up."""
    LOST = 8
    """Number of samples of the record for which the ring was full."""
    ANGLE_NRAD = 9
    """Last angle of the motor in 1e-9 rad."""
    COUPLING_TORQUE_NNM = 10
    """Last coupling torque in 1e-9 N·m."""
    TORQUE_COMMAND_NNM = 11
    """Present torque command in 1e-9 N·m."""
    CONTROL_BEAT = 12
    """Heartbeat count of the control process."""
    BUS_LOAD_PPM = 17
    """Measured load of the busiest bus or serial line in 1e-6, or UNKNOWN."""
    BUS_ERRORS = 18
    """Errors on all lines since the devices were connected, or UNKNOWN."""
    SENSOR_STATUS = 19
    """Status word of the sensor, with 0 for no fault, or UNKNOWN."""
    # Written by the recorder
    RECORDER_BEAT = 13
    """Heartbeat count of the recorder process."""
    DISK_FREE_MB = 14
    """Free space on the disk of the session file, in 10⁶ bytes, at least 1; 0: not known yet."""
    # Written by the live publisher
    LIVE_DROPPED = 15
    """Number of samples that the live publisher did not show in time."""
    LIVE_BEAT = 16
    """Heartbeat count of the live publisher."""
    LIVE_SAMPLES_SEEN = 20
    """Number of samples of the ring that have been shown, or counted as dropped."""
    # Written by the control process
    STALE_ANGLES = 21
    """Number of recorded ticks with a stale angle."""
    STALE_WRENCHES = 22
    """Number of recorded ticks with a stale wrench."""
    TOUCHES = 23
    """Number of touches detected in the record."""
    HELD_TICKS = 25
    """Number of recorded ticks in which the angle was held because no next segment was planned."""
    HELD_TICKS_BEFORE_SEGMENT = 29
    """Number of ticks in which the angle was held before the segment that began last."""
    BEGUN_REFERENCE_TICKS = 30
    """Number of ticks of the reference up to the end of the segment that began last; 0: none."""
    # Written by the touch process
    TOUCH_BEAT = 24
    """Heartbeat count of the touch process."""
    # Written by the fit process
    FIT_BEAT = 26
    """Heartbeat count of the fit process."""
    PLANNED = 27
    """Number of planned ticks of a reference that grows during the session."""
    # Written by the supervisor
    LAST_SEGMENT = 28
    """Whether the record ends with the segments that are planned: 1, otherwise 0."""


UNKNOWN = -1
"""Value of a field about a bus or serial line that does not exist or does not report."""


class SharedState:
    """State of a rig's processes in shared memory: an integer for each :class:`StateField`.

    Parameters
    ----------
    fd
        Descriptor of the memory, laid out by `create`; each field has 64 bits with sign.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._memory = mmap.mmap(fd, 8 * len(StateField))
        self._fields = memoryview(self._memory).cast("q")

    @classmethod
    def create(cls, fd: int) -> Self:
        """Reserve shared memory at descriptor `fd`, and return the state with all fields 0."""
        reserve(fd, 8 * len(StateField))
        return cls(fd)

    def __getitem__(self, field: StateField) -> int:
        return self._fields[field]

    def __setitem__(self, field: StateField, value: int) -> None:
        self._fields[field] = value

    def known(self, field: StateField) -> int | None:
        """Return the value of a field of the shared state, or None if it is `UNKNOWN`."""
        return None if (field_value := self._fields[field]) == UNKNOWN else field_value

    def view(self, field: StateField) -> "memoryview[int]":
        """Return a memory view of one field, whose value ``view[0]`` reads and writes quickly."""
        return self._fields[field : field + 1]

    def beat(self, field: StateField) -> None:
        """Increment the heartbeat counter of a process in its field."""
        self._fields[field] += 1

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for the other processes that inherited it."""
        with contextlib.suppress(BufferError):  # a view of a field is still held
            self._fields.release()
            self._memory.close()


# Events

Level = Literal["debug", "info", "warning", "error", "fatal"]
"""Severity of a log event."""
LEVELS: tuple[Level, ...] = ("debug", "info", "warning", "error", "fatal")
"""Severities of log events in ascending order."""

EVENT_SIZE = 512
"""Size of a log event in its ring, in bytes."""
_HEADER = struct.Struct("<qBH")
"""Binary header of an event: time in ns, index of the level, length of the text in bytes."""
_TEXT_SIZE = EVENT_SIZE - _HEADER.size
"""Largest length of an event's text in bytes."""


@dataclass(frozen=True, slots=True)
class LogEvent:
    """Event in the session's log, which is one line of text."""

    t_ns: int
    """Time in ns since the session's start."""
    level: Level
    """Severity of the event."""
    message: str
    """Text for the operator."""
    notable: bool = False
    """Whether the operator sees the line at once, whatever its level; not stored in the file."""


def write_event(ring: Ring, log_event: LogEvent) -> None:
    """Append a log event to a ring, or drop the event if the ring is full.

    Parameters
    ----------
    ring
        Ring of events.
    log_event
        Event; its text is cut to the size of a record.
    """
    slot_offset = ring.next_slot()
    if slot_offset < 0:
        return
    message_bytes = log_event.message.encode()[:_TEXT_SIZE]
    _HEADER.pack_into(
        ring.buffer, slot_offset, log_event.t_ns, LEVELS.index(log_event.level), len(message_bytes)
    )
    text_offset = slot_offset + _HEADER.size
    ring.buffer[text_offset : text_offset + len(message_bytes)] = message_bytes
    ring.publish()


def read_events(event_bytes: bytes) -> list[LogEvent]:
    """Decode the log events in a block of bytes that :meth:`Ring.take` returned."""
    events = []
    for event_offset in range(0, len(event_bytes), EVENT_SIZE):
        t_ns, level, text_bytes = _HEADER.unpack_from(event_bytes, event_offset)
        text_offset = event_offset + _HEADER.size
        message_text = event_bytes[text_offset : text_offset + text_bytes].decode(errors="replace")
        events.append(LogEvent(t_ns, LEVELS[level], message_text))
    return events


def activity(shared_state: SharedState) -> Activity:
    """Return the stage of the present session, derived from the shared state of the processes.

    Parameters
    ----------
    shared_state
        State of the rig's processes.

    Examples
    --------
    >>> from rigd.engine import shared_memory_fd
    >>> from rigd.engine.shared_state import Phase, SharedState, StateField, activity
    >>> shared_state = SharedState.create(shared_memory_fd())
    >>> shared_state[StateField.PHASE] = Phase.TARING
    >>> activity(shared_state)
    <Activity.PREPARING: 'preparing'>
    """
    phase = Phase(shared_state[StateField.PHASE])
    if shared_state[StateField.STOP] != StopReason.NONE:
        return Activity.STOPPING
    if phase is Phase.RUNNING:
        return Activity.RUNNING
    # Until tick 0 the phase may be that of the session before.
    if shared_state[StateField.GO] and phase is not Phase.READY:
        return Activity.FINISHING if phase is Phase.OFF else Activity.RETURNING
    return Activity.PREPARING
