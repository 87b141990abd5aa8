"""Connections of the simulated rig: its CAN bus, and a pseudo-terminal for the serial line.

The bus is a Unix socket (`VirtualBus`) or a virtual interface of the kernel (`VirtualCan`). Both
carry the 16 bytes of ``struct can_frame``. On the Unix socket every client receives the frames of
all others, as on a bus. Nothing blocks: a client that does not read loses frames, like a slow CAN
controller.
"""

import os
import socket
import struct
import tty
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rigd.devices.canbus.port import FRAME_SIZE
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters

# Delays of the links


def without_transport_delay(rig: RigParameters) -> RigParameters:
    """Return a rig's parameters without the part of its delays that the exchange itself causes.

    If replies are used one tick later, this part is one period; otherwise it is zero.
    :class:`rigd.sim._devices.SimulatedRig` subtracts the decimating filter's delay. Raise
    `DeviceError` if a delay in the profile is shorter than the part that the exchange causes.
    """
    if rig.acquisition is None or rig.acquisition.mode == "same_tick":
        return rig
    period_s = 1 / rig.rate_hz
    for section_name, delay_s in (("encoder", rig.encoder.delay_s), ("sensor", rig.sensor.delay_s)):
        if delay_s < period_s * (1 - 1e-9):
            raise DeviceError(
                f"The profile {rig.name} has {section_name}.delay_s = {delay_s:g} s, but with "
                f"acquisition.mode previous_tick values are at least one period old "
                f"({period_s:g} s); correct one of the two."
            )
    return replace(
        rig,
        encoder=replace(rig.encoder, delay_s=max(0.0, rig.encoder.delay_s - period_s)),
        sensor=replace(rig.sensor, delay_s=max(0.0, rig.sensor.delay_s - period_s)),
    )


# CAN bus

HandlersByDescriptor = dict[int, Callable[[], None]]
"""Functions to call when a file descriptor is readable, by file descriptor."""
FrameCallback = Callable[[list[bytes], object], None]
"""Function that processes the frames of a sender, in order, and the sender."""

_MAX_READ_BYTES = 65_536
"""Largest number of bytes in one read from a socket."""
_SEND_BUFFER_BYTES = 425_984  # the kernel derives from it a buffer for some 0.2 s of a full bus
_MAX_FRAMES_PER_READ = 256
"""Largest number of frames in one read from a virtual interface."""

# linux/rtnetlink.h and linux/if_link.h
_RTM_GETLINK = 18
_RTM_NEWLINK = 16
_NLM_F_REQUEST = 1
_IFLA_LINKINFO = 18
_IFLA_INFO_KIND = 1
_ATTRIBUTE_MASK = 0x3FFF
_LINK_HEADER = struct.Struct("=BxHiII")
_VIRTUAL_KINDS = ("vcan", "vxcan")
"""Kinds of CAN interfaces without hardware, by the kernel's names."""


class _LinkConnection:
    """Connection of a client to the bus, with incomplete received and unsent bytes."""

    def __init__(self, client_socket: socket.socket, client_number: int) -> None:
        self.link = client_socket
        self.number = client_number
        self.received_bytes = b""
        self.unsent_bytes = b""


