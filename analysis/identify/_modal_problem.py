"""Least-squares problem of the modal model: frequencies and damping of modes, all else eliminated.

At each point the linear parameters (residues, background and disturbances) have their best values,
and the spectra that they multiply are projected out. The fitted form and its reasons are those of
`analysis.identify._modal_fit`. The rows of a long record are processed in blocks of columns.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._comparison import MAX_BINS_OF_STORED_RESULTS
from analysis.identify._estimates import Ringing
from analysis.identify._modal_model import BACKGROUND_COEFFICIENTS, ModalModel
from analysis.optimizer import NormalEquations, RecentValues
from rigd.beam import Pole

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison

_COLUMNS_PER_BLOCK: Final = 1 << 14
"""Number of columns of the rows of a long record that are processed at once."""


def column_blocks(column_count: int) -> Iterator[slice]:
    """Yield the ranges of columns that are processed at once: all, unless the record is long."""
    is_long_record = column_count > 2 * MAX_BINS_OF_STORED_RESULTS
    columns_per_block = _COLUMNS_PER_BLOCK if is_long_record else max(column_count, 1)
    for first_column in range(0, column_count, columns_per_block):
        yield slice(first_column, min(first_column + columns_per_block, column_count))


def _scaled_gram(
    *matrices: NDArray[np.float64], regularization: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gram matrix of the rows of all matrices, scaled to length 1, and the row lengths.

    `regularization` is added to the diagonal of the Gram matrix.
    """
    row_count = sum(len(matrix) for matrix in matrices)
    row_squares, gram = np.zeros(row_count), np.zeros((row_count, row_count))
    column_ranges = list(column_blocks(matrices[0].shape[1]))
    for columns in column_ranges:
        row_squares += np.concatenate(
            [np.einsum("ij,ij->i", matrix[:, columns], matrix[:, columns]) for matrix in matrices]
        )
    row_lengths = np.sqrt(row_squares)
    row_lengths[row_lengths == 0] = 1.0  # the spectrum of a decay that ends at once
    for columns in column_ranges:
        unit_rows = np.concatenate([matrix[:, columns] for matrix in matrices])
        unit_rows /= row_lengths[:, None]
        gram += unit_rows @ unit_rows.T
    gram[np.diag_indices_from(gram)] += regularization
    return gram, row_lengths


