"""Search for the lowest minimum of one structure: coarse response first, then the whole record.

The ratio of the whole record's two transforms (the empirical transfer function estimate) is exact
except for ringing before and after the record. A few hundred of its points, densest at the
resonances, distinguish the minima in a hundredth of the time. The descents on the whole record
start at its minima.
"""

from __future__ import annotations

import itertools
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._hum import hum_near_modes, resonance_reach_hz
from analysis.identify._predictor import ResponseGrid
from analysis.identify._problem import Objective
from analysis.identify.free_decay import decay_columns
from analysis.identify.noise import NoiseSpectrum, noise_of
from analysis.identify.parametrization import Steps
from analysis.optimizer import NormalEquations, descend
from analysis.paper import thinned

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._hum import Hum
    from analysis.identify._plant import Plant
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import Minimum


# Resonances

_SCAN: Final = np.linspace(-0.5, 0.5, 101)
_MODERATE: Final = {"zeta": -4.5, "alpha": 1.0, "gamma": -3.0, "lambda": 1.0}
"""Damping for these scans, as `Unknowns.start` takes it."""


def resonance_shift(cost: Callable[[Plant], float], unknowns: Unknowns) -> NDArray[np.float64]:
    """Return the shift of the unknowns that aligns the resonances, shape (k,).

    If a resonance is off by more than its width, no descent finds it.

    Parameters
    ----------
    cost : callable
        Cost of a plant, on few points of a frequency response.
    unknowns : Unknowns
    """
    moderate = unknowns.start(np.array([_MODERATE[name] for name in unknowns.structure.free]))
    shift = np.zeros(moderate.size)
    if "density_over_stiffness" in unknowns.names:
        index = unknowns.names.index("density_over_stiffness")
        costs = []
        for step in _SCAN:
            shift[index] = step
            costs.append(cost(unknowns.plant(moderate + shift)))
        shift[index] = _SCAN[int(np.argmin(costs))]
    return shift


# Coarse response

_POINTS: Final = 400
_TOLERANCE: Final = 1e-2
_SAME_MINIMUM: Final = 0.05
"""Minima whose plants differ by less than this fraction of the cost are one."""

_MAX_EVALUATIONS: Final = 60
_SIZES: Final = {name: tuple(np.log([1e-4, 1e-3, 1e-2, 1e-1])) for name in ("zeta", "gamma")}
"""Relative to stiffness and to inertia at a mode: about twice a damping ratio."""

_ORDERS: Final = (0.5, 1.5)


class CoarseResponse:
    """Some points of the whole record's frequency response, with their weights."""

    __slots__ = ("_costs", "_frequency_hz", "_measured", "_response", "_weights")

    def __init__(self, comparison: Comparison) -> None:
        length = comparison.angle_rad.size
        hz = np.fft.rfftfreq(length, 1 / comparison.decimation.rate_hz)
        first, last = comparison.frequency_hz[[0, -1]]
        band = np.flatnonzero((hz >= first) & (hz <= last))
        angle = np.fft.rfft(comparison.angle_rad)[band]
        torque = np.fft.rfft(comparison.torque_nm)[band]
        # Without excitation the motor moved with the noise: such bins show no response.
        given = np.fft.rfft(comparison.coherent_rad())[band]
        power = given.real**2 + given.imag**2
        excited = power > 1e-12 * power.max()
        response, weights = torque[excited] / angle[excited], power[excited]
        index, self._weights = thinned(response, weights / weights.sum(), _POINTS)
        self._measured = response[index]
        self._frequency_hz = hz[band][excited][index]
        self._response = ResponseGrid(2j * np.pi * self._frequency_hz)
        self._costs: dict[Plant, float] = {}

    def whitened(self, noise: NoiseSpectrum, frequency_hz: NDArray[np.float64]) -> CoarseResponse:
        """Return the same points with their weights under a noise.

        Parameters
        ----------
        noise : Noise
        frequency_hz : ndarray, shape (K,)
            Its bins.
        """
        weight = np.interp(self._frequency_hz, frequency_hz, noise.weight**2)
        other = copy(self)
        other._weights = self._weights * weight / (self._weights @ weight)
        other._costs = {}
        return other

    def cost(self, plant: Plant) -> float:
        """Return the weighted mean square of the deviation, in (N·m/rad)²."""
        # Cached: structures that differ only in the free parameters are scanned at the same plants.
        if plant not in self._costs:
            deviation = self._response.evaluate(plant)[0] - self._measured
            self._costs[plant] = self._mean_square(deviation)
        return self._costs[plant]

    def distance(self, one: Plant, other: Plant) -> float:
        """Return the weighted mean square of the difference between two plants."""
        return self._mean_square(
            self._response.evaluate(one)[0] - self._response.evaluate(other)[0]
        )

    def alike(self, one: Plant, other: Plant) -> bool:
        """Return whether two plants belong to the same minimum."""
        return self.distance(one, other) <= _SAME_MINIMUM * min(self.cost(one), self.cost(other))

    def normal_equations(self, unknowns: Unknowns, x: NDArray[np.float64]) -> NormalEquations:
        """Return the cost and its derivatives by the unknowns."""
        plant, chain = unknowns.plant_and_gradient(x)
        response, *gradient = self._response.evaluate(plant, unknowns.gradient_names)
        deviation = response - self._measured
        jacobian = chain.T @ np.array(gradient)
        weighted = jacobian.conj() * self._weights
        return NormalEquations(
            cost=self._mean_square(deviation),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )

    def _mean_square(self, deviation: NDArray[np.complex128]) -> float:
        return float(self._weights @ (deviation.real**2 + deviation.imag**2))


