"""Minimization of a sum of squares within bounds by damped Gauss-Newton steps.

The normal equations are cheap for problems of a few unknowns and thousands of residuals. A general
solver has a large overhead: its import takes longer than all fits of a session. Steps are damped by
the method of Nielsen [1]_.

The Hessian of a sum of squares is the sum of ``J'J`` and a second part, the residuals times their
second derivatives. Gauss-Newton and Levenberg-Marquardt omit the second part. If the residual
remains large, because the model does not fit the data, they converge slowly: each step reduces the
remaining distance by the same fraction. Here, the second part is estimated from the change of the
gradient in each step (NL2SOL [2]_). It is used if it would have predicted the last step better.

References
----------
.. [1] H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05.
.. [2] J. E. Dennis, D. M. Gay and R. E. Welsch, An adaptive nonlinear least-squares algorithm, ACM
   TOMS 7 (1981) 348-368.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Generic, Protocol, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


# Problem, bounds and minimum


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Sum of squares at one point, with its gradient and its Gauss-Newton Hessian.

    Attributes
    ----------
    cost : float
        Sum of the squares of the residuals, ``|r|²``.
    gradient : ndarray, shape (k,)
        Half the gradient of the cost, ``Re(Jᴴ r)``.
    hessian : ndarray, shape (k, k)
        Half the Gauss-Newton Hessian of the cost, ``Re(Jᴴ J)``.
    """

    cost: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]

    def scaled_hessian(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the Hessian scaled to a unit diagonal, and the scales, shape (k,).

        The scales are the square roots of the diagonal of the Hessian.
        """
        scales = np.sqrt(np.maximum(np.diag(self.hessian), np.finfo(float).tiny))
        return self.hessian / np.outer(scales, scales), scales

    def is_held_at_bound(
        self, x: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return whether each unknown is at a bound beyond which the cost would decrease, (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
            Point at which the equations were evaluated.
        lower, upper : ndarray, shape (k,)
            Bounds of the unknowns.
        """
        return ((x <= lower) & (self.gradient > 0)) | ((x >= upper) & (self.gradient < 0))


@dataclass(frozen=True, slots=True)
class Minimum:
    """Local minimum at which a descent ended.

    Attributes
    ----------
    x : ndarray, shape (k,)
        Unknowns at the minimum.
    equations : NormalEquations
        Cost, gradient and Hessian at `x`.
    evaluations : int
        Number of evaluations of the problem.
    second_order_part : ndarray, shape (k, k)
        Estimate of half the second-order part of the Hessian, which Gauss-Newton omits.
    """

    x: NDArray[np.float64]
    equations: NormalEquations
    evaluations: int
    second_order_part: NDArray[np.float64]

    @property
    def cost(self) -> float:
        """Sum of squares at the minimum."""
        return self.equations.cost


class Region(Protocol):
    """Bounds of the unknowns, shape (k,), and rule by which steps remain within the bounds."""

    @property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds of the unknowns."""

    @property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds of the unknowns."""

    def step_limits(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and upper limits of a step from `x`, for each unknown, (k,) each."""

    def end_point(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the end point of a step within the bounds, shape (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
            Point within the bounds.
        step : ndarray, shape (k,)
            Requested step.
        """


@dataclass(frozen=True, slots=True)
class ConstantBounds:
    """Constant bounds, to which each unknown is clipped after a step.

    If one unknown is clipped, the others are not optimised again (as `_compute_step` would do for
    limits of the step): the fits to a frequency response would need 7 % more evaluations.
    """

    lower: NDArray[np.float64]
    """Lower bounds, shape (k,)."""
    upper: NDArray[np.float64]
    """Upper bounds, shape (k,)."""

    def step_limits(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return infinite limits of a step for each unknown, because `end_point` clips the step."""
        return np.full(x.size, -np.inf), np.full(x.size, np.inf)

    def end_point(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the end point of a step, clipped to the bounds, shape (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
            Point within the bounds.
        step : ndarray, shape (k,)
            Requested step.
        """
        return np.minimum(np.maximum(x + step, self.lower), self.upper)


# Descent

_INITIAL_STEP_DAMPING: Final = 1e-3
"""Damping of the first step, relative to the curvature."""
_LARGEST_STEP_DAMPING: Final = 1e16
"""Damping above which a descent ends, because even tiny steps do not reduce the cost."""
_SMALLEST_STEP_DAMPING_FACTOR: Final = 0.1
"""Smallest factor by which the damping is multiplied after a successful step."""

_SHORTEST_RELATIVE_STEP: Final = 1e-13
"""Length of a step relative to the unknowns, below which rounding errors dominate the step."""
_SMALLEST_RELATIVE_CURVATURE: Final = 1e-14
"""Smallest curvature used in the damping, relative to the largest one. It prevents huge steps of an
unknown without effect."""


def descend(
    problem: Callable[[NDArray[np.float64]], NormalEquations],
    start_point: NDArray[np.float64],
    region: Region,
    *,
    relative_tolerance: float,
    max_evaluations: int = 200,
    second_order_part: NDArray[np.float64] | None = None,
    early_stop_limits: tuple[int, float] | None = None,
) -> Minimum:
    """Find a local minimum of a sum of squares within bounds, by damped Gauss-Newton steps.

    Parameters
    ----------
    problem : callable
        Function that returns the normal equations at a point of shape (k,).
    start_point : ndarray, shape (k,)
        Starting point, in unknowns scaled so that a change of 1 is large.
    region : Region
        Bounds and rule for steps; a `ConstantBounds` for constant bounds.
    relative_tolerance : float
        The descent ends when the predicted cost reduction of a step is less than this fraction of
        the cost, or when the step is as small as rounding errors.
    max_evaluations : int
        Largest number of evaluations of `problem`; the best point is then returned.
    second_order_part : ndarray, shape (k, k), optional
        Estimate of the second-order part of the Hessian for the first step, from a descent on a
        similar problem. With an estimate from a few points of a frequency response, fits to all
        points need 39 evaluations instead of 57.
    early_stop_limits : tuple of int and float, optional
        Number of evaluations, and a cost. The descent ends if its cost is still higher after this
        number of evaluations, because other descents explain the data better.
    """
    x = np.clip(start_point, region.lower, region.upper)
    current_equations = problem(x)
    evaluation_count = 1
    has_second_order_part = second_order_part is not None
    second_order_part = (
        np.zeros_like(current_equations.hessian) if second_order_part is None else second_order_part
    )
    damping, damping_growth = _INITIAL_STEP_DAMPING, 2.0
    while evaluation_count < max_evaluations:
        is_held_unknown = current_equations.is_held_at_bound(x, region.lower, region.upper)
        is_free_unknown = ~is_held_unknown & (current_equations.hessian.diagonal() > 0)
        if not is_free_unknown.any():
            break
        if (
            early_stop_limits is not None
            and evaluation_count >= early_stop_limits[0]
            and current_equations.cost > early_stop_limits[1]
        ):
            break
        step_limits = region.step_limits(x)
        model_hessian = (
            current_equations.hessian + second_order_part
            if has_second_order_part
            else current_equations.hessian
        )
        step = _compute_step(
            model_hessian, current_equations, is_free_unknown, damping, step_limits
        )
        if step is None:  # not convex
            has_second_order_part, model_hessian = False, current_equations.hessian
            step = _compute_step(
                model_hessian, current_equations, is_free_unknown, damping, step_limits
            )
        if step is None:
            break
        trial_point = region.end_point(x, step)
        step = trial_point - x  # the prediction is for the step after clipping
        predicted_reduction = -float(step @ (2 * current_equations.gradient + model_hessian @ step))
        if float(np.abs(step).max()) < _SHORTEST_RELATIVE_STEP * (1 + float(np.abs(x).max())):
            break
        if 0 <= predicted_reduction < relative_tolerance * current_equations.cost and damping < 1:
            break
        next_equations = problem(trial_point)
        evaluation_count += 1
        cost_reduction = current_equations.cost - next_equations.cost
        if cost_reduction > 0:
            gauss_newton_prediction = -float(
                step @ (2 * current_equations.gradient + current_equations.hessian @ step)
            )
            second_order_part_effect = float(step @ second_order_part @ step)
            has_second_order_part = abs(
                cost_reduction - (gauss_newton_prediction - second_order_part_effect)
            ) <= abs(cost_reduction - gauss_newton_prediction)
            second_order_part = _update_second_order_part(
                second_order_part, step, current_equations, next_equations
            )
            prediction_ratio = (
                cost_reduction / predicted_reduction if predicted_reduction > 0 else 0.0
            )
            damping *= max(_SMALLEST_STEP_DAMPING_FACTOR, 1 - (2 * prediction_ratio - 1) ** 3)
            damping_growth = 2.0
            x, current_equations = trial_point, next_equations
        elif has_second_order_part:
            has_second_order_part = False
        else:
            damping *= damping_growth
            damping_growth *= 2
            if damping > _LARGEST_STEP_DAMPING:
                break
    return Minimum(x, current_equations, evaluation_count, second_order_part)


def _compute_step(
    model_hessian: NDArray[np.float64],
    current_equations: NormalEquations,
    is_free_unknown: NDArray[np.bool_],
    damping: float,
    step_limits: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64] | None:
    """Return the step to the minimum of the damped quadratic model of the cost, shape (k,).

    An unknown that would exceed its limit is set to the limit, and the others are optimised again.
    Return None if the model is not convex.
    """
    smallest_step, largest_step = step_limits
    step = np.zeros(is_free_unknown.size)
    curvatures = current_equations.hessian.diagonal()
    damped_hessian = model_hessian.copy()
    damped_hessian.flat[:: step.size + 1] += damping * np.maximum(
        curvatures, _SMALLEST_RELATIVE_CURVATURE * curvatures[is_free_unknown].max()
    )
    gradient = current_equations.gradient
    free_indices = np.flatnonzero(is_free_unknown)
    while free_indices.size:
        hessian_block = damped_hessian[free_indices[:, None], free_indices]
        try:
            np.linalg.cholesky(hessian_block)
            free_step = np.linalg.solve(hessian_block, -gradient[free_indices])
        except np.linalg.LinAlgError:
            return None
        step[free_indices] = limited_step = np.minimum(
            np.maximum(free_step, smallest_step[free_indices]), largest_step[free_indices]
        )
        is_limited = limited_step != free_step
        if not is_limited.any():
            break
        free_indices = free_indices[~is_limited]
        step[free_indices] = 0.0
        gradient = current_equations.gradient + model_hessian @ step
    return step


def _update_second_order_part(
    second_order_part: NDArray[np.float64],
    step: NDArray[np.float64],
    current_equations: NormalEquations,
    next_equations: NormalEquations,
) -> NDArray[np.float64]:
    """Return the second part of the Hessian, updated after a step by the secant rule of NL2SOL."""
    gradient_change = next_equations.gradient - current_equations.gradient
    step_curvature = float(gradient_change @ step)
    if step_curvature <= 0:
        return second_order_part
    second_order_part_gradient_change = (
        gradient_change - (current_equations.hessian + next_equations.hessian) @ step / 2
    )
    predicted_gradient_change = second_order_part @ step
    predicted_change_size = abs(float(step @ predicted_gradient_change))
    if predicted_change_size > 0:  # an estimate from a higher cost may be too large here
        sizing_factor = min(
            1.0, abs(float(step @ second_order_part_gradient_change)) / predicted_change_size
        )
        second_order_part, predicted_gradient_change = (
            sizing_factor * second_order_part,
            sizing_factor * predicted_gradient_change,
        )
    gradient_change_error = second_order_part_gradient_change - predicted_gradient_change
    outer_update = gradient_change_error[:, None] * gradient_change
    return (
        second_order_part
        + (outer_update + outer_update.T) / step_curvature
        - (float(gradient_change_error @ step) / step_curvature**2)
        * (gradient_change[:, None] * gradient_change)
    )


# Values at the last points

_CachedValue = TypeVar("_CachedValue")
"""Type of the cached values."""


class RecentValues(Generic[_CachedValue]):
    """Cache of a function's values at the last points of a descent.

    Covariances are evaluated at the last point of a descent, and the next descent begins there.

    Parameters
    ----------
    stored_points : int
        Number of stored points. One is not enough, because a descent may reject its last step.
    """

    __slots__ = ("_points", "_values")

    def __init__(self, stored_points: int = 2) -> None:
        self._points = stored_points
        self._values: dict[tuple[object, bytes], _CachedValue] = {}

    def value_at(
        self,
        x: NDArray[np.float64],
        compute_value: Callable[[NDArray[np.float64]], _CachedValue],
        owner: object = None,
    ) -> _CachedValue:
        """Return the value at `x` from the cache, or compute and store it.

        Parameters
        ----------
        x : ndarray, shape (k,)
            Point at which the function is evaluated.
        compute_value : callable
            Function that returns the value at a point.
        owner : object, optional
            Object to which `compute_value` belongs, if several objects use the same cache.
        """
        cache_key = owner, x.tobytes()
        if cache_key not in self._values:
            if len(self._values) == self._points:
                del self._values[next(iter(self._values))]
            self._values[cache_key] = compute_value(x)
        return self._values[cache_key]

    def clear(self) -> None:
        """Forget all values."""
        self._values.clear()

    def __reduce__(self) -> tuple[type[RecentValues[_CachedValue]], tuple[int]]:
        """Pickle an empty cache: its values would be the largest part of a fit."""
        return type(self), (self._points,)
