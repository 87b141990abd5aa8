"""Records that were cut short, as a killed session leaves them: reported, or refused in words."""

import json
from dataclasses import replace

import pytest

from analysis.models import WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import RecordError, load_record
from analysis.report import document_text
from analysis.report.folder import write_new_file

ONE_FIT = ("--frf", "fft", "--types", "VI", "--weights", "omega")


@pytest.fixture(scope="module")
def cut(write_session, make_signals, tmp_path_factory):
    """Make a session cut to a number of samples, of a sweep past the first mode."""
    folder = tmp_path_factory.mktemp("cut")
    whole = make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3)

    def make(samples):
        path = folder / f"{samples}.mcap"
        if not path.exists():
            write_session(path, replace(whole.part(slice(0, samples)), segments=whole.segments))
        return path

    return make


@pytest.mark.fit
def test_available_results_are_reported(cut, analyze_here, tmp_path, without_drawing):
    """A record with fewer bins than tests have neighbours, figures stretches; none at a mode."""
    with without_drawing():
        result = analyze_here(cut(1700), *ONE_FIT, "--report", "r", "--json", "r.json")
    assert (result.returncode, result.stderr) == (0, "")
    content = json.loads((tmp_path / "r.json").read_text())
    assert {fit["estimator"] for fit in content["fits"]} == {"welch", "record"}
    assert "cut short" in " ".join(content["files"][0]["warnings"])
    figures = {path.name for path in (tmp_path / "r" / "figures").glob("*.svg")}
    assert figures == {
        "record_frf.svg", "loss_factor.svg", "residual.svg", "record_signals.svg", "welch_frf.svg",
    }  # fmt: skip


@pytest.mark.fit
def test_too_short_record_is_reported(cut, analyze_here, without_drawing):
    with without_drawing():
        result = analyze_here(cut(1000), *ONE_FIT, "--report", "r")
    assert result.returncode == 0
    assert "1 s of record are too short for the band" in result.stderr
    alone = analyze_here(cut(1000), "--method", "record", "--report", "alone")
    assert alone.returncode == 1
    assert alone.stderr.startswith("Error: ")
    assert "1 s of record are too short for the band" in alone.stderr


@pytest.mark.fit
def test_transform_too_coarse_for_a_mode_is_reported(cut):
    settings = WelchSettings(estimator="fft", types=("I",), weightings=("const",))
    (warning,) = (w for w in analyse(load_record(cut(390)), settings).warnings if "resolves" in w)
    assert (
        "A transform of 0.39 s resolves 2.56 Hz and cannot show the first mode, at 2.55" in warning
    )
    assert not [w for w in analyse(load_record(cut(2200)), settings).warnings if "resolves" in w]


def test_record_too_short_for_any_mode_names_all_causes(write_session, short_signals, tmp_path):
    few = replace(short_signals.part(slice(0, 30)), segments={})
    with pytest.raises(
        RecordError, match=r"which 0\.03 s at 1000 Hz cannot show; record longer, or"
    ):
        load_record(write_session(tmp_path / "few.mcap", few))


def test_file_name_with_invalid_text_is_accepted(tmp_path):
    name = "caf\udce9.mcap"
    write_new_file(tmp_path / "a.json", document_text({"file": name}))
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"file": name}
