"""When the simulated world moves: by the wall clock on the host's grid, or by SYNC alone."""

_MEMORY_SYNCS = 256
"""Over how many SYNCs the grid's phase is averaged: a single late one hardly moves it."""
_FORGET_PERIODS = 100
"""After so long a silence the next SYNC may come from another host: its phase counts anew."""
_PATIENCE_NS = 5_000_000_000


class WallClock:
    """Whole periods of wall time, on a grid that follows the SYNC.

    A SYNC marks the tick nearest to it, whether it is up to half a period early or late. A tick
    whose SYNC has not come half a period after it passes without. The grid follows the mean phase
    of the last SYNCs, so that it need not know when the host's loop started.

    Parameters
    ----------
    period_ns
        Length of a period.
    now_ns
        Time of tick 0, on a clock that never steps back.

    Attributes
    ----------
    tick : int
        Where the world is.
    """

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns = float(now_ns)
        self._followed = 0
        self._last_sync = 0
        self.tick = 0

    @property
    def due_ns(self) -> int:
        """Until when the SYNC of the next tick may come."""
        return round(self._origin_ns + (self.tick + 1.5) * self._period_ns)

    @property
    def idle(self) -> bool:
        """No SYNC has come for a long time."""
        return self._followed == 0 or self.tick - self._last_sync > _FORGET_PERIODS

    def sync(self, now_ns: float) -> int:
        """Return how many periods pass with a SYNC at this time: one, but for irregular ones."""
        elapsed = (now_ns - self._origin_ns) / self._period_ns
        nearest = round(elapsed)
        if nearest - self._last_sync > _FORGET_PERIODS:
            self._followed = 0
        self._followed = min(self._followed + 1, _MEMORY_SYNCS)
        self._last_sync = nearest
        self._origin_ns += (elapsed - nearest) * self._period_ns / self._followed
        return self._pass_to(nearest)

    def elapse(self, now_ns: int) -> int:
        """Return how many periods pass without a SYNC, because theirs did not come in time."""
        return self._pass_to(int((now_ns - self._origin_ns) / self._period_ns - 0.5))

    def _pass_to(self, tick: int) -> int:
        passed = max(0, tick - self.tick)
        self.tick += passed
        return passed


class LockStep:
    """One period a SYNC; the world waits for the next one.

    It does not wait for ever: five seconds after the last SYNC, and at once where nobody is left
    who could send one, time goes on by the wall clock, so that a drive notices a dead host. Before
    the first SYNC it goes on too.

    Parameters
    ----------
    period_ns
        Length of a period.
    now_ns
        Wall time, on a clock that never steps back.
    """

    idle = True

    def __init__(self, period_ns: float, now_ns: int) -> None:
        self._period_ns = period_ns
        self._stands_until_ns = float(now_ns)

    @property
    def due_ns(self) -> int:
        """When a period passes without a SYNC."""
        return round(self._stands_until_ns + self._period_ns)

    def sync(self, now_ns: float) -> int:
        """Return how many periods pass with a SYNC: always one."""
        self._stands_until_ns = now_ns + _PATIENCE_NS
        return 1

    def elapse(self, now_ns: int) -> int:
        """Return how many periods pass by the wall clock."""
        passed = max(0, int((now_ns - self._stands_until_ns) / self._period_ns))
        self._stands_until_ns += passed * self._period_ns
        return passed

    def left_alone(self, now_ns: int) -> None:
        """Wait no longer: nobody is connected any more."""
        self._stands_until_ns = min(self._stands_until_ns, now_ns)
