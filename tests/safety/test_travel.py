"""How far the shaft turns after the loop has failed."""

import math
from dataclasses import replace

import pytest

from rigd.check_rows import CheckResult
from rigd.checks.stopping_distance import max_stopping_distance, stopping_distance_rows
from rigd.profile import load_profile


@pytest.fixture
def profile():
    return load_profile("antenna_can")


def worst_row(profile):
    (row,) = [row for row in stopping_distance_rows(profile) if row.what.startswith("worst, ")]
    return row


def with_motor(rig, **changes):
    return replace(rig, motor=replace(rig.motor, **changes))


def test_endless_travel_without_friction(profile):
    rig = with_motor(profile.rig, viscous_nm_s_per_rad=0.0, coulomb_nm=0.0)
    travel = max_stopping_distance(rig, profile.limits, 0.05)
    assert travel.driven_distance_rad == pytest.approx(4.0 * 0.05 + 0.5 * 450.0 * 0.05**2, rel=1e-6)
    assert travel.coasting_distance_rad == math.inf


def test_coulomb_friction_alone_brakes_evenly(profile):
    rig = with_motor(profile.rig, viscous_nm_s_per_rad=0.0, coulomb_nm=0.1)
    travel = max_stopping_distance(rig, profile.limits, 0.05)
    speed_rad_s = 4.0 + 0.8 / 2e-3 * 0.05
    inertia_kg_m2 = 2e-3 + 4.7e-3 * 0.98**3 / 3
    assert travel.driven_distance_rad == pytest.approx((4.0 + speed_rad_s) / 2 * 0.05, rel=1e-6)
    assert travel.coasting_distance_rad == pytest.approx(
        speed_rad_s**2 * inertia_kg_m2 / (2 * 0.1), rel=1e-3
    )


def test_viscous_friction_alone_brakes_by_its_time_constant(profile):
    rig = with_motor(profile.rig, coulomb_nm=1e-6)
    travel = max_stopping_distance(rig, profile.limits, 0.0)
    inertia_kg_m2 = 2e-3 + 4.7e-3 * 0.98**3 / 3
    assert travel.driven_distance_rad == 0.0
    assert travel.coasting_distance_rad == pytest.approx(4.0 * inertia_kg_m2 / 0.02, rel=1e-2)


def test_the_speed_limit_of_the_drive_shortens_the_travel(profile):
    free = max_stopping_distance(profile.rig, profile.limits, 0.05)
    limited = max_stopping_distance(profile.rig, profile.limits, 0.05, 5.0)
    assert limited.driven_distance_rad < 5.0 * 0.05
    assert limited.total_distance_rad < free.total_distance_rad / 4


@pytest.mark.parametrize("name", ["antenna_can", "antenna_serial"])
def test_the_shipped_rigs_come_to_rest_in_time(name):
    rows = list(stopping_distance_rows(load_profile(name)))
    assert [row.verdict for row in rows] == [CheckResult.OK] * 4
    (worst,) = [row for row in rows if row.what.startswith("worst, ")]
    assert worst.what == "worst, if the loop fails"
    assert "object 6080" in worst.detail
    assert [row.detail for row in rows if row is not worst] == [""] * 3


def test_a_drive_in_process_needs_no_travel_check():
    (row,) = stopping_distance_rows(load_profile("sim"))
    assert row.verdict is CheckResult.SKIPPED


@pytest.mark.parametrize(
    ("drive", "limits"),
    [
        ({"heartbeat_timeout_s": 0.5}, {}),
        ({"max_speed_rad_s": 0.0}, {}),
        ({}, {"stop_angle_rad": 2.0}),
    ],
)
def test_a_travel_beyond_the_stop_is_refused(profile, drive, limits):
    rig = replace(profile.rig, cia402=replace(profile.rig.cia402, **drive))
    wrong = replace(profile, rig=rig, limits=replace(profile.limits, **limits))
    row = worst_row(wrong)
    assert row.verdict is CheckResult.FAIL
    assert "cia402.heartbeat_timeout_s" in row.detail


@pytest.mark.parametrize(
    ("limits", "what", "key"),
    [
        ({"stale_ticks_in_a_row": 1000}, "if no angle comes", "limits.stale_ticks_in_a_row"),
        ({"missed_ticks_in_a_row": 1000}, "if ticks are missed", "limits.missed_ticks_in_a_row"),
    ],
)
def test_the_worst_travel_is_of_a_blind_loop(profile, limits, what, key):
    """With a thousand old angles a shaft turned by 38.5 rad, its drive's heartbeat being there."""
    blind = replace(profile, limits=replace(profile.limits, **limits))
    row = worst_row(blind)
    assert row.what == f"worst, {what}"
    assert row.verdict is CheckResult.FAIL
    assert f"1000 {'old angles' if 'stale' in key else 'missed ticks'} ({key})" in row.found
    assert key in row.detail
    others = [each for each in stopping_distance_rows(blind) if each.what != row.what]
    assert [each.verdict for each in others] == [CheckResult.OK] * 3
    # Five rad/s, the drive's own limit, for a second; then it runs out.
    travel = max_stopping_distance(blind.rig, blind.limits, 1.002, 5.0)
    assert 4.9 < travel.driven_distance_rad < 5.01
    assert row.found.startswith(
        f"{travel.total_distance_rad:.2f} rad: {travel.driven_distance_rad:.2f} rad in the"
    )


def test_endless_travel_is_reported_at_once(profile):
    endless = {"max_speed_rad_s": 0.0}
    blind = replace(
        profile,
        rig=replace(profile.rig, cia402=replace(profile.rig.cia402, **endless)),
        limits=replace(profile.limits, stale_ticks_in_a_row=10**9),
    )
    row = worst_row(blind)
    assert row.verdict is CheckResult.FAIL
    assert row.found.startswith("more than 100 rad: more than 100 rad in the")
    assert (
        max_stopping_distance(profile.rig, profile.limits, math.inf, 5.0).total_distance_rad
        == math.inf
    )


def test_constant_speed_needs_no_steps(profile):
    travel = max_stopping_distance(profile.rig, profile.limits, 10.0, 5.0)
    assert travel.driven_distance_rad == pytest.approx(50.0, abs=0.02)


def test_no_bound_for_a_drive_accepted_without_watchdog(profile):
    drive = replace(profile.rig.cia402, accept_without=("watchdog",))
    rows = list(stopping_distance_rows(replace(profile, rig=replace(profile.rig, cia402=drive))))
    worst, *others = rows
    assert (worst.what, worst.verdict) == ("worst, if the loop fails", CheckResult.WARNING)
    assert "without bound" in worst.found
    assert "cia402.accept_without" in worst.detail
    assert [row.verdict for row in others] == [CheckResult.OK] * 3
    assert not any(row.what.startswith("worst") for row in others)


def test_a_slower_watchdog_of_the_maker_counts(profile):
    drive = replace(profile.rig.cia402, own_watchdog_s=0.06)
    row = worst_row(replace(profile, rig=replace(profile.rig, cia402=drive)))
    assert "60 ms of the drive's watchdog (cia402.own_watchdog_s)" in row.found
