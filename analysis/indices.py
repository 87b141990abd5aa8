"""Indices of how well a model's frequency response fits the measured one, Eqs. (28) to (32)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.weights import weights


@dataclass(frozen=True, slots=True)
class Indices:
    """Distance between two frequency responses of a torque to an angle.

    Attributes
    ----------
    mse : float
        Mean square error, Eq. (28), in (N·m/rad)².
    wmse : float
        Mean square error weighted with 1/omega, Eq. (29), in (N·m/rad)².
    md : float
        Maximum deviation, Eq. (30), in N·m/rad.
    """

    mse: float
    wmse: float
    md: float


def fit_indices(
    omega_rad_s: NDArray[np.float64],
    measured: NDArray[np.complex128],
    model: NDArray[np.complex128],
) -> Indices:
    """Evaluate Eqs. (28) to (30) on complex deviations ``|G - Ĝ|``, all of shape (n,)."""
    deviation = np.abs(measured - model)
    square = deviation**2
    return Indices(
        mse=float(square.mean()),
        wmse=float(weights(omega_rad_s, "omega") @ square),
        md=float(deviation.max()),
    )


@dataclass(frozen=True, slots=True)
class Peak:
    """A resonant peak: the bin where the magnitude is largest, and the magnitude there."""

    frequency_hz: float
    magnitude_db: float


@dataclass(frozen=True, slots=True)
class PeakDeviation:
    """One session's term of Eqs. (31) and (32) for one mode."""

    frequency_rad_s: float
    magnitude_db: float


def resonant_peaks(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    mode_hz: NDArray[np.float64],
) -> tuple[Peak | None, ...]:
    """Resonant peaks on the bins, as the paper takes them (not interpolated).

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Positive, increasing.
    response : ndarray of complex, shape (n,)
    mode_hz : ndarray, shape (m,)
        Where the modes are expected, increasing: a peak is sought between the geometric means of
        neighbours, beyond the first and last as far again. The undamped frequencies will do.

    Returns
    -------
    tuple of Peak or None, length m
        None where no bin between those limits is a local maximum: the mode is damped away, or
        lies outside the band. In dB re 1 unit of the response.
    """
    magnitude = np.abs(response)
    ratio = np.sqrt(mode_hz[1:] / mode_hz[:-1])
    # A lone mode is sought within half an octave.
    first, last = (ratio[0], ratio[-1]) if ratio.size else (np.sqrt(2.0), np.sqrt(2.0))
    lower = mode_hz / np.concatenate(([first], ratio))
    upper = mode_hz * np.concatenate((ratio, [last]))
    inner = magnitude[1:-1]
    summits = 1 + np.flatnonzero((inner > magnitude[:-2]) & (inner >= magnitude[2:]))
    peaks: list[Peak | None] = []
    for low, high in zip(lower, upper, strict=True):
        candidates = summits[(frequency_hz[summits] >= low) & (frequency_hz[summits] <= high)]
        if candidates.size == 0:
            peaks.append(None)
            continue
        best = candidates[np.argmax(magnitude[candidates])]
        peaks.append(Peak(float(frequency_hz[best]), 20 * float(np.log10(magnitude[best]))))
    return tuple(peaks)


def peak_deviation(measured: Peak, model: Peak) -> PeakDeviation:
    """Deviations ``|omega_q - omega^_q|`` and ``||G| - |Ĝ||`` in dB, Eqs. (31) and (32).

    The paper averages them over sessions; this is the term of one.
    """
    return PeakDeviation(
        frequency_rad_s=2 * np.pi * abs(measured.frequency_hz - model.frequency_hz),
        magnitude_db=abs(measured.magnitude_db - model.magnitude_db),
    )
