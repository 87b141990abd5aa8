"""Least-squares problem of a record: the whitened residual of a structure, and its minimum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.free_decay import Pole
from analysis.optimizer import NormalEquations, Recent, descend

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import Minimum, Region


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Residual (prediction minus measurement) and its derivatives at one point.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Not whitened.
    jacobian : ndarray of complex, shape (k, K)
        By the unknowns.
    poles : tuple of Pole
        Differentiated by the unknowns.
    columns : ndarray of complex, shape (m, K)
        Spectra of their free decays.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    poles: tuple[Pole, ...]
    columns: NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Projected:
    """Whitened linearisation with the free decay projected out.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Real and imaginary parts of variance 1 where the noise is as assumed.
    jacobian : ndarray of complex, shape (k, K)
    amplitudes : ndarray, shape (m,)
        Amplitudes of the free decays, in N·m, at the first sample compared.
    amplitude_gram : ndarray, shape (m, m)
        Inverse covariance of the amplitudes.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    amplitudes: NDArray[np.float64]
    amplitude_gram: NDArray[np.float64]

    @property
    def cost(self) -> float:
        """Return the sum of squares."""
        return float(np.vdot(self.residual, self.residual).real)

    def normal_equations(self) -> NormalEquations:
        """Return the normal equations for the descent."""
        jacobian = _parts(self.jacobian)
        return NormalEquations(
            cost=self.cost,
            gradient=jacobian @ _parts(self.residual),
            hessian=jacobian @ jacobian.T,
        )


_FILLINGS: Final = 8
"""As often unknown torques are put as predicted, at most."""

_CONVERGED: Final = 1e-6
"""Change of the unknowns below which the fill of unknown torques is final."""


class Objective:
    """Sum of squares of one structure on one record, as a function of the unknowns.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    columns : ndarray of complex, shape (c, K), optional
        Spectra of known shape and unknown size, in N·m per unit of amplitude: their amplitudes are
        free as those of the free decay are.
    """

    __slots__ = ("_recent", "columns", "comparison", "unknowns")

    def __init__(
        self,
        comparison: Comparison,
        unknowns: Unknowns,
        columns: NDArray[np.complex128] | None = None,
    ) -> None:
        none = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        self.comparison = comparison
        self.unknowns = unknowns
        self.columns = none if columns is None else columns
        self._recent: Recent[Linearisation] = Recent()

    def linearise(self, x: NDArray[np.float64]) -> Linearisation:
        """Return residual and derivatives at `x`; the last two points are cached."""
        return self._recent.at(x, self._linearise)

    def _linearise(self, x: NDArray[np.float64]) -> Linearisation:
        comparison, unknowns = self.comparison, self.unknowns
        names = unknowns.gradient_names
        plant, chain = unknowns.plant_and_gradient(x)
        torque, gradient = comparison.prediction.torque(plant, names)
        poles = tuple(
            Pole(pole.mode, pole.at_rad_s, pole.derivative @ chain)
            for pole in comparison.poles(plant, names)
        )
        residual = comparison.spectrum(torque - comparison.torque_nm[comparison.retained])
        jacobian = (chain.T @ _parts(comparison.spectrum(gradient))).view(np.complex128)
        if comparison.drag is not None:
            change, slopes = comparison.drag.change_to(plant, poles, unknowns.names, chain)
            residual += change
            jacobian += slopes
        return Linearisation(
            residual=residual,
            jacobian=jacobian,
            poles=poles,
            columns=np.concatenate([comparison.nuisance_spectra(poles), self.columns]),
        )

    def project(self, at: Linearisation, weight: NDArray[np.float64] | float) -> Projected:
        """Whiten, and project out the free decay (variable projection).

        The best amplitudes at each point are linear in the residual; the Jacobian is Kaufman's (BIT
        15 (1975) 49-57), with the motion of the poles.

        Parameters
        ----------
        at : Linearisation
        weight : ndarray, shape (K,), or float
            Weight of `NoiseSpectrum`, or 1 not to whiten.
        """
        residual, jacobian = at.residual * weight, at.jacobian * weight
        columns = _parts(at.columns * weight)
        scale = np.sqrt(np.einsum("ij,ij->i", columns, columns))
        scale[scale == 0] = 1.0  # a decay that is over at once
        columns /= scale[:, None]
        gram = columns @ columns.T
        inverse = np.linalg.inv(gram + 1e-12 * np.eye(scale.size))
        amplitudes = -inverse @ (columns @ _parts(residual))
        jacobian += weight * self.comparison.decay_gradient(at.poles, amplitudes / scale)
        parts = _parts(jacobian)
        parts -= ((parts @ columns.T) @ inverse) @ columns
        return Projected(
            residual=residual + (amplitudes @ columns).view(np.complex128),
            jacobian=jacobian,
            amplitudes=amplitudes / scale,
            amplitude_gram=gram * np.outer(scale, scale),
        )

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NormalEquations:
        """Return the sum of squares at `x`, with gradient and Hessian of a Gauss-Newton step.

        Parameters
        ----------
        x : ndarray, shape (k,)
            Unknowns.
        weight : ndarray, shape (K,)
            Inverse standard deviation of the noise, bin by bin.
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
        """Descend; repeat while the fill of unknown torques moves the minimum.

        Parameters
        ----------
        start : ndarray, shape (k,)
        weight : ndarray, shape (K,)
            That of `NoiseSpectrum`.
        region, relative_tolerance, max_evaluations, hopeless
            Arguments of `descend`.

        Returns
        -------
        objective : Objective
            Objective with the last fill of unknown torques; `self` if all are known.
        minimum : Minimum
            Minimum of that objective.
        """
        x = start
        for _ in range(_FILLINGS):
            objective = self._filled(x)
            found = descend(
                partial(objective.normal_equations, weight=weight),
                x,
                region,
                relative_tolerance=relative_tolerance,
                max_evaluations=max_evaluations,
                hopeless=hopeless,
            )
            converged = objective is self or np.abs(found.x - x).max() < _CONVERGED
            x = found.x
            # A descent that did not converge does not converge with new fills either.
            given_up = hopeless is not None and found.equations.cost > hopeless[1]
            if converged or given_up or found.evaluations >= max_evaluations:
                break
        return objective, found

    def _filled(self, x: NDArray[np.float64]) -> Objective:
        """Fill unknown torques with the prediction at `x`; return `self` if all are known."""
        comparison = self.comparison.filled(self.unknowns.plant(x))
        if comparison is self.comparison:
            return self
        return Objective(comparison, self.unknowns, self.columns)


def _parts(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return real and imaginary parts side by side, shape (..., 2 K), as a view.

    Products of these are the real parts of complex products, at half the cost.
    """
    parts: NDArray[np.float64] = np.ascontiguousarray(values).view(np.float64)
    return parts