def initial_guesses(coarse: CoarseResponse, unknowns: Unknowns) -> list[NDArray[np.float64]]:
    """Return points from which descents lead to all relevant minima, each of shape (k,).

    The first is the best fit with all orders 1, which most materials and air come close to. The
    others have the same losses with different orders.
    """
    shift = resonance_shift(coarse.cost, unknowns)
    sizes = [_SIZES.get(name, (1.0,)) for name in unknowns.structure.free]
    found = [unknowns.start(np.array(point)) + shift for point in itertools.product(*sizes)]
    first = min(found, key=lambda x: coarse.cost(unknowns.plant(x)))
    points = [first]
    orders = [i for i, name in enumerate(unknowns.names) if name in ("alpha", "lambda")]
    for values in itertools.product(_ORDERS, repeat=len(orders)) if orders else ():
        point = first.copy()
        point[orders] = values
        points.append(point)
    return points


def coarse_minima(
    coarse: CoarseResponse, unknowns: Unknowns, points: Iterable[NDArray[np.float64]]
) -> list[Minimum]:
    """Return the distinct minima of the coarse cost from some points, the lowest first."""
    steps = Steps.of(unknowns)
    found = [
        descend(
            lambda x: coarse.normal_equations(unknowns, x),
            point,
            steps,
            relative_tolerance=_TOLERANCE,
            max_evaluations=_MAX_EVALUATIONS,
        )
        for point in points
    ]
    distinct: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        plant = unknowns.plant(minimum.x)
        if not any(coarse.alike(plant, unknowns.plant(other.x)) for other in distinct):
            distinct.append(minimum)
    return distinct


# Descents on the whole record

_BETWEEN_RIVALS: Final = 1e-2
"""Relative tolerance that decides which of several minima is lower."""

_RIVALS: Final = 2
_NO_RIVAL: Final = 1.5
"""A coarse minimum whose cost is larger than the lowest one's by this factor is not gone after."""

_CLEARLY: Final = 0.9
"""Cost, relative to the end of a descent, below which another coarse minimum is refined."""

_MOST_MINIMA: Final = 4
RENEWALS: Final = 4
"""Limit of re-estimates of the angle that follows the reference."""

_HUM_SEARCHES: Final = 3
"""Number of searches for hum: the first fit attributed part of it to the beam."""


