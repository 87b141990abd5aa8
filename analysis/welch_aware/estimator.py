"""Welch's H1 or Hiv of a fixed input as what it is: a linear map of the output.

::

    H(f) = sum_k conj(R_k(f)) Y_k(f) / sum_k conj(R_k(f)) X_k(f)

X_k and Y_k are the transforms of the windowed segments, R_k those of the reference for Hiv, and X_k
itself for H1. Input and reference being known, H of any torque costs one transform a segment. That
map's transpose tells how much of each sample's noise reaches an estimate
(`WelchEstimator.transposed`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.spectral import segment_count, window_named

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rigd.spectral import Segmentation

_ON_GRID: Final = 1e-3
"""By how much of a bin a frequency may miss the estimator's grid: files hold rounded numbers."""


class WelchAwareError(ValueError):
    """Data that do not belong together, or that cannot be used; the message says what to do."""


class WelchEstimator:
    """H1 or Hiv from a given angle to any torque, at some bins.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        The samples that were divided into segments, and no others.
    segmentation : Segmentation
    bins : ndarray of int, shape (K,)
        On the grid ``rate / nfft``; neither 0 nor half the rate.
    window : str
        As `rigd.spectral.welch_response` takes it.
    reference_rad : ndarray, shape (n,), optional
        Of an estimate by `rigd.spectral.instrumental_response`, likewise.

    Attributes
    ----------
    input_power : ndarray, shape (K,)
        What the power of white noise, windowed, is divided by on its way to the estimate.

    Raises
    ------
    WelchAwareError
        The angle has no power at one of the bins.
    """

    __slots__ = ("_gain", "_samples", "_segments", "bins", "input_power", "nfft", "taper")

    def __init__(
        self,
        angle_rad: NDArray[np.float64],
        segmentation: Segmentation,
        bins: NDArray[np.intp],
        window: str,
        reference_rad: NDArray[np.float64] | None = None,
    ) -> None:
        length = segmentation.segment_length
        hop = length - segmentation.overlap
        count = segment_count(angle_rad.size, length, segmentation.overlap)
        self.bins = bins
        self.taper = window_named(window)(length)
        self._samples = angle_rad.size
        self.nfft = segmentation.nfft
        self._segments = [slice(k * hop, k * hop + length) for k in range(count)]
        inputs = np.array([self._spectra(angle_rad, segment) for segment in self._segments])
        instruments = inputs
        if reference_rad is not None:
            instruments = np.array([self._spectra(reference_rad, k) for k in self._segments])
        product = np.sum(instruments.conj() * inputs, axis=0)
        if not product.all():
            raise WelchAwareError(
                "The angle has no power at a frequency of the response, so it cannot be the "
                "response to this angle; give the angle it was estimated from."
            )
        self._gain = instruments.conj() / product
        self.input_power = 1 / np.sum(self._gain.real**2 + self._gain.imag**2, axis=0)

    def response(self, torque_nm: NDArray[np.float64]) -> NDArray[np.complex128]:
        """H1 or Hiv of torques, shape (..., n), in N·m/rad: shape (..., K)."""
        found = np.zeros((*torque_nm.shape[:-1], self.bins.size), dtype=np.complex128)
        for segment, gain in zip(self._segments, self._gain, strict=True):
            found += gain * self._spectra(torque_nm, segment)
        return found

    def transposed(self, rows: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Sensitivity of ``Re sum_f conj(row(f)) H1(f)`` to each sample of the torque.

        Parameters
        ----------
        rows : ndarray of complex, shape (k, K)

        Returns
        -------
        ndarray, shape (k, n)
        """
        found = np.zeros((len(rows), self._samples))
        spectra = np.zeros((len(rows), self.nfft // 2 + 1), dtype=np.complex128)
        for segment, gain in zip(self._segments, self._gain, strict=True):
            spectra[:, self.bins] = rows * gain.conj()
            # irfft counts every bin with its mirror image and divides by its length.
            samples = np.fft.irfft(spectra, self.nfft)[:, : self.taper.size]
            found[:, segment] += (self.nfft / 2) * self.taper * samples
        return found

    def _spectra(self, values: NDArray[np.float64], segment: slice) -> NDArray[np.complex128]:
        windowed = values[..., segment] * self.taper
        return np.fft.rfft(windowed, self.nfft)[..., self.bins]


def bins_of(
    frequency_hz: NDArray[np.float64], rate_hz: float, segmentation: Segmentation
) -> NDArray[np.intp]:
    """Place frequencies on the estimator's grid.

    Raises
    ------
    WelchAwareError
        They do not lie on it, or not between its ends.
    """
    place = frequency_hz * segmentation.nfft / rate_hz
    bins = np.rint(place).astype(np.intp)
    off = np.abs(place - bins) > _ON_GRID
    if off.any():
        raise WelchAwareError(
            f"{np.count_nonzero(off)} of {off.size} frequencies, the first "
            f"{frequency_hz[off][0]:g} Hz, are no multiples of "
            f"{rate_hz / segmentation.nfft:g} Hz, which are the bins of nfft = "
            f"{segmentation.nfft} at {rate_hz:g} Hz; give the nfft and rate of the estimate."
        )
    if bins[0] < 1 or bins[-1] >= (segmentation.nfft + 1) // 2 or (np.diff(bins) < 1).any():
        raise WelchAwareError(
            f"The frequencies must increase between 0 and half the rate ({rate_hz / 2:g} Hz), "
            f"both excluded; they run from {frequency_hz[0]:g} to {frequency_hz[-1]:g} Hz."
        )
    return bins
