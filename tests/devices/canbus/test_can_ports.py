"""Ports: the socket that carries frames, and any adapter of python-can."""

import errno
import gc
import socket
import struct
import time
from dataclasses import replace

import can
import pytest

from rigd.devices.canbus import CanExchange
from rigd.devices.canbus.adapters import SocketPort, open_port
from rigd.devices.canbus.port import pack_frame, unpack_frame
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress

SETTINGS = CanBus("socketcan", "rigd-none0", 1_000_000)


def test_frames_go_both_ways_in_order(ends):
    port, far = ends
    for number in range(20):
        port.send(pack_frame(0x200 + number, bytes([number])))
        far.send(0x180 + number, bytes([number, number]))
    for number in range(20):
        assert far.receive() == (0x200 + number, bytes([number]))
        assert unpack_frame(port.receive()) == (0x180 + number, bytes([number, number]))
    assert port.receive() is None


def test_error_if_the_line_is_cut(ends):
    port, far = ends
    far.send(0x123)
    far.socket.close()
    assert unpack_frame(port.receive()) == (0x123, b"")
    with pytest.raises(DeviceError, match=r"can0 \(test\): it was cut off"):
        port.receive()
    with pytest.raises(DeviceError, match=r"takes no more frames \(Broken pipe\)"):
        port.send(pack_frame(0x80))


def test_error_without_blocking_if_nobody_reads(ends):
    port, _ = ends
    frame = pack_frame(0x80)
    with pytest.raises(DeviceError, match="no other device acknowledges"):
        for _ in range(100_000):
            port.send(frame)


def test_a_full_line_carries_whole_frames_only(ends):
    port, far = ends
    sent = 0
    with pytest.raises(DeviceError):
        while True:
            port.send(pack_frame(sent % 0x800, sent.to_bytes(8, "big")))
            sent += 1
    for number in range(sent):
        assert far.receive() == (number % 0x800, number.to_bytes(8, "big"))
    far.socket.setblocking(False)
    with pytest.raises(BlockingIOError):
        far.socket.recv(1)


def test_waiting_ends_with_a_frame(ends):
    port, far = ends
    far.send(0x123)
    before = time.monotonic()
    port.wait(30.0)
    assert time.monotonic() - before < 10.0
    assert port.receive() is not None
    port.wait(0.001)
    assert port.receive() is None


def test_error_of_a_closed_port_which_may_close_again(ends):
    port, _ = ends
    port.close()
    port.close()
    with pytest.raises(DeviceError):
        port.send(pack_frame(0x80))
    with pytest.raises(DeviceError):
        port.receive()


def test_the_simulated_bus_delivers_every_frame(ends):
    port, far = ends
    port.accept([0x181])
    far.send(0x182)
    assert unpack_frame(port.receive()) == (0x182, b"")


class RecordingLink:
    """Link of a kernel with CAN: takes the options, and every frame with an error of choice."""

    family = getattr(socket, "AF_CAN", 29)

    def __init__(self, error=None):
        self.options = []
        self.error = error

    def setblocking(self, flag):
        assert not flag

    def fileno(self):
        return 0

    def setsockopt(self, *option):
        self.options.append(option)

    def send(self, frame):
        raise OSError(self.error, "no buffer space available")

    def recv(self, size):
        raise OSError(self.error or errno.EAGAIN, "network is down")


def test_the_kernel_filters_frames_as_requested():
    link = RecordingLink()
    SocketPort(link, "can0").accept({0x701: None, 0x181: None})
    # Identifier and mask; neither long identifiers nor requests for data get through.
    wanted = struct.pack("=4I", 0x181, 0xC000_07FF, 0x701, 0xC000_07FF)
    assert link.options == [(101, 1, wanted)]  # SOL_CAN_RAW, CAN_RAW_FILTER


def test_a_starting_exchange_admits_subscribed_frames():
    link = RecordingLink()
    exchange = CanExchange(SocketPort(link, "can0"))
    exchange.subscribe(0x181, print)
    exchange.start()
    exchange.subscribe(0x110, print)
    exchange.start()
    assert [len(filters) for _, _, filters in link.options] == [8, 16]


def test_errors_of_the_kernel_have_a_remedy():
    full = SocketPort(RecordingLink(errno.ENOBUFS), "can0")
    with pytest.raises(DeviceError, match="no other device acknowledges: check cable"):
        full.send(pack_frame(1))
    down = SocketPort(RecordingLink(errno.ENETDOWN), "can0")
    with pytest.raises(DeviceError, match=r"cannot be read \(network is down\)"):
        down.receive()


