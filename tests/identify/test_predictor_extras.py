"""Elastic clamp, tip mass and filters, as stated or as found elsewhere: predictions and poles."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import SETTINGS, TorquePredictor
from analysis.identify.parametrization import Unknowns
from analysis.models import STRUCTURES
from rigd.beam import GRADIENT_NAMES, Beam, Damping, Plant

BEAM = Beam(0.98, 4.7e-3, 0.090275)
BARE = Plant(BEAM, Damping(7.1e-5, 0.996, 5.5e-2, 0.594), 3e-4, 1e-5)
ALL = replace(
    BARE,
    root_compliance_rad_per_nm=0.01,
    tip_mass_kg=5e-5,
    filter_time_constant_s=5e-4,
    second_order_filter_time_constant_s=3e-4,
)
WRT = (*GRADIENT_NAMES, "delay_s", "tool_inertia_kg_m2")
STEPS = {
    "zeta": 1e-9,
    "tool_inertia_kg_m2": 1e-8,
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
    prediction = TorquePredictor(angle, 125.0, slice(10, 390))
    _, gradient = prediction.torque(plant, WRT)
    step = STEPS.get(name, 1e-7)
    after, before = (prediction.torque(moved(plant, name, s), WRT)[0] for s in (step, -step))
    analytic = gradient[WRT.index(name)]
    assert np.abs((after - before) / (2 * step) - analytic).max() < 1e-5 * np.abs(analytic).max()


@pytest.mark.parametrize("plant", [BARE, ALL], ids=["bare", "all"])
def test_pole_derivatives_match_differences(plant):
    for i, pole in enumerate(plant.mode_poles(3, WRT)):
        for name, derivative in zip(WRT, pole.derivative, strict=True):
            step = STEPS.get(name, 1e-7)
            after, before = (
                moved(plant, name, s).mode_poles(3, WRT)[i].at_rad_s for s in (step, -step)
            )
            assert derivative == pytest.approx((after - before) / (2 * step), rel=1e-4, abs=1e-5)


def test_subsamples_agree():
    angle = np.random.default_rng(1).normal(size=400)
    prediction = TorquePredictor(np.convolve(angle, np.hanning(9), "same"), 125.0, slice(0, 400))
    torque, gradient = prediction.torque(ALL, WRT)
    at, gradient_at = prediction.torque_at_fine_samples(ALL, 4, np.arange(0, 1600, 4), WRT)
    assert at == pytest.approx(torque, abs=1e-9 * torque.std())
    assert gradient_at == pytest.approx(gradient, rel=1e-6, abs=1e-6 * np.abs(gradient).max())


def test_stated_filter_is_part_of_the_model(sessions):
    measurement = replace(sessions("III").measured(), filter_time_constant_s=1e-3)
    assert measurement.nominal_plant.filter_time_constant_s == 1e-3
    unknowns = Unknowns.for_structure(STRUCTURES["III"], measurement.nominal_plant, SETTINGS)
    assert unknowns.plant(unknowns.start(np.log([1e-3, 1e-2]))).filter_time_constant_s == 1e-3
