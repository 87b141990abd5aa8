"""Services of a simulated CANopen node: emergency messages, heartbeats, PDOs.

PDOs are mapped as the node's dictionary states. A changed mapping is compiled to one
:class:`struct.Struct` and a list of readers, so that receiving or sending a PDO takes only a few
microseconds.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from struct import Struct

from rigd.sim.wire._object_dictionary import Abort, AbortCode, Entry, ObjectDictionary

# Emergency messages

_EMERGENCY_LAYOUT = Struct("<HB5s")
"""Layout of an emergency message: error code, error register, vendor's bytes."""
_GENERIC_ERROR_BIT = 0x01
"""Generic bit of the error register."""
_ERROR_HISTORY_LENGTH = 8
"""Number of error codes in the error history."""


class EmergencyMessages:
    """Emergency messages of a node: active errors and error history.

    The objects 1001, 1003 and 1014 are added to the dictionary `objects`. `send` sends an emergency
    message with identifier and data.

    Attributes
    ----------
    active_errors : dict
        Bits in the error register by active error code.
    """

    def __init__(
        self, objects: ObjectDictionary, node_id: int, send: Callable[[int, bytes], None]
    ) -> None:
        self._send = send
        self.active_errors: dict[int, int] = {}
        self._history: list[int] = []
        objects.add(
            0x1001, Entry("B", access="ro", pdo_directions="t", read_value=self._error_register)
        )
        count_entry = Entry(
            "B", read_value=lambda: len(self._history), high=0, after_write=self._history.clear
        )
        objects.add(0x1003, count_entry)
        for sub in range(1, _ERROR_HISTORY_LENGTH + 1):
            objects.add(0x1003, Entry("I", access="ro", read_value=self._history_reader(sub)), sub)
        self._cob_id = objects.add(
            0x1014, Entry("I", 0x80 + node_id, check_value=self._check_cob_id)
        )

    def reset(self) -> None:
        """Clear active errors and error history, as at power-on."""
        self.active_errors.clear()
        self._history.clear()

    def report(self, error_code: int, register_bits: int, vendor_bytes: bytes = b"") -> bool:
        """Register an error and send its emergency message, unless the error is active already.

        Return whether the error was not active before. The generic bit is added to the bits of the
        error in the error register. There are up to five vendor-specific bytes.
        """
        if error_code in self.active_errors:
            return False
        self.active_errors[error_code] = register_bits | _GENERIC_ERROR_BIT
        self._history.insert(0, error_code)
        del self._history[_ERROR_HISTORY_LENGTH:]
        self._transmit(error_code, vendor_bytes)
        return True

    def clear(self, *codes_to_clear: int) -> None:
        """Remove errors from the active errors; send an emergency message if any was active."""
        cleared_codes = [
            error_code
            for error_code in codes_to_clear
            if self.active_errors.pop(error_code, None) is not None
        ]
        if cleared_codes:
            self._transmit(0, b"")

    def _transmit(self, error_code: int, vendor_bytes: bytes) -> None:
        """Send an emergency message of the node, unless object 1014 disables such messages."""
        if not self._cob_id.value & COB_ID_DISABLED_BIT:
            message_bytes = _EMERGENCY_LAYOUT.pack(
                error_code, self._error_register(), vendor_bytes[:5]
            )
            self._send(self._cob_id.value & 0x7FF, message_bytes)

    def _error_register(self) -> int:
        """Return the error register: the bits of all active errors."""
        error_register = 0
        for error_bits in self.active_errors.values():
            error_register |= error_bits
        return error_register

    def _history_reader(self, sub_index: int) -> Callable[[], int]:
        """Return the function that reads an entry of the error history."""

        def read_history_entry() -> int:
            if sub_index > len(self._history):
                raise Abort(AbortCode.NO_DATA)
            return self._history[sub_index - 1]

        return read_history_entry

    def _check_cob_id(self, new_cob_id: int) -> None:
        """Raise `Abort` if object 1014 may not be set to a value now."""
        present_cob_id = self._cob_id.value
        if new_cob_id & 0x7FFF_F800 or not is_free_id(new_cob_id & 0x7FF):
            raise Abort(AbortCode.INVALID_VALUE)
        if (
            not (present_cob_id | new_cob_id) & COB_ID_DISABLED_BIT
            and (present_cob_id ^ new_cob_id) & 0x7FF
        ):
            raise Abort(AbortCode.WRONG_STATE)


