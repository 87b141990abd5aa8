"""The estimator on motions that this file computes itself, by Runge and Kutta."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import scipy  # whose parts come on first use
from cases import further

from rigd.identification.estimate import (
    MotorEstimateError,
    PassReadings,
    Timing,
    _student_factor,
    estimate_motor,
)

pytestmark = pytest.mark.fit

RATE_HZ = 1000.0
STEPS = 5
"""A tick: delays are whole numbers of steps of 0.2 ms."""
TICKS = 1400
REPEATS = 8


@dataclass(frozen=True)
class Truth:
    """A motor that turns a flywheel on a spring instead of the beam."""

    inertia_kg_m2: float = 1.3e-3
    viscous_nm_s_per_rad: float = 0.021
    coulomb_nm: float = 0.037
    torque_scale: float = 0.93
    actuation_delay_s: float = 1.4e-3
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    zero_nm: float = 4e-3
    load_inertia_kg_m2: float = 1.1e-3
    load_rad_s: float = 17.0
    noise_nm: float = 5e-3
    resolution_rad: float = 7e-5


def simulate(truth, speed_rad_s, amplitude_rad):
    """Angle, command and coupling torque, each (n, ticks), of n passes of a controlled motor."""
    random = np.random.default_rng(1)
    step_s = 1 / RATE_HZ / STEPS
    stiffness = truth.load_inertia_kg_m2 * truth.load_rad_s**2
    damping = 0.02 * truth.load_inertia_kg_m2 * truth.load_rad_s
    friction = truth.coulomb_nm * np.sign(speed_rad_s)
    lag = round(truth.actuation_delay_s / step_s)
    age, torque_age = (round(d / step_s) for d in (truth.angle_delay_s, truth.torque_delay_s))
    frequencies = np.arange(2, 40) * RATE_HZ / TICKS
    phases = 2 * np.pi * np.random.default_rng(3).random(frequencies.size)

    def rates(state, torque):
        angle, speed, load, load_speed = state
        coupling = stiffness * (angle - load) + damping * (speed - load_speed)
        push = truth.torque_scale * torque - coupling - friction - truth.zero_nm
        push = push - truth.viscous_nm_s_per_rad * speed
        acceleration = push / truth.inertia_kg_m2
        return np.array([speed, acceleration, load_speed, coupling / truth.load_inertia_kg_m2])

    def coupling_torque(state):
        return stiffness * (state[0] - state[2]) + damping * (state[1] - state[3])

    start = random.uniform(0, truth.resolution_rad or 1e-4, speed_rad_s.size)
    state = np.array([start, speed_rad_s] * 2)
    states = [state] * (STEPS * 10)
    commands = [np.sign(speed_rad_s) * 0.05] * 10
    records = []
    before = state[0].copy()
    for tick in range(TICKS):
        t = tick / RATE_HZ
        angle = states[-1 - age][0]
        if truth.resolution_rad:
            angle = np.round(angle / truth.resolution_rad) * truth.resolution_rad
        noise = truth.noise_nm * random.standard_normal(start.size)
        coupling = coupling_torque(states[-1 - torque_age]) + noise
        waves = np.sum(np.sin(2 * np.pi * frequencies * t + phases) / frequencies)
        reference = start + speed_rad_s * t + amplitude_rad * waves
        # A controller of this file's own; the coupling torque is fed forward as the rig does it.
        speed = (angle - before) * RATE_HZ
        before = angle
        command = 8.0 * (reference - angle) + 0.12 * (speed_rad_s - speed) + coupling
        commands.append(command)
        records.append((angle, command, coupling))
        for step in range(STEPS):
            acting = commands[-1 - (lag - step + STEPS - 1) // STEPS]
            k1 = rates(state, acting)
            k2 = rates(state + 0.5 * step_s * k1, acting)
            k3 = rates(state + 0.5 * step_s * k2, acting)
            k4 = rates(state + step_s * k3, acting)
            state = state + step_s / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            states.append(state)
        states = states[-10 * STEPS :]
    return np.moveaxis(np.array(records), 0, -1)


@cache
def windows_for(truth):
    """Passes both ways with waves on them, and slow ones without."""
    speeds = np.repeat([0.9, -0.9, 0.2, -0.2], REPEATS)
    amplitudes = np.where(np.abs(speeds) > 0.5, 0.006, 0.0)
    signals = np.moveaxis(simulate(truth, speeds, amplitudes)[..., 100:], 0, 1)
    return tuple(
        PassReadings(*three, speed, 28.0 if waves else 3.0, 0 if waves else 1, speed)
        for three, speed, waves in zip(signals, speeds.tolist(), amplitudes > 0, strict=True)
    )


def timing_for(truth):
    return Timing(RATE_HZ, truth.angle_delay_s, truth.torque_delay_s, actuation_delay_s=0.5e-3)


def errors_of(estimate, truth):
    names = ("inertia_kg_m2", "viscous_nm_s_per_rad", "coulomb_nm", "torque_scale")
    names += ("actuation_delay_s",)
    return {
        name: (getattr(estimate, name).value - getattr(truth, name)) / getattr(estimate, name).std
        for name in names
    }


OLD_READINGS = Truth(angle_delay_s=0.6e-3, torque_delay_s=1.2e-3, actuation_delay_s=1.0e-3)


@pytest.mark.parametrize(
    "truth",
    [
        further(Truth()),
        further(
            Truth(actuation_delay_s=0.4e-3, torque_scale=1.2, inertia_kg_m2=4e-3, coulomb_nm=0.0)
        ),
        OLD_READINGS,
    ],
    ids=["light", "heavy", "old readings"],
)
def test_the_motor_is_found_within_its_deviations(truth):
    estimate = estimate_motor(windows_for(truth), timing_for(truth))
    errors = errors_of(estimate, truth)
    assert max(map(abs, errors.values())) < 3.0, errors
    assert estimate.inertia_kg_m2.std < 0.025 * truth.inertia_kg_m2
    assert estimate.torque_scale.std < 0.025
    assert estimate.actuation_delay_s.std < 8e-5
    assert estimate.misfit < 2.0


def test_estimate_without_noise_is_exact():
    truth = Truth(noise_nm=0.0, resolution_rad=0.0)
    estimate = estimate_motor(windows_for(truth), timing_for(truth))
    assert estimate.inertia_kg_m2.value == pytest.approx(truth.inertia_kg_m2, rel=2e-4)
    assert estimate.viscous_nm_s_per_rad.value == pytest.approx(0.021, rel=2e-3)
    assert estimate.coulomb_nm.value == pytest.approx(truth.coulomb_nm, rel=5e-4)
    assert estimate.torque_scale.value == pytest.approx(truth.torque_scale, rel=2e-4)
    assert estimate.actuation_delay_s.value == pytest.approx(1.4e-3, abs=1.5e-6)


def test_a_wrong_age_of_the_torque_reading_shows_as_a_misfit():
    truth = Truth(torque_delay_s=3e-3, noise_nm=1e-3)
    windows = windows_for(truth)
    right = estimate_motor(windows, timing_for(truth))
    wrong = estimate_motor(windows, replace(timing_for(truth), torque_delay_s=0.0))
    assert right.misfit < 2.0
    assert wrong.misfit > 5.0
    assert wrong.inertia_kg_m2.std > 2 * right.inertia_kg_m2.std


def test_rigid_load_does_not_determine_the_scale():
    truth = Truth(load_inertia_kg_m2=2e-4, load_rad_s=600.0, torque_scale=1.1)
    estimate = estimate_motor(windows_for(truth), timing_for(truth))
    assert estimate.torque_scale.std is None
    assert estimate.coulomb_nm.value == pytest.approx(truth.coulomb_nm / 1.1, rel=0.02)


def test_windows_with_a_standstill_are_left_out():
    truth = OLD_READINGS
    windows = list(windows_for(truth))
    stuck = windows[0].angle_rad.copy()
    stuck[600:700] = stuck[600]
    windows[0] = replace(windows[0], angle_rad=stuck)
    estimate = estimate_motor(windows, timing_for(truth))
    assert (estimate.window_count, estimate.dropped_window_count) == (4 * REPEATS - 1, 1)
    assert max(map(abs, errors_of(estimate, truth).values())) < 3.0


def test_too_few_passes_are_refused():
    windows = windows_for(OLD_READINGS)
    one_way = [window for window in windows if window.speed_rad_s > 0]
    for few in ((), one_way, windows[:3] + windows[8:11]):
        with pytest.raises(MotorEstimateError, match="Too few passes"):
            estimate_motor(few, timing_for(OLD_READINGS))


def test_record_without_torque_gives_no_estimate():
    still = [
        replace(window, torque_command_nm=np.zeros_like(window.torque_command_nm))
        for window in windows_for(OLD_READINGS)
    ]
    with pytest.raises(MotorEstimateError):
        estimate_motor(still, timing_for(OLD_READINGS))


@pytest.mark.parametrize("freedom", [5, 8, 15, 30, 100])
def test_three_deviations_have_normal_coverage(freedom):
    quantile = scipy.special.stdtrit(freedom, scipy.special.ndtr(3.0)) / 3.0
    assert _student_factor(np.array(float(freedom))) == pytest.approx(quantile, rel=0.06)
