"""Fit of the damping structures to a frequency response: Eq. (26) of the reference paper.

The cost is ``J = sum_p W_p |G_exp(j omega_p) - Ĝ(j omega_p)|²`` with complex deviations and the
weights of `analysis.models`. Its minimum is searched over the whole range of physical damping,
without an initial guess. The cost is evaluated on a coarse grid of all unknowns. Descents begin at
the local minima of the grid, with a few hundred representative points of the response. The best few
are refined with all points.

The grid is necessary because the cost of types III, V and VI has several minima: from a random
start, type VI reaches the best minimum in fewer than half of the cases. The reference paper uses a
fine grid over the whole range of physical interest; the grid used here is coarse (`starts`).

The standard deviations follow from the covariance of a weighted least-squares fit, which treats
each deviation of the model from the measurement as random. Their accuracy on simulated sessions
with type VI is as follows:

* If the errors of the response are independent between bins, the standard deviations are within
  20 % of the scatter of repeated fits.
* If groups of nine neighbouring bins have a common error, as with zero padding, the standard
  deviations are half of the scatter: a resonance is narrower than such a group, so that the fit
  absorbs most of the group's error.
* With Welch's estimate of a chirp, leakage dominates over noise, and the standard deviations are
  3 to 50 times the scatter between sessions. The bias of a parameter is 1 to 7 times its standard
  deviation, and 4 to 20 times if the structure is wrong.

The standard deviations therefore rank the parameters by how well the response determines them, but
they do not yield confidence intervals.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.models import (
    STRUCTURES,
    DampingUnknowns,
    Structure,
    Weighting,
    weighting_name,
    weights,
)
from analysis.optimizer import ConstantBounds, Minimum, NormalEquations, RecentValues, descend
from rigd.beam import DAMPING_PARAMETERS, Beam, Damping, Plant, ResponseGrid

# Fits

_THINNED_POINT_COUNT: Final = 800
"""Number of points of the response in the first descents."""
_MAX_REFINED_MINIMA: Final = 3
"""Number of minima that are refined with all points."""
_ROUGH_COST_TOLERANCE: Final = 1e-5
"""Relative cost reduction in a step below which the first descents end."""
_REFINED_COST_TOLERANCE: Final = 1e-12
"""Relative cost reduction in a step below which the refinement of a minimum ends."""
_SAME_MINIMUM_DISTANCE: Final = 0.02
"""Difference in an unknown above which two descents count as ended at different minima."""


class FitError(ValueError):
    """Error if no model can be fitted to a frequency response."""


@dataclass(frozen=True, slots=True)
class FrfFit:
    """Fit of one damping structure to a frequency response, with one weighting.

    Attributes
    ----------
    structure : Structure
        Fitted structure.
    weighting : str
        Name of the weighting.
    damping : Damping
        Fitted damping, for use with `rigd.beam`.
    parameters : dict
        Values of zeta, alpha, gamma and lambda, fixed parameters included.
    std : dict or None
        Standard deviations of these parameters, 0 for fixed ones; None if a parameter is at a bound
        or not determined by the data. They are computed as if the whole residual were random, so
        they are no confidence intervals: see `analysis.paper._fit`.
    cost : float
        Minimum of the cost function (Eq. 26), in (N·m/rad)².
    at_bounds : tuple of str
        Free parameters at a bound of the range searched.
    """

    structure: Structure
    weighting: str
    damping: Damping
    parameters: dict[str, float]
    std: dict[str, float] | None
    cost: float
    at_bounds: tuple[str, ...]

    @property
    def std_of_free_parameters(self) -> dict[str, float | None] | None:
        """Return the standard deviations, with None for fixed parameters; None if `std` is None."""
        if self.std is None:
            return None
        free_parameters = self.structure.free
        return {name: std if name in free_parameters else None for name, std in self.std.items()}


def fit_frf(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    beam: Beam,
    structure: Structure,
    weighting: Weighting = "const",
    *,
    tool_inertia_kg_m2: float = 0.0,
) -> FrfFit:
    """Find the global minimum of the cost (Eq. 26) for one damping structure and weighting.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Frequencies: positive, increasing, evenly spaced.
    response : ndarray of complex, shape (n,)
        Measured torque per motor angle in N·m/rad, without the delays of the instruments.
    beam : Beam
        Beam, whose properties remain fixed.
    structure : Structure
        Damping structure to be fitted.
    weighting : str or callable
        Weighting of the frequencies (see `analysis.models.weights`).
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam, added to the model.

    Raises
    ------
    FitError
        If the response has fewer points than unknowns, or values that are not finite.
    WeightingError
        If the weighting does not exist.

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
    """Fit each of several structures with each of several weightings to a frequency response.

    The fits are those of `fit_frf`, but the frequency grids are prepared only once.

    Parameters
    ----------
    frequency_hz, response, beam, tool_inertia_kg_m2
        Response, beam and tool inertia, as for `fit_frf`.
    structures : iterable of Structure
        Structures to be fitted, by default all of `analysis.models.STRUCTURES`.
    weightings : iterable of str or callable
        Weightings, by default the two of the reference paper.
    """
    structures, weightings = tuple(structures), tuple(weightings)
    _check_response(frequency_hz, response, structures)
    omega_rad_s = 2 * np.pi * frequency_hz
    s = 2j * np.pi * frequency_hz
    # The torque sensor is under the clamp: the inertia of the tool is added to the model, and never
    # subtracted from the data.
    undamped_plant = Plant(beam, Damping(), tool_inertia_kg_m2=tool_inertia_kg_m2)
    full_response_grid = ResponseGrid(s)
    thinned_and_full_grids: list[tuple[_FrequencyGrid, _FrequencyGrid]] = []
    for weighting in weightings:
        full_grid_weights = weights(omega_rad_s, weighting)
        point_index, point_weights = representative_points(
            response, full_grid_weights, _THINNED_POINT_COUNT
        )
        thinned_response_grid = ResponseGrid(s[point_index])
        thinned_and_full_grids.append(
            (
                _FrequencyGrid(
                    thinned_response_grid, undamped_plant, response[point_index], point_weights
                ),
                _FrequencyGrid(full_response_grid, undamped_plant, response, full_grid_weights),
            )
        )
    return tuple(
        _fit_structure(structure, weighting_name(weighting), thinned_grid, full_grid)
        for structure in structures
        for weighting, (thinned_grid, full_grid) in zip(
            weightings, thinned_and_full_grids, strict=True
        )
    )


