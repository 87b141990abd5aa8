"""Pole placement and the discrete controller, against their transfer functions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rigd.control import ControlDesignError, ControlSettings, PidController, design_pid

SETTINGS = ControlSettings(
    pole_rad_s=80.0,
    feedforward_gain=1.0,
    friction_compensation_nm=0.0,
    friction_velocity_rad_s=2e-3,
)
GAINS = design_pid(2e-3, 0.02, 80.0)
RATE_HZ = 1000.0

inertias = st.floats(1e-5, 1.0)
friction_poles = st.floats(0.0, 200.0)  # B/J in rad/s
ratios = st.floats(0.3, 50.0)  # p over B/J


def feedback(gains, s):
    return (
        gains.kp_nm_per_rad
        + gains.ki_nm_per_rad_s / s
        + gains.kd_nm_s_per_rad * s / (1 + gains.filter_s * s)
    )


def reference_path(gains, s):
    return (
        gains.kp_nm_per_rad * gains.setpoint_weight_p
        + gains.ki_nm_per_rad_s / s
        + gains.kd_nm_s_per_rad * gains.setpoint_weight_d * s / (1 + gains.filter_s * s)
    )


@given(inertia=inertias, g=friction_poles, ratio=ratios)
@example(inertia=1.0, g=15.0, ratio=1 / 3)  # no derivative part at all
def test_reference_to_angle_is_the_double_pole(inertia, g, ratio):
    p = ratio * max(g, 1.0)
    gains = design_pid(inertia, g * inertia, p)
    assert gains.filter_s > 0
    assert gains.kp_nm_per_rad > 0
    s = p * np.array([0.1j, 1j, 0.3 + 2j, 7j, 2.0])
    motor = 1 / (inertia * s * (s + g))
    closed = motor * reference_path(gains, s) / (1 + motor * feedback(gains, s))
    np.testing.assert_allclose(closed, 1 / (1 + s / p) ** 2, rtol=1e-8)


@given(inertia=inertias, g=friction_poles, ratio=ratios)
@example(inertia=1.0, g=15.0, ratio=1 / 3)  # no derivative part at all
def test_all_four_poles_are_as_requested(inertia, g, ratio):
    p = ratio * max(g, 1.0)
    gains = design_pid(inertia, g * inertia, p)
    a3 = 1 / gains.filter_s
    controller = [
        gains.kp_nm_per_rad + gains.kd_nm_s_per_rad * a3,
        gains.kp_nm_per_rad * a3 + gains.ki_nm_per_rad_s,
        gains.ki_nm_per_rad_s * a3,
    ]
    plant = np.polymul([inertia, inertia * g, 0.0], [1.0, a3, 0.0])
    characteristic = np.polyadd(plant, controller) / inertia
    expected = p ** np.arange(5) * [1, 4, 6, 4, 1]
    np.testing.assert_allclose(characteristic, expected, rtol=1e-8)


@pytest.mark.parametrize("p", [1.0, 26.6])
def test_a_pole_too_slow_for_the_motor_is_refused(p):
    with pytest.raises(ControlDesignError, match=r"pole_rad_s.*rad/s.*choose more than 26\.67"):
        design_pid(1e-3, 0.1, p)  # g = 100 rad/s: 4 g/15 = 26.7


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (lambda k: (float(k == 0), 0.0, 0.0), reference_path),
        (lambda k: (0.0, float(k == 0), 0.0), lambda g, s: -feedback(g, s)),
        (lambda k: (0.0, 0.0, float(k == 0)), lambda g, s: 0.8 + 0 * s),
    ],
    ids=["reference", "angle", "coupling torque"],
)
def test_discrete_step_is_tustins_rule_on_the_pid(inputs, expected):
    settings = replace(SETTINGS, feedforward_gain=0.8)
    controller = PidController(GAINS, settings, RATE_HZ, math.inf)
    impulse = np.array([controller.step(*inputs(k)) for k in range(4000)])
    z = np.array([1.02, 1.05 + 0.1j, -1.1, 1.2j])  # outside the unit circle: the sum converges
    transform = (impulse * z[:, None] ** -np.arange(4000)).sum(axis=1)
    s = 2 * RATE_HZ * (z - 1) / (z + 1)
    np.testing.assert_allclose(transform, expected(GAINS, s), rtol=1e-9)


@given(angle=st.floats(-3, 3))
def test_bumpless_transfer(angle):
    settings = replace(SETTINGS, friction_compensation_nm=0.03)
    controller = PidController(GAINS, settings, RATE_HZ, 0.9)
    controller.step(0.5, -0.2, 0.1)
    controller.reset(angle)
    for _ in range(5):
        assert controller.step(angle, angle, 0.0) == pytest.approx(0.0, abs=1e-10)
    assert controller.friction_nm == pytest.approx(0.0, abs=1e-10)


def test_terms_add_up_to_the_torque():
    settings = replace(SETTINGS, friction_compensation_nm=0.03)
    controller = PidController(GAINS, settings, RATE_HZ, 5.0)
    controller.step(0.01, 0.0, 0.0)
    torque = controller.step(0.012, 0.001, 0.02)
    terms = (
        controller.proportional_nm
        + controller.integral_nm
        + controller.derivative_nm
        + controller.feedforward_nm
        + controller.friction_nm
    )
    assert torque == pytest.approx(terms, rel=1e-12)
    assert torque == controller.unlimited_torque_nm
    assert controller.feedforward_nm == pytest.approx(0.02)
    assert not controller.saturated


def test_friction_compensation_uses_the_filtered_speed():
    settings = replace(SETTINGS, friction_compensation_nm=0.03, friction_velocity_rad_s=0.1)
    controller = PidController(GAINS, settings, RATE_HZ, math.inf)
    p, speed = settings.pole_rad_s, 0.07
    for k in range(300):  # a ramp: its filtered speed is v (1 - (1 + p t) exp(-p t))
        controller.step(speed * k / RATE_HZ, 0.0, 0.0)
        t = k / RATE_HZ
        expected = speed * (1 - (1 + p * t) * math.exp(-p * t))
        assert controller.friction_nm == pytest.approx(0.03 * math.tanh(expected / 0.1), abs=2e-5)


@pytest.mark.parametrize("sign", [-1, 1])
def test_torque_is_limited_and_flagged(sign):
    controller = PidController(GAINS, SETTINGS, RATE_HZ, 0.9)
    assert controller.step(sign * 1.0, 0.0, 0.0) == sign * 0.9
    assert controller.saturated
    assert abs(controller.unlimited_torque_nm) > 0.9


def test_integral_does_not_wind_up_in_saturation():
    controller = PidController(GAINS, SETTINGS, RATE_HZ, 0.9)
    for _ in range(20_000):  # twenty seconds of an error that cannot be corrected
        controller.step(0.5, 0.0, 0.0)
    # Without back-calculation: Ki · 0.5 rad · 20 s = 2600 N·m.
    assert abs(controller.integral_nm) < GAINS.kp_nm_per_rad
    wait = next(k for k in range(1000) if controller.step(0.5, 0.5, 0.0) < 0.9)
    assert wait < 3 * GAINS.tracking_s * RATE_HZ
