"""Signals of a running record for viewers: blocks of ticks, and fractions of limits."""

import os
from types import SimpleNamespace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.engine import Ring, shared_memory_fd
from rigd.engine.shared_state import Phase, StateField
from rigd.runner import signal_blocks
from rigd.runner.signal_blocks import SignalBlockReader
from rigd.session.layout import SAMPLE_SIZE, pack_sample_into

RATE_HZ = 1000.0


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def monotonic(self):
        return self.now_s


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(signal_blocks, "time", clock := Clock())
    return clock


@pytest.fixture(scope="module")
def profile():
    return load_shipped("sim")


@pytest.fixture
def channels():
    fd = shared_memory_fd()
    shared_state = dict.fromkeys(StateField, 0)
    yield SimpleNamespace(samples=Ring.create(SAMPLE_SIZE, 8000, fd), shared_state=shared_state)
    os.close(fd)


@pytest.fixture
def reader(profile, clock, channels):
    reader = SignalBlockReader(profile)
    reader.take(channels)
    clock.now_s += 0.1
    return reader


def put(channels, ticks, angle_rad=0.0, *, command_nm=0.0, wrench=(0.0,) * 6):
    ring = channels.samples
    for tick, angle in zip(ticks, np.broadcast_to(angle_rad, len(ticks)), strict=True):
        pack_sample_into(
            ring.buffer, ring.next_slot(), tick * 10**6, tick, 0.01, float(angle), command_nm, 0.5,
            *wrench, 0, 0, 0,
        )  # fmt: skip
        ring.publish()
    ring.discard_records()


def test_gauges_without_ticks_between_records(reader, channels):
    channels.shared_state |= {StateField.PHASE: Phase.OFF, StateField.ANGLE_NRAD: -314_000_000}
    (block,) = reader.take(channels)
    assert block.tick_count == 0
    assert {name: values.size for name, values in block.signals.items()} == {
        "angle_rad": 0, "angle_reference_rad": 0, "coupling_torque_nm": 0,
    }  # fmt: skip
    assert block.gauges["angle"].value == pytest.approx(0.314)
    assert block.gauges["angle"].fraction == pytest.approx(0.2)
    assert block.gauges["velocity"].value is None
    assert block.gauges["velocity"].fraction is None


def test_block_has_every_tick_and_nan_for_missed_ones(reader, channels):
    put(channels, range(50))
    put(channels, [52, 53, 55])
    (block,) = reader.take(channels)
    assert (block.first_tick, block.tick_count, block.last_tick, block.t_ns) == (0, 56, 55, 0)
    missed = np.flatnonzero(np.isnan(block.signals["angle_rad"]))
    assert missed.tolist() == [50, 51, 54]
    assert block.signals["coupling_torque_nm"].dtype == np.float32
    assert block.signals["coupling_torque_nm"][0] == 0.5


def test_ticks_missed_between_two_reads_are_in_the_second(reader, channels):
    put(channels, range(50))
    reader.take(channels)
    put(channels, range(53, 60))
    (block,) = reader.take(channels)
    assert (block.first_tick, block.tick_count, block.t_ns) == (50, 10, 50_000_000)
    assert np.isnan(block.signals["angle_rad"][:3]).all()
    put(channels, range(9000, 9010))  # far away: a gap
    (block,) = reader.take(channels)
    assert (block.first_tick, block.tick_count) == (9000, 10)


def test_new_records_and_long_blocks_are_separate_blocks(reader, channels):
    put(channels, [5, 6, 7])
    put(channels, range(3000))
    blocks = reader.take(channels)
    assert [(block.first_tick, block.tick_count) for block in blocks] == [
        (5, 3),
        (0, 2497),
        (2497, 503),
    ]


def test_no_old_samples_after_a_pause(reader, channels, clock):
    put(channels, range(100))
    clock.now_s += 5.0
    (block,) = reader.take(channels)
    assert block.tick_count == 0
    put(channels, range(100, 110))
    (block,) = reader.take(channels)
    assert block.first_tick == 100


def test_gauges_have_the_peaks_of_all_ticks(reader, channels, clock):
    angles_rad = []
    for first in range(0, 200, 50):
        put(channels, range(first, first + 50), 0.3 if first == 50 else 0.1)
        (block,) = reader.take(channels)
        angles_rad.append(block.gauges and block.gauges["angle"].value)
        clock.now_s += 0.05
    assert angles_rad == [0.1, None, 0.3, None]
    # Samples that remain when the record ends are in the next gauges, without ticks.
    put(channels, [200], 0.4)
    clock.now_s -= 0.05
    assert [block.gauges for block in reader.take(channels)] == [None]
    clock.now_s += 0.05
    (block,) = reader.take(channels)
    assert (block.tick_count, block.gauges["angle"].value) == (0, 0.4)


def test_gauges_are_peaks_with_their_limits(reader, channels, profile, clock):
    angle = np.array([0.0, 0.0, 0.003, -0.001])
    put(channels, range(4), angle, command_nm=-0.45, wrench=(0, -11.0, 0, 0, 0, 0.1))
    (block,) = reader.take(channels)
    gauges = block.gauges
    used = profile.limits.sensor_range_percent / 100
    expected = {
        "angle": (0.003, profile.limits.angle_rad, "rad"),
        "velocity": (4.0, profile.limits.velocity_rad_s, "rad/s"),
        "tracking_error": (0.011, profile.limits.tracking_error_rad, "rad"),
        "torque_command": (0.45, profile.rig.motor.peak_torque_nm, "N·m"),
        "fy": (11.0, used * profile.rig.sensor.range[1], "N"),
        "tz": (0.1, used * profile.rig.sensor.range[5], "N·m"),
    }
    for name, (value, limit, unit) in expected.items():
        gauge = gauges[name]
        assert (gauge.value, gauge.limit, gauge.unit) == (pytest.approx(value), limit, unit)
        assert gauge.fraction == pytest.approx(value / limit)
    assert list(gauges)[:5] == ["angle", "velocity", "tracking_error", "torque_command", "i2t"]
    # The speed is continuous across blocks.
    put(channels, [5], [0.001])
    clock.now_s += 0.1
    (block,) = reader.take(channels)
    assert block.gauges["velocity"].value == pytest.approx(1.0)


def test_nan_readings_are_ignored(reader, channels, clock):
    put(channels, range(3), [np.nan, np.inf, np.nan])
    (block,) = reader.take(channels)
    assert block.gauges["angle"].value is None
    put(channels, range(3, 5), [0.5, np.nan])
    clock.now_s += 0.1
    (block,) = reader.take(channels)
    assert block.gauges["angle"].value == 0.5


def test_i2t_gauge_agrees_with_the_limit_monitor(reader, channels, profile, clock):
    motor, torque_nm = profile.rig.motor, 0.6
    for first in range(0, 4050, 50):
        clock.now_s += 0.05
        put(channels, range(first, first + 50), command_nm=torque_nm)
        (block,) = reader.take(channels)
    passed = 1.0 - np.exp(-4.05 / motor.thermal_time_constant_s)
    expected = torque_nm * np.sqrt(passed)
    assert block.gauges["i2t"].value == pytest.approx(expected, rel=0.01)
    assert block.gauges["i2t"].limit == motor.continuous_torque_nm
    clock.now_s += motor.thermal_time_constant_s
    (block,) = reader.take(channels)
    assert block.gauges["i2t"].value == pytest.approx(expected * np.exp(-0.5), rel=0.01)
