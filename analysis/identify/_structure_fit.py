"""Fit of a damping structure of an installed package to a whole record.

Data and noise spectrum are those of the fits of types I to VII, so that the costs are comparable.
The poles of the free decay at the start of the record are those of the type with the lowest BIC.
They hardly matter: nearly all records begin at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import bic
from analysis.identify._problem import Objective
from analysis.identify._settings import free_settings
from analysis.identify._structure_plant import StructureUnknowns
from analysis.identify._uncertainty import covariance_of_unknowns
from analysis.identify.parametrization import Unknowns
from analysis.models import UNDAMPED
from analysis.optimizer import ConstantBounds
from analysis.statistics import BIC_DECISIVE
from rigd.beam import LOGARITHMIC_PARAMETERS
from rigd.plugins import plugin_errors

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from analysis.identify._select import Selection
    from analysis.identify._settings import Setting
    from analysis.models import Structure
    from analysis.structures import AddedStructure

_ROUGH_COST_TOLERANCE: Final = 1e-3
"""Relative tolerance of the cost in the descents from several starts."""
_COST_TOLERANCE: Final = 1e-8
"""Relative tolerance of the cost at the minimum."""
_MAX_FINE_DESCENTS: Final = 3
"""Maximum number of starts, those of the lowest cost, from which descents begin."""
_MAX_EVALUATIONS: Final = 60
"""Largest number of evaluations of a descent."""


@dataclass(frozen=True, slots=True)
class StructureFit:
    """Fit of a package's damping structure to a whole record.

    Attributes
    ----------
    structure : Structure
        Fitted structure.
    package : str
        Name and version of the package that adds it.
    parameters : mapping of str to float
        Values of the structure's parameters and of the settings (`SETTINGS`), fixed ones included.
    std : mapping of str to (float or None)
        Standard deviations of the free parameters; None for those at a bound of their range or not
        determined by the data.
    at_bounds : tuple of str
        Free parameters at a bound of their range.
    loss_factors : tuple of (float, float)
        Frequency in Hz of each visible mode, and the loss factor of the structure there: internal
        relative to the stiffness, plus external relative to the inertia.
    cost : float
        Sum of squares of the whitened residual.
    degrees_of_freedom : int
        Cost that is expected if the residual is noise only.
    delta_bic : float
        Bayesian information criterion (BIC) minus the lowest one of types I to VII.
    compared_with : str
        Name of the type with the lowest BIC.
    residual : ndarray of complex, shape (K,)
        Whitened spectrum of the residual.
    """

    structure: Structure
    package: str
    parameters: Mapping[str, float]
    std: Mapping[str, float | None]
    at_bounds: tuple[str, ...]
    loss_factors: tuple[tuple[float, float], ...]
    cost: float
    degrees_of_freedom: int
    delta_bic: float
    compared_with: str
    residual: NDArray[np.complex128]

    @property
    def sentence(self) -> str:
        """Return the sentence that compares this structure with types I to VII by BIC."""
        is_above = self.delta_bic > 0
        bic_text = (
            f"its BIC is {abs(self.delta_bic):.3g} {'above' if is_above else 'below'} that of type "
            f"{self.compared_with}"
        )
        meaning_text = "the record supports it less" if is_above else "the record supports it more"
        if abs(self.delta_bic) < BIC_DECISIVE:
            meaning_text = "the record does not distinguish the two"
        return (
            f"Structure {self.structure.name} of {self.package} "
            f"({self.structure.description[:1].lower()}{self.structure.description[1:]}): "
            f"{bic_text}, so {meaning_text}. The reported numbers are those of types I to VII."
        )


def fit_structure(
    added_structure: AddedStructure, selection: Selection, fixed_settings: tuple[Setting, ...] = ()
) -> StructureFit | None:
    """Fit the damping structure of a package to the record of a selection.

    Return None if drag, a change along the record or another effect is part of the selected model:
    the costs would not be comparable.

    Parameters
    ----------
    added_structure : AddedStructure
        Structure and its package.
    selection : Selection
        Selection among types I to VII, with data and noise spectrum of the record.
    fixed_settings : tuple of str
        Settings that stay at the values the file states.

    Raises
    ------
    PluginError
        If the code of the package fails, or its damping is not finite somewhere in its range.
    """
    structure, plugin = added_structure.structure, added_structure.plugin
    best_candidate = selection.candidates[0]
    if best_candidate.nonlinear_effect_count or selection.analysis.comparison.drag is not None:
        return None
    noise = selection.analysis.noise
    comparison = selection.analysis.comparison
    undamped_unknowns = Unknowns.for_structure(
        UNDAMPED, comparison.measurement.nominal_plant, free_settings(fixed_settings)
    )
    unknowns = StructureUnknowns(
        structure,
        undamped_unknowns.nominal_plant,
        undamped_unknowns.free_settings,
        undamped_unknowns.omega_rad_s,
        comparison.poles(best_candidate.fit.plant),
    )
    region = ConstantBounds(*unknowns.bounds)
    with plugin_errors(plugin):
        try:
            objective = Objective(comparison, unknowns)
            start_vectors = [
                unknowns.vector_near(v, best_candidate.fit.plant) for v in structure.start_values()
            ]
            if len(start_vectors) > _MAX_FINE_DESCENTS:
                start_vectors.sort(
                    key=lambda vector_of_unknowns: (
                        objective.normal_equations(vector_of_unknowns, noise.weight).cost
                    )
                )
            objectives_and_minima = [
                objective.find_minimum(
                    start_vector,
                    noise.weight,
                    region,
                    relative_tolerance=_ROUGH_COST_TOLERANCE,
                    max_evaluations=_MAX_EVALUATIONS,
                )
                for start_vector in start_vectors[:_MAX_FINE_DESCENTS]
            ]
            objective, rough_minimum = min(
                objectives_and_minima,
                key=lambda objective_and_minimum: objective_and_minimum[1].cost,
            )
            objective, minimum = objective.find_minimum(
                rough_minimum.x, noise.weight, region, relative_tolerance=_COST_TOLERANCE
            )
            vector_of_unknowns = minimum.x
            projected_residual = objective.project(
                objective.linearise(vector_of_unknowns), noise.weight
            )
            plant, slopes = unknowns.plant_and_gradient(vector_of_unknowns)
            loss_factors = tuple(
                (pole.frequency_hz, plant.loss_factor(abs(pole.at_rad_s)))
                for pole in unknowns.decay_poles
                if pole.oscillates
            )
        except ValueError as error:
            raise plugin.error(str(error)) from error
    degrees_of_freedom = (
        best_candidate.compared_value_count
        - vector_of_unknowns.size
        - best_candidate.fit.ringing.degrees_of_freedom
    )
    at_bound = (vector_of_unknowns <= region.lower) | (vector_of_unknowns >= region.upper)
    covariance, determined = covariance_of_unknowns(
        projected_residual.jacobian, projected_residual.cost / degrees_of_freedom, at_bound
    )
    parameter_stds = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    parameters = unknowns.parameters(vector_of_unknowns)
    parameter_names = unknowns.names
    return StructureFit(
        structure=structure,
        package=plugin.label,
        parameters=parameters,
        std={
            name: (float(std) * (parameters[name] if name in LOGARITHMIC_PARAMETERS else 1.0))
            if is_determined
            else None
            for name, std, is_determined in zip(
                parameter_names, parameter_stds, determined, strict=True
            )
        },
        at_bounds=tuple(
            name for name, is_at_bound in zip(parameter_names, at_bound, strict=True) if is_at_bound
        ),
        loss_factors=loss_factors,
        cost=minimum.cost,
        degrees_of_freedom=degrees_of_freedom,
        delta_bic=bic(minimum.cost, best_candidate.compared_value_count, vector_of_unknowns.size)
        - best_candidate.bic,
        compared_with=best_candidate.name,
        residual=projected_residual.residual,
    )
