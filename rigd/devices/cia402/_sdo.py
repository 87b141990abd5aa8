"""SDO access to the drive's objects, while no cycle runs.

The canopen library does the transfers, with a thread that receives; both end with the context. An
object's type is taken from the drive's EDS file where the profile names one, else from
``drive.eds`` in this folder.
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

EVERY_BIT = 0xFFFF_FFFF
"""Mask of an object all of whose bits count."""

_EDS = Path(__file__).with_name("drive.eds")
_SDO_TIMEOUT_S = 0.5
_SDO_TRIES = 2
_HURRIED_TIMEOUT_S = 0.05
_LATE_REPLIES = 3
"""Number of replies to earlier, abandoned requests that may come instead of the awaited one."""
_QUIET_S = 0.25
"""So long nothing comes once all replies to abandoned requests have."""
_TIMED_OUT = "No SDO response"
"""Beginning of canopen's message if no reply came; any other message means a wrong reply."""
_RECEIVER_POLL_S = 0.02
_ABSENT = {
    0x0602_0000: "no such object",
    0x0609_0011: "no such sub-index",
    0x060A_0023: "nothing behind it",
    0x0800_0024: "it has no value",
    # What firmware says that knows no better of an object which it has not.
    0x0800_0000: "general error",
    0x0504_0001: "unknown command",
    0x0601_0000: "unsupported access",
}
"""SDO abort codes by which an object that is read, or written after that, counts as absent. A state
in which it cannot be accessed (0x08000022) and an access in the wrong direction do not."""
_WRITE_ONLY = 0x0601_0001
_WRONG_LENGTHS = (0x0607_0010, 0x0607_0012, 0x0607_0013)
_KINDS = {
    "u8": datatypes.UNSIGNED8,
    "u16": datatypes.UNSIGNED16,
    "u32": datatypes.UNSIGNED32,
    "i8": datatypes.INTEGER8,
    "i16": datatypes.INTEGER16,
    "i32": datatypes.INTEGER32,
}


