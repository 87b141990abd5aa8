"""Where a search for the best damping starts: the low points of a coarse sweep of all unknowns.

The cost of types III, V and VI has several minima, and from a random start type VI falls into the
best one in fewer than half of the cases. So the whole range of physical interest is swept
coarsely first, as the paper sweeps it finely, and a descent starts from each hollow of the sweep.
"""

import itertools
import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.structures import Parameter, Structure

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
        # A point is no hollow if the cost falls towards the next one, or rose from the last.
        pad_end = [(0, 1) if k == axis else (0, 0) for k in range(costs.ndim)]
        pad_start = [(1, 0) if k == axis else (0, 0) for k in range(costs.ndim)]
        hollow &= np.pad(rise, pad_end) >= 0
        hollow &= np.pad(rise, pad_start) <= 0
    hollows = np.flatnonzero(hollow)
    best_first = hollows[np.argsort(costs.ravel()[hollows])]
    return [points[i] for i in best_first[:_MOST_STARTS]]
