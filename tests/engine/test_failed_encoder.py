"""An encoder that fails while its messages stay fresh: how far the shaft turns, session by session.

The true friction of the motor differs from the 0.03 N·m of the profile.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from rigd.control import close_loop
from rigd.control.damper import design_damper
from rigd.devices import open_devices
from rigd.devices.contracts import Devices
from rigd.engine.messages import PostRecordPlan
from rigd.excitation import Excitation, chirp, hold, multisine, step
from rigd.excitation.moves import quintic
from rigd.profile import load_profile
from rigd.sim import StuckReadings

RATE_HZ = 1000.0
BEFORE_RECORD = 1000
"""Ticks of tare and settling."""
ENCODER = r"Net torque while the encoder|Torque that the sudden stop of the encoder"
BY_OBSTACLES = r"Tracking error|Torque command|After the record: Drift of"
REPEATS = r"Number of encoder readings that repeat"


class FailingDrive:
    """A simulated drive whose encoder fails at a given reading; notes where the shaft is."""

    def __init__(self, inner, at, stuck):
        self.inner, self.at, self.stuck = inner, at, stuck
        self.reads = 0
        self.angles_rad = []
        self.speed_rad_s = 0.0

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def read_angle(self):
        self.reads += 1
        plant = self.inner._plant
        if self.reads == self.at:
            self.inner.stuck_encoder = self.stuck
            self.speed_rad_s = abs(plant.velocity_rad_s)
        if self.reads >= self.at:
            self.angles_rad.append(plant.angle_rad)
        return self.inner.read_angle()

    def travel_rad(self):
        """Greatest distance from the angle at the failure, up to rest."""
        plant = self.inner._plant
        for _ in range(3000):
            plant.advance(1)
            self.angles_rad.append(plant.angle_rad)
        return float(np.ptp([self.angles_rad[0], *self.angles_rad]))


def slew():
    path = 0.4 * quintic(0.6, RATE_HZ)
    return np.concatenate([np.zeros(500), path, np.full(1500, 0.4)])


def sessions():
    ends = {"rest_s": 0.5, "ring_down_s": 0.5}
    slow = chirp(rate_hz=RATE_HZ, duration_s=6.0, start_hz=0.05, stop_hz=5.0, **ends)
    fast = chirp(rate_hz=RATE_HZ, duration_s=5.0, stop_hz=50.0, **ends)
    tones = multisine(
        rate_hz=RATE_HZ, amplitude_rad=0.005, start_hz=1.0, stop_hz=40.0, period_s=2.0,
        duration_s=4.0, **ends,
    )  # fmt: skip
    return {
        "chirp": fast.reference_rad,
        "slow chirp": slow.reference_rad,
        "step": step(rate_hz=RATE_HZ, amplitude_rad=0.01, duration_s=4.0, **ends).reference_rad,
        "multisine": tones.reference_rad,
        "move": slew(),
        "hold": hold(rate_hz=RATE_HZ, duration_s=4.0, **ends).reference_rad,
    }


REFERENCES = sessions()


def run_with_failing_encoder(make_session, reference_rad, at, friction_nm, stuck=None):
    session = make_session()
    rig = session.profile.rig
    truth = replace(rig, motor=replace(rig.motor, coulomb_nm=friction_nm))
    devices = open_devices(truth)
    drive = FailingDrive(devices.drive, at, stuck or StuckReadings())
    session.devices = Devices(drive, devices.sensor, simulated=True)
    excitation = Excitation("file", {}, RATE_HZ, reference_rad, {})
    damper = design_damper(close_loop(session.profile.loop_model()))
    session.obey(replace(session.order(excitation), ending=PostRecordPlan(damper=damper)))
    assert not drive.inner._plant.enabled
    return session.finished, drive


def further(*case):
    return pytest.param(*case, marks=pytest.mark.further)


class ScaledDrive(FailingDrive):
    """A working drive whose motor exerts another torque than it reports."""

    def __init__(self, inner, scale):
        super().__init__(inner, np.inf, None)
        self.scale = scale

    def command(self, torque_nm):
        self.inner.command(self.scale * torque_nm)
        return torque_nm


CASES = [
    ("chirp", BEFORE_RECORD, 0.02),
    further("chirp", BEFORE_RECORD + 2000, 0.06),
    ("slow chirp", BEFORE_RECORD + 4000, 0.02),
    further("step", BEFORE_RECORD, 0.05),
    ("step", BEFORE_RECORD + 2500, 0.02),
    ("multisine", BEFORE_RECORD, 0.02),
    further("multisine", BEFORE_RECORD + 1500, 0.1),
    ("move", BEFORE_RECORD, 0.02),
    further("move", BEFORE_RECORD + 800, 0.1),
    further("hold", BEFORE_RECORD, 0.02),
]


@pytest.mark.parametrize(("name", "at", "friction_nm"), CASES)
def test_a_frozen_encoder_ends_the_session_soon(make_session, name, at, friction_nm):
    finished, drive = run_with_failing_encoder(make_session, REFERENCES[name], at, friction_nm)
    travel_rad = drive.travel_rad()
    assert travel_rad <= 0.3
    if finished.outcome == "fault" or finished.reason:
        assert re.search(ENCODER, finished.reason)
    else:
        # Torque within the friction turns nothing.
        assert travel_rad < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", REFERENCES)
def test_the_shaft_turns_little_wherever_an_encoder_freezes(make_session, name):
    random = np.random.default_rng(7)
    reference_rad = REFERENCES[name]
    for _ in range(20):
        at = int(random.integers(BEFORE_RECORD, BEFORE_RECORD + reference_rad.size))
        friction_nm = random.uniform(0.02, 0.1)
        finished, drive = run_with_failing_encoder(make_session, reference_rad, at, friction_nm)
        bound_rad = 0.3 if drive.speed_rad_s < 1.5 else 0.15 + coasting_rad(drive, friction_nm)
        assert drive.travel_rad() <= bound_rad, (at, friction_nm, finished.reason)


def coasting_rad(drive, friction_nm):
    rig = load_profile("sim").rig
    inertia_kg_m2 = rig.motor.inertia_kg_m2 + rig.beam.inertia_kg_m2
    return drive.speed_rad_s**2 * inertia_kg_m2 / (2 * friction_nm)


@pytest.mark.parametrize(
    ("name", "every"), [("move", 2), further("move", 3), further("chirp", 2), further("chirp", 3)]
)
def test_an_encoder_with_repeated_readings_is_detected(make_session, name, every):
    finished, _ = run_with_failing_encoder(
        make_session, REFERENCES[name], BEFORE_RECORD, 0.03, StuckReadings(every)
    )
    assert finished.outcome == "fault"
    # Of three readings two repeat: the shaft seems to stop.
    assert re.match(REPEATS if every == 2 else f"{REPEATS}|{ENCODER}", finished.reason)
    assert finished.device_failed


@pytest.mark.parametrize(
    ("name", "friction_nm"),
    [
        ("step", 0.02),
        further("step", 0.1),
        further("hold", 0.02),
        further("hold", 0.1),
        further("slow chirp", 0.1),
    ],
)
def test_a_working_encoder_is_not_reported_failed(make_session, name, friction_nm):
    """Not even if an impact makes the beam pull at a resting shaft."""
    reference_rad = REFERENCES[name]
    session = make_session()
    rig = session.profile.rig
    impacts = ("knock,x=0.5,force=0.4,at=1,duration=0.02", "x=0.8,force=-0.3,at=2,duration=0.01")
    impacts = tuple(impact.removeprefix("knock,") for impact in impacts)
    truth = replace(
        rig,
        motor=replace(rig.motor, coulomb_nm=friction_nm),
        simulation=replace(rig.simulation, obstacles=impacts),
    )
    devices = open_devices(truth)
    session.devices = Devices(devices.drive, devices.sensor, simulated=True)
    excitation = Excitation("file", {}, RATE_HZ, reference_rad, {})
    session.obey(session.order(excitation))
    assert session.finished.outcome == "complete", session.finished.reason
    assert session.finished.counts["scheduled"] == reference_rad.size


def draw_obstacles(random, seconds):
    """Draw a disturbance of the beam: none, an obstacle, or impacts."""
    x = random.uniform(0.2, 0.95)
    match random.integers(4):
        case 0:
            angle = random.choice([-1, 1]) * 10 ** random.uniform(-3, -0.5)
            stiffness = 10 ** random.uniform(1.5, 4.5)
            return (f"x={x:.3f},angle={angle:.5f},stiffness={stiffness:.0f}",)
        case 1:
            times = random.uniform(0.2, seconds, 3)
            return tuple(
                f"x={x:.3f},force={random.uniform(-1, 1):.3f},at={at:.2f},duration=0.02"
                for at in times
            )
    return ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_fifty_sound_sessions_end_well(make_session, seed):
    """Friction, one quantity of the motor, or a product of two differ from the profile."""
    random = np.random.default_rng(seed)
    damper = None
    for number in range(50):
        name = str(random.choice(list(REFERENCES)))
        reference_rad = REFERENCES[name]
        session = make_session()
        damper = damper or design_damper(close_loop(session.profile.loop_model()))
        rig = session.profile.rig
        error, part = random.uniform(0.75, 1.25), random.choice([0.0, 1.0, random.uniform()])
        motor = replace(
            rig.motor,
            coulomb_nm=random.uniform(0.02, 0.1),
            inertia_kg_m2=rig.motor.inertia_kg_m2 * error**part,
        )
        met = draw_obstacles(random, reference_rad.size / RATE_HZ)
        simulation = replace(rig.simulation, seed=1000 * seed + number, obstacles=met)
        devices = open_devices(replace(rig, motor=motor, simulation=simulation))
        drive = ScaledDrive(devices.drive, error ** (1.0 - part))
        session.devices = Devices(drive, devices.sensor, simulated=True)
        excitation = Excitation("file", {}, RATE_HZ, reference_rad, {})
        order = session.order(excitation, seed=1000 * seed + number)
        session.obey(replace(order, ending=PostRecordPlan(damper=damper)))
        finished = session.finished
        if finished.reason:
            # An obstacle may hold the motor back: that is no false fault.
            assert met, (name, number, error, part, motor, finished.reason)
            assert re.match(BY_OBSTACLES, finished.reason), (name, number, met, finished.reason)
