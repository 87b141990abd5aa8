"""Writer: a valid MCAP file, durable at every moment, and nothing ever overwritten."""

import errno
import itertools
import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest
from cases import further
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from session_schemas import message_class

from rigd.session import (
    SessionError,
    SessionExistsError,
    SessionWriter,
    read_session,
    read_timings,
    recover,
)
from rigd.session.layout import SAMPLE_FIELDS, TIMING_SIZE, decode_controls, decode_samples


def test_the_plain_reader_decodes_everything(kit, recorded):
    with recorded.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        classes, decoded = {}, {}
        for schema, channel, message in reader.iter_messages():
            if schema.name not in classes:
                classes[schema.name] = message_class(schema.name, schema.data)
            decoded.setdefault(channel.topic, []).append(
                (message, classes[schema.name].FromString(message.data))
            )
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record for record in reader.iter_attachments()}
    rows = [tuple(getattr(m, name) for name in SAMPLE_FIELDS) for _, m in decoded["/rig/sample"]]
    assert rows == recorded.samples.tolist()
    assert [m.tick for _, m in decoded["/rig/control"]] == list(range(0, 1111, 10))
    assert [m.level for _, m in decoded["/rig/event"]] == [2, 3]
    for record, message in decoded["/rig/sample"]:
        assert record.log_time == record.publish_time == kit.START_UTC_NS + message.t_ns
        assert record.sequence == message.tick
    assert [record.sequence for record, _ in decoded["/rig/event"]] == [0, 1]
    record, event = decoded["/rig/event"][0]
    assert event.timestamp.ToNanoseconds() == record.log_time == kit.START_UTC_NS - 5_000_000
    counts = {summary.channels[i].topic: n for i, n in
              summary.statistics.channel_message_counts.items()}  # fmt: skip
    assert counts == {
        "/rig/sample": 1111,
        "/rig/control": 112,
        "/rig/timing": 0,
        "/rig/event": 2,
        "/rig/touch": 0,
    }
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 6  # 1 of channels
    assert summary.statistics.message_start_time == kit.START_UTC_NS - 5_000_000
    assert summary.statistics.message_end_time == kit.START_UTC_NS + 1_110_000_000
    assert metadata["session"] == kit.METADATA | {
        "format_version": "1",
        "start_utc_ns": str(kit.START_UTC_NS),
    }
    assert metadata["segments"] == {"rest": "0,10", "sweep": "10,900"}
    assert metadata["outcome"] == kit.OUTCOME
    assert attachments["profile.toml"].data == b"a = 1\n"
    assert attachments["profile.toml"].media_type == "application/toml"


def test_the_plain_streaming_reader_verifies_all_checksums(recorded):
    with recorded.path.open("rb") as stream:
        assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > 1111


def test_indexes_lead_to_the_messages_of_a_time(kit, recorded):
    start = kit.START_UTC_NS + 400_000_000
    with recorded.path.open("rb") as stream:
        found = [
            (channel.topic, message.log_time - start)
            for _, channel, message in make_reader(stream).iter_messages(
                starting_at=start, ending_before=start + 11_000_000
            )
        ]
    expected = [("/rig/sample", tick * 1_000_000) for tick in range(11)]
    expected += [("/rig/control", 0), ("/rig/control", 10_000_000)]
    assert sorted(found) == sorted(expected)


