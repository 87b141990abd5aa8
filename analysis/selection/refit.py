"""Fitting again from where a fit ended: other noise, an order held, or more columns.

What the linear beam cannot do (a stiffness that depends on the deflection) adds to the torque a
column of known shape and unknown size, which is projected out like the free decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.levenberg_marquardt import minimise
from analysis.whole_record.noise import Noise, smooth_power
from analysis.whole_record.objective import Linearisation, Objective
from analysis.whole_record.summary import summary
from analysis.whole_record.unknowns import Unknowns

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.structures import Structure
    from analysis.whole_record import Plant, RecordFit
    from analysis.whole_record.comparison import Comparison

_TOLERANCE: Final = 1e-8
"""Of the sum of squares, which is some 1e4: a ten-thousandth of what BIC tells apart."""

_FILLINGS: Final = 3
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
        "delay_s": plant.delay_s * 1e3,
        "tool_inertia_kg_m2": plant.tool_inertia_kg_m2 / nominal.beam.inertia_kg_m2,
        **{
            name: value
            for name, value in plant.parameters.items()
            if name.startswith("stiffness_offset")
        },
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
    return np.array([at.get(name, 0.0) for name in unknowns.names])


def adapted(unknowns: Unknowns, plant: Plant, of: Structure) -> NDArray[np.float64]:
    """Start for one structure at the plant that another found, shape (k,).

    Damping keeps its size at the first two modes where its order changes; damping that the other
    lacks comes in small, of order 1.

    Parameters
    ----------
    unknowns : Unknowns
        Of the one.
    plant : Plant
    of : Structure
        The other.
    """
    own = Unknowns(of, unknowns.nominal, unknowns.free, unknowns.offsets, unknowns.omega_rad_s)
    start = dict(zip(own.names, vector(own, plant).tolist(), strict=True))
    for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda")):
        start.setdefault(coefficient, math.log(_SMALL))
        start.setdefault(order, 1.0)
    return np.array([start[name] for name in unknowns.names])


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


@dataclass(frozen=True, slots=True)
class Refit:
    """A minimum: where, of which sum of squares, under which noise."""

    objective: Objective
    x: NDArray[np.float64]
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
        max_evaluations: int = 60,
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
            Of the sum of squares.
        """
        none = np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128)
        further = none if columns is None else columns
        lower, upper = unknowns.bounds
        x = np.clip(start, lower, upper)
        complete = bool(comparison.measurement.torque_known.all())
        for _ in range(1 if complete else _FILLINGS):
            filled = comparison.filled(unknowns.plant(x))
            objective = WithColumns(filled, unknowns, further)
            x = minimise(
                lambda at, objective=objective: objective.normal_equations(at, noise.weight),  # type: ignore[misc]
                x,
                lower,
                upper,
                relative_tolerance=_TOLERANCE,
                max_evaluations=max_evaluations,
            ).x
        return cls(objective, x, noise, further)

    @property
    def cost(self) -> float:
        """Sum of squares here."""
        return self.objective.normal_equations(self.x, self.noise.weight).cost

    @property
    def plant(self) -> Plant:
        """The plant found."""
        return self.objective.unknowns.plant(self.x)

    def amplitudes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Amplitudes of the further columns, in units of them, and their deviations, shape (c,).

        The deviations count the uncertainty of everything else that was fitted.
        """
        projected = self.objective.project(self.objective.linearise(self.x), self.noise.weight)
        at = self.objective.linearise(self.x)
        white = at.columns * self.noise.weight
        everything = np.concatenate([projected.jacobian, white])
        scale = np.sqrt(np.sum(np.abs(everything) ** 2, axis=1))
        scale[scale == 0] = 1.0
        everything = everything / scale[:, None]
        gram = (everything.conj() @ everything.T).real + 1e-12 * np.eye(scale.size)
        std = np.sqrt(np.diag(np.linalg.inv(gram))) / scale
        first = projected.amplitudes.size - len(self.columns)
        return projected.amplitudes[first:], std[std.size - len(self.columns) :]

    def fit(self) -> RecordFit:
        """Everything that follows from this minimum."""
        fit = summary(self.objective, self.x, self.noise)
        if not len(self.columns):
            return fit
        # `summary` takes every column for one of the free decay.
        projected = self.objective.project(self.objective.linearise(self.x), self.noise.weight)
        decays = projected.amplitudes.size - len(self.columns)
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
