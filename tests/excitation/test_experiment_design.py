"""Designed segments: joints, limits with ringing, information, and duration."""

from dataclasses import replace

import numpy as np
import pytest
from beam_estimates import ESTIMATE, UNIFORM, covariance_of

from rigd.beam import Beam, Damping
from rigd.beam.tip import tip_motion
from rigd.excitation import ExcitationError, chirp, information
from rigd.excitation.experiment_design import design_excitation, next_segment
from rigd.excitation.targets import parse_target

RATE_HZ = 1000.0
LIMIT_FRACTION = 0.9
DAMPING = [parse_target("damping", "1%")]


@pytest.fixture(scope="module")
def scanned(rig):
    """Angle of a fast scan."""
    scan = chirp(rate_hz=RATE_HZ, start_hz=0.5, duration_s=5.0, rest_s=1.0, ring_down_s=0.0)
    plant = rig.plant_with(ESTIMATE.plant)
    return plant.respond(scan.reference_rad).angle_rad


@pytest.fixture(scope="module")
def design(rig, scanned):
    return design_excitation(ESTIMATE, rig, DAMPING, 30.0, angle_rad_so_far=scanned)


@pytest.mark.further  # as tests/cli/test_until.py
def test_angle_speed_and_acceleration_are_zero_at_the_joints(design):
    """Compared with the largest values of the session, which a step there would have."""

    def derivatives(path):
        speed = np.diff(path) * RATE_HZ
        return path, speed, np.diff(speed) * RATE_HZ

    largest = [np.abs(values).max() for values in derivatives(design.reference_rad)]
    for segment in design.segments:
        path = np.concatenate([np.zeros(3), segment.reference_rad, np.zeros(3)])
        for values, most, fraction in zip(
            derivatives(path), largest, (1e-5, 1e-4, 2e-3), strict=True
        ):
            assert np.abs(values[:5]).max() < fraction * most
            assert np.abs(values[-5:]).max() < fraction * most


def test_loop_of_an_estimate_is_computed_once(rig):
    plant = rig.plant_with(ESTIMATE.plant)
    assert rig.plant_with(replace(ESTIMATE.plant)) is plant
    assert rig.plant_with(replace(ESTIMATE.plant, damping=Damping(zeta=7e-5))) is not plant
    assert rig.plant_with(replace(ESTIMATE.plant, tip_mass_kg=3e-4)) is not plant


def test_all_targets_are_reached_within_the_time(design):
    assert all(each.reached for each in design.expected_precisions)
    assert not all(each.reached for each in design.segments[0].present_precisions)
    assert design.reference_rad.size < 15.0 * RATE_HZ
    assert design.reference_rad.size == design.angle_rad.size
    assert [each.target.mode for each in design.expected_precisions] == [1, 2, 3]


def test_session_stays_within_limits_and_small_slopes(rig):
    """By another way: the whole reference through the loop, the tip from the whole angle."""
    plant = rig.plant_with(ESTIMATE.plant)
    alone = design_excitation(ESTIMATE, rig, DAMPING, 6.0)
    response = plant.respond(alone.reference_rad)
    torque = np.abs(response.torque_nm).max() + plant.friction_nm
    assert torque < 1.05 * LIMIT_FRACTION * (plant.peak_torque_nm + plant.friction_nm)
    slope = tip_motion(ESTIMATE.plant, response.angle_rad, RATE_HZ).slope_rad
    # Ringing moves the motor a little, which no segment knows: the remaining fraction is for that.
    assert 0.8 * 0.9 * 0.14 < slope < 0.14


def stds_of(covariance):
    return np.sqrt(np.diag(covariance))


def test_expected_covariance_is_that_of_the_record(scanned, design):
    angle = np.concatenate([scanned, design.angle_rad])
    whole = covariance_of(information(angle, ESTIMATE, RATE_HZ))
    np.testing.assert_allclose(stds_of(design.covariance), stds_of(whole), rtol=0.02)


@pytest.mark.further  # a record of a whole number of the design's steps is tested above
def test_information_is_additive_at_any_tick(rig, scanned):
    angle = scanned[:5003]
    made = design_excitation(ESTIMATE, rig, DAMPING, 30.0, angle_rad_so_far=angle)
    whole = covariance_of(information(np.concatenate([angle, made.angle_rad]), ESTIMATE, RATE_HZ))
    np.testing.assert_allclose(stds_of(made.covariance), stds_of(whole), rtol=0.02)


