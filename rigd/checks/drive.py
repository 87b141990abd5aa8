"""What the drive says of itself."""

from collections.abc import Iterator, Mapping
from typing import Protocol, runtime_checkable

from rigd.checks.rows import Row, Verdict
from rigd.checks.text import name_of, value_of
from rigd.devices.parameters import RigParameters

_IN_HEX = ("vendor_id", "product_code", "supported_modes")


@runtime_checkable
class InspectableDrive(Protocol):
    """A drive with an identity; simulated ones in this process have none."""

    def identity(self) -> Mapping[str, object]:
        """Return what it said of itself when it was connected; the keys end in their units."""


def drive_rows(drive: InspectableDrive, rig: RigParameters) -> Iterator[Row]:
    """Show identity and rated torque; what contradicts the profile was refused on connecting."""
    settings = rig.cia402
    wanted = {
        "rated_torque_nm": f"{rig.motor.rated_torque_nm:.4g} N·m",
        "supported_modes": "0x200 (cyclic torque) among them",
    }
    if settings is not None:
        wanted["vendor_id"] = f"{settings.vendor_id:#x}" if settings.vendor_id else "any"
        wanted["product_code"] = f"{settings.product_code:#x}" if settings.product_code else "any"
    for key, value in drive.identity().items():
        if key in _IN_HEX and isinstance(value, int):
            found = f"{value:#x}"
        else:
            found = "not stated by the drive" if value in (None, "") else value_of(key, value)
        yield Row("drive", name_of(key), found, wanted.get(key, ""), Verdict.OK)
