"""Gauges: peaks of a block with their limits."""

import numpy as np
import pytest

from rigd.gauges import Gauge, Gauges
from rigd.session.layout import Status


def test_peaks_are_shown_with_limits_and_units(make_samples):
    samples = make_samples(
        100, angle_rad=-0.02, angle_reference_rad=0.01, torque_command_nm=0.3, fz_n=-4.0, ty_nm=0.5
    )
    limits = {"angle": 1.0, "tracking_error": 0.5, "i2t": np.inf, "fz": 66.0}
    found = Gauges(1000.0, limits).gauges_of_block(samples)
    assert found["angle"] == Gauge(0.02, 1.0, "rad")
    assert found["tracking_error"].fraction == pytest.approx(0.06)
    assert found["velocity"] == Gauge(0.0, None, "rad/s")
    assert found["torque_command"].value == pytest.approx(0.3)
    assert found["fz"].fraction == pytest.approx(4.0 / 66.0)
    assert (found["ty"].unit, found["fx"].unit) == ("N·m", "N")
    # A motor whose rating is not known has no limit.
    assert found["i2t"].limit is None


def test_speed_bridges_missed_and_stale_ticks(make_samples):
    samples = make_samples(200, angle_rad=np.arange(200) * 1e-3)  # 1 rad/s
    samples["angle_rad"][50] = samples["angle_rad"][49]
    samples["status"][50] = Status.ANGLE_STALE
    gauges = Gauges(1000.0, {})
    speeds = [
        gauges.gauges_of_block(part)["velocity"].value
        for part in (samples[:100], samples[140:], samples[:0])
    ]
    assert speeds[:2] == pytest.approx([1.0, 1.0])
    assert speeds[2] is None


def test_rms_torque_follows_the_motor_time_constant(make_samples):
    gauges = Gauges(1000.0, {"i2t": 0.9}, thermal_time_constant_s=2.0)
    for _ in range(20):
        found = gauges.gauges_of_block(make_samples(100, torque_command_nm=0.6))
    assert found["i2t"].value == pytest.approx(0.6 * np.sqrt(1.0 - np.exp(-1.0)), rel=0.03)


def test_nonnumeric_values_are_not_shown(make_samples):
    found = Gauges(1000.0, {"angle": 1.0}).gauges_of_block(make_samples(5, angle_rad=np.nan))
    assert found["angle"].value is None
    assert found["angle"].fraction is None
