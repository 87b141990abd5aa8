"""Noise against the simulated ATI sensors: python tests/sim/wire/ati/fuzz_ati_nodes.py N [SEED].

No input may raise, and the sensors must work afterwards as before.
"""

import struct
import sys
from collections import deque
from dataclasses import replace
from random import Random
from types import SimpleNamespace

from rigd.devices.parameters import AtiCan, AtiSerial
from rigd.profile import load_profile
from rigd.sim.wire._ati_can_node import AtiCanNode
from rigd.sim.wire._ati_serial_device import AtiSerialDevice

BASE = 0x11
START = bytes.fromhex("0A4655A39D")
READ_STATUS = bytes.fromhex("0A03001D00011577")
SEEDS = [
    START,
    READ_STATUS,
    bytes.fromhex("0A6AAAFF1D"),
    bytes.fromhex("0A6A187F68"),
    bytes.fromhex("0A0400270006C178"),
    bytes.fromhex("0A0300E30040B4B7"),
]


def simulated_rig():
    wrench = (1.0, -2.0, 3.0, 0.1, -0.2, 0.3)
    sensor = SimpleNamespace(measure=lambda: wrench, records=deque([wrench] * 13, maxlen=13))
    return SimpleNamespace(sensor=sensor, records_per_period=7)


def rig():
    return replace(
        load_profile("sim").rig,
        ati_can=AtiCan(BASE, 0, "", 32000),
        ati_serial=AtiSerial("/dev/ttyUSB0", 1_250_000, 7000.0, "mean", 1, "", 32000),
    )


def with_checksum(body):
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 * (crc & 1)
    return body + struct.pack("<H", crc)


def damaged(random):
    """A known frame, unchanged or with a byte changed, lost or doubled."""
    frame = bytearray(random.choice(SEEDS))
    at = random.randrange(len(frame))
    match random.randrange(4):
        case 0:
            frame[at] = random.randrange(256)
        case 1:
            del frame[at]
        case 2:
            frame.insert(at, frame[at])
    return bytes(frame)


def sound(random):
    """Address, any function, any content, and a valid checksum."""
    function = random.choice([3, 4, 0x10, 0x46, 0x6A, random.randrange(256)])
    if function == 0x10:
        data = random.randbytes(random.randrange(30))
        head = struct.pack(
            ">HHB", random.choice([0, 6, 12, 30, 31, 999]), random.randrange(20), len(data)
        )
        return with_checksum(bytes([10, function]) + head + data)
    if function in (3, 4):
        return with_checksum(
            struct.pack(">BBHH", 10, function, random.randrange(4000), random.randrange(140))
        )
    return with_checksum(bytes([10, function]) + random.randbytes(random.randrange(12)))


def chunk(random):
    """Return bytes that arrive at once."""
    kind = random.randrange(4)
    if kind == 0:
        return random.randbytes(random.randrange(40))
    if kind == 1:
        return damaged(random)
    if kind == 2:
        return sound(random)
    return (damaged(random) + sound(random))[: random.randrange(1, 20)]


def fuzz_serial(n, seed):
    random = Random(seed)
    written = []
    device = AtiSerialDevice(rig(), simulated_rig(), written.append, lambda *_, **__: None)
    for step in range(n):
        device.receive(chunk(random))
        if step % 8 == 0:
            device.tick(0.001 * step)
            device.emit()
        if step % 64 == 0:
            device.receive(bytes(14))
            device.tick(0.001 * step + 1000.0 * step)
            device.tick(0.001 * step + 1000.0 * step + 1.0)
            device.status_bits = 0
            written.clear()
            device.receive(READ_STATUS)
            assert written == [with_checksum(bytes.fromhex("0A03020000"))], (step, written)
        assert len(written) < 1000
    return device


def fuzz_can(n, seed):
    random = Random(seed)
    sent = []
    node = AtiCanNode(
        rig(), simulated_rig(), lambda *frame: sent.append(frame), lambda *_, **__: None
    )
    for _ in range(n):
        sent.clear()
        opcode = random.randrange(16)
        node.receive(BASE << 4 | opcode, random.randbytes(random.randrange(9)))
        node.receive(random.getrandbits(32), random.randbytes(random.randrange(9)))
        assert len(sent) <= 3
        assert all(can_id <= 0x7FF and len(data) <= 8 for can_id, data in sent)
        if opcode == 0xD:
            for base in range(0x80):
                node.receive(base << 4 | 0xD, bytes([BASE]))
    sent.clear()
    node.receive(BASE << 4 | 0xF, b"")
    assert sent == [(BASE << 4 | 0xF, bytes.fromhex("03080002"))]


def fuzz(n, seed=1):
    fuzz_can(n // 2, seed)
    fuzz_serial(n - n // 2, seed)


if __name__ == "__main__":
    fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
