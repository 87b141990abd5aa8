from dataclasses import replace

import numpy as np
import pytest

from analysis.models import WelchSettings
from analysis.paper import FrequencyResponseError, SettingsError
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from rigd.beam import transfer
from rigd.spectral import Segmentation

pytestmark = pytest.mark.fit


def test_the_paper_s_settings_and_grid(paper_analysis):
    response = paper_analysis.response
    assert paper_analysis.segmentation == Segmentation(17266, 2590, 160_000)
    assert response.segments == 8
    assert len(response.frequency_hz) == 7907
    assert response.frequency_hz[0] == pytest.approx(94 / 160)
    assert response.frequency_hz[-1] == pytest.approx(50.0)
    assert len(paper_analysis.whole_record.frequency_hz) == 7907


def test_durations_do_not_depend_on_the_rate():
    assert WelchSettings().segmentation(2000.0) == Segmentation(34532, 5180, 320_000)


def test_segment_determines_overlap_and_transform():
    own = WelchSettings(segment_length=200_000).segmentation(1000.0)
    assert own == Segmentation(200_000, 30_000, 200_000)


def test_fits_are_ordered_by_type_and_weighting(paper_analysis):
    names = [(m.fit.structure.name, m.fit.weighting) for m in paper_analysis.models]
    assert names == [(t, w) for t in ("I", "III", "VI") for w in ("const", "omega")]


def test_cost_is_the_minimised_index(paper_analysis):
    for model in paper_analysis.models:
        index = {"const": model.indices.mse, "omega": model.indices.wmse}[model.fit.weighting]
        assert model.fit.cost == pytest.approx(index, rel=1e-9)


def test_true_structure_fits_best(paper_analysis):
    """The bias of the paper's method on this plant: zeta +20 %, alpha -0.025, lambda +0.13."""
    by_name = {(m.fit.structure.name, m.fit.weighting): m for m in paper_analysis.models}
    best = by_name["VI", "omega"]
    assert best.indices.wmse == min(m.indices.wmse for m in paper_analysis.models)
    assert best.fit.parameters["zeta"] == pytest.approx(7.1e-5 * 1.2, rel=0.05)
    assert best.fit.parameters["alpha"] == pytest.approx(0.996 - 0.025, abs=0.01)
    assert best.fit.parameters["lambda"] == pytest.approx(0.594 + 0.128, abs=0.03)
    assert [mode.frequency_hz for mode in best.modes] == pytest.approx(
        [2.553, 16.00, 44.81], rel=6e-3
    )


def test_measured_peaks_lie_on_the_modes(paper_analysis):
    frequencies_hz = [peak.frequency_hz for peak in paper_analysis.peaks]
    assert frequencies_hz == pytest.approx([2.57, 16.01, 44.8], rel=5e-3)
    magnitudes_db = [peak.magnitude_db for peak in paper_analysis.peaks]
    assert magnitudes_db == pytest.approx([23.65, 30.59, 26.19], abs=0.3)


def test_known_delays_and_tool_inertia_are_removed(write_session, make_signals, tmp_path):
    """The same plant seen through late channels and under a clamp gives the same parameters."""
    plain, late = (
        make_signals(noise_nm=0, quantum_rad=0, sweep_s=60.0, ring_down_s=2.0, **channels)
        for channels in (
            {},
            {"tool_inertia_kg_m2": 1e-5, "angle_delay_s": 5e-4, "torque_delay_s": 2e-3},
        )
    )
    declared = {"tool_inertia_kg_m2": "1e-5", "angle_delay_s": "5e-4", "torque_delay_s": "2e-3"}
    settings = WelchSettings(types=("VI",), weightings=("omega",))
    fits = []
    for name, signals, metadata in (
        ("plain", plain, {}), ("declared", late, declared), ("undeclared", late, {}),
    ):  # fmt: skip
        record = load_record(write_session(tmp_path / f"{name}.mcap", signals, metadata=metadata))
        fits.append(analyse(record, settings).models[0])
    plain_fit, declared_fit, undeclared_fit = (model.fit.parameters for model in fits)
    for name in ("zeta", "gamma"):
        assert declared_fit[name] == pytest.approx(plain_fit[name], rel=0.01)
        assert abs(undeclared_fit[name] / plain_fit[name] - 1) > 0.05
    for name in ("alpha", "lambda"):
        assert declared_fit[name] == pytest.approx(plain_fit[name], abs=0.005)


def test_a_constant_angle_changes_nothing(write_session, paper_signals, paper_analysis, tmp_path):
    turned = replace(
        paper_signals,
        angle_rad=paper_signals.angle_rad + 0.3,
        reference_rad=paper_signals.reference_rad + 0.3,
    )
    record = load_record(write_session(tmp_path / "a.mcap", turned))
    found = analyse(record, WelchSettings(types=("I",), weightings=("const",)))
    np.testing.assert_allclose(
        found.response.response, paper_analysis.response.response, rtol=1e-6, atol=1e-9
    )


def test_one_percent_of_missing_ticks_has_little_effect(
    write_session, paper_signals, paper_analysis, tmp_path
):
    """The error of interpolation at the admitted limit is far less than the bias."""
    rng = np.random.default_rng(3)
    present = np.ones(136_000, bool)
    for first in rng.choice(np.arange(2000, 120_000, 10), 380, replace=False):
        present[first : first + rng.integers(1, 6)] = False
    path = write_session(
        tmp_path / "a.mcap", paper_signals.part(present), ticks=np.flatnonzero(present)
    )
    record = load_record(path)
    assert 0.008 < record.gaps.sweep_missing_ticks / record.sweep_samples <= 0.01
    (model,) = analyse(record, WelchSettings(types=("VI",), weightings=("omega",))).models
    (whole,) = (
        m for m in paper_analysis.models
        if (m.fit.structure.name, m.fit.weighting) == ("VI", "omega")
    )  # fmt: skip
    assert model.fit.parameters["zeta"] == pytest.approx(whole.fit.parameters["zeta"], rel=0.02)
    assert model.fit.parameters["alpha"] == pytest.approx(whole.fit.parameters["alpha"], abs=0.005)


