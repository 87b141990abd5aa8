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
    """Phase of the control process."""

    PREPARING = 0
    """Connecting the devices."""
    SETTLING = 1
    """Drive enabled, the motor held at its present angle."""
    TARING = 2
    READY = 3
    """Waiting for the recorder before tick 0."""
    RUNNING = 4
    RETURNING = 5
    OFF = 6
    """Torque is zero and the drive is disabled: between sessions, and at the end."""
    WAITING = 7
    """Waiting until the beam is at rest, before the tare."""
    PROBING = 8
    """Probing move before a session."""

    @property
    def words(self) -> str:
        """Name of the phase for the operator."""
        return _WORDS.get(self, self.name.lower())


_WORDS = {
    Phase.RUNNING: "recording",
    Phase.OFF: "drive off",
    Phase.WAITING: "waiting for the beam to rest",
    Phase.PROBING: "probing move",
}


class Activity(StrEnum):
    """State of a session for the operator, with the same name in every view."""

    PREPARING = "preparing"
    """The record has not begun."""
    RUNNING = "running"
    """The record runs."""
    RETURNING = "returning"
    """The record is over, and the motor returns to where it started."""
    FINISHING = "finishing"
    """The record is over and the torque off; the file is being completed."""
    STOPPING = "stopping"
    """A stop was requested."""


class Stop(IntEnum):
    """Reason for which the supervisor requests a stop: the values of :attr:`StateField.STOP`."""

    NO = 0
    OPERATOR = 1
    NO_RECORDER = 2


class StateField(IntEnum):
    """Index of each field of the :class:`SharedState`."""

    # Written by the supervisor
    STOP = 0
    GO = 1
    SUPERVISOR_BEAT = 2
    """Heartbeats count up several times a second: a process whose count does not increase hangs."""
    # Written by the control process
    PHASE = 3
    START_UTC_NS = 4
    SCHEDULED = 5
    MISSED = 6
    LATE = 7
    LOST = 8
    ANGLE_NRAD = 9
    """The last readings and the present torque command, in 1e-9 rad and 1e-9 N·m."""
    COUPLING_TORQUE_NNM = 10
    TORQUE_COMMAND_NNM = 11
    CONTROL_BEAT = 12
    BUS_LOAD_PPM = 17
    """Measured load of the busiest line, or UNKNOWN."""
    BUS_ERRORS = 18
    """Errors on all lines since the devices were connected, or UNKNOWN."""
    SENSOR_STATUS = 19
    """Status word, 0: no fault; or UNKNOWN."""
    # Written by the recorder
    RECORDER_BEAT = 13
    DISK_FREE_MB = 14
    """Free space on the disk of the session file, in 10⁶ bytes, at least 1; 0: not known yet."""
    # Written by the live publisher
    LIVE_DROPPED = 15
    LIVE_BEAT = 16
    LIVE_SEEN = 20
    """Number of samples of the ring that have been shown, or counted as dropped."""
    # Written by the control process
    STALE_ANGLES = 21
    """Recorded ticks with a stale angle."""
    STALE_WRENCHES = 22
    """Recorded ticks with a stale wrench."""
    TOUCHES = 23
    """Touches detected in the record."""
    HELD = 25
    """Ticks of the record in which the angle was held because there was no next segment."""
    HELD_BEFORE = 29
    """Number of these ticks before the segment that began last."""
    BEGUN = 30
    """Ticks of the reference up to the end of that segment; 0: none has begun."""
    # Written by the touch process
    TOUCH_BEAT = 24
    # Written by the fit process
    FIT_BEAT = 26
    PLANNED = 27
    """Planned ticks of a reference that grows during the session."""
    # Written by the supervisor
    LAST_SEGMENT = 28
    """The record ends with the segments that are planned."""


UNKNOWN = -1
"""Value for a line that does not exist or does not report."""


class SharedState:
    """Array of signed 64-bit integers in shared memory, indexed by :class:`StateField`.

    Parameters
    ----------
    fd
        Descriptor of the memory, laid out by `create`.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._memory = mmap.mmap(fd, 8 * len(StateField))
        self._fields = memoryview(self._memory).cast("q")

    @classmethod
    def create(cls, fd: int) -> Self:
        """Reserve shared memory for the fields, all of them 0."""
        reserve(fd, 8 * len(StateField))
        return cls(fd)

    def __getitem__(self, field: StateField) -> int:
        return self._fields[field]

    def __setitem__(self, field: StateField, value: int) -> None:
        self._fields[field] = value

    def known(self, field: StateField) -> int | None:
        """Return a field, or None if it says that this is not known."""
        return None if (value := self._fields[field]) == UNKNOWN else value

    def view(self, field: StateField) -> "memoryview[int]":
        """Return a view of one field, the quickest way to it: ``view[0]``."""
        return self._fields[field : field + 1]

    def beat(self, field: StateField) -> None:
        """Give the heartbeat of the process that this field belongs to."""
        self._fields[field] += 1

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for the other processes that inherited it."""
        with contextlib.suppress(BufferError):  # a view of a field is still held
            self._fields.release()
            self._memory.close()


# Events

Level = Literal["debug", "info", "warning", "error", "fatal"]
LEVELS: tuple[Level, ...] = ("debug", "info", "warning", "error", "fatal")

EVENT_SIZE = 512
_HEADER = struct.Struct("<qBH")
_TEXT_SIZE = EVENT_SIZE - _HEADER.size


@dataclass(frozen=True, slots=True)
class LogEvent:
    """One line of the session's log."""

    t_ns: int
    """Time since the session's start."""
    level: Level
    """Severity."""
    message: str
    """Text for the operator."""
    notable: bool = False
    """Show it to the operator at once, whatever the level; not stored in the file."""


def write_event(ring: Ring, event: LogEvent) -> None:
    """Append an event; it is dropped if the ring is full.

    Parameters
    ----------
    ring
        Ring of events.
    event
        Event; its text is cut to the size of a record.
    """
    offset = ring.slot()
    if offset < 0:
        return
    text = event.message.encode()[:_TEXT_SIZE]
    _HEADER.pack_into(ring.buffer, offset, event.t_ns, LEVELS.index(event.level), len(text))
    start = offset + _HEADER.size
    ring.buffer[start : start + len(text)] = text
    ring.publish()


def read_events(block: bytes) -> list[LogEvent]:
    """Return the events in a block that :meth:`Ring.take` returned."""
    events = []
    for offset in range(0, len(block), EVENT_SIZE):
        t_ns, level, size = _HEADER.unpack_from(block, offset)
        start = offset + _HEADER.size
        text = block[start : start + size].decode(errors="replace")
        events.append(LogEvent(t_ns, LEVELS[level], text))
    return events


def activity(shared_state: SharedState) -> Activity:
    """Return the state of the session from the shared state of the processes.

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
    if shared_state[StateField.STOP] != Stop.NO:
        return Activity.STOPPING
    if phase is Phase.RUNNING:
        return Activity.RUNNING
    # Until tick 0 the phase may be that of the session before.
    if shared_state[StateField.GO] and phase is not Phase.READY:
        return Activity.FINISHING if phase is Phase.OFF else Activity.RETURNING
    return Activity.PREPARING
