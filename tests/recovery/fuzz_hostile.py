"""Hostile session files: ``python tests/recovery/fuzz_hostile.py 1000 [SEED]``.

Sound sessions damaged at random, and files made to take memory, time or the operator's terminal.
Each is given to `rigd info`, `rigd recover` and `analyze`, and none may take more than 500 MB, 30 s
of a processor or 1 MB of output, or end in a traceback. A command runs in a child that is forked
when all is imported: as large as one that was started, and sooner at work.
"""

import contextlib
import os
import random
import re
import signal
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

from rigd.runtime.background import use_one_thread

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))  # as in pytest

MAGIC = b"\x89MCAP0\r\n"
MOST_MEGABYTES = 500
MOST_SECONDS = 30
MOST_PRINTED = 1_000_000
COMMANDS = ("info", "recover", "analyze")
_CONTROL = re.compile("[\x00-\x09\x0b\x0c\x0e-\x1f\x7f-\x9f]")
"""Characters that a terminal obeys; a line may end, and a progress bar go back."""
_PATIENCE_S = 600
"""After which a command counts as endless, even on a busy computer."""


def record(opcode, content):
    """Make a record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    """Make a string as in MCAP."""
    value = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(value)) + value


def mapping(values):
    """Make a map of strings."""
    return text(b"".join(text(key) + text(value) for key, value in values.items()))


def metadata(name, values):
    """Make a metadata record."""
    return record(12, text(name) + mapping(values))


def schema(number, name, data):
    """Make a schema of protobuf."""
    return record(3, struct.pack("<H", number) + text(name) + text("protobuf") + text(data))


def channel(number, topic, schema_number, encoding="protobuf"):
    """Make a channel without metadata."""
    head = struct.pack("<HH", number, schema_number)
    return record(4, head + text(topic) + text(encoding) + text(b""))


def message(number, content=b"", t_ns=0):
    """Make a message."""
    return record(5, struct.pack("<HIQQ", number, 0, t_ns, t_ns) + content)


def chunk(records, *, claimed=None, compression="lz4", crc=True):
    """Make a chunk of records."""
    pack = {"lz4": lz4.frame.compress, "zstd": zstandard.compress, "": bytes}[compression]
    packed = pack(records)
    size = len(records) if claimed is None else claimed
    head = struct.pack("<QQQI", 0, 0, size, zlib.crc32(records) if crc else 0) + text(compression)
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


SESSION = {
    "rate_hz": "1000",
    "beam_length_m": "0.98",
    "beam_density_kg_per_m": "0.0047",
    "beam_bending_stiffness_n_m2": "0.0903",
}


def session_file(*parts, session=SESSION, end=True):
    """Make a file of parts, with the schemas and channels of a session in front (1 and 2)."""
    from session_schemas import schemas

    declared = (
        schema(1, "rigd.Sample", schemas()["rigd.Sample"])
        + schema(2, "foxglove.Log", schemas()["foxglove.Log"])
        + channel(1, "/rig/sample", 1)
        + channel(2, "/rig/event", 2)
    )
    body = record(1, text("") + text("")) + metadata("session", session) + chunk(declared)
    tail = record(15, bytes(4)) + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC if end else b""
    return MAGIC + body + b"".join(parts) + tail


def sample_records(first, count, *, permuted=False):
    """Make message records of samples, as bytes; `permuted` puts the tick before the time."""
    from rigd.session.layout import SAMPLE_WIRE_DTYPE, encode_samples

    tick = first + np.arange(count)
    angle_rad = 0.02 * np.sin(0.05 * tick)
    samples = {
        "tick": tick,
        "t_ns": tick * 1_000_000,
        "angle_reference_rad": angle_rad,
        "angle_rad": angle_rad,
        "coupling_torque_nm": 0.1 * np.sin(0.05 * tick + 0.2),
    }
    size = SAMPLE_WIRE_DTYPE.itemsize
    rows = np.empty((count, 31 + size), np.uint8)
    rows[:, :31] = np.frombuffer(message(1, bytes(size))[:31], np.uint8)
    fields = np.frombuffer(encode_samples(samples), np.uint8).reshape(count, size)
    rows[:, 31:] = (
        np.concatenate([fields[:, 9:14], fields[:, :9], fields[:, 14:]], 1)
        if (permuted)
        else fields
    )
    return rows.tobytes()


def samples(count, *, permuted=False, block_size=20_000):
    """Make chunks of samples."""
    return b"".join(
        chunk(sample_records(first, min(block_size, count - first), permuted=permuted))
        for first in range(0, count, block_size)
    )


def event(message_text):
    """Make a message of the log."""
    from session_schemas import message_class

    log = message_class("foxglove.Log")
    return message(2, log(level=2, message=message_text, name="x").SerializeToString())


# Files that once failed, by their content; `scale` 1 is the original size.


def digits(rng, scale=1.0):
    """A number of ticks of thousands of digits."""
    count = max(round(scale * rng.choice((400, 5000, 1_000_000))), 30)
    return session_file(samples(2000), metadata("outcome", {"scheduled": "9" * count}))


def long_key(rng, scale=1.0):
    """One giant key and very many small ones."""
    keys = {"k" * round(20e6 * scale): "1"}
    keys |= {f"key{i}": str(rng.random()) for i in range(round(20_000 * scale))}
    return session_file(samples(2000), session={**SESSION, **keys})


def control_characters(rng, scale=1.0):
    """Sequences for a terminal wherever a file has text."""
    bad = "\x1b]0;owned\x07\x1b[31m\r\n\x9b\u202e\x00" * max(round(3 * scale), 1)
    return session_file(
        samples(2000),
        chunk(event(bad + "in the log")),
        metadata("outcome", {"outcome": bad, "reason": bad, f"recovered_{bad}": bad}),
        session={**SESSION, f"note{bad}": bad, "id": bad, "operator": bad * rng.randrange(1, 9)},
    )


def wide_chunks(rng, scale=1.0):
    """Chunks of 250 MB that hold a sample each; the rest is of another topic."""
    filler = message(3, bytes(round(5e6 * scale)))
    crc = rng.random() < 0.5
    parts = [
        chunk(
            (b"" if i else channel(3, "/other", 0)) + filler * 50 + sample_records(i, 1), crc=crc,
            compression=rng.choice(("lz4", "zstd")),
        )
        for i in range(8)
    ]  # fmt: skip
    return session_file(*parts)


def other_topic(rng, scale=1.0):
    """Chunks of 250 MB of another topic, with messages of any length."""
    filler = message(3, bytes(rng.choice((50, 3000, round(240e6 * scale)))))
    records = filler * max(round(250e6 * scale) // len(filler), 1)
    part = chunk(records)
    return session_file(chunk(channel(3, "/other", 0)), samples(2000), *[part] * 8)


def in_turn(rng, scale=1.0):
    """Two channels in turn, wanted or not: every message is a run of its own."""
    topic = rng.choice(("/other", "/rig/event", "/rig/sample", "/rig/control"))
    pair = message(3) + message(4, bytes(rng.randrange(3)))
    parts = [chunk(pair * round(1_000_000 * scale))] * 8
    declared = chunk(channel(3, topic, 1) + channel(4, "/another", 1))
    return session_file(declared, samples(2000), *parts)


def log_flood(rng, scale=1.0):
    """A few giant lines in the log, or very many."""
    if rng.random() < 0.5:
        lines = [event("x" * round(10e6 * scale))] * 20
    else:
        lines = [event("flood ü\x1b[2J" * rng.randrange(1, 60))] * round(300_000 * scale)
    parts = [chunk(b"".join(lines[i : i + 10_000])) for i in range(0, len(lines), 10_000)]
    return session_file(samples(2000), *parts)


def permuted(rng, scale=1.0):
    """Samples whose fields are in another order, and a tail that is missing at times."""
    end = rng.random() < 0.5
    return session_file(samples(round(2_000_000 * scale), permuted=True), end=end)


# Others, with random numbers.


def giant_claim(rng, scale=1.0):
    """A chunk that claims to be larger than it is."""
    compression = rng.choice(("lz4", "zstd", ""))
    claimed = rng.choice((1 << 28, 1 << 30, 1 << 63, rng.randrange(1 << 40)))
    part = chunk(bytes(round(1e6 * scale)), claimed=claimed, compression=compression)
    return session_file(samples(2000), part)


def many_channels(rng, scale=1.0):
    """As many channels as there are numbers, of one topic or of all."""
    topic = rng.choice(("/rig/sample", "/rig/event", "/t"))
    count = round(60_000 * scale)
    declared = b"".join(channel(i, topic, 1) for i in range(3, 3 + count))
    rows = b"".join(message(i, b"") for i in range(3, 3 + count))
    return session_file(chunk(declared), samples(2000), *[chunk(rows)] * rng.randrange(1, 40))


def deep_schema(rng, scale=1.0):
    """A schema of nested types, or of imports of imports, or of very much."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    kind = rng.choice(("nested", "imports", "wide"))
    if kind == "nested":
        inner = files.file.add(name="a", package="rigd").message_type.add(name="Sample")
        for _ in range(rng.randrange(5, 90)):
            inner = inner.nested_type.add(name="N")
    elif kind == "imports":
        for i in range(round(3000 * scale)):
            files.file.add(name=str(i), dependency=[str(i + 1)])
    else:
        wide = files.file.add(name="a", package="rigd").message_type.add(name="Sample")
        for i in range(round(100_000 * scale)):
            wide.field.add(name=f"f{i}", number=i + 1, type=1, label=1)
    declared = chunk(schema(9, "rigd.Sample", files.SerializeToString()))
    own = chunk(channel(3, "/rig/sample", 9) + message(3, bytes(rng.randrange(50))) * 100)
    return session_file(declared, own)


