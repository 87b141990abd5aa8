"""Set-up against a node that the canopen library makes, on a bus with two ends."""

import select
import socket
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import canopen
import pytest

import rigd.devices.cia402 as package
from rigd.devices.canbus.adapters import SocketPort
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.contracts import DeviceError

NODE = 5
EDS = str(Path(package.__file__).with_name("drive.eds"))
VALUES = {
    (0x1005, 0): 0x80,
    (0x1018, 1): 0x1234,
    (0x1018, 2): 0xABCD,
    (0x1018, 3): 3,
    (0x1018, 4): 4,
    (0x1008, 0): "CANOPEN NODE",
    (0x100A, 0): "7.1",
    (0x1401, 1): 0x305,
    (0x1402, 1): 0x80000405,
    (0x1403, 1): 0x80000505,
    (0x1801, 1): 0x40000285,
    (0x1802, 1): 0xC0000385,
    (0x1803, 1): 0xC0000485,
    (0x6040, 0): 0,
    (0x6041, 0): 0x0250,
    (0x6060, 0): 0,
    (0x6076, 0): 5,
    (0x6502, 0): 0x3ED,
}


class Hub(threading.Thread):
    """Passes frames of 16 bytes between its clients."""

    def __init__(self, path):
        super().__init__(daemon=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(path)
        self._listener.listen(4)
        self._wake, self._woken = socket.socketpair()
        self._rest = {}

    def run(self):
        while True:
            ready, _, _ = select.select([self._listener, self._woken, *self._rest], [], [])
            for end in ready:
                if end is self._woken:
                    return
                if end is self._listener:
                    self._rest[end.accept()[0]] = b""
                    continue
                data = b""
                with suppress(ConnectionResetError):  # it has left without reading everything
                    data = end.recv(4096)
                if not data:
                    end.close()
                    del self._rest[end]
                    continue
                data = self._rest[end] + data
                whole = len(data) // 16 * 16
                self._rest[end] = data[whole:]
                for other in self._rest:
                    if other is not end:
                        with suppress(BrokenPipeError):  # it has just left
                            other.sendall(data[:whole])

    def stop(self):
        self._wake.send(b".")
        self.join(5)
        for end in (self._listener, self._wake, self._woken, *self._rest):
            end.close()


@pytest.fixture
def path(tmp_path):
    path = str(tmp_path / "bus")
    hub = Hub(path)
    hub.start()
    yield path
    hub.stop()


@pytest.fixture
def node(path):
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    link.connect(path)
    port = SocketPort(link, "test")
    network = canopen.Network(port.open_bus())
    network.NOTIFIER_CYCLE = 0.02
    network.connect()
    node = canopen.LocalNode(NODE, EDS)
    for (index, sub), value in VALUES.items():
        node.sdo.get_variable(index, sub).raw = value
    node.add_read_callback(
        lambda index, subindex, od: node.sdo[0x6060].raw if index == 0x6061 else None
    )
    network.add_node(node)

    def on_sync(*_):
        # The library's node answers no SYNC by itself: switch-on disabled, position and torque 0.
        network.send_message(0x180 + NODE, bytes.fromhex("5002000000000000"))
        operational = node.nmt.state == "OPERATIONAL"
        network.send_message(0x700 + NODE, b"\x05" if operational else b"\x7f")

    network.subscribe(0x80, on_sync)
    yield node
    node.nmt.stop_heartbeat()
    for thread in threading.enumerate():
        if thread.name.startswith("Cyclic send task"):
            thread.join()
    network.disconnect()
    port.close()


@pytest.fixture
def make_drive(node, path, link_to):
    drives = []

    def make(rig):
        drives.append(Cia402Drive(rig, link_to(path)))
        return drives[-1]

    yield make
    for drive in drives:
        drive.close()


@pytest.fixture
def connect(make_drive, rig):
    """Connect the driver to the node; return the capabilities found."""

    def connect(rig=rig):
        drive = make_drive(rig)
        drive.connect()
        return drive.capabilities()

    return connect


def test_the_whole_set_up(node, connect, rig):
    identity = connect().identity
    assert identity["device_name"] == "CANOPEN NODE"
    assert identity["serial_number"] == 4

    def raw(index, sub=0):
        return node.get_data(index, sub).hex(" ")

    # Bytes as a drive stores them.
    assert raw(0x1006) == "e8 03 00 00"
    assert (raw(0x60C2, 1), raw(0x60C2, 2)) == ("01", "fd")
    assert raw(0x1016, 1) == "32 00 64 00"
    assert raw(0x1017) == "14 00"
    assert raw(0x6007) == "02 00"
    assert raw(0x1029, 1) == "00"
    assert raw(0x6072) == "08 07"
    assert raw(0x6060) == "0a"
    assert [raw(0x1A00, sub) for sub in range(4)] == [
        "03", "10 00 41 60", "20 00 64 60", "10 00 77 60",
    ]  # fmt: skip
    assert [raw(0x1600, sub) for sub in range(3)] == ["02", "10 00 40 60", "10 00 71 60"]
    assert (raw(0x1800, 1), raw(0x1800, 2)) == ("85 01 00 40", "01")
    assert (raw(0x1400, 1), raw(0x1400, 2)) == ("05 02 00 00", "01")
    assert (raw(0x1801, 1), raw(0x1401, 1)) == ("85 02 00 c0", "05 03 00 80")
    assert node.nmt.state == "OPERATIONAL"


def test_pdos_as_read_by_canopen(node, connect, rig):
    connect()
    for pdo in (node.tpdo[1], node.rpdo[1]):
        pdo.read(from_od=False)
    assert node.tpdo[1].cob_id == 0x185
    assert [(entry.index, entry.length) for entry in node.tpdo[1].map] == [
        (0x6041, 16), (0x6064, 32), (0x6077, 16),
    ]  # fmt: skip
    assert [(entry.index, entry.length) for entry in node.rpdo[1].map] == [
        (0x6040, 16), (0x6071, 16),
    ]  # fmt: skip
    assert node.tpdo[1].enabled
    assert node.rpdo[1].trans_type == 1


def test_a_node_without_an_object(node, connect, rig):
    del node.object_dictionary[0x6007]
    with pytest.raises(DeviceError, match=r"no object 6007.*\"abort_option\""):
        connect()


def test_read_only_limits_of_elmo(node, connect, rig):
    for index in (0x60E0, 0x60E1):
        entry = node.object_dictionary[index]
        node.sdo[index].raw = 50_000
        entry.access_type = "ro"
    capabilities = connect()
    assert capabilities.has_object(0x60E0)
    assert capabilities.accepted_missing_functions == ()


def test_a_read_only_limit_that_is_too_low(node, connect, rig):
    node.sdo[0x60E1].raw = 500
    node.object_dictionary[0x60E1].access_type = "ro"
    with pytest.raises(DeviceError, match=r"60E1 .*is 500 but must be 1800.*read-only"):
        connect()


def test_missing_objects_of_maxon(node, connect, rig):
    for index in (0x6072, 0x1006):
        del node.object_dictionary[index]
    limit = canopen.objectdictionary.ODVariable("Output current limit", 0x3001, 2)
    limit.data_type = canopen.objectdictionary.UNSIGNED32
    record = canopen.objectdictionary.ODRecord("Motor data", 0x3001)
    record.add_member(limit)
    node.object_dictionary.add_object(record)
    settings = replace(
        rig.cia402, accept_without=("torque_limit",), set_objects=("3001:2 u32 2500",)
    )
    capabilities = connect(replace(rig, cia402=settings))
    assert node.get_data(0x3001, 2).hex(" ") == "c4 09 00 00"
    assert {row.address for row in capabilities.missing_objects} >= {"6072", "1006"}
    assert capabilities.accepted_missing_functions == ("torque_limit",)
    assert node.get_data(0x1A00, 0) == b"\x03"


def test_a_node_without_any_watchdog(node, connect, rig):
    del node.object_dictionary[0x1016]
    with pytest.raises(DeviceError, match=r"no object 1016:1.*own_watchdog_s"):
        connect()


def test_the_bytes_of_a_fault_reset(node, make_drive, rig):
    node.sdo[0x6041].raw = 0x0218
    node.sdo[0x603F].raw = 0x3220
    words = []

    def on_write(index, subindex, od, data):
        if index == 0x6040:
            words.append(bytes(data))
            fault = node.sdo[0x6041].raw & 0x08
            if data[0] & 0x80 or not fault:
                node.sdo[0x6041].raw = 0x0231 if data[0] == 0x06 else 0x0250

    node.add_write_callback(on_write)
    assert "under-voltage" in make_drive(rig).reset_fault()
    assert [word[0] for word in words] == [0x00, 0x00, 0x80, 0x00, 0x06, 0x00]
