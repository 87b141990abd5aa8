"""Margins against closed forms, and against loops that are beyond them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import further
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rigd.beam import Damping
from rigd.control import close_loop, loop_margins

MAX_DELAY_PERIODS = 50
"""Longest delay of a computed closed loop."""
DELAY_OF = {
    "torque command": "actuation_delay_s",
    "angle reading": "angle_delay_s",
    "torque reading": "torque_delay_s",
}


def slower(model):
    """A loop with a fraction of a period in every delay."""
    return replace(model, actuation_delay_s=1.3e-3, angle_delay_s=0.6e-3, torque_delay_s=1.7e-3)


def radius_with_gain(loop, opening, factor):
    opened = loop.a - np.outer(opening.action_column, opening.reading_row)
    changed = opened + factor * np.outer(opening.action_column, opening.reading_row)
    return np.max(np.abs(np.linalg.eigvals(changed)))


def test_the_motor_alone_has_the_margins_of_the_designed_loop(motor_alone):
    """Sampled so fast that the loop is the continuous one, whose 1 + L is known in closed form."""
    model = replace(motor_alone, rate_hz=200_000.0)
    p, g = model.settings.pole_rad_s, model.viscous_nm_s_per_rad / model.motor_inertia_kg_m2
    a3 = 4 * p - g
    omega = np.geomspace(1.0, 2e4, 200_001)
    s = 1j * omega
    gain = (s + p) ** 4 / (s**2 * (s + a3) * (s + g)) - 1
    unity = np.flatnonzero(np.diff(np.sign(np.abs(gain) - 1)))
    assert unity.size == 1
    phase_rad = math.pi + np.angle(gain[unity[0]])
    # L = (a2 s² + a1 s + a0)/(s² (s + a3)(s + g)) is real at one frequency only.
    a2, a1, a0 = 6 * p**2 - 4 * p * g + g**2, 4 * p**3, p**4
    real_at = math.sqrt((a0 * (a3 + g) - a1 * a3 * g) / (a2 * (a3 + g) - a1))
    lowest = -1 / np.interp(real_at, omega, gain.real)

    loop = close_loop(model)
    command, angle, torque = loop_margins(loop)
    for margins in (command, angle):
        assert margins.phase_rad == pytest.approx(phase_rad, rel=2e-3)
        assert margins.delay_s == pytest.approx(phase_rad / omega[unity[0]], rel=2e-3)
        assert margins.modulus == pytest.approx(np.min(np.abs(1 + gain)), rel=2e-3)
        assert margins.gain_down == pytest.approx(lowest, rel=2e-3)
        assert 2 * math.pi * margins.gain_down_hz == pytest.approx(real_at, rel=2e-3)
    # No feed-forward without a beam.
    assert (torque.gain_up, torque.gain_down, torque.delay_s) == (math.inf, 0.0, math.inf)
    assert torque.modulus == pytest.approx(1.0)
    assert math.isnan(torque.delay_hz)


def open_loop_gain(loop, opening, phase_rad):
    """Gain of the loop opened at a cut, for each angle on the unit circle."""
    opened = loop.a - np.outer(opening.action_column, opening.reading_row)
    z = np.exp(1j * np.asarray(phase_rad))[:, np.newaxis, np.newaxis]
    return (
        -np.linalg.solve(z * np.eye(len(opened)) - opened, opening.action_column[:, np.newaxis])[
            ..., 0
        ]
        @ opening.reading_row
    )


def test_no_feed_forward_without_torque_reading(loop_model):
    loop = close_loop(slower(loop_model))
    torque = loop.openings[2]
    unfed = replace(loop.model, settings=replace(loop.model.settings, feedforward_gain=0.0))
    opened = loop.a - np.outer(torque.action_column, torque.reading_row)
    np.testing.assert_allclose(opened, close_loop(unfed).a, atol=1e-12)


def test_the_command_carries_both_readings(loop_model):
    """Cut at the command, or at both readings: the same poles are left, those of the plant."""
    loop = close_loop(slower(loop_model))
    command, angle, torque = (
        np.outer(opening.action_column, opening.reading_row) for opening in loop.openings
    )
    one, both = (
        np.sort(np.abs(np.linalg.eigvals(opened)))[-20:]
        for opened in (loop.a - command, loop.a - angle - torque)
    )
    np.testing.assert_allclose(one, both, atol=1e-4)


@pytest.mark.parametrize("pole_rad_s", [further(40.0), 80.0, further(100.0)])
@pytest.mark.parametrize(
    "change", [further(lambda model: model, id="sim"), pytest.param(slower, id="slower")]
)
def test_a_gain_or_delay_beyond_its_margin_is_unstable(loop_model, change, pole_rad_s):
    model = change(loop_model)
    model = replace(model, settings=replace(model.settings, pole_rad_s=pole_rad_s))
    loop = close_loop(model)
    compared = set()
    for opening, margins in zip(loop.openings, loop_margins(loop), strict=True):
        assert margins.opening == opening.name
        assert radius_with_gain(loop, opening, 0.98 * margins.gain_up) < 1
        assert radius_with_gain(loop, opening, 1.02 * margins.gain_up) > 1
        if margins.gain_down > 0:
            assert radius_with_gain(loop, opening, 1.02 * margins.gain_down) < 1
            assert radius_with_gain(loop, opening, 0.98 * margins.gain_down) > 1
        key = DELAY_OF[opening.name]
        stated = getattr(model, key)
        if (stated + 1.02 * margins.delay_s) * model.rate_hz < MAX_DELAY_PERIODS:
            compared.add(opening.name)
            for part, stable in ((0.98, True), (1.02, False)):
                late = close_loop(replace(model, **{key: stated + part * margins.delay_s}))
                assert (late.spectral_radius < 1) is stable
    assert {"torque command", "angle reading"} <= compared


def test_phase_margin_is_taken_either_way(loop_model):
    """At the limit the gain, turned by the margin one way or the other, is -1."""
    loop = close_loop(loop_model)
    for opening, margins in zip(loop.openings, loop_margins(loop), strict=True):
        at = np.array([2 * np.pi * margins.phase_hz / loop.model.rate_hz])
        gain = open_loop_gain(loop, opening, at)[0]
        turned = gain * np.exp(1j * np.array([-1, 1]) * margins.phase_rad)
        assert np.min(np.abs(turned + 1)) < 1e-6


def test_no_grid_frequency_is_nearer_to_minus_one(loop_model):
    """Sharp resonances are not stepped over: those of a beam with next to no damping."""
    light = replace(loop_model, plant=replace(loop_model.plant, damping=Damping(zeta=1e-5)))
    grid = 2 * np.pi * np.concatenate([np.linspace(2.5, 2.6, 801), np.linspace(15.8, 16.2, 801)])
    loop = close_loop(light)
    for opening, margins in zip(loop.openings, loop_margins(loop), strict=True):
        distance = np.abs(1 + open_loop_gain(loop, opening, grid / light.rate_hz))
        assert margins.modulus <= 1.001 * np.min(distance)


@pytest.mark.further  # and beyond them none
@settings(max_examples=6)
@given(
    pole_rad_s=st.floats(50.0, 110.0),
    feedforward=st.floats(0.85, 1.1),
    actuation_ms=st.floats(0.0, 2.0),
    torque_ms=st.floats(0.0, 3.0),
    part=st.floats(0.01, 0.99),
)
def test_every_loop_is_stable_between_its_gain_margins(
    loop_model, pole_rad_s, feedforward, actuation_ms, torque_ms, part
):
    model = replace(
        loop_model,
        actuation_delay_s=actuation_ms * 1e-3,
        torque_delay_s=torque_ms * 1e-3,
        settings=replace(loop_model.settings, pole_rad_s=pole_rad_s, feedforward_gain=feedforward),
    )
    loop = close_loop(model)
    assume(loop.spectral_radius < 1)
    for opening, margins in zip(loop.openings, loop_margins(loop), strict=True):
        assert margins.gain_down < 1 < margins.gain_up
        low, high = max(margins.gain_down, 1e-2), min(margins.gain_up, 50.0)
        assert radius_with_gain(loop, opening, low * (high / low) ** part) < 1 + 1e-9


def test_margins_of_the_shipped_simulation(loop_model):
    """As documented: the feed-forward tolerates a third more gain, the loop the usual 2."""
    command, angle, torque = loop_margins(close_loop(loop_model))
    assert command.gain_up == pytest.approx(1.42, abs=0.02)
    assert command.delay_s == pytest.approx(4.0e-3, abs=0.1e-3)
    assert angle.gain_up == pytest.approx(5.14, abs=0.05)
    assert math.degrees(angle.phase_rad) == pytest.approx(27.8, abs=0.5)
    assert torque.gain_up == pytest.approx(1.33, abs=0.02)
