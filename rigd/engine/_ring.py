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
"""Size in bytes of a ring's header, which contains its two counters."""
_WRITTEN_COUNTER, _READ_COUNTER = 0, 1
"""Indices of the counters in a ring's header: records written and records read."""


@dataclass(frozen=True, slots=True)
class RingSpec:
    """File descriptor and layout of a ring buffer, which a child process needs to open it."""

    fd: int
    """File descriptor of the shared memory, which the child inherits."""
    record_size: int
    """Size of a record in bytes."""
    capacity: int
    """Number of records that the ring holds."""


class Ring:
    """Ring buffer in shared memory: ``capacity`` records of ``record_size`` bytes each.

    Parameters
    ----------
    spec
        Descriptor and layout of the memory of an existing ring; :meth:`create` makes a new ring.
    """

    def __init__(self, spec: RingSpec) -> None:
        self.spec = spec
        self.capacity = spec.capacity
        self.record_size = spec.record_size
        self._memory = mmap.mmap(spec.fd, HEADER_SIZE + spec.capacity * spec.record_size)
        self.buffer = memoryview(self._memory)
        self._counters = self.buffer[:HEADER_SIZE].cast("Q")
        self._next_record = self._counters[_WRITTEN_COUNTER]

    @classmethod
    def create(cls, record_size: int, capacity: int, fd: int) -> Self:
        """Return a new empty ring buffer in the shared memory of descriptor `fd`.

        Parameters
        ----------
        record_size
            Size of a record in bytes.
        capacity
            Number of records.
        fd
            Descriptor of the memory, from :func:`shared_memory_fd`.
        """
        reserve_memory(fd, HEADER_SIZE + capacity * record_size)
        return cls(RingSpec(fd, record_size, capacity))

    @property
    def written_count(self) -> int:
        """Number of records written to the ring since it was created."""
        return self._counters[_WRITTEN_COUNTER]

    @property
    def read_count(self) -> int:
        """Number of records that the consumer has read since the ring was created."""
        return self._counters[_READ_COUNTER]

    @property
    def waiting_count(self) -> int:
        """Number of records in the ring that the consumer has not read yet."""
        return self._counters[_WRITTEN_COUNTER] - self._counters[_READ_COUNTER]

    @property
    def oldest_index(self) -> int:
        """Index of the oldest record in the ring that an observer may read.

        Records are counted from the ring's creation, and the index is negative in a new ring. Half
        of the ring is a margin for records that are written while the observer copies.
        """
        return self._counters[_WRITTEN_COUNTER] - self.capacity // 2

    # Producer

    def next_slot(self) -> int:
        """Return the byte offset in :attr:`buffer` for the next record, or -1 if the ring is full.

        The producer writes the record there and then calls :meth:`publish`.
        """
        if self._next_record - self._counters[_READ_COUNTER] >= self.capacity:
            return -1
        return HEADER_SIZE + self._next_record % self.capacity * self.record_size

    def publish(self) -> None:
        """Make the record that was written at :meth:`next_slot` visible to the ring's readers."""
        self._next_record += 1
        self._counters[_WRITTEN_COUNTER] = self._next_record

    # Consumer

    def take(self, max_records: int) -> bytes:
        """Remove up to ``max_records`` of the oldest records from the ring and return their bytes.

        Only records that are contiguous in memory are returned.
        """
        oldest_index = self._counters[_READ_COUNTER]
        record_count = min(
            max_records,
            self._counters[_WRITTEN_COUNTER] - oldest_index,
            self.capacity - oldest_index % self.capacity,
        )
        start_offset = HEADER_SIZE + oldest_index % self.capacity * self.record_size
        record_bytes = bytes(
            self.buffer[start_offset : start_offset + record_count * self.record_size]
        )
        self._counters[_READ_COUNTER] = oldest_index + record_count
        return record_bytes

    def discard_records(self) -> None:
        """Mark all records of the ring as read, for a consumer that begins with new records."""
        self._counters[_READ_COUNTER] = self._counters[_WRITTEN_COUNTER]

    def close(self) -> None:
        """Unmap the memory; the descriptor stays open for the other processes that inherited it."""
        self._counters.release()
        self.buffer.release()
        self._memory.close()


class RingObserver:
    """Reader of a ring that never delays the producer, and may therefore miss records.

    Parameters
    ----------
    ring
        Ring to read.
    first_index
        Index of the first record to read, counted since the ring was created. None: start with the
        next record that is written.

    Attributes
    ----------
    dropped
        Number of records that were overwritten before they were read.
    """

    def __init__(self, ring: Ring, first_index: int | None = None) -> None:
        self._ring = ring
        self._next_index = ring.written_count if first_index is None else first_index
        self.dropped = 0

    @property
    def next_index(self) -> int:
        """Index of the record that the observer reads next, counted since the ring's creation."""
        return self._next_index

    def take(self, max_records: int) -> bytes:
        """Return the bytes of up to ``max_records`` records that this observer has not read yet.

        The oldest record comes first.
        """
        ring = self._ring
        oldest_index = ring.oldest_index
        if self._next_index < oldest_index:
            self.dropped += oldest_index - self._next_index
            self._next_index = oldest_index
        ring_slot = self._next_index % ring.capacity
        record_count = min(
            max_records, ring.written_count - self._next_index, ring.capacity - ring_slot
        )
        start_offset = HEADER_SIZE + ring_slot * ring.record_size
        record_bytes = bytes(
            ring.buffer[start_offset : start_offset + record_count * ring.record_size]
        )
        self._next_index += record_count
        if ring.written_count - (self._next_index - record_count) >= ring.capacity:
            # The producer overtook the copy: none of it is reliable.
            self.dropped += record_count
            return b""
        return record_bytes


# Memory


def shared_memory_fd() -> int:
    """Return a file descriptor of new shared memory of size 0, which child processes inherit."""
    memory_folder = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryFile(dir=memory_folder) as temporary_file:
        fd = os.dup(temporary_file.fileno())
    os.set_inheritable(fd, True)
    return fd


def reserve_memory(fd: int, byte_count: int) -> None:
    """Allocate `byte_count` bytes of shared memory at the descriptor `fd`.

    Raise `OSError` if there is not enough memory. Without the allocation, writing to the memory
    would raise a bus error.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, byte_count)
    else:
        os.ftruncate(fd, byte_count)
