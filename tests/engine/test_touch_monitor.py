"""Reaction of the control loop to a touch; the detector itself has its own tests."""

from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.engine._touch_monitor import TouchMonitor
from rigd.engine.messages import TouchOrder
from rigd.excitation import Approach, TouchPass, reference_after_touch
from rigd.excitation.moves import braking_path, quintic
from rigd.session.layout import Status

RATE_HZ = 1000.0
BRAKING = braking_path(0.05, RATE_HZ)
BACK = quintic(0.4, RATE_HZ)
SHEAR = (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
OUT_TICKS = 500


def one_pass(first):
    """Rest of 200 ticks, way out at 1 rad/s, pause of 300, way back."""
    out = np.arange(1, OUT_TICKS + 1) / RATE_HZ
    reference = np.concatenate([np.zeros(200), out, np.full(300, out[-1]), out[-1] * (1 - BACK)])
    begin_tick = first + 200
    return_tick = begin_tick + OUT_TICKS + 300
    return reference, TouchPass(begin_tick, return_tick, first + reference.size)


class ScriptedDetector:
    """Detects in the ticks set by the test, if it is armed."""

    def __init__(self, *_):
        self.armed_at, self.disarmed_at = [], []
        self.tick = -1
        self.armed = False
        self.at = set()
        self.force_n = {}

    def arm(self):
        self.armed = True
        self.armed_at.append(self.tick + 1)

    def disarm(self):
        self.armed = False
        self.disarmed_at.append(self.tick)

    def step(self, angle_rad, torque_nm, shear_n, *, missed_tick_count, angle_stale, wrench_stale):
        self.seen = angle_rad, torque_nm, shear_n, missed_tick_count, angle_stale, wrench_stale
        self.tick += 1 + missed_tick_count
        return self.armed and self.tick in self.at

    def contact_force_n(self, shear_n):
        return self.force_n.get(self.tick, shear_n)


@pytest.fixture
def search(monkeypatch):
    """Two passes, watched; the detector is scripted."""
    monkeypatch.setattr("rigd.engine._touch_monitor.TouchDetector", ScriptedDetector)
    first, one = one_pass(100)
    second, two = one_pass(100 + first.size)
    planned = np.concatenate([np.zeros(100), first, second, np.zeros(50)])
    reference = array("d", planned)
    cycle = SimpleNamespace(flags=0, wrench=(0.0,) * 6, angle_rad=0.1, coupling_torque_nm=0.2)
    approach = Approach((one, two), BRAKING, 200, BACK, force_limit_n=5.0)
    order = TouchOrder(None, None, approach, SHEAR)
    monitor = TouchMonitor(order, cycle, memoryview(reference), RATE_HZ)
    return SimpleNamespace(
        monitor=monitor,
        cycle=cycle,
        reference=reference,
        planned=planned,
        one=one,
        two=two,
        detector=monitor._detector,
    )


def run(search, until=None):
    """Run the ticks; return the contacts by their ticks."""
    contacts = {}
    for tick in range(until or search.planned.size):
        search.cycle.flags = 0
        contact = search.monitor.step(tick, 0)
        if contact is not None:
            contacts[tick] = contact
            if contact.session_outcome:
                break
    return contacts


def test_the_reference_is_unchanged_without_a_touch(search):
    assert run(search) == {}
    assert np.array_equal(search.reference, search.planned)
    assert search.detector.armed_at == [search.one.begin_tick, search.two.begin_tick]


def test_the_motor_brakes_holds_and_returns_after_a_touch(search):
    tick = search.one.begin_tick + 300
    search.detector.at = {tick}
    contacts = run(search, tick + 1)
    assert search.cycle.flags & Status.TOUCHED
    assert contacts[tick].message == f"Touch detected at {tick / RATE_HZ:.3f} s."
    assert not contacts[tick].session_outcome
    reference = np.array(search.reference)
    speed = np.diff(reference) * RATE_HZ
    assert speed[tick - 1] == pytest.approx(1.0)
    # No step in angle or speed: the deceleration is that of the braking path at most.
    slowing = np.diff(speed[tick - 1 : tick + 60]) * RATE_HZ
    assert np.abs(slowing).max() <= 1.5 / BRAKING.duration_s + 1e-6
    held_rad = reference[tick + 60 : tick + 200]
    assert np.ptp(held_rad) == 0.0
    assert held_rad[0] == pytest.approx(reference[tick] + 0.5 * BRAKING.duration_s, abs=1e-3)
    assert reference[tick + 200 + BACK.size] == pytest.approx(0.0)
    assert not reference[tick + 200 + BACK.size : search.two.begin_tick].any()
    assert np.array_equal(reference[search.one.end_tick :], search.planned[search.one.end_tick :])


def test_the_detector_is_armed_again_in_the_next_pass(search):
    search.detector.at = {
        search.one.begin_tick + 100,
        search.one.end_tick + 50,
        search.two.begin_tick + 100,
    }
    contacts = run(search)
    assert list(contacts) == [search.one.begin_tick + 100, search.two.begin_tick + 100]
    assert search.detector.armed_at == [search.one.begin_tick, search.two.begin_tick]


def test_the_motor_stays_after_a_touch_in_the_pause(search):
    tick = search.one.return_tick - 10
    search.detector.at = {tick}
    run(search, tick + 1)
    reference = np.array(search.reference)
    assert np.allclose(reference[tick + 1 : search.one.return_tick], search.planned[tick])
    assert reference[search.one.end_tick - 1] == pytest.approx(0.0)


def test_a_touch_on_the_way_back_stops_the_session(search):
    tick = search.one.return_tick + 20
    search.detector.at = {tick}
    (contact,) = run(search).values()
    assert contact.session_outcome == "stopped"
    assert "way back" in contact.message
    assert search.cycle.flags & Status.TOUCHED


def test_an_excessive_force_is_a_fault(search):
    tick = search.one.begin_tick + 50
    search.detector.force_n = {tick - 20: -6.0, tick: -6.0, tick + 1: -6.0}
    contacts = run(search)
    assert list(contacts) == [tick + 1]
    assert contacts[tick + 1].session_outcome == "fault"
    assert "6 N exceeds force_limit_n = 5 N" in contacts[tick + 1].message


def test_the_detector_receives_all_readings(search):
    search.cycle.wrench = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    search.cycle.flags = int(Status.ANGLE_STALE | Status.WRENCH_STALE)
    search.monitor.step(3, 3)
    assert search.detector.seen == (0.1, 0.2, 2.0, 3, True, True)


@settings(max_examples=50, deadline=None)
@given(
    tick=st.integers(300, 999),
    speed=st.floats(-3.0, 3.0),
    hold=st.integers(50, 300),
)
def test_the_path_after_a_touch_is_smooth(tick, speed, hold):
    approach = Approach((), BRAKING, hold, BACK, 1.0)
    recent = tuple(0.3 + speed * k / RATE_HZ for k in (-2, -1, 0))
    end_tick = 1000 + BACK.size
    path = reference_after_touch(approach, end_tick, tick, recent, -0.2)
    assert path.shape == (end_tick - tick - 1,)
    assert path[-1] == pytest.approx(-0.2)
    if end_tick - tick - 1 - BACK.size < 50:
        return  # too late to brake: the motor was at rest in the pause already
    whole = np.concatenate([recent, path])
    jump = np.abs(np.diff(whole, 2)).max() * RATE_HZ**2
    back = 6 * (abs(path[60] + 0.2) + 0.2) / 0.4**2
    assert jump <= max(1.6 * abs(speed) / BRAKING.duration_s, back) + 1e-6
