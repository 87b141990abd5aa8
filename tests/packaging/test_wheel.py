"""The wheel, installed apart from the checkout: what it holds is enough to run and to analyse."""

import os
import subprocess
import sys
import venv
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packages import required_distributions

from rigd.testing import chirp_signals, write_session

pytestmark = pytest.mark.process

PROJECT = Path(__file__).resolve().parents[2]
SHIPPED = sorted(path.name for path in (PROJECT / "hw_profiles").glob("*.toml"))


def completed(*command, folder, **variables):
    """Run a command; return its exit code and what it wrote."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return subprocess.run(
        list(map(str, command)),
        cwd=folder, env=environment | variables, capture_output=True, text=True, check=False,
    )  # fmt: skip


def run(*command, folder, **variables):
    """Run a command that goes well; return what it wrote to standard output."""
    done = completed(*command, folder=folder, **variables)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(made_once):
    def make(folder):
        # With the build back end of this environment, so that nothing is downloaded.
        run(
            *(sys.executable, "-m", "pip", "wheel", PROJECT, "--quiet", "--no-deps"),
            *("--no-build-isolation", "--no-index", "--wheel-dir", folder),
            folder=folder,
        )

    (path,) = made_once("wheel", make).glob("rigd-*.whl")
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


@pytest.fixture(scope="module")
def bare(wheel, made_once):
    """An environment with the wheel and what it requires, without any extra."""

    def make(folder):
        venv.create(folder, symlinks=True)
        (packages,) = folder.glob("lib/python3*/site-packages")
        run(
            *(sys.executable, "-m", "pip", "--python", folder / "bin" / "python"),
            *("install", "--quiet", "--no-deps", "--no-index", "--no-compile", wheel),
            folder=folder,
        )
        (metadata,) = packages.glob("rigd-*.dist-info")
        for each in required_distributions(Distribution.at(metadata).requires).values():
            for name in {file.parts[0] for file in each.files} - {".."}:
                if not (packages / name).exists():
                    (packages / name).symlink_to(each.locate_file(name))

    return made_once("bare", make)


@pytest.mark.further  # as in test_other_systems.py
def test_the_analyser_needs_no_extra(bare, tmp_path):
    signals = chirp_signals(sweep_s=30.0, ring_down_s=5.0, rate_hz=250.0, start_hz=0.5)
    session = write_session(tmp_path / "session.mcap", signals)

    def here(program, *options):
        return run(bare / "bin" / program, *options, folder=tmp_path)

    options = ("--method", "welch", "--types", "I", "--weights", "const", "--report", "report")
    here("analyze", session, *options)
    assert (tmp_path / "report" / "figures" / "welch_frf.svg").stat().st_size > 10_000
    here("analyze", "export", "record", session, "record.csv")
    (profile,) = bare.glob("lib/python3*/site-packages/rigd/profile/shipped/sim.toml")
    channels = ("--time", "time_s:s", "--angle", "angle_rad:rad")
    channels += ("--torque", "coupling_torque_nm:N.m")
    here("analyze", "import", "record.csv", "imported.mcap", "--profile", profile, *channels)
    assert "imported.mcap" in here("rigd", "list", tmp_path)
    assert "antenna_can" in here("rigd", "profiles")


def test_the_analyser_is_small(wheel):
    """Without what Python compiles: docs/platforms.md."""
    others = required_distributions(distribution("rigd").requires).values()
    files = [Path(each.locate_file(file)) for each in others for file in each.files]
    sizes = [file.stat().st_size for file in files if file.suffix != ".pyc" and file.exists()]
    own = sum(each.file_size for each in zipfile.ZipFile(wheel).infolist())
    assert 100e6 < sum(sizes) + own < 350e6


EXTRAS_OF_COMMANDS = [
    (("rigd", "run", "chirp", "--fast", "--live"), "--live", "live"),
    (("rigd", "serve", "--profile", "sim", "--web"), "The page", "rig"),
    (("rigd", "run", "chirp", "--profile", "antenna_can"), "The rig antenna_can", "rig"),
    (("analyze", "session.mcap", "--rerun", "session.rrd"), "--rerun", "live"),
]
CHECK = (("rigd", "check", "--profile", "sim"), "This command", "rig")


def assert_extra_named(done, subject, extra):
    assert done.returncode == 1, done.stdout + done.stderr
    message = f"Error: {subject} needs optional packages: pip install 'rigd[{extra}]'."
    assert done.stderr.splitlines()[-1] == message


@pytest.mark.parametrize(("command", "subject", "extra"), EXTRAS_OF_COMMANDS)
def test_a_missing_extra_is_named(
    rigd_here, analyze_here, tmp_path, monkeypatch, command, subject, extra
):
    write_session(tmp_path / "session.mcap", chirp_signals(sweep_s=2.0, ring_down_s=0.5))
    monkeypatch.setattr("rigd.extras.find_spec", lambda _: None)
    program, *options = command
    run_command = rigd_here if program == "rigd" else analyze_here
    assert_extra_named(run_command(*options), subject, extra)
    assert not list(tmp_path.rglob("*.mcap*"))[1:]  # nothing has run


def test_a_module_that_is_missed_on_import_is_named(tmp_path):
    command, *named = CHECK
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('can', 'canopen', 'serial', 'aiohttp')))\n"
        f"sys.argv[:] = {list(command)}; from rigd.__main__ import main; main()"
    )
    assert_extra_named(completed(sys.executable, "-c", code, folder=tmp_path), *named)


@pytest.mark.further
@pytest.mark.parametrize(("command", "subject", "extra"), [*EXTRAS_OF_COMMANDS, CHECK])
def test_an_extra_that_is_not_installed_is_named(bare, tmp_path, command, subject, extra):
    write_session(tmp_path / "session.mcap", chirp_signals(sweep_s=2.0, ring_down_s=0.5))
    runtime = {"XDG_RUNTIME_DIR": str(tmp_path)}
    program, *options = command
    done = completed(bare / "bin" / program, *options, folder=tmp_path, **runtime)
    assert_extra_named(done, subject, extra)
    assert not list(tmp_path.rglob("*.mcap*"))[1:]  # nothing has run


def test_it_holds_all_modules_and_profiles_and_nothing_else(wheel):
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    retained = {
        str(path.relative_to(PROJECT))
        for room in ("rigd", "analysis")
        for path in (PROJECT / room).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert held == retained | {f"rigd/profile/shipped/{name}" for name in SHIPPED}


@pytest.mark.slow  # .ci/run does it too, with dependencies as declared
def test_from_an_empty_folder_it_runs_a_session_and_analyses_it(installed, tmp_path):
    config, work = tmp_path / "config", tmp_path / "work"
    work.mkdir()

    def here(program, *options):
        variables = {"XDG_CONFIG_HOME": str(config), "COLUMNS": "120"}
        return run(installed / "bin" / program, *options, folder=work, **variables)

    # What runs below is what is installed: the checkout is nowhere to be imported from.
    requested = (
        "import analysis, rigd, sys; print(analysis.__file__, rigd.__file__, *sys.path, sep='|')"
    )
    analyser, rig, *path = here("python", "-c", requested).strip().split("|")
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
