"""The sum of squares that is minimised: Eq. (26) with the model as the estimator sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.levenberg_marquardt import NormalEquations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.welch_aware.comparison import Comparison
    from analysis.whole_record.unknowns import Unknowns


class Objective:
    """Eq. (26) of one structure and one measured response, as a function of the unknowns.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    """

    __slots__ = ("comparison", "unknowns")

    def __init__(self, comparison: Comparison, unknowns: Unknowns) -> None:
        self.comparison = comparison
        self.unknowns = unknowns

    def linearise(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Model minus measurement, shape (K,), and its derivatives by the unknowns, (k, K)."""
        unknowns = self.unknowns
        response, gradient = self.comparison.response(unknowns.plant(x), unknowns.gradient_names)
        return (
            response - self.comparison.measured,
            unknowns.gradient_by_unknowns(x).T @ gradient,
        )

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Cost at `x`, with what a Gauss-Newton step needs."""
        deviation, jacobian = self.linearise(x)
        weights = self.comparison.weights
        weighted = jacobian.conj() * weights
        return NormalEquations(
            cost=float(weights @ (deviation.real**2 + deviation.imag**2)),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )
