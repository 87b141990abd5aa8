"""Least squares of complex residuals within bounds: Levenberg-Marquardt on the normal equations.

For problems of a few unknowns and thousands of residuals, where forming the normal equations is
cheap and a general solver's overhead (and its import, longer than all the fits of a session) is
not. Damping after H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05;
bounds by projection: an unknown that a step would push through its bound rests there.
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
    """Where a descent ended."""

    x: NDArray[np.float64]
    cost: float
    evaluations: int


def minimise(
    problem: Callable[[NDArray[np.float64]], NormalEquations],
    start: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    *,
    relative_tolerance: float,
    max_evaluations: int = 200,
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
    """
    x = np.clip(start, lower, upper)
    here = problem(x)
    evaluations = 1
    damping, growth = 1e-3, 2.0
    while evaluations < max_evaluations:
        held = ((x <= lower) & (here.gradient > 0)) | ((x >= upper) & (here.gradient < 0))
        free = ~held & (np.diag(here.hessian) > 0)
        if not free.any():
            break
        hessian = here.hessian[np.ix_(free, free)]
        # Without the floor an unknown that has next to no effect here would take any step.
        scale = np.maximum(np.diag(hessian), 1e-14 * np.diag(hessian).max())
        step = np.zeros_like(x)
        step[free] = np.linalg.solve(hessian + np.diag(damping * scale), -here.gradient[free])
        trial = np.clip(x + step, lower, upper)
        step = trial - x
        promised = -float(step @ (2 * here.gradient + here.hessian @ step))
        if float(np.abs(step).max()) < 1e-13 * (1 + float(np.abs(x).max())):
            break
        if 0 <= promised < relative_tolerance * here.cost and damping < 1:
            break
        there = problem(trial)
        evaluations += 1
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
    return Minimum(x, here.cost, evaluations)
