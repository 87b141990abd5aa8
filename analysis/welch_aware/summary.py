"""From the point where a descent ended to everything that follows from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.identify import Pole, mode_poles, mode_table, parameter_uncertainty
from analysis.welch_aware.result import WelchAwareFit
from analysis.welch_aware.uncertainty import covariance_of_unknowns

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify import ModeEstimate
    from analysis.welch_aware.comparison import Comparison
    from analysis.welch_aware.objective import Objective


def summary(
    objective: Objective, x: NDArray[np.float64], weighting: str, whole: Comparison
) -> WelchAwareFit:
    """Parameters, uncertainty, modes and response at a minimum.

    Parameters
    ----------
    objective : Objective
    x : ndarray, shape (k,)
        The minimum.
    weighting : str
        Its name.
    whole : Comparison
        With every frequency measured.
    """
    unknowns = objective.unknowns
    lower, upper = unknowns.bounds
    held = (x <= lower) | (x >= upper)
    of_unknowns, known = covariance_of_unknowns(objective.comparison, *objective.linearise(x), held)
    plant = unknowns.plant(x)
    of = parameter_uncertainty(unknowns, x, held, of_unknowns, known)
    response, _ = whole.response(plant)
    deviation = response - whole.measured
    return WelchAwareFit(
        structure=unknowns.structure,
        weighting=weighting,
        plant=plant,
        parameters=plant.parameters,
        std=of.std,
        interval=of.interval,
        determined=of.determined,
        covariance=of.covariance,
        at_bounds=of.at_bounds,
        internal=of.internal,
        external=of.external,
        modes=_modes(objective, x, of_unknowns),
        cost=float(whole.weights @ (deviation.real**2 + deviation.imag**2)),
        response=response,
    )


def _modes(
    objective: Objective, x: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[ModeEstimate, ...]:
    """Modes up to the highest frequency compared."""
    unknowns = objective.unknowns
    chain = unknowns.gradient_by_unknowns(x)
    poles = mode_poles(
        unknowns.plant(x),
        objective.comparison.visible_modes(unknowns.nominal.beam),
        unknowns.gradient_names,
    )
    return mode_table(
        [Pole(pole.mode, pole.at_rad_s, pole.derivative @ chain) for pole in poles], covariance
    )
