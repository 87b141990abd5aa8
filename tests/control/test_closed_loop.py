"""The computed closed loop against simulations with other algebra."""

import itertools
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.beam import Damping
from rigd.beam.realisation import couple, propagator, realise
from rigd.control import (
    ControlDesignError,
    PidController,
    check_stability,
    close_loop,
    design_pid,
)
from rigd.excitation import chirp, multisine

SUBSTEPS = 8


def run_tick_by_tick(model, reference_rad, torque_limit_nm=math.inf):
    """PidController against the coupled propagator; delays are whole eighths of a period.

    Returns angle, torque command and sensor torque at the ticks, friction left out of the plant.
    """
    coupled = couple(
        None if model.plant is None else realise(model.plant),
        motor_inertia_kg_m2=model.motor_inertia_kg_m2,
        viscous_nm_s_per_rad=model.viscous_nm_s_per_rad,
        tool_inertia_kg_m2=0.0 if model.plant is None else model.plant.tool_inertia_kg_m2,
    )
    phi, gamma = propagator(coupled, 1 / model.rate_hz / SUBSTEPS)
    gains = design_pid(
        model.motor_inertia_kg_m2, model.viscous_nm_s_per_rad, model.settings.pole_rad_s
    )
    controller = PidController(gains, model.settings, model.rate_hz, torque_limit_nm)
    actuation, angle_age, torque_age = (
        round(delay * model.rate_hz * SUBSTEPS)
        for delay in (model.actuation_delay_s, model.angle_delay_s, model.torque_delay_s)
    )
    before = max(angle_age, torque_age)
    moments = len(reference_rad) * SUBSTEPS
    angles, sensed = np.zeros(before + moments), np.zeros(before + moments)
    torques = np.zeros(len(reference_rad))
    x, applied = np.zeros(coupled.b.size), 0.0
    for moment in range(moments):
        angles[before + moment] = coupled.angle_output_row @ x
        sensed[before + moment] = (
            coupled.sensor_torque_output_row @ x + coupled.sensor_torque_per_torque * applied
        )
        tick, part = divmod(moment, SUBSTEPS)
        if part == 0:
            torques[tick] = controller.step(
                reference_rad[tick],
                angles[before + moment - angle_age],
                sensed[before + moment - torque_age],
            )
        sent = (moment - actuation) // SUBSTEPS
        # The plant has no friction: the compensation of the controller does not act.
        applied = torques[sent] if sent >= 0 else 0.0
        x = phi @ x + gamma * applied
    return angles[before::SUBSTEPS], torques, sensed[before::SUBSTEPS]


def damped(model, damping):
    return replace(model, plant=replace(model.plant, damping=damping))


def without_friction(model):
    return replace(model, settings=replace(model.settings, friction_compensation_nm=0.0))


def changed(model, change):
    """Change fields of the model, or of its controller's settings."""
    if change.keys() <= {field.name for field in fields(model)}:
        return replace(model, **change)
    return replace(model, settings=replace(model.settings, **change))


@pytest.mark.parametrize("pole_rad_s", [40.0, 80.0])
def test_step_of_the_motor_alone_is_the_designed_one(motor_alone, pole_rad_s):
    model = replace(motor_alone, settings=replace(motor_alone.settings, pole_rad_s=pole_rad_s))
    angle, _, _ = run_tick_by_tick(without_friction(model), np.ones(500))
    t = np.arange(500) / model.rate_hz
    ideal = 1 - (1 + pole_rad_s * t) * np.exp(-pole_rad_s * t)
    assert np.max(np.abs(angle - ideal)) < 0.02


def test_beam_and_delay_follow_the_computed_loop(loop_model):
    model = without_friction(loop_model)
    reference = chirp(rate_hz=1000.0, duration_s=2.5, rest_s=0.1, ring_down_s=0.4).reference_rad
    angle, torque, sensed = run_tick_by_tick(model, reference)
    computed = close_loop(model).simulate(reference)
    np.testing.assert_allclose(computed.angle_rad, angle, atol=1e-9 * np.max(np.abs(angle)))
    np.testing.assert_allclose(computed.torque_nm, torque, atol=1e-9 * np.max(np.abs(torque)))
    np.testing.assert_allclose(
        computed.coupling_torque_nm, sensed, atol=1e-9 * np.max(np.abs(sensed))
    )


