"""What the drive says of itself, and which safeguards it turned out to have."""

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Protocol, runtime_checkable

from rigd.checks.rows import Row, Verdict
from rigd.checks.text import name_of, value_of
from rigd.devices.cia402.requirements import WATCHDOG, Watchdog
from rigd.devices.cia402.setup import Outfit
from rigd.devices.parameters import RigParameters

_IN_HEX = ("vendor_id", "product_code", "supported_modes")


@runtime_checkable
class InspectableDrive(Protocol):
    """A drive with an identity; simulated ones in this process have none."""

    def identity(self) -> Mapping[str, object]:
        """Return what it said of itself when it was connected; the keys end in their units."""


@runtime_checkable
class OutfittedDrive(Protocol):
    """A drive whose objects were looked through when it was connected."""

    def outfit(self) -> Outfit | None:
        """Return what it turned out to have."""


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
    outfit = drive.outfit() if isinstance(drive, OutfittedDrive) else None
    if outfit is not None:
        yield from _safeguard_rows(outfit)


def _safeguard_rows(outfit: Outfit) -> Iterator[Row]:
    """Tell which watchdog stands, what stands in for what is missing, and what was accepted."""
    stands, after_s = outfit.watchdog, outfit.watchdog_s
    unproven = stands in (Watchdog.OWN, Watchdog.NONE)
    yield Row(
        "drive",
        "watchdog",
        f"{stands.value}, {after_s * 1e3:g} ms" if isfinite(after_s) else "none: accepted",
        "takes the torque off when this computer falls silent",
        Verdict.WARNING if unproven else Verdict.OK,
        _WATCHDOG_DETAIL.get(stands, ""),
    )
    accepted = outfit.accepted
    for row in outfit.lacks:
        missing = row.accept in accepted
        told = f"stands in: {row.stand_in}" if row.stand_in and row.accept != WATCHDOG else ""
        if row.accept == WATCHDOG:
            told = f"stands in: {stands.value}" if stands is not Watchdog.NONE else ""
        by_name = f'accepted by cia402.accept_without "{row.accept}"' if missing else ""
        yield Row(
            "drive",
            f"object {row.place} ({row.name})",
            "; ".join(("absent or not usable", *filter(None, (by_name, told)))),
            "",
            Verdict.WARNING if missing else Verdict.OK,
            f"{row.name}: {row.sentence}" if missing else "",
        )
    for text in outfit.assigned:
        yield Row("drive", "object set", text, "read back", Verdict.OK)


_WATCHDOG_DETAIL = {
    Watchdog.OWN: (
        "Watchdog: its time is what the profile says (cia402.own_watchdog_s), which nothing here "
        "can read back. Try it at a low torque: kill rigd, and see when the torque goes."
    ),
    Watchdog.NONE: (
        "Watchdog: should this computer fail with the torque on, nothing but the wired stop (STO) "
        "takes it off."
    ),
}
