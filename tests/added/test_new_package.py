"""A package that `rigd plugins new` makes passes its own tests, and is a part of rigd."""

import os
import subprocess
import sys
import tomllib

import pytest
from packages import rigd_with
from typer.testing import CliRunner

from rigd.cli.app import app


@pytest.mark.process
@pytest.mark.parametrize(
    ("options", "passed", "shown"),
    [
        ((), 9, '# address of the instrument\nhost = "…"\n'),
        (("--kind", "controller"), 8, '# In [control]: controller = "mypart"\n[mypart]\n'),
    ],
    ids=["device", "controller"],
)
def test_a_new_package_passes_its_tests_and_joins(tmp_path, options, passed, shown):
    folder = tmp_path / "own"
    code, output, errors = rigd_with(
        tmp_path, "plugins", "new", "mypart", *options, "--folder", folder
    )
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
    assert f"{passed} passed" in done.stdout
    code, output, _ = rigd_with(folder, "plugins", "show", "mypart", cwd=tmp_path)
    assert code == 0
    assert shown in output


@pytest.mark.parametrize(
    "arguments", [["Upper"], ["cia402"], ["a b"], ["../x"], ["pid", "--kind", "controller"]]
)
def test_a_name_that_cannot_be_is_refused(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["plugins", "new", *arguments])
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())
