"""Ten random motors, run by a controller that knows them badly: are they found, and how well?

The engine's own cycle runs here tick by tick, without its processes and files.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from cases import further

from rigd.control import PidController, design_pid
from rigd.devices import open_devices
from rigd.devices.contracts import Devices
from rigd.engine.cycle import Cycle, make_limit_monitor, make_reading_monitors
from rigd.identification import with_cautious_controller, with_tuned_controller
from rigd.identification.estimate import PassReadings, Timing, estimate_motor
from rigd.identification.experiments import (
    HIGHEST_FREQUENCY_HZ,
    constant_speeds_excitation,
    multisine_excitation,
    passes_of_schedule,
    read_schedule,
    trial_excitation,
)
from rigd.profile import load_profile

pytestmark = pytest.mark.fit

OPTIONS = {"torque_percent": 40.0, "stroke_rad": 0.8}


@dataclass(frozen=True)
class Motor:
    """The true parameters."""

    inertia_kg_m2: float
    viscous_nm_s_per_rad: float
    coulomb_nm: float
    torque_scale: float
    actuation_delay_s: float

    def rig(self, rig, seed):
        motor = replace(
            rig.motor,
            inertia_kg_m2=self.inertia_kg_m2,
            viscous_nm_s_per_rad=self.viscous_nm_s_per_rad,
            coulomb_nm=self.coulomb_nm,
        )
        return replace(
            rig,
            motor=motor,
            actuation=replace(rig.actuation, delay_s=self.actuation_delay_s),
            simulation=replace(rig.simulation, seed=seed),
        )

    def normalised_errors(self, estimate):
        """Errors in standard deviations, by name."""
        errors = {}
        for name, truth in self.__dict__.items():
            found = getattr(estimate, name)
            errors[name] = (found.value - truth) / found.std
        return errors


class ScaledDrive:
    """A drive with a wrong torque constant."""

    angle_stale = False

    def __init__(self, drive, scale):
        self.latch, self.read_angle = drive.latch, drive.read_angle
        self._command = drive.command
        self._scale = scale

    def command(self, torque_nm):
        self._command(self._scale * torque_nm)
        return torque_nm


def record(profile, true_rig, scale, excitation):
    """Angle, torque command and coupling torque, each (n,), of one session."""
    devices = open_devices(true_rig)
    rig, motor = profile.rig, profile.control_motor
    gains = design_pid(motor.inertia_kg_m2, motor.viscous_nm_s_per_rad, profile.control.pole_rad_s)
    scaled = Devices(ScaledDrive(devices.drive, scale), devices.sensor, simulated=True)
    cycle = Cycle(
        scaled,
        rig.sensor.projection,
        PidController(gains, profile.control, rig.rate_hz, motor.peak_torque_nm),
        make_limit_monitor(profile),
        make_reading_monitors(profile, scaled),
    )
    due = range(0, 10**12, round(1e9 / rig.rate_hz)).__iter__()
    wrenches = []
    for _ in range(1000):
        cycle.read_devices(next(due))
        wrenches.append(cycle.raw_wrench)
    cycle.tare = tuple(np.mean(wrenches, axis=0))
    devices.drive.enable()
    cycle.start_control(5e-3)
    rows = []
    for reference_rad in (cycle.angle_rad + excitation.reference_rad).tolist():
        violation = cycle.step(next(due), reference_rad)
        assert violation is None, violation
        rows.append((cycle.angle_rad, cycle.torque_command_nm, cycle.coupling_torque_nm))
    return np.array(rows).T


def as_text(excitation):
    """The excitation's metadata as a session file has them."""
    return {"excitation": excitation.kind} | {
        name: value if isinstance(value, str) else repr(value)
        for name, value in excitation.parameters.items()
    }


def windows_of(excitation, signals, session):
    layout = read_schedule(as_text(excitation))
    return [
        PassReadings(
            *(signal[run.first_tick : run.end_tick] for signal in signals),
            run.speed_rad_s,
            HIGHEST_FREQUENCY_HZ[excitation.kind],
            session,
            (session, run.speed_rad_s),
        )
        for run in passes_of_schedule(layout, excitation.rate_hz)
    ]


def begin(nominal, motor, seed):
    """Run the first session as the command does; its estimate, the timing, and how to go on."""
    rig = nominal.rig
    timing = Timing(rig.rate_hz, rig.encoder.delay_s, rig.sensor.delay_s, rig.actuation.delay_s)

    def run(make, prepared, number):
        excitation = make(prepared, **OPTIONS)
        true_rig = motor.rig(rig, seed + number)
        signals = record(prepared, true_rig, motor.torque_scale, excitation)
        return windows_of(excitation, signals, number)

    trial = estimate_motor(run(trial_excitation, with_cautious_controller(nominal), 0), timing)
    return trial, timing, run


