"""A drive on a bench: frames by hand, time by hand."""

import struct
from dataclasses import replace
from functools import cache

import pytest
from shipped_profile import load_shipped

from rigd.devices.parameters import ServoDrive
from rigd.sim import SimulatedRig
from rigd.sim.wire._drive_node import DriveNode
from rigd.sim.wire._object_dictionary import read_device

NODE = 5
HOST = 100
SYNC = 0x80
PERIOD_S = 1e-3

SERVO = ServoDrive(
    node_id=NODE,
    vendor_id=0x1234,
    product_code=0x5678,
    direction=1,
    gear_ratio=100.0,
    rated_torque_unit_nm=1e-5,
    torque_delivery="at_sync",
    heartbeat_period_s=0.02,
    heartbeat_timeout_s=0.05,
    drive_heartbeat_period_s=0.02,
    drive_heartbeat_timeout_s=0.05,
    host_node_id=HOST,
    abort_option=3,
    communication_error_option=1,
    enable_timeout_s=1.0,
)


@cache
def sim_rig():
    return load_shipped("sim").rig


def make_rig(**changes):
    rig = replace(sim_rig(), cia402=replace(SERVO, **changes))
    # A motor without friction moves at the least torque.
    return replace(rig, motor=replace(rig.motor, coulomb_nm=0.0))


