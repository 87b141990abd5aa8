import math

import numpy as np
import pytest

from analysis.campaigns.pooling import pool_estimates, pooled_bic

WITHIN = np.array([[0.02**2, -0.99 * 0.02 * 0.004], [-0.99 * 0.02 * 0.004, 0.004**2]])


def estimates_of(make_estimate, count, between, seed):
    """Type IV: scatter of ln zeta between sessions, none of alpha."""
    rng = np.random.default_rng(seed)
    scatter = WITHIN + np.diag([between**2, 0.0])
    for ln_zeta, alpha in rng.multivariate_normal([math.log(2e-4), 0.8], scatter, size=count):
        yield make_estimate(
            "IV", {"zeta": math.exp(ln_zeta), "alpha": alpha}, WITHIN, ("zeta", "alpha")
        )


def test_scatter_between_sessions_is_recovered(make_estimate):
    found = pool_estimates(list(estimates_of(make_estimate, 60, 0.05, seed=2)))
    zeta, alpha = found.parameters
    assert zeta.between_session_std == pytest.approx(0.05 * 2e-4, rel=0.25)
    assert zeta.within_session_std == pytest.approx(0.02 * 2e-4, rel=0.02)
    assert zeta.heterogeneity_p_value < 1e-6
    assert alpha.heterogeneity_p_value > 0.01
    assert alpha.between_session_std < 0.5 * alpha.within_session_std
    assert abs(zeta.value / 2e-4 - 1) < 3 * zeta.std / zeta.value
    # Of the next session all that is not its own noise: the pooled value and the scatter.
    assert math.log(zeta.next_session_interval[1] / zeta.value) == pytest.approx(
        2.0 * 0.05, rel=0.25
    )


def test_intervals_have_their_nominal_coverage(make_estimate):
    """Few sessions, where a normal interval would be too narrow; 200 campaigns of 5."""
    held = 0
    for seed in range(200):
        zeta, _ = pool_estimates(list(estimates_of(make_estimate, 5, 0.05, seed))).parameters
        held += zeta.interval[0] <= 2e-4 <= zeta.interval[1]
    assert 0.91 < held / 200 < 0.99


def test_sessions_with_different_noise_are_repeatable(make_estimate):
    chances = [
        each.heterogeneity_p_value
        for seed in range(40)
        for each in pool_estimates(list(estimates_of(make_estimate, 10, 0.0, seed))).parameters
    ]
    assert np.mean(chances) == pytest.approx(0.5, abs=0.1)
    assert np.mean(np.array(chances) < 0.05) < 0.12


def test_session_without_determined_damping_is_left_out(make_estimate):
    good = list(estimates_of(make_estimate, 3, 0.0, seed=1))
    values = {"zeta": 1e-9, "alpha": 1.9}
    lost = make_estimate("IV", values, [[1e-4]], ("alpha",), at_bounds=("zeta",))
    found = pool_estimates([good[0], lost, *good[1:]])
    assert found.sessions == 3
    assert found.parameters == pool_estimates(good).parameters
    assert pool_estimates([good[0], lost]) is None


def test_setting_on_a_bound_gets_the_plain_mean(make_estimate):
    names = ("zeta", "tool_inertia_kg_m2")
    free = make_estimate(
        "I", {"zeta": 1e-4, "tool_inertia_kg_m2": 3e-7}, np.diag([1e-4, 1e-16]), names
    )
    bound = make_estimate(
        "I", {"zeta": 1.1e-4}, [[1e-4]], ("zeta",), at_bounds=("tool_inertia_kg_m2",)
    )
    found = pool_estimates([free, bound, bound])
    assert [each.name for each in found.parameters] == ["zeta"]
    assert found.plant.tool_inertia_kg_m2 == pytest.approx(1e-7)
    assert found.plant.damping.zeta == found.parameters[0].value


def evidence(make_estimate, alphas, std):
    """Types I and IV on sessions of 1000 values: the cost of an alpha of 1 in each of them."""
    cov = np.diag([1e-4, std**2])
    one = [
        make_estimate(
            "I", {"zeta": 1e-4}, [[1e-4]], ("zeta",), cost=1000 + ((alpha - 1) / std) ** 2
        )
        for alpha in alphas
    ]
    free = [
        make_estimate("IV", {"zeta": 1e-4, "alpha": a}, cov, ("zeta", "alpha"), cost=1000.0)
        for a in alphas
    ]
    return one, free


def test_pooling_determines_what_no_session_does(make_estimate):
    """An alpha 1.5 standard deviations from 1, twenty times: 45 of deviance for one parameter."""
    rng = np.random.default_rng(5)
    one, free = evidence(make_estimate, rng.normal(0.985, 0.01, 20), 0.01)
    gain = np.array([a.deviance - b.deviance for a, b in zip(one, free, strict=True)])
    assert np.median(gain) < math.log(100)
    assert pooled_bic(free) < pooled_bic(one) - 10


def test_many_sessions_do_not_make_order_one_fractional(make_estimate):
    """A hundred campaigns of twenty: the simpler structure wins but for chance."""
    wins = 0
    for seed in range(100):
        alphas = np.random.default_rng(seed).normal(1.0, 0.01, 20)
        one, free = evidence(make_estimate, alphas, 0.01)
        wins += pooled_bic(one) < pooled_bic(free)
    assert wins >= 97


def test_cost_of_a_common_value(make_estimate):
    """Two sessions a and b of one std: (a-b)²/2 of it², and ln of the number of all data."""
    _, free = evidence(make_estimate, [1.00, 1.01], 0.01)
    assert pooled_bic(free) == pytest.approx(2000.0 + 0.5 + 2 * math.log(200), abs=1e-9)


def test_undetermined_parameters_count_in_each_session(make_estimate):
    _, (good, _) = evidence(make_estimate, [1.0, 1.0], 0.01)
    lost = make_estimate(
        "IV", {"zeta": 1e-4, "alpha": 0.0}, [[1e-4]], ("zeta",), ("alpha",), cost=1000.0
    )
    found = pooled_bic([good, lost])
    assert found == pytest.approx(2000.0 + math.log(200) + 2 * math.log(100), abs=1e-9)
