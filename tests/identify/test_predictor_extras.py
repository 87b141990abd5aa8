"""Elastic clamp, tip mass, filters and clocks of different rates: predictions and unknowns."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import EXTRAS, SETTINGS, Plant
from analysis.identify._free_decay import mode_poles
from analysis.identify._parametrization import Unknowns
from analysis.identify._plant import LOGARITHMIC
from analysis.identify._predictor import Prediction
from analysis.models import STRUCTURES
from rigd.beam import PARAMETERS, Beam, Damping

BEAM = Beam(0.98, 4.7e-3, 0.090275)
BARE = Plant(BEAM, Damping(7.1e-5, 0.996, 5.5e-2, 0.594), 3e-4, 1e-5)
ALL = replace(
    BARE,
    root_compliance_rad_per_nm=0.01,
    tip_mass_kg=5e-5,
    filter_time_constant_s=5e-4,
    second_order_filter_time_constant_s=3e-4,
    clock_rate_difference=2e-4,
)
WRT = (*PARAMETERS, "delay_s", "tool_inertia_kg_m2", *EXTRAS)
STEPS = {
    "zeta": 1e-9,
    "tool_inertia_kg_m2": 1e-8,
    "tip_mass_kg": 1e-9,
    "clock_rate_difference": 1e-8,
    "root_compliance_rad_per_nm": 1e-6,
}


def moved(plant, name, step):
    beam, damping = plant.beam, plant.damping
    ratio, stiffness = beam.density_over_stiffness, beam.bending_stiffness_n_m2
    if name in ("ln_density_over_stiffness", "ln_stiffness"):
        if name == "ln_stiffness":
            stiffness *= np.exp(step)
        else:
            ratio *= np.exp(step)
        return replace(plant, beam=Beam(beam.length_m, ratio * stiffness, stiffness))
    attribute = {"lambda": "lambda_"}.get(name, name)
    if attribute in Damping.__slots__:
        value = getattr(damping, attribute) + step
        return replace(plant, damping=replace(damping, **{attribute: value}))
    return replace(plant, **{name: getattr(plant, name) + step})


@pytest.mark.parametrize("plant", [BARE, ALL], ids=["bare", "all"])
@pytest.mark.parametrize("name", WRT)
def test_derivatives(plant, name):
    angle = np.random.default_rng(1).normal(size=400)
    prediction = Prediction(angle, 125.0, slice(10, 390))
    _, gradient = prediction.torque(plant, WRT)
    step = STEPS.get(name, 1e-7)
    after, before = (prediction.torque(moved(plant, name, s), WRT)[0] for s in (step, -step))
    analytic = gradient[WRT.index(name)]
    assert np.abs((after - before) / (2 * step) - analytic).max() < 1e-5 * np.abs(analytic).max()


@pytest.mark.parametrize("plant", [BARE, ALL], ids=["bare", "all"])
def test_poles_move_as_differences_say(plant):
    for i, pole in enumerate(mode_poles(plant, 3, WRT)):
        for name, derivative in zip(WRT, pole.derivative, strict=True):
            step = STEPS.get(name, 1e-7)
            after, before = (
                mode_poles(moved(plant, name, s), 3, WRT)[i].at_rad_s for s in (step, -step)
            )
            assert derivative == pytest.approx((after - before) / (2 * step), rel=1e-4, abs=1e-5)


def test_another_clock_sees_the_torque_where_a_finer_grid_has_it():
    rate_hz, factor, difference = 125.0, 64, 4e-3
    t = np.arange(1000) / rate_hz
    angle = 0.02 * np.sin(2 * np.pi * (2 * t + 20 * t**2 / t[-1] / 2)) * np.hanning(t.size)
    prediction = Prediction(angle, rate_hz, slice(100, 900))
    places = np.arange(factor * 1000)
    fine, _ = prediction.torque_between(BARE, factor, places)
    seen, _ = prediction.torque(replace(BARE, clock_rate_difference=difference))
    exact = np.interp(t[100:900] * (1 + difference), places / (factor * rate_hz), fine)
    usual, _ = prediction.torque(BARE)
    assert np.abs(seen - exact).max() < 1e-3 * np.abs(usual - exact).max()


def test_between_the_samples_another_clock_sees_the_same():
    angle = np.random.default_rng(1).normal(size=400)
    prediction = Prediction(np.convolve(angle, np.hanning(9), "same"), 125.0, slice(0, 400))
    torque, gradient = prediction.torque(ALL, WRT)
    at, gradient_at = prediction.torque_between(ALL, 4, np.arange(0, 1600, 4), WRT)
    assert at == pytest.approx(torque, abs=1e-9 * torque.std())
    assert gradient_at == pytest.approx(gradient, rel=1e-6, abs=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("extra", EXTRAS)
def test_unknowns_with_an_extra(extra):
    unknowns = Unknowns.of(STRUCTURES["VI"], Plant(BEAM, Damping()), SETTINGS, 1, (extra,))
    assert unknowns.names[-1] == extra
    x = np.array([-5, 0.9, -4, 0.6, 0.02, -0.03, 0.2, 0.01, 0.05])
    assert unknowns.vector(unknowns.plant(x)) == pytest.approx(x, abs=1e-12)

    def estimates(at):
        values = unknowns.parameters(at)
        return np.array(
            [np.log(values[n]) if n in LOGARITHMIC else values[n] for n in unknowns.names]
        )

    numeric = np.array(
        [(estimates(x + 1e-6 * e) - estimates(x - 1e-6 * e)) / 2e-6 for e in np.eye(x.size)]
    ).T
    assert unknowns.estimates_by_unknowns(x) == pytest.approx(numeric, abs=1e-8)


@pytest.mark.parametrize("extra", ["tip_mass_kg", "filter_time_constant_s"])
def test_near_nothing_an_extra_changes_nothing_that_others_do_not(extra):
    """Density, stiffness and delay are those of the rig without it, to first order."""
    unknowns = Unknowns.of(STRUCTURES["I"], Plant(BEAM, Damping()), SETTINGS, 1, (extra,))
    x = unknowns.start(np.log([1e-2]))
    angle = np.convolve(np.random.default_rng(1).normal(size=2000), np.hanning(9), "same")
    prediction = Prediction(angle, 125.0, slice(0, 2000))
    none, _ = prediction.torque(unknowns.plant(x))

    def change(size):
        return np.std(prediction.torque(unknowns.plant(x + size * np.eye(x.size)[-1]))[0] - none)

    assert change(2e-3) < 4.5 * change(1e-3)
    assert change(2e-3) > 3.0 * change(1e-3)


def test_a_filter_that_the_file_states_is_part_of_the_model(sessions):
    measurement = replace(sessions("III").measured(), filter_time_constant_s=1e-3)
    assert measurement.nominal.filter_time_constant_s == 1e-3
    unknowns = Unknowns.of(STRUCTURES["III"], measurement.nominal, SETTINGS)
    assert unknowns.plant(unknowns.start(np.log([1e-3, 1e-2]))).filter_time_constant_s == 1e-3
