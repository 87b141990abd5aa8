"""A controller of a package that misbehaves in a session: it ends as a fault without torque."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from cases import further
from packages import install
from shipped_profile import load_shipped

from rigd.engine.messages import MeasurementResult, ProbeOrder, SessionFinished
from rigd.engine.timing import VirtualClock
from rigd.excitation import hold
from rigd.session.layout import Status

CODE = """
from rigd.control import PidController, design_pid
from rigd.control.declaration import ControllerKind

AT_TICK, ACTION = -1, None

class Law:
    def __init__(self, rig):
        loop = rig.loop
        gains = design_pid(loop.motor_inertia_kg_m2, loop.viscous_nm_s_per_rad, 80.0)
        self.pid = PidController(gains, loop.settings, loop.rate_hz, rig.torque_limit_nm)
        self.ticks = 0

    def reset(self, angle_rad):
        self.pid.reset(angle_rad)
        if AT_TICK == 0:
            ACTION()

    def step(self, *readings):
        self.ticks += 1
        torque_nm = self.pid.step(*readings)
        return ACTION() if self.ticks == AT_TICK else torque_nm

class Shift(Law):
    def step(self, *readings):
        self.ticks += 1
        return ACTION() if self.ticks == AT_TICK else 0.0

LAW = ControllerKind("law", "PID that fails at a tick", make=Law)
SHIFT = ControllerKind("shift", "shift that fails", make=Shift, shifts_reference=True)
"""


@pytest.fixture
def law(tmp_path, monkeypatch):
    """Module of the package with the controller."""
    entry_points = "[rigd.controllers]\nlaw = bad_laws:LAW\nshift = bad_laws:SHIFT\n"
    install(tmp_path, "bad-laws", "0.9", CODE, entry_points)
    monkeypatch.syspath_prepend(tmp_path)
    import bad_laws

    yield bad_laws
    sys.modules.pop("bad_laws", None)


def with_controller(name):
    profile = load_shipped("sim")
    return replace(profile, control=replace(profile.control, controller=name))


def run_hold(make_session, name="law", **options):
    profile = with_controller(name)
    excitation = hold(rate_hz=1000, duration_s=0.5, rest_s=0.0, ring_down_s=0.0)
    return make_session(profile=profile, excitation=excitation, **options)


def failing(error):
    """Return an action that raises an error."""

    def act():
        raise error

    return act


def test_a_sound_controller_acts_like_the_pid_it_contains(make_session, law):
    session = run_hold(make_session).run()
    assert session.finished.outcome == "complete", session.finished.reason
    own = session.samples
    session = run_hold(make_session, "pid").run()
    assert np.array_equal(own["torque_command_nm"], session.samples["torque_command_nm"])
    session.assert_safe()


@pytest.mark.parametrize(
    ("action", "words", "name"),
    [
        (lambda: float("nan"), "it returned nan", "law"),
        further(lambda: float("-inf"), "it returned -inf", "law"),
        (lambda: None, "it returned None", "law"),
        further(lambda: "0.1", "it returned '0.1'", "law"),
        further(lambda: np.zeros(1), "it returned array", "law"),
        (lambda: 10**400, "OverflowError", "law"),
        (failing(ZeroDivisionError("gain")), "ZeroDivisionError: gain", "law"),
        further(failing(SystemExit(3)), "SystemExit: 3", "law"),
        further(lambda: float("nan"), "it returned nan", "shift"),
        (failing(OSError("disk")), "OSError: disk", "shift"),
    ],
)
def test_a_failing_controller_ends_the_session_without_torque(
    make_session, law, monkeypatch, action, words, name
):
    monkeypatch.setattr(law, "AT_TICK", 700)
    monkeypatch.setattr(law, "ACTION", action)
    session = run_hold(make_session, name)
    session.obey(session.order(), session.order())  # the rig stays connected
    assert [each.outcome for each in session.parent.messages_of(SessionFinished)] == [
        "fault",
        "fault",
    ]
    assert words in session.finished.reason
    assert "bad-laws 0.9" in session.finished.reason
    samples = session.samples
    assert samples["tick"][-1] == samples["tick"].max() == 199
    assert samples["status"][-1] & Status.TORQUE_OFF
    assert samples["torque_command_nm"][-1] == 0.0
    session.assert_safe()


@pytest.mark.parametrize("name", ["law", "shift"])
def test_a_torque_beyond_the_limits_ends_the_session_clipped(make_session, law, monkeypatch, name):
    monkeypatch.setattr(law.Law, "step", lambda *_: 1e3)
    monkeypatch.setattr(law.Shift, "step", lambda *_: 1e3)
    session = run_hold(make_session, name).run()
    assert session.finished.outcome == "fault"
    peak_nm = session.profile.rig.motor.peak_torque_nm
    assert 0 < max(map(abs, session.drive.torques), default=peak_nm) <= peak_nm
    session.assert_safe()


def test_a_failing_reset_ends_the_session_without_torque(make_session, law, monkeypatch):
    monkeypatch.setattr(law, "AT_TICK", 0)
    monkeypatch.setattr(law, "ACTION", failing(KeyError("state")))
    session = run_hold(make_session).run()
    assert session.finished.outcome == "fault"
    assert "the controller's reset failed (KeyError: 'state')" in session.finished.reason
    assert session.drive.torques == []
    session.assert_safe()


def test_failure_to_make_a_controller_ends_the_process(make_session, law, monkeypatch):
    monkeypatch.setattr(law, "design_pid", failing(ValueError("no gains")))
    session = run_hold(make_session).run()
    assert "bad-laws 0.9" in session.parent.messages[-1].reason
    assert session.drive.torques == []
    session.assert_safe()


class SlowClock(VirtualClock):
    """Virtual clock that includes the time of a slow controller."""

    def wait_until(self, deadline_ns):
        late_ns = max(0, self.now_ns() - deadline_ns)
        super().wait_until(deadline_ns + late_ns)
        return late_ns

    def spend(self, duration_ns):
        super().wait_until(self.now_ns() + duration_ns)
        return 0.0


def test_a_slow_controller_counts_as_missed_ticks(make_session, law, monkeypatch):
    clock = SlowClock()
    monkeypatch.setattr(law, "AT_TICK", 700)
    monkeypatch.setattr(law, "ACTION", lambda: clock.spend(5_300_000))
    session = run_hold(make_session, clock=clock).run()
    assert session.finished.counts["missed"] == 4
    session.assert_safe()


def test_a_probing_move_has_its_own_controller(make_session, law, monkeypatch):
    monkeypatch.setattr(law.Law, "step", lambda *_: float("nan"))
    session = run_hold(make_session)
    session.obey(ProbeOrder(session.profile), session.order())
    (measured,) = session.parent.messages_of(MeasurementResult)
    assert measured.values["end"] == "COMPLETE"
    assert session.finished.outcome == "fault"  # the session after it has the profile's controller
    session.assert_safe()
