"""The control process between and around sessions: orders, zero, rest, and devices that fail."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.devices.contracts import DeviceError, LineHealth
from rigd.engine.messages import (
    ControlEnded,
    MeasurementRefused,
    MeasurementResult,
    ReadyToRecord,
    SessionFinished,
    TareOrder,
    ZeroOrder,
)
from rigd.engine.shared_state import Phase, StateField
from rigd.engine.timing import SuspendMonitor, VirtualClock
from rigd.excitation import hold, step
from rigd.session.layout import Status


class FakeRealClock(VirtualClock):
    """Never late, but not virtual: the idle loop polls."""

    virtual = False


def short(session, **options):
    rate_hz = session.profile.rig.rate_hz
    excitation = hold(rate_hz=rate_hz, duration_s=0.5, rest_s=0.1, ring_down_s=0.0)
    return session.order(options.get("excitation", excitation))


def test_sessions_follow_each_other_on_one_connection(make_session):
    session = make_session()
    connects = []
    connect = session.drive.connect
    session.drive.connect = lambda: (connects.append(1), connect())
    session.obey(short(session), short(session))
    first, second = session.parent.messages_of(SessionFinished)
    assert (first.outcome, second.outcome) == ("complete", "complete")
    assert first.counts == second.counts == {
        "scheduled": 600, "missed": 0, "late": 0, "lost": 0,
        "stale_angles": 0, "stale_wrenches": 0,
    }  # fmt: skip
    assert connects == [1]
    assert session.samples["tick"].tolist() == [*range(600), *range(600)]
    assert session.parent.messages_of(ControlEnded) == [ControlEnded("")]
    session.assert_safe()


@pytest.mark.parametrize("clock", [further(VirtualClock), FakeRealClock])
def test_the_zero_stays_where_the_operator_sets_it(make_session, clock):
    session = make_session(clock=clock())
    session.drive.fault_at, session.drive.fault = 1, lambda angle: angle + 0.3
    session.obey(short(session), ZeroOrder(), short(session), short(session))
    (zeroed,) = session.parent.messages_of(MeasurementResult)
    assert zeroed.values["moved_rad"] == pytest.approx(0.3, abs=3 * 7e-5)
    starts = [float(m.tare["start_angle_rad"]) for m in session.parent.messages_of(ReadyToRecord)]
    assert starts == pytest.approx([0.3, 0.0, 0.0], abs=3 * 7e-5)
    samples = session.samples
    assert np.abs(samples["angle_rad"][-1200:]).max() < 1e-2


def test_limits_are_relative_to_the_zero(make_session):
    session = make_session()
    limit_rad = session.profile.limits.angle_rad
    session.drive.fault_at, session.drive.fault = 1, lambda angle: angle + 1.1 * limit_rad
    session.obey(short(session), ZeroOrder(), short(session))
    refused, fine = session.parent.messages_of(SessionFinished)
    assert refused.outcome == "fault"
    assert "outside limits.angle_rad" in refused.reason
    assert "turn it back and start again" in refused.reason
    assert refused.device_failed is False
    assert fine.outcome == "complete"


def test_no_zeroing_while_the_motor_moves(make_session):
    session = make_session()
    session.drive.fault_at = 1
    session.drive.fault = lambda angle: angle + 1e-5 * session.drive.reads
    session.obey(ZeroOrder())
    (refused,) = session.parent.messages_of(MeasurementRefused)
    assert "rest_velocity_rad_s" in refused.reason
    session.assert_safe()


def test_a_tare_between_sessions_reports_the_mean_wrench(make_session):
    session = make_session()
    session.obey(TareOrder())
    (tared,) = session.parent.messages_of(MeasurementResult)
    offset = session.profile.rig.simulation.offset
    assert tared.values["mean"]["fz_n"] == pytest.approx(offset[2], abs=0.01)
    assert tared.values["torque_std_nm"] < session.profile.session.rest_torque_nm
    assert session.drive.torques == []


def test_a_session_waits_until_the_beam_is_at_rest(make_session):
    session = make_session()
    rate_hz = session.profile.rig.rate_hz
    kick = step(rate_hz=rate_hz, amplitude_rad=0.1, duration_s=0.5, ring_down_s=0.0)
    session.obey(short(session, excitation=kick), short(session))
    first, second = session.parent.messages_of(SessionFinished)
    assert (first.outcome, second.outcome) == ("complete", "complete")
    waits = [event.message for event in session.events if "Waiting until" in event.message]
    assert len(waits) == 1
    assert "The beam is not at rest" in waits[0]
    tares = [float(m.tare["tare_std_tz_nm"]) for m in session.parent.messages_of(ReadyToRecord)]
    assert max(tares) <= session.profile.session.rest_torque_nm


def test_the_wait_for_rest_has_a_timeout(make_session):
    session = make_session()
    settings = replace(session.profile.session, rest_timeout_s=1.0)
    session.profile = replace(session.profile, session=settings)
    rate_hz = session.profile.rig.rate_hz
    kick = step(rate_hz=rate_hz, amplitude_rad=0.1, duration_s=0.5, ring_down_s=0.0)
    session.obey(short(session, excitation=kick), short(session))
    refused = session.parent.messages_of(SessionFinished)[1]
    assert refused.outcome == "fault"
    assert "rest_timeout_s = 1 s" in refused.reason
    assert refused.counts["scheduled"] == 0
    session.assert_safe()


def test_device_failure_between_sessions_ends_the_connection(make_session):
    def fail(angle_rad):
        raise DeviceError("The drive is gone.")

    session = make_session(clock=FakeRealClock())
    session.drive.fault_at, session.drive.fault = 20, fail
    polls = []
    session.parent.poll = polls.append  # no orders
    session.obey()
    assert session.parent.messages_of(ControlEnded) == [ControlEnded("The drive is gone.")]
    session.assert_safe()


def test_a_silent_encoder_between_sessions_is_reported(make_session):
    session = make_session(clock=FakeRealClock())
    session.drive.stale_at = 50
    session.parent.poll = lambda timeout_s: None
    session.obey()
    (ended,) = session.parent.messages_of(ControlEnded)
    assert "A new angle has not arrived for 1 s" in ended.reason
    session.assert_safe()


def test_stale_readings_do_not_count_in_the_next_session(make_session, monkeypatch):
    session = make_session()
    tare = round(session.profile.session.tare_s * session.profile.rig.rate_hz)
    ends = []

    def stale(drive):
        """Long enough to end the first record in its middle; once in the next tare."""
        ended = len(session.parent.messages_of(SessionFinished))
        if ended and not ends:
            ends.append(drive.reads)
        return (not ended and drive.reads > tare + 900) or (
            bool(ends) and drive.reads == ends[0] + 5
        )

    monkeypatch.setattr(type(session.drive), "angle_stale", property(stale))
    session.obey(short(session), short(session))
    first, second = session.parent.messages_of(SessionFinished)
    assert first.outcome == "fault"
    assert "angle" in first.reason
    assert (second.outcome, second.reason) == ("complete", "")


def test_device_failure_in_a_session_ends_the_connection(make_session):
    def fail(angle_rad):
        raise DeviceError("The drive is gone.")

    session = make_session()
    session.drive.fault_at, session.drive.fault = 1300, fail
    session.obey(short(session), short(session))
    (finished,) = session.parent.messages_of(SessionFinished)
    assert finished.outcome == "fault"
    assert finished.device_failed is True
    assert session.parent.messages_of(ControlEnded) == [ControlEnded("The drive is gone.")]
    session.assert_safe()


def test_a_hanging_supervisor_ends_the_session(make_session):
    session = make_session(clock=FakeRealClock())
    calls = []

    def alive():
        calls.append(1)
        if (
            session.shared_state[StateField.PHASE] != Phase.RUNNING
            or session.shared_state[StateField.SCHEDULED_TICKS] < 500
        ):
            session.shared_state.beat(StateField.SUPERVISOR_BEAT)
        return True

    session.parent.alive = alive
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert session.finished.reason == (
        "Supervisor watchdog timeout (2 s); session aborted. Check CPU load."
    )
    samples = session.samples
    assert 2400 < len(samples) < 2800
    assert samples["status"][-1] & Status.TORQUE_OFF
    assert samples["torque_command_nm"][-1] == 0.0


def test_a_suspend_of_the_computer_ends_the_session(make_session, monkeypatch):
    boot_ns = [0]
    watch = SuspendMonitor(monotonic_ns=lambda: 0, boot_ns=lambda: boot_ns[0])
    monkeypatch.setattr("rigd.engine._session_sequence.SuspendMonitor", lambda: watch)
    session = make_session(clock=FakeRealClock())

    read_angle = session.drive.read_angle

    def suspended():
        if session.shared_state[StateField.SCHEDULED_TICKS] == 1000:
            boot_ns[0] = 90_000_000_000
        return read_angle()

    session.drive.read_angle = suspended
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert "suspended for 90.0 s" in session.finished.reason
    assert 1000 < len(session.samples) <= 1066


def test_readings_and_heartbeat_are_in_the_shared_state(make_session):
    session = make_session(clock=FakeRealClock())
    session.drive.fault_at, session.drive.fault = 1, lambda angle: angle + 0.25
    beats = []
    orders = [None] * 5

    def poll(timeout_s):
        beats.append(session.shared_state[StateField.CONTROL_BEAT])
        if not orders:
            raise EOFError
        return orders.pop()

    session.parent.poll = poll
    session.obey()
    assert beats == sorted(set(beats))
    assert session.shared_state[StateField.ANGLE_NRAD] == pytest.approx(0.25e9, abs=3e5)
    assert session.shared_state[StateField.TORQUE_COMMAND_NNM] == 0


def jump_between(session, n, counts=8000):
    """Let the encoder slip while the rig is ready, after the `n`-th order."""
    give, given = session.parent.poll, []

    def poll(timeout_s):
        given.append(1)
        if len(given) == n + 1:
            slip_rad = counts * session.profile.rig.encoder.resolution_rad
            session.drive.fault_at, session.drive.fault = 1, lambda angle_rad: angle_rad + slip_rad
        return give(timeout_s)

    session.parent.poll = poll


SLIPS = [
    ("zero", "session", 8000),
    ("session", "zero", 80),
    ("tare", "tare", -8000),
    (None, "session", 80),
]
SLIP = ("session", "session", -80)


@pytest.mark.parametrize(
    ("first", "then", "counts", "clock"),
    [
        *((*slip, FakeRealClock) for slip in (SLIP, *SLIPS)),
        (*SLIP, VirtualClock),
        *(further(*slip, VirtualClock) for slip in SLIPS),
    ],
)
def test_encoder_slip_between_two_orders_is_detected(make_session, clock, first, then, counts):
    session = make_session(clock=clock())

    def order(name):
        return (
            short(session)
            if name == "session"
            else {"zero": ZeroOrder(), "tare": TareOrder()}[name]
        )

    orders = [order(name) for name in (first, then) if name is not None]
    jump_between(session, len(orders) - 1, counts)
    session.obey(*orders)
    (ended,) = session.parent.messages_of(ControlEnded)
    assert "The encoder jumped by " in ended.reason
    assert f"{counts * 7e-5:.2g}"[:-1] in ended.reason
    assert "set the zero again" in ended.reason
    finished = session.parent.messages_of(SessionFinished)
    if then == "session" and clock is VirtualClock:
        assert finished[-1].outcome == "fault"
        assert finished[-1].device_failed is True
        assert finished[-1].counts["scheduled"] == 0
    assert session.parent.messages_of(MeasurementRefused) == []
    session.assert_safe()


def test_encoder_slip_before_the_tare_is_detected(make_session):
    """Within the readings of the tare as well, where it resembled a moving motor."""
    session = make_session()
    session.drive.fault_at, session.drive.fault = 500, lambda angle_rad: angle_rad + 0.56
    session.obey(short(session))
    (finished,) = session.parent.messages_of(SessionFinished)
    assert finished.device_failed is True
    assert "The encoder jumped by 0.56 rad within one tick" in finished.reason


def test_encoder_slip_in_a_session_ends_the_connection(make_session):
    session = make_session()
    session.drive.fault_at, session.drive.fault = 1300, lambda angle_rad: angle_rad + 0.05
    session.obey(ZeroOrder(), short(session), short(session))
    (finished,) = session.parent.messages_of(SessionFinished)
    assert "ncoder jump " in finished.reason
    assert finished.device_failed is True
    assert len(session.parent.messages_of(ControlEnded)) == 1
    session.assert_safe()


@pytest.mark.parametrize("speed_rad_s", [further(0.1), further(1.0), 3.0])
def test_the_motor_may_be_turned_by_hand_between_sessions(make_session, speed_rad_s):
    """Acceleration and deceleration within 0.1 s each, over a quarter of a turn."""
    session = make_session(clock=FakeRealClock())
    rate_hz = session.profile.rig.rate_hz
    speeds = np.interp(np.arange(1000), [200, 300, 600, 700], [0.0, speed_rad_s, speed_rad_s, 0.0])
    turned = np.cumsum(speeds) / rate_hz

    def hand(angle_rad):
        return angle_rad + float(turned[min(session.drive.reads, len(turned) - 1)])

    session.drive.fault_at, session.drive.fault = 1, hand
    polls = [None] * 20
    session.parent.poll = lambda timeout_s: polls.pop() if polls else ZeroOrder()
    done = session.parent.send

    def send(message):
        done(message)
        if isinstance(message, MeasurementResult):
            session.stop.request()

    session.parent.send = send
    session.obey()
    assert session.parent.messages_of(ControlEnded) == [ControlEnded("")]
    (zeroed,) = session.parent.messages_of(MeasurementResult)
    assert zeroed.values["moved_rad"] == pytest.approx(turned[-1], abs=1e-3)


@pytest.mark.parametrize("bits", [None, 0])
def test_virtual_time_passes_for_a_device_with_heartbeat(make_session, monkeypatch, bits):
    """On a line only: time is paused for a rig simulated in this process."""
    monkeypatch.setattr("rigd.engine.control_process.MAX_VIRTUAL_PAUSE_S", 0.0)
    session = make_session()
    session.drive.health = lambda: LineHealth(bits)
    reads = []

    def poll(timeout_s):
        reads.append(session.drive.reads)
        if len(reads) > 5:
            raise EOFError

    session.parent.poll = poll
    session.obey()
    reads_per_poll = 0 if bits is None else 1
    assert np.diff(reads).tolist() == [reads_per_poll] * 5
