"""Statistics of a record, from its samples as they arrive."""

import os

import numpy as np
import pytest

from rigd.engine import Ring, shared_memory_fd
from rigd.runner.status import SignalStatisticsReader
from rigd.session.layout import SAMPLE_SIZE, pack_sample_into


@pytest.fixture
def ring():
    fd = shared_memory_fd()
    yield Ring.create(SAMPLE_SIZE, 8000, fd)
    os.close(fd)


def put(ring, ticks, *, error_rad=0.0, coupling_nm=0.0, command_nm=0.0, lateness_ns=50_000):
    for tick in ticks:
        pack_sample_into(
            ring.buffer, ring.next_slot(), tick * 10**6, tick, error_rad, 0.0, command_nm,
            coupling_nm, *[0.0] * 6, 0, lateness_ns, 80_000,
        )  # fmt: skip
        ring.publish()
    ring.discard_records()


def test_no_statistics_before_the_first_sample(ring):
    assert SignalStatisticsReader(1000.0).poll(ring) is None


def test_statistics_and_peaks_of_a_record(ring):
    watch = SignalStatisticsReader(1000.0)
    watch.poll(ring)
    put(ring, range(100), error_rad=-0.02, coupling_nm=-0.5, command_nm=0.3, lateness_ns=10**6)
    assert watch.poll(ring)().lateness_p50_us == 1000.0
    put(ring, range(100, 2500), error_rad=0.001, coupling_nm=0.1)
    status = watch.poll(ring)()
    assert status.lateness_p99_us == pytest.approx(50.0)
    assert status.work_p99_us == pytest.approx(80.0)
    assert status.rate_hz == 1000.0
    assert status.tracking_error_rad == 0.001
    peaks = (
        status.peak_tracking_error_rad,
        status.peak_coupling_torque_nm,
        status.peak_torque_command_nm,
    )
    assert peaks == (0.02, 0.5, 0.3)
    assert watch.poll(ring)() == status  # nothing has come since


def test_statistics_of_a_new_record_with_missed_ticks(ring):
    watch = SignalStatisticsReader(1000.0)
    watch.poll(ring)
    put(ring, range(1000), error_rad=0.5)
    put(ring, np.delete(np.arange(1000), np.arange(100, 200)).tolist(), error_rad=0.1)
    status = watch.poll(ring)()
    assert status.rate_hz == pytest.approx(900.0)
    assert status.peak_tracking_error_rad == 0.1
