"""Both ends of a bus: a port under test, and a raw socket on the other side."""

import socket
import struct
from dataclasses import dataclass

import pytest

from rigd.devices.canbus.adapters import SocketPort


@dataclass
class FarEnd:
    """Packs and unpacks frames by hand, as linux/can.h defines them."""

    socket: socket.socket

    def send(self, can_id, data=b"", length=None):
        length = len(data) if length is None else length
        self.socket.sendall(struct.pack("=IB3s8s", can_id, length, bytes(3), data))

    def receive(self):
        can_id, length, data = struct.unpack("=IB3x8s", self.socket.recv(16))
        return can_id, data[:length]


@pytest.fixture
def ends():
    """A port, and the far end of its line."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    far.settimeout(2.0)
    port = SocketPort(near, "can0 (test)")
    yield port, FarEnd(far)
    port.close()
    far.close()
