"""Behaviour of the simulated plant except its linear response: delays, friction, limits, energy."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.beam import Beam, Damping
from rigd.beam.realisation import RealisationError
from rigd.devices.parameters import (
    Actuation,
    DeviceSelection,
    Encoder,
    Motor,
    RigParameters,
    WrenchSensorSettings,
)
from rigd.sim import SimulatedPlant

MOTOR = Motor(
    inertia_kg_m2=2e-3,
    viscous_nm_s_per_rad=0.02,
    coulomb_nm=0.0,
    rated_torque_nm=0.5,
    peak_torque_nm=0.9,
)
RIG = RigParameters(
    rate_hz=1000.0,
    beam=Beam(0.98, 4.7e-3, 0.090275),
    damping=Damping(7.1e-5, 0.996, 0.055, 0.594),
    motor=MOTOR,
    encoder=Encoder(resolution_rad=0.0),
    sensor=WrenchSensorSettings(
        (1e-4,) * 6, (1.0,) * 6, (0, 0, 0, 0, 0, 1), tool_inertia_kg_m2=1e-5
    ),
    actuation=Actuation(delay_s=0.0),
    devices=DeviceSelection("sim", "sim"),
)
STATE = (
    "angle_rad",
    "velocity_rad_s",
    "coupling_torque_nm",
    "sensed_angle_rad",
    "sensed_torque_nm",
)


def rig(*, rate_hz=1000.0, coulomb=0.0, viscous=0.02, delay=0.0, angle_delay=0.0, torque_delay=0.0):
    return replace(
        RIG,
        rate_hz=rate_hz,
        motor=replace(MOTOR, coulomb_nm=coulomb, viscous_nm_s_per_rad=viscous),
        encoder=Encoder(0.0, angle_delay),
        sensor=replace(RIG.sensor, delay_s=torque_delay),
        actuation=Actuation(delay),
    )


def enabled(parameters):
    plant = SimulatedPlant(parameters)
    plant.enable()
    return plant


def state(plant):
    return tuple(getattr(plant, name) for name in STATE)


def run(plant, torques):
    """State at each tick, before its command: shape (ticks, 5)."""
    record = []
    for torque in torques:
        record.append(state(plant))
        plant.command(torque)
        plant.advance()
    return np.array(record)


def noise(n, level=0.1, seed=0):
    return (level * np.random.default_rng(seed).standard_normal(n)).tolist()


# Delays, against the same physics at ten times the rate, where they are whole periods. (At a jump
# of the torque the sensed torque is the mean of both sides, which the fast plant cannot know: the
# torque delays are chosen to avoid jumps.)


@pytest.mark.parametrize("delay", [further(0.0), 0.3e-3, further(1e-3), 2.7e-3])
@pytest.mark.parametrize("angle_delay", [0.0, further(0.4e-3), 2e-3, further(3.3e-3)])
@pytest.mark.parametrize("torque_delay", [further(0.1e-3), 0.8e-3, 2.2e-3])
def test_delays(delay, angle_delay, torque_delay):
    torques = noise(300)
    slow = enabled(rig(delay=delay, angle_delay=angle_delay, torque_delay=torque_delay))
    found = run(slow, torques)

    fast = enabled(rig(rate_hz=10_000.0))
    shift = round(delay * 1e4)
    applied = np.concatenate([np.zeros(shift), np.repeat(torques, 10)])[:3000]
    fine = run(fast, applied.tolist())

    def ago(column, delay_s):
        index = np.arange(0, 3000, 10) - round(delay_s * 1e4)
        return np.where(index >= 0, fine[index, column], 0.0)

    scale = np.abs(fine).max(axis=0)
    assert np.max(np.abs(found[:, 0] - ago(0, 0.0))) < 1e-10 * scale[0]
    assert np.max(np.abs(found[:, 1] - ago(1, 0.0))) < 1e-10 * scale[1]
    assert np.max(np.abs(found[:, 3] - ago(0, angle_delay))) < 1e-10 * scale[0]
    assert np.max(np.abs(found[:, 4] - ago(2, torque_delay))) < 1e-10 * scale[2]


def test_actuation_delay_of_whole_periods_shifts_everything():
    torques = noise(200)
    now = run(enabled(rig()), torques)
    later = run(enabled(rig(delay=3e-3)), torques)
    np.testing.assert_array_equal(later[3:, :2], now[:-3, :2])
    assert not later[:3].any()


def test_coupling_torque_at_a_jump_is_the_mean_of_both_sides():
    instant = 1e-9
    torques = noise(300)
    mean = run(enabled(rig(delay=1e-3)), torques)[:, 2]
    before = run(enabled(rig(delay=1e-3, torque_delay=instant * 1.5)), torques)[:, 4]
    after = run(enabled(rig(delay=1e-3, torque_delay=1e-3 * (1 - 1e-6))), torques)[1:, 4]
    jumps = np.abs(after - before[:-1])
    assert np.max(jumps) > 1e-3
    # The value after is taken a nanosecond late: the fast beam states have moved by 1e-5 of a jump.
    error = np.abs(mean[:-1] - 0.5 * (before[:-1] + after))
    assert np.max(error) < 1e-4 * np.max(jumps)


def test_sensed_torque_at_a_jump_within_a_period_is_the_mean():
    torques = noise(300)
    before, mean, after = (
        run(enabled(rig(delay=0.5e-3, torque_delay=delay)), torques)[:, 4]
        for delay in (0.5e-3 + 1e-9, 0.5e-3, 0.5e-3 - 1e-9)
    )
    jumps = np.abs(after - before)
    assert np.max(jumps) > 1e-3
    assert np.max(np.abs(mean - 0.5 * (before + after))) < 1e-4 * np.max(jumps)


# Going through time


def test_missed_periods_hold_the_last_torque():
    parameters = rig(coulomb=0.03, delay=2.4e-3, angle_delay=1.2e-3, torque_delay=0.3e-3)
    one, many = enabled(parameters), enabled(parameters)
    for n, torque in zip([1, 4, 1, 17, 2, 40], noise(6, 0.3), strict=True):
        one.command(torque)
        many.command(torque)
        for _ in range(n):
            one.advance()
        many.advance(n)
        assert state(one) == state(many)
    before = state(many)
    many.advance(0)
    assert state(many) == before


def test_same_commands_same_record():
    parameters = rig(coulomb=0.03, delay=1.3e-3, torque_delay=0.3e-3)
    first, second = (run(enabled(parameters), noise(2000)) for _ in range(2))
    assert np.array_equal(first, second)


# Limits and the drive's switch


def test_torque_saturates_at_the_peak():
    over, at = enabled(rig()), enabled(rig())
    torques = noise(100, 2.0)
    assert max(map(abs, torques)) > 0.9
    assert np.array_equal(run(over, torques), run(at, np.clip(torques, -0.9, 0.9).tolist()))


def test_a_disabled_drive_gives_no_torque():
    plant = SimulatedPlant(rig())
    assert not run(plant, noise(50)).any()


def test_disabling_stops_the_torque_and_drops_pending_commands():
    plant = enabled(rig(delay=3.6e-3))
    run(plant, [0.2] * 100)
    plant.disable()
    plant.command(0.5)
    speed = plant.velocity_rad_s
    # The same on a plant without delay, at a rate of which the delay is a whole number of periods.
    fine = enabled(rig(rate_hz=10_000.0))
    run(fine, [0.0] * 36 + [0.2] * 964)
    assert fine.velocity_rad_s == pytest.approx(speed, rel=1e-10)
    coasting = run(plant, [0.5] * 50)
    reference = run(fine, [0.0] * 500)[::10]
    np.testing.assert_allclose(coasting[:, :2], reference[:, :2], rtol=1e-9)
    plant.enable()  # commands given while the drive was off are dropped
    still = run(fine, [0.0] * 100)[::10]
    np.testing.assert_allclose(run(plant, [0.0] * 10)[:, :2], still[:, :2], rtol=1e-9)


# Friction


def test_sticks_below_the_friction_torque():
    plant = enabled(rig(coulomb=0.03))
    record = run(plant, (0.0299 * np.sign(np.sin(np.arange(3000) / 7.0))).tolist())
    assert not record[:, :2].any()
    moving = run(plant, [0.031] * 20)
    assert np.all(np.diff(moving[1:, 0]) > 0)


def test_sticking_depends_on_the_mean_torque_of_a_period():
    pulse = [0.0, 0.05, 0.0, 0.0]
    assert run(enabled(rig(coulomb=0.03)), pulse)[:, 0].any()
    assert not run(enabled(rig(coulomb=0.03, delay=0.5e-3)), pulse)[:, 0].any()


def test_sliding_friction_is_a_constant_torque_against_the_motion():
    sliding = run(enabled(rig(coulomb=0.03)), [0.10] * 300)
    net = run(enabled(rig()), [0.07] * 300)
    assert np.all(net[1:, 1] > 0)
    np.testing.assert_allclose(sliding, net, rtol=1e-9, atol=1e-15)
    back = run(enabled(rig(coulomb=0.03)), [-0.10] * 300)
    np.testing.assert_array_equal(back, -sliding)


def test_motor_rests_while_the_beam_rings_on():
    plant = enabled(rig(coulomb=0.03))
    run(plant, [0.3] * 100 + [-0.3] * 60)
    record = run(plant, [0.0] * 30_000)
    stopped = np.flatnonzero(record[:, 1])[-1] + 1
    assert stopped < 25_000
    assert np.ptp(record[stopped:, 0]) <= 1e-16  # a rounding, on some builds of numpy
    torque = record[stopped:, 2]
    assert np.max(np.abs(torque)) <= 0.03  # held by friction
    # On the locked shaft the beam has its clamped–free first mode, 2.56 Hz, and decays.
    tail = torque[:4096]
    peak_hz = np.argmax(np.abs(np.fft.rfft(tail * np.hanning(4096), 2**18))) * 1000 / 2**18
    assert peak_hz == pytest.approx(2.57, abs=0.02)
    assert np.max(np.abs(torque[-500:])) < 0.9 * np.max(np.abs(torque[:500]))


def test_friction_converges_with_the_rate():
    """Stick and slip under a slow torque: twice the rate, less than 0.65 times the error."""
    duration = 1.5

    def angles(rate):
        plant = enabled(rig(rate_hz=rate, coulomb=0.03))
        t = np.arange(int(duration * rate)) / rate
        held = 0.05 * np.sin(2 * np.pi * 1.3 * np.floor(t * 500 + 1e-9) / 500)
        return run(plant, held.tolist())[:: int(rate / 500), 0]

    finest = angles(16_000.0)
    coarse, fine = (np.max(np.abs(angles(rate) - finest)) for rate in (1000.0, 2000.0))
    assert fine < 0.65 * coarse
    assert coarse < 0.01 * np.ptp(finest)


# Energy


@pytest.mark.parametrize("coulomb", [further(0.0), 0.03])
@pytest.mark.parametrize(
    "damping",
    [
        Damping(),
        Damping(1.075e-3),
        Damping(7.1e-5, 0.996, 0.055, 0.594),
        Damping(9e-6, 1.36, 0.2, 0.6),
    ],
)
def test_energy_is_never_created(damping, coulomb):
    """From rest, the work done is at least the motor's kinetic energy, driven or free.

    The torque is constant over a period, so the work is exactly the sum of torque times the
    change of angle. The remainder is stored in the beam or lost, and never negative.
    """
    plant = enabled(replace(rig(coulomb=coulomb, viscous=0.0), damping=damping))
    # Noise, then the first mode shaken on resonance, then left alone.
    shaken = 0.1 * np.sin(2 * np.pi * 4.0 * np.arange(3000) * 1e-3)
    torques = np.concatenate([noise(2000, 0.3), shaken, np.zeros(20_000)])
    record = run(plant, torques.tolist())
    work = np.concatenate([[0], np.cumsum(torques[:-1] * np.diff(record[:, 0]))])
    kinetic = 0.5 * (2e-3 + 1e-5) * record[:, 1] ** 2
    stored_or_lost = work - kinetic
    assert np.max(kinetic) > 1e-4
    assert np.min(stored_or_lost) > -1e-6 * np.max(work)
    # Left alone, the shaft never swings more than at first (0.5 %: undamped modes beat).
    swing = np.ptp(record[5000:, 1].reshape(-1, 2000), axis=1)
    assert np.max(swing) <= 1.005 * swing[0]


def test_a_beam_that_cannot_be_realised_is_refused():
    with pytest.raises(RealisationError):
        SimulatedPlant(replace(RIG, damping=Damping(zeta=1e-4, alpha=2.5)))
