"""The cases of ``kill_rig.py``, one of each kind that no test of `rigd run` has."""

import importlib.util
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

STANDSTILL_S = 1.0
"""Pause of a virtual machine that no test fails for, even at the worst moment."""


@pytest.fixture(scope="module")
def rig():
    spec = importlib.util.spec_from_file_location(
        "kill_rig", Path(__file__).with_name("kill_rig.py")
    )
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.process
@pytest.mark.parametrize(
    ("victim", "how", "moment_s", "others"),
    [
        # Each by itself is killed in tests/cli/test_run.py.
        pytest.param("all", signal.SIGKILL, 0.6, {"analysed": True}, marks=pytest.mark.further),
        # The others have to continue without it, for the drive and for the file.
        pytest.param(
            *("all", signal.SIGSTOP, 0.4, {"afterwards": signal.SIGKILL}), marks=pytest.mark.slow
        ),
        # In a session of this process it hangs in tests/cli/test_run.py.
        pytest.param("recorder", signal.SIGSTOP, 0.3, {"sweep_s": 1.5}, marks=pytest.mark.slow),
        # In a session of this process it is killed in tests/live/test_live_rig.py.
        pytest.param("publisher", signal.SIGKILL, 0.3, {"sweep_s": 1.5}, marks=pytest.mark.slow),
        # What its silence does is in tests/engine/test_attendance.py.
        pytest.param("supervisor", signal.SIGSTOP, 0.3, {}, marks=pytest.mark.slow),
    ],
)
def test_drive_goes_off_and_record_stays(rig, tmp_path, victim, how, moment_s, others):
    options = {"analysed": False, "grace_s": STANDSTILL_S, **others}
    verdict = rig.run_case(rig.Case(victim, how, moment_s, **options), tmp_path)
    assert not verdict.complaints, f"{verdict.row()}\n{verdict.stderr}"


@pytest.mark.parametrize(
    ("off_s", "torque_nm", "complaint"),
    [(10.29, 0.0, ""), (10.4, 0.0, "off after 0.400 s"), (None, 0.2, "on in the end")],
)
def test_complaint_if_drive_stays_on(rig, tmp_path, off_s, torque_nm, complaint):
    log = rig.DriveLog(tmp_path / "drive.jsonl")
    torques = [(9.0, 0.1, True), (10.001, 0.2, True)]
    if off_s is not None:
        torques.append((off_s, torque_nm, False))
    log.entries = [
        {"t_s": t_s, "device": "drive", "what": "torque", "torque_nm": torque, "enabled": enabled}
        for t_s, torque, enabled in torques
    ]
    verdict = rig.Verdict(rig.Case("control", signal.SIGKILL, 1.0))
    rig._check_drive(verdict, log, 10.0, 10.0, was_on=True)
    assert complaint in "; ".join(verdict.complaints)
    assert bool(verdict.complaints) == bool(complaint)


def test_complaint_if_a_command_takes_too_long(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(rig, "BIN", tmp_path)
    monkeypatch.setattr(rig, "_COMMAND_S", 0.05)
    for name in ("analyze", "rigd"):
        (tmp_path / name).write_text("#!/bin/sh\nexec sleep 20\n")
        (tmp_path / name).chmod(0o700)
    verdict = rig.Verdict(rig.Case("control", signal.SIGKILL, 1.0))
    assert rig._analysed(verdict, tmp_path / "a.mcap", 1000) == "too slow"
    part = tmp_path / "a.mcap.part"
    part.write_bytes(b"x")
    assert rig._recovered(verdict, part, SimpleNamespace(folder=tmp_path)) is None
    assert verdict.complaints == [
        "analyze a.mcap: not done after 0.05 s",
        "rigd recover: not done after 0.05 s",
    ]
