"""Drive and sensor on their wires: the real ones, or the simulated rig that stands in for them."""

from dataclasses import replace
from pathlib import Path

from rigd.devices.canbus import CanLink
from rigd.devices.cia402.drive import Cia402Drive
from rigd.devices.contracts import DeviceError, Devices, WrenchSensor
from rigd.devices.parameters import RigParameters
from rigd.devices.registry import objections
from rigd.devices.simulator import SimulatorAddress, find_simulator

_LOCK_STEP_PATIENCE_US = 0.5e6
"""In lock-step the world waits for the replies, so a tick can wait for them too."""

_INTERFACES = Path("/sys/class/net")


def open_wired_rig(rig: RigParameters) -> Devices:
    """Make the drivers of a rig on CAN, or on CAN and a serial line.

    Raises
    ------
    DeviceError
        If identifiers collide, the bus would be too full, or the hardware and a simulated rig are
        both there.
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
    )


def _sensor(rig: RigParameters, link: CanLink, simulator: SimulatorAddress | None) -> WrenchSensor:
    if rig.devices.sensor == "ati_serial":
        from rigd.devices.ati.serial_sensor import AtiSerialSensor

        return AtiSerialSensor(rig, simulator)
    from rigd.devices.ati.can_sensor import AtiCanSensor

    return AtiCanSensor(rig, link)


def _refuse_ambiguity(rig: RigParameters, simulator: SimulatorAddress) -> None:
    """Refuse to guess between a simulated rig and hardware that is there as well."""
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
