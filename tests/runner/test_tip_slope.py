"""The slope of the antenna's tip limits identifications; other plans state it."""

import re

import numpy as np
import pytest
from cases import further

from rigd.beam.tip import SMALL_TIP_SLOPE_RAD, linear_model_error
from rigd.errors import UserError
from rigd.excitation import chirp, from_csv, multisine, step
from rigd.identification.experiments import constant_speeds_excitation
from rigd.runner import with_tip_slope
from rigd.runner.planning import (
    excitation_for,
    largest_amplitude,
    plan_document,
    predict_session,
    predicted_metadata,
)

MAKE = {
    "chirp": lambda rad: chirp(rate_hz=1000.0, amplitude_rad=rad, duration_s=20.0),
    "step": lambda rad: step(rate_hz=1000.0, amplitude_rad=-rad, duration_s=2.0, ring_down_s=1.0),
    "multisine": lambda rad: multisine(rate_hz=1000.0, amplitude_rad=rad, period_s=5.0,
                                       duration_s=10.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["chirp", "step", further("multisine")])
def test_identification_beyond_the_limit_is_refused_with_remedies(profile, kind):
    """The message has value, limit, largest amplitude and override; both remedies work."""
    excitation = MAKE[kind](0.12)
    refused = predict_session(
        profile, excitation, allows_saturation=True
    ).refusal_text  # no torque is concerned
    (line,) = [each for each in refused.splitlines() if "tip slope" in each]
    slope_rad, limit_rad = map(float, re.search(r"of (\S+) rad exceeds (\S+) rad", line).groups())
    assert slope_rad > limit_rad == SMALL_TIP_SLOPE_RAD
    assert "(limits.tip_slope_rad)" in line
    lower_rad = float(re.search(r"lower the amplitude to (\S+) rad", line)[1])
    assert lower_rad == largest_amplitude(profile, excitation, allows_saturation=True)
    lower = predict_session(profile, MAKE[kind](lower_rad), allows_saturation=True)
    assert 0.95 * limit_rad < lower.prediction.tip.slope_rad <= limit_rad
    assert not lower.refusal_text
    allowed_rad = float(re.search(r"--tip-slope (\S+)", line)[1])
    allowed = with_tip_slope(profile, allowed_rad)
    assert "tip slope" not in predict_session(allowed, excitation).refusal_text
    assert predict_session(with_tip_slope(profile, 0.99 * slope_rad), excitation).refusal_text


def test_chirp_is_exempt_up_to_the_reference_amplitude(profile):
    for amplitude_rad, exempt in ((0.025, True), (0.0251, False)):
        excitation = chirp(rate_hz=1000.0, amplitude_rad=amplitude_rad)
        plan = predict_session(profile, excitation)
        assert bool(plan.refusal_text) == (not exempt)
        assert ("is not refused for it" in plan.tip_in_words) == exempt
        assert "error at most 12 %" in plan.tip_in_words
    # The offered amplitude is within the range of the linear model.
    offered = chirp(rate_hz=1000.0, amplitude_rad=largest_amplitude(profile, excitation))
    assert predict_session(profile, offered).prediction.tip.slope_rad <= SMALL_TIP_SLOPE_RAD


def test_file_beyond_the_limit_is_refused_with_a_factor(profile, tmp_path):
    path = tmp_path / "reference.csv"
    path.write_text("\n".join(map(str, 0.1 * np.sin(np.arange(8000) * 2.5 * 2e-3 * np.pi))))
    refused = predict_session(profile, from_csv(path, rate_hz=1000.0)).refusal_text
    factor = float(re.search(r"tip slope .* lower the amplitude to (\S+) of it", refused)[1])
    path.write_text("\n".join(str(factor * float(each)) for each in path.read_text().split()))
    assert not predict_session(profile, from_csv(path, rate_hz=1000.0)).refusal_text


@pytest.mark.parametrize(
    ("kind", "options", "meaning"),
    [
        ("move", {"angle_rad": 0.5}, "more vibration may be left"),
        ("touch", {"angle_rad": 0.6, "speed_rad_s": 3.0}, "position and force of a touch"),
    ],
)
def test_moves_and_touches_state_their_slope(profile, kind, options, meaning):
    plan = predict_session(profile, excitation_for(profile, kind, options))
    assert plan.prediction.tip.slope_rad > SMALL_TIP_SLOPE_RAD
    assert "slope" not in plan.refusal_text
    assert f"slope {plan.prediction.tip.slope_rad:.2g} rad" in plan.tip_in_words
    assert meaning in plan.tip_in_words
    assert "At slopes above" in plan.tip_in_words
    assert "amplitude" not in plan.tip_in_words


def test_motor_identification_is_independent_of_the_model(profile):
    excitation = constant_speeds_excitation(profile, torque_percent=40.0, stroke_rad=0.8)
    plan = predict_session(profile, excitation)
    assert plan.prediction.tip.slope_rad > SMALL_TIP_SLOPE_RAD
    assert not plan.refusal_text
    assert "does not depend on it" in plan.tip_in_words
    assert "amplitude" not in plan.tip_in_words


def test_impossible_deflection_is_not_stated(profile):
    excitation = chirp(rate_hz=1000.0, amplitude_rad=1.0)
    plan = predict_session(profile, excitation)
    document = plan_document(profile, excitation, plan)
    assert not document["tip"]["physical"]
    assert "does not hold" in plan.tip_in_words
    assert "above 100 %" in plan.tip_in_words
    assert " m " not in plan.tip_in_words
    small = plan_document(profile, MAKE["step"](0.01), predict_session(profile, MAKE["step"](0.01)))
    assert small["tip"]["physical"]
    assert small["limits"]["tip_slope_rad"] == SMALL_TIP_SLOPE_RAD


def test_file_has_the_predicted_slope(profile):
    excitation = chirp(rate_hz=1000.0)
    plan = predict_session(profile, excitation)
    metadata = predicted_metadata(profile, plan.prediction, excitation)
    assert float(metadata["predicted_peak_tip_slope_rad"]) == plan.prediction.tip.slope_rad
    assert float(metadata["limit_tip_slope_rad"]) == SMALL_TIP_SLOPE_RAD
    # Segments planned during the session may reach the limit; the scan does not.
    rig = with_tip_slope(profile, 0.2)
    search = excitation_for(rig, "until", {"targets": "damping 1%"})
    plan = predict_session(rig, search)
    assert plan.prediction.tip.slope_rad < 0.17
    metadata = predicted_metadata(rig, plan.prediction, search)
    assert float(metadata["predicted_peak_tip_slope_rad"]) == 0.2


@pytest.mark.parametrize("tip_slope_rad", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_limit_is_refused(profile, tip_slope_rad):
    with pytest.raises(UserError, match="--tip-slope"):
        with_tip_slope(profile, tip_slope_rad)


def test_error_of_the_linear_model_is_quadratic():
    assert linear_model_error(0.6) == pytest.approx(0.12)
    assert linear_model_error(1.2) == pytest.approx(0.48)
