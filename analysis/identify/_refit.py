"""Refit from the end of a fit: another structure, other noise, a fixed order, or added torques.

A nonlinear effect (for example a stiffness that depends on the deflection) adds to the torque a
spectrum of known shape and unknown size. It is projected out like the free decay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import Candidate
from analysis.identify._fit import record_fit_summary
from analysis.identify._problem import Objective
from analysis.identify.noise import NoiseSpectrum, smooth_power
from analysis.identify.parametrization import VANISHING_LOSS_FACTOR, StepRule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._result import RecordFit
    from analysis.identify.parametrization import Unknowns
    from analysis.optimizer import NormalEquations
    from rigd.beam import Plant


REFIT_EVALUATIONS: Final = 8
"""Number of evaluations of the sum of squares after which a fit under slightly other noise has
converged, or a start has proved useless."""

DESCENT_EVALUATIONS: Final = 40
"""Number of evaluations of the sum of squares after which a descent from another start has
converged."""

MISSED_MINIMUM_COST_FRACTION: Final = 1e-5
"""Fraction of a sum of squares (some 1e4) by which a lower minimum counts as missed. The BIC
penalty of a parameter is 9."""

_COST_TOLERANCE: Final = 1e-8
"""Relative tolerance of the sum of squares (some 1e4): 1e-4 of a significant difference of BIC."""


@dataclass(frozen=True, slots=True)
class Refit:
    """Fit of one structure to a record: the minimum of the sum of squares for one noise spectrum.

    Attributes
    ----------
    objective : Objective
        Sum of squares of the whitened residual.
    x : ndarray, shape (k,)
        Unknowns at the minimum.
    equations : NormalEquations
        Sum of squares with its derivatives at `x`.
    noise : NoiseSpectrum
        Noise that weights the residual.
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
        start_vector: NDArray[np.float64],
        noise: NoiseSpectrum,
        torque_spectra: NDArray[np.complex128] | None = None,
        *,
        max_evaluations: int = 60,
        relative_tolerance: float = _COST_TOLERANCE,
        fixed_unknowns: Sequence[str] = (),
        give_up_condition: tuple[int, float] | None = None,
    ) -> Refit:
        """Descend from a start vector, after unknown torques are filled with the prediction there.

        `torque_spectra`, shape (c, K), are torque spectra of unknown size that are projected out in
        addition to the free decay. `fixed_unknowns` names unknowns that keep their start values.
        `relative_tolerance` is that of `analysis.optimizer.descend`, and `give_up_condition` its
        `early_stop_limits`. With `max_evaluations` of 1 the start is only evaluated.
        """
        step_rule = StepRule.for_unknowns(unknowns, VANISHING_LOSS_FACTOR)
        x = np.clip(start_vector, step_rule.lower, step_rule.upper)
        for fixed_name in fixed_unknowns:
            fixed_index = unknowns.names.index(fixed_name)
            step_rule.lower[fixed_index] = step_rule.upper[fixed_index] = x[fixed_index]
        objective, minimum = Objective(comparison, unknowns, torque_spectra).find_minimum(
            x,
            noise.weight,
            step_rule,
            relative_tolerance=relative_tolerance,
            max_evaluations=max_evaluations,
            give_up_condition=give_up_condition,
        )
        return cls(objective, minimum.x, minimum.equations, noise)

    def continue_descent(self, max_evaluations: int) -> Refit:
        """Continue the descent with no unknown fixed, as `descend` from the same point would.

        The evaluation made at this point counts as the first one. It is repeated only if torques of
        impacts are unknown.
        """
        objective, minimum = self.objective.find_minimum(
            self.x,
            self.noise.weight,
            StepRule.for_unknowns(self.objective.unknowns, VANISHING_LOSS_FACTOR),
            relative_tolerance=_COST_TOLERANCE,
            max_evaluations=max_evaluations,
        )
        return Refit(objective, minimum.x, minimum.equations, self.noise)

    @property
    def effect_spectra(self) -> NDArray[np.complex128]:
        """Return the torque spectra of effects, projected out like those of free decays, (c, K)."""
        return self.objective.effect_spectra

    @property
    def cost(self) -> float:
        """Return the sum of squares of the whitened residual at this minimum."""
        return self.equations.cost

    @property
    def expected_cost(self) -> float:
        """Return the sum of squares that is expected if the residual is noise only."""
        known_fraction = self.objective.comparison.measurement.known_torque_fraction
        return float(2 * np.count_nonzero(self.noise.is_compared) * known_fraction)

    @property
    def predicted_cost(self) -> float:
        """Return the sum of squares at the minimum that the Gauss-Newton step predicts."""
        return max(self.cost + float(self.equations.gradient @ self.predicted_step), 0.0)

    @property
    def predicted_step(self) -> NDArray[np.float64]:
        """Return the Gauss-Newton step of the unknowns to the predicted minimum, shape (k,)."""
        normal_equations = self.equations
        is_at_bound = normal_equations.is_held_at_bound(self.x, *self.objective.unknowns.bounds)
        is_free = ~is_at_bound & (np.diag(normal_equations.hessian) > 0)
        scaled_hessian, hessian_scale = normal_equations.scaled_hessian()
        scaled_gradient = normal_equations.gradient[is_free] / hessian_scale[is_free]
        newton_step = np.zeros(self.x.size)
        scaled_step = np.linalg.solve(
            scaled_hessian[np.ix_(is_free, is_free)] + 1e-12 * np.eye(scaled_gradient.size),
            scaled_gradient,
        )
        newton_step[is_free] = -scaled_step / hessian_scale[is_free]
        return newton_step

    @property
    def plant(self) -> Plant:
        """Return the rig and beam with the fitted parameters."""
        return self.objective.unknowns.plant(self.x)

    def amplitudes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the sizes of the added torque spectra, shape (c,), and their standard deviations.

        The standard deviations include the uncertainty of all other fitted parameters.
        """
        torque_amplitudes, covariance = self.amplitude_covariance()
        return torque_amplitudes, np.sqrt(np.diag(covariance))

    def amplitude_covariance(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the sizes of the added torque spectra, shape (c,), and the covariance, (c, c)."""
        linearisation = self.objective.linearise(self.x)
        projected_objective = self.objective.project(linearisation, self.noise.weight)
        whitened_spectra = self.objective.unknown_torque_spectra(linearisation) * self.noise.weight
        # The Jacobian before the projection is needed: after it the spectra are orthogonal to the
        # Jacobian, so their amplitudes would seem independent of the unknowns.
        derivatives = np.concatenate([linearisation.jacobian * self.noise.weight, whitened_spectra])
        derivative_norms = np.sqrt(np.sum(np.abs(derivatives) ** 2, axis=1))
        derivative_norms[derivative_norms == 0] = 1.0
        derivatives = derivatives / derivative_norms[:, None]
        gram_matrix = (derivatives.conj() @ derivatives.T).real + 1e-12 * np.eye(
            derivative_norms.size
        )
        first_column = derivative_norms.size - len(self.effect_spectra)
        column_scale = derivative_norms[first_column:]
        covariance = np.linalg.inv(gram_matrix)[first_column:, first_column:] / np.outer(
            column_scale, column_scale
        )
        return projected_objective.amplitudes[
            projected_objective.amplitudes.size - len(self.effect_spectra) :
        ], covariance

    def unexplained_spectra(
        self, torque_spectra: NDArray[np.complex128], *, are_beam_unknowns_free: bool = True
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the part of whitened torque spectra that other free terms do not explain, (c, K).

        The free terms are the disturbances of unknown amplitude and, with `are_beam_unknowns_free`,
        the unknowns of the beam. The whitened residual (prediction minus measurement), shape (K,),
        is returned as well.
        """
        noise_weight, linearisation = self.noise.weight, self.objective.linearise(self.x)
        projected_objective = self.objective.project(linearisation, noise_weight)
        explaining_spectra = self.objective.unknown_torque_spectra(linearisation) * noise_weight
        if are_beam_unknowns_free:
            explaining_spectra = np.concatenate([projected_objective.jacobian, explaining_spectra])
        return part_outside_spectra(
            torque_spectra * noise_weight, explaining_spectra
        ), projected_objective.residual

    def cost_reduction_by_spectrum(
        self, torque_spectra: NDArray[np.complex128]
    ) -> NDArray[np.float64]:
        """Return the first-order reduction of the cost by each torque spectrum alone, shape (c,).

        The spectra, shape (c, K), are of unknown size.
        """
        unexplained_spectra, residual = self.unexplained_spectra(torque_spectra)
        correlation = (unexplained_spectra.conj() @ residual).real
        unexplained_squares = np.maximum(
            np.sum(np.abs(unexplained_spectra) ** 2, axis=1), np.finfo(float).tiny
        )
        cost_reductions: NDArray[np.float64] = correlation**2 / unexplained_squares
        return cost_reductions

    def fit(self) -> RecordFit:
        """Return the fit at this minimum with parameters, modes and uncertainties."""
        fit = record_fit_summary(self.objective, self.x, self.noise)
        if not len(self.effect_spectra):
            return fit
        # `record_fit_summary` does not know that the amplitudes of the effects are free as well.
        projected_objective = self.objective.project(
            self.objective.linearise(self.x), self.noise.weight
        )
        decay_count = fit.ringing.degrees_of_freedom
        gram_scale = np.sqrt(np.diag(projected_objective.amplitude_gram))
        gram_scale[gram_scale == 0] = 1.0
        gram_matrix = projected_objective.amplitude_gram / np.outer(
            gram_scale, gram_scale
        ) + 1e-12 * np.eye(gram_scale.size)
        decay_gram, cross_gram, column_gram = (
            gram_matrix[:decay_count, :decay_count],
            gram_matrix[:decay_count, decay_count:],
            gram_matrix[decay_count:, decay_count:],
        )
        # Inverse covariance of the decays alone, the other amplitudes free (Schur complement).
        decay_precision = decay_gram - cross_gram @ np.linalg.solve(column_gram, cross_gram.T)
        scaled_amplitudes = (projected_objective.amplitudes * gram_scale)[:decay_count]
        chi_square = (
            float(scaled_amplitudes @ decay_precision @ scaled_amplitudes)
            * fit.degrees_of_freedom
            / fit.cost
        )
        return replace(
            fit, ringing=replace(fit.ringing, chi_square=chi_square, degrees_of_freedom=decay_count)
        )

    def candidate(self) -> Candidate:
        """Return the fit at this minimum, with its structure, as a candidate."""
        unknowns = self.objective.unknowns
        return Candidate(unknowns.structure, self.fit(), len(self.effect_spectra))

    def residual_noise(self) -> NoiseSpectrum:
        """Return the noise of the residual at this minimum. Lines stay excluded."""
        unwhitened_residual = self.objective.project(self.objective.linearise(self.x), 1.0).residual
        comparison = self.objective.comparison
        noise_power = smooth_power(unwhitened_residual)
        noise_power /= comparison.measurement.known_torque_fraction
        noise_power += comparison.encoder_noise_power(self.objective.unknowns.plant(self.x))
        return replace(self.noise, power=noise_power)


def part_outside_spectra(
    whitened_spectra: NDArray[np.complex128], explaining_spectra: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Return the part of whitened spectra that other free terms do not explain, shape (c, K).

    `explaining_spectra`, shape (k, K), are those of the other free terms: whitened derivatives by
    all free parameters and amplitudes.
    """
    spectrum_norms = np.sqrt(np.sum(np.abs(explaining_spectra) ** 2, axis=1))
    normalized_spectra = (
        explaining_spectra[spectrum_norms > 0] / spectrum_norms[spectrum_norms > 0, None]
    )
    gram_matrix = (normalized_spectra.conj() @ normalized_spectra.T).real + 1e-12 * np.eye(
        len(normalized_spectra)
    )
    coefficients = np.linalg.solve(
        gram_matrix, (normalized_spectra.conj() @ whitened_spectra.T).real
    )
    unexplained_spectra: NDArray[np.complex128] = (
        whitened_spectra - coefficients.T @ normalized_spectra
    )
    return unexplained_spectra
