"""Fakes of both ATI sensors, written with struct: nothing here uses the drivers' codecs.

Sources: devices.md 1.1 (NETCANOEM) and 2.1 (Digital F/T).
"""

import fcntl
import os
import select
import struct
import termios
import threading
import time
import tty
from collections import deque

from rigd.devices.canbus import CanExchange

BASE = 0x68
GAUGES = (100, -2000, 300, 4000, -5, 6000)
MATRIX = tuple(
    tuple(
        0.5 * (7 * axis + gauge + 1) * (-1) ** (axis + gauge) + 100.0 * (axis == gauge)
        for gauge in range(6)
    )
    for axis in range(6)
)


def frame_of(can_id, data=b""):
    return struct.pack("=IB3x8s", can_id, len(data), data)


class FakeNetcanoem:
    """Answers every request; the answers can be changed."""

    def __init__(self, base=BASE):
        self.base = base
        self.matrix = MATRIX
        self.serial_number = b"FT12345\0"
        self.firmware = (3, 8, 2)
        self.counts = (1_000_000, 2_000_000)
        self.units = (2, 3)
        self.calibrations = {0, 1, 2}
        self.active = 0
        self.status = 0
        self.gauges = GAUGES
        self.requests = []
        self.silent_to = set()
        self.lose_once = set()
        self.lengthen = set()

    def answer(self, frame):
        can_id, length = struct.unpack_from("=IB", frame)
        data = frame[8 : 8 + length]
        opcode = can_id & 0xF
        if can_id >> 4 != self.base or opcode in self.silent_to:
            return []
        self.requests.append((opcode, data))
        replies = self._replies(opcode, data)
        if opcode in self.lengthen:
            replies = [(op, content[:-1]) for op, content in replies]
        frames = [frame_of(self.base << 4 | op, content) for op, content in replies]
        if opcode in self.lose_once:
            self.lose_once.discard(opcode)
            return frames[:-1]
        return frames

    def _replies(self, opcode, data):
        g = self.gauges
        if opcode == 0:
            return [
                (0, struct.pack(">Hhhh", self.status, g[0], g[2], g[4])),
                (1, struct.pack(">hhh", g[1], g[3], g[5])),
            ]
        if opcode == 2:
            row = self.matrix[data[0]]
            return [(2 + i, struct.pack(">ff", *row[2 * i : 2 * i + 2])) for i in range(3)]
        if opcode == 5:
            return [(5, self.serial_number)]
        if opcode == 6:
            self.active = data[0] if data[0] in self.calibrations else self.active
            return [(6, bytes((self.active,)))]
        if opcode == 7:
            return [(7, struct.pack(">II", *self.counts))]
        if opcode == 8:
            return [(8, bytes(self.units))]
        if opcode == 0xF:
            return [(0xF, struct.pack(">BBH", *self.firmware))]
        return []


class FakeBus:
    """A CAN port whose other end is a function that returns the replies to a frame."""

    name = "fake0"

    def __init__(self, answer):
        self.answer = answer
        self.queue = deque()
        self.sent = []

    def send(self, frame):
        self.sent.append(frame)
        self.queue.extend(self.answer(frame))

    def receive(self):
        return self.queue.popleft() if self.queue else None

    def wait(self, timeout_s):
        if not self.queue:
            time.sleep(timeout_s)

    def accept(self, can_ids):
        self.accepted = set(can_ids)

    def close(self):
        pass


class LateBus(FakeBus):
    """A bus with delayed replies: by `late_s` of a request (opcode, data), else at once."""

    def __init__(self, answer):
        super().__init__(answer)
        self.late_s = {}

    def send(self, frame):
        can_id, length = struct.unpack_from("=IB", frame)
        late_s = self.late_s.get((can_id & 0xF, frame[8 : 8 + length]))
        arrives_s = time.monotonic() + (late_s.pop() if late_s else 0.0)
        for reply in self.answer(frame):  # one after the other, for any request
            last_s = self.queue[-1][0] if self.queue else 0.0
            self.queue.append((max(arrives_s, last_s + 2e-3), reply))

    def receive(self):
        if self.queue and self.queue[0][0] <= time.monotonic():
            return self.queue.popleft()[1]
        return None

    def wait(self, timeout_s):
        until_s = time.monotonic() + timeout_s
        if self.queue:
            until_s = min(until_s, self.queue[0][0])
        time.sleep(max(0.0, until_s - time.monotonic()))


class FakeLink:
    """Replaces the shared bus."""

    def __init__(self, bus):
        self.bus = bus
        self.users = 0
        self._exchange = CanExchange(bus)

    def open(self):
        self.users += 1
        return self._exchange

    def close(self):
        self.users -= 1


