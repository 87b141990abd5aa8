"""`--method record`: the whole record alone, with nothing of the paper's route."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import further
from typer.testing import CliRunner

from analysis.cli.app import app
from analysis.results import whole_record

pytestmark = pytest.mark.fit


@pytest.fixture(scope="module")
def brief_signals(make_signals):
    return make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3)


@pytest.fixture(scope="module", autouse=True)
def fitted_once():
    """Have the record of these tests fitted once, for any excitation stated in its file."""
    first = []

    def fitted(record, fixed, band_hz):
        assert band_hz == (1.0, 20.0)
        if not first:
            first.append(whole_record(record, fixed, band_hz))
        np.testing.assert_array_equal(first[0].record.torque_nm, record.torque_nm)
        return replace(first[0], record=record)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.results.whole_record", fitted)
        yield


@pytest.fixture(scope="module")
def done(write_session, brief_signals, tmp_path_factory, without_drawing):
    folder = tmp_path_factory.mktemp("record")
    path = write_session(folder / "a.mcap", brief_signals)
    options = ("--method", "record", "--band", "1,20", "--weights", "omega")
    with without_drawing():
        result = CliRunner().invoke(app, [str(path), *options, "--json", str(folder / "a.json")])
    assert result.exit_code == 0, result.stderr
    return result, folder, json.loads((folder / "a.json").read_text())


def test_only_the_whole_record_is_fitted_and_by_every_type(done):
    result, _, content = done
    assert {fit["estimator"] for fit in content["fits"]} == {"record"}
    assert {fit["type"] for fit in content["fits"]} == {"I", "II", "III", "IV", "V", "VI", "VII"}
    assert {mode["estimator"] for mode in content["modes"]} == {"record"}
    (record,) = content["records"]
    assert record["verdict"][0] in " ".join(result.stdout.split())
    assert "weights" not in result.stdout


def test_the_file_is_described_without_settings_of_the_paper(done):
    (file,) = done[2]["files"]
    assert (file["samples"], file["rate_hz"]) == (5500, 1000.0)
    assert "settings" not in file


def test_the_report_has_no_figure_of_the_paper(done):
    report = done[1] / "a.report"
    assert sorted(path.name for path in report.iterdir()) == [
        "SHA256SUMS", "analysis.json", "figures", "report.html", "tables", "tables.txt",
    ]  # fmt: skip
    assert "a.mcap: verdict" in (report / "tables.txt").read_text()


def test_options_without_effect_are_reported(done):
    (warning,) = done[0].stderr.splitlines()
    assert warning.startswith("Warning: --weights concerns the Welch fits alone, which --method")


def test_band_is_that_of_the_whole_record(done):
    (record,) = done[2]["records"]
    assert record["band_hz"] == [1.0, 20.0]
    assert {mode["mode"] for mode in done[2]["modes"]} == {1, 2}


@pytest.mark.parametrize("method", ["all", further("record")])
def test_warnings_are_reported_without_welch_fits(
    write_session, brief_signals, tmp_path, monkeypatch, without_drawing, method
):
    """They went to page and JSON alone."""
    monkeypatch.chdir(tmp_path)
    write_session("a.mcap", brief_signals, metadata={"excitation": "touch"})
    brief = ("--band", "1,20")
    with without_drawing():
        result = CliRunner().invoke(app, ["a.mcap", "--method", method, "--report", method, *brief])
    assert result.stdout.count("Warning: The session is a touch") == 1
    assert result.output.count("Welch fits left out") == (method == "all")


def test_common_warning_is_printed_once(
    write_session, brief_signals, tmp_path, monkeypatch, without_drawing
):
    monkeypatch.chdir(tmp_path)
    for name in ("a.mcap", "b.mcap"):
        write_session(name, brief_signals, metadata={"excitation": "touch"})
    options = ("--each", "--band", "1,20", "--report", "r", "--json", "r.json")
    with without_drawing():
        result = CliRunner().invoke(app, ["a.mcap", "b.mcap", *options])
    assert result.exit_code == 0, result.stderr
    (line,) = result.stderr.splitlines()
    assert line.startswith("Warning: all 2 files: Welch fits left out")
    assert result.stdout.count("Warning: ") == 1
    assert "Warning: all 2 files: The session is a touch" in result.stdout
    files = json.loads((tmp_path / "r.json").read_text())["files"]
    assert all(any("left out" in text for text in file["warnings"]) for file in files)
