"""Read and write the drive's objects by SDO, while the control loop does not run.

The canopen library transfers the values, and receives replies in a thread that ends with the
context. An object's data type is taken from the drive's EDS file if the profile names one, else
from ``drive.eds`` in this folder.
"""

import logging
import queue
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import can
import canopen
from canopen.network import MessageListener
from canopen.objectdictionary import (
    ObjectDictionary,
    ObjectDictionaryError,
    ODRecord,
    ODVariable,
    datatypes,
)
from canopen.sdo.base import SdoVariable
from canopen.sdo.client import SdoClient

from rigd.devices.canbus.port import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402._assignments import Assignment
from rigd.devices.cia402._protocol import NMT_PRE_OPERATIONAL
from rigd.devices.contracts import DeviceError
from rigd.devices.eds import EdsError, read_eds

ALL_BITS_MASK = 0xFFFF_FFFF
"""Mask that selects all 32 bits of an object's value."""

_DEFAULT_EDS_PATH = Path(__file__).with_name("drive.eds")
"""EDS file with the data types of the objects that the driver uses."""
_SDO_TIMEOUT_S = 0.5
"""Time in seconds to wait for the reply to one SDO request."""
_SDO_ATTEMPTS = 2
"""Number of attempts of one SDO transfer."""
_SHORT_SDO_TIMEOUT_S = 0.05
"""Time in seconds to wait for an SDO reply while the torque has to be switched off quickly."""
_MAX_LATE_REPLIES = 3
"""Largest number of replies to abandoned requests that may arrive before the awaited reply."""
_LATE_REPLY_SILENCE_S = 0.25
"""Silence in seconds after which all replies to abandoned requests have arrived."""
_TIMEOUT_MESSAGE_START = "No SDO response"
"""Beginning of canopen's message if no reply came; any other message means a wrong reply."""
_RECEIVER_POLL_INTERVAL_S = 0.02
"""Interval in seconds at which canopen's receiving thread checks whether it has to end."""
_ABSENT_OBJECT_ABORTS = {
    0x0602_0000: "no such object",
    0x0609_0011: "no such sub-index",
    0x060A_0023: "nothing behind it",
    0x0800_0024: "it has no value",
    # Codes that simple firmware sends for objects that it does not have.
    0x0800_0000: "general error",
    0x0504_0001: "unknown command",
    0x0601_0000: "unsupported access",
}
"""SDO abort codes that mean that the drive has no such object, with their meanings.

They have this meaning when the object is read, or is written after reading it failed. Codes for an
object that is not accessible in the present state (0x08000022), or only in the other direction, are
not in the table."""
_WRITE_ONLY_ABORT = 0x0601_0001
"""SDO abort code for reading a write-only object."""
_WRONG_LENGTH_ABORTS = (0x0607_0010, 0x0607_0012, 0x0607_0013)
"""SDO abort codes for a value whose length does not match the object's data type."""
_DATA_TYPES = {
    "u8": datatypes.UNSIGNED8,
    "u16": datatypes.UNSIGNED16,
    "u32": datatypes.UNSIGNED32,
    "i8": datatypes.INTEGER8,
    "i16": datatypes.INTEGER16,
    "i32": datatypes.INTEGER32,
}
"""CANopen data type by the name of the integer type in a profile (``cia402.set_objects``)."""


class SdoAbortError(DeviceError):
    """Error: the drive refused to read or write an object; `code` is the SDO abort code."""

    def __init__(self, message: str, abort_code: int) -> None:
        super().__init__(message)
        self.code = abort_code

    @property
    def is_object_absent(self) -> bool:
        """Whether the abort code means that the drive has no such object."""
        return self.code in _ABSENT_OBJECT_ABORTS

    @property
    def is_object_write_only(self) -> bool:
        """Whether the abort code means that the object exists but can only be written."""
        return self.code == _WRITE_ONLY_ABORT


