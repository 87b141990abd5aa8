"""Random and mutated frames at the driver: python fuzz_cia402.py FRAMES.

The handlers accept any frame, and the driver raises only ``DeviceError``.
"""

import random
import struct
import sys
import time

from rigd.devices.canbus import CanExchange
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.cia402._node import Node
from rigd.devices.contracts import DeviceError

NODE = 5
IDS = (0x185, 0x085, 0x705, 0x585)
GOOD = {
    0x185: bytes.fromhex("5002E80300000000"),
    0x085: bytes.fromhex("0000000000000000"),
    0x705: b"\x05",
    0x585: bytes.fromhex("4F6160000A000000"),
}


class FuzzPort:
    """Answers every SYNC with frames, some of them right, and takes whatever is sent."""

    name = "fuzz"

    def __init__(self, seed):
        self._random = random.Random(seed)
        self.queue = []
        self.made = 0
        self.sent = 0

    def send(self, frame):
        self.sent += 1
        if frame[:4] == b"\x80\0\0\0":
            self.queue += [self._frame() for _ in range(self._random.randrange(4))]

    def receive(self):
        return self.queue.pop(0) if self.queue else None

    def wait(self, timeout_s):
        pass

    def accept(self, can_ids):
        pass

    def close(self):
        pass

    def _frame(self):
        self.made += 1
        draw = self._random
        can_id = draw.choice(IDS)
        kind = draw.random()
        data = bytearray(GOOD[can_id])
        if kind < 0.2:
            data = bytearray(draw.randbytes(draw.randrange(9)))
        elif kind < 0.7:
            for _ in range(draw.randrange(1, 4)):
                data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        elif kind < 0.8:
            data = data[: draw.randrange(len(data) + 1)]
        length = len(data)
        if draw.random() < 0.05:
            length = draw.randrange(256)
        if draw.random() < 0.02:
            can_id |= draw.choice((0x80000000, 0x40000000, 0x20000000, 0x200))
            # Not a bus that is off: that would end every later tick at once.
            data = bytearray(8)
        return struct.pack("=IB3x8s", can_id & ~0x60 if can_id >> 29 == 1 else can_id, length, data)


def connected(rig, seed):
    """A driver after its set-up, on a port that fuzzes."""
    port = FuzzPort(seed)
    exchange = CanExchange(port)
    drive = Cia402Drive(rig, None)
    drive._subscribe(exchange)
    drive._node = Node(rig, exchange, drive._frames, drive._inbox)
    drive._inbox.must_stay_operational = True
    return drive, port


def fuzz(rig, frames, seed=1):
    """Return how often the driver ended a session."""
    drive, port = connected(rig, seed)
    tick = ends = 0
    chooser = random.Random(seed + 1)
    while port.made < frames:
        tick += 1
        try:
            drive.latch(tick * 1_000_000)
            angle = drive.read_angle()
            assert isinstance(angle, float)
            drive.command(chooser.uniform(-2, 2))
            if chooser.random() < 0.01:
                drive.enable()
        except DeviceError as error:
            assert str(error)
            ends += 1
            drive.disable()
            assert not drive._enabled
            # As after the operator's reset.
            drive._inbox.clear()
            drive._inbox.must_stay_operational = drive._inbox.heartbeat_received = True
            drive._may_be_on = False
    drive.disable()
    return ends


def main():
    from dataclasses import replace

    from rigd.devices.parameters import Acquisition, CanBus, ServoDrive
    from rigd.profile import load_profile

    settings = ServoDrive(
        NODE, 0, 0, 1, 100.0, 0.0, "at_sync", 0.02, 0.05, 0.02, 0.05, 100, 2, 0, 0.01
    )
    rig = replace(
        load_profile("sim").rig,
        can=CanBus("socketcan", "can0", 1_000_000),
        acquisition=Acquisition("same_tick", 1.0),
        cia402=settings,
    )
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    started = time.monotonic()
    ends = fuzz(rig, frames)
    print(f"{frames} frames, {ends} sessions ended, {time.monotonic() - started:.1f} s")  # noqa: T201


if __name__ == "__main__":
    main()
