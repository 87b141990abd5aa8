"""Moves: residual vibration by the exact model; limits, and braking."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further

from rigd.beam import participation, transfer
from rigd.control import close_loop
from rigd.excitation import ExcitationError, shortest_braking, shortest_move
from rigd.excitation.moves import (
    braked_reference,
    braking_path,
    modal_state,
    quintic,
    slew,
    vibration_free_path,
)
from rigd.identified_beam import MOVE_USE

RATE_HZ = 1000.0


@pytest.fixture(scope="session")
def plant(rig):
    return rig.move_plant("", MOVE_USE)


@pytest.fixture(scope="session")
def ring_down_nm(profile):
    """The torque that rings on after a reference, by the exact model in the frequency domain."""
    loop = close_loop(profile.loop_model())

    def ring(reference_rad, seconds=2.0, beam=profile.rig.beam):
        held = np.full(round(seconds * RATE_HZ), reference_rad[-1])
        angle = (
            close_loop(replace(loop.model, plant=replace(loop.model.plant, beam=beam)))
            .simulate(np.concatenate([[0.0], reference_rad, held]))
            .angle_rad
        )
        # A long pause in which the beam is turned back slowly, so that the record is periodic.
        back = angle[-1] * (1.0 - quintic(20.0, RATE_HZ))
        whole = np.concatenate([angle, back, np.zeros(40_000)])
        s = 2j * np.pi * np.fft.rfftfreq(whole.size, 1.0 / RATE_HZ)
        g = transfer(s, beam, profile.rig.damping)
        torque = np.fft.irfft(g * np.fft.rfft(whole), whole.size)
        return torque[reference_rad.size + 101 : angle.size]

    return ring


def vibration_nm(torque_nm):
    """Half the range of a ring-down without its slow part."""
    t = np.linspace(-1.0, 1.0, torque_nm.size)
    return 0.5 * np.ptp(torque_nm - np.polyval(np.polyfit(t, torque_nm, 3), t))


def test_torque_of_a_mode_matches_the_exact_model(plant, ring_down_nm):
    """The predicted amplitude against the exact model's, for a quintic that excites mode 1."""
    path = 0.5 * quintic(0.2, RATE_HZ)
    state = modal_state(np.concatenate([[0.0], path]), RATE_HZ, plant.poles_rad_s)
    amplitude = np.abs(state) * plant.torque_per_state_nm_s
    assert amplitude[0] > 10 * amplitude[1:].max()
    assert vibration_nm(ring_down_nm(path)[:1000]) == pytest.approx(amplitude[0], rel=0.15)


@pytest.mark.parametrize("duration_s", [0.5, 0.8, 2.0])
def test_vibration_free_path_ends_at_1(plant, ring_down_nm, duration_s):
    path = vibration_free_path(duration_s, RATE_HZ, plant.poles_rad_s)
    assert path.size == duration_s * RATE_HZ
    assert path[-1] == pytest.approx(1.0, abs=1e-12)
    assert path[-1] - path[-2] == pytest.approx(0.0, abs=1e-3)
    left = vibration_nm(ring_down_nm(0.1 * path))
    assert left < 4e-4
    if duration_s < 1.0:
        assert left < 0.1 * vibration_nm(ring_down_nm(0.1 * quintic(duration_s, RATE_HZ)))


def test_too_short_path_is_the_quintic(plant):
    path = vibration_free_path(0.1, RATE_HZ, plant.poles_rad_s)
    assert np.array_equal(path, quintic(0.1, RATE_HZ))


@pytest.mark.parametrize("distance_rad", [further(0.1), -0.5, further(1.2)])
def test_shortest_move_leaves_no_vibration_within_limits(
    plant, profile, ring_down_nm, distance_rad
):
    move = shortest_move(plant, distance_rad)
    usual = distance_rad * quintic(move.duration_s, RATE_HZ)
    assert move.reference_rad[-1] == pytest.approx(distance_rad, rel=1e-9)
    # The residual of the exact model is the memory of the fractional damping.
    assert vibration_nm(ring_down_nm(move.reference_rad)) < 0.02 * vibration_nm(ring_down_nm(usual))
    held = np.full(200, distance_rad)
    response = close_loop(profile.loop_model()).simulate(
        np.concatenate([[0.0], move.reference_rad, held])
    )
    assert np.abs(response.torque_nm).max() < 0.93 * profile.rig.motor.peak_torque_nm
    assert np.abs(response.velocity_rad_s).max() < 0.93 * profile.limits.velocity_rad_s
    assert move.limit_fraction < 0.93
    assert response.angle_rad[-1] == pytest.approx(distance_rad, abs=2e-3)


