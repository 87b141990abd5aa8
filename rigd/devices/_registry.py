"""Open the devices that a profile names, and state what will move; import no other drivers."""

import importlib
from enum import Enum
from pathlib import Path
from types import ModuleType

from rigd.devices._unknown import describe_unknown_values
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.kinds import DEVICES, can_be_combined, known_selections
from rigd.devices.parameters import DeviceSelection, RigParameters
from rigd.devices.running_simulator import find_simulator, profile_differences
from rigd.errors import UserError
from rigd.plugins import PluginError, plugin_errors


class UnknownDeviceError(UserError, ValueError):
    """Error: a profile names drivers that do not exist or cannot be combined."""


class ActuationTarget(Enum):
    """What moves when a session runs: the hardware, or which simulation."""

    HARDWARE = "the hardware"
    """The motor of the real rig."""
    SIMULATED = "the simulated rig"
    """A rig simulated in the process that opens it, under the real or the virtual clock."""
    SIMULATOR = "rigd simulate, by the clock"
    """A rig simulated by ``rigd simulate`` in real time."""
    LOCK_STEP = "rigd simulate, in lock-step"
    """A rig simulated by ``rigd simulate`` whose time advances with each SYNC."""

    @property
    def allows_virtual_clock(self) -> bool:
        """Whether a session on this target can run under the virtual clock instead of real time.

        True for a rig simulated in this process, and for ``rigd simulate`` in lock-step.
        """
        return self in (ActuationTarget.SIMULATED, ActuationTarget.LOCK_STEP)


def check_selection(selection: DeviceSelection, profile_path: Path | None = None) -> None:
    """Raise if there are no drivers for the drive and sensor that a profile names.

    Parameters
    ----------
    selection
        Drive and sensor that a profile names.
    profile_path
        Path of the profile's file, for the message; None: not stated.

    Raises
    ------
    UnknownDeviceError
        If there is no such combination; the message lists the existing combinations.
    PluginError
        If the package that adds one of the devices cannot be used.
    """
    drive, sensor = DEVICES.get(selection.drive), DEVICES.get(selection.sensor)
    if drive is None or sensor is None or not can_be_combined(drive, sensor):
        known_pairs = "; ".join(known_selections())
        file_prefix = "" if profile_path is None else f"{profile_path}: "
        raise UnknownDeviceError(
            f'{file_prefix}devices: drive = "{selection.drive}" with sensor = '
            f'"{selection.sensor}" is no '
            f"known combination; choose {known_pairs}."
        )


def is_simulated_here(rig: RigParameters) -> bool:
    """Return whether the drive of a rig is a simulation in the process that opens it."""
    kind = DEVICES.get(rig.devices.drive)
    return kind is not None and kind.in_process


def actuation_target(rig: RigParameters) -> ActuationTarget:
    """Return what would move if the devices of a rig were opened now."""
    if is_simulated_here(rig):
        return ActuationTarget.SIMULATED
    running_simulator = find_simulator(rig.name)
    if running_simulator is None:
        return ActuationTarget.HARDWARE
    return ActuationTarget.LOCK_STEP if running_simulator.lock_step else ActuationTarget.SIMULATOR


def describe_actuation_target(rig: RigParameters, target: ActuationTarget) -> str:
    """Return a sentence for the operator about what will move: the hardware or its simulation.

    Parameters
    ----------
    rig
        Parameters of the rig.
    target
        Result of `actuation_target`.
    """
    if target is not ActuationTarget.HARDWARE:
        simulation_location = (
            "in this process" if target is ActuationTarget.SIMULATED else target.value
        )
        return f"No hardware: {rig.name} is simulated ({simulation_location})."
    return f"HARDWARE: {rig.name} moves the drive on {drive_address(rig)}."


def drive_address(rig: RigParameters) -> str:
    """Return where the drive of a rig is connected, as a phrase such as "can0, node 3"."""
    kind = DEVICES.get(rig.devices.drive)
    if kind is None or kind.address is None:
        return rig.devices.drive
    with plugin_errors(DEVICES.owner(kind.name)):
        return kind.address(rig)


def simulation_differences(rig: RigParameters) -> list[str]:
    """Return the differences between a profile and the running simulator of its rig, as phrases.

    The list is empty if no simulator runs.
    """
    running_simulator = None if is_simulated_here(rig) else find_simulator(rig.name)
    return [] if running_simulator is None else profile_differences(rig, running_simulator)


def simulator() -> ModuleType:
    """Import and return the package `rigd.sim.wire`, the simulator on CAN bus and serial line."""
    return importlib.import_module("rigd.sim.wire")


def open_devices(rig: RigParameters, target: ActuationTarget | None = None) -> Devices:
    """Create the drivers that a profile names; nothing is connected yet.

    Parameters
    ----------
    rig
        Parameters of a profile.
    target
        What the operator has confirmed will move, or None if nothing was confirmed.

    Raises
    ------
    UnknownDeviceError
        If the profile names drivers that do not exist.
    DeviceError
        If the drivers cannot work with the profile, a value of the profile is unknown, or something
        else would move now than was confirmed.
    """
    check_selection(rig.devices)
    unknown_values_message = describe_unknown_values(rig)
    if unknown_values_message:
        raise DeviceError(unknown_values_message)
    try:
        devices = _create_devices(rig)
    except PluginError as error:
        raise DeviceError(str(error)) from error
    if target is not None and devices.simulated is (target is ActuationTarget.HARDWARE):
        present_target = "a simulated rig" if devices.simulated else ActuationTarget.HARDWARE.value
        raise DeviceError(
            f"{target.value.capitalize()} was to move, but now {present_target} would: rigd "
            "simulate was started or ended in between. Nothing was sent; start again."
        )
    return devices


def _create_devices(rig: RigParameters) -> Devices:
    """Create drive and sensor of a rig with a valid selection of devices."""
    drive_kind, sensor_kind = DEVICES.get(rig.devices.drive), DEVICES.get(rig.devices.sensor)
    assert drive_kind is not None
    assert drive_kind.open_drive is not None
    assert sensor_kind is not None
    assert sensor_kind.open_sensor is not None
    with plugin_errors(DEVICES.owner(drive_kind.name)):
        opened_drive = drive_kind.open_drive(rig)
    with plugin_errors(DEVICES.owner(sensor_kind.name)):
        sensor = sensor_kind.open_sensor(opened_drive.rig, opened_drive)
    return Devices(opened_drive.drive, sensor, opened_drive.simulated, opened_drive.renew_noise)
