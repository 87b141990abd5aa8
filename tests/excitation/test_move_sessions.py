"""Moves as sessions: what they refuse, the identified beam, and one through the real engine."""

import json

import numpy as np
import pytest

from rigd.excitation import KINDS, ExcitationError, move
from rigd.identified_beam import MOVE
from rigd.profile import load_profile
from rigd.runner import (
    LoopPreview,
    RefusedError,
    Series,
    excitation_for,
    plan_document,
    plan_session,
)
from rigd.session import read_session


def test_the_move_is_planned_for_the_beam_of_the_analysis(analysed, profile):
    """A beam of another stiffness has other poles; certain frequencies leave less."""
    same, own = (
        excitation_for(profile, "move", {"angle_rad": 0.3, **options})
        for options in ({"path": analysed()}, {})
    )
    assert same.parameters["file"] == "model.json"
    assert np.allclose(same.reference_rad, own.reference_rad, atol=1e-3)
    off_nm = [each.parameters["frequency_residual_nm"] for each in (same, own)]
    assert off_nm[0] < 0.1 * off_nm[1]
    assert same.parameters["residual_nm"] == pytest.approx(own.parameters["residual_nm"], rel=0.5)
    stiffness = 1.2 * profile.rig.beam.bending_stiffness_n_m2
    stiffer = LoopPreview(profile).move_plant(
        analysed(bending_stiffness_n_m2={"value": stiffness, "std": 0.0},
                 density_over_stiffness={"value": 4.7e-3 / stiffness, "std": 0.0}),
        MOVE,
    )  # fmt: skip
    stated = LoopPreview(profile).move_plant("", MOVE)
    ratio = abs(stiffer.poles_rad_s[0]) / abs(stated.poles_rad_s[0])
    assert ratio == pytest.approx(1.2**0.5, rel=1e-2)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "either angle_rad or by_rad"),
        ({"angle_rad": 0.1, "by_rad": 0.1}, "either angle_rad or by_rad"),
        ({"angle_rad": 2.0}, r"limits\.angle_rad = 1\.57 rad allows 1\.539 rad"),
        ({"by_rad": 1.5}, r"by -1\.739 to 1\.339 rad from 0\.2 rad"),
        ({"angle_rad": 0.2}, "stands at 0.2 rad already"),
        ({"angle_rad": float("nan")}, "angle_rad = nan rad is not a finite number"),
        ({"angle_rad": 7.0}, "more than a full turn"),
        ({"angle_rad": 0.1, "robust": 2}, "neither 0 nor 1"),
    ],
)
def test_a_move_that_cannot_be_is_refused(profile, options, says):
    with pytest.raises(ExcitationError, match=says):
        excitation_for(profile, "move", options, start_rad=0.2)


def test_a_move_knows_where_it_starts(profile):
    made = excitation_for(profile, "move", {"by_rad": -0.4}, start_rad=1.2)
    assert made.stays
    assert made.kind == "move"
    assert KINDS["move"] is move
    assert made.reference_rad[-1] == pytest.approx(-0.4)
    plan = plan_session(profile, made)
    assert plan.ending.stays
    assert plan.prediction.peak_angle_rad == pytest.approx(1.2, abs=0.01)
    words = plan_document(profile, made, plan)["sweep"]
    assert "by -0.4 rad to 0.8 rad" in words
    with pytest.raises(ExcitationError, match="for a rig"):
        move(rate_hz=1000.0, angle_rad=0.1)


def test_a_move_is_run_once(profile, tmp_path):
    made = excitation_for(profile, "move", {"by_rad": 0.1})
    with pytest.raises(RefusedError, match="--repeat 2"):
        Series(profile, made, tmp_path, repeat=2)


def test_a_move_through_the_engine_leaves_nothing_that_rings(rigd, tmp_path):
    """Friction, noise and quantisation included, against the quintic of the same time."""
    done = rigd("run", "move", "-0.5", "--fast", "--json", "--ring-down", "3", "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    session = read_session(json.loads(done.stdout)["sessions"][0]["path"])
    assert session.metadata["excitation"] == "move"
    assert float(session.metadata["angle_rad"]) == -0.5
    predicted_nm = float(session.metadata["quintic_residual_nm"])
    samples, end = session.samples, session.segments["sweep"][1]
    assert samples["angle_rad"][-1] == pytest.approx(-0.5, abs=2e-3)
    profile = load_profile("sim")
    assert np.abs(samples["torque_command_nm"]).max() < 0.95 * profile.rig.motor.peak_torque_nm
    # The first mode in two seconds of ring-down, by its Fourier coefficient.
    torque = samples["coupling_torque_nm"][end + 100 : end + 2100]
    wave = np.exp(-2j * np.pi * 2.57 * np.arange(torque.size) / 1000.0)
    amplitude = 2 * abs(np.mean((torque - torque.mean()) * wave))
    assert predicted_nm > 0.1
    assert amplitude < 0.02 * predicted_nm


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"angle_rad": 0.2}, r"angle_rad = 0\.2 rad is where the motor stands"),
        ({"angle_rad": 0.5, "speed_rad_s": 0.0}, r"speed_rad_s = 0 rad/s must be more than 0"),
        ({"angle_rad": 0.5, "hold_s": 1e-3}, "ends before the motor has stopped"),
        ({"angle_rad": 0.5, "passes": 0}, r"passes = 0 must be at least 1"),
    ],
)
def test_a_search_for_obstacles_that_cannot_be_is_refused(profile, options, says):
    with pytest.raises(ExcitationError, match=says):
        excitation_for(profile, "touch", options, start_rad=0.2)
