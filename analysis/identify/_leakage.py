"""Leakage of a narrow-band disturbance (hum) next to the band: the mains are at 50 Hz, its end.

Within the band the estimator finds lines itself (`RecordAnalysis.lines`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.noise import NoiseSpectrum, noise_of, smooth_power

if TYPE_CHECKING:
    from analysis.identify._comparison import Comparison
    from analysis.identify._result import RecordFit

_NEAR_HZ: Final = 5.0
_SAME_HZ: Final = 0.1
_APART: Final = 0.5
_ALIKE: Final = 0.9
"""Correlation of the angle with itself a period later, and below which it is another motion."""

_LEAKS: Final = 0.3
"""Leaked power over that of the noise that does no harm."""


def without_leakage(noise: NoiseSpectrum, comparison: Comparison, fit: RecordFit) -> NoiseSpectrum:
    """Exclude the bins into which a line beyond the band leaks, and return the line.

    Parameters
    ----------
    noise : Noise
        Estimated noise.
    comparison : Comparison
    fit : RecordFit
        Best fit under that noise: its torque is subtracted.
    """
    rate_hz, samples = comparison.decimation.rate_hz, comparison.samples
    end_hz = float(comparison.frequency_hz[-1])
    torque, _ = comparison.prediction.torque(fit.plant)
    residual = np.fft.rfft(comparison.torque_nm[comparison.retained] - torque)
    all_hz = np.fft.rfftfreq(samples, 1 / rate_hz).astype(np.float64)
    near = np.abs(all_hz - end_hz) < min(_NEAR_HZ, rate_hz / 2 - end_hz)
    known_fraction = comparison.measurement.known_torque_fraction
    anywhere = np.zeros(np.count_nonzero(near), dtype=bool)
    found = noise_of(residual[near], all_hz[near], samples, known_fraction, near_mode=anywhere)
    counts, lines = noise.counts.copy(), list(noise.lines)
    for line in found.lines:
        # A line leaks as peak / (pi distance in bins).
        peak = line.amplitude_nm * samples / 2
        harmless = math.sqrt(_LEAKS * float(noise.power[-1]))
        reach_hz = peak / (math.pi * harmless) * rate_hz / samples
        counts &= np.abs(comparison.frequency_hz - line.frequency_hz) > reach_hz
        others = [k for k in lines if abs(line.frequency_hz - k.frequency_hz) > _SAME_HZ]
        lines = [*others, line]
    if not found.lines:
        return noise
    # What leaked has raised the estimated noise of whole blocks of bins.
    clean = (fit.residual * np.sqrt(noise.power / 2))[counts]
    bins = np.arange(counts.size)
    power = np.exp(np.interp(bins, bins[counts], np.log(smooth_power(clean) / known_fraction)))
    return NoiseSpectrum(power, counts, tuple(lines))


def repeats_after_s(comparison: Comparison) -> float:
    """Return the period of the angle in s, 0 if it does not repeat at least once as a whole."""
    angle = comparison.angle_rad[comparison.retained]
    angle = angle - angle.mean()
    count = angle.size
    spectrum = np.fft.rfft(angle, 2 * count)
    own = np.fft.irfft(np.abs(spectrum) ** 2)[: count // 2 + 1]
    # Energy of what overlaps at a lag, of either part.
    squares = np.concatenate([[0.0], np.cumsum(angle**2)])
    lags = np.arange(own.size)
    both = np.sqrt(squares[count - lags] * (squares[count] - squares[lags]))
    alike = own / np.maximum(both, np.finfo(float).tiny)
    apart = np.flatnonzero(alike < _APART)
    if apart.size == 0:
        return 0.0
    again = np.flatnonzero((alike > _ALIKE) & (lags > apart[0]))
    if again.size == 0:
        return 0.0
    end = int(again[0])
    while end + 1 < own.size and alike[end + 1] > alike[end]:
        end += 1
    return end / comparison.decimation.rate_hz
