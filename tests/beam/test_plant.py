"""The plant and the table of its parameters: no consumer can drop or confuse one of them."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from rigd.beam import (
    BEAM_PARAMETERS,
    DAMPING_PARAMETERS,
    LOGARITHMIC_PARAMETERS,
    PARAMETERS,
    Beam,
    Damping,
    Plant,
    gradient_name,
    parameter_named,
    transfer,
)

UNIFORM = Plant(
    Beam(0.98, 4.7e-3, 0.090275),
    Damping(7.1e-5, 0.92, 5.5e-2, 0.594),
    delay_s=-3e-4,
    tool_inertia_kg_m2=1e-5,
    filter_time_constant_s=1e-3,
    second_order_filter_time_constant_s=2e-3,
)
HEAVY = replace(UNIFORM, tip_mass_kg=2e-4, root_compliance_rad_per_nm=0.02)
UNEVEN = replace(UNIFORM, stiffness_offsets=(0.03, 0.0, -0.05))
PLANTS = pytest.mark.parametrize("plant", [UNIFORM, HEAVY, UNEVEN])


@PLANTS
def test_plant_matches_its_parameters_and_json(plant):
    again = Plant.from_parameters(plant.beam.length_m, plant.parameters)
    assert again.beam.density_kg_per_m == pytest.approx(plant.beam.density_kg_per_m, rel=1e-14)
    assert replace(again, beam=plant.beam) == plant
    document = json.loads(json.dumps(plant.as_dict()))
    assert document.keys() == {field.name for field in fields(Plant)}
    assert Plant.from_dict(document) == plant


@PLANTS
def test_all_parameters_are_in_the_table_and_independent(plant):
    for name, value in plant.parameters.items():
        assert parameter_named(name).is_valid(value)
        changed = plant.with_parameters({name: 1.25 * value}).parameters
        others = plant.parameters.keys() - {name}
        assert changed.keys() == plant.parameters.keys()
        assert changed[name] == pytest.approx(1.25 * value)
        assert [changed[other] for other in others] == pytest.approx(
            [plant.parameters[other] for other in others]
        )


def test_unknown_parameter_is_refused_by_name():
    for name in ("drag", "length_m"):
        with pytest.raises(ValueError, match=f"'{name}' is not a parameter"):
            UNIFORM.with_parameters({name: 1.0})
    with pytest.raises(KeyError):
        parameter_named("stiffness_offset_")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("alpha", 2.0),
        ("zeta", -1e-9),
        ("delay_s", np.nan),
        ("tip_mass_kg", np.inf),
    ],
)
def test_a_value_out_of_its_range_is_refused_by_name(name, value):
    UNIFORM.raise_if_invalid()
    with pytest.raises(ValueError, match=f"{name} = "):
        UNIFORM.with_parameters({name: value}).raise_if_invalid()
    with pytest.raises(ValueError, match="bending_stiffness_n_m2 = 0"):
        replace(UNIFORM, beam=Beam(0.98, 4.7e-3, 0.0)).raise_if_invalid()


def test_ranges_are_stated_with_their_unit():
    assert PARAMETERS["density_over_stiffness"].range_text == "more than 0 s²/m⁴"
    assert PARAMETERS["alpha"].range_text == "0 or more below 2"
    assert PARAMETERS["delay_s"].range_text == "any size s"


def test_the_logarithms_of_sizes_are_estimated():
    assert {"zeta", "gamma", *BEAM_PARAMETERS} == LOGARITHMIC_PARAMETERS
    assert [gradient_name(name) for name in (*DAMPING_PARAMETERS, *BEAM_PARAMETERS, "drag")] == [
        *DAMPING_PARAMETERS, "ln_density_over_stiffness", "ln_stiffness", "drag",
    ]  # fmt: skip


def test_a_uniform_cantilever_has_the_exact_transfer_function():
    s = 2j * np.pi * np.geomspace(0.1, 90.0, 50)
    assert (UNIFORM.transfer(s) == transfer(s, UNIFORM.beam, UNIFORM.damping)).all()
    nearly = replace(UNIFORM, tip_mass_kg=1e-12)
    assert nearly.transfer(s) == pytest.approx(UNIFORM.transfer(s), rel=1e-6)
    assert nearly.tip_slope(s) == pytest.approx(UNIFORM.tip_slope(s), rel=1e-6)


def test_pole_derivatives_match_for_every_variant():
    for plant in (UNIFORM, HEAVY, UNEVEN):
        step = 1e-6 * plant.damping.gamma
        after, before = (
            plant.with_parameters({"gamma": plant.damping.gamma + change}).mode_poles(3)
            for change in (step, -step)
        )
        for pole, up, down in zip(plant.mode_poles(3, ["gamma"]), after, before, strict=True):
            moved = (up.frequency_hz - down.frequency_hz) / (2 * step)
            damped = (up.damping_ratio - down.damping_ratio) / (2 * step)
            assert pole.frequency_derivative_hz == pytest.approx(moved, rel=1e-4, abs=1e-6)
            assert pole.damping_ratio_derivative == pytest.approx(damped, rel=1e-4)
