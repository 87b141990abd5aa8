"""Sessions of a folder: their rows, with any other files next to them, and filters."""

import os
import time
from datetime import datetime

import pytest
from library_folders import START_UTC_NS, mode

from rigd.errors import UserError
from rigd.library import list_sessions
from rigd.session import SessionWriter, Validity


def test_row_combines_file_quick_look_and_report(
    record_briefly, write_quick_look, write_report, tmp_path
):
    path = record_briefly("first", specimen="antenna 3", operator="Ada", note="dry air",
                  meta_temperature_c="21.4", meta_batch="7")  # fmt: skip
    write_quick_look(path, mode(2.5))
    write_report(path, mode(2.6))
    last = write_report(path, mode(2.61), mode(16.3), number=12)
    (row,) = list_sessions(tmp_path)
    assert (row.id, row.path, row.size_bytes) == ("first", path, path.stat().st_size)
    assert (row.start_utc_ns, row.profile) == (START_UTC_NS, "sim")
    assert (row.specimen, row.operator, row.note) == ("antenna 3", "Ada", "dry air")
    assert (row.outcome, row.reason, row.problem) == ("complete", "", "")
    assert (row.scheduled, row.recorded, row.missed, row.late, row.lost) == (1010, 1000, 7, 2, 3)
    assert row.duration_s == 1.01
    assert row.meta == {"temperature_c": 21.4, "batch": "7"}
    assert row.report == last / "report.html"
    assert [each.frequency_hz.value for each in row.modes] == [2.61, 16.3]
    assert row.modes[0].damping_ratio.interval_95 == pytest.approx([0.0045, 0.0055])


def test_modes_come_with_the_validity_of_their_source(
    record_briefly, write_quick_look, write_report, tmp_path
):
    of_quick_look, of_report = Validity(0.6, 0.12).as_json(), Validity(0.1, 0.003).as_json()
    for name, quick_look, report, expected in (
        ("a", of_quick_look, None, of_quick_look),
        ("b", of_quick_look, of_report, of_report),
        ("c", {}, None, Validity().as_json()),  # of before an update: not known
    ):
        path = record_briefly(name)
        write_quick_look(path, mode(2.5), validity=quick_look)
        if report is not None:
            write_report(path, mode(2.6), validity=report)
        for _ in "read", "from the index":
            assert {row.id: row.validity for row in list_sessions(tmp_path)}[name] == expected
    record_briefly("without_modes")
    assert {row.id: row.validity for row in list_sessions(tmp_path)}["without_modes"] is None


@pytest.mark.parametrize("rate_hz", ["1e-310", "0"])
def test_impossible_rate_gives_no_duration(record_briefly, tmp_path, rate_hz):
    record_briefly("first", rate_hz=rate_hz)
    (row,) = list_sessions(tmp_path)
    assert row.duration_s is None


def test_modes_come_from_the_quick_look_without_a_report(
    record_briefly, write_quick_look, tmp_path
):
    modes = [mode(2.5) | {"shown": True}, mode(16.3) | {"shown": False}]
    write_quick_look(record_briefly("first"), *modes)
    (row,) = list_sessions(tmp_path)
    assert [each.frequency_hz.value for each in row.modes] == [2.5]
    assert row.report is None


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[1]", b'{"version": 1, "modes": 7}', b"[" * 100_000,
     b'{"version": 1, "modes": [7, {}, {"frequency_hz": {"value": "a"}}]}'],
)  # fmt: skip
def test_invalid_quick_look_gives_no_modes(record_briefly, tmp_path, content):
    record_briefly("first").with_suffix(".look.json").write_bytes(content)
    (row,) = list_sessions(tmp_path)
    assert (row.modes, row.outcome) == ((), "complete")


