"""Decimation to a frequency band, and interpolation of gaps in a band-limited signal.

Decimation is by a linear-phase FIR filter (Kaiser window), so that the whole band is retained and
no channel is delayed relative to another.

References
----------
N. Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
J. F. Kaiser, Nonrecursive digital filter design using the I0-sinh window function, Proc. IEEE Int.
Symp. Circuits and Systems (1974) 20-23.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Interpolation of gaps

MAX_GAP_PERIODS: Final = 0.4
"""Longest gap that is interpolated, in periods of the band's highest frequency."""

NEIGHBOUR_REACH_PERIODS: Final = 2.0
"""Duration to either side of a gap from which values are used to interpolate the gap, in periods of
the highest frequency."""

_ASSUMED_BANDWIDTH_RATIO: Final = 1.2
"""Bandwidth that the interpolation of gaps assumes, relative to the signal's highest frequency."""

_RELATIVE_NOISE_POWER: Final = 1e-6
"""Power of white noise that the interpolation of gaps assumes, relative to the power of the signal.
"""


def interpolate_gaps(
    signal_values: NDArray[np.float64], known_mask: NDArray[np.bool_], cycles_per_sample: float
) -> NDArray[np.float64]:
    """Estimate the unknown values of a band-limited signal from their known neighbours.

    This is the best linear estimate for a signal with a flat spectrum up to its highest frequency
    and a little white noise (N. Wiener), from the values within two periods to either side of a
    gap. In a gap of a quarter of a period, its error is less than 0.1 % of the signal; linear
    interpolation would have an error of a third.

    Parameters
    ----------
    signal_values : ndarray, shape (n,)
        Signal; unknown values are ignored.
    known_mask : ndarray of bool, shape (n,)
        Whether each value is known.
    cycles_per_sample : float
        Highest frequency, in cycles per sample.

    Returns
    -------
    ndarray, shape (n,)
        The given values where known, the estimates elsewhere.
    """
    filled_values = np.where(known_mask, signal_values, 0.0)
    neighbour_reach_samples = int(np.ceil(NEIGHBOUR_REACH_PERIODS / cycles_per_sample))
    for gap_start, gap_end in zip(*runs_of_true(~known_mask), strict=True):
        first_neighbour = max(gap_start - neighbour_reach_samples, 0)
        neighbour_indices = first_neighbour + np.flatnonzero(
            known_mask[first_neighbour : gap_end + neighbour_reach_samples]
        )
        if neighbour_indices.size == 0:
            continue
        weights = _interpolation_weights(
            tuple(neighbour_indices - gap_start),
            int(gap_end - gap_start),
            _ASSUMED_BANDWIDTH_RATIO * cycles_per_sample,
        )
        mean_value = float(signal_values[neighbour_indices].mean())
        filled_values[gap_start:gap_end] = mean_value + weights @ (
            signal_values[neighbour_indices] - mean_value
        )
    return filled_values


@lru_cache(maxsize=64)
def _interpolation_weights(
    neighbour_offsets: tuple[int, ...], gap_length: int, cycles_per_sample: float
) -> NDArray[np.float64]:
    """Return the weights of known neighbours in the estimates of a gap's values.

    The shape is (gap length, neighbours). `neighbour_offsets` are the indices of the neighbours
    relative to the start of the gap, and `cycles_per_sample` is the bandwidth of the signal.
    """
    offsets = np.array(neighbour_offsets)
    neighbour_covariance = np.sinc(2 * cycles_per_sample * np.subtract.outer(offsets, offsets))
    neighbour_covariance += _RELATIVE_NOISE_POWER * np.eye(offsets.size)
    gap_covariance = np.sinc(
        2 * cycles_per_sample * np.subtract.outer(np.arange(gap_length), offsets)
    )
    weights: NDArray[np.float64] = np.linalg.solve(neighbour_covariance, gap_covariance.T).T
    return weights


