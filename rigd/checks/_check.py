"""Complete check of a rig: offline, this computer, then the devices.

The order matters: a failed offline check can rule out that devices are connected.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.checks._offline_checks import offline_rows
from rigd.checks.devices import calibration_rows, inspect_devices
from rigd.checks.machine import machine_rows, rights_rows
from rigd.checks.offline import wiring_rows
from rigd.devices import unknown_values
from rigd.errors import UserError
from rigd.profile import Profile
from rigd.runner.planning import RigPreview, excitation_for


def check_rig(profile: Profile) -> list[CheckRow]:
    """Run all checks of a rig that need no torque, and return their results as table rows.

    The devices are not connected if identifiers collide or the bus load is too high, because a
    device might then act on frames for another device. They are not connected either if a value of
    the profile is unknown.
    """
    check_rows = _rows_without_devices(profile)
    if any(row.verdict is CheckResult.FAIL for row in wiring_rows(profile.rig)):
        skip_reason = "not connected: correct the bus first"
        return [
            *check_rows,
            CheckRow("devices", "connection", skip_reason, "", CheckResult.SKIPPED),
        ]
    if unknown_values(profile.rig):
        skip_reason = "not connected: enter the unknown values first"
        return [
            *check_rows,
            CheckRow("devices", "connection", skip_reason, "", CheckResult.SKIPPED),
        ]
    return check_rows + inspect_devices(profile)


def check_without_devices(
    profile: Profile, calibration: Mapping[str, Any] | None
) -> list[CheckRow]:
    """Run the checks that need no devices, for a rig whose devices a daemon uses.

    Parameters
    ----------
    profile
        Rig to check.
    calibration
        Calibration that the sensor reported when the daemon connected it, or None if it is not
        connected.

    Returns
    -------
    list of CheckRow
        Rows of the offline checks, of this computer, and of the calibration.
    """
    check_rows = _rows_without_devices(profile)
    if calibration is None:
        return [
            *check_rows,
            CheckRow("devices", "connection", "not connected", "", CheckResult.SKIPPED),
        ]
    check_rows.append(
        CheckRow("devices", "connection", "connected by the daemon", "", CheckResult.OK)
    )
    return [*check_rows, *calibration_rows(calibration, profile.rig)]


def _rows_without_devices(profile: Profile) -> list[CheckRow]:
    """Return the rows of all checks of a profile and this computer that need no devices."""
    return [
        *offline_rows(profile),
        *default_session_rows(profile),
        *rights_rows(profile.realtime),
        *machine_rows(profile.realtime),
    ]


def default_session_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the result on whether a default `rigd run chirp` stays within the profile's limits.

    If not, there is a warning only: other sessions, such as a hold, may stay within the limits.
    """
    try:
        chirp = excitation_for(profile, "chirp", {})
        percent_of_limits = 100 * RigPreview(profile).fraction_of_limits(chirp.reference_rad)
    except UserError:  # an unstable loop or an unknown value, which have rows of their own
        return
    exceeds_limits = not percent_of_limits <= 100
    yield CheckRow(
        "session",
        "chirp without options",
        f"predicted peaks reach {percent_of_limits:.0f} % of a limit",
        "at most 100 %",
        grade(fail=False, warn=exceeds_limits),
        "Session: rigd run chirp is refused with its default amplitude; it names the limit and the "
        "largest amplitude (--amplitude)."
        if exceeds_limits
        else "",
    )
