"""Least-squares problem of a record: whitened residual of a damping structure, and its minimum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.optimizer import NormalEquations, RecentValues, descend
from rigd.beam import Pole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import Minimum, Region


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Torque residual spectrum (prediction minus measurement), and its derivatives, at one point.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Residual in N·m, not whitened.
    jacobian : ndarray of complex, shape (k, K)
        Derivatives of the residual by the unknowns.
    poles : tuple of Pole
        Poles of the beam, differentiated by the unknowns.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    poles: tuple[Pole, ...]


@dataclass(frozen=True, slots=True)
class ProjectedResidual:
    """Whitened residual and derivatives with the torques of unknown amplitude projected out.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Whitened residual. Its real and imaginary parts have variance 1 if the noise is as assumed.
    jacobian : ndarray of complex, shape (k, K)
        Derivatives of the residual by the unknowns.
    amplitudes : ndarray, shape (m,)
        Best amplitudes of the torques that are projected out; those of free decays are in N·m at
        the first compared sample.
    amplitude_gram : ndarray, shape (m, m)
        Inverse covariance of the amplitudes.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    amplitudes: NDArray[np.float64]
    amplitude_gram: NDArray[np.float64]

    @property
    def cost(self) -> float:
        """Return the cost: the sum of the squared whitened residual."""
        return float(np.vdot(self.residual, self.residual).real)

    def normal_equations(self) -> NormalEquations:
        """Return cost, gradient and Hessian for a Gauss-Newton step of the unknowns."""
        real_jacobian = _as_real_rows(self.jacobian)
        return NormalEquations(
            cost=self.cost,
            gradient=real_jacobian @ _as_real_rows(self.residual),
            hessian=real_jacobian @ real_jacobian.T,
        )


_MAX_TORQUE_FILLING_ROUNDS: Final = 8
"""Maximum number of times that a descent is repeated with unknown torques filled again."""

_CONVERGED_UNKNOWNS_CHANGE: Final = 1e-6
"""Change of the unknowns below which the filling of unknown torques has converged."""


