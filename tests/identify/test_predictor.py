"""Predicted torque: the synthesis' torque in the band, and derivatives that differences confirm."""

import numpy as np
import pytest

from analysis.identify import Comparison, TorquePredictor
from rigd.beam import GRADIENT_NAMES, Beam, Damping, Plant

OFFSETS = (0.03, -0.05)
WRT = (*GRADIENT_NAMES, "delay_s", "tool_inertia_kg_m2")


@pytest.fixture(scope="module")
def plant(link):
    return Plant(link, Damping(7.1e-5, 0.996, 5.5e-2, 0.594), 3e-4, 1e-5, OFFSETS)


@pytest.fixture(scope="module")
def link():
    return Beam(0.98, 4.7e-3, 0.090275)


@pytest.mark.fit
@pytest.mark.parametrize(
    "more", [{}, {"delay_s": 3e-4, "tool_inertia_kg_m2": 1e-5}, {"offsets": OFFSETS}]
)
def test_torque_agrees_with_independent_synthesis(sessions, link, plant, more):
    compared = Comparison.from_measurement(sessions("VI", **more).measured(), (0.0, 50.0))
    renamed = {name.replace("offsets", "stiffness_offsets"): value for name, value in more.items()}
    torque, _ = compared.torque_predictor.torque(Plant(link, plant.damping, **renamed))
    measured = compared.torque_nm[compared.retained_samples]
    assert np.sqrt(np.mean((torque - measured) ** 2)) < 1e-6 * measured.std()


def moved(plant, name, step):
    beam = plant.beam
    ratio, stiffness = beam.density_over_stiffness, beam.bending_stiffness_n_m2
    at = plant.parameters
    match name:
        case "ln_density_over_stiffness":
            ratio *= np.exp(step)
        case "ln_stiffness":
            stiffness *= np.exp(step)
        case _:
            at[name] += step
    return Plant(
        Beam(beam.length_m, ratio * stiffness, stiffness),
        Damping(at["zeta"], at["alpha"], at["gamma"], at["lambda"]),
        at["delay_s"],
        at["tool_inertia_kg_m2"],
        plant.stiffness_offsets,
    )


@pytest.mark.parametrize("name", WRT)
def test_derivatives(plant, name):
    angle = np.random.default_rng(1).normal(size=400)
    prediction = TorquePredictor(angle, 125.0, slice(10, 390))
    _, gradient = prediction.torque(plant, WRT)
    step = 1e-5 * (plant.parameters.get(name) or 1.0)
    after, _ = prediction.torque(moved(plant, name, step))
    before, _ = prediction.torque(moved(plant, name, -step))
    analytic = gradient[WRT.index(name)]
    assert np.abs((after - before) / (2 * step) - analytic).max() < 1e-6 * np.abs(analytic).max()


@pytest.mark.fit
def test_subsamples_agree(plant, decimation):
    noise = np.random.default_rng(1).normal(size=3200)
    angle = decimation.apply(noise)
    prediction = TorquePredictor(angle, 125.0, slice(0, 400))
    torque, gradient = prediction.torque(plant, WRT)
    at, gradient_at = prediction.torque_at_fine_samples(plant, 8, np.arange(0, 3200, 8), WRT)
    assert np.abs(at - torque).max() < 1e-3 * torque.std()
    assert (np.abs(gradient_at - gradient).max(axis=1) < 1e-3 * gradient.std(axis=1)).all()


@pytest.mark.parametrize("factor", [2, 3, 8])
def test_subsamples_agree_with_a_higher_rate(plant, factor):
    def angle(rate_hz):
        time_s = np.arange(round(3.2 * rate_hz)) / rate_hz
        waves = np.sin(2 * np.pi * 7.3 * time_s) + np.cos(2 * np.pi * 31.0 * time_s)
        return np.sin(np.pi * time_s / 3.2) ** 8 * waves  # nothing at half the rate

    fine = TorquePredictor(angle(factor * 125.0), factor * 125.0, slice(0, factor * 400))
    torque, gradient = fine.torque(plant, WRT)
    indices = np.arange(1, torque.size, 5)
    coarse = TorquePredictor(angle(125.0), 125.0, slice(0, 400))
    at, gradient_at = coarse.torque_at_fine_samples(plant, factor, indices, WRT)
    assert np.abs(at - torque[indices]).max() < 1e-6 * torque.std()
    difference = np.abs(gradient_at - gradient[:, indices]).max(axis=1)
    assert (difference < 1e-6 * gradient.std(axis=1)).all()
