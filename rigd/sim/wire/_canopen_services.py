"""Services of a simulated CANopen node: emergency messages, heartbeats, PDOs.

PDOs are mapped as the node's dictionary says. A mapping is turned into one :class:`struct.Struct`
and a list of readers whenever it changes, so that a PDO costs a few microseconds when it comes or
goes.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from struct import Struct

from rigd.sim.wire._object_dictionary import Abort, AbortCode, Entry, ObjectDictionary

# Emergency messages

_FRAME = Struct("<HB5s")
_GENERIC = 0x01
_HISTORY = 8


class Emergencies:
    """Emergency messages: present errors, and the history.

    Parameters
    ----------
    objects
        Gets the objects 1001, 1003 and 1014.
    node_id
        Number of the node.
    send
        Takes identifier and data of an EMCY message, where one may be sent.

    Attributes
    ----------
    active : dict
        Active error codes, and their bits in the error register.
    """

    def __init__(
        self, objects: ObjectDictionary, node_id: int, send: Callable[[int, bytes], None]
    ) -> None:
        self._send = send
        self.active: dict[int, int] = {}
        self._history: list[int] = []
        objects.add(0x1001, Entry("B", access="ro", mapping="t", live=self._register))
        count = Entry("B", live=lambda: len(self._history), high=0, wrote=self._history.clear)
        objects.add(0x1003, count)
        for sub in range(1, _HISTORY + 1):
            objects.add(0x1003, Entry("I", access="ro", live=self._past(sub)), sub)
        self._cob_id = objects.add(0x1014, Entry("I", 0x80 + node_id, check=self._check_cob_id))

    def reset(self) -> None:
        """Forget all, as at power-on."""
        self.active.clear()
        self._history.clear()

    def report(self, code: int, register: int, vendor: bytes = b"") -> bool:
        """Register an error and send its message, unless it is active already.

        Parameters
        ----------
        code
            Error code.
        register
            Bits of the error in the error register; the generic bit is added.
        vendor
            Up to five bytes of the message.

        Returns
        -------
        bool
            Whether it is new.
        """
        if code in self.active:
            return False
        self.active[code] = register | _GENERIC
        self._history.insert(0, code)
        del self._history[_HISTORY:]
        self._transmit(code, vendor)
        return True

    def clear(self, *codes: int) -> None:
        """Clear errors, and send a message if any of them was active."""
        gone = [code for code in codes if self.active.pop(code, None) is not None]
        if gone:
            self._transmit(0, b"")

    def _transmit(self, code: int, vendor: bytes) -> None:
        if not self._cob_id.value & DISABLED:
            frame = _FRAME.pack(code, self._register(), vendor[:5])
            self._send(self._cob_id.value & 0x7FF, frame)

    def _register(self) -> int:
        register = 0
        for bits in self.active.values():
            register |= bits
        return register

    def _past(self, sub: int) -> Callable[[], int]:
        def read() -> int:
            if sub > len(self._history):
                raise Abort(AbortCode.NO_DATA)
            return self._history[sub - 1]

        return read

    def _check_cob_id(self, value: int) -> None:
        standing = self._cob_id.value
        if value & 0x7FFF_F800 or not is_free_id(value & 0x7FF):
            raise Abort(AbortCode.VALUE)
        if not (standing | value) & DISABLED and (standing ^ value) & 0x7FF:
            raise Abort(AbortCode.STATE)


# Heartbeats

WATCHES = 2
_TOLERANCE_S = 1e-9


class HeartbeatProducer:
    """Determines when the node's own heartbeat is due, by object 1017."""

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
        """Number of the watched node; 0 for none."""
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
        Number of nodes that can be watched; with 0 there is no such object.
    restarted
        Called after a watch was set again, and so is not lost.
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


# PDOs

DISABLED = 0x8000_0000
MAX_ENTRIES = 8
_MAX_BITS = 64
_LAST_SYNC_TYPE = 240
_EVENT_TYPES = (254, 255)


