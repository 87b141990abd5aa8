"""The beam's shape against the boundary value problem in closed form."""

import numpy as np
import pytest
from cases import further

from rigd.beam import (
    Beam,
    Damping,
    DeflectionFilter,
    mode_shape,
    transfer,
    undamped_frequencies_rad_s,
)

BEAM = Beam(0.98, 4.7e-3, 0.090275)
LENGTH_M = BEAM.length_m
RATE_HZ = 1000.0
TIME_S = 200.0  # except for the undamped beam, all vibration has decayed by then

# Table 3 of the paper, one of each type, and its best fits.
DAMPINGS = {
    "I omega": Damping(10.75e-4),
    "II const": Damping(gamma=0.197),
    "III omega": Damping(0.54e-4, 1.0, 0.02),
    "IV omega": Damping(24.45e-4, 0.679),
    "V const": Damping(gamma=0.046, lambda_=1.247),
    "VI const": Damping(0.09e-4, 1.362, 0.225, 0.616),
    "VI omega": Damping(0.71e-4, 0.996, 0.055, 0.594),
}


def exact(frequency_hz: float, damping: Damping, x_m: np.ndarray, beam: Beam = BEAM) -> np.ndarray:
    """Complex deflection per angle: EI (1 + zeta s^alpha) y'''' + (rho s² + c_v s^lambda) y = 0.

    It solves for y with its four boundary conditions: y = 0 and y' = 1 at the motor, no bending
    moment and no shear force at the tip.
    """
    s = 2j * np.pi * frequency_hz
    stiffness = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    drag = damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    wave = (-(beam.density_kg_per_m * s**2 + drag) / stiffness) ** 0.25
    end = wave * beam.length_m
    conditions = [
        [1, 0, 1, 0],
        [0, wave, 0, wave],
        [-np.cos(end), -np.sin(end), np.cosh(end), np.sinh(end)],
        [np.sin(end), -np.cos(end), np.sinh(end), np.cosh(end)],
    ]
    factors = np.linalg.solve(conditions, [0, 1, 0, 0])
    x = wave * x_m
    return factors @ [np.cos(x), np.sin(x), np.cosh(x), np.sinh(x)] - x_m


def deflection_after(
    bends: DeflectionFilter, angle_rad: np.ndarray, longest_block: int = 2000
) -> np.ndarray:
    """Feed in blocks of 1 … `longest_block` samples; return the last result."""
    random = np.random.default_rng(5)
    start = 0
    while start < angle_rad.size:
        end = start + int(random.integers(1, longest_block + 1))
        deflection_m = bends.feed(angle_rad[start:end])
        start = end
    return deflection_m


def response(
    frequency_hz: float, damping: Damping, beam: Beam = BEAM, rate_hz: float = RATE_HZ, **options
) -> np.ndarray:
    """Complex deflection per angle of the filter, once a sinusoid has lasted for long."""
    phase = 2 * np.pi * frequency_hz * np.arange(int(TIME_S * rate_hz)) / rate_hz
    parts = [
        deflection_after(DeflectionFilter(beam, damping, rate_hz, **options), 0.025 * wave(phase))
        for wave in (np.cos, np.sin)
    ]
    return (parts[0] + 1j * parts[1]) * np.exp(-1j * phase[-1]) / 0.025


def x_m(points: int = 41) -> np.ndarray:
    return np.linspace(0, LENGTH_M, points)


@pytest.mark.parametrize("frequency_hz", [0.5, 2.6, 20.0])
def test_reference_of_these_tests_is_eq_25(frequency_hz):
    """Torque is stiffness times curvature at the motor."""
    damping = DAMPINGS["VI omega"]
    s = 2j * np.pi * frequency_hz
    near_m = 1e-3 * np.arange(1, 4)
    # Clamped there: the deflection begins with the second power.
    powers = np.linalg.solve(near_m[:, None] ** [2, 3, 4], exact(frequency_hz, damping, near_m))
    curvature = 2 * powers[0]
    stiffness = BEAM.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    assert -stiffness * curvature == pytest.approx(transfer([s], BEAM, damping)[0], rel=1e-4)


@pytest.mark.parametrize("damping", DAMPINGS.values(), ids=DAMPINGS)
@pytest.mark.parametrize(
    "frequency_hz", [2.5537, 30.0, *map(further, (0.3, 1.0, 9.0, 16.002, 44.81, 49.0))]
)
def test_shape_is_that_of_the_boundary_value_problem(damping, frequency_hz):
    shape = response(frequency_hz, damping)
    truth = exact(frequency_hz, damping, x_m())
    # Amplitude and phase, all along the beam.
    assert np.abs(shape - truth).max() < 1e-3 * np.abs(truth).max()


@pytest.mark.parametrize("number", [1, 2, 3])
def test_deflection_at_resonance_is_the_mode_shape(number):
    damping = Damping(gamma=0.005)
    frequency_hz = undamped_frequencies_rad_s(BEAM, number)[-1] / (2 * np.pi)
    shape = response(frequency_hz, damping)
    mode = mode_shape(number, x_m() / LENGTH_M)
    # A quarter of a period behind the angle; the part in phase with it is of the other modes.
    np.testing.assert_allclose(shape.imag / shape.imag[-1], mode / mode[-1], atol=2e-3)
    assert abs(shape.imag[-1]) > 20 * np.abs(shape.real).max()


@pytest.mark.parametrize("beam_length_m", [0.5, 2.0])
def test_other_beams_and_rates(beam_length_m):
    beam = Beam(beam_length_m, 0.02, 0.3)
    damping = Damping(2e-4, 0.9, 0.05, 0.7)
    for frequency_hz in (0.5, 7.0, 21.0):
        shape = response(frequency_hz, damping, beam, rate_hz=400.0, modes=6)
        truth = exact(frequency_hz, damping, np.linspace(0, beam_length_m, 41), beam)
        assert np.abs(shape - truth).max() < 5e-3 * np.abs(truth).max()


