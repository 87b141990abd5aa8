"""A CAN bus over a Unix socket, as an interface of python-can that any process can open.

`SeqpacketHub` is the bus itself, in the process of the devices; `can.Bus(interface="seqpacket",
channel=PATH)` is a participant. python-can finds the interface by the entry point that
`announce` writes into a folder of PYTHONPATH, as it finds one that is installed. Frames arrive
whole and in order; a participant that does not read loses them.
"""

import contextlib
import select
import socket
import struct
from pathlib import Path

import can

_FRAME = struct.Struct("=IB3x8s")  # linux/can.h, struct can_frame
_BACKLOG = 16


def announce(folder: Path) -> str:
    """Return a folder for PYTHONPATH with which python-can knows the interface."""
    info = folder / "seqpacket_bus-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: seqpacket-bus\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[can.interface]\nseqpacket = seqpacket_bus:SeqpacketBus\n"
    )
    (folder / "seqpacket_bus.py").write_text(Path(__file__).read_text("utf-8"), encoding="utf-8")
    return str(folder)


def _pack(message: can.Message) -> bytes:
    return _FRAME.pack(message.arbitration_id, message.dlc, bytes(message.data))


def _unpack(raw: bytes) -> can.Message:
    can_id, length, data = _FRAME.unpack(raw)
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data[:length])


class SeqpacketBus(can.BusABC):
    """A participant."""

    def __init__(self, channel: str, **others: object) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(channel)
        except OSError:
            self._socket.close()
            self._is_shutdown = True
            raise
        self.channel_info = f"seqpacket {channel}"
        super().__init__(channel=channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        try:
            self._socket.send(_pack(msg), socket.MSG_DONTWAIT)
        except OSError as error:
            raise can.CanOperationError(f"not sent: {error.strerror}") from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not select.select([self._socket], (), (), timeout)[0]:
            return None, False
        raw = self._socket.recv(_FRAME.size)
        if len(raw) != _FRAME.size:
            raise can.CanOperationError("the bus was cut off")
        return _unpack(raw), False

    def fileno(self) -> int:
        return self._socket.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


class SeqpacketHub(can.BusABC):
    """The bus: all others and the owner of the hub get the frames of a participant."""

    def __init__(self, path: str) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(path)
        self._listener.listen(_BACKLOG)
        self._participants: list[socket.socket] = []
        self.dropped = 0
        self.channel_info = f"hub {path}"
        super().__init__(channel=path)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._distribute(_pack(msg), but=None)

    def poll(self, timeout_s: float, *others: int) -> tuple[list[can.Message], list[int]]:
        """Wait for frames; return them, and those of the other descriptors that are ready."""
        sources = [self._listener, *self._participants, *others]
        ready = select.select(sources, (), (), timeout_s)[0]
        messages = []
        for source in ready:
            if source is self._listener:
                self._participants.append(self._listener.accept()[0])
            elif isinstance(source, socket.socket):
                messages += self._take(source)
        return messages, [source for source in ready if isinstance(source, int)]

    def _take(self, source: socket.socket) -> list[can.Message]:
        """Take and distribute the next frame of a participant: one at a time, to preserve order."""
        with contextlib.suppress(ConnectionError):
            raw = source.recv(_FRAME.size)
            if len(raw) == _FRAME.size:
                self._distribute(raw, but=source)
                return [_unpack(raw)]
        self._participants.remove(source)
        source.close()
        return []

    def _distribute(self, raw: bytes, but: socket.socket | None) -> None:
        for each in list(self._participants):
            if each is not but:
                try:
                    each.send(raw, socket.MSG_DONTWAIT)
                except OSError:
                    self.dropped += 1

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        raise NotImplementedError("the hub is polled")

    def shutdown(self) -> None:
        super().shutdown()
        for each in (self._listener, *self._participants):
            each.close()
