"""Feed both drivers rubbish: ``python tests/devices/ati/fuzz_ati.py 1000000``.

Each function handles `n` chunks or frames, counts the results, and fails if a driver raises
anything but its own errors or delivers a value that no sensor sent.
"""

import random
import struct
import sys
import time
from dataclasses import replace

from fakes_ati import (
    BASE,
    FakeBus,
    FakeLink,
    FakeNetcanoem,
    crc_bitwise,
    frame_of,
    record_of,
)

from rigd.devices.ati import AtiCanSensor
from rigd.devices.ati import _serial_protocol as protocol
from rigd.devices.contracts import DeviceError
from rigd.profile import load_profile


def noisy_records(rng, count):
    """Records of a drifting load, with the noise of a real sensor."""
    levels = [rng.randint(-8000, 8000) for _ in range(6)]
    records = []
    for _ in range(count):
        levels = [max(-30000, min(30000, level + rng.randint(-40, 40))) for level in levels]
        records.append(record_of([level + rng.randint(-6, 6) for level in levels]))
    return records


def split(data):
    """Cut bytes into records."""
    size = protocol.RECORD_SIZE
    return [data[i : i + size] for i in range(0, len(data), size)]


def disturb(rng, data):
    """Damage, drop or insert a few bytes; return the result and the kind."""
    at = rng.randrange(len(data) - 40)
    kind = rng.choice(("flip", "drop", "insert", "noise"))
    if kind == "flip":
        data[at] ^= rng.randint(1, 127)
    elif kind == "drop":
        del data[at : at + rng.randint(1, 30)]
    elif kind == "insert":
        data[at:at] = rng.randbytes(rng.randint(1, 30))
    else:
        data[at : at + 20] = rng.randbytes(20)
    return kind


def fuzz_stream(n, seed):
    """Feed a disturbed stream in `n` chunks; every value delivered in sync must be a sent one."""
    rng = random.Random(seed)
    counts = dict.fromkeys(("chunks", "sent", "delivered", "wrong", "disturbed"), 0)
    stream = protocol.RecordStream()
    stream.start(starts_at_record=True)
    while counts["chunks"] < n:
        records = noisy_records(rng, 400)
        data = bytearray(b"".join(records))
        for _ in range(rng.randint(0, 2)):
            disturb(rng, data)
            counts["disturbed"] += 1
        # So that batches are independent: a sound end, long enough to synchronise again.
        tail = noisy_records(rng, 4 * protocol.RECORDS_TO_SYNCHRONISE)
        data += b"".join(tail)
        counts["sent"] += len(records) + len(tail)
        delivered = []
        at = 0
        while at < len(data):
            size = rng.choice((1, 5, 13, 64, 91, 300))
            found = stream.feed(bytes(data[at : at + size]))
            assert len(found) % protocol.RECORD_SIZE == 0
            delivered += [
                found[i : i + protocol.RECORD_SIZE]
                for i in range(0, len(found), protocol.RECORD_SIZE)
            ]
            at += size
            counts["chunks"] += 1
        counts["delivered"] += len(delivered)
        known = set(records) | set(tail)
        wrong = [record for record in delivered if record not in known]
        # One damaged record in 128 has a sum that fits by chance, and passes as good.
        counts["wrong"] += len(wrong)
        assert len(wrong) <= 3, wrong
        assert (
            delivered[-protocol.RECORDS_TO_SYNCHRONISE :]
            == tail[-protocol.RECORDS_TO_SYNCHRONISE :]
        )
        assert stream.synchronised
    return counts


def fuzz_rubbish_stream(n, seed):
    """Feed bytes without any meaning: nothing is raised, and the memory does not grow."""
    rng = random.Random(seed)
    stream = protocol.RecordStream()
    for _ in range(n):
        stream.feed(rng.randbytes(rng.choice((1, 13, 40, 91))))
        assert (
            stream.pending_byte_count
            <= (protocol.RECORDS_TO_SYNCHRONISE + 2) * protocol.RECORD_SIZE
        )
    return {"chunks": n, "records": stream.records}


class CountingSensor(FakeNetcanoem):
    """Gauges hold the number of the reading, so that a wrong pairing shows."""

    def __init__(self):
        super().__init__()
        one = [[float(axis == gauge) * 1e6 for gauge in range(6)] for axis in range(6)]
        self.matrix = tuple(map(tuple, one))
        self.counts = (1_000_000, 1_000_000)
        self.polls = 0

    def answer(self, frame):
        if frame[:4] == struct.pack("=I", self.base << 4):
            self.polls += 1
            self.gauges = (self.polls % 30000,) * 6
        return super().answer(frame)


