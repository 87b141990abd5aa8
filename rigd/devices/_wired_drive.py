"""Open a CiA 402 drive on its CAN bus, or on the simulator that replaces the bus."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rigd.devices._bus_conflicts import bus_conflicts
from rigd.devices.canbus import CanLink
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.contracts import DeviceError
from rigd.devices.declaration import OpenedDrive
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import SimulatorAddress, ask_simulator, find_simulator

_LOCK_STEP_DEADLINE_US = 0.5e6
"""Deadline in microseconds for replies of a simulated rig in lock-step.

It may be long, since the simulated rig waits for the loop."""

_NETWORK_INTERFACES_FOLDER = Path("/sys/class/net")
"""Folder in which the kernel lists the network interfaces, CAN included."""


@dataclass(frozen=True, slots=True)
class WiredConnection:
    """CAN bus of a CiA 402 drive, and the simulator that replaces the hardware, if one runs."""

    can_link: CanLink
    """Bus of the drive."""
    simulator: SimulatorAddress | None
    """Simulator of the rig's bus and serial line; None: the hardware is used."""


def open_wired_drive(rig: RigParameters) -> OpenedDrive:
    """Create the drive of a rig on CAN; nothing is connected yet.

    Raise `DeviceError` if identifiers collide, the bus load is too high, or both hardware and a
    simulated rig are available.
    """
    bus_settings = rig.can
    assert bus_settings is not None
    conflict_sentences = bus_conflicts(rig)
    if conflict_sentences:
        raise DeviceError("\n".join(conflict_sentences))
    running_simulator = find_simulator(rig.name)
    if running_simulator is not None:
        _refuse_simulator_and_hardware(rig, running_simulator)
        if running_simulator.lock_step:
            assert rig.acquisition is not None
            acquisition_with_long_deadline = replace(
                rig.acquisition, deadline_us=_LOCK_STEP_DEADLINE_US
            )
            rig = replace(rig, acquisition=acquisition_with_long_deadline)
    can_link = CanLink(bus_settings, running_simulator)
    return OpenedDrive(
        rig,
        Cia402Drive(rig, can_link),
        simulated=running_simulator is not None,
        renew_noise=None
        if running_simulator is None
        else partial(_restart_simulator_noise, running_simulator),
        line=WiredConnection(can_link, running_simulator),
    )


def _restart_simulator_noise(simulator: SimulatorAddress, seed: int | None) -> int:
    """Restart the noise of a simulated rig with a seed (None: a random one); return the seed."""
    return int(ask_simulator(simulator, {"renew_noise": seed})["seed"])


def _refuse_simulator_and_hardware(rig: RigParameters, simulator: SimulatorAddress) -> None:
    """Raise if both a simulated rig and the hardware that it replaces are available."""
    assert rig.can is not None
    available_hardware = []
    if simulator.can_socket and (_NETWORK_INTERFACES_FOLDER / rig.can.channel).exists():
        available_hardware.append(f"the CAN interface {rig.can.channel}")
    if simulator.serial_port and rig.ati_serial is not None and Path(rig.ati_serial.port).exists():
        available_hardware.append(f"the serial port {rig.ati_serial.port}")
    if available_hardware:
        raise DeviceError(
            f"A simulated rig of {rig.name} is running (rigd simulate, process {simulator.pid}), "
            f"and {' and '.join(available_hardware)} of the real one is here too; stop the "
            "simulated rig, or unplug the real one."
        )
