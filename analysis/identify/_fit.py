"""Output-error estimation from a whole record: fit of the predicted to the measured torque."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import HOPELESS_BIC_DIFFERENCE
from analysis.identify._comparison import Comparison
from analysis.identify._problem import Objective
from analysis.identify._result import RecordAnalysis, RecordFit
from analysis.identify._search import CoarseResponse, Descent, StructureSearch
from analysis.identify._settings import SETTINGS, free_settings
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
    from analysis.identify._problem import ProjectedResidual
    from analysis.identify._settings import Setting
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure
    from rigd.beam import Plant

BAND_HZ: Final[tuple[float, float]] = RECORD_BAND_HZ
"""First and last frequency that are compared, unless another band is given."""

_COST_TOLERANCE: Final = 1e-9
"""Relative tolerance of the cost in a descent: it moves the minimum by less than a hundredth of a
standard deviation."""

_ROUGH_COST_TOLERANCE: Final = 1e-4
"""Relative tolerance of the cost in a descent before noise and lines have been estimated: it moves
the minimum by about a standard deviation."""

_HOPELESS_FIT_EVALUATIONS: Final = 20
"""Number of evaluations after which the descent of a structure ends if its cost is far above that
of the closest structure. Such a descent converges slowly, along a flat direction that damping of
the wrong kind causes."""

_SHORT_DESCENT_EVALUATIONS: Final = 4
"""Number of evaluations after which the descent of a structure ends if its cost was, and still is,
far above that of the closest structure."""

_MAX_REFERENCE_ESTIMATES: Final = 3
"""Maximum number of estimates of the part of the angle that follows the reference. Each estimate
leaves a fifth of the bias that a narrow-band disturbance caused."""


def fit_record(
    measurement: Measurement,
    structures: Iterable[Structure] = tuple(STRUCTURES.values()),
    *,
    fixed_settings: Iterable[Setting] = (),
    band_hz: tuple[float, float] = BAND_HZ,
) -> RecordAnalysis:
    """Fit damping structures to a whole record in a band.

    The torque is predicted from the measured angle (`TorquePredictor`). The squared residual,
    whitened with the estimated noise spectrum, is minimised over the damping and over density over
    stiffness, stiffness, delay and tool inertia. For noise in the torque alone this is the
    maximum-likelihood estimate, whatever the excitation. If a controller made the motor follow a
    reference, the noise moves the motor as well. The part of the angle coherent with the reference
    is then used as input (`analysis.identify._instrument`).

    Parameters
    ----------
    measurement : Measurement
        Record to which the structures are fitted.
    structures : iterable of Structure
        Structures to fit. All use one noise spectrum, so that their costs are comparable: that of
        the structure closest to the coarse response.
    fixed_settings : iterable of str
        Settings (`SETTINGS`) that stay at the values the file states.
    band_hz : tuple of float
        First and last frequency compared.

    Raises
    ------
    MeasurementError
        The record cannot be used.
    ValueError
        `fixed_settings` contains a name that is no setting.
    """
    fixed_settings = tuple(fixed_settings)
    invalid_names = sorted(set(fixed_settings) - set(SETTINGS))
    if invalid_names:
        raise ValueError(f"{invalid_names} cannot be fixed: choose from {SETTINGS}.")
    free_names = free_settings(fixed_settings)
    comparison = Comparison.from_measurement(measurement, band_hz)
    nominal_plant = measurement.nominal_plant
    coarse_response = CoarseResponse(comparison)
    searches = [
        StructureSearch.from_objective(Objective(comparison, unknowns), coarse_response)
        for unknowns in (
            Unknowns.for_structure(structure, nominal_plant, free_names) for structure in structures
        )
    ]
    closest_index = min(
        range(len(searches)), key=lambda search_index: searches[search_index].minima[0].cost
    )
    reference_descent = searches[closest_index].lowest_coarse_minimum()
    reference_descent = reference_descent.descend_to_minimum(
        reference_descent.noise(), _ROUGH_COST_TOLERANCE
    )
    whole_angle_comparison = reference_descent.objective.comparison
    comparison = whole_angle_comparison.use_reference_coherent_angle(reference_descent.plant)
    searches = [search.with_comparison(comparison) for search in searches]
    reference_descent = Descent(searches[closest_index].objective, reference_descent.x)
    hum_free_descent = reference_descent.remove_hum(_ROUGH_COST_TOLERANCE)
    if hum_free_descent is not reference_descent:
        reference_descent = _update_coherent_angle(hum_free_descent, whole_angle_comparison)
        comparison = reference_descent.objective.comparison
        coarse_response = CoarseResponse(comparison)
        searches = [
            StructureSearch.from_objective(Objective(comparison, search.unknowns), coarse_response)
            for search in searches
        ]
    # The incoherent part of the angle may contain the beam's motion, and not noise alone. It is
    # re-estimated with the closest structure, before and after all others are fitted.
    updated_descent = reference_descent.with_reestimated_angle(
        reference_descent.noise(), _ROUGH_COST_TOLERANCE
    )
    descents: list[Descent] = []
    for _ in range(_MAX_REFERENCE_ESTIMATES):
        if updated_descent is not reference_descent:
            reference_descent = updated_descent
            comparison = reference_descent.objective.comparison
            searches = [search.with_comparison(comparison) for search in searches]
        noise, descents = _descend_with_noise(searches, closest_index, reference_descent, descents)
        closest_index = min(
            range(len(searches)), key=lambda search_index: descents[search_index].cost(noise)
        )
        reference_descent = descents[closest_index]
        if not _residual_is_noise(reference_descent, noise):
            break  # none of these explains it, so a further pass does not distinguish them better
        updated_descent = reference_descent.with_reestimated_angle(noise, _ROUGH_COST_TOLERANCE)
        if updated_descent is reference_descent:
            break
    fits = (record_fit_summary(descent.objective, descent.x, noise) for descent in descents)
    return RecordAnalysis.from_fits(fits, noise, comparison)


def refit_record(
    measurement: Measurement,
    unknowns: Unknowns,
    plant: Plant,
    *,
    band_hz: tuple[float, float] = BAND_HZ,
) -> RecordAnalysis | None:
    """Fit one structure, starting from a plant that explained an earlier part of the record.

    Return None if the residual is more than noise, or contains a hum: then a full search is needed.
    `measurement` is the longer record, and `band_hz` the band that is compared. Raise
    `MeasurementError` if the record cannot be used.
    """
    comparison = Comparison.from_measurement(measurement, band_hz).use_reference_coherent_angle(
        plant
    )
    descent = Descent(Objective(comparison, unknowns), unknowns.vector(plant))
    descent = descent.descend_to_minimum(descent.noise(), _ROUGH_COST_TOLERANCE)
    descent = descent.with_reestimated_angle(descent.noise(), _ROUGH_COST_TOLERANCE)
    if descent.hum():
        return None
    noise = descent.noise(with_lines=True)
    descent = descent.descend_to_minimum(noise, _COST_TOLERANCE)
    if not _residual_is_noise(descent, noise):
        return None
    comparison = descent.objective.comparison
    return RecordAnalysis.from_fits(
        [record_fit_summary(descent.objective, descent.x, noise)], noise, comparison
    )


def _descend_with_noise(
    searches: list[StructureSearch],
    closest_index: int,
    reference_descent: Descent,
    earlier_descents: list[Descent],
) -> tuple[NoiseSpectrum, list[Descent]]:
    """Fit all structures under the noise estimated from the residual of the closest structure.

    `searches` holds one search for each structure; `closest_index` is the index of the closest
    structure, and `reference_descent` its descent. `earlier_descents` are the results of the last
    call, with an earlier estimate of the input; empty at the first call. A structure whose cost was
    far above that of the closest one is not searched for again.
    """
    # Lines are searched for once, in the residual of a fit to every bin.
    noise_spectrum = reference_descent.noise(with_lines=True)
    hum = reference_descent.objective.comparison.hum
    noise_spectrum = replace(
        noise_spectrum, lines=(*noise_spectrum.lines, *(removed_hum.line for removed_hum in hum))
    )
    closest_descent = (
        searches[closest_index]
        .descend_to_lowest(noise_spectrum, reference_descent)
        .descend_to_minimum(noise_spectrum, _COST_TOLERANCE)
    )
    hopeless_cost_ratio = math.exp(
        HOPELESS_BIC_DIFFERENCE / (2 * np.count_nonzero(noise_spectrum.is_compared))
    )
    cost_limit = hopeless_cost_ratio * closest_descent.cost(noise_spectrum)
    structure_descents = []
    for i, search in enumerate(searches):
        descent = closest_descent if i == closest_index else None
        if descent is None and earlier_descents:
            descent = _descent_if_still_worse(
                Descent(search.objective, earlier_descents[i].x), noise_spectrum, cost_limit
            )
        if descent is None:
            descent = search.descend_to_lowest(noise_spectrum).descend_to_minimum(
                noise_spectrum, _COST_TOLERANCE, (_HOPELESS_FIT_EVALUATIONS, cost_limit)
            )
        structure_descents.append(descent)
    return noise_spectrum, structure_descents


def _residual_is_noise(descent: Descent, noise: NoiseSpectrum) -> bool:
    """Return whether the residual at the end of a descent is white at the 1 % level."""
    objective, is_compared = descent.objective, noise.is_compared
    residual = objective.project(objective.linearise(descent.x), noise.weight).residual
    frequency_hz = objective.comparison.frequency_hz
    return whiteness(residual[is_compared], frequency_hz[is_compared]).is_nearly_white


def _descent_if_still_worse(
    earlier_descent: Descent, noise: NoiseSpectrum, cost_limit: float
) -> Descent | None:
    """Continue a descent briefly; return it if its cost stays above a limit, else None."""
    if earlier_descent.cost(noise) <= cost_limit:
        return None
    short_descent = earlier_descent.descend_to_minimum(
        noise, _COST_TOLERANCE, (_SHORT_DESCENT_EVALUATIONS, cost_limit)
    )
    return short_descent if short_descent.cost(noise) > cost_limit else None


def _update_coherent_angle(descent: Descent, whole_angle_comparison: Comparison) -> Descent:
    """Return a descent whose input, the angle that follows the reference, is estimated without hum.

    The first estimate was biased by the hum.
    """
    hum, unknowns = descent.objective.comparison.hum, descent.objective.unknowns
    for _ in range(_MAX_REFERENCE_ESTIMATES):
        comparison = whole_angle_comparison.use_reference_coherent_angle(descent.plant).remove_hum(
            hum
        )
        descent = Descent(Objective(comparison, unknowns), descent.x)
        descent = descent.descend_to_minimum(descent.noise(), _COST_TOLERANCE)
        hum = descent.hum() or hum
    return Descent(Objective(descent.objective.comparison.remove_hum(hum), unknowns), descent.x)


# Result at a minimum


def record_fit_summary(
    objective: Objective, vector_of_unknowns: NDArray[np.float64], noise: NoiseSpectrum
) -> RecordFit:
    """Return the fit at a minimum of the cost: parameters, uncertainties, modes and residual.

    `vector_of_unknowns`, shape (k,), are the unknowns at the minimum, which was found under the
    noise spectrum `noise`.
    """
    unknowns, comparison = objective.unknowns, objective.comparison
    linearisation = objective.linearise(vector_of_unknowns)
    projected_residual = objective.project(linearisation, noise.weight)
    # Where the torque is unknown the residual is 0 and adds nothing to the cost.
    compared_value_count = round(
        2 * np.sum(noise.is_compared) * comparison.measurement.known_torque_fraction
    )
    degrees_of_freedom = (
        compared_value_count - vector_of_unknowns.size - projected_residual.amplitudes.size
    )
    residual_variance = projected_residual.cost / degrees_of_freedom
    lower_bounds, upper_bounds = unknowns.bounds
    is_at_bound = (vector_of_unknowns <= lower_bounds) | (vector_of_unknowns >= upper_bounds)
    jacobian = _compared_jacobian(objective, vector_of_unknowns, projected_residual, noise)
    covariance, is_determined = covariance_of_unknowns(jacobian, residual_variance, is_at_bound)
    unknown_names, plant = unknowns.names, unknowns.plant(vector_of_unknowns)
    parameter_values = unknowns.parameters(vector_of_unknowns)
    parameter_uncertainties = parameter_uncertainty(
        unknowns, vector_of_unknowns, is_at_bound, covariance, is_determined
    )
    std, intervals = dict(parameter_uncertainties.std), dict(parameter_uncertainties.interval)
    tool_inertia_name = "tool_inertia_kg_m2"
    if tool_inertia_name in unknown_names and is_at_bound[unknown_names.index(tool_inertia_name)]:
        inertia_index = unknown_names.index(tool_inertia_name)
        is_other_at_bound = is_at_bound & (np.arange(is_at_bound.size) != inertia_index)
        free_covariance, _ = covariance_of_unknowns(jacobian, residual_variance, is_other_at_bound)
        estimates_by_unknowns = unknowns.estimates_by_unknowns(vector_of_unknowns)
        std[tool_inertia_name] = float(
            estimates_by_unknowns[inertia_index, inertia_index]
            * free_covariance[inertia_index, inertia_index] ** 0.5
        )
    tool_inertia_std = std.get(tool_inertia_name)
    if tool_inertia_name in unknown_names and tool_inertia_std:
        intervals[tool_inertia_name] = interval_from_zero(
            parameter_values[tool_inertia_name], tool_inertia_std
        )
    hum_spectra = (
        comparison.decay_spectra.hum([noise_line.frequency_hz for noise_line in noise.lines])
        * noise.weight
    )
    return RecordFit(
        structure=unknowns.structure,
        plant=plant,
        parameters=parameter_values,
        std=std,
        interval=intervals,
        determined=parameter_uncertainties.determined,
        covariance=parameter_uncertainties.covariance,
        at_bounds=parameter_uncertainties.at_bounds,
        internal=parameter_uncertainties.internal,
        external=parameter_uncertainties.external,
        modes=mode_table(linearisation.poles, covariance),
        ringing=ringing(
            linearisation.poles,
            projected_residual,
            residual_variance,
            objective.unknown_torque_spectra(linearisation) * noise.weight,
            hum_spectra,
        ),
        cost=projected_residual.cost,
        degrees_of_freedom=degrees_of_freedom,
        residual=projected_residual.residual,
    )


def _compared_jacobian(
    objective: Objective,
    vector_of_unknowns: NDArray[np.float64],
    projected_residual: ProjectedResidual,
    noise: NoiseSpectrum,
) -> NDArray[np.complex128]:
    """Return the whitened derivatives of the measured torque's spectrum by the unknowns, (k, K).

    Torques that are unknown, and filled by the prediction, contribute nothing.
    """
    comparison, unknowns = objective.comparison, objective.unknowns
    if comparison.measurement.torque_known.all():
        return projected_residual.jacobian
    plant, parameters_by_unknowns = unknowns.plant_and_gradient(vector_of_unknowns)
    unknown_gradient = comparison.gradient_at_unknown_torque(plant, unknowns.gradient_names)
    unknown_jacobian = noise.weight * (parameters_by_unknowns.T @ unknown_gradient)
    return projected_residual.jacobian - unknown_jacobian
