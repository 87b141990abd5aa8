"""Through the wires, one period per SYNC, the samples are those of the direct simulation."""

import time
from dataclasses import replace

import numpy as np
import pytest

from rigd.devices.parameters import DeviceSelection
from rigd.excitation import hold
from rigd.runner import Rig
from rigd.runner.request import SessionOrder
from rigd.runtime import StopRequest
from rigd.session import read_session
from rigd.sim.wire import inject

pytestmark = pytest.mark.process

# Of the devices alone all of these are compared in tests/sim/wire/process: of whole sessions those
# in which the loop itself does something else, or another line is read.
AGAIN = pytest.mark.slow
FURTHER = pytest.mark.further


@pytest.mark.parametrize(
    ("name", "values"),
    [
        pytest.param("antenna_can", {}, id="can"),
        pytest.param(
            "antenna_can",
            {"cia402.torque_delivery": '"on_arrival"'},
            id="on_arrival",
            marks=AGAIN,
        ),
        pytest.param(
            "antenna_can",
            {
                "acquisition.mode": '"previous_tick"',
                "encoder.delay_s": "1.0e-3",
                "sensor.delay_s": "1.0e-3",
            },
            id="previous_tick",
            marks=FURTHER,
        ),
        pytest.param("antenna_can", {"cia402.direction": "-1"}, id="turned_round", marks=AGAIN),
        pytest.param("antenna_serial", {}, id="serial", marks=FURTHER),
        pytest.param(
            "antenna_serial",
            {"ati_serial.filter": '"triangle"', "sensor.delay_s": "9.6e-4"},
            id="triangle",
            marks=AGAIN,
        ),
    ],
)
def test_samples_equal_those_of_the_direct_simulation(
    name, values, quiet_profile, start_simulator, run_order, load, tmp_path
):
    path = quiet_profile(name, values)
    profile = load(path)
    direct = replace(
        profile, rig=replace(profile.rig, devices=DeviceSelection(drive="sim", sensor="sim"))
    )
    start_simulator(path, "--lock-step")
    for which, rig_profile in (("wired", profile), ("direct", direct)):
        result = run_order(
            rig_profile, which, fast=True, duration_s=1.0, rest_s=0.2, ring_down_s=0.4
        )
        assert result.is_successful, result.reason
        assert result.scheduled == result.recorded == 1600
        assert result.missed == result.lost == 0
    wired = read_session(tmp_path / "wired.mcap")
    expected = read_session(tmp_path / "direct.mcap")
    assert (wired.metadata["simulated"], wired.metadata["drive"]) == ("true", "cia402")
    ours, theirs = wired.samples, expected.samples
    assert np.array_equal(ours["status"], theirs["status"])
    rig = profile.rig
    # One step of the encoder, and of the torque that the drive takes in thousandths.
    angle = np.abs(ours["angle_rad"] - theirs["angle_rad"]) / rig.encoder.resolution_rad
    _, end = wired.segments["sweep"]
    assert angle[:end].max() < 1.01
    # A motor that comes to rest sticks on either side of the set-point.
    assert angle[end:].max() < 10
    torque = ours["coupling_torque_nm"] - theirs["coupling_torque_nm"]
    # A step of the sensor and one of a raw gauge on either side, the tare's own, and what the
    # torque's thousandths do to the motion.
    assert np.abs(torque).max() < 6 * rig.sensor.resolution[5]
    assert torque.std() < rig.sensor.resolution[5]
    # The controller amplifies an encoder step: compare the torque as a whole.
    command = ours["torque_command_nm"] - theirs["torque_command_nm"]
    assert command.std() < 0.05 * theirs["torque_command_nm"].std()


@pytest.mark.slow
def test_a_rig_may_be_idle_between_sessions(quiet_profile, start_simulator, load, tmp_path):
    """Longer than the 5 s that the simulated drive waits for a host; then its STO is reported."""
    profile = load(quiet_profile("antenna_can", {"cia402.enable_timeout_s": "0.1"}))
    start_simulator(profile.path, "--lock-step")
    excitation = hold(rate_hz=1000.0, duration_s=0.1, rest_s=0.0, ring_down_s=0.0)
    rig = Rig(profile, uses_virtual_clock=True)

    def run(name):
        order = SessionOrder(profile, excitation, tmp_path / f"{name}.mcap")
        return rig.run(order, StopRequest(), lambda *_: None)

    def leave_alone(duration_s):
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            rig.check_control_process()
            time.sleep(0.2)

    try:
        rig.connect()
        assert run("first").is_successful
        leave_alone(5.5)
        assert run("second").is_successful
        inject(profile.name, ["sto"])
        leave_alone(1.5)
        refused = run("third")
        assert refused.outcome == "fault"
        assert "check STO" in refused.reason
    finally:
        rig.disconnect()
