"""Motor with beam as one linear model, and its step."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm as scipy_expm

from rigd.beam import Beam, Damping, Plant
from rigd.beam.realisation import couple, propagator, realise

BEAM = Beam(0.98, 4.7e-3, 0.090275)
REALISATION = realise(Plant(BEAM, Damping(7.1e-5, 0.996, 0.055, 0.594)))
MOTOR = {"motor_inertia_kg_m2": 2e-3, "viscous_nm_s_per_rad": 0.02}


def frequency_response(model, row, direct, s):
    identity = np.eye(model.b.size)
    return np.array([row @ np.linalg.solve(x * identity - model.a, model.b) + direct for x in s])


@pytest.mark.parametrize("tool_inertia", [0.0, 1e-5])
@pytest.mark.parametrize("realisation", [None, REALISATION])
def test_rows_are_the_mechanics_of_motor_clamp_and_beam(realisation, tool_inertia):
    model = couple(realisation, **MOTOR, tool_inertia_kg_m2=tool_inertia)
    s = 2j * np.pi * np.geomspace(0.05, 200, 25)
    g = 0 if realisation is None else realisation.transfer(s)
    angle = 1 / ((2e-3 + tool_inertia) * s**2 + 0.02 * s + g)
    for row, direct, expected in (
        (model.angle_output_row, 0, angle),
        (model.velocity_output_row, 0, s * angle),
        (model.acceleration_output_row, model.acceleration_per_torque, s**2 * angle),
        (model.beam_torque_output_row, model.beam_torque_per_torque, g * angle),
        (
            model.sensor_torque_output_row,
            model.sensor_torque_per_torque,
            (g + tool_inertia * s**2) * angle,
        ),
    ):
        found = frequency_response(model, row, direct, s)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-15)


def test_motor_alone_follows_the_textbook():
    model = couple(None, **MOTOR)
    phi, gamma = propagator(model, 0.05)
    tau = 2e-3 / 0.02
    decay = np.exp(-0.05 / tau)
    np.testing.assert_allclose(phi, [[1, tau * (1 - decay)], [0, decay]], rtol=1e-13)
    np.testing.assert_allclose(
        gamma, [(0.05 - tau * (1 - decay)) / 0.02, (1 - decay) / 0.02], rtol=1e-12
    )


@pytest.mark.parametrize("duration_s", [0.0, 1e-6, 1e-4, 1e-3, 0.1])
def test_propagator_against_scipy(duration_s):
    model = couple(REALISATION, **MOTOR, tool_inertia_kg_m2=1e-5)
    n = model.b.size
    extended = np.zeros((n + 1, n + 1))
    extended[:n, :n], extended[:n, n] = model.a, model.b
    exact = scipy_expm(extended * duration_s)
    phi, gamma = propagator(model, duration_s)
    assert np.max(np.abs(phi - exact[:n, :n])) < 1e-12 * np.max(np.abs(exact))
    assert np.max(np.abs(gamma - exact[:n, n])) < 1e-12 * np.max(np.abs(exact[:n, n]) + 1e-300)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [1e-8, 0.1, 1.0, 5.0, 40.0])
def test_a_step_of_any_size_against_scipy(scale, seed):
    matrix = scale * np.random.default_rng(seed).standard_normal((12, 12)) / np.sqrt(12)
    exact = scipy_expm(matrix)
    phi, _ = propagator(replace(couple(REALISATION, **MOTOR), a=matrix, b=np.zeros(12)), 1.0)
    assert np.max(np.abs(phi - exact)) < 1e-12 * max(1.0, scale) * np.max(np.abs(exact))


def test_two_half_steps_are_one_step():
    model = couple(REALISATION, **MOTOR)
    phi, gamma = propagator(model, 1e-3)
    half_phi, half_gamma = propagator(model, 5e-4)
    np.testing.assert_allclose(half_phi @ half_phi, phi, atol=1e-12 * np.abs(phi).max())
    np.testing.assert_allclose(half_phi @ half_gamma + half_gamma, gamma, rtol=1e-9, atol=1e-12)
