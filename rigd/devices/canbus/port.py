"""Ports of a CAN bus: a socket of the kernel, the Unix socket of a simulated bus, or python-can.

All carry the kernel's ``struct can_frame``: identifier, length, up to eight bytes; 16 bytes in all.
Classical CAN with identifiers of 11 bits is all that the rig speaks.
"""

import errno
import select
import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from struct import Struct
from typing import TYPE_CHECKING, Protocol

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress

if TYPE_CHECKING:
    import can

FRAME_SIZE = 16
ERROR_FLAG = 0x2000_0000
"""Flag in the identifier: the controller reports on itself (linux/can/error.h)."""
LONG_FLAG = 0x8000_0000
"""Flag in the identifier: it has 29 bits; no device of the rig sends such frames."""
REMOTE_FLAG = 0x4000_0000
"""Flag in the identifier: a request for data; no device of the rig sends such frames."""
ERROR_MASK = 0x1FFF_FFFF
SFF_MASK = 0x7FF

BUS_OFF = 0x40
"""Class of an error frame: the controller has switched itself off after too many errors."""
_PROTOCOL_VIOLATION = 0x08

_FRAME = Struct("=IB3x8s")
BUS_OFF_FRAME = _FRAME.pack(ERROR_FLAG | BUS_OFF, 8, bytes(8))
"""Error frame with which the kernel reports bus-off."""
DAMAGED_FRAME = _FRAME.pack(ERROR_FLAG | _PROTOCOL_VIOLATION, 8, bytes(8))
"""Frame that replaces a damaged one; it is counted, and has no other effect."""
LENGTH_AT = 4
"""Offset of the number of data bytes in a raw frame."""
read_head = Struct("=IB").unpack_from
"""Identifier with flags, and length, from raw frame."""


# Frames


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Return the 16 bytes of a frame.

    Parameters
    ----------
    can_id
        Identifier of 11 bits.
    data
        At most eight bytes.

    Raises
    ------
    ValueError
        If the identifier has more than 11 bits, or there are more than eight bytes.

    Examples
    --------
    >>> from rigd.devices.canbus.port import pack_frame, unpack_frame
    >>> raw = pack_frame(0x181, b"rigd")
    >>> len(raw), unpack_frame(raw)
    (16, (385, b'rigd'))
    """
    if not 0 <= can_id <= SFF_MASK:
        raise ValueError(f"{can_id:#x} is not an 11-bit CAN identifier.")
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes do not fit into a CAN frame, which has 8.")
    return _FRAME.pack(can_id, len(data), data)


def unpack_frame(raw: bytes) -> tuple[int, bytes]:
    """Return identifier (flags included) and data of 16 bytes; a length beyond 8 counts as 8."""
    can_id, length, data = _FRAME.unpack(raw)
    return can_id, data[: min(length, 8)]


# Ports

# Receive buffer for a late reader: some 200 ms of a full bus.
_RECEIVE_BUFFER = 212_992
# As large as the system allows: a stopped simulated rig is detected by its silence.
_SIMULATOR_SEND_BUFFER = 4_194_304
_CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h
_DAMAGED_IN_A_ROW = 20
"""Frames that an adapter cannot read, without a sound one in between, that end a session."""


class CanPort(Protocol):
    """One connection to a bus. Nothing here blocks, but for `wait`.

    Whatever an adapter's driver raises leaves every method as a `DeviceError`, but for `close`,
    which raises nothing.
    """

    name: str
    """Name of the bus, for messages."""

    def send(self, frame: bytes) -> None:
        """Send 16 bytes made by :func:`rigd.devices.canbus.port.pack_frame`.

        Raises
        ------
        DeviceError
            If the bus does not take it.
        """

    def receive(self) -> bytes | None:
        """Return the next frame that has arrived, of 16 bytes, or None.

        A damaged frame is returned as an error frame.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def wait(self, timeout_s: float) -> None:
        """Return as soon as a frame may have arrived, or after the timeout.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Accept only frames of these identifiers, and error frames of the controller.

        None accepts all frames again.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus on this port, for set-up; closing it leaves the port open."""

    def close(self) -> None:
        """Release the port; harmless when repeated."""


