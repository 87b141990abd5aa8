"""When a tick is due, and what happens to those that were missed."""

from rigd.engine.clocks import Clock


class Metronome:
    """Absolute deadlines, one a period; a missed tick is skipped, never made up in a burst.

    Attributes
    ----------
    tick
        Index of the current tick, counted from the last :meth:`restart`.
    t_ns
        Scheduled time of the current tick, since tick 0.
    due_ns
        The same on the clock: it goes on evenly through a restart.
    lateness_ns
        By how much its deadline was missed: less than a period.
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
        """Make the next tick tick 0; it is due where it would have been due anyway."""
        self._start_ns += round((self.tick + 1) * self._period_ns)
        self.tick = -1

    def wait(self) -> int:
        """Wait for the next tick and return how many were missed before it.

        Whoever wakes a period or more after the deadline has missed that tick: the current tick is
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
