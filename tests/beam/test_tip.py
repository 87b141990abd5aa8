"""The free end: closed form against the modes, and what the paper's chirp does with it."""

import numpy as np
import pytest

from rigd.beam import (
    Beam,
    Damping,
    DeflectionFilter,
    clamped_free_eigenvalues,
    mode_shape,
    tip_motion,
    tip_response,
)

BEAM = Beam(0.98, 4.7e-3, 0.090275)
VI = Damping(0.71e-4, 0.996, 0.055, 0.594)


@pytest.mark.parametrize("damping", [Damping(), VI, Damping(0.09e-4, 1.362, 0.225, 0.616)])
def test_the_closed_form_is_the_sum_of_the_modes(damping):
    s = 0.05 + 2j * np.pi * np.geomspace(0.05, 200, 300)
    inertial = BEAM.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    elastic = 1 + damping.zeta * s**damping.alpha
    total = np.full(s.size, BEAM.length_m, dtype=complex)
    for i, z in enumerate(clamped_free_eigenvalues(40)):
        load = elastic * (z / BEAM.length_m) ** 4
        leverage = 2 * BEAM.length_m * (-1.0) ** i / z**2
        total -= leverage * float(mode_shape(i + 1, 1.0)) * inertial / (load + inertial)
    # What the modes after the fortieth add grows with the square of the frequency.
    assert np.abs(tip_response(BEAM, damping, s) - total).max() < 1e-3


def test_a_standing_angle_turns_the_tip_and_does_not_bend_it():
    near_rest = tip_response(BEAM, Damping(), np.array([1e-3 + 0j]))[0]
    assert near_rest == pytest.approx(BEAM.length_m, rel=1e-6)


def test_the_largest_deflection_is_that_of_the_shape_as_it_happens():
    rate_hz = 1000.0
    t = np.arange(12_000) / rate_hz
    angle = 0.025 * np.sin(2 * np.pi * (0.05 + 0.21 * t) * t)
    followed = DeflectionFilter(BEAM, VI, rate_hz)
    ends = [followed.feed(angle[i : i + 5])[-1] for i in range(0, t.size, 5)]
    motion = tip_motion(BEAM, VI, angle, rate_hz)
    assert motion.deflection_m == pytest.approx(np.abs(ends).max(), rel=5e-3)
    speed = np.gradient(np.array(ends) + BEAM.length_m * angle[4::5], 5 / rate_hz)
    assert motion.speed_m_s == pytest.approx(np.abs(speed).max(), rel=1e-2)
