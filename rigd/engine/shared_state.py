"""Shared state of a rig's processes: fields, each written by one process, and log events.

Fields
    `SharedState` holds a few integers, such as the phase of the session and the heartbeat of each
    process. All processes can read them. Access takes a fraction of a microsecond and never
    blocks, so the control loop can use it.
Events
    Log lines of the control process, as fixed-size records in a separate ring. The loop must not
    wait for a reader, so it writes to shared memory instead of a pipe. The recorder writes each
    event to the file, and the supervisor shows it to the operator.

The module `channels` lists the published topics and allocates the memory. This module imports
nothing heavy, because the supervisor imports it before it starts the processes of a rig, which must
start early.
"""

import contextlib
import mmap
import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Literal, Self

from rigd.engine._ring import Ring, reserve_memory

# Fields


class Phase(IntEnum):
    """Phase of the control process, such as taring or recording."""

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
    """Idle, after the drive has shown that it is off, between sessions and at the end.

    If it has not shown this, the phase remains the last one of the session."""
    WAITING = 7
    """Waiting until the beam is at rest, before the tare."""
    PROBING = 8
    """Probing move before a session."""

    @property
    def display_text(self) -> str:
        """Name of the phase as text for the operator, such as "recording"."""
        return _OPERATOR_PHASE_NAMES.get(self, self.name.lower())


_OPERATOR_PHASE_NAMES = {
    Phase.RUNNING: "recording",
    Phase.OFF: "drive off",
    Phase.WAITING: "waiting for the beam to rest",
    Phase.PROBING: "probing move",
}
"""Phase → name for the operator, where it differs from the name in the code."""


class Activity(StrEnum):
    """Stage of a session, as terminal, page and socket documents show it to the operator."""

    PREPARING = "preparing"
    """The record has not begun."""
    RUNNING = "running"
    """The record runs."""
    RETURNING = "returning"
    """The record is over, and the motor returns to its start angle."""
    FINISHING = "finishing"
    """The drive has shown that it is off after the record; the file is being completed."""
    STOPPING = "stopping"
    """A stop was requested."""


class StopReason(IntEnum):
    """Reason why the supervisor requests a stop, a value of :attr:`StateField.STOP_REASON`."""

    NONE = 0
    """No stop is requested."""
    OPERATOR = 1
    """The operator requested the stop."""
    NO_RECORDER = 2
    """The recorder process has ended."""


class StateField(IntEnum):
    """Fields of the :class:`SharedState`, by their indices in the memory."""

    # Written by the supervisor
    STOP_REASON = 0
    """Reason for a requested stop, a value of :class:`StopReason`."""
    RECORD_MAY_START = 1
    """Whether the record may begin, because the recorder is ready: 1, otherwise 0."""
    SUPERVISOR_BEAT = 2
    """Heartbeat count of the supervisor. Each process increments its count several times a second;
    a process whose count does not increase hangs."""
    # Written by the control process
    PHASE = 3
    """Phase of the control process, a value of :class:`Phase`."""
    START_UTC_NS = 4
    """UTC time of tick 0 in ns since 1970; 0: the record has not begun."""
    SCHEDULED_TICKS = 5
    """Number of ticks of the record so far, including missed and lost ticks."""
    MISSED_TICKS = 6
    """Number of ticks of the record that were missed."""
    LATE_TICKS = 7
    """Number of ticks of the record with a late wake-up."""
    LOST_SAMPLES = 8
    """Number of samples of the record that were lost because the ring was full."""
    ANGLE_NRAD = 9
    """Last angle of the motor in 1e-9 rad."""
    COUPLING_TORQUE_NNM = 10
    """Last coupling torque in 1e-9 N·m."""
    TORQUE_COMMAND_NNM = 11
    """Present torque command in 1e-9 N·m."""
    CONTROL_BEAT = 12
    """Heartbeat count of the control process."""
    BUS_LOAD_PPM = 17
    """Measured load of the busiest bus or serial line in ppm, or UNKNOWN_VALUE."""
    BUS_ERRORS = 18
    """Number of errors on all bus and serial lines since the connection, or UNKNOWN_VALUE."""
    SENSOR_STATUS = 19
    """Status word of the sensor, with 0 for no fault, or UNKNOWN_VALUE."""
    # Written by the recorder
    RECORDER_BEAT = 13
    """Heartbeat count of the recorder process."""
    DISK_FREE_MB = 14
    """Free space on the disk of the session file, in 10⁶ bytes, at least 1; 0: not known yet."""
    # Written by the live publisher
    LIVE_SAMPLES_DROPPED = 15
    """Number of samples that the live publisher did not show in time."""
    LIVE_BEAT = 16
    """Heartbeat count of the live publisher."""
    LIVE_SAMPLES_SEEN = 20
    """Number of samples that the live publisher has shown or dropped."""
    # Written by the control process
    STALE_ANGLES = 21
    """Number of recorded ticks with a stale angle."""
    STALE_WRENCHES = 22
    """Number of recorded ticks with a stale wrench."""
    TOUCHES = 23
    """Number of touches detected in the record."""
    HELD_TICKS = 25
    """Number of ticks in which the angle was held because the next segment was not planned yet."""
    HELD_TICKS_BEFORE_SEGMENT = 29
    """Value of `HELD_TICKS` at the start of the segment that began last."""
    BEGUN_REFERENCE_TICKS = 30
    """Tick of the reference at which the segment that began last ends; 0: none has begun."""
    # Written by the touch process
    TOUCH_BEAT = 24
    """Heartbeat count of the touch process."""
    # Written by the fit process
    FIT_BEAT = 26
    """Heartbeat count of the fit process."""
    PLANNED_TICKS = 27
    """Number of ticks planned so far of a reference that grows during the session."""
    # Written by the supervisor
    LAST_SEGMENT = 28
    """Whether no further segments follow the planned ones: 1, otherwise 0."""


