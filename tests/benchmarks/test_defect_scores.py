"""Scores of random defects: wrong, false, and missing results."""

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from defect_scores import (
    ScoredDefect,
    complaints,
    coverage,
    score_document,
    table,
    totals,
)
from independent_records import Truth
from uniform_shift import headline_shift

UNIFORM = Truth(7.1e-5, 0.996, 0.055, 0.594)
OVER, STIFFNESS = UNIFORM.density_over_stiffness, UNIFORM.bending_stiffness_n_m2


def true_mode(number: int, *, visible: bool = True) -> dict[str, Any]:
    pole = UNIFORM.pole(number)
    circle = 1e-4 * abs(pole) * np.array([1, 1j, -1, -1j])
    residue = complex(np.mean(UNIFORM.torque_per_angle(pole + circle) * circle))
    return {
        "mode": number,
        "frequency_hz": UNIFORM.frequency_hz(number),
        "damping_ratio": UNIFORM.damping_ratio(number),
        "residue": [residue.real, residue.imag],
        "peak_nm": 0.1,
        "visible": visible,
        "later_frequency_hz": None,
        "later_damping_ratio": None,
    }


def quantity(value: float, std: float, flag: str | None = None) -> dict[str, Any]:
    half = 1.96 * std
    return {"value": value, "std": std, "interval_95": [value - half, value + half], "flag": flag}


@pytest.fixture
def truth() -> dict[str, Any]:
    ranges = {
        "zeta": [7.1e-5] * 2,
        "alpha": [0.996] * 2,
        "gamma": [0.055] * 2,
        "lambda": [0.594] * 2,
        "density_over_stiffness": [OVER] * 2,
        "bending_stiffness_n_m2": [STIFFNESS] * 2,
        "delay_s": [0.0] * 2,
        "tool_inertia_kg_m2": [0.0] * 2,
        "drag_m": [0.0] * 2,
    }
    return {
        "seed": 1,
        "kind": "none",
        "linear_constant": True,
        "noise": {"white_nm": 5e-3, "corner_hz": 0.0, "bumps": []},
        "modes": [true_mode(1), true_mode(2), true_mode(3), true_mode(4, visible=False)],
        "law": {
            "zeta": 7.1e-5,
            "alpha": 0.996,
            "gamma": 0.055,
            "lambda": 0.594,
            "relaxations": [],
        },
        "parameters": {name: low for name, (low, _) in ranges.items()},
        "ranges": ranges,
        "effects": [],
    }


@pytest.fixture
def headline(truth: dict[str, Any]) -> dict[str, Any]:
    """Return a headline with correct values and no flags."""
    modes = [
        {
            "mode": mode["mode"],
            "frequency_hz": quantity(
                mode["frequency_hz"] * (1 + 1e-5), 1e-5 * mode["frequency_hz"]
            ),
            "damping_ratio": quantity(mode["damping_ratio"] * 0.999, 1e-3 * mode["damping_ratio"]),
        }
        for mode in truth["modes"][:3]
    ]
    lost = 7.1e-5 * 100**0.996 * math.sin(0.498 * math.pi)
    return {
        "type": "VI",
        "validity": {"uniform_beam": {"p_value": 0.4, "status": "passed"}},
        "parameters": {"alpha": quantity(0.99, 0.02), "gamma": quantity(0.056, 0.002)},
        "sizes": [{"damping": "internal", "omega_rad_s": 100.0, **quantity(lost, 1e-2 * lost)}],
        "modes": modes,
        "structures": [{"type": "VI", "status": "selected"}],
        "orders": {
            "alpha": {"status": "compatible", "interval_95": [0.95, 1.03]},
            "lambda": {"status": "fractional", "interval_95": [0.5, 0.7]},
        },
        "exact_geometry": {"parameters": {"alpha": quantity(0.9961, 1e-3)}, "modes": modes},
        "named": [],
    }


def test_correct_document_has_no_errors(truth: dict[str, Any], headline: dict[str, Any]):
    found = score_document(truth, headline, 1.0)
    assert not found.wrong
    assert not found.false_facts
    assert not found.not_given
    assert found.visible == 3
    assert all(number.inside for number in found.numbers)
    assert (found.gate, found.gate_p) == ("passed", 0.4)
    assert ScoredDefect.from_line(found.line()) == found
    its = totals([found])
    assert (its.inside, its.intervals, its.wrong, its.false, its.not_given) == (6, 6, 0, 0, 0)
    assert complaints([found]) == []
    assert "6 of 6" in table([found])
    assert "exact geometry alpha: 1 of 1" in coverage([found])


def test_documents_without_the_newer_keys_are_read(truth: dict[str, Any], headline: dict[str, Any]):
    del headline["exact_geometry"]
    headline["validity"] = {}
    found = score_document(truth, headline, 1.0)
    assert found.gate is None
    assert not any(number.group == "exact geometry" for number in found.numbers)


