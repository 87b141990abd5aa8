"""Tests of rings and boards give back the shared memory that they have made.

Nothing else closes a raw descriptor, and `select`, which pyserial waits with, takes none beyond
1023: a worker that got most of these tests could open no serial line afterwards.
"""

import os
from contextlib import suppress
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _shared_memory_closed(request):
    if request.path.parent.name not in ("engine", "live"):
        yield
        return
    before = _shared_memory()
    yield
    for descriptor in _shared_memory() - before:
        os.close(descriptor)


def _shared_memory() -> set[int]:
    found = set()
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if str(path.readlink()).startswith("/dev/shm/"):
                found.add(int(path.name))
    return found
