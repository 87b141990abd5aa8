"""Fit of the damping structures to a frequency response: Eq. (26) of the reference paper.

``J = sum_p W_p |G_exp(j omega_p) - Ĝ(j omega_p)|²`` with complex deviations and the weights of
`analysis.models`. Its minimum is searched over the whole range of physical damping, without a guess
from the user: a coarse sweep of all unknowns, descents from each of its local minima on a few
hundred representative points, and refinement of the best few on every point.

The sweep is needed: the cost of types III, V and VI has several minima, and from a random start
type VI falls into the best one in fewer than half of the cases. The reference paper sweeps the
whole range of physical interest finely; here the sweep is coarse (`starts`).

Standard deviations are from the covariance of a weighted least-squares fit, which treats every
deviation of the model from the measurement as random. Their accuracy on simulated sessions with
type VI:

* errors that are independent from bin to bin: within 20 % of the scatter of repeated fits;
* errors shared by the nine neighbours that zero padding makes alike: half of that scatter, since
  a resonance is then narrower than one error and the fit absorbs most of it;
* Welch's estimate of a chirp: leakage, not noise, dominates, and the standard deviations
  are 3 to 50 times the scatter between sessions. The bias itself is 1 to 7 times as large as
  they are, and 4 to 20 times if the structure is wrong.

So they rank parameters by how well the response determines them and are not confidence intervals.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.models import (
    PARAMETERS,
    STRUCTURES,
    DampingUnknowns,
    FrequencyResponseModel,
    Parameter,
    Structure,
    Weighting,
    weighting_name,
    weights,
)
from analysis.optimizer import Box, Minimum, NormalEquations, Recent, descend
from rigd.beam import Beam, Damping

# Fits

_THINNED_POINTS: Final = 800
_POLISHED: Final = 3
_THINNED_TOLERANCE: Final = 1e-5
_POLISHED_TOLERANCE: Final = 1e-12
# Descents that end this close to each other, in every unknown, have found the same minimum.
_SAME_MINIMUM: Final = 0.02


class FitError(ValueError):
    """No model can be fitted to the frequency response."""


@dataclass(frozen=True, slots=True)
class FrfFit:
    """Fit of one structure with one weighting.

    Attributes
    ----------
    structure : Structure
    weighting : str
        Name of the weighting.
    damping : Damping
        Fitted damping, for use with `rigd.beam`.
    parameters : dict
        zeta, alpha, gamma and lambda, the fixed ones included.
    std : dict or None
        Standard deviations of the same, 0 for the fixed ones; None if a parameter rests on the edge
        of its range or the data do not determine it. Computed as if the whole residual were random,
        so they give no confidence intervals: see `analysis.paper._fit`.
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
        See `analysis.models.weights`.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, added to the model.

    Raises
    ------
    FitError
        If the response holds fewer points than unknowns, or values that are not finite.
    WeightingError
        If there is no such weighting.

    References
    ----------
    Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
    Navigation, Eq. 26.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.models import STRUCTURES
    >>> from analysis.paper import fit_frf
    >>> from rigd.beam import Beam, Damping, transfer
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> frequency_hz = np.linspace(0.5, 50, 400)
    >>> response = transfer(2j * np.pi * frequency_hz, beam, Damping(zeta=7e-5, alpha=0.95))
    >>> found = fit_frf(frequency_hz, response, beam, STRUCTURES["IV"])
    >>> print(f"zeta {found.damping.zeta:.3g}, alpha {found.damping.alpha:.4f}")
    zeta 7e-05, alpha 0.9500
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

    Each fit has the same result as alone; only the preparation of the grids is common.

    Parameters
    ----------
    frequency_hz, response, beam, tool_inertia_kg_m2
        As for `fit_frf`.
    structures : iterable of Structure
        By default the six of the reference paper.
    weightings : iterable of str or callable
        By default the two of the reference paper.
    """
    structures, weightings = tuple(structures), tuple(weightings)
    _check(frequency_hz, response, structures)
    omega = 2 * np.pi * frequency_hz
    whole_model = FrequencyResponseModel(frequency_hz, beam, tool_inertia_kg_m2)
    grids: list[tuple[_Grid, _Grid]] = []
    for weighting in weightings:
        every = weights(omega, weighting)
        index, point_weights = thinned(response, every, _THINNED_POINTS)
        few_model = FrequencyResponseModel(frequency_hz[index], beam, tool_inertia_kg_m2)
        grids.append(
            (_Grid(few_model, response[index], point_weights), _Grid(whole_model, response, every))
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


class _FrfProblem:
    """Eq. (26) for one structure on one grid, as a function of the unknowns."""

    def __init__(self, unknowns: DampingUnknowns, grid: _Grid) -> None:
        self.unknowns = unknowns
        self.grid = grid
        self._recent: Recent[_Linearised] = Recent()

    def cost(self, x: NDArray[np.float64]) -> float:
        deviation = self.grid.model.evaluate(self.unknowns.damping(x)) - self.grid.measured
        return float(self.grid.weights @ (deviation.real**2 + deviation.imag**2))

    def deviation_and_jacobian(self, x: NDArray[np.float64]) -> _Linearised:
        """Return model minus measurement, (n,), and its derivatives by the unknowns, (k, n)."""
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
    unknowns = DampingUnknowns.of(structure, whole.model.beam)
    bounds = Box(*unknowns.bounds)
    thin, full = _FrfProblem(unknowns, few), _FrfProblem(unknowns, whole)
    found = [
        descend(thin.normal_equations, x, bounds, relative_tolerance=_THINNED_TOLERANCE)
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


def _polished(problem: _FrfProblem, rough: Minimum, bounds: Box) -> Minimum:
    """Continue to the minimum from the end of a rougher descent."""
    return descend(
        problem.normal_equations,
        rough.x,
        bounds,
        relative_tolerance=_POLISHED_TOLERANCE,
        second_part=rough.second_part,
    )


def _different(found: list[Minimum]) -> list[Minimum]:
    """Return the distinct minima, the lowest first."""
    distinct: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.cost):
        if all(np.abs(minimum.x - other.x).max() > _SAME_MINIMUM for other in distinct):
            distinct.append(minimum)
    return distinct


def _standard_deviations(problem: _FrfProblem, x: NDArray[np.float64]) -> dict[str, float] | None:
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


# Points that stand for all


def thinned(
    measured: NDArray[np.complex128], weights: NDArray[np.float64], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Choose points, densest on the flanks of peaks and under large weights.

    Parameters
    ----------
    measured : ndarray of complex, shape (n,)
    weights : ndarray, shape (n,)
        Weights, of sum 1.
    count : int
        How many points to choose at most.

    Returns
    -------
    index : ndarray of int, shape (m,), m <= count
        Increasing.
    weights : ndarray, shape (m,)
        Weight of each point with that of the omitted points around it. The sum is 1.
    """
    n = measured.size
    if n <= count:
        return np.arange(n), weights
    # Where the response is large, where it varies from bin to bin, and a third everywhere: with
    # 800 of 7907 points the cost at a minimum then differs by less than 1 % from the whole one.
    root = np.sqrt(weights)
    size, variation = root * np.abs(measured), root * np.abs(np.gradient(measured))
    density = np.full(n, 1 / n)
    for part in (size, variation):
        density += part / max(float(part.sum()), np.finfo(float).tiny)
    reached = np.cumsum(density)
    marks = (np.arange(count) + 0.5) * (reached[-1] / count)
    index = np.unique(np.searchsorted(reached, marks))
    borders = (index[:-1] + index[1:] + 1) // 2
    return index, np.add.reduceat(weights, np.concatenate(([0], borders)))