def test_truncated_and_other_files_are_listed_with_their_error(record_briefly, tmp_path):
    torn = record_briefly("torn", specimen="antenna 3", day=1)
    content = torn.read_bytes()
    (tmp_path / "torn.mcap.part").write_bytes(content[: len(content) // 2])
    torn.unlink()
    record_briefly("good")
    (tmp_path / "text.mcap").write_text("no session at all")
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "dangling.mcap").symlink_to("nowhere")
    (tmp_path / "beside.txt").touch()
    rows = {row.path.name: row for row in list_sessions(tmp_path)}
    assert rows.keys() == {
        "good.mcap", "torn.mcap.part", "text.mcap", "empty.mcap", "folder.mcap", "dangling.mcap"
    }  # fmt: skip
    assert rows["good.mcap"].problem == ""
    assert (rows["torn.mcap.part"].outcome, rows["torn.mcap.part"].specimen) == (
        "incomplete", "antenna 3"
    )  # fmt: skip
    assert "rigd recover" in rows["torn.mcap.part"].problem
    assert rows["torn.mcap.part"].recorded is None
    assert rows["torn.mcap.part"].id == "torn"
    for name in ("text.mcap", "empty.mcap", "folder.mcap", "dangling.mcap"):
        assert rows[name].outcome == "unreadable"
        assert name in rows[name].problem


def test_running_session_is_distinguished_from_a_truncated_one(tmp_path):
    writer = SessionWriter(tmp_path / "now.mcap")
    writer.begin(START_UTC_NS, {"rate_hz": "1000.0", "specimen": "antenna 3"}, {}, {})
    (row,) = list_sessions(tmp_path)
    assert (row.id, row.outcome, row.specimen) == ("now", "recording", "antenna 3")
    writer.close({"outcome": "complete"})
    (row,) = list_sessions(tmp_path)
    assert (row.path.name, row.outcome, row.recorded) == ("now.mcap", "complete", 0)


def test_damaged_file_with_its_end_is_reported(record_briefly, tmp_path):
    path = record_briefly("first")
    content = bytearray(path.read_bytes())
    content[len(content) // 3 :: 50] = bytes(len(content[len(content) // 3 :: 50]))
    content[-100:] = path.read_bytes()[-100:]
    path.write_bytes(content)
    (row,) = list_sessions(tmp_path)
    assert row.outcome in ("incomplete", "unreadable")
    assert row.problem


def test_texts_of_a_file_are_escaped_for_a_terminal(record_briefly, tmp_path):
    record_briefly("first", specimen="\x1b[2J" + "x" * 5000)
    (row,) = list_sessions(tmp_path)
    assert row.specimen.isprintable()
    assert len(row.specimen) < 1100


def test_name_with_invalid_text_is_listed(record_briefly, tmp_path):
    record_briefly("first").rename(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.mcap"))
    for _ in range(2):
        (row,) = list_sessions(tmp_path)
        assert row.outcome == "complete"


def test_filters(record_briefly, tmp_path):
    record_briefly("a", specimen="antenna 3", operator="Ada", day=0, note="after glueing")
    record_briefly("b", specimen="Antenna 4", excitation="step", day=1, outcome="stopped")
    record_briefly("c", specimen="antenna 3", day=2, meta_humidity_percent="40.0")

    def ids(**filters):
        return [row.id for row in list_sessions(tmp_path, **filters)]

    assert ids() == ["c", "b", "a"]
    assert ids(specimen="antenna 3") == ["c", "a"]
    assert ids(specimen="antenna 4") == ["b"]
    assert ids(operator="ADA") == ["a"]
    assert ids(excitation="step") == ids(outcome="stopped") == ["b"]
    assert ids(text="GLUEING") == ["a"]
    assert ids(text="humidity_percent=40") == ["c"]
    assert ids(specimen="antenna 3", outcome="stopped") == []


def test_dates_are_local_and_the_last_day_is_included(record_briefly, tmp_path, monkeypatch):
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        record_briefly("a", day=0)  # 2023-11-15T07:13:20 there
        record_briefly("b", day=1)

        def ids(**filters):
            return [row.id for row in list_sessions(tmp_path, **filters)]

        assert ids(since="2023-11-15", until="2023-11-15") == ["a"]
        assert ids(since="2023-11-15T07:13:20") == ["b", "a"]
        assert ids(since="2023-11-15T07:14") == ["b"]
        assert ids(until="2023-11-15T07:14") == ["a"]
        assert ids(until="2023-11-14T22:14+00:00") == ["a"]
        assert ids(since=datetime(2023, 11, 16)) == ["b"]
        assert ids(until="2023-11-14") == []
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize("given", ["yesterday", "2026-13-01", "9" * 400])
def test_invalid_date_is_refused(tmp_path, given):
    with pytest.raises(UserError, match=r"since = .* 2026-11-20"):
        list_sessions(tmp_path, since=given)


@pytest.mark.parametrize("name", ["nowhere", "file"])
def test_non_folder_is_refused(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=f"{name}: the folder cannot be listed"):
        list_sessions(tmp_path / name)