def test_a_chunk_has_250_samples_and_their_controls(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_controls(kit.packed_controls(range(0, 600, 10)))
    writer.write_samples(kit.packed(kit.make_samples(600)))
    writer.close(kit.OUTCOME)
    ticks = [
        {c: [decode(m.data)["tick"][0] for m in chunk if m.channel_id == c]
         for c, decode in ((1, decode_samples), (2, decode_controls))}
        for chunk in kit.chunks_of(tmp_path / "a.mcap")
    ]  # fmt: skip
    for i, (first, end) in enumerate(((0, 250), (250, 500), (500, 600))):
        assert ticks[i] == {1: list(range(first, end)), 2: list(range(first, end, 10))}


def test_ages_are_stored_with_their_samples(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_timings(kit.packed_timings(range(300)))
    writer.write_samples(kit.packed(kit.make_samples(250)))
    (chunk,) = kit.chunks_of(writer.part)
    assert sum(len(message.data) == TIMING_SIZE for message in chunk) == 250
    writer.close(kit.OUTCOME)
    timings = read_timings(tmp_path / "a.mcap")
    assert timings["tick"].tolist() == list(range(300))
    assert timings["angle_age_s"].tolist() == [1e-6 * tick for tick in range(300)]
    assert timings["wrench_age_s"].tolist() == [-2e-6 * tick for tick in range(300)]


def test_an_error_is_in_the_file_at_once(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(7)))
    writer.log(7_000_000, "warning", "wait for the chunk")
    assert kit.chunks_of(writer.part) == []
    writer.log(7_000_000, "fatal", "angle limit")
    (chunk,) = kit.chunks_of(writer.part)
    assert len(chunk) == 9
    writer.abandon()


def test_a_session_without_samples_is_complete(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.close({"outcome": "fault"})
    session = read_session(tmp_path / "a.mcap")
    assert len(session.samples) == 0
    assert session.outcome == {"outcome": "fault"}


CHILD = """
    import sys
    from pathlib import Path
    sys.path[:0] = sys.argv[2], sys.argv[2] + "/../plugins"
    from conftest import begin, make_samples, packed
    from rigd.session.layout import SAMPLE_SIZE

    block = packed(make_samples(5000))
    writer = begin(Path(sys.argv[1]))
    for tick in range(5000):
        writer.write_samples(block[tick * SAMPLE_SIZE : (tick + 1) * SAMPLE_SIZE])
        if tick % 100 == 99:
            print(tick + 1, flush=True)
    input()
"""


@pytest.mark.process
@pytest.mark.parametrize("after", [further(100), 2600])
def test_a_killed_recorder_loses_at_most_250_samples(kit, tmp_path, after):
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-c", textwrap.dedent(CHILD), str(path), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        for line in child.stdout:
            if int(line) >= after:
                break
        child.send_signal(signal.SIGKILL)
        # What it printed before it died, it had written before.
        printed = [after, *(int(line) for line in child.stdout if line.strip().isdigit())]
    part = tmp_path / "a.mcap.part"
    ticks = [decode_samples(m.data)["tick"][0] for chunk in kit.chunks_of(part) for m in chunk]
    assert ticks == list(range(len(ticks)))
    assert len(ticks) > max(printed) - 250
    assert not path.exists()
    with pytest.raises(SessionError, match=rf"is incomplete.* {len(ticks)} complete samples"):
        read_session(part)


def test_the_file_is_synced_about_once_a_second(kit, tmp_path, monkeypatch):
    now = 0.0
    synced = []
    monkeypatch.setattr("rigd.session._writer.time.monotonic", lambda: now)
    writer = kit.begin(tmp_path / "a.mcap")
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (synced.append(now), sync(fd)))
    block = kit.packed(kit.make_samples(5000))
    for first in range(0, 5000, 50):
        writer.write_samples(block[first * 119 : (first + 50) * 119])
        now += 0.05
    writer.abandon()
    waited = [later - earlier for earlier, later in itertools.pairwise(synced[:-1])]
    assert len(waited) >= 3
    assert max(waited) < 1.3
    assert min(waited) >= 1.0


def test_a_growing_file_is_marked_while_its_writer_lives(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(250)))
    with pytest.raises(SessionError, match=r"because it is still being recorded\. Wait"):
        read_session(writer.part)
    writer.abandon()
    with pytest.raises(SessionError, match=r"250 complete samples .* with `rigd recover "):
        read_session(writer.part)


@pytest.mark.parametrize("name", ["a.mcap", "a.mcap.part"])
def test_an_existing_file_is_refused_and_unchanged(tmp_path, name):
    existing = tmp_path / name
    existing.write_bytes(b"precious")
    with pytest.raises(SessionExistsError, match=rf"{name} exists"):
        SessionWriter(tmp_path / "a.mcap")
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert existing.read_bytes() == b"precious"


