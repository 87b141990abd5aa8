"""Every row of the table of interlocks: a session in which it acts, and its end."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from cases import further

from rigd.control import close_loop
from rigd.devices.contracts import Devices
from rigd.engine.cycle import make_limit_monitor
from rigd.engine.messages import MeasurementRefused, SessionFinished, TareOrder
from rigd.engine.shared_state import StateField
from rigd.engine.timing import VirtualClock
from rigd.excitation import chirp, hold
from rigd.profile import load_profile
from rigd.safety.limits import INTERLOCKS, Action
from rigd.session.layout import Status
from rigd.sim import StuckReadings

MIDDLE_NS = 2_000_000_000
MIDDLE = 2000
"""Tick and time in the middle of the record: tare and settling take 1 s, the record 3 s."""


FAST = 3100
"""Tick at which the shaft moves fast."""


class Sensor:
    """The simulated sensor, with faults from a given reading on."""

    def __init__(self, inner, wrong_from):
        self.inner = inner
        self.wrong_from = wrong_from
        self.reads = 0
        self.added = [0.0] * 6
        self.stale = self.saturated = False
        self.stuck = self.stuck_axis = None
        self.stale_every = 1

    def __getattr__(self, name):
        return getattr(self.inner, name)

    @property
    def _wrong(self):
        return self.reads >= self.wrong_from

    @property
    def wrench_stale(self):
        return self.stale and self._wrong and self.reads % self.stale_every == 0

    @property
    def wrench_saturated(self):
        return self.saturated and self._wrong

    def read_wrench(self):
        self.reads += 1
        wrench = self.inner.read_wrench()
        if not self._wrong:
            return wrench
        if self.stuck is not None:
            return self.stuck(wrench)
        if self.stuck_axis is not None:
            axis, stuck = self.stuck_axis
            return (*wrench[:axis], stuck(wrench[axis]), *wrench[axis + 1 :])
        return tuple(value + more for value, more in zip(wrench, self.added, strict=True))


class Clock(VirtualClock):
    """Late at some of its deadlines, and runs an action at one; not virtual if requested."""

    def __init__(self, action=None, late_ns=(), *, virtual=True):
        super().__init__()
        self.virtual = virtual
        self._action = action
        self._late_ns = dict(late_ns)

    def wait_until(self, deadline_ns):
        if self._action is not None and deadline_ns >= MIDDLE_NS:
            action, self._action = self._action, None
            action()
        late_ns = max(self._late_ns.get(deadline_ns, 0), self._now_ns - deadline_ns)
        self._now_ns = deadline_ns + late_ns
        return late_ns


def limit(session, **changes):
    session.profile = replace(session.profile, limits=replace(session.profile.limits, **changes))


def motor(session, **changes):
    rig = session.profile.rig
    changed = replace(rig, motor=replace(rig.motor, **changes))
    session.profile = replace(session.profile, rig=changed)


def sensor(session, wrong_from=MIDDLE, **faults):
    faulty = Sensor(session.devices.sensor, wrong_from)
    for name, value in faults.items():
        setattr(faulty, name, value)
    session.devices = Devices(session.drive, faulty, simulated=True)


def jump(session):
    session.drive.fault_at, session.drive.fault = MIDDLE, lambda angle_rad: angle_rad + 0.005


def stick_encoder(session, at, every=0):
    session.drive.fault_at, session.drive.fault = at, StuckReadings(every)


def strengthen(session):
    """Let the motor exert more than twice the torque that is commanded."""
    inner, command = session.drive.inner, session.drive.inner.command

    def strong(torque_nm):
        command(2.5 * torque_nm)
        return torque_nm

    inner.command = strong


def demand_excessive_torque(session):
    motor(session, peak_torque_nm=0.04)
    limit(session, torque_command_nm=0.05)


def drop_sto(session):
    def drop():
        assert session.drive.enabled
        session.drive.inner.sto_dropped = True

    session.clock = Clock(drop)


def fill_disk(session):
    session.clock = Clock(lambda: session.shared_state.__setitem__(StateField.DISK_FREE_MB, 40))


def miss(session, *late_ns):
    """Miss ticks from the middle on, so many ns a quarter of a second apart."""
    late = {MIDDLE_NS + 250_000_000 * k: ns for k, ns in enumerate(late_ns)}
    session.clock = Clock(late_ns=late, virtual=False)


def lag(session):
    limit(session, recorder_lag_s=1.0)
    session.clock = Clock(virtual=False)  # nothing reads the ring


@dataclass(frozen=True)
class Case:
    """How an interlock is made to act, and its message."""

    happens: Callable
    message: str


CASES = {
    "angle": Case(
        # Beyond the demand of the reference, at which the session would not begin.
        lambda s: (
            limit(s, angle_rad=0.03),
            sensor(s, 2200, added=[0.0, 0.0, 0.0, 0.0, 0.0, -0.5]),
        ),
        r"Angle -?0\.03\d* rad exceeds limit 0\.03 rad",
    ),
    "velocity": Case(
        lambda s: limit(s, velocity_rad_s=0.3),
        r"Speed -?0\.3\d* rad/s exceeds limit 0\.3 rad/s",
    ),
    "tracking error": Case(
        lambda s: limit(s, tracking_error_rad=0.005),
        r"Tracking error -?0\.005\d* rad exceeds limit 0\.005 rad",
    ),
    "encoder jump": Case(jump, r"Encoder jump 0\.00[45]\d* rad exceeds limit 0\.002\d* rad"),
    "frozen encoder": Case(
        lambda s: stick_encoder(s, at=1500),
        r"Net torque while the encoder stands still -?0\.\d+ N·m exceeds limit 0\.\d+ N·m",
    ),
    "stopped encoder": Case(
        lambda s: stick_encoder(s, at=FAST),
        r"Torque that the sudden stop of the encoder would have required \d?\.?\d+ N·m exceeds",
    ),
    "repeated angle": Case(
        lambda s: stick_encoder(s, at=1500, every=2),
        r"Number of encoder readings that repeat the one before while the shaft moves 6 in 32 tick",
    ),
    "scales": Case(
        strengthen,
        r"Ratio of the net torque .* acceleration 0\.\d+ below limit 0\.5 ",
    ),
    "frozen sensor": Case(
        lambda s: sensor(s, stuck=StuckReadings()),
        r"Run of identical readings of all sensor channels 20 ticks exceeds limit 19 ticks",
    ),
    "frozen channel": Case(
        lambda s: sensor(s, stuck_axis=(1, StuckReadings())),
        r"Run of identical readings of the sensor's fy_n \d+ ticks exceeds limit \d+ ticks",
    ),
    "repeated wrench": Case(
        lambda s: sensor(s, stuck=StuckReadings(2)),
        r"Percentage of readings of the sensor's whole wrench that repeat the one before \d\d\.\d",
    ),
    "torque command": Case(
        demand_excessive_torque,
        r"Torque command -?0\.0\d+ N·m exceeds limit 0\.05 N·m",
    ),
    "i²t": Case(
        lambda s: motor(s, continuous_torque_nm=0.01, thermal_time_constant_s=0.5),
        r"Motor's rms torque \(i²t\) 0\.0\d+ N·m exceeds limit 0\.01 N·m",
    ),
    "wrench range": Case(
        lambda s: sensor(s, added=[0.0, -25.0, 0.0, 0.0, 0.0, 0.0]),
        r"Sensor's fy -25\.\d+ N exceeds limit 22 N",
    ),
    "gauge saturation": Case(
        lambda s: (limit(s, saturated_ticks_in_a_row=5), sensor(s, saturated=True)),
        r"Run of ticks with a saturated sensor 6 ticks exceeds limit 5 ticks",
    ),
    "stale angle": Case(
        lambda s: setattr(s.drive, "stale_at", MIDDLE),
        r"Run of ticks without a new angle 4 ticks exceeds limit 3 ticks",
    ),
    "stale wrench": Case(
        lambda s: sensor(s, stale=True),
        r"Run of ticks without a new wrench 4 ticks exceeds limit 3 ticks",
    ),
    "stale angle share": Case(
        lambda s: (
            setattr(s.drive, "stale_at", MIDDLE),
            setattr(s.drive, "stale_pattern", (False, True, True)),
        ),
        r"Percentage of ticks without a new angle 1\.01 % exceeds limit 1 %",
    ),
    "stale wrench share": Case(
        lambda s: sensor(s, stale=True, stale_every=2),
        r"Percentage of ticks without a new wrench 1\.01 % exceeds limit 1 %",
    ),
    "missed ticks": Case(
        lambda s: miss(s, 80_000_000),
        r"Run of missed ticks 80 ticks exceeds limit 50 ticks",
    ),
    "missed share": Case(
        lambda s: miss(s, *[45_000_000] * 6),
        r"Percentage of missed ticks 2\.\d* % exceeds limit 2 %",
    ),
    "wired stop": Case(drop_sto, r"Simulated drive: the wired stop \(STO\) was dropped.* reset"),
    "recorder lag": Case(lag, r"Recorder backlog 1\.\d+ s exceeds limit 1 s"),
    "disk space": Case(fill_disk, r"Free space on the session's disk 40 MB below limit 50 MB"),
    "operator stop": Case(
        lambda s: setattr(s, "clock", Clock(s.stop.request)), r"Stopped by the operator\."
    ),
}
ON_THE_WIRE = {
    "bus-off": "controller off the bus",
    "emergency message": "emergency message",
    "wired stop": "wired stop (STO) opened",
}
"""Rows of docs/faults.md that have separate tests."""
AT_REST = {"tare drift"}
INTERLOCKS_BY_NAME = {row.name: row for row in INTERLOCKS}


def test_every_interlock_has_its_test():
    assert len(INTERLOCKS_BY_NAME) == len(INTERLOCKS)
    assert CASES.keys() | ON_THE_WIRE.keys() | AT_REST == INTERLOCKS_BY_NAME.keys()
    faults = (Path(__file__).parents[2] / "docs" / "faults.md").read_text("utf-8")
    assert all(f"\n| {row} | `" in faults for row in ON_THE_WIRE.values())


@pytest.mark.parametrize("name", CASES)
def test_an_interlock_ends_the_session_without_torque(make_session, name):
    case, row = CASES[name], INTERLOCKS_BY_NAME[name]
    session = make_session()
    case.happens(session)
    session.run()
    session.assert_safe()
    assert not session.drive.inner._plant.enabled
    finished = session.finished
    assert finished.outcome == ("stopped" if row.action is Action.STOP else "fault")
    assert re.match(case.message, finished.reason), finished.reason
    if row.limit:
        assert f"({row.limit}). {row.remedy}" in finished.reason
    samples = session.samples
    assert samples["status"][-1] & Status.TORQUE_OFF
    assert samples["torque_command_nm"][-1] == 0.0
    counts = finished.counts
    assert counts["scheduled"] == len(samples) + counts["missed"] + counts["lost"]
    assert counts["scheduled"] < 3000


def resting(make_session):
    """A session without motion: the beam does not swing after it."""
    return make_session(excitation=hold(rate_hz=1000.0, duration_s=1.5, rest_s=0.5))


def test_a_zero_drift_in_a_session_is_reported(make_session):
    session = resting(make_session)
    sensor(session, wrong_from=3600, added=[0.0, 0.0, 0.0, 0.0, 0.0, 0.05])
    finished = session.run().finished
    session.assert_safe()
    assert finished.outcome == "complete"  # the record is what it is
    assert re.match(
        r"After the record: Drift of the coupling torque's zero 0\.0\d+ N·m exceeds "
        r"limit 0\.01 N·m \(limits\.tare_drift_nm\)",
        finished.reason,
    )
    assert 0.049 < float(finished.results["tare_drift_nm"]) < 0.051


@pytest.mark.parametrize("operator_tares", [False, True])
def test_a_zero_drift_between_sessions_needs_a_tare(make_session, operator_tares):
    session = resting(make_session)
    sensor(session, wrong_from=4301, added=[0.0, 0.0, 0.0, 0.0, 0.0, -0.05])
    job = session.order()
    session.obey(*[job, *([TareOrder()] if operator_tares else []), job])
    session.assert_safe()
    first, second = session.parent.messages_of(SessionFinished)
    assert (first.outcome, first.reason) == ("complete", "")
    if operator_tares:
        assert (second.outcome, second.reason) == ("complete", "")
    else:
        assert second.outcome == "fault"
        assert re.match(r"Drift of .* zero -0\.0\d+ N·m exceeds limit", second.reason)
        assert "rigd tare" in second.reason
        assert second.counts["scheduled"] == 0


def test_the_tare_of_a_frozen_sensor_is_refused(make_session):
    session = make_session()
    sensor(session, wrong_from=0, stuck=StuckReadings())
    session.obey(TareOrder())
    (refused,) = session.parent.messages_of(MeasurementRefused)
    assert refused.reason.startswith("Run of identical readings of all sensor channels")
    session.assert_safe()


def test_a_small_drift_is_a_warning(make_session):
    session = resting(make_session)
    sensor(session, wrong_from=3600, added=[0.0, 0.0, 0.0, 0.0, 0.0, 0.005])
    finished = session.run().finished
    assert (finished.outcome, finished.reason) == ("complete", "")
    [warning] = [event for event in session.events if event.level == "warning"]
    assert re.match(r"Drift of the .* zero 0\.00\d+ N·m above warning level", warning.message)


def test_values_near_a_limit_are_reported_once_and_flagged(make_session):
    session = make_session()
    limit(session, angle_rad=0.028)  # of which 0.8 are 0.0224; the chirp reaches 0.025
    finished = session.run().finished
    assert finished.outcome == "complete", finished
    samples = session.samples
    flagged = samples["status"] & Status.LIMIT_WARNING != 0
    near = abs(samples["angle_rad"]) >= 0.8 * 0.028
    assert near.sum() > 100
    assert (flagged == near).all()
    warnings = [event for event in session.events if event.level == "warning"]
    assert 1 <= len(warnings) <= 3
    assert all(re.match(r"Angle .* rad above warning level", w.message) for w in warnings)


def test_motor_heat_carries_over_between_sessions(make_session, complete_session):
    commanded = complete_session[1]["torque_command_nm"]
    heat_nm2 = float((commanded**2).sum()) / 1000 / 1e4  # no cooling in 10 000 s
    session = make_session()
    motor(session, continuous_torque_nm=(1.5 * heat_nm2) ** 0.5, thermal_time_constant_s=1e4)
    job = session.order()
    session.obey(job, job)
    first, second = session.parent.messages_of(SessionFinished)
    assert (first.outcome, first.reason) == ("complete", "")
    assert second.outcome == "fault"
    assert "i²t" in second.reason
    session.assert_safe()


@pytest.mark.parametrize("name", [further("sim"), "antenna_can", "antenna_serial"])
def test_the_paper_s_chirp_comes_near_no_limit(name):
    """Its predicted torque, speed and angle pass the limits of each shipped profile."""
    profile = load_profile(name)
    excitation = chirp(rate_hz=1000.0)
    response = close_loop(profile.loop_model()).simulate(excitation.reference_rad)
    watch = make_limit_monitor(profile)
    resolution_rad = profile.rig.encoder.resolution_rad
    angles_rad = (response.angle_rad / resolution_rad).round() * resolution_rad
    rest, squares_nm2 = (0.0,) * 5, 0.0
    for tick, (reference, angle, torque, coupling) in enumerate(
        zip(
            excitation.reference_rad.tolist(),
            angles_rad.tolist(),
            response.torque_nm.tolist(),
            response.coupling_torque_nm.tolist(),
            strict=True,
        )
    ):
        assert watch.check(reference, angle, (*rest, coupling)) is None
        squares_nm2 += torque**2
        if tick % 64 == 0:
            assert watch.check_slow(tick * 1_000_000, squares_nm2) is None
            squares_nm2 = 0.0
    assert watch.take_notices() == []


@pytest.mark.parametrize(
    ("amplitude_rad", "slow"),
    [(0.01, True), (0.025, False), further(0.01, False), further(0.025, True)],
)
def test_a_reversed_angle_is_distinguished_from_excessive_amplitude(
    make_session, amplitude_rad, slow
):
    excitation = chirp(
        rate_hz=1000.0, amplitude_rad=amplitude_rad, duration_s=4.0, rest_s=0.5, stop_hz=5.0
    )
    session = make_session(excitation=excitation)
    if slow:  # the limits of a real rig
        limit(session, velocity_rad_s=4.0, tracking_error_rad=0.1)
    session.drive.fault_at, session.drive.fault = 1, lambda angle_rad: -angle_rad
    reason = session.run().finished.reason
    session.assert_safe()
    assert " exceeds limit " in reason
    assert "against the torque" in reason
    assert "object 607E" in reason
    assert "lower the amplitude" not in reason


@pytest.mark.parametrize("push_nm", [-0.5, 1.5])
def test_a_push_on_the_beam_is_no_wrong_sign(make_session, push_nm):
    """A loop with the right sign turns with its torque, under any load on the sensor."""
    slow = chirp(rate_hz=1000.0, duration_s=4.0, rest_s=0.5, stop_hz=5.0)
    session = make_session(excitation=slow)
    limit(session, velocity_rad_s=2.0, tracking_error_rad=0.02)
    sensor(session, wrong_from=3000, added=[0.0, 0.0, 0.0, 0.0, 0.0, push_nm])
    reason = session.run().finished.reason
    assert " exceeds limit " in reason
    assert "against the torque" not in reason


def test_an_excessive_amplitude_is_no_wrong_sign(make_session):
    session = make_session()
    limit(session, velocity_rad_s=0.4)
    reason = session.run().finished.reason
    assert "Speed " in reason
    assert "lower the amplitude" in reason
    assert "against the torque" not in reason
