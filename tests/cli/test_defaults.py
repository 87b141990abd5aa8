"""The command line's defaults are the excitations' own."""

import inspect

import pytest

from rigd import excitation
from rigd.cli import run
from rigd.excitation import RIG_ARGUMENTS


@pytest.mark.parametrize(
    ("command", "function"),
    [
        (run.chirp, excitation.chirp),
        (run.hold, excitation.hold),
        (run.step, excitation.step),
        (run.multisine, excitation.multisine),
        (run.file, excitation.from_csv),
        (run.modes, excitation.modes),
        (run.move, excitation.move),
        (run.touch, excitation.touch),
    ],
)
def test_defaults_agree(command, function):
    def defaults(thing):
        return {
            name.replace("phase_seed", "seed"): parameter.default
            for name, parameter in inspect.signature(thing).parameters.items()
            if name not in {*RIG_ARGUMENTS, "path"}  # no file: None here, "" there
        }

    assert defaults(command) == defaults(function)
