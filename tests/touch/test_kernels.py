"""Contact kernels compared with closed forms and modal sums, with and without sensor filters."""

from math import pi, sqrt

import numpy as np
import pytest
from touch_records import DAMPED, LINK

from rigd.beam import Damping, PointForceGrid, clamped_free_eigenvalues, mode_shape
from rigd.touch import SensorFilter
from rigd.touch._kernels import (
    ForcePulse,
    beam_positions,
    chebyshev_nodes,
    contact_kernels,
    cross_kernels,
    cubic_weights,
)

STEP_S = 1 / 8000
KERNEL_NAMES = ("displacement_m_per_n", "torque_nm_per_n", "shear_per_n")


@pytest.fixture(scope="module")
def kernels():
    return contact_kernels(LINK, DAMPED, beam_positions(LINK.length_m, 0.007), STEP_S, 400)


@pytest.fixture(scope="module")
def at_point():
    return contact_kernels(LINK, DAMPED, np.array([0.62]), STEP_S, 400)


def ramp_response(poles, t):
    """Inverse Laplace transform of ``1 / (s² (s - p) (s - q))``."""
    p, q = poles
    t = np.maximum(t, 0)
    slow = t / (p * q) + (p + q) / (p * q) ** 2
    return (slow + np.exp(p * t) / (p**2 * (p - q)) + np.exp(q * t) / (q**2 * (q - p))).real


def test_displacement_is_the_sum_of_the_modes(at_point):
    count = 60
    z = clamped_free_eigenvalues(count)
    shape = np.array([float(mode_shape(i + 1, 0.62 / LINK.length_m)) for i in range(count)])
    stiffness = (z / LINK.length_m) ** 4 / LINK.density_over_stiffness
    drag = DAMPED.gamma / LINK.density_over_stiffness + DAMPED.zeta * stiffness
    t = np.arange(400) * STEP_S
    total = np.zeros(400)
    for i in range(count):
        poles = np.roots([1, drag[i], stiffness[i]]).astype(complex)
        hat = sum(
            weight * ramp_response(poles, t + shift) * (t + shift > 0)
            for weight, shift in ((1, STEP_S), (-2, 0), (1, -STEP_S))
        )
        total += shape[i] ** 2 / (LINK.density_kg_per_m * LINK.length_m) * hat / STEP_S
    assert np.abs(total - at_point.displacement_m_per_n[0]).max() < 3e-4 * np.abs(total).max()


def test_cross_kernels_match_exact_model():
    x, other = np.array([0.1, 0.3, 0.8]), np.array([0.25, 0.62, 0.7])
    crossing = cross_kernels(LINK, DAMPED, beam_positions(LINK.length_m, 0.007), 2 * STEP_S, 400)
    computed = crossing.between_positions(x, other, 300)
    hat = ForcePulse(2 * STEP_S, 400)
    exact = hat.kernels(
        PointForceGrid(hat.transform.s, LINK, DAMPED).displacement_per_force(x, other).T
    )
    assert computed == pytest.approx(exact[:, :300], abs=1e-3 * np.abs(exact).max())
    assert crossing.between_positions(other, x, 300) == pytest.approx(computed)


def test_constant_force_has_static_response():
    damped = Damping(zeta=0.02, alpha=1.0)
    kernels = contact_kernels(LINK, damped, np.array([0.4]), 2.5e-4, 16000)
    static = {name: getattr(kernels, name)[0].sum() for name in KERNEL_NAMES}
    assert static["shear_per_n"] == pytest.approx(-1.0, abs=2e-3)
    assert static["torque_nm_per_n"] == pytest.approx(-0.4, abs=2e-3)
    compliance = 0.4**3 / (3 * LINK.bending_stiffness_n_m2)
    assert static["displacement_m_per_n"] == pytest.approx(compliance, rel=5e-3)


def test_interpolated_kernels_match_exact_ones(kernels, at_point):
    between = kernels.at_positions(np.array([0.62]), 400)
    for name in KERNEL_NAMES:
        exact = getattr(at_point, name)
        assert np.abs(getattr(between, name) - exact).max() < 1e-4 * np.abs(exact).max()


def test_wider_hats_are_sums_of_narrow_ones(at_point):
    wide = contact_kernels(LINK, DAMPED, np.array([0.62]), 4 * STEP_S, 90)
    summed = at_point.with_wider_pulses(4, 90)
    for name in KERNEL_NAMES:
        exact = getattr(wide, name)
        assert np.abs(getattr(summed, name) - exact).max() < 2e-4 * np.abs(exact).max()


def test_cubic_interpolation_is_exact_for_cubics():
    grid = np.linspace(0.1, 0.9, 9)
    at = np.array([0.1, 0.23, 0.5, 0.88, 0.9])
    first, weights = cubic_weights(at, grid)
    values = sum(weights[:, i] * (grid[first + i] ** 3 - grid[first + i]) for i in range(4))
    assert values == pytest.approx(at**3 - at)


def test_chebyshev_interpolation_of_a_wave():
    """At 1 kHz this beam has at most six waves along its length."""
    x_m = beam_positions(LINK.length_m, 0.007)
    nodes, between = chebyshev_nodes(x_m, 36)
    at_positions, at_nodes = (np.exp(12j * np.pi * x / LINK.length_m) for x in (x_m, nodes))
    assert np.abs(between @ at_nodes - at_positions).max() < 1e-7
    assert x_m[0] < nodes.min() < nodes.max() < x_m[-1]


# With filters of the sensor


def test_averaged_kernels_are_means_of_delayed_ones(at_point):
    mean = SensorFilter(weights=(0.25,) * 4, spacing_s=2 * STEP_S)
    filtered = contact_kernels(LINK, DAMPED, np.array([0.62]), STEP_S, 400, mean)
    for name in ("torque_nm_per_n", "shear_per_n"):
        unfiltered = getattr(at_point, name)[0]
        delayed = [np.concatenate([np.zeros(2 * i), unfiltered[: 400 - 2 * i]]) for i in range(4)]
        assert getattr(filtered, name)[0] == pytest.approx(
            np.mean(delayed, axis=0), abs=2e-3 * np.abs(unfiltered).max()
        )
    # The filter does not act on the displacement.
    assert np.array_equal(filtered.displacement_m_per_n, at_point.displacement_m_per_n)
    assert mean.weights_delay_s == 3 * STEP_S


@pytest.mark.parametrize("order", [1, 2])
def test_low_pass_filter_matches_scipy(at_point, order):
    corner = 2 * pi * 150.0
    low_pass = SensorFilter(corner_hz=150.0, order=order)
    filtered = contact_kernels(LINK, DAMPED, np.array([0.62]), STEP_S, 400, low_pass)
    u = np.array([1 / corner, 1.0])
    from scipy.signal import TransferFunction, lsim  # half a second for every worker

    system = TransferFunction([1.0], u if order == 1 else [u[0] ** 2, sqrt(2) * u[0], 1.0])
    _, computed, _ = lsim(system, at_point.shear_per_n[0], np.arange(400) * STEP_S)
    assert filtered.shear_per_n[0] == pytest.approx(computed, abs=1e-2 * np.abs(computed).max())
    assert abs(low_pass.response(1j * corner)) == pytest.approx(sqrt(0.5))
