"""When a tick is due, and what happens to those that were missed."""

from rigd.engine.clocks import Clock


class Metronome:
    """Absolute deadlines, one a period; a missed tick is skipped, never made up in a burst.

    Attributes
    ----------
    tick
        Index of the current tick, counted from the last :meth:`restart`.
    lateness_ns
        By how much its deadline was missed: less than a period.
    """

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        self._clock = clock
        self._period_ns = 1e9 / rate_hz
        self._start_ns = clock.now_ns()
        self.tick = 0
        self.lateness_ns = 0

    @property
    def start_ns(self) -> int:
        """Clock time of tick 0."""
        return self._start_ns

    def time_of(self, tick: int) -> int:
        """Scheduled time of a tick, in ns since tick 0."""
        return round(tick * self._period_ns)

    def restart(self) -> None:
        """Make the next tick tick 0; it is due where it would have been due anyway."""
        self._start_ns += self.time_of(self.tick + 1)
        self.tick = -1

    def wait(self) -> int:
        """Wait for the next tick and return how many were missed before it.

        Whoever wakes a period or more after the deadline has missed that tick: the current tick is
        then the last one whose deadline has passed.
        """
        tick = self.tick + 1
        late_ns = self._clock.wait_until(self._start_ns + round(tick * self._period_ns))
        missed = 0
        if late_ns >= self._period_ns:
            missed = int(late_ns / self._period_ns)
            late_ns -= round(missed * self._period_ns)
        self.tick = tick + missed
        self.lateness_ns = max(0, late_ns)
        return missed
