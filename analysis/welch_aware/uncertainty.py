"""How far the noise of the torque moves a Welch-aware fit.

The estimate is to first order a linear function of the torque: Gauss-Newton's step is linear in the
deviations, and these in every sample. So each estimate has a sensitivity to each sample (b below),
and for noise of power spectral density S its variance is the sum of ``S |B|²`` over the record's
frequencies, B being the transform of b. That counts exactly what Welch's estimate blurs: neighbours
that are alike, segments that overlap, frequencies with hardly any input. S is taken from the
deviations that remain.

It holds where the structure is right, the start was at rest, and the noise is the torque's alone
and does not follow the angle. It does not see a bias.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.welch_aware.comparison import Comparison

_SMOOTHED_HZ: Final = 5.0
_WORST_CONDITION: Final = 1e13


def noise_power(
    comparison: Comparison, deviation: NDArray[np.complex128], unknowns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spectrum of the torque's noise, as the variance of white noise that is as strong there.

    A deviation of the estimate is the noise's spectrum over the input's, so it is the better known
    the more input there is: deviations are averaged with the input's power, over 5 Hz.

    Parameters
    ----------
    deviation : ndarray of complex, shape (K,)
    unknowns : int
        How many were fitted: so much of the noise they took with them.

    Returns
    -------
    frequency_hz, variance_nm2 : ndarray, shape (K,)
    """
    estimator, rate_hz = comparison.estimator, comparison.rate_hz
    frequency_hz = comparison.frequency_hz
    power = (deviation.real**2 + deviation.imag**2) * estimator.input_power
    power /= float(estimator.taper @ estimator.taper)
    reached = np.concatenate(([0.0], np.cumsum(power)))
    first = np.searchsorted(frequency_hz, frequency_hz - _SMOOTHED_HZ / 2)
    end = np.searchsorted(frequency_hz, frequency_hz + _SMOOTHED_HZ / 2, side="right")
    # Independent deviations lie a reciprocal segment's length apart, each with two parts.
    independent = 2 * (frequency_hz[-1] - frequency_hz[0]) * estimator.taper.size / rate_hz
    taken = 1 - min(unknowns / max(independent, 1.0), 0.5)
    return frequency_hz, (reached[end] - reached[first]) / (end - first) / taken


def covariance_of_unknowns(
    comparison: Comparison,
    deviation: NDArray[np.complex128],
    jacobian: NDArray[np.complex128],
    held: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Covariance of the unknowns that the data determine.

    Parameters
    ----------
    comparison : Comparison
    deviation : ndarray of complex, shape (K,)
        At the minimum.
    jacobian : ndarray of complex, shape (k, K)
    held : ndarray of bool, shape (k,)
        Unknowns at a bound.

    Returns
    -------
    covariance : ndarray, shape (k, k)
        Zero in rows and columns of the others.
    determined : ndarray of bool, shape (k,)
    """
    weighted = jacobian * comparison.weights
    hessian = (weighted.conj() @ jacobian.T).real
    scale = np.sqrt(np.diag(hessian))
    determined = ~held & (scale > 0) & np.isfinite(scale)
    covariance = np.zeros_like(hessian)
    if not determined.any():
        return covariance, determined
    unit = scale[determined]
    scaled = hessian[np.ix_(determined, determined)] / np.outer(unit, unit)
    if np.linalg.cond(scaled) > _WORST_CONDITION:
        return covariance, np.zeros_like(determined)
    sensitivity = comparison.estimator.transposed(weighted[determined] / unit[:, None])
    samples = sensitivity.shape[1]
    spectra = np.fft.rfft(sensitivity)
    hz = np.fft.rfftfreq(samples, 1 / comparison.rate_hz)
    variance = np.interp(hz, *noise_power(comparison, deviation, int(np.count_nonzero(determined))))
    # One-sided: every frequency but the first counts twice.
    shares = variance * np.where(hz > 0, 2.0, 1.0) / samples
    scatter = ((spectra * shares) @ spectra.conj().T).real
    inverse = np.linalg.inv(scaled)
    covariance[np.ix_(determined, determined)] = (inverse @ scatter @ inverse) / np.outer(
        unit, unit
    )
    return covariance, determined