# Heartbeats

DEFAULT_MONITOR_COUNT = 2
"""Number of heartbeats that a node without a device file can monitor."""
_TIME_TOLERANCE_S = 1e-9
"""Tolerance in seconds for rounding errors of times."""


class HeartbeatProducer:
    """Schedule of the node's own heartbeat, whose period is in object 1017."""

    def __init__(self, objects: ObjectDictionary) -> None:
        self._period_ms = objects.add(0x1017, Entry("H", after_write=self.restart))
        self.restart()

    def restart(self) -> None:
        """Make the next heartbeat due at once."""
        self._due_s: float | None = None

    def is_due(self, now_s: float) -> bool:
        """Return whether a heartbeat is due, and schedule the next one a period later."""
        period_s = 1e-3 * self._period_ms.value
        if not period_s or (self._due_s is not None and now_s < self._due_s - _TIME_TOLERANCE_S):
            return False
        next_due_s = (now_s if self._due_s is None else self._due_s) + period_s
        # Heartbeats that a late call has missed are not made up for.
        self._due_s = next_due_s if next_due_s > now_s else now_s + period_s
        return True


class HeartbeatMonitor:
    """Monitor of another node's heartbeat, which an entry of object 1016 configures.

    The monitor is active after the first heartbeat.

    Attributes
    ----------
    lost : bool
        Whether the heartbeat has been missing for longer than its timeout.
    """

    def __init__(self, entry: Entry) -> None:
        self._entry = entry
        self.restart()

    def restart(self) -> None:
        """Restart the monitoring: wait for the first heartbeat of the node again."""
        self.lost = False
        self._last_s: float | None = None

    @property
    def node_id(self) -> int:
        """Number of the monitored node; 0 for none."""
        return _monitored_node(self._entry.value)

    def register_heartbeat(self, now_s: float) -> None:
        """Register a received heartbeat at a time in seconds."""
        self._last_s = now_s
        self.lost = False

    def check(self, now_s: float) -> bool:
        """Return whether the monitored heartbeat has been lost since the last check."""
        timeout_s = 1e-3 * (self._entry.value & 0xFFFF)
        if self.lost or not timeout_s or self._last_s is None:
            return False
        self.lost = now_s - self._last_s > timeout_s + _TIME_TOLERANCE_S
        return self.lost


def _monitored_node(monitor_value: int) -> int:
    """Return the number of the monitored node in a value of object 1016; 0 for none."""
    return monitor_value >> 16 & 0x7F if monitor_value & 0xFFFF else 0


def add_heartbeat_monitors(
    objects: ObjectDictionary, monitor_count: int, on_restart: Callable[[], None]
) -> list[HeartbeatMonitor]:
    """Add object 1016 to a dictionary, and return the heartbeat monitors of its entries.

    The object is not added if `monitor_count`, the number of nodes that can be monitored, is 0.
    `on_restart` is called after an entry was set, which restarts its monitoring.
    """
    monitor_entries = {sub: Entry("I") for sub in range(1, monitor_count + 1)}
    monitors = [HeartbeatMonitor(monitor_entry) for monitor_entry in monitor_entries.values()]

    def check_monitor_value(monitor_entry: Entry, monitor_value: int) -> None:
        if monitor_value >> 24 or monitor_value >> 16 > 0x7F:
            raise Abort(AbortCode.INVALID_VALUE)
        other_nodes = {
            _monitored_node(other_entry.value)
            for other_entry in monitor_entries.values()
            if other_entry is not monitor_entry
        }
        if _monitored_node(monitor_value) and _monitored_node(monitor_value) in other_nodes:
            raise Abort(AbortCode.INCOMPATIBLE_PARAMETERS)

    def restart_monitor(monitor: HeartbeatMonitor) -> None:
        monitor.restart()
        on_restart()

    for monitor_entry, monitor in zip(monitor_entries.values(), monitors, strict=True):
        monitor_entry.check_value = partial(check_monitor_value, monitor_entry)
        monitor_entry.after_write = partial(restart_monitor, monitor)
    if monitor_entries:
        objects.add_record(0x1016, monitor_entries)
    return monitors


