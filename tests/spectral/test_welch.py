"""Welch's estimate against scipy's, against known systems, and against the segment trap."""

import numpy as np
import pytest
import scipy  # whose parts come on first use
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral import SpectralError, segment_count, segment_lengths, welch_response

RATE_HZ = 200.0
SETTINGS = {"segment_length": 600, "overlap": 90, "nfft": 1000}
ESTIMATORS = ("h1", "h2", "hv")


def peer(x, y, rate_hz, segment_length, overlap, nfft):
    """Cross- and auto-spectra by scipy, with MATLAB's conventions."""
    options = {
        "fs": rate_hz,
        "window": scipy.signal.windows.hamming(segment_length, sym=True),
        "nperseg": segment_length,
        "noverlap": overlap,
        "nfft": nfft,
        "detrend": False,
    }
    frequency, sxy = scipy.signal.csd(x, y, **options)
    return (
        frequency,
        scipy.signal.welch(x, **options)[1],
        scipy.signal.welch(y, **options)[1],
        sxy,
    )


@pytest.mark.parametrize(
    ("segment_length", "overlap", "nfft"),
    [(600, 90, 1000), (600, 0, 600), (601, 300, 1024), (512, 470, 777), (6000, 900, 6001)],
)
def test_agrees_with_scipy(segment_length, overlap, nfft):
    rng = np.random.default_rng(41)
    x = rng.normal(size=6000) + 3.0
    y = np.convolve(x, [0.2, 0.5, -0.4])[: x.size] + 0.3 * rng.normal(size=x.size) - 1.0
    frequency, sxx, syy, sxy = peer(x, y, RATE_HZ, segment_length, overlap, nfft)
    inner = slice(1, -1 if nfft % 2 == 0 else None)
    expected = {
        "h1": sxy / sxx,
        "h2": syy / np.conj(sxy),
        "hv": np.sqrt(syy / sxx) * np.exp(1j * np.angle(sxy)),
    }
    for name in ESTIMATORS:
        got = welch_response(
            x, y, RATE_HZ, segment_length=segment_length, overlap=overlap, nfft=nfft,
            estimator=name,
        )  # fmt: skip
        assert got.estimator == name
        np.testing.assert_allclose(got.frequency_hz, frequency, rtol=1e-14, atol=0)
        np.testing.assert_allclose(got.response[inner], expected[name][inner], rtol=1e-9)
        if got.segments > 1:
            coherence = np.abs(sxy) ** 2 / (sxx * syy)
            np.testing.assert_allclose(got.coherence[inner], coherence[inner], atol=1e-10)


def test_paper_settings_agree_with_scipy():
    rng = np.random.default_rng(12_061)
    x = np.cumsum(rng.normal(size=120_000)) * 1e-3
    y = np.roll(x, 7) + 1e-3 * rng.normal(size=x.size)
    got = welch_response(x, y, 1000.0)
    _, sxx, _, sxy = peer(x, y, 1000.0, 17_266, 2590, 160_000)
    np.testing.assert_allclose(got.response, sxy / sxx, rtol=1e-8)
    assert got.segments == 8
    band = got.band(0.5875, 50.0)
    assert band.frequency_hz.size == band.response.size == band.coherence.size == 7907
    assert band.frequency_hz[0] == 94 / 160
    assert band.frequency_hz[-1] == 50.0


def test_segment_trap():
    assert segment_count(120_000, 17_266, 2590) == 8
    assert segment_count(120_000, 17_266, 2589) == 7
    rng = np.random.default_rng(77)
    x, y = rng.normal(size=(2, 120_000))
    changed = y.copy()
    changed[106_000:] = 0.0
    for overlap, segments in ((2590, 8), (2589, 7)):
        a = welch_response(x, y, 1000.0, overlap=overlap)
        b = welch_response(x, changed, 1000.0, overlap=overlap)
        assert a.segments == segments
        # With seven segments the end of the record, and its excitation, is not used.
        assert np.array_equal(a.response, b.response) == (segments == 7)


def test_segments_of_the_paper():
    assert segment_lengths(120_000, 8, 0.15) == (17_266, 2590)


@given(
    samples=st.integers(50, 10**6),
    segments=st.integers(1, 24),
    fraction=st.floats(0.0, 0.9),
)
def test_segments_are_as_long_as_possible(samples, segments, fraction):
    length, overlap = segment_lengths(samples, segments, fraction)
    assert segment_count(samples, length, overlap) >= segments
    assert overlap == round(fraction * length) < length
    longer = length + 1
    step = longer - round(fraction * longer)
    assert longer + (segments - 1) * step > samples


@pytest.mark.parametrize(
    ("samples", "segments", "fraction"), [(10, 8, 0.0), (0, 1, 0.0), (100, 0, 0.1), (100, 2, 1.0)]
)
def test_impossible_segments_are_refused(samples, segments, fraction):
    with pytest.raises(SpectralError, match="segments"):
        segment_lengths(samples, segments, fraction)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_phase_of_a_delay_is_negative(system, records, estimator):
    got = welch_response(
        records.input_, records.output, system.rate_hz, **SETTINGS, estimator=estimator
    ).band(1.0, 90.0)
    exact = system.response(got.frequency_hz)
    np.testing.assert_allclose(got.response, exact, rtol=0.1)
    np.testing.assert_allclose(np.angle(got.response / exact), 0.0, atol=0.05)
    unwrapped = np.unwrap(np.angle(got.response))
    assert unwrapped[-1] < unwrapped[0] - 10
    assert np.median(got.coherence) > 0.99


