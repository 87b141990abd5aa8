"""Quick look: its findings against those of `select`; the last session; the file; the program."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warm_start
from processes import eventually, has_ended

from analysis import quick_look
from analysis.identify import Measurement, fit_freest_alone
from analysis.quick_look import QuickLookError, make_quick_look, write_quick_look
from analysis.record import load_record
from analysis.results import whole_record
from rigd.beam import transfer
from rigd.estimates import modes_from_json
from rigd.session.quick_look import quick_look_path


@pytest.fixture(scope="module")
def judgements():
    """Whole judgements by name of the file, each made once."""
    made = {}

    def once(record):
        if record.path.name not in made:
            made[record.path.name] = whole_record(record)
        return made[record.path.name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.results.whole_record", once)
        yield made


@pytest.fixture(scope="module")
def chirps(short_chirps, judgements, tmp_path_factory):
    """Both chirps in their own folder, and their quick looks in turn."""
    folder = tmp_path_factory.mktemp("looks")
    paths = [Path(shutil.copy(path, folder)) for path in short_chirps]
    documents = []
    for path in paths:
        documents.append(make_quick_look(path))
        write_quick_look(documents[-1], path)
    return paths, documents


@pytest.fixture(scope="module")
def whole(chirps, judgements):
    paths, _ = chirps
    return judgements[paths[0].name]


@pytest.fixture(scope="module")
def selection(whole):
    return whole.selection


@pytest.mark.fit
@pytest.mark.process
def test_modes_equal_those_of_the_full_analysis(chirps, selection):
    _, (document, _) = chirps
    assert [mode["mode"] for mode in document["modes"]] == [1, 2, 3]
    for found, mode in zip(document["modes"], selection.headline.modes, strict=True):
        assert found["frequency_hz"] == mode.frequency_hz.as_json()
        assert found["damping_ratio"] == mode.damping_ratio.as_json()
        assert found["shown"] is mode.shown
    assert document["flags"] == [finding.sentence for finding in selection.verdict.findings]


@pytest.mark.fit
@pytest.mark.process
def test_modes_have_their_validity(chirps, whole):
    """The files state no slope: it is that of the full analysis, by the fitted beam."""
    _, (document, _) = chirps
    assert document["validity"] == whole.validity.as_json()
    assert document["validity"]["predicted_peak_tip_slope_rad"] > 0.05
    assert f"  {whole.validity.sentence}" in document["text"]


@pytest.mark.fit
@pytest.mark.process
def test_response_preserves_resonance_peaks(chirps):
    _, (document, _) = chirps
    response = document["response"]
    hz, magnitude = (np.array(response[name]) for name in ("frequency_hz", "magnitude"))
    assert 200 < hz.size <= 400
    assert (np.diff(hz) > 0).all()
    assert {len(values) for values in response.values() if isinstance(values, list)} == {hz.size}
    assert 0.01 < response["resolution_hz"] < 1.0
    for mode in document["modes"][:2]:
        near = np.abs(hz - mode["frequency_hz"]["value"]) < 1.0
        assert magnitude[near].max() > 3 * np.median(magnitude)
    low = document["coherence"]["low_bands"]
    assert 0.4 < document["coherence"]["mean"] < 1.0
    assert all(0.5 <= first < last < 51 for first, last in low)


def test_low_bands_are_joined():
    hz = np.arange(100) * 0.1 + 10.0
    low = np.zeros(100, bool)
    low[[5, 40, 41, 42, 45, 99]] = True  # single bins are narrower than the resolution
    assert list(quick_look._join_bins(hz, low, 0.15)) == [
        (pytest.approx(14.0), pytest.approx(14.5))
    ]
    assert list(quick_look._join_bins(hz, ~low, 0.15)) == [(10.0, pytest.approx(19.8))]


@pytest.mark.fit
@pytest.mark.process
def test_the_last_session_of_the_specimen_is_compared_with(chirps):
    paths, (first, second) = chirps
    assert first["against_last"] is None
    against = second["against_last"]
    assert against["file"] == paths[0].name
    assert against["sentence"].startswith(f"No significant change against {paths[0].stem} (mode 1")
    for mode, before, after in zip(against["modes"], first["modes"], second["modes"], strict=True):
        change = after["frequency_hz"]["value"] - before["frequency_hz"]["value"]
        assert mode["frequency_hz_change"] == change
        ratio = after["damping_ratio"]["value"] / before["damping_ratio"]["value"]
        assert mode["damping_ratio_change_percent"] == pytest.approx(100 * (ratio - 1))
        assert mode["significant"] is False
    # On request, an earlier one is compared with a later one too.
    assert make_quick_look(paths[0], paths[1])["against_last"]["file"] == paths[1].name


def estimated(value, std):
    interval = [value - 1.96 * std, value + 1.96 * std]
    return {"value": value, "std": std, "interval_95": interval, "flag": None}


def document_with(*hz, **others):
    modes = [
        {
            "mode": number,
            "shown": True,
            "frequency_hz": estimated(value, 0.001),
            "damping_ratio": estimated(0.01, 1e-4),
        }
        for number, value in enumerate(hz, start=1)
    ]
    common = {"version": 1, "specimen": "a", "start_utc_ns": 5, "made_utc_ns": 6}
    return common | {"file": "before.mcap", "modes": modes} | others


@pytest.mark.parametrize(
    ("unseen", "words"), [(1, "mode 1"), (2, "modes 1 and 2"), (3, "modes 1, 2 and 3")]
)
def test_invisible_modes_are_listed_in_english(unseen, words):
    document = document_with(2.5, 16.0, 44.0, session_id="now", flags=[], against_last=None)
    document["coherence"] = quick_look._empty_coherence()
    for mode in document["modes"][:unseen]:
        mode["shown"] = False
    assert f"  not visible in this record: {words}" in quick_look._text_lines(document)


def test_a_change_counts_from_three_standard_deviations_on():
    before = document_with(2.5, 16.0, 44.0)
    now = document_with(2.5 + 4.1e-3, 16.0 + 4.4e-3)
    now["modes"][1]["damping_ratio"] = estimated(0.0105, 1e-4)
    against = quick_look._compare_modes(modes_from_json(now["modes"]), before)
    assert [mode["significant"] for mode in against["modes"]] == [False, True]
    assert against["sentence"] == (
        "Significant change against before: mode 2 +0.0044 Hz, damping +5 %."
    )
    before["modes"][1]["frequency_hz"]["flag"] = "part of the record is unexplained"
    now["modes"][1]["damping_ratio"]["interval_95"] = None
    against = quick_look._compare_modes(modes_from_json(now["modes"]), before)
    assert not any(mode["significant"] for mode in against["modes"])


@pytest.mark.parametrize(
    ("name", "content", "file"),
    [
        ("newer", document_with(2.5, start_utc_ns=7, file="newer.mcap"), "newer.mcap"),
        ("older", document_with(2.5, start_utc_ns=3), "last.mcap"),
        ("other", document_with(2.5, start_utc_ns=7, specimen="b"), "last.mcap"),
        ("later", document_with(2.5, start_utc_ns=9), "last.mcap"),
        ("without", document_with(start_utc_ns=7), "last.mcap"),
        ("version", document_with(2.5, start_utc_ns=7, version=2), "last.mcap"),
        ("garbage", [1], "last.mcap"),
        ("garbage", {"file": 1, "modes": {"a": 1}}, "last.mcap"),
    ],
)
def test_last_quick_look_is_found_by_start_and_specimen(tmp_path, name, content, file):
    last = quick_look_path(tmp_path / "last.mcap")
    last.write_text(json.dumps(document_with(2.5, start_utc_ns=4, file="last.mcap")))
    quick_look_path(tmp_path / f"{name}.mcap").write_text(json.dumps(content))
    found = quick_look._last_quick_look(tmp_path / "now.mcap", "a", 8)
    assert found["file"] == file


@pytest.mark.fit
@pytest.mark.process
def test_fitted_model_lies_within_its_band(chirps, selection):
    """Its peak is the mode's, which Welch's segments do not resolve."""
    _, (document, _) = chirps
    model = {name: np.array(values) for name, values in document["model"].items()}
    hz, magnitude = model["frequency_hz"], model["magnitude"]
    assert (np.diff(hz) > 0).all()
    assert {values.size for values in model.values()} == {hz.size}
    assert (model["magnitude_low_95"] <= magnitude).all()
    assert (magnitude <= model["magnitude_high_95"]).all()
    (mode, *_) = selection.headline.modes
    s = 2j * np.pi * mode.frequency_hz.value
    plant = selection.headline.fit.plant
    peak = abs(transfer(np.array([s]), plant.beam, plant.damping)[0])
    near = np.abs(hz / mode.frequency_hz.value - 1) < 0.01
    assert magnitude[near].max() == pytest.approx(peak, rel=0.02)


@pytest.mark.fit
@pytest.mark.process
def test_long_record_is_fitted_with_freest_structure(chirps, selection, monkeypatch):
    paths, _ = chirps
    monkeypatch.setattr(quick_look, "_LONGEST_FULL_ANALYSIS_S", 10.0)
    document = make_quick_look(paths[0])
    for found, mode in zip(document["modes"], selection.headline.modes, strict=True):
        # The same structure is selected, under a noise spectrum that hardly differs.
        std = mode.frequency_hz.std
        assert found["frequency_hz"]["value"] == pytest.approx(mode.frequency_hz.value, abs=std)
        assert found["frequency_hz"]["std"] == pytest.approx(std, rel=0.3)
        assert found["frequency_hz"]["flag"] is None
    assert "type VI alone was fitted" in document["flags"][0]


@pytest.mark.process
def test_freest_structure_flags_unexplained_torque(short_chirps):
    measurement = Measurement.from_record(load_record(short_chirps[0]))
    cubic = measurement.torque_nm + 4e3 * measurement.angle_rad**3
    headline, found, _ = fit_freest_alone(replace(measurement, torque_nm=cubic))
    assert {mode.frequency_hz.flag for mode in headline.modes if mode.shown} == {
        "part of the record is unexplained"
    }
    assert found


@pytest.mark.process
@pytest.mark.further  # as the quick look at such a record
def test_freest_structure_flags_contradicting_record(short_chirps):
    measurement = Measurement.from_record(load_record(short_chirps[0]))
    headline, found, _ = fit_freest_alone(replace(measurement, torque_nm=-measurement.torque_nm))
    assert {mode.frequency_hz.flag for mode in headline.modes} == {
        "the record contradicts its file"
    }
    assert [finding.kind for finding in found] == ["sign"]


@pytest.mark.fit
def test_quick_look_states_why_a_record_is_unusable(
    write_session, short_signals, signals_of, tmp_path
):
    held = replace(short_signals, metadata={"excitation": "hold", "specimen": "a"})
    document = make_quick_look(write_session(tmp_path / "held.mcap", held))
    assert document["modes"] == []
    assert document["specimen"] == "a"
    assert document["flags"][-1].startswith("No modes: the motor was held")
    assert "No modes" in document["text"][-1]
    cut = replace(short_signals, segments={"sweep": (6000, 7000)})
    document = make_quick_look(write_session(tmp_path / "cut.mcap", cut))
    assert document["flags"][0].startswith("segment 'sweep' covers ticks 6000 to 6999")
    json.dumps(document, allow_nan=False)


@pytest.mark.fit
def test_contradicting_record_has_no_model_band(write_session, make_signals, tmp_path):
    signals = make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3)
    turned = replace(signals, torque_nm=-signals.torque_nm)
    document = make_quick_look(write_session(tmp_path / "turned.mcap", turned))
    assert document["model"] is None
    assert document["response"] is not None
    assert all(mode["frequency_hz"]["flag"] for mode in document["modes"])


@pytest.mark.fit
@pytest.mark.process
def test_text_suits_a_terminal(chirps):
    paths, (_, document) = chirps
    head, *modes = document["text"]
    assert head == f"Quick look at {paths[1].stem}; ± 95 %, statistical only:"
    assert modes[0].startswith("  mode 1: 2.5")
    assert modes[2].endswith(" kg·mm²")
    assert modes[3].startswith("  Tip slopes up to 0.")
    assert modes[4].startswith("  A uniform beam predicts the modes (p = 0.")
    assert modes[5].startswith("  mean coherence 0.")
    assert document["text"][-1] == f"  {document['against_last']['sentence']}"


def test_quick_look_is_complete_and_replaces_older_ones_only(tmp_path):
    path = tmp_path / "a.mcap"
    quick_look_file = quick_look_path(path)
    write_quick_look(document_with(2.5, made_utc_ns=6), path)
    write_quick_look(document_with(2.6, made_utc_ns=7), path)
    assert json.loads(quick_look_file.read_text())["made_utc_ns"] == 7
    write_quick_look(document_with(2.7, made_utc_ns=5), path)
    assert json.loads(quick_look_file.read_text())["made_utc_ns"] == 7
    quick_look_file.write_text("somebody else's")
    with pytest.raises(QuickLookError, match="move it away"):
        write_quick_look(document_with(2.5), path)
    assert quick_look_file.read_text() == "somebody else's"
    with pytest.raises(QuickLookError, match="cannot be written"):
        write_quick_look(document_with(2.5), tmp_path / "missing" / "a.mcap")
    assert [each.name for each in tmp_path.iterdir()] == [quick_look_file.name]


def run_quick_look(*arguments):
    return warm_start.run(
        [sys.executable, "-m", "analysis.quick_look", *map(str, arguments)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.process
def test_program_writes_and_prints_the_quick_look(write_session, short_signals, tmp_path):
    held = replace(short_signals, metadata={"excitation": "hold"})  # for which little is computed
    path = write_session(tmp_path / "held.mcap", held)
    done = run_quick_look(path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == json.loads(quick_look_path(path).read_text())["text"]
    assert done.stderr == ""


@pytest.mark.process
def test_program_reports_errors_in_one_sentence():
    done = run_quick_look("missing.mcap")
    assert done.returncode == 1
    assert done.stderr.startswith("Error: missing.mcap cannot be read")
    assert done.stderr.count("\n") == 1


@pytest.mark.process
def test_runs_at_low_priority_and_ends_with_parent(short_chirps, tmp_path):
    """As it is started: below a process that is killed, suspended."""
    path = Path(shutil.copy(short_chirps[0], tmp_path))
    code = (
        "import os, pathlib, sys, time\n"
        "from rigd.engine.processes import ChildProcess\n"
        "from rigd.engine.workers import QUICK_LOOK\n"
        "look = ChildProcess(QUICK_LOOK, sys.argv[1])\n"
        "own = os.getpriority(os.PRIO_PROCESS, 0)\n"
        "assert os.getpriority(os.PRIO_PROCESS, look.pid) == min(19, own + 10)\n"
        "command = pathlib.Path(f'/proc/{look.pid}/cmdline')\n"
        # Empty for a moment, while one program becomes the other.
        "while b'run_program' in (command.read_bytes() or b'run_program'): time.sleep(0.001)\n"
        "look.suspend()\n"
        "print(look.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    assert Path(f"/proc/{pid}/oom_score_adj").read_text() == "1000\n"
    parent.kill()
    parent.communicate()
    assert eventually(lambda: has_ended(pid))
    assert not quick_look_path(path).exists()