class SdoRefusal(DeviceError):
    """The drive refused to read or write an object; carries the abort code."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code

    @property
    def is_absent(self) -> bool:
        """Whether the abort code means that the drive has no such object."""
        return self.code in _ABSENT

    @property
    def is_write_only(self) -> bool:
        """Whether the object exists and cannot be read."""
        return self.code == _WRITE_ONLY


class ValueNotStored(DeviceError):
    """The drive accepted a value but reads back another one, which this error carries."""

    def __init__(self, message: str, got: int) -> None:
        super().__init__(message)
        self.got = got


class _Receiver(MessageListener):
    """Receiver of canopen that reports no error from its thread when the bus is disconnected.

    The next request reports the failure.
    """

    def on_error(self, exc: Exception) -> None:  # noqa: ARG002
        """Let the thread continue until the network ends it."""
        time.sleep(_RECEIVER_POLL_S)


class SdoAccess:
    """Reading and writing of one drive's objects, as a context.

    Parameters
    ----------
    port
        Open port; no other code receives from it meanwhile.
    node_id
        Node number of the drive.
    name
        Name of the drive, for messages.
    """

    def __init__(self, port: CanPort, node_id: int, name: str) -> None:
        for library in ("can", "canopen"):
            # What goes wrong is raised; without a handler they would also print it.
            logging.getLogger(library).addHandler(logging.NullHandler())
        self._name = name
        self._bus_name = port.name
        self._node_id = node_id
        self._node = canopen.RemoteNode(node_id, canopen.import_od(str(_EDS), node_id))
        self._node.sdo.RESPONSE_TIMEOUT = _SDO_TIMEOUT_S
        self._node.sdo.MAX_RETRIES = _SDO_TRIES
        port.accept(None)  # a sensor on the same bus may have narrowed it to its own frames
        self._network = canopen.Network(port.open_bus())
        self._network.NOTIFIER_CYCLE = _RECEIVER_POLL_S
        self._network.listeners = [_Receiver(self._network)]

    def __enter__(self) -> "SdoAccess":
        self._network.add_node(self._node)
        self._network.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # It reports a cut bus once more, when everything has ended.
        with suppress(Exception):
            self._network.disconnect()

    def to_pre_operational(self) -> None:
        """Bring the drive to pre-operational, and verify that it answers.

        Raises
        ------
        DeviceError
            If it does not.
        """
        self.request_pre_operational()
        try:
            self.read(objects.IDENTITY, 1)
        except SdoRefusal:
            return
        except DeviceError as error:
            others = sorted(set(self._network.scanner.nodes) - {self._node.id})
            received = f"; frames came from node {', '.join(map(str, others))}" if others else ""
            raise DeviceError(
                f"{error} Check its supply, its node id (cia402.node_id) and bit rate{received}."
            ) from None

    def use_eds(self, path: str) -> tuple[int, int]:
        """Take objects' types from the drive's EDS file from now on.

        Returns
        -------
        tuple of int
            Vendor and product number in it; 0 where it states none.

        Raises
        ------
        DeviceError
            If it cannot be read.
        """
        return _take_types(self._node.object_dictionary, path, self._node_id)

    def request_pre_operational(self) -> None:
        """Command the drive to pre-operational without waiting; the drive may ignore the command.

        Raises
        ------
        DeviceError
            If the bus does not take the command.
        """
        try:
            self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
        except (can.CanError, OSError) as error:
            raise DeviceError(
                f"{self._name}: CAN bus {self._bus_name} takes no commands ({error})."
            ) from None

    @contextmanager
    def hurried(self) -> Iterator[None]:
        """Allow each transfer one attempt of 50 ms, as needed to switch the torque off."""
        client = self._node.sdo
        before = client.RESPONSE_TIMEOUT, client.MAX_RETRIES
        client.RESPONSE_TIMEOUT, client.MAX_RETRIES = _HURRIED_TIMEOUT_S, 1
        try:
            yield
        finally:
            client.RESPONSE_TIMEOUT, client.MAX_RETRIES = before

    def read(self, index: int, sub: int = 0) -> int:
        """Return the value of an object.

        Raises
        ------
        DeviceError
            If the drive does not answer, or refuses (:class:`SdoRefusal`).
        """
        value = self._transfer(index, sub, None)
        if not isinstance(value, int):
            raise DeviceError(f"{self._name}: {self._title(index, sub)} is not a number.")
        return value

    def read_if_there(self, index: int, sub: int = 0) -> int | None:
        """Return the value of an object, or None where the drive has no such object.

        Raises
        ------
        DeviceError
            If the drive does not answer, or refuses for another reason.
        """
        try:
            return self.read(index, sub)
        except SdoRefusal as refusal:
            if refusal.is_absent:
                return None
            raise

    def read_text(self, index: int) -> str:
        """Return a text, empty if the drive has none; as :meth:`read` otherwise."""
        try:
            return str(self._transfer(index, 0, None)).strip("\0 ")
        except SdoRefusal:
            return ""

    def write(self, index: int, sub: int, value: int) -> None:
        """Write an object without reading it back.

        Raises
        ------
        DeviceError
            If the drive does not answer, or refuses.
        """
        self._transfer(index, sub, value)

    def configure(self, index: int, sub: int, value: int, mask: int = EVERY_BIT) -> None:
        """Write an object and read it back.

        Raises
        ------
        DeviceError
            If the drive does not answer, refuses (:class:`SdoRefusal`), or stores another value in
            the bits of `mask` (:class:`ValueNotStored`).
        """
        self.write(index, sub, value)
        got = self.read(index, sub)
        if (got ^ value) & mask:
            raise ValueNotStored(
                f"{self._name}: {self._title(index, sub)} was set to {show_value(value)} and reads "
                f"{show_value(got)}; check with the drive's own tool why it does not keep it.",
                got,
            )

    def assign(self, assignment: Assignment) -> None:
        """Write a manufacturer-specific object and read it back; raises as :meth:`configure`."""
        index, sub = assignment.index, assignment.sub
        variable = self._variable(index, sub)
        variable.data_type = _KINDS[assignment.kind]
        self.configure(index, sub, assignment.value)

    def last_emergency(self) -> int:
        """Return the code of the last emergency message received, or 0."""
        log = self._node.emcy.log
        return log[-1].code if log else 0

    def _transfer(self, index: int, sub: int, value: int | None) -> object:
        """Write a value, or read one."""
        variable = SdoVariable(self._node.sdo, self._variable(index, sub))
        what = "reading" if value is None else f"writing {show_value(value)} to"
        try:
            return _ask(self._node.sdo, variable, value)
        except canopen.SdoAbortedError as error:
            remedy = (
                " Name the drive's EDS file in the profile (cia402.eds), which has its types."
                if error.code in _WRONG_LENGTHS
                else ""
            )
            raise SdoRefusal(
                f"{self._name}: it refuses {what} {self._title(index, sub)}: {error}.{remedy}",
                error.code,
            ) from None
        except (canopen.SdoCommunicationError, can.CanError, OSError):
            raise DeviceError(
                f"{self._name}: no answer on CAN bus {self._bus_name} to {what} "
                f"{self._title(index, sub)}."
            ) from None
        except (ObjectDictionaryError, ValueError) as error:
            raise DeviceError(
                f"{self._name}: unusable answer to {what} {self._title(index, sub)} ({error})."
            ) from None

    def _variable(self, index: int, sub: int) -> ODVariable:
        """Return the entry of an object in the dictionary, made where it has none."""
        dictionary = self._node.object_dictionary
        known = dictionary.get_variable(index, sub)
        if known is not None:
            return known
        variable = ODVariable("", index, sub)
        variable.data_type = _KINDS[_kind_of_parameter(index, sub)]
        if index not in dictionary:
            dictionary.add_object(ODRecord(f"{index:04X}", index))
        record = dictionary[index]
        if isinstance(record, ODVariable):
            dictionary.add_object(record := ODRecord(f"{index:04X}", index))
        record.add_member(variable)
        return variable

    def _title(self, index: int, sub: int) -> str:
        name = self._variable(index, sub).name
        address = f"{index:04X}:{sub}" if sub else f"{index:04X}"
        return f"object {address}" + (f" ({name})" if name else "")


def _ask(client: SdoClient, variable: SdoVariable, value: int | None) -> object:
    """Read or write a value; skip late replies to abandoned requests."""
    for left in reversed(range(_LATE_REPLIES + 1)):
        try:
            if value is None:
                return variable.raw
            variable.raw = value
            return value
        except canopen.SdoCommunicationError as error:
            if not left or str(error).startswith(_TIMED_OUT):
                raise
            # That to this request is still to come: it would be taken for that to the next one.
            _let_pass(client)
    raise AssertionError


def _let_pass(client: SdoClient) -> None:
    """Discard replies until no more arrive."""
    patience_s = min(_QUIET_S, client.RESPONSE_TIMEOUT)
    with suppress(queue.Empty):
        while True:
            client.responses.get(timeout=patience_s)


def _take_types(own: ObjectDictionary, eds: str, node_id: int) -> tuple[int, int]:
    """Take the types of whole numbers from a drive's EDS file; return its identity."""
    try:
        theirs = read_eds(Path(eds), node_id)
    except EdsError as error:
        raise DeviceError(
            f"{error} Get it again from the manufacturer, or remove cia402.eds from the profile."
        ) from None
    for address in [(v.index, v.subindex) for o in own.values() for v in _variables(o)]:
        entry, mine = theirs.get(*address), own.get_variable(*address)
        if (
            entry is not None
            and mine is not None
            and {entry.data_type, mine.data_type} <= set(datatypes.INTEGER_TYPES)
        ):
            mine.data_type = entry.data_type
    return theirs.vendor_id, theirs.product_code


def _variables(entry: object) -> list[ODVariable]:
    return [entry] if isinstance(entry, ODVariable) else list(entry.values())  # type: ignore[attr-defined]


def _kind_of_parameter(index: int, sub: int) -> str:
    """Return the type of a PDO's parameter or of a heartbeat consumer, by CiA 301."""
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return {0: "u8", 1: "u32", 2: "u8"}.get(sub, "u16")
    return "u32" if sub else "u8"


def show_value(value: object) -> str:
    """Return a value as messages show it: large numbers in hexadecimal."""
    if isinstance(value, int) and not -65536 < value < 65536:
        return f"0x{value:08X}"
    return str(value)
