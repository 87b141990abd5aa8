"""Prediction of a session and its check against limits before motion."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.control import ControlDesignError, PidController, close_loop, design_pid
from rigd.excitation import chirp, from_csv, hold, multisine, step
from rigd.runner import plan_lines, planning, with_tip_slope
from rigd.runner.planning import (
    RefusedError,
    excitation_for,
    largest_amplitude,
    plan_document,
    plan_session,
    predict,
    predict_session,
)


def test_reference_chirp_is_within_the_shipped_limits(profile):
    plan = plan_session(profile, chirp(rate_hz=1000.0))
    assert plan.warnings == ()
    assert plan.prediction.peak_torque_nm == pytest.approx(0.41, abs=0.01)
    assert plan.prediction.peak_angle_rad == pytest.approx(0.025, rel=0.01)


def test_tip_deflection_of_the_reference_chirp_is_large(profile):
    """36 % of the length at mode 1, and 0.6 rad at mode 2; a tenth of it is."""
    plan = plan_session(profile, chirp(rate_hz=1000.0))
    tip = plan.prediction.tip
    assert tip is not None
    assert tip.deflection_m == pytest.approx(0.36 * profile.rig.beam.length_m, rel=0.01)
    assert tip.speed_m_s == pytest.approx(12.6, rel=0.01)
    assert "36 % of the length" in plan.tip_in_words
    assert tip.slope_rad == pytest.approx(0.603, rel=0.01)
    assert "0.23 times the amplitude stays within" in plan.tip_in_words
    small = plan_session(profile, chirp(rate_hz=1000.0, amplitude_rad=0.0025))
    assert small.prediction.tip is not None
    assert small.prediction.tip.deflection_m == pytest.approx(tip.deflection_m / 10, rel=1e-6)
    assert "3.6 % of the length" in small.tip_in_words
    assert "small" not in small.tip_in_words


def test_slope_limits_the_linear_model_at_small_deflection(profile):
    """Above mode 1 the tip deflects by 6 % of the length, and slopes by 0.3 rad."""
    excitation = chirp(rate_hz=1000.0, amplitude_rad=0.0125, start_hz=8.0)
    plan = plan_session(profile, excitation)
    tip = plan.prediction.tip
    assert tip is not None
    assert tip.deflection_m < 0.08 * profile.rig.beam.length_m
    assert tip.slope_rad > 0.25
    assert "the linear model is not exact" in plan.tip_in_words


def test_ten_times_the_amplitude_saturates_and_may_be_forced(profile):
    profile = with_tip_slope(profile, 10.0)
    excitation = chirp(rate_hz=1000.0, amplitude_rad=0.25)
    with pytest.raises(RefusedError, match=r"peak torque of 3\.8.* exceeds 0\.9 N·m .*--force"):
        plan_session(profile, excitation)
    plan = plan_session(profile, excitation, allows_saturation=True)
    assert any("will be clipped and flagged" in warning for warning in plan.warnings)
    assert not any("--force" in warning for warning in plan.warnings)


def test_predicted_saturation_is_that_of_the_controller(profile):
    """A step just below and just above the limit, tick by tick on the reference's jump."""
    model = profile.loop_model()
    gains = design_pid(2e-3, 0.02, 80.0)
    for amplitude in (0.05, 0.09):
        prediction = predict(close_loop(model), step(rate_hz=1000.0, amplitude_rad=amplitude))
        controller = PidController(gains, model.settings, 1000.0, 0.9)
        controller.step(0.0, 0.0, 0.0)
        controller.step(amplitude, 0.0, 0.0)
        assert controller.saturated == (prediction.peak_torque_nm > 0.9)
        assert prediction.peak_torque_nm >= abs(controller.unlimited_torque_nm) - 1e-12


@pytest.mark.parametrize("force", [False, further(True)])
@pytest.mark.parametrize(
    "make",
    [
        lambda rad: chirp(rate_hz=1000.0, amplitude_rad=rad, duration_s=20.0, taper_s=1.0),
        lambda rad: step(rate_hz=1000.0, amplitude_rad=-rad, duration_s=1.0, ring_down_s=1.0),
        further(
            lambda rad: multisine(rate_hz=1000.0, amplitude_rad=rad, period_s=5.0, duration_s=10.0)
        ),
    ],
)
def test_largest_amplitude_is_accepted_and_a_larger_one_refused(profile, make, force):
    profile = with_tip_slope(profile, 10.0)
    largest_rad = largest_amplitude(profile, make(4.0), allows_saturation=force)
    assert largest_amplitude(profile, make(1e-3), allows_saturation=force) == pytest.approx(
        largest_rad, rel=0.01
    )
    assert not predict_session(profile, make(largest_rad), allows_saturation=force).refusal_text
    with pytest.raises(RefusedError, match=f"lower the amplitude to {largest_rad:g} rad"):
        plan_session(profile, make(1.011 * largest_rad), allows_saturation=force)