class SocketPort:
    """A socket that carries ``struct can_frame``: the kernel's CAN, or the simulated bus.

    Parameters
    ----------
    link
        Connected socket; it is made non-blocking.
    name
        Name of the bus, for messages.
    remedy
        Advice for the operator where the bus is gone.
    """

    def __init__(
        self, link: socket.socket, name: str, remedy: str = "check cable and adapter"
    ) -> None:
        link.setblocking(False)
        self._link = link
        self._send = link.send
        self._recv = link.recv
        self._fd = [link.fileno()]
        self.name = name
        self._remedy = remedy

    def send(self, frame: bytes) -> None:
        """Send one frame of 16 bytes."""
        try:
            self._send(frame)
        except OSError as error:
            raise DeviceError(self._why("takes no more frames", error)) from None

    def receive(self) -> bytes | None:
        """Return the next frame, or None."""
        try:
            raw = self._recv(FRAME_SIZE)
        except BlockingIOError:
            return None
        except OSError as error:
            raise DeviceError(self._why("cannot be read", error)) from None
        if len(raw) != FRAME_SIZE:
            raise DeviceError(f"CAN bus {self.name}: it was cut off; {self._remedy}.")
        return raw

    def wait(self, timeout_s: float) -> None:
        """Wait for a frame."""
        try:
            select.select(self._fd, (), (), timeout_s)
        except (OSError, ValueError) as error:
            raise DeviceError(self._why("cannot be waited for", error)) from None

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Let the kernel filter all other identifiers; a simulated bus delivers all."""
        if self._link.family == getattr(socket, "AF_CAN", None):
            exactly = SFF_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
            wanted = [(0, 0)] if can_ids is None else [(i, exactly) for i in sorted(set(can_ids))]
            filters = b"".join(struct.pack("=II", *each) for each in wanted)
            try:
                self._link.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
            except OSError as error:
                raise DeviceError(self._why("takes no filter", error)) from None

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus that sends and receives through this port."""
        from rigd.devices.canbus._setup_bus import SetupBus

        return SetupBus(self)

    def close(self) -> None:
        """Close the socket."""
        with suppress(OSError):
            self._link.close()

    def _why(self, what: str, error: OSError | ValueError) -> str:
        reason, number = str(error), None
        if isinstance(error, OSError):
            reason, number = error.strerror or reason, error.errno
        remedy = (
            "no other device acknowledges: check cable, termination, power and bit rate"
            if number in (errno.ENOBUFS, errno.EAGAIN)
            else self._remedy
        )
        return f"CAN bus {self.name}: it {what} ({reason}); {remedy}."


