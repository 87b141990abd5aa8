"""Fakes of the nodes, and a world in memory."""

import struct

import pytest
from shipped_profile import load_shipped

from rigd.sim import SimulatedRig
from rigd.sim.wire._bus_simulation import BusSimulation

PERIOD_NS = 1_000_000


@pytest.fixture(autouse=True)
def _patient(patient_drives):
    pass


def frame(can_id, data=b""):
    """16 bytes of struct can_frame, packed by hand."""
    return struct.pack("=IB3x8s", can_id, len(data), data)


SYNC = frame(0x80)


class Drive:
    """Answers each SYNC with the number of periods that the rig has moved so far."""

    def __init__(self, step, send):
        self.frozen = self.sto_dropped = False
        self.torque_lag_s = 0.0
        self.never_sets_bit_12 = self.stays_operational = self.ignores_silent_host = False
        self.restarts = []
        self.angle_offset_counts = 0
        self.received = []
        self.ticks_s = []
        self.emergencies = []
        self.step, self.send = step, send
        self.rig_periods = lambda: 0

    def receive(self, can_id, data):
        if self.frozen:
            return
        self.received.append((can_id, data))
        if can_id == 0x80:
            self.step()
            self.send(0x181, struct.pack("<I", self.rig_periods()))

    def tick(self, now_s):
        self.ticks_s.append(now_s)

    def reset(self):
        self.restarts.append("restart")

    def power_cycle(self):
        self.restarts.append("power_cycle")

    def emergency(self, code, register, vendor):
        self.emergencies.append((code, register, vendor))


class Sensor:
    """Answers a poll with two frames."""

    def __init__(self, send):
        self.frozen = False
        self.saturate = None
        self.status_bits = 0
        self.received = []
        self.restarts = []
        self.send = send

    def reset(self):
        self.restarts.append("restart")

    def power_cycle(self):
        self.restarts.append("power_cycle")

    def receive(self, can_id, data):
        self.received.append((can_id, data))
        if can_id == 0x680 and not self.frozen:
            self.send(0x680, b"first")
            self.send(0x681, b"second")

    def tick(self, now_s):
        pass


class SerialSensor:
    """Streams one numbered record of 13 bytes for every reading."""

    def __init__(self, write, records_per_period):
        self.frozen = False
        self.saturate = None
        self.status_bits = 0
        self.received = b""
        self.write = write
        self.records_per_period = records_per_period
        self.emitted = 0

    def receive(self, data):
        self.received += data

    def emit(self):
        first, self.emitted = self.emitted, self.emitted + self.records_per_period
        self.write(b"".join(bytes([n % 256]) * 13 for n in range(first, self.emitted)))

    def tick(self, now_s):
        pass


class Recording:
    """A world, and its output."""

    def __init__(self, rig, *, lock_step, serial, log):
        self.sent = []
        self.written = b""
        self.cuts = []
        self.mended = []
        self.log = log
        simulated = SimulatedRig(rig)
        self.simulated = simulated
        self.world = BusSimulation(
            rig,
            simulated,
            lock_step=lock_step,
            now_ns=0,
            send_frame=lambda raw, origin: self.sent.append((raw, origin)),
            write_bytes=self._write,
            interrupt_line=self.cuts.append,
            reconnect_line=self.mended.append,
            log=log,
        )
        self.drive = Drive(self.world.step, self.world.can_sender("drive"))
        self.drive.rig_periods = lambda: self.world.rig_periods
        self.world.add_node("drive", self.drive)
        if serial:
            self.sensor = SerialSensor(self.world.serial_writer(), simulated.records_per_period)
            self.world.add_serial_device(self.sensor)
        else:
            self.sensor = Sensor(self.world.can_sender("sensor"))
            self.world.add_node("sensor", self.sensor)

    def _write(self, data):
        self.written += data

    def sync(self, *ticks):
        """Receive a SYNC at each of these ticks, fractions allowed."""
        for tick in ticks:
            self.world.receive_frames([SYNC], "host", round(tick * PERIOD_NS))

    def from_nodes(self):
        """Return the frames of the nodes, as (identifier, data)."""
        return [unpack(raw) for raw, origin in self.sent if origin is None]

    def answers(self):
        """Return the answers of the drive."""
        return [
            struct.unpack("<I", data)[0] for can_id, data in self.from_nodes() if can_id == 0x181
        ]


def unpack(raw):
    can_id, length, data = struct.unpack("=IB3x8s", raw)
    return can_id, data[:length]


class Events:
    """Records log entries, with the simulated time that the world sets."""

    def __init__(self):
        self.time_s = 0.0
        self.entries = []

    def __call__(self, device, what, **values):
        self.entries.append((round(self.time_s, 6), device, what, values))

    def of(self, what):
        return [entry for entry in self.entries if entry[2] == what]


@pytest.fixture
def sim_rig():
    return load_shipped("sim").rig


@pytest.fixture
def make_world(sim_rig):
    def make(*, lock_step=False, serial=False):
        rig = sim_rig
        if serial:
            rig = load_shipped("antenna_serial").rig
        return Recording(rig, lock_step=lock_step, serial=serial, log=Events())

    return make
