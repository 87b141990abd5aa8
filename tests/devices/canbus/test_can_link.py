"""The common bus of the devices: opened by the first, closed by the last."""

import os
import socket

import pytest

from rigd.devices.canbus import CanLink
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.running_simulator import SimulatorAddress

SETTINGS = CanBus("socketcan", "rigd-none0", 1_000_000)


@pytest.fixture
def hub(runtime_folder):
    path = runtime_folder / "can"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
        listener.settimeout(2.0)
        yield listener


@pytest.fixture
def link(hub):
    link = CanLink(SETTINGS, SimulatorAddress(1, "", can_socket=hub.getsockname()))
    yield link
    link.close()
    link.close()


def is_connected(far):
    far.settimeout(0.0)
    try:
        return far.recv(16) != b""
    except BlockingIOError:
        return True


def test_two_users_have_one_bus_and_the_last_closes_it(hub, link):
    exchange = link.open()
    assert link.open() is exchange
    assert link.exchange is exchange
    far, _ = hub.accept()
    hub.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        hub.accept()
    with far:
        link.close()
        assert link.exchange is exchange
        assert is_connected(far)
        link.close()
        assert not is_connected(far)


def test_error_if_the_bus_is_not_open(link):
    with pytest.raises(DeviceError, match="not open"):
        _ = link.exchange
    link.open()
    link.close()
    with pytest.raises(DeviceError, match="not open"):
        _ = link.exchange


def test_closing_twice_is_harmless_and_the_bus_opens_again(hub, link):
    link.close()
    first = link.open()
    link.close()
    link.close()
    assert link.open() is not first
    link.close()
    with pytest.raises(DeviceError):
        _ = link.exchange


def test_a_failure_to_open_counts_no_user():
    link = CanLink(SETTINGS, None)
    for _ in range(2):
        with pytest.raises(DeviceError, match="rigd-none0"):
            link.open()
    link.close()
    with pytest.raises(DeviceError, match="not open"):
        _ = link.exchange


def test_a_bus_is_used_by_one_program_at_a_time(hub, link, runtime_folder):
    link.open()
    second = CanLink(SETTINGS, SimulatorAddress(1, "", can_socket=hub.getsockname()))
    with pytest.raises(
        DeviceError, match=rf"another rigd is using it \(rigd, process {os.getpid()}\)"
    ):
        second.open()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other_hub:
        other_hub.bind(str(runtime_folder / "other"))
        other_hub.listen()
        other = CanLink(SETTINGS, SimulatorAddress(1, "", can_socket=other_hub.getsockname()))
        other.open()
        other.close()
    link.close()
    second.open()
    second.close()
    second.close()
