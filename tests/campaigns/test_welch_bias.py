"""Bias of the Welch fits against the pooled whole-record estimates, from made-up sessions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.campaigns import sentences
from analysis.paper.welch_analysis import FitIndices

pytestmark = pytest.mark.fit

RECORD_STD = 0.001


@pytest.fixture
def make_sessions(make_fit, make_estimate, make_session):
    """Five sessions of order 1, whose Welch fits have `offset` and `scatter` in lambda."""

    def make(offset, scatter, cost=100.0):
        names = ("zeta", "alpha", "gamma", "lambda")
        values = {"zeta": 1e-4, "alpha": 1.0, "gamma": 0.1, "lambda": 1.0}
        covariance = np.diag([RECORD_STD**2] * 4)
        sessions = []
        for number, away in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0)):
            welch = {**values, "lambda": 1.0 + offset + scatter * away}
            fit = make_fit("VI", "omega", **welch)
            sessions.append(
                make_session(
                    f"{number}.mcap",
                    fits=[replace(fit, indices=FitIndices(0.5, 0.5, 0.5))],
                    estimates=[make_estimate("VI", values, covariance, names, cost=cost)],
                )
            )
        return sessions

    return make


@pytest.fixture
def biases_of(campaign_of):
    def found(sessions):
        result = campaign_of(sessions)
        return result.pooled[0], result.welch_biases

    return found


def test_bias_is_the_difference_of_means(make_sessions, biases_of):
    freest, (found,) = biases_of(make_sessions(0.068, 0.001))
    by_name = {each.parameter: each for each in found.parameters}
    bias = by_name["lambda"]
    assert bias.welch_mean == pytest.approx(1.068)
    assert bias.bias == pytest.approx(0.068)
    assert bias.welch_std == pytest.approx(0.001 * np.std([-1, -0.5, 0, 0.5, 1], ddof=1))
    assert bias.bias_std == pytest.approx(np.hypot(bias.welch_std, RECORD_STD) / 5**0.5)
    assert [each.parameter for each in found.significant_parameters] == ["lambda"]
    first, second = sentences.describe_welch_bias(freest, (found,), (), has_reference=True)
    assert "Welch's lambda (1.06800 ± 0.00079 between sessions) is 0.06800 above" in first
    assert "1.00000 (type VI, weights omega, as in Table 3): bias, not scatter" in first
    assert "lower WMSE of the Welch fits (0.5 against 1 (N·m/rad)²) is no evidence" in second
    # Of an order that is not reported, and of a mixture, nothing is compared.
    assert sentences.describe_welch_bias(freest, (found,), ("lambda",), has_reference=True) == []
    assert sentences.describe_welch_bias(freest, (found,), (), has_reference=False) == []


def test_a_difference_within_the_scatter_is_no_bias(make_sessions, biases_of):
    freest, (found,) = biases_of(make_sessions(0.02, 0.1))
    assert found.significant_parameters == ()
    assert sentences.describe_welch_bias(freest, (found,), (), has_reference=True) == []


def test_inadequate_structure_is_no_reference(make_sessions, biases_of):
    _, found = biases_of(make_sessions(0.068, 0.001, cost=900.0))
    assert found == ()


def test_the_verdict_states_the_bias(make_sessions, campaign_of):
    order = SimpleNamespace(status="compatible")
    verdict = SimpleNamespace(
        adequate=True, visible_modes=(1, 2, 3), findings=(), experiments=(), alpha=order,
        lambda_=order,
    )  # fmt: skip
    sessions = [replace(each, verdict=verdict) for each in make_sessions(0.068, 0.001)]
    found = campaign_of(sessions).verdict
    assert (
        "external damping compatible with order 1 (lambda = 1.00000 ± 0.00124)"
        in found.sentences[0]
    )
    assert any("0.06800 above the whole records'" in each for each in found.sentences)