UNKNOWN_VALUE = -1
"""Value of a field about a bus or serial line that does not exist or does not report."""


class SharedState:
    """State of a rig's processes in shared memory: an integer for each :class:`StateField`.

    Parameters
    ----------
    fd
        Descriptor of memory that `create` has reserved, with a signed 64-bit integer per field.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._memory = mmap.mmap(fd, 8 * len(StateField))
        self._fields = memoryview(self._memory).cast("q")

    @classmethod
    def create(cls, fd: int) -> Self:
        """Reserve shared memory at descriptor `fd`, and return the state with all fields 0."""
        reserve_memory(fd, 8 * len(StateField))
        return cls(fd)

    def __getitem__(self, field: StateField) -> int:
        return self._fields[field]

    def __setitem__(self, field: StateField, value: int) -> None:
        self._fields[field] = value

    def known_value(self, field: StateField) -> int | None:
        """Return the value of a field of the shared state, or None if it is `UNKNOWN_VALUE`."""
        return None if (field_value := self._fields[field]) == UNKNOWN_VALUE else field_value

    def field_view(self, field: StateField) -> "memoryview[int]":
        """Return a view of one field, for quick access: ``view[0]`` is the value."""
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
_EVENT_HEADER = struct.Struct("<qBH")
"""Binary header of an event: time in ns, index of the level, length of the text in bytes."""
_MAX_EVENT_TEXT_BYTES = EVENT_SIZE - _EVENT_HEADER.size
"""Largest length of an event's text in bytes."""


@dataclass(frozen=True, slots=True)
class LogEvent:
    """Event of the session's log, with one line of text."""

    t_ns: int
    """Time in ns since the session's start."""
    level: Level
    """Severity of the event."""
    message: str
    """Text for the operator."""
    notable: bool = False
    """Whether the event is shown to the operator whatever its level; not stored in the file."""


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
    message_bytes = log_event.message.encode()[:_MAX_EVENT_TEXT_BYTES]
    _EVENT_HEADER.pack_into(
        ring.buffer, slot_offset, log_event.t_ns, LEVELS.index(log_event.level), len(message_bytes)
    )
    text_offset = slot_offset + _EVENT_HEADER.size
    ring.buffer[text_offset : text_offset + len(message_bytes)] = message_bytes
    ring.publish()


def read_events(event_bytes: bytes) -> list[LogEvent]:
    """Decode the log events in a block of bytes that :meth:`Ring.take` returned."""
    events = []
    for event_offset in range(0, len(event_bytes), EVENT_SIZE):
        t_ns, level, text_bytes = _EVENT_HEADER.unpack_from(event_bytes, event_offset)
        text_offset = event_offset + _EVENT_HEADER.size
        message_text = event_bytes[text_offset : text_offset + text_bytes].decode(errors="replace")
        events.append(LogEvent(t_ns, LEVELS[level], message_text))
    return events


def activity(shared_state: SharedState) -> Activity:
    """Return the stage of the present session for the operator, from the shared state.

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
    if shared_state[StateField.STOP_REASON] != StopReason.NONE:
        return Activity.STOPPING
    if phase is Phase.RUNNING:
        return Activity.RUNNING
    # Until tick 0 the phase may be that of the session before.
    if shared_state[StateField.RECORD_MAY_START] and phase is not Phase.READY:
        return Activity.FINISHING if phase is Phase.OFF else Activity.RETURNING
    return Activity.PREPARING
