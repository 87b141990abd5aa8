"""Table, TOML and notes of estimates that are made up."""

import re
import tomllib
from dataclasses import replace

import pytest

from rigd.identification import propose
from rigd.identification.estimate import MotorEstimate, MotorQuantity
from rigd.profile import load_profile

ESTIMATE = MotorEstimate(
    inertia_kg_m2=MotorQuantity(2.0123e-3, 2.1e-6),
    viscous_nm_s_per_rad=MotorQuantity(0.02004, 6e-5),
    coulomb_nm=MotorQuantity(-1e-5, 4e-5),
    torque_scale=MotorQuantity(1.1, 5e-4),
    actuation_delay_s=MotorQuantity(9.96e-4, 8e-6),
    window_count=72,
    dropped_window_count=0,
    misfit=1.0,
    friction_departure_nm=1e-4,
)


def test_verdict_uses_three_deviations(profile):
    differs = {row.profile_key: row.differs for row in propose(ESTIMATE, profile).rows}
    assert differs["motor.inertia_kg_m2"] is True
    assert differs["motor.viscous_nm_s_per_rad"] is False
    assert differs["actuation.delay_s"] is False


def test_scale_is_applied_to_the_rated_torque(profile):
    toml = tomllib.loads("\n".join(propose(ESTIMATE, profile).toml()))
    assert toml["motor"]["rated_torque_nm"]["value"] == pytest.approx(0.55)
    assert toml["motor"]["inertia_kg_m2"] == {"value": 2.0123e-3, "source": "measured"}


def test_rated_torque_of_the_drive_is_compared_in_one_unit():
    proposal = propose(ESTIMATE, load_profile("antenna_can"))
    toml = tomllib.loads("\n".join(proposal.toml()))
    ratio = toml["motor"]["rated_torque_nm"]["value"] / 0.5
    assert toml["cia402"]["rated_torque_unit_nm"]["value"] == pytest.approx(1e-3 * ratio)


def test_negative_values_are_proposed_as_zero(profile):
    toml = tomllib.loads("\n".join(propose(ESTIMATE, profile).toml()))
    assert toml["motor"]["coulomb_nm"]["value"] == 0.0


def test_unreported_scale_is_not_proposed(profile):
    proposal = propose(replace(ESTIMATE, torque_scale=MotorQuantity(1.0, None)), profile)
    assert "rated_torque_nm" not in "\n".join(proposal.toml())
    assert any("not identifiable" in line for line in proposal.table())
    assert "is not identifiable" in proposal.notes[0]
    assert proposal.as_dict()["torque_scale"] == {"value": 1.0, "std": None}
    assert proposal.as_dict()["parameters"]["motor.rated_torque_nm"]["differs"] is None


def test_misfit_and_missing_passes_are_reported(profile):
    notes = propose(
        replace(ESTIMATE, misfit=7.3, dropped_window_count=2), profile, unusable_count=3
    ).notes
    assert any("7.3 times" in note for note in notes)
    assert any("5 of 77 passes were left out" in note for note in notes)
    quiet = propose(ESTIMATE, profile).notes
    assert not any("times what scatter" in note or "left out" in note for note in quiet)


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (2.0123e-3, 2.1e-6, ("0.0020123", "2.1e-06")),
        (0.0300123, 4.4e-5, ("0.030012", "4.4e-05")),
        (9.9612e-4, 7.8e-6, ("9.961e-04", "7.8e-06")),
        (1.00045, 5.2e-4, ("1.00045", "0.00052")),
        (0.0, 1e-3, ("0.0000", "0.001")),
    ],
)
def test_numbers_show_two_figures_of_their_deviation(profile, value, std, expected):
    estimate = replace(ESTIMATE, viscous_nm_s_per_rad=MotorQuantity(value, std))
    (line,) = [row for row in propose(estimate, profile).table() if "motor.viscous" in row]
    cells = re.split(r"  +", line)
    assert (cells[1].partition(" ")[0], cells[2]) == expected


@pytest.mark.parametrize(("delay_s", "pasted"), [(9.96e-4, 1e-3), (1.004e-3, 1.004e-3)])
def test_delay_near_the_protocol_minimum_is_rounded_to_it(delay_s, pasted):
    estimate = replace(ESTIMATE, actuation_delay_s=MotorQuantity(delay_s, 8e-6))
    proposal = propose(estimate, load_profile("antenna_can"))
    toml = tomllib.loads("\n".join(proposal.toml()))
    assert toml["actuation"]["delay_s"]["value"] == pytest.approx(pasted)
    assert not any("on_arrival" in note for note in proposal.notes)


def test_drive_that_applies_torque_on_arrival_is_recognised():
    estimate = replace(ESTIMATE, actuation_delay_s=MotorQuantity(6.0e-4, 8e-6))
    proposal = propose(estimate, load_profile("antenna_can"))
    assert any('torque_delivery = "on_arrival"' in note for note in proposal.notes)
    toml = tomllib.loads("\n".join(proposal.toml()))
    assert toml["actuation"]["delay_s"]["value"] == pytest.approx(6.0e-4)
