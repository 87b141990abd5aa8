"""Steps of the motor: no false finding; orders that one mode does not determine are reported."""

import pytest

from analysis.identify import select
from analysis.identify.profile_likelihood import LikelihoodProfile, profile_both_orders
from analysis.identify.sentences import order_sentence
from analysis.identify.verdict import order_verdict

pytestmark = pytest.mark.fit


@pytest.fixture(scope="module")
def without_delay(steps, candidates_of):
    """Candidates on a step that the beam still rings from, loudly, when the record ends."""
    return candidates_of(steps("IV", 0.1).measured(noise_nm=0.01, seed=8))


@pytest.mark.further  # nothing else is reported with a delay either
def test_step_without_delay_reports_at_most_drag(without_delay):
    findings = select(without_delay.comparison.measurement).verdict.findings
    assert {finding.kind for finding in findings} <= {"air drag"}


def test_delay_is_reported_in_a_step(steps):
    measured = steps("III", 0.3, delay_s=2e-3).measured(noise_nm=0.01, seed=5)
    (found,) = select(measured).verdict.findings
    assert found.kind == "delay"
    assert found.value == pytest.approx(2e-3, abs=3e-4)


@pytest.mark.further  # the profile's parts are in test_profile_valleys.py
def test_profile_search_ends_without_a_second_minimum(without_delay):
    field, alpha, _ = profile_both_orders(without_delay)
    assert len(alpha.local_minima) == 1
    assert alpha.estimate == pytest.approx(field.best.fit.parameters["alpha"], abs=1e-4)


def test_two_equally_good_values_are_both_reported(steps, freest_of):
    candidates = freest_of(steps("IV", 0.1).measured(noise_nm=0.01, seed=8))
    found = LikelihoodProfile(
        "lambda", "VII", (0.5, 0.657, 0.9, 1.235, 1.4), (9.0, 0.0, 8.0, 0.8, 9.0), 0.657,
        (0.657, 1.235), (0.58, 1.3), False, False, 0.0,
    )  # fmt: skip
    verdict = order_verdict(candidates, found, (1,), doubt_reason=None)
    assert (verdict.status, verdict.value, verdict.interval) == ("not identifiable", None, None)
    sentence = order_sentence(verdict)
    assert "0.657 and 1.235 fit the record equally well" in sentence
    assert "not identifiable" in sentence
