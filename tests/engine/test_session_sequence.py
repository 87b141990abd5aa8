"""A session from rest to rest, and every way out of it: the torque is off, the counts add up."""

import itertools
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cases import further

from rigd.control import close_loop
from rigd.devices.contracts import DeviceError
from rigd.engine import IDLE_NAME
from rigd.engine.messages import DevicesConnected, ProbeOrder, ReadyToRecord, SessionFinished
from rigd.engine.shared_state import Activity, Phase, StateField, StopReason, activity
from rigd.engine.timing import VirtualClock
from rigd.excitation import hold
from rigd.runtime.processes import name_this_process
from rigd.session.layout import Status, decode_samples
from rigd.session.limits import MAX_SAMPLES


def counts_of(**counts):
    """The counts of a session, of which all but those given are zero."""
    nothing = ("scheduled", "missed", "late", "lost", "stale_angles", "stale_wrenches")
    return dict.fromkeys(nothing, 0) | counts


def assert_counts_add_up(session, samples):
    counts = session.finished.counts
    assert counts["scheduled"] == len(samples) + counts["missed"] + counts["lost"]


BRIEF = hold(rate_hz=1000.0, duration_s=0.2, rest_s=0.0, ring_down_s=0.0)


def test_a_complete_session_has_every_tick(complete_session):
    session, samples = complete_session
    assert session.finished.outcome == "complete"
    assert session.finished.reason == ""
    assert session.finished.counts == counts_of(scheduled=3000)
    assert np.array_equal(samples["tick"], np.arange(3000))
    assert np.array_equal(samples["t_ns"], 1_000_000 * np.arange(3000))
    assert not samples["lateness_ns"].any()
    assert not samples["work_ns"].any()
    assert not np.bitwise_and(samples["status"], Status.TORQUE_OFF).any()
    session.assert_safe()


def test_the_reference_starts_at_the_angle_of_the_motor(complete_session):
    session, samples = complete_session
    relative = samples["angle_reference_rad"] - samples["angle_reference_rad"][0]
    assert np.allclose(relative, session.excitation.reference_rad, atol=1e-15)
    assert abs(samples["angle_reference_rad"][0] - samples["angle_rad"][0]) < 3 * 7e-5


def test_the_tare_removes_the_offset(complete_session):
    session, samples = complete_session
    ready = session.parent.messages_of(ReadyToRecord)[0].tare
    offset = session.profile.rig.simulation.offset
    axes = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
    for axis, expected in zip(axes, offset, strict=True):
        spread = float(ready[f"tare_std_{axis}"])
        assert abs(float(ready[f"tare_mean_{axis}"]) - expected) < 0.2 * spread
    rest = samples[: session.excitation.segments["rest"][1]]
    assert abs(rest["fz_n"].mean()) < 0.01
    assert abs(rest["coupling_torque_nm"].mean()) < 1e-3
    assert np.array_equal(rest["coupling_torque_nm"], rest["tz_nm"])


def test_an_ideal_rig_is_the_computed_closed_loop(make_session, quiet_profile):
    session = make_session(profile=quiet_profile).run()
    response = close_loop(quiet_profile.loop_model()).simulate(session.excitation.reference_rad)
    samples = session.samples
    scale = np.abs(response.angle_rad).max()
    assert np.abs(samples["angle_rad"] - response.angle_rad).max() < 0.02 * scale
    scale = np.abs(response.torque_nm).max()
    assert np.abs(samples["torque_command_nm"] - response.torque_nm).max() < 0.02 * scale


def test_a_seed_repeats_the_samples(make_session):
    session = make_session(excitation=BRIEF)
    session.obey(session.order(seed=None), session.order(seed=None))
    first, second = (
        int(ready.tare["simulation_seed"]) for ready in session.parent.messages_of(ReadyToRecord)
    )
    assert first != second
    here, there = np.split(session.samples, 2)
    assert not np.array_equal(here["coupling_torque_nm"], there["coupling_torque_nm"])
    again = make_session(excitation=BRIEF)
    again.obey(again.order(seed=first))
    assert np.array_equal(here, again.samples)