_Linearization = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Model minus measurement, shape (n,), and its derivatives by the unknowns, shape (k, n)."""


@dataclass(frozen=True, slots=True)
class _FrequencyGrid:
    """Frequencies with weights and measured response, at which a model is compared with it."""

    response_grid: ResponseGrid
    undamped_plant: Plant
    measured_response: NDArray[np.complex128]
    weights: NDArray[np.float64]

    def evaluate(self, damping: Damping, wrt: Sequence[str] = ()) -> NDArray[np.complex128]:
        """Return response (first row) and derivatives of the damped plant, shape (1 + k, n)."""
        return self.response_grid.evaluate(replace(self.undamped_plant, damping=damping), wrt)


class _FrfProblem:
    """Cost (Eq. 26) of a damping structure on a frequency grid, as a function of unknowns."""

    def __init__(self, unknowns: DampingUnknowns, grid: _FrequencyGrid) -> None:
        self.unknowns = unknowns
        self.grid = grid
        self._recent_linearizations: RecentValues[_Linearization] = RecentValues()

    def cost(self, x: NDArray[np.float64]) -> float:
        """Return the cost (Eq. 26) at the unknowns x."""
        deviation = self.grid.evaluate(self.unknowns.damping(x))[0] - self.grid.measured_response
        return float(self.grid.weights @ (deviation.real**2 + deviation.imag**2))

    def deviation_and_jacobian(self, x: NDArray[np.float64]) -> _Linearization:
        """Return model minus measurement, (n,), and its derivatives with respect to x, (k, n)."""
        return self._recent_linearizations.value_at(x, self._deviation_and_jacobian_at)

    def _deviation_and_jacobian_at(self, x: NDArray[np.float64]) -> _Linearization:
        """Compute model minus measurement and its derivatives with respect to x."""
        response_and_derivatives = self.grid.evaluate(
            self.unknowns.damping(x), self.unknowns.structure.free
        )
        jacobian = self.unknowns.derivative_of_parameters(x).T @ response_and_derivatives[1:]
        return response_and_derivatives[0] - self.grid.measured_response, jacobian

    def normal_equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Return cost, gradient and Gauss-Newton Hessian at the unknowns x."""
        deviation, jacobian = self.deviation_and_jacobian(x)
        weighted_jacobian = jacobian.conj() * self.grid.weights
        return NormalEquations(
            cost=float(self.grid.weights @ (deviation.real**2 + deviation.imag**2)),
            gradient=(weighted_jacobian @ deviation).real,
            hessian=(weighted_jacobian @ jacobian.T).real,
        )