@pytest.fixture(scope="module")
def plain(plant):
    return shortest_move(plant, 0.5)


def test_the_shortest_move_is_not_much_slower_than_the_bound(plant, plain):
    """A move of the same reach in 5 % less time has no solution within the limits."""
    from rigd.excitation._shortest_move import _MoveSearch

    assert plain.duration_s < 0.55 * 2 * np.pi / abs(plant.poles_rad_s[0])
    search = _MoveSearch(plant, 0.5, 0.0, 1, None)
    assert search._least_limit_fraction(round(0.95 * plain.reference_rad.size))[0] > 1.0


def test_robust_move_tolerates_frequency_errors(plant, plain, profile, ring_down_nm):
    beam = replace(
        profile.rig.beam,
        bending_stiffness_n_m2=profile.rig.beam.bending_stiffness_n_m2 * 1.02,
    )
    robust = shortest_move(plant, 0.5, robust=True)
    assert robust.duration_s > plain.duration_s
    assert robust.residual_nm < 0.2 * plain.residual_nm
    assert vibration_nm(ring_down_nm(robust.reference_rad, beam=beam)) < 0.5 * vibration_nm(
        ring_down_nm(plain.reference_rad, beam=beam)
    )
    # The prediction for 1 % is of the size that the exact model has.
    predicted, found = plain.residual_nm, vibration_nm(ring_down_nm(plain.reference_rad, beam=beam))
    assert 0.5 * found < predicted < 2.0 * found


@pytest.mark.parametrize("robust", [False, further(True)])
def test_move_removes_initial_vibration(plant, ring_down_nm, robust):
    before = 0.1 * quintic(0.15, RATE_HZ)
    ringing = modal_state(np.concatenate([[0.0], before]), RATE_HZ, plant.poles_rad_s)
    move = shortest_move(plant, 0.5, robust=robust, initial_modal_states=ringing)
    blind = shortest_move(plant, 0.5, robust=robust)
    left, not_taken_out = (
        vibration_nm(ring_down_nm(np.concatenate([before, before[-1] + each.reference_rad])))
        for each in (move, blind)
    )
    assert not_taken_out > 0.02
    assert left < 0.05 * not_taken_out
    assert left < move.residual_nm < 0.3 * not_taken_out  # for wrong frequencies


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("max_velocity_rad_s", 1.5),
        further("peak_torque_nm", 0.15),  # which the shortest move above is near to
        ("max_coupling_torque_nm", 0.025),
        ("max_tracking_error_rad", 0.03),
    ],
)
def test_moves_slow_down_for_the_limits(plant, plain, name, limit):
    slow = shortest_move(replace(plant, **{name: limit}), 0.5)
    assert slow.duration_s > 1.1 * plain.duration_s
    assert slow.limit_fraction < 0.95


def test_a_move_stays_within_the_angle(plant, monkeypatch):
    tight = replace(plant, max_angle_rad=1.0)
    move = shortest_move(tight, 0.97)
    response = tight.respond(np.concatenate([[0.0], move.reference_rad, np.full(200, 0.97)]))
    assert response.angle_rad.max() <= 1.001
    monkeypatch.setattr("rigd.excitation._shortest_move.LONGEST_MOVE_S", 2.0)
    with pytest.raises(ExcitationError, match=r"limits\.velocity_rad_s"):
        shortest_move(replace(plant, max_velocity_rad_s=0.1), 1.0)