def many_keys(rng, scale=1.0):
    """Metadata of millions of tiny entries, in one record or in many."""
    entries = (text("") + text("")) * round(rng.choice((50_000, 3_000_000)) * scale)
    one = record(12, text("session") + text(entries))
    return session_file(samples(2000), *[one] * rng.randrange(1, 4))


def many_records(rng, scale=1.0):
    """Records without content, known or not, within chunks and without."""
    part = record(rng.choice((0x80, 7, 8, 14, 12, 5)), b"") * round(3_000_000 * scale)
    return session_file(samples(2000), rng.choice((chunk(part), part)))


def many_chunks(rng, scale=1.0):
    """Chunks with hardly any content."""
    part = chunk(sample_records(5000, 1)) if rng.random() < 0.5 else chunk(b"")
    return session_file(samples(2000), part * round(200_000 * scale))


def any_length(rng, scale=1.0):
    """Samples of nearly all different lengths, due to unknown fields."""
    whole = sample_records(0, 1)[31:]
    rows = [
        message(1, whole + b"\xa2\x01" + bytes([n]) + bytes(n))
        for n in (rng.randrange(120) for _ in range(3000))
    ]
    return session_file(chunk(b"".join(rows)) * round(rng.randrange(1, 100) * scale + 1))


def doubled(rng, scale=1.0):
    """Chunks that are repeated, or not in order."""
    parts = [chunk(sample_records(1000 * i, 1000)) for i in range(max(round(20 * scale), 4))]
    for _ in range(rng.randrange(1, 5)):
        parts.insert(rng.randrange(len(parts)), rng.choice(parts))
    if rng.random() < 0.3:
        rng.shuffle(parts)
    return session_file(*parts)


