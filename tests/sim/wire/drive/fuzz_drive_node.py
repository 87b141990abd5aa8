"""Random and mutated frames at a drive node: nothing may raise, no torque may leave its limits.

The suite runs a few thousand; a long run is ``python tests/sim/wire/drive/fuzz_drive_node.py N``.
"""

import random
import struct
import sys
import time
from collections import Counter
from dataclasses import replace

from rigd.devices.parameters import RigParameters, ServoDrive
from rigd.profile import load_profile
from rigd.sim import SimulatedRig
from rigd.sim.wire._drive_node import DriveNode

NODE = 5
INTERESTING = (0x000, 0x080, 0x085, 0x185, 0x205, 0x305, 0x405, 0x505, 0x585, 0x605, 0x705, 0x764)
INDICES = (
    *(0x1000, 0x1001, 0x1003, 0x1005, 0x1006, 0x1008, 0x1014, 0x1016, 0x1017, 0x1018, 0x1019),
    *(0x1029, 0x1400, 0x1401, 0x1403, 0x1600, 0x1601, 0x1800, 0x1801, 0x1A00, 0x1A01, 0x6007),
    *(0x603F, 0x6040, 0x6041, 0x605A, 0x605E, 0x6060, 0x6064, 0x6071, 0x6072, 0x6076, 0x6077),
    *(0x6080, 0x60B2, 0x60C2, 0x60E0, 0x60E1, 0x6502),
)
BRING_UP = [
    (0x000, "81 05"),
    (0x605, "23 00 14 01 05 02 00 80"),
    (0x605, "2f 00 14 02 01 00 00 00"),
    (0x605, "2f 00 16 00 00 00 00 00"),
    (0x605, "23 00 16 01 10 00 40 60"),
    (0x605, "23 00 16 02 10 00 71 60"),
    (0x605, "2f 00 16 00 02 00 00 00"),
    (0x605, "23 00 14 01 05 02 00 00"),
    (0x605, "2f 60 60 00 0a 00 00 00"),
    (0x605, "23 16 10 01 32 00 64 00"),
    (0x000, "01 05"),
    (0x764, "05"),
    (0x205, "00 00 00 00"),
    (0x080, ""),
    (0x205, "80 00 00 00"),
    (0x080, ""),
    (0x205, "06 00 00 00"),
    (0x080, ""),
    (0x205, "07 00 00 00"),
    (0x080, ""),
    (0x205, "0f 00 00 00"),
    (0x080, ""),
    (0x205, "0f 00 bc 02"),
    (0x080, ""),
    (0x080, ""),
]


def fuzzed_rig() -> RigParameters:
    drive = ServoDrive(
        NODE, 0, 0, -1, 100.0, 1e-5, "at_sync", 0.02, 0.05, 0.02, 0.05, 100, 3, 1, 1.0
    )
    return replace(load_profile("sim").rig, cia402=drive)


def frames(generator):
    """Random frames, and mutations of those that bring the drive into operation."""
    while True:
        for can_id, text in BRING_UP:
            yield can_id, bytes.fromhex(text)
        # In the milder half of the batches nothing but a controlword ends operation.
        mildest, wildest = generator.choice(((0.0, 1.0), (0.4, 0.8)))
        for _ in range(generator.randrange(200)):
            kind = generator.uniform(mildest, wildest)
            if kind < 0.2:
                yield generator.randrange(0x800), generator.randbytes(generator.randrange(9))
            elif kind < 0.4:
                yield generator.choice(INTERESTING), generator.randbytes(generator.randrange(9))
            elif kind < 0.6:
                head = struct.pack(
                    "<BHB",
                    generator.choice((0x20, 0x21, 0x22, 0x23, 0x27, 0x2B, 0x2F, 0x40, 0xA0, 0xC0)),
                    generator.choice(INDICES),
                    generator.randrange(7),
                )
                yield 0x605, head + generator.randbytes(4)
            elif kind < 0.7:
                yield 0x080, b""
            elif kind < 0.8:
                word = generator.choice((0x06, 0x07, *[0x0F] * 12, 0x10F, 0x80, 0x02, 0x02))
                yield 0x205, struct.pack("<Hh", word, generator.randint(-32768, 32767))
            else:
                can_id, text = generator.choice(BRING_UP)
                data = bytearray.fromhex(text)
                change = generator.randrange(4)
                if change == 0 and data:
                    data[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
                elif change == 1:
                    del data[generator.randrange(len(data) + 1) :]
                elif change == 2:
                    data = (data + generator.randbytes(8))[: generator.randrange(9)]
                else:
                    can_id ^= 1 << generator.randrange(11)
                yield can_id, bytes(data)


def fuzz(count: int, seed: int) -> Counter:
    """Feed a node; return how often each state was entered, and frames that came back."""
    generator = random.Random(seed)
    rig = fuzzed_rig()
    simulated = SimulatedRig(rig)
    plant = simulated.plant
    seen: Counter = Counter()
    logged = {"torque_nm": 0.0, "enabled": False}

    def log(source, what, **values):
        if what == "torque":
            logged.update(values)
        elif what == "state":
            seen[values["state"]] += 1

    def send(can_id, data):
        seen["frames sent"] += 1
        assert 0 < can_id < 0x800
        assert len(data) <= 8

    node = DriveNode(rig, simulated, lambda: plant.advance(1), send, log)
    now_s = 0.0
    limit_nm = rig.motor.peak_torque_nm * (1 + 1e-12)
    source = frames(generator)
    for _ in range(count):
        if generator.random() < 0.3:
            now_s += generator.choice((*[1e-3] * 100, 0.02, 0.2))
            node.tick(now_s)
        if generator.random() < 0.0005:
            node.frozen = not node.frozen
            node.angle_offset_counts = generator.randint(-(1 << 32), 1 << 32)
        elif node.frozen and generator.random() < 0.01:
            node.frozen = False
        if generator.random() < 0.001:
            node.emergency(generator.randrange(0x10000), generator.randrange(256), b"\x01\x02")
        can_id, data = next(source)
        node.receive(can_id, data)
        torque_nm = plant._torque_nm
        assert -limit_nm <= torque_nm <= limit_nm
        # The log agrees with the plant.
        assert plant.enabled == logged["enabled"]
        assert torque_nm == logged["torque_nm"]
        assert plant.enabled or torque_nm == 0.0
        seen["frames"] += 1
        seen["torques"] += torque_nm != 0.0
    return seen


if __name__ == "__main__":
    started = time.perf_counter()
    total: Counter = Counter()
    for part in range(10):
        total += fuzz(int(sys.argv[1]) // 10, seed=part)
    sys.stdout.write(f"{time.perf_counter() - started:.0f} s\n")
    for name, number in total.most_common():
        sys.stdout.write(f"{number:10d}  {name}\n")
