"""The bus on a Unix socket: who hears whom, torn frames, clients that do not read."""

import os
import select
import socket
import struct

import pytest

from rigd.devices.contracts import DeviceError
from rigd.sim.wire._links import (
    VirtualBus,
    VirtualCan,
    interface_kind,
    is_virtual,
    kind_in_reply,
    listen,
)


def frame(n):
    return struct.pack("=IB3x8s", 0x200 + n % 0x100, 4, struct.pack("<I", n))


class Bench:
    """A hub with its own small event loop."""

    def __init__(self, path):
        self.path = path
        self.handlers = {}
        self.heard = []
        self.told = []
        self.hub = VirtualBus(path, self.handlers, self._hear, lambda *told: self.told.append(told))
        self.links = []

    def _hear(self, frames, origin):
        self.heard += frames
        for raw in frames:
            self.hub.send(raw, origin)

    def turn(self):
        while ready := select.select(self.handlers, (), (), 0)[0]:
            for descriptor in ready:
                self.handlers[descriptor]()

    def connect(self):
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.links.append(link)
        link.connect(os.fspath(self.path))
        link.setblocking(False)
        self.turn()
        return link

    def close(self):
        self.hub.close()
        for link in self.links:
            link.close()


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path / "bus")
    yield bench
    bench.close()


def read(link):
    try:
        return link.recv(1_000_000)
    except BlockingIOError:
        return None


def test_a_client_is_heard_by_the_nodes_and_by_all_other_clients(bench):
    one, two, three = (bench.connect() for _ in range(3))
    one.send(frame(1) + frame(2))
    bench.turn()
    assert bench.heard == [frame(1), frame(2)]
    assert read(one) is None
    assert read(two) == read(three) == frame(1) + frame(2)


def test_a_node_is_heard_by_every_client(bench):
    one, two = bench.connect(), bench.connect()
    bench.hub.send(frame(3))
    assert read(one) == read(two) == frame(3)


@pytest.mark.parametrize("cut", range(1, 16))
def test_torn_frames_are_put_together(bench, cut):
    link = bench.connect()
    data = frame(1) + frame(2) + frame(3)
    for piece in (data[:cut], data[cut : 16 + cut], data[16 + cut :]):
        link.send(piece)
        bench.turn()
    assert bench.heard == [frame(1), frame(2), frame(3)]


def test_two_torn_senders_do_not_mix(bench):
    one, two = bench.connect(), bench.connect()
    one.send(frame(1)[:7])
    bench.turn()
    two.send(frame(2))
    bench.turn()
    one.send(frame(1)[7:])
    bench.turn()
    assert bench.heard == [frame(2), frame(1)]


def test_who_does_not_read_loses_whole_frames_and_nobody_waits(bench):
    deaf, reading = bench.connect(), bench.connect()
    sent = 0
    while bench.hub.lost < 100:
        bench.hub.send(frame(sent))
        assert read(reading) == frame(sent)
        sent += 1
    kept = b""
    while chunk := read(deaf):
        kept += chunk
    assert len(kept) % 16 == 0
    assert kept == b"".join(frame(n) for n in range(len(kept) // 16))
    assert len(kept) // 16 == sent - bench.hub.lost
    bench.hub.send(frame(sent))
    assert read(deaf) == frame(sent)


def test_a_frame_that_went_half_is_finished_before_the_next(bench):
    link = bench.connect()
    client = bench.hub._clients[0]
    client.unsent = frame(1)[5:]
    bench.hub.send(frame(2))
    assert read(link) == frame(1)[5:] + frame(2)
    assert bench.hub.lost == 0


def test_clients_come_and_go(bench):
    one, two = bench.connect(), bench.connect()
    one.close()
    bench.turn()
    assert bench.hub.clients == 1
    bench.hub.send(frame(1))
    assert read(two) == frame(1)
    two.close()
    bench.turn()
    assert bench.told == [
        ("client 1 connected", 1),
        ("client 2 connected", 2),
        ("client 1 gone", 1),
        ("client 2 gone", 0),
    ]
    assert len(bench.handlers) == 1


def test_a_cut_bus_refuses_everybody(bench):
    link = bench.connect()
    bench.hub.close()
    assert read(link) == b""
    with pytest.raises(OSError, match=r"No such file|refused"):
        bench.connect()
    assert bench.handlers == {}
    bench.hub.send(frame(1))
    bench.hub.close()


def test_what_a_dead_process_left_is_replaced(tmp_path):
    path = tmp_path / "bus"
    first = listen(path)
    first.close()
    assert path.exists()
    listen(path).close()


def test_a_socket_that_cannot_be_made_is_told(tmp_path):
    with pytest.raises(DeviceError, match="XDG_RUNTIME_DIR"):
        listen(tmp_path / ("x" * 120))
    with pytest.raises(DeviceError, match="cannot make its socket"):
        listen(tmp_path / "no such folder" / "bus")


# The kernel's virtual bus. Where there is none, a pair of sockets that keep packets apart takes
# the place of it.


@pytest.fixture
def virtual():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    bus = VirtualCan.__new__(VirtualCan)
    handlers, heard = {}, []
    bus._serve(ours, handlers, lambda frames, origin: heard.append((frames, origin)))
    yield bus, theirs, handlers, heard
    bus.close()
    theirs.close()


def test_frames_of_a_virtual_bus_come_in_one_go(virtual):
    bus, theirs, handlers, heard = virtual
    for n in range(3):
        theirs.send(frame(n))
    for handler in list(handlers.values()):
        handler()
        handler()
    assert heard == [([frame(0), frame(1), frame(2)], bus)]


def test_a_virtual_bus_brings_frames_of_hosts_to_each_other_by_itself(virtual):
    bus, theirs, _, _ = virtual
    bus.send(frame(1), bus)
    bus.send(frame(2))
    assert read(theirs) == frame(2)
    assert read(theirs) is None


def test_a_full_or_cut_virtual_bus_loses_frames(virtual):
    bus, _, handlers, _ = virtual
    for n in range(10_000):
        bus.send(frame(n))
    assert 0 < bus.lost < 10_000
    bus.close()
    bus.send(frame(0))
    assert handlers == {}


def test_a_channel_that_is_not_there_is_no_virtual_bus():
    assert is_virtual("nocan77") is False


def test_an_interface_that_is_not_a_virtual_bus_is_refused():
    with pytest.raises(DeviceError, match="must not answer beside real ones"):
        is_virtual("lo")
    assert interface_kind("lo") == ""


def test_the_kernel_s_word_for_a_virtual_bus_is_understood():
    # RTM_NEWLINK as iproute2 shows it for "ip link add vcan0 type vcan": name, MTU, LINKINFO.
    info = bytes.fromhex("0900 0100 7663616e 00 000000".replace(" ", ""))
    linkinfo = struct.pack("=HH", 4 + len(info), 18) + info
    name = bytes.fromhex("0a00 0300 7663616e3000 0000".replace(" ", ""))
    body = struct.pack("=BxHiII", 0, 280, 3, 0x40C1, 0) + name + linkinfo
    head = struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 4711)
    assert kind_in_reply(head + body) == "vcan"
    without = struct.pack("=BxHiII", 0, 280, 3, 0x40C1, 0) + name
    assert kind_in_reply(struct.pack("=IHHII", 16 + len(without), 16, 0, 1, 0) + without) == ""
    error = struct.pack("=IHHIIi", 36, 2, 0, 1, 0, -19) + bytes(16)
    assert kind_in_reply(error) == ""
    assert kind_in_reply(b"") == ""
