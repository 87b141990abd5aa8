"""Parametrization of a fit: its vector of unknowns, the way from it to a plant, and suitable steps.

Damping of a low order acts as stiffness, damping of an order near 2 as inertia. With density and
stiffness free, such damping and the beam can compensate each other along a curved flat direction,
in which a descent takes hundreds of steps. So the unknowns are quantities that a record determines
directly; orders then change alone:

* internal damping by its loss relative to the stiffness, ``ln(z sin(alpha pi/2))`` with
  ``z = zeta omega_2^alpha`` at the undamped second mode, and ``alpha``;
* external damping by its loss relative to the inertia, ``ln(g sin(lambda pi/2))`` with
  ``g = gamma omega_1^lambda / (rho/EI omega_1²)`` at the undamped first mode, and ``lambda``;
* the stiffness that counts with its damping, ``EI |1 + z exp(j alpha pi/2)|``, and likewise
  density over stiffness, ``rho/EI |1 - g exp(j lambda pi/2)| / |1 + z exp(j alpha pi/2)|``, both
  as logarithms relative to the nominal beam's;
* the delay in ms, and the tool inertia relative to the nominal beam's.

Where damping is larger than the stiffness or inertia it adds to, loss and order compensate each
other: the record determines only the phase theta of ``1 ± size exp(j order pi/2)``, and at constant
theta loss and order vary over many powers of ten. A straight step leaves this curve at once, and a
descent with straight steps takes a hundred of them. So a step is taken along ``ln tan(theta/2)``
and the order instead of ``ln loss`` and the order (`Steps`); where the damping is small the two
are the same.
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

_BEAM_RANGE: Final = math.log(3.0)
_DELAY_UNIT_S: Final = 1e-3
_DELAY_RANGE_S: Final = 0.02

_GRADIENT_NAMES: Final[Mapping[str, str]] = {
    "density_over_stiffness": "ln_density_over_stiffness",
    "bending_stiffness_n_m2": "ln_stiffness",
}
_QUARTER_TURN: Final = math.pi / 2
_SMALL: Final = 1e-5
"""Loss, relative to stiffness or inertia, at which a damping is brought in."""


@dataclass(frozen=True)
class Unknowns:
    """Vector of unknowns of one structure: its damping, and the free settings.

    Attributes
    ----------
    structure : Structure
    nominal : Plant
        Source of the values that are not free; its damping is not used.
    free : tuple of str
        Free settings, in the order of `SETTINGS`.
    omega_rad_s : tuple of float
        Undamped first and second mode of the nominal beam.
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
            Says which damping parameters are free.
        nominal : Plant
            Beam and rig as the file states them.
        free : tuple of str
            Settings that are estimated.
        """
        first, second = map(float, undamped_frequencies_rad_s(nominal.beam, 2))
        ordered = tuple(name for name in SETTINGS if name in free)
        return cls(structure, nominal, ordered, (first, second))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters, in the order of the vector."""
        return (*self.structure.free, *self.free)

    @cached_property
    def gradient_names(self) -> tuple[str, ...]:
        """Return the same names as the prediction uses for its derivatives."""
        return tuple(_GRADIENT_NAMES.get(name, name) for name in self.names)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return lower and upper bounds, shape (k,)."""
        size = (math.log(SIZE_RANGE[0]), math.log(SIZE_RANGE[1]))
        delay = _DELAY_RANGE_S / _DELAY_UNIT_S
        ranges = {
            "zeta": size,
            "alpha": ORDER_RANGE,
            "gamma": size,
            "lambda": ORDER_RANGE,
            "density_over_stiffness": (-_BEAM_RANGE, _BEAM_RANGE),
            "bending_stiffness_n_m2": (-_BEAM_RANGE, _BEAM_RANGE),
            "delay_s": (-delay, delay),
            "tool_inertia_kg_m2": (0.0, 1.0),
        }
        low, high = zip(*(ranges[name] for name in self.names), strict=True)
        return np.array(low), np.array(high)

    def start(self, sizes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the vector for given damping sizes, with settings at their nominal values.

        Parameters
        ----------
        sizes : ndarray, shape (len(structure.free),)
            ``ln z``, ``alpha``, ``ln g`` and ``lambda``, those that are free.
        """
        at: dict[str, float] = {
            **dict(self.structure.fixed.items()),
            **dict(zip(self.structure.free, sizes.tolist(), strict=True)),
            "density_over_stiffness": 0.0,
            "bending_stiffness_n_m2": 0.0,
            **self._linear(self.nominal),
        }
        for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda")):
            if coefficient in self.names:
                at[coefficient] += math.log(math.sin(_QUARTER_TURN * at[order]))
        return np.array([at[name] for name in self.names])

    def vector(self, plant: Plant) -> NDArray[np.float64]:
        """Return the unknowns of a plant, shape (k,): the inverse of `plant`.

        Parameters
        ----------
        plant : Plant
            Plant of any structure. If this one fixes another order, the damping has the same loss
            at the mode; absent damping starts small, with order 1.
        """
        damping, nominal = plant.damping, self.nominal.beam
        first, second = self.omega_rad_s
        ratio = plant.beam.density_over_stiffness
        ln_ratio = math.log(ratio / nominal.density_over_stiffness)
        ln_stiffness = math.log(plant.beam.bending_stiffness_n_m2 / nominal.bending_stiffness_n_m2)
        at = {"zeta": math.log(_SMALL), "alpha": 1.0, "gamma": math.log(_SMALL), "lambda": 1.0}
        at |= self._linear(plant)
        if damping.zeta > 0:
            size, turn = damping.zeta * second**damping.alpha, _QUARTER_TURN * damping.alpha
            at["zeta"], at["alpha"] = math.log(size * math.sin(turn)), damping.alpha
            stiffening = math.log(abs(1 + size * complex(math.cos(turn), math.sin(turn))))
            ln_ratio -= stiffening
            ln_stiffness += stiffening
        if damping.gamma > 0:
            size = damping.gamma / ratio * first ** (damping.lambda_ - 2)
            turn = _QUARTER_TURN * damping.lambda_
            at["gamma"], at["lambda"] = math.log(size * math.sin(turn)), damping.lambda_
            ln_ratio += math.log(abs(1 - size * complex(math.cos(turn), math.sin(turn))))
        at |= {"density_over_stiffness": ln_ratio, "bending_stiffness_n_m2": ln_stiffness}
        return np.array([at[name] for name in self.names])

    def plant(self, x: NDArray[np.float64]) -> Plant:
        """Return the plant at `x`."""
        return self._plant_of(self._values(x)[0])

    def plant_and_gradient(self, x: NDArray[np.float64]) -> tuple[Plant, NDArray[np.float64]]:
        """Return `plant` at `x` and the derivatives of its parameters by `x`.

        The parameters are `gradient_names`, shape (k, k): zeta and gamma themselves, not their
        logarithms.
        """
        values, derivative = self._values(x)
        for index, name in enumerate(self.names):
            if name in ("zeta", "gamma"):
                derivative[index] *= values[name]
        return self._plant_of(values), derivative

    def _plant_of(self, values: Mapping[str, float]) -> Plant:
        ratio, stiffness = values["density_over_stiffness"], values["bending_stiffness_n_m2"]
        return replace(
            self.nominal,
            beam=Beam(self.nominal.beam.length_m, ratio * stiffness, stiffness),
            damping=self.structure.damping({name: values[name] for name in self.structure.free}),
            delay_s=values["delay_s"],
            tool_inertia_kg_m2=values["tool_inertia_kg_m2"],
        )

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return all parameters at `x`."""
        return self.plant(x).parameters

    @cached_property
    def units(self) -> Mapping[str, float]:
        """Return the size of a unit of each linear unknown."""
        beam = self.nominal.beam
        units = {
            "delay_s": _DELAY_UNIT_S,
            "tool_inertia_kg_m2": beam.inertia_kg_m2,
        }
        return MappingProxyType(units)

    @cached_property
    def _indices(self) -> Mapping[str, int]:
        """Return the index of each free parameter in the vector."""
        return MappingProxyType({name: i for i, name in enumerate(self.names)})

    @cached_property
    def _given(self) -> Mapping[str, float]:
        """Return the parameters before any is set free."""
        fixed = dict(self.structure.fixed.items())
        return MappingProxyType({**self.nominal.parameters, **fixed})

    def _linear(self, plant: Plant) -> dict[str, float]:
        """Return the linear unknowns of a plant, by name."""
        values = plant.parameters
        return {name: values[name] / unit for name, unit in self.units.items()}

    def estimates_by_unknowns(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differentiate the free parameters by `x`, shape (k, k): [parameter, unknown].

        `LOGARITHMIC` parameters count as logarithms.
        """
        derivative: NDArray[np.float64] = self._values(x)[1]
        return derivative

    def _values(self, x: NDArray[np.float64]) -> tuple[dict[str, float], NDArray[np.float64]]:
        """Return all parameters at `x`, and `estimates_by_unknowns`."""
        index = self._indices
        given: dict[str, float] = dict(zip(self.names, x.tolist(), strict=True))
        values: dict[str, float] = dict(self._given)
        derivative = np.eye(x.size)
        first, second = self.omega_rad_s
        # How much the damping adds to stiffness and inertia, as logarithms, and who moves that.
        stiffening, inertial = np.zeros((2, x.size + 1))
        if self.structure.internal:
            values["alpha"] = order = given.get("alpha", values["alpha"])
            ln_z, slope = _size(given["zeta"], order)
            values["zeta"] = math.exp(ln_z - order * math.log(second))
            stiffening = self._addition(ln_z, order, 1.0, "zeta", "alpha", slope)
            if "alpha" in index:
                derivative[index["zeta"], index["alpha"]] = slope - math.log(second)
        if self.structure.external:
            values["lambda"] = order = given.get("lambda", values["lambda"])
            ln_g, slope = _size(given["gamma"], order)
            inertial = self._addition(ln_g, order, -1.0, "gamma", "lambda", slope)
            if "lambda" in index:
                derivative[index["gamma"], index["lambda"]] = slope - math.log(first)
        for name, sign in (("density_over_stiffness", 1.0), ("bending_stiffness_n_m2", -1.0)):
            if name in index:
                added = sign * stiffening - (inertial if sign > 0 else 0.0)
                values[name] *= math.exp(given[name] + added[-1])
                derivative[index[name]] += added[:-1]
        if self.structure.external:
            ratio = values["density_over_stiffness"]
            values["gamma"] = ratio * math.exp(ln_g + (2 - values["lambda"]) * math.log(first))
            if "density_over_stiffness" in index:
                derivative[index["gamma"]] += derivative[index["density_over_stiffness"]]
        units = self.units
        for name in units.keys() & index.keys():
            values[name] = given[name] * units[name]
            derivative[index[name], index[name]] = units[name]
        return values, derivative

    def _addition(
        self, ln_size: float, order: float, sign: float, coefficient: str, of: str, slope: float
    ) -> NDArray[np.float64]:
        """Return slopes of ``ln |1 ± size exp(j order pi/2)|`` by the unknowns; last the value.

        `slope` is that of `ln_size` by the order at constant loss.
        """
        size, angle = sign * math.exp(ln_size), _QUARTER_TURN * order
        square = 1 + 2 * size * math.cos(angle) + size * size
        by_ln_size = size * (math.cos(angle) + size) / square
        addition = np.zeros(len(self.names) + 1)
        addition[self._indices[coefficient]] = by_ln_size
        if of in self._indices:
            turning = -_QUARTER_TURN * size * math.sin(angle) / square
            addition[self._indices[of]] = by_ln_size * slope + turning
        addition[-1] = math.log(square) / 2
        return addition


