"""Residual tests: whiteness, coherence with the input, harmonics of the sweep.

Chance is ruled out at one level throughout (`SIGNIFICANT_STD`). The cumulative periodogram of a
white residual is a straight line, apart from a Kolmogorov statistic (Bartlett's test). A residual
that is coherent with the angle is linear dynamics that the model lacks.

A linear beam responds at the drive frequency, and rings at frequencies that the sweep has passed. A
response at twice or three times the drive frequency is nonlinear. The test for it needs no model.

References
----------
M. S. Bartlett, An Introduction to Stochastic Processes (1955): the cumulative periodogram.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.statistics import KOLMOGOROV_95, chi_square_deviate, kolmogorov_p_value

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Level of significance

SIGNIFICANT_STD: Final = 5.0
"""Standard deviations from which chance is ruled out: a probability of 3 in 10 million for all
tests together."""


def largest_deviate_limit(deviate_count: int) -> float:
    """Return the significance limit of x²/2 for the largest of several normal deviates x."""
    return SIGNIFICANT_STD**2 / 2 + math.log(max(deviate_count, 1))


# Whiteness, and coherence with the input

_NOT_WHITE_PROBABILITY: Final = 1e-6
"""Probability of chance below which a residual is not white, comparable to `SIGNIFICANT_STD`."""

_DOUBTFUL_PROBABILITY: Final = 0.01
"""Probability of chance below which a residual is doubtful. A false alarm costs only computing time
there."""

_MAX_POWER_RATIO_BY_WINDOW_BINS: Final = {8: 5.0, 32: 2.6}
"""Power over that of the noise above which a window of 8 or 32 bins is loud. One record of white
noise in 5000 has such a window (of 12 000 records with the noise estimated from medians of 60
bins). Such an estimate is uncertain by up to 18 %: with the limits for a noise that is known
exactly, 4.3 and 2.3, one record in 160 would be loud."""

_COHERENCE_BIN_COUNT: Final = 9
"""Number of neighbouring bins over which the coherence is computed."""

_DRIVEN_POWER_RATIO: Final = 0.1
"""Power of the angle, relative to the mean around it, from which a bin counts as driven."""

_MAX_WHITENED_RESIDUAL: Final = 4.0
"""Magnitude to which the whitened residual is limited. Chance exceeds it once in 3000 bins."""

_MAX_LAG_S: Final = 1.0
"""Largest lag of the correlation between residual and angle, in seconds."""

_AVERAGING_BINS: Final = 64
"""Number of bins over which the angle's power is averaged: more than between two lines of a
multisine."""


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Result of the test whether a residual is white, by Bartlett's cumulative periodogram.

    Attributes
    ----------
    distance : float
        Largest distance of the cumulative periodogram from the straight line.
    band : float
        Distance that 95 % of the records with nothing but noise do not exceed.
    probability : float
        Probability of such a distance by chance.
    loudest_hz : tuple of float
        First and last frequency of the window whose power is least likely by chance.
    loudest_ratio : float
        Power in this window over that of the noise.
    loud : bool
        Whether the power in any window rules out chance.
    """

    distance: float
    band: float
    probability: float
    loudest_hz: tuple[float, float]
    loudest_ratio: float
    loud: bool

    @property
    def is_white(self) -> bool:
        """Return whether the power of the residual is distributed over frequency as noise is."""
        return self.probability > _NOT_WHITE_PROBABILITY and not self.loud

    @property
    def is_nearly_white(self) -> bool:
        """Return whether noise alone gives such a residual in at least one record of 100."""
        return self.probability > _DOUBTFUL_PROBABILITY and not self.loud


