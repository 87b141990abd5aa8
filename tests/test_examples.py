"""Each example runs in an empty folder with the right output; its device passes the contract."""

import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from operator import ne
from pathlib import Path

import pytest
import warm_start

from rigd.testing import DEVICE_CHECKS

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


def module_at(path):
    """Import a file that is in no package."""
    spec = spec_from_file_location(path.stem, path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(example, folder, *arguments, cold=False):
    """Run an example in a folder; return its output. A `cold` start turns warnings into errors."""
    command = [EXAMPLES / f"{example}.py", *arguments]
    if cold:
        command = [sys.executable, "-W", "error", *command]
    done = (subprocess if cold else warm_start).run(
        command, cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def values(pattern, printed):
    """Numbers that the lines beginning so give."""
    return [float(each) for each in re.findall(f"^{pattern}", printed, re.MULTILINE)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Output of the example that runs sessions, and its files, which the others read."""
    folder = tmp_path_factory.mktemp("sessions")
    printed = run("run_session", folder)
    return printed, sorted((folder / "sessions").glob("*.mcap"))


@pytest.fixture
def session(made):
    return made[1][0]


def test_sessions_are_run(made):
    printed, files = made
    assert len(files) == 2
    assert printed.splitlines() == [
        f"complete: 21500 of 21500 samples, {Path('sessions') / path.name}" for path in files
    ]


def test_a_session_is_read(session, tmp_path):
    printed = run("read_session", tmp_path, session)
    assert printed.startswith("antenna 3: chirp at 1000 Hz\n21500 samples of t_ns, tick, ")
    swept_rad = values(r"sweep: 20 s, angle ([\d.]+) rad peak to peak, torque", printed)
    assert swept_rad == pytest.approx([0.05], rel=0.2)
    assert "outcome: complete\n" in printed


def test_peaks_of_the_response_are_found(session, tmp_path):
    printed = run("frequency_response", tmp_path, session)
    undamped = [float(each) for each in re.findall(r"([\d.]+) Hz", printed.splitlines()[0])]
    for name in ("Welch", "whole record"):
        part = printed.partition(f"{name}: ")[2]
        assert values(r"  ([\d.]+) Hz, ", part)[:2] == pytest.approx(undamped, rel=0.02)


@pytest.mark.further  # as in tests/identify
def test_structures_are_fitted_and_one_is_selected(session, tmp_path):
    printed = run("fit_and_select", tmp_path, session, cold=True)
    fits = re.findall(r"^type (\w+), cost [\d.]+$", printed, re.MULTILINE)
    assert fits == ["III", "VI"]
    modes_hz = values(r"mode \d: ([\d.]+) Hz", printed)
    assert modes_hz == pytest.approx([2.57, 16.01, 44.8], rel=5e-3)
    assert values(r"lambda = ([\d.]+) ", printed) == pytest.approx([0.594], abs=0.03)


@pytest.mark.further  # as in tests/campaigns
def test_sessions_are_pooled(made, tmp_path):
    printed = run("campaign", tmp_path, *made[1], cold=True)
    assert "2 sessions\n" in printed
    pooled = re.findall(r"^type (.+)$", printed, re.MULTILINE)
    assert {"III", "VI", "VII"} <= set(pooled)  # the freest is always among them
    assert values(r"  (44[\d.]+) Hz, damping ratio", printed)


def test_user_device_turns(tmp_path):
    printed = run("own_device", tmp_path, cold=True)
    assert values(r"999 ms: ([\d.]+) rad", printed) == pytest.approx([0.1], abs=1e-3)


@pytest.mark.parametrize("check", DEVICE_CHECKS, ids=lambda check: check.__name__.strip("_"))
def test_user_device_passes_the_contract(check):
    check(module_at(EXAMPLES / "own_device.py").open_rigid_hub())


def test_user_device_has_noise():
    sensor = module_at(EXAMPLES / "own_device.py").open_rigid_hub().sensor
    assert all(map(ne, sensor.read_wrench(), sensor.read_wrench()))  # else a session ends at once


def test_each_example_is_tested_here():
    tested = set(re.findall(r'run\("(\w+)"', Path(__file__).read_text("utf-8")))
    assert tested == {path.stem for path in EXAMPLES.glob("*.py")}
    assert len(DEVICE_CHECKS) >= 4
