"""A simulated beam whose stiffness drifts, against plants without drift and modal equations."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further
from scipy.integrate import solve_ivp
from shipped_profile import load_shipped

from rigd.beam import Beam, Damping, clamped_free_eigenvalues
from rigd.beam.realisation import RealisationError, realise
from rigd.sim import SimulatedPlant

RATE_HZ = 1000.0
LARGEST_DRIFT = 0.05
"""Fraction of the stiffness at which a drift ends."""
FASTEST = 1e-3
STATE = (
    "angle_rad", "velocity_rad_s", "coupling_torque_nm", "base_shear_n",
    "sensed_angle_rad", "sensed_torque_nm", "sensed_shear_n",
)  # fmt: skip


@pytest.fixture(scope="module")
def rig():
    rig = load_shipped("sim").rig
    return replace(rig, motor=replace(rig.motor, coulomb_nm=0.0))


def plant_of(rig, **more):
    return SimulatedPlant(replace(rig, simulation=replace(rig.simulation, **more)))


def run(plant, torques):
    """State at each tick, before its command: shape (ticks, 7)."""
    record = np.empty((len(torques), len(STATE)))
    for tick, torque in enumerate(np.asarray(torques).tolist()):
        record[tick] = [getattr(plant, name) for name in STATE]
        plant.command(torque)
        plant.advance()
    return record


def noise(ticks, level=0.1):
    return level * np.random.default_rng(0).standard_normal(ticks)


def poles(step, states):
    """Poles of a step's matrix that oscillate, are not aliased and decay slowly."""
    found = np.log(np.linalg.eigvals(step[:states, :states]).astype(complex)) * RATE_HZ
    slow = (np.abs(found.imag) < 2 * np.pi * 100) & (-found.real < 0.1 * found.imag)
    return np.sort_complex(found[slow] * -1j)


BARE = (None, {})
TIP_MASS = (None, {"tip_mass_kg": 2e-4, "stiffness_ratio": 1.1})
CLAMP = (None, {"clamp_compliance_rad_per_nm": 0.02})
FILTER = (None, {"torque_filter_hz": 80.0, "torque_filter_order": 2})
DAMPED = (Damping(9e-6, 1.36, 0.2, 0.6), {})
# The seventh mode oscillates only if the stiffness falls.
OVER_DAMPED = (Damping(zeta=1.075e-3), {})


@pytest.mark.parametrize(
    ("damping", "more", "rate"),
    [
        *((*rig, FASTEST) for rig in (TIP_MASS, CLAMP, FILTER)),
        (*OVER_DAMPED, -FASTEST),
        *(further(*rig, FASTEST) for rig in (BARE, DAMPED, OVER_DAMPED)),
        *(further(*rig, -FASTEST) for rig in (BARE, TIP_MASS, CLAMP, FILTER, DAMPED)),
    ],
)
def test_poles_are_those_of_the_stiffness_at_each_time(rig, damping, more, rate):
    rig = rig if damping is None else replace(rig, damping=damping)
    plant = plant_of(rig, **more, stiffness_drift_per_s=rate)
    for time_s in (0.0, 11.0, 44.0, 50.0, 60.0):
        periods = round(time_s * RATE_HZ)
        changed = plant._drift.refresh_if_due(periods)
        assert changed == (time_s < 60)
        seconds = min(time_s + 0.01, LARGEST_DRIFT / FASTEST)  # a matrix is in use for 0.02 s
        ratio = more.get("stiffness_ratio", 1.0) * (1 + rate * seconds)
        exact = plant_of(rig, **(more | {"stiffness_ratio": ratio}))
        for now, then in (
            (plant._free_step, exact._free_step),
            (plant._locked_step, exact._locked_step),
        ):
            found, expected = (
                poles(each.__self__, which._state_count)
                for each, which in ((now, plant), (then, exact))
            )
            assert found.real == pytest.approx(expected.real, rel=1e-6)
            assert found.imag == pytest.approx(expected.imag, rel=1e-4)


