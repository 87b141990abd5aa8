"""Files that are not sessions, cut off, damaged or hostile: one error, and never a wrong number."""

import os
import random
import struct
import tracemalloc
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from rigd.session import SessionError, describe, limits, read_controls, read_session

MAGIC = b"\x89MCAP0\r\n"


def refused(path, message):
    """Every way of reading refuses the file with this message, naming the file."""
    for read in (read_session, read_controls, describe):
        with pytest.raises(SessionError, match=message) as error:
            read(path)
        text = str(error.value)
        assert str(path) in text
        assert len(text) - len(str(path)) < 450
    return text


def test_a_missing_file(tmp_path):
    refused(tmp_path / "a.mcap", r"a\.mcap cannot be read: No such file or directory")


def test_a_folder_and_a_pipe(tmp_path):
    refused(tmp_path, "is not a file")
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / "pipe", "is not a file")


def test_an_empty_file(tmp_path):
    (tmp_path / "a.mcap").touch()
    refused(tmp_path / "a.mcap", r"a\.mcap is empty")


@pytest.mark.parametrize("data", [b"\n", b"time,angle\n0,0\n" * 1000, bytes(5000), MAGIC[:-1]])
def test_a_file_of_another_format(tmp_path, data):
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    refused(path, r"is not an MCAP file\. Give a session file")


def test_an_mcap_file_without_samples_channel(kit, tmp_path):
    messages = kit.fixed_messages(kit.make_samples(3))
    path = kit.write_third_party(tmp_path / "a.mcap", messages, topic="/other")
    refused(path, "without the channel /rig/sample, so it is not a session")


def test_samples_without_protobuf(kit, tmp_path):
    path = kit.write_third_party(tmp_path / "a.mcap", [b"{}"], encoding="jsonschema", schema=b"{}")
    with pytest.raises(SessionError, match=r"encoding 'jsonschema'.*has protobuf"):
        read_session(path)


@pytest.mark.parametrize("schema", [b"", b"\xff\xff", b"garbage" * 20])
def test_an_invalid_schema(kit, tmp_path, schema):
    path = kit.write_third_party(tmp_path / "a.mcap", [b""], schema=schema)
    with pytest.raises(SessionError, match="not a usable protobuf schema"):
        read_session(path)


def test_messages_unlike_their_schema(kit, tmp_path):
    path = kit.write_third_party(tmp_path / "a.mcap", [b"\x09\x00"])
    with pytest.raises(SessionError, match="not what its schema says"):
        read_session(path)


def test_truncation_anywhere(kit, recorded, tmp_path):
    path = tmp_path / "a.mcap.part"
    size = len(recorded.data)
    lengths = random.Random(1).sample(range(len(MAGIC), size), 30)
    for length in [*lengths, size - 1, size - 8, size - 9, size - 40]:
        path.write_bytes(recorded.data[:length])
        with pytest.raises(SessionError, match=r"is incomplete: it (ends|has no)") as error:
            read_session(path)
        readable = int(str(error.value).split("; ")[1].split()[0])
        # The plain reader decides what is whole; samples are of channel 1.
        whole = [m for chunk in kit.chunks_of(path) for m in chunk if m.channel_id == 1]
        assert readable == len(whole)
    assert readable == 1111  # then only the footer is missing


def test_truncated_files_without_chunks_count_their_messages(kit, tmp_path):
    messages = kit.fixed_messages(kit.make_samples(30))
    data = kit.write_third_party(tmp_path / "a.mcap", messages, use_chunking=False).read_bytes()
    second = data.index(messages[1])
    path = tmp_path / "b.mcap"
    path.write_bytes(data[: second + 119 + 150 * 5 + 30])
    refused(path, "; 7 complete samples are readable")


@pytest.mark.parametrize("length", [8, 20, 300])
def test_nothing_to_recover_without_a_whole_sample(recorded, tmp_path, length):
    path = tmp_path / "a.mcap"
    path.write_bytes(recorded.data[:length])
    refused(path, "; 0 complete samples are readable before that, so there is nothing to recover")


def test_a_tail_of_zeros_after_a_dead_host(recorded, tmp_path):
    path = tmp_path / "a.mcap.part"
    path.write_bytes(recorded.data[:60_000] + bytes(60_000))
    refused(path, "is incomplete: it .*complete samples are readable")


