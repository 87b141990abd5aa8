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

_LINE_SEARCH_RANGE_HZ: Final = 5.0
"""Distance in hertz from the upper end of the band within which lines are searched for."""

_SAME_LINE_DISTANCE_HZ: Final = 0.1
"""Distance in hertz within which two lines are considered the same line."""

_MAX_DIFFERENT_MOTION_CORRELATION: Final = 0.5
"""Correlation of the motor angle with itself, at a time lag, below which the motions are different.
"""

_MIN_REPEATED_MOTION_CORRELATION: Final = 0.9
"""Correlation of the motor angle with itself, at a time lag, above which the motion is repeated."""

_MAX_HARMLESS_LEAKAGE_RATIO: Final = 0.3
"""Largest power that leaks into a bin without harm, relative to the noise."""


def without_leakage(noise: NoiseSpectrum, comparison: Comparison, fit: RecordFit) -> NoiseSpectrum:
    """Return the noise without the bins into which disturbances beyond the band leak.

    The disturbances are added to the lines of the noise. `fit` is the best fit under the estimated
    noise; its torque is subtracted.
    """
    rate_hz, samples = comparison.decimation.rate_hz, comparison.sample_count
    band_end_hz = float(comparison.frequency_hz[-1])
    predicted_nm, _ = comparison.torque_predictor.torque(fit.plant)
    residual_spectrum = np.fft.rfft(
        comparison.torque_nm[comparison.retained_samples] - predicted_nm
    )
    all_frequencies_hz = np.fft.rfftfreq(samples, 1 / rate_hz).astype(np.float64)
    is_near_band_end = np.abs(all_frequencies_hz - band_end_hz) < min(
        _LINE_SEARCH_RANGE_HZ, rate_hz / 2 - band_end_hz
    )
    known_torque_fraction = comparison.measurement.known_torque_fraction
    is_near_mode = np.zeros(np.count_nonzero(is_near_band_end), dtype=bool)
    noise_near_band_end = estimate_noise(
        residual_spectrum[is_near_band_end],
        all_frequencies_hz[is_near_band_end],
        samples,
        known_torque_fraction,
        is_near_mode=is_near_mode,
    )
    used_bins, noise_lines = noise.is_compared.copy(), list(noise.lines)
    for leaking_line in noise_near_band_end.lines:
        # A line leaks as peak / (pi distance in bins).
        line_peak = leaking_line.amplitude_nm * samples / 2
        harmless_leakage = math.sqrt(_MAX_HARMLESS_LEAKAGE_RATIO * float(noise.power[-1]))
        leakage_reach_hz = line_peak / (math.pi * harmless_leakage) * rate_hz / samples
        used_bins &= np.abs(comparison.frequency_hz - leaking_line.frequency_hz) > leakage_reach_hz
        other_lines = [
            k
            for k in noise_lines
            if abs(leaking_line.frequency_hz - k.frequency_hz) > _SAME_LINE_DISTANCE_HZ
        ]
        noise_lines = [*other_lines, leaking_line]
    if not noise_near_band_end.lines:
        return noise
    # The leakage has raised the estimated noise of whole blocks of bins: estimate it again.
    leakage_free_residual = (fit.residual * np.sqrt(noise.power / 2))[used_bins]
    bin_indices = np.arange(used_bins.size)
    noise_power = np.exp(
        np.interp(
            bin_indices,
            bin_indices[used_bins],
            np.log(smooth_power(leakage_free_residual) / known_torque_fraction),
        )
    )
    return NoiseSpectrum(noise_power, used_bins, tuple(noise_lines))


def repetition_period_s(comparison: Comparison) -> float:
    """Return the period in seconds of the motion of the motor; 0 if the motion does not repeat."""
    motor_angle_rad = comparison.angle_rad[comparison.retained_samples]
    motor_angle_rad = motor_angle_rad - motor_angle_rad.mean()
    sample_count = motor_angle_rad.size
    spectrum = np.fft.rfft(motor_angle_rad, 2 * sample_count)
    autocorrelation = np.fft.irfft(np.abs(spectrum) ** 2)[: sample_count // 2 + 1]
    # Norm of the two overlapping parts of the angle at each lag.
    cumulative_energy = np.concatenate([[0.0], np.cumsum(motor_angle_rad**2)])
    lag_samples = np.arange(autocorrelation.size)
    overlap_norm = np.sqrt(
        cumulative_energy[sample_count - lag_samples]
        * (cumulative_energy[sample_count] - cumulative_energy[lag_samples])
    )
    correlation = autocorrelation / np.maximum(overlap_norm, np.finfo(float).tiny)
    different_motion_lags = np.flatnonzero(correlation < _MAX_DIFFERENT_MOTION_CORRELATION)
    if different_motion_lags.size == 0:
        return 0.0
    repeated_motion_lags = np.flatnonzero(
        (correlation > _MIN_REPEATED_MOTION_CORRELATION) & (lag_samples > different_motion_lags[0])
    )
    if repeated_motion_lags.size == 0:
        return 0.0
    period_samples = int(repeated_motion_lags[0])
    while (
        period_samples + 1 < autocorrelation.size
        and correlation[period_samples + 1] > correlation[period_samples]
    ):
        period_samples += 1
    return period_samples / comparison.decimation.rate_hz