def test_noise_on_the_output_biases_h2_only(system, records):
    noisy = records.output + 0.4 * np.random.default_rng(5).normal(size=records.output.size)
    ratio, coherence = _ratios(system, records.input_, noisy, 5.0, 20.0)
    assert ratio["h1"] == pytest.approx(1.0, abs=0.02)
    assert ratio["h2"] == pytest.approx(1 / coherence, rel=0.05)
    assert ratio["h2"] > 1.1


def test_noise_on_the_input_biases_h1_only(system, records):
    noisy = records.input_ + 0.7 * np.random.default_rng(6).normal(size=records.input_.size)
    ratio, _ = _ratios(system, noisy, records.output, 5.0, 20.0)
    assert ratio["h2"] == pytest.approx(1.0, abs=0.02)
    assert ratio["h1"] == pytest.approx(1 / (1 + 0.7**2), abs=0.02)


def test_hv_is_the_geometric_mean(records):
    noisy = records.output + 0.2 * np.random.default_rng(9).normal(size=records.output.size)
    h1, h2, hv = (
        welch_response(records.input_, noisy, RATE_HZ, **SETTINGS, estimator=e).response
        for e in ESTIMATORS
    )
    np.testing.assert_allclose(hv**2, h1 * h2, rtol=1e-10)
    np.testing.assert_allclose(np.angle(hv / h1), 0.0, atol=1e-10)


def _ratios(system, x, y, first_hz, last_hz):
    """Mean ratio of each estimate to the exact response, and mean coherence, over a band."""
    found = {}
    coherence = 0.0
    for name in ESTIMATORS:
        got = welch_response(x, y, system.rate_hz, **SETTINGS, estimator=name)
        got = got.band(first_hz, last_hz)
        found[name] = float((got.response / system.response(got.frequency_hz)).real.mean())
        coherence = float(got.coherence.mean())
    return found, coherence


def test_coherence_is_the_explained_fraction_of_output():
    rng = np.random.default_rng(21)
    x, noise = rng.normal(size=(2, 200_000))
    got = welch_response(x, x + 0.5 * noise, 100.0, segment_length=500, overlap=0, nfft=500)
    assert got.coherence.mean() == pytest.approx(1 / 1.25, abs=0.01)
    clean = welch_response(x, -3 * x, 100.0, segment_length=500, overlap=0, nfft=500)
    np.testing.assert_allclose(clean.coherence, 1.0, atol=1e-12)
    alone = welch_response(x, x + noise, 100.0, segment_length=150_000, overlap=0, nfft=150_000)
    assert alone.segments == 1
    assert alone.coherence is None


@given(in_scale=st.floats(1e-6, 1e6), out_scale=st.floats(1e-6, 1e6), sign=st.sampled_from([-1, 1]))
def test_units_scale_only_the_response(in_scale, out_scale, sign):
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(2, 400))
    y += x
    for name in ESTIMATORS:
        settings = {"segment_length": 100, "overlap": 15, "nfft": 128, "estimator": name}
        a = welch_response(x, y, 10.0, **settings)
        b = welch_response(in_scale * x, sign * out_scale * y, 10.0, **settings)
        np.testing.assert_allclose(b.response, sign * out_scale / in_scale * a.response, rtol=1e-9)
        np.testing.assert_allclose(b.coherence, a.coherence, atol=1e-9)


def test_silent_input_bins_are_nan_and_silent_output_is_zero():
    # Of a constant, a transform of two samples is exactly zero at half the rate.
    settings = {"segment_length": 2, "overlap": 0, "nfft": 2}
    got = welch_response(np.ones(8), np.zeros(8), 10.0, **settings)
    assert got.response[0] == 0
    assert np.isnan(got.response[1])
    assert (got.coherence == 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"segment_length": 2000, "nfft": 4000}, r"1000 samples \(10 s\).*segment of 2000 \(20 s"),
        ({"overlap": 100}, "overlap"),
        ({"overlap": -1}, "overlap"),
        ({"segment_length": 1, "overlap": 0}, "at least 2"),
        ({"nfft": 99}, "nfft = 99"),
        ({"estimator": "h3"}, "'h3'.*h1, h2, hv"),
    ],
)
def test_invalid_settings_are_refused(changes, message):
    x = np.sin(np.arange(1000.0))
    settings = {"segment_length": 100, "overlap": 10, "nfft": 128} | changes
    with pytest.raises(SpectralError, match=message):
        welch_response(x, x, 100.0, **settings)


@pytest.mark.parametrize(
    ("x", "y", "rate_hz", "message"),
    [
        (np.ones(500), np.ones(499), 100.0, "equal length"),
        (np.ones((5, 100)), np.ones((5, 100)), 100.0, "one dimension"),
        (np.ones(500), np.full(500, np.nan), 100.0, "500 of 500 samples of the output"),
        (np.full(500, np.inf), np.ones(500), 100.0, "of the input"),
        (np.zeros(500), np.ones(500), 100.0, "zero in all"),
        (np.ones(500), np.ones(500), 0.0, "rate"),
        (np.ones(500), np.ones(500), np.nan, "rate"),
    ],
)
def test_invalid_records_are_refused(x, y, rate_hz, message):
    with pytest.raises(SpectralError, match=message):
        welch_response(x, y, rate_hz, segment_length=100, overlap=10, nfft=128)
