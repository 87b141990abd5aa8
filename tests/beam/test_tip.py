"""The free end: closed form against the modes, and its motion in the paper's chirp."""

import numpy as np
import pytest

from rigd.beam import Beam, Damping, DeflectionFilter, Plant, clamped_free_eigenvalues, mode_shape
from rigd.beam.tip import tip_motion

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
    # The part of the modes after the fortieth grows with the square of the frequency.
    displacement, _ = Plant(BEAM, damping).tip_response(s)
    assert np.abs(displacement + BEAM.length_m - total).max() < 1e-3


@pytest.mark.parametrize("damping", [Damping(), VI])
def test_displacement_and_slope_solve_the_boundary_value_problem(damping):
    s = 0.05 + 2j * np.pi * np.geomspace(0.05, 200, 100)
    inertial = BEAM.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    elastic = 1 + damping.zeta * s**damping.alpha
    found = []
    for wave_number in (-inertial / elastic) ** 0.25:
        roots = wave_number * np.array([1, 1j, -1, -1j])
        # Growing waves are normalised to their value at the tip.
        at_root = np.exp(-np.maximum(roots.real, 0) * BEAM.length_m)
        at_tip = np.exp(roots * BEAM.length_m) * at_root
        matrix = np.array([at_root, roots * at_root, roots**2 * at_tip, roots**3 * at_tip])
        scale = np.abs(matrix).max(axis=1)
        waves = np.linalg.solve(matrix / scale[:, None], np.array([0, 1, 0, 0]) / scale) * at_tip
        found.append((waves.sum(), (roots * waves).sum()))
    displacement, slope = Plant(BEAM, damping).tip_response(s)
    displacement, slope = displacement + BEAM.length_m, slope + 1
    assert displacement == pytest.approx(np.array(found)[:, 0], rel=1e-9)
    assert slope == pytest.approx(np.array(found)[:, 1], rel=1e-9)


def test_constant_angle_turns_the_tip_without_bending():
    displacement, slope = Plant(BEAM, Damping()).tip_response(np.array([1e-3 + 0j]))
    assert displacement[0] == pytest.approx(0.0, abs=1e-6)
    assert slope[0] == pytest.approx(0.0, abs=1e-6)


def test_angle_that_stays_at_its_end_excites_nothing():
    """A slow turn to 20 mrad, held to the last sample."""
    rate_hz = 1000.0
    x = np.clip(np.arange(6000) / (2 * rate_hz), 0, 1)
    angle = 0.02 * (10 * x**3 - 15 * x**4 + 6 * x**5)
    rigid_m_s = BEAM.length_m * rate_hz * np.diff(angle).max()
    assert tip_motion(Plant(BEAM, VI), angle, rate_hz).speed_m_s == pytest.approx(
        rigid_m_s, rel=0.05
    )


@pytest.mark.parametrize(
    ("frequency_hz", "slope_per_deflection"), [(2.5536, 1.3765), (16.003, 4.781)]
)
def test_equal_deflection_slopes_more_in_higher_modes(frequency_hz, slope_per_deflection):
    """Modes of the clamped beam; the tip's slope over its deflection relative to the length."""
    t = np.arange(8000) / 1000.0
    angle = 1e-3 * np.minimum(t, 1) * np.sin(2 * np.pi * frequency_hz * t)
    motion = tip_motion(Plant(BEAM, VI), angle, 1000.0)
    relative_deflection = motion.deflection_m / BEAM.length_m
    assert motion.slope_rad == pytest.approx(slope_per_deflection * relative_deflection, rel=0.02)


def test_largest_deflection_is_that_of_the_true_shape():
    rate_hz = 1000.0
    t = np.arange(12_000) / rate_hz
    angle = 0.025 * np.sin(2 * np.pi * (0.05 + 0.21 * t) * t)
    followed = DeflectionFilter(BEAM, VI, rate_hz)
    ends = [followed.feed(angle[i : i + 5])[-1] for i in range(0, t.size, 5)]
    motion = tip_motion(Plant(BEAM, VI), angle, rate_hz)
    assert motion.deflection_m == pytest.approx(np.abs(ends).max(), rel=5e-3)
    speed = np.gradient(np.array(ends) + BEAM.length_m * angle[4::5], 5 / rate_hz)
    assert motion.speed_m_s == pytest.approx(np.abs(speed).max(), rel=1e-2)


def test_a_tip_mass_and_a_clamp_are_in_the_motion_of_the_tip():
    """A slow turn: the mass bends the beam by its own inertia, and the clamp yields."""
    t = np.arange(4000) / 1000.0
    angle_rad = 0.05 * np.sin(2 * np.pi * 0.2 * t) * np.minimum(t, 1.0) ** 2
    free = tip_motion(Plant(BEAM, VI), angle_rad, 1000.0)
    same = tip_motion(Plant(BEAM, VI, tip_mass_kg=1e-12), angle_rad, 1000.0)
    assert same.deflection_m == pytest.approx(free.deflection_m, rel=1e-3)
    assert same.speed_m_s == pytest.approx(free.speed_m_s, rel=1e-3)
    heavy = tip_motion(Plant(BEAM, VI, tip_mass_kg=1e-3), angle_rad, 1000.0)
    assert heavy.slope_rad > 1.3 * free.slope_rad
    soft = tip_motion(Plant(BEAM, VI, root_compliance_rad_per_nm=0.5), angle_rad, 1000.0)
    assert soft.slope_rad == pytest.approx(free.slope_rad, rel=0.3)
    assert soft.speed_m_s == pytest.approx(free.speed_m_s, rel=0.1)


def test_motion_of_a_long_record_is_that_of_its_largest_part():
    """The sweep passes mode 1 late in the record, whose chunks are computed one by one."""
    t = np.arange(60_000) / 1000.0
    sweep_rad = 0.02 * np.sin(2 * np.pi * (1.0 + 0.02 * t) * t)
    sweep_rad[:5000] *= np.sin(0.5 * np.pi * t[:5000] / 5) ** 2
    long_rad = np.zeros(1_500_000)
    long_rad[700_000:760_000] = sweep_rad  # across the first two chunks
    long_rad[760_000:] = sweep_rad[-1]
    plant = Plant(BEAM, VI)
    alone, within = tip_motion(plant, sweep_rad, 1000.0), tip_motion(plant, long_rad, 1000.0)
    for quantity in ("deflection_m", "slope_rad", "speed_m_s"):
        assert getattr(within, quantity) == pytest.approx(getattr(alone, quantity), rel=1e-3)
