"""After a record: active damping of the beam, and return of the motor."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.control.damper import DamperSettings
from rigd.engine.messages import PostRecordPlan, ReadyToRecord, SessionFinished
from rigd.excitation import chirp, hold, step
from rigd.runner.planning import plan_session

RATE_HZ = 1000.0


@pytest.fixture
def vibrating():
    """Some periods at the first mode, after which the beam vibrates for long."""
    return chirp(
        rate_hz=RATE_HZ, amplitude_rad=0.02, start_hz=2.57, stop_hz=2.57, duration_s=1.6,
        rest_s=0.3, ring_down_s=0.0,
    )  # fmt: skip


@pytest.fixture
def step_excitation():
    """A step, so that the record ends elsewhere than it starts."""
    return step(rate_hz=RATE_HZ, amplitude_rad=0.05, duration_s=0.5, rest_s=0.3, ring_down_s=0.0)


@pytest.fixture
def two_sessions(make_session, vibrating):
    """Run a session and a brief one with an ending; returns it and the virtual time (s)."""

    def run(ending, excitation=vibrating):
        session = make_session(excitation=excitation)
        brief = hold(rate_hz=RATE_HZ, duration_s=0.1, rest_s=0.0, ring_down_s=0.0)
        orders = [session.order(), session.order(brief)]
        session.obey(*(replace(order, ending=ending) for order in orders))
        outcomes = [finished.outcome for finished in session.parent.messages_of(SessionFinished)]
        assert outcomes == ["complete", "complete"]
        session.assert_safe()
        return session, session.clock.now_ns() * 1e-9

    return run


def test_no_wait_for_the_beam_before_the_next_session(two_sessions, vibrating):
    ending = plan_session_of(vibrating)
    damped, damped_s = two_sessions(ending)
    left, left_s = two_sessions(replace(ending, damper=None))
    assert damped_s < left_s - 2.0
    assert not any("Waiting" in event.message for event in damped.events)
    assert any("Waiting" in event.message for event in left.events)
    # The zero of the torque can be checked right after the record, which needs a beam at rest.
    for session, checked in ((damped, True), (left, False)):
        finished = session.parent.messages_of(SessionFinished)[0]
        assert ("tare_drift_nm" in finished.results) == checked


def plan_session_of(excitation):
    from rigd.profile import load_profile

    return plan_session(load_profile("sim"), excitation).ending


def starts_rad(session):
    return [
        float(ready.tare["start_angle_rad"]) for ready in session.parent.messages_of(ReadyToRecord)
    ]


def test_the_motor_returns_to_where_it_started(two_sessions, step_excitation):
    session, _ = two_sessions(plan_session_of(step_excitation), step_excitation)
    first_rad, second_rad = starts_rad(session)
    assert second_rad == pytest.approx(first_rad, abs=1e-3)


def test_the_motor_stays_after_a_move(two_sessions, step_excitation):
    session, _ = two_sessions(
        replace(plan_session_of(step_excitation), stays=True), step_excitation
    )
    first_rad, second_rad = starts_rad(session)
    assert second_rad - first_rad == pytest.approx(0.05, abs=1e-3)


def test_active_damping_stays_within_the_limit_of_the_angle(make_session):
    """A record that ends at the limit: the motor yields to the other side only."""
    excitation = step(
        rate_hz=RATE_HZ, amplitude_rad=0.2, duration_s=0.3, rest_s=0.3, ring_down_s=0.0
    )
    session = make_session(excitation=excitation)
    limits = replace(session.profile.limits, angle_rad=0.21, stop_angle_rad=0.5)
    session.profile = replace(session.profile, limits=limits)
    session.run()
    assert session.finished.outcome == "complete"
    assert session.finished.reason == ""


def test_a_damper_that_excites_the_beam_ends(two_sessions):
    """With reversed sign the damper feeds the vibration: it ends in time, and safely."""
    wrong = PostRecordPlan(damper=DamperSettings(-2.0, 0.025, 4.0, 320.0))
    small = step(rate_hz=RATE_HZ, amplitude_rad=0.005, duration_s=0.2, rest_s=0.2, ring_down_s=0.0)
    session, _ = two_sessions(wrong, small)
    assert np.abs(session.samples["coupling_torque_nm"]).max() < 1.0


@pytest.mark.parametrize(
    "unlike",
    [
        lambda p: replace(
            p,
            design_motor=p.rig.motor,
            rig=replace(
                p.rig, motor=replace(p.rig.motor, inertia_kg_m2=2 * p.rig.motor.inertia_kg_m2)
            ),
        ),
        further(
            lambda p: replace(p, rig=replace(p.rig, motor=replace(p.rig.motor, coulomb_nm=0.08)))
        ),
        further(
            lambda p: replace(p, rig=replace(p.rig, sensor=replace(p.rig.sensor, delay_s=5e-3)))
        ),
        further(lambda p: replace(p, control=replace(p.control, feedforward_gain=0.8))),
        further(
            lambda p: replace(
                p, rig=replace(p.rig, beam=replace(p.rig.beam, bending_stiffness_n_m2=0.075))
            )
        ),
    ],
    ids=["inertia", "friction", "delay", "feed-forward", "stiffness"],
)
def test_active_damping_tolerates_a_rig_unlike_the_profile(make_session, vibrating, unlike):
    """The damper planned for the profile damps a different rig."""
    profile = unlike(make_session().profile)
    session = make_session(excitation=vibrating, profile=profile)
    ending = plan_session_of(vibrating)
    session.obey(replace(session.order(), ending=ending))
    assert session.finished.outcome == "complete"
    assert session.finished.reason == ""
    assert "tare_drift_nm" in session.finished.results  # the beam was at rest
