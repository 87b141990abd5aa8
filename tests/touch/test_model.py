"""Beam models from an analysis, from a profile, and with one changed parameter."""

import json
from dataclasses import replace

import pytest

from rigd.beam import Beam, Damping, Plant
from rigd.touch import TouchModel

LENGTH_M = 0.98
STATED = Plant(Beam(LENGTH_M, 4.7e-3, 0.09), Damping(zeta=7e-5, gamma=0.05))


def quantity(value, std=None, interval=None):
    return {"value": value, "std": std, "interval_95": interval, "flag": None}


PARAMETERS = {
    "zeta": quantity(7e-5, 1e-6, [6.6e-5, 7.4e-5]),
    "alpha": quantity(0.99, 0.01, None),
    "gamma": quantity(0.05, 0.01, [0.03, 0.07]),
    "lambda": quantity(0.6, None, None),
    "density_over_stiffness": quantity(0.052, 5e-6, [0.05199, 0.05201]),
    "bending_stiffness_n_m2": quantity(0.09, 1e-4, [0.0898, 0.0902]),
    "delay_s": quantity(2e-4, 1e-6, [1.98e-4, 2.02e-4]),
    "tool_inertia_kg_m2": quantity(1e-5, 0.0, None),
}


@pytest.fixture
def write_document(tmp_path):
    """Function that writes a document with given headlines and returns its path."""

    def write(*headlines):
        path = tmp_path / "model.json"
        path.write_text(json.dumps({"headlines": list(headlines)}))
        return path

    return write


def test_model_from_analysis(write_document):
    path = write_document({"file": "a.mcap", "parameters": PARAMETERS})
    model = TouchModel.from_analysis(path, STATED, angle_delay_s=1e-4)
    assert model.plant.beam == Beam(LENGTH_M, 0.052 * 0.09, 0.09)
    assert model.plant.damping == Damping(zeta=7e-5, alpha=0.99, gamma=0.05, lambda_=0.6)
    assert model.plant.tool_inertia_kg_m2 == 1e-5
    assert model.wrench_delay_s == pytest.approx(3e-4)  # older than the angle, by delay_s
    assert model.source == str(path)
    assert model.std_by_parameter["bending_stiffness_n_m2"] == pytest.approx(4e-4 / 3.919928)
    assert model.std_by_parameter["alpha"] == 0.01
    assert "lambda" not in model.std_by_parameter
    assert "tool_inertia_kg_m2" not in model.std_by_parameter


def test_defaults_for_missing_parameters(write_document):
    few_parameters = {
        name: PARAMETERS[name] for name in ("density_over_stiffness", "bending_stiffness_n_m2")
    }
    model = TouchModel.from_analysis(
        write_document({"file": "a.mcap", "parameters": few_parameters}),
        replace(STATED, delay_s=5e-4, tool_inertia_kg_m2=2e-5),
    )
    assert model.plant.damping == Damping()
    assert (model.wrench_delay_s, model.plant.tool_inertia_kg_m2) == (5e-4, 2e-5)


def test_only_one_parameter_changes():
    model = TouchModel.with_assumed_uncertainty(STATED)
    stiffer = model.with_changed_parameter("bending_stiffness_n_m2", 0.009)
    assert stiffer.plant.beam.bending_stiffness_n_m2 == pytest.approx(0.099)
    assert stiffer.plant.beam.density_over_stiffness == pytest.approx(
        model.plant.beam.density_over_stiffness
    )
    heavier = model.with_changed_parameter(
        "density_over_stiffness", 0.01 * model.plant.beam.density_over_stiffness
    )
    assert heavier.plant.beam.density_kg_per_m == pytest.approx(1.01 * 4.7e-3)
    assert heavier.plant.beam.bending_stiffness_n_m2 == 0.09
    assert model.with_changed_parameter("zeta", -1.0).plant.damping.zeta == 0.0
    assert model.with_changed_parameter("alpha", 0.2).plant.damping.alpha == pytest.approx(1.2)
    assert model.with_changed_parameter("delay_s", 1e-4).wrench_delay_s == pytest.approx(1e-4)
    assert set(model.std_by_parameter) == {
        "bending_stiffness_n_m2",
        "density_over_stiffness",
        "zeta",
        "gamma",
    }
    with pytest.raises(ValueError, match="is not a parameter"):
        model.with_changed_parameter("length", 0.1)
