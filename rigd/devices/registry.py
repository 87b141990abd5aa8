"""The drivers a profile can name, found without importing those it does not name."""

import importlib
from collections.abc import Callable
from typing import cast

from rigd.devices.contracts import Devices
from rigd.devices.parameters import RigParameters, Selection

# A simulated drive and a simulated sensor share one plant, so drivers are opened by the pair.
_OPENERS = {
    Selection(drive="sim", sensor="sim"): ("rigd.sim.devices", "open_simulated_rig"),
}


class UnknownDeviceError(ValueError):
    """A profile names drivers that do not exist or do not belong together."""


def check_selection(selection: Selection) -> None:
    """Refuse a selection of drivers that cannot be opened.

    Raises
    ------
    UnknownDeviceError
        Naming what there is to choose from.
    """
    if selection not in _OPENERS:
        known = "; ".join(f'drive = "{s.drive}" with sensor = "{s.sensor}"' for s in _OPENERS)
        raise UnknownDeviceError(
            f'devices: drive = "{selection.drive}" with sensor = "{selection.sensor}" is not a '
            f"known combination; choose {known}."
        )


def is_simulated(selection: Selection) -> bool:
    """Whether nothing real moves, so that the virtual clock may be used."""
    return selection.drive == "sim"


def open_devices(rig: RigParameters) -> Devices:
    """Make the drivers that a profile names; nothing is connected yet.

    Raises
    ------
    UnknownDeviceError
        If the profile names drivers that do not exist.
    """
    check_selection(rig.devices)
    module, name = _OPENERS[rig.devices]
    opener = cast(
        "Callable[[RigParameters], Devices]", getattr(importlib.import_module(module), name)
    )
    return opener(rig)
