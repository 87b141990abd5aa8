"""Instrumental variable: the part of the motor's angle that is coherent with the reference.

The controller uses the measured torque as feedforward and the measured angle as feedback, so the
motor moves with the noise of the sensor. A fit of the torque to the whole angle takes part of that
noise for response: in a closed loop noise and input are correlated, and a fit that omits everything
beyond its band is biased by the noise [1]_: a chirp's tool inertia by 1.4 and its stiffness by 0.24
standard deviations at 1e-2 N·m. The reference was known beforehand and does not depend on the
noise, so the part of the angle that is coherent with the reference is used as input
(`reference_coherent_angle`). The torque caused by the remaining angle is computed with the current
estimate of the beam, and removed. The fit to the remaining torque is the instrumental-variable
estimate with the reference as instrument. Where the remaining angle is noise, the estimate is
unbiased for any beam. But a beam that rings for long moves the motor in bands narrower than the
smoothing of the response, and then the remaining angle is not noise: in a record of narrow sweeps
with 0.2 g at the tip the first beam would bias the result by up to 45 standard deviations. So if a
better beam predicts another torque, the part of the angle that follows the reference is
re-estimated, with the torque on the motor as a second input (`Comparison.with_reestimated_angle`).

References
----------
.. [1] U. Forssell and L. Ljung, Closed-loop identification revisited, Automatica 35 (1999)
   1215-1241.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.decimation import fast_fft_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CORRELATION_LAG_WINDOW_S: Final = 0.4
"""Standard deviation in seconds of the window over the lags of the correlations: the time for which
the loop may depend on its past reference (0.4 Hz in frequency).

A longer window takes noise for response. A shorter window misses sharp features of the loop, and
those of a beam that rings for long. The torque, given as a second input, provides the features of
the beam."""

_RETURN_TO_ZERO_S: Final = 4.0
"""Duration in seconds after the record in which angle and reference are assumed to return to 0. If
both fell to 0 at once, the angle would not lag the reference, as it does in the loop."""

_RELATIVE_POWER_FLOOR: Final = 1e-12
"""Minimum assumed power of the reference at a frequency, relative to its largest power."""

_MIN_POWER_RATIO: Final = 10.0
"""Power of the angle that the reference explains, relative to the power that it would explain by
chance, below which the angle does not follow the reference. Between the bands of narrow sweeps the
reference has hardly any power, and noise of the angle would be taken for a response to it."""


def reference_coherent_angle(
    angle_rad: NDArray[np.float64],
    reference_rad: NDArray[np.float64],
    rate_hz: float,
    torque_nm: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return the part of the motor angle in rad that is coherent with the reference, shape (n,).

    The response is estimated by windowed correlations (R. B. Blackman and J. W. Tukey, Bell System
    Technical Journal 37 (1958) 185-282): at each frequency by least squares over its neighbours.

    Angle and reference are assumed to be 0 before the record. The torque on the motor without noise
    is a second input, since it may ring in bands narrower than the smoothing of the response.
    """
    return_to_zero_weights = 0.5 * (
        1 + np.cos(np.linspace(0, np.pi, round(_RETURN_TO_ZERO_S * rate_hz) + 1)[1:])
    )
    padded_length = fast_fft_length(2 * (angle_rad.size + return_to_zero_weights.size))

    def padded_spectrum(samples: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.fft.rfft(
            np.concatenate([samples, samples[-1] * return_to_zero_weights]), padded_length
        )

    lag_s = np.fft.fftfreq(padded_length) * (padded_length / rate_hz)
    lag_window = np.exp(-0.5 * (lag_s / _CORRELATION_LAG_WINDOW_S) ** 2)
    # Number of independent frequencies whose powers are averaged.
    independent_estimates = angle_rad.size / np.sum(lag_window**2)

    def smooth_over_frequency(power_spectrum: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return np.fft.rfft(lag_window * np.fft.irfft(power_spectrum, padded_length))

    angle_spectrum, reference_spectrum = padded_spectrum(angle_rad), padded_spectrum(reference_rad)

    def significant_response(
        cross_spectrum: NDArray[np.complex128],
        input_power: NDArray[np.float64],
        output_power: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Return the response from an input to an output; 0 where it is not significant."""
        response = cross_spectrum / input_power
        explained_power = np.abs(response) ** 2 * input_power
        # A response that is noise explains this power of the output on average.
        power_by_chance = np.maximum(output_power - explained_power, 0.0) / independent_estimates
        return np.where(explained_power > _MIN_POWER_RATIO * power_by_chance, response, 0.0)

    angle_power = smooth_over_frequency(np.abs(angle_spectrum) ** 2).real
    cross_spectrum, reference_power = (
        smooth_over_frequency(angle_spectrum * reference_spectrum.conj()),
        smooth_over_frequency(np.abs(reference_spectrum) ** 2).real,
    )
    if not reference_power.max() > 0:
        return np.zeros(angle_rad.size)
    reference_power = np.maximum(reference_power, _RELATIVE_POWER_FLOOR * reference_power.max())
    coherent_spectrum = (
        significant_response(cross_spectrum, reference_power, angle_power) * reference_spectrum
    )
    if torque_nm is not None:
        # Use the part of the torque that is no smooth response to the reference.
        torque_spectrum = padded_spectrum(torque_nm)
        torque_per_reference = (
            smooth_over_frequency(torque_spectrum * reference_spectrum.conj()) / reference_power
        )
        reference_free_torque_power = (
            smooth_over_frequency(np.abs(torque_spectrum) ** 2).real
            - np.abs(torque_per_reference) ** 2 * reference_power
        )
        reference_free_torque_power = np.maximum(
            reference_free_torque_power, _RELATIVE_POWER_FLOOR * reference_free_torque_power.max()
        )
        angle_per_torque = significant_response(
            smooth_over_frequency(angle_spectrum * torque_spectrum.conj())
            - cross_spectrum * torque_per_reference.conj(),
            reference_free_torque_power,
            angle_power - np.abs(cross_spectrum) ** 2 / reference_power,
        )
        coherent_spectrum += angle_per_torque * (
            torque_spectrum - torque_per_reference * reference_spectrum
        )
    coherent_angle_rad: NDArray[np.float64] = np.fft.irfft(coherent_spectrum, padded_length)[
        : angle_rad.size
    ]
    return coherent_angle_rad