def odd_numbers(rng, scale=1.0):
    """Numbers in the metadata that no rig has."""
    odd = ("nan", "inf", "1e308", "-1", "1e-300", "9" * round(100_000 * scale + 5), "\u0663", "0x1")
    session = {**SESSION, rng.choice(list(SESSION)): rng.choice(odd)}
    session |= {"start_utc_ns": rng.choice(("1", "9" * 19, "9" * 30)), "start_hz": rng.choice(odd)}
    segments = {"sweep": rng.choice(("0,2000", "0," + "9" * 30, "5,1", "9" * 5000))}
    return session_file(samples(2000), metadata("segments", segments), session=session)


def attachments(rng, scale=1.0):
    """Files attached, large or many."""
    data = bytes(round(rng.choice((10, 30e6)) * scale))
    one = struct.pack("<QQ", 0, 0) + text("../../x\x1b") + text("a/b")
    one = record(9, one + struct.pack("<Q", len(data)) + data + bytes(4))
    return session_file(samples(2000), one * rng.randrange(1, 40))


LOST_ONCE = (
    digits, long_key, control_characters, wide_chunks, other_topic, in_turn, log_flood, permuted,
)  # fmt: skip
OTHERS = (
    giant_claim, many_channels, deep_schema, many_keys, many_records, many_chunks, any_length,
    doubled, odd_numbers, attachments,
)  # fmt: skip


def damaged(rng, scale=1.0):
    """A sound session cut off, flipped, smeared, with parts doubled, deleted or exchanged."""
    parts = [chunk(sample_records(250 * i, 250)) for i in range(max(round(40 * scale), 8))]
    data = bytearray(session_file(*parts, chunk(event("hello")), metadata("outcome", {"a": "b"})))
    for _ in range(rng.choice((1, 1, 1, 3))):
        at, size = rng.randrange(8, len(data)), rng.randrange(1, 600)
        kind = rng.randrange(8)
        if kind == 0:
            del data[at:]
        elif kind == 1:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            data[at : at + size] = rng.randbytes(size)
        elif kind == 3:
            data[at : at + size] = bytes(size)
        elif kind == 4:
            data[at:at] = data[at : at + size]
        elif kind == 5:
            del data[at : at + size]
        elif kind == 6:
            data[at : at + 8] = struct.pack("<Q", rng.choice((0, 1, 1 << 31, 1 << 62, 2**64 - 1)))
        else:
            data += rng.randbytes(size)
        if len(data) < 16:
            break
    return bytes(data)


@dataclass(frozen=True)
class Outcome:
    """Result and resources of a command."""

    case: str
    command: str
    code: int
    megabytes: float
    seconds: float
    """Processor time."""
    printed: int
    words: str
    """The end of what was printed."""

    def wrong(self):
        """Return the complaint, or ""."""
        found = ["control characters"] if _CONTROL.search(self.words) else []
        if self.code not in (0, 1, 2):
            found.append(f"ended with {self.code}")
        if "Traceback" in self.words:
            found.append("traceback")
        if self.megabytes > MOST_MEGABYTES:
            found.append(f"{self.megabytes:.0f} MB")
        if self.seconds > MOST_SECONDS:
            found.append(f"{self.seconds:.1f} s")
        if self.printed > MOST_PRINTED:
            found.append(f"{self.printed} bytes printed")
        return f"{self.case}: {self.command}: {', '.join(found)}\n{self.words}" if found else ""


def run_forked(action, output, interrupt_s=None):
    """Run something in a child; return its exit code, and its resources as wait4 reports them.

    It gets a SIGINT after so many seconds.
    """
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            os.dup2(output, 1)
            os.dup2(output, 2)
            code = action()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        except BaseException:
            os.write(2, traceback.format_exc().encode())
        finally:
            with contextlib.suppress(BaseException):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code or 0)
    began = time.monotonic()
    deadline = began + _PATIENCE_S
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), usage
        if interrupt_s is not None and time.monotonic() > began + interrupt_s:
            os.kill(child, signal.SIGINT)
            interrupt_s = None
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)


