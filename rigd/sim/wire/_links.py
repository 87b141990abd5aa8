"""Links of the simulated rig: its end of the CAN bus, and a pseudo-terminal for the serial line.

The bus is a Unix socket (`VirtualBus`) or a virtual interface of the kernel (`VirtualCan`). Both
carry the 16 bytes of ``struct can_frame``. On the Unix socket every client hears every other one,
as on a bus. Nothing here blocks: who does not read loses frames, as a slow CAN controller does.
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


def without_transport(rig: RigParameters) -> RigParameters:
    """Return the rig with the delays that are left to simulate behind the wire.

    With replies taken a tick later the exchange itself brings one period of what the profile
    states; the decimating filter's delay is seen to by :class:`rigd.sim._devices.SimulatedRig`.

    Raises
    ------
    DeviceError
        If the profile states less than the exchange takes.
    """
    if rig.acquisition is None or rig.acquisition.mode == "same_tick":
        return rig
    period_s = 1 / rig.rate_hz
    for name, delay_s in (("encoder", rig.encoder.delay_s), ("sensor", rig.sensor.delay_s)):
        if delay_s < period_s * (1 - 1e-9):
            raise DeviceError(
                f"The profile {rig.name} has {name}.delay_s = {delay_s:g} s, but with "
                f"acquisition.mode previous_tick values are at least one period old "
                f"({period_s:g} s); correct one of the two."
            )
    return replace(
        rig,
        encoder=replace(rig.encoder, delay_s=max(0.0, rig.encoder.delay_s - period_s)),
        sensor=replace(rig.sensor, delay_s=max(0.0, rig.sensor.delay_s - period_s)),
    )


# CAN bus

Handlers = dict[int, Callable[[], None]]
"""Functions to call when a file descriptor has something to read."""
OnFrames = Callable[[list[bytes], object], None]
"""Takes the frames of a sender, in order, and who it is."""

_READ_BYTES = 65_536
_SEND_BUFFER = 425_984  # what the kernel makes of it holds some 0.2 s of a full bus
_READ_FRAMES = 256

# linux/rtnetlink.h and linux/if_link.h
_RTM_GETLINK = 18
_RTM_NEWLINK = 16
_NLM_F_REQUEST = 1
_IFLA_LINKINFO = 18
_IFLA_INFO_KIND = 1
_ATTRIBUTE_MASK = 0x3FFF
_LINK_HEADER = struct.Struct("=BxHiII")
_VIRTUAL_KINDS = ("vcan", "vxcan")


class _LinkConnection:
    """One connection, with its incomplete received frame and its unsent bytes."""

    def __init__(self, link: socket.socket, number: int) -> None:
        self.link = link
        self.number = number
        self.received = b""
        self.unsent = b""


class VirtualBus:
    """A CAN bus on a Unix socket.

    Parameters
    ----------
    path
        Path of the socket.
    handlers
        Handlers of the event loop, by file descriptor; updated here.
    on_frames
        Gets what a client sends.
    on_clients
        Called when a client connects or disconnects, with their number.

    Attributes
    ----------
    lost : int
        Frames that a client did not get because it does not read.
    """

    def __init__(
        self,
        path: Path,
        handlers: Handlers,
        on_frames: OnFrames,
        on_clients: Callable[[str, int], None],
    ) -> None:
        self._handlers = handlers
        self._on_frames = on_frames
        self._on_clients = on_clients
        self._clients: list[_LinkConnection] = []
        self._count = 0
        self.lost = 0
        self._path = path
        self.open()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def open(self) -> None:
        """Let clients connect, at first and after `close`."""
        self._listener = listen(self._path)
        self._handlers[self._listener.fileno()] = self._accept

    def send(self, frame: bytes, origin: object = None) -> None:
        """Send a frame to all clients but the one that it comes from."""
        for client in self._clients:
            if client is not origin:
                self._send(client, frame)

    def close(self) -> None:
        """Close every connection; no client can connect any more."""
        if self._listener.fileno() >= 0:
            del self._handlers[self._listener.fileno()]
            self._listener.close()
            self._path.unlink(missing_ok=True)
        for client in list(self._clients):
            self._drop(client)

    def _accept(self) -> None:
        with suppress(OSError):
            link, _ = self._listener.accept()
            link.setblocking(False)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self._count += 1
            client = _LinkConnection(link, self._count)
            self._clients.append(client)
            self._handlers[link.fileno()] = lambda: self._receive(client)
            self._on_clients(f"client {client.number} connected", len(self._clients))

    def _receive(self, client: _LinkConnection) -> None:
        try:
            fresh = client.link.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            fresh = b""
        if not fresh:
            self._drop(client)
            return
        data = client.received + fresh if client.received else fresh
        whole = len(data) - len(data) % FRAME_SIZE
        client.received = data[whole:]
        self._on_frames([data[i : i + FRAME_SIZE] for i in range(0, whole, FRAME_SIZE)], client)

    def _send(self, client: _LinkConnection, frame: bytes) -> None:
        # The rest of a frame has to go before the next one, or all later ones are torn.
        if client.unsent:
            client.unsent = client.unsent[_offer(client.link, client.unsent) :]
            if client.unsent:
                self.lost += 1
                return
        sent = _offer(client.link, frame)
        if sent == 0:
            self.lost += 1
        elif sent < len(frame):
            client.unsent = frame[sent:]

    def _drop(self, client: _LinkConnection) -> None:
        if client in self._clients:
            self._clients.remove(client)
            del self._handlers[client.link.fileno()]
            client.link.close()
            self._on_clients(f"client {client.number} gone", len(self._clients))


class VirtualCan:
    """A CAN bus that the kernel simulates (vcan).

    Parameters
    ----------
    channel
        Name of the interface.
    handlers, on_frames
        As for :class:`VirtualBus`.

    Raises
    ------
    DeviceError
        If the interface cannot be used.
    """

    clients = 1
    """Who listens on such a bus is not known."""
    lost = 0

    def __init__(self, channel: str, handlers: Handlers, on_frames: OnFrames) -> None:
        self._channel = channel
        self._serve(self._bound(), handlers, on_frames)

    def open(self) -> None:
        """Take part in the bus again, after `close`."""
        self._serve(self._bound(), self._handlers, self._on_frames)

    def _bound(self) -> socket.socket:
        channel = self._channel
        try:
            link = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except (AttributeError, OSError):
            raise DeviceError(f"CAN bus {channel}: this system has no CAN sockets.") from None
        try:
            link.bind((channel,))
        except OSError as error:
            link.close()
            raise DeviceError(
                f"CAN bus {channel}: it cannot be opened ({error.strerror}); bring it up with: "
                f"ip link set {channel} up"
            ) from None
        return link

    def _serve(self, link: socket.socket, handlers: Handlers, on_frames: OnFrames) -> None:
        link.setblocking(False)
        self._link = link
        self._handlers = handlers
        self._on_frames = on_frames
        handlers[link.fileno()] = self._receive

    def send(self, frame: bytes, origin: object = None) -> None:
        """Send a frame that a node sends; those of others are on the bus already."""
        if origin is None and self._link.fileno() >= 0:
            try:
                self._link.send(frame)
            except OSError:
                self.lost += 1

    def close(self) -> None:
        """Leave the bus."""
        if self._link.fileno() >= 0:
            del self._handlers[self._link.fileno()]
            self._link.close()

    def _receive(self) -> None:
        frames: list[bytes] = []
        with suppress(OSError):
            while len(frames) < _READ_FRAMES:
                frames.append(self._link.recv(FRAME_SIZE))
        if frames:
            self._on_frames(frames, self)


def listen(path: Path) -> socket.socket:
    """Return a listening Unix socket; remove one that a dead process has left.

    Raises
    ------
    DeviceError
        If there can be none.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)
        listener.bind(os.fspath(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise DeviceError(
            f"The simulated rig cannot make its socket {path} ({error.strerror or error}); set "
            "XDG_RUNTIME_DIR to a folder with a short name that is yours."
        ) from None
    listener.setblocking(False)
    return listener


def is_virtual(channel: str) -> bool:
    """Whether a network interface is a CAN bus without hardware.

    Raises
    ------
    DeviceError
        If there is such an interface, and it is anything else.
    """
    if not Path(f"/sys/class/net/{channel}").exists():
        return False
    kind = interface_kind(channel)
    if kind in _VIRTUAL_KINDS:
        return True
    raise DeviceError(
        f"CAN bus {channel}: this is not a virtual bus here, and a simulated drive must not answer "
        "together with real ones; simulate with a copy of the profile that has another name and "
        "another can.channel."
    )


def interface_kind(name: str) -> str:
    """Return what the kernel calls the kind of a network interface; empty for hardware.

    A serial CAN adapter is also among the virtual devices of ``/sys``, so only the kernel's own
    attribute counts (``IFLA_INFO_KIND``).
    """
    try:
        index = socket.if_nametoindex(name)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as kernel:
            body = _LINK_HEADER.pack(socket.AF_UNSPEC, 0, index, 0, 0)
            head = struct.pack("=IHHII", 16 + len(body), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0)
            kernel.send(head + body)
            reply = kernel.recv(_READ_BYTES)
    except OSError:
        return ""
    return kind_in_reply(reply)


def kind_in_reply(reply: bytes) -> str:
    """Return the kind of interface in a message RTM_NEWLINK."""
    if len(reply) < 32 or struct.unpack_from("=H", reply, 4)[0] != _RTM_NEWLINK:
        return ""
    length = struct.unpack_from("=I", reply)[0]
    for link_type, link_value in _attributes(reply[16 + _LINK_HEADER.size : length]):
        if link_type == _IFLA_LINKINFO:
            for info_type, value in _attributes(link_value):
                if info_type == _IFLA_INFO_KIND:
                    return value.rstrip(b"\0").decode()
    return ""


def _attributes(data: bytes) -> Iterable[tuple[int, bytes]]:
    """Yield type and value of netlink attributes."""
    at = 0
    while at + 4 <= len(data):
        length, kind = struct.unpack_from("=HH", data, at)
        if length < 4:
            return
        yield kind & _ATTRIBUTE_MASK, data[at + 4 : at + length]
        at += (length + 3) & ~3


def _offer(link: socket.socket, data: bytes) -> int:
    """Return how many bytes a socket took; a dead one takes none."""
    try:
        return link.send(data)
    except OSError:
        return 0


# Serial line

_LINE_BYTES = 4096


class PtyLine:
    """The sensor's end of a serial line.

    While the other end is not open, what is sent is lost, as on a real line. A terminal with a
    closed end is always "readable", so it is polled from time to time instead.

    Parameters
    ----------
    handlers
        Handlers of the event loop, by file descriptor; updated here.
    on_bytes
        Gets what the host sends.
    on_open
        Called when the host opens the port, and when it closes it.

    Attributes
    ----------
    port : str
        What the host opens.
    lost : int
        Bytes that the host did not take.
    """

    def __init__(
        self,
        handlers: Handlers,
        on_bytes: Callable[[bytes], None],
        on_open: Callable[[bool], None],
    ) -> None:
        self._handlers = handlers
        self._on_bytes = on_bytes
        self._on_open = on_open
        self.lost = 0
        self.open()

    def open(self) -> None:
        """Make the line, at first and after `close`; its port may get another name."""
        self._ours, theirs = os.openpty()
        tty.setraw(theirs)
        self.port = os.ttyname(theirs)
        os.close(theirs)
        os.set_blocking(self._ours, False)
        self._open = False

    def write(self, data: bytes) -> None:
        """Send bytes; those that the host does not take are gone."""
        sent = 0
        if self._open:
            with suppress(OSError):
                sent = os.write(self._ours, data)
            self.lost += len(data) - sent

    def poll(self) -> None:
        """Check whether the host has opened or closed the port."""
        if not self._open and self._ours >= 0:
            self._receive()

    def close(self) -> None:
        """Cut the line."""
        if self._ours >= 0:
            self._handlers.pop(self._ours, None)
            os.close(self._ours)
            self._ours = -1
            self._open = False

    def _receive(self) -> None:
        data = b""
        try:
            data = os.read(self._ours, _LINE_BYTES)
            is_open = True
        except BlockingIOError:
            is_open = True
        except OSError:
            is_open = False
        if is_open and not self._open:
            self._handlers[self._ours] = self._receive
        elif self._open and not is_open:
            del self._handlers[self._ours]
        if is_open != self._open:
            self._open = is_open
            self._on_open(is_open)
        if data:
            self._on_bytes(data)
