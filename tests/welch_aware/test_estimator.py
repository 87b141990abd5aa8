"""The estimator as a linear map: it is Welch's, and its transpose is its transpose."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.welch_aware import WelchAwareError
from analysis.welch_aware.estimator import WelchEstimator, bins_of
from rigd.spectral import Segmentation, instrumental_response, welch_response

segmentations = st.integers(8, 60).flatmap(
    lambda length: st.builds(
        Segmentation, st.just(length), st.integers(0, length - 1), st.integers(length, 130)
    )
)


@settings(max_examples=80)
@given(
    segmentation=segmentations,
    samples=st.integers(60, 200),
    window=st.sampled_from(["hamming", "hann", "rectangular"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_response_and_transpose(segmentation, samples, window, seed):
    rng = np.random.default_rng(seed)
    angle, one, other = rng.normal(size=(3, samples))
    welch = welch_response(
        angle, one, 1.0, segment_length=segmentation.segment_length,
        overlap=segmentation.overlap, nfft=segmentation.nfft, window=window,
    )  # fmt: skip
    bins = np.arange(1, (segmentation.nfft + 1) // 2)
    estimator = WelchEstimator(angle, segmentation, bins, window)
    both = estimator.response(np.array([one, other]))
    np.testing.assert_allclose(both[0], welch.response[bins], rtol=1e-9, atol=1e-9)
    rows = rng.normal(size=(2, bins.size, 2)) @ [1, 1j]
    sensitivity = estimator.transposed(rows)
    for row, b in zip(rows, sensitivity, strict=True):
        for torque, response in zip((one, other), both, strict=True):
            whole = np.abs(row) @ np.abs(response)
            assert b @ torque == pytest.approx(np.vdot(row, response).real, abs=1e-9 * whole)


@settings(max_examples=40)
@given(segmentation=segmentations, samples=st.integers(60, 200), seed=st.integers(0, 2**32 - 1))
def test_with_a_reference_it_is_hiv(segmentation, samples, seed):
    rng = np.random.default_rng(seed)
    reference, more, torque = rng.normal(size=(3, samples))
    angle = reference + 0.1 * more
    hiv = instrumental_response(
        reference, angle, torque, 1.0, segment_length=segmentation.segment_length,
        overlap=segmentation.overlap, nfft=segmentation.nfft,
    )  # fmt: skip
    bins = np.arange(1, (segmentation.nfft + 1) // 2)
    estimator = WelchEstimator(angle, segmentation, bins, "hamming", reference)
    np.testing.assert_allclose(estimator.response(torque), hiv.response[bins], rtol=1e-6)
    rows = rng.normal(size=(1, bins.size, 2)) @ [1, 1j]
    expected = np.vdot(rows[0], hiv.response[bins]).real
    whole = np.abs(rows[0]) @ np.abs(hiv.response[bins])
    assert estimator.transposed(rows)[0] @ torque == pytest.approx(expected, abs=1e-6 * whole)


def test_input_power_is_what_white_noise_is_divided_by():
    """Var H = variance of the noise x taper's power / input_power, H1 or Hiv."""
    rng = np.random.default_rng(2)
    angle, more = rng.normal(size=(2, 400))
    noise = rng.normal(size=(4000, 400))
    for reference in (None, angle + 0.5 * more):
        estimator = WelchEstimator(
            angle, Segmentation(50, 0, 50), np.arange(2, 24), "hann", reference
        )
        scatter = np.mean(np.abs(estimator.response(noise)) ** 2, axis=0)
        expected = float(estimator.taper @ estimator.taper) / estimator.input_power
        np.testing.assert_allclose(scatter / expected, 1.0, atol=0.15)


def test_samples_after_the_last_segment_do_not_count():
    angle = np.random.default_rng(1).normal(size=100)
    estimator = WelchEstimator(angle, Segmentation(30, 0, 30), np.arange(1, 15), "hann")
    sensitivity = estimator.transposed(np.ones((1, 14), dtype=complex))[0]
    assert not sensitivity[90:].any()
    assert sensitivity[:90].any()


def test_an_angle_without_power_is_refused():
    with pytest.raises(WelchAwareError, match="no power"):
        WelchEstimator(np.zeros(100), Segmentation(30, 0, 30), np.arange(1, 15), "hann")


def test_rounded_frequencies_find_their_bins():
    exact = np.arange(94, 8001) / 160
    bins = bins_of(np.round(exact, 5), 1000.0, Segmentation())
    np.testing.assert_array_equal(bins, np.arange(94, 8001))


@pytest.mark.parametrize(
    ("frequency_hz", "said"),
    [
        ([1.0, 1.00313, 2.0], "1 of 3 frequencies, the first 1.00313 Hz.*multiples of 0.00625 Hz"),
        ([0.0, 1.0], "between 0 and half the rate"),
        ([1.0, 500.0], "between 0 and half the rate"),
        ([2.0, 1.0], "must increase"),
    ],
)
def test_frequencies_off_the_grid_are_refused(frequency_hz, said):
    with pytest.raises(WelchAwareError, match=said):
        bins_of(np.array(frequency_hz), 1000.0, Segmentation())
