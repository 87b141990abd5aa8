"""Indices, Eqs. (28) to (32), and the search for resonant peaks."""

import numpy as np
import pytest

from analysis.paper.welch_analysis import Peak, fit_indices, peak_deviation, resonant_peaks
from rigd.beam import Damping, transfer


def test_indices_by_hand():
    omega = np.array([1.0, 2.0, 4.0])
    measured = np.array([1.0 + 1.0j, 2.0, -3.0j])
    model = np.array([1.0 - 1.0j, 2.0, 0.0j])
    indices = fit_indices(omega, measured, model)
    assert indices.mse == pytest.approx((4 + 0 + 9) / 3)
    assert indices.wmse == pytest.approx((4 / 1 + 9 / 4) / (1 + 1 / 2 + 1 / 4))
    assert indices.md == pytest.approx(3.0)


def test_peaks_of_the_exact_model(link, plant, paper_grid_hz, mode_hz):
    response = transfer(2j * np.pi * paper_grid_hz, link, plant)
    peaks = resonant_peaks(paper_grid_hz, response, mode_hz)
    assert [p.magnitude_db for p in peaks] == pytest.approx([26.05, 32.94, 25.39], abs=0.01)
    assert [2 * np.pi * p.frequency_hz for p in peaks] == pytest.approx(
        [16.14, 100.61, 281.7], abs=0.1
    )
    for peak in peaks:
        assert peak.frequency_hz in paper_grid_hz


def test_welch_flattens_the_first_peaks(clean_frf, mode_hz):
    """The window, not the damping, sets the height of peaks narrower than its own width."""
    peaks = resonant_peaks(clean_frf.frequency_hz, clean_frf.response, mode_hz)
    assert [p.magnitude_db for p in peaks] == pytest.approx([23.65, 30.59, 26.19], abs=0.06)


def test_seven_segments_lose_the_third_peak(sweep, plant, mode_hz):
    trapped = sweep(plant, None).welch(overlap=2589)
    assert trapped.segments == 7
    peaks = resonant_peaks(trapped.frequency_hz, trapped.response, mode_hz)
    assert peaks[2] is None or abs(peaks[2].magnitude_db - 26.19) > 3


def test_overdamped_peak_is_none(link, paper_grid_hz, mode_hz):
    heavy = transfer(2j * np.pi * paper_grid_hz, link, Damping(zeta=0.01, alpha=1.0))
    peaks = resonant_peaks(paper_grid_hz, heavy, mode_hz)
    assert peaks[0] is not None
    assert peaks[1:] == (None, None)


def test_modes_outside_the_band_are_none(link, plant, paper_grid_hz, mode_hz):
    response = transfer(2j * np.pi * paper_grid_hz, link, plant)
    part = slice(0, 4000)
    peaks = resonant_peaks(paper_grid_hz[part], response[part], mode_hz)
    assert peaks[2] is None
    assert peaks[:2] == resonant_peaks(paper_grid_hz, response, mode_hz)[:2]


def test_plateau_of_two_bins_is_one_peak():
    frequency_hz = np.arange(1.0, 8.0)
    response = np.array([1, 2, 5, 5, 2, 1, 1], dtype=complex)
    assert resonant_peaks(frequency_hz, response, np.array([3.5])) == (Peak(3.0, 20 * np.log10(5)),)


def test_deviation_of_peaks():
    deviation = peak_deviation(Peak(2.0, 26.0), Peak(2.5, 23.0))
    assert deviation.frequency_rad_s == pytest.approx(np.pi)
    assert deviation.magnitude_db == pytest.approx(3.0)


def test_table_4_follows_from_table_3(link, paper_grid_hz, mode_hz, paper_dampings, paper_table4):
    """Deviations of the paper's nominal models from its measured peaks.

    The peaks are read from its figures. Parameters are printed with three digits, each session
    has its own peaks, and frequencies come in bins of 0.0393 rad/s, so not all can agree.
    """
    measured = [
        Peak(omega / (2 * np.pi), magnitude_db)
        for omega, magnitude_db in ((16.17, 26.95), (100.84, 33.78), (279.81, 32.16))
    ]
    s = 2j * np.pi * paper_grid_hz
    off = []
    for (name, weighting), damping in paper_dampings.items():
        peaks = resonant_peaks(paper_grid_hz, transfer(s, link, damping), mode_hz)
        for mode, (seen, modelled) in enumerate(zip(measured, peaks, strict=True), start=1):
            deviation = peak_deviation(seen, modelled)
            for quantity in ("frequency_rad_s", "magnitude_db"):
                printed = paper_table4[quantity, mode, weighting, name]
                off.append(abs(getattr(deviation, quantity) - printed))
    assert len(off) == len(paper_table4) == 72
    assert sum(d <= 0.1 for d in off) >= 40
    assert sum(d <= 0.5 for d in off) >= 67
