"""What the control process has to say, as fixed-size records in a ring of their own.

The loop must not wait for anybody who listens, so it writes to shared memory instead of a pipe;
the recorder puts every event into the file, the supervisor shows it to the operator.
"""

import struct
from dataclasses import dataclass
from typing import Literal

from rigd.engine.ring import Ring

Level = Literal["debug", "info", "warning", "error", "fatal"]
LEVELS: tuple[Level, ...] = ("debug", "info", "warning", "error", "fatal")

EVENT_SIZE = 512
_HEADER = struct.Struct("<qBH")
_TEXT_SIZE = EVENT_SIZE - _HEADER.size


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the session's log."""

    t_ns: int
    level: Level
    message: str


def write_event(ring: Ring, event: Event) -> None:
    """Append an event; where the ring is full it is dropped rather than waited for."""
    offset = ring.slot()
    if offset < 0:
        return
    text = event.message.encode()[:_TEXT_SIZE]
    _HEADER.pack_into(ring.buffer, offset, event.t_ns, LEVELS.index(event.level), len(text))
    start = offset + _HEADER.size
    ring.buffer[start : start + len(text)] = text
    ring.publish()


def read_events(block: bytes) -> list[Event]:
    """Decode what :meth:`Ring.take` returned."""
    events = []
    for offset in range(0, len(block), EVENT_SIZE):
        t_ns, level, size = _HEADER.unpack_from(block, offset)
        start = offset + _HEADER.size
        text = block[start : start + size].decode(errors="replace")
        events.append(Event(t_ns, LEVELS[level], text))
    return events
