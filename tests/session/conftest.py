"""Sessions to write and to read."""

import contextlib
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer
from session_schemas import schemas

from rigd.session import SessionWriter
from rigd.session.layout import (
    CONTROL_FIELD_TYPES,
    CONTROL_SIZE,
    SAMPLE_DTYPE,
    SAMPLE_FIELDS,
    SAMPLE_SIZE,
    TIMING_SIZE,
    pack_control_into,
    pack_sample_into,
    pack_timing_into,
)

START_UTC_NS = 1_700_000_000_123_456_789
METADATA = {
    "id": "test",
    "rate_hz": "1000.0",
    "beam_length_m": "0.98",
    "beam_density_kg_per_m": "0.0047",
    "beam_bending_stiffness_n_m2": "0.090275",
    "operator": "Ä. Tester, 测试",
}
SEGMENTS = {"rest": (0, 10), "sweep": (10, 900)}
ATTACHMENTS = {"profile.toml": b"a = 1\n", "calibration.json": b"{}"}
OUTCOME = {"outcome": "complete", "reason": ""}


def make_samples(n, *, first_tick=0, seed=0):
    """Samples with noise in every field without a fixed meaning."""
    rng = np.random.default_rng(seed)
    samples = np.zeros(n, SAMPLE_DTYPE)
    samples["tick"] = first_tick + np.arange(n)
    samples["t_ns"] = samples["tick"].astype(np.int64) * 1_000_000
    for name in SAMPLE_FIELDS[2:12]:
        samples[name] = rng.normal(size=n)
    samples["status"] = rng.integers(0, 512, n)
    samples["lateness_ns"] = rng.integers(0, 100_000, n)
    samples["work_ns"] = rng.integers(0, 2**32, n)
    return samples


def packed(samples):
    block = bytearray(len(samples) * SAMPLE_SIZE)
    for i, sample in enumerate(samples.tolist()):
        pack_sample_into(block, i * SAMPLE_SIZE, *sample)
    return bytes(block)


def packed_timings(ticks):
    """Ages that differ in every tick."""
    buffer = bytearray(TIMING_SIZE * len(ticks))
    for i, tick in enumerate(ticks):
        pack_timing_into(buffer, i * TIMING_SIZE, tick * 1_000_000, tick, 1e-6 * tick, -2e-6 * tick)
    return bytes(buffer)


def packed_controls(ticks, seed=0):
    rng = np.random.default_rng(seed)
    block = bytearray(len(ticks) * CONTROL_SIZE)
    for i, tick in enumerate(ticks):
        terms = rng.normal(size=len(CONTROL_FIELD_TYPES) - 2).tolist()
        pack_control_into(block, i * CONTROL_SIZE, tick * 1_000_000, tick, *terms)
    return bytes(block)


def begin(path):
    writer = SessionWriter(path)
    writer.begin(START_UTC_NS, METADATA, SEGMENTS, ATTACHMENTS)
    return writer


MINIMUM = {
    key: METADATA[key]
    for key in ("rate_hz", "beam_length_m", "beam_density_kg_per_m", "beam_bending_stiffness_n_m2")
}


def write_third_party(path, messages, *, schema=None, name="rigd.Sample", metadata=MINIMUM,
                  topic="/rig/sample", extra=None, encoding="protobuf", **options):  # fmt: skip
    """Write messages with the plain mcap package; `extra` names a second channel."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        for key, values in ({"session": metadata} if metadata else {}).items():
            writer.add_metadata(key, values)
        data = schemas()["rigd.Sample"] if schema is None else schema
        schema_id = writer.register_schema(name, encoding, data)
        channel = writer.register_channel(topic, encoding, schema_id)
        if extra:
            other = writer.register_channel(extra, "json", 0)
        for tick, message in enumerate(messages):
            writer.add_message(channel, tick * 1_000_000 + 77, message, 0)
            if extra:
                writer.add_message(other, tick, b"{" + b"x" * (tick % 3) + b"}", 0)
        writer.finish()
    return path


def fixed_messages(samples):
    block = packed(samples)
    return [block[i : i + SAMPLE_SIZE] for i in range(0, len(block), SAMPLE_SIZE)]


def chunks_of(path):
    """Messages of each complete chunk of a file that may be cut off, by the plain mcap reader.

    Chunks without messages, which declare channels, are left out.
    """
    chunks = []
    with path.open("rb") as stream, contextlib.suppress(EndOfFile, struct.error):
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                records = breakup_chunk(record, validate_crc=True)
                chunks.append([message for message in records if isinstance(message, Message)])
    return [chunk for chunk in chunks if chunk]


@dataclass(frozen=True)
class Recorded:
    path: Path
    samples: np.ndarray
    controls: bytes
    data: bytes


@pytest.fixture(scope="session")
def kit():
    """This module's functions and values: test modules cannot import it by name."""
    return sys.modules[__name__]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A session of 1111 samples, written in blocks of uneven length, with controls and events."""
    path = tmp_path_factory.mktemp("recorded") / "session.mcap"
    samples = make_samples(1111)
    block = packed(samples)
    controls = packed_controls(range(0, 1111, 10))
    writer = begin(path)
    writer.log(-5_000_000, "info", "before the first tick", name="rigd.engine")
    position, position_of_controls = 0, 0
    for count in (1, 249, 3, 600, 0, 250, 8):
        until = position + count
        controls_until = -(-until // 10)
        writer.write_controls(
            controls[position_of_controls * CONTROL_SIZE : controls_until * CONTROL_SIZE]
        )
        writer.write_samples(memoryview(block)[position * SAMPLE_SIZE : until * SAMPLE_SIZE])
        position, position_of_controls = until, controls_until
    writer.log(1_000_000_000, "warning", "late — 3 ticks")
    writer.close(OUTCOME)
    return Recorded(path, samples, controls, path.read_bytes())
