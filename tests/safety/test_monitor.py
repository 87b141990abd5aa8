"""Monitoring of jumps, heat, lag and disk, and how often it reports values near a limit."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.engine.cycle import make_limit_monitor
from rigd.excitation import hold
from rigd.profile import load_profile
from rigd.runner import Series
from rigd.runner.planning import RefusedError
from rigd.safety import SLOW_CHECK_TICKS, SensorMonitor

PROFILE = load_profile("antenna_can")
LIMITS = PROFILE.limits
STEP_RAD = PROFILE.rig.encoder.resolution_rad
REST = (0.0,) * 6
PERIOD_NS = 1_000_000


@pytest.fixture
def watch():
    return make_limit_monitor(PROFILE)


def follow(watch, angles_rad):
    """Check angles equal to their reference; return the first that ends the session."""
    for tick, angle_rad in enumerate(angles_rad):
        violation = watch.check(angle_rad, angle_rad, REST)
        if violation is not None:
            return tick, violation
    return None


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("counts", [20, 50, 5000])
def test_an_encoder_slip_at_rest_is_found_at_once(watch, counts, sign):
    tick, violation = follow(watch, [0.0] * 10 + [sign * counts * STEP_RAD])
    assert tick == 10
    assert violation.channel == "encoder jump"
    assert violation.value == pytest.approx(sign * counts * STEP_RAD)
    assert violation.limit == pytest.approx(1e-3 + 2 * STEP_RAD)


def test_a_slip_in_motion_is_found_below_the_speed_limit(watch):
    angles_rad = 0.5e-3 * np.arange(100)
    angles_rad[60:] += 0.003  # 3.5 rad/s for a tick, where 4 are allowed
    tick, violation = follow(watch, angles_rad.tolist())
    assert tick == 60
    assert violation.channel == "encoder jump"


@settings(max_examples=60)
@given(
    st.floats(0.0, 1.3),
    st.floats(0.05, 20.0),
    st.lists(st.floats(0.0, 0.8), min_size=50, max_size=50),
    st.floats(0.0, 6.3),
)
def test_late_ticks_are_no_jumps(speed_rad_s, frequency_hz, lateness, phase):
    """A shaft at up to the chirp's speed, latched late by up to 0.8 of a period."""
    watch = make_limit_monitor(replace(PROFILE, limits=replace(LIMITS, velocity_rad_s=100.0)))
    omega = min(2 * math.pi * frequency_hz, 900.0 / max(speed_rad_s, 1e-3))
    late_s = np.array(lateness) * 1e-3
    t_s = np.arange(50) * 1e-3 + late_s
    angles_rad = speed_rad_s / omega * np.sin(omega * t_s + phase)
    angles_rad = np.round(angles_rad / STEP_RAD) * STEP_RAD
    watch.reset(float(angles_rad[0]))
    # Nothing can accelerate from rest to this speed in one tick.
    watch._previous_moved_rad = watch._second_last_moved_rad = float(angles_rad[1] - angles_rad[0])
    watch._previous_angle_rad = float(angles_rad[1])
    limited = [v for v in angles_rad[2:].tolist() if abs(v) < 1.2]
    assert follow(watch, limited) is None


def test_uneven_latches_after_missed_ticks_are_no_jumps(watch):
    # As seen on the wire: 24 ticks missed, then a latch too early and one that makes up for it.
    follow(watch, (1.9e-3 * np.arange(5)).tolist())
    watch.skip(24)
    moved_rad = 1.9e-3 * np.array([29.0, 29.0, 31.05])
    assert follow(watch, moved_rad.tolist()) is None
    # A slip is found again soon after.
    ordinary = moved_rad[-1] + 1.9e-3 * np.arange(1, 11)
    ordinary[6:] -= 0.0055  # 3.6 rad/s for a tick
    tick, violation = follow(watch, ordinary.tolist())
    assert (tick, violation.channel) == (6, "encoder jump")


def test_missing_angles_are_no_jump(watch):
    """Nine old angles in a row, while the motor goes from rest to 3 rad/s."""
    speeds_rad_s = np.minimum(np.arange(20) * 0.4, 3.0)
    angles_rad = np.cumsum(speeds_rad_s) * 1e-3
    assert follow(watch, angles_rad[:2].tolist()) is None
    for _ in range(9):
        held = float(angles_rad[1])
        assert watch.check(held, held, REST, angle_stale=True) is None
    assert follow(watch, angles_rad[11:].tolist()) is None