class ValueNotStoredError(DeviceError):
    """Error: the value read back from an object (`value_read`) differs from that written."""

    def __init__(self, message: str, value_read: int) -> None:
        super().__init__(message)
        self.value_read = value_read


class _ErrorIgnoringListener(MessageListener):
    """Frame listener for canopen that ignores bus errors in its thread.

    The next SDO request fails and reports the bus error to the caller.
    """

    def on_error(self, exc: Exception) -> None:  # noqa: ARG002
        """Ignore a bus error, so that the receiving thread goes on until the network ends it."""
        time.sleep(_RECEIVER_POLL_INTERVAL_S)


class SdoAccess:
    """Context manager that reads and writes one drive's objects by SDO.

    No other code receives from the open port meanwhile. The drive's name is for messages.
    """

    def __init__(self, port: CanPort, node_id: int, drive_name: str) -> None:
        for library in ("can", "canopen"):
            # Errors are raised; without a handler these libraries would print them, too.
            logging.getLogger(library).addHandler(logging.NullHandler())
        self._name = drive_name
        self._bus_name = port.name
        self._node_id = node_id
        self._node = canopen.RemoteNode(node_id, canopen.import_od(str(_DEFAULT_EDS_PATH), node_id))
        self._node.sdo.RESPONSE_TIMEOUT = _SDO_TIMEOUT_S
        self._node.sdo.MAX_RETRIES = _SDO_ATTEMPTS
        port.accept(None)  # a sensor on the same bus may have restricted it to its own frames
        self._network = canopen.Network(port.open_bus())
        self._network.NOTIFIER_CYCLE = _RECEIVER_POLL_INTERVAL_S
        self._network.listeners = [_ErrorIgnoringListener(self._network)]

    def __enter__(self) -> "SdoAccess":
        self._network.add_node(self._node)
        self._network.connect()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # If the bus was cut, disconnecting reports that error again; nobody needs it any more.
        with suppress(Exception):
            self._network.disconnect()

    def enter_pre_operational(self) -> None:
        """Command the drive to the NMT state pre-operational, and check that it answers.

        Raise `DeviceError` if the drive does not answer.
        """
        self.request_pre_operational()
        try:
            self.read(objects.IDENTITY, 1)
        except SdoAbortError:
            return
        except DeviceError as error:
            other_nodes = sorted(set(self._network.scanner.nodes) - {self._node.id})
            received_text = (
                f"; frames came from node {', '.join(map(str, other_nodes))}" if other_nodes else ""
            )
            raise DeviceError(
                f"{error} Check its supply, its node id (cia402.node_id) and bit "
                f"rate{received_text}."
            ) from None

    def load_eds(self, eds_path: str) -> tuple[int, int]:
        """Load the objects' data types from a drive's EDS file; return vendor and product code.

        A number that the file does not state is 0. Raise `DeviceError` if the file cannot be read.
        """
        return _load_integer_types(self._node.object_dictionary, eds_path, self._node_id)

    def request_pre_operational(self) -> None:
        """Command the drive to pre-operational without waiting; the drive may ignore the command.

        Raise `DeviceError` if the bus does not take the command.
        """
        try:
            self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
        except (can.CanError, OSError) as error:
            raise DeviceError(
                f"{self._name}: CAN bus {self._bus_name} takes no commands ({error})."
            ) from None

    @contextmanager
    def short_timeouts(self) -> Iterator[None]:
        """Allow each SDO transfer in this context one attempt of 50 ms, to switch off quickly."""
        sdo_client = self._node.sdo
        previous_timeout_and_retries = sdo_client.RESPONSE_TIMEOUT, sdo_client.MAX_RETRIES
        sdo_client.RESPONSE_TIMEOUT, sdo_client.MAX_RETRIES = _SHORT_SDO_TIMEOUT_S, 1
        try:
            yield
        finally:
            sdo_client.RESPONSE_TIMEOUT, sdo_client.MAX_RETRIES = previous_timeout_and_retries

    def read(self, index: int, subindex: int = 0) -> int:
        """Read an object by SDO and return its integer value.

        Raise `DeviceError` if the drive does not answer, or refuses (:class:`SdoAbortError`).
        """
        object_value = self._transfer(index, subindex, None)
        if not isinstance(object_value, int):
            raise DeviceError(
                f"{self._name}: {self._object_name(index, subindex)} is not a number."
            )
        return object_value

    def read_or_none(self, index: int, subindex: int = 0) -> int | None:
        """Read an object by SDO and return its value, or None if the drive has no such object.

        Raise `DeviceError` if the drive does not answer, or refuses for another reason.
        """
        try:
            return self.read(index, subindex)
        except SdoAbortError as refusal:
            if refusal.is_object_absent:
                return None
            raise

    def read_text(self, index: int) -> str:
        """Read a text object by SDO; return an empty text if the drive refuses to read it."""
        try:
            return str(self._transfer(index, 0, None)).strip("\0 ")
        except SdoAbortError:
            return ""

    def write(self, index: int, subindex: int, object_value: int) -> None:
        """Write an object by SDO without reading it back.

        Raise `DeviceError` if the drive does not answer, or refuses.
        """
        self._transfer(index, subindex, object_value)

    def configure(
        self, index: int, subindex: int, object_value: int, compared_bits_mask: int = ALL_BITS_MASK
    ) -> None:
        """Write an object by SDO, read it back, and raise if the values differ.

        Raise `DeviceError` if the drive does not answer, refuses (:class:`SdoAbortError`), or
        stores another value in the bits of `compared_bits_mask` (:class:`ValueNotStoredError`).
        """
        self.write(index, subindex, object_value)
        value_read = self.read(index, subindex)
        if (value_read ^ object_value) & compared_bits_mask:
            raise ValueNotStoredError(
                f"{self._name}: {self._object_name(index, subindex)} was set to "
                f"{value_text(object_value)} and reads {value_text(value_read)}; check with the "
                "drive's own tool why it does not retain this value.",
                value_read,
            )

    def assign(self, assignment: Assignment) -> None:
        """Write a manufacturer-specific object of the profile and read it back.

        Raises the same errors as :meth:`configure`.
        """
        index, subindex = assignment.index, assignment.subindex
        variable = self._variable(index, subindex)
        variable.data_type = _DATA_TYPES[assignment.integer_type]
        self.configure(index, subindex, assignment.object_value)

    def last_emergency(self) -> int:
        """Return the error code of the drive's last emergency message, or 0 if there was none."""
        emergency_log = self._node.emcy.log
        return emergency_log[-1].code if emergency_log else 0

    def _transfer(self, index: int, subindex: int, value_to_write: int | None) -> object:
        """Write a value to an object, or read the object if the value is None; return the value."""
        variable = SdoVariable(self._node.sdo, self._variable(index, subindex))
        action_text = (
            "reading" if value_to_write is None else f"writing {value_text(value_to_write)} to"
        )
        try:
            return _transfer_skipping_late_replies(self._node.sdo, variable, value_to_write)
        except canopen.SdoAbortedError as error:
            remedy = (
                " Name the drive's EDS file in the profile (cia402.eds), which has its types."
                if error.code in _WRONG_LENGTH_ABORTS
                else ""
            )
            raise SdoAbortError(
                f"{self._name}: it refuses {action_text} {self._object_name(index, subindex)}: "
                f"{error}.{remedy}",
                error.code,
            ) from None
        except (canopen.SdoCommunicationError, can.CanError, OSError):
            raise DeviceError(
                f"{self._name}: no answer on CAN bus {self._bus_name} to {action_text} "
                f"{self._object_name(index, subindex)}."
            ) from None
        except (ObjectDictionaryError, ValueError) as error:
            raise DeviceError(
                f"{self._name}: unusable answer to {action_text} "
                f"{self._object_name(index, subindex)} ({error})."
            ) from None

    def _variable(self, index: int, subindex: int) -> ODVariable:
        """Return the dictionary entry of an object; create the entry if the dictionary has none."""
        object_dictionary = self._node.object_dictionary
        variable_or_none = object_dictionary.get_variable(index, subindex)
        if variable_or_none is not None:
            return variable_or_none
        new_variable = ODVariable("", index, subindex)
        new_variable.data_type = _DATA_TYPES[_communication_parameter_type(index, subindex)]
        if index not in object_dictionary:
            object_dictionary.add_object(ODRecord(f"{index:04X}", index))
        object_record = object_dictionary[index]
        if isinstance(object_record, ODVariable):
            object_dictionary.add_object(object_record := ODRecord(f"{index:04X}", index))
        object_record.add_member(new_variable)
        return new_variable

    def _object_name(self, index: int, subindex: int) -> str:
        """Return index, sub-index and name of an object for messages."""
        object_name = self._variable(index, subindex).name
        address = f"{index:04X}:{subindex}" if subindex else f"{index:04X}"
        return f"object {address}" + (f" ({object_name})" if object_name else "")


