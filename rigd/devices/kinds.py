"""Kinds of devices that a profile can name: those of rigd, and those of installed packages.

A package adds a kind by an entry point of the group ``rigd.devices`` (:mod:`rigd.plugins`), which
names a `rigd.devices.declaration.DeviceKind`.
"""

from typing import Final

from rigd.devices._shipped import SHIPPED
from rigd.devices.contracts import DeviceError
from rigd.devices.declaration import DeviceKind
from rigd.devices.parameters import DeviceSelection
from rigd.plugins import Plugin, Registry, error_of_package, load_declaration


def _load_device(plugin: Plugin) -> DeviceKind:
    """Import the kind of device that a package adds; raise PluginError if it is invalid."""
    kind = load_declaration(plugin, DeviceKind)
    if kind.open_drive is None and kind.open_sensor is None:
        raise plugin.error("it is neither drive nor sensor; add open_drive or open_sensor.")
    return kind


DEVICES: Final = Registry("rigd.devices", SHIPPED, _load_device)
"""Kinds of devices, by their names in a profile."""


def failure_of_device(error: Exception, selection: DeviceSelection) -> str:
    """Return the message for the operator of an exception that a device has raised.

    Parameters
    ----------
    error
        Exception in the control process.
    selection
        Drive and sensor of the profile.

    Raises
    ------
    Exception
        The given exception, if it is neither a device's error nor raised in a package's device.
    """
    if isinstance(error, DeviceError | OSError):
        return str(error)
    for name in (selection.drive, selection.sensor):
        owner_plugin = DEVICES.owner(name)
        if (
            owner_plugin is not None
            and (package_error := error_of_package(error, owner_plugin)) is not None
        ):
            return str(package_error)
    raise error


def selected_kinds(selection: DeviceSelection) -> tuple[DeviceKind, ...]:
    """Return the kinds of the drive and of the sensor that a profile names, as far as they exist.

    A device that is both drive and sensor is returned once.

    Raises
    ------
    PluginError
        If a package that adds one of these devices cannot be used.
    """
    device_names = dict.fromkeys((selection.drive, selection.sensor))
    return tuple(kind for name in device_names if (kind := DEVICES.get(name)) is not None)


def known_selections() -> list[str]:
    """Return the combinations of drive and sensor that fit, as phrases for messages.

    The last phrase names the devices that installed packages add.
    """
    selection_phrases = [
        f'drive = "{drive.name}" with sensor = "{sensor.name}"'
        for drive in SHIPPED.values()
        for sensor in SHIPPED.values()
        if drive.open_drive and sensor.open_sensor and can_be_combined(drive, sensor)
    ]
    added_device_names = [plugin.name for plugin in DEVICES.added_plugins()]
    return [
        *selection_phrases,
        *(
            [f"installed packages add {', '.join(added_device_names)}"]
            if added_device_names
            else []
        ),
    ]


def can_be_combined(drive: DeviceKind, sensor: DeviceKind) -> bool:
    """Return whether a kind of drive and a kind of sensor can be combined.

    Parameters
    ----------
    drive, sensor
        Kinds of devices; the first must be a drive and the second a sensor.
    """
    return (
        drive.open_drive is not None
        and sensor.open_sensor is not None
        and (not sensor.drives or drive.name in sensor.drives)
    )
