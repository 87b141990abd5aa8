"""Torn and damaged files: all intact samples are recovered and marked, and no others."""

import fcntl
import random
import struct

import numpy as np
import pytest
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from session_schemas import schemas

from analysis.record import load_record
from rigd.session import SessionError, SessionExistsError, describe, read_session, recover
from rigd.session.layout import encode_samples


def test_samples_before_any_damage_or_a_refusal(fuzz_recovery, original):
    results = fuzz_recovery.fuzz(original, 10, seed=1)
    for kind in fuzz_recovery.KINDS:
        assert results[kind, "recovered"] > 4
    assert results.total() == 10 * len(fuzz_recovery.KINDS)


def test_a_flipped_bit_in_a_record_head_adds_nothing(
    fuzz_recovery, original, tmp_path, monkeypatch
):
    """An opcode or a length that is wrong makes a reader take one record for another."""
    heads, position = [], 8
    while position < original.part_bytes:
        heads.append(position)
        position += 9 + struct.unpack_from("<Q", original.data, position + 1)[0]
    rng = random.Random(1)
    cases = rng.sample([(head, bit) for head in heads for bit in range(8)], 20)
    cases += [(rng.choice(heads) + rng.randrange(1, 9), rng.randrange(8)) for _ in range(8)]
    # An index of a single event that becomes a message has the length of an empty one.
    index = original.data.index(struct.pack("<BQHI", 7, 22, 4, 16))
    for at, bit in {*cases, (index, 1)}:
        data = bytearray(original.data[: original.part_bytes])
        data[at] ^= 1 << bit
        case = (bytes(data), at)
        monkeypatch.setattr(fuzz_recovery, "damaged", lambda *_, case=case: case)
        folder = tmp_path / f"{at}-{bit}"
        folder.mkdir()
        fuzz_recovery.check_case(original, "flipped part", rng, folder)


def test_a_recovered_file_is_complete_and_marked(torn, original):
    recovery = recover(torn)
    assert recovery.path == torn.with_name("a.mcap")
    assert recovery.samples == original.chunk_samples[3]
    assert recovery.bytes_lost == 300
    with recovery.path.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    kinds = [type(record).__name__ for record in records]
    assert {"Statistics", "ChunkIndex", "Footer"} <= set(kinds)
    outcome = read_session(recovery.path).outcome
    assert outcome["outcome"] == "fault"
    assert outcome["reason"].startswith("Recovered from a.mcap.part, which ends in the middle of")
    assert outcome["reason"].endswith("; 300 bytes from there on were lost.")
    assert outcome["recovered_from"] == "a.mcap.part"
    assert outcome["recovered_bytes_lost"] == "300"
    assert outcome["recovered_protected"] == "true"
    assert (outcome["recorded"], outcome["missed"], outcome["lost"]) == ("1000", "3", "0")
    assert outcome["scheduled"] == "1003"
    status = read_session(recovery.path).samples["status"]
    assert outcome["stale_angles"] == str(np.count_nonzero(status & 4))
    assert outcome["stale_wrenches"] == str(np.count_nonzero(status & 8))
    assert torn.exists()


def test_the_statistics_of_a_damaged_file_give_the_loss(original, tmp_path):
    path = tmp_path / "a.mcap"
    data = bytearray(original.data)
    data[original.chunk_ends[1] + 20_000] ^= 1
    path.write_bytes(data)
    recovery = recover(path)
    assert recovery.path == tmp_path / "a.recovered.mcap"
    assert (recovery.samples, recovery.outcome["lost"]) == (500, "997")
    assert recovery.outcome["scheduled"] == str(500 + 997)


def test_outcome_is_preserved_if_only_the_summary_is_damaged(original, tmp_path):
    path = tmp_path / "a.mcap.part"
    path.write_bytes(original.data[:-20])
    outcome = read_session(recover(path).path).outcome
    assert original.session.outcome.items() <= outcome.items()
    assert outcome["recovered_damage"] == (
        "ends in the middle of its summary, or something was appended to it"
    )
    warnings = load_record(tmp_path / "a.mcap").warnings
    assert any("recovered from a.mcap.part, without loss of samples" in text for text in warnings)


def test_a_complete_part_gets_its_name(original, tmp_path):
    path = tmp_path / "a.mcap.part"
    path.write_bytes(original.data)
    recovery = recover(path)
    assert recovery.damage is None
    assert (tmp_path / "a.mcap").read_bytes() == original.data
    assert "complete and intact" in recovery.lines()[0]


