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
and the order instead of ``ln loss`` and the order (`Steps`). Where the damping is small the two are
the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._plant import SETTINGS, Plant
from analysis.models import ORDER_RANGE, SIZE_RANGE
from rigd.beam import Beam, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from analysis.identify._plant import Setting
    from analysis.models import Structure


# Unknowns

_LN_BEAM_HALF_RANGE: Final = math.log(3.0)
"""Largest change of ln(rho/EI) and ln(EI) from the nominal beam: a factor of 3."""

_DELAY_UNIT_S: Final = 1e-3
"""Delay in seconds at which the delay unknown is 1."""

_DELAY_RANGE_S: Final = 0.02
"""Largest magnitude of the delay in seconds."""

_GRADIENT_NAMES: Final[Mapping[str, str]] = {
    "density_over_stiffness": "ln_density_over_stiffness",
    "bending_stiffness_n_m2": "ln_stiffness",
}
"""Names of parameters whose derivatives the prediction has by their logarithms."""

_QUARTER_TURN_RAD: Final = math.pi / 2
"""Phase of ``s^1`` on the imaginary axis, in radians."""

_LOSS_OF_NEW_DAMPING: Final = 1e-5
"""Loss, relative to stiffness or inertia, at which a fit starts with a damping that was absent."""


@dataclass(frozen=True)
class Unknowns:
    """Vector of unknowns of one structure: its free damping parameters and free settings.

    Attributes
    ----------
    structure : Structure
        Damping structure.
    nominal : Plant
        Source of the values that are not free. Its damping is not used.
    free : tuple of str
        Free settings, in the order of `SETTINGS`.
    omega_rad_s : tuple of float
        Undamped first and second natural frequency of the nominal beam.
    """

    structure: Structure
    nominal: Plant
    free: tuple[Setting, ...]
    omega_rad_s: tuple[float, float]

    @classmethod
    def of(cls, structure: Structure, nominal: Plant, free: tuple[Setting, ...]) -> Unknowns:
        """Return the unknowns of a structure with some settings free.

        Parameters
        ----------
        structure : Structure
            Structure that states which damping parameters are free.
        nominal : Plant
            Beam and rig as the file states them.
        free : tuple of str
            Names of the settings that are estimated.
        """
        first_omega, second_omega = map(float, undamped_frequencies_rad_s(nominal.beam, 2))
        ordered = tuple(name for name in SETTINGS if name in free)
        return cls(structure, nominal, ordered, (first_omega, second_omega))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters, in the order of the vector."""
        return (*self.structure.free, *self.free)

    @cached_property
    def gradient_names(self) -> tuple[str, ...]:
        """Return the names of the free parameters as the prediction uses them for derivatives."""
        return tuple(_GRADIENT_NAMES.get(name, name) for name in self.names)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and the upper bounds of the unknowns, each of shape (k,)."""
        ln_size_range = (math.log(SIZE_RANGE[0]), math.log(SIZE_RANGE[1]))
        largest_delay = _DELAY_RANGE_S / _DELAY_UNIT_S
        ranges = {
            "zeta": ln_size_range,
            "alpha": ORDER_RANGE,
            "gamma": ln_size_range,
            "lambda": ORDER_RANGE,
            "density_over_stiffness": (-_LN_BEAM_HALF_RANGE, _LN_BEAM_HALF_RANGE),
            "bending_stiffness_n_m2": (-_LN_BEAM_HALF_RANGE, _LN_BEAM_HALF_RANGE),
            "delay_s": (-largest_delay, largest_delay),
            "tool_inertia_kg_m2": (0.0, 1.0),
        }
        lower_bounds, upper_bounds = zip(*(ranges[name] for name in self.names), strict=True)
        return np.array(lower_bounds), np.array(upper_bounds)

    def start(self, sizes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unknowns for given damping sizes, with nominal settings, shape (k,).

        Parameters
        ----------
        sizes : ndarray, shape (len(structure.free),)
            Those of ``ln z``, ``alpha``, ``ln g`` and ``lambda`` that are free.
        """
        at: dict[str, float] = {
            **dict(self.structure.fixed.items()),
            **dict(zip(self.structure.free, sizes.tolist(), strict=True)),
            "density_over_stiffness": 0.0,
            "bending_stiffness_n_m2": 0.0,
            **self._linear_unknowns(self.nominal),
        }
        for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda")):
            if coefficient in self.names:
                at[coefficient] += math.log(math.sin(_QUARTER_TURN_RAD * at[order]))
        return np.array([at[name] for name in self.names])

    def vector(self, plant: Plant) -> NDArray[np.float64]:
        """Return the unknowns that describe a plant, shape (k,): the inverse of `plant`.

        Parameters
        ----------
        plant : Plant
            Plant with damping of any structure. If the structure of these unknowns fixes another
            order, the damping keeps its loss at the mode. Absent damping starts small, with order
            1.
        """
        damping, nominal = plant.damping, self.nominal.beam
        first_omega, second_omega = self.omega_rad_s
        density_over_stiffness = plant.beam.density_over_stiffness
        ln_ratio = math.log(density_over_stiffness / nominal.density_over_stiffness)
        ln_stiffness = math.log(plant.beam.bending_stiffness_n_m2 / nominal.bending_stiffness_n_m2)
        at = {
            "zeta": math.log(_LOSS_OF_NEW_DAMPING),
            "alpha": 1.0,
            "gamma": math.log(_LOSS_OF_NEW_DAMPING),
            "lambda": 1.0,
        }
        at |= self._linear_unknowns(plant)
        if damping.zeta > 0:
            damping_size, phase = (
                damping.zeta * second_omega**damping.alpha,
                _QUARTER_TURN_RAD * damping.alpha,
            )
            at["zeta"], at["alpha"] = math.log(damping_size * math.sin(phase)), damping.alpha
            stiffening = math.log(abs(1 + damping_size * complex(math.cos(phase), math.sin(phase))))
            ln_ratio -= stiffening
            ln_stiffness += stiffening
        if damping.gamma > 0:
            damping_size = (
                damping.gamma / density_over_stiffness * first_omega ** (damping.lambda_ - 2)
            )
            phase = _QUARTER_TURN_RAD * damping.lambda_
            at["gamma"], at["lambda"] = math.log(damping_size * math.sin(phase)), damping.lambda_
            ln_ratio += math.log(abs(1 - damping_size * complex(math.cos(phase), math.sin(phase))))
        at |= {"density_over_stiffness": ln_ratio, "bending_stiffness_n_m2": ln_stiffness}
        return np.array([at[name] for name in self.names])

    def plant(self, x: NDArray[np.float64]) -> Plant:
        """Return the plant that a vector of unknowns describes."""
        return self._plant_of(self._values_and_derivatives(x)[0])

    def plant_and_gradient(self, x: NDArray[np.float64]) -> tuple[Plant, NDArray[np.float64]]:
        """Return the plant for a vector of unknowns, and the derivatives of its parameters.

        The derivatives have the shape (k, k): [parameter, unknown]. The parameters are
        `gradient_names`, where zeta and gamma are not logarithms.
        """
        values, derivative = self._values_and_derivatives(x)
        for index, name in enumerate(self.names):
            if name in ("zeta", "gamma"):
                derivative[index] *= values[name]
        return self._plant_of(values), derivative

    def _plant_of(self, values: Mapping[str, float]) -> Plant:
        """Return the plant with given values of all parameters."""
        density_over_stiffness, stiffness = (
            values["density_over_stiffness"],
            values["bending_stiffness_n_m2"],
        )
        return replace(
            self.nominal,
            beam=Beam(self.nominal.beam.length_m, density_over_stiffness * stiffness, stiffness),
            damping=self.structure.damping({name: values[name] for name in self.structure.free}),
            delay_s=values["delay_s"],
            tool_inertia_kg_m2=values["tool_inertia_kg_m2"],
        )

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return all plant parameters by name, free and fixed, for a vector of unknowns."""
        return self.plant(x).parameters

    @cached_property
    def units(self) -> Mapping[str, float]:
        """Return, for delay and tool inertia, the value that corresponds to 1 of the unknown."""
        beam = self.nominal.beam
        units = {
            "delay_s": _DELAY_UNIT_S,
            "tool_inertia_kg_m2": beam.inertia_kg_m2,
        }
        return MappingProxyType(units)

    @cached_property
    def _indices(self) -> Mapping[str, int]:
        """Return the index of each free parameter in the vector of unknowns."""
        return MappingProxyType({name: i for i, name in enumerate(self.names)})

    @cached_property
    def _fixed_values(self) -> Mapping[str, float]:
        """Return nominal settings and fixed damping parameters, by name."""
        fixed = dict(self.structure.fixed.items())
        return MappingProxyType({**self.nominal.parameters, **fixed})

    def _linear_unknowns(self, plant: Plant) -> dict[str, float]:
        """Return delay and tool inertia of a plant in the units of the unknowns, by name."""
        values = plant.parameters
        return {name: values[name] / unit for name, unit in self.units.items()}

    def estimates_by_unknowns(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the free parameters by the unknowns, shape (k, k).

        The indices are [parameter, unknown]. Parameters in `LOGARITHMIC_PARAMETERS` count as
        logarithms.
        """
        derivative: NDArray[np.float64] = self._values_and_derivatives(x)[1]
        return derivative

    def _values_and_derivatives(
        self, x: NDArray[np.float64]
    ) -> tuple[dict[str, float], NDArray[np.float64]]:
        """Return all parameters for a vector of unknowns, and `estimates_by_unknowns`."""
        indices = self._indices
        unknown_values: dict[str, float] = dict(zip(self.names, x.tolist(), strict=True))
        values: dict[str, float] = dict(self._fixed_values)
        derivative = np.eye(x.size)
        first_omega, second_omega = self.omega_rad_s
        # ln of the factor by which damping changes stiffness and inertia, with its derivatives.
        stiffness_change, inertia_change = np.zeros((2, x.size + 1))
        if self.structure.internal:
            values["alpha"] = order = unknown_values.get("alpha", values["alpha"])
            ln_z, slope = _ln_damping_size(unknown_values["zeta"], order)
            values["zeta"] = math.exp(ln_z - order * math.log(second_omega))
            stiffness_change = self._ln_factor_of_damping(ln_z, order, 1.0, "zeta", "alpha", slope)
            if "alpha" in indices:
                derivative[indices["zeta"], indices["alpha"]] = slope - math.log(second_omega)
        if self.structure.external:
            values["lambda"] = order = unknown_values.get("lambda", values["lambda"])
            ln_g, slope = _ln_damping_size(unknown_values["gamma"], order)
            inertia_change = self._ln_factor_of_damping(ln_g, order, -1.0, "gamma", "lambda", slope)
            if "lambda" in indices:
                derivative[indices["gamma"], indices["lambda"]] = slope - math.log(first_omega)
        for name, sign in (("density_over_stiffness", 1.0), ("bending_stiffness_n_m2", -1.0)):
            if name in indices:
                ln_factor = sign * stiffness_change - (inertia_change if sign > 0 else 0.0)
                values[name] *= math.exp(unknown_values[name] + ln_factor[-1])
                derivative[indices[name]] += ln_factor[:-1]
        if self.structure.external:
            density_over_stiffness = values["density_over_stiffness"]
            values["gamma"] = density_over_stiffness * math.exp(
                ln_g + (2 - values["lambda"]) * math.log(first_omega)
            )
            if "density_over_stiffness" in indices:
                derivative[indices["gamma"]] += derivative[indices["density_over_stiffness"]]
        units = self.units
        for name in units.keys() & indices.keys():
            values[name] = unknown_values[name] * units[name]
            derivative[indices[name], indices[name]] = units[name]
        return values, derivative

    def _ln_factor_of_damping(
        self,
        ln_size: float,
        order: float,
        sign: float,
        loss_name: str,
        order_name: str,
        slope: float,
    ) -> NDArray[np.float64]:
        """Return ``ln |1 ± size exp(j order pi/2)|`` with its derivatives by the unknowns.

        The result has the shape (k + 1,): the derivatives, then the value. `slope` is the
        derivative of `ln_size` by the order at constant loss.
        """
        size, phase = sign * math.exp(ln_size), _QUARTER_TURN_RAD * order
        square = 1 + 2 * size * math.cos(phase) + size * size
        by_ln_size = size * (math.cos(phase) + size) / square
        addition = np.zeros(len(self.names) + 1)
        addition[self._indices[loss_name]] = by_ln_size
        if order_name in self._indices:
            by_phase = -_QUARTER_TURN_RAD * size * math.sin(phase) / square
            addition[self._indices[order_name]] = by_ln_size * slope + by_phase
        addition[-1] = math.log(square) / 2
        return addition


def _ln_damping_size(ln_loss: float, order: float) -> tuple[float, float]:
    """Return ``ln size`` of a damping with a given loss, and its derivative by the order."""
    phase = _QUARTER_TURN_RAD * order
    return ln_loss - math.log(math.sin(phase)), -_QUARTER_TURN_RAD / math.tan(phase)


# Steps

_MAX_ORDER_STEP_FRACTION: Final = 0.5
"""Longest step of an order, as a fraction of its distance to 0 or 2."""

VANISHING_LOSS: Final = 1e-4
"""Loss, relative to stiffness or inertia, below which one step may remove the damping."""

_MAX_GROWTH_EXPONENT: Final = 50.0
"""Largest exponent by which one step increases ``tan(theta/2)``."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Curved steps of a descent from a vector of unknowns, and their limits.

    Attributes
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the unknowns.
    dampings : tuple of (int, int, bool)
        Index of the loss and index of the order of each damping with a free order, and whether the
        damping adds to the stiffness. If not, it reduces the inertia.
    losses : tuple of int
        Indices of the losses of dampings with a fixed order.
    linear_below : float
        Loss below which a step changes the loss itself, to which the effect of the damping is
        proportional. A step of its logarithm would lead from a negligible value to the upper bound,
        and most of a descent would be spent on the way back.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    dampings: tuple[tuple[int, int, bool], ...]
    losses: tuple[int, ...] = ()
    linear_below: float = 0.0

    @classmethod
    def of(cls, unknowns: Unknowns, linear_below: float = 0.0) -> Steps:
        """Return the steps for the unknowns of a structure.

        Parameters
        ----------
        unknowns : Unknowns
            Unknowns of the structure.
        linear_below : float
            Loss below which a step changes the loss itself.
        """
        names = unknowns.names
        dampings = tuple(
            (names.index(coefficient), names.index(order), coefficient == "zeta")
            for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda"))
            if order in names
        )
        losses = tuple(
            names.index(coefficient)
            for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda"))
            if coefficient in names and order not in names
        )
        return cls(*unknowns.bounds, dampings, losses, linear_below)

    def limits(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the smallest and largest admissible step of each unknown, each of shape (k,).

        An order approaches 0 and 2 by a fraction of its distance at a time: the effect of damping
        depends on the logarithm of that distance. The order of a vanished damping is constant.
        """
        smallest, largest = self.lower - x, self.upper - x
        for loss, order, _ in self.dampings:
            fraction = _MAX_ORDER_STEP_FRACTION if x[loss] > self.lower[loss] else 0.0
            smallest[order] = max(smallest[order], -fraction * x[order])
            largest[order] = min(largest[order], fraction * (2 - x[order]))
        return smallest, largest

    def end(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unknowns after a step along the curve, within the bounds, shape (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
            Unknowns before the step.
        step : ndarray, shape (k,)
            Step within the `limits`, tangent to the curve at `x`.
        """
        end = np.clip(x + step, self.lower, self.upper)
        for i in self.losses:
            if step[i] > 0 and math.exp(x[i]) < self.linear_below:
                end[i] = min(x[i] + math.log1p(step[i]), self.upper[i])
        for i, j, adds_stiffness in self.dampings:
            if step[i] != 0:
                phase_before, phase_after = (
                    _phase_of_order(x[j], adds_stiffness),
                    _phase_of_order(end[j], adds_stiffness),
                )
                largest_loss = math.exp(self.upper[i])
                loss = math.exp(x[i])
                linear = loss < self.linear_below
                loss, phase = _loss_and_phase_after_step(
                    loss, float(step[i]), phase_before, phase_after, largest_loss, linear=linear
                )
                end[i] = math.log(loss) if loss > 0 else self.lower[i]
                if phase != phase_after:
                    end[j] = _order_of_phase(phase, adds_stiffness)
        clipped: NDArray[np.float64] = np.clip(end, self.lower, self.upper)
        return clipped


def _loss_and_phase_after_step(
    loss: float,
    step: float,
    phase_before: float,
    phase_after: float,
    largest_loss: float,
    *,
    linear: bool,
) -> tuple[float, float]:
    """Return loss and phase of a damping after a step of ``ln loss`` and phase.

    The phase changes from `phase_before` to `phase_after`. If no loss up to `largest_loss` gives
    the required phase, the largest loss is combined with the phase that it gives.
    """
    size = loss / math.sin(phase_before)
    real_part = 1 + size * math.cos(phase_before)
    # d ln tan(theta/2) = (d ln loss + size / sin(turn) d turn) / |1 + size exp(j turn)|
    ln_tan_step = (
        step + size / math.sin(phase_before) * (phase_after - phase_before)
    ) / math.hypot(real_part, loss)
    if ln_tan_step <= -1 and loss < VANISHING_LOSS:
        return (
            0.0,
            phase_after,
        )  # a step in proportion to the effect would change the sign of the loss
    theta = math.atan2(loss, real_part)
    growth = (
        1 + ln_tan_step
        if linear and ln_tan_step > 0
        else math.exp(min(ln_tan_step, _MAX_GROWTH_EXPONENT))
    )
    theta = 2 * math.atan(math.tan(theta / 2) * growth)
    if theta < phase_after:
        loss = math.sin(theta) / math.sin(phase_after - theta) * math.sin(phase_after)
        if loss <= largest_loss:
            return loss, phase_after
    return largest_loss, theta + math.asin(min(math.sin(theta) ** 2 / largest_loss, 1.0))


def _phase_of_order(order: float, adds_stiffness: bool) -> float:
    """Return the phase of a damping relative to stiffness or inertia, 0 to pi, from its order."""
    phase = math.pi / 2 * float(order)
    return phase if adds_stiffness else math.pi - phase


def _order_of_phase(phase: float, adds_stiffness: bool) -> float:
    """Return the order of a damping from its phase relative to stiffness or inertia."""
    return (phase if adds_stiffness else math.pi - phase) / (math.pi / 2)
