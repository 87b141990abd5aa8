"""A ceiling on memory while a file of unknown origin is read."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_MEMORY: Final = 800_000_000
"""Most memory that reading a file may take, bytes."""


@contextmanager
def bounded_memory(extra_bytes: int = MAX_MEMORY) -> Iterator[None]:
    """Let the process grow by so much and no further: what asks for more gets a MemoryError.

    Formats such as MATLAB's are compressed and nested, and their readers believe what a file says
    of its sizes; a kilobyte can ask for all the memory there is. The kernel's own limit holds for
    every library alike. Where there is none (Windows, macOS) nothing is limited. Libraries are to
    be imported before, as the address space that they reserve would count too.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ceiling = pages * resource.getpagesize() + extra_bytes
    bounds = [limit for limit in (soft, hard, ceiling) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(bounds), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