@pytest.fixture
def kernel_bus():
    """The virtual bus of the kernel, if it has one."""
    try:
        link = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except (AttributeError, OSError) as error:
        pytest.skip(f"CAN SOCKETS NOT TESTED: this kernel has none ({error})")
    with link:
        try:
            link.bind(("vcan0",))
        except OSError as error:
            pytest.skip(f"CAN SOCKETS NOT TESTED: there is no vcan0 ({error})")
        yield link


def test_the_kernel_s_bus_delivers_subscribed_frames_only(kernel_bus):
    port = open_port(replace(SETTINGS, channel="vcan0"), None)
    port.accept([0x181])
    try:
        for can_id in (0x182, 0x181 | 0x8000_0000, 0x181 | 0x4000_0000, 0x181):
            kernel_bus.send(struct.pack("=IB3x8s", can_id, 0, b""))
        port.wait(1.0)
        assert unpack_frame(port.receive()) == (0x181, b"")
        assert port.receive() is None
    finally:
        port.close()


class KernelSocket:
    """CAN socket of a kernel that has CAN, but not the interface."""

    def __init__(self, *_):
        pass

    def setsockopt(self, *_):
        pass

    def bind(self, _):
        raise OSError(errno.ENODEV, "No such device")

    def close(self):
        pass


def test_no_advice_to_bring_up_can_without_a_can_kernel(monkeypatch):
    def refuse(*_):
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr("rigd.devices.canbus.adapters.socket.socket", refuse)
    with pytest.raises(DeviceError, match="this kernel has no CAN sockets") as refused:
        open_port(SETTINGS, None)
    assert "ip link" not in str(refused.value)
    assert "modprobe can_raw" in str(refused.value)
    assert "rigd simulate" in str(refused.value)


def test_a_missing_bus_is_an_error_with_a_remedy(monkeypatch):
    monkeypatch.setattr("rigd.devices.canbus.adapters.socket.socket", KernelSocket)
    with pytest.raises(DeviceError) as refused:
        open_port(SETTINGS, None)
    assert "rigd-none0" in str(refused.value)
    assert "ip link set rigd-none0 up type can bitrate 1000000" in str(refused.value)
    assert "rigd simulate" in str(refused.value)


@pytest.mark.parametrize("interface", ["no-such-adapter", "slcan"])
def test_a_missing_adapter_is_an_error(interface):
    with pytest.raises(DeviceError, match=r"check can\.interface and can\.channel"):
        open_port(CanBus(interface, "/dev/rigd-none", 1_000_000), None)
    gc.collect()


def test_the_simulated_bus_is_reached_by_its_socket(runtime_folder):
    path = str(runtime_folder / "can")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(path)
        listener.listen()
        port = open_port(SETTINGS, SimulatorAddress(1, "", can_socket=path))
        far, _ = listener.accept()
        with far:
            port.send(pack_frame(0x80))
            assert far.recv(16) == pack_frame(0x80)
            assert "simulated" in port.name
            port.close()
            assert far.recv(16) == b""


def test_a_lost_simulated_bus_is_an_error(runtime_folder):
    address = SimulatorAddress(1, "", can_socket=str(runtime_folder / "gone"))
    with pytest.raises(DeviceError, match="start rigd simulate again"):
        open_port(SETTINGS, address)


def test_a_simulator_on_a_real_bus_uses_the_profile_s_bus(runtime_folder):
    with pytest.raises(DeviceError, match=r"CAN bus rigd-none0: .*start the simulated rig"):
        open_port(SETTINGS, SimulatorAddress(1, "", can_socket=""))


@pytest.fixture
def adapter(request):
    """A port on python-can's virtual bus, and a peer of python-can on it."""
    channel = request.node.name
    port = open_port(CanBus("virtual", channel, 1_000_000), None)
    with can.Bus(interface="virtual", channel=channel) as peer:
        assert not isinstance(port, SocketPort)
        yield port, peer
        port.close()


def message(can_id, data=b"", **flags):
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False} | flags)


def test_an_adapter_carries_frames_both_ways(adapter):
    port, peer = adapter
    port.send(pack_frame(0x201, b"\x0f\x00"))
    received = peer.recv(1.0)
    assert (received.arbitration_id, bytes(received.data)) == (0x201, b"\x0f\x00")
    assert not received.is_extended_id
    assert not received.is_error_frame
    peer.send(message(0x181, b"12345678"))
    assert unpack_frame(port.receive()) == (0x181, b"12345678")
    assert port.receive() is None


def test_waiting_on_an_adapter_loses_nothing(adapter):
    port, peer = adapter
    for number in range(3):
        peer.send(message(0x181, bytes([number])))
    port.wait(1.0)
    port.wait(1.0)
    received = [unpack_frame(port.receive()) for _ in range(3)]
    assert received == [(0x181, bytes([number])) for number in range(3)]
    port.wait(0.001)
    assert port.receive() is None


