"""The how-tos of the README run as written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
RIGD = Path(sys.executable).parent / "rigd"
README = (PROJECT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def assert_went_well(process):
    output, errors = process.communicate()
    assert process.returncode == 0, output + errors
    assert "Traceback" not in errors


def tear_a_session(folder, name):
    """Leave what a recorder leaves that dies: a session file without its end."""
    folder.mkdir()
    command = [RIGD, "run", "hold", "--duration", "2", "--fast", "--output", "whole"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    (whole,) = (folder / "whole").glob("*.mcap")
    (folder / name).parent.mkdir()
    (folder / name).write_bytes(whole.read_bytes()[:-2000])


@pytest.mark.timeout(300)
def test_every_how_to_runs_as_written(write_profile, tmp_path, runtime_folder):
    shutil.copy(PROJECT / "hw_profiles" / "sim.toml", tmp_path / "my_rig.toml")
    shells, python = blocks("sh"), blocks("python")
    assert len(shells) >= 6
    assert len(python) == 1
    (recover,) = (shell for shell in shells if "rigd recover" in shell)
    shells.remove(recover)
    tear_a_session(tmp_path / "torn", re.search(r"rigd recover (\S+)", recover)[1])
    # The one in real time waits most of its time: beside the others, as a rig of its own, and one
    # that bears a machine that stands still.
    (live,) = (shell for shell in shells if "--live" in shell)
    shells.remove(live)
    patient = write_profile("sim", {"name": '"patient"'}, patient=True)
    live = live.replace("--live", f"--live --profile {patient}")
    # Job control, as on a terminal: the simulated rig of one how-to is ended by its job's number.
    script = "set -em\n" + "\n".join(shells)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "XDG_RUNTIME_DIR": str(runtime_folder)}

    def start(*command, folder=tmp_path):
        return subprocess.Popen(
            command,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )

    with start("bash", "-c", recover, folder=tmp_path / "torn") as process:
        assert_went_well(process)
    with start("bash", "-c", live) as beside:
        for command in (("bash", "-c", script), (sys.executable, "-c", python[0])):
            with start(*command) as process:
                assert_went_well(process)
        assert_went_well(beside)
    assert len(list((tmp_path / "sessions").glob("*.mcap"))) == 6
    for report in ("one_look", "another_look"):
        assert (tmp_path / report / "frf.png").stat().st_size > 50_000


def test_its_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if not target.startswith("http"):
            assert (PROJECT / target).exists(), target