class StopAt(VirtualClock):
    """A clock that runs an action at one of its deadlines."""

    def __init__(self, at_ns, action):
        super().__init__()
        self._at_ns = at_ns
        self._action = action

    def wait_until(self, deadline_ns):
        if deadline_ns == self._at_ns:
            self._action()
        return super().wait_until(deadline_ns)


@pytest.mark.parametrize(
    ("action", "outcome", "words"),
    [
        (
            lambda s: s.shared_state.__setitem__(StateField.STOP_REASON, StopReason.OPERATOR),
            "stopped",
            "operator",
        ),
        (
            lambda s: s.shared_state.__setitem__(StateField.STOP_REASON, StopReason.NO_RECORDER),
            "fault",
            "recorder",
        ),
        (lambda s: setattr(s.parent, "living", False), "fault", "supervising"),
        (lambda s: s.stop.request(), "stopped", "operator"),
    ],
)
@pytest.mark.parametrize("at_s", [further(0.3), further(1.2), 2.0])
def test_a_stop_leaves_the_torque_off(make_session, action, outcome, words, at_s):
    assert_stop_leaves_torque_off(make_session(), action, outcome, words, at_s)


@pytest.mark.parametrize("at_s", [0.3, 0.8])
def test_a_stop_before_the_record_leaves_the_torque_off(make_session, at_s):
    def stop(session):
        session.shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

    assert_stop_leaves_torque_off(make_session(), stop, "stopped", "operator", at_s)


def assert_stop_leaves_torque_off(session, action, outcome, words, at_s):
    session.clock = StopAt(int(at_s * 1e9), lambda: action(session))
    session.run()
    session.assert_safe()
    assert session.finished.outcome == outcome
    assert words in session.finished.reason
    samples = session.samples
    if samples is not None:
        assert samples["status"][-1] & Status.TORQUE_OFF
        assert samples["torque_command_nm"][-1] == 0.0
        assert samples["tick"][-1] + 1 == session.finished.counts["scheduled"]
        assert_counts_add_up(session, samples)
    else:
        assert session.finished.counts["scheduled"] == 0


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda angle: angle + 2.0, " exceeds limit "),
        (lambda angle: float("nan"), "not a number"),
        (lambda angle: float("inf"), "not a number"),
    ],
)
@pytest.mark.parametrize("read", [1200, further(1501), further(2000)])
def test_a_reading_beyond_its_limit_is_a_fault_at_once(make_session, fault, words, read):
    session = make_session()
    session.drive.fault_at, session.drive.fault = read, fault
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert words in session.finished.reason
    # With the session over, two more measure the motor's angle, unless the encoder failed.
    after = 0 if session.finished.device_failed else 2
    assert session.drive.reads == read + after
    samples = session.samples
    if samples is not None:
        assert samples["status"][-1] & Status.TORQUE_OFF
        assert samples["torque_command_nm"][-1] == 0.0
        assert_counts_add_up(session, samples)


@pytest.mark.parametrize(
    ("read", "error"),
    [
        *((read, DeviceError("The drive is gone.")) for read in (3, 1200, 2000, 4200)),
        (2000, ZeroDivisionError()),
        *(further(read, ZeroDivisionError()) for read in (3, 1200, 4200)),
    ],
)
def test_a_device_that_fails_leaves_the_torque_off(make_session, read, error):
    def fail(angle_rad):
        raise error

    session = make_session()
    session.drive.fault_at, session.drive.fault = read, fail
    if isinstance(error, DeviceError):
        session.run()
        assert "The drive is gone." in session.finished.reason
        samples = session.samples
        if read == 2000:
            expected = Status.TORQUE_OFF | Status.ANGLE_STALE | Status.WRENCH_STALE
            assert samples["status"][-1] & expected == expected
            assert samples["torque_command_nm"][-1] == 0.0
            assert_counts_add_up(session, samples)
    else:
        with pytest.raises(ZeroDivisionError):
            session.run()
    session.assert_safe()


