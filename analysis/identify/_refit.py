"""Refit from where a fit ended: another structure, other noise, an order held, or further columns.

What the linear beam cannot do (a stiffness that depends on the deflection, say) adds to the torque
a column of known shape and unknown size, which is projected out as the free decay is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._fit import summary
from analysis.identify._noise import Noise, smooth_power
from analysis.identify._parametrization import FILTER_DELAYS, bare_beam
from analysis.identify._problem import Linearisation, Objective
from analysis.optimizer import Box, descend
from rigd.beam import clamped_free_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._parametrization import Unknowns
    from analysis.identify._plant import Plant
    from analysis.identify._problem import Comparison
    from analysis.identify._result import ModeEstimate, RecordFit
    from analysis.models import Structure
    from analysis.optimizer import NormalEquations


# Start of one structure at the plant that another found

_SMALL: Final = 1e-5
"""Loss, relative to stiffness or inertia, at which a damping is brought in."""


def vector(unknowns: Unknowns, plant: Plant) -> NDArray[np.float64]:
    """Unknowns of a plant, shape (k,): the way back of `Unknowns.plant`.

    Parameters
    ----------
    unknowns : Unknowns
    plant : Plant
        With damping wherever the structure has some.
    """
    damping, nominal = plant.damping, unknowns.nominal
    first, second = unknowns.omega_rad_s
    ratio = plant.beam.density_over_stiffness
    at = {
        "alpha": damping.alpha,
        "lambda": damping.lambda_,
        "density_over_stiffness": math.log(ratio / nominal.beam.density_over_stiffness),
        "bending_stiffness_n_m2": math.log(
            plant.beam.bending_stiffness_n_m2 / nominal.beam.bending_stiffness_n_m2
        ),
        "delay_s": plant.delay_s / unknowns.units["delay_s"],
        "tool_inertia_kg_m2": plant.tool_inertia_kg_m2 / nominal.beam.inertia_kg_m2,
        **{
            name: value
            for name, value in plant.parameters.items()
            if name.startswith("stiffness_offset")
        },
        **{name: value / unknowns.units[name] for name, value in plant.extras.items()},
    }
    if unknowns.structure.internal:
        size = damping.zeta * second**damping.alpha
        turn = math.pi / 2 * damping.alpha
        at["zeta"] = math.log(size * math.sin(turn))
        stiffening = math.log(abs(1 + size * complex(math.cos(turn), math.sin(turn))))
        at["density_over_stiffness"] -= stiffening
        at["bending_stiffness_n_m2"] += stiffening
    if unknowns.structure.external:
        size = damping.gamma / ratio * first ** (damping.lambda_ - 2)
        turn = math.pi / 2 * damping.lambda_
        at["gamma"] = math.log(size * math.sin(turn))
        at["density_over_stiffness"] += math.log(
            abs(1 - size * complex(math.cos(turn), math.sin(turn)))
        )
    if "tip_mass_kg" in unknowns.extras:
        ln_ratio, ln_stiffness = bare_beam(at["tip_mass_kg"])
        at["density_over_stiffness"] -= ln_ratio
        at["bending_stiffness_n_m2"] -= ln_stiffness
    for name, share in FILTER_DELAYS.items():
        if name in unknowns.extras:
            at["delay_s"] += share * plant.extras[name] / unknowns.units["delay_s"]
    return np.array([at.get(name, 0.0) for name in unknowns.names])


def adapted(unknowns: Unknowns, plant: Plant, of: Structure) -> NDArray[np.float64]:
    """Start for one structure at the plant that another found, shape (k,).

    Damping keeps its size at the first two modes where its order changes; damping that the other
    lacks comes in small, of order 1.

    Parameters
    ----------
    unknowns : Unknowns
        Unknowns of the one.
    plant : Plant
    of : Structure
        The other.
    """
    own = replace(unknowns, structure=of)
    start = dict(zip(own.names, vector(own, plant).tolist(), strict=True))
    for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda")):
        start.setdefault(coefficient, math.log(_SMALL))
        start.setdefault(order, 1.0)
    return np.array([start[name] for name in unknowns.names])


def resonances_kept(
    unknowns: Unknowns, damped_as: RecordFit, modes: Sequence[ModeEstimate]
) -> NDArray[np.float64]:
    """Start for a beam that is not uniform with its modes where a uniform one has them, shape (k,).

    A fractional order acts as stiffness, differently at each mode; with another order the modes
    would lie elsewhere, by more than they are wide.

    Parameters
    ----------
    unknowns : Unknowns
        Unknowns of the beam that is not uniform.
    damped_as : RecordFit
        Its damping is where that of the start comes from.
    modes : sequence of ModeEstimate
        Those of the uniform beam.
    """
    x = adapted(unknowns, damped_as.plant, damped_as.structure)
    plant = unknowns.plant(x)
    damping, ratio = plant.damping, plant.beam.density_over_stiffness
    numbers = range(1, len(unknowns.offsets) + 2)
    found = {mode.number: mode for mode in modes if mode.frequency_hz > 0}
    if not all(number in found for number in numbers):
        return x
    stiffness = (clamped_free_eigenvalues(len(numbers)) / plant.beam.length_m) ** 4
    rises = []
    for k, number in zip(stiffness.tolist(), numbers, strict=True):
        mode = found[number]
        s = 2 * np.pi * mode.frequency_hz * complex(-mode.damping_ratio, 1.0)
        inertial = ratio * s**2 + damping.gamma * s**damping.lambda_
        elastic = k * (1 + damping.zeta * s**damping.alpha)
        rises.append((-inertial / elastic).real)
    if "density_over_stiffness" in unknowns.free:
        # Mode 1 has no offset: rho/EI puts it where it is.
        x[unknowns.names.index("density_over_stiffness")] -= math.log(rises[0])
        rises = [rise / rises[0] for rise in rises]
    for name, rise in zip(unknowns.offsets, rises[1:], strict=True):
        x[unknowns.names.index(name)] = rise - 1
    return x


# Refit

_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares (some 1e4): 1e-4 of what BIC tells apart."""