@pytest.mark.parametrize("sign", [further(1), -1])
def test_the_beam_has_the_final_stiffness_after_the_drift(rig, sign):
    rig = replace(rig, motor=replace(rig.motor, coulomb_nm=0.03))
    torques = noise(2000, 0.2)
    drifted = plant_of(rig, stiffness_drift_per_s=sign * FASTEST)
    drifted.enable()
    drifted.advance(60_000)
    exact = plant_of(rig, stiffness_ratio=1 + sign * LARGEST_DRIFT)
    exact.enable()
    found, expected = run(drifted, torques), run(exact, torques)
    assert np.abs(found - expected).max(axis=0) == pytest.approx(
        0.0, abs=1e-7 * np.abs(expected).max()
    )


def test_the_drift_begins_at_the_first_enabling(rig):
    once, twice = (plant_of(rig, stiffness_drift_per_s=FASTEST) for _ in range(2))
    once.advance(5000)
    for plant in (once, twice):
        plant.enable()
    torques = noise(3000)
    assert np.array_equal(run(once, torques), run(twice, torques))
    for plant in (once, twice):
        plant.disable()
        plant.advance(1000)
        plant.enable()
    usual = plant_of(rig)
    usual.enable()
    run(usual, torques)
    usual.disable()
    usual.advance(1000)
    usual.enable()
    difference = run(twice, torques) - run(usual, torques)
    assert np.abs(difference[:, 2]).max() > 1e-3 * 0.1


def test_a_drift_that_cannot_be_realised_is_refused(rig, monkeypatch):
    def realised(plant, **more):
        if plant.beam.bending_stiffness_n_m2 < 0.97 * rig.beam.bending_stiffness_n_m2:
            raise RealisationError("Too soft.")
        return realise(plant, **more)

    monkeypatch.setattr("rigd.sim._step.realise", realised)
    plant_of(rig, stiffness_drift_per_s=FASTEST)
    with pytest.raises(RealisationError, match=r"stiffness_drift_per_s.*Too soft"):
        plant_of(rig, stiffness_drift_per_s=-FASTEST)


def test_a_negligible_drift_is_no_drift(rig):
    torques = noise(3000)
    found = []
    for rate in (0.0, 1e-12):
        plant = plant_of(rig, stiffness_drift_per_s=rate)
        plant.enable()
        found.append(run(plant, torques))
    none, hardly = found
    assert np.abs(hardly - none).max(axis=0) == pytest.approx(0.0, abs=1e-8 * np.abs(none).max())


def test_sliding_friction_is_a_constant_torque(rig):
    rubbed = replace(rig, motor=replace(rig.motor, coulomb_nm=0.03))
    found = []
    for each, torque_nm in ((rubbed, 0.10), (rig, 0.07)):
        plant = plant_of(each, stiffness_drift_per_s=-FASTEST)
        plant.enable()
        found.append(run(plant, [torque_nm] * 300))
    # Except the tick at which the matrix is renewed: one in twenty.
    sliding, net = found
    assert np.abs(sliding - net).max(axis=0) == pytest.approx(0.0, abs=1e-6 * np.abs(net).max())


# Modal equations of a beam with Kelvin-Voigt damping, integrated in time

BEAM = Beam(0.98, 4.7e-3, 0.090275)
ZETA_S = 1e-4
MODES = 6
EIGENVALUES = clamped_free_eigenvalues(MODES)
OMEGA_RAD_S = (EIGENVALUES / BEAM.length_m) ** 2 / BEAM.density_over_stiffness**0.5
INERTIAS_KG_M2 = 4 * BEAM.density_kg_per_m * BEAM.length_m**3 / EIGENVALUES**4


def kelvin_voigt(rig, **motor):
    return replace(rig, beam=BEAM, damping=Damping(zeta=ZETA_S), motor=replace(rig.motor, **motor))


