"""Reading and writing of the drive's objects by SDO, while no cycle runs.

The canopen library does it, with a thread that receives; both are gone when the access is left.
What it takes of an object's type stands in ``drive.eds``.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import can
import canopen
from canopen.network import MessageListener
from canopen.objectdictionary import ObjectDictionaryError

from rigd.devices.canbus import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402.frames import NMT_PRE_OPERATIONAL
from rigd.devices.contracts import DeviceError

EVERY_BIT = 0xFFFF_FFFF
"""Mask of an object all of whose bits count."""

_EDS = Path(__file__).with_name("drive.eds")
_SDO_TIMEOUT_S = 0.5
_SDO_TRIES = 2
_HURRIED_TIMEOUT_S = 0.05
_RECEIVER_POLL_S = 0.02
_ABSENT = (0x0602_0000, 0x0609_0011, 0x060A_0023)
"""SDO abort codes: no such object, no such sub-index, nothing behind it."""


class SdoRefusal(DeviceError):
    """The drive refused to read or write an object; carries the abort code."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class _Receiver(MessageListener):
    """Canopen's receiver; it keeps its thread quiet when the bus is cut.

    The next request reports the failure.
    """

    def on_error(self, exc: Exception) -> None:  # noqa: ARG002
        """Let the thread go on until the network ends it; it would ask again at once."""
        time.sleep(_RECEIVER_POLL_S)


class SdoAccess:
    """Reading and writing of one drive's objects, as a context.

    Parameters
    ----------
    port
        Open; nobody else receives from it meanwhile.
    node_id
        Of the drive.
    name
        Of the drive, for messages.
    """

    def __init__(self, port: CanPort, node_id: int, name: str) -> None:
        for library in ("can", "canopen"):
            # What goes wrong is raised; without a handler they would also print it.
            logging.getLogger(library).addHandler(logging.NullHandler())
        self._name = name
        self._bus_name = port.name
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
        """Have the drive leave operational, and make sure that it answers.

        Raises
        ------
        DeviceError
            If it does not.
        """
        self.tell_pre_operational()
        try:
            self.read(objects.IDENTITY, 1)
        except SdoRefusal:
            return
        except DeviceError as error:
            others = sorted(set(self._network.scanner.nodes) - {self._node.id})
            heard = f"; heard of node {', '.join(map(str, others))}" if others else ""
            raise DeviceError(
                f"{error} Look at its supply, its node id (cia402.node_id) and bit rate{heard}."
            ) from None

    def tell_pre_operational(self) -> None:
        """Tell the drive to leave operational, which it may ignore; nobody waits for it.

        Raises
        ------
        DeviceError
            If the bus does not take the command.
        """
        try:
            self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
        except can.CanError as error:
            raise DeviceError(
                f"{self._name}: CAN bus {self._bus_name} takes no commands ({error})."
            ) from None

    @contextmanager
    def hurried(self) -> Iterator[None]:
        """Wait for each answer for 50 ms only, and ask once, as where torque is to be taken off."""
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
            if refusal.code in _ABSENT:
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
            If the drive does not answer, refuses, or keeps another value in the bits of `mask`.
        """
        self.write(index, sub, value)
        got = self.read(index, sub)
        if (got ^ value) & mask:
            raise DeviceError(
                f"{self._name}: {self._title(index, sub)} was set to {show_value(value)} and reads "
                f"{show_value(got)}; check with the drive's own tool why it does not keep it."
            )

    def last_emergency(self) -> int:
        """Return the code of the last emergency message heard, or 0."""
        log = self._node.emcy.log
        return log[-1].code if log else 0

    def _transfer(self, index: int, sub: int, value: int | None) -> object:
        """Write a value, or read one."""
        variable = self._node.sdo.get_variable(index, sub)
        assert variable is not None, f"0x{index:04X}:{sub} is missing in {_EDS.name}"
        what = "reading" if value is None else f"writing {show_value(value)} to"
        try:
            if value is None:
                return variable.raw
            variable.raw = value
            return value
        except canopen.SdoAbortedError as error:
            raise SdoRefusal(
                f"{self._name}: it refuses {what} {self._title(index, sub)}: {error}.", error.code
            ) from None
        except (canopen.SdoCommunicationError, can.CanError):
            raise DeviceError(
                f"{self._name}: no answer on CAN bus {self._bus_name} to {what} "
                f"{self._title(index, sub)}."
            ) from None
        except (ObjectDictionaryError, ValueError) as error:
            raise DeviceError(
                f"{self._name}: unusable answer to {what} {self._title(index, sub)} ({error})."
            ) from None

    def _title(self, index: int, sub: int) -> str:
        entry = self._node.object_dictionary.get_variable(index, sub)
        place = f"{index:04X}:{sub}" if sub else f"{index:04X}"
        return f"object {place}" + (f" ({entry.name})" if entry is not None else "")


def show_value(value: object) -> str:
    """Return a value as messages show it: large numbers in hexadecimal."""
    if isinstance(value, int) and not -65536 < value < 65536:
        return f"0x{value:08X}"
    return str(value)
