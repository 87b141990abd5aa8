"""Registry of the drivers that a profile can name; only the named drivers are imported."""

import importlib
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import cast

from rigd.devices._unknown import describe_unknown_values
from rigd.devices.contracts import DeviceError, Devices
from rigd.devices.parameters import DeviceSelection, RigParameters
from rigd.devices.running_simulator import differences, find_simulator
from rigd.errors import UserError
from rigd.extras import require_extra

# Drive and sensor use the same plant or bus, so drivers are opened in pairs.
_OPENERS = {
    DeviceSelection(drive="sim", sensor="sim"): ("rigd.sim._devices", "open_simulated_rig"),
    DeviceSelection(drive="cia402", sensor="ati_can"): (
        "rigd.devices._wired_rig",
        "open_wired_rig",
    ),
    DeviceSelection(drive="cia402", sensor="ati_serial"): (
        "rigd.devices._wired_rig",
        "open_wired_rig",
    ),
}
"""Module and function that open a pair of drive and sensor, by the selection in a profile."""


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

        It can on a rig simulated in this process, and on ``rigd simulate`` in lock-step.
        """
        return self in (ActuationTarget.SIMULATED, ActuationTarget.LOCK_STEP)


def check_selection(selection: DeviceSelection, source: Path | None = None) -> None:
    """Raise if there are no drivers for the drive and sensor that a profile names.

    Parameters
    ----------
    selection
        Drive and sensor that a profile names.
    source
        The profile's file, for the message.

    Raises
    ------
    UnknownDeviceError
        If there is no such combination; the message lists the existing combinations.
    """
    if selection not in _OPENERS:
        known_pairs = "; ".join(f'drive = "{s.drive}" with sensor = "{s.sensor}"' for s in _OPENERS)
        file_prefix = "" if source is None else f"{source}: "
        raise UnknownDeviceError(
            f'{file_prefix}devices: drive = "{selection.drive}" with sensor = '
            f'"{selection.sensor}" is no '
            f"known combination; choose {known_pairs}."
        )


def actuation_target(rig: RigParameters) -> ActuationTarget:
    """Return what would move if the devices of a rig were opened now."""
    if rig.devices.drive == "sim":
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
        how = "in this process" if target is ActuationTarget.SIMULATED else target.value
        return f"No hardware: {rig.name} is simulated ({how})."
    assert rig.can is not None
    assert rig.cia402 is not None
    return (
        f"HARDWARE: {rig.name} moves the drive on {rig.can.interface} {rig.can.channel}, node "
        f"{rig.cia402.node_id}."
    )


def simulated_differently(rig: RigParameters) -> list[str]:
    """Return the differences between a profile and the running simulator of its rig, as phrases.

    The list is empty if no simulator runs.
    """
    running_simulator = None if rig.devices.drive == "sim" else find_simulator(rig.name)
    return [] if running_simulator is None else differences(rig, running_simulator)


def bus_conflicts(rig: RigParameters) -> list[str]:
    """Return the reasons why the devices of a rig cannot use one CAN bus, as sentences.

    The list is empty if they can. Nothing is sent on the bus.
    """
    if rig.can is None:
        return []
    require_extra("rig", f"The rig {rig.name}")
    from rigd.devices.canbus import MAX_LOAD, bus_load, check_identifiers

    conflict_reasons = check_identifiers(rig)
    worst_load = bus_load(rig).worst
    if worst_load > MAX_LOAD:
        conflict_reasons.append(
            f"The frames of a tick take up to {100 * worst_load:.0f} % of the CAN bus at "
            f"{rig.can.bitrate_bit_s} bit/s, more than {100 * MAX_LOAD:.0f} %; choose a higher "
            "can.bitrate_bit_s or a lower rig.rate_hz."
        )
    return conflict_reasons


def simulator() -> ModuleType:
    """Import and return the package `rigd.sim.wire`, which simulates a rig's bus and line."""
    return importlib.import_module("rigd.sim.wire")


def open_devices(rig: RigParameters, target: ActuationTarget | None = None) -> Devices:
    """Create the drivers that a profile names; nothing is connected yet.

    Parameters
    ----------
    rig
        Parameters of a profile.
    target
        What the operator has confirmed to move, or None if nothing was confirmed.

    Raises
    ------
    UnknownDeviceError
        If the profile names drivers that do not exist.
    DeviceError
        If the drivers cannot work with the profile, a value of the profile is unknown, or something
        else would move now than was confirmed.
    """
    check_selection(rig.devices)
    unknown_text = describe_unknown_values(rig)
    if unknown_text:
        raise DeviceError(unknown_text)
    module_name, opener_name = _OPENERS[rig.devices]
    opener = cast(
        "Callable[[RigParameters], Devices]",
        getattr(importlib.import_module(module_name), opener_name),
    )
    devices = opener(rig)
    if target is not None and devices.simulated is (target is ActuationTarget.HARDWARE):
        present_target = "a simulated rig" if devices.simulated else ActuationTarget.HARDWARE.value
        raise DeviceError(
            f"{target.value.capitalize()} was to move, and now it would be {present_target}: rigd "
            "simulate was started or ended in between. Nothing was sent; start again."
        )
    return devices
