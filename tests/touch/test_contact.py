"""The march of the contact, and what it makes of forces."""

import numpy as np
import pytest

from rigd.touch._contact import march, responses

STEP_S = 1e-4


def spring_kernel(count, mass_kg=1e-3):
    """Displacement of a free mass per hat of force: what a march must integrate exactly."""
    t = np.arange(count) * STEP_S

    def cubic(late):
        return np.maximum(t + late, 0) ** 3 / 6

    return ((cubic(STEP_S) - 2 * cubic(0) + cubic(-STEP_S)) / STEP_S / mass_kg)[None, :]


def test_a_mass_bounces_off_a_spring_in_half_a_period():
    kernel = spring_kernel(400)
    speed, stiffness, mass = 1.0, 1000.0, 1e-3
    approach = speed * STEP_S * np.arange(400)[None, :]
    force = march(kernel, approach, np.array([stiffness]), STEP_S)[0]
    omega = np.sqrt(stiffness / mass)
    assert force.max() == pytest.approx(speed * np.sqrt(stiffness * mass), rel=1e-3)
    last = np.flatnonzero(force)[-1] * STEP_S
    assert last == pytest.approx(np.pi / omega, abs=1.5 * STEP_S)
    # It goes back as fast as it came: twice its momentum has been taken.
    assert force.sum() * STEP_S == pytest.approx(2 * mass * speed, rel=2e-3)


def test_force_never_pulls_and_obstacles_that_flee_press_less():
    kernel = np.repeat(spring_kernel(200), 2, axis=0)
    approach = np.repeat(STEP_S * np.arange(200)[None, :], 2, axis=0)
    stiffness = np.array([500.0, 500.0])
    still, fleeing = march(kernel, approach, stiffness, STEP_S, np.array([0.0, 0.5]))
    assert still.min() == 0.0
    assert fleeing.max() == pytest.approx(0.5 * still.max(), rel=1e-2)
    _, giving = march(kernel, approach, stiffness, STEP_S, 0.0, np.array([0.0, 5.0]))
    assert 0 < giving.max() < still.max()


def test_responses_are_convolutions():
    rng = np.random.default_rng(1)
    kernel, force = rng.normal(size=(2, 3, 50))
    (told,) = responses((kernel,), force)
    for row in range(3):
        assert told[row] == pytest.approx(np.convolve(kernel[row], force[row])[:50])