class PythonCanPort:
    """Adapter of python-can. It takes about three times the processor time of a socket.

    An adapter's driver says by `can.CanError` or OSError that the adapter has failed. Anything else
    that it raises while it receives is a frame that it could not read: the parser of slcan raises
    ValueError for a damaged line. One such frame is an error on the line, and many in a row are an
    adapter that has failed.

    Parameters
    ----------
    bus
        Open bus of python-can.
    name
        Name of the bus, for messages.
    """

    def __init__(self, bus: "can.BusABC", name: str) -> None:
        import can

        from rigd.devices.canbus._setup_bus import from_message, to_message

        self._bus = bus
        self._to_message, self._from_message = to_message, from_message
        self._error = can.CanError
        self._next: bytes | None = None
        self._damaged_in_a_row = 0
        self.name = name

    def send(self, frame: bytes) -> None:
        """Send one frame of 16 bytes."""
        try:
            self._bus.send(self._to_message(frame), timeout=0.0)
        except Exception as error:
            raise DeviceError(
                f"CAN bus {self.name}: it takes no more frames ({_words(error)}); check cable "
                "and adapter."
            ) from None

    def receive(self) -> bytes | None:
        """Return the next frame, or None."""
        if self._next is not None:
            raw, self._next = self._next, None
            return raw
        return self._receive(0.0)

    def wait(self, timeout_s: float) -> None:
        """Wait for a frame."""
        if self._next is None:
            self._next = self._receive(timeout_s)

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Do nothing: python-can's filters end a poll at each dropped frame, and drop errors."""

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus that sends and receives through this port."""
        from rigd.devices.canbus._setup_bus import SetupBus

        return SetupBus(self)

    def close(self) -> None:
        """Shut the adapter down."""
        with suppress(Exception):
            self._bus.shutdown()

    def _receive(self, timeout_s: float) -> bytes | None:
        try:
            message = self._bus.recv(timeout_s)
            raw = None if message is None else self._from_message(message)
        except (self._error, OSError) as error:
            raise DeviceError(
                f"CAN bus {self.name}: it cannot be read ({_words(error)}); check cable and "
                "adapter."
            ) from None
        except Exception as error:
            self._damaged_in_a_row += 1
            if self._damaged_in_a_row < _DAMAGED_IN_A_ROW:
                return DAMAGED_FRAME
            self._damaged_in_a_row = 0
            raise DeviceError(
                f"CAN bus {self.name}: the adapter sends what is no CAN frame, "
                f"{_DAMAGED_IN_A_ROW} times in a row ({_words(error)}); check the adapter, its "
                "cable and its firmware."
            ) from None
        if raw is not None and not read_head(raw)[0] & ERROR_FLAG:
            self._damaged_in_a_row = 0
        return raw


def _words(error: Exception) -> str:
    """Return the text and the type of an adapter's error: some have no text."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def open_port(settings: CanBus, simulator: SimulatorAddress | None) -> CanPort:
    """Open the bus of a profile, or that of the simulated rig that replaces it.

    Parameters
    ----------
    settings
        The profile's ``[can]``.
    simulator
        Simulated rig that replaces the hardware; None: the bus itself.

    Raises
    ------
    DeviceError
        If there is no such bus here; the message says how to get one.
    """
    name = f"{settings.channel} ({settings.interface})"
    if simulator is not None and simulator.can_socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SIMULATOR_SEND_BUFFER)
        try:
            link.connect(simulator.can_socket)
        except OSError as error:
            link.close()
            raise DeviceError(
                f"CAN bus {name}: the simulated rig does not answer ({error.strerror}); start "
                "rigd simulate again."
            ) from None
        return SocketPort(link, f"{name}, simulated", "check whether rigd simulate still runs")
    if settings.interface == "socketcan":
        return SocketPort(_open_socketcan(settings), name)
    import can

    try:
        bus = can.Bus(
            interface=settings.interface, channel=settings.channel, bitrate=settings.bitrate_bit_s
        )
    except Exception as error:
        raise DeviceError(
            f"CAN bus {name}: it cannot be opened ({_words(error)}); check can.interface and "
            "can.channel."
        ) from None
    return PythonCanPort(bus, name)


def _open_socketcan(settings: CanBus) -> socket.socket:
    channel = settings.channel
    remedy = (
        f"bring it up with: ip link set {channel} up type can bitrate {settings.bitrate_bit_s}; "
        "or start the simulated rig: rigd simulate --profile PROFILE"
    )
    if not hasattr(socket, "AF_CAN"):
        raise DeviceError(f"CAN bus {channel}: this system has no CAN sockets; {remedy}.")
    try:
        link = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise DeviceError(
            f"CAN bus {channel}: this kernel has no CAN sockets ({error.strerror}); {remedy}."
        ) from None
    try:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        link.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", ERROR_MASK))
        link.bind((channel,))
    except OSError as error:
        link.close()
        raise DeviceError(
            f"CAN bus {channel}: it cannot be opened ({error.strerror}); {remedy}."
        ) from None
    return link
