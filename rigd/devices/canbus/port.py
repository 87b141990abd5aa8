"""Ports to a CAN bus: a socket of the kernel, the Unix socket of a simulated bus, or python-can.

All ports use the layout of the kernel's ``struct can_frame``, 16 bytes with identifier, length and
up to eight data bytes. The rig uses only classical CAN with 11-bit identifiers.
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
"""Size of a raw CAN frame in bytes."""
ERROR_FLAG = 0x2000_0000
"""Flag in the identifier of an error frame, with which the controller reports its state.

See linux/can/error.h."""
EXTENDED_FLAG = 0x8000_0000
"""Flag in the identifier of a frame with 29 identifier bits; no device of the rig sends such
frames."""
REMOTE_FLAG = 0x4000_0000
"""Flag in the identifier of a remote request for data; no device of the rig sends such frames."""
ERROR_MASK = 0x1FFF_FFFF
"""Mask of the error class in the identifier of an error frame."""
STANDARD_ID_MASK = 0x7FF
"""Mask of an 11-bit identifier (standard frame format)."""

BUS_OFF = 0x40
"""Class of an error frame: the controller has switched itself off after too many errors."""
_PROTOCOL_VIOLATION = 0x08
"""Class of an error frame: a frame violated the protocol."""

_FRAME_LAYOUT = Struct("=IB3x8s")
"""Layout of a raw CAN frame: identifier with flags, length, data."""
BUS_OFF_FRAME = _FRAME_LAYOUT.pack(ERROR_FLAG | BUS_OFF, 8, bytes(8))
"""Error frame with which the kernel reports that the controller is off the bus."""
DAMAGED_FRAME = _FRAME_LAYOUT.pack(ERROR_FLAG | _PROTOCOL_VIOLATION, 8, bytes(8))
"""Error frame that replaces an unreadable frame; it is counted, and has no other effect."""
LENGTH_OFFSET = 4
"""Offset of the number of data bytes in a raw frame."""
unpack_header = Struct("=IB").unpack_from
"""Unpack identifier (with flags) and number of data bytes from a raw frame."""


# Frames


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Return the raw frame of 16 bytes with an identifier and data.

    Parameters
    ----------
    can_id
        CAN identifier of 11 bits.
    data
        At most eight data bytes.

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
    if not 0 <= can_id <= STANDARD_ID_MASK:
        raise ValueError(f"{can_id:#x} is not an 11-bit CAN identifier.")
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes do not fit into a CAN frame, which has 8.")
    return _FRAME_LAYOUT.pack(can_id, len(data), data)


def unpack_frame(raw: bytes) -> tuple[int, bytes]:
    """Return identifier (with flags) and data of a raw frame; a length above 8 counts as 8."""
    can_id, data_length, frame_data = _FRAME_LAYOUT.unpack(raw)
    return can_id, frame_data[: min(data_length, 8)]


# Ports

_RECEIVE_BUFFER_SIZE = 212_992
"""Size in bytes of a socket's receive buffer, for a late reader: some 200 ms of a full bus."""
_SIMULATOR_SEND_BUFFER_SIZE = 4_194_304
"""Size in bytes of the send buffer to a simulated rig, as large as the system allows.

A stopped simulated rig is then detected by its missing replies.

A simulated rig that has stopped is detected by its missing replies, not by a full buffer."""
_CAN_RAW_ERR_FILTER = 2
"""Number of the socket option that selects the error frames to receive (linux/can/raw.h)."""
_MOST_DAMAGED_FRAMES = 20
"""Number of consecutive unreadable frames of an adapter that end a session."""


class CanPort(Protocol):
    """Connection to a CAN bus, none of whose methods blocks except `wait`.

    Every error of an adapter's driver is raised as a `DeviceError`, except in `close`, which never
    raises.
    """

    name: str
    """Name of the bus, for messages."""

    def send(self, frame: bytes) -> None:
        """Send a raw frame of 16 bytes, made by :func:`rigd.devices.canbus.port.pack_frame`.

        Raises
        ------
        DeviceError
            If the bus does not accept the frame.
        """

    def receive(self) -> bytes | None:
        """Return the next received raw frame of 16 bytes, or None if no frame has arrived.

        An unreadable frame is returned as an error frame.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame may have arrived, at most for the timeout.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Accept only frames with these identifiers, and error frames of the controller.

        If `can_ids` is None, all frames are accepted again.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus on this port, for set-up; closing the bus keeps the port open."""

    def close(self) -> None:
        """Close the port to the CAN bus; harmless when repeated."""


