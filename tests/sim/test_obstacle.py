"""Obstacles in the way of the simulated beam, against a solution by other means.

The other solution knows the exact model on a line of the Laplace plane only: its kernels are
convolved on a fine grid of times, and the force of the obstacle is found point by point.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further
from hypothesis import given
from hypothesis import strategies as st
from resting_beams import pressing_force_n
from shipped_profile import load_shipped

from rigd.beam import Damping, PointForceGrid
from rigd.devices.obstacles import ObstacleError
from rigd.sim import SimulatedPlant
from rigd.sim._obstacle import _ActiveObstacle

RIG = load_shipped("sim").rig
BEAM, DAMPING = RIG.beam, RIG.damping
PERIOD_S = 1e-3
FINE_S = {100.0: 1e-5, 3000.0: 1e-5, 100_000.0: 2e-6}
"""Step of the other solution by the stiffness of the obstacle: less than the time it yields for."""

# An angle that no beam disturbs: a heavy motor accelerates in 50 ms to 1 rad/s.
HEAVY_KG_M2 = 1e5
START_RAD_S2, START_S = 20.0, 0.05
TOUCH_RAD = 0.05
SESSION_S = 0.16


def rig_with(*obstacles, inertia_kg_m2=2e-3, viscous=0.0, coulomb_nm=0.0, **changes):
    motor = replace(
        RIG.motor,
        inertia_kg_m2=inertia_kg_m2,
        viscous_nm_s_per_rad=viscous,
        coulomb_nm=coulomb_nm,
        peak_torque_nm=1e8,
    )
    actuation = replace(RIG.actuation, delay_s=0.0)
    simulation = replace(RIG.simulation, obstacles=obstacles)
    return replace(RIG, motor=motor, actuation=actuation, simulation=simulation, **changes)


class Record:
    """Motion of a plant, tick by tick, and the forces of its substeps."""

    def __init__(self, rig, torques_nm):
        self.plant = plant = SimulatedPlant(rig)
        plant.enable()
        rows, forces = [], []
        for torque_nm in torques_nm:
            plant.command(float(torque_nm(plant) if callable(torque_nm) else torque_nm))
            plant.advance()
            rows.append(
                (
                    plant.angle_rad,
                    plant.velocity_rad_s,
                    plant.coupling_torque_nm,
                    plant.base_shear_n,
                    plant.sensed_torque_nm,
                    plant.sensed_shear_n,
                )
            )
            forces.append(plant.contact_forces_n)
        (
            self.angle, self.velocity, self.torque, self.shear,
            self.sensed_torque, self.sensed_shear,
        ) = np.array(rows).T  # fmt: skip
        self.forces = np.concatenate(forces)
        self.substeps = len(forces[0])


def started(*obstacles, **changes):
    """Record of the beam on the heavy motor."""
    ticks = round(SESSION_S / PERIOD_S)
    torques = np.where(np.arange(ticks) * PERIOD_S < START_S - 1e-9, START_RAD_S2 * HEAVY_KG_M2, 0)
    return Record(rig_with(*obstacles, inertia_kg_m2=HEAVY_KG_M2, **changes), torques)


class ReferenceSolution:
    """Kernels of the exact beam for a force at a position, by inversion along a shifted line."""

    def __init__(self, at_m, step_s):
        self.points = round(SESSION_S / step_s)
        padded = 1 << (4 * self.points).bit_length()
        shift = 26 / (padded * step_s)  # what wraps round has decayed to exp(-26)
        s = shift + 2j * np.pi * np.fft.rfftfreq(padded, step_s)
        growth = np.exp(shift * step_s * np.arange(padded))
        grid = PointForceGrid(s, BEAM, DAMPING)

        def in_time(spectrum):
            return (np.fft.irfft(spectrum, padded) * growth / step_s)[: self.points]

        angle = START_RAD_S2 * (1 - np.exp(-s * START_S)) / s**3
        self.free = in_time(grid.displacement_per_angle(at_m) * angle)
        self.torque = in_time(grid.torque_per_angle() * angle)
        self.shear = in_time(grid.shear_per_angle() * angle)
        # Of a force that goes from 0 to 1 N and back within two steps.
        hat = (1 - np.exp(-s * step_s)) ** 2 / (s**2 * step_s)
        self.by_force = in_time(grid.displacement_per_force(at_m, at_m) * hat)
        self.torque_by_force = in_time(grid.torque_per_force(at_m) * hat)
        self.shear_by_force = in_time(grid.shear_per_force(at_m) * hat)
        self.surface = TOUCH_RAD * at_m

    def solve(self, stiffness):
        """Force, torque and shear at each point."""
        motion, force = self.free.copy(), np.zeros(self.points)
        for j in range(1, self.points):
            inside = motion[j] - self.surface
            if inside > 0:
                force[j] = -stiffness * inside / (1 + stiffness * self.by_force[1])
                motion[j:] += force[j] * self.by_force[1 : self.points - j + 1]
        return (
            force,
            self.torque + self._of(force, self.torque_by_force),
            self.shear + self._of(force, self.shear_by_force),
        )

    def _of(self, force, kernel):
        length = 2 * self.points
        spectrum = np.fft.rfft(force, length) * np.fft.rfft(kernel, length)
        return np.fft.irfft(spectrum, length)[1 : self.points + 1]


reference_solution = cache(ReferenceSolution)


@pytest.mark.parametrize("stiffness", [further(100.0), 3000.0, further(100_000.0)])
@pytest.mark.parametrize("at_m", [further(0.1), 0.4, further(0.7), further(0.97)])
def test_force_torque_and_shear_of_a_touch(at_m, stiffness):
    fine_s = FINE_S[stiffness]
    force, torque, shear = reference_solution(at_m, fine_s).solve(stiffness)
    record = started(f"x={at_m},angle={TOUCH_RAD},stiffness={stiffness}")
    peak = np.abs(force).max()
    assert np.abs(record.forces).max() == pytest.approx(peak, rel=0.01)

    # The plant returns the mean over each substep.
    times = np.arange(force.size) * fine_s
    impulse = np.append(0.0, np.cumsum((force[1:] + force[:-1]) / 2 * fine_s))
    step_s = PERIOD_S / record.substeps
    edges = np.arange(record.forces.size - record.substeps + 1) * step_s
    mean = np.diff(np.interp(edges, times, impulse)) / step_s
    assert np.abs(record.forces[: mean.size, 0] - mean).max() < 0.01 * peak

    ticks = np.round(np.arange(1, record.torque.size) * PERIOD_S / fine_s).astype(int)
    for ours, theirs in ((record.torque, torque), (record.shear, shear)):
        assert np.abs(ours[:-1] - theirs[ticks]).max() < 0.005 * np.abs(theirs).max()


def test_the_beam_bounces():
    record = started(f"x=0.7,angle={TOUCH_RAD},stiffness=3000")
    touching = record.forces[:, 0] < 0
    breaks = np.count_nonzero(touching[:-1] & ~touching[1:])
    assert breaks >= 3
    assert 0.02 < touching.mean() < 0.3
    assert record.forces.max() <= 0


def test_an_obstacle_on_the_other_side_is_the_mirror_image():
    record = started(f"x=0.6,angle={TOUCH_RAD},stiffness=3000")
    ticks = record.angle.size
    torques = np.where(np.arange(ticks) < 50, -START_RAD_S2 * HEAVY_KG_M2, 0)
    mirrored = Record(
        rig_with(f"x=0.6,angle=-{TOUCH_RAD},stiffness=3000", inertia_kg_m2=HEAVY_KG_M2), torques
    )
    assert mirrored.forces == pytest.approx(-record.forces, abs=1e-9)
    assert mirrored.torque == pytest.approx(-record.torque, abs=1e-9)


@pytest.mark.parametrize("stiffness", ["300", further("100000"), "rigid"])
@pytest.mark.parametrize("at_m", [further(0.2), 0.62, further(0.97)])
def test_rest_against_an_obstacle(at_m, stiffness):
    # Stiff damping, so that it rests soon; the heavy motor is at rest at any angle.
    rig = rig_with(
        f"x={at_m},angle=0.01,stiffness={stiffness}",
        inertia_kg_m2=HEAVY_KG_M2,
        damping=Damping(zeta=0.05),
    )
    push = START_RAD_S2 * HEAVY_KG_M2
    record = Record(rig, [push] * 40 + [0.0] * 20 + [-push] * 40 + [0.0] * 500)
    yielding = np.inf if stiffness == "rigid" else float(stiffness)
    expected = pressing_force_n(BEAM, at_m, record.angle[-1] - 0.01, yielding)
    assert expected > 0.01
    assert record.forces[-1, 0] == pytest.approx(-expected, rel=2e-3)
    assert record.torque[-1] == pytest.approx(at_m * expected, rel=2e-3)
    assert record.shear[-1] == pytest.approx(expected, rel=2e-3)
    assert record.sensed_torque[-1] == pytest.approx(record.torque[-1])
    assert record.sensed_shear[-1] == pytest.approx(record.shear[-1])


@pytest.mark.parametrize("stiffness", [further("300"), further("30000"), "rigid"])
@pytest.mark.parametrize("damping", [further(Damping()), DAMPING], ids=["undamped", "paper"])
def test_no_touch_creates_energy(damping, stiffness):
    # A motor without friction drives the beam from one wall to the other and back, then tries to
    # extract all the energy.
    rig = rig_with(
        f"x=0.5,angle=0.06,stiffness={stiffness}",
        f"x=0.8,angle=-0.04,side=-1,stiffness={stiffness}",
        damping=damping,
    )
    pushes = np.repeat(np.random.default_rng(0).uniform(-0.1, 0.1, 10), 40)
    record = Record(
        rig, [*pushes, *[lambda plant: -0.02 * np.sign(plant.velocity_rad_s)] * 200, *[0.0] * 200]
    )
    torques = np.zeros(record.angle.size)
    torques[:400] = pushes
    torques[400:600] = -0.02 * np.sign(record.velocity[399:599])
    work_j = np.cumsum(torques * np.diff(record.angle, prepend=0.0))
    assert (record.forces < 0).any()
    assert (record.forces > 0).any()
    moving_j = 0.5 * rig.motor.inertia_kg_m2 * record.velocity**2
    # The remainder is in the beam, in the obstacles, or dissipated.
    assert (work_j - moving_j).min() > -1e-3 * np.abs(work_j).max()


# In steps of a picometre: the smallest floats have no digits to compare.
DEPTHS_M = st.integers(-(10**10), 10**10).map(lambda picometres: 1e-12 * picometres)


@given(
    a=DEPTHS_M,
    p=DEPTHS_M,
    stiffness=st.floats(1.0, 1e9),
    damping=st.one_of(st.just(0.0), st.floats(0.0, 1e8)),
    compliance=st.floats(1e-9, 1e-2),
)
def test_a_substep_takes_the_energy_stored_in_the_obstacle(a, p, stiffness, damping, compliance):
    wall = _ActiveObstacle(0, 1, stiffness, damping, compliance, np.zeros(1), a, np.zeros(1))
    push, q = wall.force_and_penetration(p)
    assert push >= 0
    assert q == pytest.approx(p - compliance * push, abs=1e-9 * (abs(a) + abs(p)))
    held = [0.5 * stiffness * max(0.0, inside) ** 2 for inside in (a, q)]
    lost = push * (q - a) - (held[1] - held[0])
    size = max(held[0], held[1], push * (abs(q) + abs(a)), stiffness * a * a)
    assert lost >= -1e-6 * size
    if damping == 0 and stiffness * compliance < 1e-5 and max(p, q) > 0:
        assert lost <= 1e-4 * size  # a spring that the substeps resolve loses none


def test_an_impact_is_half_a_sine_at_its_instant():
    rig = rig_with("x=0.5,force=2,duration=0.02,at=0.0305", inertia_kg_m2=HEAVY_KG_M2)
    record = Record(rig, np.zeros(80))
    step_s = PERIOD_S / record.substeps
    middle_s = (np.arange(record.forces.size) + 0.5) * step_s
    inside = (middle_s > 0.0305) & (middle_s < 0.0505)
    pulse = np.where(inside, 2 * np.sin(np.pi * (middle_s - 0.0305) / 0.02), 0.0)
    assert record.forces[:, 0] == pytest.approx(pulse, abs=0.01)
    s = 1j * 2 * np.pi * np.fft.rfftfreq(1 << 15, 1e-4) + 8.0
    spectrum = np.exp(-0.0305 * s) * (1 + np.exp(-0.02 * s)) * 2 * (np.pi / 0.02)
    spectrum /= s**2 + (np.pi / 0.02) ** 2
    grid = PointForceGrid(s, BEAM, DAMPING)
    times_s = np.arange(1 << 15) * 1e-4
    for ours, per_force in (
        (record.torque, grid.torque_per_force(0.5)),
        (record.shear, grid.shear_per_force(0.5)),
    ):
        exact = np.fft.irfft(spectrum * per_force) * 1e4 * np.exp(8.0 * times_s)
        assert np.abs(ours[:-1] - exact[10:800:10]).max() < 0.01 * np.abs(exact[:800]).max()


def test_an_obstacle_comes_and_goes():
    touched = started(f"x=0.5,angle={TOUCH_RAD},stiffness=1000")
    late = started(f"x=0.5,angle={TOUCH_RAD},stiffness=1000,from=0.14")
    short = started(f"x=0.5,angle={TOUCH_RAD},stiffness=1000,until=0.14")
    before = 140 * touched.substeps
    assert (touched.forces[:before] < 0).any()
    assert (late.forces[:before] == 0).all()
    assert late.forces[before] < -1  # the beam is in its way
    assert short.forces[:before] == pytest.approx(touched.forces[:before])
    assert (short.forces[before:] == 0).all()


def test_a_moving_obstacle_strikes_a_beam_at_rest():
    # In the frame of the obstacle the beam moves: the same force as for a beam thrown at it.
    record = Record(
        rig_with("x=0.6,angle=0.02,side=1,rate=-0.5,stiffness=3000", inertia_kg_m2=HEAVY_KG_M2),
        np.zeros(100),
    )
    first = np.flatnonzero(record.forces)[0]
    assert first / record.substeps * PERIOD_S == pytest.approx(0.04, abs=2e-4)
    assert record.forces.min() < -0.1


def test_several_obstacles_are_independent_until_waves_meet():
    # Distance 30 cm: the beam's own waves of a kHz take 3 ms from one to the other.
    alone = started(f"x=0.9,angle={TOUCH_RAD},stiffness=1000")
    both = started(
        f"x=0.9,angle={TOUCH_RAD},stiffness=1000", f"x=0.3,angle={TOUCH_RAD},stiffness=1000"
    )
    assert (both.forces[:, 1] < 0).any()
    first = np.flatnonzero(both.forces.any(axis=1))[0]
    assert alone.forces[: first + 1] == pytest.approx(both.forces[: first + 1, :1], abs=1e-9)
    assert np.abs(both.forces[:, :1] - alone.forces).max() > 0.01


def test_friction_holds_a_gently_pushed_shaft():
    rig = rig_with("x=0.5,force=0.02,duration=0.2,at=0.05", coulomb_nm=0.03)
    held = Record(rig, np.zeros(300))
    assert (held.angle == 0).all()
    assert np.abs(held.torque).max() > 0.005
    loose = Record(replace(rig, motor=replace(rig.motor, coulomb_nm=0.0)), np.zeros(300))
    assert loose.angle[-1] > 0.01
    pushed = Record(
        rig_with("x=0.5,force=0.5,duration=0.2,at=0.05", coulomb_nm=0.03), np.zeros(300)
    )
    assert pushed.angle[-1] > 0.01


def test_far_from_an_obstacle_nothing_changes():
    ticks = 300
    torques = 0.05 * np.sin(0.05 * np.arange(ticks))
    free = SimulatedPlant(rig_with())
    free.enable()
    record = Record(rig_with("x=0.5,angle=3,stiffness=3000"), torques)
    for tick in range(ticks):
        free.command(float(torques[tick]))
        free.advance()
        assert record.angle[tick] == pytest.approx(free.angle_rad, rel=1e-9, abs=1e-12)
        assert record.shear[tick] == pytest.approx(free.base_shear_n, rel=1e-9, abs=1e-12)
    assert (record.forces == 0).all()


@pytest.mark.parametrize("delay_s", [further(0.0), 0.3e-3, further(1.4e-3)])
def test_the_sensor_measures_a_touch_with_its_delay(delay_s):
    prompt = started(f"x=0.6,angle={TOUCH_RAD},stiffness=300")
    late = started(
        f"x=0.6,angle={TOUCH_RAD},stiffness=300", sensor=replace(RIG.sensor, delay_s=delay_s)
    )
    times = (np.arange(prompt.torque.size) + 1) * PERIOD_S
    # Ten times as often: what the torque was then, between two ticks.
    fine = Record(
        replace(
            rig_with(f"x=0.6,angle={TOUCH_RAD},stiffness=300", inertia_kg_m2=HEAVY_KG_M2),
            rate_hz=10_000.0,
        ),
        np.where(np.arange(1600) < 500, START_RAD_S2 * HEAVY_KG_M2, 0.0),
    )
    fine_times = (np.arange(1600) + 1) * 1e-4
    for name in ("torque", "shear"):
        expected = np.interp(times - delay_s, fine_times, getattr(fine, name), left=0.0)
        seen = getattr(late, f"sensed_{name}")
        scale = np.abs(expected).max()
        # Except jumps of the motor's own torque.
        off_jumps = np.abs(times - delay_s - START_S) > 2e-3
        assert np.abs(seen - expected)[off_jumps & (times > 3e-3)].max() < 0.02 * scale


@pytest.mark.parametrize(
    ("simulation", "key"),
    [
        ({"tip_mass_kg": 1e-3}, "tip_mass_kg"),
        ({"clamp_compliance_rad_per_nm": 1e-3}, "clamp_compliance_rad_per_nm"),
        ({"air_drag_m": 2e-3}, "air_drag_m"),
        ({"torque_filter_hz": 100.0}, "torque_filter_hz"),
        ({"stiffness_drift_per_s": -1e-5}, "stiffness_drift_per_s"),
    ],
)
def test_unsupported_combinations_are_refused(simulation, key):
    rig = rig_with("x=0.5,angle=0.1")
    with pytest.raises(ObstacleError, match=key):
        SimulatedPlant(replace(rig, simulation=replace(rig.simulation, **simulation)))


def test_an_obstacle_beyond_the_tip_is_refused():
    with pytest.raises(ObstacleError, match="beyond the tip"):
        SimulatedPlant(rig_with("x=0.99,angle=0.1"))
