"""Fit of the damping structures to a measured frequency response: the paper's cost, Eq. (26).

``J = sum_p W_p |G_exp(j omega_p) - Ĝ(j omega_p)|²`` with complex deviations and the weights of
`analysis.weights`. Its minimum is sought over the whole range of physical damping, without a guess
from the user: a coarse sweep of all unknowns, descents from each of its hollows on a few hundred
points that stand for all, and the best few of these polished on every point.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.descent import Box, Minimum, NormalEquations, descend
from analysis.model import FrequencyResponseModel
from analysis.recent import Recent
from analysis.spread import sandwich_covariance
from analysis.starts import starts
from analysis.structures import PARAMETERS, STRUCTURES, Structure
from analysis.thinning import thinned
from analysis.unknowns import Unknowns
from analysis.weights import Weighting, weighting_name, weights
from rigd.beam import Beam, Damping

_THINNED_POINTS: Final = 800
_POLISHED: Final = 3
_THINNED_TOLERANCE: Final = 1e-5
_POLISHED_TOLERANCE: Final = 1e-12
# Descents that end this close to each other, in every unknown, have found the same minimum.
_SAME_MINIMUM: Final = 0.02


class FitError(ValueError):
    """A frequency response to which no model can be fitted."""


@dataclass(frozen=True, slots=True)
class FrfFit:
    """One structure fitted with one weighting.

    Attributes
    ----------
    structure : Structure
    weighting : str
        Name of the weighting.
    damping : Damping
        What was found, ready for `rigd.beam`.
    parameters : dict
        zeta, alpha, gamma and lambda, the fixed ones included.
    std : dict or None
        Standard deviations of the same, 0 for the fixed ones; None if a parameter rests on the
        edge of its range or the data do not determine it. Computed as if all that the model
        leaves unexplained were chance, so no confidence intervals: see `analysis.spread`.
    cost : float
        Eq. (26) at the minimum, in (N·m/rad)².
    at_bounds : tuple of str
        Free parameters that rest on the edge of the range searched.
    """

    structure: Structure
    weighting: str
    damping: Damping
    parameters: dict[str, float]
    std: dict[str, float] | None
    cost: float
    at_bounds: tuple[str, ...]


def fit_frf(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    beam: Beam,
    structure: Structure,
    weighting: Weighting = "const",
    *,
    tool_inertia_kg_m2: float = 0.0,
) -> FrfFit:
    """Find the global minimum of Eq. (26) for one structure and weighting.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Positive, increasing, evenly spaced.
    response : ndarray of complex, shape (n,)
        Measured torque per motor angle in N·m/rad, free of the delays of the instruments.
    beam : Beam
        Held fixed.
    structure : Structure
    weighting : str or callable
        See `analysis.weights.weights`.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, added to the model.

    Raises
    ------
    FitError
        If the response holds fewer points than unknowns, or values that are not finite.
    WeightingError
        If there is no such weighting.
    """
    (fit,) = fit_many(
        frequency_hz,
        response,
        beam,
        [structure],
        [weighting],
        tool_inertia_kg_m2=tool_inertia_kg_m2,
    )
    return fit


def fit_many(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    beam: Beam,
    structures: Iterable[Structure] = tuple(STRUCTURES.values()),
    weightings: Iterable[Weighting] = ("const", "omega"),
    *,
    tool_inertia_kg_m2: float = 0.0,
) -> tuple[FrfFit, ...]:
    """Fit every structure with every weighting, structure by structure: see `fit_frf`.

    Each fit comes out as it would alone; what they share is the work of preparing the grids.
    """
    structures, weightings = tuple(structures), tuple(weightings)
    _check(frequency_hz, response, structures)
    omega = 2 * np.pi * frequency_hz
    whole_model = FrequencyResponseModel(frequency_hz, beam, tool_inertia_kg_m2)
    grids: list[tuple[_Grid, _Grid]] = []
    for weighting in weightings:
        every = weights(omega, weighting)
        index, share = thinned(response, every, _THINNED_POINTS)
        few_model = FrequencyResponseModel(frequency_hz[index], beam, tool_inertia_kg_m2)
        grids.append(
            (_Grid(few_model, response[index], share), _Grid(whole_model, response, every))
        )
    return tuple(
        _fit(structure, weighting_name(weighting), few, whole)
        for structure in structures
        for weighting, (few, whole) in zip(weightings, grids, strict=True)
    )


_Linearised = tuple[NDArray[np.complex128], NDArray[np.complex128]]


@dataclass(frozen=True, slots=True)
class _Grid:
    """Points at which model and measurement are compared."""

    model: FrequencyResponseModel
    measured: NDArray[np.complex128]
    weights: NDArray[np.float64]


class _Problem:
    """Eq. (26) for one structure on one grid, as a function of the unknowns."""

    def __init__(self, unknowns: Unknowns, grid: _Grid) -> None:
        self.unknowns = unknowns
        self.grid = grid
        self._recent: Recent[_Linearised] = Recent()

    def cost(self, x: NDArray[np.float64]) -> float:
        deviation = self.grid.model.evaluate(self.unknowns.damping(x)) - self.grid.measured
        return float(self.grid.weights @ (deviation.real**2 + deviation.imag**2))

    def deviation_and_jacobian(self, x: NDArray[np.float64]) -> _Linearised:
        """Model minus measurement, shape (n,), and its derivatives by the unknowns, (k, n)."""
        return self._recent.at(x, self._linearise)

    def _linearise(self, x: NDArray[np.float64]) -> _Linearised:
        model, gradient = self.grid.model.evaluate_with_gradient(
            self.unknowns.damping(x), self.unknowns.structure.free
        )
        jacobian = self.unknowns.derivative_of_parameters(x).T @ gradient
        return model - self.grid.measured, jacobian

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        deviation, jacobian = self.deviation_and_jacobian(x)
        weighted = jacobian.conj() * self.grid.weights
        return NormalEquations(
            cost=float(self.grid.weights @ (deviation.real**2 + deviation.imag**2)),
            gradient=(weighted @ deviation).real,
            hessian=(weighted @ jacobian.T).real,
        )


def _fit(structure: Structure, weighting: str, few: _Grid, whole: _Grid) -> FrfFit:
    unknowns = Unknowns.of(structure, whole.model.beam)
    bounds = Box(*unknowns.bounds)
    thin, full = _Problem(unknowns, few), _Problem(unknowns, whole)
    found = [
        descend(
            thin.normal_equations, x, bounds, relative_tolerance=_THINNED_TOLERANCE, learns=False
        )
        for x in starts(structure, thin.cost)
    ]
    # To the bottom of the few points first, and on with the Hessian learnt there: that leaves one
    # or two steps on every point.
    polished = _different(
        [_polished(thin, rough, bounds) for rough in _different(found)[:_POLISHED]]
    )
    polished = [_polished(full, rough, bounds) for rough in polished]
    best = min(polished, key=lambda minimum: minimum.cost)
    parameters = unknowns.parameters(best.x)
    on_edge = (best.x <= bounds.lower) | (best.x >= bounds.upper)
    return FrfFit(
        structure=structure,
        weighting=weighting,
        damping=unknowns.damping(best.x),
        parameters={name: parameters[name] for name in PARAMETERS},
        std=None if on_edge.any() else _standard_deviations(full, best.x),
        cost=best.cost,
        at_bounds=tuple(name for name, held in zip(structure.free, on_edge, strict=True) if held),
    )


def _polished(problem: _Problem, rough: Minimum, bounds: Box) -> Minimum:
    """Descend to the bottom from where a rougher descent ended."""
    return descend(
        problem.normal_equations,
        rough.x,
        bounds,
        relative_tolerance=_POLISHED_TOLERANCE,
        second_part=rough.second_part,
    )


def _different(found: list[Minimum]) -> list[Minimum]:
    """Minima that differ, the lowest first."""
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        if all(np.abs(minimum.x - other.x).max() > _SAME_MINIMUM for other in kept):
            kept.append(minimum)
    return kept


def _standard_deviations(problem: _Problem, x: NDArray[np.float64]) -> dict[str, float] | None:
    deviation, jacobian = problem.deviation_and_jacobian(x)
    covariance = sandwich_covariance(deviation, jacobian, problem.grid.weights)
    if covariance is None:
        return None
    derivative = problem.unknowns.derivative_of_parameters(x)
    variance = np.diag(derivative @ covariance @ derivative.T)
    free = dict(zip(problem.unknowns.structure.free, variance, strict=True))
    return {name: math.sqrt(max(float(free.get(name, 0.0)), 0.0)) for name in PARAMETERS}


def _check(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    structures: tuple[Structure, ...],
) -> None:
    needed = max((len(structure.free) for structure in structures), default=0)
    if frequency_hz.size < max(needed, 3):
        raise FitError(
            f"The band holds {frequency_hz.size} points of the frequency response, too few for "
            f"{needed} unknowns; widen the band."
        )
    if not (np.isfinite(response).all() and frequency_hz[0] > 0):
        raise FitError(
            "The frequency response must be finite and start above 0 Hz to be fitted; "
            "choose a band in which the input was excited."
        )
