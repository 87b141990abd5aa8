"""What is compared: enough bins and no more, and nothing that does not belong together."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.welch_aware import WelchAwareError
from analysis.welch_aware.comparison import Measured
from rigd.spectral import Segmentation

TIME_S = np.arange(12_000) / 100.0
GOOD = Measured(
    angle_rad=np.sin(2 * np.pi * (0.05 + 0.15 * TIME_S) * TIME_S),
    rate_hz=100.0,
    frequency_hz=np.arange(94, 4001) / 160,
    response=np.ones(3907, dtype=complex),
    segmentation=Segmentation(1726, 259, 16_000),
    window="hamming",
    estimated_from=slice(None),
)


def test_as_many_bins_as_the_segments_tell_apart():
    comparison = GOOD.comparison("const")
    hz = comparison.frequency_hz
    np.testing.assert_allclose(np.diff(hz), 8 / 160)  # 20 Hz: the next finer than 1/17.26 s
    assert hz[0] == pytest.approx(96 / 160)
    assert comparison.weights.sum() == pytest.approx(1.0)


def test_bins_that_are_sparse_already_are_all_kept():
    sparse = slice(6, None, 10)
    measured = replace(GOOD, frequency_hz=GOOD.frequency_hz[sparse], response=GOOD.response[sparse])
    np.testing.assert_allclose(measured.comparison("omega").frequency_hz, GOOD.frequency_hz[sparse])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"response": np.ones(3, dtype=complex)}, "one value of the response for each frequency"),
        ({"response": np.full(3907, np.nan + 0j)}, "leave out frequencies without a value"),
        ({"rate_hz": 50.0}, "reaches 25 Hz.*sampled at 50 Hz.*below 20 Hz"),
        ({"angle_rad": np.zeros(12_000)}, "finite at every sample, and move"),
        ({"angle_rad": np.full(12_000, np.nan)}, "finite at every sample"),
        ({"estimated_from": slice(0, 900)}, "900 samples.*fewer than one Welch segment of 1726"),
    ],
)
def test_what_cannot_be_used_is_refused(change, said):
    with pytest.raises(WelchAwareError, match=said):
        replace(GOOD, **change).check()
