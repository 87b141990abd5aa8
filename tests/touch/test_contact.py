"""The march of the contact, and what it makes of forces."""

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
    """Displacement of a free mass per hat of force: what a march must integrate exactly."""
    t = np.arange(count) * STEP_S

    def cubic(late):
        return np.maximum(t + late, 0) ** 3 / 6

    return ((cubic(STEP_S) - 2 * cubic(0) + cubic(-STEP_S)) / STEP_S / mass_kg)[None, :]


def test_a_mass_bounces_off_a_spring_in_half_a_period():
    kernel = spring_kernel(400)
    speed, stiffness, mass = 1.0, 1000.0, 1e-3
    approach = speed * STEP_S * np.arange(400)[None, :]
    force = integrate_contact(kernel, approach, np.array([stiffness]), STEP_S)[0]
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
    still, fleeing = integrate_contact(kernel, approach, stiffness, STEP_S, np.array([0.0, 0.5]))
    assert still.min() == 0.0
    assert fleeing.max() == pytest.approx(0.5 * still.max(), rel=1e-2)
    _, giving = integrate_contact(kernel, approach, stiffness, STEP_S, 0.0, np.array([0.0, 5.0]))
    assert 0 < giving.max() < still.max()


def test_a_march_is_the_same_step_by_step():
    """Obstacles that stay, flee and give way, over blocks of steps with and without contact."""
    rng = np.random.default_rng(2)
    k, n = 5, 83
    kernel = np.abs(rng.normal(1e-3, 2e-4, (k, n)))
    approach = 2e-2 * np.sin(np.arange(n) * np.linspace(0.1, 0.4, k)[:, None])
    stiffness, rate, mobility = np.geomspace(30, 3e4, k), 2.0 * (np.arange(k) % 2), [0, 0, 0, 1, 2]
    told = integrate_contact(kernel, approach, stiffness, STEP_S, rate, np.array(mobility))
    for row in range(k):
        force, fled = np.zeros(n), 0.0
        gives = stiffness[row] / (1 + stiffness[row] * (kernel[row, 0] + mobility[row] * STEP_S))
        for i in range(1, n):
            fled += rate[row] * STEP_S
            bent = sum(kernel[row, i - j] * force[j] for j in range(i))
            force[i] = gives * max(approach[row, i] - bent - fled, 0.0)
            fled += mobility[row] * STEP_S * force[i]
        assert told[row] == pytest.approx(force, abs=1e-12)
        assert np.any(force[1:] == 0)
        assert np.any(force > 0)


def test_two_obstacles_press_as_springs_on_what_both_forces_bend():
    """Over blocks of steps in which none, either and both are in contact."""
    rng = np.random.default_rng(3)
    k, n = 4, 83
    lags = np.arange(n)
    own = [size * np.exp(-lags / 40.0) * np.ones((k, 1)) for size in (1e-3, 4e-4)]
    cross = 3e-4 * np.exp(-lags / 60.0) * np.array([[1.0], [-1.0], [0.0], [2.0]])
    approach = [np.cumsum(rng.normal(0.0, 1e-3, (k, n)), axis=1) for _ in own]
    for each in approach:
        each[:, 0] = 0.0
    stiffness = [np.geomspace(300.0, 30000.0, k), np.full(k, 800.0)]
    told = integrate_two_contacts(tuple(own), cross, tuple(approach), tuple(stiffness))
    pressing = np.array(told) > 0
    assert all(np.any(np.all(pressing == [[[a]], [[b]]], axis=0)) for a in (0, 1) for b in (0, 1))
    for i in range(2):
        for row in range(k):
            bent = np.convolve(own[i][row], told[i][row])[:n]
            bent += np.convolve(cross[row], told[1 - i][row])[:n]
            wanted = stiffness[i][row] * np.maximum(approach[i][row] - bent, 0.0)
            assert told[i][row][1:] == pytest.approx(wanted[1:], abs=1e-9)
    alone = integrate_contact(own[0], approach[0], stiffness[0], STEP_S)
    assert told[0][2] == pytest.approx(alone[2])


def test_responses_are_convolutions():
    rng = np.random.default_rng(1)
    kernels, force = rng.normal(size=(2, 3, 100)), rng.normal(size=(3, 121))
    told = contact_responses(tuple(kernels), force, steps_per_sample=4, sample_count=31)
    for channel in range(2):
        for row in range(3):
            whole = np.convolve(kernels[channel, row], force[row])[:121]
            assert told[row, channel] == pytest.approx(whole[::4])


def test_shifted_values_lie_on_the_curve():
    steps = np.arange(40.0)
    table = np.stack([steps**3, steps**2])
    told = shift_rows(table, np.array([7.25, -3.5]), 20)
    assert told[0] == pytest.approx((7.25 + np.arange(20)) ** 3)
    # It is 0 before its first column.
    assert told[1, :2] == pytest.approx([0.0, 0.0])
    assert told[1, 5:] == pytest.approx((np.arange(5, 20) - 3.5) ** 2)
    assert shift_rows(table, np.array([37.5, 50.0]), 9)[1] == pytest.approx(39.0**2)
    # However far off it is asked for.
    assert shift_rows(table, np.array([1e7, -1e7]), 9) == pytest.approx(
        np.outer([39.0**3, 0.0], [1.0] * 9)
    )
