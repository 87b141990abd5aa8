"""Drive and sensor on a CAN bus or serial line, opened as one rig, and the reset of a fault."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

from rigd.devices._registry import ActuationTarget, objections, open_devices
from rigd.devices.canbus import CanLink
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.contracts import DeviceError, Devices, WrenchSensor
from rigd.devices.parameters import RigParameters
from rigd.devices.running_simulator import SimulatorAddress, ask_simulator, find_simulator

_LOCK_STEP_PATIENCE_US = 0.5e6
"""In lock-step the simulated rig waits for the replies, so a tick can wait for them too."""

_INTERFACES = Path("/sys/class/net")


def open_wired_rig(rig: RigParameters) -> Devices:
    """Make the drivers of a rig on CAN, or on CAN and a serial line.

    Raises
    ------
    DeviceError
        If identifiers collide, the bus load is too high, or both hardware and a simulated rig are
        available.
    """
    bus = rig.can
    assert bus is not None
    refusals = objections(rig)
    if refusals:
        raise DeviceError("\n".join(refusals))
    simulator = find_simulator(rig.name)
    if simulator is not None:
        _refuse_ambiguity(rig, simulator)
        if simulator.lock_step:
            assert rig.acquisition is not None
            patient = replace(rig.acquisition, deadline_us=_LOCK_STEP_PATIENCE_US)
            rig = replace(rig, acquisition=patient)
    link = CanLink(bus, simulator)
    return Devices(
        drive=Cia402Drive(rig, link),
        sensor=_sensor(rig, link, simulator),
        simulated=simulator is not None,
        renew_noise=None if simulator is None else partial(_renew_noise, simulator),
    )


def _renew_noise(simulator: SimulatorAddress, seed: int | None) -> int:
    """Restart the noise of a simulated rig; return the seed."""
    return int(ask_simulator(simulator, {"renew_noise": seed})["seed"])


def _sensor(rig: RigParameters, link: CanLink, simulator: SimulatorAddress | None) -> WrenchSensor:
    if rig.devices.sensor == "ati_serial":
        from rigd.devices.ati import AtiSerialSensor

        return AtiSerialSensor(rig, simulator)
    from rigd.devices.ati import AtiCanSensor

    return AtiCanSensor(rig, link)


def _refuse_ambiguity(rig: RigParameters, simulator: SimulatorAddress) -> None:
    """Raise if both a simulated rig and hardware are available."""
    assert rig.can is not None
    found = []
    if simulator.can_socket and (_INTERFACES / rig.can.channel).exists():
        found.append(f"the CAN interface {rig.can.channel}")
    if simulator.serial_port and rig.ati_serial is not None and Path(rig.ati_serial.port).exists():
        found.append(f"the serial port {rig.ati_serial.port}")
    if found:
        raise DeviceError(
            f"A simulated rig of {rig.name} is running (rigd simulate, process {simulator.pid}), "
            f"and {' and '.join(found)} of the real one is here too; stop the simulated rig, or "
            "unplug the real one."
        )


@runtime_checkable
class ResettableDrive(Protocol):
    """Drive that can be in fault; drives simulated in this process cannot."""

    def reset_fault(self) -> str | None:
        """Switch off, reset a fault, check that it would get ready; return the fault, or None.

        Raises
        ------
        DeviceError
            If the drive may still turn, the fault persists, or no session could be started.
        """


def reset_drive(rig: RigParameters, moving: ActuationTarget | None = None) -> str:
    """Reset the fault of a rig's drive, and release the drive.

    Parameters
    ----------
    rig, moving
        See :func:`rigd.devices._registry.open_devices`.

    Returns
    -------
    str
        Fault that was found and present state of the drive, for the operator.

    Raises
    ------
    DeviceError
        If the drive does not answer, may still turn, the fault persists, or the drive does not
        become ready, for instance because STO is open.
    """
    drive = open_devices(rig, moving).drive
    if not isinstance(drive, ResettableDrive):
        return "Each session simulates a new drive: there is no fault to reset."
    try:
        fault = drive.reset_fault()
    finally:
        drive.close()
    if fault is None:
        return (
            "The drive is not in fault, so there is nothing to reset. Its statusword shows it off "
            "and it gets ready to switch on: the next session can be started."
        )
    return (
        f"The drive was in fault: {fault}. The fault is reset. Its statusword shows it off and it "
        "gets ready to switch on: the next session can be started."
    )
