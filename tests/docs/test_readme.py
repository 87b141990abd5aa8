"""The how-tos of the README run as written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# Sessions in real time share a core: one at a time.
pytestmark = pytest.mark.xdist_group("realtime")

PROJECT = Path(__file__).parents[2]
README = (PROJECT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


@pytest.mark.timeout(300)
def test_every_how_to_runs_as_written(tmp_path, runtime_folder):
    shutil.copy(PROJECT / "hw_profiles" / "sim.toml", tmp_path / "my_rig.toml")
    shells, python = blocks("sh"), blocks("python")
    assert len(shells) >= 6
    assert len(python) == 1
    # Job control, as on a terminal: the simulated rig of one how-to is ended by its job's number.
    script = "set -em\n" + "\n".join(shells)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "XDG_RUNTIME_DIR": str(runtime_folder)}
    for command in (["bash", "-c", script], [sys.executable, "-c", python[0]]):
        done = subprocess.run(
            command,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
    assert len(list((tmp_path / "sessions").glob("*.mcap"))) == 5
    for report in ("one_look", "another_look"):
        assert (tmp_path / report / "frf.png").stat().st_size > 50_000


def test_its_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if not target.startswith("http"):
            assert (PROJECT / target).exists(), target
