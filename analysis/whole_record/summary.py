"""From the point where a descent ended to everything that follows from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.whole_record.parameter_uncertainty import parameter_uncertainty
from analysis.whole_record.result import RecordFit
from analysis.whole_record.uncertainty import (
    covariance_of_unknowns,
    interval_from_zero,
    mode_table,
    ringing,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.noise import Noise
    from analysis.whole_record.objective import Objective, Projected


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
    names, plant = unknowns.names, unknowns.plant(x)
    values = unknowns.parameters(x)
    of = parameter_uncertainty(unknowns, x, held, of_unknowns, known)
    std, intervals = dict(of.std), dict(of.interval)
    tool = "tool_inertia_kg_m2"
    if tool in names and held[names.index(tool)]:
        place = names.index(tool)
        free = held & (np.arange(held.size) != place)
        every, _ = covariance_of_unknowns(jacobian, scatter, free)
        chain = unknowns.estimates_by_unknowns(x)
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
        determined=of.determined,
        covariance=of.covariance,
        at_bounds=of.at_bounds,
        internal=of.internal,
        external=of.external,
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
