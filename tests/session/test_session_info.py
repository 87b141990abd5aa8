"""Summary of a session file."""

import json
import time

import numpy as np
import pytest

from rigd.session import SessionError, SessionWriter, describe
from rigd.session.layout import Status


@pytest.fixture
def gappy(kit, tmp_path):
    """Ticks 100…119 and 150…199; two samples late, one saturated."""
    samples = kit.make_samples(100, first_tick=100)
    samples["status"] = 0
    samples["status"][3] = Status.LATE
    samples["status"][60] = Status.LATE | Status.TORQUE_SATURATED
    samples = np.concatenate([samples[:20], samples[50:]])
    writer = SessionWriter(tmp_path / "a.mcap")
    metadata = kit.METADATA | {"note": "red\x1b[31m\nsecond line"}
    writer.begin(kit.START_UTC_NS, metadata, kit.SEGMENTS, kit.ATTACHMENTS)
    writer.write_samples(kit.packed(samples))
    writer.log(1_500_000_000, "error", "too fast")
    return writer.close({"outcome": "stopped", "reason": "angle limit"})


def test_counts(gappy):
    info = describe(gappy)
    assert (info.samples, info.ticks, info.missing_ticks) == (70, 100, 30)
    assert info.duration_s == 0.1
    assert info.status_counts == {"torque_saturated": 1, "late": 2}
    assert info.start_utc == "2023-11-14T22:13:20.123456+00:00"
    assert info.attachments == {"profile.toml": 6, "calibration.json": 2}
    assert info.size_bytes == gappy.stat().st_size


@pytest.mark.parametrize("stated", [{"recorded": "900", "scheduled": "900"}, {}])
def test_a_trimmed_copy_is_not_complete(kit, tmp_path, stated):
    writer = SessionWriter(tmp_path / "a.mcap")
    writer.begin(kit.START_UTC_NS, kit.METADATA, kit.SEGMENTS, kit.ATTACHMENTS)
    writer.write_samples(kit.packed(kit.make_samples(300, first_tick=100)))
    info = describe(writer.close(kit.OUTCOME | stated))
    text = "\n".join(info.lines())
    assert "outcome" in text
    assert "Complete" not in text
    assert "it was trimmed" in text
    assert ("600 of the 900 samples" if stated else "Samples of rest and sweep") in text
    assert "ticks 100 to 399" in text
    assert info.as_dict()["absent"] == info.missing_samples_text


def test_no_omissions_of_a_whole_session(kit, tmp_path):
    writer = SessionWriter(tmp_path / "a.mcap")
    writer.begin(kit.START_UTC_NS, kit.METADATA, kit.SEGMENTS, kit.ATTACHMENTS)
    writer.write_samples(kit.packed(kit.make_samples(900)))
    counts = {"recorded": "900", "scheduled": "900", "missed": "0", "late": "0", "lost": "0"}
    info = describe(writer.close(kit.OUTCOME | counts))
    assert info.missing_samples_text == ""
    assert any(
        line.endswith("Complete: 900 of 900 samples, 0 missed, 0 late") for line in info.lines()
    )


def test_the_document_is_json(gappy, kit):
    document = json.loads(json.dumps(describe(gappy).as_dict()))
    assert document["segments"] == {"rest": [0, 10], "sweep": [10, 900]}
    assert document["outcome"] == {"outcome": "stopped", "reason": "angle limit"}
    assert document["metadata"]["operator"] == kit.METADATA["operator"]
    assert document["events"] == [
        {"t_ns": 1_500_000_000, "level": "error", "name": "rigd", "message": "too fast"}
    ]


def test_the_lines_have_no_control_characters(gappy):
    lines = describe(gappy).lines()
    assert all(line.isprintable() for line in lines)
    text = "\n".join(lines)
    for part in (
        "Stopped. angle limit",
        "70 at 1000 Hz, 0.1 s, 30 ticks missing",
        "late: 2 samples",
        "sweep: 10 to 900 (0.89 s)",
        "1.500 s",
        "error: too fast [rigd]",
        "red?[31m?second line",
    ):
        assert part in text


def test_a_file_without_rate_is_refused(kit, tmp_path):
    path = kit.write_third_party(tmp_path / "a.mcap", [], metadata=None)
    with pytest.raises(SessionError, match=r"a\.mcap.*has no rate_hz"):
        describe(path)


@pytest.mark.parametrize("rate", ["0", "-1000"])
def test_a_rate_that_is_not_positive_is_refused(kit, tmp_path, rate):
    path = kit.write_third_party(tmp_path / "a.mcap", [], metadata={"rate_hz": rate})
    with pytest.raises(SessionError, match=r"a\.mcap.*rate_hz .*must be greater than 0 Hz"):
        describe(path)


def test_numbers_are_rounded_and_times_local(kit, tmp_path, monkeypatch):
    writer = SessionWriter(tmp_path / "a.mcap")
    metadata = {
        "tare_mean_fx_n": "0.40008999999999867", "beam_length_m": "0.98", "series": "1 of 2",
        "sensor_projection": "0.0,0.0,-1.0", "simulation_seed": "3",
    }  # fmt: skip
    writer.begin(kit.START_UTC_NS, kit.METADATA | metadata, kit.SEGMENTS, {})
    writer.write_samples(kit.packed(kit.make_samples(1000)))
    counts = dict.fromkeys(("missed", "late", "lost", "stale_angles", "stale_wrenches"), "0")
    end = {"end_utc_ns": str(kit.START_UTC_NS), "tare_drift_nm": "-6.112500000000909e-05"}
    path = writer.close(
        {"outcome": "complete", "reason": "", "scheduled": "1000", "recorded": "1000"}
        | counts
        | end
    )
    try:
        monkeypatch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        rows = dict(line.split("  ", 1) for line in describe(path).lines())
    finally:
        monkeypatch.undo()
        time.tzset()
    rows = {key: value.strip() for key, value in rows.items()}
    assert rows["started"] == "2023-11-14 22:13:20 UTC (2023-11-14 23:13:20 CET)"
    assert rows["end"] == rows["started"]
    assert rows["outcome"] == "Complete: 1000 of 1000 samples, 0 missed, 0 late"
    assert rows["tare drift"] == "-6.11e-05 N·m"
    assert rows["tare mean fx"] == "0.4 N"
    assert rows["beam length"] == "0.98 m"
    assert rows["sensor projection"] == "0, 0, -1"
    assert rows["simulation seed"] == "3"
    assert rows["series"] == "1 of 2"


def test_several_files_are_described_in_turn(gappy, rigd_here, tmp_path):
    done = rigd_here("info", gappy, "missing.mcap", gappy)
    assert done.returncode == 1
    assert done.stdout.count("outcome ") == 2
    assert done.stderr.startswith("Error: missing.mcap cannot be read")
    done = rigd_here("info", "--json", gappy, "missing.mcap")
    first, second = json.loads(done.stdout)["files"]
    assert first == describe(gappy).as_dict()
    assert second["path"] == "missing.mcap"
    done = rigd_here("info", "--json", gappy)
    assert (done.returncode, json.loads(done.stdout)) == (0, first)


def test_progress_increases_while_a_file_is_read(gappy):
    fractions = []
    describe(gappy, fractions.append)
    assert fractions == sorted(fractions)
    assert 0.0 < fractions[-1] <= 1.0
