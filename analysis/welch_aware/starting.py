"""Where the descents start: fits that take Welch's estimate for the response itself.

They are wrong by what the windows do, which is what a descent mends; but they tell the minima
apart in a hundredth of the time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify import Box, Minimum, NormalEquations, ResponseGrid, descend, resonance_shift
from analysis.paper import starts, thinned

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify import Plant, Unknowns

_POINTS: Final = 400
_TOLERANCE: Final = 1e-2
_MAX_EVALUATIONS: Final = 40
_MOST: Final = 3
_SAME_MINIMUM: Final = 0.05
"""Minima that lie closer in every unknown are one; a change of 1 is large."""


class PlainResponse:
    """Few points of a measured frequency response, with their weights.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
    measured : ndarray of complex, shape (n,)
    weights : ndarray, shape (n,)
        Of sum 1.
    """

    __slots__ = ("_grid", "_measured", "_weights")

    def __init__(
        self,
        frequency_hz: NDArray[np.float64],
        measured: NDArray[np.complex128],
        weights: NDArray[np.float64],
    ) -> None:
        index, self._weights = thinned(measured, weights, _POINTS)
        self._measured = measured[index]
        self._grid = ResponseGrid(2j * np.pi * frequency_hz[index])

    def cost(self, plant: Plant) -> float:
        """Weighted mean square of the deviation, in (N·m/rad)²."""
        deviation = self._grid.evaluate(plant)[0] - self._measured
        return float(self._weights @ (deviation.real**2 + deviation.imag**2))

    def normal_equations(self, unknowns: Unknowns, x: NDArray[np.float64]) -> NormalEquations:
        """Compute the same with its derivatives by the unknowns."""
        response, *gradient = self._grid.evaluate(unknowns.plant(x), unknowns.gradient_names)
        deviation = response - self._measured
        jacobian = unknowns.gradient_by_unknowns(x).T @ np.array(gradient)
        weighted = jacobian.conj() * self._weights
        return NormalEquations(
            cost=float(self._weights @ (deviation.real**2 + deviation.imag**2)),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )


def starting_points(plain: PlainResponse, unknowns: Unknowns) -> list[NDArray[np.float64]]:
    """Choose where to start: the lowest few minima of a plain fit, the lowest first.

    With free modes that of the uniform beam follows, whose cost must not be exceeded.
    """
    found = [minimum.x for minimum in _minima(plain, unknowns)[:_MOST]]
    if unknowns.offsets:
        uniform = _minima(plain, replace(unknowns, offsets=()))[0]
        found.append(np.concatenate((uniform.x, np.zeros(len(unknowns.offsets)))))
    return found


def _minima(plain: PlainResponse, unknowns: Unknowns) -> list[Minimum]:
    """Different minima, the lowest first."""
    bounds = Box(*unknowns.bounds)
    shift = resonance_shift(plain.cost, unknowns)
    found = [
        descend(
            lambda x: plain.normal_equations(unknowns, x),
            unknowns.start(sizes) + shift,
            bounds,
            relative_tolerance=_TOLERANCE,
            learns=False,
            max_evaluations=_MAX_EVALUATIONS,
        )
        for sizes in starts(
            unknowns.structure,
            lambda sizes: plain.cost(unknowns.plant(unknowns.start(sizes) + shift)),
        )
    ]
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        if all(np.abs(minimum.x - other.x).max() > _SAME_MINIMUM for other in kept):
            kept.append(minimum)
    return kept