def _transfer_skipping_late_replies(
    client: SdoClient, variable: SdoVariable, value_to_write: int | None
) -> object:
    """Read an object by SDO, or write `value_to_write` unless it is None; return the value.

    Late replies to abandoned requests are skipped.
    """
    for attempts_left in reversed(range(_MAX_LATE_REPLIES + 1)):
        try:
            if value_to_write is None:
                return variable.raw
            variable.raw = value_to_write
            return value_to_write
        except canopen.SdoCommunicationError as error:
            if not attempts_left or str(error).startswith(_TIMEOUT_MESSAGE_START):
                raise
            # The reply to this request is still to come: it would be taken for the reply to the
            # next request.
            _discard_late_replies(client)
    raise AssertionError


def _discard_late_replies(sdo_client: SdoClient) -> None:
    """Discard late SDO replies until none arrives for a while."""
    max_wait_s = min(_LATE_REPLY_SILENCE_S, sdo_client.RESPONSE_TIMEOUT)
    with suppress(queue.Empty):
        while True:
            sdo_client.responses.get(timeout=max_wait_s)


def _load_integer_types(
    object_dictionary: ObjectDictionary, eds_path: str, node_id: int
) -> tuple[int, int]:
    """Copy integer data types from a drive's EDS file into an object dictionary.

    Return vendor and product code in the EDS file.
    """
    try:
        drive_eds = read_eds(Path(eds_path), node_id)
    except EdsError as error:
        raise DeviceError(
            f"{error} Get it again from the manufacturer, or remove cia402.eds from the profile."
        ) from None
    for address in [
        (v.index, v.subindex) for o in object_dictionary.values() for v in _variables_of_entry(o)
    ]:
        eds_entry, own_entry = drive_eds.get(*address), object_dictionary.get_variable(*address)
        if (
            eds_entry is not None
            and own_entry is not None
            and {eds_entry.data_type, own_entry.data_type} <= set(datatypes.INTEGER_TYPES)
        ):
            own_entry.data_type = eds_entry.data_type
    return drive_eds.vendor_id, drive_eds.product_code


def _variables_of_entry(dictionary_entry: object) -> list[ODVariable]:
    """Return the variables of a dictionary entry: the entry itself, or its sub-entries."""
    if isinstance(dictionary_entry, ODVariable):
        return [dictionary_entry]
    return list(dictionary_entry.values())  # type: ignore[attr-defined]


def _communication_parameter_type(index: int, subindex: int) -> str:
    """Return the integer type that CiA 301 defines for a PDO parameter or heartbeat consumer."""
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return {0: "u8", 1: "u32", 2: "u8"}.get(subindex, "u16")
    return "u32" if subindex else "u8"


def value_text(value: object) -> str:
    """Format a value for messages: large numbers in hexadecimal."""
    if isinstance(value, int) and not -65536 < value < 65536:
        return f"0x{value:08X}"
    return str(value)
