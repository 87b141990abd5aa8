"""From the point where a descent ended to everything that follows from it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.welch_aware.result import WelchAwareFit
from analysis.welch_aware.uncertainty import covariance_of_unknowns
from analysis.whole_record.free_decay import Pole, mode_poles
from analysis.whole_record.plant import LOGARITHMIC
from analysis.whole_record.uncertainty import damping_size, interval, mode_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.welch_aware.comparison import Comparison
    from analysis.welch_aware.objective import Objective
    from analysis.whole_record import ModeEstimate

_UNDETERMINED: Final = 20.0
"""Standard deviation of a logarithm that says nothing: a factor of 1e9 either way."""


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
    chain = unknowns.estimates_by_unknowns(x)
    every_covariance = chain @ of_unknowns @ chain.T
    names, plant = unknowns.names, unknowns.plant(x)
    values = plant.parameters
    logarithmic = np.array([name in LOGARITHMIC for name in names])
    known &= ~(logarithmic & (np.diag(every_covariance) > _UNDETERMINED**2))
    covariance = every_covariance[np.ix_(known, known)]

    determined = tuple(name for name, is_known in zip(names, known, strict=True) if is_known)
    std: dict[str, float | None] = dict.fromkeys(values, 0.0) | dict.fromkeys(names, None)
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(names, None)
    for name, variance in zip(determined, np.diag(covariance).tolist(), strict=True):
        spread = variance**0.5
        std[name] = values[name] * spread if name in LOGARITHMIC else spread
        intervals[name] = interval(name, values[name], spread)
    response, _ = whole.response(plant)
    deviation = response - whole.measured
    return WelchAwareFit(
        structure=unknowns.structure,
        weighting=weighting,
        plant=plant,
        parameters=values,
        std=std,
        interval=intervals,
        determined=determined,
        covariance=covariance,
        at_bounds=tuple(name for name, is_held in zip(names, held, strict=True) if is_held),
        internal=damping_size("zeta", "alpha", values, determined, covariance),
        external=damping_size("gamma", "lambda", values, determined, covariance),
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
