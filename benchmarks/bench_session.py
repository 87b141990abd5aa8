"""Session files: cost of writing a sample and of reading 120 000, against the plain packages.

The peer writes and reads the same messages with the ``mcap`` package one by one, encoding and
decoding them with ``protobuf`` objects. Best of ten runs of this package, best of two of the peer.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from rigd.session import SessionWriter, read_session
from rigd.session.layout import (
    CONTROL_SIZE,
    SAMPLE_FIELDS,
    SAMPLE_SIZE,
    pack_control_into,
    pack_sample_into,
)

SAMPLES = 120_000
CONTROL_EVERY = 10
BLOCK = 50
START_UTC_NS = 1_700_000_000_000_000_000


def rows() -> list[tuple[float, ...]]:
    """Make samples of realistic entropy: quantised angles, noisy quantised wrenches."""
    rng = np.random.default_rng(1)
    tick = np.arange(SAMPLES)
    reference = 0.025 * np.sin(0.03 * tick)
    angle = np.round(reference / 7e-5) * 7e-5
    wrench = np.round(rng.normal(scale=0.01, size=(6, SAMPLES)) / 1.25e-4) * 1.25e-4
    columns = [
        tick * 1_000_000, tick, reference, angle, rng.normal(scale=0.1, size=SAMPLES), wrench[5],
        *wrench, np.zeros(SAMPLES, int), rng.integers(5_000, 90_000, SAMPLES),
        rng.integers(50_000, 90_000, SAMPLES),
    ]  # fmt: skip
    return list(zip(*(column.tolist() for column in columns), strict=True))


def write(path: Path, samples: memoryview, controls: memoryview) -> float:
    """Record in blocks as they come from the ring; return the seconds from begin to closed."""
    started = time.perf_counter()
    writer = SessionWriter(path)
    writer.begin(START_UTC_NS, {"rate_hz": "1000.0"}, {}, {})
    for first in range(0, SAMPLES, BLOCK):
        end = first + BLOCK
        writer.write_controls(
            controls[first // CONTROL_EVERY * CONTROL_SIZE : end // CONTROL_EVERY * CONTROL_SIZE]
        )
        writer.write_samples(samples[first * SAMPLE_SIZE : end * SAMPLE_SIZE])
    writer.close({"outcome": "complete"})
    return time.perf_counter() - started


def message_class(schema: Schema) -> type[Message]:
    """Return protobuf's class of the messages of a schema."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(schema.name))


def write_plainly(path: Path, table: list[tuple[float, ...]], like: Path) -> float:
    """Write the samples (without controls) with protobuf objects, by the schema of a session."""
    with like.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (stated,) = (each for each in summary.schemas.values() if each.name == "rigd.Sample")
    cls = message_class(stated)
    started = time.perf_counter()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        schema = writer.register_schema(stated.name, "protobuf", stated.data)
        channel = writer.register_channel("/rig/sample", "protobuf", schema)
        for row in table:
            data = cls(**dict(zip(SAMPLE_FIELDS, row, strict=True))).SerializeToString()
            writer.add_message(channel, START_UTC_NS + int(row[0]), data, 0)
        writer.finish()
    return time.perf_counter() - started


def read_plainly(path: Path) -> float:
    """Read the samples into arrays with the mcap package and protobuf objects."""
    started = time.perf_counter()
    columns: list[list[float]] = [[] for _ in SAMPLE_FIELDS]
    with path.open("rb") as stream:
        cls = None
        for schema, _, message in make_reader(stream).iter_messages(topics=["/rig/sample"]):
            if cls is None:
                assert schema is not None
                cls = message_class(schema)
            sample = cls.FromString(message.data)
            for name, column in zip(SAMPLE_FIELDS, columns, strict=True):
                column.append(getattr(sample, name))
    arrays = [np.array(column) for column in columns]
    elapsed = time.perf_counter() - started
    assert all(len(array) == SAMPLES for array in arrays)
    return elapsed


def timed(action: Callable[[], object]) -> float:
    """Return the seconds that an action takes."""
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def main() -> None:
    """Measure and print."""
    table = rows()
    samples = bytearray(SAMPLES * SAMPLE_SIZE)
    packing = timed(
        lambda: [pack_sample_into(samples, i * SAMPLE_SIZE, *row) for i, row in enumerate(table)]
    )
    controls = bytearray(SAMPLES // CONTROL_EVERY * CONTROL_SIZE)
    for i in range(SAMPLES // CONTROL_EVERY):
        pack_control_into(controls, i * CONTROL_SIZE, i * 10**7, i * 10, *table[i][2:8])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_s = min(
            write(folder / f"{i}.mcap", memoryview(samples), memoryview(controls))
            for i in range(10)
        )
        path = folder / "0.mcap"
        read_s = min(timed(lambda: read_session(path)) for _ in range(10))
        plain_write_s = min(write_plainly(folder / "plain.mcap", table, path) for _ in range(2))
        plain_read_s = min(read_plainly(path) for _ in range(2))
        size_mb = path.stat().st_size / 1e6
    scale = 1e6 / SAMPLES
    print(f"session file, {SAMPLES} samples, {size_mb:.1f} MB; best of 10 (peer: of 2)")
    print(f"  pack   {packing * scale:7.2f} µs/sample")
    print(
        f"  write  {write_s * scale:7.2f} µs/sample, with controls, begin and close;  "
        f"mcap + protobuf {plain_write_s * scale:.2f} ({plain_write_s / write_s:.1f} ×)"
    )
    print(
        f"  read   {read_s * 1e3:7.1f} ms to numpy;  "
        f"mcap + protobuf {plain_read_s * 1e3:.0f} ({plain_read_s / read_s:.1f} ×)"
    )


if __name__ == "__main__":
    main()
