"""Least squares of complex residuals within bounds: Levenberg-Marquardt on the normal equations.

For problems of a few unknowns and thousands of residuals, where forming the normal equations is
cheap and a general solver's overhead (and its import, longer than all the fits of a session) is
not. Damping after H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05;
bounds by projection: an unknown that a step would push through its bound rests there.

Where the model cannot follow the data, what remains is large, and Gauss-Newton's Hessian lacks the
part that goes with it: near the minimum steps shrink by a constant factor only. That part can be
learnt from how the gradient changes, by symmetric rank-one updates (J. Nocedal and S. J. Wright,
"Numerical Optimization", sections 6.2 and 10.3).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """A sum of squares at one point, with what a Gauss-Newton step needs.

    Attributes
    ----------
    cost : float
        Sum of ``|r|²``.
    gradient : ndarray, shape (k,)
        Half the gradient of the cost, ``Re(Jᴴ r)``.
    hessian : ndarray, shape (k, k)
        Half its Gauss-Newton Hessian, ``Re(Jᴴ J)``.
    """

    cost: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a descent ended, and what it knows of the Hessian beyond Gauss-Newton's, (k, k)."""

    x: NDArray[np.float64]
    cost: float
    evaluations: int
    residual_part: NDArray[np.float64] | None = None


def minimise(
    problem: Callable[[NDArray[np.float64]], NormalEquations],
    start: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    *,
    relative_tolerance: float,
    max_evaluations: int = 200,
    residual_part: NDArray[np.float64] | None = None,
) -> Minimum:
    """Descend to a local minimum.

    Parameters
    ----------
    problem : callable
        Normal equations at a point of shape (k,).
    start, lower, upper : ndarray, shape (k,)
        The unknowns should be scaled so that a change of 1 is large.
    relative_tolerance : float
        Stop when a step promises or brings less than this fraction of the cost, or is too short
        to be told from rounding.
    max_evaluations : int
        Of `problem`, after which the best point so far is returned.
    residual_part : ndarray, shape (k, k), optional
        What the Hessian is thought to have beyond Gauss-Newton's, to be learnt better on the way;
        zeros if nothing is known. Only for a start close to the minimum: what is learnt from afar
        misleads. By default Gauss-Newton's Hessian is taken for the whole.
    """
    x = np.clip(start, lower, upper)
    learns = residual_part is not None
    part = np.zeros((x.size, x.size)) if residual_part is None else residual_part
    here = problem(x)
    evaluations = 1
    damping, growth = 1e-3, 2.0
    while evaluations < max_evaluations:
        held = ((x <= lower) & (here.gradient > 0)) | ((x >= upper) & (here.gradient < 0))
        free = ~held & (np.diag(here.hessian) > 0)
        if not free.any():
            break
        full = here.hessian
        if learns and _is_convex((full + part)[np.ix_(free, free)]):
            full = full + part
        hessian = full[np.ix_(free, free)]
        # Without the floor an unknown that has next to no effect here would take any step.
        scale = np.diag(here.hessian)[free]
        scale = np.maximum(scale, 1e-14 * scale.max())
        step = np.zeros_like(x)
        step[free] = np.linalg.solve(hessian + np.diag(damping * scale), -here.gradient[free])
        trial = np.clip(x + step, lower, upper)
        step = trial - x
        promised = -float(step @ (2 * here.gradient + full @ step))
        if float(np.abs(step).max()) < 1e-13 * (1 + float(np.abs(x).max())):
            break
        if 0 <= promised < relative_tolerance * here.cost and damping < 1:
            break
        there = problem(trial)
        evaluations += 1
        if learns:
            change = there.gradient - here.gradient - there.hessian @ step
            part = _learnt(part, step, change)
        gained = here.cost - there.cost
        if gained > 0:
            quality = gained / promised if promised > 0 else 0.0
            damping *= max(1 / 3, 1 - (2 * quality - 1) ** 3)
            growth = 2.0
            x, here = trial, there
        else:
            damping *= growth
            growth *= 2
            if damping > 1e16:
                break
    return Minimum(x, here.cost, evaluations, part)


def _is_convex(hessian: NDArray[np.float64]) -> bool:
    return bool(np.linalg.eigvalsh(hessian)[0] > 0)


def _learnt(
    part: NDArray[np.float64], step: NDArray[np.float64], change: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Correct a symmetric matrix by as little as makes it map `step` to `change`."""
    missing = change - part @ step
    along = float(missing @ step)
    if abs(along) <= 1e-8 * float(np.linalg.norm(missing) * np.linalg.norm(step)):
        return part
    return part + np.outer(missing, missing) / along