@pytest.mark.parametrize("rate", [FASTEST, further(-FASTEST)])
def test_motion_follows_the_modal_equations(rig, rate):
    rig = kelvin_voigt(rig)
    rig = replace(rig, actuation=replace(rig.actuation, delay_s=0.0))
    plant = plant_of(rig, stiffness_drift_per_s=rate)
    plant.enable()
    ticks = 1000
    t = np.arange(ticks) / RATE_HZ
    torques = 0.1 * np.hanning(ticks) * np.sin(2 * np.pi * (1.0 + 9.0 * t) * t)
    found = run(plant, torques)

    motor, tool = rig.motor, rig.sensor.tool_inertia_kg_m2
    rigid = BEAM.inertia_kg_m2 + tool
    # q'' + (1 + rate t) omega² (q + zeta q') = -θ'';  J θ'' + b θ' = τ - rigid θ'' - Σ m q''
    alone = motor.inertia_kg_m2 + rigid - INERTIAS_KG_M2.sum()

    def slope(time_s, state, torque_nm):
        q, q_rate, speed = state[:MODES], state[MODES:-2], state[-1]
        pull = (1 + rate * time_s) * OMEGA_RAD_S**2 * (q + ZETA_S * q_rate)
        turn = (torque_nm - motor.viscous_nm_s_per_rad * speed + INERTIAS_KG_M2 @ pull) / alone
        seen = torque_nm - motor.viscous_nm_s_per_rad * speed - motor.inertia_kg_m2 * turn
        return np.concatenate([q_rate, -pull - turn, [speed, turn]]), seen

    state, steps = np.zeros(2 * MODES + 2), 5
    h = 1 / RATE_HZ / steps
    expected = np.empty((ticks, 2))
    for tick, torque_nm in enumerate(torques.tolist()):
        before = torques[max(tick - 1, 0)]  # at a jump the plant returns the value just before
        expected[tick] = state[-2], slope(t[tick], state, before)[1]
        for step in range(steps):
            now = t[tick] + step * h
            a = slope(now, state, torque_nm)[0]
            b = slope(now + h / 2, state + h / 2 * a, torque_nm)[0]
            c = slope(now + h / 2, state + h / 2 * b, torque_nm)[0]
            d = slope(now + h, state + h * c, torque_nm)[0]
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
    for column, name in enumerate(("angle_rad", "coupling_torque_nm")):
        seen = found[:, STATE.index(name)]
        # Without drift the angle would be another by a thousandth, the torque by more.
        assert np.std(seen - expected[:, column]) < 5e-5 * np.std(seen)


@pytest.mark.parametrize("rate", [FASTEST, further(-FASTEST)])
def test_a_locked_beam_rings_as_the_modal_equations(rig, rate):
    rig = kelvin_voigt(rig, coulomb_nm=0.1)
    plant = plant_of(rig, stiffness_drift_per_s=rate)
    plant.enable()
    run(plant, [0.3] * 60 + [-0.3] * 30)
    record = run(plant, [0.0] * 4500)
    first = np.flatnonzero(record[:, 1])[-1] + 2000  # the higher modes have decayed
    assert first < 3000
    torque = record[first:, STATE.index("coupling_torque_nm")]
    assert np.abs(torque).max() > 1e-3
    start_s = (90 + first) / RATE_HZ
    t = start_s + np.arange(torque.size) / RATE_HZ
    columns = []
    for omega in OMEGA_RAD_S[:3].tolist():

        def slope(time_s, state, omega=omega):
            pull = (1 + rate * time_s) * omega**2 * (state[0] + ZETA_S * state[1])
            return [state[1], -pull]

        for begin in ([1 / omega, 0.0], [0.0, 1.0]):
            q, q_rate = solve_ivp(
                slope, (t[0], t[-1]), begin, t_eval=t, method="DOP853", rtol=1e-9, atol=1e-12
            ).y
            columns.append((1 + rate * t) * (q + ZETA_S * q_rate))
    left = torque - np.array(columns).T @ np.linalg.lstsq(np.array(columns).T, torque)[0]
    assert np.std(left) < 2e-5 * np.std(torque)
