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
    """Posterior distribution of an obstacle's parameters, as weighted samples."""

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

    def quantiles(self, column: int, levels: tuple[float, ...]) -> Real:
        """Return quantiles of a parameter's posterior distribution.

        Parameters
        ----------
        column
            Column of the parameter.
        levels
            Probabilities of the quantiles, between 0 and 1.
        """
        values = self.samples[:, column]
        order = np.argsort(values)
        cumulated = np.cumsum(self.weights[order]) - 0.5 * self.weights[order]
        return np.interp(levels, cumulated, values[order])

    def mean(self, column: int) -> float:
        """Return the posterior mean of a parameter.

        Parameters
        ----------
        column
            Column of the parameter.
        """
        return float(self.weights @ self.samples[:, column])

    def std(self, column: int) -> float:
        """Return the posterior standard deviation of a parameter.

        Parameters
        ----------
        column
            Column of the parameter.
        """
        deviation = self.samples[:, column] - self.mean(column)
        return float(np.sqrt(self.weights @ deviation**2))


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
    """Draw weighted samples of the posterior, with a uniform prior within the bounds.

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
    width = centres.shape[1]
    low, high = bounds
    mixture = np.full(len(centres), 1 / len(centres))
    samples = np.empty((0, width))
    chi2 = np.empty(0)
    density = np.empty(0)
    proposals: list[tuple[Real, Real, Real]] = []
    posterior = None
    for _ in range(rounds):
        chosen = rng.choice(len(centres), count, p=mixture)
        factors = np.linalg.cholesky(covariances)
        normal = rng.standard_normal((count, width))
        student_scale = np.sqrt(_STUDENT_DEGREES / rng.chisquare(_STUDENT_DEGREES, count))
        drawn = centres[chosen] + student_scale[:, None] * np.einsum(
            "kpq,kq->kp", factors[chosen], normal
        )
        in_bounds = np.all((drawn >= low) & (drawn <= high), axis=1)
        drawn_chi2 = np.full(count, np.inf)
        if in_bounds.any():
            drawn_chi2[in_bounds] = chi2_of(drawn[in_bounds])
        proposals.append((centres, covariances, mixture))
        density = density + _density(samples, *proposals[-1]) if samples.size else density
        own_density = sum(_density(drawn, *each) for each in proposals)
        samples = np.concatenate([samples, drawn])
        chi2 = np.concatenate([chi2, drawn_chi2])
        density = np.concatenate([density, own_density])
        log_weights = -0.5 * (chi2 - chi2.min()) / scale - np.log(density)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        posterior = Posterior(samples, weights, chi2)
        if posterior.effective_samples > enough_samples and len(proposals) > 1:
            break
        # Tempered weights choose the next centres, so that one lucky sample does not dominate.
        tempered = weights**0.5
        tempered /= tempered.sum()
        best = np.argsort(-tempered)[:_MAX_CENTRES]
        centres, mixture = samples[best], tempered[best] / tempered[best].sum()
        mean = tempered @ samples
        deviation = samples - mean
        clipped_deviation = np.minimum(
            np.abs(deviation),
            6 * np.sqrt(weights @ (samples - weights @ samples) ** 2) + smallest_std,
        ) * np.sign(deviation)
        covariance = (clipped_deviation * tempered[:, None]).T @ clipped_deviation
        shrink = max(len(best), 2) ** (-2 / (width + 4))
        covariances = np.broadcast_to(
            shrink * covariance + np.diag(smallest_std**2), (len(best), width, width)
        )
    assert posterior is not None
    return posterior


def _density(samples: Real, centres: Real, covariances: Real, mixture: Real) -> Real:
    """Return the density of a mixture of Student distributions at samples, shape (n,).

    A constant factor is omitted.
    """
    width = samples.shape[1]
    total = np.zeros(samples.shape[0])
    for centre, covariance, weight in zip(centres, covariances, mixture, strict=True):
        factor = np.linalg.cholesky(covariance)
        scaled = np.linalg.solve(factor, (samples - centre).T)
        distance = np.sum(scaled**2, axis=0)
        peak_density = weight / np.prod(np.diag(factor))
        total += peak_density * (1 + distance / _STUDENT_DEGREES) ** (
            -(_STUDENT_DEGREES + width) / 2
        )
    return total
