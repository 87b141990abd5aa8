"""The wired stop (STO) as the simulated drives show it and the driver understands it."""

import struct
from dataclasses import replace

import pytest
from shipped_profile import load_shipped

from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError
from rigd.sim import SimulatedRig
from rigd.sim.wire._drive_node import DriveNode

HOST, NODE = 127, 1


@pytest.fixture
def direct():
    devices = open_devices(load_shipped("sim").rig)
    devices.drive.connect()
    devices.drive.enable()
    devices.drive.latch(0)
    devices.drive.command(0.2)
    return devices.drive


def test_the_direct_drive_has_no_torque_from_that_instant_on(direct):
    direct.sto_dropped = True
    assert not direct._plant.enabled
    direct.command(0.2)
    assert direct._plant._torque_nm == 0.0
    with pytest.raises(DeviceError, match=r"the wired stop \(STO\) was dropped"):
        direct.read_angle()


def test_the_direct_drive_stays_off_until_it_is_released_and_enabled_again(direct):
    direct.sto_dropped = True
    direct.disable()
    direct.read_angle()  # a drive that is off may be watched
    with pytest.raises(DeviceError, match="STO"):
        direct.enable()
    direct.sto_dropped = False
    assert not direct._plant.enabled
    direct.enable()
    direct.read_angle()
    assert direct._plant.enabled


class Node:
    """The simulated drive on a bench, brought to operation enabled by hand."""

    def __init__(self, sto_error_code):
        rig = load_shipped("antenna_can").rig
        rig = replace(rig, cia402=replace(rig.cia402, sto_error_code=sto_error_code))
        simulated = SimulatedRig(rig)
        self.plant = simulated.plant
        self.sent = []
        self.now_s = 0.0
        self.node = DriveNode(
            rig,
            simulated,
            lambda: simulated.advance(1),
            lambda can_id, data: self.sent.append((can_id, data)),
            lambda *_, **__: None,
        )
        self.node.tick(0.0)
        self.write(0x6060, 10, 1)
        # A TPDO with the statusword at every SYNC is what it sends at power-on.
        self.write(0x1800, 1, 1, sub=2)
        self.node.receive(0, bytes([1, NODE]))
        self.control(0x06, 0x07, 0x0F)
        assert self.plant.enabled

    def write(self, index, value, size, sub=0):
        head = bytes([0x23 | (4 - size) << 2]) + struct.pack("<HB", index, sub)
        self.node.receive(0x600 + NODE, head + value.to_bytes(size, "little").ljust(4, b"\0"))

    def control(self, *words):
        for word in words:
            self.write(0x6040, word, 2)

    def sync(self):
        """Let a period pass; return the statusword."""
        self.now_s += 1e-3
        self.sent.clear()
        self.node.receive(0x80, b"")
        self.node.tick(self.now_s)
        [data] = [data for can_id, data in self.sent if can_id == 0x180 + NODE]
        return struct.unpack_from("<H", data)[0]


def test_a_drive_without_a_code_shows_it_in_its_statusword():
    bench = Node(0)
    assert bench.sync() & 0x7F == 0x37
    bench.node.sto_dropped = True
    assert not bench.plant.enabled
    assert bench.sync() & 0x7F == 0x40  # switch on disabled, and no voltage
    bench.control(0x06, 0x07, 0x0F)
    assert bench.sync() & 0x4F == 0x40
    bench.node.sto_dropped = False
    assert bench.sync() & 0x7F == 0x50
    assert not bench.plant.enabled  # nothing happens by itself
    bench.control(0x06, 0x07, 0x0F)
    assert bench.plant.enabled


def test_a_drive_with_a_code_goes_to_fault_and_stays_there_while_it_lasts():
    bench = Node(0xFF20)
    bench.node.sto_dropped = True
    assert not bench.plant.enabled
    assert (0x80 + NODE, bytes.fromhex("20ff010000000000")) in bench.sent
    for _ in range(60):
        word = bench.sync()
    assert word & 0x4F == 0x08
    bench.control(0x00, 0x80)
    assert bench.sync() & 0x4F == 0x08
    bench.node.sto_dropped = False
    bench.control(0x00, 0x80)
    assert bench.sync() & 0x4F == 0x40