def test_number_far_off_is_wrong_without_a_flag(truth: dict[str, Any], headline: dict[str, Any]):
    headline["parameters"]["gamma"] = quantity(0.064, 0.002)
    (wrong,) = score_document(truth, headline, 1.0).wrong
    assert (wrong.name, wrong.deviation) == ("gamma", pytest.approx(4.5, rel=1e-3))
    headline["parameters"]["gamma"]["flag"] = "not that of the beam"
    assert not score_document(truth, headline, 1.0).wrong
    # A condition is no headline.
    headline["exact_geometry"]["parameters"]["alpha"] = quantity(1.2, 1e-3)
    found = score_document(truth, headline, 1.0)
    assert not found.wrong
    assert found.moved_exactly
    assert not found.moved
    assert not replace(found, exact_shift=0.5).moved_exactly
    assert replace(found, shift=1.5).moved


def test_values_within_a_range_of_truths_are_correct(
    truth: dict[str, Any], headline: dict[str, Any]
):
    truth["ranges"]["bending_stiffness_n_m2"] = [0.088, 0.092]
    for value, far in ((0.0899, False), (0.0925, True), (0.0922, False)):
        headline["parameters"]["bending_stiffness_n_m2"] = quantity(value, 1e-4)
        assert bool(score_document(truth, headline, 1.0).wrong) == far


@pytest.mark.parametrize("key", ["frequency_hz", "damping_ratio"])
def test_a_visible_mode_with_a_flag_is_not_given(
    truth: dict[str, Any], headline: dict[str, Any], key: str
):
    headline["modes"][1][key]["flag"] = "another model differs"
    found = score_document(truth, headline, 1.0)
    assert found.not_given == (2,)
    assert any("not given: 1" in line for line in complaints([found]))
    del headline["modes"][1]
    assert score_document(truth, headline, 1.0).not_given == (2,)
    truth["modes"][1]["visible"] = False
    assert score_document(truth, headline, 1.0).not_given == ()


def test_modes_are_matched_by_frequency(truth: dict[str, Any], headline: dict[str, Any]):
    # If only modes 2 and 3 are visible, they may be numbered from 1.
    headline["modes"] = headline["modes"][1:]
    for number, mode in enumerate(headline["modes"], start=1):
        mode["mode"] = number
    found = score_document(truth, headline, 1.0)
    assert found.not_given == (1,)
    assert [number.name for number in found.modes] == ["f2", "xi2", "f3", "xi3"]
    assert not found.wrong


def test_mode_with_a_step_has_two_true_values(truth: dict[str, Any], headline: dict[str, Any]):
    mode = truth["modes"][2]
    mode["later_frequency_hz"] = 1.002 * mode["frequency_hz"]
    mode["later_damping_ratio"] = mode["damping_ratio"]
    for factor, far in ((1.0, False), (1.001, False), (1.002, False), (1.003, True)):
        headline["modes"][2]["frequency_hz"] = quantity(factor * mode["frequency_hz"], 1e-3)
        assert bool(score_document(truth, headline, 1.0).wrong) == far


@pytest.mark.parametrize(
    ("order", "status", "interval", "false"),
    [
        ("lambda", "fractional", [0.55, 0.62], False),
        ("lambda", "fractional", [0.70, 0.72], True),
        ("lambda", "open", [0.70, 0.72], False),
        ("lambda", "not identifiable", None, False),
        ("alpha", "compatible", [0.9995, 1.0005], True),
    ],
)
def test_an_order_that_excludes_the_truth_is_a_false_fact(
    truth: dict[str, Any],
    headline: dict[str, Any],
    order: str,
    status: str,
    interval: list[float] | None,
    false: bool,
):
    headline["orders"][order] = {"status": status, "interval_95": interval}
    assert bool(score_document(truth, headline, 1.0).false_facts) == false


def test_fractional_order_of_a_relaxing_material_is_false(
    truth: dict[str, Any], headline: dict[str, Any]
):
    truth["law"] |= {"zeta": None, "alpha": None, "relaxations": [[0.01, 0.02]]}
    truth["ranges"]["alpha"] = [0.4, 0.9]
    del truth["ranges"]["zeta"]
    headline["orders"]["alpha"] = {"status": "fractional", "interval_95": [0.6, 0.7]}
    assert score_document(truth, headline, 1.0).false_facts == (
        "alpha fractional (0.600 to 0.700)",
    )
    # It is correct as a slope of the loss.
    headline["orders"]["alpha"]["status"] = "open"
    headline["parameters"]["alpha"] = quantity(0.65, 0.02)
    found = score_document(truth, headline, 1.0)
    assert not found.false_facts
    assert not found.wrong


