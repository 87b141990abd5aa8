"""The sum of squares that is minimised: Eq. (26) with the model as the estimator sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import NormalEquations, Recent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify import Unknowns
    from analysis.welch_aware.comparison import Comparison

    _Linearised = tuple[NDArray[np.complex128], NDArray[np.complex128]]


class Objective:
    """Eq. (26) of one structure and one measured response, as a function of the unknowns.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    """

    __slots__ = ("_recent", "comparison", "unknowns")

    def __init__(self, comparison: Comparison, unknowns: Unknowns) -> None:
        self.comparison = comparison
        self.unknowns = unknowns
        self._recent: Recent[_Linearised] = Recent()

    def linearise(self, x: NDArray[np.float64]) -> _Linearised:
        """Model minus measurement, shape (K,), and its derivatives by the unknowns, (k, K)."""
        return self._recent.at(x, self._linearise)

    def _linearise(self, x: NDArray[np.float64]) -> _Linearised:
        unknowns = self.unknowns
        response, gradient = self.comparison.response(unknowns.plant(x), unknowns.gradient_names)
        return (
            response - self.comparison.measured,
            unknowns.gradient_by_unknowns(x).T @ gradient,
        )

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Cost at `x`, with what a Gauss-Newton step needs."""
        deviation, jacobian = self.linearise(x)
        weighted = jacobian.conj() * self.comparison.weights
        return NormalEquations(
            cost=float(self.comparison.weights @ (deviation.real**2 + deviation.imag**2)),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )
