"""Metadata and counts without the samples: equal to what the whole file says, whoever wrote it."""

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from rigd.session import SessionError, read_session, read_summary, schema_data
from rigd.session import _summary as summary_module


def write_plainly(path, **options):
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        writer.add_metadata("session", {"rate_hz": "1000", "specimen": "of others"})
        schema = writer.register_schema("rigd.Sample", "protobuf", schema_data("rigd.Sample"))
        channel = writer.register_channel("/rig/sample", "protobuf", schema)
        for tick in range(700):
            writer.add_message(channel, tick, b"\x15" + tick.to_bytes(4, "little"), tick)
        writer.add_metadata("session", {"specimen": "later"})
        writer.add_metadata("outcome", {"outcome": "stopped"})
        writer.finish()
    return path


@pytest.fixture
def whole_reads(monkeypatch):
    """Files that were walked whole."""
    read = []

    def reading(path, topics):
        read.append(path)
        return load_contents(path, topics)

    load_contents = summary_module.load_contents
    monkeypatch.setattr(summary_module, "load_contents", reading)
    return read


def test_it_says_what_the_whole_file_says(short_chirps, whole_reads):
    session = read_session(short_chirps[0])
    summary = read_summary(short_chirps[0])
    assert summary.metadata == session.metadata
    assert summary.outcome == session.outcome
    assert summary.samples == len(session.samples)
    assert (summary.problem, summary.recording) == ("", False)
    assert whole_reads == []


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
def test_files_of_other_writers(tmp_path, options, by_index, whole_reads):
    summary = read_summary(write_plainly(tmp_path / "other.mcap", **options))
    assert summary.metadata == {"rate_hz": "1000", "specimen": "later"}
    assert (summary.outcome, summary.samples) == ({"outcome": "stopped"}, 700)
    assert bool(whole_reads) is not by_index


def test_every_cut_and_every_damaged_byte_at_the_end_is_borne(tmp_path, record_briefly):
    whole = record_briefly("whole").read_bytes()
    stated = read_summary(tmp_path / "whole.mcap")
    path = tmp_path / "harmed.mcap"
    for length in [*range(0, len(whole), 997), *range(len(whole) - 60, len(whole))]:
        path.write_bytes(whole[:length])
        try:
            assert read_summary(path).problem
        except SessionError as error:
            assert length < 10, error
    for place in range(len(whole) - 400, len(whole)):
        harmed = bytearray(whole)
        harmed[place] ^= 0x55
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