@pytest.mark.parametrize("read", [20, 1200, 1600, 2000])
def test_the_motor_does_not_run_away_without_encoder(make_session, read):
    session = make_session()
    session.drive.stale_at = read
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert "without a new angle" in session.finished.reason
    after = 2 if read > 1000 else 0  # the same here, unless that was the tare
    assert session.drive.reads == read + 3 + after  # three are let through
    samples = session.samples
    if samples is not None:
        assert_counts_add_up(session, samples)
        stale = samples["status"] & Status.ANGLE_STALE
        assert np.flatnonzero(stale).size == min(4, len(samples))
        last = Status(int(samples["status"][-1]))
        assert Status.TORQUE_OFF | Status.LIMIT_WARNING in last


def test_single_stale_angles_are_held_and_flagged(make_session):
    session = make_session()
    # Two in a row, and fast: at 0.16 rad/s the new angle after them is not overspeed either.
    stale = set(range(1500, 3500, 10)) | set(range(1501, 3500, 10))
    limits = replace(session.profile.limits, velocity_rad_s=1.0, stale_percent=6.0)
    session.profile = replace(session.profile, limits=limits)
    type(session.drive).angle_stale, original = (
        property(lambda drive: drive.reads in stale),
        type(session.drive).angle_stale,
    )
    try:
        session.run()
    finally:
        type(session.drive).angle_stale = original
    assert session.finished.outcome == "complete"
    assert np.flatnonzero(session.samples["status"] & Status.ANGLE_STALE).size == len(stale)
    assert session.finished.counts == counts_of(scheduled=3000, stale_angles=len(stale))
    assert session.shared_state[StateField.STALE_ANGLES] == len(stale)
    # Four per cent of ten seconds, of which there may be six: reported once, and past half of it.
    [warning] = [event.message for event in session.events if event.level == "warning"]
    assert warning.startswith("Percentage of ticks without a new angle 3 % above warning level")
    assert "limit 6, limits.stale_percent" in warning


def test_two_of_three_angles_may_not_be_old(make_session):
    """No run of them is longer than two ticks, but the record would be useless."""
    session = make_session()
    session.drive.stale_at, session.drive.stale_pattern = 0, (False, True, True)
    session.run()
    session.assert_safe()
    finished = session.finished
    assert finished.outcome == "fault"
    assert "Percentage of ticks without a new angle 1.01 %" in finished.reason
    assert "acquisition.deadline_us" in finished.reason
    counts, samples = finished.counts, session.samples
    assert counts["stale_angles"] in (101, 102), "one may come with the last sample"
    assert counts["stale_wrenches"] == 0
    assert np.flatnonzero(samples["status"] & Status.ANGLE_STALE).size == counts["stale_angles"]
    assert_counts_add_up(session, samples)
    assert samples["status"][-1] & Status.TORQUE_OFF


def test_old_readings_before_the_record_do_not_count(make_session):
    session = make_session()
    session.drive.stale_at, session.drive.stale_pattern = 0, (False, True, True)
    session.clock = StopAt(1_000_000_000, lambda: setattr(session.drive, "stale_at", None))
    session.run()
    assert session.finished.outcome == "complete"
    assert session.finished.counts["stale_angles"] <= 2


def test_device_failure_at_the_stop_does_not_change_the_outcome(make_session):
    def fail(angle_rad):
        raise OSError("the line is dead")

    session = make_session()
    session.clock = StopAt(2_000_000_000, session.stop.request)
    session.drive.fault_at, session.drive.fault = 2000, fail
    session.run()
    session.assert_safe()
    samples = session.samples
    assert session.finished.outcome == "stopped"
    assert samples["status"][-1] & Status.TORQUE_OFF
    assert samples["torque_command_nm"][-1] == 0.0
    assert_counts_add_up(session, samples)