def _fit_structure(
    structure: Structure,
    weighting: str,
    thinned_grid: _FrequencyGrid,
    full_grid: _FrequencyGrid,
) -> FrfFit:
    """Fit a damping structure: descents on few points, then refinement on all points."""
    unknowns = DampingUnknowns.for_beam(structure, full_grid.undamped_plant.beam)
    bounds = ConstantBounds(*unknowns.bounds)
    thinned_problem, full_problem = (
        _FrfProblem(unknowns, thinned_grid),
        _FrfProblem(unknowns, full_grid),
    )
    rough_minima = [
        descend(
            thinned_problem.normal_equations, x, bounds, relative_tolerance=_ROUGH_COST_TOLERANCE
        )
        for x in starting_points(structure, thinned_problem.cost)
    ]
    # The descents first converge on the few points. With the Hessian estimated there, one or two
    # steps on all points remain.
    refined_minima = _distinct_minima(
        [
            _refine(thinned_problem, rough_minimum, bounds)
            for rough_minimum in _distinct_minima(rough_minima)[:_MAX_REFINED_MINIMA]
        ]
    )
    refined_minima = [
        _refine(full_problem, rough_minimum, bounds) for rough_minimum in refined_minima
    ]
    best_minimum = min(refined_minima, key=lambda minimum: minimum.cost)
    parameters = unknowns.parameters(best_minimum.x)
    are_at_bound = (best_minimum.x <= bounds.lower) | (best_minimum.x >= bounds.upper)
    return FrfFit(
        structure=structure,
        weighting=weighting,
        damping=unknowns.damping(best_minimum.x),
        parameters={
            parameter_name: parameters[parameter_name] for parameter_name in DAMPING_PARAMETERS
        },
        std=None if are_at_bound.any() else _standard_deviations(full_problem, best_minimum.x),
        cost=best_minimum.cost,
        at_bounds=tuple(
            parameter_name
            for parameter_name, is_at_bound in zip(structure.free, are_at_bound, strict=True)
            if is_at_bound
        ),
    )


def _refine(frf_problem: _FrfProblem, rough_minimum: Minimum, bounds: ConstantBounds) -> Minimum:
    """Continue a descent that ended with a rough tolerance, with the refined tolerance."""
    return descend(
        frf_problem.normal_equations,
        rough_minimum.x,
        bounds,
        relative_tolerance=_REFINED_COST_TOLERANCE,
        second_order_part=rough_minimum.second_order_part,
    )


def _distinct_minima(minima: list[Minimum]) -> list[Minimum]:
    """Return the distinct minima, the one of the lowest cost first."""
    distinct_minima: list[Minimum] = []
    for minimum in sorted(minima, key=lambda m: m.cost):
        if all(
            np.abs(minimum.x - other_minimum.x).max() > _SAME_MINIMUM_DISTANCE
            for other_minimum in distinct_minima
        ):
            distinct_minima.append(minimum)
    return distinct_minima