_FILLINGS: Final = 3


@dataclass(frozen=True, slots=True)
class Refit:
    """A minimum: where, of which sum of squares, under which noise.

    Attributes
    ----------
    objective : Objective
    x : ndarray, shape (k,)
    equations : NormalEquations
        At `x`.
    noise : Noise
    columns : ndarray of complex, shape (c, K)
    """

    objective: Objective
    x: NDArray[np.float64]
    equations: NormalEquations
    noise: Noise
    columns: NDArray[np.complex128]

    @classmethod
    def descend(
        cls,
        comparison: Comparison,
        unknowns: Unknowns,
        start: NDArray[np.float64],
        noise: Noise,
        columns: NDArray[np.complex128] | None = None,
        *,
        max_evaluations: int = 60,
        relative_tolerance: float = _TOLERANCE,
        hold: str | None = None,
    ) -> Refit:
        """Descend from `start`, unknown torques being put as they are predicted there.

        Parameters
        ----------
        comparison : Comparison
        unknowns : Unknowns
        start : ndarray, shape (k,)
        noise : Noise
        columns : ndarray of complex, shape (c, K), or None
            Spectra to be projected out beside the free decay.
        max_evaluations : int
            Most evaluations of the sum of squares; with 1 nothing moves.
        relative_tolerance : float
            As `descend` takes it.
        hold : str, optional
            An unknown that stays where it starts.
        """
        none = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        further = none if columns is None else columns
        lower, upper = unknowns.bounds
        x = np.clip(start, lower, upper)
        if hold is not None:
            place = unknowns.names.index(hold)
            lower[place] = upper[place] = x[place]
        bounds = Box(lower, upper)
        complete = bool(comparison.measurement.torque_known.all())
        for _ in range(1 if complete else _FILLINGS):
            objective = WithColumns(comparison.filled(unknowns.plant(x)), unknowns, further)
            found = descend(
                partial(objective.normal_equations, weight=noise.weight),
                x,
                bounds,
                relative_tolerance=relative_tolerance,
                max_evaluations=max_evaluations,
                learns=False,
            )
            x = found.x
        return cls(objective, x, found.equations, noise, further)

    @property
    def cost(self) -> float:
        """Sum of squares here."""
        return self.equations.cost

    @property
    def promised_cost(self) -> float:
        """What it would be at the minimum, as far as can be seen from here."""
        lower, upper = self.objective.unknowns.bounds
        gradient, hessian = self.equations.gradient, self.equations.hessian
        held = ((self.x <= lower) & (gradient > 0)) | ((self.x >= upper) & (gradient < 0))
        free = ~held & (np.diag(hessian) > 0)
        scale = np.sqrt(np.diag(hessian)[free])
        slope = gradient[free] / scale
        scaled = hessian[np.ix_(free, free)] / np.outer(scale, scale)
        step = np.linalg.solve(scaled + 1e-12 * np.eye(scale.size), slope)
        return max(self.cost - float(slope @ step), 0.0)

    @property
    def plant(self) -> Plant:
        """The plant found."""
        return self.objective.unknowns.plant(self.x)

    def amplitudes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Amplitudes of the further columns, in units of them, and their deviations, shape (c,).

        The deviations count the uncertainty of everything else that was fitted.
        """
        values, covariance = self.amplitude_covariance()
        return values, np.sqrt(np.diag(covariance))

    def amplitude_covariance(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Amplitudes of the further columns, shape (c,), and their covariance, shape (c, c)."""
        at = self.objective.linearise(self.x)
        projected = self.objective.project(at, self.noise.weight)
        white = at.columns * self.noise.weight
        # As it was before the projection: that has made it orthogonal to the columns, whose
        # amplitudes would then seem to have nothing in common with the unknowns.
        everything = np.concatenate([at.jacobian * self.noise.weight, white])
        scale = np.sqrt(np.sum(np.abs(everything) ** 2, axis=1))
        scale[scale == 0] = 1.0
        everything = everything / scale[:, None]
        gram = (everything.conj() @ everything.T).real + 1e-12 * np.eye(scale.size)
        first = scale.size - len(self.columns)
        own = scale[first:]
        covariance = np.linalg.inv(gram)[first:, first:] / np.outer(own, own)
        return projected.amplitudes[projected.amplitudes.size - len(self.columns) :], covariance

    def fit(self) -> RecordFit:
        """Everything that follows from this minimum."""
        fit = summary(self.objective, self.x, self.noise)
        if not len(self.columns):
            return fit
        # `summary` does not know that the amplitudes of other columns are free as well.
        projected = self.objective.project(self.objective.linearise(self.x), self.noise.weight)
        decays = fit.ringing.degrees_of_freedom
        scale = np.sqrt(np.diag(projected.amplitude_gram))
        scale[scale == 0] = 1.0
        gram = projected.amplitude_gram / np.outer(scale, scale) + 1e-12 * np.eye(scale.size)
        own, shared, others = gram[:decays, :decays], gram[:decays, decays:], gram[decays:, decays:]
        # Inverse covariance of the decays alone, the other columns free (Schur complement).
        alone = own - shared @ np.linalg.solve(others, shared.T)
        a = (projected.amplitudes * scale)[:decays]
        chi_square = float(a @ alone @ a) * fit.degrees_of_freedom / fit.cost
        return replace(
            fit, ringing=replace(fit.ringing, chi_square=chi_square, degrees_of_freedom=decays)
        )

    def noise_here(self) -> Noise:
        """Take for noise what remains here and no column explains; lines stay left out."""
        residual = self.objective.project(self.objective.linearise(self.x), 1.0).residual
        share = self.objective.comparison.measurement.torque_share
        return replace(self.noise, power=smooth_power(residual) / share)


