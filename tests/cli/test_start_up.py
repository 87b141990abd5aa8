"""Imports of commands before their options are known, and numpy's threads."""

import os
import subprocess
import sys

import pytest
from cases import further

from rigd.runtime.background import SINGLE_THREADED

pytestmark = pytest.mark.process

PROGRAM = """
import importlib, os, sys


class Witness:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == "numpy":
            print({variables} <= os.environ.items(), flush=True)
            os._exit(0)
        return None


sys.meta_path.insert(0, Witness)
sys.argv = ["program", *{arguments}]
importlib.import_module("{module}").main()
"""


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("rigd.__main__", ["run", "chirp", "--fast", "--profile", "sim", "--amplitude", "9"]),
        further("rigd.__main__", ["serve", "--profile", "sim", "--output", "/dev/null/nowhere"]),
        further("rigd.__main__", ["check", "--profile", "sim"]),
        ("analysis.__main__", ["/dev/null"]),
    ],
)
def test_threads_are_limited_before_numpy_is_imported(module, arguments):
    code = PROGRAM.format(variables=SINGLE_THREADED.items(), module=module, arguments=arguments)
    code = code.replace("dict_items(", "set(")
    # The tests' own environment forbids them.
    clean = {name: value for name, value in os.environ.items() if name not in SINGLE_THREADED}

    run = subprocess.run(
        [sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=False
    )

    assert run.stdout == "True\n", run.stderr


def test_help_imports_no_numpy():
    code = (
        "import sys; from rigd.cli.app import app; "
        "print([name for name in ('numpy', 'scipy', 'pydantic', 'rerun') if name in sys.modules])"
    )

    printed = subprocess.check_output([sys.executable, "-c", code], text=True)

    assert printed == "[]\n"


def test_processes_of_a_rig_start_before_numpy_is_imported():
    code = "import sys; from rigd.runner import ProcessGroup; print('numpy' in sys.modules)"

    printed = subprocess.check_output([sys.executable, "-c", code], text=True)

    assert printed == "False\n"


def test_status_imports_no_parser_of_options(runtime_folder):
    code = (
        "import sys; sys.argv = ['rigd', 'status']; from rigd.__main__ import main\n"
        "try: main()\nexcept SystemExit as end: print(end.code)\n"
        "print([name for name in ('numpy', 'pydantic', 'typer') if name in sys.modules])"
    )

    printed = subprocess.check_output([sys.executable, "-c", code], text=True)

    assert printed == "1\n[]\n"
