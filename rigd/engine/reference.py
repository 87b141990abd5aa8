"""The reference of a session, in shared memory: the control process must not pause to take it.

However long a session is, a drive that watches over the loop's heartbeat waits no longer.
"""

import mmap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.engine.ring import reserve

_SIZE = 8  # bytes of a double


@dataclass(frozen=True, slots=True)
class ReferenceSpec:
    """What the control process needs to find it: an inherited descriptor and its length."""

    fd: int
    ticks: int


def put_reference(fd: int, reference_rad: NDArray[np.float64]) -> ReferenceSpec:
    """Place a reference, shape (n,), in the memory of `fd`.

    Raises
    ------
    OSError
        If there is not enough shared memory.
    """
    size = _SIZE * reference_rad.size
    reserve(fd, size)
    with mmap.mmap(fd, size) as memory:
        memory[:] = reference_rad.astype(np.float64).tobytes()
    return ReferenceSpec(fd, reference_rad.size)


def map_reference(spec: ReferenceSpec) -> Sequence[float]:
    """Attach to a reference: one Python number a tick, read where it lies."""
    memory = mmap.mmap(spec.fd, _SIZE * spec.ticks, access=mmap.ACCESS_READ)
    return memoryview(memory).cast("d")
