"""Heartbeats of a simulated CANopen node: its own, and those of the nodes it watches."""

from collections.abc import Callable
from functools import partial

from rigd.sim.wire.canopen_objects import Abort, AbortCode, Entry, ObjectDictionary

WATCHES = 2
_TOLERANCE_S = 1e-9


class HeartbeatProducer:
    """Says when the node's own heartbeat is due, by object 1017."""

    def __init__(self, objects: ObjectDictionary) -> None:
        self._period_ms = objects.add(0x1017, Entry("H", wrote=self.restart))
        self.restart()

    def restart(self) -> None:
        """Have the next one sent at once."""
        self._due_s: float | None = None

    def is_due(self, now_s: float) -> bool:
        """Whether to send one now; the next is due a period later."""
        period_s = 1e-3 * self._period_ms.value
        if not period_s or (self._due_s is not None and now_s < self._due_s - _TOLERANCE_S):
            return False
        next_s = (now_s if self._due_s is None else self._due_s) + period_s
        # What a late call missed is not made up.
        self._due_s = next_s if next_s > now_s else now_s + period_s
        return True


class HeartbeatWatch:
    """One entry of object 1016: it starts with the first heartbeat that comes.

    Attributes
    ----------
    lost : bool
        The heartbeat has been missing for longer than its time.
    """

    def __init__(self, entry: Entry) -> None:
        self._entry = entry
        self.restart()

    def restart(self) -> None:
        """Wait for the first heartbeat again."""
        self.lost = False
        self._last_s: float | None = None

    @property
    def node_id(self) -> int:
        """Who is watched; 0 for nobody."""
        return _watched(self._entry.value)

    def beat(self, now_s: float) -> None:
        """Take a heartbeat."""
        self._last_s = now_s
        self.lost = False

    def check(self, now_s: float) -> bool:
        """Return whether the heartbeat has just been lost."""
        timeout_s = 1e-3 * (self._entry.value & 0xFFFF)
        if self.lost or not timeout_s or self._last_s is None:
            return False
        self.lost = now_s - self._last_s > timeout_s + _TOLERANCE_S
        return self.lost


def _watched(value: int) -> int:
    return value >> 16 & 0x7F if value & 0xFFFF else 0


def add_watches(
    objects: ObjectDictionary, count: int, restarted: Callable[[], None]
) -> list[HeartbeatWatch]:
    """Add object 1016, and return the watches that its entries set.

    Parameters
    ----------
    objects
        Gets the object.
    count
        How many nodes can be watched; with 0 there is no such object.
    restarted
        Called after a watch was set anew, and so is not lost.
    """
    entries = {sub: Entry("I") for sub in range(1, count + 1)}
    watches = [HeartbeatWatch(entry) for entry in entries.values()]

    def check(entry: Entry, value: int) -> None:
        if value >> 24 or value >> 16 > 0x7F:
            raise Abort(AbortCode.VALUE)
        others = {_watched(other.value) for other in entries.values() if other is not entry}
        if _watched(value) and _watched(value) in others:
            raise Abort(AbortCode.INCOMPATIBLE)

    def restart(watch: HeartbeatWatch) -> None:
        watch.restart()
        restarted()

    for entry, watch in zip(entries.values(), watches, strict=True):
        entry.check = partial(check, entry)
        entry.wrote = partial(restart, watch)
    if entries:
        objects.add_record(0x1016, entries)
    return watches
