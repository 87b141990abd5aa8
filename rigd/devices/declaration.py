"""Declaration of a kind of device: its settings, its checks and how it is opened.

A kind is a drive, a sensor, or both. The devices that come with rigd are declared in the same way
as those of installed packages (:mod:`rigd.devices.kinds`).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rigd.check_rows import CheckRow
from rigd.devices.contracts import Drive, WrenchSensor
from rigd.devices.parameters import RigParameters


@dataclass(frozen=True, slots=True)
class OpenedDrive:
    """Drive of a rig, not yet connected, and what it offers to the sensor of the same rig."""

    rig: RigParameters
    """Parameters of the rig with which the drive was created."""
    drive: Drive
    """Drive of the rig, not yet connected."""
    simulated: bool
    """Whether the drive is simulated, so that no motor moves."""
    renew_noise: Callable[[int | None], int] | None = None
    """See `rigd.devices.contracts.Devices.renew_noise`."""
    line: Any = None
    """Bus of the drive, for a sensor on the same bus; None: the drive has none."""
    simulated_sensor: WrenchSensor | None = None
    """Sensor that measures the simulated plant of this drive; None: the plant is not simulated
    here."""


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """Declaration of a kind of device that a profile can name in its section ``[devices]``."""

    name: str
    """Name in a profile, equal to the name of the entry point."""
    summary: str
    """One line on the device, for lists."""
    open_drive: Callable[[RigParameters], OpenedDrive] | None = None
    """Function that creates the drive without connecting it; None: the device is no drive."""
    open_sensor: Callable[[RigParameters, OpenedDrive], WrenchSensor] | None = None
    """Function that creates the sensor of a rig with this drive, without connecting it.

    None: the device is no sensor."""
    settings: type | None = None
    """Frozen dataclass with the keys of the profile's section of this name; None: no section.

    The fields are declared like those of :mod:`rigd.devices.parameters`: units in the names, ranges
    and help (``annotated_types.doc``) in ``Annotated``. A key may be omitted if its field has a
    default. `rigd.devices.parameters.RigParameters.settings_of` returns the values."""
    sections: tuple[str, ...] = ()
    """Sections of rigd's own that a profile with this device must have."""
    drives: tuple[str, ...] = ()
    """Names of the drives with which the sensor works; empty: with any drive."""
    in_process: bool = False
    """Whether the drive is a simulation in the process that opens it; it can then use the virtual
    clock."""
    address: Callable[[RigParameters], str] | None = None
    """Function that returns where the device is connected, as a phrase ("can0, node 3")."""
    stream_hz: Callable[[RigParameters], float] | None = None
    """Function that returns the records per second that the sensor streams; None: it is polled."""
    contradictions: Callable[[Mapping[str, Any]], Iterable[str]] | None = None
    """Function that yields messages on values of a profile that contradict each other.

    Its argument maps the dotted keys of the profile (``"rig.rate_hz"``) to validated values."""
    check_rows: Callable[[RigParameters], Iterable[CheckRow]] | None = None
    """Function that yields rows of ``rigd check`` for which no device is opened.

    No session is run while one of these rows has failed."""
    metadata: Callable[[RigParameters], Mapping[str, str]] | None = None
    """Function that returns metadata for the session file; rigd's own keys are not replaced."""

    @property
    def required_sections(self) -> tuple[str, ...]:
        """Sections that a profile with this device must have."""
        return self.sections if self.settings is None else (*self.sections, self.name)