class VirtualBus:
    """Simulated CAN bus on a Unix socket.

    This class updates `handlers`, the handlers of the event loop by file descriptor. `on_frames`
    processes the frames that a client sends. `on_client_change` is called with a text and the
    number of clients when one connects or disconnects.

    Attributes
    ----------
    lost_frame_count : int
        Number of frames that clients have not received because they do not read.
    """

    def __init__(
        self,
        path: Path,
        handlers: HandlersByDescriptor,
        on_frames: FrameCallback,
        on_client_change: Callable[[str, int], None],
    ) -> None:
        self._handlers = handlers
        self._on_frames = on_frames
        self._on_client_change = on_client_change
        self._clients: list[_LinkConnection] = []
        self._count = 0
        self.lost_frame_count = 0
        self._path = path
        self.open()

    @property
    def client_count(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def open(self) -> None:
        """Create the socket and accept clients, at first and after `close`."""
        self._listener = listen(self._path)
        self._handlers[self._listener.fileno()] = self._accept

    def send(self, frame: bytes, sending_host: object = None) -> None:
        """Send a frame to all clients except the one that sent it."""
        for other_client in self._clients:
            if other_client is not sending_host:
                self._send(other_client, frame)

    def close(self) -> None:
        """Close the socket and every connection; no client can connect any more."""
        if self._listener.fileno() >= 0:
            del self._handlers[self._listener.fileno()]
            self._listener.close()
            self._path.unlink(missing_ok=True)
        for open_client in list(self._clients):
            self._drop(open_client)

    def _accept(self) -> None:
        """Accept the connection of a client, and register it in the event loop."""
        with suppress(OSError):
            client_socket, _ = self._listener.accept()
            client_socket.setblocking(False)
            client_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            self._count += 1
            new_client = _LinkConnection(client_socket, self._count)
            self._clients.append(new_client)
            self._handlers[client_socket.fileno()] = lambda: self._receive(new_client)
            self._on_client_change(f"client {new_client.number} connected", len(self._clients))

    def _receive(self, client: _LinkConnection) -> None:
        """Receive frames of a client, and pass them on; drop a client that has closed."""
        try:
            received_bytes = client.link.recv(_MAX_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            received_bytes = b""
        if not received_bytes:
            self._drop(client)
            return
        pending_bytes = (
            client.received_bytes + received_bytes if client.received_bytes else received_bytes
        )
        complete_byte_count = len(pending_bytes) - len(pending_bytes) % FRAME_SIZE
        client.received_bytes = pending_bytes[complete_byte_count:]
        self._on_frames(
            [pending_bytes[i : i + FRAME_SIZE] for i in range(0, complete_byte_count, FRAME_SIZE)],
            client,
        )

    def _send(self, client: _LinkConnection, frame: bytes) -> None:
        """Send a frame to a client, after unsent bytes of the previous frame; count lost frames."""
        # The rest of a frame has to be sent before the next one, or all later frames are
        # misaligned.
        if client.unsent_bytes:
            client.unsent_bytes = client.unsent_bytes[
                _send_without_blocking(client.link, client.unsent_bytes) :
            ]
            if client.unsent_bytes:
                self.lost_frame_count += 1
                return
        sent_bytes = _send_without_blocking(client.link, frame)
        if sent_bytes == 0:
            self.lost_frame_count += 1
        elif sent_bytes < len(frame):
            client.unsent_bytes = frame[sent_bytes:]

    def _drop(self, client: _LinkConnection) -> None:
        """Close the connection of a client."""
        if client in self._clients:
            self._clients.remove(client)
            del self._handlers[client.link.fileno()]
            client.link.close()
            self._on_client_change(f"client {client.number} gone", len(self._clients))


class VirtualCan:
    """CAN bus that the kernel simulates (vcan).

    `channel` is the name of the interface. `handlers` and `on_frames` are as for
    :class:`VirtualBus`. The constructor raises `DeviceError` if the interface cannot be used.
    """

    client_count = 1
    """Number of clients, which is unknown on such a bus and assumed to be 1."""
    lost_frame_count = 0
    """Number of frames that could not be sent."""

    def __init__(
        self, channel: str, handlers: HandlersByDescriptor, on_frames: FrameCallback
    ) -> None:
        self._channel = channel
        self._use_socket(self._bound_socket(), handlers, on_frames)

    def open(self) -> None:
        """Open the kernel's CAN interface again, after `close`."""
        self._use_socket(self._bound_socket(), self._handlers, self._on_frames)

    def _bound_socket(self) -> socket.socket:
        """Return a new CAN socket bound to the interface, or raise."""
        interface_name = self._channel
        try:
            can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except (AttributeError, OSError):
            raise DeviceError(
                f"CAN bus {interface_name}: this system has no CAN sockets."
            ) from None
        try:
            can_socket.bind((interface_name,))
        except OSError as error:
            can_socket.close()
            raise DeviceError(
                f"CAN bus {interface_name}: it cannot be opened ({error.strerror}); bring it up "
                f"with: ip link set {interface_name} up"
            ) from None
        return can_socket

    def _use_socket(
        self, can_socket: socket.socket, handlers: HandlersByDescriptor, on_frames: FrameCallback
    ) -> None:
        """Use a socket, and register its handler in the event loop."""
        can_socket.setblocking(False)
        self._link = can_socket
        self._handlers = handlers
        self._on_frames = on_frames
        handlers[can_socket.fileno()] = self._receive

    def send(self, frame: bytes, sending_host: object = None) -> None:
        """Send a frame of a node; frames of another `sending_host` are on the bus already."""
        if sending_host is None and self._link.fileno() >= 0:
            try:
                self._link.send(frame)
            except OSError:
                self.lost_frame_count += 1

    def close(self) -> None:
        """Close the socket on the kernel's CAN interface."""
        if self._link.fileno() >= 0:
            del self._handlers[self._link.fileno()]
            self._link.close()

    def _receive(self) -> None:
        """Receive frames from the kernel's CAN interface, and pass them to the simulation."""
        received_frames: list[bytes] = []
        with suppress(OSError):
            while len(received_frames) < _MAX_FRAMES_PER_READ:
                received_frames.append(self._link.recv(FRAME_SIZE))
        if received_frames:
            self._on_frames(received_frames, self)


def listen(path: Path) -> socket.socket:
    """Return a listening Unix socket; replace a socket that a dead process has left.

    Raise `DeviceError` if the socket cannot be created.
    """
    listening_socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)
        listening_socket.bind(os.fspath(path))
        listening_socket.listen()
    except OSError as error:
        listening_socket.close()
        raise DeviceError(
            f"The simulated rig cannot make its socket {path} ({error.strerror or error}); set "
            "XDG_RUNTIME_DIR to a folder with a short name that is yours."
        ) from None
    listening_socket.setblocking(False)
    return listening_socket


def is_virtual_can(interface_name: str) -> bool:
    """Return whether a network interface is a virtual CAN bus; False if it does not exist.

    Raise `DeviceError` if the interface exists, but is not a virtual CAN bus.
    """
    if not Path(f"/sys/class/net/{interface_name}").exists():
        return False
    kernel_kind = interface_kind(interface_name)
    if kernel_kind in _VIRTUAL_KINDS:
        return True
    raise DeviceError(
        f"CAN bus {interface_name}: this is not a virtual bus here, and a simulated drive must not "
        "answer together with real ones; simulate with a copy of the profile that has another "
        "name and another can.channel."
    )


def interface_kind(interface_name: str) -> str:
    """Return the kernel's name for the kind of a network interface; empty for hardware.

    A serial CAN adapter is also among the virtual devices of ``/sys``, so the kernel's attribute
    ``IFLA_INFO_KIND`` is used.
    """
    try:
        interface_index = socket.if_nametoindex(interface_name)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as netlink_socket:
            request_body = _LINK_HEADER.pack(socket.AF_UNSPEC, 0, interface_index, 0, 0)
            request_header = struct.pack(
                "=IHHII", 16 + len(request_body), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0
            )
            netlink_socket.send(request_header + request_body)
            kernel_reply = netlink_socket.recv(_MAX_READ_BYTES)
    except OSError:
        return ""
    return kind_in_reply(kernel_reply)


def kind_in_reply(netlink_reply: bytes) -> str:
    """Return the kind of interface in a netlink message RTM_NEWLINK, or an empty text."""
    if len(netlink_reply) < 32 or struct.unpack_from("=H", netlink_reply, 4)[0] != _RTM_NEWLINK:
        return ""
    message_length = struct.unpack_from("=I", netlink_reply)[0]
    for link_type, link_value in _netlink_attributes(
        netlink_reply[16 + _LINK_HEADER.size : message_length]
    ):
        if link_type == _IFLA_LINKINFO:
            for info_type, info_value in _netlink_attributes(link_value):
                if info_type == _IFLA_INFO_KIND:
                    return info_value.rstrip(b"\0").decode()
    return ""


def _netlink_attributes(data: bytes) -> Iterable[tuple[int, bytes]]:
    """Yield type and value of the netlink attributes in a message."""
    byte_offset = 0
    while byte_offset + 4 <= len(data):
        attribute_length, attribute_type = struct.unpack_from("=HH", data, byte_offset)
        if attribute_length < 4:
            return
        yield (
            attribute_type & _ATTRIBUTE_MASK,
            data[byte_offset + 4 : byte_offset + attribute_length],
        )
        byte_offset += (attribute_length + 3) & ~3


def _send_without_blocking(target_socket: socket.socket, data: bytes) -> int:
    """Send bytes on a socket without blocking; return the number sent, 0 if the socket is dead."""
    try:
        return target_socket.send(data)
    except OSError:
        return 0


# Serial line

_MAX_LINE_READ_BYTES = 4096
"""Largest number of bytes in one read from the serial line."""


class PtyLine:
    """Sensor's end of a serial line, on a pseudo-terminal.

    While the other end is not open, sent bytes are lost, as on a real line. A terminal with a
    closed end is always "readable", so it is polled from time to time instead.

    This class updates `handlers`, the handlers of the event loop by file descriptor. `on_bytes`
    processes the bytes that the host sends. `on_open` is called with True or False when the host
    opens or closes the port.

    Attributes
    ----------
    port : str
        Path of the terminal that the host opens.
    lost_byte_count : int
        Number of bytes that the host did not accept.
    """

    def __init__(
        self,
        handlers: HandlersByDescriptor,
        on_bytes: Callable[[bytes], None],
        on_open: Callable[[bool], None],
    ) -> None:
        self._handlers = handlers
        self._on_bytes = on_bytes
        self._on_open = on_open
        self.lost_byte_count = 0
        self.open()

    def open(self) -> None:
        """Create the pseudo-terminal, at first and after `close`; its port may get another name."""
        self._simulator_end, host_end = os.openpty()
        tty.setraw(host_end)
        self.port = os.ttyname(host_end)
        os.close(host_end)
        os.set_blocking(self._simulator_end, False)
        self._is_open = False

    def write(self, data: bytes) -> None:
        """Send bytes; bytes that the host does not accept are lost."""
        sent_bytes = 0
        if self._is_open:
            with suppress(OSError):
                sent_bytes = os.write(self._simulator_end, data)
            self.lost_byte_count += len(data) - sent_bytes

    def poll(self) -> None:
        """Check whether the host has opened or closed the port."""
        if not self._is_open and self._simulator_end >= 0:
            self._receive()

    def close(self) -> None:
        """Close the pseudo-terminal, as if the line was interrupted."""
        if self._simulator_end >= 0:
            self._handlers.pop(self._simulator_end, None)
            os.close(self._simulator_end)
            self._simulator_end = -1
            self._is_open = False

    def _receive(self) -> None:
        """Read bytes of the host, and register whether the host has the port open."""
        received_bytes = b""
        try:
            received_bytes = os.read(self._simulator_end, _MAX_LINE_READ_BYTES)
            is_open = True
        except BlockingIOError:
            is_open = True
        except OSError:
            is_open = False
        if is_open and not self._is_open:
            self._handlers[self._simulator_end] = self._receive
        elif self._is_open and not is_open:
            del self._handlers[self._simulator_end]
        if is_open != self._is_open:
            self._is_open = is_open
            self._on_open(is_open)
        if received_bytes:
            self._on_bytes(received_bytes)
