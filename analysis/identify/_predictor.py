"""Torque predicted from the measured angle by the response of a plant (`ResponseGrid`).

The angle is convolved with the response causally, over the whole record, on
``s = sigma + j omega``: see `TorquePredictor`.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._data import fast_length
from analysis.identify._modal_model import ModalModel
from rigd.beam import (
    Plant,
    ResponseGrid,
    clamped_free_eigenvalues,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


@lru_cache(maxsize=16)
def eigenvalues(count: int) -> NDArray[np.float64]:
    """Return the first eigenvalues k L of a clamped-free beam, shape (count,).

    They are the roots of ``1 + cos z cosh z = 0``.

    The array is cached and read-only.
    """
    z = clamped_free_eigenvalues(count)
    z.flags.writeable = False
    return z


# Prediction

_PADDED_LENGTH_RATIO: Final = 1.1
"""Length of the padded Fourier transforms relative to the record."""

_WRAPPED_DECAY_EXPONENT: Final = 6.6
"""Product of the damping rate sigma and the padded duration.

The part that wraps around shrinks by exp(-6.6), to 1e-3 of the response of a beam after a whole
record. It has the form of a free decay, which no fit mistakes for the response. Rounding errors and
what the decimation left beyond the band grow by exp(6.6 / 1.1) = 400."""


class TorquePredictor:
    """Prediction of the torque from one motor angle, with derivatives by the plant's parameters.

    A finite convolution by discrete transforms wraps around, and a lightly damped beam rings longer
    than any padding. So the angle is multiplied with exp(-sigma t) before the transform, which
    gives its Laplace transform on s = sigma + j omega. There it is multiplied with the response,
    and after the inverse transform the exponential is removed: the part that wrapped around has
    decayed.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        Angle from rest, band-limited: it has no power at half the rate.
    rate_hz : float
        Sampling rate of the angle.
    retained : slice
        Samples at which the torque is returned.
    """

    __slots__ = (
        "_decay",
        "_growth",
        "_length",
        "_response",
        "_retained",
        "_sigma",
        "_spectrum",
        "rate_hz",
    )

    def __init__(self, angle_rad: NDArray[np.float64], rate_hz: float, retained: slice) -> None:
        self.rate_hz = rate_hz
        self._retained = retained
        self._length = fast_length(int(np.ceil(_PADDED_LENGTH_RATIO * angle_rad.size)))
        self._sigma = decay_rate_per_s = _WRAPPED_DECAY_EXPONENT * rate_hz / self._length
        time_s = np.arange(angle_rad.size) / rate_hz
        bin_indices = np.arange(self._length // 2 + 1)
        self._response = ResponseGrid(
            decay_rate_per_s + 2j * np.pi * rate_hz / self._length * bin_indices
        )
        self._decay = np.exp(-decay_rate_per_s * time_s)
        self._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        self._growth = np.exp(decay_rate_per_s * time_s[retained])

    def with_angle(self, angle_rad: NDArray[np.float64]) -> TorquePredictor:
        """Return the torque predictor for another motor angle of the same length, shape (n,)."""
        predictor = copy(self)
        predictor._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        return predictor

    @property
    def s(self) -> NDArray[np.complex128]:
        """Return the grid of the Laplace variable for responses, in rad/s."""
        return self._response.s

    def in_time(self, responses: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the torques in N·m that transfer functions predict from the angle, shape (..., m).

        Parameters
        ----------
        responses : ndarray of complex, shape (..., n)
            Transfer functions on the grid `s`.
        """
        torque_spectra = responses * self._spectrum
        torque_nm: NDArray[np.float64] = np.fft.irfft(torque_spectra, self._length)[
            ..., self._retained
        ]
        return torque_nm * self._growth

    def torque(
        self, plant: Plant | ModalModel, wrt: Sequence[str] = ()
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the predicted torque in N·m at the retained samples, and its derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Plant or model whose torque is computed.
        wrt : sequence of str
            Names of k parameters as for `ResponseGrid.evaluate`; none for a modal model.

        Returns
        -------
        torque : ndarray, shape (m,)
        gradient : ndarray, shape (k, m)
        """
        torque_spectra = self._torque_spectra(plant, wrt)
        torque_and_derivatives = (
            np.fft.irfft(torque_spectra, self._length)[:, self._retained] * self._growth
        )
        return torque_and_derivatives[0], torque_and_derivatives[1:]

    def _torque_spectra(
        self, plant: Plant | ModalModel, wrt: Sequence[str]
    ) -> NDArray[np.complex128]:
        """Return the transforms of the predicted torque and its k derivatives, shape (1 + k, n)."""
        if isinstance(plant, ModalModel):
            return (plant.response(self.s) * self._spectrum)[None]
        return self._response.evaluate(plant, wrt, self._spectrum)

    def torque_at_fine_samples(
        self,
        plant: Plant | ModalModel,
        rate_factor: int,
        fine_indices: NDArray[np.intp],
        wrt: Sequence[str] = (),
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the torque in N·m predicted at fine samples of a higher rate, and derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Plant or model whose torque is computed.
        rate_factor : int
            Higher rate, in multiples of `rate_hz`.
        fine_indices : ndarray of int, shape (p,)
            Samples at the higher rate, counted from the angle's first sample.
        wrt : sequence of str
            Names of the k parameters with respect to which the torque is differentiated.

        Returns
        -------
        torque : ndarray, shape (p,)
        gradient : ndarray, shape (k, p)
        """
        sample_growth = np.exp(self._sigma * fine_indices / (rate_factor * self.rate_hz))
        torque_spectra = self._torque_spectra(plant, wrt)
        # One short transform for each sample of the higher rate within a sample of the lower one:
        # they fit into the cache, and take less than half the time of one long transform.
        shift_factors = np.ones((rate_factor, torque_spectra.shape[1]), dtype=np.complex128)
        shift_factors[1:] = np.exp(
            2j * np.pi / (rate_factor * self._length) * np.arange(torque_spectra.shape[1])
        )
        np.cumprod(shift_factors, axis=0, out=shift_factors)
        if self._length % 2 == 0:
            # At the higher rate this bin and its mirror image are distinct.
            shift_factors[:, -1] *= 2
        torque_and_derivatives = np.empty((len(torque_spectra), fine_indices.size))
        for row, torque_spectrum in zip(torque_and_derivatives, torque_spectra, strict=True):
            row[:] = np.fft.irfft(shift_factors * torque_spectrum, self._length).T.ravel()[
                fine_indices
            ]
        torque_and_derivatives *= sample_growth
        return torque_and_derivatives[0], torque_and_derivatives[1:]