def test_no_start_while_the_motor_moves(make_session):
    profile = make_session().profile
    brief = replace(profile.session, rest_timeout_s=2.0)
    session = make_session(profile=replace(profile, session=brief))
    session.drive.fault_at = 1
    session.drive.fault = lambda angle: angle + 1e-5 * session.drive.reads
    session.run()
    session.assert_safe()
    assert session.drive.torques == []
    assert session.finished.outcome == "fault"
    assert "not at rest" in session.finished.reason
    assert "rest_timeout_s = 2 s" in session.finished.reason


@pytest.mark.parametrize("sign", [1, -1])
def test_no_start_if_the_reference_exceeds_the_limit(make_session, sign):
    """As after a move: the plan starts at the rig's zero; its limits are checked before motion."""
    session = make_session()
    session.drive.fault_at = 1
    session.drive.fault = lambda angle: angle + sign * 1.56
    session.run()
    session.assert_safe()
    assert session.drive.torques == []
    assert session.finished.outcome == "fault"
    assert session.finished.counts == counts_of()
    goal = f"{sign * 1.585:g} rad, outside limits.angle_rad = 1.57 rad"
    assert f"The motor is at {sign * 1.56:g} rad" in session.finished.reason
    assert goal in session.finished.reason
    assert "rigd run move 0" in session.finished.reason


class LateAt(VirtualClock):
    """A clock that wakes late at some of its deadlines."""

    virtual = False

    def __init__(self, late_ns):
        super().__init__()
        self._late_ns = late_ns

    def wait_until(self, deadline_ns):
        late_ns = max(self._late_ns.get(deadline_ns, 0), self._now_ns - deadline_ns)
        self._now_ns = deadline_ns + late_ns
        return late_ns


def test_missed_ticks_are_skipped_flagged_and_counted(make_session):
    session = make_session(clock=LateAt({2_000_000_000: 3_200_000, 2_500_000_000: 700_000}))
    session.run()
    samples = session.samples
    counts = session.finished.counts
    assert session.finished.outcome == "complete"
    assert counts == counts_of(scheduled=3000, missed=3, late=1)
    assert_counts_add_up(session, samples)
    gap = int(np.flatnonzero(np.diff(samples["tick"]) > 1)[0])
    assert samples["tick"][gap + 1] - samples["tick"][gap] == 4
    after = np.flatnonzero(samples["status"] & Status.AFTER_MISSED)
    assert after.tolist() == [gap + 1]
    assert samples["lateness_ns"][gap + 1] == 200_000
    assert np.flatnonzero(samples["status"] & Status.LATE).size == 1


class WorkingClock(VirtualClock):
    """A clock that runs while this thread works, but not while the computer is paused."""

    virtual = False

    def __init__(self, end_ns, at_end):
        super().__init__()
        self._since_ns = time.thread_time_ns()
        self._end_ns = end_ns
        self._at_end = at_end

    def now_ns(self):
        return self._now_ns + time.thread_time_ns() - self._since_ns

    def wait_until(self, deadline_ns):
        if deadline_ns > self._end_ns:
            self._at_end()
        late_ns = max(0, self.now_ns() - deadline_ns)
        self._now_ns = deadline_ns + late_ns
        self._since_ns = time.thread_time_ns()
        return late_ns


def test_a_long_record_starts_without_a_gap(make_session):
    rate_hz = make_session().profile.rig.rate_hz
    longest = hold(rate_hz=rate_hz, duration_s=MAX_SAMPLES / rate_hz, rest_s=0.0, ring_down_s=0.0)
    session = make_session(excitation=longest)
    session.clock = WorkingClock(2_000_000_000, session.stop.request)
    session.run()
    assert session.finished.outcome == "stopped"
    assert session.samples["tick"][0] <= 2


