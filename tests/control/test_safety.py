"""Limits: predicted before a session, checked in every tick."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.control import PidController, close_loop, design_pid
from rigd.excitation import chirp, step
from rigd.safety import Limits, LimitWatch, predict, violations

LIMITS = Limits(
    angle_rad=1.0,
    velocity_rad_s=10.0,
    tracking_error_rad=0.1,
    sensor_range_percent=90.0,
    missed_ticks_in_a_row=50,
    missed_percent=2.0,
)
RANGE = (20.0, 20.0, 60.0, 1.0, 1.0, 1.0)
REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def watch():
    return LimitWatch(LIMITS, RANGE, 1000.0)


def judge(profile, excitation, **changes):
    prediction = predict(
        close_loop(profile.loop_model()), excitation, torque_limit_nm=0.9, **changes
    )
    found = violations(
        prediction, profile.limits, torque_limit_nm=0.9, coupling_torque_limit_nm=1.0
    )
    return prediction, found


def test_the_papers_chirp_stays_within_the_shipped_limits(profile):
    prediction, found = judge(profile, chirp(rate_hz=1000.0))
    assert found == []
    assert prediction.saturated_ticks == 0
    assert prediction.peak_torque_nm == pytest.approx(0.41, abs=0.01)
    assert prediction.peak_angle_rad == pytest.approx(0.025, rel=0.01)


def test_ten_times_the_amplitude_saturates_and_may_be_forced(profile):
    prediction, found = judge(profile, chirp(rate_hz=1000.0, amplitude_rad=0.25))
    assert prediction.saturated_ticks > 10_000
    assert found
    assert all(violation.may_be_forced for violation in found)
    sentence = next(v.sentence for v in found if "motor.peak_torque_nm" in v.sentence)
    assert "peak torque of 3.8" in sentence
    assert "exceeds 0.9 N·m" in sentence


def test_predicted_saturation_is_what_the_controller_does(profile):
    """A step just below and just above the limit, tick by tick on the reference's jump."""
    model = profile.loop_model()
    gains = design_pid(2e-3, 0.02, 80.0)
    for amplitude in (0.05, 0.09):
        excitation = step(rate_hz=1000.0, amplitude_rad=amplitude)
        prediction, _ = judge(profile, excitation)
        controller = PidController(gains, model.settings, 1000.0, 0.9)
        controller.step(0.0, 0.0, 0.0)
        controller.step(amplitude, 0.0, 0.0)
        assert controller.saturated == (prediction.saturated_ticks > 0)
        assert prediction.peak_torque_nm >= abs(controller.unlimited_torque_nm) - 1e-12


def test_angle_and_speed_can_never_be_forced(profile):
    _, found = judge(profile, step(rate_hz=1000.0, amplitude_rad=2.0))
    firm = [v.sentence for v in found if not v.may_be_forced]
    assert any("limits.angle_rad" in sentence for sentence in firm)
    assert any("limits.velocity_rad_s" in sentence for sentence in firm)
    assert any("limits.tracking_error_rad" in sentence for sentence in firm)


def test_the_start_angle_counts_for_the_angle(profile):
    excitation = chirp(rate_hz=1000.0, duration_s=2.0)
    from_zero = close_loop(profile.loop_model()).simulate(excitation.reference_rad).angle_rad
    prediction, found = judge(profile, excitation, start_angle_rad=-1.56)
    assert prediction.peak_angle_rad == pytest.approx(1.56 - np.min(from_zero))
    assert ["limits.angle_rad" in v.sentence for v in found] == [True]


def test_a_prediction_that_is_no_number_violates(profile):
    prediction, _ = judge(profile, chirp(rate_hz=1000.0, duration_s=1.0))
    broken = replace(prediction, peak_angle_rad=math.nan)
    [found] = violations(broken, profile.limits, torque_limit_nm=0.9, coupling_torque_limit_nm=1.0)
    assert not found.may_be_forced


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


def test_speed_is_checked_over_the_time_that_passed(watch):
    watch.reset(0.0)
    assert watch.check(0.05, 0.05, REST).channel == "speed"
    watch.reset(0.0)
    watch.skip(9)  # the same way in ten ticks
    assert watch.check(0.05, 0.05, REST) is None
    assert not watch.warning
    assert watch.check(0.06, 0.06, REST) is None  # one tick again: exactly at the limit
    assert watch.warning


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(8))
def test_readings_that_are_no_numbers_end_the_session(watch, place, bad):
    values = [0.0] * 8
    values[place] = bad
    violation = watch.check(values[0], values[1], tuple(values[2:]))
    assert violation is not None
    assert "not a number" in str(violation)


@given(
    angle=st.floats(-1.2, 1.2),
    error=st.floats(-0.12, 0.12),
    tz=st.floats(-1.0, 1.0),
    fz=st.floats(-60, 60),
)
def test_fast_check_and_definition_agree(angle, error, tz, fz):
    watch = LimitWatch(LIMITS, RANGE, 1000.0)
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
    assert str(violation) == "The run of missed ticks of 51 ticks exceeds its limit of 50 ticks."


def test_percentage_of_missed_ticks_bears_an_early_burst(watch):
    assert watch.check_missed(40, 200, 300) is None  # 2 % of ten seconds
    assert watch.check_missed(1, 201, 5000).unit == "%"
    assert watch.check_missed(1, 1999, 100_000) is None
    assert watch.check_missed(1, 2001, 100_000) is not None
