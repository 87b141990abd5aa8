"""Scores of headlines: coverage, widths, and false statements."""

import math
from dataclasses import replace

import pytest
from headline_scores import (
    ReportedNumber,
    Scored,
    complaints,
    containing,
    headline_numbers,
    loss_factor_numbers,
    loss_frequencies_hz,
    score,
    shown,
    table,
    wilson,
)
from independent_records import Truth

PAPER = Truth(7.1e-5, 0.996, 5.5e-2, 0.594)
PLAIN = Scored(
    cell="a cell",
    seed=1,
    cpu_s=1.0,
    type="VI",
    numbers=(),
    own={},
    own_holds={},
    contains=("VI",),
    structures={"VI": "selected", "VII": "compatible", "III": "excluded"},
    orders={"alpha": [0.996, "compatible", [0.99, 1.01]]},
    named=[],
)


def quantity(value: float, half: float, flag: str | None = None) -> dict[str, object]:
    return {
        "value": value,
        "std": half / 1.96,
        "interval_95": [value - half, value + half],
        "flag": flag,
    }


def session(
    *numbers: ReportedNumber, own: dict[str, float | None] | None = None, **other: object
) -> Scored:
    return replace(PLAIN, numbers=numbers, own=own or {}, **other)  # type: ignore[arg-type]


def test_wilson_interval_matches_the_literature():
    # R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(29, 29) == pytest.approx((0.8830, 1.0), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_all_numbers_of_a_headline_have_a_truth():
    omega = 120.0
    headline = {
        "parameters": {"zeta": quantity(7.0e-5, 2e-6), "lambda": quantity(0.7, 0.01, "why not")},
        "sizes": [
            {"damping": "internal", "omega_rad_s": omega, **quantity(8.36e-3, 1e-5)},
            {"damping": "external", "omega_rad_s": None, **quantity(0.05, 0.01)},
        ],
        "modes": [
            {
                "mode": 2,
                "frequency_hz": quantity(16.0, 1e-3),
                "damping_ratio": {**quantity(4.2e-3, 1.0), "interval_95": None},
            }
        ],
    }
    found = {each.name: each for each in headline_numbers(headline, PAPER)}
    assert found.keys() == {"zeta", "lambda", "internal size", "external size", "f2", "xi2"}
    assert found["zeta"].holds
    assert (found["lambda"].truth, found["lambda"].holds, found["lambda"].flag) == (
        0.594,
        False,
        "why not",
    )
    loss = 7.1e-5 * math.exp(0.996 * math.log(omega)) * math.sin(0.498 * math.pi)
    assert found["internal size"].truth == pytest.approx(loss)
    assert found["external size"].truth == 5.5e-2
    assert found["f2"].truth == pytest.approx(16.0111, abs=1e-4)
    assert not found["f2"].holds
    assert found["xi2"].interval is None
    assert not found["xi2"].holds


def test_loss_factor_counts_in_the_supported_band_only():
    frequency_hz = [0.3 * 1.1**i for i in range(60)]
    true = PAPER.loss_factor(frequency_hz).tolist()
    curves = {
        "frequency_hz": frequency_hz,
        "loss_factor": {
            "value": true,
            "low": [0.99 * each for each in true],
            "high": [
                (1.01 if hz < 20 else 0.995) * x for hz, x in zip(frequency_hz, true, strict=True)
            ],
        },
        "loss_factor_supported_hz": [1.0, 45.0],
    }
    chosen = loss_frequencies_hz(curves)
    assert chosen.size == 12
    assert chosen.min() >= 1.0
    assert chosen.max() <= 45.0
    points = loss_factor_numbers(curves, PAPER)
    held = [hz < 20 for hz in chosen]
    assert [each.holds for each in points] == held
    its = score("loss factor", [session(*points)])
    assert its.facts == 1
    assert its.held == pytest.approx(sum(held) / 12)
    assert loss_factor_numbers({**curves, "loss_factor_supported_hz": None}, PAPER) == []


def test_flags_and_missing_intervals_are_counted_separately():
    sessions = [
        session(ReportedNumber("f1", 1.0, 1.01, (0.9, 1.1)), own={"f1": 0.1}),
        session(ReportedNumber("f1", 1.0, 1.11, (1.01, 1.21)), own={"f1": 0.2}),
        session(ReportedNumber("f1", 1.0, 1.0, (0.9, 1.1), "doubtful"), own={"f1": 0.1}),
        session(ReportedNumber("f1", 1.0, 2.0, (1.9, 2.1), "doubtful"), own={"f1": 0.1}),
        session(ReportedNumber("f1", 1.0, 1.0, None)),
        session(ReportedNumber("f2", 1.0, 1.0, (0.9, 1.1))),
    ]
    its = score("f1", sessions)
    assert (its.held, its.facts, its.held_flagged, its.flagged, its.without) == (1, 2, 1, 2, 1)
    assert its.wider == pytest.approx(1.5)
    assert its.mark_of_all == "<"  # 2 of 4
    assert its.bias == pytest.approx(1.96 * (0.1 + 1.1) / 2, rel=1e-3)
    assert "1/2" in shown("a cell", sessions)


