"""What suits a record: its band, and Welch's fits only where they are informative."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from analysis import fit
from analysis.applicability import (
    analysis_remarks,
    check_excited_band,
    record_band_hz,
    welch_analysis,
    welch_exclusion_reason,
    welch_settings,
)
from analysis.identify import Comparison, Measurement, MeasurementError
from analysis.models import WelchSettings
from analysis.paper import FrequencyResponseError, SettingsError
from analysis.record import load_record
from analysis.results import whole_record


@pytest.fixture
def record_of(write_session, short_signals, tmp_path):
    """Read a session of 4 s of sweep, with metadata as wanted and every so-manyth sample."""

    def make(every=1, **metadata):
        signals = short_signals.part(slice(None, None, every))
        segments = {
            name: (first // every, end // every)
            for name, (first, end) in short_signals.segments.items()
        }
        stated = {"rate_hz": repr(1000.0 / every), **metadata}
        ticks = np.arange(len(signals.angle_rad))
        path = write_session(
            tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap", signals, metadata=stated,
            segments=segments, ticks=ticks, t_ns=ticks * every * 1_000_000,
        )  # fmt: skip
        return load_record(path)

    return make


@pytest.mark.fit
@pytest.mark.parametrize(("every", "last_hz"), [(1, 50.0), (8, 50.0), (10, 40.0), (25, 16.0)])
def test_the_band_ends_at_four_tenths_of_the_rate(record_of, every, last_hz):
    record = record_of(every)
    assert record_band_hz(record) == (0.0, last_hz)
    assert welch_settings(record, WelchSettings()).band_hz == (0.5875, last_hz)
    assert [f"{last_hz:g} Hz" in each for each in analysis_remarks(record)] == [True] * (
        last_hz < 50
    )
    # And that is what the estimator takes: 0.4 of the rate, and nothing beyond.
    measurement = Measurement.from_record(record)
    assert (
        Comparison.from_measurement(measurement, record_band_hz(record)).frequency_hz[-1] <= last_hz
    )


def test_band_of_a_part_is_its_sweep(record_of):
    record = record_of()
    for swept_hz, record_hz, welch_hz in (
        ((0.3, 30.0), (0.0, 30.0), (0.5875, 30.0)),  # from the beginning of the sweep
        ((8.0, 60.0), (8.0, 50.0), (8.0, 50.0)),
    ):
        part = replace(record, part_s=(0.0, 4.0), swept_hz=swept_hz)
        assert record_band_hz(part) == record_hz
        assert welch_settings(part, WelchSettings()).band_hz == welch_hz
        assert record_band_hz(part, (2.0, 30.0)) == (2.0, 30.0)
        (remark,) = analysis_remarks(part)
        assert f"{record_hz[0]:g} to {record_hz[1]:g} Hz" in remark
        assert welch_exclusion_reason(part) is None


def test_requested_band_applies_to_all_fits(record_of):
    record = record_of()
    assert record_band_hz(record, (2.0, 30.0)) == (2.0, 30.0)
    assert welch_settings(record, WelchSettings(), (2.0, 30.0)).band_hz == (2.0, 30.0)
    assert analysis_remarks(record, (2.0, 30.0)) == ()
    # A frequency response is undefined at 0 Hz: its next bin is the first.
    assert welch_settings(record, WelchSettings(), (0.0, 30.0)).band_hz == (1 / 160, 30.0)
    own = WelchSettings(band_hz=(1.0, 60.0))
    assert welch_settings(record_of(10), own).band_hz == (1.0, 60.0)


@pytest.mark.parametrize("kind", ["chirp", "multisine", "modes"])
def test_band_far_beyond_the_excitation_is_refused(record_of, kind):
    record = record_of(excitation=kind, start_hz="50", stop_hz="0.05")
    check_excited_band(record, (0.0, 55.0))  # the end of a sweep excites a little beyond
    check_excited_band(record, None)
    for refused_by in (check_excited_band, fit_in_band, whole_record_in_band):
        with pytest.raises(MeasurementError, match=r"120 Hz, .* 0\.05 to 50 Hz, .* ends at 50 Hz"):
            refused_by(record, (0.0, 120.0))
    part = replace(record, part_s=(0.0, 4.0), swept_hz=(8.0, 30.0))
    check_excited_band(part, (0.0, 33.0))
    with pytest.raises(MeasurementError, match="8 to 30 Hz"):
        check_excited_band(part, (0.0, 50.0))


def fit_in_band(record, band_hz):
    return fit(record, ["III"], band_hz=band_hz)


def whole_record_in_band(record, band_hz):
    return whole_record(record, band_hz=band_hz)


@pytest.mark.parametrize(
    "metadata",
    [
        {"excitation": "step"},
        {"excitation": "file", "stop_hz": "5"},
        {"excitation": "", "stop_hz": "5"},
    ],
)
def test_any_band_is_accepted_if_the_excited_one_is_not_stated(record_of, metadata):
    check_excited_band(record_of(start_hz="1", **metadata), (0.0, 300.0))


@pytest.mark.parametrize("kind", ["step", "multisine", "modes", "move", "touch"])
def test_welch_method_is_for_sweeps(record_of, kind):
    record = record_of(excitation=kind, duration_s="4.0")
    assert kind in f"{welch_exclusion_reason(record)} modes"
    found, left_out = welch_analysis(record, WelchSettings(), is_optional=True)
    assert found is None
    assert left_out.startswith("Welch fits left out: ")
    chosen = WelchSettings(segment_length=1000, types=("I",), weightings=("const",))
    assert welch_analysis(record, chosen, is_optional=True)[0] is not None


def test_suggested_option_makes_the_fits(record_of):
    """Of 4 s the usual segments are too long, and only an estimator without them is left."""
    record = record_of(excitation="step")
    assert "(--method welch --frf fft computes them nevertheless)" in welch_exclusion_reason(record)
    with pytest.raises(FrequencyResponseError):
        welch_analysis(record, WelchSettings(), is_optional=False)
    chosen = WelchSettings(estimator="fft", types=("I",), weightings=("const",))
    assert welch_analysis(record, chosen, is_optional=False)[0] is not None
    longer = replace(record, sweep=slice(0, 17266))
    assert "(--method welch computes them nevertheless)" in welch_exclusion_reason(longer)


def test_remark_that_fits_assume_a_free_beam(record_of):
    (remark,) = analysis_remarks(record_of(excitation="touch"))
    assert "analyze touch estimates where" in remark
    assert analysis_remarks(record_of(excitation="chirp")) == ()


def test_stopped_sweep_is_fitted_up_to_its_end(record_of):
    stated = {"start_hz": "0.05", "stop_hz": "50.0", "duration_s": "8.0"}
    reason = welch_exclusion_reason(record_of(**stated))
    assert "after 4 of 8 s, at 25 Hz" in reason
    assert "--band 0.5875,25" in reason
    # With the band narrowed so far, or nothing missing, there is nothing against it.
    assert welch_exclusion_reason(record_of(**stated), (0.5875, 25.0)) is None
    assert welch_exclusion_reason(record_of(**{**stated, "duration_s": "4.0"})) is None
    # Downwards the low frequencies are missing, which the sentence could not state.
    assert (
        welch_exclusion_reason(record_of(**{**stated, "start_hz": "50", "stop_hz": "0.05"})) is None
    )


def test_short_sweep_is_reported_with_fitting_settings(record_of):
    found, left_out = welch_analysis(record_of(), WelchSettings(), is_optional=True)
    assert found is None
    assert "--segment 575 --overlap 86" in left_out
    with pytest.raises(FrequencyResponseError):
        welch_analysis(record_of(), WelchSettings(), is_optional=False)
    wrong = WelchSettings(types=("I",), band_hz=(1.0, 900.0))
    with pytest.raises(SettingsError):
        welch_analysis(record_of(), wrong, is_optional=True)


@pytest.fixture
def slow(write_session, make_signals, tmp_path):
    """slow.mcap: a sweep of 20 s past two modes, as a data logger of 100 Hz has it."""
    signals = make_signals(rest_s=1.0, sweep_s=20.0, ring_down_s=2.0, noise_nm=1e-3)
    segments = {name: (a // 10, b // 10) for name, (a, b) in signals.segments.items()}
    signals = replace(signals.part(slice(None, None, 10)), segments=segments)
    ticks = np.arange(len(signals.angle_rad))
    write_session(
        tmp_path / "slow.mcap", signals, metadata={"rate_hz": "100.0", "duration_s": "20.0"},
        t_ns=ticks * 10_000_000,
    )  # fmt: skip


@pytest.mark.fit
@pytest.mark.usefixtures("slow")
@pytest.mark.further  # the band that is fitted is tested above
def test_a_record_of_100_hz_is_analysed(analyze_here, without_drawing, tmp_path):
    brief = ("--types", "I", "--weights", "const")
    with without_drawing():
        result = analyze_here("slow.mcap", "--json", "slow.json", "--report", "r", *brief)
    assert result.returncode == 0, result.stderr
    content = json.loads((tmp_path / "slow.json").read_text())
    (record,) = content["records"]
    assert record["band_hz"] == [0.0, 40.0]
    (file,) = content["files"]
    assert any("Fits end at 40 Hz" in warning for warning in file["warnings"])
    modes = [mode for mode in content["modes"] if mode["estimator"] == "record"]
    assert modes[1]["frequency_hz"] == pytest.approx(16.0, rel=5e-3)
    # Warnings of the program, not of its libraries.
    assert all(line.startswith("Warning: slow.mcap:") for line in result.stderr.splitlines())


@pytest.mark.fit
@pytest.mark.further  # as report/test_method_record.py, at another rate
@pytest.mark.usefixtures("slow")
def test_a_band_of_a_record_of_100_hz_is_analysed(analyze_here, tmp_path):
    band = analyze_here("slow.mcap", "--method", "record", "--band", "1,20", "--json", "b.json")
    assert (band.returncode, band.stderr) == (0, "")
    assert json.loads((tmp_path / "b.json").read_text())["records"][0]["band_hz"] == [1.0, 20.0]


@pytest.mark.fit
@pytest.mark.further  # what suits a step is decided above
def test_step_gets_whole_record_analysis_and_a_remark(
    write_session, make_signals, analyze_here, tmp_path
):
    """The metadata decide, so a sweep that is labelled as a step will do."""
    signals = make_signals(rest_s=0.2, sweep_s=5.0, ring_down_s=0.3)
    write_session(tmp_path / "step.mcap", signals, metadata={"excitation": "step"})
    result = analyze_here("step.mcap", "--json", "a.json", "--report", "r")
    assert result.returncode == 0
    (line,) = result.stderr.splitlines()
    assert line.startswith("Warning: step.mcap: Welch fits left out: a step excites")
    content = json.loads((tmp_path / "a.json").read_text())
    assert {fit["estimator"] for fit in content["fits"]} == {"record"}
    assert content["errors"] == []
    assert any("left out" in warning for warning in content["files"][0]["warnings"])
    assert "Welch fits left out" in (tmp_path / "r" / "report.html").read_text()


@pytest.mark.process
@pytest.mark.parametrize("always", [False, True])
def test_warnings_of_libraries_stay_off_the_terminal(tmp_path, always):
    """Those of numpy and matplotlib, here and in the processes that it starts; unless requested."""
    inner = "import numpy; numpy.float64(1e308) * 10"
    program = f"""
import logging, subprocess, sys
from analysis.cli import app as cli
def work():
    import numpy
    numpy.float64(1e308) * 10
    logging.getLogger("matplotlib.font_manager").warning("no such font")
    subprocess.run([sys.executable, "-c", {inner!r}], check=True)
cli.app = work
cli.main()
"""
    switches = ["-W", "always"] if always else []
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"}
    done = subprocess.run(
        [sys.executable, *switches, "-c", program], cwd=tmp_path, env=environment,
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    assert "no such font" not in done.stderr
    assert ("overflow" in done.stderr) == always
    if not always:
        assert done.stderr == ""