def test_bit_flips_anywhere(recorded, tmp_path):
    """Every byte of such a file is under a checksum or compared, so none goes unnoticed."""
    path = tmp_path / "a.mcap"
    for bit in random.Random(2).sample(range(8 * len(recorded.data)), 50):
        damaged = bytearray(recorded.data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(SessionError, match=r"damaged|incomplete|not an MCAP"):
            read_session(path)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_bit_flips_without_checksums_never_give_wrong_samples(kit, tmp_path, compression):
    from mcap.writer import CompressionType

    samples = kit.make_samples(300)
    path = kit.write_third_party(
        tmp_path / "a.mcap",
        kit.fixed_messages(samples),
        compression=CompressionType[compression],
        chunk_size=10_000,
    )
    data = path.read_bytes()
    refusals = 0
    for bit in random.Random(3).sample(range(8 * len(data)), 80):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            read = read_session(path).samples
        except SessionError:
            refusals += 1
        else:  # a flip in unused bytes
            np.testing.assert_array_equal(read, samples)
    assert refusals > 40


def test_random_bytes_behind_the_magic(tmp_path):
    path = tmp_path / "a.mcap"
    for seed in range(100):
        path.write_bytes(MAGIC + random.Random(seed).randbytes(3000))
        with pytest.raises(SessionError):
            read_session(path)


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk_file(path, *, claimed, packed, compression, crc=0):
    """A file of one chunk, with an end."""
    head = struct.pack("<QQQII", 0, 0, claimed, crc, len(compression)) + compression
    chunk = record(6, head + struct.pack("<Q", len(packed)) + packed)
    footer = record(2, struct.pack("<QQI", 0, 0, 0))
    path.write_bytes(
        MAGIC + record(1, bytes(8)) + chunk + record(15, bytes(4)) + footer + MAGIC
    )  # fmt: skip
    return path


ZEROS = bytes(64 << 20)
SMALL = b"\x05" * 1000


@pytest.mark.parametrize(
    ("claimed", "compression", "packed", "message"),
    [
        (10 << 30, b"zstd", lambda: zstandard.compress(SMALL), "claims 10737418240 bytes"),
        (10 << 30, b"lz4", lambda: lz4.frame.compress(SMALL), "claims 10737418240 bytes"),
        (1000, b"zstd", lambda: zstandard.compress(ZEROS), "two different sizes"),
        (1000, b"zstd", lambda: streamed(ZEROS), "does not decompress"),
        (1000, b"lz4", lambda: lz4.frame.compress(ZEROS), "wrong size|does not decompress"),
        (999, b"lz4", lambda: lz4.frame.compress(SMALL), "wrong size|does not decompress"),
        (1001, b"lz4", lambda: lz4.frame.compress(SMALL), "wrong size"),
        (1000, b"", lambda: SMALL[1:], "wrong size"),
        (1000, b"zstd", lambda: b"nonsense", "does not decompress"),
        (1000, b"lz4", lambda: b"nonsense", "does not decompress"),
        (1000, b"lz4", lambda: lz4.frame.compress(SMALL)[:-12], "wrong size|does not decompress"),
        (1000, b"zip", lambda: SMALL, "unknown compression b'zip'"),
        (2**64 - 1, b"", lambda: SMALL, "claims"),
    ],
)
def test_a_chunk_with_a_false_size_takes_no_memory(tmp_path, claimed, compression, packed, message):
    path = chunk_file(
        tmp_path / "a.mcap", claimed=claimed, packed=packed(), compression=compression
    )
    tracemalloc.start()
    try:
        refused(path, f"damaged: it .*({message})")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20


def streamed(data):
    """A zstd frame that does not state its size."""
    compressor = zstandard.ZstdCompressor().compressobj()
    return compressor.compress(data) + compressor.flush()


def test_many_chunks_of_excessive_total_size_are_refused(kit, tmp_path, monkeypatch):
    path = kit.write_third_party(
        tmp_path / "a.mcap", kit.fixed_messages(kit.make_samples(100)), chunk_size=3000
    )
    assert len(read_session(path).samples) == 100  # 15 000 bytes and a schema
    monkeypatch.setattr(limits, "MAX_TOTAL_UNPACKED_BYTES", 10_000)
    refused(path, "claims .* which is more than")


def test_a_wrong_chunk_checksum_is_found(tmp_path):
    records = record(0x80, bytes(100))
    path = chunk_file(
        tmp_path / "a.mcap",
        claimed=len(records),
        packed=records,
        compression=b"",
        crc=zlib.crc32(records) ^ 1,
    )
    refused(path, "wrong checksum in the chunk at byte")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (record(5, bytes(21)), "too short"),
        (record(5, bytes(30)), "undeclared channel 0"),
        (record(4, b"\x01\x00\x00\x00\xff\xff\xff\xff"), "malformed record"),
        (record(3, b"\x01\x00\x02\x00\x00\x00\xff\xfe" + bytes(8)), "malformed record"),
        (b"\x05" + b"\xff" * 8, "middle of a record"),
        (b"\x05\x00", "middle of a record"),
        (bytes(20), "no record where one must be"),
    ],
)
def test_malformed_records_in_a_chunk(tmp_path, content, message):
    path = chunk_file(
        tmp_path / "a.mcap", claimed=len(content), packed=content, compression=b""
    )  # fmt: skip
    refused(path, message)


def test_a_channel_or_schema_declared_twice_differently(tmp_path):
    def channel(topic):
        text = struct.pack("<I", len(topic)) + topic
        return record(4, struct.pack("<HH", 1, 0) + text + bytes(4) + bytes(4))

    content = channel(b"/rig/sample") + channel(b"/other")
    path = chunk_file(
        tmp_path / "a.mcap", claimed=len(content), packed=content, compression=b""
    )  # fmt: skip
    refused(path, "declares channel 1 twice")


def test_messages_counted_in_the_statistics_must_exist(kit, tmp_path):
    """A chunk whose opcode was damaged is skipped as an unknown record: no other check finds it."""
    path = kit.write_third_party(
        tmp_path / "a.mcap", kit.fixed_messages(kit.make_samples(100)), chunk_size=5000
    )
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        from mcap.reader import make_reader

        index = make_reader(stream).get_summary().chunk_indexes[1]
    assert data[index.chunk_start_offset] == 6
    data[index.chunk_start_offset] = 0x86
    path.write_bytes(data)
    refused(path, "does not contain the messages that its statistics count")


def test_a_damaged_attachment(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_attachment(0, 0, "profile.toml", "application/toml", b"precious")
        writer.finish()
    path.write_bytes(path.read_bytes().replace(b"precious", b"precioux"))
    refused(path, "an attachment with a wrong checksum")
