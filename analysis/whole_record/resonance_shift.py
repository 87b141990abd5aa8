"""Where the resonances of a beam are, before anything is known of its damping."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from analysis.whole_record.plant import Plant
    from analysis.whole_record.unknowns import Unknowns

_SCANS: Final = {"density_over_stiffness": np.linspace(-0.3, 0.3, 61)}
_OFFSET_SCAN: Final = np.linspace(-0.1, 0.1, 41)
_MODERATE: Final = {"zeta": -4.5, "alpha": 1.0, "gamma": -3.0, "lambda": 1.0}
"""Damping for these scans, as `Unknowns.start` takes it."""


def resonance_shift(cost: Callable[[Plant], float], unknowns: Unknowns) -> NDArray[np.float64]:
    """Find what brings the resonances of a vector of unknowns to where they are, shape (k,).

    With a resonance off by more than it is wide, no descent would find it: all of them by rho/EI,
    then one by one where modes have offsets of their own.

    Parameters
    ----------
    cost : callable
        Of a plant, on few points of a frequency response.
    unknowns : Unknowns
    """
    moderate = unknowns.start(np.array([_MODERATE[name] for name in unknowns.structure.free]))
    shift = np.zeros(moderate.size)
    for place, name in enumerate(unknowns.names):
        if name in _SCANS or name in unknowns.offsets:
            steps = _SCANS.get(name, _OFFSET_SCAN)
            costs = []
            for step in steps:
                shift[place] = step
                costs.append(cost(unknowns.plant(moderate + shift)))
            shift[place] = steps[int(np.argmin(costs))]
    return shift
