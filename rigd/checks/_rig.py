"""The whole check of a rig, in the order in which one thing rules out the next."""

from pathlib import Path

from rigd.checks._devices import inspect_devices
from rigd.checks._machine import machine_rows, rights_rows
from rigd.checks._on_paper import eds_rows, loop_rows, profile_rows, travel_rows, wiring_rows
from rigd.checks._rows import Row, Verdict
from rigd.profile import Profile


def check_rig(profile: Profile) -> list[Row]:
    """Check the rig of a profile without a torque: on paper, this computer, then the devices.

    Where the identifiers meet or the bus cannot carry the frames, nothing is connected: devices
    might obey what is not meant for them.
    """
    wiring = list(wiring_rows(profile.rig))
    rows = [
        *_drive_rows(profile),
        *profile_rows(profile),
        *wiring,
        *loop_rows(profile),
        *travel_rows(profile),
        *rights_rows(profile.realtime),
        *machine_rows(profile.realtime),
    ]
    if any(row.verdict is Verdict.FAIL for row in wiring):
        why = "not connected: first the bus has to be right"
        return [*rows, Row("devices", "connection", why, "", Verdict.SKIPPED)]
    return rows + inspect_devices(profile)


def _drive_rows(profile: Profile) -> list[Row]:
    """Hold the EDS that a profile names against what is asked of a drive."""
    settings = profile.rig.cia402
    return list(eds_rows(Path(settings.eds), profile.rig)) if settings and settings.eds else []
