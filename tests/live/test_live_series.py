"""One publisher for all sessions of a rig: a recording for each, and no accumulation."""

import os
import signal
import time
from pathlib import Path

import pytest
from processes import eventually

pytestmark = pytest.mark.process


def run_session(publisher, name: str) -> tuple[int, int]:
    """Make the producer's next quarter of a second a separate session.

    Return its first sample, and the number of samples at its end.
    """
    producer = publisher.producer
    begins = tuple(ring.written_count for ring in producer.channels.rings)
    publisher.show(name, begins)
    until = producer.tick + 250
    assert eventually(lambda: producer.tick > until)
    publisher.finish()
    return begins[-1], producer.channels.samples.written_count


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


@pytest.mark.further  # as of a rig's series
def test_each_session_is_a_recording_with_its_own_samples(publisher_without_drops, receive):
    publisher = publisher_without_drops
    received = receive(publisher)
    publisher.finish()
    bounds = {f"recording of {name}": run_session(publisher, name) for name in ("second", "third")}
    recordings = received()
    assert recordings.keys() == bounds.keys() | {"recording of chirp under test"}
    for name, (first, end) in bounds.items():
        ticks = recordings[name]("/signals", "angle_mrad")[0] // 1_000_000
        assert ticks[0] == first
        assert first + 250 <= ticks[-1] + 1 <= end, "up to when it was finished"
        assert (ticks[1:] - ticks[:-1] == 1).all()


@pytest.mark.further  # at length
def test_sessions_leave_no_memory_and_threads(publisher):
    publisher.finish()
    for number in range(4):  # objects that are made once, and stored
        run_session(publisher, f"early {number}")
    pid, server = publisher.process.pid, publisher.server_pid
    before_mb, before = resident_mb(pid), threads(pid)
    for number in range(8):
        run_session(publisher, f"later {number}")
    assert publisher.server_pid == server
    assert eventually(lambda: threads(pid) <= before + 3), "of streams that have come and gone"
    assert resident_mb(pid) < before_mb + 10.0


@pytest.mark.slow
def test_session_begun_with_a_frozen_server_is_shown_later(
    start_producer, start_publisher, receive
):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(
        producer, first="from rigd.live import publisher; publisher._MAX_QUEUED_SAMPLES_S = 1.0"
    )
    server = publisher.server_pid
    os.kill(server, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > 1000)
    publisher.show("next", tuple(ring.written_count for ring in producer.channels.rings))
    assert eventually(lambda: publisher.dropped < 1000), "they are counted for each session"
    os.kill(server, signal.SIGCONT)
    dropped = -1

    def count_is_constant() -> bool:
        nonlocal dropped
        before, dropped = dropped, publisher.dropped
        time.sleep(0.3)
        return dropped == before

    assert eventually(count_is_constant)
    columns = receive(publisher)()["recording of next"]
    assert columns("/signals", "angle_mrad")[0].size > 100
