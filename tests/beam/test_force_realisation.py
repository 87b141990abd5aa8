"""Realisation of a force on the beam, and outputs computed from the states of a realisation."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from cases import further

from rigd.beam import (
    Beam,
    Damping,
    Plant,
    PointForceGrid,
    mode_shape,
    mode_shape_mean,
    realise_force,
)
from rigd.beam.realisation import RealisationError, realise, state_output

BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
DAMPINGS = {
    "undamped": Damping(),
    "integer": Damping(1.07e-3, 1.0, 0.02, 1.0),
    "paper": Damping(7.1e-5, 0.996, 0.055, 0.594),
    "half": Damping(1e-3, 0.5, 0.1, 0.3),
    "above one": Damping(7.1e-5, 1.3, 0.055, 0.594),
}
MOST = (1e-3, 1e-3, 1e-3, 0.01, 0.03)
OUTPUT_POSITIONS_M = np.array([0.1, 0.5, 0.97])


def response(realised, s):
    """Outputs per force, shape (s, outputs)."""
    poles, vectors = np.linalg.eig(realised.a)
    driven = np.linalg.solve(vectors, realised.b.astype(complex))
    return (driven / (s[:, None] - poles)) @ (
        realised.output_rows @ vectors
    ).T + realised.feedthrough


@pytest.mark.parametrize("highest_rad_s", [further(1e4), 1e5])
@pytest.mark.parametrize("at_m", [0.1, further(0.62), 0.97])
@pytest.mark.parametrize("damping", DAMPINGS.values(), ids=DAMPINGS)
def test_response_to_a_force_is_the_exact_one(damping, at_m, highest_rad_s):
    s = 1j * np.geomspace(0.1, 0.5 * highest_rad_s, 700)
    grid = PointForceGrid(s, BEAM, damping)
    exact = np.column_stack(
        [
            grid.displacement_per_force(OUTPUT_POSITIONS_M, np.full(3, at_m)),
            grid.torque_per_force(at_m),
            grid.shear_per_force(at_m),
        ]
    )
    realised = response(realise_force(BEAM, damping, at_m, OUTPUT_POSITIONS_M, highest_rad_s), s)
    # Displacement of a beam without ends: its size at a node.
    stiffness = 0.090275 * (1 + damping.zeta * s**damping.alpha)
    load = 4.7e-3 * s**2 + 0.090275 * damping.gamma * s**damping.lambda_
    unbounded = np.sqrt(1 / 8) / np.abs(load**0.75 * stiffness**0.25)
    size = np.abs(exact) + np.column_stack(
        [unbounded] * 3 + [np.full(700, 0.01), np.full(700, 0.05)]
    )
    error = (np.abs(realised - exact) / size).max(axis=0)
    assert (error < MOST).all(), error


def test_static_force_bends_the_beam_as_in_textbooks():
    at_m = 0.7
    realised = realise_force(BEAM, DAMPINGS["paper"], at_m, OUTPUT_POSITIONS_M, 1e4)
    static = realised.feedthrough - realised.output_rows @ np.linalg.solve(realised.a, realised.b)
    ei = BEAM.bending_stiffness_n_m2
    short, long = np.minimum(OUTPUT_POSITIONS_M, at_m), np.maximum(OUTPUT_POSITIONS_M, at_m)
    assert static[:3] == pytest.approx(short**2 * (3 * long - short) / (6 * ei), rel=2e-3)
    assert static[3:] == pytest.approx([-at_m, -1.0], rel=2e-3)


def test_an_order_that_is_too_high_is_refused_where_it_damps():
    with pytest.raises(RealisationError, match=r"order above 1\.5"):
        realise_force(BEAM, Damping(1e-4, 1.6), 0.3, np.array([0.3]), 1e4)
    realise_force(BEAM, Damping(1e-4, 1.0, 0.0, 1.6), 0.3, np.array([0.3]), 1e4)


@pytest.mark.parametrize("damping", DAMPINGS.values(), ids=DAMPINGS)
@pytest.mark.parametrize("x_m", [0.1, 0.7])
def test_displacement_as_output_of_the_states(damping, x_m):
    realisation = realise(Plant(BEAM, damping))
    output = state_output(
        realisation,
        lambda s: PointForceGrid(s, BEAM, damping).displacement_per_angle(x_m),
        has_inertial_term=False,
    )
    assert output.output_per_acceleration == 0
    assert (
        errors(realisation, output, damping, lambda grid: grid.displacement_per_angle(x_m)) < 2e-3
    )


@pytest.mark.parametrize("damping", DAMPINGS.values(), ids=DAMPINGS)
def test_shear_as_output_of_the_states(damping):
    realisation = realise(Plant(BEAM, damping))
    output = state_output(
        realisation,
        lambda s: PointForceGrid(s, BEAM, damping).shear_per_angle(),
        has_inertial_term=True,
    )
    assert errors(realisation, output, damping, lambda grid: grid.shear_per_angle()) < 2e-3


def with_output(realisation, output):
    """Replace the torque of the realisation by another output."""
    return replace(
        realisation,
        c=output.c,
        direct_inertia_kg_m2=output.output_per_acceleration,
        direct_viscosity_nm_s_per_rad=output.output_per_velocity,
        direct_stiffness_nm_per_rad=output.output_per_angle,
    )


def errors(realisation, output, damping, response_of):
    s = 2j * pi * np.geomspace(0.05, 400, 2000)
    exact = response_of(PointForceGrid(s, BEAM, damping))
    realised = with_output(realisation, output).transfer(s)
    return (np.abs(realised - exact) / np.abs(exact)).max()


@pytest.mark.parametrize("at_m", [0.2, 0.62, 0.97])
def test_torque_of_a_force_is_the_displacement_of_an_angle(at_m):
    damping = DAMPINGS["paper"]
    s = 2j * pi * np.geomspace(0.05, 300, 1000)
    realisation = realise(Plant(BEAM, damping))
    output = state_output(
        realisation,
        lambda s: PointForceGrid(s, BEAM, damping).displacement_per_angle(at_m),
        has_inertial_term=False,
    )
    displacement = with_output(realisation, output).transfer(s)
    torque = response(realise_force(BEAM, damping, at_m, np.array([at_m]), 1e4), s)[:, -2]
    assert (np.abs(torque + displacement) / (np.abs(displacement) + 0.01 * at_m)).max() < 2e-3


def test_mean_of_the_mode_shapes():
    x = np.linspace(0, 1, 20001)
    means = [np.trapezoid(mode_shape(number, x), x) for number in range(1, 9)]
    assert mode_shape_mean(8) == pytest.approx(means, abs=1e-6)
