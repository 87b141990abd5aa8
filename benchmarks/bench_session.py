"""Session files: cost of writing a sample and of reading 120 000, against the plain packages.

The peer writes and reads the same messages one by one with the ``mcap`` package, encoding and
decoding them with ``protobuf`` objects. Both start from the values of the samples, so packing them
(here into the ring's layout, by the peer into protobuf messages) counts for both. Best of two runs
of the peer, in turn with five runs each of this package.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from gate import Gate, Row
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from timing import least_s

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
CONTROLS = BLOCK // CONTROL_EVERY
ROWS = (
    # Measured 0.26 to 0.38, and 0.022 to 0.031.
    Row("writing, packing included", most=0.6, unit="times mcap and protobuf"),
    Row("reading to arrays", most=0.05, unit="times mcap and protobuf"),
    # Measured 110.
    Row("size of a sample in the file", most=130, unit="bytes"),
)
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


def write(path: Path, table: list[tuple[float, ...]]) -> float:
    """Pack and record in blocks, as from the ring; return the seconds it takes."""
    started = time.perf_counter()
    writer = SessionWriter(path)
    writer.begin(START_UTC_NS, {"rate_hz": "1000.0"}, {}, {})
    samples, controls = bytearray(BLOCK * SAMPLE_SIZE), bytearray(CONTROLS * CONTROL_SIZE)
    for first in range(0, SAMPLES, BLOCK):
        for index, row in enumerate(table[first : first + BLOCK]):
            pack_sample_into(samples, index * SAMPLE_SIZE, *row)
        for index in range(CONTROLS):
            tick = first + CONTROL_EVERY * index
            pack_control_into(controls, index * CONTROL_SIZE, tick * 10**6, tick, *table[tick][2:8])
        writer.write_controls(memoryview(controls))
        writer.write_samples(memoryview(samples))
    writer.close({"outcome": "complete"})
    return time.perf_counter() - started


def message_class(schema: Schema) -> type[Message]:
    """Return the protobuf class of the messages of a schema."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(schema.name))


def write_plainly(path: Path, table: list[tuple[float, ...]], like: Path) -> float:
    """Write the samples (without controls) as protobuf objects with the schema of a session."""
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


def main() -> None:
    """Measure and print the ratios, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    table = rows()
    writes, reads = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, plain = folder / "session.mcap", folder / "plain.mcap"
        for _ in range(2):
            for _ in range(5):
                path.unlink(missing_ok=True)
                writes.append(write(path, table))
            read_s = least_s(lambda: read_session(path), 5)
            plain_write_s = write_plainly(plain, table, path)
            reads.append((read_s, read_plainly(plain), plain_write_s))
        size = path.stat().st_size / SAMPLES
    read_s, plain_read_s, plain_write_s = (min(times) for times in zip(*reads, strict=True))
    write_s, scale = min(writes), 1e6 / SAMPLES
    print(f"{SAMPLES} samples: writing {write_s * scale:.2f} µs a sample with begin, close and")
    print(f"controls (of which the peer has none), the peer {plain_write_s * scale:.2f} µs;")
    print(f"reading {read_s * 1e3:.1f} ms, the peer {plain_read_s * 1e3:.0f} ms")
    gate.measured("writing, packing included", write_s / plain_write_s)
    gate.measured("reading to arrays", read_s / plain_read_s)
    gate.measured("size of a sample in the file", size)
    gate.finish()


if __name__ == "__main__":
    main()
