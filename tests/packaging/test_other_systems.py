"""The analyser on systems without POSIX: its modules and its whole command line.

On Windows and macOS the commands run as they are. On Linux `windows_like/sitecustomize.py` takes
from `rigd` and `analysis` what Windows does not have, and all packages that they do not require.
"""

import ast
import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from packages import required_distributions
from packaging.utils import canonicalize_name

from rigd.session import read_session
from rigd.testing import PAPER_BEAM, chirp_signals, write_session

pytestmark = [pytest.mark.process, pytest.mark.fit]

PROJECT = Path(__file__).parents[2]
WINDOWS_LIKE = Path(__file__).with_name("windows_like")
POSIX_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")


def names_of_platform(statements, platform):
    """Return the names that the description of a module defines for a platform."""
    names = set()
    for statement in statements:
        if isinstance(statement, ast.If):
            system = SimpleNamespace(platform=platform, version_info=sys.version_info)
            condition = compile(ast.Expression(statement.test), "condition", "eval")
            branch = statement.body if eval(condition, {"sys": system}) else statement.orelse
            names |= names_of_platform(branch, platform)
        elif isinstance(statement, (ast.ImportFrom, ast.Import)):
            names |= {alias.asname or alias.name for alias in statement.names}
        elif isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
            names.add(statement.name)
        elif isinstance(statement, ast.AnnAssign):
            names.add(statement.target.id)
        elif isinstance(statement, ast.Assign):
            names |= {target.id for target in statement.targets}
    return names


def missing_on_windows():
    """Return module → names that Windows does not have, by mypy's descriptions of the library."""
    stubs = Path(find_spec("mypy").origin).parent / "typeshed" / "stdlib"
    missing = dict.fromkeys(POSIX_MODULES)
    for module, stub in {"os": "os/__init__", "signal": "signal", "socket": "socket"}.items():
        statements = ast.parse((stubs / f"{stub}.pyi").read_text()).body
        missing[module] = sorted(
            names_of_platform(statements, "linux") - names_of_platform(statements, "win32")
        )
    return missing


def not_required():
    """Return the modules that are installed here, but not with `rigd` alone."""
    required = required_distributions(["rigd"]).keys()
    return {
        module
        for module, names in packages_distributions().items()
        if not {canonicalize_name(name) for name in names} & required
    }


@pytest.fixture(scope="module")
def variables():
    if sys.platform != "linux":
        return os.environ | {"PYTHONIOENCODING": "cp1252"}
    return os.environ | {
        "MISSING_ON_WINDOWS": json.dumps(missing_on_windows()),
        "MISSING_PACKAGES": json.dumps(sorted(not_required())),
        "PYTHONPATH": str(WINDOWS_LIKE),
        "PYTHONIOENCODING": "cp1252",  # what a pipe has there
    }


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Three short chirps of a beam with other noise."""
    folder = tmp_path_factory.mktemp("sessions")
    for seed in range(3):
        signals = chirp_signals(
            sweep_s=30.0, ring_down_s=5.0, rate_hz=250.0, start_hz=0.5, noise_nm=1e-3,
            quantum_rad=0.0, seed=seed,
        )  # fmt: skip
        write_session(folder / f"{seed}.mcap", replace(signals, metadata={}), beam=PAPER_BEAM)
    return folder


@pytest.fixture
def python(variables, tmp_path):
    """Run Python in an empty folder, and return what it prints."""

    def run(*arguments):
        done = subprocess.run(
            [sys.executable, *map(str, arguments)],
            cwd=tmp_path, env=variables, capture_output=True, encoding="cp1252", check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


ALL_MODULES = """
import importlib, pkgutil, analysis
names = [each.name for each in pkgutil.walk_packages(analysis.__path__, "analysis.")]
for name in names:
    importlib.import_module(name)
    module = importlib.import_module(name)
    for public in getattr(module, "__all__", ()):
        getattr(module, public)
