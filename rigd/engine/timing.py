"""Clocks of the cycle, real and virtual, and the schedule of its ticks.

Both clocks count nanoseconds of monotonic time and have the same two methods, so the cycle uses
the same code with either. `TickScheduler` computes when a tick is due and how many were missed.
`SuspendWatch` detects that the computer was suspended.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

SUSPENDED_S = 0.01
"""Threshold of :meth:`SuspendWatch.suspended_s` for a suspend; every real suspend is longer."""
SIGN_OF_LIFE_S = 1.0
"""Longest pause of virtual time with devices on lines, which assume that a silent host is dead."""


class Clock(Protocol):
    """Monotonic clock with a method to wait for a deadline."""

    virtual: bool

    def now_ns(self) -> int:
        """Return the present time."""

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline and return the lateness in ns (never negative)."""


class RealClock:
    """The system's monotonic clock.

    Deadlines are absolute: the remainder is recomputed for each sleep, so that neither the
    work of a tick nor a late wake-up adds up (a loop that sleeps "period minus work" drifts).
    ``time.sleep`` itself waits for an absolute time; calling the kernel's ``clock_nanosleep`` for
    the deadline wakes up no earlier (measured in alternation: medians of 24–31 µs either way).

    Parameters
    ----------
    spin_ns
        The last part of each wait that is spent polling instead of sleeping. It trades processor
        time for punctuality; the kernel's real-time throttling allows no more than a part of each
        period.
    """

    virtual = False

    def __init__(self, spin_ns: int = 0) -> None:
        self._spin_ns = spin_ns

    def now_ns(self) -> int:
        """Return the present time."""
        return time.monotonic_ns()

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline and return the lateness in ns (never negative)."""
        remainder = deadline_ns - time.monotonic_ns() - self._spin_ns
        if remainder > 0:
            time.sleep(remainder * 1e-9)
        late = time.monotonic_ns() - deadline_ns
        while late < 0:
            late = time.monotonic_ns() - deadline_ns
        return late


class VirtualClock:
    """A clock that jumps to each deadline: no sleep, no lateness, no execution time."""

    virtual = True

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the present time."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> int:
        """Set the time to the deadline and return 0."""
        self._now_ns = deadline_ns
        return 0


class SuspendWatch:
    """Detector of a suspended computer.

    The monotonic clock stops during a suspend, so no tick seems missed although the rig ran without
    a loop. The clock since boot continues.

    Parameters
    ----------
    monotonic_ns, boot_ns
        Clocks, which tests replace.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        boot_ns: Callable[[], int] | None = None,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._boot_ns = boot_ns or _clock_since_boot()
        # In this order a delay between the two readings is never mistaken for a suspend.
        before_ns = self._monotonic_ns()
        self._ahead_ns = self._boot_ns() - before_ns

    def suspended_s(self) -> float:
        """Return the time for which the computer was suspended since this watch began.

        It takes about a microsecond: call it now and then, not in every tick.
        """
        ahead_ns = self._boot_ns() - self._monotonic_ns()
        return max(0, ahead_ns - self._ahead_ns) * 1e-9


def _clock_since_boot() -> Callable[[], int]:
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return time.monotonic_ns
    return partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)


class TickScheduler:
    """Schedule of absolute deadlines, one per period; missed ticks are skipped, not made up.

    Parameters
    ----------
    clock
        Real or virtual time.
    rate_hz
        Ticks per second.

    Attributes
    ----------
    tick
        Index of the current tick, counted from the last :meth:`restart`.
    t_ns
        Scheduled time of the current tick, since tick 0.
    due_ns
        Scheduled time of the current tick on the clock; a restart does not change it.
    lateness_ns
        Wake-up latency: time since its deadline, less than a period.

    Examples
    --------
    >>> from rigd.engine.timing import TickScheduler, VirtualClock
    >>> metronome = TickScheduler(VirtualClock(), rate_hz=1000)
    >>> metronome.restart()
    >>> [metronome.wait() for _ in range(3)], metronome.t_ns
    ([0, 0, 0], 2000000)
    """

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        self._clock = clock
        self._period_ns = 1e9 / rate_hz
        self._start_ns = clock.now_ns()
        self.tick = 0
        self.t_ns = 0
        self.due_ns = self._start_ns
        self.lateness_ns = 0

    @property
    def start_ns(self) -> int:
        """Clock time of tick 0."""
        return self._start_ns

    def restart(self) -> None:
        """Make the next tick number 0, without moving its deadline."""
        self._start_ns += round((self.tick + 1) * self._period_ns)
        self.tick = -1

    def wait(self) -> int:
        """Wait for the next tick and return how many were missed before it.

        A wake-up one period or more late counts as missed ticks: the current tick is
        then the last one whose deadline has passed.
        """
        tick = self.tick + 1
        t_ns = round(tick * self._period_ns)
        due_ns = self._start_ns + t_ns
        late_ns = self._clock.wait_until(due_ns)
        missed = 0
        if late_ns >= self._period_ns:
            missed = int(late_ns / self._period_ns)
            tick += missed
            t_ns = round(tick * self._period_ns)
            late_ns = max(0, late_ns + due_ns - self._start_ns - t_ns)
            due_ns = self._start_ns + t_ns
        self.tick = tick
        self.t_ns = t_ns
        self.due_ns = due_ns
        self.lateness_ns = late_ns
        return missed
