"""Refit from the end of a fit: another structure, other noise, a held order, or further columns.

A nonlinear effect (for example a stiffness that depends on the deflection) adds to the torque a
column of known shape and unknown size, which is projected out like the free decay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import Candidate
from analysis.identify._fit import summary
from analysis.identify._problem import Objective
from analysis.identify.noise import NoiseSpectrum, smooth_power
from analysis.identify.parametrization import NEXT_TO_NOTHING, Steps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant
    from analysis.identify._result import RecordFit
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import NormalEquations


FEW: Final = 8
"""Evaluations that settle a fit under slightly other noise, or show that a start leads nowhere."""

MANY: Final = 40
"""Evaluations of a descent that is to end."""

MISSED: Final = 1e-5
"""Significant fraction of a sum of squares (some 1e4); the BIC penalty of a parameter is 9."""

_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares (some 1e4): 1e-4 of a significant difference of BIC."""


@dataclass(frozen=True, slots=True)
class Refit:
    """Minimum of a sum of squares under one noise spectrum.

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
        """Descend from `start`, with unknown torques filled by the prediction there.

        `columns`, shape (c, K), are projected out in addition to the free decay. `hold` names
        unknowns that stay at their start. `relative_tolerance` and `hopeless` are those of
        `analysis.optimizer.descend`; with `max_evaluations` of 1 nothing moves.
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
        """Continue the descent from here, with nothing held, as `descend` does from the same point.

        The evaluation at this point, which counts, is not repeated unless torques are unknown.
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
        """Return the columns that were projected out in addition to the free decay, (c, K)."""
        return self.objective.columns

    @property
    def cost(self) -> float:
        """Return the sum of squares here."""
        return self.equations.cost

    @property
    def expected_cost(self) -> float:
        """Return the expected sum of squares if only noise remains."""
        known_fraction = self.objective.comparison.measurement.known_torque_fraction
        return float(2 * np.count_nonzero(self.noise.counts) * known_fraction)

    @property
    def predicted_cost(self) -> float:
        """Return the cost at the minimum that the Gauss-Newton step predicts."""
        return max(self.cost + float(self.equations.gradient @ self.predicted_step), 0.0)

    @property
    def predicted_step(self) -> NDArray[np.float64]:
        """Return the Gauss-Newton step to that minimum, shape (k,)."""
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
        """Return the fitted plant."""
        return self.objective.unknowns.plant(self.x)

    def amplitudes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return amplitudes of the further columns, and their standard deviations, shape (c,).

        The deviations include the uncertainty of all other fitted parameters.
        """
        values, covariance = self.amplitude_covariance()
        return values, np.sqrt(np.diag(covariance))

    def amplitude_covariance(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return amplitudes of the further columns, (c,), and their covariance, (c, c)."""
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
        """Whiten further columns and remove the part that other free terms explain.

        Also returns the whitened residual (prediction minus measurement), shape (K,). With
        `beam_free` the unknowns may explain a part as well, else only the terms that are projected
        out.
        """
        weight, at = self.noise.weight, self.objective.linearise(self.x)
        projected = self.objective.project(at, weight)
        known = at.columns * weight
        if beam_free:
            known = np.concatenate([projected.jacobian, known])
        return unexplained_part(columns * weight, known), projected.residual

    def saved_by(self, columns: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the first-order cost reduction by each further column alone, shape (c,).

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
        """Return the full result at this minimum."""
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
        """Return the result as a candidate."""
        of = self.objective.unknowns
        return Candidate(of.structure, self.fit(), len(self.columns))

    def noise_here(self) -> NoiseSpectrum:
        """Return the noise of the residual that no column explains; lines stay excluded."""
        residual = self.objective.project(self.objective.linearise(self.x), 1.0).residual
        known_fraction = self.objective.comparison.measurement.known_torque_fraction
        return replace(self.noise, power=smooth_power(residual) / known_fraction)


def unexplained_part(
    columns: NDArray[np.complex128], known: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Return the part of whitened columns that other free terms do not explain, shape (c, K).

    `known`, shape (k, K), are the whitened derivatives by all free parameters and amplitudes.
    """
    scale = np.sqrt(np.sum(np.abs(known) ** 2, axis=1))
    basis = known[scale > 0] / scale[scale > 0, None]
    gram = (basis.conj() @ basis.T).real + 1e-12 * np.eye(len(basis))
    coefficients = np.linalg.solve(gram, (basis.conj() @ columns.T).real)
    part: NDArray[np.complex128] = columns - coefficients.T @ basis
    return part
