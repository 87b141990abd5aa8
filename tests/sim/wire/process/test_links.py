"""The bus on a Unix socket and the serial line: distribution, torn frames, deaf clients."""

import os
import select
import socket
import struct
from dataclasses import replace

import pytest

from rigd.devices.contracts import DeviceError
from rigd.profile import load_profile
from rigd.sim.wire import _links as links


def frame(n):
    return struct.pack("=IB3x8s", 0x200 + n % 0x100, 4, struct.pack("<I", n))


class Bench:
    """A hub with its own small event loop."""

    def __init__(self, path):
        self.path = path
        self.handlers = {}
        self.received = []
        self.events = []
        self.hub = links.VirtualBus(
            path, self.handlers, self._receive, lambda *events: self.events.append(events)
        )
        self.links = []

    def _receive(self, frames, origin):
        self.received += frames
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


def test_nodes_and_other_clients_receive_frames_of_a_client(bench):
    one, two, three = (bench.connect() for _ in range(3))
    one.send(frame(1) + frame(2))
    bench.turn()
    assert bench.received == [frame(1), frame(2)]
    assert read(one) is None
    assert read(two) == read(three) == frame(1) + frame(2)


def test_every_client_receives_frames_of_a_node(bench):
    one, two = bench.connect(), bench.connect()
    bench.hub.send(frame(3))
    assert read(one) == read(two) == frame(3)


@pytest.mark.parametrize("cut", range(1, 16))
def test_torn_frames_are_joined(bench, cut):
    link = bench.connect()
    data = frame(1) + frame(2) + frame(3)
    for chunk in (data[:cut], data[cut : 16 + cut], data[16 + cut :]):
        link.send(chunk)
        bench.turn()
    assert bench.received == [frame(1), frame(2), frame(3)]


def test_two_torn_senders_do_not_mix(bench):
    one, two = bench.connect(), bench.connect()
    one.send(frame(1)[:7])
    bench.turn()
    two.send(frame(2))
    bench.turn()
    one.send(frame(1)[7:])
    bench.turn()
    assert bench.received == [frame(2), frame(1)]


