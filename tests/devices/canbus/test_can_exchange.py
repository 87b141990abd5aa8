"""The exchange: distribution of frames, waiting for replies, and reports of the controller."""

import threading
import time

import pytest

from rigd.devices.canbus import CanExchange
from rigd.devices.canbus.port import pack_frame
from rigd.devices.contracts import DeviceError

ERROR = 0x2000_0000


@pytest.fixture
def exchange(ends):
    return CanExchange(ends[0])


def test_each_frame_goes_to_its_subscriber(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, lambda data: received.append(("drive", data)))
    exchange.subscribe(0x110, lambda data: received.append(("sensor", data)))
    far.send(0x110, b"abc")
    far.send(0x3FF, b"nobody's")
    far.send(0x181, b"12345678")
    far.send(0x110)
    exchange.deliver_frames()
    assert received == [("sensor", b"abc"), ("drive", b"12345678"), ("sensor", b"")]


@pytest.mark.parametrize("flag", [0x8000_0000, 0x4000_0000])
def test_long_identifiers_and_remote_frames_are_dropped(ends, exchange, flag):
    _, far = ends
    exchange.subscribe(0x181, lambda data: pytest.fail("not ours"))
    far.send(0x181 | flag)
    exchange.deliver_frames()


def test_one_identifier_has_one_subscriber(exchange):
    exchange.subscribe(0x201, print)
    with pytest.raises(DeviceError, match=r"two devices use the identifier 0x201.*profile"):
        exchange.subscribe(0x201, repr)


def test_starting_drops_queued_frames_but_no_subscriptions(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    far.send(0x181, b"old")
    exchange.start()
    far.send(0x181, b"new")
    exchange.deliver_frames()
    assert received == [b"new"]


def test_sending_uses_the_port(ends, exchange):
    _, far = ends
    exchange.send(pack_frame(0x80, b"\x01"))
    assert far.receive() == (0x80, b"\x01")


def test_waiting_ends_as_soon_as_it_is_ready(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    later = threading.Timer(0.02, far.send, (0x181, b"x"))
    later.start()
    assert exchange.wait_until(lambda: bool(received), time.monotonic_ns() + 10_000_000_000)
    later.join()
    assert received == [b"x"]


def test_waiting_continues_after_other_frames(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    for number in range(3):
        far.send(0x181, bytes([number]))
    assert exchange.wait_until(lambda: len(received) == 3, time.monotonic_ns() + 1_000_000_000)


def test_waiting_ends_at_its_deadline(exchange):
    before = time.monotonic_ns()
    assert not exchange.wait_until(lambda: False, before + 5_000_000)
    assert time.monotonic_ns() >= before + 5_000_000


def test_received_frames_are_taken_after_the_deadline(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    far.send(0x181, b"x")
    assert exchange.wait_until(lambda: bool(received), time.monotonic_ns() - 1)
    assert not exchange.wait_until(lambda: False, time.monotonic_ns() - 1)


@pytest.mark.parametrize(
    ("kind", "data", "message"),
    [
        (0x040, bytes(8), "bus-off"),
        (0x020, bytes(8), "no device acknowledges"),
        (0x004, b"\0\x10" + bytes(6), "error-passive"),
        (0x004, b"\0\x20" + bytes(6), "error-passive"),
        (0x044, bytes(8), "bus-off"),
    ],
)
def test_a_disturbed_bus_is_reported_each_time(ends, exchange, kind, data, message):
    _, far = ends
    far.send(ERROR | kind, data)
    for _ in range(2):
        with pytest.raises(DeviceError, match=message):
            exchange.deliver_frames()
    assert exchange.error_frames == 1


@pytest.mark.parametrize(
    ("kind", "data"), [(0x004, b"\0\x0c" + bytes(6)), (0x008, bytes(8)), (0x100, bytes(8))]
)
def test_a_warning_of_the_controller_is_only_counted(ends, exchange, kind, data):
    _, far = ends
    for _ in range(3):
        far.send(ERROR | kind, data)
    exchange.deliver_frames()
    assert exchange.error_frames == 3


def test_frames_before_a_cut_are_delivered(ends, exchange):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    far.send(0x181, b"x")
    far.socket.close()
    with pytest.raises(DeviceError, match="cut off"):
        exchange.deliver_frames()
    assert received == [b"x"]


def test_waiting_detects_a_cut_line(ends, exchange):
    _, far = ends
    cut = threading.Timer(0.02, far.socket.close)
    cut.start()
    with pytest.raises(DeviceError, match="cut off"):
        exchange.wait_until(lambda: False, time.monotonic_ns() + 10_000_000_000)
    cut.join()


@pytest.mark.parametrize(
    ("kind", "data"), [(0x020, bytes(8)), (0x004, b"\0\x10" + bytes(6)), (0x040, bytes(8))]
)
def test_frames_pass_regardless_of_a_disturbed_bus(ends, exchange, kind, data):
    _, far = ends
    received = []
    exchange.subscribe(0x181, received.append)
    far.send(ERROR | kind, data)
    far.send(0x181, b"x")
    with exchange.ignore_errors():
        exchange.deliver_frames()
        exchange.send(pack_frame(0x80))
        far.send(0x181, b"y")
        assert exchange.wait_until(lambda: len(received) == 2, time.monotonic_ns() + 10_000_000_000)
    assert received == [b"x", b"y"]
    assert far.receive() == (0x80, b"")
    with pytest.raises(DeviceError):  # reported to the caller that continues the loop
        exchange.deliver_frames()


def test_waiting_ends_in_time_on_a_lost_line(ends, exchange):
    _, far = ends
    far.socket.close()
    with exchange.ignore_errors():
        exchange.deliver_frames()
        before = time.monotonic_ns()
        assert not exchange.wait_until(lambda: False, before + 20_000_000)
        with pytest.raises(DeviceError, match="takes no more frames"):
            exchange.send(pack_frame(0x80))
    with pytest.raises(DeviceError, match="cut off"):
        exchange.deliver_frames()


def test_no_busy_wait_on_a_port_without_wait(ends):
    port, _ = ends
    tries = 0

    class Broken:
        name = "can0 (broken)"
        send = port.send

        def receive(self):
            nonlocal tries
            tries += 1
            raise DeviceError("it cannot be read")

        def wait(self, _):
            raise DeviceError("it cannot be waited for")

    exchange = CanExchange(Broken())
    with exchange.ignore_errors():
        assert not exchange.wait_until(lambda: False, time.monotonic_ns() + 50_000_000)
    assert 0 < tries <= 10 * 52  # ten a drain, a drain a millisecond
    with pytest.raises(DeviceError, match="cannot be read"):
        exchange.deliver_frames()
