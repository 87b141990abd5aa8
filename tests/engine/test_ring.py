"""The ring hands every record over once and in order, and refuses when it is full."""

import struct
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.engine import Ring, RingObserver, shared_memory_fd

RECORD = struct.Struct("<Q")


@pytest.fixture
def ring():
    made = Ring.create(RECORD.size, 8, shared_memory_fd())
    yield made
    made.close()


def put(ring, number):
    offset = ring.next_slot()
    if offset < 0:
        return False
    RECORD.pack_into(ring.buffer, offset, number)
    ring.publish()
    return True


def numbers(block):
    return [number for (number,) in RECORD.iter_unpack(block)]


def take_all(source, most=100):
    found = []
    while block := source.take(most):
        found += numbers(block)
    return found


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 12)), max_size=60))
def test_any_mix_of_writing_and_reading_preserves_the_order(steps):
    ring = Ring.create(RECORD.size, 8, shared_memory_fd())
    written, read = 0, []
    for writing, count in steps:
        if writing:
            for _ in range(count):
                written += put(ring, written)
        else:
            read += numbers(ring.take(count))
        assert ring.written_count - ring.read_count <= 8
    read += take_all(ring)
    assert read == list(range(written))
    ring.close()


def test_a_full_ring_takes_no_more_until_something_is_read(ring):
    assert all(put(ring, number) for number in range(8))
    assert not put(ring, 8)
    assert numbers(ring.take(1)) == [0]
    assert put(ring, 8)
    assert take_all(ring) == list(range(1, 9))


def test_an_observer_counts_missed_records_without_blocking(ring):
    observer = RingObserver(ring)
    for number in range(20):
        assert put(ring, number)
        ring.take(1)
    seen = take_all(observer)
    assert seen == list(range(20 - len(seen), 20))
    assert 0 < len(seen) <= 4  # half of the ring is the margin for what is written meanwhile
    assert observer.dropped == 20 - len(seen)


def test_an_observer_in_time_sees_everything(ring):
    observer = RingObserver(ring)
    seen = []
    for number in range(20):
        put(ring, number)
        ring.take(1)
        seen += numbers(observer.take(10))
    assert seen == list(range(20))
    assert observer.dropped == 0


@pytest.mark.process
def test_another_process_reads_the_records(ring):
    for number in range(5):
        put(ring, number)
    spec = ring.spec
    child = (
        "from rigd.engine._ring import Ring, RingSpec; import sys\n"
        f"ring = Ring(RingSpec({spec.fd}, {spec.record_size}, {spec.capacity}))\n"
        "sys.stdout.buffer.write(ring.take(100))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", child], pass_fds=(spec.fd,), capture_output=True, check=True
    )
    assert numbers(done.stdout) == [0, 1, 2, 3, 4]
    assert ring.read_count == 5
