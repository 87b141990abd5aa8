"""The probing move finds wrong scales and signs before the shaft leaves its limits."""

from dataclasses import replace

import pytest
from bench_probing import Mismatch, mismatches, probe
from cases import further

from rigd.engine import probed_rig
from rigd.profile import load_profile
from rigd.safety.probe_estimate import contradiction
from rigd.safety.probing_move import ProbeEnd, plan_probe

STEP, RATED, INERTIA = "encoder.resolution_rad", "motor.rated_torque_nm", "motor.inertia_kg_m2"


@pytest.fixture(scope="module")
def profile():
    return load_profile("antenna_can")


@pytest.mark.parametrize(
    ("mismatch", "coulomb_nm", "message"),
    [
        pytest.param(Mismatch(profile={STEP: 0.1}), 0.02, "encoder.resolution_rad", id="step 0.1"),
        further(Mismatch(profile={STEP: 0.25}), 0.1, "encoder.resolution_rad", id="step 0.25"),
        pytest.param(
            Mismatch(profile={STEP: 0.5}),
            0.03,
            "resolution_rad is probably too small",
            id="step 0.5",
        ),
        further(Mismatch(profile={STEP: 4.0}), 0.03, "encoder.resolution_rad", id="step 4"),
        pytest.param(
            Mismatch(truth={RATED: 5.0, "motor.peak_torque_nm": 5.0}),
            0.02,
            "exerts 5 ",
            id="torque 5",
        ),
        further(Mismatch(profile={RATED: 2.0}), 0.03, "motor.rated_torque_nm", id="torque 0.5"),
        pytest.param(Mismatch(truth={INERTIA: 2.0}), 0.1, "motor.inertia_kg_m2", id="inertia 2"),
        further(Mismatch(profile={INERTIA: 5.0}), 0.03, "motor.inertia_kg_m2", id="inertia 0.2"),
        pytest.param(Mismatch(encoder_sign=-1), 0.03, "counts against the torque", id="encoder"),
        further(Mismatch(torque_sign=-1), 0.03, "counts against the torque", id="torque"),
        pytest.param(Mismatch(sensor_sign=-1), 0.03, "sign is wrong (sensor", id="sensor"),
        pytest.param(Mismatch(frozen_from=0), 0.02, "encoder stands still", id="frozen"),
        further(Mismatch(frozen_from=1650), 0.02, "encoder stands still", id="frozen while moving"),
    ],
)
def test_mismatch_is_named_within_the_limits_of_the_shaft(profile, mismatch, coulomb_nm, message):
    done = probe(profile, mismatch, coulomb_nm=coulomb_nm)
    assert message in done.contradiction
    assert done.speed_rad_s < profile.limits.velocity_rad_s
    assert done.angle_rad < (0.3 if mismatch.frozen_from is not None else profile.limits.angle_rad)


@pytest.mark.parametrize(
    ("mismatch", "coulomb_nm"),
    [
        (Mismatch(), 0.1),
        (Mismatch(profile={STEP: 0.75}), 0.02),
        further(Mismatch(profile={STEP: 1.25}), 0.03, id="step 1.25"),
        further(Mismatch(truth={RATED: 0.75, "motor.peak_torque_nm": 0.75}), 0.06, id="torque"),
        further(Mismatch(profile={INERTIA: 1.25}), 0.03, id="inertia"),
    ],
)
def test_a_quarter_too_much_or_too_little_is_accepted(profile, mismatch, coulomb_nm):
    done = probe(profile, mismatch, coulomb_nm=coulomb_nm)
    assert done.end is ProbeEnd.COMPLETE
    assert done.contradiction == ""
    assert done.estimate.coulomb_nm == pytest.approx(coulomb_nm, rel=0.1)


def test_undetermined_motor_is_no_contradiction(profile):
    done = probe(profile, Mismatch(), coulomb_nm=0.1)
    vague = replace(done.estimate, inertia_std=0.2 * done.estimate.inertia_ratio)
    text = contradiction(probed_rig(profile), done.end, vague)
    assert "could not be determined whether the motor agrees with the inertia" in text
    assert "Start the session again" in text
    assert "Correct the profile" not in text
    assert contradiction(probed_rig(profile), done.end, vague, with_motor=False) == ""


def test_a_shaft_that_does_not_move_is_refused(profile):
    done = probe(profile, Mismatch(), coulomb_nm=0.4)
    assert done.end is ProbeEnd.BLOCKED
    assert "no motion" in done.contradiction
    assert done.angle_rad < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("coulomb_nm", [0.02, 0.1])
@pytest.mark.parametrize("mismatch", list(mismatches()), ids=lambda mismatch: mismatch.name)
def test_every_mismatch(profile, mismatch, coulomb_nm):
    done = probe(profile, mismatch, coulomb_nm=coulomb_nm, seed=3)
    assert bool(done.contradiction) is mismatch.must_fail
    assert done.speed_rad_s < profile.limits.velocity_rad_s
    assert done.angle_rad < profile.limits.angle_rad


def test_the_plan_is_within_the_limits_of_the_profile(profile):
    rig = probed_rig(profile)
    plan = plan_probe(rig)
    assert plan.travel_rad >= 0.1
    assert plan.speed_rad_s < plan.fast_speed_rad_s <= 0.2 * profile.limits.velocity_rad_s
    assert plan.torque_limit_nm == 0.5 * profile.rig.motor.rated_torque_nm