def _standard_deviations(
    frf_problem: _FrfProblem, x: NDArray[np.float64]
) -> dict[str, float] | None:
    """Return the standard deviations of all parameters; None if the data do not determine them."""
    deviation, jacobian = frf_problem.deviation_and_jacobian(x)
    covariance = sandwich_covariance(deviation, jacobian, frf_problem.grid.weights)
    if covariance is None:
        return None
    derivative = frf_problem.unknowns.derivative_of_parameters(x)
    variances = np.diag(derivative @ covariance @ derivative.T)
    variance_by_name = dict(zip(frf_problem.unknowns.structure.free, variances, strict=True))
    return {
        parameter_name: math.sqrt(max(float(variance_by_name.get(parameter_name, 0.0)), 0.0))
        for parameter_name in DAMPING_PARAMETERS
    }


def _check_response(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    structures: tuple[Structure, ...],
) -> None:
    """Raise if a response has too few points, values that are not finite, or a frequency of 0."""
    min_point_count = max((len(structure.free) for structure in structures), default=0)
    if frequency_hz.size < max(min_point_count, 3):
        raise FitError(
            f"The band holds {frequency_hz.size} points of the frequency response, too few for "
            f"{min_point_count} unknowns; widen the band."
        )
    if not (np.isfinite(response).all() and frequency_hz[0] > 0):
        raise FitError(
            "The frequency response must be finite and start above 0 Hz to be fitted; "
            "choose a band in which the input was excited."
        )


# Representative points


