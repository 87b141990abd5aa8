"""Ports on adapters: a socket of the kernel, the Unix socket of a simulated bus, or python-can."""

import errno
import select
import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING

from rigd.devices.canbus.port import (
    DAMAGED_FRAME,
    ERROR_CLASS_MASK,
    ERROR_FRAME_FLAG,
    FRAME_SIZE,
    STANDARD_ID_MASK,
    CanPort,
    unpack_header,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress

if TYPE_CHECKING:
    import can

_RECEIVE_BUFFER_SIZE = 212_992
"""Size in bytes of a socket's receive buffer, for a late reader: some 200 ms of a full bus."""
_SIMULATOR_SEND_BUFFER_SIZE = 4_194_304
"""Requested size in bytes of the send buffer to a simulated rig; the system may grant less.

A simulated rig that has stopped is then detected by its missing replies, not by a full buffer."""
_CAN_RAW_ERR_FILTER = 2
"""Number of the socket option that selects the error frames to receive (linux/can/raw.h)."""
_MAX_DAMAGED_FRAMES = 20
"""Number of consecutive unreadable frames of an adapter that end a session."""


class SocketPort:
    """Port on a socket that carries ``struct can_frame``: the kernel's CAN, or the simulated bus.

    Parameters
    ----------
    connected_socket
        Connected socket, which the port makes non-blocking.
    name
        Name of the bus, for messages.
    remedy
        Advice for the operator if the bus has failed.
    """

    def __init__(
        self, connected_socket: socket.socket, name: str, remedy: str = "check cable and adapter"
    ) -> None:
        connected_socket.setblocking(False)
        self._socket = connected_socket
        self._send = connected_socket.send
        self._recv = connected_socket.recv
        self._fd = [connected_socket.fileno()]
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
            raw_frame = self._recv(FRAME_SIZE)
        except BlockingIOError:
            return None
        except OSError as error:
            raise DeviceError(self._error_message("cannot be read", error)) from None
        if len(raw_frame) != FRAME_SIZE:
            raise DeviceError(f"CAN bus {self.name}: it was cut off; {self._remedy}.")
        return raw_frame

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame may have arrived on the bus, at most for `timeout_s`."""
        try:
            select.select(self._fd, (), (), timeout_s)
        except (OSError, ValueError) as error:
            raise DeviceError(self._error_message("cannot be waited for", error)) from None

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Let the kernel drop frames with other identifiers; a simulated bus drops none."""
        if self._socket.family == getattr(socket, "AF_CAN", None):
            filter_mask = STANDARD_ID_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
            id_filters = (
                [(0, 0)] if can_ids is None else [(i, filter_mask) for i in sorted(set(can_ids))]
            )
            packed_filters = b"".join(struct.pack("=II", *id_filter) for id_filter in id_filters)
            try:
                self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed_filters)
            except OSError as error:
                raise DeviceError(self._error_message("takes no filter", error)) from None

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus that sends and receives through this port."""
        from rigd.devices.canbus._setup_bus import SetupBus

        return SetupBus(self)

    def close(self) -> None:
        """Close the port's socket."""
        with suppress(OSError):
            self._socket.close()

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
        self._consecutive_damaged_frames = 0
        self.name = name

    def send(self, frame: bytes) -> None:
        """Send a raw frame of 16 bytes."""
        try:
            self._bus.send(self._to_message(frame), timeout=0.0)
        except Exception as error:
            raise DeviceError(
                f"CAN bus {self.name}: it takes no more frames ({_error_reason(error)}); check "
                "cable and adapter."
            ) from None

    def receive(self) -> bytes | None:
        """Return the next received raw frame of 16 bytes, or None if no frame has arrived."""
        if self._next_frame is not None:
            raw_frame, self._next_frame = self._next_frame, None
            return raw_frame
        return self._receive(0.0)

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame has arrived on the bus, at most for `timeout_s`."""
        if self._next_frame is None:
            self._next_frame = self._receive(timeout_s)

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Do nothing: a filter of python-can would end a wait at each dropped frame.

        It would also drop error frames.
        """

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
            raw_frame = None if message is None else self._from_message(message)
        except (self._error, OSError) as error:
            raise DeviceError(
                f"CAN bus {self.name}: it cannot be read ({_error_reason(error)}); check cable and "
                "adapter."
            ) from None
        except Exception as error:
            self._consecutive_damaged_frames += 1
            if self._consecutive_damaged_frames < _MAX_DAMAGED_FRAMES:
                return DAMAGED_FRAME
            self._consecutive_damaged_frames = 0
            raise DeviceError(
                f"CAN bus {self.name}: the adapter sent {_MAX_DAMAGED_FRAMES} invalid CAN frames "
                f"in a row ({_error_reason(error)}); check the adapter, its cable and its "
                "firmware."
            ) from None
        if raw_frame is not None and not unpack_header(raw_frame)[0] & ERROR_FRAME_FLAG:
            self._consecutive_damaged_frames = 0
        return raw_frame


def _error_reason(error: Exception) -> str:
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
        simulator_socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        simulator_socket.setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, _SIMULATOR_SEND_BUFFER_SIZE
        )
        try:
            simulator_socket.connect(simulator.can_socket)
        except OSError as error:
            simulator_socket.close()
            raise DeviceError(
                f"CAN bus {bus_name}: the simulated rig does not answer ({error.strerror}); start "
                "rigd simulate again."
            ) from None
        return SocketPort(
            simulator_socket, f"{bus_name}, simulated", "check whether rigd simulate still runs"
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
            f"CAN bus {bus_name}: it cannot be opened ({_error_reason(error)}); check "
            "can.interface and can.channel."
        ) from None
    return PythonCanPort(bus, bus_name)


def _open_socketcan(settings: CanBus) -> socket.socket:
    """Open and bind a CAN socket of the kernel; raise with a remedy if that fails."""
    interface_name = settings.channel
    simulation_advice = "start the simulated rig: rigd simulate --profile PROFILE"
    remedy = (
        f"bring it up with: ip link set {interface_name} up type can bitrate "
        f"{settings.bitrate_bit_s}; or {simulation_advice}"
    )
    if not hasattr(socket, "AF_CAN"):
        raise DeviceError(
            f"CAN bus {interface_name}: this system has no CAN sockets; run the rig on Linux, or "
            f"{simulation_advice}."
        )
    try:
        can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise DeviceError(
            f"CAN bus {interface_name}: this kernel has no CAN sockets ({error.strerror}); load "
            f"them with: modprobe can_raw; or, if it was built without them, {simulation_advice}."
        ) from None
    try:
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_SIZE)
        can_socket.setsockopt(
            socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", ERROR_CLASS_MASK)
        )
        can_socket.bind((interface_name,))
    except OSError as error:
        can_socket.close()
        raise DeviceError(
            f"CAN bus {interface_name}: it cannot be opened ({error.strerror}); {remedy}."
        ) from None
    return can_socket