def test_slew_has_its_speed_without_vibration(plant, ring_down_nm):
    path = slew(
        -0.8, speed_rad_s=1.0, acceleration_rad_s2=20.0, rate_hz=RATE_HZ,
        poles_rad_s=plant.poles_rad_s,
    )  # fmt: skip
    speed = np.diff(path) * RATE_HZ
    assert path[-1] == pytest.approx(-0.8, abs=1e-9)
    assert speed[path.size // 2] == pytest.approx(-1.0, rel=1e-2)
    assert np.abs(np.diff(speed)).max() * RATE_HZ <= 20.0
    assert vibration_nm(ring_down_nm(path)) < 5e-4
    # On the way too: the first pulse alone leaves the modes at rest.
    cruise = path[: path.size // 2]
    state = modal_state(np.concatenate([[0.0], cruise]), RATE_HZ, plant.poles_rad_s)
    assert np.abs(state).max() < 1e-9


def test_a_slew_too_short_for_its_speed_is_slower(plant):
    options = {"acceleration_rad_s2": 20.0, "rate_hz": RATE_HZ, "poles_rad_s": plant.poles_rad_s}
    path = slew(0.05, speed_rad_s=1.0, **options)
    assert path[-1] == pytest.approx(0.05, abs=1e-9)
    assert np.abs(np.diff(path)).max() * RATE_HZ < 0.5
    with pytest.raises(ExcitationError, match="speed_rad_s"):
        slew(0.05, speed_rad_s=0.0, **options)


# Braking


def test_a_braking_path_continues_angle_speed_and_acceleration():
    braking = braking_path(0.2, RATE_HZ)
    t = np.arange(-5, 0) / RATE_HZ
    angle, speed, acceleration = 0.3, -2.0, 15.0
    before = angle + speed * t + 0.5 * acceleration * t**2
    path = np.concatenate([before, [angle], braking.path(angle, speed, acceleration)])
    speeds = np.diff(path) * RATE_HZ
    assert np.abs(np.diff(speeds)).max() * RATE_HZ < 1.5 * 2.0 / 0.2 + 15.0 + 1.0
    # Neither speed nor acceleration jumps at the joint.
    accelerations = np.diff(speeds) * RATE_HZ
    assert np.abs(np.diff(accelerations[:12])).max() < 1.0
    assert speeds[-1] == pytest.approx(0.0, abs=1e-3)
    assert braking.duration_s == 0.2


def test_braking_respects_the_torque_anywhere_on_a_slew(plant, profile):
    path = slew(
        3.0,
        speed_rad_s=12.0,
        acceleration_rad_s2=150.0,
        rate_hz=RATE_HZ,
        poles_rad_s=plant.poles_rad_s,
    )
    path = np.concatenate([[0.0], path])
    braking = shortest_braking(plant, path)
    loop = close_loop(profile.loop_model())

    def peak_nm(table):
        peaks = []
        for tick in range(2, path.size, 7):
            reference = braked_reference(path, tick, table)
            response = loop.simulate(np.concatenate([reference, np.full(300, reference[-1])]))
            peaks.append(np.abs(response.torque_nm).max())
            assert abs(response.velocity_rad_s[-1]) < 0.02
        return max(peaks)

    limit_nm = profile.rig.motor.peak_torque_nm
    assert peak_nm(braking) <= 1.02 * limit_nm
    # A motor of half that torque takes longer, and needs to.
    gentle = shortest_braking(replace(plant, peak_torque_nm=limit_nm / 2), path)
    assert gentle.duration_s > braking.duration_s
    assert peak_nm(gentle) <= 1.02 * limit_nm / 2 < peak_nm(braking)


def test_error_if_motion_cannot_be_braked(plant):
    path = np.linspace(0.0, 50.0, 1000)
    with pytest.raises(ExcitationError, match=r"motor\.peak_torque_nm"):
        shortest_braking(replace(plant, peak_torque_nm=0.04), path)


def test_participation_gives_the_rigid_beam(plant, profile):
    """All modes' torques together are the rigid inertia: the first has 97 % of it."""
    beam = profile.rig.beam
    omega = np.abs(plant.poles_rad_s[0])
    rigid = beam.inertia_kg_m2 * participation(beam, 1)[0] / (beam.length_m**3 / 3)
    assert plant.torque_per_state_nm_s[0] == pytest.approx(rigid * omega, rel=0.05)
