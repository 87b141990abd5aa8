"""Optional parts of a simulated rig, against the exact response to its own angle."""

from dataclasses import replace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.beam import Plant, PointForceGrid
from rigd.sim import SimulatedPlant

TICKS = 12_000
RATE_HZ = 1000.0


@pytest.fixture(scope="module")
def rig():
    rig = load_shipped("sim").rig
    return replace(rig, motor=replace(rig.motor, coulomb_nm=0.0))


def driven(rig, **more):
    """Sensed angle, torque and shear while the motor's torque sweeps to 30 Hz."""
    t = np.arange(TICKS) / RATE_HZ
    sweep = np.sin(2 * np.pi * (0.5 * t + 29.5 * t**2 / (2 * t[-1])))
    torques = (0.2 * np.hanning(TICKS) * sweep).tolist()
    plant = SimulatedPlant(replace(rig, simulation=replace(rig.simulation, **more)))
    plant.enable()
    found = np.empty((3, TICKS))
    for tick, torque in enumerate(torques):
        found[:, tick] = plant.sensed_angle_rad, plant.sensed_torque_nm, plant.sensed_shear_n
        plant.command(torque)
        plant.advance()
    return found


def low_pass(s, hertz, order):
    x = s / (2 * np.pi * hertz)
    return 1 / (1 + x) if order == 1 else 1 / (1 + 2**0.5 * x + x**2)


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"density_ratio": 0.8, "stiffness_ratio": 1.2},
        {"clamp_compliance_rad_per_nm": 0.02},
        {"tip_mass_kg": 2e-4},
        {"torque_filter_hz": 80.0},
        {"torque_filter_hz": 80.0, "torque_filter_order": 2},
    ],
    ids=lambda more: " ".join(more) or "nothing",
)
def test_torque_and_shear_are_those_of_the_exact_response(rig, more):
    angle, torque, shear = driven(rig, **more)
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    own = replace(
        rig.beam,
        density_kg_per_m=more.get("density_ratio", 1.0) * rig.beam.density_kg_per_m,
        bending_stiffness_n_m2=more.get("stiffness_ratio", 1.0) * rig.beam.bending_stiffness_n_m2,
    )
    beam = Plant(
        own,
        rig.damping,
        tip_mass_kg=more.get("tip_mass_kg", 0.0),
        root_compliance_rad_per_nm=more.get("clamp_compliance_rad_per_nm", 0.0),
    )
    seen = np.fft.rfft(angle * decay, 4 * TICKS)
    if "torque_filter_hz" in more:
        seen *= low_pass(s, more["torque_filter_hz"], more.get("torque_filter_order", 1))
    for sensed, response in ((torque, beam.transfer(s)), (shear, beam.shear_response(s))):
        exact = np.fft.irfft(seen * response, 4 * TICKS)[:TICKS]
        difference = (sensed - exact / decay)[: TICKS * 9 // 10]
        assert np.std(difference) < 3e-4 * np.std(sensed)


def test_shear_accelerates_the_beam_and_its_tip_mass(rig):
    # Integral over the beam, and not a derivative at its root.
    s = 2j * np.pi * np.geomspace(0.1, 100, 50)
    mass_kg, compliance = 3e-4, 0.02
    node, weight = np.polynomial.legendre.leggauss(80)
    length = rig.beam.length_m
    x = length * (node + 1) / 2
    grid = PointForceGrid(s, rig.beam, rig.damping)
    load = rig.beam.bending_stiffness_n_m2 * rig.damping.gamma * s**rig.damping.lambda_
    load += rig.beam.density_kg_per_m * s**2
    tip = grid.displacement_per_angle(length) / (
        1 + mass_kg * s**2 * grid.displacement_per_force(length, length)
    )
    pushed = grid.displacement_per_force(x, length) * (-mass_kg * s**2 * tip)[:, None]
    momentum = (
        load * ((grid.displacement_per_angle(x) + pushed) @ weight) * length / 2
        + mass_kg * s**2 * tip
    )
    clamped = Plant(rig.beam, rig.damping, tip_mass_kg=mass_kg)
    assert clamped.shear_response(s) == pytest.approx(momentum, rel=1e-9)
    soft = replace(clamped, root_compliance_rad_per_nm=compliance)
    turned = 1 / (1 + compliance * clamped.transfer(s))
    assert soft.shear_response(s) == pytest.approx(momentum * turned, rel=1e-9)


def test_a_slower_clock_delays_the_torque_ever_more(rig):
    _, usual, _ = driven(rig)
    _, older, _ = driven(rig, clock_rate_difference=-5e-4)
    delayed_ticks = np.arange(TICKS) * (1 - 5e-4)
    whole = delayed_ticks.astype(int)
    # Band-limited: a cubic through four ticks, here of the usual readings.
    first = np.clip(whole - 1, 0, TICKS - 4)
    x = delayed_ticks - first
    a, b, c, d = (usual[first + k] for k in range(4))
    seen = (
        -a * (x - 1) * (x - 2) * (x - 3) / 6
        + b * x * (x - 2) * (x - 3) / 2
        - c * x * (x - 1) * (x - 3) / 2
        + d * x * (x - 1) * (x - 2) / 6
    )
    assert np.std(older - seen) < 2e-3 * np.std(usual)
    assert np.std(older - usual) > 0.1 * np.std(usual)