def test_too_many_missed_ticks_in_a_row_end_the_session(make_session):
    session = make_session(clock=LateAt({2_000_000_000: 80_000_000}))
    session.run()
    session.assert_safe()
    samples = session.samples
    assert session.finished.outcome == "fault"
    assert "missed ticks" in session.finished.reason
    assert session.finished.counts["missed"] == 80
    assert samples["status"][-1] & Status.TORQUE_OFF
    assert_counts_add_up(session, samples)


def test_missed_ticks_explain_a_drive_fault_just_after(make_session):
    session = make_session(clock=LateAt({2_000_000_000: 40_200_000}))

    def fail(_):
        raise DeviceError("The drive reports an error.")

    read = session.drive.read_angle

    def read_angle():
        # Its watchdog has acted meanwhile.
        if session.clock.now_ns() > 2_001_000_000 and session.drive.enabled:
            fail(0.0)
        return read()

    session.drive.read_angle = read_angle
    session.run()
    session.assert_safe()
    assert session.finished.counts["missed"] == 40
    assert session.finished.reason == (
        "The drive reports an error. It came after 40 missed ticks. "
        "The computer is overloaded: close other programs."
    )


def test_ticks_missed_after_the_record_do_not_count(make_session):
    # The last tick, and ten after it.
    late = make_session(clock=LateAt({4_002_000_000: 11_400_000}))
    late.run()
    assert late.finished.outcome == "complete"
    assert late.finished.counts == counts_of(scheduled=3000, missed=1)
    assert_counts_add_up(late, late.samples)


def test_a_lost_sample_ends_the_session_and_is_counted(make_session):
    # The ring holds 2 s. In real time the loop does not wait for the reader, which sleeps so long.
    profile = make_session().profile
    read_late = []

    class ReaderWakes(StopAt):
        virtual = False

    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=2.0)
    session = make_session(excitation=excitation, buffered_s=2.0)
    session.clock = ReaderWakes(
        3_004_000_000, lambda: read_late.append(session.channels.samples.take(1000))
    )
    session.run()
    session.assert_safe()
    samples = np.concatenate([decode_samples(read_late[0]), session.samples])
    assert session.finished.outcome == "fault"
    assert "recorder" in session.finished.reason
    assert session.finished.counts == counts_of(scheduled=2002, lost=1)
    assert_counts_add_up(session, samples)
    assert samples["tick"][-2:].tolist() == [1999, 2001]
    assert session.drive.torques[-1] != 0.0
    assert samples["status"][-1] & Status.AFTER_LOST
    assert samples["status"][-1] & Status.TORQUE_OFF


def test_a_paused_computer_does_not_count_as_recorder_lag(make_session, monkeypatch):
    """The virtual clock waits for it; here it reads once the ring has been full."""
    profile = make_session().profile
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=2.0)
    session = make_session(excitation=excitation, buffered_s=2.0)
    now_s, taken = [0.0], []

    def pause(_):
        now_s[0] += 5.0
        if len(taken) < 2:  # the first time the recorder is paused as well
            taken.append(b"" if not taken else session.channels.samples.take(1500))

    clock = SimpleNamespace(monotonic=lambda: now_s[0], sleep=pause)
    monkeypatch.setattr("rigd.engine._publish.time", clock)
    session.run()
    assert session.finished.outcome == "complete", session.finished.reason
    samples = np.concatenate([decode_samples(taken[1]), session.samples])
    assert samples["tick"].tolist() == list(range(session.finished.counts["scheduled"]))


def test_the_wait_for_a_blocked_recorder_has_a_timeout(make_session, monkeypatch):
    profile = make_session().profile
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=2.0)
    session = make_session(excitation=excitation, buffered_s=2.0)
    seconds = itertools.count(step=0.1)
    clock = SimpleNamespace(monotonic=lambda: next(seconds), sleep=lambda _: None)
    monkeypatch.setattr("rigd.engine._publish.time", clock)
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert session.finished.counts["lost"] == 2  # and the one that has the torque off
    assert_counts_add_up(session, session.samples)


