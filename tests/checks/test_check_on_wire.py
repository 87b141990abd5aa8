"""The real drivers on the simulated rig's bus, in lock-step: check, fault, reset, check."""

import subprocess
import sys
import time
from dataclasses import replace

import pytest
from cases import further

from rigd.check_rows import CheckResult, overall_verdict
from rigd.checks.devices import inspect_devices
from rigd.devices import reset_drive
from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import find_simulator

RUN = """
import sys
from rigd.profile import load_profile
from rigd.sim.wire import SimulatorOptions, run_simulator
sys.exit(run_simulator(load_profile(sys.argv[1]).rig, SimulatorOptions(lock_step=True, quiet=True)))
"""


@pytest.fixture(params=["antenna_can", further("antenna_serial")])
def profile(request, can_profile, serial_profile):
    profile = {"antenna_can": can_profile, "antenna_serial": serial_profile}[request.param]
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, profile.name], stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 300
    while find_simulator(profile.name) is None and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.02)
    yield profile
    process.terminate()
    sys.stderr.write(process.communicate(timeout=300)[1])


@pytest.mark.process
def test_a_fault_is_found_and_not_reset(profile, monkeypatch):
    from rigd.sim.wire import inject

    monkeypatch.setattr("rigd.checks.devices.EXCHANGE_CHECK_TICKS", 100)
    rows = inspect_devices(profile)
    assert overall_verdict(rows) == "ok", rows
    found = {(row.group, row.what): row.found for row in rows}
    assert "rigd simulate, in lock-step" in found["link", "what moves"]
    assert found["drive", "supported modes"] == "0x200"
    assert found["exchange", "angles missing"] == "0 of 100 ticks"
    assert found["exchange", "wrenches missing"] == "0 of 100 ticks"

    inject(profile.name, ["emcy,code=0x2310"])
    for _ in range(2):  # a check does not reset it
        failed = [row for row in inspect_devices(profile) if row.verdict is CheckResult.FAIL]
        assert [row.group for row in failed] == ["drive"]
        assert "0x2310" in failed[0].found
        assert "rigd reset" in failed[0].found

    assert "was in fault: current at the output" in reset_drive(profile.rig)
    assert "not in fault" in reset_drive(profile.rig)
    assert overall_verdict(inspect_devices(profile)) == "ok"


def test_reset_without_a_bus(can_profile):
    rig = can_profile.rig
    with pytest.raises(DeviceError, match="nocan9"):
        reset_drive(replace(rig, can=replace(rig.can, channel="nocan9")))
