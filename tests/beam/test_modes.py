"""Eigenvalues, shapes, participation and poles against their equations and the exact model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.beam import (
    Beam,
    Damping,
    clamped_free_eigenvalues,
    mode_shape,
    modes,
    participation,
    poles,
    transfer,
    undamped_frequencies_rad_s,
)

PAPER_BEAM = Beam(0.98, 4.7e-3, 0.090275)


def test_eigenvalues_against_the_tables():
    """R. D. Blevins, Formulas for Natural Frequency and Mode Shape, Table 8-1."""
    table = [1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839]
    np.testing.assert_allclose(clamped_free_eigenvalues(5), table, rtol=3e-9)


def test_eigenvalues_solve_their_equation_to_the_last_digits():
    z = clamped_free_eigenvalues(200)
    residual = np.cos(z) + 2 * np.exp(-z) / (1 + np.exp(-2 * z))
    assert np.all(np.abs(residual) <= 2 * np.spacing(z))
    assert np.all(np.diff(z) > 2.8)


def test_participation_adds_up_to_the_rigid_beam():
    n = 3000
    rest = 4 / (3 * np.pi**4 * n**3)  # of the sum of 4 / z⁴, by its integral
    total = participation(PAPER_BEAM, n).sum() / PAPER_BEAM.length_m**3
    assert total + rest == pytest.approx(1 / 3, rel=1e-13)


@pytest.mark.parametrize("number", [1, 2, 3, 10, 60])
def test_mode_shape(number):
    x, weight = np.polynomial.legendre.leggauss(400)
    x, weight = 0.5 * (x + 1), 0.5 * weight
    shape = mode_shape(number, x)
    z = clamped_free_eigenvalues(number)[-1]
    assert np.sum(weight * shape**2) == pytest.approx(1, abs=1e-11)
    # The participation is the fraction of a rigid rotation in the shape.
    fraction = np.sum(weight * x * shape) ** 2 * PAPER_BEAM.length_m**3
    assert fraction == pytest.approx(participation(PAPER_BEAM, number)[-1], rel=1e-7)
    np.testing.assert_allclose(mode_shape(number, [0.0, 1.0]), [0.0, 2.0], atol=1e-12)
    # Clamped: neither deflection nor slope.
    near = 1e-4 / z
    assert mode_shape(number, near) == pytest.approx(0, abs=1e-7)
    # The shape solves w'''' = z⁴ w: fourth differences.
    h = 0.02 / z
    points = np.linspace(0.2, 0.8, 7)[:, None] + h * np.arange(-3, 4)
    fourth = mode_shape(number, points) @ np.array([-1, 12, -39, 56, -39, 12, -1]) / 6 / h**4
    np.testing.assert_allclose(fourth, z**4 * mode_shape(number, points[:, 3]), atol=1e-5 * z**4)


def test_high_modes_stay_orthogonal():
    x, weight = np.polynomial.legendre.leggauss(800)
    x, weight = 0.5 * (x + 1), 0.5 * weight
    shapes = np.array([mode_shape(number, x) for number in (1, 2, 40, 41, 80)])
    np.testing.assert_allclose((shapes * weight) @ shapes.T, np.eye(5), atol=1e-11)


def test_paper_beam():
    frequencies = [mode.natural_frequency_rad_s for mode in modes(PAPER_BEAM, Damping(), 3)]
    np.testing.assert_allclose(frequencies, [16.045, 100.55, 281.55], rtol=2e-5)
    np.testing.assert_allclose(undamped_frequencies_rad_s(PAPER_BEAM, 3), frequencies, rtol=1e-14)
    assert [mode.damping_ratio for mode in modes(PAPER_BEAM, Damping(), 3)] == [0, 0, 0]


def test_modes_are_consistent_with_their_poles():
    for mode in modes(PAPER_BEAM, Damping(1.075e-3), 8):
        first, second = mode.poles_rad_s
        omega, ratio = mode.natural_frequency_rad_s, mode.damping_ratio
        for pole in (first, second):
            assert abs(pole**2 + 2 * ratio * omega * pole + omega**2) < 1e-12 * abs(pole) ** 2
        assert mode.frequency_hz == pytest.approx(abs(first.imag) / (2 * np.pi))


def test_over_damped_modes_have_two_real_poles():
    """Type I of Table 3 with omega weights: real poles above about 1/(pi zeta) = 300 Hz."""
    zeta = 1.075e-3
    found = poles(PAPER_BEAM, Damping(zeta), 12)
    omega = (clamped_free_eigenvalues(12) / 0.98) ** 2 / np.sqrt(PAPER_BEAM.density_over_stiffness)
    over_damped = omega > 2 / zeta
    assert 0 < over_damped.sum() < 12
    assert np.all((found.imag == 0).all(axis=1) == over_damped)
    np.testing.assert_allclose((found[:, 0] * found[:, 1]).real, omega**2, rtol=1e-12)
    np.testing.assert_allclose(-found.sum(axis=1).real, zeta * omega**2, rtol=1e-12)
    # Each is where Eq. 25 has a pole: 1/G vanishes.
    for pole in found[over_damped].ravel():
        step = 1e-6 * pole
        around = transfer(np.array([pole + step, pole - step]), PAPER_BEAM, Damping(zeta))
        assert around[0] == pytest.approx(-around[1], rel=1e-2)


dampings = st.builds(
    Damping,
    zeta=st.floats(1e-7, 1e-2),
    alpha=st.floats(0.1, 0.95) | st.just(1.0) | st.floats(1.05, 1.9),
    gamma=st.floats(1e-4, 0.5),
    lambda_=st.floats(0.1, 0.95) | st.just(1.0) | st.floats(1.05, 1.9),
)


@given(damping=dampings, length=st.floats(0.3, 2.0))
def test_poles_solve_the_characteristic_equation(damping, length):
    beam = Beam(length, 4.7e-3, 0.090275)
    mixed = (damping.alpha - 1) * (damping.lambda_ - 1) < 0
    try:
        found = poles(beam, damping, 12)
    except ArithmeticError:
        assert mixed, "a pole pair must exist unless one order is above 1 and the other below"
        return
    assert np.all(found.real < 0)
    s = found[:, 0]
    beta4 = (clamped_free_eigenvalues(12) / length) ** 4
    terms = np.array([
        beam.density_over_stiffness * s**2,
        damping.gamma * s**damping.lambda_,
        beta4 * damping.zeta * s**damping.alpha,
        beta4 + 0 * s,
    ])  # fmt: skip
    assert np.all(np.abs(terms.sum(axis=0)) < 1e-8 * np.abs(terms).sum(axis=0))


def test_modal_sum_is_the_transfer_function():
    damping = Damping(7.1e-5, 0.996, 0.055, 0.594)
    beam = PAPER_BEAM
    s = 1j * np.geomspace(0.1, 400, 60)
    z = clamped_free_eigenvalues(4000)[:, None]
    p = (
        beam.density_kg_per_m * s**2
        + damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    )
    q = (
        beam.bending_stiffness_n_m2
        * (1 + damping.zeta * s**damping.alpha)
        * (z / beam.length_m) ** 4
    )
    total = np.sum(participation(beam, 4000)[:, None] * p * q / (q + p), axis=0)
    np.testing.assert_allclose(total, transfer(s, beam, damping), rtol=1e-7)
