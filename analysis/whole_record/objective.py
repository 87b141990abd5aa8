"""The sum of squares that is minimised: whitened residual, free decay projected out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.descent import NormalEquations
from analysis.recent import Recent
from analysis.whole_record.free_decay import Pole, mode_poles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.comparison import Comparison
    from analysis.whole_record.unknowns import Unknowns


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Residual, prediction minus measurement, and its derivatives at one point.

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
    """A linearisation whitened, with what free decay explains taken out.

    Attributes
    ----------
    residual : ndarray of complex, shape (K,)
        Real and imaginary parts of variance 1 where the noise is as assumed.
    jacobian : ndarray of complex, shape (k, K)
    amplitudes : ndarray, shape (m,)
        Of the free decays, in N·m, at the first sample compared.
    amplitude_gram : ndarray, shape (m, m)
        Inverse covariance of the amplitudes.
    """

    residual: NDArray[np.complex128]
    jacobian: NDArray[np.complex128]
    amplitudes: NDArray[np.float64]
    amplitude_gram: NDArray[np.float64]

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(np.vdot(self.residual, self.residual).real)

    def normal_equations(self) -> NormalEquations:
        """As the descent wants them."""
        jacobian = _parts(self.jacobian)
        return NormalEquations(
            cost=self.cost,
            gradient=jacobian @ _parts(self.residual),
            hessian=jacobian @ jacobian.T,
        )


class Objective:
    """Sum of squares of one structure on one record, as a function of the unknowns.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    """

    __slots__ = ("_recent", "comparison", "unknowns")

    def __init__(self, comparison: Comparison, unknowns: Unknowns) -> None:
        self.comparison = comparison
        self.unknowns = unknowns
        self._recent: Recent[Linearisation] = Recent()

    def linearise(self, x: NDArray[np.float64]) -> Linearisation:
        """Residual and derivatives at `x`; the last two points cost nothing again."""
        return self._recent.at(x, self._linearise)

    def _linearise(self, x: NDArray[np.float64]) -> Linearisation:
        comparison, unknowns = self.comparison, self.unknowns
        plant, names = unknowns.plant(x), unknowns.gradient_names
        torque, gradient = comparison.prediction.torque(plant, names)
        chain = unknowns.gradient_by_unknowns(x)
        poles = tuple(
            Pole(pole.mode, pole.at_rad_s, pole.derivative @ chain)
            for pole in mode_poles(plant, comparison.visible_modes, names)
        )
        residual = comparison.spectrum(torque - comparison.torque_nm[comparison.kept])
        jacobian = (chain.T @ _parts(comparison.spectrum(gradient))).view(np.complex128)
        if comparison.drag is not None:
            change, slopes = comparison.drag.beside(plant, poles, unknowns.names, chain)
            residual += change
            jacobian += slopes
        return Linearisation(
            residual=residual,
            jacobian=jacobian,
            poles=poles,
            columns=comparison.nuisance(poles),
        )

    def project(self, at: Linearisation, weight: NDArray[np.float64] | float) -> Projected:
        """Whiten, and take out what free decay explains (variable projection).

        The amplitudes that fit best at each point are linear in the residual; the Jacobian is
        Kaufman's (BIT 15 (1975) 49-57), with the poles' motion.

        Parameters
        ----------
        at : Linearisation
        weight : ndarray, shape (K,), or float
            That of `Noise`, or 1 not to whiten.
        """
        residual, jacobian = at.residual * weight, at.jacobian * weight
        if not len(at.columns):
            return Projected(residual, jacobian, np.zeros(0), np.zeros((0, 0)))
        columns = _parts(at.columns * weight)
        scale = np.sqrt(np.einsum("ij,ij->i", columns, columns))
        scale[scale == 0] = 1.0  # a decay that is over at once
        columns /= scale[:, None]
        gram = columns @ columns.T
        inverse = np.linalg.inv(gram + 1e-12 * np.eye(scale.size))
        amplitudes = -inverse @ (columns @ _parts(residual))
        jacobian += weight * self.comparison.decays.gradient(at.poles, amplitudes / scale)
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
        """Sum of squares at `x`, with what a Gauss-Newton step needs."""
        return self.project(self.linearise(x), weight).normal_equations()


def _parts(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Real and imaginary parts side by side, shape (..., 2 K), of the same memory.

    Products of these are the real parts of those of the complex values, at half the price.
    """
    parts: NDArray[np.float64] = np.ascontiguousarray(values).view(np.float64)
    return parts
