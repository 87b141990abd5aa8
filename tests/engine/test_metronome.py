"""Deadlines are absolute, and missed ticks are skipped and counted."""

import time

from hypothesis import given
from hypothesis import strategies as st

from rigd.engine.timing import (
    MIN_SUSPENSION_S,
    RealClock,
    SuspendMonitor,
    TickScheduler,
    VirtualClock,
)


class LateClock:
    """A clock on which each wait wakes late by times set by the test."""

    virtual = False

    def __init__(self, delays_ns):
        self._delays_ns = iter(delays_ns)
        self._now_ns = 5_000_000_000

    def now_ns(self):
        return self._now_ns

    def wait_until(self, deadline_ns):
        self._now_ns = max(self._now_ns, deadline_ns + next(self._delays_ns))
        return self._now_ns - deadline_ns


@given(
    st.sampled_from([1000.0, 500.0, 3000.0, 48000.0, 0.7]),
    st.lists(st.floats(0, 40), min_size=1, max_size=60),
)
def test_every_tick_is_run_once_or_counted_as_missed(rate_hz, delays):
    period_ns = 1e9 / rate_hz
    metronome = TickScheduler(LateClock([int(d * period_ns) for d in delays]), rate_hz)
    start_ns = metronome.start_ns
    metronome.restart()
    before = -1
    for _ in delays:
        missed = metronome.wait()
        assert metronome.tick == before + 1 + missed
        assert metronome.t_ns == round(metronome.tick * period_ns)
        assert metronome.due_ns == metronome.start_ns + metronome.t_ns
        assert 0 <= metronome.lateness_ns <= period_ns + 1
        before = metronome.tick
    assert metronome.start_ns - start_ns == round(period_ns)


def test_a_burst_of_missed_ticks_is_not_run_later():
    metronome = TickScheduler(LateClock([0, 7_300_000, 0, 0]), 1000.0)
    assert metronome.wait() == 0
    assert metronome.wait() == 7
    assert (metronome.tick, metronome.lateness_ns) == (9, 300_000)
    assert metronome.wait() == 0
    assert (metronome.tick, metronome.lateness_ns) == (10, 0)


def test_due_times_continue_evenly_through_a_restart():
    metronome = TickScheduler(VirtualClock(), 1000.0)
    due = []
    for tick in range(6):
        if tick == 3:
            metronome.restart()
        metronome.wait()
        due.append(metronome.due_ns)
    assert due == [1_000_000 * k for k in range(1, 7)]
    assert metronome.tick == 2


def test_real_deadlines_do_not_drift_with_the_work():
    metronome = TickScheduler(RealClock(), 500.0)
    start_ns = metronome.start_ns
    missed, behind_ns = 0, []
    for _ in range(50):
        missed += metronome.wait()
        behind_ns.append(time.monotonic_ns() - start_ns - 2_000_000 * metronome.tick)
        time.sleep(0.0005)
    assert metronome.tick == 50 + missed
    assert min(behind_ns) >= 0
    # A loop that slept a whole period after its work would be twenty milliseconds behind by now.
    # This one may lose the processor, but hardly each time between waking and reading the clock.
    assert min(behind_ns[-10:]) < 2_000_000


def test_spinning_waits_until_the_deadline():
    clock = RealClock(spin_ns=150_000)
    for _ in range(5):
        deadline_ns = clock.now_ns() + 1_000_000
        assert clock.wait_until(deadline_ns) >= 0
        assert clock.now_ns() >= deadline_ns


class SuspendableComputer:
    """Two clocks of a computer; each reading takes time, and a suspend stops one of them."""

    def __init__(self, steps_ns=()):
        self._steps_ns = iter(steps_ns)
        self.now_ns = 10**12
        self.suspended_ns = 0

    def monotonic_ns(self):
        self.now_ns += next(self._steps_ns, 100)
        return self.now_ns

    def boot_ns(self):
        return self.monotonic_ns() + self.suspended_ns + 7 * 10**9

    def watch(self):
        return SuspendMonitor(self.monotonic_ns, self.boot_ns)


@given(
    st.lists(st.integers(0, 10**9), min_size=4, max_size=4), st.integers(0, 10**13), st.booleans()
)
def test_a_suspend_is_detected_and_a_reading_delay_is_not(steps_ns, suspended_ns, delayed):
    computer = SuspendableComputer(steps_ns if delayed else ())
    watch = computer.watch()
    assert watch.suspended_s() == 0.0
    computer.suspended_ns = suspended_ns
    reported_s = watch.suspended_s()
    assert reported_s <= suspended_ns * 1e-9
    if not delayed:
        assert reported_s >= suspended_ns * 1e-9 - 1e-6


def test_this_computer_was_not_suspended_meanwhile():
    watch = SuspendMonitor()
    time.sleep(0.01)
    assert watch.suspended_s() < MIN_SUSPENSION_S
