"""Sessions whose fits the live view shows, and the number of modes."""

from pathlib import Path

import pytest
from shipped_profile import load_shipped

from rigd.excitation import make_excitation
from rigd.runner._live_view import describe_planned_session
from rigd.runner.request import SessionOrder


@pytest.mark.parametrize(
    ("kind", "parameters", "watch_fit", "modes"),
    [
        ("chirp", {}, False, None),
        ("chirp", {}, True, 3),  # 2.57, 16.0 and 44.8 Hz, and then 88 Hz
        ("chirp", {"start_hz": 20.0, "stop_hz": 1.0}, True, 2),
        ("chirp", {"stop_hz": 250.0}, True, 4),
        ("chirp", {"start_hz": 0.1, "stop_hz": 1.0}, True, 1),
        ("hold", {}, True, 3),
        ("until", {"targets": "damping 1%"}, False, 3),
    ],
)
def test_plotted_modes_are_those_expected_in_the_band(kind, parameters, watch_fit, modes):
    profile = load_shipped("sim")
    excitation = make_excitation(kind, parameters, profile.rig.rate_hz)
    order = SessionOrder(profile, excitation, Path("a.mcap"), watch_fit=watch_fit)
    assert describe_planned_session(order).fitted_mode_count == modes