def identify(nominal, motor, seed):
    """Run the three sessions as the command does, and estimate."""
    trial, timing, run = begin(nominal, motor, seed)
    fitted = with_tuned_controller(nominal, trial)
    windows = run(multisine_excitation, fitted, 1) + run(constant_speeds_excitation, fitted, 2)
    return estimate_motor(windows, timing)


LARGEST_STD = {
    "inertia_kg_m2": 0.004,
    "viscous_nm_s_per_rad": 0.02,
    "coulomb_nm": 0.02,
    "torque_scale": 0.0015,
    "actuation_delay_s": 0.06,
}
"""Relative; of Coulomb friction relative to at least 0.01 N·m."""


def random_case(number):
    """A motor, and the profile that is wrong about it."""
    random = np.random.default_rng(2026 + number)
    motor = Motor(
        inertia_kg_m2=float(np.exp(random.uniform(np.log(5e-4), np.log(5e-3)))),
        viscous_nm_s_per_rad=random.uniform(0.005, 0.05),
        coulomb_nm=random.uniform(0.0, 0.06),
        torque_scale=random.uniform(0.8, 1.2),
        actuation_delay_s=random.uniform(0.3e-3, 2.4e-3),
    )
    profile = load_profile("sim")
    wrong = replace(
        profile.rig.motor,
        inertia_kg_m2=motor.inertia_kg_m2 * random.uniform(0.7, 1.3),
        viscous_nm_s_per_rad=motor.viscous_nm_s_per_rad * random.uniform(0.7, 1.3),
    )
    return motor, replace(profile, rig=replace(profile.rig, motor=wrong))


def test_trial_identifies_a_motor_and_tunes_its_controller():
    motor, nominal = random_case(0)
    trial, *_ = begin(nominal, motor, seed=0)
    errors = motor.normalised_errors(trial)
    assert max(map(abs, errors.values())) < 3.0, errors
    tuned = with_tuned_controller(nominal, trial).control_motor
    assert tuned.inertia_kg_m2 * motor.torque_scale == pytest.approx(motor.inertia_kg_m2, rel=0.05)


@pytest.mark.parametrize("count", [further(2), pytest.param(10, marks=pytest.mark.slow)])
def test_random_motors_are_found_within_three_deviations(count):
    all_errors = []
    for number in range(count):
        motor, nominal = random_case(number)
        estimate = identify(nominal, motor, seed=1000 * number)
        errors = motor.normalised_errors(estimate)
        assert max(map(abs, errors.values())) < 3.0, (number, errors)
        for name, largest in LARGEST_STD.items():
            truth = getattr(motor, name)
            least = 0.01 if name == "coulomb_nm" else 0.0
            assert getattr(estimate, name).std < largest * max(truth, least), (number, name)
        assert estimate.misfit < 1.5, number
        assert estimate.window_count > 60, number
        all_errors.append(list(errors.values()))

    if count < 10:
        return
    # The deviations are neither too small nor too large: of ten normal errors, with the margin of
    # 1.25, 0.8, and between 0.4 and 1.3 but for 1 in 1000.
    rms = np.sqrt(np.mean(np.square(all_errors), axis=0))
    assert (rms > 0.3).all(), rms
    assert (rms < 1.3).all(), rms


def without_antenna(rig):
    beam = replace(rig.beam, density_kg_per_m=1e-8, bending_stiffness_n_m2=1e-7)
    return replace(rig, beam=beam)


@pytest.mark.further  # as test_motor_estimate.py
def test_scale_is_not_reported_without_an_antenna():
    profile = load_profile("sim")
    motor = Motor(1.6e-3, 0.025, 0.02, 1.1, 1.3e-3)

    class MotorAlone(Motor):
        def rig(self, rig, seed):
            return without_antenna(super().rig(rig, seed))

    estimate = identify(profile, MotorAlone(**motor.__dict__), seed=5)
    assert estimate.torque_scale.std is None
    assert estimate.torque_scale.value == 1.0
    # In the torque that the drive states.
    in_its_torque = Motor(1.6e-3 / 1.1, 0.025 / 1.1, 0.02 / 1.1, 1.0, 1.3e-3)
    for name in ("inertia_kg_m2", "viscous_nm_s_per_rad", "coulomb_nm", "actuation_delay_s"):
        quantity = getattr(estimate, name)
        assert abs(quantity.value - getattr(in_its_torque, name)) < 3 * quantity.std, name
        assert quantity.std < 0.03 * quantity.value


@pytest.mark.further  # as test_motor_estimate.py
def test_readings_of_different_ages():
    profile = load_profile("sim")
    rig = replace(
        profile.rig,
        encoder=replace(profile.rig.encoder, delay_s=1.0e-3),
        sensor=replace(profile.rig.sensor, delay_s=1.4e-3),
    )
    motor = Motor(2.2e-3, 0.015, 0.04, 1.05, 0.7e-3)
    estimate = identify(replace(profile, rig=rig), motor, seed=9)
    errors = motor.normalised_errors(estimate)
    assert max(map(abs, errors.values())) < 3.0, errors
