"""Modes of measured responses agree with published values.

`ESTIMATORS` are compared with the published values: vector fitting of the response, and the modal
model of the analyzer, fitted to a record that has this response.
"""

import numpy as np
import pytest
from published_data import (
    MeasuredResponse,
    Resonance,
    fit_poles,
    fit_record,
    impact_test,
    periodic_record,
    phase_resonance,
)

RESPONSE, PUBLISHED = impact_test()
SLOWDOWN = 10


def fit_slow_record(measured, starts_hz, background):
    """Return the modes by the analyzer's modal model, of a record at a tenth of the speed."""
    assert background <= 5
    record = periodic_record(measured, 250.0, 2, slowdown=SLOWDOWN)
    band_hz = measured.frequency_hz[[0, -1]] / SLOWDOWN
    found = fit_record(record, tuple(band_hz), [hz / SLOWDOWN for hz in starts_hz])
    return [Resonance(SLOWDOWN * mode.frequency_hz, mode.damping_ratio) for mode in found]


ESTIMATORS = [fit_poles, fit_slow_record]


@pytest.mark.parametrize("estimate", ESTIMATORS)
@pytest.mark.parametrize("published", PUBLISHED, ids=lambda mode: f"{mode.first_hz:g} Hz")
def test_mode_of_the_impact_test(estimate, published):
    band = RESPONSE.within(published.first_hz, published.last_hz)
    (mode,) = estimate(band, [212.0], 5)
    assert mode.frequency_hz == pytest.approx(published.resonance.frequency_hz, rel=1e-4)
    # The published fit weights lines far from the resonance most: a wide band biases its result.
    within = 0.02 if published.last_hz - published.first_hz < 30 else 0.07
    assert mode.damping_ratio == pytest.approx(published.resonance.damping_ratio, rel=within)


@pytest.mark.parametrize(
    ("estimate", "frequency_within", "ratio_within"),
    [(fit_poles, 1e-6, 1e-4), (fit_slow_record, 1e-4, 1e-2)],
)
def test_modes_of_a_known_response(estimate, frequency_within, ratio_within):
    """Four modes with complex residues, two of them close, over a background."""
    known = [
        Resonance(2.6, 0.01),
        Resonance(16.1, 0.004),
        Resonance(16.9, 0.003),
        Resonance(45, 0.01),
    ]
    frequency_hz = np.arange(0.05, 50, 0.05)
    s = 2j * np.pi * frequency_hz
    response = 0.3 + 1e-3 * s + 1e-5 * s**2
    for index, mode in enumerate(known):
        omega = 2 * np.pi * mode.frequency_hz
        pole = omega * (-mode.damping_ratio + 1j * np.sqrt(1 - mode.damping_ratio**2))
        residue = np.exp(0.7j * index) / (1 + index)
        response += residue / (s - pole) + np.conj(residue) / (s - np.conj(pole))
    measured = MeasuredResponse("known", frequency_hz, response)
    for mode, expected in zip(estimate(measured, [2.5, 16, 17, 44], 3), known, strict=True):
        assert mode.frequency_hz == pytest.approx(expected.frequency_hz, rel=frequency_within)
        assert mode.damping_ratio == pytest.approx(expected.damping_ratio, rel=ratio_within)


def test_phase_resonance_of_one_mode():
    frequency_hz = np.arange(79.0, 81.2, 0.05)
    ratio = frequency_hz / 80
    response = 1 / (1 - ratio**2 + 2j * 0.004 * ratio)
    mode = phase_resonance(MeasuredResponse("one mode", frequency_hz, response))
    assert mode.frequency_hz == pytest.approx(80, rel=1e-5)
    assert mode.damping_ratio == pytest.approx(0.004, rel=5e-3)


def test_periodic_record_has_the_measured_response():
    """At a tenth of the speed: the mode at 21 Hz, with the damping ratio as it was."""
    record = periodic_record(RESPONSE, 250.0, 2, slowdown=10)
    period_s = 10 / RESPONSE.line_hz
    assert record.output.size == 2 * period_s * record.rate_hz == 16_000
    spectra = np.fft.rfft(np.stack([record.input, record.output]))
    lines = 2 * np.round(RESPONSE.frequency_hz / RESPONSE.line_hz).astype(int)
    assert spectra[1, lines] / spectra[0, lines] == pytest.approx(RESPONSE.response, rel=1e-9)
    rest = np.delete(np.abs(spectra[1]), lines)
    assert rest.max() < 1e-9 * np.abs(spectra[1]).max()


def test_period_of_fractional_samples_is_refused():
    with pytest.raises(ValueError, match="no whole number of samples"):
        periodic_record(RESPONSE, 250.3, 1, slowdown=10)
    with pytest.raises(ValueError, match="beyond half the rate"):
        periodic_record(RESPONSE, 250.0, 1)
