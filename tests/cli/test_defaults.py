"""The command line's defaults are the excitations' own."""

import inspect

import pytest

from rigd.cli import run
from rigd.excitation import excitation_options


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        (run.chirp, "chirp"),
        (run.hold, "hold"),
        (run.step, "step"),
        (run.multisine, "multisine"),
        (run.file, "file"),
        (run.modes, "modes"),
        (run.move, "move"),
        (run.touch, "touch"),
    ],
)
def test_defaults_agree(command, kind):
    options = {
        option.name: inspect.Parameter.empty if option.required else option.default
        for option in excitation_options(kind)
    }
    defaults = {
        name.replace("phase_seed", "seed"): argument.default
        for name, argument in inspect.signature(command).parameters.items()
    }
    # No file: None in a command, "" in the function.
    assert {**options, "path": ""} == {**defaults, "path": ""}