def test_a_client_that_does_not_read_loses_whole_frames(bench):
    deaf, reading = bench.connect(), bench.connect()
    sent = 0
    while bench.hub.lost_frame_count < 100:
        bench.hub.send(frame(sent))
        assert read(reading) == frame(sent)
        sent += 1
    data = b""
    while chunk := read(deaf):
        data += chunk
    assert len(data) % 16 == 0
    assert data == b"".join(frame(n) for n in range(len(data) // 16))
    assert len(data) // 16 == sent - bench.hub.lost_frame_count
    bench.hub.send(frame(sent))
    assert read(deaf) == frame(sent)


def test_a_half_sent_frame_is_completed_first(bench):
    link = bench.connect()
    client = bench.hub._clients[0]
    client.unsent_bytes = frame(1)[5:]
    bench.hub.send(frame(2))
    assert read(link) == frame(1)[5:] + frame(2)
    assert bench.hub.lost_frame_count == 0


def test_clients_come_and_go(bench):
    one, two = bench.connect(), bench.connect()
    one.close()
    bench.turn()
    assert bench.hub.client_count == 1
    bench.hub.send(frame(1))
    assert read(two) == frame(1)
    two.close()
    bench.turn()
    assert bench.events == [
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


def test_the_socket_of_a_dead_process_is_replaced(tmp_path):
    path = tmp_path / "bus"
    first = links.listen(path)
    first.close()
    assert path.exists()
    links.listen(path).close()


def test_failure_to_make_the_socket_is_reported(tmp_path):
    with pytest.raises(DeviceError, match="XDG_RUNTIME_DIR"):
        links.listen(tmp_path / ("x" * 120))
    with pytest.raises(DeviceError, match="cannot make its socket"):
        links.listen(tmp_path / "no such folder" / "bus")


# The kernel's virtual bus. Where there is none, a pair of packet sockets
# replaces it.


@pytest.fixture
def virtual():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    bus = links.VirtualCan.__new__(links.VirtualCan)
    handlers, received = {}, []
    bus._use_socket(ours, handlers, lambda frames, origin: received.append((frames, origin)))
    yield bus, theirs, handlers, received
    bus.close()
    theirs.close()


def test_frames_of_a_virtual_bus_are_received_together(virtual):
    bus, theirs, handlers, received = virtual
    for n in range(3):
        theirs.send(frame(n))
    for handler in list(handlers.values()):
        handler()
        handler()
    assert received == [([frame(0), frame(1), frame(2)], bus)]


def test_a_virtual_bus_is_not_repeated_to_other_hosts(virtual):
    bus, theirs, _, _ = virtual
    bus.send(frame(1), bus)
    bus.send(frame(2))
    assert read(theirs) == frame(2)
    assert read(theirs) is None


def test_a_full_or_cut_virtual_bus_loses_frames(virtual):
    bus, _, handlers, _ = virtual
    for n in range(10_000):
        bus.send(frame(n))
    assert 0 < bus.lost_frame_count < 10_000
    bus.close()
    bus.send(frame(0))
    assert handlers == {}


def test_a_missing_channel_is_no_virtual_bus():
    assert links.is_virtual_can("nocan77") is False


def test_another_kind_of_interface_is_refused():
    with pytest.raises(DeviceError, match="must not answer together with real ones"):
        links.is_virtual_can("lo")
    assert links.interface_kind("lo") == ""


def test_the_kernel_s_name_of_a_virtual_bus_is_known():
    # RTM_NEWLINK as iproute2 shows it for "ip link add vcan0 type vcan": name, MTU, LINKINFO.
    info = bytes.fromhex("0900 0100 7663616e 00 000000".replace(" ", ""))
    linkinfo = struct.pack("=HH", 4 + len(info), 18) + info
    name = bytes.fromhex("0a00 0300 7663616e3000 0000".replace(" ", ""))
    body = struct.pack("=BxHiII", 0, 280, 3, 0x40C1, 0) + name + linkinfo
    head = struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 4711)
    assert links.kind_in_reply(head + body) == "vcan"
    without = struct.pack("=BxHiII", 0, 280, 3, 0x40C1, 0) + name
    assert (
        links.kind_in_reply(struct.pack("=IHHII", 16 + len(without), 16, 0, 1, 0) + without) == ""
    )
    error = struct.pack("=IHHIIi", 36, 2, 0, 1, 0, -19) + bytes(16)
    assert links.kind_in_reply(error) == ""
    assert links.kind_in_reply(b"") == ""


# The serial line


class Line:
    def __init__(self):
        self.handlers = {}
        self.received = b""
        self.events = []
        self.pty = links.PtyLine(self.handlers, self._receive, self.events.append)
        self.port = None

    def _receive(self, data):
        self.received += data

    def open(self):
        self.port = os.open(self.pty.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.pty.poll()

    def turn(self):
        for descriptor in select.select(self.handlers, (), (), 30.0 if self.handlers else 0)[0]:
            self.handlers[descriptor]()

    def read(self):
        select.select([self.port], (), (), 30.0)
        return os.read(self.port, 65536)

    def close(self):
        self.pty.close()
        if self.port is not None:
            os.close(self.port)


@pytest.fixture
def line():
    line = Line()
    yield line
    line.close()


def test_bytes_go_both_ways_unchanged(line):
    line.open()
    every = bytes(range(256))
    line.pty.write(every)
    assert line.read() == every
    os.write(line.port, every)
    line.turn()
    assert line.received == every
    assert line.events == [True]


def test_no_busy_wait_on_an_idle_line(line):
    line.pty.poll()
    assert line.handlers == {}
    line.open()
    assert select.select(line.handlers, (), (), 0)[0] == []


def test_bytes_without_a_listener_are_lost(line):
    line.pty.write(b"nobody hears this")
    line.open()
    line.pty.write(b"this is heard")
    assert line.read() == b"this is heard"
    assert line.pty.lost_byte_count == 0


def test_a_host_that_does_not_read_loses_bytes(line):
    line.open()
    for _ in range(1000):
        line.pty.write(bytes(91))
    assert 0 < line.pty.lost_byte_count < 91_000


def test_the_port_can_be_closed_and_opened_again(line):
    line.open()
    os.write(line.port, b"first")
    line.turn()
    os.close(line.port)
    line.turn()
    assert line.handlers == {}
    line.open()
    os.write(line.port, b", second")
    line.turn()
    assert line.received == b"first, second"
    assert line.events == [True, False, True]


def test_a_cut_line_is_dead(line):
    line.open()
    line.pty.close()
    line.pty.write(b"lost")
    line.pty.poll()
    assert line.handlers == {}
    assert os.read(line.port, 10) == b""


# Delays


def test_delays_of_the_exchange_are_not_simulated_twice():
    rig = load_profile("antenna_can").rig
    assert links.without_transport_delay(rig) is rig
    late = replace(
        rig,
        acquisition=replace(rig.acquisition, mode="previous_tick"),
        encoder=replace(rig.encoder, delay_s=1.055e-3),
        sensor=replace(rig.sensor, delay_s=1.0e-3),
    )
    left = links.without_transport_delay(late)
    assert left.encoder.delay_s == pytest.approx(5.5e-5)
    assert left.sensor.delay_s == pytest.approx(0.0, abs=1e-12)
    assert left.actuation == late.actuation


@pytest.mark.parametrize("device", ["encoder", "sensor"])
def test_a_delay_below_that_of_the_exchange_is_refused(device):
    rig = load_profile("antenna_can").rig
    rig = replace(
        rig,
        acquisition=replace(rig.acquisition, mode="previous_tick"),
        encoder=replace(rig.encoder, delay_s=1.0e-3),
        sensor=replace(rig.sensor, delay_s=1.0e-3),
    )
    rig = replace(rig, **{device: replace(getattr(rig, device), delay_s=0.5e-3)})
    with pytest.raises(DeviceError, match=rf"{device}\.delay_s = 0\.0005 s"):
        links.without_transport_delay(rig)