# PDOs

COB_ID_DISABLED_BIT = 0x8000_0000
"""Bit in the COB-ID of a PDO or emergency message that disables it."""
MAX_MAPPING_ENTRIES = 8
"""Largest number of objects in a PDO."""
_MAX_PDO_BITS = 64
"""Largest length of a PDO in bits."""
_MAX_SYNCHRONOUS_TYPE = 240
"""Largest transmission type of a synchronous PDO."""
_EVENT_DRIVEN_TYPES = (254, 255)
"""Transmission types of event-driven PDOs."""


def is_free_id(can_id: int) -> bool:
    """Return whether an 11-bit identifier may be given to a PDO, SYNC or EMCY (CiA 301)."""
    return not (
        can_id <= 0x07F
        or can_id > 0x6FF
        or 0x101 <= can_id <= 0x180
        or 0x581 <= can_id <= 0x5FF
        or 0x601 <= can_id <= 0x67F
        or 0x6E0 <= can_id <= 0x6FF
    )


class Pdo:
    """PDO of a node: its communication and mapping parameters.

    The parameters are added to the dictionary `objects`, which contains the mapped objects.
    `communication_index` and `mapping_index` are the indices of the parameters, such as 1400 and
    1600. `direction` is "r" (received) or "t" (transmitted), which the `Entry.pdo_directions` of
    mapped objects must contain.

    `cob_id` and `default_mapping` are the values at power-on: the COB-ID with or without
    `COB_ID_DISABLED_BIT`, and for each mapped object index << 16 | sub-index << 8 | bits.
    `slot_count` is the largest number of mapped objects. `on_change` is called after identifier,
    type or mapping have changed.

    Attributes
    ----------
    can_id : int
        CAN identifier; -1 while the PDO is disabled or empty.
    size : int
        Size of the PDO in bytes.
    entries : list of Entry
        Mapped objects.
    """

    direction = ""
    """Letter of the direction, "r" or "t"."""

    def __init__(
        self,
        objects: ObjectDictionary,
        communication_index: int,
        mapping_index: int,
        cob_id: int,
        default_mapping: tuple[int, ...],
        slot_count: int,
        on_change: Callable[[], None],
    ) -> None:
        self._objects = objects
        self._on_change = on_change
        self._cob_id = Entry("I", cob_id, check_value=self._check_cob_id, after_write=self._rebuild)
        self._type = Entry(
            "B", 255, check_value=_check_transmission_type, after_write=self._rebuild
        )
        self._inhibit = Entry("H", check_value=self._check_inhibit_time)
        self._timer = Entry("H")
        objects.add_record(
            communication_index, {1: self._cob_id, 2: self._type, 3: self._inhibit, 5: self._timer}
        )
        self._count = Entry(
            "B",
            len(default_mapping),
            check_value=self._check_mapping_count,
            after_write=self._rebuild,
        )
        objects.add(mapping_index, self._count)
        self._slots = [
            objects.add(
                mapping_index, Entry("I", mapping_value, check_value=self._check_mapping_slot), sub
            )
            for sub, mapping_value in enumerate(
                (default_mapping + (0,) * slot_count)[:slot_count], 1
            )
        ]

    def compile_mapping(self) -> None:
        """Rebuild the PDO's mapping from the object dictionary."""
        used_slots = self._slots[: self._count.value]
        try:
            self.entries = [self._mapped_entry(mapping_slot.value) for mapping_slot in used_slots]
        except Abort:  # a device's file may map objects at power-on that it declares unmappable
            self.entries = []
        self._struct = Struct("<" + "".join(entry.type_letter for entry in self.entries))
        self.size = self._struct.size
        is_enabled = self.entries and not self._cob_id.value & COB_ID_DISABLED_BIT
        self.can_id = self._cob_id.value & 0x7FF if is_enabled else -1
        self.reset_exchange()

    def reset_exchange(self) -> None:
        """Reset the state of the PDO: nothing has been received or sent yet."""
        raise NotImplementedError

    @property
    def is_synchronous(self) -> bool:
        """Whether the PDO is synchronous with SYNC."""
        return self._type.value <= _MAX_SYNCHRONOUS_TYPE

    def _rebuild(self) -> None:
        """Rebuild the mapping after a parameter was written, and report the change."""
        self.compile_mapping()
        self._on_change()

    def _mapped_entry(self, mapping_value: int) -> Entry:
        """Return the entry of the dictionary that a mapping entry names.

        Raise `Abort` if the object does not exist, cannot be mapped into this PDO, or has another
        length.
        """
        mapped_entry = self._objects.find(mapping_value >> 16, mapping_value >> 8 & 0xFF)
        if (
            self.direction not in mapped_entry.pdo_directions
            or mapped_entry.bit_length != mapping_value & 0xFF
        ):
            raise Abort(AbortCode.NOT_MAPPABLE)
        return mapped_entry

    def _check_cob_id(self, new_cob_id: int) -> None:
        """Raise `Abort` if the PDO's COB-ID may not be set to a value now."""
        was_enabled = not self._cob_id.value & COB_ID_DISABLED_BIT
        if new_cob_id & 0x3FFF_F800 or not is_free_id(new_cob_id & 0x7FF):
            raise Abort(AbortCode.INVALID_VALUE)
        if (
            was_enabled
            and not new_cob_id & COB_ID_DISABLED_BIT
            and (new_cob_id ^ self._cob_id.value) & 0x7FF
        ):
            raise Abort(AbortCode.WRONG_STATE)

    def _check_inhibit_time(self, new_inhibit_time: int) -> None:  # noqa: ARG002
        """Raise `Abort` if the PDO's inhibit time may not be set to a value now."""
        if not self._cob_id.value & COB_ID_DISABLED_BIT:
            raise Abort(AbortCode.WRONG_STATE)

    def _check_mapping_slot(self, new_mapping_value: int) -> None:
        """Raise `Abort` if a mapping entry of the PDO may not be set to a value now."""
        if not self._cob_id.value & COB_ID_DISABLED_BIT or self._count.value:
            raise Abort(AbortCode.WRONG_STATE)
        if new_mapping_value:
            self._mapped_entry(new_mapping_value)

    def _check_mapping_count(self, new_mapping_count: int) -> None:
        """Raise `Abort` if the number of mapped objects may not be set to a value now."""
        if not self._cob_id.value & COB_ID_DISABLED_BIT:
            raise Abort(AbortCode.WRONG_STATE)
        if new_mapping_count > len(self._slots):
            raise Abort(AbortCode.PDO_TOO_LONG)
        if (
            sum(
                self._mapped_entry(mapping_slot.value).bit_length
                for mapping_slot in self._slots[:new_mapping_count]
            )
            > _MAX_PDO_BITS
        ):
            raise Abort(AbortCode.PDO_TOO_LONG)


