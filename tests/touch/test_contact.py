"""Time integration of contacts, and responses to contact forces."""

import numpy as np
import pytest

from rigd.touch._contact import (
    contact_responses,
    integrate_contact,
    integrate_two_contacts,
    shift_rows,
)

STEP_S = 1e-4


def spring_kernel(count, mass_kg=1e-3):
    """Return the displacement of a free mass per hat of force, which is integrated exactly."""
    t = np.arange(count) * STEP_S

    def cubic(delay):
        return np.maximum(t + delay, 0) ** 3 / 6

    return ((cubic(STEP_S) - 2 * cubic(0) + cubic(-STEP_S)) / STEP_S / mass_kg)[None, :]


def test_mass_leaves_spring_after_half_a_period():
    kernel = spring_kernel(400)
    speed, stiffness, mass = 1.0, 1000.0, 1e-3
    approach = speed * STEP_S * np.arange(400)[None, :]
    force = integrate_contact(kernel, approach, np.array([stiffness]), STEP_S)[0]
    omega = np.sqrt(stiffness / mass)
    assert force.max() == pytest.approx(speed * np.sqrt(stiffness * mass), rel=1e-3)
    last = np.flatnonzero(force)[-1] * STEP_S
    assert last == pytest.approx(np.pi / omega, abs=1.5 * STEP_S)
    # It leaves as fast as it came: the impulse is twice its momentum.
    assert force.sum() * STEP_S == pytest.approx(2 * mass * speed, rel=2e-3)


def test_force_on_moving_and_yielding_obstacles_is_smaller():
    kernel = np.repeat(spring_kernel(200), 2, axis=0)
    approach = np.repeat(STEP_S * np.arange(200)[None, :], 2, axis=0)
    stiffness = np.array([500.0, 500.0])
    resting, moving = integrate_contact(kernel, approach, stiffness, STEP_S, np.array([0.0, 0.5]))
    assert resting.min() == 0.0
    assert moving.max() == pytest.approx(0.5 * resting.max(), rel=1e-2)
    _, yielding = integrate_contact(kernel, approach, stiffness, STEP_S, 0.0, np.array([0.0, 5.0]))
    assert 0 < yielding.max() < resting.max()


def test_block_integration_equals_single_steps():
    """Obstacles at rest, moving and yielding, in blocks of steps with and without contact."""
    rng = np.random.default_rng(2)
    k, n = 5, 83
    kernel = np.abs(rng.normal(1e-3, 2e-4, (k, n)))
    approach = 2e-2 * np.sin(np.arange(n) * np.linspace(0.1, 0.4, k)[:, None])
    stiffness, rate, mobility = np.geomspace(30, 3e4, k), 2.0 * (np.arange(k) % 2), [0, 0, 0, 1, 2]
    computed = integrate_contact(kernel, approach, stiffness, STEP_S, rate, np.array(mobility))
    for row in range(k):
        force, obstacle_motion = np.zeros(n), 0.0
        stiffness_of_step = stiffness[row] / (
            1 + stiffness[row] * (kernel[row, 0] + mobility[row] * STEP_S)
        )
        for i in range(1, n):
            obstacle_motion += rate[row] * STEP_S
            deflection = sum(kernel[row, i - j] * force[j] for j in range(i))
            force[i] = stiffness_of_step * max(approach[row, i] - deflection - obstacle_motion, 0.0)
            obstacle_motion += mobility[row] * STEP_S * force[i]
        assert computed[row] == pytest.approx(force, abs=1e-12)
        assert np.any(force[1:] == 0)
        assert np.any(force > 0)


def test_two_contact_forces_satisfy_the_spring_law():
    """Blocks of steps include contact with no, either and both obstacles."""
    rng = np.random.default_rng(3)
    k, n = 4, 83
    lags = np.arange(n)
    own_kernels = [size * np.exp(-lags / 40.0) * np.ones((k, 1)) for size in (1e-3, 4e-4)]
    cross_kernel = 3e-4 * np.exp(-lags / 60.0) * np.array([[1.0], [-1.0], [0.0], [2.0]])
    approach = [np.cumsum(rng.normal(0.0, 1e-3, (k, n)), axis=1) for _ in own_kernels]
    for distances in approach:
        distances[:, 0] = 0.0
    stiffness = [np.geomspace(300.0, 30000.0, k), np.full(k, 800.0)]
    computed = integrate_two_contacts(
        tuple(own_kernels), cross_kernel, tuple(approach), tuple(stiffness)
    )
    pressing = np.array(computed) > 0
    assert all(np.any(np.all(pressing == [[[a]], [[b]]], axis=0)) for a in (0, 1) for b in (0, 1))
    for i in range(2):
        for row in range(k):
            deflection = np.convolve(own_kernels[i][row], computed[i][row])[:n]
            deflection += np.convolve(cross_kernel[row], computed[1 - i][row])[:n]
            expected = stiffness[i][row] * np.maximum(approach[i][row] - deflection, 0.0)
            assert computed[i][row][1:] == pytest.approx(expected[1:], abs=1e-9)
    single = integrate_contact(own_kernels[0], approach[0], stiffness[0], STEP_S)
    assert computed[0][2] == pytest.approx(single[2])


def test_responses_are_convolutions():
    rng = np.random.default_rng(1)
    kernels, force = rng.normal(size=(2, 3, 100)), rng.normal(size=(3, 121))
    computed = contact_responses(tuple(kernels), force, steps_per_sample=4, sample_count=31)
    for channel in range(2):
        for row in range(3):
            convolution = np.convolve(kernels[channel, row], force[row])[:121]
            assert computed[row, channel] == pytest.approx(convolution[::4])


def test_shifted_rows_are_exact_for_cubics():
    steps = np.arange(40.0)
    table = np.stack([steps**3, steps**2])
    computed = shift_rows(table, np.array([7.25, -3.5]), 20)
    assert computed[0] == pytest.approx((7.25 + np.arange(20)) ** 3)
    # Values are 0 before the first column.
    assert computed[1, :2] == pytest.approx([0.0, 0.0])
    assert computed[1, 5:] == pytest.approx((np.arange(5, 20) - 3.5) ** 2)
    assert shift_rows(table, np.array([37.5, 50.0]), 9)[1] == pytest.approx(39.0**2)
    # The same holds for columns far outside the table.
    assert shift_rows(table, np.array([1e7, -1e7]), 9) == pytest.approx(
        np.outer([39.0**3, 0.0], [1.0] * 9)
    )
