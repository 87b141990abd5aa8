"""A package that `rigd plugins new` makes passes its own tests, and is a device of rigd."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packages import rigd_with
from typer.testing import CliRunner

from rigd.cli.app import app

PROJECT = Path(__file__).parents[2]


@pytest.mark.process
def test_a_new_package_passes_its_tests_and_joins(tmp_path):
    folder = tmp_path / "own"
    code, output, errors = rigd_with(tmp_path, "plugins", "new", "mysensor", "--folder", folder)
    assert code == 0, output + errors
    # As pip would install it.
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    metadata = folder / f"{project['name']}-{project['version']}.dist-info"
    metadata.mkdir()
    ((group, names),) = project["entry-points"].items()
    lines = [f"[{group}]", *(f"{name} = {reference}" for name, reference in names.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error",
         folder / "tests"],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "9 passed" in done.stdout
    code, section, _ = rigd_with(folder, "plugins", "show", "mysensor", cwd=tmp_path)
    assert code == 0
    assert '# address of the instrument\nhost = "…"\n' in section
    follow_the_page(folder, tmp_path / "lab")


def follow_the_page(package, work):
    """Do what docs/your_own_device.md says with an installed package."""
    page = (PROJECT / "docs" / "your_own_device.md").read_text("utf-8")
    (section,) = re.findall(r"^```toml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    commands = re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    lines = "".join(commands).splitlines()
    assert [line.partition(" ")[0] for line in lines] == ["rigd"] * 4
    work.mkdir()
    for line in lines:
        arguments = line.replace("--duration 20", "--duration 2 --no-look").split()[1:]
        own = {"XDG_CONFIG_HOME": str(work)}
        code, output, errors = rigd_with(package, *arguments, cwd=work, environment=own)
        assert code == 0, output + errors
        if arguments[:2] == ["profiles", "copy"]:
            (profile,) = work.rglob("lab.toml")
            text, chosen = re.subn(r'\nsensor = ".*"', '\nsensor = "mysensor"', profile.read_text())
            assert chosen == 1
            profile.write_text(text + section)
    assert list(work.glob("sessions/*-chirp.mcap"))


@pytest.mark.parametrize("name", ["Upper", "cia402", "a b", "../x"])
def test_a_name_that_cannot_be_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["plugins", "new", name])
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())
