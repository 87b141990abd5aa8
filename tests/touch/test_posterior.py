"""Weighted samples of a known distribution."""

import numpy as np
import pytest

from rigd.touch._posterior import sample_posterior

BOUNDS = (np.array([-20.0, -20.0]), np.array([20.0, 20.0]))


def draw_posterior(chi2_of, centres, width):
    return sample_posterior(
        chi2_of,
        np.array(centres, dtype=float),
        np.broadcast_to(width**2 * np.eye(2), (len(centres), 2, 2)),
        BOUNDS,
        residual_variance=1.0,
        samples_per_round=400,
        max_rounds=6,
        sufficient_samples=1500.0,
        smallest_std=np.array([0.01, 0.01]),
    )


def test_a_normal_distribution_has_its_moments_and_quantiles():
    posterior = draw_posterior(
        lambda x: ((x - [1.0, -2.0]) ** 2 / [0.25, 4.0]).sum(axis=1), [[0.5, -1.0]], 1.0
    )
    assert posterior.mean(0) == pytest.approx(1.0, abs=0.06)
    assert posterior.std(0) == pytest.approx(0.5, rel=0.1)
    assert posterior.std(1) == pytest.approx(2.0, rel=0.1)
    assert posterior.quantiles(0, (0.025, 0.975)) == pytest.approx([0.02, 1.98], abs=0.15)
    assert posterior.effective_sample_count > 300


def test_weights_of_two_minima():
    def chi2_of(x):
        deeper = ((x - [-3.0, 0.0]) ** 2 / 0.04).sum(axis=1)
        shallower = ((x - [3.0, 0.0]) ** 2 / 0.04).sum(axis=1) + 2 * np.log(3)
        return -2 * np.logaddexp(-deeper / 2, -shallower / 2)

    posterior = draw_posterior(chi2_of, [[-3.0, 0.0], [3.0, 0.0]], 0.3)
    weight_fraction = posterior.weights[posterior.samples[:, 0] < 0].sum()
    assert weight_fraction == pytest.approx(0.75, abs=0.06)


def test_samples_are_within_bounds():
    posterior = draw_posterior(
        lambda x: (x - [20.0, 0.0])[:, 0] ** 2 + x[:, 1] ** 2, [[19.0, 0.0]], 1.0
    )
    likely = posterior.samples[posterior.weights > 0]
    assert likely[:, 0].max() <= 20.0
    assert posterior.mean(0) == pytest.approx(20 - np.sqrt(2 / np.pi), abs=0.1)