def representative_points(
    measured_response: NDArray[np.complex128], weights: NDArray[np.float64], point_count: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Choose representative points of a response, densest near peaks and at large weights.

    Parameters
    ----------
    measured_response : ndarray of complex, shape (n,)
        Measured response.
    weights : ndarray, shape (n,)
        Weights of the points, with a sum of 1.
    point_count : int
        Largest number of points to be chosen.

    Returns
    -------
    point_indices : ndarray of int, shape (m,), m <= count
        Indices of the chosen points, increasing.
    weights : ndarray, shape (m,)
        Weight of each chosen point, to which the weights of omitted points around it are added.
        Their sum is 1.
    """
    bin_count = measured_response.size
    if bin_count <= point_count:
        return np.arange(bin_count), weights
    # The density of the points has three equal parts: uniform, by the size of the response, and by
    # its change from bin to bin. With 800 of 7907 points, the cost at a minimum then differs by
    # less than 1 % from the cost with all points.
    root_weights = np.sqrt(weights)
    weighted_magnitude, weighted_variation = (
        root_weights * np.abs(measured_response),
        root_weights * np.abs(np.gradient(measured_response)),
    )
    point_density = np.full(bin_count, 1 / bin_count)
    for weight_density in (weighted_magnitude, weighted_variation):
        point_density += weight_density / max(float(weight_density.sum()), np.finfo(float).tiny)
    cumulative_density = np.cumsum(point_density)
    density_levels = (np.arange(point_count) + 0.5) * (cumulative_density[-1] / point_count)
    point_indices = np.unique(np.searchsorted(cumulative_density, density_levels))
    cell_borders = (point_indices[:-1] + point_indices[1:] + 1) // 2
    return point_indices, np.add.reduceat(weights, np.concatenate(([0], cell_borders)))


# Starts

_STARTING_GRID_VALUES: Final[dict[str, tuple[float, ...]]] = {
    "zeta": tuple(math.log(size) for size in (1e-4, 1e-3, 1e-2, 1e-1)),
    "alpha": (0.3, 0.8, 1.3, 1.8),
    "gamma": tuple(math.log(size) for size in (1e-3, 1e-2, 1e-1, 1.0)),
    "lambda": (0.3, 0.8, 1.3, 1.8),
}
"""Values of the unknowns in the coarse grid. The unknown for a coefficient is the logarithm of the
damping relative to stiffness or inertia at a mode, which is about twice a damping ratio."""
_MAX_STARTING_POINTS: Final = 8
"""Largest number of descents for each structure."""


def starting_points(
    structure: Structure, cost: Callable[[NDArray[np.float64]], float]
) -> list[NDArray[np.float64]]:
    """Choose starting points of the descents for a damping structure, by increasing cost.

    `cost` is a function of the vector of unknowns, shape (k,). Return at most eight points of the
    coarse grid, shape (k,), that have no neighbour of lower cost along any axis.
    """
    parameter_axes = [_STARTING_GRID_VALUES[parameter_name] for parameter_name in structure.free]
    grid_points = np.array(list(itertools.product(*parameter_axes)))
    grid_costs = np.array([cost(x) for x in grid_points]).reshape(
        [len(axis) for axis in parameter_axes]
    )
    is_local_minimum = np.ones(grid_costs.shape, dtype=bool)
    for axis in range(grid_costs.ndim):
        cost_differences = np.diff(grid_costs, axis=axis)
        # A point is no minimum if the next or the previous point along the axis has a lower cost.
        padding_at_end = [(0, 1) if k == axis else (0, 0) for k in range(grid_costs.ndim)]
        padding_at_start = [(1, 0) if k == axis else (0, 0) for k in range(grid_costs.ndim)]
        is_local_minimum &= np.pad(cost_differences, padding_at_end) >= 0
        is_local_minimum &= np.pad(cost_differences, padding_at_start) <= 0
    minimum_indices = np.flatnonzero(is_local_minimum)
    minima_by_cost = minimum_indices[np.argsort(grid_costs.ravel()[minimum_indices])]
    return [grid_points[i] for i in minima_by_cost[:_MAX_STARTING_POINTS]]


# Covariance


def sandwich_covariance(
    deviation: NDArray[np.complex128],
    jacobian: NDArray[np.complex128],
    weights: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Return the covariance of the unknowns, ``A⁻¹ B A⁻¹``, shape (k, k).

    A is the Gauss-Newton Hessian. B is the covariance of the gradient, estimated from the
    deviations with correlations between neighbouring bins (Newey and West, "A simple, positive
    semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
    Econometrica 55 (1987) 703-708), because zero padding and the window make neighbours similar.

    `deviation` is the model minus the measurement at the minimum, shape (n,), `jacobian` has the
    shape (k, n) and `weights` (n,). Return None if the data do not determine the unknowns.
    """
    hessian = ((jacobian.conj() * weights) @ jacobian.T).real
    hessian_scales = np.sqrt(np.diag(hessian))
    if not (np.isfinite(hessian).all() and (hessian_scales > 0).all()):
        return None
    scaled_hessian = hessian / np.outer(hessian_scales, hessian_scales)
    if np.linalg.cond(scaled_hessian) > 1e12:
        return None
    gradient_terms = (jacobian.conj() * (weights * deviation)).real
    correlated_bin_count = _count_correlated_bins(np.sqrt(weights) * deviation)
    # Bartlett's kernel over a number of bins equals the mean square of sums over as many
    # neighbours.
    cumulative_terms = np.cumsum(
        np.pad(gradient_terms, ((0, 0), (correlated_bin_count, correlated_bin_count - 1))), axis=1
    )
    neighbour_sums = (
        cumulative_terms[:, correlated_bin_count:] - cumulative_terms[:, :-correlated_bin_count]
    )
    gradient_covariance = neighbour_sums @ neighbour_sums.T / correlated_bin_count
    inverse_hessian = np.linalg.inv(scaled_hessian) / np.outer(hessian_scales, hessian_scales)
    covariance: NDArray[np.float64] = inverse_hessian @ gradient_covariance @ inverse_hessian
    return covariance


def _count_correlated_bins(deviation: NDArray[np.complex128]) -> int:
    """Return the number of correlated neighbouring bins, from the lag of a correlation of 0.5."""
    half_power = 0.5 * np.vdot(deviation, deviation).real
    # Only a few lags are needed. FFTs would cost as much as the model at every point.
    for lag in range(1, deviation.size):
        if np.vdot(deviation[:-lag], deviation[lag:]).real < half_power:
            return 1 + 2 * lag
    return 1