def crc_bitwise(data):
    """CRC-16/Modbus, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            lsb = crc & 1
            crc >>= 1
            if lsb:
                crc ^= 0xA001
    return struct.pack("<H", crc)


def record_of(gauges, *, error=False):
    g = gauges
    body = struct.pack(">6h", g[0], g[2], g[4], g[1], g[3], g[5])
    return body + bytes((sum(body) % 128 | (0x80 if error else 0),))


def calibration_registers(matrix=MATRIX, **changes):
    """The 169 registers of a calibration block."""
    fields = {
        "serial": b"FT12345",
        "part": b"SI-20-1",
        "family": b"DIG",
        "date": b"2021/03/04 12:00",
        "units": 0x0203,
        "ratings": (20.0, 20.0, 60.0, 1.0, 1.0, 1.0),
        "counts": (1_000_000, 2_000_000),
        "gains": (541, 550, 560, 570, 575, 579),
        "offsets": (31842, 32000, 32768, 33000, 34000, 34927),
    } | changes
    raw = b"".join(
        (
            struct.pack("8s32s4s20s", *(fields[k] for k in ("serial", "part", "family", "date"))),
            struct.pack(">36f", *(entry for row in matrix for entry in row)),
            struct.pack(">H6f", fields["units"], *fields["ratings"]),
            struct.pack(">ii", *fields["counts"]),
            struct.pack(">6H6H", *fields["gains"], *fields["offsets"]),
        )
    )
    raw = raw.ljust(2 * 169, b"\0")
    return list(struct.unpack(">169H", raw))


class FakeDigitalFt:
    """A sensor at one end of a pseudo-terminal, in its own thread."""

    def __init__(self, block=1):
        self.master, slave = os.openpty()
        tty.setraw(slave, termios.TCSANOW)
        self.port = os.ttyname(slave)
        self._slave = slave
        self._wake, self._ring = os.pipe()
        self.registers = [0] * 4096
        self.set_block(block, calibration_registers())
        self.first_records = [record_of(GAUGES)] * 20
        self.unlocked = False
        self.streaming = False
        self.log = []
        self.silent = False
        self.damage_next = 0
        self.refuse = {}
        self.start_reply = 1
        self.deaf_to_jam = False
        self.forgets_writes = False
        self.after_load = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def set_block(self, block, registers):
        first = 0xE3 + (block - 1) * 192
        self.registers[first : first + len(registers)] = registers

    @property
    def status(self):
        return self.registers[0x1D]

    @status.setter
    def status(self, word):
        self.registers[0x1D] = word

    def emit(self, data):
        """Send some bytes, and return once the other end could read them."""
        before = self._readable()
        os.write(self.master, data)
        patience = time.monotonic() + 5.0
        while self._readable() < before + len(data) and time.monotonic() < patience:
            time.sleep(1e-4)

    def _readable(self):
        count = fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4))
        return struct.unpack("=i", count)[0]

    def hang_up(self):
        """Disappear like an unplugged adapter."""
        self._stop()
        os.close(self._slave)
        os.close(self.master)
        self._slave = self.master = None

    def close(self):
        self._stop()
        for fd in (self.master, self._slave, self._wake, self._ring):
            if fd is not None:
                os.close(fd)

    def _stop(self):
        if self._thread.is_alive():
            os.write(self._ring, b"x")
            self._thread.join()

    def _serve(self):
        while True:
            readable, _, _ = select.select([self.master, self._wake], [], [])
            if self._wake in readable:
                return
            request = os.read(self.master, 256)
            if self.streaming:
                if len(request) >= 14 and not self.deaf_to_jam:
                    self.streaming = False
                    self.log.append("jam")
                elif self.deaf_to_jam:
                    os.write(self.master, record_of(GAUGES) * 10)
                continue
            if self.silent or crc_bitwise(request[:-2]) != request[-2:]:
                continue
            reply = self._answer(request)
            if reply is None:
                continue
            reply += crc_bitwise(reply)
            if self.damage_next:
                self.damage_next -= 1
                reply = bytes((reply[0] ^ 0x40,)) + reply[1:]
            if self.streaming:
                reply += b"".join(self.first_records)
            os.write(self.master, reply)

    def _answer(self, request):
        address, function = request[0], request[1]
        assert address == 0x0A
        self.log.append(request.hex(" "))
        if function in self.refuse:
            return bytes((0x0A, function | 0x80, self.refuse[function]))
        if function == 0x03:
            first, count = struct.unpack(">HH", request[2:6])
            assert 1 <= count <= 64
            return struct.pack(f">BBB{count}H", 0x0A, 3, 2 * count,
                               *self.registers[first : first + count])  # fmt: skip
        if function == 0x10:
            first, count, size = struct.unpack(">HHB", request[2:7])
            assert size == 2 * count == len(request) - 9
            if not self.unlocked:
                return bytes((0x0A, 0x90, 4))
            if not self.forgets_writes:
                self.registers[first : first + count] = struct.unpack(f">{count}H", request[7:-2])
            if self.after_load is not None:
                self.status = self.after_load
            return request[:6]
        if function == 0x6A:
            self.unlocked = request[2] == 0xAA
            return bytes((0x0A, 0x6A, 1))
        if function == 0x46 and request[2] == 0x55:
            self.streaming = self.start_reply == 1
            return bytes((0x0A, 0x46, self.start_reply))
        return bytes((0x0A, function | 0x80, 1))
