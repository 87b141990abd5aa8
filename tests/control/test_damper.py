"""Active damping: its effect on several beams, and its recursion."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import poles
from rigd.control import close_loop
from rigd.control.damper import VibrationDamper, damped_poles, design_damper
from rigd.profile import load_profile


@pytest.fixture(scope="module", params=["sim", "antenna_can", "antenna_serial"])
def model(request):
    return load_profile(request.param).loop_model()


def ratios(model, settings, stiffness):
    beam = model.plant.beam
    beam = replace(beam, bending_stiffness_n_m2=stiffness * beam.bending_stiffness_n_m2)
    loop = close_loop(replace(model, plant=replace(model.plant, beam=beam)))
    found = loop.poles_rad_s if settings is None else damped_poles(loop, settings)
    modes = [found[np.argmin(np.abs(found - s))] for s in poles(beam, model.plant.damping, 3)[:, 0]]
    return np.array([-s.real / abs(s) for s in modes]), found


@pytest.mark.parametrize("stiffness", [0.5, 0.8, 1.0, 1.25, 2.0])
def test_damping_of_a_beam_unlike_the_profile(model, stiffness):
    settings = design_damper(close_loop(model))
    without, _ = ratios(model, None, stiffness)
    damped, found = ratios(model, settings, stiffness)
    assert damped[0] > 0.06 > 5 * without[0]
    assert damped[1] > 1.3 * without[1]
    # The third mode has damping of its own, which may be reduced a little.
    assert damped[2] > without[2] - 0.004
    assert found.real.max() < 0.0


def test_a_delayed_torque_weakens_the_damper(model):
    prompt = design_damper(close_loop(model))
    old = design_damper(close_loop(replace(model, torque_delay_s=0.02)))
    assert old is None or old.gain_rad_per_nm_s < prompt.gain_rad_per_nm_s


def test_no_damper_without_a_beam(model):
    assert design_damper(close_loop(replace(model, plant=None))) is None


def test_the_recursion_gives_the_designed_poles(model):
    """Simulated with the damper, the first mode of the closed loop decays as computed."""
    settings = design_damper(close_loop(model))
    loop = close_loop(model)
    reading = next(
        opening.reading_row for opening in loop.openings if opening.name == "torque reading"
    )
    damper = VibrationDamper(settings, model.rate_hz)
    state, torques = np.zeros(loop.b.size), []
    for tick in range(2500):
        # A push that excites the first mode, then none.
        pushed = 0.01 * np.sin(2 * np.pi * 2.57 * tick / model.rate_hz) if tick < 800 else 0.0
        torques.append(reading @ state)
        state = loop.a @ state + loop.b * (pushed + damper.step(torques[-1]))
    modes = damped_poles(loop, settings)
    first = modes[np.argmin(np.abs(modes - poles(model.plant.beam, model.plant.damping, 1)[0, 0]))]
    period = round(model.rate_hz * 2 * np.pi / first.imag)
    spans = [np.ptp(torques[start : start + period]) for start in (900, 900 + 2 * period)]
    expected = np.exp(first.real * 2 * period / model.rate_hz)
    assert spans[1] / spans[0] == pytest.approx(expected, rel=0.25)


def test_a_steady_torque_does_not_move_the_motor(model):
    damper = VibrationDamper(design_damper(close_loop(model)), model.rate_hz)
    moved = [damper.step(0.01) for _ in range(6000)]
    assert abs(moved[-1]) < 1e-6