def heat(watch, torque_nm, seconds, start_s=0.0):
    """Exert a torque; return when that ends the session."""
    for check in range(round(seconds * 1000 / SLOW_CHECK_TICKS)):
        now_ns = round(start_s * 1e9) + check * SLOW_CHECK_TICKS * PERIOD_NS
        if watch.check_slow(now_ns, SLOW_CHECK_TICKS * torque_nm**2) is not None:
            return (now_ns * 1e-9) - start_s
    return None


@pytest.mark.parametrize("torque_nm", [0.45, 0.6, 0.9])
def test_the_motor_heats_up_with_its_time_constant(watch, torque_nm):
    motor = PROFILE.rig.motor
    ratio = (motor.continuous_torque_nm / torque_nm) ** 2
    expected_s = -motor.thermal_time_constant_s * math.log(1 - ratio)
    assert heat(watch, torque_nm, 60.0) == pytest.approx(expected_s, abs=0.2)


def test_continuous_torque_has_no_time_limit(watch):
    assert heat(watch, 0.99 * PROFILE.rig.motor.continuous_torque_nm, 300.0) is None
    assert heat(watch, 0.9, 5.0, start_s=300.0) < 0.3
    # A minute without a check, as between two sessions.
    assert heat(watch, 0.9, 5.0, start_s=400.0) > 1.5


def test_heat_lag_and_disk_mark_samples_until_normal(watch):
    assert watch.check_slow(0, 0.0, 0.6 * LIMITS.recorder_lag_s) is None
    assert watch.check(0.0, 0.0, REST) is None
    assert watch.warning
    assert watch.check_slow(SLOW_CHECK_TICKS * PERIOD_NS, 0.0, 0.1 * LIMITS.recorder_lag_s) is None
    assert watch.check(0.0, 0.0, REST) is None
    assert not watch.warning
    assert watch.check_slow(2 * SLOW_CHECK_TICKS * PERIOD_NS, disk_free_mb=400.0) is None
    assert watch.check(0.0, 0.0, REST) is None
    assert watch.warning
    lag, disk = watch.take_notices()
    assert "ecorder backlog 7.2 s above warning level 6 s (limit 12" in lag
    assert "Free space on the session's disk 400 MB below warning level 500 MB (limit 50" in disk


def test_a_channel_is_reported_again_after_a_second(watch):
    near = 0.9 * LIMITS.angle_rad

    def hold_angle(angle_rad, checks):
        for _ in range(checks):
            watch.reset(angle_rad)
            assert watch.check(angle_rad, angle_rad, REST) is None
            assert watch.check_slow(0) is None
        return len(watch.take_notices())

    assert hold_angle(near, 50) == 1
    assert hold_angle(0.0, 10) == 0
    assert hold_angle(near, 1) == 0  # back after 0.6 s
    assert hold_angle(0.0, 20) == 0
    assert hold_angle(near, 1) == 1  # back after 1.3 s


def test_no_notice_beyond_the_limit(watch):
    watch.reset(2.0)
    assert watch.check(2.0, 2.0, REST) is not None
    assert watch.take_notices() == []


def test_missed_ticks_near_their_limit_mark_the_next_sample(watch):
    assert watch.check_missed(22, 22, 1000) is None
    assert watch.check(0.0, 0.0, REST) is None
    assert watch.warning
    assert watch.check(0.0, 0.0, REST) is None
    assert not watch.warning
    [notice] = watch.take_notices()
    assert notice.startswith("Run of missed ticks 22 ticks above warning level 20 ticks (limit 25")


def test_many_old_readings_near_their_limit_mark_the_next_sample(watch):
    assert watch.check_stale_fraction(49, 49, 10_000) is None
    assert watch.take_notices() == []
    assert watch.check_stale_fraction(51, 60, 10_000) is None
    assert watch.check(0.0, 0.0, REST) is None
    # No angle was old in this tick or the one before: the check of old readings reports it.
    assert watch.check_stale(angle_stale=False, wrench_stale=False) is None
    assert watch.warning
    assert watch.check(0.0, 0.0, REST) is None
    assert not watch.warning
    angle, wrench = watch.take_notices()
    assert angle == (
        "Percentage of ticks without a new angle 0.51 % above warning level 0.5 % (limit 1, "
        "limits.stale_percent)."
    )
    assert "new wrench 0.6 %" in wrench


