"""Leakage of a narrow-band disturbance (hum) next to the band, such as the mains at 50 Hz.

Within the band the estimator finds lines itself (`NoiseSpectrum.lines`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.noise import NoiseSpectrum, estimate_noise, smooth_power

if TYPE_CHECKING:
    from analysis.identify._comparison import Comparison
    from analysis.identify._result import RecordFit

_SEARCH_RANGE_HZ: Final = 5.0
"""Distance in hertz from the upper end of the band within which lines are searched for."""

_SAME_LINE_HZ: Final = 0.1
"""Distance in hertz within which two lines are considered the same line."""

_DIFFERENT_MOTION_CORRELATION: Final = 0.5
"""Correlation of the motor angle with itself, at a time lag, below which the motions are different.
"""

_REPEATED_MOTION_CORRELATION: Final = 0.9
"""Correlation of the motor angle with itself, at a time lag, above which the motion is repeated."""

_HARMLESS_LEAKAGE_RATIO: Final = 0.3
"""Largest power that leaks into a bin without harm, relative to the noise."""


def without_leakage(noise: NoiseSpectrum, comparison: Comparison, fit: RecordFit) -> NoiseSpectrum:
    """Exclude bins into which a disturbance beyond the band leaks; add it to the noise lines.

    Parameters
    ----------
    noise : NoiseSpectrum
        Estimated noise.
    comparison : Comparison
        Record, reduced to the band.
    fit : RecordFit
        Best fit under that noise: its torque is subtracted.
    """
    rate_hz, samples = comparison.decimation.rate_hz, comparison.samples
    end_hz = float(comparison.frequency_hz[-1])
    torque, _ = comparison.prediction.torque(fit.plant)
    residual = np.fft.rfft(comparison.torque_nm[comparison.retained] - torque)
    all_hz = np.fft.rfftfreq(samples, 1 / rate_hz).astype(np.float64)
    is_near_end = np.abs(all_hz - end_hz) < min(_SEARCH_RANGE_HZ, rate_hz / 2 - end_hz)
    known_fraction = comparison.measurement.known_torque_fraction
    near_mode = np.zeros(np.count_nonzero(is_near_end), dtype=bool)
    noise_near_end = estimate_noise(
        residual[is_near_end], all_hz[is_near_end], samples, known_fraction, near_mode=near_mode
    )
    is_used, lines = noise.counts.copy(), list(noise.lines)
    for line in noise_near_end.lines:
        # A line leaks as peak / (pi distance in bins).
        peak = line.amplitude_nm * samples / 2
        harmless_peak = math.sqrt(_HARMLESS_LEAKAGE_RATIO * float(noise.power[-1]))
        reach_hz = peak / (math.pi * harmless_peak) * rate_hz / samples
        is_used &= np.abs(comparison.frequency_hz - line.frequency_hz) > reach_hz
        other_lines = [k for k in lines if abs(line.frequency_hz - k.frequency_hz) > _SAME_LINE_HZ]
        lines = [*other_lines, line]
    if not noise_near_end.lines:
        return noise
    # The leakage has raised the estimated noise of whole blocks of bins: estimate it again.
    clean_residual = (fit.residual * np.sqrt(noise.power / 2))[is_used]
    bins = np.arange(is_used.size)
    power = np.exp(
        np.interp(bins, bins[is_used], np.log(smooth_power(clean_residual) / known_fraction))
    )
    return NoiseSpectrum(power, is_used, tuple(lines))


def repetition_period_s(comparison: Comparison) -> float:
    """Return the period in seconds of the motion of the motor; 0 if the motion does not repeat."""
    angle = comparison.angle_rad[comparison.retained]
    angle = angle - angle.mean()
    count = angle.size
    spectrum = np.fft.rfft(angle, 2 * count)
    autocorrelation = np.fft.irfft(np.abs(spectrum) ** 2)[: count // 2 + 1]
    # Norm of the two overlapping parts of the angle at each lag.
    cumulative_energy = np.concatenate([[0.0], np.cumsum(angle**2)])
    lags = np.arange(autocorrelation.size)
    norm = np.sqrt(
        cumulative_energy[count - lags] * (cumulative_energy[count] - cumulative_energy[lags])
    )
    correlation = autocorrelation / np.maximum(norm, np.finfo(float).tiny)
    different_lags = np.flatnonzero(correlation < _DIFFERENT_MOTION_CORRELATION)
    if different_lags.size == 0:
        return 0.0
    repeated_lags = np.flatnonzero(
        (correlation > _REPEATED_MOTION_CORRELATION) & (lags > different_lags[0])
    )
    if repeated_lags.size == 0:
        return 0.0
    end = int(repeated_lags[0])
    while end + 1 < autocorrelation.size and correlation[end + 1] > correlation[end]:
        end += 1
    return end / comparison.decimation.rate_hz
