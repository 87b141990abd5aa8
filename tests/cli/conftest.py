"""The commands as an operator runs them: as processes of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = Path(sys.executable).parent


@pytest.fixture
def rigd(tmp_path):
    """Run `rigd` in an empty folder; returns the completed process."""

    def run(*arguments, timeout=100):
        return subprocess.run(
            [COMMANDS / "rigd", *map(str, arguments)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
            env=os.environ | {"COLUMNS": "120"},
        )

    return run


@pytest.fixture
def patient(write_profile):
    """The simulated rig, for sessions in real time on a machine that may stand still."""
    return write_profile("sim", patient=True)


@pytest.fixture
def start_rigd(tmp_path):
    """Start `rigd` in an empty folder; it is killed if a test leaves it running."""
    started = []

    def start(*arguments, folder=tmp_path):
        started.append(
            subprocess.Popen(
                [COMMANDS / "rigd", *map(str, arguments)],
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,  # a process group of its own, as in a terminal
            )
        )
        return started[-1]

    yield start
    for process in started:
        process.kill()
        # What it said helps where a test failed without asking.
        sys.stdout.write("\n".join(process.communicate()))
