"""What of the motor's angle follows its reference, and what the rig's controller made of noise.

The controller feeds the measured torque forward and the measured angle back, so the motor moves
with the noise of the sensor. A fit of the torque to all of the angle takes part of that noise for
response: in a closed loop noise and input are correlated, and a fit that leaves out all beyond its
band is biased by it (U. Forssell and L. Ljung, Automatica 35 (1999) 1215-1241): a chirp's tool
inertia by 1.4 and its stiffness by 0.24 standard deviations at 1e-2 N·m. The reference was known
beforehand and owes nothing to the noise, so only what follows it is taken for input. The torque
that the rest makes is computed with the beam found so far, and taken out. Fitting what remains is
the instrumental-variable estimate with the reference as instrument, which is unbiased whatever that
beam was.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.decimation import fast_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MEMORY_S: Final = 0.4
"""Standard deviation of the window over the lags of the correlations, that is how long the loop may
remember its reference: 0.4 Hz in frequency. A longer one lets noise pass for response; what a
shorter one misses of a sharp feature of the loop costs a little precision and nothing else."""

_RETURN_S: Final = 4.0
"""For which both are taken to return to 0 after the record. A reference that ended elsewhere and
fell to 0 at once would do so without the lag of the loop."""

_FLOOR: Final = 1e-12
"""Of the reference's largest power: with less there is none at a frequency."""


def following(
    angle_rad: NDArray[np.float64], reference_rad: NDArray[np.float64], rate_hz: float
) -> NDArray[np.float64]:
    """Part of the angle that follows the reference, shape (n,).

    By the response that windowed correlations give (R. B. Blackman and J. W. Tukey, Bell System
    Technical Journal 37 (1958) 185-282): at each frequency the least squares over its neighbours.

    Parameters
    ----------
    angle_rad, reference_rad : ndarray, shape (n,)
        Both taken as 0 before.
    rate_hz : float
    """
    way_back = 0.5 * (1 + np.cos(np.linspace(0, np.pi, round(_RETURN_S * rate_hz) + 1)[1:]))
    length = fast_length(2 * (angle_rad.size + way_back.size))
    angle, reference = (
        np.fft.rfft(np.concatenate([values, values[-1] * way_back]), length)
        for values in (angle_rad, reference_rad)
    )
    lag_s = np.fft.fftfreq(length) * (length / rate_hz)
    window = np.exp(-0.5 * (lag_s / _MEMORY_S) ** 2)
    across, own = (
        np.fft.rfft(window * np.fft.irfft(power, length))
        for power in (angle * reference.conj(), np.abs(reference) ** 2)
    )
    if not own.real.max() > 0:
        return np.zeros(angle_rad.size)
    response = across / np.maximum(own.real, _FLOOR * own.real.max())
    followed: NDArray[np.float64] = np.fft.irfft(response * reference, length)[: angle_rad.size]
    return followed