class ReceivePdo(Pdo):
    """PDO that the node receives (RPDO).

    Attributes
    ----------
    pending : bytes or None
        Received data that takes effect at the next SYNC; None if there is none.
    received_s : float or None
        Time in seconds at which the last PDO was received; None before the first.
    applied : bool
        Whether a received PDO has taken effect.
    """

    direction = "r"

    def reset_exchange(self) -> None:
        """Discard the data of received PDOs."""
        self.pending: bytes | None = None
        self.received_s: float | None = None
        self.applied = False

    @property
    def deadline_s(self) -> float:
        """Longest time in seconds until the next PDO, from sub-index 5; 0 for no deadline."""
        return 1e-3 * self._timer.value

    def apply(self, data: bytes) -> None:
        """Store all values of a received PDO, then run their effects; skip values out of range."""
        for mapped_entry, received_value in zip(
            self.entries, self._struct.unpack(data), strict=True
        ):
            with suppress(Abort):
                mapped_entry.store_integer(received_value)
        self.applied = True
        for mapped_entry in self.entries:
            if mapped_entry.after_write is not None:
                mapped_entry.after_write()


class TransmitPdo(Pdo):
    """PDO that the node sends (TPDO)."""

    direction = "t"

    def compile_mapping(self) -> None:
        """Rebuild the PDO's mapping from the object dictionary, and its list of readers."""
        super().compile_mapping()
        self._readers: list[Callable[[], int]] = [
            entry.read_value or entry.read_integer for entry in self.entries
        ]

    def reset_exchange(self) -> None:
        """Forget the data sent before, as on entering operational; the next event sends the PDO."""
        self._syncs = 0
        self._last_data: bytes | None = None
        self._sent_s = -math.inf

    def build_data(self) -> bytes:
        """Return the PDO's data with the present values."""
        return self._struct.pack(*[read_value() for read_value in self._readers])

    def data_at_sync(self, now_s: float) -> bytes | None:
        """Return the data to send at a SYNC, or None if nothing is to be sent.

        As in some real drives, the inhibit time also applies to synchronous PDOs. It begins when
        the PDO has been sent, a little after its SYNC.
        """
        if self._inhibit.value:
            if now_s - self._sent_s < 1e-4 * self._inhibit.value + 1e-9:
                return None
            pdo_data = self._data_by_transmission_type()
            if pdo_data is not None:
                self._sent_s = now_s
            return pdo_data
        return self._data_by_transmission_type()

    def _data_by_transmission_type(self) -> bytes | None:
        """Return the data that the transmission type requires to send at a SYNC, or None."""
        transmission_type = self._type.value
        if transmission_type == 1:
            return self.build_data()
        if transmission_type == 0:
            pdo_data = self.build_data()
            has_changed, self._last_data = pdo_data != self._last_data, pdo_data
            return pdo_data if has_changed else None
        self._syncs += 1
        if self._syncs < transmission_type:
            return None
        self._syncs = 0
        return self.build_data()

    def data_at_event(self, now_s: float) -> bytes | None:
        """Return the data to send if a value has changed or the timer has expired, else None."""
        pdo_data = self.build_data()
        age_s = now_s - self._sent_s
        event_timer_s = 1e-3 * self._timer.value
        is_timer_due = event_timer_s > 0 and age_s >= event_timer_s - 1e-9
        is_inhibited = age_s < 1e-4 * self._inhibit.value - 1e-9
        if (
            self._last_data is not None
            and not is_timer_due
            and (pdo_data == self._last_data or is_inhibited)
        ):
            return None
        self._last_data = pdo_data
        self._sent_s = now_s
        return pdo_data


def _check_transmission_type(new_transmission_type: int) -> None:
    """Raise `Abort` if a value is not a supported transmission type of a PDO."""
    if (
        new_transmission_type > _MAX_SYNCHRONOUS_TYPE
        and new_transmission_type not in _EVENT_DRIVEN_TYPES
    ):
        raise Abort(AbortCode.INVALID_VALUE)
