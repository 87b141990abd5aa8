"""Two short sessions of the simulated rig, laid out as docs/python_api.md has them."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROFILE = Path(__file__).parents[2] / "hw_profiles" / "sim.toml"


@pytest.fixture(scope="session")
def workspace(tmp_path_factory):
    """Folder with ``session.mcap`` and ``sessions/``."""
    folder = tmp_path_factory.mktemp("api")
    rigd = Path(sys.executable).parent / "rigd"
    command = [rigd, "run", "chirp", "--profile", PROFILE, "--fast", "--duration", "20"]
    command += ["--rest", "0.5", "--ring-down", "1", "--seed", "3", "--repeat", "2"]
    subprocess.run(
        [*command, "--output", folder / "sessions"], check=True, capture_output=True, timeout=60
    )
    shutil.copy(min((folder / "sessions").glob("*.mcap")), folder / "session.mcap")
    return folder