@dataclass(frozen=True, slots=True)
class InputRelation:
    """Result of the test whether a residual follows the angle, by dynamics outside the model.

    Attributes
    ----------
    coherence : float
        Squared coherence of residual and angle over nine neighbouring bins, at the frequency where
        it is least likely by chance.
    at_hz : float
        Frequency of this coherence.
    local : bool
        Whether this coherence rules out chance.
    deviate : float
        Deviate of the coherence over the whole band, in standard deviations beyond chance.
    correlation : float
        Largest correlation of residual and angle, both whitened, in standard deviations.
    lag_s : float
        Lag of the largest correlation, negative if the residual precedes the angle.
    related : bool
        Whether any of the three tests rules out chance.
    """

    coherence: float
    at_hz: float
    local: bool
    deviate: float
    correlation: float
    lag_s: float
    related: bool


def cumulative_periodogram(residual: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the fraction of the power of a whitened residual up to each bin, shape (K,).

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.identify.residual_tests import cumulative_periodogram
    >>> print(cumulative_periodogram(np.array([1, 1j, -1, 1])))
    [0.25 0.5  0.75 1.  ]
    """
    cumulative_power = np.cumsum(residual.real**2 + residual.imag**2)
    power_fraction: NDArray[np.float64] = cumulative_power / cumulative_power[-1]
    return power_fraction


def whiteness(residual: NDArray[np.complex128], frequency_hz: NDArray[np.float64]) -> Whiteness:
    """Test whether a whitened residual is white.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Whitened residual at the compared bins.
    frequency_hz : ndarray, shape (K,)
        Frequencies of these bins.
    """
    bin_count = residual.size
    straight_line = np.arange(1, bin_count + 1) / bin_count
    largest_distance = float(np.abs(cumulative_periodogram(residual) - straight_line).max())
    bin_power = residual.real**2 + residual.imag**2
    cumulative_power = np.concatenate([[0.0], np.cumsum(bin_power)])
    largest_deviate, loudest_hz, loudest_ratio, is_loud = -math.inf, (0.0, 0.0), 1.0, False
    for window_bins, max_power_ratio in _MAX_POWER_RATIO_BY_WINDOW_BINS.items():
        if window_bins >= bin_count:
            continue
        window_power = cumulative_power[window_bins:] - cumulative_power[:-window_bins]
        loudest_window_index = int(np.argmax(window_power))
        window_deviate = chi_square_deviate(
            float(window_power[loudest_window_index]), 2 * window_bins
        )
        if window_deviate > largest_deviate:
            largest_deviate = window_deviate
            loudest_hz = (
                float(frequency_hz[loudest_window_index]),
                float(frequency_hz[loudest_window_index + window_bins - 1]),
            )
            loudest_ratio = float(window_power[loudest_window_index]) / (2 * window_bins)
        is_loud |= float(window_power[loudest_window_index]) / (2 * window_bins) > max_power_ratio
    return Whiteness(
        distance=largest_distance,
        band=KOLMOGOROV_95 / math.sqrt(bin_count),
        probability=kolmogorov_p_value(largest_distance * math.sqrt(bin_count)),
        loudest_hz=loudest_hz,
        loudest_ratio=loudest_ratio,
        loud=is_loud,
    )


def input_relation(
    residual: NDArray[np.complex128],
    angle_transform: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
) -> InputRelation:
    """Test whether a residual is linearly related to the angle.

    Parameters
    ----------
    residual, angle_transform : ndarray of complex, shape (K,)
        Whitened residual, and Fourier transform of the angle.
    frequency_hz : ndarray, shape (K,)
        Frequencies of the bins, equally spaced.
    """
    # Where the motor was not driven, the angle is the response of the loop to the torque's noise.
    # Such bins would show a relation of residual and angle, so they have almost no weight here.
    angle_power_per_bin = np.abs(angle_transform) ** 2
    averaged_bins = min(_AVERAGING_BINS, angle_power_per_bin.size)
    mean_power = np.convolve(
        angle_power_per_bin, np.full(averaged_bins, 1 / averaged_bins), mode="same"
    )
    normalized_angle = angle_transform / np.sqrt(np.maximum(mean_power, np.finfo(float).tiny))
    # The limit keeps a hum, which is no linear dynamics, from dominating.
    limited_residual = residual / np.maximum(np.abs(residual) / _MAX_WHITENED_RESIDUAL, 1.0)
    cross_spectrum = limited_residual * normalized_angle.conj()
    block_count = residual.size // _COHERENCE_BIN_COUNT
    first_bins = np.arange(0, block_count * _COHERENCE_BIN_COUNT, _COHERENCE_BIN_COUNT)

    def block_sums(bin_values: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the sum of values over each group of `_COHERENCE_BIN_COUNT` neighbouring bins."""
        sums_per_block: NDArray[np.complex128] = np.add.reduceat(
            bin_values[: block_count * _COHERENCE_BIN_COUNT], first_bins
        )
        return sums_per_block

    block_angle_power = block_sums(normalized_angle * normalized_angle.conj()).real
    driven_blocks = np.flatnonzero(block_angle_power > _DRIVEN_POWER_RATIO * _COHERENCE_BIN_COUNT)
    largest_cross_power = (
        block_sums(limited_residual * limited_residual.conj()).real[driven_blocks]
        * block_angle_power[driven_blocks]
    )
    coherence = np.abs(block_sums(cross_spectrum)[driven_blocks]) ** 2 / np.maximum(
        largest_cross_power, np.finfo(float).tiny
    )
    # Under chance (1 - coherence)^(m - 1) is uniform, whatever the angle.
    ln_chance = -(_COHERENCE_BIN_COUNT - 1) * np.log1p(-np.minimum(coherence, 1 - 1e-12))
    least_likely_index = int(np.argmax(ln_chance))
    is_locally_related = bool(
        ln_chance[least_likely_index] > largest_deviate_limit(driven_blocks.size)
    )
    summed_deviate = chi_square_deviate(2 * float(ln_chance.sum()), 2 * driven_blocks.size)

    spacing_hz = float(frequency_hz[1] - frequency_hz[0])
    padded_length = 4 * residual.size
    lag_transform = np.fft.ifft(cross_spectrum, padded_length)
    lags_s = np.fft.fftfreq(padded_length, spacing_hz)  # bins are spaced as the lags' inverse
    first_bin_carrier = np.exp(2j * np.pi * frequency_hz[0] * lags_s)
    correlation = (
        np.abs((lag_transform * first_bin_carrier).real)
        * padded_length
        / np.linalg.norm(normalized_angle)
    )
    correlation[np.abs(lags_s) > _MAX_LAG_S] = 0.0
    largest_index = int(np.argmax(correlation))
    lag_count = int(np.count_nonzero(correlation))
    return InputRelation(
        coherence=float(coherence[least_likely_index]),
        at_hz=float(
            frequency_hz[first_bins[driven_blocks[least_likely_index]] + _COHERENCE_BIN_COUNT // 2]
        ),
        local=is_locally_related,
        deviate=summed_deviate,
        correlation=float(correlation[largest_index]),
        lag_s=float(lags_s[largest_index]),
        related=bool(
            is_locally_related
            or summed_deviate > SIGNIFICANT_STD
            or correlation[largest_index] ** 2 / 2 > largest_deviate_limit(lag_count)
        ),
    )


# Harmonics of the sweep

TESTED_MULTIPLES: Final = (2, 3)
"""Multiples of the drive frequency that are tested."""

_BLOCK_DURATION_S: Final = 1.0
"""Duration of the blocks in which a harmonic is measured, in seconds."""

_MIN_DRIVE_HZ: Final = 2.0
"""Drive frequency below which a block does not resolve a frequency and its double."""

_MAX_UNSTEADINESS: Final = 0.3
"""Largest deviation of the phase from a smooth curve in rad, and smallest amplitude relative to the
median, of a usable block."""

_MIN_BLOCKS: Final = 5
"""Smallest number of usable blocks for the test of a harmonic."""


@dataclass(frozen=True, slots=True)
class Harmonic:
    """Result of the test for one harmonic of the sweep in a residual.

    Attributes
    ----------
    multiple : int
        Multiple of the drive frequency: 2 or 3.
    deviate : float
        Deviate of the power along the whole sweep, in standard deviations beyond chance.
    drive_hz : float
        Drive frequency at which the harmonic is largest.
    present : bool
        Whether chance is ruled out, for the whole sweep or at `drive_hz`.
    """

    multiple: int
    deviate: float
    drive_hz: float
    present: bool


def harmonics(
    angle_rad: NDArray[np.float64],
    residual: NDArray[np.float64],
    rate_hz: float,
    band_hz: tuple[float, float],
) -> tuple[Harmonic, ...]:
    """Test a residual for harmonics of a sweep; return an empty tuple if the angle is no sweep.

    Parameters
    ----------
    angle_rad, residual : ndarray, shape (n,)
        Angle, and whitened residual (variance 1 per sample if white up to half the rate).
    rate_hz : float
        Sampling rate of both.
    band_hz : tuple of float
        First and last frequency at which the residual is known.
    """
    block_length = round(_BLOCK_DURATION_S * rate_hz)
    block_count = angle_rad.size // block_length
    analytic_blocks = _analytic_signal(angle_rad)[: block_count * block_length].reshape(
        block_count, block_length
    )
    phase_rad = np.unwrap(np.angle(analytic_blocks), axis=1)
    drive_hz = (phase_rad[:, -1] - phase_rad[:, 0]) / (2 * np.pi * (block_length - 1) / rate_hz)
    block_amplitude = np.abs(analytic_blocks).mean(axis=1)
    # The frequency of a sweep hardly varies within a block, so its phase is a smooth curve.
    block_time = np.linspace(-1, 1, block_length)
    phase_coefficients = np.polynomial.polynomial.polyfit(block_time, phase_rad.T, 2)
    phase_deviation = np.abs(
        phase_rad - np.polynomial.polynomial.polyval(block_time, phase_coefficients)
    ).mean(axis=1)
    is_steady_block = (
        (phase_deviation < _MAX_UNSTEADINESS)
        & (block_amplitude > _MAX_UNSTEADINESS * np.median(block_amplitude))
        & (drive_hz > _MIN_DRIVE_HZ)
    )
    hann_window = np.hanning(block_length)
    windowed_blocks = (
        residual[: block_count * block_length].reshape(block_count, block_length) * hann_window
    )
    harmonic_tests = []
    for multiple in TESTED_MULTIPLES:
        is_tested_block = (
            is_steady_block
            & (multiple * drive_hz > band_hz[0] + 2)
            & (multiple * drive_hz < band_hz[1] - 2)
        )
        if np.count_nonzero(is_tested_block) < _MIN_BLOCKS:
            continue
        harmonic_amplitudes = np.sum(
            windowed_blocks[is_tested_block] * np.exp(-1j * multiple * phase_rad[is_tested_block]),
            axis=1,
        )
        chi_square = 2 * np.abs(harmonic_amplitudes) ** 2 / np.sum(hann_window**2)
        harmonic_deviate = chi_square_deviate(float(chi_square.sum()), 2 * chi_square.size)
        largest_index = int(np.argmax(chi_square))
        harmonic_tests.append(
            Harmonic(
                multiple=multiple,
                deviate=harmonic_deviate,
                drive_hz=float(drive_hz[is_tested_block][largest_index]),
                present=bool(
                    harmonic_deviate > SIGNIFICANT_STD
                    or chi_square[largest_index] / 2 > largest_deviate_limit(chi_square.size)
                ),
            )
        )
    return tuple(harmonic_tests)


def _analytic_signal(real_samples: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the analytic signal of real samples without their mean, shape (n,).

    Its spectrum has no negative frequencies.
    """
    one_sided_spectrum = np.fft.fft(real_samples - real_samples.mean())
    n = real_samples.size
    one_sided_spectrum[(n + 1) // 2 :] = 0
    one_sided_spectrum[1 : (n + 1) // 2] *= 2
    analytic_signal: NDArray[np.complex128] = np.fft.ifft(one_sided_spectrum)
    return analytic_signal
