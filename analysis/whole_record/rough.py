"""Where the descents on the whole record start: fits of a coarse frequency response.

The ratio of the whole record's two transforms is exact but for what rings before and after it. A
few hundred of its points, densest at the resonances, tell the minima apart in a hundredth of the
time.
"""

from __future__ import annotations

import itertools
from copy import copy
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.descent import NormalEquations, descend
from analysis.thinning import thinned
from analysis.whole_record.resonance_shift import resonance_shift
from analysis.whole_record.response import ResponseGrid
from analysis.whole_record.steps import Steps

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.descent import Minimum
    from analysis.whole_record.comparison import Comparison
    from analysis.whole_record.noise import Noise
    from analysis.whole_record.plant import Plant
    from analysis.whole_record.unknowns import Unknowns

_POINTS: Final = 400
_TOLERANCE: Final = 1e-2
_SAME_MINIMUM: Final = 0.05
"""Minima whose plants differ by less than this share of the cost are one."""

_MAX_EVALUATIONS: Final = 60
_SIZES: Final = {name: tuple(np.log([1e-4, 1e-3, 1e-2, 1e-1])) for name in ("zeta", "gamma")}
"""Relative to stiffness and to inertia at a mode: about twice a damping ratio."""

_ORDERS: Final = (0.5, 1.5)


class RoughResponse:
    """Few points of the whole record's frequency response, with their weights."""

    __slots__ = ("_frequency_hz", "_measured", "_response", "_weights")

    def __init__(self, comparison: Comparison) -> None:
        length = comparison.angle_rad.size
        hz = np.fft.rfftfreq(length, 1 / comparison.decimation.rate_hz)
        first, last = comparison.frequency_hz[[0, -1]]
        band = np.flatnonzero((hz >= first) & (hz <= last))
        angle = np.fft.rfft(comparison.angle_rad)[band]
        torque = np.fft.rfft(comparison.torque_nm)[band]
        # Where nothing was asked of the motor it moved with the noise: no response is seen there.
        given = np.fft.rfft(comparison.followed_rad())[band]
        power = given.real**2 + given.imag**2
        excited = power > 1e-12 * power.max()
        response, weights = torque[excited] / angle[excited], power[excited]
        index, self._weights = thinned(response, weights / weights.sum(), _POINTS)
        self._measured = response[index]
        self._frequency_hz = hz[band][excited][index]
        self._response = ResponseGrid(2j * np.pi * self._frequency_hz)

    def whitened(self, noise: Noise, frequency_hz: NDArray[np.float64]) -> RoughResponse:
        """Take the same points with the weights that they have under a noise.

        Parameters
        ----------
        noise : Noise
        frequency_hz : ndarray, shape (K,)
            Its bins.
        """
        weight = np.interp(self._frequency_hz, frequency_hz, noise.weight**2)
        other = copy(self)
        other._weights = self._weights * weight / (self._weights @ weight)
        return other

    def cost(self, plant: Plant) -> float:
        """Weighted mean square of the deviation, in (N·m/rad)²."""
        return self._mean_square(self._response.evaluate(plant)[0] - self._measured)

    def distance(self, one: Plant, other: Plant) -> float:
        """Weighted mean square of the difference between two plants."""
        return self._mean_square(
            self._response.evaluate(one)[0] - self._response.evaluate(other)[0]
        )

    def alike(self, one: Plant, other: Plant) -> bool:
        """Whether two plants stand for the same minimum."""
        return self.distance(one, other) <= _SAME_MINIMUM * min(self.cost(one), self.cost(other))

    def normal_equations(self, unknowns: Unknowns, x: NDArray[np.float64]) -> NormalEquations:
        """Compute the same and its derivatives by the unknowns."""
        response, *gradient = self._response.evaluate(unknowns.plant(x), unknowns.gradient_names)
        deviation = response - self._measured
        jacobian = unknowns.gradient_by_unknowns(x).T @ np.array(gradient)
        weighted = jacobian.conj() * self._weights
        return NormalEquations(
            cost=self._mean_square(deviation),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )

    def _mean_square(self, deviation: NDArray[np.complex128]) -> float:
        return float(self._weights @ (deviation.real**2 + deviation.imag**2))


def rough_starts(rough: RoughResponse, unknowns: Unknowns) -> list[NDArray[np.float64]]:
    """Points from which descents lead to all minima of interest, each of shape (k,).

    The damping that fits best with all orders 1, which most materials and air come close to; then
    the same losses with the orders apart.
    """
    shift = resonance_shift(rough.cost, unknowns)
    sizes = [_SIZES.get(name, (1.0,)) for name in unknowns.structure.free]
    found = [unknowns.start(np.array(point)) + shift for point in itertools.product(*sizes)]
    first = min(found, key=lambda x: rough.cost(unknowns.plant(x)))
    points = [first]
    orders = [i for i, name in enumerate(unknowns.names) if name in ("alpha", "lambda")]
    for values in itertools.product(_ORDERS, repeat=len(orders)) if orders else ():
        point = first.copy()
        point[orders] = values
        points.append(point)
    return points


def rough_minima(
    rough: RoughResponse, unknowns: Unknowns, points: Iterable[NDArray[np.float64]]
) -> list[Minimum]:
    """Different minima of the rough response's cost, the lowest first, from some points."""
    steps = Steps.of(unknowns)
    found = [
        descend(
            lambda x: rough.normal_equations(unknowns, x),
            point,
            steps,
            relative_tolerance=_TOLERANCE,
            max_evaluations=_MAX_EVALUATIONS,
        )
        for point in points
    ]
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        plant = unknowns.plant(minimum.x)
        if not any(rough.alike(plant, unknowns.plant(other.x)) for other in kept):
            kept.append(minimum)
    return kept