class Bench:
    """One drive, its frames and log, and the few requests that tests need."""

    node_id = NODE

    def __init__(self, rig, **options):
        self.rig = rig
        self.simulated = SimulatedRig(rig)
        self.plant = self.simulated.plant
        self.sent = []
        self.events = []
        self.now_s = 0.0
        self.torques = []
        command = self.plant.command

        def spy(torque_nm):
            self.torques.append(torque_nm)
            command(torque_nm)

        self.exerting = lambda: self.plant._torque_nm
        # The plant has slots: a proxy passes everything on.
        self.simulated.plant = _Spy(self.plant, spy)
        self.node = DriveNode(
            rig,
            self.simulated,
            lambda: self.plant.advance(1),
            lambda can_id, data: self.sent.append((can_id, data)),
            lambda source, what, **values: self.events.append((source, what, values)),
            **options,
        )

    def boot(self):
        self.node.tick(self.now_s)
        self.sent.clear()
        return self

    def take(self):
        """Return the frames sent since the last call."""
        sent, self.sent[:] = list(self.sent), []
        return sent

    def wait(self, milliseconds, *, sync=False, beat=False, rpdo=None):
        """Let time pass, with the actions of the host in each millisecond."""
        for _ in range(milliseconds):
            self.now_s += PERIOD_S
            if beat:
                self.beat()
            if sync:
                self.node.receive(SYNC, b"")
            if rpdo is not None:
                self.rpdo(*rpdo)
            self.node.tick(self.now_s)

    def beat(self):
        self.node.receive(0x700 + HOST, b"\x05")

    def sync(self):
        """A SYNC; returns statusword, position and torque of the TPDO, if one came."""
        self.sent.clear()
        self.node.receive(SYNC, b"")
        frames = [data for can_id, data in self.sent if can_id == 0x180 + NODE]
        return struct.unpack("<Hih", frames[0]) if frames else None

    def rpdo(self, word, per_mille):
        self.node.receive(0x200 + NODE, struct.pack("<Hh", word, per_mille))

    def nmt(self, command):
        self.node.receive(0, bytes([command, NODE]))

    def request(self, text):
        """Send an SDO request in hex, and return the reply in hex."""
        self.sent.clear()
        self.node.receive(0x600 + NODE, bytes.fromhex(text))
        replies = [data for can_id, data in self.sent if can_id == 0x580 + NODE]
        assert len(replies) == 1
        return replies[0].hex(" ")

    def write(self, index, sub, value, size):
        """Expedited download; returns the abort code, or 0."""
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        head = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub)
        reply = bytes.fromhex(self.request((head + data).hex()))
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0

    def read(self, index, sub=0, *, signed=False):
        reply = bytes.fromhex(self.request(struct.pack("<BHBI", 0x40, index, sub, 0).hex()))
        assert reply[0] & 0xE3 == 0x43, reply.hex(" ")
        size = 4 - (reply[0] >> 2 & 3)
        return int.from_bytes(reply[4 : 4 + size], "little", signed=signed)

    def map_pdo(self, number, direction, transmission, *entries):
        """Configure a PDO as a good master does."""
        com, mapping, base = (
            (0x1400, 0x1600, 0x200) if direction == "r" else (0x1800, 0x1A00, 0x180)
        )
        cob_id = base + NODE + 0x100 * (number - 1)
        com, mapping = com + number - 1, mapping + number - 1
        for index, sub, value, size in (
            (com, 1, 0x8000_0000 | cob_id, 4),
            (com, 2, transmission, 1),
            (mapping, 0, 0, 1),
            *((mapping, sub, entry, 4) for sub, entry in enumerate(entries, 1)),
            (mapping, 0, len(entries), 1),
            (com, 1, cob_id, 4),
        ):
            assert self.write(index, sub, value, size) == 0, f"{index:04X}:{sub}"

    def configure(self, *, delivery=1):
        """The rig's PDOs, the mode, and NMT operational."""
        self.map_pdo(1, "r", delivery, 0x6040_0010, 0x6071_0010)
        self.map_pdo(1, "t", 1, 0x6041_0010, 0x6064_0020, 0x6077_0010)
        assert self.write(0x6060, 0, 10, 1) == 0
        self.nmt(1)
        return self

    def enable(self):
        """Up to operation enabled, a controlword a SYNC."""
        for word in (0x06, 0x07, 0x0F):
            self.rpdo(word, 0)
            self.sync()
        assert self.state() == "operation enabled"
        self.sent.clear()
        return self

    def drive(self, per_mille):
        """Make a torque take effect."""
        self.rpdo(0x0F, per_mille)
        return self.sync()

    def state(self):
        return [v["state"] for _, what, v in self.events if what == "state"][-1]

    def nmt_state(self):
        return [v["state"] for _, what, v in self.events if what == "nmt"][-1]

    def logged_torque(self):
        """The last torque (N·m) and whether the drive is on, from the log."""
        last = [v for _, what, v in self.events if what == "torque"][-1]
        return last["torque_nm"], last["enabled"]

    def emergencies(self):
        """Code, register and vendor's bytes of the EMCY messages on the bus since last taken."""
        frames = [data for can_id, data in self.sent if can_id == 0x80 + NODE]
        return [(*struct.unpack_from("<HB", data), data[3:].hex()) for data in frames]

    def assert_off(self):
        """Torque zero and drive off: in the plant, in the log, on the bus."""
        assert not self.plant.enabled
        assert self.exerting() == 0.0
        assert not any(self.plant._torques)
        assert self.logged_torque() == (0.0, False)
        assert self.read_torque() == 0

    def read_torque(self):
        return self.node._objects[0x6077, 0].read_integer()


class _Spy:
    """The plant, its commands recorded."""

    def __init__(self, plant, command):
        self._plant = plant
        self.command = command

    def __getattr__(self, name):
        return getattr(self._plant, name)


@pytest.fixture
def rig():
    return make_rig()


@pytest.fixture
def bench(rig):
    """Booted, in pre-operational."""
    return Bench(rig).boot()


@pytest.fixture
def running(bench):
    """In operation enabled, at zero torque."""
    return bench.configure().enable()


@pytest.fixture
def make_bench():
    def make(options=None, *, booted=True, **changes):
        made = Bench(make_rig(**changes), **(options or {}))
        return made.boot() if booted else made

    return make


@pytest.fixture
def bench_on():
    """Make the bench of a whole rig."""
    return Bench


@pytest.fixture
def eds_bench():
    """Make the bench of a drive as an EDS file describes it."""

    def make(path):
        return Bench(make_rig(), device_file=read_device(path, NODE)).boot()

    return make
