"""Beam turned at its root and pushed at a point."""

from math import pi

import numpy as np
import pytest

from rigd.beam import Beam, Damping, PointForceGrid, transfer

BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
FRACTIONAL = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
HALF = Damping(zeta=1e-3, alpha=0.5, gamma=0.1, lambda_=0.3)
POSITIONS_M = np.array([0.05, 0.3, 0.62, 0.98])

S = {
    "axis": 2j * pi * np.geomspace(1e-3, 3e3, 801),
    "shifted": 4.0 + 2j * pi * np.linspace(-200, 200, 801),
    "real": np.geomspace(1e-2, 1e4, 101).astype(complex),
}


def stiffness_and_load(s, damping):
    ei = BEAM.bending_stiffness_n_m2
    load = BEAM.density_kg_per_m * s**2 + ei * damping.gamma * s**damping.lambda_
    return ei * (1 + damping.zeta * s**damping.alpha), load


@pytest.mark.parametrize("line", S)
@pytest.mark.parametrize("damping", [FRACTIONAL, HALF])
def test_torque_without_force_is_that_of_eq_25(line, damping):
    grid = PointForceGrid(S[line], BEAM, damping)
    exact = transfer(S[line], BEAM, damping)
    assert np.abs(grid.torque_per_angle() / exact - 1).max() < 1e-12


@pytest.mark.parametrize("line", S)
@pytest.mark.parametrize("damping", [FRACTIONAL, HALF])
def test_torque_of_a_force_is_the_displacement_of_an_angle(line, damping):
    grid = PointForceGrid(S[line], BEAM, damping)
    displacement = grid.displacement_per_angle(POSITIONS_M)
    assert np.abs(grid.torque_per_force(POSITIONS_M) / displacement + 1).max() < 1e-12


def test_forces_and_displacements_are_reciprocal():
    grid = PointForceGrid(S["axis"], BEAM, FRACTIONAL)
    there = grid.displacement_per_force(POSITIONS_M[:, None], POSITIONS_M)
    assert there.shape == (801, 4, 4)
    size = np.sqrt(np.abs(np.einsum("sii,sjj->sij", there, there)))
    assert (np.abs(there - there.swapaxes(1, 2)) / size).max() < 1e-10


@pytest.mark.parametrize("at_m", [0.05, 0.4, 0.98])
def test_balance_of_forces_and_moments(at_m):
    # Integrals over the beam (Gauss and Legendre on either side of the force) against the root's.
    s = 2j * pi * np.geomspace(0.05, 300, 60)
    grid = PointForceGrid(s, BEAM, HALF)
    node, weight = np.polynomial.legendre.leggauss(60)
    ends = [(0.0, at_m), (at_m, BEAM.length_m)]
    x = np.concatenate([a + (b - a) * (node + 1) / 2 for a, b in ends])
    w = np.concatenate([(b - a) * weight / 2 for a, b in ends])
    _, load = stiffness_and_load(s, HALF)
    turned, pushed = grid.displacement_per_angle(x), grid.displacement_per_force(x, at_m)
    assert load * (turned @ w) == pytest.approx(grid.shear_per_angle(), rel=1e-9)
    assert load * (turned @ (w * x)) == pytest.approx(grid.torque_per_angle(), rel=1e-9)
    assert load * (pushed @ w) == pytest.approx(grid.shear_per_force(at_m) + 1, rel=1e-8, abs=1e-9)
    assert load * (pushed @ (w * x)) == pytest.approx(
        grid.torque_per_force(at_m) + at_m, rel=1e-8, abs=1e-9
    )


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_along_the_beam(order):
    grid = PointForceGrid(2j * pi * np.array([0.1, 2.0, 40.0, 400.0]), BEAM, FRACTIONAL)
    x, h = np.array([0.1, 0.33, 0.8]), 1e-5

    def differences(derivative):
        return (derivative(x + h, order - 1) - derivative(x - h, order - 1)) / (2 * h)

    assert grid.displacement_per_angle(x, order) == pytest.approx(
        differences(grid.displacement_per_angle), rel=1e-5
    )

    def pushed(x, order):
        return grid.displacement_per_force(x, 0.5, order)

    assert pushed(x, order) == pytest.approx(differences(pushed), rel=1e-5)


def test_series_and_waves_meet():
    q = 40 * (1 + np.array([-1e-9, 1e-9]))
    s = 1j * np.sqrt(q / (BEAM.density_over_stiffness * BEAM.length_m**4))
    grid = PointForceGrid(s, BEAM, Damping())
    for curve in (
        grid.displacement_per_angle(POSITIONS_M),
        grid.displacement_per_force(POSITIONS_M, 0.5),
    ):
        assert curve[0] == pytest.approx(curve[1], rel=1e-6)


def test_static_deflection():
    grid = PointForceGrid([0.0], BEAM, FRACTIONAL)
    ei = BEAM.bending_stiffness_n_m2
    assert grid.displacement_per_force(POSITIONS_M, POSITIONS_M)[0] == pytest.approx(
        POSITIONS_M**3 / (3 * ei)
    )
    assert grid.displacement_per_angle(POSITIONS_M)[0] == pytest.approx(POSITIONS_M)
    assert grid.torque_per_force(POSITIONS_M)[0] == pytest.approx(-POSITIONS_M)
    assert grid.shear_per_force(POSITIONS_M)[0] == pytest.approx(-1.0)


def test_rigid_obstacle_at_tip_gives_pinned_frequencies():
    for z in (3.926602, 7.068583, 10.210176):
        omega = (z * (1 + np.array([-1e-5, 1e-5])) / BEAM.length_m) ** 2
        s = 1j * omega / np.sqrt(BEAM.density_over_stiffness)
        grid, tip = PointForceGrid(s, BEAM, Damping()), BEAM.length_m
        force = -grid.displacement_per_angle(tip) / grid.displacement_per_force(tip, tip)
        assert force[0].real * force[1].real < 0  # passes through infinity
        assert np.abs(force).min() > 1e3


def test_shapes():
    grid = PointForceGrid(np.full((2, 3), 5j), BEAM, FRACTIONAL)
    assert grid.torque_per_angle().shape == (2, 3)
    assert grid.displacement_per_angle(POSITIONS_M).shape == (2, 3, 4)
    assert grid.displacement_per_force(0.2, 0.5).shape == (2, 3)
    assert grid.displacement_per_force(POSITIONS_M, POSITIONS_M).shape == (2, 3, 4)


def test_single_point():
    grid = PointForceGrid(5j, BEAM, FRACTIONAL)
    assert grid.torque_per_angle() == pytest.approx(transfer(5j, BEAM, FRACTIONAL))
    assert grid.displacement_per_force(0.2, 0.5).shape == ()
