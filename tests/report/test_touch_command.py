"""`analyze touch`: table, JSON, report, and messages on wrong requests."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.cli.app import app
from analysis.report.table import csv_text
from analysis.report.touch_report import touches_document, touches_table, write_touch_report
from rigd.session import SessionWriter


@pytest.fixture
def analyze(monkeypatch, touch_analysis, touch_file, touched):
    """Run the command; the file is analysed once for all tests."""

    class Analysed:
        def analyse_session(self, path, *options):
            if path == touch_file.path:
                return touched
            return touch_analysis.analyse_session(path, *options)

    monkeypatch.setattr(
        "analysis.touch.TouchAnalysis", lambda model: Analysed() if model is None else None
    )
    return lambda *arguments: CliRunner().invoke(app, ["touch", *map(str, arguments)])


def test_touches_are_printed_and_written_as_json(analyze, touch_file, tmp_path):
    out = tmp_path / "touches.json"
    result = analyze(touch_file.path, "--json", out)
    assert result.exit_code == 0, result.output
    assert "touch.mcap: 1 touch, detected during the session. Model: the nominal" in result.stdout
    assert "obstacle at rest" in result.stdout
    (touch,) = json.loads(out.read_text())["touches"]
    assert touch["file"] == str(touch_file.path)
    low, high = touch["x_m"]["interval_95"]
    assert low < touch["x_m"]["value"] < high
    assert (touch["number"], touch["kind"], touch["detected"]) == (1, "rigid", "loop")


def test_json_alone_on_standard_output(analyze, touch_file):
    result = analyze(touch_file.path, "--json", "-")
    assert len(json.loads(result.stdout)["touches"]) == 1
    assert "1 touch" in result.stderr


def test_unreadable_file_does_not_stop_the_others(analyze, touch_file, tmp_path):
    result = analyze(touch_file.path, tmp_path / "none.mcap", "--json", tmp_path / "a.json")
    assert result.exit_code == 1
    assert "Error: " in result.stderr
    assert "none.mcap cannot be read" in result.stderr
    document = json.loads((tmp_path / "a.json").read_text())
    assert len(document["touches"]) == len(document["errors"]) == 1


@pytest.mark.parametrize("option", ["--json", "--report"])
def test_nothing_is_overwritten(analyze, touch_file, tmp_path, option):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()
    result = analyze(touch_file.path, option, tmp_path / "there")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"Error: {option} ")


def test_wrong_model_ends_the_command(touch_file, tmp_path):
    (tmp_path / "m.json").write_text("[]")
    arguments = ["touch", str(touch_file.path), "--model", str(tmp_path / "m.json")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"Error: {tmp_path / 'm.json'}: has no headlines")


def test_a_session_may_be_called_touch(touch_file, tmp_path):
    (tmp_path / "touch.mcap").write_bytes(b"")
    result = CliRunner().invoke(app, [str(tmp_path / "touch.mcap"), "--method", "record"])
    assert "is empty, nothing was recorded to it" in result.stderr


def test_a_session_without_samples_is_refused(analyze, tmp_path):
    writer = SessionWriter(tmp_path / "a.mcap")
    writer.begin(0, {"rate_hz": "1000.0"}, {}, {})
    result = analyze(writer.close({"outcome": "complete"}))
    assert result.exit_code == 1
    assert "a.mcap: the session holds no samples" in result.stderr


def test_the_report_has_a_map_and_the_evidence(touched, tmp_path, without_drawing):
    with without_drawing():
        write_touch_report([touched, touched], {"b.mcap": "b.mcap is damaged."}, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "<title>2 sessions: touches</title>" in page
    assert "Left out: b.mcap is damaged." in page
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names >= {"map.svg", "touch_1.svg", "touch_2.svg"}
    assert page.count("<figure ") == 3
    assert "http" not in page.replace("http://www.w3.org", "")
    assert json.loads((tmp_path / "touches.json").read_text()) == touches_document(
        [touched, touched], {"b.mcap": "b.mcap is damaged."}
    )


def test_ends_of_an_asymmetric_interval_are_reported(touched, tmp_path):
    (touch,) = touched.touches
    x_m = replace(touch.estimate.x_m, value=0.92, interval_95=(0.48, 0.94))
    estimate = replace(touch.estimate, x_m=x_m, kind="unknown", force_history_n=np.empty(0))
    estimate = replace(estimate, force_times_s=np.empty(0), force_n=None, time_s=None)
    session = replace(touched, touches=(replace(touch, estimate=estimate),))
    (cells,) = touches_table([session]).shown_rows
    assert "0.48 to 0.94" in [cell.text for cell in cells]
    assert "not identifiable" in [cell.text for cell in cells]
    write_touch_report([session], {}, tmp_path)
    drawn = sorted(path.stem for path in (tmp_path / "figures").glob("*.svg"))
    assert drawn == ["map", "touch_1"]


def test_the_table_has_numbers_for_programs(touched):
    (row,) = csv.DictReader(io.StringIO(csv_text(touches_table([touched]))))
    estimate = touched.touches[0].estimate
    assert float(row["x_m"]) == estimate.x_m.value
    assert float(row["x_m_std"]) == estimate.x_m.std
    assert float(row["time_s"]) == touched.touches[0].start_s + estimate.time_s.value
