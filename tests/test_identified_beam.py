"""The beam of an analysis, from its JSON document: values used, and effects refused by name."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import Beam, Damping, Plant, clamped_free_eigenvalues, participation
from rigd.identified_beam import MOVE_USE, TOUCH_USE, IdentifiedBeamError, read_identified_beam
from rigd.profile import load_profile

STATED = Plant(Beam(0.98, 4.7e-3, 0.09), Damping())
OFFSETS = {"stiffness_offset_2": {"value": 0.03}, "stiffness_offset_3": {"value": -0.05}}


@pytest.fixture
def profile():
    return load_profile("sim")


def changed(path, **more):
    """Change the headline of a document."""
    document = json.loads(path.read_text())
    document["headlines"][0].update(more)
    path.write_text(json.dumps(document))
    return path


def refusal(path, use):
    with pytest.raises(IdentifiedBeamError) as refused:
        read_identified_beam(path, STATED, use)
    assert str(refused.value).startswith(f"{path}: headlines[0].")
    return str(refused.value)


def test_the_beam_of_an_analysis_is_read(analysed, profile):
    found = read_identified_beam(analysed(), profile.plant, MOVE_USE)
    assert found.plant.damping == profile.rig.damping
    assert found.plant.beam.density_kg_per_m == pytest.approx(profile.rig.beam.density_kg_per_m)
    assert found.pole_uncertainty(2) == pytest.approx((1e-4, 1e-4))
    undamped = read_identified_beam(analysed(zeta=None, alpha=None), STATED, TOUCH_USE)
    assert undamped.plant.damping.zeta == 0.0


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"density_over_stiffness": None}, "density_over_stiffness is missing"),
        ({"zeta": {"value": -1.0, "std": 0.0}}, r"zeta\.value = -1\.0 must be"),
        ({"alpha": {"value": 2.5, "std": 0.0}}, r"alpha\.value = 2\.5 must be .* below 2"),
        ({"bending_stiffness_n_m2": {"value": 0, "std": 0}}, "more than 0 N·m²"),
        ({"gamma": 3}, r"gamma\.value = null"),
        ({"gamma": {"value": 10**400, "std": 0.0}}, r"gamma\.value = 1000.* must be"),
        ({"stiffness_offset_3": {"value": 0.1}}, "of modes 3, but must be those of modes 2 to 2"),
        ({"tip_mass_kg": {"value": 1e-4}, **OFFSETS}, "together are not defined"),
    ],
)
def test_errors_of_the_document_are_reported(analysed, other, message):
    with pytest.raises(IdentifiedBeamError, match=message) as refused:
        read_identified_beam(analysed(**other), STATED, MOVE_USE)
    assert "model.json" in str(refused.value)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"headlines": []}', '{"headlines": [{}]}', '{"headlines": 3}', "\x00"]
)
def test_other_file_is_refused(tmp_path, text):
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(IdentifiedBeamError, match="analyze session"):
        read_identified_beam(path, STATED, MOVE_USE)
    with pytest.raises(IdentifiedBeamError, match="cannot be read"):
        read_identified_beam(tmp_path / "none.json", STATED, MOVE_USE)


@pytest.mark.parametrize(
    ("effect", "read"),
    [
        ({"tip_mass_kg": {"value": 3e-4}}, (3e-4, 0.0, ())),
        ({"root_compliance_rad_per_nm": {"value": 0.2}}, (0.0, 0.2, ())),
        (OFFSETS, (0.0, 0.0, (0.03, -0.05))),
    ],
)
def test_move_accepts_ends_and_modes_but_touch_does_not(analysed, effect, read):
    path = analysed(**effect)
    loaded = read_identified_beam(path, STATED, MOVE_USE).plant
    found = loaded.tip_mass_kg, loaded.root_compliance_rad_per_nm, loaded.stiffness_offsets
    assert found == read
    refused = refusal(path, TOUCH_USE)
    assert f"parameters.{next(iter(effect))}.value = " in refused
    assert "a search for touches does not take into account" in refused


@pytest.mark.parametrize("use", [MOVE_USE, TOUCH_USE])
@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (
            {"filter_time_constant_s": {"value": 2e-3}},
            "state it in the profile (sensor.filter_hz = 79.58, sensor.filter_order = 1)",
        ),
        ({"second_order_filter_time_constant_s": {"value": 2e-3}}, "sensor.filter_order = 2)"),
        ({"clock_rate_difference": {"value": -2e-4}}, "clock_rate_difference.value = -0.0002: "),
        ({"drag": {"value": 2e-3}}, "drag.value = 0.002 m: the analysis found drag of the air"),
        ({"twist_rad": {"value": 0.0}}, "parameters.'twist_rad' is not known to this version"),
        ({"stiffness_offset_": {"value": 0.0}}, "'stiffness_offset_' is not known"),
    ],
)
def test_unsupported_effect_is_refused_by_name(analysed, use, effect, message):
    assert message in refusal(analysed(**effect), use)


def test_effect_of_size_zero_has_no_influence(analysed):
    none = {"drag": {"value": 0.0}, "filter_time_constant_s": {"value": 0.0}}
    assert read_identified_beam(analysed(**none), STATED, TOUCH_USE).plant.is_uniform_cantilever


@pytest.mark.parametrize("use", [MOVE_USE, TOUCH_USE])
@pytest.mark.parametrize(
    ("what", "accepted"),
    [
        *((what, True) for what in ("hum", "beam data", "delay", "rival explanations", "knock")),
        *((what, True) for what in ("not uniform", "elastic clamp", "tip mass", "torque filter")),
        *((what, False) for what in ("nonlinear stiffness", "play", "drifting stiffness")),
        ("clock rate difference", False),
        *((what, False) for what in ("unexplained", "unit", "of a later version", None)),
    ],
)
def test_findings_without_a_parameter_are_refused(analysed, use, what, accepted):
    finding = {"what": what, "value": None, "interval_95": None, "sentence": "It was found."}
    path = changed(analysed(), named=[{"what": "hum"}, finding])
    if accepted:
        read_identified_beam(path, STATED, use)
    else:
        assert f"named[1]: {what}, which {use.name} does not take" in refusal(path, use)


@pytest.mark.parametrize("use", [MOVE_USE, TOUCH_USE])
def test_significant_air_drag_without_a_parameter_is_refused(analysed, use):
    drag = {"what": "air drag", "value": 2.3e-3, "interval_95": None, "sentence": "Drag acts."}
    refused = refusal(changed(analysed(), named=[drag]), use)
    assert f"named[0]: air drag, which {use.name} does not take" in refused
    assert "(Drag acts.); leave --model out" in refused
    # Without a size it is not significant.
    read_identified_beam(changed(analysed(), named=[drag | {"value": None}]), STATED, use)
    # The message names the parameter if there is one.
    described = changed(analysed(drag={"value": 2.3e-3}), named=[drag])
    assert "drag.value = 0.0023 m: the analysis found drag" in refusal(described, use)


@pytest.mark.parametrize("stated", [{"status": "refused"}, {"status": []}, [], "passed"])
def test_unreadable_uniformity_test_is_refused(analysed, stated):
    path = changed(analysed(), validity={"uniform_beam": stated})
    with pytest.raises(
        IdentifiedBeamError, match=r"model\.json: validity\.uniform_beam = .* is not"
    ):
        read_identified_beam(path, STATED, MOVE_USE)


def flagged(value, **more):
    return {"value": value, "std": 0.1 * value, "flag": "another explanation fits", **more}


def test_a_flagged_number_is_refused(analysed):
    for name in ("density_over_stiffness", "bending_stiffness_n_m2"):
        path = analysed(**{name: flagged(0.05)})
        for use in (MOVE_USE, TOUCH_USE):
            refused = refusal(path, use)
            assert f"{name} is flagged (another explanation fits), and {use.name}" in refused
        no_text = analysed(**{name: {"value": 0.05, "flag": 3}})
        assert f"{name} is flagged (3), and a move" in refusal(no_text, MOVE_USE)
    assert "tip_mass_kg is flagged" in refusal(analysed(tip_mass_kg=flagged(1e-4)), MOVE_USE)


def test_touch_uses_the_deviation_of_a_flagged_damping(analysed):
    path = analysed(gamma=flagged(0.05, interval_95=[0.03, 0.07]))
    assert read_identified_beam(path, STATED, TOUCH_USE).parameter_stds["gamma"] == pytest.approx(
        0.0102, 1e-2
    )
    path = analysed(gamma={"value": 0.05, "std": None, "flag": "not identifiable"})
    assert "gamma is flagged" in refusal(path, TOUCH_USE)
    assert "gamma" not in read_identified_beam(path, STATED, MOVE_USE).parameter_stds


def test_the_uncertainty_of_the_poles_is_that_of_the_modes(analysed):
    def mode(number, hz_std, ratio_std):
        return {
            "mode": number,
            "frequency_hz": {"value": 10.0, "std": hz_std},
            "damping_ratio": {"value": 0.01, "std": ratio_std},
        }

    modes = [mode(1, 0.03, 0.004), mode(2, 0.1, 0.0)]
    found = read_identified_beam(changed(analysed(), modes=modes), STATED, MOVE_USE)
    assert found.pole_uncertainty(3) == pytest.approx((0.005, 0.01, 0.01))
    assert "modes[0] is not mode 1" in refusal(changed(analysed(), modes=[mode(2, 0, 0)]), MOVE_USE)


def quantity(value, std=0.0, flag=None):
    return {"value": value, "std": std, "flag": flag}


def shown(beam, *, flag=None):
    """Modes of an antenna as the modal model has them, with the effective inertias."""
    poles = beam.poles(clamped_free_eigenvalues(3))[:, 0]
    inertias = beam.beam.density_kg_per_m * participation(beam.beam, 3)
    return [
        {
            "mode": number,
            "shown": True,
            "source": "modal",
            "frequency_hz": quantity(pole.imag / (2 * np.pi), 1e-3, flag),
            "damping_ratio": quantity(-pole.real / abs(pole), 1e-5, flag),
            "participation": quantity(float(inertia)),
        }
        for number, (pole, inertia) in enumerate(zip(poles, inertias, strict=True), start=1)
    ]


REFUSED = {"uniform_beam": {"status": "refused", "p_value": 3e-7}}
PASSED = {"uniform_beam": {"status": "passed", "p_value": 0.4}}


def test_exact_parameters_of_a_uniform_beam_are_read(analysed, profile):
    """They predict the record best; those with a tolerance of the geometry hold for its modes."""
    exact = json.loads(analysed().read_text())["headlines"][0]["parameters"]
    exact = {name: entry | {"flag": None} for name, entry in exact.items()}
    loaded = Plant(profile.rig.beam, profile.rig.damping)
    changes = {"validity": PASSED, "exact_geometry": {"parameters": exact, "modes": shown(loaded)}}
    path = analysed(density_over_stiffness={"value": 0.06, "std": 1e-4}, alpha=flagged(1.2))
    for use in (MOVE_USE, TOUCH_USE):
        found = read_identified_beam(changed(path, **changes), STATED, use)
        assert found.plant.damping == profile.rig.damping
        assert found.plant.beam.density_kg_per_m == pytest.approx(profile.rig.beam.density_kg_per_m)
    assert found.pole_uncertainty(1)[0] == pytest.approx(1e-3 / 2.57, rel=0.02)


def test_nonuniform_beam_is_accepted_by_moves_only(analysed, profile):
    """No effective beam: frequencies and inertia are those of the modes."""
    beam = replace(profile.rig.beam, density_kg_per_m=5.1e-3, bending_stiffness_n_m2=0.1)
    true = Plant(beam, profile.rig.damping, stiffness_offsets=(0.02, -0.03))
    effective = {name: flagged(value) for name, value in (
        ("density_over_stiffness", 0.0523), ("bending_stiffness_n_m2", 0.0907),
        ("tip_mass_kg", 1e-4),
    )}  # fmt: skip
    path = changed(analysed(**effective), validity=REFUSED, modes=shown(true))
    assert "validity.uniform_beam: a uniform beam does not predict" in refusal(path, TOUCH_USE)
    found = read_identified_beam(path, STATED, MOVE_USE)
    assert found.plant.stiffness_offsets == pytest.approx((0.02, -0.03), abs=1e-5)
    assert found.plant.beam.density_kg_per_m == pytest.approx(5.1e-3)
    assert found.plant.beam.bending_stiffness_n_m2 == pytest.approx(0.1)
    assert found.plant.tip_mass_kg == 0.0
    assert max(found.pole_uncertainty(3)) < 1e-3
    doubtful = changed(path, modes=shown(true, flag="part of the record is unexplained"))
    assert "modes: a uniform beam does not predict" in refusal(doubtful, MOVE_USE)
    # Of a campaign one such record is enough.
    document = json.loads(changed(path, modes=shown(true)).read_text())
    pooled = {**document["headlines"][0], "file": None, "validity": {"uniform_beam": None}}
    path.write_text(json.dumps({"headlines": [*document["headlines"], pooled]}))
    with pytest.raises(IdentifiedBeamError, match="does not predict the modes"):
        read_identified_beam(path, STATED, TOUCH_USE)


def test_damping_unlike_that_of_modes_counts_as_uncertainty(analysed, profile):
    modes = shown(Plant(profile.rig.beam, profile.rig.damping))
    modes[0]["damping_ratio"]["value"] += 0.002
    found = read_identified_beam(
        changed(analysed(), validity=REFUSED, modes=modes), STATED, MOVE_USE
    )
    assert found.pole_uncertainty(2) == pytest.approx((0.002, 7e-5), rel=0.1)