# Starts

# Sizes are relative to stiffness and to inertia at a mode: about twice a damping ratio.
_SWEEP: Final[dict[Parameter, tuple[float, ...]]] = {
    "zeta": tuple(math.log(size) for size in (1e-4, 1e-3, 1e-2, 1e-1)),
    "alpha": (0.3, 0.8, 1.3, 1.8),
    "gamma": tuple(math.log(size) for size in (1e-3, 1e-2, 1e-1, 1.0)),
    "lambda": (0.3, 0.8, 1.3, 1.8),
}
_MOST_STARTS: Final = 8


def starts(
    structure: Structure, cost: Callable[[NDArray[np.float64]], float]
) -> list[NDArray[np.float64]]:
    """Choose starts for the unknowns of `structure`, the most promising first.

    Parameters
    ----------
    structure : Structure
    cost : callable
        Cost at a vector of unknowns, shape (k,).

    Returns
    -------
    list of ndarray, each of shape (k,)
        At most eight: points of the sweep whose cost no neighbour along any axis undercuts.
    """
    axes = [_SWEEP[name] for name in structure.free]
    points = np.array(list(itertools.product(*axes)))
    costs = np.array([cost(x) for x in points]).reshape([len(axis) for axis in axes])
    hollow = np.ones(costs.shape, dtype=bool)
    for axis in range(costs.ndim):
        rise = np.diff(costs, axis=axis)
        # A point is not a hollow if the cost falls towards the next one, or rose from the last.
        pad_end = [(0, 1) if k == axis else (0, 0) for k in range(costs.ndim)]
        pad_start = [(1, 0) if k == axis else (0, 0) for k in range(costs.ndim)]
        hollow &= np.pad(rise, pad_end) >= 0
        hollow &= np.pad(rise, pad_start) <= 0
    hollows = np.flatnonzero(hollow)
    best_first = hollows[np.argsort(costs.ravel()[hollows])]
    return [points[i] for i in best_first[:_MOST_STARTS]]


