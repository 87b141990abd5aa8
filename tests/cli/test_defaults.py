"""The command line's defaults are the excitations' own."""

import inspect

import pytest

from rigd import excitation
from rigd.cli import run

OTHER_NAMES = {
    "amplitude": "amplitude_rad",
    "duration": "duration_s",
    "rest": "rest_s",
    "ring_down": "ring_down_s",
    "taper": "taper_s",
    "period": "period_s",
    "phase_seed": "seed",
}


@pytest.mark.parametrize(
    ("command", "function"),
    [
        (run.chirp, excitation.chirp),
        (run.hold, excitation.hold),
        (run.step, excitation.step),
        (run.multisine, excitation.multisine),
        (run.file, excitation.from_csv),
    ],
)
def test_defaults_agree(command, function):
    options = {
        OTHER_NAMES.get(name, name): parameter.default
        for name, parameter in inspect.signature(command).parameters.items()
    }
    parameters = {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if name != "rate_hz"
    }
    assert options == parameters
