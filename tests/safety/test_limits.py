"""Limits, checked in every tick."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.safety import LimitMonitor
from rigd.safety.limits import Limits

LIMITS = Limits(
    angle_rad=1.0,
    stop_angle_rad=2.0,
    velocity_rad_s=10.0,
    acceleration_rad_s2=1e6,  # jumps have tests of their own
    tracking_error_rad=0.1,
    torque_command_nm=5.0,
    sensor_range_percent=90.0,
    saturated_ticks_in_a_row=10,
    stale_ticks_in_a_row=3,
    missed_ticks_in_a_row=50,
    missed_percent=2.0,
    tare_drift_nm=0.01,
    recorder_lag_s=8.0,
    disk_free_mb=50.0,
)
RANGE = (20.0, 20.0, 60.0, 1.0, 1.0, 1.0)
REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
MOTOR = {
    "resolution_rad": 0.0,
    "peak_torque_nm": math.inf,
    "continuous_torque_nm": math.inf,
    "thermal_time_constant_s": 10.0,
    "tare_warning_nm": math.inf,
}


@pytest.fixture
def watch():
    return LimitMonitor(LIMITS, RANGE, 1000.0, **MOTOR)


def test_ordinary_ticks_pass(watch):
    for tick in range(1000):
        angle = 0.5 * math.sin(2 * math.pi * tick / 1000)
        assert watch.check(angle + 0.01, angle, (1.0, -1.0, 5.0, 0.1, 0.1, -0.4)) is None
        assert not watch.warning


@pytest.mark.parametrize(
    ("reading", "channel", "unit"),
    [
        ((1.01, 1.01, REST), "angle", "rad"),
        ((-1.01, -1.01, REST), "angle", "rad"),
        ((0.11, 0.0, REST), "tracking error", "rad"),
        ((0.0, 0.0, (0, -18.1, 0, 0, 0, 0)), "sensor's fy", "N"),
        ((0.0, 0.0, (0, 0, 0, 0, 0, 0.91)), "sensor's tz", "N·m"),
        ((0.0, 0.0, (0, 0, 0, -0.91, 0, 0)), "sensor's tx", "N·m"),
    ],
)
def test_each_limit_is_found_with_its_numbers(watch, reading, channel, unit):
    watch.reset(reading[1])
    violation = watch.check(*reading)
    assert violation is not None
    assert (violation.channel, violation.unit) == (channel, unit)
    assert abs(violation.value) > violation.limit
    assert f"{violation.limit:.4g} {unit}" in str(violation)


def test_speed_is_checked_over_the_elapsed_time(watch):
    watch.reset(0.0)
    assert watch.check(0.05, 0.05, REST).channel == "speed"
    watch.reset(0.0)
    watch.skip(9)  # the same way in ten ticks
    assert watch.check(0.05, 0.05, REST) is None
    assert not watch.warning
    assert watch.check(0.06, 0.06, REST) is None  # one tick again: exactly at the limit
    assert watch.warning
    watch.reset(0.0)
    assert watch.check_missed(9, 9, 10) is None
    assert watch.check(0.05, 0.05, REST) is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("index", range(8))
def test_nan_readings_end_the_session(watch, index, bad):
    values = [0.0] * 8
    values[index] = bad
    violation = watch.check(values[0], values[1], tuple(values[2:]))
    assert violation is not None
    assert "not a number" in str(violation)


@settings(max_examples=50)
@given(
    angle=st.floats(-1.2, 1.2),
    error=st.floats(-0.12, 0.12),
    tz=st.floats(-1.0, 1.0),
    fz=st.floats(-60, 60),
)
def test_fast_check_and_definition_agree(angle, error, tz, fz):
    watch = LimitMonitor(LIMITS, RANGE, 1000.0, **MOTOR)
    watch.reset(angle)
    reference = angle + error
    violation = watch.check(reference, angle, (0.0, 0.0, fz, 0.0, 0.0, tz))
    ratios = np.abs([angle / 1.0, (reference - angle) / 0.1, tz / 0.9, fz / 54.0])
    assert (violation is not None) == bool(np.max(ratios) > 1.0)
    if not np.any(np.isclose(ratios, 0.8)):
        assert watch.warning == bool(np.max(ratios) > 0.8)


def test_missed_ticks_in_a_row(watch):
    assert watch.check_missed(50, 50, 60) is None
    violation = watch.check_missed(51, 51, 61)
    assert violation is not None
    assert str(violation) == (
        "Run of missed ticks 51 ticks exceeds limit 50 ticks "
        "(limits.missed_ticks_in_a_row). The computer is overloaded: close "
        "other programs."
    )


def test_percentage_of_missed_ticks_tolerates_an_early_burst(watch):
    assert watch.check_missed(40, 200, 300) is None  # 2 % of ten seconds
    assert watch.check_missed(1, 201, 5000).unit == "%"
    assert watch.check_missed(1, 1999, 100_000) is None
    assert watch.check_missed(1, 2001, 100_000) is not None


def test_stale_readings_are_tolerated_up_to_the_limit(watch):
    for angle, wrench, word in ((True, False, "angle"), (False, True, "wrench")):
        watch.reset(0.0)
        for _ in range(3):
            assert watch.check_stale(angle, wrench) is None
        assert f"without a new {word}" in str(watch.check_stale(angle, wrench))


def test_a_fresh_reading_resets_the_count_of_stale_ones(watch):
    for _ in range(20):
        assert watch.check_stale(True, True) is None
        assert watch.check_stale(True, False) is None
        assert watch.check_stale(False, True) is None
        assert watch.check_stale(False, False) is None


def test_speed_after_stale_angles_is_over_the_whole_time(watch):
    """A shaft at 9 of 10 rad/s, of which three angles do not arrive."""
    step = 9.0 / 1000
    watch.reset(0.0)
    assert watch.check(0.0, step, REST) is None
    for _ in range(3):
        assert watch.check(0.0, step, REST, angle_stale=True) is None
    assert watch.check(0.0, 5 * step, REST) is None
    watch.reset(0.0)
    assert watch.check(0.0, step, REST, angle_stale=True) is None
    faster = watch.check(0.0, 2.5 * step, REST)
    assert faster is not None
    assert faster.channel == "speed"