def fuzz_can(n, seed, mode="same_tick"):
    """Run `n` ticks with frames lost, late by up to two periods, cut, and rubbish between."""
    rng = random.Random(seed)
    rig = load_profile("antenna_can").rig
    rig = replace(
        rig,
        ati_can=replace(rig.ati_can, base_id=BASE, calibration=1, serial_number=""),
        acquisition=replace(rig.acquisition, mode=mode, deadline_us=1.0),
    )
    fake = CountingSensor()
    bus = FakeBus(fake.answer)
    bus.wait = lambda timeout_s: None
    sensor = AtiCanSensor(rig, FakeLink(bus))
    sensor.connect()
    late, later = [], []
    before_last = fresh = stale = 0

    def answer(frame):
        replies = fake.answer(frame)
        fate = rng.random()
        if fate < 0.1:
            replies = []
        elif fate < 0.2:
            del replies[rng.randrange(2)]
        elif fate < 0.3:
            late.extend(replies)
            replies = []
        elif fate < 0.35:
            late.append(replies.pop())
        elif fate < 0.4:
            later.extend(replies[rng.randrange(2) :])
            replies = replies[: 2 - len(later)]
        elif fate < 0.45:
            replies = [reply[:4] + bytes((rng.randint(0, 8),)) + reply[5:] for reply in replies]
        # Other frames than half readings of the sensor may come anywhere between.
        for _ in range(rng.choice((0, 0, 1, 3))):
            can_id = rng.choice(
                (BASE << 4 | rng.randint(2, 15), rng.randrange(0x800), 0x80, 0x20000004)
            )
            if can_id & ~1 != BASE << 4:
                rubbish = frame_of(can_id, rng.randbytes(rng.randint(0, 8)))
                if can_id == 0x20000004:
                    rubbish = frame_of(can_id, bytes(8))
                replies.insert(rng.randint(0, len(replies)), rubbish)
        return replies

    bus.answer = answer
    for _ in range(n):
        polls_before = fake.polls
        overdue, later[:] = list(later), []
        sensor.request(0)
        # Late by more than a period: it comes into the next tick.
        bus.queue.extend(overdue)
        wrench = sensor.read_wrench()
        # Late by less: here before the next request.
        bus.queue.extend(late)
        late.clear()
        if sensor.wrench_stale:
            stale += 1
        else:
            fresh += 1
            wanted = fake.polls if mode == "same_tick" else before_last
            assert fake.polls > polls_before
            assert wrench == (float(wanted % 30000),) * 6, (wrench, wanted)
        before_last = fake.polls
    assert fresh > 0.2 * n
    return {"ticks": n, "fresh": fresh, "stale": stale, "lost": sensor.polls.lost_reply_count,
            "late": sensor.late_replies}  # fmt: skip


def fuzz_can_setup(n, seed):
    """Connect to boxes whose replies are at random; return or DeviceError, nothing else."""
    rng = random.Random(seed)
    rig = load_profile("antenna_can").rig
    rig = replace(rig, ati_can=replace(rig.ati_can, base_id=BASE, calibration=1, serial_number=""))
    frames = connected = 0
    while frames < n:
        fake = FakeNetcanoem()
        rate = rng.choice((0.0, 0.01, 0.1))

        def answer(frame, fake=fake, rate=rate):
            for reply in fake.answer(frame):
                length = rng.randint(0, 8) if rng.random() < rate else reply[4]
                data = rng.randbytes(8) if rng.random() < rate else reply[8:]
                yield reply[:4] + bytes((length,)) + reply[5:8] + data

        bus = FakeBus(answer)
        sensor = AtiCanSensor(rig, FakeLink(bus))
        try:
            sensor.connect()
            connected += 1
        except DeviceError:
            pass
        sensor.close()
        frames += len(bus.sent)
    return {"requests": frames, "connected": connected}


def fuzz_modbus(n, seed):
    """Check replies with damage, and replies without any meaning."""
    rng = random.Random(seed)
    request = protocol.read_registers(0xE3, 8)
    body = bytes((0x0A, 3, 16)) + rng.randbytes(16)
    sound = body + crc_bitwise(body)
    taken = 0
    for i in range(n):
        reply = bytearray(sound if i % 2 else rng.randbytes(rng.randint(0, 30)))
        for _ in range(rng.randint(0, 3)):
            if reply:
                reply[rng.randrange(len(reply))] = rng.randrange(256)
        if rng.random() < 0.2:
            del reply[rng.randrange(len(reply) + 1) :]
        try:
            content = protocol.reply_content(request, bytes(reply))
        except (protocol.InvalidReplyError, protocol.ModbusExceptionError):
            content = None
        if content is not None:
            taken += 1
            # A checksum of 16 bits lets one damaged reply in 65536 pass.
            assert len(content) == 16
    return {"replies": n, "taken": taken}


PARTS = {
    "stream, disturbed": (0.30, fuzz_stream),
    "stream, rubbish": (0.15, fuzz_rubbish_stream),
    "CAN, same tick": (0.15, fuzz_can),
    "CAN, previous tick": (0.15, lambda n, seed: fuzz_can(n, seed, "previous_tick")),
    "CAN set-up": (0.05, fuzz_can_setup),
    "Modbus": (0.20, fuzz_modbus),
}


def run(total, seed):
    """Distribute `total` over all parts; yield the result of each."""
    for name, (part, function) in PARTS.items():
        yield name, function(int(part * total), seed)


if __name__ == "__main__":
    total = int(sys.argv[1])
    begin = time.monotonic()
    for name, counts in run(total, seed=total):
        sys.stdout.write(f"{name}: {counts}\n")
    sys.stdout.write(f"{total} in {time.monotonic() - begin:.0f} s\n")
