"""The whole check of a rig, in the order in which one thing rules out the next."""

from collections.abc import Mapping
from typing import Any

from rigd.checks._devices import calibration_rows, inspect_devices
from rigd.checks._gate import paper_rows
from rigd.checks._machine import machine_rows, rights_rows
from rigd.checks._on_paper import wiring_rows
from rigd.checks._rows import Row, Verdict
from rigd.devices import unknown_values
from rigd.profile import Profile


def check_rig(profile: Profile) -> list[Row]:
    """Check the rig of a profile without a torque: on paper, this computer, then the devices.

    Where the identifiers meet or the bus cannot carry the frames, nothing is connected: devices
    might obey what is not meant for them. Nor is it while a value of the profile is unknown.
    """
    rows = _rows_without_devices(profile)
    if any(row.verdict is Verdict.FAIL for row in wiring_rows(profile.rig)):
        why = "not connected: first the bus has to be right"
        return [*rows, Row("devices", "connection", why, "", Verdict.SKIPPED)]
    if unknown_values(profile.rig):
        why = "not connected: first the unknown values have to be entered"
        return [*rows, Row("devices", "connection", why, "", Verdict.SKIPPED)]
    return rows + inspect_devices(profile)


def check_beside(profile: Profile, calibration: Mapping[str, Any] | None) -> list[Row]:
    """Check the rig of a profile while a daemon has its devices: they are not asked anything.

    Parameters
    ----------
    profile
        Rig to check.
    calibration
        What the sensor told of itself when the daemon connected it; None: it is not connected.
    """
    rows = _rows_without_devices(profile)
    if calibration is None:
        return [*rows, Row("devices", "connection", "not connected", "", Verdict.SKIPPED)]
    rows.append(Row("devices", "connection", "connected by the daemon", "", Verdict.OK))
    return [*rows, *calibration_rows(calibration, profile.rig)]


def _rows_without_devices(profile: Profile) -> list[Row]:
    return [
        *paper_rows(profile),
        *rights_rows(profile.realtime),
        *machine_rows(profile.realtime),
    ]