def test_omitted_modes_contribute_at_low_frequency():
    """All other modes are in the shape of the last one; the first mode alone is not enough."""
    damping = DAMPINGS["VI omega"]
    truth = exact(5.0, damping, x_m())
    assert np.abs(response(5.0, damping, modes=1) - truth).max() < 2e-3 * np.abs(truth).max()
    mode = mode_shape(1, x_m() / LENGTH_M)
    alone = mode * (mode @ truth) / (mode @ mode)
    assert np.abs(alone - truth).max() > 1e-2 * np.abs(truth).max()


def test_a_beam_too_stiff_for_the_sampling_rate_is_drawn_straight():
    stiff = Beam(0.1, 4.7e-3, 10.0)
    assert undamped_frequencies_rad_s(stiff, 1)[0] > np.pi * RATE_HZ
    bends = DeflectionFilter(stiff, Damping(1e-5, 0.9), RATE_HZ)
    assert np.all(bends.feed(np.linspace(0, 1, 100)) == 0)


def test_a_beam_whose_higher_modes_have_no_poles():
    damping = Damping(0.0050729, 0.95614, 0.28743, 1.65535)
    beam = Beam(LENGTH_M, 4.7e-3, 0.046769)
    truth = exact(3.0, damping, x_m(), beam)
    assert np.abs(response(3.0, damping, beam) - truth).max() < 5e-3 * np.abs(truth).max()


def test_over_damped_modes():
    damping = Damping(zeta=0.01)
    truth = exact(20.0, damping, x_m())
    assert np.abs(response(20.0, damping) - truth).max() < 1e-2 * np.abs(truth).max()


def test_positive_acceleration_bends_the_tip_backwards():
    """And by as much as the distributed inertial load bends a cantilever."""
    acceleration = 0.2
    time_s = np.arange(100) / RATE_HZ
    bends = DeflectionFilter(BEAM, DAMPINGS["I omega"], RATE_HZ)
    assert bends.feed(0.5 * acceleration * time_s**2)[-1] < 0
    # From a negative speed to none: the acceleration is all there is in the end.
    time_s = np.arange(-150 * RATE_HZ, 1) / RATE_HZ
    bends = DeflectionFilter(BEAM, DAMPINGS["I omega"], RATE_HZ)
    deflection_m = deflection_after(bends, 0.5 * acceleration * time_s**2)
    x = x_m() / LENGTH_M
    load = BEAM.density_kg_per_m * acceleration * LENGTH_M**5 / BEAM.bending_stiffness_n_m2
    static_m = -load * (20 * x**2 - 10 * x**3 + x**5) / 120
    np.testing.assert_allclose(deflection_m, static_m, atol=2e-3 * abs(static_m[-1]))


@pytest.mark.parametrize("damping", [DAMPINGS["I omega"], DAMPINGS["II const"]])
def test_steady_rotation_bends_the_beam_by_drag_only(damping):
    speed = 0.2
    angle_rad = speed * np.arange(100_000) / RATE_HZ
    deflection_m = deflection_after(DeflectionFilter(BEAM, damping, RATE_HZ), angle_rad)
    x = x_m() / LENGTH_M
    drag_m = -damping.gamma * speed * LENGTH_M**5 * (20 * x**2 - 10 * x**3 + x**5) / 120
    np.testing.assert_allclose(deflection_m, drag_m, atol=1e-5 * speed * LENGTH_M)


def test_constant_angle_does_not_bend_the_beam():
    bends = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ)
    assert np.all(deflection_after(bends, np.full(5000, 1.234)) == 0)
    swing = 0.1 * np.sin(np.arange(3000) / 50)
    here = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ).feed(swing)
    there = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ).feed(swing - 2.5)
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-9)


@pytest.mark.parametrize("damping", [Damping(), DAMPINGS["IV omega"]])
def test_blocks_make_no_difference(damping):
    angle_rad = 0.02 * np.random.default_rng(2).standard_normal(7000)
    whole = DeflectionFilter(BEAM, damping, RATE_HZ).feed(angle_rad)
    for longest_block in (1, 3, 300, 2000):
        bends = DeflectionFilter(BEAM, damping, RATE_HZ)
        parts = deflection_after(bends, angle_rad, longest_block)
        np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-11)


def test_the_steps_of_the_encoder_are_not_magnified():
    resolution_rad = 7e-5
    time_s = np.arange(20_000) / RATE_HZ
    angle_rad = 0.025 * np.sin(2 * np.pi * (0.5 + 0.4 * time_s) * time_s)
    steps_rad = resolution_rad * np.round(angle_rad / resolution_rad)
    smooth = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ)
    coarse = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ)
    errors_m = [
        coarse.feed(steps_rad[i : i + 50])[-1] - smooth.feed(angle_rad[i : i + 50])[-1]
        for i in range(0, time_s.size, 50)
    ]
    assert np.std(errors_m) < 1.5 * resolution_rad / np.sqrt(12) * LENGTH_M


def test_clamp_does_not_move():
    bends = DeflectionFilter(BEAM, DAMPINGS["VI omega"], RATE_HZ, points=11)
    np.testing.assert_allclose(bends.x_m, x_m(11))
    deflection_m = bends.feed(0.1 * np.sin(np.arange(2000) / 9))
    assert deflection_m.shape == (11,)
    assert deflection_m[0] == pytest.approx(0, abs=1e-15)
    assert np.abs(deflection_m[-1]) > 1e-3
