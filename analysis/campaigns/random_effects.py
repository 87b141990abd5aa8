"""Estimates of many sessions pooled, when sessions differ by more than their own uncertainty.

The random-effects model ``y_k ~ N(mu, S_k + diag(tau²))``: S_k is the covariance that session k
states for itself, tau the scatter of each parameter between sessions, by the moments of R.
DerSimonian and N. Laird, "Meta-analysis in clinical trials", Controlled Clinical Trials 7 (1986)
177-188. A full matrix in place of ``diag(tau²)`` would have more numbers than a campaign has
sessions: by maximum likelihood, five sessions that do repeat then show two thirds of their own
standard deviations as scatter in each of eight parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class RandomEffects:
    """Pooled estimate of k parameters over K sessions.

    Attributes
    ----------
    mean : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
        Of the mean.
    between_std : ndarray, shape (k,)
        Scatter between sessions, tau; 0 where the sessions' own uncertainties explain all.
    cochran_q : ndarray, shape (k,)
        Squares of the deviations from the weighted mean over the sessions' variances, summed:
        about K − 1 without scatter between sessions.
    deviance : float
        ``-2 ln`` likelihood of the mean and tau, above that of a value of its own for each
        session: ``sum_k ln|I + S_k⁻¹ diag(tau²)| + r_kᵀ (S_k + diag(tau²))⁻¹ r_k``. Of the tau by
        moments and of none, the one that is likelier: parameters that each session correlates
        closely do not scatter one by one, and a tau of a third of their standard deviations then
        makes forty sessions that repeat less likely by a factor of e⁶⁵.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    between_std: NDArray[np.float64]
    cochran_q: NDArray[np.float64]
    deviance: float


def random_effects(
    estimates: NDArray[np.float64], covariances: NDArray[np.float64]
) -> RandomEffects:
    """Pool estimates by the random-effects model.

    Parameters
    ----------
    estimates : ndarray, shape (K, k)
        Of two sessions at least.
    covariances : ndarray, shape (K, k, k)
        Positive definite, of each estimate.
    """
    weight = 1 / np.diagonal(covariances, axis1=1, axis2=2)
    total = weight.sum(axis=0)
    q = (weight * (estimates - (weight * estimates).sum(axis=0) / total) ** 2).sum(axis=0)
    excess = q - (len(estimates) - 1)
    between = np.maximum(excess / (total - (weight**2).sum(axis=0) / total), 0.0)

    # In units of a typical standard deviation: parameters differ by orders of magnitude.
    unit = 1 / np.sqrt(weight.mean(axis=0))
    units = np.outer(unit, unit)
    origin = estimates.mean(axis=0)
    own, every = covariances / units, covariances / units + np.diag(between / unit**2)
    away = (estimates - origin) / unit
    shift, spread, squares = _combined(away, every)
    widening = float((np.linalg.slogdet(every)[1] - np.linalg.slogdet(own)[1]).sum())
    return RandomEffects(
        mean=origin + unit * shift,
        covariance=units * spread,
        between_std=np.sqrt(between),
        cochran_q=q,
        deviance=min(widening + squares, _combined(away, own)[2]),
    )


def _combined(
    values: NDArray[np.float64], covariances: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Weighted mean, its covariance, and the sum of squares of what values are off it."""
    precision = np.linalg.inv(covariances)
    spread = np.linalg.inv(precision.sum(axis=0))
    mean = spread @ np.einsum("kij,kj->i", precision, values)
    off = values - mean
    return mean, spread, float(np.einsum("ki,kij,kj->", off, precision, off))


@cache
def t_quantile(level: float, degrees_of_freedom: int) -> float:
    """Two-sided point of Student's t: within it a share `level` lies.

    With ``t = sqrt(nu) tan(theta)`` the density of theta is ``cos(theta)^(nu-1)`` up to a factor.
    """
    theta = np.linspace(0.0, np.pi / 2, 100_001)
    density = np.cos(theta) ** (degrees_of_freedom - 1)
    reached = np.concatenate(([0.0], np.cumsum(density[1:] + density[:-1])))
    at = float(np.interp(level, reached / reached[-1], theta))
    return float(np.sqrt(degrees_of_freedom) * np.tan(at))


def chance_of(cochran_q: NDArray[np.float64], sessions: int) -> NDArray[np.float64]:
    """Probability of at least that Q without scatter between sessions, shape (k,).

    Chi-square of K − 1 degrees of freedom by the cube-root approximation of Wilson and Hilferty
    (PNAS 17 (1931) 684-688).
    """
    freedom = sessions - 1
    spread = 2 / (9 * freedom)
    z = (np.cbrt(cochran_q / freedom) - 1 + spread) / np.sqrt(spread)
    return np.array([math.erfc(each / math.sqrt(2)) / 2 for each in z])
