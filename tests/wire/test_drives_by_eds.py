"""Sessions on simulated drives that are made from EDS files."""

import time

import pytest
from eds_files import eds_path

from rigd.devices import reset_drive
from rigd.runner import Rig, RigError
from rigd.sim.wire import inject

pytestmark = pytest.mark.process

CHIRP = {"start_hz": 5.0, "stop_hz": 10.0, "rest_s": 0.1, "ring_down_s": 0.1, "duration_s": 0.5}


@pytest.mark.further  # as test_injected_faults.py has it of another drive
def test_a_drive_with_torque_mode_runs_again_after_a_fault(
    quiet_profile, start_simulator, run_order, load, drive_log, tmp_path
):
    path, log = quiet_profile("antenna_can"), tmp_path / "drive.jsonl"
    start_simulator(path, "--lock-step", "--log", log, "--eds", eds_path("elmo_gold"))
    profile = load(path)
    first = run_order(profile, "first", fast=True, **CHIRP)
    assert first.is_successful, first.reason
    written = {(e["index"], e["sub"]) for e in drive_log(log).of("sdo write")}
    assert ("1016", 1) in written
    assert ("60E0", 0) not in written  # read-only there
    inject(profile.name, ["emcy,code=0x2310"])
    assert "The fault is reset" in reset_drive(profile.rig)
    again = run_order(profile, "again", fast=True, **CHIRP)
    assert again.is_successful, again.reason


@pytest.mark.further  # as tests/devices/cia402/test_cia402_setup.py has it
def test_a_drive_without_torque_mode_is_refused_by_name(quiet_profile, start_simulator, load):
    path = quiet_profile("antenna_can")
    start_simulator(path, "--lock-step", "--eds", eds_path("pilz_prbt"))
    rig = Rig(load(path), uses_virtual_clock=True)
    begun = time.monotonic()
    with pytest.raises(RigError, match="no cyclic synchronous torque mode"):
        rig.connect()
    assert time.monotonic() - begun < 30.0
    rig.disconnect()


def test_the_simulated_drive_follows_the_eds_of_the_profile(quiet_profile, start_simulator, load):
    path = quiet_profile("antenna_can")
    text = path.read_text()
    path.write_text(text.replace("[cia402]\n", f'[cia402]\neds = "{eds_path("pilz_prbt")}"\n', 1))
    start_simulator(path, "--lock-step")
    printed = inject(load(path).name, [])
    assert "drive: pilz_prbt.eds" in printed


@pytest.mark.further  # as rigd check --eds has it
def test_an_invalid_file_ends_the_command(rigd, quiet_profile, runtime_folder, tmp_path):
    done = rigd("simulate", "--profile", quiet_profile("antenna_can"), "--eds", tmp_path / "no.eds")
    assert done.returncode == 1
    assert "cannot be read (No such file" in done.stderr
    assert "Traceback" not in done.stderr
