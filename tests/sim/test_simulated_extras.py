"""What a simulated rig may have beside, against the exact response to its own angle."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import LoadedBeam
from rigd.profile import load_profile
from rigd.sim._plant import OtherClock, SimulatedPlant

TICKS = 12_000
RATE_HZ = 1000.0


@pytest.fixture(scope="module")
def rig():
    rig = load_profile("sim").rig
    return replace(rig, motor=replace(rig.motor, coulomb_nm=0.0))


def driven(rig, **more):
    """Sensed angle and torque while the motor's torque sweeps to 30 Hz."""
    t = np.arange(TICKS) / RATE_HZ
    sweep = np.sin(2 * np.pi * (0.5 * t + 29.5 * t**2 / (2 * t[-1])))
    torques = (0.2 * np.hanning(TICKS) * sweep).tolist()
    plant = SimulatedPlant(replace(rig, simulation=replace(rig.simulation, **more)))
    plant.enable()
    found = np.empty((2, TICKS))
    for tick, torque in enumerate(torques):
        found[:, tick] = plant.sensed_angle_rad, plant.sensed_torque_nm
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
        {"clamp_compliance_rad_per_nm": 0.02},
        {"tip_mass_kg": 2e-4},
        {"torque_filter_hz": 80.0},
        {"torque_filter_hz": 80.0, "torque_filter_order": 2},
    ],
    ids=lambda more: " ".join(more) or "nothing",
)
def test_the_torque_is_that_of_the_exact_response(rig, more):
    angle, torque = driven(rig, **more)
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    beam = LoadedBeam(
        rig.beam,
        rig.damping,
        more.get("tip_mass_kg", 0.0),
        more.get("clamp_compliance_rad_per_nm", 0.0),
    )
    response = beam.transfer(s)
    if "torque_filter_hz" in more:
        order = more.get("torque_filter_order", 1)
        response = response * low_pass(s, more["torque_filter_hz"], order)
    exact = np.fft.irfft(np.fft.rfft(angle * decay, 4 * TICKS) * response, 4 * TICKS)[:TICKS]
    apart = (torque - exact / decay)[: TICKS * 9 // 10]
    assert np.std(apart) < 1e-4 * np.std(torque)


def test_a_slower_clock_shows_the_torque_ever_older(rig):
    _, usual = driven(rig)
    _, older = driven(rig, clock_rate_difference=-5e-4)
    place = np.arange(TICKS) * (1 - 5e-4)
    whole = place.astype(int)
    # Band-limited: a cubic through four ticks, here of the usual readings.
    first = np.clip(whole - 1, 0, TICKS - 4)
    x = place - first
    a, b, c, d = (usual[first + k] for k in range(4))
    seen = (
        -a * (x - 1) * (x - 2) * (x - 3) / 6
        + b * x * (x - 2) * (x - 3) / 2
        - c * x * (x - 1) * (x - 3) / 2
        + d * x * (x - 1) * (x - 2) / 6
    )
    assert np.std(older - seen) < 2e-3 * np.std(usual)
    assert np.std(older - usual) > 0.1 * np.std(usual)


def test_a_line_of_readings_grows_older():
    line = OtherClock(periods=1, growth=0.25)
    seen = []
    for tick in range(1, 40):
        line.append(float(tick))
        seen.append(line[0])
    expected = [tick - 1 - 0.25 * tick for tick in range(1, 40)]
    assert seen[8:] == pytest.approx(expected[8:])