# Covariance


def sandwich_covariance(
    deviation: NDArray[np.complex128],
    jacobian: NDArray[np.complex128],
    weights: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Return the covariance of the unknowns, ``A⁻¹ B A⁻¹``, from the residual deviations.

    A is the Gauss-Newton Hessian and B the covariance of the gradient, summed over neighbouring
    bins as well as each bin alone (Newey and West, "A simple, positive semi-definite,
    heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55 (1987)
    703-708): zero padding and the window make neighbours similar.

    Parameters
    ----------
    deviation : ndarray of complex, shape (n,)
        Model minus measurement at the minimum.
    jacobian : ndarray of complex, shape (k, n)
    weights : ndarray, shape (n,)

    Returns
    -------
    ndarray, shape (k, k), or None
        None if the data do not determine the unknowns.
    """
    hessian = ((jacobian.conj() * weights) @ jacobian.T).real
    scale = np.sqrt(np.diag(hessian))
    if not (np.isfinite(hessian).all() and (scale > 0).all()):
        return None
    scaled = hessian / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e12:
        return None
    scores = (jacobian.conj() * (weights * deviation)).real
    span = _alike(np.sqrt(weights) * deviation)
    # Bartlett's kernel over `span` bins is the mean square of sums over as many neighbours.
    reached = np.cumsum(np.pad(scores, ((0, 0), (span, span - 1))), axis=1)
    sums = reached[:, span:] - reached[:, :-span]
    middle = sums @ sums.T / span
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    covariance: NDArray[np.float64] = inverse @ middle @ inverse
    return covariance


def _alike(deviation: NDArray[np.complex128]) -> int:
    """Count correlated neighbouring bins: twice the lag of half the correlation."""
    half = 0.5 * np.vdot(deviation, deviation).real
    # A few lags, so not by transforms: those would cost as much as the model on every point.
    for lag in range(1, deviation.size):
        if np.vdot(deviation[:-lag], deviation[lag:]).real < half:
            return 1 + 2 * lag
    return 1
