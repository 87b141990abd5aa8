"""Output-error estimation on the whole record: measured torque against predicted torque."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import FAR_BEHIND
from analysis.identify._comparison import Comparison
from analysis.identify._plant import SETTINGS, free_settings
from analysis.identify._problem import Objective
from analysis.identify._result import RecordAnalysis, RecordFit
from analysis.identify._search import CoarseResponse, Descent, StructureSearch
from analysis.identify._uncertainty import (
    covariance_of_unknowns,
    interval_from_zero,
    mode_table,
    parameter_uncertainty,
    ringing,
)
from analysis.identify.parametrization import Unknowns
from analysis.identify.residual_tests import whiteness
from analysis.models import RECORD_BAND_HZ, STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from analysis.identify._data import Measurement
    from analysis.identify._plant import Plant, Setting
    from analysis.identify._problem import Projected
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure

BAND_HZ: Final[tuple[float, float]] = RECORD_BAND_HZ
_TOLERANCE: Final = 1e-9
"""Relative tolerance of the sum of squares: less than a hundredth of a standard deviation."""

_BEFORE_LINES: Final = 1e-4
"""The same while noise and lines are still to be found: a standard deviation."""

_PATIENCE: Final = 20
"""Evaluations after which a structure far behind the closest one is left where it is: it
converges slowly along a flat direction that damping of the wrong kind causes."""

_EARLY_EVALUATIONS: Final = 4
"""The same for one that was far behind before."""

_REPEATS: Final = 3
"""Each leaves a fifth of the bias that a narrow-band disturbance caused."""


def fit_record(
    measurement: Measurement,
    structures: Iterable[Structure] = tuple(STRUCTURES.values()),
    *,
    fixed: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
) -> RecordAnalysis:
    """Fit structures to a whole record in the band.

    The torque is predicted from the measured angle (`TorquePredictor`); the squared residual,
    whitened with the estimated noise spectrum, is minimised over the damping and over density over
    stiffness, stiffness, delay and tool inertia. For noise in the torque alone that is the
    maximum-likelihood estimate, whatever the excitation. Where a controller held the motor to a
    reference, the part coherent with that is used as input (`analysis.identify._instrument`): the
    noise then moves the motor as well.

    Parameters
    ----------
    measurement : Measurement
    structures : iterable of Structure
        All use one noise spectrum, that of the one closest to the coarse response, so that their
        costs are comparable.
    fixed : iterable of str
        Settings (`SETTINGS`) that stay at the values the file states.
    band_hz : tuple of float
        First and last frequency compared.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    ValueError
        There is no such setting.
    """
    fixed = tuple(fixed)
    unknown = sorted(set(fixed) - set(SETTINGS))
    if unknown:
        raise ValueError(f"{unknown} cannot be fixed: choose from {SETTINGS}.")
    free = free_settings(fixed)
    comparison = Comparison.of(measurement, band_hz)
    nominal = measurement.nominal
    coarse = CoarseResponse(comparison)
    searches = [
        StructureSearch.of(Objective(comparison, unknowns), coarse)
        for unknowns in (Unknowns.of(structure, nominal, free) for structure in structures)
    ]
    closest = min(range(len(searches)), key=lambda i: searches[i].minima[0].cost)
    reference = searches[closest].lowest()
    reference = reference.to_minimum(reference.noise(), _BEFORE_LINES)
    whole = reference.objective.comparison
    comparison = whole.following_reference(reference.plant)
    searches = [search.on(comparison) for search in searches]
    reference = Descent(searches[closest].objective, reference.x)
    clean = reference.without_hum(_BEFORE_LINES)
    if clean is not reference:
        reference = _followed_again(clean, whole)
        comparison = reference.objective.comparison
        coarse = CoarseResponse(comparison)
        searches = [
            StructureSearch.of(Objective(comparison, search.unknowns), coarse)
            for search in searches
        ]
    # What was apart from the reference may hide the beam, or stand for noise. The closest structure
    # shows that before all others are fitted, and the closest of all once they are.
    renewed = reference.renewed(reference.noise(), _BEFORE_LINES)
    descents: list[Descent] = []
    for _ in range(_REPEATS):
        if renewed is not reference:
            reference = renewed
            comparison = reference.objective.comparison
            searches = [search.on(comparison) for search in searches]
        noise, descents = _descend_with_noise(searches, closest, reference, descents)
        closest = min(range(len(searches)), key=lambda i: descents[i].cost(noise))
        reference = descents[closest]
        if not _explains(reference, noise):
            break  # none of these explains it, so a further pass does not distinguish them better
        renewed = reference.renewed(noise, _BEFORE_LINES)
        if renewed is reference:
            break
    fits = (summary(descent.objective, descent.x, noise) for descent in descents)
    return RecordAnalysis.of(fits, noise, comparison)


def refit_record(
    measurement: Measurement,
    unknowns: Unknowns,
    plant: Plant,
    *,
    band_hz: tuple[float, float] = BAND_HZ,
) -> RecordAnalysis | None:
    """Fit one structure from a plant that explained an earlier part of the record.

    Parameters
    ----------
    measurement : Measurement
    unknowns : Unknowns
    plant : Plant
    band_hz : tuple of float

    Returns
    -------
    RecordAnalysis or None
        None if the residual is more than noise, or a hum: then a search is needed.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    """
    comparison = Comparison.of(measurement, band_hz).following_reference(plant)
    here = Descent(Objective(comparison, unknowns), unknowns.vector(plant))
    here = here.to_minimum(here.noise(), _BEFORE_LINES)
    here = here.renewed(here.noise(), _BEFORE_LINES)
    if here.hum():
        return None
    noise = here.noise(with_lines=True)
    here = here.to_minimum(noise, _TOLERANCE)
    if not _explains(here, noise):
        return None
    comparison = here.objective.comparison
    return RecordAnalysis.of([summary(here.objective, here.x, noise)], noise, comparison)


def _descend_with_noise(
    searches: list[StructureSearch], closest: int, reference: Descent, before: list[Descent]
) -> tuple[NoiseSpectrum, list[Descent]]:
    """Descend with all structures under the noise of the closest one's residual.

    `searches` holds one search for each structure; `closest` is the index of the closest one, and
    `reference` its descent. `before` holds the descents before the part that follows the reference
    was re-estimated, and is empty the first time: a structure far behind then is not searched for
    again.
    """
    # Lines are searched for once, in the residual of a fit to every bin.
    noise = reference.noise(with_lines=True)
    hum = reference.objective.comparison.hum
    noise = replace(noise, lines=(*noise.lines, *(each.line for each in hum)))
    first = searches[closest].under(noise, reference).to_minimum(noise, _TOLERANCE)
    behind = math.exp(FAR_BEHIND / (2 * np.count_nonzero(noise.counts)))
    most = behind * first.cost(noise)
    descents = []
    for i, search in enumerate(searches):
        found = first if i == closest else None
        if found is None and before:
            found = _still_worse(Descent(search.objective, before[i].x), noise, most)
        if found is None:
            found = search.under(noise).to_minimum(noise, _TOLERANCE, (_PATIENCE, most))
        descents.append(found)
    return noise, descents


def _explains(closest: Descent, noise: NoiseSpectrum) -> bool:
    """Return whether chance explains the residual of a structure."""
    objective, counts = closest.objective, noise.counts
    residual = objective.project(objective.linearise(closest.x), noise.weight).residual
    hz = objective.comparison.frequency_hz
    return whiteness(residual[counts], hz[counts]).all_but_white


def _still_worse(before: Descent, noise: NoiseSpectrum, most: float) -> Descent | None:
    """Return the descent of a structure that stays above a cost; None if it does not."""
    if before.cost(noise) <= most:
        return None
    found = before.to_minimum(noise, _TOLERANCE, (_EARLY_EVALUATIONS, most))
    return found if found.cost(noise) > most else None


def _followed_again(clean: Descent, whole: Comparison) -> Descent:
    """Recompute the incoherent part: the first estimate was biased by a disturbance."""
    hum, unknowns = clean.objective.comparison.hum, clean.objective.unknowns
    for _ in range(_REPEATS):
        comparison = whole.following_reference(clean.plant).without_hum(hum)
        clean = Descent(Objective(comparison, unknowns), clean.x)
        clean = clean.to_minimum(clean.noise(), _TOLERANCE)
        hum = clean.hum() or hum
    return Descent(Objective(clean.objective.comparison.without_hum(hum), unknowns), clean.x)


# Result at a minimum


def summary(objective: Objective, x: NDArray[np.float64], noise: NoiseSpectrum) -> RecordFit:
    """Return parameters, uncertainty, modes and residual at a minimum.

    Parameters
    ----------
    objective : Objective
    x : ndarray, shape (k,)
        The minimum.
    noise : Noise
        Noise model when it was found.
    """
    unknowns, comparison = objective.unknowns, objective.comparison
    at = objective.linearise(x)
    projected = objective.project(at, noise.weight)
    # Where a torque is unknown the residual is nought and adds nothing to the sum.
    compared = round(2 * np.sum(noise.counts) * comparison.measurement.known_torque_fraction)
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
        index = names.index(tool)
        free = held & (np.arange(held.size) != index)
        every, _ = covariance_of_unknowns(jacobian, scatter, free)
        chain = unknowns.estimates_by_unknowns(x)
        std[tool] = float(chain[index, index] * every[index, index] ** 0.5)
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
    noise: NoiseSpectrum,
) -> NDArray[np.complex128]:
    """Return the Jacobian of the known torques, shape (k, K)."""
    comparison, unknowns = objective.comparison, objective.unknowns
    if comparison.measurement.torque_known.all():
        return projected.jacobian
    plant, chain = unknowns.plant_and_gradient(x)
    lost = comparison.gradient_at_unknown_torque(plant, unknowns.gradient_names)
    weighted = noise.weight * (chain.T @ lost)
    return projected.jacobian - weighted
