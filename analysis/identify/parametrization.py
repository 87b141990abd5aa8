"""Parametrization of a fit: its vector of unknowns, conversion to a plant, and suitable steps.

Damping of a low order acts as stiffness, damping of an order near 2 as inertia. With density and
stiffness free, such damping and the beam can compensate each other along a curved flat direction,
in which a descent takes hundreds of steps. So the unknowns are quantities that a record determines
directly, and an order changes without them:

* internal damping by its loss relative to the stiffness, ``ln(z sin(alpha pi/2))`` with
  ``z = zeta omega_2^alpha`` at the undamped second mode, and ``alpha``;
* external damping by its loss relative to the inertia, ``ln(g sin(lambda pi/2))`` with
  ``g = gamma omega_1^lambda / (rho/EI omega_1²)`` at the undamped first mode, and ``lambda``;
* the effective stiffness with its damping, ``EI |1 + z exp(j alpha pi/2)|``, and likewise
  density over stiffness, ``rho/EI |1 - g exp(j lambda pi/2)| / |1 + z exp(j alpha pi/2)|``, both
  as logarithms relative to the nominal beam;
* the delay in ms, and the tool inertia relative to the inertia of the nominal beam.

Where damping is larger than the stiffness or inertia it adds to, loss and order compensate each
other: the record determines only the phase theta of ``1 ± size exp(j order pi/2)``, and at constant
theta loss and order vary over many powers of ten. A straight step leaves this curve at once, and a
descent with straight steps takes a hundred of them. So a step is taken along ``ln tan(theta/2)``
and the order instead of ``ln loss`` and the order (`StepRule`). Where the damping is small the two
are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._settings import SETTINGS
from analysis.models import ORDER_RANGE, RELATIVE_DAMPING_RANGE
from rigd.beam import DAMPING_PARAMETERS, Plant, gradient_name, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from analysis.identify._settings import Setting
    from analysis.models import Structure


# Unknowns

_LN_BEAM_PARAMETER_HALF_RANGE: Final = math.log(3.0)
"""Largest change of ln(rho/EI) and ln(EI) from the nominal beam: a factor of 3."""

_DELAY_UNIT_S: Final = 1e-3
"""Delay in seconds at which the delay unknown is 1."""

_DELAY_RANGE_S: Final = 0.02
"""Largest magnitude of the delay in seconds."""

_QUARTER_TURN_RAD: Final = math.pi / 2
"""Phase of ``s^1`` on the imaginary axis, in radians."""

_LOSS_FACTOR_OF_NEW_DAMPING: Final = 1e-5
"""Loss, relative to stiffness or inertia, at which a fit starts with a damping that was absent."""


@dataclass(frozen=True)
class Unknowns:
    """Vector of unknowns of one structure: its free damping parameters and free settings.

    Attributes
    ----------
    structure : Structure
        Damping structure.
    nominal_plant : Plant
        Source of the values that are not free. Its damping is not used.
    free_settings : tuple of str
        Free settings, in the order of `SETTINGS`.
    omega_rad_s : tuple of float
        Undamped first and second natural frequency of the nominal beam.
    """

    structure: Structure
    nominal_plant: Plant
    free_settings: tuple[Setting, ...]
    omega_rad_s: tuple[float, float]

    @classmethod
    def for_structure(
        cls, structure: Structure, nominal_plant: Plant, free_settings: tuple[Setting, ...]
    ) -> Unknowns:
        """Return the unknowns of a structure with some settings of the rig free.

        Parameters
        ----------
        structure : Structure
            Structure that states which damping parameters are free.
        nominal_plant : Plant
            Beam and rig as the file states them.
        free_settings : tuple of str
            Names of the settings that are estimated.
        """
        first_omega_rad_s, second_omega_rad_s = map(
            float, undamped_frequencies_rad_s(nominal_plant.beam, 2)
        )
        ordered_settings = tuple(
            setting_name for setting_name in SETTINGS if setting_name in free_settings
        )
        return cls(
            structure, nominal_plant, ordered_settings, (first_omega_rad_s, second_omega_rad_s)
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters, in the order of the vector."""
        return (*self.structure.free, *self.free_settings)

    @cached_property
    def gradient_names(self) -> tuple[str, ...]:
        """Return the names of the free parameters as the derivatives of the response use them.

        Beam parameters are logarithms there.
        """
        return tuple(map(gradient_name, self.names))

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and the upper bounds of the unknowns, each of shape (k,)."""
        ln_size_range = (math.log(RELATIVE_DAMPING_RANGE[0]), math.log(RELATIVE_DAMPING_RANGE[1]))
        largest_scaled_delay = _DELAY_RANGE_S / _DELAY_UNIT_S
        unknown_ranges = {
            "zeta": ln_size_range,
            "alpha": ORDER_RANGE,
            "gamma": ln_size_range,
            "lambda": ORDER_RANGE,
            "density_over_stiffness": (
                -_LN_BEAM_PARAMETER_HALF_RANGE,
                _LN_BEAM_PARAMETER_HALF_RANGE,
            ),
            "bending_stiffness_n_m2": (
                -_LN_BEAM_PARAMETER_HALF_RANGE,
                _LN_BEAM_PARAMETER_HALF_RANGE,
            ),
            "delay_s": (-largest_scaled_delay, largest_scaled_delay),
            "tool_inertia_kg_m2": (0.0, 1.0),
        }
        lower_bounds, upper_bounds = zip(
            *(unknown_ranges[parameter_name] for parameter_name in self.names), strict=True
        )
        return np.array(lower_bounds), np.array(upper_bounds)

    def start(self, damping_sizes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unknowns for given damping sizes, with nominal settings, shape (k,).

        Parameters
        ----------
        damping_sizes : ndarray, shape (len(structure.free),)
            Values of ``ln z``, ``alpha``, ``ln g`` and ``lambda``, as far as they are free.
        """
        unknown_values: dict[str, float] = {
            **dict(self.structure.fixed.items()),
            **dict(zip(self.structure.free, damping_sizes.tolist(), strict=True)),
            "density_over_stiffness": 0.0,
            "bending_stiffness_n_m2": 0.0,
            **self._linear_unknowns(self.nominal_plant),
        }
        for damping_coefficient, order_name in (("zeta", "alpha"), ("gamma", "lambda")):
            if damping_coefficient in self.names:
                unknown_values[damping_coefficient] += math.log(
                    math.sin(_QUARTER_TURN_RAD * unknown_values[order_name])
                )
        return np.array([unknown_values[parameter_name] for parameter_name in self.names])

    def vector(self, plant: Plant) -> NDArray[np.float64]:
        """Return the unknowns that describe a plant, shape (k,): the inverse of `plant`.

        Parameters
        ----------
        plant : Plant
            Plant with damping of any structure. If the structure of these unknowns fixes an order
            that differs from the plant's, the loss factor does not change at the second undamped
            natural frequency (internal damping) or at the first one (external damping). Absent
            damping starts small, with order 1.
        """
        damping, nominal_beam = plant.damping, self.nominal_plant.beam
        first_omega_rad_s, second_omega_rad_s = self.omega_rad_s
        density_over_stiffness = plant.beam.density_over_stiffness
        ln_ratio = math.log(density_over_stiffness / nominal_beam.density_over_stiffness)
        ln_stiffness = math.log(
            plant.beam.bending_stiffness_n_m2 / nominal_beam.bending_stiffness_n_m2
        )
        unknown_values = {
            "zeta": math.log(_LOSS_FACTOR_OF_NEW_DAMPING),
            "alpha": 1.0,
            "gamma": math.log(_LOSS_FACTOR_OF_NEW_DAMPING),
            "lambda": 1.0,
        }
        unknown_values |= self._linear_unknowns(plant)
        if damping.zeta > 0:
            pivot_loss_factor, damping_phase_rad = (
                damping.zeta * second_omega_rad_s**damping.alpha,
                _QUARTER_TURN_RAD * damping.alpha,
            )
            unknown_values["zeta"], unknown_values["alpha"] = (
                math.log(pivot_loss_factor * math.sin(damping_phase_rad)),
                damping.alpha,
            )
            ln_stiffening = math.log(
                abs(
                    1
                    + pivot_loss_factor
                    * complex(math.cos(damping_phase_rad), math.sin(damping_phase_rad))
                )
            )
            ln_ratio -= ln_stiffening
            ln_stiffness += ln_stiffening
        if damping.gamma > 0:
            pivot_loss_factor = (
                damping.gamma / density_over_stiffness * first_omega_rad_s ** (damping.lambda_ - 2)
            )
            damping_phase_rad = _QUARTER_TURN_RAD * damping.lambda_
            unknown_values["gamma"], unknown_values["lambda"] = (
                math.log(pivot_loss_factor * math.sin(damping_phase_rad)),
                damping.lambda_,
            )
            ln_ratio += math.log(
                abs(
                    1
                    - pivot_loss_factor
                    * complex(math.cos(damping_phase_rad), math.sin(damping_phase_rad))
                )
            )
        unknown_values |= {
            "density_over_stiffness": ln_ratio,
            "bending_stiffness_n_m2": ln_stiffness,
        }
        return np.array([unknown_values[parameter_name] for parameter_name in self.names])

    def plant(self, vector_of_unknowns: NDArray[np.float64]) -> Plant:
        """Return the plant that a vector of unknowns describes."""
        return self._plant_of(self._values_and_derivatives(vector_of_unknowns)[0])

    def plant_and_gradient(
        self, vector_of_unknowns: NDArray[np.float64]
    ) -> tuple[Plant, NDArray[np.float64]]:
        """Return the plant for a vector of unknowns, and the derivatives of its parameters.

        The derivatives have the shape (k, k): [parameter, unknown]. The parameters are
        `gradient_names`, where zeta and gamma are not logarithms.
        """
        parameter_values, parameter_slopes = self._values_and_derivatives(vector_of_unknowns)
        for unknown_index, parameter_name in enumerate(self.names):
            if parameter_name in ("zeta", "gamma"):
                parameter_slopes[unknown_index] *= parameter_values[parameter_name]
        return self._plant_of(parameter_values), parameter_slopes

    def _plant_of(self, parameter_values: Mapping[str, float]) -> Plant:
        """Return the rig and beam for values of all parameters, by name."""
        names = (*DAMPING_PARAMETERS, *SETTINGS)
        return self.nominal_plant.with_parameters({name: parameter_values[name] for name in names})

    def parameters(self, vector_of_unknowns: NDArray[np.float64]) -> dict[str, float]:
        """Return all plant parameters by name, free and fixed, for a vector of unknowns."""
        return self.plant(vector_of_unknowns).parameters

    @cached_property
    def units(self) -> Mapping[str, float]:
        """Return the delay and the tool inertia for which their unknowns are 1, by name.

        The tool inertia is that between torque sensor and beam.
        """
        nominal_beam = self.nominal_plant.beam
        unknown_units = {
            "delay_s": _DELAY_UNIT_S,
            "tool_inertia_kg_m2": nominal_beam.inertia_kg_m2,
        }
        return MappingProxyType(unknown_units)

    @cached_property
    def _indices(self) -> Mapping[str, int]:
        """Return the index of each free parameter in the vector of unknowns."""
        return MappingProxyType({parameter_name: i for i, parameter_name in enumerate(self.names)})

    @cached_property
    def _fixed_values(self) -> Mapping[str, float]:
        """Return nominal settings and fixed damping parameters, by name."""
        fixed_values = dict(self.structure.fixed.items())
        return MappingProxyType({**self.nominal_plant.parameters, **fixed_values})

    def _linear_unknowns(self, plant: Plant) -> dict[str, float]:
        """Return delay and tool inertia of a plant, divided by `units`, by name."""
        parameter_values = plant.parameters
        return {
            parameter_name: parameter_values[parameter_name] / unknown_unit
            for parameter_name, unknown_unit in self.units.items()
        }

    def estimates_by_unknowns(self, vector_of_unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the free parameters by the unknowns, shape (k, k).

        The indices are [parameter, unknown]. Parameters in `LOGARITHMIC_PARAMETERS` count as
        logarithms.
        """
        parameter_slopes: NDArray[np.float64] = self._values_and_derivatives(vector_of_unknowns)[1]
        return parameter_slopes

    def _values_and_derivatives(
        self, vector_of_unknowns: NDArray[np.float64]
    ) -> tuple[dict[str, float], NDArray[np.float64]]:
        """Return all plant parameters by name, and their derivatives by the unknowns.

        The derivatives are those of `estimates_by_unknowns`.
        """
        unknown_indices = self._indices
        unknown_values: dict[str, float] = dict(
            zip(self.names, vector_of_unknowns.tolist(), strict=True)
        )
        parameter_values: dict[str, float] = dict(self._fixed_values)
        parameter_slopes = np.eye(vector_of_unknowns.size)
        first_omega_rad_s, second_omega_rad_s = self.omega_rad_s
        # ln of the factor by which damping changes stiffness and inertia, with its derivatives.
        stiffness_change, inertia_change = np.zeros((2, vector_of_unknowns.size + 1))
        if self.structure.has_internal_damping:
            parameter_values["alpha"] = damping_order = unknown_values.get(
                "alpha", parameter_values["alpha"]
            )
            ln_z, ln_size_slope = _ln_damping_size(unknown_values["zeta"], damping_order)
            parameter_values["zeta"] = math.exp(ln_z - damping_order * math.log(second_omega_rad_s))
            stiffness_change = self._ln_factor_of_damping(
                ln_z, damping_order, 1.0, "zeta", "alpha", ln_size_slope
            )
            if "alpha" in unknown_indices:
                parameter_slopes[unknown_indices["zeta"], unknown_indices["alpha"]] = (
                    ln_size_slope - math.log(second_omega_rad_s)
                )
        if self.structure.has_external_damping:
            parameter_values["lambda"] = damping_order = unknown_values.get(
                "lambda", parameter_values["lambda"]
            )
            ln_g, ln_size_slope = _ln_damping_size(unknown_values["gamma"], damping_order)
            inertia_change = self._ln_factor_of_damping(
                ln_g, damping_order, -1.0, "gamma", "lambda", ln_size_slope
            )
            if "lambda" in unknown_indices:
                parameter_slopes[unknown_indices["gamma"], unknown_indices["lambda"]] = (
                    ln_size_slope - math.log(first_omega_rad_s)
                )
        for parameter_name, term_sign in (
            ("density_over_stiffness", 1.0),
            ("bending_stiffness_n_m2", -1.0),
        ):
            if parameter_name in unknown_indices:
                ln_factor = term_sign * stiffness_change - (
                    inertia_change if term_sign > 0 else 0.0
                )
                parameter_values[parameter_name] *= math.exp(
                    unknown_values[parameter_name] + ln_factor[-1]
                )
                parameter_slopes[unknown_indices[parameter_name]] += ln_factor[:-1]
        if self.structure.has_external_damping:
            density_over_stiffness = parameter_values["density_over_stiffness"]
            parameter_values["gamma"] = density_over_stiffness * math.exp(
                ln_g + (2 - parameter_values["lambda"]) * math.log(first_omega_rad_s)
            )
            if "density_over_stiffness" in unknown_indices:
                parameter_slopes[unknown_indices["gamma"]] += parameter_slopes[
                    unknown_indices["density_over_stiffness"]
                ]
        unknown_units = self.units
        for parameter_name in unknown_units.keys() & unknown_indices.keys():
            parameter_values[parameter_name] = (
                unknown_values[parameter_name] * unknown_units[parameter_name]
            )
            parameter_slopes[unknown_indices[parameter_name], unknown_indices[parameter_name]] = (
                unknown_units[parameter_name]
            )
        return parameter_values, parameter_slopes

    def _ln_factor_of_damping(
        self,
        ln_size: float,
        order: float,
        term_sign: float,
        loss_name: str,
        order_name: str,
        ln_size_slope: float,
    ) -> NDArray[np.float64]:
        """Return ``ln |1 ± signed_size exp(j order pi/2)|`` with its derivatives by the unknowns.

        The result has the shape (k + 1,): the derivatives, then the value. `ln_size_slope` is the
        derivative of `ln_size` by the order at constant loss.
        """
        signed_size, order_phase_rad = term_sign * math.exp(ln_size), _QUARTER_TURN_RAD * order
        squared_factor = 1 + 2 * signed_size * math.cos(order_phase_rad) + signed_size * signed_size
        derivative_by_ln_size = (
            signed_size * (math.cos(order_phase_rad) + signed_size) / squared_factor
        )
        derivatives_and_value = np.zeros(len(self.names) + 1)
        derivatives_and_value[self._indices[loss_name]] = derivative_by_ln_size
        if order_name in self._indices:
            derivative_by_phase = (
                -_QUARTER_TURN_RAD * signed_size * math.sin(order_phase_rad) / squared_factor
            )
            derivatives_and_value[self._indices[order_name]] = (
                derivative_by_ln_size * ln_size_slope + derivative_by_phase
            )
        derivatives_and_value[-1] = math.log(squared_factor) / 2
        return derivatives_and_value


def _ln_damping_size(ln_loss: float, order: float) -> tuple[float, float]:
    """Return ``ln z`` or ``ln g`` of a damping with a given loss, and its slope over the order."""
    order_phase_rad = _QUARTER_TURN_RAD * order
    return ln_loss - math.log(math.sin(order_phase_rad)), -_QUARTER_TURN_RAD / math.tan(
        order_phase_rad
    )


# Steps

_MAX_ORDER_STEP_FRACTION: Final = 0.5
"""Longest step of an order, as a fraction of its distance to 0 or 2."""

VANISHING_LOSS_FACTOR: Final = 1e-4
"""Loss, relative to stiffness or inertia, below which one step may remove the damping."""

_MAX_GROWTH_EXPONENT: Final = 50.0
"""Largest exponent by which one step increases ``tan(theta/2)``."""


@dataclass(frozen=True, slots=True)
class StepRule:
    """Rule of the steps of a descent: their limits, and curve in the space of the unknowns.

    Attributes
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the unknowns.
    damping_indices : tuple of (int, int, bool)
        Index of the loss and index of the order of each damping with a free order, and whether the
        damping adds to the stiffness. If not, it reduces the inertia.
    loss_indices : tuple of int
        Indices of the losses of dampings with a fixed order.
    linear_loss_limit : float
        Loss below which a step changes the loss itself instead of its logarithm. The effect of the
        damping is proportional to the loss: a step of the logarithm would lead from a negligible
        value to the upper bound, and most of a descent would be spent on the way back.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    damping_indices: tuple[tuple[int, int, bool], ...]
    loss_indices: tuple[int, ...] = ()
    linear_loss_limit: float = 0.0

    @classmethod
    def for_unknowns(cls, unknowns: Unknowns, linear_loss_limit: float = 0.0) -> StepRule:
        """Return the rule of the steps for the unknowns of a structure.

        Parameters
        ----------
        unknowns : Unknowns
            Unknowns of the structure.
        linear_loss_limit : float
            Loss below which a step changes the loss itself instead of its logarithm.
        """
        unknown_names = unknowns.names
        damping_indices = tuple(
            (
                unknown_names.index(coefficient_name),
                unknown_names.index(order_name),
                coefficient_name == "zeta",
            )
            for coefficient_name, order_name in (("zeta", "alpha"), ("gamma", "lambda"))
            if order_name in unknown_names
        )
        loss_indices = tuple(
            unknown_names.index(coefficient_name)
            for coefficient_name, order_name in (("zeta", "alpha"), ("gamma", "lambda"))
            if coefficient_name in unknown_names and order_name not in unknown_names
        )
        return cls(*unknowns.bounds, damping_indices, loss_indices, linear_loss_limit)

    def step_limits(
        self, vector_of_unknowns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the smallest and largest admissible step of each unknown, each of shape (k,).

        An order approaches 0 and 2 by a fraction of its distance at a time: the effect of damping
        depends on the logarithm of that distance. The order of a vanished damping is constant.
        """
        smallest_steps, largest_steps = (
            self.lower - vector_of_unknowns,
            self.upper - vector_of_unknowns,
        )
        for loss_index, order_index, _ in self.damping_indices:
            order_step_fraction = (
                _MAX_ORDER_STEP_FRACTION
                if vector_of_unknowns[loss_index] > self.lower[loss_index]
                else 0.0
            )
            smallest_steps[order_index] = max(
                smallest_steps[order_index], -order_step_fraction * vector_of_unknowns[order_index]
            )
            largest_steps[order_index] = min(
                largest_steps[order_index],
                order_step_fraction * (2 - vector_of_unknowns[order_index]),
            )
        return smallest_steps, largest_steps

    def end_point(
        self, vector_of_unknowns: NDArray[np.float64], unknown_step: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the unknowns after a step along the curve, within the bounds, shape (k,).

        Parameters
        ----------
        vector_of_unknowns : ndarray, shape (k,)
            Unknowns before the step.
        unknown_step : ndarray, shape (k,)
            Step within the `step_limits`, tangent to the curve at `vector_of_unknowns`.
        """
        bounded_end = np.clip(vector_of_unknowns + unknown_step, self.lower, self.upper)
        for i in self.loss_indices:
            if unknown_step[i] > 0 and math.exp(vector_of_unknowns[i]) < self.linear_loss_limit:
                bounded_end[i] = min(
                    vector_of_unknowns[i] + math.log1p(unknown_step[i]), self.upper[i]
                )
        for i, j, adds_stiffness in self.damping_indices:
            if unknown_step[i] != 0:
                phase_before, phase_after = (
                    _phase_of_order(vector_of_unknowns[j], adds_stiffness),
                    _phase_of_order(bounded_end[j], adds_stiffness),
                )
                largest_loss = math.exp(self.upper[i])
                loss_factor = math.exp(vector_of_unknowns[i])
                is_linear = loss_factor < self.linear_loss_limit
                loss_factor, phase_rad = _loss_and_phase_after_step(
                    loss_factor,
                    float(unknown_step[i]),
                    phase_before,
                    phase_after,
                    largest_loss,
                    is_linear=is_linear,
                )
                bounded_end[i] = math.log(loss_factor) if loss_factor > 0 else self.lower[i]
                if phase_rad != phase_after:
                    bounded_end[j] = _order_of_phase(phase_rad, adds_stiffness)
        bounded_unknowns: NDArray[np.float64] = np.clip(bounded_end, self.lower, self.upper)
        return bounded_unknowns


def _loss_and_phase_after_step(
    loss_factor: float,
    ln_loss_step: float,
    phase_before: float,
    phase_after: float,
    largest_loss: float,
    *,
    is_linear: bool,
) -> tuple[float, float]:
    """Return the loss factor and the phase in rad of a damping after a step of the descent.

    The phase changes from `phase_before` to `phase_after`. If no loss up to `largest_loss` gives
    the required phase, the largest loss is combined with the phase that it gives.
    """
    pivot_loss_factor = loss_factor / math.sin(phase_before)
    real_part = 1 + pivot_loss_factor * math.cos(phase_before)
    # d ln tan(theta/2) = (d ln loss + size / sin(turn) d turn) / |1 + size exp(j turn)|
    ln_tan_step = (
        ln_loss_step + pivot_loss_factor / math.sin(phase_before) * (phase_after - phase_before)
    ) / math.hypot(real_part, loss_factor)
    if ln_tan_step <= -1 and loss_factor < VANISHING_LOSS_FACTOR:
        return (
            0.0,
            phase_after,
        )  # a step in proportion to the effect would change the sign of the loss
    loss_angle_rad = math.atan2(loss_factor, real_part)
    growth_factor = (
        1 + ln_tan_step
        if is_linear and ln_tan_step > 0
        else math.exp(min(ln_tan_step, _MAX_GROWTH_EXPONENT))
    )
    loss_angle_rad = 2 * math.atan(math.tan(loss_angle_rad / 2) * growth_factor)
    if loss_angle_rad < phase_after:
        loss_factor = (
            math.sin(loss_angle_rad)
            / math.sin(phase_after - loss_angle_rad)
            * math.sin(phase_after)
        )
        if loss_factor <= largest_loss:
            return loss_factor, phase_after
    return largest_loss, loss_angle_rad + math.asin(
        min(math.sin(loss_angle_rad) ** 2 / largest_loss, 1.0)
    )


def _phase_of_order(order: float, adds_stiffness: bool) -> float:
    """Return the phase in rad of a damping of given order relative to stiffness or inertia.

    It is between 0 and pi.
    """
    phase_rad = math.pi / 2 * float(order)
    return phase_rad if adds_stiffness else math.pi - phase_rad


def _order_of_phase(phase_rad: float, adds_stiffness: bool) -> float:
    """Return the order of a damping from its phase in rad relative to stiffness or inertia."""
    return (phase_rad if adds_stiffness else math.pi - phase_rad) / (math.pi / 2)