def command_action(command, path):
    """Return a function that runs a command on a file."""

    def action():
        folder = path.parent
        if command == "analyze":
            from analysis.cli.app import app

            arguments = [str(path), "--method", "welch", "--types", "III", "--report",
                         str(folder / "report")]  # fmt: skip
        else:
            from rigd.cli.app import app

            arguments = [command, str(path)]
        app(arguments)
        return 0

    return action


def check_file(make, case, folder, commands=COMMANDS):
    """Make a file, and run the commands on it; yield their results."""
    path = folder / "a.mcap"
    made = folder / "made"
    with made.open("wb") as log:
        code, _ = run_forked(lambda: path.write_bytes(make()) and 0, log.fileno())
    assert code == 0, made.read_text()
    for command in commands:
        printed = folder / f"{command}.txt"
        with printed.open("wb") as output:
            code, usage = run_forked(command_action(command, path), output.fileno())
        with printed.open("rb") as output:
            output.seek(max(printed.stat().st_size - 2000, 0))
            words = output.read().decode(errors="replace")
        yield Outcome(
            case, command, code, usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime,
            printed.stat().st_size, words,
        )  # fmt: skip


def cases(count, seed, scale=None):
    """Yield names and makers: half of them damaged, the rest made to be hostile, in turn."""
    kinds: tuple[Callable, ...] = (*LOST_ONCE, *OTHERS)
    for number in range(count):
        rng = random.Random(f"{seed}-{number}")
        kind = damaged if number % 2 else kinds[number // 2 % len(kinds)]
        size = scale if scale is not None else rng.choice((0.01,) * 5 + (0.1,) * 3 + (0.3, 1.0))
        name = f"{number} {kind.__name__} (scale {size})"
        yield name, lambda kind=kind, rng=rng, size=size: kind(rng, size)


def warm_up(commands=COMMANDS):
    """Run each command on a sound file, so that the imports are not repeated in each child."""
    use_one_thread()  # as the commands do themselves
    sys.stdout.flush()
    before = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with tempfile.TemporaryDirectory(prefix="rigd-hostile-") as folder:
        # Too short for `analyze`, which reports it once all is imported and the file is read.
        path = Path(folder) / "a.mcap"
        path.write_bytes(session_file(samples(2000)))
        # Not the streams of Python: a reference to one would be a reference to that of the warm-up.
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        try:
            for command in commands:
                with contextlib.suppress(SystemExit):
                    command_action(command, path)()
                sys.stdout.flush()
                sys.stderr.flush()
        finally:
            for number, descriptor in enumerate(before, 1):
                os.dup2(descriptor, number)
                os.close(descriptor)
            os.close(nowhere)


def fuzz(count, seed, scale=None, report=lambda outcome: None):
    """Try so many files; return the complaints."""
    warm_up()
    wrong = []
    for name, make in cases(count, seed, scale):
        with tempfile.TemporaryDirectory(prefix="rigd-hostile-") as folder:
            for outcome in check_file(make, name, Path(folder)):
                report(outcome)
                if outcome.wrong():
                    wrong.append(outcome.wrong())
    return wrong


def main():
    """Try them, and print the worst of each."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    worst: dict[tuple[str, str], Outcome] = {}

    def report(outcome):
        for what in ("megabytes", "seconds", "printed"):
            known = worst.get((outcome.command, what))
            if known is None or getattr(outcome, what) > getattr(known, what):
                worst[outcome.command, what] = outcome

    wrong = fuzz(count, seed, report=report)
    for (command, what), outcome in sorted(worst.items()):
        value = getattr(outcome, what)
        sys.stdout.write(f"{command:8} most {what:10} {value:10.1f}  {outcome.case}\n")
    sys.stdout.write("".join(f"WRONG {each}\n" for each in wrong))
    sys.stdout.write(f"{count} files, seed {seed}: {len(wrong)} wrong\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
