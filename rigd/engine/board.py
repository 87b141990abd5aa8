"""The board: a few shared words by which processes tell each other where they are.

Every word has one writer. Reading or writing one takes a fraction of a microsecond and never
blocks, which is why the control loop may do so.
"""

import contextlib
import mmap
from enum import IntEnum
from typing import Self

from rigd.engine.ring import reserve


class Phase(IntEnum):
    """Where the control process is."""

    PREPARING = 0
    """Connecting the devices."""
    SETTLING = 1
    """Drive enabled, the motor held where it stands."""
    TARING = 2
    READY = 3
    """Waiting for the recorder before tick 0."""
    RUNNING = 4
    RETURNING = 5
    OFF = 6
    """Torque is zero and the drive is disabled: between sessions, and at the end."""
    WAITING = 7
    """Until the beam is at rest, before the tare."""

    @property
    def words(self) -> str:
        """What the operator reads."""
        return _WORDS.get(self, self.name.lower())


_WORDS = {
    Phase.RUNNING: "recording",
    Phase.OFF: "drive off",
    Phase.WAITING: "waiting for the beam to rest",
}


class Stop(IntEnum):
    """Why the supervisor asks for a stop: the values of :attr:`Word.STOP`."""

    NO = 0
    OPERATOR = 1
    NO_RECORDER = 2


class Word(IntEnum):
    """The words of the board."""

    # Written by the supervisor
    STOP = 0
    GO = 1
    SUPERVISOR_BEAT = 2
    """Beats count up several times a second: whoever does not beat hangs."""
    # Written by the control process
    PHASE = 3
    START_UTC_NS = 4
    SCHEDULED = 5
    MISSED = 6
    LATE = 7
    LOST = 8
    ANGLE_NRAD = 9
    """The last readings, and the torque that stands, in 1e-9 rad and 1e-9 N·m."""
    COUPLING_TORQUE_NNM = 10
    TORQUE_COMMAND_NNM = 11
    CONTROL_BEAT = 12
    BUS_LOAD_PPM = 17
    """Of the busiest line, as measured, or UNKNOWN. Likewise:"""
    BUS_ERRORS = 18
    """On all lines, since the devices were connected."""
    SENSOR_STATUS = 19
    """Status word; 0: all is well."""
    # Written by the recorder
    RECORDER_BEAT = 13
    DISK_FREE_MB = 14
    """Of the disk that the session goes to, in 10⁶ bytes, at least 1; 0: not known yet."""
    # Written by the live publisher
    LIVE_DROPPED = 15
    LIVE_BEAT = 16
    LIVE_SEEN = 20
    """Samples up to this one of the ring have been shown, or counted as dropped."""
    # Written by the control process
    STALE_ANGLES = 21
    """Recorded ticks whose angle is an old one; likewise:"""
    STALE_WRENCHES = 22


UNKNOWN = -1
"""Of a line that there is not, or that does not tell."""


class Board:
    """Array of signed 64-bit words, indexed by :class:`Word`."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._memory = mmap.mmap(fd, 8 * len(Word))
        self._words = memoryview(self._memory).cast("q")

    @classmethod
    def create(cls, fd: int) -> Self:
        """Lay out a board of zeros in shared memory."""
        reserve(fd, 8 * len(Word))
        return cls(fd)

    def __getitem__(self, word: Word) -> int:
        return self._words[word]

    def __setitem__(self, word: Word, value: int) -> None:
        self._words[word] = value

    def known(self, word: Word) -> int | None:
        """Return a word, or None if it says that this is not known."""
        return None if (value := self._words[word]) == UNKNOWN else value

    def word(self, word: Word) -> "memoryview[int]":
        """Return a view of one word, the quickest way to it: ``view[0]``."""
        return self._words[word : word + 1]

    def beat(self, word: Word) -> None:
        """Show that the process that this word belongs to is at work."""
        self._words[word] += 1

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for whoever else inherited it."""
        with contextlib.suppress(BufferError):  # a view of a word is still held
            self._words.release()
            self._memory.close()