@pytest.mark.parametrize("hard_links", [True, False])
def test_a_file_created_meanwhile_is_not_overwritten(kit, tmp_path, monkeypatch, hard_links):
    if not hard_links:
        forbid_hard_links(monkeypatch)
    path = tmp_path / "a.mcap"
    writer = kit.begin(path)
    writer.write_samples(kit.packed(kit.make_samples(3)))
    path.write_bytes(b"precious")
    with pytest.raises(SessionExistsError, match=r"complete session is .*a\.mcap\.part"):
        writer.close(kit.OUTCOME)
    assert path.read_bytes() == b"precious"
    assert len(read_session(writer.part).samples) == 3


def forbid_hard_links(monkeypatch):
    def link(source, target):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", link)


def test_a_session_gets_its_name_without_hard_links(kit, tmp_path, monkeypatch):
    forbid_hard_links(monkeypatch)
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(3)))
    assert writer.close(kit.OUTCOME) == tmp_path / "a.mcap"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert len(read_session(tmp_path / "a.mcap").samples) == 3


def test_a_name_is_free_again_after_a_failure(kit, tmp_path, monkeypatch):
    """Without hard links the name is reserved by an empty file, which would block a recovery."""
    forbid_hard_links(monkeypatch)

    def replace(self, target):
        raise OSError(errno.EIO, "Input/output error")

    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(3)))
    with monkeypatch.context() as broken:
        broken.setattr(Path, "replace", replace)
        with pytest.raises(SessionError, match="Input/output error"):
            writer.close(kit.OUTCOME)
    writer.abandon()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap.part"]
    assert len(read_session(recover(writer.part).path).samples) == 3


@pytest.mark.parametrize("size", [0, 100, 20_000])
def test_a_file_shortened_by_another_program_is_incomplete(kit, tmp_path, size):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(250)))
    os.truncate(writer.part, size)
    writer.write_samples(kit.packed(kit.make_samples(500, first_tick=250)))
    with pytest.raises(SessionError, match="shortened or written to by another program"):
        writer.close(kit.OUTCOME)
    assert not writer.path.exists()
    assert writer.abandon() == writer.part


def test_one_of_many_writers_gets_the_name(tmp_path):
    path = tmp_path / "a.mcap"
    barrier = threading.Barrier(8)
    won, lost = [], []

    def record():
        barrier.wait()
        try:
            won.append(SessionWriter(path))
        except SessionExistsError as error:
            lost.append(error)

    threads = [threading.Thread(target=record) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(won), len(lost)) == (1, 7)
    won[0].discard()
    assert list(tmp_path.iterdir()) == []


def test_abandoning_retains_written_samples(kit, tmp_path):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(260)))
    writer.abandon()
    assert sum(len(chunk) for chunk in kit.chunks_of(writer.part)) == 260
    assert not writer.path.exists()


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(
        SessionError, match=r"nowhere/a\.mcap\.part cannot be written: No such file"
    ):
        SessionWriter(tmp_path / "nowhere" / "a.mcap")


def test_a_full_disk_ends_the_recording_and_loses_nothing_written(kit, tmp_path, monkeypatch):
    writer = kit.begin(tmp_path / "a.mcap")
    writer.write_samples(kit.packed(kit.make_samples(250)))
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full on this system")
    stream = writer._stream
    writer._stream = writer._mcap._stream = full.open("wb")
    with pytest.raises(SessionError, match="cannot be written: No space left on device"):
        writer.write_samples(kit.packed(kit.make_samples(250, first_tick=250)))
    with pytest.raises(SessionError, match="writing failed before"):
        writer.write_samples(kit.packed(kit.make_samples(1, first_tick=500)))
    writer.abandon()
    stream.close()
    assert sum(len(chunk) for chunk in kit.chunks_of(writer.part)) == 250


def test_wrong_use_of_the_writer_is_a_programming_error(kit, tmp_path):
    writer = SessionWriter(tmp_path / "a.mcap")
    with pytest.raises(RuntimeError, match="begin"):
        writer.write_samples(b"")
    writer.begin(kit.START_UTC_NS, kit.METADATA, {}, {})
    with pytest.raises(RuntimeError, match="twice"):
        writer.begin(kit.START_UTC_NS, kit.METADATA, {}, {})
    with pytest.raises(RuntimeError, match="not discarded"):
        writer.discard()
    with pytest.raises(ValueError, match="119-byte"):
        writer.write_samples(bytes(118))
    with pytest.raises(ValueError, match="68-byte"):
        writer.write_controls(bytes(69))
    writer.abandon()