@pytest.mark.parametrize(
    ("what", "value", "half", "false"),
    [
        ("tool inertia", 5e-5, 1e-6, True),
        ("tool inertia", 1e-6, 9e-7, False),
        ("air drag", 2e-6, 1e-7, True),
        ("drifting gain", 0.04, 0.01, True),
        ("delay", 1e-4, 1e-6, True),
    ],
)
def test_absent_effect_is_a_false_fact(
    truth: dict[str, Any], headline: dict[str, Any], what: str, value: float, half: float,
    false: bool,
):  # fmt: skip
    entry = {"what": what, "value": value, "sentence": "It is."}
    headline["named"] = [entry | {"interval_95": [value - half, value + half]}]
    assert bool(score_document(truth, headline, 1.0).false_facts) == false
    headline["named"] = [
        entry | {"interval_95": None},
        entry | {"value": None, "interval_95": None},
    ]
    assert not score_document(truth, headline, 1.0).false_facts


def test_present_effect_is_no_false_fact(truth: dict[str, Any], headline: dict[str, Any]):
    truth["effects"] = ["drifting stiffness"]
    entry = {"what": "drifting stiffness", "value": 0.01, "sentence": "It drifts."}
    headline["named"] = [entry | {"interval_95": [0.005, 0.015]}]
    assert not score_document(truth, headline, 1.0).false_facts
    truth["ranges"]["drag_m"] = [1e-3] * 2
    truth["effects"] = ["air drag"]
    entry = {"what": "air drag", "value": 2e-3, "sentence": "Air."}
    headline["named"] = [entry | {"interval_95": [1.9e-3, 2.1e-3]}]
    assert not score_document(truth, headline, 1.0).false_facts


def test_beam_data_are_compared_with_the_file(truth: dict[str, Any], headline: dict[str, Any]):
    truth["ranges"]["density_over_stiffness"] = [0.97 * OVER, 1.01 * OVER]
    for sentence, value, false in (
        ("Mass per length over bending stiffness (rho/EI) is 2 % lower.", -0.02, False),
        ("Mass per length over bending stiffness (rho/EI) is 5 % lower.", -0.05, True),
        ("The bending stiffness (EI) is 2 % lower.", -0.02, True),
    ):
        entry = {"what": "beam data", "value": value, "sentence": sentence}
        headline["named"] = [entry | {"interval_95": [value - 1e-3, value + 1e-3]}]
        assert bool(score_document(truth, headline, 1.0).false_facts) == false


def test_structure_that_includes_the_beam_must_not_be_excluded(
    truth: dict[str, Any], headline: dict[str, Any]
):
    headline["structures"] = [{"type": "III", "status": "excluded"}]
    assert not score_document(truth, headline, 1.0).false_facts
    truth["law"] |= {"alpha": 1, "lambda": 1}
    assert score_document(truth, headline, 1.0).false_facts == ("type III excluded",)


def test_limits(truth: dict[str, Any], headline: dict[str, Any]):
    right = score_document(truth, headline, 1.0)
    headline["parameters"]["gamma"] = quantity(0.09, 0.002)
    wrong = score_document(truth, headline, 12.0)
    uneven = replace(right, kind="taper", gate="passed", shift=30.0)
    refused = replace(right, gate="refused")
    assert complaints([right] * 95 + [replace(wrong, cpu_s=1.0)] * 5) == []
    assert any("beyond 4 std" in line for line in complaints([right] * 94 + [wrong] * 6))
    assert any("longest" in line for line in complaints([right, wrong]))
    assert any("refused" in line for line in complaints([right] * 28 + [refused] * 2))
    assert complaints([right] * 29 + [refused]) == []
    assert any("pass" in line for line in complaints([right, uneven, uneven]))
    assert complaints([right, replace(uneven, shift=0.3), replace(uneven, shift=0.3)]) == []
    failed = replace(right, numbers=(), error="no result")
    assert any("seeds [1]" in line for line in complaints([failed]))


def test_only_nonuniform_beams_are_shifted(truth: dict[str, Any], headline: dict[str, Any]):
    assert headline_shift(truth, headline, 0.0) == pytest.approx(0.0, abs=0.05)
    slightly = copy.deepcopy(truth)
    slightly["modes"][2]["damping_ratio"] *= 1.003
    shift = headline_shift(slightly, headline, 0.0)
    assert shift is not None
    assert 0.3 < shift < 10
    slightly["modes"][2]["frequency_hz"] *= 1.0005
    exact, with_tolerance = (headline_shift(slightly, headline, each) for each in (0.0, 1e-3))
    assert exact is not None
    assert with_tolerance is not None
    assert with_tolerance < 1 < exact
    slightly["modes"][2]["frequency_hz"] *= 1.01
    assert headline_shift(slightly, headline, 0.0) == math.inf
    slightly["linear_constant"] = False
    assert headline_shift(slightly, headline, 0.0) is None
