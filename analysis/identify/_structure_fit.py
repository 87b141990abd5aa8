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
_MAX_DESCENTS: Final = 3
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
        above = self.delta_bic > 0
        difference = (
            f"its BIC is {abs(self.delta_bic):.3g} {'above' if above else 'below'} that of type "
            f"{self.compared_with}"
        )
        meaning = "the record supports it less" if above else "the record supports it more"
        if abs(self.delta_bic) < BIC_DECISIVE:
            meaning = "the record does not distinguish the two"
        return (
            f"Structure {self.structure.name} of {self.package} "
            f"({self.structure.description[:1].lower()}{self.structure.description[1:]}): "
            f"{difference}, so {meaning}. The reported numbers are those of types I to VII."
        )


def fit_structure(
    added_structure: AddedStructure, selection: Selection, fixed: tuple[Setting, ...] = ()
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
    fixed : tuple of str
        Settings that stay at the values the file states.

    Raises
    ------
    PluginError
        If the code of the package fails, or its damping is not finite somewhere in its range.
    """
    structure, plugin = added_structure.structure, added_structure.plugin
    best = selection.candidates[0]
    if best.nonlinear_effect_count or selection.analysis.comparison.drag is not None:
        return None
    noise = selection.analysis.noise
    comparison = selection.analysis.comparison
    undamped_unknowns = Unknowns.for_structure(
        UNDAMPED, comparison.measurement.nominal_plant, free_settings(fixed)
    )
    unknowns = StructureUnknowns(
        structure,
        undamped_unknowns.nominal,
        undamped_unknowns.free_settings,
        undamped_unknowns.omega_rad_s,
        comparison.poles(best.fit.plant),
    )
    region = ConstantBounds(*unknowns.bounds)
    with plugin_errors(plugin):
        try:
            objective = Objective(comparison, unknowns)
            starts = [unknowns.vector_near(v, best.fit.plant) for v in structure.start_values()]
            if len(starts) > _MAX_DESCENTS:
                starts.sort(key=lambda x: objective.normal_equations(x, noise.weight).cost)
            descents = [
                objective.find_minimum(
                    start,
                    noise.weight,
                    region,
                    relative_tolerance=_ROUGH_COST_TOLERANCE,
                    max_evaluations=_MAX_EVALUATIONS,
                )
                for start in starts[:_MAX_DESCENTS]
            ]
            objective, rough_minimum = min(descents, key=lambda each: each[1].cost)
            objective, minimum = objective.find_minimum(
                rough_minimum.x, noise.weight, region, relative_tolerance=_COST_TOLERANCE
            )
            x = minimum.x
            projected_residual = objective.project(objective.linearise(x), noise.weight)
            plant, slopes = unknowns.plant_and_gradient(x)
            loss_factors = tuple(
                (pole.frequency_hz, plant.loss_factor(abs(pole.at_rad_s)))
                for pole in unknowns.decay_poles
                if pole.oscillates
            )
        except ValueError as error:
            raise plugin.error(str(error)) from error
    degrees_of_freedom = best.compared_value_count - x.size - best.fit.ringing.degrees_of_freedom
    at_bound = (x <= region.lower) | (x >= region.upper)
    covariance, determined = covariance_of_unknowns(
        projected_residual.jacobian, projected_residual.cost / degrees_of_freedom, at_bound
    )
    stds = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    parameters = unknowns.parameters(x)
    names = unknowns.names
    return StructureFit(
        structure=structure,
        package=plugin.label,
        parameters=parameters,
        std={
            name: (float(std) * (parameters[name] if name in LOGARITHMIC_PARAMETERS else 1.0))
            if is_determined
            else None
            for name, std, is_determined in zip(names, stds, determined, strict=True)
        },
        at_bounds=tuple(
            name for name, is_at_bound in zip(names, at_bound, strict=True) if is_at_bound
        ),
        loss_factors=loss_factors,
        cost=minimum.cost,
        degrees_of_freedom=degrees_of_freedom,
        delta_bic=bic(minimum.cost, best.compared_value_count, x.size) - best.bic,
        compared_with=best.name,
        residual=projected_residual.residual,
    )
