"""Posterior distribution of an obstacle's parameters, sampled by population Monte Carlo.

The likelihood of a bouncing contact is rough, so that curvatures at its maxima do not describe it.
Samples are drawn around these maxima, weighted by their likelihood, and drawn again around the best
samples (adaptive importance sampling with deterministic-mixture weights).

References
----------
O. Cappé, A. Guillin, J.-M. Marin, C. Robert, Population Monte Carlo, J. Comput. Graph. Stat. 13
(2004). J.-M. Cornuet et al., Adaptive multiple importance sampling, Scand. J. Stat. 39 (2012).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RealArray = NDArray[np.float64]

_STUDENT_DEGREES_OF_FREEDOM = 4.0
"""Degrees of freedom of the Student distributions from which samples are drawn; few degrees give
heavy tails."""
_MAX_PROPOSAL_CENTRES = 16
"""Largest number of samples around which Student distributions are centred in the next round."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """Posterior distribution of an obstacle's parameters, such as position, as weighted samples."""

    samples: RealArray
    """Parameters of each sample, shape (n, p)."""
    weights: RealArray
    """Weight of each sample, with the sum 1; shape (n,)."""
    chi2: RealArray
    """Sum of squared residuals of each sample, shape (n,)."""

    @property
    def effective_sample_count(self) -> float:
        """Effective sample size: the number of equally weighted samples of the same precision."""
        return float(1 / np.sum(self.weights**2))

    def quantiles(self, parameter_column: int, quantile_levels: tuple[float, ...]) -> RealArray:
        """Return quantiles of one parameter's posterior distribution, in the parameter's unit."""
        parameter_values = self.samples[:, parameter_column]
        value_order = np.argsort(parameter_values)
        cumulated_weights = np.cumsum(self.weights[value_order]) - 0.5 * self.weights[value_order]
        return np.interp(quantile_levels, cumulated_weights, parameter_values[value_order])

    def mean(self, parameter_column: int) -> float:
        """Return the mean of one obstacle parameter's posterior distribution."""
        return float(self.weights @ self.samples[:, parameter_column])

    def std(self, parameter_column: int) -> float:
        """Return the standard deviation of one obstacle parameter's posterior distribution."""
        deviations = self.samples[:, parameter_column] - self.mean(parameter_column)
        return float(np.sqrt(self.weights @ deviations**2))


def sample_posterior(
    chi2_of: Callable[[RealArray], RealArray],
    centres: RealArray,
    covariances: RealArray,
    bounds: tuple[RealArray, RealArray],
    *,
    residual_variance: float,
    samples_per_round: int,
    max_rounds: int,
    sufficient_samples: float,
    smallest_std: RealArray,
) -> Posterior:
    """Return weighted samples of the posterior distribution, for a uniform prior within bounds.

    `chi2_of` returns the sum of squared residuals of each row of parameters; its minima are the
    `centres` (k, p), around which the first samples are drawn with `covariances` (k, p, p), but at
    least with `smallest_std` (p,). Rounds end when the effective number of samples is sufficient.
    """
    rng = np.random.default_rng(0)  # the same record gives the same answer
    parameter_count = centres.shape[1]
    lower_bounds, upper_bounds = bounds
    mixture_weights = np.full(len(centres), 1 / len(centres))
    samples = np.empty((0, parameter_count))
    chi2 = np.empty(0)
    proposal_density = np.empty(0)
    proposals: list[tuple[RealArray, RealArray, RealArray]] = []
    posterior = None
    for _ in range(max_rounds):
        chosen_centres = rng.choice(len(centres), samples_per_round, p=mixture_weights)
        centre_factors = np.linalg.cholesky(covariances)
        normal_numbers = rng.standard_normal((samples_per_round, parameter_count))
        student_scale = np.sqrt(
            _STUDENT_DEGREES_OF_FREEDOM
            / rng.chisquare(_STUDENT_DEGREES_OF_FREEDOM, samples_per_round)
        )
        drawn_samples = centres[chosen_centres] + student_scale[:, None] * np.einsum(
            "kpq,kq->kp", centre_factors[chosen_centres], normal_numbers
        )
        is_in_bounds = np.all(
            (drawn_samples >= lower_bounds) & (drawn_samples <= upper_bounds), axis=1
        )
        drawn_chi2 = np.full(samples_per_round, np.inf)
        if is_in_bounds.any():
            drawn_chi2[is_in_bounds] = chi2_of(drawn_samples[is_in_bounds])
        proposals.append((centres, covariances, mixture_weights))
        proposal_density = (
            proposal_density + _mixture_density(samples, *proposals[-1])
            if samples.size
            else proposal_density
        )
        new_proposal_density = sum(
            _mixture_density(drawn_samples, *proposal) for proposal in proposals
        )
        samples = np.concatenate([samples, drawn_samples])
        chi2 = np.concatenate([chi2, drawn_chi2])
        proposal_density = np.concatenate([proposal_density, new_proposal_density])
        log_weights = -0.5 * (chi2 - chi2.min()) / residual_variance - np.log(proposal_density)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        posterior = Posterior(samples, weights, chi2)
        if posterior.effective_sample_count > sufficient_samples and len(proposals) > 1:
            break
        # Tempered weights choose the next centres, so that one lucky sample does not dominate.
        tempered_weights = weights**0.5
        tempered_weights /= tempered_weights.sum()
        best_centre_indices = np.argsort(-tempered_weights)[:_MAX_PROPOSAL_CENTRES]
        centres, mixture_weights = (
            samples[best_centre_indices],
            tempered_weights[best_centre_indices] / tempered_weights[best_centre_indices].sum(),
        )
        weighted_mean = tempered_weights @ samples
        deviations = samples - weighted_mean
        clipped_deviation = np.minimum(
            np.abs(deviations),
            6 * np.sqrt(weights @ (samples - weights @ samples) ** 2) + smallest_std,
        ) * np.sign(deviations)
        covariance = (clipped_deviation * tempered_weights[:, None]).T @ clipped_deviation
        shrink_factor = max(len(best_centre_indices), 2) ** (-2 / (parameter_count + 4))
        covariances = np.broadcast_to(
            shrink_factor * covariance + np.diag(smallest_std**2),
            (len(best_centre_indices), parameter_count, parameter_count),
        )
    assert posterior is not None
    return posterior


def _mixture_density(
    samples: RealArray, centres: RealArray, covariances: RealArray, mixture_weights: RealArray
) -> RealArray:
    """Return the density of a mixture of Student distributions at each sample, shape (n,).

    A constant factor is omitted.
    """
    parameter_count = samples.shape[1]
    total_density = np.zeros(samples.shape[0])
    for proposal_centre, covariance, centre_weight in zip(
        centres, covariances, mixture_weights, strict=True
    ):
        cholesky_factor = np.linalg.cholesky(covariance)
        scaled_deviations = np.linalg.solve(cholesky_factor, (samples - proposal_centre).T)
        squared_distances = np.sum(scaled_deviations**2, axis=0)
        peak_density = centre_weight / np.prod(np.diag(cholesky_factor))
        total_density += peak_density * (1 + squared_distances / _STUDENT_DEGREES_OF_FREEDOM) ** (
            -(_STUDENT_DEGREES_OF_FREEDOM + parameter_count) / 2
        )
    return total_density