def test_table_has_a_cell_for_each_quantity_and_group():
    facts = [
        session(ReportedNumber("f1", 2.0 if i == 0 else 1.0, 1.0, (0.9, 1.1)), own={"f1": 0.1})
        for i in range(10)
    ]
    doubtful = [session(ReportedNumber("xi1", 1.0, 1.0, (0.9, 1.1), "why"))]
    lines = table({"some": facts, "others": doubtful}).splitlines()
    assert lines[0] == "| | some (10) | others (1) |"
    assert lines[1] == "|---|---|---|"
    assert lines[2] == "| f1 | 90.0 % (60–98), × 2.00 | – |"
    assert lines[3] == "| xi1 | – | flagged 100 % |"
    assert len(lines) == 4


def test_result_of_the_true_structure_is_shown_with_a_miss():
    sessions = [
        replace(session(ReportedNumber("f1", 2.0, 1.0, (0.9, 1.1))), own_holds={"f1": float(i % 2)})
        for i in range(20)
    ]
    assert score("f1", sessions).own == 0.5
    assert "own 50 %" in str(score("f1", sessions))


def test_widths_of_loss_factors_are_compared_relatively():
    # At another frequency the size is another number.
    its = score(
        "internal size",
        [
            session(
                ReportedNumber("internal size", 2.0, 2.0, (1.8, 2.2)), own={"internal size": 0.1}
            )
        ],
    )
    assert its.wider == pytest.approx(2.0)


@pytest.mark.parametrize(("held", "mark"), [(30, "<"), (40, "<"), (44, ""), (48, ""), (50, "")])
def test_coverage_is_missed_only_beyond_chance(held: int, mark: str):
    sessions = [
        session(ReportedNumber("f1", 1.0 if i < held else 2.0, 1.0, (0.9, 1.1)), own={"f1": 0.2})
        for i in range(50)
    ]
    assert score("f1", sessions).mark == mark
    assert bool(complaints({"a cell": sessions})) == bool(mark)


def test_intervals_that_always_hold_are_too_wide():
    sessions = [session(ReportedNumber("f1", 1.0, 1.0, (0.9, 1.1)), own={"f1": 0.2})] * 500
    assert score("f1", sessions).mark == ">"


@pytest.mark.parametrize(
    ("name", "own", "missed"), [("f1", 0.18, True), ("f3", 0.1, False), ("f3", 0.07, True)]
)
def test_widths_have_limits_of_their_own(name: str, own: float, missed: bool):
    sessions = [session(ReportedNumber(name, 1.0, 1.0, (0.9, 1.1)), own={name: own})]
    assert [line.startswith(f"width of {name}") for line in complaints({"a": sessions})] == [
        True
    ] * missed


def test_structures_that_include_a_truth():
    integer, half = replace(PAPER, alpha=1.0, lambda_=1.0), replace(PAPER, alpha=1.0)
    assert containing(PAPER) == ("VI",)
    assert containing(half) == ("VII", "VI")
    assert containing(integer) == ("III", "VII", "VI")
    assert containing(replace(integer, offsets=(0.006, -0.013))) == ()


def test_false_statements_are_found():
    true = session(contains=("VII", "VI"), orders={"alpha": [1.0, "compatible", None]})
    assert true.excluded_falsely == []
    assert true.fractional_falsely == []
    excluded = replace(true, structures={"VI": "selected", "VII": "excluded", "III": "excluded"})
    assert excluded.excluded_falsely == ["VII"]
    fractional = replace(
        true, orders={"alpha": [1.0, "fractional", None], "lambda": [0.6, "fractional", None]}
    )
    assert fractional.fractional_falsely == ["alpha"]
    assert complaints({"a": [true] * 50}) == []
    assert len(complaints({"a": [true] * 45 + [excluded] * 5})) == 1
    assert len(complaints({"a": [true] * 45 + [fractional] * 5})) == 1


def test_orders_are_not_scored_for_one_mode():
    silent = session(orders={"alpha": [1.0, "not identifiable", None]})
    assert silent.statements == []
    assert complaints({"one mode, a": [silent]}) == []
    assert len(complaints({"one mode, a": [silent, PLAIN]})) == 1


def test_a_session_outlives_its_line():
    one = session(
        ReportedNumber("f1", 1.0, 1.0, (0.9, 1.1)),
        ReportedNumber("f2", 1.0, 1.0, None, "why"),
        own={"f1": None},
    )
    assert Scored.from_line(one.line()) == one


def test_flags_cannot_hide_failures():
    good = session(ReportedNumber("f1", 1.0, 1.0, (0.9, 1.1), "doubtful"))
    bad = session(ReportedNumber("f1", 2.0, 1.0, (0.9, 1.1)))
    its = score("f1", [good] * 45 + [bad] * 5)
    assert (its.mark, its.mark_of_all) == ("<", "")
    assert (
        score("f1", [replace(bad, numbers=(replace(bad.numbers[0], flag="x"),))] * 9).mark_of_all
        == "<"
    )
