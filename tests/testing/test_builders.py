"""`rigd.testing`: what it builds is what it says, and its checks refuse what is wrong."""

import doctest
import inspect
import itertools
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.record import load_record
from rigd import testing
from rigd.beam import Beam, Damping
from rigd.control import PidController, design_pid
from rigd.devices import open_devices
from rigd.profile import load_profile


@pytest.mark.parametrize(
    "offered", [testing.write_profile, testing.chirp_signals], ids=lambda offered: offered.__name__
)
def test_the_examples_run_as_written(offered):
    failed, tried = doctest.testmod(inspect.getmodule(offered))
    assert (failed, tried > 3) == (0, True)


def test_the_page_s_tests_pass(tmp_path):
    page = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text("utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    found = {"open_my_device": lambda: open_devices(load_profile("sim").rig)}
    exec(block, found)
    found["test_my_device"]()
    found["test_my_analysis"](tmp_path)


@pytest.mark.process
def test_it_needs_no_test_framework():
    code = "import sys; from rigd.testing import *; assert 'pytest' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_profile_has_only_the_requested_differences(tmp_path):
    values = {
        "name": "other",
        "limits.angle_rad": 0.5,
        "sensor.range": (10.0, 10.0, 30.0, 0.5, 0.5, 0.5),
        "cia402.accept_without": ("watchdog",),
    }
    path = testing.write_profile(tmp_path, values, base_profile="antenna_can")
    made, base = load_profile(path), load_profile("antenna_can")
    assert (path.name, made.name) == ("other.toml", "other")
    assert made.limits == replace(base.limits, angle_rad=0.5)
    assert made.rig.sensor.range == values["sensor.range"]
    assert made.rig.cia402 == replace(base.rig.cia402, accept_without=("watchdog",))
    assert made.sources["limits.angle_rad"] == base.sources["limits.angle_rad"]
    assert made.control == base.control


def test_a_section_that_there_is_not_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"sim has no section for cia402\.node_id, limit\.angle"):
        testing.write_profile(tmp_path, {"cia402.node_id": 5, "limit.angle_rad": 1.0})
    assert list(tmp_path.iterdir()) == []


def test_the_shipped_rig_is_the_papers():
    rig = load_profile("sim").rig
    assert (rig.beam, rig.damping) == (testing.PAPER_BEAM, testing.PAPER_DAMPING)


def test_the_torque_is_that_of_a_rigid_body_where_the_beam_is_stiff():
    """A motion with a smooth begin and end: the moment of inertia times the acceleration."""
    stiff = Beam(length_m=0.5, density_kg_per_m=0.03, bending_stiffness_n_m2=1e4)
    t = np.arange(4000) / 1000
    angle = 0.1 * np.sin(np.pi * t / 4) ** 4
    torque = testing.beam_torque(
        angle, 1000.0, beam=stiff, damping=Damping(), tool_inertia_kg_m2=1e-4
    )
    acceleration = np.gradient(np.gradient(angle, 1e-3), 1e-3)
    expected = (stiff.inertia_kg_m2 + 1e-4) * acceleration
    assert np.abs(np.abs(torque) - np.abs(expected))[5:-5].max() < 0.01 * np.abs(expected).max()


def test_a_file_states_what_was_put_into_it(tmp_path):
    signals = testing.chirp_signals(rest_s=0.5, sweep_s=8.0, ring_down_s=1.0, rate_hz=500.0)
    record = load_record(testing.write_session(tmp_path / "a.mcap", signals))
    assert record.rate_hz == 500.0
    assert record.beam == testing.PAPER_BEAM
    assert record.metadata["excitation"] == "chirp"
    np.testing.assert_array_equal(record.angle_rad, signals.angle_rad)
    np.testing.assert_array_equal(record.torque_nm, signals.torque_nm)
    assert (record.sweep.start, record.sweep.stop) == (250, 4250)


class Wrong:
    """The simulated drive, but for what is given."""

    def __init__(self, drive, **instead):
        self._drive = drive
        vars(self).update(instead)

    def __getattr__(self, name):
        return getattr(self._drive, name)


def test_the_shipped_controller_is_as_the_loop_relies_on():
    for check in testing.CONTROLLER_CHECKS:
        check(load_profile("sim"))


_PID_STEP, _PID_RESET = PidController.step, PidController.reset
_LEFT_BEHIND, _NOISE = [], itertools.count()


@pytest.mark.parametrize(
    ("method", "wrong", "complaint"),
    [
        ("step", lambda *_: float("nan"), "a torque is not finite"),
        ("step", lambda pid, *w: 2 * _PID_STEP(pid, *w), "exceeds motor.peak_torque_nm"),
        ("step", lambda pid, *w: _PID_STEP(pid, *w) + 0.1, "it gives 0.1 N·m at rest"),
        ("step", lambda pid, *w: _PID_STEP(pid, *w) + 1e-9 * next(_NOISE), "equal readings"),
        ("step", lambda *w: _LEFT_BEHIND.append([w]) or _PID_STEP(*w), "memory grows by"),
        ("reset", lambda pid, _: _PID_RESET(pid, 0.0), "after a reset at"),
    ],
)
def test_a_controller_that_is_wrong_is_refused(monkeypatch, method, wrong, complaint):
    monkeypatch.setattr(PidController, method, wrong)
    assert any(complaint in each for each in controller_complaints())
    _LEFT_BEHIND.clear()


def test_a_controller_that_winds_up_is_refused(monkeypatch):
    gains = design_pid(motor_inertia_kg_m2=2e-3, viscous_nm_s_per_rad=1e-2, pole_rad_s=80)
    monkeypatch.setattr(type(gains), "tracking_s", float("inf"))
    assert any("winding up" in each for each in controller_complaints())


def controller_complaints():
    """What the checks of controllers say of the PID."""
    for check in testing.CONTROLLER_CHECKS:
        try:
            check(load_profile("sim"))
        except AssertionError as error:
            yield str(error)


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        (lambda drive: {"disable": lambda: None}, "does not coast to a stop"),
        (lambda drive: {"command": lambda nm: drive.command(-nm)}, "towards positive"),
        (lambda drive: {"command": lambda nm: 1e3 * drive.command(nm)}, "reported as 300 N·m"),
        (lambda drive: {"command": lambda nm: drive.command(nm) or nm}, "before it is enabled"),
        (lambda drive: {"read_angle": lambda: float("nan")}, "an angle is not finite"),
        (lambda drive: {"angle_stale": True}, "the angle is stale"),
        (lambda drive: {"connect": lambda: drive.connect() or drive.enable()}, "it moves before"),
    ],
)
def test_a_drive_that_is_wrong_is_refused(wrong, complaint):
    def complaints():
        for check in testing.DEVICE_CHECKS:
            made = open_devices(load_profile("sim").rig)
            try:
                check(replace(made, drive=Wrong(made.drive, **wrong(made.drive))))
            except AssertionError as error:
                yield str(error)

    assert any(complaint in each for each in complaints())