class SocketPort:
    """Port on a socket that carries ``struct can_frame``: the kernel's CAN, or the simulated bus.

    Parameters
    ----------
    link
        Connected socket, which the port makes non-blocking.
    name
        Name of the bus, for messages.
    remedy
        Advice for the operator if the bus has failed.
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
        """Send a raw frame of 16 bytes."""
        try:
            self._send(frame)
        except OSError as error:
            raise DeviceError(self._error_message("takes no more frames", error)) from None

    def receive(self) -> bytes | None:
        """Return the next received raw frame of 16 bytes, or None if no frame has arrived."""
        try:
            raw = self._recv(FRAME_SIZE)
        except BlockingIOError:
            return None
        except OSError as error:
            raise DeviceError(self._error_message("cannot be read", error)) from None
        if len(raw) != FRAME_SIZE:
            raise DeviceError(f"CAN bus {self.name}: it was cut off; {self._remedy}.")
        return raw

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame may have arrived on the bus, at most for `timeout_s`."""
        try:
            select.select(self._fd, (), (), timeout_s)
        except (OSError, ValueError) as error:
            raise DeviceError(self._error_message("cannot be waited for", error)) from None

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Let the kernel drop frames with other identifiers; a simulated bus drops none."""
        if self._link.family == getattr(socket, "AF_CAN", None):
            filter_mask = STANDARD_ID_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
            id_filters = (
                [(0, 0)] if can_ids is None else [(i, filter_mask) for i in sorted(set(can_ids))]
            )
            packed_filters = b"".join(struct.pack("=II", *id_filter) for id_filter in id_filters)
            try:
                self._link.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed_filters)
            except OSError as error:
                raise DeviceError(self._error_message("takes no filter", error)) from None

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus that sends and receives through this port."""
        from rigd.devices.canbus._setup_bus import SetupBus

        return SetupBus(self)

    def close(self) -> None:
        """Close the port's socket."""
        with suppress(OSError):
            self._link.close()

    def _error_message(self, failed_action: str, error: OSError | ValueError) -> str:
        """Return the message of an error of the socket, with cause and remedy."""
        error_reason, error_number = str(error), None
        if isinstance(error, OSError):
            error_reason, error_number = error.strerror or error_reason, error.errno
        remedy = (
            "no other device acknowledges: check cable, termination, power and bit rate"
            if error_number in (errno.ENOBUFS, errno.EAGAIN)
            else self._remedy
        )
        return f"CAN bus {self.name}: it {failed_action} ({error_reason}); {remedy}."


