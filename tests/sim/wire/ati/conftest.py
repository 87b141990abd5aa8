"""The simulated ATI sensors under wrenches of the test's choice, and hosts written by hand."""

import struct
from collections import deque
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.devices.parameters import AtiCan, AtiSerial
from rigd.sim.wire._ati_can_node import AtiCanNode
from rigd.sim.wire._ati_serial_device import AtiSerialDevice

RECORDS_PER_PERIOD = 7


def crc16(frame: bytes) -> int:
    """CRC of Modbus RTU, bit by bit."""
    crc = 0xFFFF
    for byte in frame:
        crc ^= byte
        for _ in range(8):
            odd = crc & 1
            crc >>= 1
            if odd:
                crc ^= 0xA001
    return crc


def framed(body: bytes) -> bytes:
    return body + struct.pack("<H", crc16(body))


class Load:
    """Replaces the simulated rig: the sensor measures the load set by the test."""

    def __init__(self) -> None:
        self.wrench = (0.0,) * 6
        self.measured = 0
        self.records_per_period = RECORDS_PER_PERIOD
        self.sensor = SimpleNamespace(measure=self._measure, records=deque(maxlen=13))

    def advance(self, *wrenches) -> None:
        """One period: its records, or the present wrench in each of them."""
        self.sensor.records.extend(wrenches or [self.wrench] * RECORDS_PER_PERIOD)

    def _measure(self):
        self.measured += 1
        return self.wrench


@dataclass
class Logged:
    entries: list = field(default_factory=list)

    def __call__(self, source, what, **values):
        self.entries.append((source, what, values))

    @property
    def what(self):
        return [what for _, what, _ in self.entries]


class CanHost:
    """Speaks NETCANOEM to a node, from the table of the protocol."""

    def __init__(self, rig, load, **options) -> None:
        self.log = Logged()
        self.base = rig.ati_can.base_id
        self.frames = []
        self.node = AtiCanNode(
            rig, load, lambda can_id, data: self.frames.append((can_id, data)), self.log, **options
        )

    def request(self, opcode, data=b""):
        """Frames that came in answer, as (identifier, data)."""
        self.frames.clear()
        self.node.receive(self.base << 4 | opcode, data)
        return list(self.frames)

    def matrix(self):
        rows = []
        for axis in range(6):
            frames = self.request(0x2, bytes([axis]))
            assert [can_id & 0xF for can_id, _ in frames] == [2, 3, 4]
            rows.append([v for _, data in frames for v in struct.unpack(">ff", data)])
        return np.array(rows)

    def counts_per_unit(self):
        ((_, data),) = self.request(0x7)
        return struct.unpack(">II", data)

    def gauges(self):
        """Status, and gauges 0 to 5."""
        (first_id, first), (second_id, second) = self.request(0x0)
        assert (first_id, second_id) == (self.base << 4, self.base << 4 | 1)
        status, g0, g2, g4 = struct.unpack(">Hhhh", first)
        g1, g3, g5 = struct.unpack(">hhh", second)
        return status, np.array([g0, g1, g2, g3, g4, g5])


class SerialHost:
    """Speaks Modbus RTU to a device, from the table of the protocol."""

    def __init__(self, rig, load) -> None:
        self.log = Logged()
        self.writes = []
        self.device = AtiSerialDevice(rig, load, self.writes.append, self.log)

    def send(self, data):
        """Return the answer of the device."""
        self.writes.clear()
        self.device.receive(data)
        return b"".join(self.writes)

    def request(self, body):
        """Answer to a request, without address and checksum."""
        answer = self.send(framed(b"\x0a" + body))
        assert answer[:1] == b"\x0a"
        assert crc16(answer) == 0
        return answer[1:-2]

    def registers(self, first, count, function=3):
        answer = self.request(struct.pack(">BHH", function, first, count))
        assert answer[:2] == bytes([function, 2 * count])
        return list(struct.unpack(f">{count}H", answer[2:]))

    def write(self, first, values):
        data = struct.pack(f">{len(values)}H", *values)
        return self.request(struct.pack(">BHHB", 0x10, first, len(values), len(data)) + data)

    def load_gains(self, block=1):
        """The set-up before a stream."""
        assert self.request(b"\x6a\xaa") == b"\x6a\x01"
        at = 0xE3 + (block - 1) * 192
        assert self.write(0, self.registers(at + 121, 6)) == b"\x10\x00\x00\x00\x06"
        assert self.write(6, self.registers(at + 127, 6)) == b"\x10\x00\x06\x00\x06"
        assert self.request(b"\x6a\x18") == b"\x6a\x01"

    def calibration(self, block=1):
        """Matrix, and counts per N and per N·m."""
        at = 0xE3 + (block - 1) * 192
        words = self.registers(at, 64) + self.registers(at + 64, 64) + self.registers(at + 128, 41)
        data = struct.pack(">169H", *words)
        matrix = np.array(struct.unpack(">36f", data[64:208])).reshape(6, 6)
        return data, matrix, struct.unpack(">ii", data[234:242])

    def period(self):
        """Records of one period: gauges 0 to 5 (n, 6), and error bits."""
        self.writes.clear()
        self.device.emit()
        (written,) = self.writes
        records = [written[i : i + 13] for i in range(0, len(written), 13)]
        gauges, errors = [], []
        for record in records:
            assert len(record) == 13
            assert record[12] & 0x7F == sum(record[:12]) % 128
            g0, g2, g4, g1, g3, g5 = struct.unpack(">hhhhhh", record[:12])
            gauges.append([g0, g1, g2, g3, g4, g5])
            errors.append(record[12] >> 7)
        return np.array(gauges), errors


@pytest.fixture
def load():
    return Load()


@pytest.fixture(scope="session")
def rig():
    return replace(
        load_shipped("sim").rig,
        ati_can=AtiCan(base_id=0x11, calibration=3, serial_number="", saturation_counts=32000),
        ati_serial=AtiSerial(
            port="/dev/ttyUSB0",
            baud=1_250_000,
            stream_hz=7000.0,
            filter="triangle",
            calibration=2,
            serial_number="",
            saturation_counts=32000,
        ),
    )


@pytest.fixture
def can_host(rig, load):
    """Its calibration is selected already."""
    host = CanHost(rig, load)
    assert host.request(0x6, b"\x03") == [(0x116, b"\x03")]
    return host


@pytest.fixture
def make_can_host(load, rig):
    def make(simulated=load, *, serial_number="", sensor=rig.sensor, **options):
        settings = replace(rig.ati_can, serial_number=serial_number)
        return CanHost(replace(rig, ati_can=settings, sensor=sensor), simulated, **options)

    return make


@pytest.fixture
def serial_host(rig, load):
    return SerialHost(rig, load)


@pytest.fixture
def make_serial_host(load, rig):
    def make(simulated=load, **settings):
        return SerialHost(replace(rig, ati_serial=replace(rig.ati_serial, **settings)), simulated)

    return make


@pytest.fixture
def check_crc():
    return crc16


@pytest.fixture
def with_crc():
    return framed
