import os
import subprocess
import sys
from pathlib import Path

import pytest

from rigd.profile import load_profile


@pytest.fixture(scope="session")
def profile():
    return load_profile("sim")


@pytest.fixture
def rigd(tmp_path):
    """Run `rigd` in an empty folder; returns the completed process."""

    def run(*arguments, timeout=60):
        return subprocess.run(
            [Path(sys.executable).parent / "rigd", *map(str, arguments)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
            env=os.environ,
        )

    return run
