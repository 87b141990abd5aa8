"""Set-up through canopen on our ports, which leaves the port unchanged."""

import socket

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes

from rigd.devices.canbus.adapters import SocketPort
from rigd.devices.canbus.port import pack_frame, unpack_frame

NODE = 5


def dictionary():
    objects = canopen.ObjectDictionary()
    for index, name, kind in (
        (0x2000, "number", datatypes.UNSIGNED32),
        (0x2001, "text", datatypes.VISIBLE_STRING),
    ):
        variable = ODVariable(name, index)
        variable.data_type = kind
        variable.access_type = "rw"
        objects.add_object(variable)
    return objects


@pytest.fixture
def nodes():
    """A node as its master sees it, and the node itself, on two ends of a line."""
    networks = []
    ports = [
        SocketPort(link, f"end {number}")
        for number, link in enumerate(socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM))
    ]
    for port in ports:
        network = canopen.Network(port.open_bus())
        network.NOTIFIER_CYCLE = 0.02
        network.connect()
        networks.append(network)
    remote = canopen.RemoteNode(NODE, dictionary())
    networks[0].add_node(remote)
    local = canopen.LocalNode(NODE, dictionary())
    networks[1].add_node(local)
    yield remote, local, ports, networks
    for network in networks:
        network.disconnect()
    for port in ports:
        port.close()


def test_objects_are_written_and_read(nodes):
    remote, local, _, _ = nodes
    remote.sdo["number"].raw = 0x1234_5678
    assert local.sdo["number"].raw == 0x1234_5678
    assert remote.sdo["number"].raw == 0x1234_5678
    text = "longer than what fits into one frame, so that it goes in segments"
    remote.sdo["text"].raw = text
    assert remote.sdo["text"].raw == text


def test_a_refusal_is_an_error_of_canopen(nodes):
    remote, _, _, _ = nodes
    with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
        remote.sdo.upload(0x3000, 0)


def test_after_set_up_the_port_is_still_open(nodes):
    remote, _, ports, networks = nodes
    remote.sdo["number"].raw = 1
    for network in networks:
        network.disconnect()
    ports[0].send(pack_frame(0x80))
    ports[1].wait(1.0)
    assert unpack_frame(ports[1].receive()) == (0x80, b"")


def test_receiving_waits_for_its_timeout(ends):
    port, far = ends
    bus = port.open_bus()
    assert bus.recv(0.0) is None
    assert bus.recv(0.005) is None
    far.send(0x705, b"\x05")
    received = bus.recv(5.0)
    assert (received.arbitration_id, bytes(received.data)) == (0x705, b"\x05")
    bus.shutdown()


@pytest.mark.parametrize("flag", [0x8000_0000, 0x4000_0000])
def test_frames_of_another_kind_are_dropped(ends, flag):
    port, far = ends
    bus = port.open_bus()
    far.send(flag | 0x585)
    far.send(0x705)
    assert bus.recv(1.0).arbitration_id == 0x705
    assert bus.recv(0.0) is None
    bus.shutdown()


@pytest.mark.parametrize(
    ("message", "can_id"),
    [
        ({"arbitration_id": 0x123, "is_extended_id": False}, 0x123),
        ({"arbitration_id": 0x1234_5678, "is_extended_id": True}, 0x9234_5678),
        (
            {"arbitration_id": 0x123, "is_extended_id": False, "is_remote_frame": True},
            0x4000_0123,
        ),
        ({"arbitration_id": 0x44, "is_extended_id": False, "is_error_frame": True}, 0x2000_0044),
    ],
    ids=["data", "long", "remote", "error"],
)
def test_frames_are_sent_with_the_flags_of_the_kernel(ends, message, can_id):
    port, far = ends
    data = b"" if "is_remote_frame" in message else b"abc"
    port.open_bus().send(can.Message(**message, data=data))
    assert far.receive() == (can_id, data)


def test_an_error_frame_is_received_as_one(ends):
    port, far = ends
    far.send(0x2000_0044, bytes(8))
    received = port.open_bus().recv(1.0)
    assert received.is_error_frame
    assert received.arbitration_id == 0x44
    assert bytes(received.data) == bytes(8)
