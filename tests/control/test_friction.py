"""The loop with friction, encoder steps and noise: against the linear loop, and at rest."""

import numpy as np
import pytest

from rigd.control import Disturbances, close_loop, simulate_disturbed
from rigd.excitation.moves import quintic

NONE = Disturbances(coulomb_nm=0.0, encoder_step_rad=0.0, torque_noise_nm=0.0)
PATH = np.concatenate([[0.0], 0.3 * quintic(0.2, 1000.0), np.full(400, 0.3)])


@pytest.fixture(scope="module")
def loop(loop_model):
    return close_loop(loop_model)


def simulate(loop, disturbances, reference_rad=PATH, draws=3):
    return simulate_disturbed(loop, reference_rad, disturbances, mode_count=3, draw_count=draws)


def test_linear_loop_without_disturbance_and_compensation(loop):
    from dataclasses import replace

    settings = replace(loop.model.settings, friction_compensation_nm=0.0)
    linear = close_loop(replace(loop.model, settings=settings))
    found = simulate(linear, NONE, draws=1)
    assert found.angle_rad[:, 0] == pytest.approx(linear.simulate(PATH).angle_rad, abs=1e-10)
    assert found.mode_torque_nm.shape == (PATH.size, 3, 1)


def test_torque_rings_with_the_amplitudes_of_the_modes(loop):
    found = simulate(loop, NONE, draws=1)
    torque = loop.simulate(PATH).coupling_torque_nm[-380:]
    half_range = 0.5 * np.ptp(torque - np.linspace(torque[0], torque[-1], torque.size) * 0.0)
    amplitudes = found.mode_torque_nm[-380, :, 0]
    assert amplitudes[0] > 5 * amplitudes[1:].max()
    assert half_range == pytest.approx(amplitudes[0], rel=0.3)


def test_compensated_friction_leaves_less_vibration(loop):
    stated = loop.model.settings.friction_compensation_nm
    errors = []
    for coulomb_nm in (stated, 3 * stated):
        angle = simulate(loop, Disturbances(coulomb_nm, 0.0, 0.0), draws=1).angle_rad[:, 0]
        errors.append(np.abs(angle - loop.simulate(PATH).angle_rad).max())
    assert errors[0] < 0.3 * errors[1]


def test_friction_holds_a_motor_against_the_noise(loop):
    """At rest nothing moves; without friction the noise that is fed forward moves it."""
    at_rest = np.zeros(300)
    held = simulate(loop, Disturbances(0.03, 7e-5, 5e-3), at_rest)
    assert np.abs(held.angle_rad).max() < 1e-9
    free = simulate(loop, Disturbances(0.0, 7e-5, 5e-3), at_rest)
    assert np.abs(free.angle_rad[-1]).min() > 1e-7
    assert np.ptp(free.angle_rad[-1]) > 0.0


def test_the_same_seed_repeats_the_draws(loop):
    disturbances = Disturbances(0.03, 7e-5, 5e-3)
    one, same, other = (
        simulate_disturbed(
            loop, PATH[:120], disturbances, mode_count=1, draw_count=2, seed=seed
        ).angle_rad
        for seed in (1, 1, 2)
    )
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
