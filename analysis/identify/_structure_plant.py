"""Plant with the damping structure of an installed package, and the unknowns of its fit."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._settings import SETTINGS
from analysis.identify.parametrization import Unknowns
from analysis.models import UNDAMPED
from rigd.beam import BEAM_PARAMETERS, Plant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.models import Structure
    from rigd.beam import Parameter, Pole

_PARAMETER_DIFFERENCE_STEP: Final = 1e-5
"""Step of central differences by a parameter, relative to its value or to its range."""
_UNKNOWN_DIFFERENCE_STEP: Final = 1e-6
"""Step of central differences by an unknown."""
_PLANT_FIELD_NAMES: Final = tuple(each.name for each in fields(Plant))
"""Names of the fields of a plant, in their order."""


@dataclass(frozen=True, slots=True)
class StructurePlant(Plant):
    """Plant whose damping is that of a package's structure, instead of `damping`."""

    structure: Structure = UNDAMPED
    """Damping structure."""
    parameter_values: Mapping[str, float] = field(default_factory=dict)
    """Values of the structure's parameters."""
    decay_poles: tuple[Pole, ...] = ()
    """Poles of the free decay at the start of the record, which no parameter moves."""

    def elastic_and_inertial_factors(
        self, s: NDArray[np.complex128]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the elastic factor c and the inertial factor p at `s` (rad/s)."""
        elastic, external = self.structure.finite_factors(s, self.parameter_values)
        return elastic, self.beam.density_over_stiffness * s * s + external

    def torque_spectra(
        self,
        s: NDArray[np.complex128],
        gradient_parameters: Sequence[str],
        angle_spectrum: NDArray[np.complex128],
    ) -> NDArray[np.complex128]:
        """Return the transforms of the torque and its derivatives, like `ResponseGrid.evaluate`.

        `s`, shape (n,), is the Laplace variable in rad/s, not 0, and `angle_spectrum` the transform
        of the motor angle. `gradient_parameters` names parameters of the structure, or settings as
        `gradient_name` has them.
        """
        s_squared = s * s
        clamp_response = self.rigid_clamp_response(s)
        clamp_factor = 1 / (1 + self.root_compliance_rad_per_nm * clamp_response.response)
        torque_response = (
            clamp_response.response * clamp_factor + self.tool_inertia_kg_m2 * s_squared
        )
        density_derivative = (
            clamp_response.slope_by_inertial_factor * self.beam.density_over_stiffness * s_squared
        )
        derivatives = {
            "ln_density_over_stiffness": density_derivative * clamp_factor**2,
            "ln_stiffness": clamp_response.response * clamp_factor**2,
            "delay_s": -s * torque_response,
            "tool_inertia_kg_m2": s_squared,
        }
        for parameter in self.structure.parameters:
            if parameter.name in gradient_parameters:
                by_elastic, by_external = self._factor_slopes(s, parameter)
                derivatives[parameter.name] = (
                    clamp_response.slope_by_elastic_factor * by_elastic
                    + clamp_response.slope_by_inertial_factor * by_external
                ) * clamp_factor**2
        response_and_derivatives = np.stack(
            [torque_response, *(derivatives[name] for name in gradient_parameters)]
        )
        return response_and_derivatives * (self.channel_response(s) * angle_spectrum)

    def _factor_slopes(
        self, s: NDArray[np.complex128], parameter: Parameter
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the derivatives of elastic factor and external damping by a parameter, (n,) each.

        They are central differences.
        """
        parameter_value = self.parameter_values[parameter.name]
        difference_step = _PARAMETER_DIFFERENCE_STEP * (
            parameter_value if parameter.logarithmic else parameter.upper - parameter.lower
        )
        low, high = (
            max(parameter_value - difference_step, parameter.lower),
            min(parameter_value + difference_step, parameter.upper),
        )
        below, above = (
            self.structure.finite_factors(s, {**self.parameter_values, parameter.name: at})
            for at in (low, high)
        )
        return (above[0] - below[0]) / (high - low), (above[1] - below[1]) / (high - low)

    def mode_poles(
        self,
        mode_count: int,  # noqa: ARG002 - that of `decay_poles`
        gradient_parameters: Sequence[str] = (),
        expected_roots_rad_s: Sequence[complex] = (),  # noqa: ARG002 - nothing is searched
    ) -> tuple[Pole, ...]:
        """Return `decay_poles`, with derivatives of 0 by the parameters `gradient_parameters`."""
        zero_derivative = np.zeros(len(gradient_parameters), dtype=np.complex128)
        return tuple(replace(pole, derivative=zero_derivative) for pole in self.decay_poles)

    def loss_factor(self, omega_rad_s: float) -> float:
        """Return the loss factor of the damping at an angular frequency."""
        s = np.array([1j * omega_rad_s])
        (elastic,), (external,) = self.structure.finite_factors(s, self.parameter_values)
        inertial_term = self.beam.density_over_stiffness * omega_rad_s**2
        return float(elastic.imag / elastic.real + external.imag / (inertial_term - external.real))


@dataclass(frozen=True)
class StructureUnknowns(Unknowns):
    """Unknowns of the fit of a damping structure that an installed package adds.

    The free parameters of the structure come first, then those of beam and rig. A parameter on a
    logarithmic scale is represented by its logarithm, any other by its value over its range. The
    stiffness, and the ratio of density to stiffness, are effective values, which include the real
    part of the damping at the first two modes: a step of a parameter then does not move the modes.
    """

    decay_poles: tuple[Pole, ...] = ()
    """Poles of the free decay at the start of the record."""

    @cached_property
    def setting_unknowns(self) -> Unknowns:
        """Return the unknowns of beam and rig alone, which come after those of the structure."""
        return Unknowns(UNDAMPED, self.nominal_plant, self.free_settings, self.omega_rad_s)

    @property
    def _free_parameters(self) -> list[Parameter]:
        """Return the free parameters of the structure."""
        return [
            parameter
            for parameter in self.structure.parameters
            if parameter.name in self.structure.free
        ]

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and the upper bounds of the unknowns, each of shape (k,)."""
        lower, upper = self.setting_unknowns.bounds
        return (
            np.array(
                [
                    *(
                        _unknown_of_value(parameter, parameter.lower)
                        for parameter in self._free_parameters
                    ),
                    *lower,
                ]
            ),
            np.array(
                [
                    *(
                        _unknown_of_value(parameter, parameter.upper)
                        for parameter in self._free_parameters
                    ),
                    *upper,
                ]
            ),
        )

    def vector_near(
        self, parameter_values: Mapping[str, float], closest_plant: Plant
    ) -> NDArray[np.float64]:
        """Return the vector of unknowns for values of the structure's parameters.

        The other unknowns (beam, delay and tool inertia) are those of `closest_plant`.
        """
        own_unknowns = [
            _unknown_of_value(parameter, parameter_values[parameter.name])
            for parameter in self._free_parameters
        ]
        return np.array([*own_unknowns, *self.setting_unknowns.vector(closest_plant)])

    def parameter_values(self, vector_of_unknowns: NDArray[np.float64]) -> dict[str, float]:
        """Return the values of the structure's parameters for a vector of unknowns."""
        own_values = {
            parameter.name: _value_of_unknown(parameter, float(unknown))
            for parameter, unknown in zip(self._free_parameters, vector_of_unknowns, strict=False)
        }
        return {**self.structure.fixed, **own_values}

    def plant(self, vector_of_unknowns: NDArray[np.float64]) -> StructurePlant:
        """Return the plant that a vector of unknowns describes."""
        parameter_values, plant = (
            self.parameter_values(vector_of_unknowns),
            self.setting_unknowns.plant(vector_of_unknowns[len(self.structure.free) :]),
        )
        first_rad_s, second_rad_s = self.setting_unknowns.omega_rad_s
        s = np.array([1j * first_rad_s, 1j * second_rad_s])
        elastic, external = self.structure.finite_factors(s, parameter_values)
        density_over_stiffness = plant.beam.density_over_stiffness
        stiffening_factor = abs(elastic[1])
        inertia_factor = abs(1 + external[0] / (density_over_stiffness * s[0] ** 2))
        effective_beam_parameters: dict[str, float] = {
            "density_over_stiffness": density_over_stiffness * stiffening_factor / inertia_factor,
            "bending_stiffness_n_m2": plant.beam.bending_stiffness_n_m2 / stiffening_factor,
        }
        changed_parameters: dict[str, float] = {
            name: effective_beam_parameters[name]
            for name in BEAM_PARAMETERS
            if name in self.free_settings
        }
        plant = plant.with_parameters(changed_parameters)
        return StructurePlant(
            **{name: getattr(plant, name) for name in _PLANT_FIELD_NAMES},
            structure=self.structure,
            parameter_values=parameter_values,
            decay_poles=self.decay_poles,
        )

    def parameters(self, vector_of_unknowns: NDArray[np.float64]) -> dict[str, float]:
        """Return the values of structure and settings by name, for a vector of unknowns."""
        plant = self.plant(vector_of_unknowns)
        return {
            **plant.parameter_values,
            **{name: float(plant.parameters[name]) for name in SETTINGS},
        }

    def plant_and_gradient(
        self, vector_of_unknowns: NDArray[np.float64]
    ) -> tuple[StructurePlant, NDArray[np.float64]]:
        """Return the plant for a vector of unknowns, and the derivatives of its parameters.

        The derivatives have the shape (k, k): [parameter, unknown]. The parameters are
        `gradient_names`.
        """
        lower, upper = self.bounds
        parameter_slopes = np.empty((vector_of_unknowns.size, vector_of_unknowns.size))
        for index in range(vector_of_unknowns.size):
            interval_ends = np.clip(
                vector_of_unknowns[index]
                + np.array([-_UNKNOWN_DIFFERENCE_STEP, _UNKNOWN_DIFFERENCE_STEP]),
                lower[index],
                upper[index],
            )
            below, above = (
                self._gradient_values(_with_element_changed(vector_of_unknowns, index, end))
                for end in interval_ends
            )
            parameter_slopes[:, index] = (above - below) / (interval_ends[1] - interval_ends[0])
        return self.plant(vector_of_unknowns), parameter_slopes

    def _gradient_values(self, vector_of_unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of the parameters by which the response is differentiated."""
        parameter_values = self.parameters(vector_of_unknowns)
        return np.array(
            [
                np.log(parameter_values[name])
                if gradient.startswith("ln_")
                else parameter_values[name]
                for name, gradient in zip(self.names, self.gradient_names, strict=True)
            ]
        )


def _unknown_of_value(parameter: Parameter, parameter_value: float) -> float:
    """Return the unknown for the value of a structure's parameter."""
    if parameter.logarithmic:
        return float(np.log(parameter_value))
    return (parameter_value - parameter.lower) / (parameter.upper - parameter.lower)


def _value_of_unknown(parameter: Parameter, unknown_value: float) -> float:
    """Return the value of a structure's parameter for its unknown."""
    parameter_value = (
        float(np.exp(unknown_value))
        if parameter.logarithmic
        else parameter.lower + unknown_value * (parameter.upper - parameter.lower)
    )
    return min(max(parameter_value, parameter.lower), parameter.upper)


def _with_element_changed(
    vector: NDArray[np.float64], index: int, value: float
) -> NDArray[np.float64]:
    """Return a copy of a vector with another value at one index."""
    changed_vector = vector.copy()
    changed_vector[index] = value
    return changed_vector