# Columns of known shape and unknown size


class WithColumns(Objective):
    """Sum of squares with further columns, whose amplitudes are free as those of the decay are.

    Parameters
    ----------
    comparison : Comparison
    unknowns : Unknowns
    columns : ndarray of complex, shape (c, K)
        Spectra, in N·m a unit of amplitude.
    """

    __slots__ = ("_further",)

    def __init__(
        self, comparison: Comparison, unknowns: Unknowns, columns: NDArray[np.complex128]
    ) -> None:
        super().__init__(comparison, unknowns)
        self._further = columns

    def linearise(self, x: NDArray[np.float64]) -> Linearisation:
        """Residual, derivatives and all columns at `x`."""
        at = super().linearise(x)
        return replace(at, columns=np.concatenate([at.columns, self._further]))


def unexplained_part(
    columns: NDArray[np.complex128], known: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Part of whitened columns that nothing that is free already could explain, shape (c, K).

    Parameters
    ----------
    columns : ndarray of complex, shape (c, K)
    known : ndarray of complex, shape (k, K)
        What the free parameters and amplitudes do to the torque, whitened.
    """
    scale = np.sqrt(np.sum(np.abs(known) ** 2, axis=1))
    basis = known[scale > 0] / scale[scale > 0, None]
    gram = (basis.conj() @ basis.T).real + 1e-12 * np.eye(len(basis))
    shares = np.linalg.solve(gram, (basis.conj() @ columns.T).real)
    part: NDArray[np.complex128] = columns - shares.T @ basis
    return part
