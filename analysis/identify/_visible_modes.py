"""Visible modes of a record, and excitation near the other modes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._result import RecordFit
    from analysis.identify.noise import NoiseSpectrum

_EVIDENCE: Final = 400.0
"""Deviance by which a response with a resonance must be better than a smooth one: the resonance is
then known to a twentieth of its height, and its damping to about a tenth."""

_OVER_NOISE: Final = 1.4
"""Least residual of a smooth response over the noise, which is known to 10-20 % only."""

_NEAR: Final = 0.05
_HALF_WIDTHS: Final = 4.0
_FARTHEST: Final = 0.4
"""Window to either side of a mode, relative to its frequency: at least, in half-widths of the
resonance, and at most."""

_FEWEST_BINS: Final = 8
"""To either side."""

_DEGREE: Final = 2
"""Degree in frequency of the polynomial for a response without a resonance near the mode."""

_DRIVEN: Final = 0.2
"""Amplitude of the reference, relative to that at mode 1, from which a mode counts as driven: a
sweep has 1 there at all modes it passes, a step 1/6 at mode 2."""


def visible_modes(comparison: Comparison, noise: NoiseSpectrum, fit: RecordFit) -> tuple[int, ...]:
    """Return the modes whose resonance is needed to explain the record.

    Near each mode the torque is compared with the best smooth response to the angle. Without a
    resonance the residual is noise, with chi-square of known mean and scatter; the energy of a
    resonance against the noise is the evidence. The position of the resonance in the window does
    not matter, so the modes of a beam that is not uniform are found as well. A fit that is better
    than the smooth response is evidence as well, for weaker resonances in a long record. `fit`
    provides the frequencies and widths of the modes.
    """
    torque = comparison.spectrum(comparison.torque_nm[comparison.retained])
    angle = comparison.spectrum(comparison.angle_rad[comparison.retained])
    found = []
    for mode in fit.modes:
        offset = comparison.frequency_hz - mode.frequency_hz
        reach_hz = _reach_hz(comparison, mode.frequency_hz, mode.damping_ratio)
        near = (np.abs(offset) < reach_hz) & noise.counts
        freedom = 2 * (int(np.count_nonzero(near)) - _DEGREE - 1)
        if freedom < _FEWEST_BINS:
            continue
        weight = noise.weight[near]
        left = _chi_square_of_smooth(
            torque[near] * weight, angle[near] * weight, offset[near] / reach_hz
        )
        # Chance does neither: together they are nearly eight standard deviations, or more.
        significant = left - freedom > _EVIDENCE and left > _OVER_NOISE * freedom
        # In many bins a resonance need not stand out of the noise, where the fit knows where it is.
        own = float(np.vdot(fit.residual[near], fit.residual[near]).real)
        if significant or left - own > _EVIDENCE:
            found.append(mode.number)
    return tuple(found)


def driven(comparison: Comparison, frequency_hz: float, relative_to_hz: float) -> bool:
    """Return whether the excitation near one frequency is almost as large as near another."""
    measurement = comparison.measurement
    reference = measurement.reference_rad
    moved_rad = measurement.angle_from_rest(1.0) if reference is None else reference - reference[0]
    power = np.abs(np.fft.rfft(moved_rad)) ** 2
    hz = np.fft.rfftfreq(moved_rad.size, 1 / measurement.rate_hz)

    def amplitude(at_hz: float) -> float:
        near = np.abs(hz - at_hz) <= max(_NEAR * at_hz, _FEWEST_BINS * hz[1])
        return math.sqrt(float(np.mean(power[near]))) if near.any() else 0.0

    return amplitude(frequency_hz) > _DRIVEN * amplitude(relative_to_hz) > 0


def _reach_hz(comparison: Comparison, frequency_hz: float, damping_ratio: float) -> float:
    """Return the half width of the window around a mode."""
    spacing_hz = float(comparison.frequency_hz[1] - comparison.frequency_hz[0])
    fraction = min(max(_NEAR, _HALF_WIDTHS * damping_ratio), _FARTHEST)
    return max(fraction * frequency_hz, (_FEWEST_BINS + 0.5) * spacing_hz)


def _chi_square_of_smooth(
    torque: NDArray[np.complex128], angle: NDArray[np.complex128], position: NDArray[np.float64]
) -> float:
    """Return the sum of squares of the best smooth response to whitened spectra of shape (K,).

    `position` is that within the window, -1 to 1.
    """
    columns, _ = np.linalg.qr(np.array([position**k * angle for k in range(_DEGREE + 1)]).T)
    left = torque - columns @ (columns.conj().T @ torque)
    return float(np.vdot(left, left).real)