assert len(names) > 100
"""


ONE_AFTER_THE_OTHER = """
import json, runpy, sys
for program, *arguments in json.loads(sys.argv[1]):
    sys.argv = [program, *arguments]
    try:
        runpy.run_module(program, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise
"""


@pytest.fixture
def run_commands(python):
    """Run commands in one process, once it has imported every module of the analyser."""

    def run(*commands):
        texts = [list(map(str, command)) for command in commands]
        return python("-c", ALL_MODULES + ONE_AFTER_THE_OTHER, json.dumps(texts))

    return run


@pytest.fixture
def analyze(python):
    return lambda *arguments: python("-m", "analysis", *arguments)


@pytest.mark.skipif(sys.platform != "linux", reason="nothing is simulated there")
@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import fcntl", "No module named 'fcntl'"),
        ("import os; os.getuid()", "has no attribute 'getuid'"),
        ("from signal import SIGHUP", "cannot import name 'SIGHUP'"),
        ("import socket; socket.AF_UNIX", "has no attribute 'AF_UNIX'"),
        ("import os; os.fork()", "has no attribute 'fork'"),
        ("open('/proc/self/stat')", "No such file"),
        ("open('12:30.mcap', 'w')", "filename"),
        ("f = open('a', 'w'); import os; os.remove('a')", "used by another process"),
        ("import canopen", "canopen"),
    ],
)
def test_the_simulation_refuses_what_windows_does_not_have(variables, tmp_path, code, words):
    done = subprocess.run(
        [sys.executable, "-c", f"__package__ = 'analysis.simulated'\n{code}"],
        cwd=tmp_path, env=variables, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert words in done.stderr.splitlines()[-1]


def test_every_module_can_be_imported_and_the_commands_run(run_commands, sessions, tmp_path):
    (tmp_path / "report").mkdir()  # an empty folder is taken
    printed = run_commands(
        ("rigd", "list", sessions),
        ("rigd", "info", sessions / "0.mcap"),
        ("analysis", sessions / "0.mcap", "--method", "welch", "--types", "I", "--weights", "const",
         "--report", "report", "--json", "fits.json", "--figures", "svg"),
        ("analysis", "export", "record", sessions / "0.mcap", "record.csv"),
        ("analysis", "import", "record.csv", "imported.mcap",
         "--profile", PROJECT / "hw_profiles" / "sim.toml", "--time", "time_s:s",
         "--angle", "angle_rad:rad", "--torque", "coupling_torque_nm:N.m", "--sweep", "1,31"),
        ("analysis", "export", "frf", "imported.mcap", "frf.mat"),
    )  # fmt: skip
    assert "2.mcap" in printed
    assert "rate" in printed
    assert (tmp_path / "report" / "figures" / "welch_frf.svg").stat().st_size > 10_000
    assert json.loads((tmp_path / "fits.json").read_text("utf-8"))["fits"]
    assert not list(tmp_path.glob(".*"))  # nothing temporary remains
    imported, original = read_session(tmp_path / "imported.mcap"), read_session(sessions / "0.mcap")
    for field in ("angle_rad", "coupling_torque_nm"):
        assert np.array_equal(imported.samples[field], original.samples[field])
    assert (tmp_path / "frf.mat").stat().st_size > 1000


def test_a_session_needs_linux(sessions, variables):
    done = subprocess.run(
        [sys.executable, "-m", "rigd", "run", "chirp", "--fast"],
        cwd=sessions, env=variables, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("Error: rigd run needs Linux. ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="another system refuses it without this")
def test_a_rig_is_not_run_from_macos(tmp_path):
    without_affinity = "import os, sys; del os.sched_setaffinity; from rigd.__main__ import main; "
    done = subprocess.run(
        [sys.executable, "-c", without_affinity + "sys.argv = ['rigd', 'serve']; main()"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("Error: rigd serve needs Linux. ")


@pytest.mark.further
def test_a_campaign_has_workers(analyze, sessions, tmp_path):
    analyze(
        *sorted(sessions.glob("*.mcap")), "--method", "welch", "--types", "I", "--weights", "const",
        "--segment", "2000", "--overlap", "300", "--nfft", "8000",
        "--jobs", "2", "--report", "campaign", "--json", "campaign.json", "--figures", "svg",
    )  # fmt: skip
    document = json.loads((tmp_path / "campaign.json").read_text("utf-8"))
    assert len({fit["file"] for fit in document["fits"]} - {None}) == 3
    assert (tmp_path / "campaign" / "report.html").exists()


@pytest.mark.further
def test_whole_record_fits_and_their_model(analyze, sessions, tmp_path):
    analyze(
        sessions / "0.mcap", "--method", "record",
        "--report", "report", "--json", "fits.json", "--figures", "svg",
    )  # fmt: skip
    assert (tmp_path / "report" / "report.html").exists()
    analyze("export", "model", "fits.json", "model.mat")
    assert (tmp_path / "model.mat").stat().st_size > 1000


@pytest.mark.further
def test_touches_are_estimated(analyze, touch_file, tmp_path):
    analyze("touch", touch_file.path, "--report", "touches", "--json", "touches.json")
    assert len(json.loads((tmp_path / "touches.json").read_text("utf-8"))["touches"]) == 1
    assert (tmp_path / "touches" / "report.html").exists()
