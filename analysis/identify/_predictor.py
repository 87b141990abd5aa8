"""Torque predicted from the measured angle by the response of a plant (`ResponseGrid`).

The angle is convolved with the response causally, over the whole record (`CausalTransform`).
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._modal_model import ModalModel
from analysis.identify._structure_plant import StructurePlant
from rigd.beam import (
    CausalTransform,
    Plant,
    ResponseGrid,
    clamped_free_eigenvalues,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray


@lru_cache(maxsize=16)
def eigenvalues(mode_count: int) -> NDArray[np.float64]:
    """Return the first eigenvalues k L of a clamped-free beam, shape (count,).

    They are the roots of ``1 + cos z cosh z = 0``.

    The array is cached and read-only.
    """
    eigenvalues_kl = clamped_free_eigenvalues(mode_count)
    eigenvalues_kl.flags.writeable = False
    return eigenvalues_kl


# Prediction

_VALUES_PER_BLOCK: Final = 1 << 17
"""Number of values of time series that are transformed at once. A transform of two rows takes
little longer than that of one, and what exceeds the processor's cache takes longer again. The rows
of long records are transformed one by one, since their transforms take much memory."""


class TorquePredictor:
    """Prediction of the torque from one motor angle, with derivatives by the plant's parameters.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        Angle from rest, band-limited: it has no power at half the rate.
    rate_hz : float
        Sampling rate of the angle.
    retained_samples : slice
        Samples at which the torque is returned.
    """

    __slots__ = ("_response", "_retained", "_spectrum", "_transform", "rate_hz")

    def __init__(
        self, angle_rad: NDArray[np.float64], rate_hz: float, retained_samples: slice
    ) -> None:
        self.rate_hz = rate_hz
        self._retained = retained_samples
        self._transform = CausalTransform.for_record(angle_rad.size, rate_hz)
        self._response = ResponseGrid(self._transform.s)
        self._spectrum = self._transform.forward(angle_rad)

    def with_angle(self, angle_rad: NDArray[np.float64]) -> TorquePredictor:
        """Return the torque predictor for another motor angle of the same length, shape (n,)."""
        predictor = copy(self)
        predictor._spectrum = self._transform.forward(angle_rad)
        return predictor

    @property
    def s(self) -> NDArray[np.complex128]:
        """Return the grid of the Laplace variable for responses, in rad/s."""
        return self._response.s

    def to_time_series(self, responses: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the torques in N·m that transfer functions predict from the angle, shape (..., m).

        Parameters
        ----------
        responses : ndarray of complex, shape (..., n)
            Transfer functions on the grid `s`.
        """
        return self._transform.inverse(responses * self._spectrum, self._retained)

    def torque(
        self, plant: Plant | ModalModel, gradient_parameters: Sequence[str] = ()
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the predicted torque in N·m at the retained samples, and its derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Plant or model whose torque is computed.
        gradient_parameters : sequence of str
            Names of k parameters as for `ResponseGrid.evaluate`; none for a modal model.

        Returns
        -------
        torque : ndarray, shape (m,)
        gradient : ndarray, shape (k, m)
        """
        torque_spectra = self._torque_spectra(plant, gradient_parameters)
        torque_and_derivatives = self._transform.inverse(torque_spectra, self._retained)
        return torque_and_derivatives[0], torque_and_derivatives[1:]

    def torque_blocks(
        self, plant: Plant | ModalModel, gradient_parameters: Sequence[str]
    ) -> Iterator[tuple[slice, NDArray[np.float64]]]:
        """Yield the predicted torque in N·m at the retained samples and its derivatives, in blocks.

        Each block, shape (b, m), comes with the range of its rows. Row 0 is the torque, and rows 1
        to k are its derivatives.

        Parameters
        ----------
        plant, gradient_parameters
            As for `torque`.
        """
        torque_spectra = self._torque_spectra(plant, gradient_parameters)
        for rows in self.row_blocks(len(torque_spectra)):
            yield rows, self._transform.inverse(torque_spectra[rows], self._retained)

    def row_blocks(self, row_count: int) -> Iterator[slice]:
        """Yield the ranges of rows that are transformed at once.

        Parameters
        ----------
        row_count : int
            Number of time series.
        """
        rows_per_block = max(_VALUES_PER_BLOCK // self._transform.length, 1)
        for first_row in range(0, row_count, rows_per_block):
            yield slice(first_row, min(first_row + rows_per_block, row_count))

    def _torque_spectra(
        self, plant: Plant | ModalModel, gradient_parameters: Sequence[str]
    ) -> NDArray[np.complex128]:
        """Return the transforms of the predicted torque and its k derivatives, shape (1 + k, n)."""
        if isinstance(plant, ModalModel):
            return (plant.response(self.s) * self._spectrum)[None]
        if isinstance(plant, StructurePlant):
            return plant.torque_spectra(self.s, gradient_parameters, self._spectrum)
        return self._response.evaluate(plant, gradient_parameters, self._spectrum)

    def torque_at_fine_samples(
        self,
        plant: Plant | ModalModel,
        rate_factor: int,
        fine_indices: NDArray[np.intp],
        gradient_parameters: Sequence[str] = (),
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the torque in N·m at samples of a higher rate, and its derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Plant or model whose torque is computed.
        rate_factor : int
            Higher rate, in multiples of `rate_hz`.
        fine_indices : ndarray of int, shape (p,)
            Samples at the higher rate, counted from the angle's first sample.
        gradient_parameters : sequence of str
            Names of the k parameters with respect to which the torque is differentiated.

        Returns
        -------
        torque : ndarray, shape (p,)
        gradient : ndarray, shape (k, p)
        """
        torque_spectra = self._torque_spectra(plant, gradient_parameters)
        torque_and_derivatives = self._transform.inverse_at(
            torque_spectra, fine_indices, rate_factor
        )
        return torque_and_derivatives[0], torque_and_derivatives[1:]
