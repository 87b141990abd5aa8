"""Instrument: the part of the motor's angle that is coherent with the reference.

The controller feeds the measured torque forward and the measured angle back, so the motor moves
with the noise of the sensor. A fit of the torque to all of the angle takes part of that noise for
response: in a closed loop noise and input are correlated, and a fit that leaves out all beyond its
band is biased by it [1]_: a chirp's tool inertia by 1.4 and its stiffness by 0.24 standard
deviations at 1e-2 N·m. The reference was known beforehand and does not depend on the noise, so the
part of the angle that is coherent with the reference is used as input (`following`). The torque by
the remaining angle is computed with the current estimate of the beam, and removed. Fitting what
remains is the instrumental-variable estimate with the reference as instrument. Where the remaining
angle is noise it is unbiased for any beam. But a beam that rings for long moves the motor in bands
narrower than the smoothing of the response, and then the remaining angle is not noise: in a record
of narrow sweeps with 0.2 g at the tip the first beam would bias the result by up to 45 standard
deviations. So if a better beam predicts another torque, the part of the angle that follows the
reference is re-estimated, with the torque on the motor as a second input (`Comparison.renewed`).

References
----------
.. [1] U. Forssell and L. Ljung, Closed-loop identification revisited, Automatica 35 (1999)
   1215-1241.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import fast_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MEMORY_S: Final = 0.4
"""Standard deviation of the window over the lags of the correlations, that is how long the loop may
remember its reference: 0.4 Hz in frequency. A longer one lets noise pass for response. A shorter
one misses sharp features of the loop, and those of a beam that rings for long; its torque, given as
a second input, provides the latter."""

_RETURN_S: Final = 4.0
"""For which both are taken to return to 0 after the record. A reference that ended elsewhere and
fell to 0 at once would do so without the lag of the loop."""

_FLOOR: Final = 1e-12
"""Least power of the reference at a frequency, relative to its largest."""


def following(
    angle_rad: NDArray[np.float64],
    reference_rad: NDArray[np.float64],
    rate_hz: float,
    torque_nm: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return the part of the angle that is coherent with the reference, shape (n,).

    The response is estimated by windowed correlations (R. B. Blackman and J. W. Tukey, Bell System
    Technical Journal 37 (1958) 185-282): at each frequency by least squares over its neighbours.

    Parameters
    ----------
    angle_rad, reference_rad : ndarray, shape (n,)
        Both taken as 0 before.
    rate_hz : float
    torque_nm : ndarray, shape (n,), optional
        Torque on the motor without noise: it may ring in bands narrower than the smoothing of the
        response.
    """
    way_back = 0.5 * (1 + np.cos(np.linspace(0, np.pi, round(_RETURN_S * rate_hz) + 1)[1:]))
    length = fast_length(2 * (angle_rad.size + way_back.size))

    def transformed(values: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.fft.rfft(np.concatenate([values, values[-1] * way_back]), length)

    lag_s = np.fft.fftfreq(length) * (length / rate_hz)
    window = np.exp(-0.5 * (lag_s / _MEMORY_S) ** 2)

    def smoothed(power: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return np.fft.rfft(window * np.fft.irfft(power, length))

    angle, reference = transformed(angle_rad), transformed(reference_rad)
    across, own = smoothed(angle * reference.conj()), smoothed(np.abs(reference) ** 2).real
    if not own.max() > 0:
        return np.zeros(angle_rad.size)
    own = np.maximum(own, _FLOOR * own.max())
    spectrum = across / own * reference
    if torque_nm is not None:
        # What of the torque is no smooth response to the reference itself.
        torque = transformed(torque_nm)
        shared = smoothed(torque * reference.conj()) / own
        apart = smoothed(np.abs(torque) ** 2).real - np.abs(shared) ** 2 * own
        apart = np.maximum(apart, _FLOOR * apart.max())
        felt = (smoothed(angle * torque.conj()) - across * shared.conj()) / apart
        spectrum += felt * (torque - shared * reference)
    followed: NDArray[np.float64] = np.fft.irfft(spectrum, length)[: angle_rad.size]
    return followed
