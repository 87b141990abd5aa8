"""The verdict on the closed loop."""

from dataclasses import replace

import pytest
from cases import further

from rigd.beam import Damping
from rigd.check_rows import CheckResult, overall_verdict
from rigd.checks.closed_loop import margin_rows, stability_rows
from rigd.profile import load_profile


def loop_rows(profile):
    return [*stability_rows(profile), *margin_rows(profile)]


@pytest.fixture(scope="module")
def sim():
    return load_profile("sim")


def with_control(profile, **changes):
    return replace(profile, control=replace(profile.control, **changes))


@pytest.mark.parametrize("name", ["sim", further("antenna_can"), further("antenna_serial")])
def test_the_shipped_loops_are_fine(name):
    rows = list(loop_rows(load_profile(name)))
    assert overall_verdict(rows) == "ok"
    assert [row.what for row in rows[1:5]] == [
        "gain margin",
        "phase margin",
        "delay margin",
        "modulus margin",
    ]
    assert [row.group for row in rows[1::4]] == [
        "loop, torque command",
        "loop, angle reading",
        "loop, torque reading",
    ]


def test_an_unstable_loop_fails_with_its_remedy(sim):
    stability, margins = loop_rows(with_control(sim, feedforward_gain=0.0))
    assert stability.verdict is CheckResult.FAIL
    assert "control.feedforward_gain" in stability.found
    assert margins.verdict is CheckResult.SKIPPED


def test_a_slowly_growing_loop_is_a_warning(sim):
    light = replace(sim, rig=replace(sim.rig, damping=Damping(zeta=1e-6)))
    stability, margins = loop_rows(light)
    assert stability.verdict is CheckResult.WARNING
    assert "almost no damping" in stability.found
    assert margins.verdict is CheckResult.SKIPPED


def test_a_margin_below_its_limit_is_a_warning(sim):
    """A feed-forward that is 20 % too strong has no 20 % left."""
    rows = list(loop_rows(with_control(sim, feedforward_gain=1.2)))
    low = {(row.group, row.what) for row in rows if row.verdict is CheckResult.WARNING}
    assert ("loop, torque reading", "gain margin") in low
    assert ("loop, torque command", "phase margin") in low
    assert overall_verdict(rows) == "warnings"


def test_a_delay_margin_below_a_period_is_a_warning(sim):
    rig = replace(sim.rig, actuation=replace(sim.rig.actuation, delay_s=4.5e-3))
    rows = {(row.group, row.what): row for row in loop_rows(replace(sim, rig=rig))}
    delay = rows["loop, torque command", "delay margin"]
    assert delay.verdict is CheckResult.WARNING
    assert delay.wanted == "1.00 ms"


def test_an_impossible_design_fails(sim):
    stability, _ = loop_rows(with_control(sim, pole_rad_s=0.1))
    assert stability.verdict is CheckResult.FAIL
    assert "too slow for this motor" in stability.found