@pytest.mark.further  # as the limits of the session
def test_a_tighter_limit_lowers_the_amplitude(rig, scanned):
    free, held = (
        next_segment(ESTIMATE, np.zeros(1000), DAMPING, rig, 10.0, tip_slope_rad=slope)
        for slope in (0.14, 0.07)
    )
    slopes = [
        tip_motion(ESTIMATE.plant, segment.angle_rad, RATE_HZ).slope_rad for segment in (free, held)
    ]
    assert slopes[1] < 0.064
    assert slopes[0] < 0.13
    assert slopes[1] < 0.7 * slopes[0]


def test_fraction_of_the_limits_is_respected(rig):
    segment = next_segment(ESTIMATE, np.zeros(1000), DAMPING, rig, 3.0, limit_fraction=0.4)
    assert 0.2 < segment.fraction_of_limits <= 0.4 * LIMIT_FRACTION + 1e-9


def test_segment_fits_in_the_remaining_time(rig, scanned):
    segment = next_segment(ESTIMATE, scanned, DAMPING, rig, 1.2)
    assert segment.reference_rad.size <= 1200
    with pytest.raises(ExcitationError, match=r"fits into 0\.4 s"):
        next_segment(ESTIMATE, scanned, DAMPING, rig, 0.4)


def test_unreachable_target_is_reported_with_the_reason(rig, scanned, design):
    hard = next_segment(ESTIMATE, scanned, [parse_target("damping", "0.01%")], rig, 60.0).forecast
    assert hard.time_to_targets_s > 1000
    assert "60 s are left" in hard.reason
    easy = design.segments[0].forecast
    assert 0 < easy.time_to_targets_s < 20
    assert not easy.reason
    internal = replace(
        ESTIMATE,
        plant=replace(ESTIMATE.plant, damping=Damping(zeta=7.1e-5)),
        free_parameters=tuple(name for name in UNIFORM if name not in ("gamma", "lambda")),
    )
    absent = next_segment(internal, scanned, [parse_target("gamma", "5%")], rig, 60.0)
    assert absent.forecast.time_to_targets_s == np.inf
    assert "external damping is absent" in absent.forecast.reason
    assert not any(each.reached for each in absent.expected_precisions)
    beyond = next_segment(ESTIMATE, scanned, [parse_target("damping", "7:1%")], rig, 60.0)
    assert "mode 7 is not below 50 Hz" in beyond.forecast.reason


def test_predicted_duration_is_near_that_of_a_design(design):
    taken_s = design.reference_rad.size / RATE_HZ
    assert 0.4 < design.segments[0].forecast.time_to_targets_s / taken_s < 2.5


def test_only_the_requested_mode_is_driven(rig):
    segment = next_segment(
        ESTIMATE, np.zeros(1000), [parse_target("frequency", "3:0.01%")], rig, 10.0
    )
    power = np.abs(np.fft.rfft(segment.angle_rad, 8000)) ** 2
    hz = np.fft.rfftfreq(8000, 1 / RATE_HZ)
    assert power[np.abs(hz - 44.8) < 4].sum() > 0.5 * power.sum()


def test_required_mode_is_driven_first(rig, scanned):
    def driven(*through):
        name = next_segment(ESTIMATE, scanned, DAMPING, rig, 3.0, modes_to_drive=through).name
        return set(name.partition(",")[0].split())

    others = {"1", "2", "3"} - driven()
    assert others
    for number in others:
        assert number in driven(int(number))


def test_no_target_and_no_mode_are_refused(rig, scanned):
    with pytest.raises(ExcitationError, match="No precision is requested"):
        next_segment(ESTIMATE, scanned, [], rig, 10.0)
    stiff = replace(ESTIMATE, plant=replace(ESTIMATE.plant, beam=Beam(0.1, 4.7e-3, 0.090275)))
    with pytest.raises(ExcitationError, match="no mode below 50 Hz"):
        next_segment(stiff, scanned, [parse_target("zeta", "5%")], rig, 10.0)
