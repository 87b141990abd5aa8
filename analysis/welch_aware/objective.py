"""The sum of squares that is minimised: Eq. (26) with the model as the estimator sees it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.levenberg_marquardt import NormalEquations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.welch_aware.comparison import Comparison
    from analysis.whole_record.unknowns import Unknowns

    _Linearised = tuple[NDArray[np.complex128], NDArray[np.complex128]]


_NONE: Final = np.empty(0, dtype=np.complex128)


class Objective:
    """Eq. (26) of one structure and one measured response, as a function of the unknowns.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    """

    __slots__ = ("_lowest", "comparison", "unknowns")

    def __init__(self, comparison: Comparison, unknowns: Unknowns) -> None:
        self.comparison = comparison
        self.unknowns = unknowns
        self._lowest: tuple[bytes, float, _Linearised] = (b"", math.inf, (_NONE, _NONE))

    def linearise(self, x: NDArray[np.float64]) -> _Linearised:
        """Model minus measurement, shape (K,), and its derivatives by the unknowns, (k, K).

        Where the cost was lowest they are kept: a descent goes on from there, and the covariance
        is asked for there. So they are read-only.
        """
        place = x.tobytes()
        if place == self._lowest[0]:
            return self._lowest[2]
        found = self._linearise(x)
        for each in found:
            each.setflags(write=False)
        cost = self._cost(found[0])
        if cost < self._lowest[1]:
            self._lowest = place, cost, found
        return found

    def _linearise(self, x: NDArray[np.float64]) -> _Linearised:
        unknowns = self.unknowns
        response, gradient = self.comparison.response(unknowns.plant(x), unknowns.gradient_names)
        return (
            response - self.comparison.measured,
            unknowns.gradient_by_unknowns(x).T @ gradient,
        )

    def _cost(self, deviation: NDArray[np.complex128]) -> float:
        return float(self.comparison.weights @ (deviation.real**2 + deviation.imag**2))

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Cost at `x`, with what a Gauss-Newton step needs."""
        deviation, jacobian = self.linearise(x)
        weighted = jacobian.conj() * self.comparison.weights
        return NormalEquations(
            cost=self._cost(deviation),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )
