"""Refit from where a fit ended: another structure, other noise, an order held, or further columns.

What the linear beam cannot do (a stiffness that depends on the deflection, say) adds to the torque
a column of known shape and unknown size, which is projected out as the free decay is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import Candidate
from analysis.identify._fit import summary
from analysis.identify._noise import NoiseSpectrum, smooth_power
from analysis.identify._parametrization import NEXT_TO_NOTHING, Steps
from analysis.identify._problem import Objective

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._parametrization import Unknowns
    from analysis.identify._plant import Plant
    from analysis.identify._result import RecordFit
    from analysis.optimizer import NormalEquations


FEW: Final = 8
"""Evaluations that settle a fit under slightly other noise, or show that a start leads nowhere."""

MANY: Final = 40
"""Evaluations of a descent that is to end."""

MISSED: Final = 1e-5
"""Share of a sum of squares, which is some 1e4, that counts; BIC counts a parameter as 9."""

_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares (some 1e4): 1e-4 of what BIC tells apart."""


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
    """

    objective: Objective
    x: NDArray[np.float64]
    equations: NormalEquations
    noise: NoiseSpectrum

    @classmethod
    def descend(
        cls,
        comparison: Comparison,
        unknowns: Unknowns,
        start: NDArray[np.float64],
        noise: NoiseSpectrum,
        columns: NDArray[np.complex128] | None = None,
        *,
        max_evaluations: int = 60,
        relative_tolerance: float = _TOLERANCE,
        hold: Sequence[str] = (),
        hopeless: tuple[int, float] | None = None,
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
        hold : sequence of str
            Unknowns that stay where they start.
        hopeless : tuple of int and float, optional
            As `analysis.optimizer.descend` takes it.
        """
        region = Steps.of(unknowns, NEXT_TO_NOTHING)
        x = np.clip(start, region.lower, region.upper)
        for name in hold:
            index = unknowns.names.index(name)
            region.lower[index] = region.upper[index] = x[index]
        objective, found = Objective(comparison, unknowns, columns).minimum(
            x,
            noise.weight,
            region,
            relative_tolerance=relative_tolerance,
            max_evaluations=max_evaluations,
            hopeless=hopeless,
        )
        return cls(objective, found.x, found.equations, noise)

    def further(self, max_evaluations: int) -> Refit:
        """Descend on from here, with nothing held, as `descend` does from the same point.

        What was evaluated here is not evaluated again, unless torques are unknown.

        Parameters
        ----------
        max_evaluations : int
            Most evaluations of the sum of squares, this one counted.
        """
        objective, found = self.objective.minimum(
            self.x,
            self.noise.weight,
            Steps.of(self.objective.unknowns, NEXT_TO_NOTHING),
            relative_tolerance=_TOLERANCE,
            max_evaluations=max_evaluations,
        )
        return Refit(objective, found.x, found.equations, self.noise)

    @property
    def columns(self) -> NDArray[np.complex128]:
        """What was projected out beside the free decay, shape (c, K)."""
        return self.objective.columns

    @property
    def cost(self) -> float:
        """Sum of squares here."""
        return self.equations.cost

    @property
    def expected_cost(self) -> float:
        """What it is where noise alone is left."""
        known_fraction = self.objective.comparison.measurement.known_torque_fraction
        return float(2 * np.count_nonzero(self.noise.counts) * known_fraction)

    @property
    def predicted_cost(self) -> float:
        """What it would be at the minimum, as far as can be seen from here."""
        return max(self.cost + float(self.equations.gradient @ self.predicted_step), 0.0)

    @property
    def predicted_step(self) -> NDArray[np.float64]:
        """Way to that minimum (Gauss and Newton's), shape (k,)."""
        equations = self.equations
        held = equations.held(self.x, *self.objective.unknowns.bounds)
        free = ~held & (np.diag(equations.hessian) > 0)
        scaled, scale = equations.scaled_hessian()
        slope = equations.gradient[free] / scale[free]
        step = np.zeros(self.x.size)
        solved = np.linalg.solve(scaled[np.ix_(free, free)] + 1e-12 * np.eye(slope.size), slope)
        step[free] = -solved / scale[free]
        return step

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

    def unexplained_columns(
        self, columns: NDArray[np.complex128], *, beam_free: bool = True
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Whiten further columns and leave of them what nothing free already could explain.

        Parameters
        ----------
        columns : ndarray of complex, shape (c, K)
        beam_free : bool
            Whether the unknowns may explain a part as well; else only what is projected out may.

        Returns
        -------
        free : ndarray of complex, shape (c, K)
        residual : ndarray of complex, shape (K,)
            What is left here, prediction less measurement, whitened.
        """
        weight, at = self.noise.weight, self.objective.linearise(self.x)
        projected = self.objective.project(at, weight)
        known = at.columns * weight
        if beam_free:
            known = np.concatenate([projected.jacobian, known])
        return unexplained_part(columns * weight, known), projected.residual

    def saved_by(self, columns: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Squares that each of some further columns alone would save to first order, shape (c,).

        Parameters
        ----------
        columns : ndarray of complex, shape (c, K)
        """
        free, residual = self.unexplained_columns(columns)
        along = (free.conj() @ residual).real
        squares = np.maximum(np.sum(np.abs(free) ** 2, axis=1), np.finfo(float).tiny)
        saved: NDArray[np.float64] = along**2 / squares
        return saved

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

    def candidate(self) -> Candidate:
        """Make a candidate of what was found."""
        of = self.objective.unknowns
        return Candidate(of.structure, self.fit(), len(self.columns))

    def noise_here(self) -> NoiseSpectrum:
        """Take for noise what remains here and no column explains; lines stay left out."""
        residual = self.objective.project(self.objective.linearise(self.x), 1.0).residual
        known_fraction = self.objective.comparison.measurement.known_torque_fraction
        return replace(self.noise, power=smooth_power(residual) / known_fraction)


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
    coefficients = np.linalg.solve(gram, (basis.conj() @ columns.T).real)
    part: NDArray[np.complex128] = columns - coefficients.T @ basis
    return part