def test_a_sample_lost_in_the_last_tick_is_a_fault(make_session):
    profile = make_session().profile
    session = make_session(
        clock=LateAt({}),
        excitation=hold(rate_hz=profile.rig.rate_hz, duration_s=1.001, rest_s=1.0),
        buffered_s=2.0,
    )
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert session.finished.counts["lost"] == 1
    assert_counts_add_up(session, session.samples)


def test_ticks_missed_at_the_end_count_like_all_others(make_session):
    # The last 100 ticks of the record and some beyond.
    session = make_session(clock=LateAt({3_902_000_000: 150_000_000}))
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert "missed" in session.finished.reason
    counts = session.finished.counts
    assert counts["scheduled"] == 3000
    assert counts["missed"] == 101
    assert_counts_add_up(session, session.samples)


def test_a_swinging_beam_is_no_drift_of_the_sensor(make_session):
    from rigd.excitation import step

    profile = make_session().profile
    session = make_session(
        excitation=step(
            rate_hz=profile.rig.rate_hz, amplitude_rad=0.1, duration_s=0.5, ring_down_s=0.0
        )
    )
    session.run()
    assert session.finished.outcome == "complete"
    assert any("still vibrates" in event.message for event in session.events)
    assert not any(event.level == "warning" for event in session.events)
    assert "tare_drift_nm" not in session.finished.results


def test_refused_settings_are_reported_and_logged(make_session):
    session = make_session(excitation=BRIEF)
    session.obtained = {"clock": "real", "memory": "refused: no", "scheduling": "refused: never"}
    session.run()
    [warning] = [event for event in session.events if event.level == "warning"]
    assert "memory (refused: no), scheduling (refused: never)" in warning.message
    assert session.parent.messages_of(DevicesConnected)[0].realtime == session.obtained


def test_refusals_of_supervisor_and_recorder_are_reported(make_session):
    session = make_session(excitation=BRIEF)
    order = session.order()
    refused = {"supervisor_scheduling": "refused: not permitted"}
    session.obey(replace(order, refused_settings=refused))
    [warning] = [event for event in session.events if event.level == "warning"]
    assert warning.message == (
        "The system did not grant supervisor_scheduling (refused: not permitted): a computer that "
        "is busy with other programs may end the session."
    )


def test_torque_ends_without_action_of_the_supervisor(make_session, monkeypatch):
    monkeypatch.setattr("rigd.engine._session_sequence._START_TIMEOUT_S", 0.2)
    session = make_session()
    session.shared_state[StateField.RECORD_MAY_START] = 0
    session.run()
    session.assert_safe()
    assert session.finished.outcome == "fault"
    assert "did not start the record" in session.finished.reason
    assert session.finished.counts["scheduled"] == 0


def test_the_cycle_disables_the_drive_after_a_session(make_session):
    session = make_session()
    session.clock = StopAt(2_000_000_000, session.stop.request)
    calls = []
    disable = session.drive.disable
    session.drive.disable = lambda: (calls.append(1), disable())
    session.run()
    session.assert_safe()
    assert len(calls) == 3


def test_a_drive_possibly_still_on_is_reported(make_session):
    session = make_session(excitation=BRIEF)
    session.drive.doubt = "Drive: it does not show that it is off."
    finished = session.run().finished
    assert finished.outcome == "complete"  # the record is what it is
    assert finished.reason == "After the record: Drive: it does not show that it is off."