def test_a_sound_file_needs_no_recovery(original, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(original.data)
    assert recover(path).path is None
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("complete", [True, False])
def test_a_taken_name_is_refused(original, torn, complete):
    if complete:
        torn.write_bytes(original.data)
    target = torn.with_name("a.mcap")
    target.write_bytes(b"precious")
    with pytest.raises(SessionExistsError, match=r"a\.mcap exists and is not overwritten"):
        recover(torn)
    assert target.read_bytes() == b"precious"
    assert sorted(p.name for p in torn.parent.iterdir()) == ["a.mcap", "a.mcap.part"]


def test_a_name_taken_meanwhile_is_refused(torn, monkeypatch):
    target = torn.with_name("a.mcap")
    read = read_session

    def slow_reading(path, **options):
        target.write_bytes(b"precious")
        return read(path, **options)

    monkeypatch.setattr("rigd.session._recovery.read_session", slow_reading)
    with pytest.raises(SessionExistsError, match=r"a\.mcap exists and is not overwritten"):
        recover(torn)
    assert target.read_bytes() == b"precious"
    assert sorted(p.name for p in torn.parent.iterdir()) == ["a.mcap", "a.mcap.part"]


def test_a_file_being_recorded_is_not_recovered(torn):
    with torn.open("r+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)  # as in a process that records
        with pytest.raises(SessionError, match="is still being recorded"):
            recover(torn)
        with pytest.raises(SessionError, match=r"is still being recorded\. Wait for the end"):
            read_session(torn)
    recover(torn)


def test_a_file_without_an_intact_sample_is_refused(original, tmp_path):
    path = tmp_path / "a.mcap.part"
    for length in (9, 500, original.head_bytes - 40):
        path.write_bytes(original.data[:length])
        with pytest.raises(SessionError, match=r"no sample is intact before that"):
            recover(path)
    for data, message in ((b"", "is empty"), (b"text", "is not an MCAP file")):
        path.write_bytes(data)
        with pytest.raises(SessionError, match=message):
            recover(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap.part"]


@pytest.mark.parametrize(
    ("value", "instead"),
    [
        (b"1000.0", b"1000.8"),
        (b"0.0047", b"0.0057"),
        (b"200,1297", b"200,1287"),
        (b"rest", b"test"),
    ],
)
def test_wrong_metadata_of_a_torn_file_are_ignored(original, torn, value, instead):
    data = torn.read_bytes()
    assert value in data[:400]
    torn.write_bytes(data.replace(value, instead, 1))
    session = read_session(recover(torn).path)
    assert session.metadata == original.session.metadata
    assert session.segments == original.session.segments


def test_a_damaged_attachment_is_omitted(original, torn):
    torn.write_bytes(torn.read_bytes().replace(b"rate_hz = 1000\n", b"rate_hz = 1001\n", 1))
    recovery = recover(torn)
    assert recovery.samples == 1000
    assert recovery.skipped[0].startswith("has an attachment with a wrong checksum at byte")
    session = read_session(recovery.path)
    assert list(session.attachments) == ["calibration.json"]
    assert "wrong checksum" in session.outcome["recovered_left_out"]


def test_the_analysis_reports_that_a_file_was_recovered(torn):
    with pytest.raises(
        SessionError, match=r"is incomplete: .* Save them with `rigd recover .*part"
    ):
        load_record(torn)
    recovery = recover(torn)
    record = load_record(recovery.path)
    assert record.outcome == "fault"
    assert any("'fault', not 'complete': Recovered from a.mcap.part" in w for w in record.warnings)
    text = "\n".join(describe(recovery.path).lines())
    assert "from: a.mcap.part" in text
    assert "bytes_lost: 300" in text


def write_plainly(path, samples, *, use_chunking):
    """Write with the plain mcap package, without an end."""
    stream = path.open("wb")
    writer = Writer(stream, use_chunking=use_chunking, chunk_size=20_000)
    writer.start()
    keys = ("beam_length_m", "beam_density_kg_per_m", "beam_bending_stiffness_n_m2")
    writer.add_metadata("session", {"rate_hz": "1000"} | dict.fromkeys(keys, "0.5"))
    schema = writer.register_schema("rigd.Sample", "protobuf", schemas()["rigd.Sample"])
    channel = writer.register_channel("/rig/sample", "protobuf", schema)
    other = writer.register_channel("/lab/temperature", "json", 0)
    for tick, message in enumerate(samples):
        writer.add_message(channel, tick * 10**6 + 77, message, 0, tick)
        if tick % 100 == 0:
            writer.add_message(other, tick * 10**6, b"21.5", 0)
    stream.flush()
    data = path.read_bytes()
    stream.close()
    return data


@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_torn_third_party_file_is_recovered_with_a_warning(original, tmp_path, use_chunking):
    rows = original.session.samples[:700]
    messages = [packed(row) for row in rows]
    path = tmp_path / "b.mcap.part"
    data = write_plainly(path, messages, use_chunking=use_chunking)
    path.write_bytes(data[:-10])
    recovery = recover(path)
    assert not recovery.protected
    assert "no checksum covers the metadata" in recovery.lines()[-1]
    session = read_session(recovery.path)
    n = len(session.samples)
    assert n > 500
    assert session.samples["angle_rad"].tolist() == rows["angle_rad"][:n].tolist()
    assert session.metadata["rate_hz"] == "1000"
    with recovery.path.open("rb") as stream:
        temperatures = [
            record
            for record in StreamReader(stream).records
            if type(record).__name__ == "Message" and record.data == b"21.5"
        ]
    assert len(temperatures) >= n // 100
    warnings = load_record(recovery.path).warnings
    assert any("whose metadata no checksum covered" in text for text in warnings)


def packed(row):
    return encode_samples({name: row[name] for name in row.dtype.names})


def test_the_progress_runs_from_start_to_end(torn):
    fractions = []
    recover(torn, fractions.append)
    assert fractions == sorted(fractions)
    assert np.isclose(fractions[-1], 1.0)
    assert fractions[0] < 0.3
