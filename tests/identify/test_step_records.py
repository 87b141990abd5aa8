"""Steps of the motor: no false finding; orders that one mode does not determine are reported."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import fit_freest_alone, select
from analysis.identify.profile_likelihood import LikelihoodProfile, profile_both_orders
from analysis.identify.sentences import order_sentence
from analysis.identify.verdict import order_verdict
from rigd.beam import Plant

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


def test_step_after_a_short_rest_determines_the_stiffness(steps, true_parameters):
    measured = steps("III", 0.05, rest_s=0.3, held_s=4.3).measured(noise_nm=2e-3, seed=3)
    headline = select(measured).headline
    assert headline.modal.visible_mode_numbers == (1, 2)
    assert headline.uniform_beam.status == "passed"
    stiffness = headline.parameters["bending_stiffness_n_m2"]
    error = stiffness.value - true_parameters("III")["bending_stiffness_n_m2"]
    assert abs(error) < 4 * stiffness.std
    assert stiffness.std < 0.1 * stiffness.value
    assert not any(finding.kind == "ringing start" for finding in select(measured).verdict.findings)


@pytest.mark.parametrize("first_tick", [250, 1500])
def test_step_without_a_rest_determines_nothing_but_the_decay(steps, link, plants, first_tick):
    """A rest of 50 ms, or only the decay after the step."""
    measured = steps("III", 0.05, rest_s=0.3, held_s=9.7).cut(first_tick).measured(
        noise_nm=2e-3, seed=3
    )  # fmt: skip
    selection = select(measured)
    (found,) = selection.verdict.findings
    assert found.kind == "hidden response"
    assert "at least 0.4 s before the motor moves" in found.remedy
    headline = selection.headline
    assert headline.uniform_beam.status == "not tested"
    assert not any("uniform" in sentence for sentence in selection.verdict.sentences)
    assert all(
        number.flag is not None
        for mode in headline.modes
        for number in (mode.frequency_hz, mode.damping_ratio, mode.participation)
        if number is not None
    )
    assert all(parameter.flag is not None for parameter in headline.parameters.values())
    pole = Plant(link, plants["III"]).mode_poles(1)[0].at_rad_s
    assert headline.modes[0].damping_ratio.value == pytest.approx(-pole.real / abs(pole), rel=0.1)
    assert fit_freest_alone(measured)[1] == (found,)


def test_damping_that_acts_as_a_stiffness_makes_the_beam_undetermined(steps):
    """In this record the order of the internal damping falls to 0, and EI to a hundredth."""
    step = steps("VI", 0.01, rest_s=0.6, held_s=8.0)
    rounded = replace(step, angle_rad=7e-5 * np.round(step.angle_rad / 7e-5))
    selection = select(rounded.measured(noise_nm=2e-3, seed=7))
    parameters = selection.headline.parameters
    assert parameters["bending_stiffness_n_m2"].value < 0.01
    assert all(parameters[name].flag for name in parameters if name != "tool_inertia_kg_m2")
    assert not any("stiffness (EI)" in sentence for sentence in selection.verdict.sentences)


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