@pytest.mark.parametrize("makes_probe", [False, True])
@pytest.mark.parametrize("confirming_call", [1, 2, 99])
def test_only_a_confirmed_off_is_published(make_session, makes_probe, confirming_call):
    session = make_session(excitation=BRIEF)
    drive, shared_state, published = session.drive, session.shared_state, []
    disable = drive.disable

    def publish():
        process_name = Path("/proc/thread-self/comm").read_text().strip()
        published.append((drive.doubt, Phase(shared_state[StateField.PHASE]), process_name))

    def doubtful_disable():
        disable()
        publish()
        is_confirmed = len(published) >= confirming_call
        drive.doubt = "" if is_confirmed else "Drive: it does not show that it is off."

    drive.disable = doubtful_disable
    name_before = Path("/proc/thread-self/comm").read_text().strip()
    try:
        session.obey(ProbeOrder(session.profile) if makes_probe else session.order())
        publish()
    finally:
        name_this_process(name_before)
    for doubt, phase, process_name in published:
        assert not (doubt and (phase is Phase.OFF or process_name == IDLE_NAME))
    is_doubtful = bool(drive.doubt)
    assert is_doubtful is (confirming_call == 99)
    _, last_phase, last_name = published[-1]
    assert (last_phase is Phase.OFF, last_name == IDLE_NAME) == (not is_doubtful, not is_doubtful)
    assert (activity(shared_state) is Activity.FINISHING) is not is_doubtful


def test_drive_that_was_never_connected_is_not_published_as_off(make_session):
    def fail():
        raise DeviceError("The drive does not answer.")

    session = make_session()
    session.drive.connect = fail
    session.obey()
    assert session.shared_state[StateField.PHASE] == Phase.PREPARING


class StallWhileReturning(VirtualClock):
    """Pauses for 60 periods, once, after the record."""

    shared_state = None

    def wait_until(self, deadline_ns):
        late_ns = super().wait_until(deadline_ns)
        if self.shared_state is not None and self.shared_state[StateField.PHASE] == Phase.RETURNING:
            self.shared_state = None
            return late_ns + 60_000_000
        return late_ns


def test_missed_ticks_while_returning_have_their_limit(make_session):
    clock = StallWhileReturning()
    session = make_session(clock=clock, excitation=BRIEF)
    clock.shared_state = session.shared_state
    finished = session.run().finished
    assert "stalled for 60 ticks" in finished.reason
    session.assert_safe()


def test_doubt_about_reading_age_is_reported_once_per_session(make_session):
    session = make_session()
    health = session.devices.sensor.health

    def doubtful():
        late = session.shared_state[
            StateField.SCHEDULED_TICKS
        ] > 1000 or session.parent.messages_of(SessionFinished)
        count = f"Late so far: {session.shared_state[StateField.SCHEDULED_TICKS]}." if late else ""
        return replace(health(), doubt="Records are late." if late else "", doubt_count=count)

    session.devices.sensor.health = doubtful
    short = hold(rate_hz=1000.0, duration_s=2.0, rest_s=0.2, ring_down_s=0.0)
    session.obey(session.order(short), session.order(short))
    events = session.events
    doubts = [event for event in events if event.message == "Records are late."]
    assert [event.level for event in doubts] == ["warning", "warning"]
    assert doubts[0].t_ns > 1_000_000_000
    assert doubts[1].t_ns == 0, "in its tare"
    counts = [event.message for event in events if event.message.startswith("Late so far")]
    assert counts == ["Late so far: 2200."] * 2
    assert [m.outcome for m in session.parent.messages_of(SessionFinished)] == ["complete"] * 2


def test_the_cause_known_to_the_sensor_is_the_remedy(make_session):
    session = make_session()
    sensor = session.devices.sensor
    health = sensor.health
    sensor.health = lambda: replace(health(), cause="Set the latency timer to 1 ms.")
    sensor.wrench_stale = True
    finished = session.run().finished
    assert finished.outcome == "fault"
    assert finished.reason.endswith("(limits.stale_ticks_in_a_row). Set the latency timer to 1 ms.")
    session.assert_safe()