@pytest.mark.parametrize(("angles", "wrenches", "which"), [(101, 0, "angle"), (3, 101, "wrench")])
def test_too_many_old_readings_end_a_session(watch, angles, wrenches, which):
    assert watch.check_stale_fraction(100, 100, 10_000) is None
    violation = watch.check_stale_fraction(angles, wrenches, 5)  # as if ten seconds had passed
    assert violation.channel == f"percentage of ticks without a new {which}"
    assert (violation.value, violation.limit) == (pytest.approx(1.01), 1.0)
    assert watch.check_stale_fraction(400, 400, 40_000) is None


def test_a_nan_torque_is_never_commanded(watch):
    assert "not a number" in str(watch.check_torque(math.nan))
    assert watch.check_torque(1.0) is None  # cut at 0.9 N·m, and reported
    assert len(watch.take_notices()) == 1


def usage(free_mb):
    return lambda _: SimpleNamespace(free=round(free_mb * 1e6))


def test_a_session_too_large_for_the_disk_is_refused(tmp_path, monkeypatch):
    excitation = hold(rate_hz=1000.0, duration_s=100.0)  # up to 27 MB with the reserve
    monkeypatch.setattr("shutil.disk_usage", usage(80.0))
    Series(PROFILE, excitation, tmp_path / "sessions")
    assert (tmp_path / "sessions").is_dir()
    monkeypatch.setattr("shutil.disk_usage", usage(75.0))
    with pytest.raises(
        RefusedError, match=r"75\.0 MB .* limits\.disk_free_mb = 50 MB .* free up space"
    ):
        Series(PROFILE, excitation, tmp_path / "sessions")


OVERLOADED_ADVICE = "The computer is overloaded: close other programs."


def tracking_violation(watch):
    """Have the shaft fall far behind its reference, and return the message."""
    return str(watch.check(2.0 * LIMITS.tracking_error_rad, 0.0, REST))


def test_a_violation_after_a_pause_is_due_to_the_computer(watch):
    assert "lower the amplitude" in tracking_violation(watch)
    watch.reset(0.0)
    assert watch.check_missed(20, 20, 1000) is None
    message = tracking_violation(watch)
    assert message.endswith(f"It came after 20 missed ticks. {OVERLOADED_ADVICE}")
    assert "amplitude" not in message


def test_missed_ticks_of_several_gaps_are_reported_together(watch):
    watch.skip(4)
    assert watch.missed_ticks_text == "It came after 4 missed ticks."
    watch.skip(5)
    assert watch.missed_ticks_text == f"It came after 9 missed ticks. {OVERLOADED_ADVICE}"


def test_few_missed_ticks_do_not_explain_a_violation(watch):
    watch.skip(1)
    message = tracking_violation(watch)
    assert "It came after 1 missed tick." in message
    assert "lower the amplitude" in message
    assert OVERLOADED_ADVICE not in message


def test_missed_ticks_expire_after_two_checks(watch):
    watch.skip(20)
    watch.check_slow(0)
    assert watch.missed_ticks_text
    watch.check_slow(SLOW_CHECK_TICKS * PERIOD_NS)
    assert watch.missed_ticks_text == ""
    assert "amplitude" in tracking_violation(watch)


def test_missed_ticks_do_not_explain_a_full_disk(watch):
    watch.skip(20)
    violation = watch.check_slow(0, disk_free_mb=0.5 * LIMITS.disk_free_mb)
    assert "missed" not in str(violation)


def test_a_new_session_resets_the_missed_ticks(watch):
    watch.skip(20)
    watch.reset(0.0)
    assert watch.missed_ticks_text == ""


@pytest.mark.parametrize(("readings", "checked"), [(90, False), (110, True)])
def test_a_sensor_is_checked_by_enough_readings_at_rest(readings, checked):
    sensor_monitor = SensorMonitor(("fx", "fy"), (True, True), 1000.0)
    for _ in range(readings):
        assert sensor_monitor.step((1.0, 2.0)) is None
    assert (sensor_monitor.finish_learning() is not None) == checked
    if not checked:
        assert not any(sensor_monitor.step((1.0, 2.0)) for _ in range(2000))
