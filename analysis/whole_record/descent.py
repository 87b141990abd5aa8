"""Descent to a minimum of a sum of squares that stays large: a structured quasi-Newton method.

The Hessian of a sum of squares is ``J'J`` and a second part: the residuals times their own second
derivatives. Gauss-Newton and Levenberg-Marquardt leave the second part out. Where the residual
stays large, because the structure is not the record's, they creep: each step shortens the way that
remains by the same share. Here the second part is learned from how the gradient changes from step
to step (J. E. Dennis, D. M. Gay and R. E. Welsch, ACM TOMS 7 (1981) 348-368: NL2SOL), and used when
it would have foretold the last step better. Steps are damped after H. B. Nielsen, "Damping
parameter in Marquardt's method", IMM-REP-1999-05.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.levenberg_marquardt import Minimum, NormalEquations

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from analysis.whole_record.steps import Steps

_FIRST_DAMPING: Final = 1e-3
_LARGEST_DAMPING: Final = 1e16
_LEAST_RELIEF: Final = 0.1
"""Of the damping that a step which kept its promise leaves."""

_SHORTEST_STEP: Final = 1e-13
_FLOOR: Final = 1e-14
"""Least curvature, relative to the largest: an unknown without effect takes no huge step."""


def descend(
    problem: Callable[[NDArray[np.float64]], NormalEquations],
    start: NDArray[np.float64],
    steps: Steps,
    *,
    relative_tolerance: float,
    max_evaluations: int = 200,
) -> Minimum:
    """Descend to a local minimum within bounds.

    Parameters
    ----------
    problem : callable
        Normal equations at a point of shape (k,).
    start : ndarray, shape (k,)
    steps : Steps
        Where steps lead, and the bounds.
    relative_tolerance : float
        Stop when a step promises less than this fraction of the cost, or is too short to be told
        from rounding.
    max_evaluations : int
        Of `problem`, after which the best point so far is returned.
    """
    x = np.clip(start, steps.lower, steps.upper)
    here = problem(x)
    evaluations = 1
    second = np.zeros_like(here.hessian)
    uses_second = False
    damping, growth = _FIRST_DAMPING, 2.0
    while evaluations < max_evaluations:
        held = ((x <= steps.lower) & (here.gradient > 0)) | (
            (x >= steps.upper) & (here.gradient < 0)
        )
        free = ~held & (here.hessian.diagonal() > 0)
        if not free.any():
            break
        limits = steps.limits(x)
        model = here.hessian + second if uses_second else here.hessian
        step = _step(model, here, free, damping, limits)
        if step is None:  # not convex
            uses_second, model = False, here.hessian
            step = _step(model, here, free, damping, limits)
        if step is None:
            break
        promised = -float(step @ (2 * here.gradient + model @ step))
        if float(np.abs(step).max()) < _SHORTEST_STEP * (1 + float(np.abs(x).max())):
            break
        if 0 <= promised < relative_tolerance * here.cost and damping < 1:
            break
        trial = steps.end(x, step)
        there = problem(trial)
        evaluations += 1
        gained = here.cost - there.cost
        if gained > 0:
            foretold = -float(step @ (2 * here.gradient + here.hessian @ step))
            bend = float(step @ second @ step)
            uses_second = abs(gained - (foretold - bend)) <= abs(gained - foretold)
            second = _learned(second, trial - x, here, there)
            quality = gained / promised if promised > 0 else 0.0
            damping *= max(_LEAST_RELIEF, 1 - (2 * quality - 1) ** 3)
            growth = 2.0
            x, here = trial, there
        elif uses_second:
            uses_second = False
        else:
            damping *= growth
            growth *= 2
            if damping > _LARGEST_DAMPING:
                break
    return Minimum(x, here.cost, evaluations)


def _step(
    model: NDArray[np.float64],
    here: NormalEquations,
    free: NDArray[np.bool_],
    damping: float,
    limits: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64] | None:
    """Lowest point of the model within the limits, shape (k,); None if the model is not convex.

    What would go beyond its limit stays there, and the others make the best of it.
    """
    least, most = limits
    step = np.zeros(free.size)
    curvature = here.hessian.diagonal()
    damped = model + np.diag(damping * np.maximum(curvature, _FLOOR * curvature[free].max()))
    moving = np.flatnonzero(free)
    while moving.size:
        block = damped[moving[:, None], moving]
        step[moving] = 0.0
        pull = here.gradient[moving] + model[moving] @ step
        try:
            np.linalg.cholesky(block)
            found = np.linalg.solve(block, -pull)
        except np.linalg.LinAlgError:
            return None
        step[moving] = np.clip(found, least[moving], most[moving])
        beyond = step[moving] != found
        if not beyond.any():
            break
        moving = moving[~beyond]
    return step


def _learned(
    second: NDArray[np.float64],
    step: NDArray[np.float64],
    here: NormalEquations,
    there: NormalEquations,
) -> NDArray[np.float64]:
    """Second part of the Hessian after a step, by the symmetric secant update of NL2SOL, (k, k)."""
    change = there.gradient - here.gradient
    along = float(change @ step)
    if along <= 0:
        return second
    bend = change - (here.hessian + there.hessian) @ step / 2
    turned = second @ step
    size = abs(float(step @ turned))
    if size > 0:  # what was learned farther up may be too large here
        share = min(1.0, abs(float(step @ bend)) / size)
        second, turned = share * second, share * turned
    miss = bend - turned
    both = np.outer(miss, change)
    return (
        second
        + (both + both.T) / along
        - (float(miss @ step) / along**2) * np.outer(change, change)
    )
