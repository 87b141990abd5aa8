"""Modes that a record shows, and test of whether a mode was excited."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._result import RecordFit
    from analysis.identify.noise import NoiseSpectrum

_MIN_RESONANCE_DEVIANCE: Final = 400.0
"""Deviance by which a response with a resonance must be better than a smooth one. The resonance is
then known to a twentieth of its height, and its damping to about a tenth."""

_MIN_RESIDUAL_TO_NOISE_RATIO: Final = 1.4
"""Chi-square of a smooth response, relative to that of noise, from which a mode is visible. The
noise is known to 10-20 % only."""

_MIN_RELATIVE_WINDOW_HALF_WIDTH: Final = 0.05
"""Smallest half width of the window around a mode, relative to its frequency."""

_WINDOW_TO_RESONANCE_HALF_WIDTH: Final = 4.0
"""Half width of the window, in half widths of the resonance."""

_MAX_RELATIVE_WINDOW_HALF_WIDTH: Final = 0.4
"""Largest half width of the window, relative to the frequency of the mode."""

_MIN_WINDOW_BINS_PER_SIDE: Final = 8
"""Smallest number of bins to either side of a mode."""

_SMOOTH_RESPONSE_DEGREE: Final = 2
"""Degree in frequency of the polynomial for a response without a resonance near the mode."""

_MIN_EXCITATION_RATIO: Final = 0.2
"""Amplitude of the reference, relative to that near the other mode, from which a mode counts as
excited. A sweep has 1 at all modes that it passes, a step 1/6 at mode 2 relative to mode 1."""


def visible_modes(comparison: Comparison, noise: NoiseSpectrum, fit: RecordFit) -> tuple[int, ...]:
    """Return the numbers of the modes whose resonance is needed to explain the record.

    Near each mode of `fit` the best smooth response to the angle is fitted to the torque. If there
    is no resonance, the residual is noise, whose chi-square has a known mean and scatter. A larger
    chi-square is evidence of a resonance. Its position in the window does not matter, so the modes
    of a beam that is not uniform are found as well. In a long record, weaker resonances are also
    found if `fit` has a much lower chi-square than the smooth response.
    """
    torque_spectrum = comparison.spectrum(comparison.torque_nm[comparison.retained_samples])
    angle_spectrum = comparison.spectrum(comparison.angle_rad[comparison.retained_samples])
    visible_numbers = []
    for mode_estimate in fit.modes:
        offset_hz = comparison.frequency_hz - mode_estimate.frequency_hz
        window_half_width_hz = _window_half_width_hz(
            comparison, mode_estimate.frequency_hz, mode_estimate.damping_ratio
        )
        is_in_window = (np.abs(offset_hz) < window_half_width_hz) & noise.is_compared
        degrees_of_freedom = 2 * (int(np.count_nonzero(is_in_window)) - _SMOOTH_RESPONSE_DEGREE - 1)
        if degrees_of_freedom < _MIN_WINDOW_BINS_PER_SIDE:
            continue
        noise_weight = noise.weight[is_in_window]
        smooth_chi_square = _smooth_response_chi_square(
            torque_spectrum[is_in_window] * noise_weight,
            angle_spectrum[is_in_window] * noise_weight,
            offset_hz[is_in_window] / window_half_width_hz,
        )
        # Chance does neither: together they are nearly eight standard deviations, or more.
        has_evidence = (
            smooth_chi_square - degrees_of_freedom > _MIN_RESONANCE_DEVIANCE
            and smooth_chi_square > _MIN_RESIDUAL_TO_NOISE_RATIO * degrees_of_freedom
        )
        # With many bins a resonance may be below the noise of each and still be significant.
        fit_chi_square = float(np.vdot(fit.residual[is_in_window], fit.residual[is_in_window]).real)
        if has_evidence or smooth_chi_square - fit_chi_square > _MIN_RESONANCE_DEVIANCE:
            visible_numbers.append(mode_estimate.number)
    return tuple(visible_numbers)


def is_excited(comparison: Comparison, frequency_hz: float, compared_hz: float) -> bool:
    """Return whether the excitation near a frequency is at least 0.2 of that near another one."""
    measurement = comparison.measurement
    reference_rad = measurement.reference_rad
    excitation_rad = (
        measurement.angle_from_rest_rad(1.0)
        if reference_rad is None
        else reference_rad - reference_rad[0]
    )
    excitation_power = np.abs(np.fft.rfft(excitation_rad)) ** 2
    frequencies_hz = np.fft.rfftfreq(excitation_rad.size, 1 / measurement.rate_hz)

    def mean_power_near(centre_hz: float) -> float:
        """Return the root-mean-square amplitude of the excitation near a frequency."""
        is_in_window = np.abs(frequencies_hz - centre_hz) <= max(
            _MIN_RELATIVE_WINDOW_HALF_WIDTH * centre_hz,
            _MIN_WINDOW_BINS_PER_SIDE * frequencies_hz[1],
        )
        return (
            math.sqrt(float(np.mean(excitation_power[is_in_window]))) if is_in_window.any() else 0.0
        )

    return mean_power_near(frequency_hz) > _MIN_EXCITATION_RATIO * mean_power_near(compared_hz) > 0


def _window_half_width_hz(
    comparison: Comparison, frequency_hz: float, damping_ratio: float
) -> float:
    """Return the half width in hertz of the frequency window in which a mode is tested."""
    spacing_hz = float(comparison.frequency_hz[1] - comparison.frequency_hz[0])
    relative_half_width = min(
        max(_MIN_RELATIVE_WINDOW_HALF_WIDTH, _WINDOW_TO_RESONANCE_HALF_WIDTH * damping_ratio),
        _MAX_RELATIVE_WINDOW_HALF_WIDTH,
    )
    return max(relative_half_width * frequency_hz, (_MIN_WINDOW_BINS_PER_SIDE + 0.5) * spacing_hz)


def _smooth_response_chi_square(
    whitened_torque: NDArray[np.complex128],
    whitened_angle: NDArray[np.complex128],
    window_position: NDArray[np.float64],
) -> float:
    """Return the sum of squares that remains of the torque after the best fit of a smooth response.

    Torque and angle are whitened spectra, shape (K,). `window_position` is the position of each bin
    within the window, -1 to 1.
    """
    orthonormal_spectra, _ = np.linalg.qr(
        np.array(
            [window_position**k * whitened_angle for k in range(_SMOOTH_RESPONSE_DEGREE + 1)]
        ).T
    )
    unexplained_torque = whitened_torque - orthonormal_spectra @ (
        orthonormal_spectra.conj().T @ whitened_torque
    )
    return float(np.vdot(unexplained_torque, unexplained_torque).real)