def is_free_id(can_id: int) -> bool:
    """Whether an identifier of 11 bits may be given to a PDO, to SYNC or to EMCY (CiA 301)."""
    return not (
        can_id <= 0x07F
        or can_id > 0x6FF
        or 0x101 <= can_id <= 0x180
        or 0x581 <= can_id <= 0x5FF
        or 0x601 <= can_id <= 0x67F
        or 0x6E0 <= can_id <= 0x6FF
    )


class Pdo:
    """Communication and mapping parameters of one PDO.

    Parameters
    ----------
    objects
        The dictionary that gets the parameters, and that holds what is mapped.
    communication, mapping
        Indices of the parameters, such as 1400 and 1600.
    direction
        "r" or "t": what entries must allow in `Entry.mapping`.
    cob_id
        COB-ID at power-on, with `DISABLED` or not.
    mapped
        At power-on: index << 16 | sub-index << 8 | bits.
    slots
        Largest number of entries.
    changed
        Called after identifier, type or mapping have changed.

    Attributes
    ----------
    can_id : int
        Identifier in use; -1 while the PDO is off or empty.
    size : int
        Bytes of the PDO.
    entries : list of Entry
        Objects that it carries.
    """

    direction = ""

    def __init__(
        self,
        objects: ObjectDictionary,
        communication: int,
        mapping: int,
        cob_id: int,
        mapped: tuple[int, ...],
        slots: int,
        changed: Callable[[], None],
    ) -> None:
        self._objects = objects
        self._changed = changed
        self._cob_id = Entry("I", cob_id, check=self._check_cob_id, wrote=self._rebuild)
        self._type = Entry("B", 255, check=_check_type, wrote=self._rebuild)
        self._inhibit = Entry("H", check=self._check_inhibit)
        self._timer = Entry("H")
        objects.add_record(
            communication, {1: self._cob_id, 2: self._type, 3: self._inhibit, 5: self._timer}
        )
        self._count = Entry("B", len(mapped), check=self._check_count, wrote=self._rebuild)
        objects.add(mapping, self._count)
        self._slots = [
            objects.add(mapping, Entry("I", value, check=self._check_slot), sub)
            for sub, value in enumerate((mapped + (0,) * slots)[:slots], 1)
        ]
        self.can_id = -1
        self.size = 0
        self.entries: list[Entry] = []
        self._struct = Struct("<")
        self.forget()

    def compile(self) -> None:
        """Rebuild the mapping from the dictionary."""
        slots = self._slots[: self._count.value]
        try:
            self.entries = [self._mapped(slot.value) for slot in slots]
        except Abort:  # at power-on: a device's file may map what it says cannot be mapped
            self.entries = []
        self._struct = Struct("<" + "".join(entry.kind for entry in self.entries))
        self.size = self._struct.size
        on = self.entries and not self._cob_id.value & DISABLED
        self.can_id = self._cob_id.value & 0x7FF if on else -1
        self.forget()

    def forget(self) -> None:
        """Reset: nothing has been received or sent yet."""
        raise NotImplementedError

    @property
    def is_synchronous(self) -> bool:
        """Whether it belongs to the SYNC."""
        return self._type.value <= _LAST_SYNC_TYPE

    def _rebuild(self) -> None:
        self.compile()
        self._changed()

    def _mapped(self, value: int) -> Entry:
        """Return the entry a mapping names.

        Raises
        ------
        Abort
            If it does not exist, does not go into this PDO, or has another length.
        """
        entry = self._objects.find(value >> 16, value >> 8 & 0xFF)
        if self.direction not in entry.mapping or entry.bits != value & 0xFF:
            raise Abort(AbortCode.NOT_MAPPABLE)
        return entry

    def _check_cob_id(self, value: int) -> None:
        was_on = not self._cob_id.value & DISABLED
        if value & 0x3FFF_F800 or not is_free_id(value & 0x7FF):
            raise Abort(AbortCode.VALUE)
        if was_on and not value & DISABLED and (value ^ self._cob_id.value) & 0x7FF:
            raise Abort(AbortCode.STATE)

    def _check_inhibit(self, value: int) -> None:  # noqa: ARG002
        if not self._cob_id.value & DISABLED:
            raise Abort(AbortCode.STATE)

    def _check_slot(self, value: int) -> None:
        if not self._cob_id.value & DISABLED or self._count.value:
            raise Abort(AbortCode.STATE)
        if value:
            self._mapped(value)

    def _check_count(self, value: int) -> None:
        if not self._cob_id.value & DISABLED:
            raise Abort(AbortCode.STATE)
        if value > len(self._slots):
            raise Abort(AbortCode.PDO_LENGTH)
        if sum(self._mapped(slot.value).bits for slot in self._slots[:value]) > _MAX_BITS:
            raise Abort(AbortCode.PDO_LENGTH)