def _orthonormalise(rows_to_change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace rows, in place, by orthonormal rows with the same span.

    Return the matrix whose product with the orthonormal rows restores the given rows.
    """
    gram, row_lengths = _scaled_gram(rows_to_change, regularization=1e-13)
    cholesky_factor = np.linalg.cholesky(gram)
    # A product takes a third of the time of a solution for many columns.
    orthonormalising_matrix = np.linalg.inv(cholesky_factor) / row_lengths
    for columns in column_blocks(rows_to_change.shape[1]):
        rows_to_change[:, columns] = orthonormalising_matrix @ rows_to_change[:, columns]
    restoring_matrix: NDArray[np.float64] = cholesky_factor * row_lengths[:, None]
    return restoring_matrix


def _remove_span(rows_to_change: NDArray[np.float64], span_rows: NDArray[np.float64]) -> None:
    """Subtract from rows, in place, their projections on the orthonormal rows `span_rows`."""
    coefficients = rows_to_change @ span_rows.T
    for columns in column_blocks(rows_to_change.shape[1]):
        rows_to_change[:, columns] -= coefficients @ span_rows[:, columns]


@dataclass(frozen=True, slots=True)
class _LinearSolution:
    """Best linear parameters of the modal model for one set of frequencies and damping.

    `jacobian` are the derivatives of the whitened `residual` outside the span of the spectra that
    the linear parameters multiply. Real and imaginary parts are interleaved, so that rows have 2 K
    values.
    """

    residual: NDArray[np.float64]
    linear_parameters: NDArray[np.float64]
    jacobian: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Uncertainty:
    """Uncertainty of the modal model at a minimum.

    `covariance` is that of frequencies, damping and linear parameters together. `span_rows` are
    orthonormal rows that span all derivatives of the residual. `ln_damping_per_torque`, shape
    (n, 2 K), is the derivative of the logarithm of each eta by the whitened torque.
    """

    covariance: NDArray[np.float64]
    span_rows: NDArray[np.float64]
    ln_damping_per_torque: NDArray[np.float64]


def _ln_damping_per_torque(
    jacobian: NDArray[np.float64], mode_unknowns: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative of each ln(eta) at a minimum by the whitened torque, shape (n, 2 K)."""
    gram, row_lengths = _scaled_gram(jacobian, regularization=1e-14)
    derivatives = np.empty((mode_unknowns.size // 2, jacobian.shape[1]))
    for columns in column_blocks(jacobian.shape[1]):
        # The residual is predicted minus measured: the torque enters it with the opposite sign.
        unit_rows = jacobian[:, columns] / row_lengths[:, None]
        unknowns_per_torque = np.linalg.solve(gram, unit_rows) / row_lengths[:, None]
        derivatives[:, columns] = unknowns_per_torque[1::2] / mode_unknowns[1::2, None]
    return derivatives


def _relative_pole(eta: float) -> complex:
    """Return the pole of a mode with loss factor eta, divided by its undamped frequency in rad/s.

    It is the root of ``1 + eta q + q²`` with positive imaginary part.
    """
    return complex(-eta / 2, math.sqrt(1 - eta * eta / 4))


def _relative_pole_derivative(eta: float) -> complex:
    """Return the derivative of `_relative_pole` with respect to the loss factor eta."""
    return complex(-0.5, -eta / (4 * math.sqrt(1 - eta * eta / 4)))


class ModalProblem:
    """Least-squares problem of the modal model: its unknowns are mode frequencies and damping."""

    def __init__(
        self,
        comparison: Comparison,
        noise_weight: NDArray[np.float64],
        effect_spectra: NDArray[np.complex128],
        mode_numbers: tuple[int, ...],
    ) -> None:
        self._recent: RecentValues[_LinearSolution] = (
            comparison.shared_result_cache if comparison.is_long else RecentValues()
        )
        self._numbers = mode_numbers
        self._comparison = comparison
        self._weight = noise_weight
        self._effect_spectra = effect_spectra
        self._s = comparison.torque_predictor.s
        self.scale_rad_s = 2 * math.pi * float(comparison.frequency_hz[-1])
        self._measured_torque = self._whiten(
            comparison.spectrum(comparison.torque_nm[comparison.retained_samples])
        )
        background_responses = np.array(
            [(self._s / self.scale_rad_s) ** n for n in range(BACKGROUND_COEFFICIENTS)]
        )
        self._background = self._predicted_spectra(background_responses)

    def for_modes(self, mode_numbers: tuple[int, ...]) -> ModalProblem:
        """Return the problem of other modes of the same record."""
        problem = copy(self)
        problem._numbers = mode_numbers
        if not self._comparison.is_long:
            problem._recent = RecentValues()
        return problem

    def _whiten(self, spectra: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return whitened spectra with real and imaginary parts interleaved, shape (..., 2 K)."""
        return np.ascontiguousarray(spectra * self._weight).view(np.float64)

    def _predicted_spectra(
        self, responses: Sequence[NDArray[np.complex128]] | NDArray[np.complex128]
    ) -> NDArray[np.float64]:
        """Return the whitened torque spectra of transfer functions from the angle, (n, 2 K)."""
        comparison = self._comparison
        predicted_spectra = np.empty((len(responses), 2 * self._weight.size))
        for rows in comparison.torque_predictor.row_blocks(len(responses)):
            torque_nm = comparison.torque_predictor.to_time_series(np.asarray(responses[rows]))
            predicted_spectra[rows] = self._whiten(comparison.spectrum(torque_nm))
        return predicted_spectra

    def _poles(self, mode_unknowns: NDArray[np.float64]) -> list[Pole]:
        """Return the poles of the modes, with their derivatives by frequencies and damping.

        `mode_unknowns` is ``(ln omega_1, eta_1, ln omega_2, …)``.
        """
        poles = []
        for k, (log_omega, eta) in enumerate(mode_unknowns.reshape(-1, 2)):
            omega_rad_s, q = math.exp(log_omega), _relative_pole(eta)
            pole_derivative = np.zeros(mode_unknowns.size, dtype=np.complex128)
            pole_derivative[2 * k] = omega_rad_s * q
            pole_derivative[2 * k + 1] = omega_rad_s * _relative_pole_derivative(eta)
            poles.append(Pole(self._numbers[k], omega_rad_s * q, pole_derivative))
        return poles

    def _nuisance_spectra(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the torque spectra of all disturbances and effects of unknown amplitude, (m, K).

        They are not whitened.
        """
        return self._comparison.nuisance_spectra(poles, self._effect_spectra)

    def solution_at(self, mode_unknowns: NDArray[np.float64]) -> _LinearSolution:
        """Return the best linear parameters at a point ``(ln omega_1, eta_1, ln omega_2, …)``.

        The solutions at the last points are cached.
        """
        return self._recent.value_at(
            mode_unknowns, self._solve_at, self if self._comparison.is_long else None
        )

    def _solve_at(self, mode_unknowns: NDArray[np.float64]) -> _LinearSolution:
        """Return the best linear parameters at a point, computed without the cache."""
        linear_spectra = self._linear_spectra(mode_unknowns)
        residual, linear_parameters = self._solve(mode_unknowns, linear_spectra)
        jacobian = np.empty((mode_unknowns.size, residual.size))
        self._write_jacobian(mode_unknowns, linear_parameters, jacobian)
        _remove_span(jacobian, linear_spectra)
        return _LinearSolution(residual, linear_parameters, jacobian)

    def residual_and_linear_parameters(
        self, mode_unknowns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the whitened residual and the best linear parameters at a point."""
        if self._comparison.is_long:
            self._recent.clear()
        return self._solve(mode_unknowns, self._linear_spectra(mode_unknowns))

    def cost(self, mode_unknowns: NDArray[np.float64]) -> float:
        """Return the sum of the squared whitened residual at a point."""
        residual, _ = self.residual_and_linear_parameters(mode_unknowns)
        return float(residual @ residual)

    def uncertainty(
        self, mode_unknowns: NDArray[np.float64], linear_parameters: NDArray[np.float64]
    ) -> _Uncertainty:
        """Return covariance and derivatives at a minimum with its linear parameters."""
        if self._comparison.is_long:
            self._recent.clear()
        rows = self._linear_spectra(mode_unknowns, mode_unknowns.size)
        spectra, jacobian = rows[: -mode_unknowns.size], rows[-mode_unknowns.size :]
        self._write_jacobian(mode_unknowns, linear_parameters, jacobian)
        gram, row_lengths = _scaled_gram(jacobian, spectra, regularization=1e-14)
        covariance: NDArray[np.float64] = np.linalg.inv(gram) / np.outer(row_lengths, row_lengths)
        # From here on in place: the rows of a long record take much memory.
        _orthonormalise(spectra)
        _remove_span(jacobian, spectra)
        ln_damping_per_torque = _ln_damping_per_torque(jacobian, mode_unknowns)
        _orthonormalise(jacobian)
        return _Uncertainty(covariance, rows, ln_damping_per_torque)

    def _linear_spectra(
        self, mode_unknowns: NDArray[np.float64], appended_row_count: int = 0
    ) -> NDArray[np.float64]:
        """Return the whitened spectra that the linear parameters multiply, shape (m, 2 K).

        They are those of the numerators of the modes, of the background and of the nuisances, in
        this order. `appended_row_count` is the number of rows without values that are appended.
        """
        nuisance_spectra = self._nuisance_spectra(self._poles(mode_unknowns))
        nuisance_start = mode_unknowns.size + BACKGROUND_COEFFICIENTS
        nuisance_end = nuisance_start + len(nuisance_spectra)
        spectrum_rows = np.empty((nuisance_end + appended_row_count, 2 * self._weight.size))
        for row, spectrum in zip(
            spectrum_rows[nuisance_start:nuisance_end], nuisance_spectra, strict=True
        ):
            row[:] = self._whiten(spectrum)
        del nuisance_spectra
        for k, (log_omega, eta) in enumerate(mode_unknowns.reshape(-1, 2)):
            _, _, numerators = self._numerators(log_omega, eta)
            spectrum_rows[2 * k : 2 * k + 2] = self._predicted_spectra(numerators)
        spectrum_rows[mode_unknowns.size : nuisance_start] = self._background
        return spectrum_rows

    def _numerators(
        self, log_omega: float, eta: float
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128], tuple[NDArray[np.complex128], ...]]:
        """Return q, ``1/d``, and ``(q²/d, q³/d)`` of a mode, with ``d = 1 + eta q + q²``."""
        q = self._s / math.exp(log_omega)
        inverse_denominator = 1 / (1 + eta * q + q * q)
        return q, inverse_denominator, (q * q * inverse_denominator, q**3 * inverse_denominator)

    def _solve(
        self, mode_unknowns: NDArray[np.float64], linear_spectra: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return residual and best linear parameters at given nonlinear parameters.

        The `linear_spectra` of the linear parameters are made orthonormal in place.
        """
        restoring_matrix = _orthonormalise(linear_spectra)
        measured_torque = self._measured_torque
        if (drag := self._comparison.drag) is not None:
            drag_torque_change, _ = drag.torque_change_by_poles(
                self._poles(mode_unknowns), mode_unknowns.size
            )
            measured_torque = measured_torque - self._whiten(drag_torque_change)
        projections = linear_spectra @ measured_torque
        residual: NDArray[np.float64] = projections @ linear_spectra - measured_torque
        linear_parameters = np.linalg.solve(restoring_matrix.T, projections)
        return residual, linear_parameters.astype(np.float64, copy=False)

    def _write_jacobian(
        self,
        mode_unknowns: NDArray[np.float64],
        linear_parameters: NDArray[np.float64],
        jacobian: NDArray[np.float64],
    ) -> None:
        """Write the derivatives of the whitened residual by the unknowns to an array, (k, 2 K)."""
        poles = self._poles(mode_unknowns)
        jacobian[:] = 0.0
        if (drag := self._comparison.drag) is not None:
            jacobian[:] = self._whiten(drag.torque_change_by_poles(poles, mode_unknowns.size)[1])
        if poles:
            nuisance_amplitudes = linear_parameters[mode_unknowns.size + BACKGROUND_COEFFICIENTS :]
            decay_gradient = self._comparison.decay_gradient(poles, nuisance_amplitudes)
            for k, derivative in enumerate(decay_gradient):
                jacobian[k] += self._whiten(derivative)
            del decay_gradient
        for k, (log_omega, eta) in enumerate(mode_unknowns.reshape(-1, 2)):
            q, inverse_denominator, numerators = self._numerators(log_omega, eta)
            a, b = linear_parameters[2 * k : 2 * k + 2]
            mode_response = a * numerators[0] + b * numerators[1]
            denominator_by_ln_omega = (eta * q + 2 * q * q) * inverse_denominator
            jacobian[2 * k : 2 * k + 2] += self._predicted_spectra(
                [
                    mode_response * (denominator_by_ln_omega - 2) - b * numerators[1],
                    -mode_response * q * inverse_denominator,
                ]
            )

    def modal_model(
        self, mode_unknowns: NDArray[np.float64], linear_parameters: NDArray[np.float64]
    ) -> ModalModel:
        """Return the modal model with given frequencies, damping and linear parameters."""
        unknowns_by_mode = mode_unknowns.reshape(-1, 2)
        poles, residues = [], []
        background_start = 2 * len(unknowns_by_mode)
        background_coefficients = linear_parameters[
            background_start : background_start + BACKGROUND_COEFFICIENTS
        ] / self.scale_rad_s ** np.arange(BACKGROUND_COEFFICIENTS)
        for k, (log_omega, eta) in enumerate(unknowns_by_mode):
            omega_rad_s, (a, b) = math.exp(log_omega), linear_parameters[2 * k : 2 * k + 2]
            q = _relative_pole(eta)
            poles.append(omega_rad_s * q)
            residues.append(omega_rad_s * (a + b * q) * q * q / (2j * q.imag))
            # Add the polynomial part of (a + b q) q² over the denominator.
            background_coefficients[0] += a - b * eta
            background_coefficients[1] += b / omega_rad_s
        return ModalModel(tuple(poles), tuple(residues), tuple(background_coefficients.tolist()))

    def residual_spectrum(
        self,
        mode_unknowns: NDArray[np.float64],
        linear_parameters: NDArray[np.float64],
        model: ModalModel,
    ) -> NDArray[np.complex128]:
        """Return the residual spectrum of a model in N·m, not whitened, shape (K,)."""
        poles, nuisance_amplitudes = self.decays(mode_unknowns, linear_parameters)
        comparison = self._comparison
        predicted_nm = comparison.torque_predictor.torque(model)[0]
        modal_residual = comparison.spectrum(
            predicted_nm - comparison.torque_nm[comparison.retained_samples]
        )
        if comparison.drag is not None:
            modal_residual += comparison.drag.torque_change_by_poles(poles, mode_unknowns.size)[0]
        return modal_residual + nuisance_amplitudes @ self._nuisance_spectra(poles)

    def decays(
        self, mode_unknowns: NDArray[np.float64], linear_parameters: NDArray[np.float64]
    ) -> tuple[list[Pole], NDArray[np.float64]]:
        """Return the poles of the free decays, and the amplitudes of all disturbances."""
        amplitudes = linear_parameters[mode_unknowns.size + BACKGROUND_COEFFICIENTS :]
        return self._poles(mode_unknowns), amplitudes

    def ringing(
        self, linear_parameters: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> Ringing:
        """Return amplitudes and chi-square of the free decay at the beginning of the record.

        The decay of each mode has two amplitudes, which are free linear parameters of the fit.
        `covariance` is that of frequencies, damping and linear parameters together.
        """
        mode_count = len(self._numbers)
        decay_start = 2 * mode_count + BACKGROUND_COEFFICIENTS
        decay_amplitudes = linear_parameters[decay_start : decay_start + 2 * mode_count]
        decay_rows = slice(
            2 * mode_count + decay_start, 2 * mode_count + decay_start + 2 * mode_count
        )
        # Variances of the modes' numerators, and those that they would have with known decays.
        numerator_rows = slice(2 * mode_count, 4 * mode_count)
        numerator_variances = np.diag(covariance)[numerator_rows]
        covariance_with_decays = covariance[numerator_rows, decay_rows]
        variances_by_decays = np.einsum(
            "ij,ji->i",
            covariance_with_decays,
            np.linalg.solve(covariance[decay_rows, decay_rows], covariance_with_decays.T),
        )
        known_fractions = 1 - variances_by_decays / numerator_variances
        return Ringing(
            amplitude_nm=tuple(np.hypot(decay_amplitudes[::2], decay_amplitudes[1::2]).tolist()),
            chi_square=float(
                decay_amplitudes
                @ np.linalg.solve(covariance[decay_rows, decay_rows], decay_amplitudes)
            ),
            degrees_of_freedom=decay_amplitudes.size,
            residue_std_growth=float(
                np.max(np.maximum(known_fractions, np.finfo(float).eps) ** -0.5, initial=1.0)
            ),
        )

    def constants_with_covariance(
        self,
        linear_parameters: NDArray[np.float64],
        mode_unknowns: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the constants of all modes, and their covariance with the background coefficients.

        The constants are `MODE_CONSTANT_NAMES`. The shapes are (4 n,) and (4 n + 5, 4 n + 5).
        """
        mode_count = mode_unknowns.size // 2
        mode_constants = np.empty(4 * mode_count)
        background_start = mode_unknowns.size + 2 * mode_count
        derivatives = np.zeros(
            (4 * mode_count + BACKGROUND_COEFFICIENTS, background_start + BACKGROUND_COEFFICIENTS)
        )
        background_derivatives = derivatives[4 * mode_count :]
        background_derivatives[:, background_start:] = np.diag(
            self.scale_rad_s ** -np.arange(float(BACKGROUND_COEFFICIENTS))
        )
        for k in range(mode_count):
            log_omega, eta = mode_unknowns[2 * k : 2 * k + 2]
            a, b = linear_parameters[2 * k : 2 * k + 2]
            q = _relative_pole(eta)
            residue_numerator = a + b * q
            # ln of the residue over j: ln omega + ln (a + b q) + 2 ln q - ln(2 Im q) + j pi
            log_residue = np.log(-residue_numerator * q * q / (2 * q.imag)) + log_omega
            pole_derivative = _relative_pole_derivative(eta)
            residue_by_eta = (
                b / residue_numerator + 2 / q
            ) * pole_derivative - pole_derivative.imag / q.imag
            residue_by_a, residue_by_b = 1 / residue_numerator, q / residue_numerator
            mode_constants[4 * k : 4 * k + 4] = (
                log_omega + math.log(q.imag / (2 * math.pi)),
                math.log(eta / 2),
                log_residue.real,
                log_residue.imag,
            )
            mode_derivatives = derivatives[4 * k : 4 * k + 4]
            omega_index, eta_index, a_index, b_index = (
                2 * k,
                2 * k + 1,
                mode_unknowns.size + 2 * k,
                mode_unknowns.size + 2 * k + 1,
            )
            mode_derivatives[0, [omega_index, eta_index]] = 1.0, pole_derivative.imag / q.imag
            mode_derivatives[1, eta_index] = 1 / eta
            mode_derivatives[2, [omega_index, eta_index, a_index, b_index]] = (
                1.0,
                residue_by_eta.real,
                residue_by_a.real,
                residue_by_b.real,
            )
            mode_derivatives[3, [eta_index, a_index, b_index]] = (
                residue_by_eta.imag,
                residue_by_a.imag,
                residue_by_b.imag,
            )
            # The remainder of the division of the numerator by the denominator, as in `model`.
            background_derivatives[0, [a_index, b_index, eta_index]] = 1.0, -eta, -b
            background_derivatives[1, [b_index, omega_index]] = np.array([1.0, -b]) / math.exp(
                log_omega
            )
        used_covariance = covariance[: derivatives.shape[1], : derivatives.shape[1]]
        return mode_constants, derivatives @ used_covariance @ derivatives.T

    def normal_equations(self, mode_unknowns: NDArray[np.float64]) -> NormalEquations:
        """Return cost, gradient and Hessian at a point, with Kaufman's Jacobian."""
        solution = self.solution_at(mode_unknowns)
        return NormalEquations(
            cost=float(solution.residual @ solution.residual),
            gradient=solution.jacobian @ solution.residual,
            hessian=solution.jacobian @ solution.jacobian.T,
        )
