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

_PARAMETER_STEP: Final = 1e-5
"""Step of central differences by a parameter, relative to its value or to its range."""
_UNKNOWN_STEP: Final = 1e-6
"""Step of central differences by an unknown."""
_PLANT_FIELDS: Final = tuple(each.name for each in fields(Plant))
"""Names of the fields of a plant, in their order."""


@dataclass(frozen=True, slots=True)
class StructurePlant(Plant):
    """Plant whose damping is that of a package's structure, instead of `damping`."""

    structure: Structure = UNDAMPED
    """Damping structure."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Values of the structure's parameters."""
    decay_poles: tuple[Pole, ...] = ()
    """Poles of the free decay at the start of the record, which no parameter moves."""

    def elastic_and_inertial_factors(
        self, s: NDArray[np.complex128]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the elastic factor c and the inertial factor p at `s` (rad/s)."""
        elastic, external = self.structure.finite_factors(s, self.values)
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
        at = self.rigid_clamp_response(s)
        clamp_factor = 1 / (1 + self.root_compliance_rad_per_nm * at.response)
        torque = at.response * clamp_factor + self.tool_inertia_kg_m2 * s_squared
        by_density = at.slope_by_inertial_factor * self.beam.density_over_stiffness * s_squared
        derivatives = {
            "ln_density_over_stiffness": by_density * clamp_factor**2,
            "ln_stiffness": at.response * clamp_factor**2,
            "delay_s": -s * torque,
            "tool_inertia_kg_m2": s_squared,
        }
        for parameter in self.structure.parameters:
            if parameter.name in gradient_parameters:
                by_elastic, by_external = self._factor_slopes(s, parameter)
                derivatives[parameter.name] = (
                    at.slope_by_elastic_factor * by_elastic
                    + at.slope_by_inertial_factor * by_external
                ) * clamp_factor**2
        rows = np.stack([torque, *(derivatives[name] for name in gradient_parameters)])
        return rows * (self.channel_response(s) * angle_spectrum)

    def _factor_slopes(
        self, s: NDArray[np.complex128], parameter: Parameter
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the derivatives of elastic factor and external damping by a parameter, (n,) each.

        They are central differences.
        """
        value = self.values[parameter.name]
        step = _PARAMETER_STEP * (
            value if parameter.logarithmic else parameter.upper - parameter.lower
        )
        low, high = max(value - step, parameter.lower), min(value + step, parameter.upper)
        below, above = (
            self.structure.finite_factors(s, {**self.values, parameter.name: at})
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
        (elastic,), (external,) = self.structure.finite_factors(s, self.values)
        inertia = self.beam.density_over_stiffness * omega_rad_s**2
        return float(elastic.imag / elastic.real + external.imag / (inertia - external.real))


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
        return Unknowns(UNDAMPED, self.nominal, self.free_settings, self.omega_rad_s)

    @property
    def _free_parameters(self) -> list[Parameter]:
        """Return the free parameters of the structure."""
        return [each for each in self.structure.parameters if each.name in self.structure.free]

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and the upper bounds of the unknowns, each of shape (k,)."""
        lower, upper = self.setting_unknowns.bounds
        return (
            np.array(
                [*(_unknown_of_value(each, each.lower) for each in self._free_parameters), *lower]
            ),
            np.array(
                [*(_unknown_of_value(each, each.upper) for each in self._free_parameters), *upper]
            ),
        )

    def vector_near(self, values: Mapping[str, float], closest: Plant) -> NDArray[np.float64]:
        """Return the unknowns for values of the structure's parameters, with `closest` as beam."""
        own_unknowns = [
            _unknown_of_value(each, values[each.name]) for each in self._free_parameters
        ]
        return np.array([*own_unknowns, *self.setting_unknowns.vector(closest)])

    def values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return the values of the structure's parameters for a vector of unknowns."""
        own_values = {
            each.name: _value_of_unknown(each, float(unknown))
            for each, unknown in zip(self._free_parameters, x, strict=False)
        }
        return {**self.structure.fixed, **own_values}

    def plant(self, x: NDArray[np.float64]) -> StructurePlant:
        """Return the plant that a vector of unknowns describes."""
        values, plant = self.values(x), self.setting_unknowns.plant(x[len(self.structure.free) :])
        first_rad_s, second_rad_s = self.setting_unknowns.omega_rad_s
        s = np.array([1j * first_rad_s, 1j * second_rad_s])
        elastic, external = self.structure.finite_factors(s, values)
        density_over_stiffness = plant.beam.density_over_stiffness
        stiffening = abs(elastic[1])
        inertia_change = abs(1 + external[0] / (density_over_stiffness * s[0] ** 2))
        effective: dict[str, float] = {
            "density_over_stiffness": density_over_stiffness * stiffening / inertia_change,
            "bending_stiffness_n_m2": plant.beam.bending_stiffness_n_m2 / stiffening,
        }
        changes: dict[str, float] = {
            name: effective[name] for name in BEAM_PARAMETERS if name in self.free_settings
        }
        plant = plant.with_parameters(changes)
        return StructurePlant(
            **{name: getattr(plant, name) for name in _PLANT_FIELDS},
            structure=self.structure,
            values=values,
            decay_poles=self.decay_poles,
        )

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return the values of structure and settings by name, for a vector of unknowns."""
        plant = self.plant(x)
        return {**plant.values, **{name: float(plant.parameters[name]) for name in SETTINGS}}

    def plant_and_gradient(
        self, x: NDArray[np.float64]
    ) -> tuple[StructurePlant, NDArray[np.float64]]:
        """Return the plant for a vector of unknowns, and the derivatives of its parameters.

        The derivatives have the shape (k, k): [parameter, unknown]. The parameters are
        `gradient_names`.
        """
        lower, upper = self.bounds
        slopes = np.empty((x.size, x.size))
        for index in range(x.size):
            ends = np.clip(
                x[index] + np.array([-_UNKNOWN_STEP, _UNKNOWN_STEP]), lower[index], upper[index]
            )
            below, above = (self._gradient_values(_with_value(x, index, end)) for end in ends)
            slopes[:, index] = (above - below) / (ends[1] - ends[0])
        return self.plant(x), slopes

    def _gradient_values(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of the parameters by which the response is differentiated."""
        values = self.parameters(x)
        return np.array(
            [
                np.log(values[name]) if gradient.startswith("ln_") else values[name]
                for name, gradient in zip(self.names, self.gradient_names, strict=True)
            ]
        )


def _unknown_of_value(parameter: Parameter, value: float) -> float:
    """Return the unknown for the value of a structure's parameter."""
    if parameter.logarithmic:
        return float(np.log(value))
    return (value - parameter.lower) / (parameter.upper - parameter.lower)


def _value_of_unknown(parameter: Parameter, unknown: float) -> float:
    """Return the value of a structure's parameter for its unknown."""
    value = (
        float(np.exp(unknown))
        if parameter.logarithmic
        else parameter.lower + unknown * (parameter.upper - parameter.lower)
    )
    return min(max(value, parameter.lower), parameter.upper)


def _with_value(x: NDArray[np.float64], index: int, value: float) -> NDArray[np.float64]:
    """Return a copy of a vector with another value at one index."""
    changed = x.copy()
    changed[index] = value
    return changed
