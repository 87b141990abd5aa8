"""Which rig is opened: the hardware, its simulation, or neither."""

import os
import socket
from dataclasses import replace

import pytest

from rigd.devices import ActuationTarget, actuation_target, open_devices, simulation_differences
from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import (
    SimulatorAddress,
    parameters_by_dotted_key,
    write_address_file,
)
from rigd.profile import load_profile


@pytest.fixture
def rig():
    return load_profile("antenna_can").rig


@pytest.fixture
def stand_in(runtime_folder):
    """Announce a simulated rig whose control socket answers, and nothing more."""
    path = str(runtime_folder / "control")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(path)
        listener.listen(8)
        yield lambda name, **more: write_address_file(
            name, SimulatorAddress(os.getpid(), path, **more)
        )


def test_actuation_targets(rig, stand_in):
    assert actuation_target(load_profile("sim").rig) is ActuationTarget.SIMULATED
    assert actuation_target(rig) is ActuationTarget.HARDWARE
    stand_in("another_rig")
    assert actuation_target(rig) is ActuationTarget.HARDWARE
    stand_in(rig.name)
    assert actuation_target(rig) is ActuationTarget.SIMULATOR
    stand_in(rig.name, lock_step=True)
    assert actuation_target(rig) is ActuationTarget.LOCK_STEP


def test_virtual_clock_only_without_real_time_devices():
    assert {each for each in ActuationTarget if each.allows_virtual_clock} == {
        ActuationTarget.SIMULATED,
        ActuationTarget.LOCK_STEP,
    }


def test_only_the_stated_target_moves(rig, stand_in):
    assert not open_devices(rig, ActuationTarget.HARDWARE).simulated
    with pytest.raises(DeviceError, match="was to move, but now the hardware would"):
        open_devices(rig, ActuationTarget.SIMULATOR)
    stand_in(rig.name, can_socket="/nowhere")
    assert open_devices(rig, ActuationTarget.SIMULATOR).simulated
    with pytest.raises(DeviceError, match="hardware was to move"):
        open_devices(rig, ActuationTarget.HARDWARE)


def test_devices_report_whether_they_are_simulated(rig, stand_in):
    assert not open_devices(rig).simulated
    stand_in(rig.name, can_socket="/nowhere")
    assert open_devices(rig).simulated


def test_colliding_identifiers_are_refused_before_sending(rig, runtime_folder):
    colliding = replace(rig, ati_can=replace(rig.ati_can, base_id=0x20))
    with pytest.raises(DeviceError, match=r"0x201"):
        open_devices(colliding)


def test_hardware_and_a_simulated_rig_are_refused(rig, stand_in):
    stand_in(rig.name, can_socket="/nowhere")
    absent, present = (
        replace(rig, can=replace(rig.can, channel=channel)) for channel in ("nocan9", "lo")
    )
    assert open_devices(absent).simulated
    with pytest.raises(DeviceError, match=r"is running .* and the CAN interface lo of the real"):
        open_devices(present)


def test_a_real_and_a_simulated_serial_port_are_refused(stand_in, tmp_path):
    rig = load_profile("antenna_serial").rig
    port = tmp_path / "ttyUSB0"
    rig = replace(rig, ati_serial=replace(rig.ati_serial, port=str(port)))
    stand_in(rig.name, can_socket="/nowhere", serial_port="/dev/null")
    assert open_devices(rig).simulated
    port.touch()
    with pytest.raises(DeviceError, match=r"the serial port .*ttyUSB0 of the real one"):
        open_devices(rig)


def test_an_overloaded_bus_is_refused(rig, runtime_folder):
    slow = replace(rig, can=replace(rig.can, bitrate_bit_s=500_000))
    with pytest.raises(DeviceError, match=r"up to 120 % of the CAN bus at 500000 bit/s"):
        open_devices(slow)


def test_differences_of_a_simulated_rig_are_reported(rig, stand_in):
    assert simulation_differences(rig) == []
    stand_in(rig.name, rig=parameters_by_dotted_key(rig))
    assert simulation_differences(rig) == []
    other = replace(
        rig,
        beam=replace(rig.beam, length_m=0.7),
        acquisition=replace(rig.acquisition, mode="previous_tick"),
    )
    assert simulation_differences(other) == [
        "beam.length_m = 0.98 instead of 0.7",
        'acquisition.mode = "same_tick" instead of "previous_tick"',
    ]
