"""Posterior of candidates: population Monte Carlo over position, instant and stiffness.

The likelihood of a bouncing contact is rough, so the curvatures at its minima do not describe it.
Samples are drawn around the minima, weighted by their likelihood, and drawn again around the best
of them (adaptive importance sampling with the weights of the deterministic mixture).

References
----------
O. Cappé, A. Guillin, J.-M. Marin, C. Robert, Population Monte Carlo, J. Comput. Graph. Stat. 13
(2004). J.-M. Cornuet et al., Adaptive multiple importance sampling, Scand. J. Stat. 39 (2012).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_STUDENT_DEGREES = 4.0
"""Degrees of freedom of the Student distributions from which samples are drawn; they have heavy
tails."""
_MAX_CENTRES = 16
"""Largest number of Student distributions in a round, centred at the best samples."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """Posterior distribution of an obstacle's parameters, such as position, as weighted samples."""

    samples: Real
    """Parameters of each sample, shape (n, p)."""
    weights: Real
    """Weight of each sample, with the sum 1; shape (n,)."""
    chi2: Real
    """Sum of squared residuals of each sample, shape (n,)."""

    @property
    def effective_samples(self) -> float:
        """Effective number of samples: number of equal weights with the same precision."""
        return float(1 / np.sum(self.weights**2))

    def quantiles(self, parameter_column: int, quantile_levels: tuple[float, ...]) -> Real:
        """Return quantiles of the posterior distribution of one obstacle parameter.

        Parameters
        ----------
        parameter_column
            Column of the parameter.
        quantile_levels
            Probabilities of the quantiles, between 0 and 1.
        """
        parameter_values = self.samples[:, parameter_column]
        value_order = np.argsort(parameter_values)
        cumulated_weights = np.cumsum(self.weights[value_order]) - 0.5 * self.weights[value_order]
        return np.interp(quantile_levels, cumulated_weights, parameter_values[value_order])

    def mean(self, parameter_column: int) -> float:
        """Return the mean of one obstacle parameter's posterior distribution.

        Parameters
        ----------
        parameter_column
            Column of the parameter.
        """
        return float(self.weights @ self.samples[:, parameter_column])

    def std(self, parameter_column: int) -> float:
        """Return the standard deviation of one obstacle parameter's posterior distribution.

        Parameters
        ----------
        parameter_column
            Column of the parameter.
        """
        deviations = self.samples[:, parameter_column] - self.mean(parameter_column)
        return float(np.sqrt(self.weights @ deviations**2))


def sample_posterior(
    chi2_of: Callable[[Real], Real],
    centres: Real,
    covariances: Real,
    bounds: tuple[Real, Real],
    *,
    scale: float,
    count: int,
    rounds: int,
    enough_samples: float,
    smallest_std: Real,
) -> Posterior:
    """Draw weighted samples of obstacle parameters from the posterior, uniform prior in bounds.

    Parameters
    ----------
    chi2_of
        Function that returns the sum of squared residuals of rows of parameters.
    centres
        Minima of the sum of squared residuals, around which samples are drawn, shape (k, p).
    covariances
        Covariance of the parameters at each minimum, shape (k, p, p).
    bounds
        Lower and upper ends of the parameters' ranges.
    scale
        Variance of a residual.
    count
        Number of samples in a round.
    rounds
        Largest number of rounds.
    enough_samples
        Effective number of samples that ends the rounds.
    smallest_std
        Smallest standard deviation for drawing samples, shape (p,).
    """
    rng = np.random.default_rng(0)  # the same record gives the same answer
    parameter_count = centres.shape[1]
    lower_bounds, upper_bounds = bounds
    mixture = np.full(len(centres), 1 / len(centres))
    samples = np.empty((0, parameter_count))
    chi2 = np.empty(0)
    proposal_density = np.empty(0)
    proposals: list[tuple[Real, Real, Real]] = []
    posterior = None
    for _ in range(rounds):
        chosen_centres = rng.choice(len(centres), count, p=mixture)
        centre_factors = np.linalg.cholesky(covariances)
        normal_numbers = rng.standard_normal((count, parameter_count))
        student_scale = np.sqrt(_STUDENT_DEGREES / rng.chisquare(_STUDENT_DEGREES, count))
        drawn_samples = centres[chosen_centres] + student_scale[:, None] * np.einsum(
            "kpq,kq->kp", centre_factors[chosen_centres], normal_numbers
        )
        is_in_bounds = np.all(
            (drawn_samples >= lower_bounds) & (drawn_samples <= upper_bounds), axis=1
        )
        drawn_chi2 = np.full(count, np.inf)
        if is_in_bounds.any():
            drawn_chi2[is_in_bounds] = chi2_of(drawn_samples[is_in_bounds])
        proposals.append((centres, covariances, mixture))
        proposal_density = (
            proposal_density + _density(samples, *proposals[-1])
            if samples.size
            else proposal_density
        )
        own_density = sum(_density(drawn_samples, *proposal) for proposal in proposals)
        samples = np.concatenate([samples, drawn_samples])
        chi2 = np.concatenate([chi2, drawn_chi2])
        proposal_density = np.concatenate([proposal_density, own_density])
        log_weights = -0.5 * (chi2 - chi2.min()) / scale - np.log(proposal_density)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        posterior = Posterior(samples, weights, chi2)
        if posterior.effective_samples > enough_samples and len(proposals) > 1:
            break
        # Tempered weights choose the next centres, so that one lucky sample does not dominate.
        tempered_weights = weights**0.5
        tempered_weights /= tempered_weights.sum()
        best_centre = np.argsort(-tempered_weights)[:_MAX_CENTRES]
        centres, mixture = (
            samples[best_centre],
            tempered_weights[best_centre] / tempered_weights[best_centre].sum(),
        )
        weighted_mean = tempered_weights @ samples
        deviations = samples - weighted_mean
        clipped_deviation = np.minimum(
            np.abs(deviations),
            6 * np.sqrt(weights @ (samples - weights @ samples) ** 2) + smallest_std,
        ) * np.sign(deviations)
        covariance = (clipped_deviation * tempered_weights[:, None]).T @ clipped_deviation
        shrink_factor = max(len(best_centre), 2) ** (-2 / (parameter_count + 4))
        covariances = np.broadcast_to(
            shrink_factor * covariance + np.diag(smallest_std**2),
            (len(best_centre), parameter_count, parameter_count),
        )
    assert posterior is not None
    return posterior


def _density(samples: Real, centres: Real, covariances: Real, mixture_weights: Real) -> Real:
    """Return the density of a mixture of Student distributions at samples, shape (n,).

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
        total_density += peak_density * (1 + squared_distances / _STUDENT_DEGREES) ** (
            -(_STUDENT_DEGREES + parameter_count) / 2
        )
    return total_density