class PythonCanPort:
    """Port on an adapter of python-can, with about three times the processor time of a socket.

    An adapter's driver raises `can.CanError` or OSError if the adapter has failed. Any other error
    while receiving means a frame that the driver could not read: the parser of slcan raises
    ValueError for a damaged line. A single such frame counts as an error on the line. Many in a row
    mean that the adapter has failed.

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
        self._next_frame: bytes | None = None
        self._damaged_in_a_row = 0
        self.name = name

    def send(self, frame: bytes) -> None:
        """Send a raw frame of 16 bytes."""
        try:
            self._bus.send(self._to_message(frame), timeout=0.0)
        except Exception as error:
            raise DeviceError(
                f"CAN bus {self.name}: it takes no more frames ({_error_text(error)}); check cable "
                "and adapter."
            ) from None

    def receive(self) -> bytes | None:
        """Return the next received raw frame of 16 bytes, or None if no frame has arrived."""
        if self._next_frame is not None:
            raw, self._next_frame = self._next_frame, None
            return raw
        return self._receive(0.0)

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame has arrived on the bus, at most for `timeout_s`."""
        if self._next_frame is None:
            self._next_frame = self._receive(timeout_s)

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Do nothing: python-can's filters end a poll at each dropped frame and drop errors."""

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus that sends and receives through this port."""
        from rigd.devices.canbus._setup_bus import SetupBus

        return SetupBus(self)

    def close(self) -> None:
        """Shut down the adapter of python-can; errors are ignored."""
        with suppress(Exception):
            self._bus.shutdown()

    def _receive(self, timeout_s: float) -> bytes | None:
        """Return the next frame from the adapter, or None if none arrives within `timeout_s`."""
        try:
            message = self._bus.recv(timeout_s)
            raw = None if message is None else self._from_message(message)
        except (self._error, OSError) as error:
            raise DeviceError(
                f"CAN bus {self.name}: it cannot be read ({_error_text(error)}); check cable and "
                "adapter."
            ) from None
        except Exception as error:
            self._damaged_in_a_row += 1
            if self._damaged_in_a_row < _MOST_DAMAGED_FRAMES:
                return DAMAGED_FRAME
            self._damaged_in_a_row = 0
            raise DeviceError(
                f"CAN bus {self.name}: the adapter sends what is no CAN frame, "
                f"{_MOST_DAMAGED_FRAMES} times in a row ({_error_text(error)}); check the adapter, "
                "its cable and its firmware."
            ) from None
        if raw is not None and not unpack_header(raw)[0] & ERROR_FLAG:
            self._damaged_in_a_row = 0
        return raw


def _error_text(error: Exception) -> str:
    """Return type and text of an adapter's error, since some errors have no text."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def open_port(settings: CanBus, simulator: SimulatorAddress | None) -> CanPort:
    """Open the CAN bus of a profile, or the bus of the simulated rig that replaces the hardware.

    Parameters
    ----------
    settings
        Section ``[can]`` of the profile.
    simulator
        Address of the simulated rig that replaces the hardware; None: open the real bus.

    Raises
    ------
    DeviceError
        If the bus does not exist or cannot be opened; the message states the remedy.
    """
    bus_name = f"{settings.channel} ({settings.interface})"
    if simulator is not None and simulator.can_socket:
        bus_socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        bus_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SIMULATOR_SEND_BUFFER_SIZE)
        try:
            bus_socket.connect(simulator.can_socket)
        except OSError as error:
            bus_socket.close()
            raise DeviceError(
                f"CAN bus {bus_name}: the simulated rig does not answer ({error.strerror}); start "
                "rigd simulate again."
            ) from None
        return SocketPort(
            bus_socket, f"{bus_name}, simulated", "check whether rigd simulate still runs"
        )
    if settings.interface == "socketcan":
        return SocketPort(_open_socketcan(settings), bus_name)
    import can

    try:
        bus = can.Bus(
            interface=settings.interface, channel=settings.channel, bitrate=settings.bitrate_bit_s
        )
    except Exception as error:
        raise DeviceError(
            f"CAN bus {bus_name}: it cannot be opened ({_error_text(error)}); check can.interface "
            "and can.channel."
        ) from None
    return PythonCanPort(bus, bus_name)


def _open_socketcan(settings: CanBus) -> socket.socket:
    """Open and bind a CAN socket of the kernel; raise with a remedy if that fails."""
    interface_name = settings.channel
    simulation = "start the simulated rig: rigd simulate --profile PROFILE"
    remedy = (
        f"bring it up with: ip link set {interface_name} up type can bitrate "
        f"{settings.bitrate_bit_s}; or {simulation}"
    )
    if not hasattr(socket, "AF_CAN"):
        raise DeviceError(
            f"CAN bus {interface_name}: this system has no CAN sockets; run the rig on Linux, or "
            f"{simulation}."
        )
    try:
        can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise DeviceError(
            f"CAN bus {interface_name}: this kernel has no CAN sockets ({error.strerror}); load "
            f"them with: modprobe can_raw; or, if it was built without them, {simulation}."
        ) from None
    try:
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_SIZE)
        can_socket.setsockopt(
            socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", ERROR_MASK)
        )
        can_socket.bind((interface_name,))
    except OSError as error:
        can_socket.close()
        raise DeviceError(
            f"CAN bus {interface_name}: it cannot be opened ({error.strerror}); {remedy}."
        ) from None
    return can_socket
