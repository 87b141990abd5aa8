"""The whole-record estimate: exact for signals that start and end at rest."""

import numpy as np
import pytest

from rigd.spectral import SpectralError, fft_response


def burst(n=4000, quiet=1500):
    x = np.random.default_rng(606).normal(size=n)
    x[:100] = 0.0
    x[-quiet:] = 0.0
    return x


def test_exact_from_rest_to_rest(system):
    x = burst()
    got = fft_response(x, system.output(x), system.rate_hz)
    np.testing.assert_allclose(got.response, system.response(got.frequency_hz), rtol=1e-9)
    assert (got.segments, got.coherence, got.estimator) == (1, None, "fft")


@pytest.mark.parametrize("nfft", [4001, 8192, 10_000])
def test_zero_padding_sets_the_grid(system, nfft):
    x = burst()
    got = fft_response(x, system.output(x), system.rate_hz, nfft)
    assert got.frequency_hz.size == nfft // 2 + 1
    np.testing.assert_allclose(
        got.frequency_hz, np.fft.rfftfreq(nfft, 1 / system.rate_hz), rtol=1e-14
    )
    np.testing.assert_allclose(got.response, system.response(got.frequency_hz), rtol=1e-8)


def test_record_is_never_cut():
    with pytest.raises(SpectralError, match=r"nfft = 100 .* 4000"):
        fft_response(burst(), burst(), 200.0, 100)


def test_zero_input_is_refused():
    with pytest.raises(SpectralError, match="zero in all"):
        fft_response(np.zeros(10), np.ones(10), 200.0)
