"""Shared memory between the processes: rings of fixed-size records.

A ring has one producer (the control loop), one consumer that must get everything (the recorder),
and any number of observers that may miss records but never delay the writer (the live publisher).

The memory is an unlinked temporary file handed to children by file descriptor: nothing with a
name is left behind, however a process ends.

The two counters in a ring's header only ever grow and are written by one side each, as aligned
64-bit words: a record is in place before the counter that announces it. That order is what the
processor keeps on x86-64; on a weaker memory model the interpreter's own work between the two
stores is all that separates them, and a reader's own check of the record (tags, consecutive ticks)
is the guard.
"""

import mmap
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

HEADER_SIZE = 64
_WRITTEN, _READ = 0, 1


@dataclass(frozen=True, slots=True)
class RingSpec:
    """What a child needs to attach to a ring: an inherited descriptor and the layout."""

    fd: int
    record_size: int
    capacity: int


class Ring:
    """Ring of ``capacity`` records of ``record_size`` bytes.

    Parameters
    ----------
    spec
        Descriptor of the memory and its layout; :meth:`create` makes a new one.
    """

    def __init__(self, spec: RingSpec) -> None:
        self.spec = spec
        self.capacity = spec.capacity
        self.record_size = spec.record_size
        self._memory = mmap.mmap(spec.fd, HEADER_SIZE + spec.capacity * spec.record_size)
        self.buffer = memoryview(self._memory)
        self._counters = self.buffer[:HEADER_SIZE].cast("Q")
        self._next = self._counters[_WRITTEN]

    @classmethod
    def create(cls, record_size: int, capacity: int, fd: int) -> Self:
        """Lay out an empty ring in the memory of `fd`, from :func:`shared_memory_fd`.

        Parameters
        ----------
        record_size
            Bytes of a record.
        capacity
            Number of records.
        fd
            Descriptor of the memory.
        """
        reserve(fd, HEADER_SIZE + capacity * record_size)
        return cls(RingSpec(fd, record_size, capacity))

    @property
    def written(self) -> int:
        """Records written since the ring was made."""
        return self._counters[_WRITTEN]

    @property
    def read(self) -> int:
        """Records the consumer has released."""
        return self._counters[_READ]

    @property
    def waiting(self) -> int:
        """Records that the consumer has yet to take."""
        return self._counters[_WRITTEN] - self._counters[_READ]

    @property
    def oldest(self) -> int:
        """Number of the oldest record that an observer reads, negative in a ring that is new.

        Half the ring is left as a margin for records that are written during the copy.
        """
        return self._counters[_WRITTEN] - self.capacity // 2

    # Producer

    def slot(self) -> int:
        """Offset in :attr:`buffer` where the next record goes, or -1 where the ring is full."""
        if self._next - self._counters[_READ] >= self.capacity:
            return -1
        return HEADER_SIZE + self._next % self.capacity * self.record_size

    def publish(self) -> None:
        """Announce the record just placed at :meth:`slot`."""
        self._next += 1
        self._counters[_WRITTEN] = self._next

    # Consumer

    def take(self, most: int) -> bytes:
        """Copy out and release up to ``most`` records, as far as they lie in one piece."""
        first = self._counters[_READ]
        count = min(most, self._counters[_WRITTEN] - first, self.capacity - first % self.capacity)
        start = HEADER_SIZE + first % self.capacity * self.record_size
        block = bytes(self.buffer[start : start + count * self.record_size])
        self._counters[_READ] = first + count
        return block

    def discard(self) -> None:
        """Release all records unseen; for a consumer that starts over."""
        self._counters[_READ] = self._counters[_WRITTEN]

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for the other processes that inherited it."""
        self._counters.release()
        self.buffer.release()
        self._memory.close()


class Observer:
    """A reader that never holds the producer up: what was overwritten before it came is counted.

    Parameters
    ----------
    ring
        Ring whose records it sees from now on.
    first
        Number of the first record to see, counted since the ring was made, if not from now on.

    Attributes
    ----------
    dropped
        Records that were overwritten before they were read.
    """

    def __init__(self, ring: Ring, first: int | None = None) -> None:
        self._ring = ring
        self._cursor = ring.written if first is None else first
        self.dropped = 0

    @property
    def next(self) -> int:
        """Number of the next record, counted like `first`."""
        return self._cursor

    def take(self, most: int) -> bytes:
        """Copy out up to ``most`` of the records not yet seen, oldest first."""
        ring = self._ring
        oldest = ring.oldest
        if self._cursor < oldest:
            self.dropped += oldest - self._cursor
            self._cursor = oldest
        place = self._cursor % ring.capacity
        count = min(most, ring.written - self._cursor, ring.capacity - place)
        start = HEADER_SIZE + place * ring.record_size
        block = bytes(ring.buffer[start : start + count * ring.record_size])
        self._cursor += count
        if ring.written - (self._cursor - count) >= ring.capacity:
            # The producer lapped the copy: none of it can be trusted.
            self.dropped += count
            return b""
        return block


# Memory


def shared_memory_fd() -> int:
    """Return a descriptor of shared memory, still of size 0, that child processes can inherit."""
    folder = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryFile(dir=folder) as file:
        fd = os.dup(file.fileno())
    os.set_inheritable(fd, True)
    return fd


def reserve(fd: int, size: int) -> None:
    """Give shared memory its size, all of it at once.

    Raises
    ------
    OSError
        If there is not enough: better now than as a bus error when it is written to.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, size)
    else:
        os.ftruncate(fd, size)
