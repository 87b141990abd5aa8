"""``rigd list``: a table, the trend of a specimen, and JSON."""

import json
import time

import pytest
from library_folders import mode
from typer.testing import CliRunner

from rigd.cli.app import app


@pytest.fixture
def run_list(tmp_path, monkeypatch):
    """Run `rigd list` in the time zone of Tokyo; return its result."""
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    monkeypatch.chdir(tmp_path)
    yield lambda *arguments: CliRunner().invoke(app, ["list", *map(str, arguments)])
    monkeypatch.undo()
    time.tzset()


@pytest.fixture
def sessions(record_briefly, write_quick_look, write_report):
    """Two sessions of a specimen, one of another, and a text."""
    first = record_briefly("first", specimen="antenna 3", operator="Ada")
    write_quick_look(first, mode(2.600, 0.002, 0.00910, 0.00008), mode(16.3))
    second = record_briefly("second", specimen="antenna 3", day=1.5, outcome="stopped")
    write_report(
        second,
        mode(2.570, 0.002, 0.00905, 0.00008),
        mode(16.3),
        validity={
            "predicted_peak_tip_slope_rad": 0.6,
            "linear_model_error": 0.12,
            "uniform_beam": {"status": "refused", "p_value": 2e-18},
        },
    )
    record_briefly("third", specimen="antenna 4", day=2)
    second.with_name("text.mcap").write_text("no session")


@pytest.mark.usefixtures("sessions")
def test_newest_first_with_modes_and_problems(run_list):
    lines = run_list(".").stdout.splitlines()
    assert [line.split("  ")[0] for line in lines[:4]] == [
        "date", "2023-11-17 07:13", "2023-11-16 19:13", "2023-11-15 07:13"
    ]  # fmt: skip
    assert [cell.strip() for cell in lines[2].split("  ") if cell.strip()][1:] == [
        "second.mcap", "antenna 3", "chirp", "stopped", "2.57 Hz 0.905 %, 16.3 Hz 0.5 %",
        "0.6 rad, error ≤ 12 %", "no (p = 2e-18)", "report",
    ]  # fmt: skip
    assert "unknown" in lines[3]  # the quick look of the first session states no slope
    assert "unknown" not in lines[1] + lines[2]
    assert "text.mcap" in lines[4]
    assert lines[5].startswith("text.mcap: ")
    assert "is not an MCAP file" in lines[5]


@pytest.mark.usefixtures("sessions")
def test_trend_marks_changes_beyond_the_intervals(run_list):
    lines = run_list(".", "--specimen", "antenna 3", "--trend").stdout.splitlines()
    first, second = lines[1:3]
    assert first.startswith("2023-11-15 07:13  2.6000 ± 0.0020 ")
    assert "-1.2 % *" in second
    assert "-0.55 % " in second
    assert second.count("*") == 1
    assert first.index("●") > second.index("●")
    assert "unknown" in first
    assert "0.6 rad, error ≤ 12 %" in second
    assert lines[4].startswith("mode 2")
    assert "*" not in "".join(lines[4:7])


@pytest.mark.usefixtures("sessions")
def test_a_trend_is_of_one_specimen(run_list, write_quick_look, record_briefly):
    write_quick_look(record_briefly("fourth", day=3), mode(9.0))
    refused = run_list(".", "--trend")
    assert refused.exit_code == 2
    assert "--specimen" in refused.stderr
    assert "'antenna 3'" in refused.stderr
    assert "none" in refused.stderr


@pytest.mark.usefixtures("sessions")
def test_json_has_rows_and_trends(run_list):
    document = json.loads(run_list(".", "--specimen", "antenna 3", "--trend", "--json").stdout)
    assert [row["id"] for row in document["sessions"]] == ["second", "first"]
    assert document["sessions"][0]["report"].endswith("second.report/report.html")
    change = document["trends"][0]["points"][1]["frequency_change"]
    assert change == {"difference": pytest.approx(-0.03), "significant": True}


def test_specimens_are_listed_with_their_beams_and_problems(run_list, tmp_path):
    folder = tmp_path / "specimens"
    folder.mkdir()
    beam = "[beam]\n" + "".join(
        f'{key} = {{ value = {value}, source = "paper" }}\n'
        for key, value in (
            ("length_m", 0.95), ("density_kg_per_m", 4.7e-3), ("bending_stiffness_n_m2", 0.09)
        )
    )  # fmt: skip
    (folder / "antenna 4.toml").write_text(f"note = 'steel'\n{beam}")
    (folder / "broken.toml").write_text("[beam]")
    lines = CliRunner().invoke(app, ["specimens"]).stdout.splitlines()
    assert lines == [
        "antenna 4: 0.95 m, 0.0047 kg/m, 0.09 N·m², steel (specimens/antenna 4.toml)",
        "broken: cannot be used: specimens/broken.toml: section [beam] is missing.",
    ]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--meta", "temperature_c"], "--meta 'temperature_c': must be NAME=VALUE"),
        (["--meta", "batch=1", "--meta", "batch=2"], "--meta 'batch=2': is given twice"),
        (["--meta", "temperature_c=21,4"], "temperature_c = '21,4' is not a finite number"),
    ],
)
def test_invalid_metadata_is_refused_before_the_start(options, expected):
    refused = CliRunner().invoke(app, ["run", "hold", *options])
    assert refused.exit_code == 2
    assert expected in refused.stderr


def test_completion_of_the_shell_can_be_installed():
    words = {"_RIGD_COMPLETE": "complete_bash", "COMP_WORDS": "rigd ru", "COMP_CWORD": "1"}
    completed = CliRunner().invoke(app, [], prog_name="rigd", env=words)
    assert completed.stdout.split() == ["run"]


def test_several_folders_and_an_error_for_a_missing_one(run_list, record_briefly, tmp_path):
    path = record_briefly("first")
    other = tmp_path / "other"
    other.mkdir()
    path.rename(other / "late.mcap")
    record_briefly("second", day=1)
    lines = run_list(".", "other").stdout.splitlines()
    assert [line.split()[2] for line in lines[1:]] == ["second.mcap", "late.mcap"]
    missing = run_list("sessions")
    assert missing.exit_code == 2
    assert "sessions: the folder cannot be listed" in missing.stderr
    first = run_list()
    assert first.exit_code == 0
    assert first.stdout.startswith("No sessions yet: ")
    assert "rigd run chirp --fast" in first.stdout
    assert json.loads(run_list("--json").stdout) == {"sessions": []}
    (tmp_path / "sessions").mkdir()
    assert run_list().stdout == "No sessions.\n"
