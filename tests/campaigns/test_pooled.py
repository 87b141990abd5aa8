import math

import numpy as np
import pytest

from analysis.campaigns.pooled import best_estimate, pooled

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
    found = pooled(list(estimates_of(make_estimate, 60, 0.05, seed=2)))
    zeta, alpha = found.parameters
    assert zeta.between_std == pytest.approx(0.05 * 2e-4, rel=0.25)
    assert zeta.within_std == pytest.approx(0.02 * 2e-4, rel=0.02)
    assert zeta.chance < 1e-6
    assert alpha.chance > 0.01
    assert alpha.between_std < 0.5 * alpha.within_std
    assert abs(zeta.value / 2e-4 - 1) < 3 * zeta.std / zeta.value
    # Of the next session all that is not its own noise: the pooled value and the scatter.
    assert math.log(zeta.next_interval[1] / zeta.value) == pytest.approx(2.0 * 0.05, rel=0.25)


def test_intervals_hold_the_truth_as_often_as_they_say(make_estimate):
    """Few sessions, where a normal interval would be too narrow; 200 campaigns of 5."""
    held = 0
    for seed in range(200):
        zeta, _ = pooled(list(estimates_of(make_estimate, 5, 0.05, seed))).parameters
        held += zeta.interval[0] <= 2e-4 <= zeta.interval[1]
    assert 0.91 < held / 200 < 0.99


def test_sessions_that_differ_by_noise_alone_are_found_to_repeat(make_estimate):
    chances = [
        each.chance
        for seed in range(40)
        for each in pooled(list(estimates_of(make_estimate, 10, 0.0, seed))).parameters
    ]
    assert np.mean(chances) == pytest.approx(0.5, abs=0.1)
    assert np.mean(np.array(chances) < 0.05) < 0.12


def test_a_session_that_does_not_determine_the_damping_is_left_out(make_estimate):
    good = list(estimates_of(make_estimate, 3, 0.0, seed=1))
    values = {"zeta": 1e-9, "alpha": 1.9}
    lost = make_estimate("IV", values, [[1e-4]], ("alpha",), at_bounds=("zeta",))
    found = pooled([good[0], lost, *good[1:]])
    assert found.sessions == 3
    assert found.parameters == pooled(good).parameters
    assert pooled([good[0], lost]) is None


def test_a_setting_on_its_bound_in_some_session_gets_the_plain_mean(make_estimate):
    names = ("zeta", "tool_inertia_kg_m2")
    free = make_estimate(
        "I", {"zeta": 1e-4, "tool_inertia_kg_m2": 3e-7}, np.diag([1e-4, 1e-16]), names
    )
    bound = make_estimate(
        "I", {"zeta": 1.1e-4}, [[1e-4]], ("zeta",), at_bounds=("tool_inertia_kg_m2",)
    )
    found = pooled([free, bound, bound])
    assert [each.name for each in found.parameters] == ["zeta"]
    assert found.plant.tool_inertia_kg_m2 == pytest.approx(1e-7)
    assert found.plant.damping.zeta == found.parameters[0].value


def test_the_best_structure_is_of_the_lowest_criterion(make_estimate):
    two = [
        [make_estimate(name, {"zeta": 1e-4, "alpha": 1.0}, cov, free, cost=cost)] * 2
        for name, cov, free, cost in (
            ("I", [[1e-4]], ("zeta",), 103.0),
            ("IV", WITHIN, ("zeta", "alpha"), 100.0),
        )
    ]
    # An order more costs ln(100) = 4.6 a session, and gains 3.
    assert best_estimate([pooled(each) for each in two]).structure == "I"
