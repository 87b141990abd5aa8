"""Shared memory between the processes: rings of fixed-size records.

A ring has one producer (the control loop), one consumer that must get everything (the recorder),
and any number of observers that may miss records but never delay the writer (the live publisher).

The memory is an unlinked temporary file that children inherit by file descriptor. However a process
ends, no named file remains.

The two counters in a ring's header only increase. Each is an aligned 64-bit word with one writer,
and a record is written before the counter that announces it. x86-64 processors preserve this order
of stores. On a weaker memory model only the interpreter's work lies between the two stores, so
readers check the records themselves (tags, consecutive ticks).
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
    """Inherited descriptor and layout, with which a child attaches to a ring."""

    fd: int
    record_size: int
    capacity: int


class Ring:
    """Ring of ``capacity`` records of ``record_size`` bytes.

    Parameters
    ----------
    spec
        Descriptor of the memory and its layout; :meth:`create` makes a new ring.
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
        """Number of records written since the ring was created."""
        return self._counters[_WRITTEN]

    @property
    def read(self) -> int:
        """Number of records that the consumer has released."""
        return self._counters[_READ]

    @property
    def waiting(self) -> int:
        """Number of records that wait for the consumer."""
        return self._counters[_WRITTEN] - self._counters[_READ]

    @property
    def oldest(self) -> int:
        """Number of the oldest record that an observer reads; negative in a new ring.

        Half of the ring is a margin for records that are written during the copy.
        """
        return self._counters[_WRITTEN] - self.capacity // 2

    # Producer

    def slot(self) -> int:
        """Return the offset of the next record in :attr:`buffer`, or -1 if the ring is full."""
        if self._next - self._counters[_READ] >= self.capacity:
            return -1
        return HEADER_SIZE + self._next % self.capacity * self.record_size

    def publish(self) -> None:
        """Announce the record just written at :meth:`slot`."""
        self._next += 1
        self._counters[_WRITTEN] = self._next

    # Consumer

    def take(self, most: int) -> bytes:
        """Return and release up to ``most`` records that are contiguous in memory."""
        first = self._counters[_READ]
        count = min(most, self._counters[_WRITTEN] - first, self.capacity - first % self.capacity)
        start = HEADER_SIZE + first % self.capacity * self.record_size
        block = bytes(self.buffer[start : start + count * self.record_size])
        self._counters[_READ] = first + count
        return block

    def discard(self) -> None:
        """Release all records unread, for a consumer that starts again."""
        self._counters[_READ] = self._counters[_WRITTEN]

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for the other processes that inherited it."""
        self._counters.release()
        self.buffer.release()
        self._memory.close()


class Observer:
    """A reader that never delays the producer, and counts the records that it missed.

    Parameters
    ----------
    ring
        Ring to read.
    first
        Number of the first record to read, counted since the ring was created; None: the next one.

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
        """Number of the next record, counted as `first` is."""
        return self._cursor

    def take(self, most: int) -> bytes:
        """Return up to ``most`` unread records, oldest first."""
        ring = self._ring
        oldest = ring.oldest
        if self._cursor < oldest:
            self.dropped += oldest - self._cursor
            self._cursor = oldest
        index = self._cursor % ring.capacity
        count = min(most, ring.written - self._cursor, ring.capacity - index)
        start = HEADER_SIZE + index * ring.record_size
        block = bytes(ring.buffer[start : start + count * ring.record_size])
        self._cursor += count
        if ring.written - (self._cursor - count) >= ring.capacity:
            # The producer overtook the copy: none of it is reliable.
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
    """Allocate shared memory.

    Raises
    ------
    OSError
        If there is not enough memory; without this, writing to it would raise a bus error.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, size)
    else:
        os.ftruncate(fd, size)