@pytest.mark.parametrize("estimator", ["h2", "hv", "iv", "fft"])
def test_the_other_estimators_follow_the_plant(paper_file, estimator, link, plant):
    record = load_record(paper_file)
    found = analyse(record, WelchSettings(estimator=estimator, types=("III",)))
    response = found.response
    assert response.estimator == estimator
    exact = transfer(2j * np.pi * response.frequency_hz, link, plant)
    deviation = np.abs(response.response / exact - 1)
    for first_hz, last_hz in ((2.8, 4.0), (14.0, 15.5), (16.5, 18.0)):  # flanks of resonances
        flank = (response.frequency_hz > first_hz) & (response.frequency_hz < last_hz)
        assert np.median(deviation[flank]) < 0.12


def test_a_short_sweep_is_refused_with_settings_that_fit(write_session, short_signals, tmp_path):
    record = load_record(write_session(tmp_path / "a.mcap", short_signals))
    with pytest.raises(FrequencyResponseError, match="4000 samples") as caught:
        analyse(record, WelchSettings())
    words = str(caught.value).replace(",", "").split()
    length, overlap = (int(words[words.index(o) + 1]) for o in ("--segment", "--overlap"))
    found = analyse(record, WelchSettings(segment_length=length, overlap=overlap, types=("I",)))
    assert found.response.segments == 8
    assert not any("segment(s)" in warning for warning in found.warnings)


def test_fewer_segments_than_in_the_paper_give_a_warning(paper_file):
    record = load_record(paper_file)
    found = analyse(record, WelchSettings(segment_length=60_000, types=("I",)))
    assert found.response.segments == 2
    assert any("Only 2 Welch segment(s)" in warning for warning in found.warnings)


def test_band_beyond_the_excitation_gives_a_warning(write_session, paper_signals, tmp_path):
    path = write_session(tmp_path / "a.mcap", paper_signals, metadata={"stop_hz": "20"})
    found = analyse(load_record(path), WelchSettings(types=("I",)))
    assert any("beyond the excitation (0.05 to 20 Hz)" in w for w in found.warnings)


def test_falling_sweep_excites_as_much(write_session, paper_signals, tmp_path):
    metadata = {"start_hz": "50.0", "stop_hz": "0.05"}
    path = write_session(tmp_path / "a.mcap", paper_signals, metadata=metadata)
    found = analyse(load_record(path), WelchSettings(types=("I",)))
    assert found.warnings == ()


def test_constant_angle_is_refused(write_session, paper_signals, tmp_path):
    still = replace(paper_signals, angle_rad=np.full(136_000, 0.25))
    record = load_record(write_session(tmp_path / "a.mcap", still))
    with pytest.raises(FrequencyResponseError, match=r"a\.mcap.*nothing was excited"):
        analyse(record, WelchSettings(types=("I",)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (WelchSettings(band_hz=(1.0, 600.0)), "nothing above 500 Hz"),
        (WelchSettings(overlap=20_000), "--overlap"),
        (WelchSettings(nfft=1000), "--nfft"),
        (WelchSettings(band_hz=(1.0001, 1.0002)), "no bin"),
        (WelchSettings(band_hz=(1.0, 1.007)), "points"),
        (WelchSettings(weightings=("omega^11",)), "from -10 to 10"),
    ],
)
def test_invalid_settings_are_distinguished(paper_file, settings, message):
    record = load_record(paper_file)
    with pytest.raises(SettingsError, match=message):
        analyse(record, settings)


def test_file_with_required_content_only(write_session, paper_signals, paper_analysis, tmp_path):
    """No segments: the whole record is the sweep, rest and ring-down included."""
    path = write_session(
        tmp_path / "a.mcap", paper_signals, segments={},
        metadata={"excitation": "", "start_hz": "", "stop_hz": ""},
    )  # fmt: skip
    found = analyse(load_record(path), WelchSettings(types=("VI",), weightings=("omega",)))
    assert found.response.segments == 9
    assert found.warnings == ()
    zeta = found.models[0].fit.parameters["zeta"]
    assert zeta == pytest.approx(paper_analysis.models[-1].fit.parameters["zeta"], rel=0.3)


def test_modes_followed_by_a_fit_are_reported(paper_analysis, paper_file):
    assert all(model.are_near_undamped == (True, True, True) for model in paper_analysis.models)
    # One segment of 20 s of the sweep, whose resonances the window fades out.
    record = load_record(paper_file)
    short = replace(record, sweep=slice(record.sweep.start, record.sweep.start + 20_000))
    found = analyse(short, WelchSettings(types=("II", "IV", "VI")))
    assert any(not all(model.are_near_undamped) for model in found.models)
    for model in found.models:
        assert len(model.are_near_undamped) == len(model.modes)
        followed = [
            mode for mode, is_so in zip(model.modes, model.are_near_undamped, strict=True) if is_so
        ]
        frequencies_hz = [mode.frequency_hz for mode in followed]
        assert frequencies_hz == sorted(frequencies_hz)
        assert all(0 < mode.damping_ratio < 1 for mode in followed)


def test_hiv_without_a_reference_is_refused(paper_file):
    record = load_record(paper_file)
    still = replace(record, reference_rad=np.full_like(record.reference_rad, 0.3))
    with pytest.raises(FrequencyResponseError, match=r"no reference that moves.*--frf h1"):
        analyse(still, WelchSettings(estimator="iv", types=("I",)))
