import numpy as np
import pytest

from analysis.campaigns.pooling import random_effects


def one_dimension(values, variances):
    return random_effects(np.array(values)[:, None], np.array(variances)[:, None, None])


def test_equal_variances_by_hand():
    """Mean 3, variance (4 + 1 + 0 + 9) / 3; between sessions the part beyond 0.5."""
    found = one_dimension([1.0, 2.0, 3.0, 6.0], [0.5] * 4)
    assert found.mean == pytest.approx([3.0])
    assert found.cochran_q == pytest.approx([28.0])
    assert found.between_session_std**2 == pytest.approx([14 / 3 - 0.5])
    assert found.covariance[0, 0] == pytest.approx(14 / 3 / 4)


def test_unequal_variances_by_hand():
    """Weights 1, 1/2, 1/2: fixed mean 1, Q = 1 + 12.5 + 4.5; tau² = 16 / 1.25."""
    found = one_dimension([0.0, 6.0, -2.0], [1.0, 2.0, 2.0])
    assert found.cochran_q == pytest.approx([18.0])
    assert found.between_session_std**2 == pytest.approx([12.8])
    w = 1 / (np.array([1.0, 2.0, 2.0]) + 12.8)
    assert found.mean == pytest.approx([(6 * w[1] - 2 * w[2]) / w.sum()])
    assert found.covariance[0, 0] == pytest.approx(1 / w.sum())


def test_agreeing_sessions_are_weighted_by_precision():
    found = one_dimension([2.0, 2.01, 1.99], [1.0, 2.0, 4.0])
    assert found.between_session_std == 0
    assert found.mean == pytest.approx([(2.0 + 2.01 / 2 + 1.99 / 4) / 1.75])
    assert found.covariance[0, 0] == pytest.approx(1 / 1.75)


def test_correlated_estimates_are_weighted_by_full_covariance():
    """Where nothing scatters between sessions: generalised least squares, written out."""
    good = np.array([[1.0, -0.9], [-0.9, 1.0]])
    covariances = np.array([good, 9 * good + np.eye(2)])
    values = np.array([[0.0, 0.0], [1.0, 1.0]])
    weights = [np.linalg.inv(each) for each in covariances]
    spread = np.linalg.inv(weights[0] + weights[1])
    found = random_effects(values, covariances)
    assert np.all(found.between_session_std == 0)
    assert found.mean == pytest.approx(spread @ weights[1] @ values[1])
    assert found.covariance == pytest.approx(spread)


def test_units_do_not_matter():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(12, 3, 3))
    covariances = a @ a.transpose(0, 2, 1) + np.eye(3)
    values = rng.normal(scale=3.0, size=(12, 3))
    unit = np.array([1e-6, 1e3, 1.0])
    plain = random_effects(values, covariances)
    scaled = random_effects(values * unit, covariances * np.outer(unit, unit))
    assert scaled.mean == pytest.approx(plain.mean * unit)
    assert scaled.between_session_std == pytest.approx(plain.between_session_std * unit)


def test_scatter_between_sessions_is_recovered_from_correlated_estimates():
    """A correlation of -0.99 within sessions, as of zeta and alpha, none between them."""
    within = np.array([[4.0, -0.99], [-0.99, 0.25]])
    between = np.diag([4.0, 0.25])
    mean = np.array([10.0, -3.0])
    found, squares = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        values = rng.multivariate_normal(mean, within + between, size=150)
        campaign = random_effects(values, np.broadcast_to(within, (150, 2, 2)))
        found.append(campaign.between_session_std**2)
        error = campaign.mean - mean
        squares.append(error @ np.linalg.solve(campaign.covariance, error))
    assert np.mean(found, axis=0) == pytest.approx(np.diag(between), rel=0.12)
    # Chi-square of two degrees of freedom: the covariance gives the error of the mean.
    assert np.mean(squares) == pytest.approx(2.0, abs=1.0)
