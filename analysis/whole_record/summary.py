"""From the point where a descent ended to everything that follows from it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.whole_record.plant import LOGARITHMIC
from analysis.whole_record.result import RecordFit
from analysis.whole_record.uncertainty import (
    covariance_of_unknowns,
    damping_size,
    interval,
    interval_from_zero,
    mode_table,
    ringing,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.noise import Noise
    from analysis.whole_record.objective import Objective, Projected

_UNDETERMINED: Final = 20.0
"""Standard deviation of a logarithm that says nothing: a factor of 1e9 either way."""


def summary(objective: Objective, x: NDArray[np.float64], noise: Noise) -> RecordFit:
    """Parameters, uncertainty, modes and residual at a minimum.

    Parameters
    ----------
    objective : Objective
    x : ndarray, shape (k,)
        The minimum.
    noise : Noise
        What was taken for noise when it was found.
    """
    unknowns, comparison = objective.unknowns, objective.comparison
    at = objective.linearise(x)
    projected = objective.project(at, noise.weight)
    # Where a torque is unknown the residual is nought and adds nothing to the sum.
    compared = round(2 * np.sum(noise.counts) * comparison.measurement.torque_share)
    freedom = compared - x.size - projected.amplitudes.size
    scatter = projected.cost / freedom
    lower, upper = unknowns.bounds
    held = (x <= lower) | (x >= upper)
    jacobian = _compared_jacobian(objective, x, projected, noise)
    of_unknowns, known = covariance_of_unknowns(jacobian, scatter, held)
    chain = unknowns.estimates_by_unknowns(x)
    every_covariance = chain @ of_unknowns @ chain.T
    names, plant = unknowns.names, unknowns.plant(x)
    values = plant.parameters
    logarithmic = np.array([name in LOGARITHMIC for name in names])
    known &= ~(logarithmic & (np.diag(every_covariance) > _UNDETERMINED**2))
    covariance = every_covariance[np.ix_(known, known)]

    determined = tuple(name for name, is_known in zip(names, known, strict=True) if is_known)
    estimated = dict(zip(determined, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    std: dict[str, float | None] = dict.fromkeys(values, 0.0) | dict.fromkeys(names, None)
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(names, None)
    for name, spread in estimated.items():
        std[name] = values[name] * spread if name in LOGARITHMIC else spread
        intervals[name] = interval(name, values[name], spread)
    tool = "tool_inertia_kg_m2"
    if tool in names and held[names.index(tool)]:
        place = names.index(tool)
        free = held & (np.arange(held.size) != place)
        every, _ = covariance_of_unknowns(jacobian, scatter, free)
        std[tool] = float(chain[place, place] * every[place, place] ** 0.5)
    spread = std.get(tool)
    if tool in names and spread:
        intervals[tool] = interval_from_zero(values[tool], spread)
    hum = comparison.decays.hum([line.frequency_hz for line in noise.lines]) * noise.weight
    return RecordFit(
        structure=unknowns.structure,
        plant=plant,
        parameters=values,
        std=std,
        interval=intervals,
        determined=determined,
        covariance=covariance,
        at_bounds=tuple(name for name, is_held in zip(names, held, strict=True) if is_held),
        internal=damping_size("zeta", "alpha", values, determined, covariance),
        external=damping_size("gamma", "lambda", values, determined, covariance),
        modes=mode_table(at.poles, of_unknowns),
        ringing=ringing(at.poles, projected, scatter, at.columns * noise.weight, hum),
        cost=projected.cost,
        degrees_of_freedom=freedom,
        residual=projected.residual,
    )


def _compared_jacobian(
    objective: Objective,
    x: NDArray[np.float64],
    projected: Projected,
    noise: Noise,
) -> NDArray[np.complex128]:
    """Jacobian of the torques that are known, shape (k, K)."""
    comparison, unknowns = objective.comparison, objective.unknowns
    if comparison.measurement.torque_known.all():
        return projected.jacobian
    lost = comparison.lost_gradient(unknowns.plant(x), unknowns.gradient_names)
    weighted = noise.weight * (unknowns.gradient_by_unknowns(x).T @ lost)
    return projected.jacobian - weighted