class Objective:
    """Cost of one damping structure on one record, as a function of the unknowns.

    The cost is the sum of the squared whitened residual.

    Parameters
    ----------
    comparison : Comparison
        Record, reduced to the band.
    unknowns : Unknowns
        Free parameters of the structure.
    effect_spectra : ndarray of complex, shape (c, K), optional
        Torque spectra of known form, in N·m per unit of amplitude. Their amplitudes are free, like
        those of the free decay.
    """

    __slots__ = ("_recent", "comparison", "effect_spectra", "unknowns")

    def __init__(
        self,
        comparison: Comparison,
        unknowns: Unknowns,
        effect_spectra: NDArray[np.complex128] | None = None,
    ) -> None:
        no_effect_spectra = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        self.comparison = comparison
        self.unknowns = unknowns
        self.effect_spectra = no_effect_spectra if effect_spectra is None else effect_spectra
        self._recent: RecentValues[Linearisation] = (
            comparison.shared_result_cache if comparison.is_long else RecentValues()
        )

    def linearise(self, vector_of_unknowns: NDArray[np.float64]) -> Linearisation:
        """Return the torque residual and its derivatives for the unknowns `vector_of_unknowns`.

        The results at the last points are cached.
        """
        cache_owner = self if self.comparison.is_long else None
        return self._recent.value_at(vector_of_unknowns, self._linearise, cache_owner)

    def _linearise(self, vector_of_unknowns: NDArray[np.float64]) -> Linearisation:
        """Return torque residual and derivatives for given unknowns, without the cache."""
        comparison, unknowns = self.comparison, self.unknowns
        gradient_names = unknowns.gradient_names
        plant, parameters_by_unknowns = unknowns.plant_and_gradient(vector_of_unknowns)
        predicted_spectra = np.empty(
            (1 + len(gradient_names), comparison.frequency_hz.size), np.complex128
        )
        for rows, torque_nm in comparison.torque_predictor.torque_blocks(plant, gradient_names):
            if rows.start == 0:
                torque_nm[0] -= comparison.torque_nm[comparison.retained_samples]
            predicted_spectra[rows] = comparison.spectrum(torque_nm)
        # A copy, so that the derivatives are not stored with the residual.
        residual, derivatives = predicted_spectra[0].copy(), predicted_spectra[1:]
        poles = tuple(
            Pole(
                plant_pole.mode, plant_pole.at_rad_s, plant_pole.derivative @ parameters_by_unknowns
            )
            for plant_pole in comparison.poles(plant, gradient_names)
        )
        jacobian = (parameters_by_unknowns.T @ _as_real_rows(derivatives)).view(np.complex128)
        if comparison.drag is not None:
            drag_change, drag_derivatives = comparison.drag.torque_change_to(
                plant, poles, unknowns.names, parameters_by_unknowns
            )
            residual += drag_change
            jacobian += drag_derivatives
        return Linearisation(residual=residual, jacobian=jacobian, poles=poles)

    def unknown_torque_spectra(self, linearisation: Linearisation) -> NDArray[np.complex128]:
        """Return the spectra of torques with unknown amplitude at one point, shape (m, K).

        They are free decays, other disturbances and effects.
        """
        return self.comparison.nuisance_spectra(linearisation.poles, self.effect_spectra)

    def project(
        self, linearisation: Linearisation, noise_weight: NDArray[np.float64] | float
    ) -> ProjectedResidual:
        """Return whitened residual and derivatives without the torques of unknown amplitude.

        These torques are projected out.

        This is variable projection: the best amplitudes at each point are linear in the residual.
        The Jacobian is Kaufman's (BIT 15 (1975) 49-57), with the motion of the poles.

        Parameters
        ----------
        linearisation : Linearisation
            Residual and derivatives at one point.
        noise_weight : ndarray, shape (K,), or float
            Weight of `NoiseSpectrum`; with 1 nothing is whitened.
        """
        residual, jacobian = (
            linearisation.residual * noise_weight,
            linearisation.jacobian * noise_weight,
        )
        unit_columns = _as_real_rows(self.unknown_torque_spectra(linearisation) * noise_weight)
        column_lengths = np.sqrt(np.einsum("ij,ij->i", unit_columns, unit_columns))
        column_lengths[column_lengths == 0] = 1.0  # the spectrum of a decay that ends at once
        unit_columns /= column_lengths[:, None]
        column_gram = unit_columns @ unit_columns.T
        inverse_gram = np.linalg.inv(column_gram + 1e-12 * np.eye(column_lengths.size))
        amplitudes = -inverse_gram @ (unit_columns @ _as_real_rows(residual))
        jacobian += noise_weight * self.comparison.decay_gradient(
            linearisation.poles, amplitudes / column_lengths
        )
        real_jacobian = _as_real_rows(jacobian)
        real_jacobian -= ((real_jacobian @ unit_columns.T) @ inverse_gram) @ unit_columns
        return ProjectedResidual(
            residual=residual + (amplitudes @ unit_columns).view(np.complex128),
            jacobian=jacobian,
            amplitudes=amplitudes / column_lengths,
            amplitude_gram=column_gram * np.outer(column_lengths, column_lengths),
        )

    def normal_equations(
        self, vector_of_unknowns: NDArray[np.float64], noise_weight: NDArray[np.float64]
    ) -> NormalEquations:
        """Return the cost for given unknowns, with gradient and Hessian of a Gauss-Newton step.

        Parameters
        ----------
        vector_of_unknowns : ndarray, shape (k,)
            Unknowns.
        noise_weight : ndarray, shape (K,)
            Inverse standard deviation of the noise in each bin.
        """
        return self.project(self.linearise(vector_of_unknowns), noise_weight).normal_equations()

    def find_minimum(
        self,
        start_unknowns: NDArray[np.float64],
        noise_weight: NDArray[np.float64],
        region: Region,
        *,
        relative_tolerance: float,
        max_evaluations: int = 200,
        give_up_condition: tuple[int, float] | None = None,
    ) -> tuple[Objective, Minimum]:
        """Return the minimum of the cost reached by descents from `start_unknowns`.

        The descent is repeated until filling the unknown torques no longer moves the minimum.

        Parameters
        ----------
        start_unknowns : ndarray, shape (k,)
            Unknowns at which the descent starts.
        noise_weight : ndarray, shape (K,)
            Weight of `NoiseSpectrum`.
        region, relative_tolerance, max_evaluations, give_up_condition
            Arguments of `descend`.

        Returns
        -------
        objective : Objective
            Objective with the unknown torques filled for the last time; `self` if all are known.
        find_minimum : Minimum
            Minimum of that objective.
        """
        objective, vector_of_unknowns = self, start_unknowns
        for _ in range(_MAX_TORQUE_FILLING_ROUNDS):
            objective = objective._fill_unknown_torque(vector_of_unknowns, noise_weight)
            minimum = descend(
                partial(objective.normal_equations, noise_weight=noise_weight),
                vector_of_unknowns,
                region,
                relative_tolerance=relative_tolerance,
                max_evaluations=max_evaluations,
                early_stop_limits=give_up_condition,
            )
            has_converged = (
                objective is self
                or np.abs(minimum.x - vector_of_unknowns).max() < _CONVERGED_UNKNOWNS_CHANGE
            )
            vector_of_unknowns = minimum.x
            # A descent that did not converge does not converge with new fills either.
            is_given_up = (
                give_up_condition is not None and minimum.equations.cost > give_up_condition[1]
            )
            if has_converged or is_given_up or minimum.evaluations >= max_evaluations:
                break
        return objective, minimum

    def _fill_unknown_torque(
        self, vector_of_unknowns: NDArray[np.float64], noise_weight: NDArray[np.float64]
    ) -> Objective:
        """Return the objective with unmeasured torques filled by the prediction for given unknowns.

        Return `self` if all torques were measured.
        """
        if self.comparison.measurement.torque_known.all():
            return self
        linearisation = self.linearise(vector_of_unknowns)
        comparison = self.comparison.fill_unknown_torque(
            self.unknowns.plant(vector_of_unknowns),
            linearisation.poles,
            self.project(linearisation, noise_weight).amplitudes,
        )
        return Objective(comparison, self.unknowns, self.effect_spectra)


def _as_real_rows(complex_rows: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return complex rows as real ones, real and imaginary parts interleaved, shape (..., 2 K).

    Products of such rows are the real parts of complex products, at half the cost.
    """
    real_rows: NDArray[np.float64] = np.ascontiguousarray(complex_rows).view(np.float64)
    return real_rows
