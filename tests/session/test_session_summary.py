"""Metadata and counts without the samples: equal to those of the whole file, for any writer."""

import pytest
from cases import further
from mcap.writer import CompressionType, IndexType, Writer
from session_schemas import schemas

from rigd.session import SessionError, read_session, read_summary


def write_plainly(path, **options):
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        writer.add_metadata("session", {"rate_hz": "1000", "specimen": "of others"})
        schema = writer.register_schema("rigd.Sample", "protobuf", schemas()["rigd.Sample"])
        channel = writer.register_channel("/rig/sample", "protobuf", schema)
        for tick in range(700):
            writer.add_message(channel, tick, b"\x15" + tick.to_bytes(4, "little"), tick)
        writer.add_metadata("session", {"specimen": "later"})
        writer.add_metadata("outcome", {"outcome": "stopped"})
        writer.finish()
    return path


def with_unreadable_samples(path):
    """Give the first chunk or message a length that only a whole read detects."""
    data = bytearray(path.read_bytes())
    position = 8
    while data[position] not in (5, 6):
        position += 9 + int.from_bytes(data[position + 1 : position + 9], "little")
    data[position + 1 : position + 9] = (1 << 40).to_bytes(8, "little")
    path.write_bytes(data)
    return path


@pytest.mark.process
def test_the_summary_equals_the_whole_file(short_chirps):
    session = read_session(short_chirps[0])
    summary = read_summary(short_chirps[0])
    assert summary.metadata == session.metadata
    assert summary.outcome == session.outcome
    assert summary.samples == len(session.samples)
    assert (summary.problem, summary.is_recording) == ("", False)


@pytest.mark.process
def test_an_indexed_file_is_not_read_whole(short_chirps, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(short_chirps[0].read_bytes())
    stated = read_summary(path)
    found = read_summary(with_unreadable_samples(path))
    assert (found.metadata, found.outcome, found.samples, found.problem) == (
        stated.metadata, stated.outcome, stated.samples, "",
    )  # fmt: skip
    with pytest.raises(SessionError):
        read_session(path)


@pytest.mark.parametrize(
    ("options", "by_index"),
    [
        ({}, True),
        ({"compression": CompressionType.NONE, "use_chunking": False}, True),
        ({"index_types": IndexType.CHUNK}, False),
        ({"use_statistics": False}, False),
        ({"enable_crcs": False}, False),
    ],
)
def test_files_of_other_writers(tmp_path, options, by_index):
    path = write_plainly(tmp_path / "other.mcap", **options)
    summary = read_summary(path)
    assert summary.metadata == {"rate_hz": "1000", "specimen": "later"}
    assert (summary.outcome, summary.samples) == ({"outcome": "stopped"}, 700)
    assert bool(read_summary(with_unreadable_samples(path)).problem) is not by_index


@pytest.mark.parametrize("every", [11, further(1)])
def test_cuts_and_damaged_bytes_at_the_end_are_tolerated(tmp_path, record_briefly, every):
    whole = record_briefly("whole").read_bytes()
    stated = read_summary(tmp_path / "whole.mcap")
    path = tmp_path / "harmed.mcap"
    for length in [*range(0, len(whole), 997), *range(len(whole) - 60, len(whole), every)]:
        path.write_bytes(whole[:length])
        try:
            assert read_summary(path).problem
        except SessionError as error:
            assert length < 10, error
    for offset in range(len(whole) - 400, len(whole), every):
        harmed = bytearray(whole)
        harmed[offset] ^= 0x55
        path.write_bytes(harmed)
        found = read_summary(path)
        assert found.problem or (found.metadata, found.samples) == (
            stated.metadata, stated.samples
        )  # fmt: skip


def test_a_file_of_another_kind_is_no_session(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(SessionError, match="without the channel /rig/sample"):
        read_summary(path)
    with pytest.raises(SessionError, match=r"nowhere\.mcap cannot be read"):
        read_summary(tmp_path / "nowhere.mcap")
