"""Torque predicted from the measured angle: exact causal convolution with the beam of Eq. 25."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.decimation import fast_length
from analysis.whole_record.response import ResponseGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.whole_record.plant import Plant

_PADDED: Final = 1.1
_DECAY: Final = 6.6
"""sigma times the padded duration. What wraps round shrinks by exp(-6.6), to 1e-3 of what a beam
still does after a whole record, and is a free decay, of which no fit takes notice; rounding and
what the decimation left beyond the band grow by exp(6.6 / 1.1) = 400."""


CLOCK: Final = "clock_rate_difference"


class Prediction:
    """Response of the exact model to one angle, and its derivatives.

    A finite convolution by discrete transforms wraps round, and a lightly damped beam rings longer
    than any padding. So the angle is multiplied with exp(-sigma t) before it is transformed, which
    is its Laplace transform on s = sigma + j omega; there it is multiplied with the response, and
    after the way back the exponential is undone: what wrapped round has decayed.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        From rest, band-limited: nothing left at half the rate.
    rate_hz : float
    kept : slice
        Samples of which the prediction is wanted.
    """

    __slots__ = (
        "_decay",
        "_growth",
        "_kept",
        "_length",
        "_response",
        "_sigma",
        "_spectrum",
        "rate_hz",
    )

    def __init__(self, angle_rad: NDArray[np.float64], rate_hz: float, kept: slice) -> None:
        self.rate_hz = rate_hz
        self._kept = kept
        self._length = fast_length(int(np.ceil(_PADDED * angle_rad.size)))
        self._sigma = sigma = _DECAY * rate_hz / self._length
        time_s = np.arange(angle_rad.size) / rate_hz
        bins = np.arange(self._length // 2 + 1)
        self._response = ResponseGrid(sigma + 2j * np.pi * rate_hz / self._length * bins)
        self._decay = np.exp(-sigma * time_s)
        self._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        self._growth = np.exp(sigma * time_s[kept])

    def of_other(self, angle_rad: NDArray[np.float64]) -> Prediction:
        """Predict from another angle of the same length, shape (n,)."""
        other = copy(self)
        other._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        return other

    def torque(
        self, plant: Plant, wrt: Sequence[str] = ()
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Torque in N·m at the samples kept, and its derivatives.

        Parameters
        ----------
        plant : Plant
            Where to evaluate.
        wrt : sequence of str
            As `ResponseGrid.evaluate` takes them.

        Returns
        -------
        torque : ndarray, shape (m,)
        gradient : ndarray, shape (k, m)
        """
        if plant.clock_rate_difference or CLOCK in wrt:
            places = np.arange(self._kept.start, self._kept.stop)
            return self._by_other_clock(plant, wrt, places / self.rate_hz)
        spectra = self._response.evaluate(plant, wrt, self._spectrum)
        in_time = np.fft.irfft(spectra, self._length)[:, self._kept] * self._growth
        return in_time[0], in_time[1:]

    def _by_other_clock(
        self, plant: Plant, wrt: Sequence[str], time_s: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict where a clock of another rate than the angle's takes its samples.

        Parameters
        ----------
        time_s : ndarray, shape (m,)
            Equally spaced, by the angle's clock.
        """
        of_beam = tuple(name for name in wrt if name != CLOCK)
        spectra = self._response.evaluate(plant, of_beam, self._spectrum)
        if CLOCK in wrt:
            faster = self._response.s * spectra[0]
            spectra = np.insert(spectra, 1 + wrt.index(CLOCK), faster, axis=0)
        rate = 1 + plant.clock_rate_difference
        weights = np.full(spectra.shape[1], 2.0)  # a bin and its mirror image
        weights[0] = 1.0
        weights[self._length // 2 :] = 2.0 - (self._length % 2 == 0)
        step_s = float(time_s[1] - time_s[0]) if time_s.size > 1 else 0.0
        turn = 2 * np.pi * self.rate_hz / self._length * rate
        at = _fourier_sums(spectra * weights, turn * float(time_s[0]), turn * step_s, time_s.size)
        at *= np.exp(self._sigma * rate * time_s) / self._length
        if CLOCK in wrt:
            at[1 + wrt.index(CLOCK)] *= time_s
        return at[0], at[1:]

    def torque_between(
        self, plant: Plant, factor: int, places: NDArray[np.intp], wrt: Sequence[str] = ()
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict the same at a multiple of the rate, at some places only.

        Parameters
        ----------
        factor : int
            Rate, in multiples of `rate_hz`.
        places : ndarray of int, shape (p,)
            In samples of that rate from the angle's first sample on.

        Returns
        -------
        torque : ndarray, shape (p,)
        gradient : ndarray, shape (k, p)
        """
        if plant.clock_rate_difference or CLOCK in wrt:
            every = np.arange(factor * self._length) / (factor * self.rate_hz)
            torque, gradient = self._by_other_clock(plant, wrt, every)
            return torque[places], gradient[:, places]
        growth = np.exp(self._sigma * places / (factor * self.rate_hz))
        spectra = self._response.evaluate(plant, wrt, self._spectrum)
        # As many short transforms, each of them shifted by a tick, as the factor says: they stay
        # in the cache, and take less than half the time of a long one.
        shifts = np.ones((factor, spectra.shape[1]), dtype=np.complex128)
        shifts[1:] = np.exp(2j * np.pi / (factor * self._length) * np.arange(spectra.shape[1]))
        np.cumprod(shifts, axis=0, out=shifts)
        if self._length % 2 == 0:
            shifts[:, -1] *= 2  # at the longer length this bin and its mirror image are two
        at = np.empty((len(spectra), places.size))
        for row, spectrum in zip(at, spectra, strict=True):
            row[:] = np.fft.irfft(shifts * spectrum, self._length).T.ravel()[places]
        at *= growth
        return at[0], at[1:]


def _fourier_sums(
    spectra: NDArray[np.complex128], first: float, step: float, count: int
) -> NDArray[np.float64]:
    """Real parts of ``sum_k S_k exp(j k (first + step n))``, shape (r, count).

    At any spacing: kn is written as ``(k² + n² - (n - k)²) / 2``, which leaves a convolution
    (L. I. Bluestein, IEEE Trans. Audio and Electroacoustics 18 (1970) 451-455).

    Parameters
    ----------
    spectra : ndarray of complex, shape (r, K)
    first, step : float
        In rad.
    count : int
    """
    bins, places = np.arange(spectra.shape[1]), np.arange(count)
    length = fast_length(bins.size + count)
    lags = np.concatenate([places, np.zeros(length - count - bins.size + 1), bins[:0:-1]])
    chirp = np.fft.fft(np.exp(-0.5j * step * lags**2))
    turned = spectra * np.exp(1j * (first * bins + 0.5 * step * bins**2))
    sums = np.fft.ifft(np.fft.fft(turned, length) * chirp)[:, :count]
    return np.ascontiguousarray((sums * np.exp(0.5j * step * places**2)).real)
