"""Bands and delays of a frequency response."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral import FrequencyResponse, SpectralError, fft_response

RATE_HZ = 200.0


def grid(n=8001, step_hz=1 / 160):
    frequency_hz = np.arange(n) * step_hz
    return FrequencyResponse(frequency_hz, frequency_hz * 1j, frequency_hz / 1e3, 3, "h1")


@given(first=st.integers(0, 8000), last=st.integers(0, 8000))
def test_band_includes_both_ends(first, last):
    first, last = sorted((first, last))
    band = grid().band(first * 0.00625, last * 0.00625)
    np.testing.assert_array_equal(band.frequency_hz, grid().frequency_hz[first : last + 1])
    np.testing.assert_array_equal(band.response, 1j * band.frequency_hz)
    np.testing.assert_array_equal(band.coherence, band.frequency_hz / 1e3)
    assert (band.segments, band.estimator) == (3, "h1")


@pytest.mark.parametrize("band_hz", [(60.0, 70.0), (3.001, 3.002), (5.0, 4.0), (np.nan, 4.0)])
def test_band_without_bins_is_refused(band_hz):
    with pytest.raises(SpectralError, match="no bin"):
        grid().band(*band_hz)


@pytest.mark.parametrize(("input_age", "output_age"), [(0, 3), (4, 0), (2, 5), (3, 3)])
def test_ages_of_the_samples_are_compensated(input_age, output_age):
    """Two channels stamped late by some samples give the response of the channels themselves."""
    rng = np.random.default_rng(31)
    x = np.zeros(1000)
    x[50:600] = rng.normal(size=550)
    y = np.convolve(x, [0.5, 0.3, -0.1])[:1000]
    true = fft_response(x, y, RATE_HZ)
    stamped = fft_response(np.roll(x, input_age), np.roll(y, output_age), RATE_HZ)
    undone = stamped.without_delays(
        input_delay_s=input_age / RATE_HZ, output_delay_s=output_age / RATE_HZ
    )
    np.testing.assert_allclose(undone.response, true.response, rtol=1e-9)
    if input_age != output_age:
        assert np.abs(stamped.response - true.response).max() > 0.1
