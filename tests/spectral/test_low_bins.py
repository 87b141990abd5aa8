"""The lowest bins of a padded transform, against the whole transform."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral._running import LowBins, bins_up_to


@given(data=st.data())
def test_equals_the_whole_transform(data):
    length = data.draw(st.integers(1, 300))
    nfft = data.draw(st.integers(length, 1000))
    bins = data.draw(st.integers(1, nfft // 2 + 1))
    transform = LowBins(length, nfft, bins)
    rng = np.random.default_rng(length)
    # The shorter one after the longer: nothing of that may be left.
    for samples in (length, data.draw(st.integers(1, length))):
        x = rng.normal(size=samples)
        whole = np.fft.rfft(x, nfft)
        np.testing.assert_allclose(
            transform(x), whole[:bins], rtol=0, atol=1e-13 * np.abs(whole).max()
        )


def test_equals_the_papers_transform():
    x = np.random.default_rng(5).normal(size=17_266) * np.hamming(17_266)
    whole = np.fft.rfft(x, 160_000)[:9601]
    np.testing.assert_allclose(LowBins(17_266, 160_000, 9601)(x), whole, rtol=1e-10)


@pytest.mark.parametrize(
    ("last_hz", "nfft", "rate_hz", "bins"),
    [
        (60.0, 160_000, 1000.0, 9601),
        (0.1 + 0.2, 100, 10.0, 4),
        (0.3, 100, 10.0, 4),
        (0.2999, 100, 10.0, 3),
        (1e6, 100, 10.0, 51),
        (0.0, 100, 10.0, 1),
    ],
)
def test_bins_up_to_a_frequency(last_hz, nfft, rate_hz, bins):
    assert bins_up_to(last_hz, nfft, rate_hz) == bins
