"""Clocks of the cycle, real and virtual, and the schedule of its ticks.

Both clocks count nanoseconds of monotonic time and have the same two methods, so the cycle uses
the same code with either. `TickScheduler` computes when a tick is due and how many were missed.
`SuspendMonitor` detects that the computer was suspended.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

MIN_SUSPENSION_S = 0.01
"""Result of :meth:`SuspendMonitor.suspended_s` in s above which the computer was suspended; any
real suspend takes longer."""
MAX_VIRTUAL_PAUSE_S = 1.0
"""Longest pause in s between two ticks of virtual time if devices are on a bus or serial line.
After a longer pause the devices would treat the host as failed."""


class Clock(Protocol):
    """Monotonic clock with a method to wait for a deadline."""

    virtual: bool
    """Whether the clock jumps to each deadline instead of waiting."""

    def now_ns(self) -> int:
        """Return the present time in ns of the monotonic clock."""

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline, and return the lateness of the wake-up in ns, which is ≥ 0."""


class RealClock:
    """The system's monotonic clock.

    Deadlines are absolute: the remaining time is recomputed for each sleep, so that neither the
    work of a tick nor a late wake-up shifts later ticks (a loop that sleeps "period minus work"
    drifts). Calling the kernel's ``clock_nanosleep`` instead of ``time.sleep`` does not reduce the
    wake-up latency (median 24–31 µs with either).

    Parameters
    ----------
    spin_ns
        Time at the end of each wait that is spent polling instead of sleeping. Polling costs
        processor time and makes the wake-up more punctual. The kernel's real-time throttling
        allows polling in a part of each period only.
    """

    virtual = False

    def __init__(self, spin_ns: int = 0) -> None:
        self._spin_ns = spin_ns

    def now_ns(self) -> int:
        """Return the present time in ns of the system's monotonic clock."""
        return time.monotonic_ns()

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline, and return the lateness of the wake-up in ns, which is ≥ 0."""
        remaining_ns = deadline_ns - time.monotonic_ns() - self._spin_ns
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)
        lateness_ns = time.monotonic_ns() - deadline_ns
        while lateness_ns < 0:
            lateness_ns = time.monotonic_ns() - deadline_ns
        return lateness_ns


class VirtualClock:
    """Simulated clock that jumps to each deadline, without sleep, lateness or execution time."""

    virtual = True

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the present virtual time in ns."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> int:
        """Set the virtual time to a deadline, and return 0 as the lateness in ns."""
        self._now_ns = deadline_ns
        return 0


class SuspendMonitor:
    """Detector of a suspended computer.

    The monotonic clock stops during a suspend, so that no tick appears missed although the loop did
    not run. The clock since boot does not stop; the difference of the clocks shows the suspend.

    Parameters
    ----------
    monotonic_ns, boot_ns
        Monotonic clock and clock since boot, which tests replace.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        boot_ns: Callable[[], int] | None = None,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._boot_ns = boot_ns or _clock_since_boot()
        # In this order a delay between the two readings is never mistaken for a suspend.
        monotonic_before_ns = self._monotonic_ns()
        self._initial_lead_ns = self._boot_ns() - monotonic_before_ns

    def suspended_s(self) -> float:
        """Return the time in s for which the computer was suspended since this object was created.

        A call takes about a microsecond, so call it every few ticks only.
        """
        boot_clock_lead_ns = self._boot_ns() - self._monotonic_ns()
        return max(0, boot_clock_lead_ns - self._initial_lead_ns) * 1e-9


def _clock_since_boot() -> Callable[[], int]:
    """Return a clock in ns that runs during a suspend; without one the monotonic clock."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return time.monotonic_ns
    return partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)


class TickScheduler:
    """Schedule of the loop's ticks, each with an absolute deadline; missed ticks are skipped.

    Parameters
    ----------
    clock
        Real or virtual clock.
    rate_hz
        Ticks per second.

    Attributes
    ----------
    tick
        Index of the current tick, counted from the last :meth:`restart`.
    t_ns
        Scheduled time of the current tick in ns since tick 0.
    due_ns
        Scheduled time of the current tick in ns on the clock; a restart does not change it.
    lateness_ns
        Wake-up latency: time in ns from the deadline to the wake-up, less than a period.

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
        """Time of tick 0 on the clock, in ns."""
        return self._start_ns

    def restart(self) -> None:
        """Restart the count of ticks: the next tick becomes tick 0, with an unchanged deadline."""
        self._start_ns += round((self.tick + 1) * self._period_ns)
        self.tick = -1

    def wait(self) -> int:
        """Wait for the next tick, and return the number of ticks missed before it.

        A wake-up one period or more late counts as missed ticks: the current tick is
        then the last one whose deadline has passed.
        """
        tick = self.tick + 1
        t_ns = round(tick * self._period_ns)
        due_ns = self._start_ns + t_ns
        lateness_ns = self._clock.wait_until(due_ns)
        missed_ticks = 0
        if lateness_ns >= self._period_ns:
            missed_ticks = int(lateness_ns / self._period_ns)
            tick += missed_ticks
            t_ns = round(tick * self._period_ns)
            lateness_ns = max(0, lateness_ns + due_ns - self._start_ns - t_ns)
            due_ns = self._start_ns + t_ns
        self.tick = tick
        self.t_ns = t_ns
        self.due_ns = due_ns
        self.lateness_ns = lateness_ns
        return missed_ticks