def test_one_poll_of_an_adapter_gets_past_frames_of_others(adapter):
    port, peer = adapter
    payloads = []
    exchange = CanExchange(port)
    exchange.subscribe(0x181, payloads.append)
    exchange.start()
    for _ in range(5):
        peer.send(message(0x3FF))
    peer.send(message(0x181, b"x"))
    exchange.deliver_frames()
    assert payloads == [b"x"]


def test_error_frames_of_an_adapter_pass_the_filters(adapter):
    port, peer = adapter
    exchange = CanExchange(port)
    exchange.subscribe(0x181, print)
    exchange.start()
    peer.send(message(0x40, bytes(8), is_error_frame=True))
    with pytest.raises(DeviceError, match="bus-off"):
        exchange.deliver_frames()


@pytest.mark.parametrize(
    "unrelated",
    [
        message(0x181, b"x", is_extended_id=True),
        message(0x1800_0181, b"x", is_extended_id=True),
        message(0x181, is_remote_frame=True),
    ],
    ids=["long", "long, same end", "remote"],
)
def test_frames_of_another_kind_are_dropped(adapter, unrelated):
    port, peer = adapter
    payloads = []
    exchange = CanExchange(port)
    exchange.subscribe(0x181, payloads.append)
    peer.send(unrelated)
    exchange.deliver_frames()
    assert payloads == []
    exchange.start()
    peer.send(unrelated)
    exchange.deliver_frames()
    assert payloads == []


def test_error_of_a_closed_adapter_which_may_close_again(adapter):
    port, _ = adapter
    port.close()
    port.close()
    with pytest.raises(DeviceError):
        port.send(pack_frame(0x80))
    with pytest.raises(DeviceError):
        port.receive()


class Scripted:
    """A python-can bus whose driver raises or returns the items of a list, then nothing."""

    def __init__(self, *script):
        self._script = list(script)

    def recv(self, _):
        step = self._script.pop(0) if self._script else None
        if isinstance(step, Exception):
            raise step
        return step

    def send(self, _, timeout):
        raise AssertionError

    def shutdown(self):
        raise RuntimeError("no such thread")


@pytest.fixture
def scripted_port(monkeypatch):
    """Make a port on an adapter of python-can that follows a script."""

    def make(*script):
        monkeypatch.setattr(can, "Bus", lambda **_: Scripted(*script))
        return open_port(CanBus("slcan", "slcan0", 1_000_000), None)

    return make


@pytest.mark.parametrize(
    "failure", [ValueError("invalid literal"), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "start")]
)
def test_a_damaged_line_is_an_error_frame(scripted_port, failure):
    payloads = []
    exchange = CanExchange(
        scripted_port(failure, message(0x181, b"a"), failure, message(0x181, b"b"))
    )
    exchange.subscribe(0x181, payloads.append)
    exchange.deliver_frames()
    assert payloads == [b"a", b"b"]
    assert exchange.error_frames == 2


def test_nineteen_damaged_lines_between_sound_ones_are_tolerated(scripted_port):
    script = [ValueError()] * 19 + [message(0x181)] + [ValueError()] * 19
    exchange = CanExchange(scripted_port(*script))
    exchange.deliver_frames()
    assert exchange.error_frames == 38


def test_silence_and_reports_do_not_reset_damaged_lines(scripted_port):
    script = [ValueError("odd"), None, message(1, bytes(8), is_error_frame=True)] * 20
    exchange = CanExchange(scripted_port(*script))
    with pytest.raises(
        DeviceError, match=r"slcan0 \(slcan\).*20 invalid CAN frames in a row.*ValueError: odd"
    ):
        for _ in range(60):
            exchange.deliver_frames()


def test_a_frame_of_can_fd_is_dropped(scripted_port):
    port = scripted_port(message(0x181, bytes(64), is_fd=True))
    assert unpack_frame(port.receive())[0] & 0x2000_0000


@pytest.mark.parametrize("failure", [can.CanOperationError("gone"), OSError(5, "gone")])
def test_a_failed_adapter_is_reported_at_once(scripted_port, failure):
    port = scripted_port(failure, failure)
    with pytest.raises(DeviceError, match=r"it cannot be read .*gone"):
        port.receive()
    with pytest.raises(DeviceError, match=r"it cannot be read .*gone"):
        port.wait(0.1)


def test_any_error_of_a_driver_is_reported_except_while_closing(scripted_port):
    port = scripted_port()
    with pytest.raises(DeviceError, match=r"takes no more frames \(AssertionError\)"):
        port.send(pack_frame(0x80))
    port.close()


def test_error_while_waiting_for_a_closed_port(ends):
    port, _ = ends
    port.close()
    with pytest.raises(DeviceError, match="cannot be waited for"):
        port.wait(0.1)