def _size(ln_loss: float, order: float) -> tuple[float, float]:
    """Return ``ln size`` of a damping with a loss, and its slope by the order."""
    angle = _QUARTER_TURN * order
    return ln_loss - math.log(math.sin(angle)), -_QUARTER_TURN / math.tan(angle)


# Steps

_STEP_FRACTION: Final = 0.5
"""Longest step of an order, as a fraction of the distance to 0 or 2."""

NEXT_TO_NOTHING: Final = 1e-4
"""Loss that may vanish in one step."""

_LARGEST_GROWTH: Final = 50.0


@dataclass(frozen=True, slots=True)
class Steps:
    """Curved steps from a vector of unknowns, and their limits.

    Attributes
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the unknowns.
    dampings : tuple of (int, int, bool)
        Indices of loss and order of each damping with a free order, and whether it adds to the
        stiffness; otherwise it reduces the inertia.
    losses : tuple of int
        Indices of the losses of dampings with a fixed order.
    linear_below : float
        Loss below which a step changes the loss itself, to which its effect is proportional. Its
        logarithm would jump from a negligible value to the upper bound, and most of a descent would
        be spent on the way back.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    dampings: tuple[tuple[int, int, bool], ...]
    losses: tuple[int, ...] = ()
    linear_below: float = 0.0

    @classmethod
    def of(cls, unknowns: Unknowns, linear_below: float = 0.0) -> Steps:
        """Return the steps for a vector of unknowns.

        Parameters
        ----------
        unknowns : Unknowns
        linear_below : float
            Value of the attribute `linear_below`.
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
        """Return the least and largest step in each unknown, shape (k,).

        Orders approach 0 and 2 by a fraction of the distance at a time: the effect of damping
        depends on the logarithm of that distance. Vanished damping has a constant order.
        """
        least, most = self.lower - x, self.upper - x
        for loss, order, _ in self.dampings:
            fraction = _STEP_FRACTION if x[loss] > self.lower[loss] else 0.0
            least[order] = max(least[order], -fraction * x[order])
            most[order] = min(most[order], fraction * (2 - x[order]))
        return least, most

    def end(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the point within the bounds that a step leads to, shape (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
        step : ndarray, shape (k,)
            Step within the `limits`, tangent to the curve at `x`.
        """
        end = np.clip(x + step, self.lower, self.upper)
        for i in self.losses:
            if step[i] > 0 and math.exp(x[i]) < self.linear_below:
                end[i] = min(x[i] + math.log1p(step[i]), self.upper[i])
        for i, j, elastic in self.dampings:
            if step[i] != 0:
                before, after = _turn(x[j], elastic), _turn(end[j], elastic)
                most = math.exp(self.upper[i])
                loss = math.exp(x[i])
                linear = loss < self.linear_below
                loss, turn = _along(loss, float(step[i]), before, after, most, linear=linear)
                end[i] = math.log(loss) if loss > 0 else self.lower[i]
                if turn != after:
                    end[j] = _order(turn, elastic)
        clipped: NDArray[np.float64] = np.clip(end, self.lower, self.upper)
        return clipped


def _along(
    loss: float, step: float, before: float, after: float, most: float, *, linear: bool
) -> tuple[float, float]:
    """Return loss and phase after a step of ``ln loss`` while the phase goes from before to after.

    If no loss up to `most` gives the required phase, the largest loss is combined with the phase
    that it gives.
    """
    size = loss / math.sin(before)
    real = 1 + size * math.cos(before)
    # d ln tan(theta/2) = (d ln loss + size / sin(turn) d turn) / |1 + size exp(j turn)|
    along = (step + size / math.sin(before) * (after - before)) / math.hypot(real, loss)
    if along <= -1 and loss < NEXT_TO_NOTHING:
        return 0.0, after  # in proportion to its effect it would change sign
    theta = math.atan2(loss, real)
    growth = 1 + along if linear and along > 0 else math.exp(min(along, _LARGEST_GROWTH))
    theta = 2 * math.atan(math.tan(theta / 2) * growth)
    if theta < after:
        loss = math.sin(theta) / math.sin(after - theta) * math.sin(after)
        if loss <= most:
            return loss, after
    return most, theta + math.asin(min(math.sin(theta) ** 2 / most, 1.0))


def _turn(order: float, elastic: bool) -> float:
    """Return the phase of the damping against stiffness or inertia, 0 to pi."""
    turn = math.pi / 2 * float(order)
    return turn if elastic else math.pi - turn


def _order(turn: float, elastic: bool) -> float:
    return (turn if elastic else math.pi - turn) / (math.pi / 2)