def test_chunks_of_a_long_response_are_those_of_the_whole(loop_model):
    reference = np.sin(2 * np.pi * 3.0 * np.arange(300_000) / 1000.0)
    loop = close_loop(loop_model)
    whole, chunks = loop.simulate(reference), list(loop.simulate_in_chunks(reference))
    assert len(chunks) == 2
    for name in ("angle_rad", "velocity_rad_s", "torque_nm", "coupling_torque_nm"):
        joined = np.concatenate([getattr(chunk, name) for chunk in chunks])
        np.testing.assert_array_equal(joined, getattr(whole, name))
    # The chunks join without a jump: the motion stays that of one sine.
    late = whole.angle_rad[260_000:264_000]
    np.testing.assert_allclose(late[3000:], late[:1000], atol=1e-6)


@settings(max_examples=6)
@given(
    actuation=st.integers(0, 20),
    angle=st.integers(0, 18),
    torque=st.integers(0, 18),
    tool=st.sampled_from([0.0, 1e-5]),
)
def test_delays_of_any_fraction_of_a_period(loop_model, actuation, angle, torque, tool):
    eighth_s = 1 / loop_model.rate_hz / SUBSTEPS
    model = replace(
        without_friction(loop_model),
        actuation_delay_s=actuation * eighth_s,
        angle_delay_s=angle * eighth_s,
        torque_delay_s=torque * eighth_s,
        plant=replace(loop_model.plant, tool_inertia_kg_m2=tool),
    )
    reference = np.random.default_rng(1).normal(size=200) * 1e-2
    truth = run_tick_by_tick(model, reference)
    computed = close_loop(model).simulate(reference)
    for ours, theirs in zip(
        (computed.angle_rad, computed.torque_nm, computed.coupling_torque_nm), truth, strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.max(np.abs(theirs)))


def test_friction_compensation_is_part_of_the_predicted_torque(loop_model):
    reference = chirp(rate_hz=1000.0, duration_s=2.0, rest_s=0.1, ring_down_s=0.1).reference_rad
    with_it = close_loop(loop_model).simulate(reference)
    without = close_loop(without_friction(loop_model)).simulate(reference)
    gains = design_pid(2e-3, 0.02, 80.0)
    controller = PidController(gains, loop_model.settings, 1000.0, math.inf)
    for tick, value in enumerate(reference):
        controller.step(value, 0.0, 0.0)
        difference = with_it.torque_nm[tick] - without.torque_nm[tick]
        assert difference == pytest.approx(controller.friction_nm, abs=1e-12)


def test_velocity_is_the_derivative_of_the_angle(loop_model):
    response = close_loop(loop_model).simulate(
        chirp(rate_hz=1000.0, duration_s=2.0, stop_hz=10.0).reference_rad
    )
    numeric = np.gradient(response.angle_rad, 1e-3)
    np.testing.assert_allclose(
        response.velocity_rad_s, numeric, atol=5e-3 * np.max(np.abs(numeric))
    )