class ReceivePdo(Pdo):
    """A PDO that the node receives.

    Attributes
    ----------
    pending : bytes or None
        Received, and waiting for the next SYNC.
    received_s : float or None
        Time of the last one; None before the first.
    applied : bool
        Whether one has taken effect.
    """

    direction = "r"

    def forget(self) -> None:
        """Discard the received data."""
        self.pending: bytes | None = None
        self.received_s: float | None = None
        self.applied = False

    @property
    def deadline_s(self) -> float:
        """How long the next one may take, from sub-index 5; 0 for any time."""
        return 1e-3 * self._timer.value

    def apply(self, data: bytes) -> None:
        """Store the values, all of them before any takes effect; what is out of range is left."""
        for entry, value in zip(self.entries, self._struct.unpack(data), strict=True):
            with suppress(Abort):
                entry.put(value)
        self.applied = True
        for entry in self.entries:
            if entry.wrote is not None:
                entry.wrote()


class TransmitPdo(Pdo):
    """A PDO that the node sends."""

    direction = "t"

    def compile(self) -> None:
        """Rebuild the mapping from the dictionary."""
        super().compile()
        self._readers: list[Callable[[], int]] = [entry.live or entry.get for entry in self.entries]

    def forget(self) -> None:
        """Start as on entering operational: every event is news."""
        self._syncs = 0
        self._last: bytes | None = None
        self._sent_s = -math.inf

    def build(self) -> bytes:
        """Return the values as they are now."""
        return self._struct.pack(*[read() for read in self._readers])

    def at_sync(self, now_s: float) -> bytes | None:
        """Return what is to be sent at this SYNC, or None.

        Some drives keep their inhibit time with the SYNC too, and so does this one. It begins when
        the PDO has gone, a little after its SYNC: one SYNC later than that comes too early.
        """
        if self._inhibit.value:
            if now_s - self._sent_s < 1e-4 * self._inhibit.value + 1e-9:
                return None
            data = self._of_sync()
            if data is not None:
                self._sent_s = now_s
            return data
        return self._of_sync()

    def _of_sync(self) -> bytes | None:
        every = self._type.value
        if every == 1:
            return self.build()
        if every == 0:
            data = self.build()
            changed, self._last = data != self._last, data
            return data if changed else None
        self._syncs += 1
        if self._syncs < every:
            return None
        self._syncs = 0
        return self.build()

    def at_event(self, now_s: float) -> bytes | None:
        """Return what is to be sent by now as values have changed or the timer ran out, or None."""
        data = self.build()
        age_s = now_s - self._sent_s
        timer_s = 1e-3 * self._timer.value
        is_due = timer_s > 0 and age_s >= timer_s - 1e-9
        is_inhibited = age_s < 1e-4 * self._inhibit.value - 1e-9
        if self._last is not None and not is_due and (data == self._last or is_inhibited):
            return None
        self._last = data
        self._sent_s = now_s
        return data


def _check_type(value: int) -> None:
    if value > _LAST_SYNC_TYPE and value not in _EVENT_TYPES:
        raise Abort(AbortCode.VALUE)
