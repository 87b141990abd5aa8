"""The wheel, installed apart from the checkout: what it holds is enough to run and to analyse."""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

PROJECT = Path(__file__).resolve().parents[2]
SHIPPED = sorted(path.name for path in (PROJECT / "hw_profiles").glob("*.toml"))


def run(*command, folder, **variables):
    """Run a command that goes well; return what it wrote to standard output."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder, env=environment | variables, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    # With the build back end of this environment, so that nothing is downloaded.
    run(
        *(sys.executable, "-m", "pip", "wheel", PROJECT, "--quiet", "--no-deps"),
        *("--no-build-isolation", "--no-index", "--wheel-dir", folder),
        folder=folder,
    )
    (path,) = folder.glob("rigd-*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """An environment with the wheel, and with what this one has of others' packages."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, symlinks=True)
    (packages,) = folder.glob("lib/python3*/site-packages")
    # Only folders, no .pth files in them: the one that leads to the checkout is not followed.
    others = [each for each in sys.path if Path(each).is_relative_to(sys.prefix)]
    assert others
    (packages / "others.pth").write_text("\n".join(others) + "\n")
    run(
        *(sys.executable, "-m", "pip", "--python", folder / "bin" / "python"),
        *("install", "--quiet", "--no-deps", "--no-index", wheel),
        folder=folder,
    )
    return folder


def test_it_holds_all_modules_and_profiles_and_nothing_else(wheel):
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    kept = {
        str(path.relative_to(PROJECT))
        for room in ("rigd", "analysis")
        for path in (PROJECT / room).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert held == kept | {f"rigd/profile/shipped/{name}" for name in SHIPPED}


@pytest.mark.slow  # .ci/run does it too, with dependencies as declared
def test_from_an_empty_folder_it_runs_a_session_and_analyses_it(installed, tmp_path):
    config, work = tmp_path / "config", tmp_path / "work"
    work.mkdir()

    def here(program, *options):
        variables = {"XDG_CONFIG_HOME": str(config), "COLUMNS": "120"}
        return run(installed / "bin" / program, *options, folder=work, **variables)

    # What runs below is what is installed: the checkout is nowhere to be imported from.
    asked = (
        "import analysis, rigd, sys; print(analysis.__file__, rigd.__file__, *sys.path, sep='|')"
    )
    analyser, rig, *path = here("python", "-c", asked).strip().split("|")
    for module in (analyser, rig):
        assert Path(module).is_relative_to(installed)
    assert str(PROJECT) not in path

    (shipped,) = installed.glob("lib/python3*/site-packages/rigd/profile/shipped")
    assert [line.rpartition(" (")[2] for line in here("rigd", "profiles").splitlines()] == [
        f"{shipped / name}, shipped)" for name in SHIPPED
    ]
    assert list(work.iterdir()) == []

    here("rigd", "profiles", "copy", "sim", "mine")
    mine = config / "rigd" / "profiles" / "mine.toml"
    assert f"({mine}, per-user folder)" in here("rigd", "profiles", "list")

    short = ("--duration", "5", "--ring-down", "1", "--output", "sessions")
    here("rigd", "run", "chirp", "--fast", "--profile", "sim", *short)
    (session,) = (work / "sessions").glob("*-chirp.mcap")
    here("analyze", session, "--report", "report")
    assert (work / "report" / "report.html").stat().st_size > 10_000
