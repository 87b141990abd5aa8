"""The two clocks a cycle can run under.

Both count nanoseconds of monotonic time and both are asked the same two questions, so the cycle
is the same code under either.
"""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time in ns, and waiting for a point in it."""

    virtual: bool

    def now_ns(self) -> int:
        """Return the time now."""

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline and return by how much it was missed, in ns (never negative)."""


class RealClock:
    """The system's monotonic clock.

    Deadlines are absolute: the remainder is computed anew for each sleep, so that neither the
    work of a tick nor a late wake-up adds up (a loop that sleeps "period minus work" drifts).

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
        """Return the time now."""
        return time.monotonic_ns()

    def wait_until(self, deadline_ns: int) -> int:
        """Wait for a deadline and return by how much it was missed, in ns (never negative)."""
        remainder = deadline_ns - time.monotonic_ns() - self._spin_ns
        if remainder > 0:
            time.sleep(remainder * 1e-9)
        late = time.monotonic_ns() - deadline_ns
        while late < 0:
            late = time.monotonic_ns() - deadline_ns
        return late


class VirtualClock:
    """A clock that stands at the last deadline: no sleeping, no lateness, no work time."""

    virtual = True

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the time now."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> int:
        """Move to the deadline at once."""
        self._now_ns = deadline_ns
        return 0
