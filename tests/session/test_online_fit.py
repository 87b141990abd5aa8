"""Text for the estimates of an online fit."""

import json

from rigd.estimates import modes_from_json
from rigd.session.online_fit import estimate_lines


def quantity(value, half, flag=None) -> dict:
    ends = [value - half, value + half]
    return {"value": value, "std": half / 1.96, "interval_95": ends, "flag": flag}


def answer_with(*modes, **others) -> dict:
    return {"problem": "", "duration_s": 7.0, "modes": list(modes), "findings": []} | others


def mode(number, hz, damping, *, shown=True, flag=None) -> dict:
    return {
        "mode": number,
        "shown": shown,
        "frequency_hz": quantity(hz, 1.2e-3),
        "damping_ratio": quantity(damping, 1.2e-4, flag),
    }


def test_lines_state_modes_changes_doubts_and_findings():
    before = answer_with(mode(1, 2.5, 0.01), mode(2, 16.0, 0.005, shown=False))
    now = answer_with(
        mode(1, 2.502, 0.0102),
        mode(2, 16.0, 0.005, flag="part of the record is unexplained"),
        mode(3, 45.0, 0.01, shown=False),
        findings=["A hum."],
        validity={"predicted_peak_tip_slope_rad": 0.6, "linear_model_error": 0.12},
    )
    json.dumps(now)
    assert estimate_lines(now, before) == [
        "After 7.0 s (± 95 %, statistical only; tip slope 0.6 rad, error ≤ 12 %):",
        "  mode 1: 2.5020 ± 0.0012 Hz, damping 1.020 ± 0.012 %; change +0.00200 Hz, +2 %",
        "  mode 2: 16.0000 ± 0.0012 Hz, damping 0.500 ± 0.012 % "
        "(doubtful: part of the record is unexplained)",
        "  not visible so far: mode 3",
        "  A hum.",
    ]
    assert "change" not in "".join(estimate_lines(now))
    assert "tip slope unknown" in estimate_lines(before)[0]
    assert modes_from_json(now["modes"])[0].summary_line() in estimate_lines(now)[1]


def test_lines_state_the_reason_for_no_estimate():
    assert estimate_lines(answer_with(problem="Nothing is excited yet.")) == [
        "After 7.0 s: Nothing is excited yet."
    ]