@pytest.mark.parametrize("ticks", [1, 63, 64, 65, 4096 * 64 + 3])
def test_blocks_join_seamlessly(loop_model, ticks):
    loop = close_loop(loop_model)
    reference = np.zeros(ticks)
    reference[ticks // 3] = 1.0
    blockwise = loop.simulate(reference).angle_rad
    assert blockwise.shape == (ticks,)
    # An impulse has the same response wherever it falls.
    shifted = loop.simulate(np.concatenate([reference[ticks // 3 :], np.zeros(64)])).angle_rad
    rest = blockwise[ticks // 3 :]
    np.testing.assert_allclose(rest, shifted[: rest.size], atol=1e-12)


def test_paper_chirp_follows_the_design_below_8_hz(loop_model):
    """Within 5 % of the amplitude, sample by sample, against the exact filtered chirp."""
    excitation = chirp(rate_hz=1000.0)
    first, end = excitation.segments["sweep"]
    loop = close_loop(loop_model)
    angle = loop.simulate(excitation.reference_rad).angle_rad
    at_8_hz = first + int(1000 * 120 * (8 - 0.05) / (50 - 0.05))
    # 1/(1 + s/p)² by two exact first-order steps on the continuous chirp, ten times finer.
    ideal = chirp(rate_hz=10_000.0).reference_rad[: 10 * at_8_hz]
    pole = loop_model.settings.pole_rad_s
    decay = math.exp(-pole * 1e-4)
    for _ in range(2):
        mean = 0.5 * (ideal + np.concatenate([[0.0], ideal[:-1]]))
        step = ((1 - decay) * mean).tolist()
        ideal = np.array(list(itertools.accumulate(step, lambda last, new: decay * last + new)))
    deviation = np.abs(angle[:at_8_hz] - ideal[::10])
    assert np.max(deviation) < 0.05 * 0.025
    frequency_hz = np.linspace(0.05, 8.0, 80)
    ratio = loop.response(frequency_hz) * (1 + 2j * np.pi * frequency_hz / pole) ** 2
    assert np.max(np.abs(ratio - 1)) < 0.05
    assert end == 121_000


def test_response_agrees_with_the_simulation(loop_model):
    """On a multisine's harmonics, over its last period, when transients have died out."""
    excitation = multisine(
        rate_hz=1000.0,
        period_s=4.0,
        duration_s=60.0,
        rest_s=0.0,
        ring_down_s=0.0,
        start_hz=1.0,
        stop_hz=40.0,
        seed=3,
    )
    loop = close_loop(loop_model)
    angle = loop.simulate(excitation.reference_rad).angle_rad
    harmonics = np.arange(4, 160, 7)
    output, reference = (
        np.fft.rfft(signal[-4000:])[harmonics] for signal in (angle, excitation.reference_rad)
    )
    np.testing.assert_allclose(output / reference, loop.response(harmonics / 4.0), rtol=2e-3)


def test_each_of_the_papers_sets_is_stable(loop_model, paper_damping):
    loop = close_loop(damped(loop_model, paper_damping))
    assert loop.spectral_radius < 1
    assert check_stability(loop) is None


@pytest.mark.parametrize("pole_rad_s", [40.0, 60.0, 80.0, 100.0])
def test_a_loop_without_feed_forward_is_refused(loop_model, paper_damping, pole_rad_s):
    change = {"feedforward_gain": 0.0, "pole_rad_s": pole_rad_s}
    loop = close_loop(changed(damped(loop_model, paper_damping), change))
    with pytest.raises(ControlDesignError, match=r"feedforward_gain = 0 .* set it to 1"):
        check_stability(loop)


def test_growth_without_feed_forward_is_real(loop_model):
    """The tick-by-tick loop grows after an impact at the rate that the design step computes."""
    change = {"feedforward_gain": 0.0, "pole_rad_s": 40.0}
    model = without_friction(changed(loop_model, change))
    loop = close_loop(model)
    assert loop.growth_per_s == pytest.approx(0.0547, abs=0.001)
    pole = loop.poles_rad_s[0]
    assert abs(pole.imag) / 2 / np.pi == pytest.approx(2.43, abs=0.01)
    impact = np.zeros(12_000)
    impact[0] = 0.1
    angle, _, _ = run_tick_by_tick(model, impact)
    early = np.max(np.abs(angle[4000:4824]))  # two periods of 2.43 Hz
    late = np.max(np.abs(angle[11_000:11_824]))
    assert math.log(late / early) / 7.0 == pytest.approx(loop.growth_per_s, rel=0.05)


@pytest.mark.parametrize(
    "change",
    [
        {"actuation_delay_s": 10e-3},
        {"angle_delay_s": 10e-3},
        {"feedforward_gain": 1.5},
        {"pole_rad_s": 600.0},
    ],
    ids=str,
)
def test_bad_designs_are_refused_with_numbers(loop_model, change):
    with pytest.raises(ControlDesignError, match=r"spectral radius 1\.\d+.* Hz with damping ratio"):
        check_stability(close_loop(changed(loop_model, change)))


@pytest.mark.parametrize(
    "change",
    [
        {"torque_delay_s": 5e-3},
        {"actuation_delay_s": 4e-3},
        {"feedforward_gain": 0.9},
        {"feedforward_gain": 1.2},
        {"pole_rad_s": 40.0},
        {"pole_rad_s": 100.0},
    ],
    ids=str,
)
def test_tolerable_designs_are_accepted(loop_model, change):
    assert check_stability(close_loop(changed(loop_model, change))) is None


def test_a_beam_with_almost_no_damping_gives_a_warning(loop_model):
    loop = close_loop(damped(loop_model, Damping(zeta=1e-6)))
    warning = check_stability(loop)
    assert warning is not None
    assert "2.55 Hz" in warning
    assert "almost no damping" in warning


def test_an_absurd_delay_is_refused(loop_model):
    with pytest.raises(ControlDesignError, match=r"encoder\.delay_s = 1 s is 1000 periods"):
        close_loop(replace(loop_model, angle_delay_s=1.0))


def test_no_endless_simulation_of_an_unstable_loop(loop_model):
    loop = close_loop(replace(loop_model, actuation_delay_s=20e-3))
    with (
        np.errstate(over="ignore", invalid="ignore"),
        pytest.raises(ControlDesignError, match="unstable"),
    ):
        loop.simulate(np.ones(200_000))