def runs_of_true(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the start index of each run of True in a mask, and the index after its end."""
    edge_value = np.zeros(1, np.int8)  # of the mask's own size: a long record has many values
    run_edges = np.diff(np.concatenate((edge_value, mask.astype(np.int8), edge_value)))
    return np.flatnonzero(run_edges == 1), np.flatnonzero(run_edges == -1)


# Decimation

_STOP_BAND_ATTENUATION_DB: Final = 100.0
"""Attenuation of the decimation filter in its stop band, in decibels."""

_RATE_RATIO_TOLERANCE: Final = 1e-9
"""Tolerance for the rounding error of the ratio of two sampling rates."""

_MIN_RATE_TO_BAND_RATIO: Final = 2.4
"""Minimum decimated sampling rate relative to the highest frequency: at lower rates the decimation
filter becomes long."""

_RATE_TO_BAND_RATIOS: Final = (_MIN_RATE_TO_BAND_RATIO, 5.0, 10.0)
"""Minimum decimated sampling rates relative to the highest frequency: the filter has a half length
of some 13, 2 or 0.8 periods of the highest frequency."""


@dataclass(frozen=True, slots=True)
class Decimation:
    """Reduction of the sampling rate: centred linear-phase low-pass filter, then downsampling.

    It does not use `scipy.signal` (`kaiserord`, `firwin` and `oaconvolve`), whose import takes 0.64
    s of processor time: a tenth of the analysis of a session of 76 s.

    Attributes
    ----------
    downsampling_factor : int
        One sample in `downsampling_factor` is retained.
    kernel : ndarray, shape (2 * half_length_samples * downsampling_factor + 1,)
        Impulse response of the filter: it passes `highest_hz`, and attenuates by 100 dB from half
        the new rate on.
    half_length_samples : int
        Half length of the filter, in samples of the new rate.
    rate_hz : float
        Sampling rate after decimation.
    """

    downsampling_factor: int
    kernel: NDArray[np.float64]
    half_length_samples: int
    rate_hz: float

    @classmethod
    def to_band(
        cls,
        rate_hz: float,
        highest_hz: float,
        min_rate_to_band_ratio: float = _MIN_RATE_TO_BAND_RATIO,
    ) -> Decimation:
        """Return the decimation to the lowest rate that preserves the band from 0 to `highest_hz`.

        Parameters
        ----------
        rate_hz : float
            Rate of the record.
        highest_hz : float
            Highest frequency that is preserved, at most 0.4 `rate_hz`.
        min_rate_to_band_ratio : float
            Minimum rate after decimation relative to `highest_hz`.
        """
        downsampling_factor = max(
            int(rate_hz / (min_rate_to_band_ratio * highest_hz) + _RATE_RATIO_TOLERANCE), 1
        )
        new_rate_hz = rate_hz / downsampling_factor
        stop_band_hz = new_rate_hz / 2
        # Kaiser's formulas for the length of the filter and the shape of its window.
        transition_width = 2 * np.pi * (stop_band_hz - highest_hz) / rate_hz
        half_length = (_STOP_BAND_ATTENUATION_DB - 7.95) / (2 * 2.285 * transition_width)
        half_length_samples = int(np.ceil(half_length / downsampling_factor))
        kernel_ticks = np.arange(
            -half_length_samples * downsampling_factor,
            half_length_samples * downsampling_factor + 1,
        )
        relative_cutoff = (
            stop_band_hz + highest_hz
        ) / rate_hz  # twice the middle of the transition
        kernel = relative_cutoff * np.sinc(relative_cutoff * kernel_ticks)
        kernel *= np.kaiser(kernel_ticks.size, 0.1102 * (_STOP_BAND_ATTENUATION_DB - 8.7))
        return cls(downsampling_factor, kernel / kernel.sum(), half_length_samples, new_rate_hz)

    @classmethod
    def with_half_length(
        cls, rate_hz: float, highest_hz: float, max_half_length_s: float
    ) -> Decimation:
        """Return the decimation to the lowest rate with a filter that is short enough.

        If no filter is short enough, return the decimation to the lowest rate.

        Parameters
        ----------
        rate_hz, highest_hz : float
            As for `to_band`.
        max_half_length_s : float
            Largest half length of the filter in seconds.
        """
        for rate_to_band_ratio in _RATE_TO_BAND_RATIOS:
            decimation = cls.to_band(rate_hz, highest_hz, rate_to_band_ratio)
            if decimation.half_length_samples <= max_half_length_s * decimation.rate_hz:
                return decimation
        return cls.to_band(rate_hz, highest_hz)

    def apply(self, signal_values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Low-pass filter a signal and downsample it.

        Parameters
        ----------
        signal_values : ndarray, shape (n,)
            Signal at the original rate, assumed to be 0 before and after.

        Returns
        -------
        ndarray, shape (m,)
            Filtered samples. Sample `half_length_samples` has the time of the first value.
        """
        filtered_length = signal_values.size + self.kernel.size - 1
        padded_length = fast_fft_length(filtered_length)
        spectrum = np.fft.rfft(signal_values, padded_length) * np.fft.rfft(
            self.kernel, padded_length
        )
        return np.fft.irfft(spectrum, padded_length)[
            : filtered_length : self.downsampling_factor
        ].copy()

    def samples_inside_record(self, tick_count: int) -> slice:
        """Return the slice of decimated samples whose filter window lies within the record.

        `tick_count` is the number of ticks of the record.
        """
        return slice(2 * self.half_length_samples, (tick_count - 1) // self.downsampling_factor + 1)


def fast_fft_length(min_length: int) -> int:
    """Return the smallest integer from `min_length` (1 or more) on with prime factors up to 11.

    Fourier transforms of such a length are fast. With prime factors up to 5 (``real=True`` in
    SciPy), transforms of real values would be a fifth faster, but no fit. The length determines the
    grid of the Laplace variable (`TorquePredictor`) and so the last digits of every estimate.

    Examples
    --------
    >>> from analysis.decimation import fast_fft_length
    >>> fast_fft_length(1013)
    1024
    """
    from scipy.fft import next_fast_len

    return int(next_fast_len(min_length))


def fast_fft_length_below(max_length: int) -> int:
    """Return the largest integer up to `max_length` (1 or more) with prime factors up to 11.

    Fourier transforms of such a length are fast.
    """
    from scipy.fft import prev_fast_len

    return int(prev_fast_len(max_length))