def test_no_largest_amplitude_without_an_amplitude(profile, tmp_path):
    path = tmp_path / "reference.csv"
    path.write_text("0\n3.0\n")
    far = from_csv(path, rate_hz=1000.0, ring_down_s=1.0)
    assert "lower the amplitude.\n" in predict_session(profile, far).refusal_text
    for excitation in (far, hold(rate_hz=1000.0, duration_s=1.0)):
        assert largest_amplitude(profile, excitation) is None


@pytest.mark.parametrize("projection", [(0.0,) * 6, None])
def test_warning_if_the_contact_force_is_unknown(profile, projection):
    sensor = profile.rig.sensor
    if projection is not None:
        sensor = replace(sensor, shear_projection=projection)
    rig = replace(profile, rig=replace(profile.rig, sensor=sensor))
    plan = predict_session(rig, excitation_for(rig, "touch", {"angle_rad": 0.6}))
    assert any("--force-limit" in each for each in plan.warnings) == (projection is not None)


@pytest.mark.parametrize(
    ("make", "rest_s", "warned"), [(step, 0.1, True), (step, 0.4, False), (chirp, 0.1, False)]
)
def test_warning_of_a_short_rest_before_a_step(profile, make, rest_s, warned):
    excitation = make(rate_hz=1000.0, duration_s=4.0, rest_s=rest_s, ring_down_s=0.3)
    warnings = plan_session(profile, excitation).warnings
    assert any("--rest 0.4" in each for each in warnings) == warned
    assert len(warnings) == warned


@pytest.mark.parametrize(
    ("start_hz", "expected"),
    [(60.0, "sweeps down from 60 to 50 Hz"), (0.05, "sweeps from 0.05 to 50 Hz")],
)
def test_plan_states_the_direction_of_a_chirp(profile, start_hz, expected):
    excitation = chirp(rate_hz=1000.0, start_hz=start_hz, duration_s=1.0, amplitude_rad=1e-3)
    document = plan_document(profile, excitation, plan_session(profile, excitation))
    assert next(plan_lines(document)) == f"chirp on {profile.name}, {expected}, record of 17 s."


def test_angle_speed_and_tracking_can_never_be_forced(profile):
    with pytest.raises(RefusedError) as refusal:
        plan_session(profile, step(rate_hz=1000.0, amplitude_rad=2.0), allows_saturation=True)
    for key in ("limits.angle_rad", "limits.velocity_rad_s", "limits.tracking_error_rad"):
        assert key in str(refusal.value)


@pytest.mark.parametrize(
    "projection",
    [further((0, 0, 0, 0, 0, 1.0)), further((0, 0, 0, 0, 0, -2.0)), (0, 0.03, 0, 0, 0, 0.5)],
)
def test_the_sensor_s_range_bounds_the_coupling_torque(profile, projection):
    excitation = chirp(rate_hz=1000.0, duration_s=20.0)
    response = close_loop(profile.loop_model()).simulate(excitation.reference_rad)
    peak = float(np.max(np.abs(response.coupling_torque_nm)))
    weight = sum(p * p for p in projection)
    # The largest wrench that this torque makes on each axis, a little more and a little less.
    for factor, refused in ((0.99, True), (1.01, False)):
        ranges = tuple(factor * peak * abs(p) / weight if p else 1.0 for p in projection)
        rig = replace(
            profile.rig,
            sensor=replace(profile.rig.sensor, projection=projection, range=ranges),
        )
        narrow = replace(profile, rig=rig)
        if refused:
            with pytest.raises(RefusedError, match=r"coupling torque .*sensor\.range"):
                plan_session(narrow, excitation)
            assert plan_session(narrow, excitation, allows_saturation=True).warnings
        else:
            assert plan_session(narrow, excitation).warnings == ()


def test_nan_prediction_is_refused(profile, monkeypatch):
    broken = replace(
        predict(close_loop(profile.loop_model()), chirp(rate_hz=1000.0, duration_s=1.0)),
        peak_angle_rad=float("nan"),
    )
    monkeypatch.setattr(planning, "predict", lambda loop, excitation: broken)
    with pytest.raises(RefusedError, match="nan rad"):
        plan_session(profile, chirp(rate_hz=1000.0, duration_s=1.0), allows_saturation=True)


def test_an_unstable_loop_is_refused(profile):
    without = replace(profile, control=replace(profile.control, feedforward_gain=0.0))
    with pytest.raises(ControlDesignError, match="feedforward_gain"):
        plan_session(without, chirp(rate_hz=1000.0, duration_s=1.0), allows_saturation=True)
