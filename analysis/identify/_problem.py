"""Least-squares problem of a record: whitened residual of a damping structure, and its minimum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.free_decay import Pole
from analysis.optimizer import NormalEquations, RecentValues, descend

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import Minimum, Region


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Residual spectrum (prediction minus measurement) and its derivatives at one point.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Residual in N·m, not whitened.
    jacobian : ndarray of complex, shape (k, K)
        Derivatives of the residual by the unknowns.
    poles : tuple of Pole
        Poles of the beam, differentiated by the unknowns.
    columns : ndarray of complex, shape (m, K)
        Spectra of torques with unknown amplitude: free decays, other disturbances and effects.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    poles: tuple[Pole, ...]
    columns: NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Projected:
    """Whitened residual and derivatives with the torques of unknown amplitude projected out.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Whitened residual. Its real and imaginary parts have variance 1 if the noise is as assumed.
    jacobian : ndarray of complex, shape (k, K)
        Derivatives of the residual by the unknowns.
    amplitudes : ndarray, shape (m,)
        Best amplitudes of `Linearisation.columns`; those of free decays are in N·m at the first
        compared sample.
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
        """Return the normal equations of a Gauss-Newton step."""
        jacobian = _as_real_rows(self.jacobian)
        return NormalEquations(
            cost=self.cost,
            gradient=jacobian @ _as_real_rows(self.residual),
            hessian=jacobian @ jacobian.T,
        )


_MAX_FILLINGS: Final = 8
"""Maximum number of times that a descent is repeated with unknown torques filled again."""

_UNKNOWNS_TOLERANCE: Final = 1e-6
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
    columns : ndarray of complex, shape (c, K), optional
        Torque spectra of known form, in N·m per unit of amplitude. Their amplitudes are free, like
        those of the free decay.
    """

    __slots__ = ("_recent", "columns", "comparison", "unknowns")

    def __init__(
        self,
        comparison: Comparison,
        unknowns: Unknowns,
        columns: NDArray[np.complex128] | None = None,
    ) -> None:
        no_columns = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        self.comparison = comparison
        self.unknowns = unknowns
        self.columns = no_columns if columns is None else columns
        self._recent: RecentValues[Linearisation] = RecentValues()

    def linearise(self, x: NDArray[np.float64]) -> Linearisation:
        """Return residual and derivatives at `x`; the results at the last two points are cached."""
        return self._recent.at(x, self._linearise)

    def _linearise(self, x: NDArray[np.float64]) -> Linearisation:
        """Return residual and derivatives at `x`, without the cache."""
        comparison, unknowns = self.comparison, self.unknowns
        names = unknowns.gradient_names
        plant, parameters_by_unknowns = unknowns.plant_and_gradient(x)
        torque, gradient = comparison.prediction.torque(plant, names)
        poles = tuple(
            Pole(pole.mode, pole.at_rad_s, pole.derivative @ parameters_by_unknowns)
            for pole in comparison.poles(plant, names)
        )
        residual = comparison.spectrum(torque - comparison.torque_nm[comparison.retained])
        jacobian = (parameters_by_unknowns.T @ _as_real_rows(comparison.spectrum(gradient))).view(
            np.complex128
        )
        if comparison.drag is not None:
            drag_change, drag_derivatives = comparison.drag.change_to(
                plant, poles, unknowns.names, parameters_by_unknowns
            )
            residual += drag_change
            jacobian += drag_derivatives
        return Linearisation(
            residual=residual,
            jacobian=jacobian,
            poles=poles,
            columns=np.concatenate([comparison.nuisance_spectra(poles), self.columns]),
        )

    def project(self, at: Linearisation, weight: NDArray[np.float64] | float) -> Projected:
        """Whiten residual and derivatives, and project out the torques of unknown amplitude.

        This is variable projection: the best amplitudes at each point are linear in the residual.
        The Jacobian is Kaufman's (BIT 15 (1975) 49-57), with the motion of the poles.

        Parameters
        ----------
        at : Linearisation
            Residual and derivatives at one point.
        weight : ndarray, shape (K,), or float
            Weight of `NoiseSpectrum`; with 1 nothing is whitened.
        """
        residual, jacobian = at.residual * weight, at.jacobian * weight
        columns = _as_real_rows(at.columns * weight)
        lengths = np.sqrt(np.einsum("ij,ij->i", columns, columns))
        lengths[lengths == 0] = 1.0  # the spectrum of a decay that ends at once
        columns /= lengths[:, None]
        gram = columns @ columns.T
        inverse_gram = np.linalg.inv(gram + 1e-12 * np.eye(lengths.size))
        amplitudes = -inverse_gram @ (columns @ _as_real_rows(residual))
        jacobian += weight * self.comparison.decay_gradient(at.poles, amplitudes / lengths)
        real_jacobian = _as_real_rows(jacobian)
        real_jacobian -= ((real_jacobian @ columns.T) @ inverse_gram) @ columns
        return Projected(
            residual=residual + (amplitudes @ columns).view(np.complex128),
            jacobian=jacobian,
            amplitudes=amplitudes / lengths,
            amplitude_gram=gram * np.outer(lengths, lengths),
        )

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NormalEquations:
        """Return the cost at `x`, with gradient and Hessian of a Gauss-Newton step.

        Parameters
        ----------
        x : ndarray, shape (k,)
            Unknowns.
        weight : ndarray, shape (K,)
            Inverse standard deviation of the noise in each bin.
        """
        return self.project(self.linearise(x), weight).normal_equations()

    def minimum(
        self,
        start: NDArray[np.float64],
        weight: NDArray[np.float64],
        region: Region,
        *,
        relative_tolerance: float,
        max_evaluations: int = 200,
        hopeless: tuple[int, float] | None = None,
    ) -> tuple[Objective, Minimum]:
        """Descend to a minimum of the cost; repeat while filling unknown torques moves the minimum.

        Parameters
        ----------
        start : ndarray, shape (k,)
            Unknowns at which the descent starts.
        weight : ndarray, shape (K,)
            Weight of `NoiseSpectrum`.
        region, relative_tolerance, max_evaluations, hopeless
            Arguments of `descend`.

        Returns
        -------
        objective : Objective
            Objective with the unknown torques filled for the last time; `self` if all are known.
        minimum : Minimum
            Minimum of that objective.
        """
        x = start
        for _ in range(_MAX_FILLINGS):
            objective = self._fill_unknown_torque(x)
            minimum = descend(
                partial(objective.normal_equations, weight=weight),
                x,
                region,
                relative_tolerance=relative_tolerance,
                max_evaluations=max_evaluations,
                hopeless=hopeless,
            )
            converged = objective is self or np.abs(minimum.x - x).max() < _UNKNOWNS_TOLERANCE
            x = minimum.x
            # A descent that did not converge does not converge with new fills either.
            given_up = hopeless is not None and minimum.equations.cost > hopeless[1]
            if converged or given_up or minimum.evaluations >= max_evaluations:
                break
        return objective, minimum

    def _fill_unknown_torque(self, x: NDArray[np.float64]) -> Objective:
        """Fill unknown torques with the prediction at `x`; return `self` if all are known."""
        comparison = self.comparison.fill_unknown_torque(self.unknowns.plant(x))
        if comparison is self.comparison:
            return self
        return Objective(comparison, self.unknowns, self.columns)


def _as_real_rows(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return a view with real and imaginary parts interleaved, shape (..., 2 K).

    Products of such rows are the real parts of complex products, at half the cost.
    """
    real_rows: NDArray[np.float64] = np.ascontiguousarray(values).view(np.float64)
    return real_rows
