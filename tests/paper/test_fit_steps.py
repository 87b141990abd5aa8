"""Inside a fit: starts lie in hollows of the coarse sweep; the spread is that of repeated fits."""

import numpy as np
import pytest

from analysis.models import STRUCTURES
from analysis.paper._fit import sandwich_covariance, starting_points

N = 2000
SLOPES = np.array([np.ones(N), np.linspace(-1, 1, N) ** 2, np.exp(1j * np.linspace(0, 9, N))])


def repeated_fits(weights, noise, seed, repeats=200):
    """Estimates of a linear model with three unknowns, and the covariance of the last fit."""
    rng = np.random.default_rng(seed)
    hessian = ((SLOPES.conj() * weights) @ SLOPES.T).real
    estimates, covariances = [], []
    for _ in range(repeats):
        e = noise(rng)
        x = np.linalg.solve(hessian, ((SLOPES.conj() * weights) @ e).real)
        estimates.append(x)
        covariances.append(sandwich_covariance(x @ SLOPES - e, SLOPES, weights))
    return np.cov(np.array(estimates).T), np.mean(covariances, axis=0)


def white(rng):
    return rng.normal(size=N) + 1j * rng.normal(size=N)


def loud_at_one_end(rng):
    return white(rng) * np.linspace(0.1, 3.0, N)


def smooth(rng):
    return np.convolve(white(rng), np.hamming(12), mode="same")


@pytest.mark.parametrize(
    ("noise", "tolerance"), [(white, 0.2), (loud_at_one_end, 0.2), (smooth, 0.3)]
)
@pytest.mark.parametrize("power", [0.0, -1.0])
def test_agrees_with_scatter(noise, tolerance, power):
    weights = np.linspace(1.0, 20.0, N) ** power
    scatter, computed = repeated_fits(weights / weights.sum(), noise, seed=90_125)
    ratio = np.sqrt(np.diag(computed) / np.diag(scatter))
    np.testing.assert_allclose(ratio, 1.0, atol=tolerance)


def test_undetermined_unknowns_have_no_deviation():
    weights = np.full(N, 1 / N)
    deviation = white(np.random.default_rng(1))
    for slopes in (
        np.array([SLOPES[0], SLOPES[0]]),
        np.array([SLOPES[0], np.zeros(N)]),
        np.array([SLOPES[0], np.full(N, np.nan)]),
    ):
        assert sandwich_covariance(deviation, slopes.astype(complex), weights) is None


def test_a_perfect_fit_has_no_spread():
    covariance = sandwich_covariance(np.zeros(N, dtype=complex), SLOPES, np.full(N, 1 / N))
    np.testing.assert_array_equal(covariance, np.zeros((3, 3)))


def test_one_minimum_gives_one_start():
    target = np.array([np.log(1e-3), 0.8, np.log(0.1), 1.3])
    found = starting_points(STRUCTURES["VI"], lambda x: float(np.sum((x - target) ** 2)))
    assert len(found) == 1
    np.testing.assert_allclose(found[0], target)


def test_two_minima_give_two_starts_deeper_first():
    def cost(x):
        left, right = (x[0] - np.log(1e-4)) ** 2, (x[0] - np.log(1e-1)) ** 2
        return float(min(left + 0.5, right) + (x[1] - 1.3) ** 2)

    found = starting_points(STRUCTURES["IV"], cost)
    np.testing.assert_allclose(found, [[np.log(1e-1), 1.3], [np.log(1e-4), 1.3]])


def test_rugged_costs_give_the_lowest_eight():
    rng = np.random.default_rng(909)
    seen = []

    def cost(_x):
        seen.append(rng.random())
        return seen[-1]

    found = starting_points(STRUCTURES["VI"], cost)
    assert len(found) == 8
    assert len(seen) == 256
