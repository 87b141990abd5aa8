"""Moves as sessions: refusals, the identified beam, and one through the real engine."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.beam import clamped_free_eigenvalues
from rigd.excitation import KINDS, ExcitationError, move
from rigd.excitation.moves import modal_state
from rigd.identified_beam import MOVE_USE, IdentifiedBeamError
from rigd.profile import load_profile
from rigd.runner import Series
from rigd.runner.planning import (
    RefusedError,
    RigPreview,
    excitation_for,
    plan_document,
    plan_session,
)
from rigd.session import read_session
from rigd.testing import write_profile

STATED = ("residual_nm", "residual_floor_nm", "quintic_residual_nm", "arrival_s")


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
    stiffer = RigPreview(profile).move_plant(
        analysed(bending_stiffness_n_m2={"value": stiffness, "std": 0.0},
                 density_over_stiffness={"value": 4.7e-3 / stiffness, "std": 0.0}),
        MOVE_USE,
    )  # fmt: skip
    stated = RigPreview(profile).move_plant("", MOVE_USE)
    ratio = abs(stiffer.poles_rad_s[0]) / abs(stated.poles_rad_s[0])
    assert ratio == pytest.approx(1.2**0.5, rel=1e-2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either angle_rad or by_rad"),
        ({"angle_rad": 0.1, "by_rad": 0.1}, "either angle_rad or by_rad"),
        ({"angle_rad": 2.0}, r"limits\.angle_rad = 1\.57 rad allows 1\.539 rad"),
        ({"by_rad": 1.5}, r"by -1\.739 to 1\.339 rad from 0\.2 rad"),
        ({"angle_rad": 0.2}, "is already at 0.2 rad"),
        ({"angle_rad": float("nan")}, "angle_rad = nan rad is not a finite number"),
        ({"angle_rad": 7.0}, "more than a full turn"),
        ({"angle_rad": 0.1, "robust": 2}, "neither 0 nor 1"),
    ],
)
def test_impossible_move_is_refused(profile, options, message):
    with pytest.raises(ExcitationError, match=message):
        excitation_for(profile, "move", options, start_angle_rad=0.2)


def test_move_starts_at_the_current_angle(profile):
    made = excitation_for(profile, "move", {"by_rad": -0.4}, start_angle_rad=1.2)
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


def test_move_runs_once(profile, tmp_path):
    made = excitation_for(profile, "move", {"by_rad": -0.4}, start_angle_rad=1.2)
    with pytest.raises(RefusedError, match="--repeat 2"):
        Series(profile, made, tmp_path, session_count=2)


@pytest.mark.process
@pytest.mark.further  # as with an identified tip mass
def test_move_through_the_engine_leaves_no_vibration(rigd, tmp_path):
    """Friction, noise and quantisation included, against the quintic of the same time."""
    options = ("--fast", "--seed", "1", "--json", "--ring-down", "3", "--output", tmp_path)
    done = rigd("run", "move", "-0.5", *options)
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


def amplitude_nm(samples, first, hz):
    """Amplitude of the torque at a frequency in two seconds, by its Fourier coefficient."""
    torque = samples["coupling_torque_nm"][first : first + 2000]
    wave = np.exp(-2j * np.pi * hz * np.arange(torque.size) / 1000.0)
    return 2 * abs(np.mean((torque - torque.mean()) * wave))


@pytest.mark.process
def test_residual_vibration_with_tip_mass_is_as_planned(rigd, analysed, tmp_path):
    """The rig has 0.3 g at its tip, which the model contains but not the profile."""
    heavy = write_profile(tmp_path, {"simulation.tip_mass_kg": 3e-4})
    model = analysed(tip_mass_kg={"value": 3e-4, "std": 2e-6})
    done = rigd(
        "run", "move", "0.5", "--model", model, "--profile", heavy, "--fast", "--json",
        "--no-look", "--ring-down", "3", "--output", tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    session = read_session(json.loads(done.stdout)["sessions"][0]["path"])
    stated = {name: float(session.metadata[name]) for name in STATED}
    floor_nm, quintic_nm = stated["residual_floor_nm"], stated["quintic_residual_nm"]
    assert stated["residual_nm"] < floor_nm < 0.02 * quintic_nm
    assert f"below the noise of the sensor ({1e3 * floor_nm:.2g} mN·m)" in done.stderr
    first, end = session.segments["sweep"]
    # The first mode is at 2.29 Hz; that of the profile would be at 2.57 Hz.
    assert amplitude_nm(session.samples, end + 150, 2.286) < min(floor_nm, 0.01 * quintic_nm)
    torque_nm = session.samples["torque_command_nm"]
    assert np.abs(torque_nm).max() < 0.95 * load_profile("sim").rig.motor.peak_torque_nm
    away = np.flatnonzero(np.abs(session.samples["angle_rad"] - 0.5) > 1e-3)[-1] + 1 - first
    assert stated["arrival_s"] == pytest.approx(away / 1000.0, abs=0.01)
    assert (end - first) / 1000.0 == pytest.approx(stated["arrival_s"] - 0.08, abs=0.02)
    arrives = f"the angle within 1 mrad after {1e3 * stated['arrival_s']:.0f} ms"
    assert arrives in done.stderr


@pytest.mark.parametrize(
    ("kind", "effect", "message"),
    [
        ("move", "clock_rate_difference", "clocks of different rates, which a move does not"),
        ("touch", "tip_mass_kg", "a mass at the tip, which a search for touches does not"),
    ],
)
def test_model_with_an_unsupported_effect_is_refused(profile, analysed, kind, effect, message):
    path = analysed(**{effect: {"value": 1e-4}})
    with pytest.raises(IdentifiedBeamError, match=message) as refused:
        excitation_for(profile, kind, {"angle_rad": 0.5, "path": path})
    assert f"headlines[0].parameters.{effect}.value = 0.0001" in str(refused.value)


TIP_MASS = {"tip_mass_kg": {"value": 1e-3}}
COMPLIANCE = {"root_compliance_rad_per_nm": {"value": 0.5}}
OFFSETS = {"stiffness_offset_2": {"value": -0.1}, "stiffness_offset_3": {"value": 0.2}}


@pytest.mark.parametrize("effect", [TIP_MASS, COMPLIANCE, OFFSETS])
def test_poles_of_a_move_are_those_of_the_identified_beam(profile, analysed, effect):
    plant = RigPreview(profile).move_plant(analysed(**effect), MOVE_USE)
    assert plant.model is not None
    locked = plant.model.plant.poles(clamped_free_eigenvalues(3))[:, 0]
    assert plant.poles_rad_s[:3] == pytest.approx(locked, rel=5e-3)


@pytest.mark.parametrize("effect", [further(TIP_MASS), further(COMPLIANCE), OFFSETS])
def test_move_of_the_identified_beam_leaves_no_vibration(profile, analysed, effect):
    plant = RigPreview(profile).move_plant(analysed(**effect), MOVE_USE)
    made = excitation_for(profile, "move", {"by_rad": 0.1, "path": analysed(**effect)})
    path = made.reference_rad[slice(made.segments["sweep"][0] - 1, made.segments["sweep"][1])]
    left = np.abs(modal_state(path, 1000.0, plant.poles_rad_s)) @ plant.torque_per_state_nm_s
    assert left < 1e-4 * made.parameters["quintic_residual_nm"]
    plan = plan_session(profile, made)
    assert plan.prediction.tip is not None


def test_plan_warns_of_sensitivity_to_frequency(profile):
    """The frequencies of a profile's beam are uncertain by 1 %."""
    made = excitation_for(profile, "move", {"by_rad": 0.8})
    off_nm = float(made.parameters["frequency_residual_nm"])
    assert off_nm > float(made.parameters["residual_floor_nm"])
    words = plan_document(profile, made, plan_session(profile, made))["sweep"]
    assert f"{1e3 * off_nm:.2g} mN·m if the beam's frequencies are wrong" in words


def test_quiet_sensor_shows_vibration_by_friction(profile):
    """The vibration is stated in numbers where the sensor shows it, and grows with the friction."""
    left = []
    for coulomb_nm in (0.03, 0.09):
        rig = profile.rig
        quiet = replace(
            profile,
            rig=replace(
                rig,
                motor=replace(rig.motor, coulomb_nm=coulomb_nm),
                simulation=replace(rig.simulation, torque_noise_nm=1e-5),
            ),
        )
        made = excitation_for(quiet, "move", {"by_rad": 0.1})
        assert made.parameters["residual_floor_nm"] < made.parameters["residual_nm"]
        words = plan_document(quiet, made, plan_session(quiet, made))["sweep"]
        assert f"vibration left {1e3 * made.parameters['residual_nm']:.2g} mN·m" in words
        left.append(made.parameters["residual_nm"])
    assert left[1] > 2 * left[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"angle_rad": 0.2}, r"angle_rad = 0\.2 rad is the angle"),
        ({"angle_rad": 0.5, "speed_rad_s": 0.0}, r"speed_rad_s = 0 rad/s must be more than 0"),
        ({"angle_rad": 0.5, "hold_s": 1e-3}, "ends before the motor has stopped"),
        ({"angle_rad": 0.5, "passes": 0}, r"passes = 0 must be at least 1"),
    ],
)
def test_impossible_search_for_obstacles_is_refused(profile, options, message):
    with pytest.raises(ExcitationError, match=message):
        excitation_for(profile, "touch", options, start_angle_rad=0.2)
