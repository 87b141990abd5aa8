"""The how-to of docs/devices.md runs as written, with drives whose EDS files are public."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from eds_files import WITHOUT_TORQUE, eds_path

from rigd.devices.cia402.requirements import ACCEPTABLE_MISSING_FUNCTIONS
from rigd.profile import load_profile

PAGE = (Path(__file__).parents[2] / "docs" / "devices.md").read_text("utf-8")
SHELLS = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture
def run(tmp_path, runtime_folder):
    """Run a script in the folder of an operator; job control as on a terminal."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "XDG_RUNTIME_DIR": str(runtime_folder)}

    def run(script):
        return subprocess.run(
            ["bash", "-c", f"set -em\n{script}"],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip

    return run


@pytest.mark.process
@pytest.mark.further  # its commands are parsed in test_documents.py
def test_documented_steps_from_eds_to_first_session(run, tmp_path):
    shutil.copy(eds_path("epos4_0170"), tmp_path / "drive.eds")
    assert len(SHELLS) == 4
    done = run("\n".join(SHELLS))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert "TO FILL IN" in done.stderr
    assert len(list((tmp_path / "first").glob("*-chirp.mcap"))) == 1
    assert load_profile(tmp_path / "new_rig.toml").rig.cia402.eds == str(tmp_path / "drive.eds")


@pytest.mark.process
def test_a_drive_without_torque_ends_at_the_first_step(run, tmp_path):
    shutil.copy(eds_path(WITHOUT_TORQUE[0]), tmp_path / "drive.eds")
    done = run("\n".join(SHELLS))
    assert done.returncode == 1
    assert "6502" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["drive.eds"]


def test_every_accepted_name_is_explained():
    for name in ACCEPTABLE_MISSING_FUNCTIONS:
        assert f"accepted as `{name}`" in PAGE
