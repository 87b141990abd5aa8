"""Where the descents on the whole record start: fits of a coarse frequency response.

The ratio of the whole record's two transforms is exact but for what rings before and after it. A
few hundred of its points, densest at the resonances, tell the minima apart in a hundredth of the
time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.levenberg_marquardt import Minimum, NormalEquations, minimise
from analysis.starts import starts
from analysis.thinning import thinned
from analysis.whole_record.response import ResponseGrid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.comparison import Comparison
    from analysis.whole_record.plant import Plant
    from analysis.whole_record.unknowns import Unknowns

_POINTS: Final = 400
_TOLERANCE: Final = 3e-3
_SAME_MINIMUM: Final = 0.05
"""Minima whose plants differ by less than this share of the cost are one."""

_SCANS: Final = {"density_over_stiffness": np.linspace(-0.3, 0.3, 61)}
_OFFSET_SCAN: Final = np.linspace(-0.1, 0.1, 41)
_MAX_EVALUATIONS: Final = 60
_MODERATE: Final = {"zeta": -4.5, "alpha": 1.0, "gamma": -3.0, "lambda": 1.0}
"""Damping for these scans, as `analysis.starts` gives it."""


class RoughResponse:
    """Few points of the whole record's frequency response, with their weights."""

    __slots__ = ("_measured", "_response", "_weights")

    def __init__(self, comparison: Comparison) -> None:
        length = comparison.angle_rad.size
        hz = np.fft.rfftfreq(length, 1 / comparison.decimation.rate_hz)
        first, last = comparison.frequency_hz[[0, -1]]
        band = np.flatnonzero((hz >= first) & (hz <= last))
        angle = np.fft.rfft(comparison.angle_rad)[band]
        torque = np.fft.rfft(comparison.torque_nm)[band]
        power = angle.real**2 + angle.imag**2
        excited = power > 1e-12 * power.max()
        response, weights = torque[excited] / angle[excited], power[excited]
        index, self._weights = thinned(response, weights / weights.sum(), _POINTS)
        self._measured = response[index]
        self._response = ResponseGrid(2j * np.pi * hz[band][excited][index])

    def cost(self, plant: Plant) -> float:
        """Weighted mean square of the deviation, in (N·m/rad)²."""
        return self._mean_square(self._response.evaluate(plant)[0] - self._measured)

    def distance(self, one: Plant, other: Plant) -> float:
        """Weighted mean square of the difference between two plants."""
        return self._mean_square(
            self._response.evaluate(one)[0] - self._response.evaluate(other)[0]
        )

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


def rough_minima(rough: RoughResponse, unknowns: Unknowns) -> list[Minimum]:
    """Different minima of the rough response's cost, the lowest first."""
    lower, upper = unknowns.bounds
    shift = _shift_of_resonances(rough, unknowns)

    def start(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
        vector: NDArray[np.float64] = unknowns.start(sizes) + shift
        return vector

    found = [
        minimise(
            lambda x: rough.normal_equations(unknowns, x),
            start(sizes),
            lower,
            upper,
            relative_tolerance=_TOLERANCE,
            max_evaluations=_MAX_EVALUATIONS,
        )
        for sizes in starts(
            unknowns.structure, lambda sizes: rough.cost(unknowns.plant(start(sizes)))
        )
    ]
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        plant = unknowns.plant(minimum.x)
        if all(
            rough.distance(plant, unknowns.plant(other.x)) > _SAME_MINIMUM * other.cost
            for other in kept
        ):
            kept.append(minimum)
    return kept


def _shift_of_resonances(rough: RoughResponse, unknowns: Unknowns) -> NDArray[np.float64]:
    """Find what brings the resonances of a vector of unknowns to where they are, shape (k,).

    With a resonance off by more than it is wide, no descent would find it: all of them by rho/EI,
    then one by one where modes have offsets of their own.
    """
    moderate = unknowns.start(np.array([_MODERATE[name] for name in unknowns.structure.free]))
    shift = np.zeros(moderate.size)
    for place, name in enumerate(unknowns.names):
        if name in _SCANS or name in unknowns.offsets:
            steps = _SCANS.get(name, _OFFSET_SCAN)
            costs = []
            for step in steps:
                shift[place] = step
                costs.append(rough.cost(unknowns.plant(moderate + shift)))
            shift[place] = steps[int(np.argmin(costs))]
    return shift