@dataclass(frozen=True, slots=True)
class Descent:
    """State of the descent of one structure."""

    objective: Objective
    x: NDArray[np.float64]

    @property
    def plant(self) -> Plant:
        """Return the plant at this point."""
        return self.objective.unknowns.plant(self.x)

    def to_minimum(
        self, noise: NoiseSpectrum, tolerance: float, hopeless: tuple[int, float] | None = None
    ) -> Descent:
        """Descend to the minimum under a noise spectrum.

        Parameters
        ----------
        noise : Noise
        tolerance : float
            Relative, of the sum of squares.
        hopeless : tuple of int and float, optional
            Argument of `descend`.
        """
        region = Steps.of(self.objective.unknowns)
        objective, minimum = self.objective.minimum(
            self.x, noise.weight, region, relative_tolerance=tolerance, hopeless=hopeless
        )
        return Descent(objective, minimum.x)

    def cost(self, noise: NoiseSpectrum) -> float:
        """Return the sum of squares here under a noise spectrum."""
        return self.objective.normal_equations(self.x, noise.weight).cost

    def renewed(self, noise: NoiseSpectrum, tolerance: float) -> Descent:
        """Re-estimate the angle that follows the reference until it converges.

        Return `self` if it has converged.
        """
        here = self
        for _ in range(RENEWALS):
            comparison = here.objective.comparison.renewed(here.plant, noise)
            if comparison is here.objective.comparison:
                break
            here = Descent(Objective(comparison, here.objective.unknowns), here.x)
            noise = here.noise()
            here = here.to_minimum(noise, tolerance)
        return here

    def hum(self) -> tuple[Hum, ...]:
        """Search for narrow-band disturbances near the modes of the current beam."""
        comparison = self.objective.comparison
        at, noise = self.objective.linearise(self.x), self.noise()
        amplitudes = self.objective.project(at, noise.weight).amplitudes
        decays = decay_columns(at.poles) * (1 + len(comparison.later_decays))
        decaying_nm = comparison.in_time(amplitudes[:decays] @ at.columns[:decays])
        return hum_near_modes(comparison, self.plant, at.poles, noise, decaying_nm)

    def without_hum(self, tolerance: float) -> Descent:
        """Remove the hum near modes and descend again; return `self` if there is none."""
        here = self
        for _ in range(_HUM_SEARCHES):
            hum = here.hum()
            if not hum:
                return self
            objective = Objective(
                here.objective.comparison.without_hum(hum), here.objective.unknowns
            )
            here = Descent(objective, here.x)
            here = here.to_minimum(here.noise(), tolerance)
        return here

    def noise(self, *, with_lines: bool = False) -> NoiseSpectrum:
        """Return the noise of the residual here without the free decay."""
        objective, comparison = self.objective, self.objective.comparison
        at = objective.linearise(self.x)
        near_mode = None
        if with_lines:
            hz = comparison.frequency_hz
            near_mode = np.zeros(hz.size, dtype=bool)
            for pole in at.poles:
                width = resonance_reach_hz(pole, float(hz[1] - hz[0]))
                near_mode |= np.abs(hz - abs(pole.at_rad_s.imag) / (2 * np.pi)) < width
        return noise_of(
            objective.project(at, 1.0).residual,
            comparison.frequency_hz,
            comparison.samples,
            comparison.measurement.known_torque_fraction,
            near_mode,
        )


@dataclass(frozen=True, slots=True)
class StructureSearch:
    """Search for the minima of one structure on one record.

    Attributes
    ----------
    objective : Objective
    coarse : CoarseResponse
    first : ndarray, shape (k,)
        Minimum with orders of 1.
    minima : list of Minimum
        Minima of the coarse response, noise taken as white; the lowest first.
    """

    objective: Objective
    coarse: CoarseResponse
    first: NDArray[np.float64]
    minima: list[Minimum]

    @classmethod
    def of(cls, objective: Objective, coarse: CoarseResponse) -> StructureSearch:
        """Search the whole range of the unknowns on the coarse response."""
        starts = initial_guesses(coarse, objective.unknowns)
        return cls(objective, coarse, starts[0], coarse_minima(coarse, objective.unknowns, starts))

    @property
    def unknowns(self) -> Unknowns:
        """Return the unknowns of the search."""
        return self.objective.unknowns

    def on(self, comparison: Comparison) -> StructureSearch:
        """Return the search on another comparison, with the same starts."""
        return replace(self, objective=Objective(comparison, self.unknowns))

    def lowest(self) -> Descent:
        """Return the point where the coarse response has its lowest cost."""
        return Descent(self.objective, self.minima[0].x)

    def under(self, noise: NoiseSpectrum, near: Descent | None = None) -> Descent:
        """Descend to the lowest minimum of the whole record.

        Under another noise another minimum may be the lowest. So all are compared again on the
        coarse response, which is cheap, and the best few are refined.

        Parameters
        ----------
        noise : Noise
        near : Descent, optional
            Descent at a known minimum.
        """
        coarse = self.coarse.whitened(noise, self.objective.comparison.frequency_hz)
        points = [minimum.x for minimum in self.minima[:_MOST_MINIMA]]
        found = coarse_minima(coarse, self.unknowns, [*points, self.first])
        rivals = [
            Descent(self.objective, minimum.x)
            for minimum in found[:_RIVALS]
            if minimum.cost < _NO_RIVAL * found[0].cost
        ]
        if near is not None:
            plant = self.unknowns.plant(near.x)
            rivals = [near] + [
                rival
                for rival in rivals
                if not coarse.alike(plant, self.unknowns.plant(rival.x))
                and coarse.cost(self.unknowns.plant(rival.x)) < _CLEARLY * coarse.cost(plant)
            ]
        if len(rivals) == 1:
            return rivals[0]
        ends = [rival.to_minimum(noise, _BETWEEN_RIVALS) for rival in rivals]
        return min(ends, key=lambda end: end.cost(noise))
