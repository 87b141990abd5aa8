"""The watch over a profile's limits, and how warm its motor is from one connection to the next."""

import json
import time
from contextlib import suppress
from math import exp, isfinite
from pathlib import Path

from rigd.devices.simulator import runtime_folder
from rigd.profile import Profile
from rigd.safety import LimitWatch


def make_watch(profile: Profile, heat_nm2: float = 0.0) -> LimitWatch:
    """Return the watch for the rig of a profile; it stays for as long as the rig is connected.

    Parameters
    ----------
    profile
        Of the rig.
    heat_nm2
        How warm the motor is: mean square of its torque over its thermal time constant, (N·m)².
    """
    rig = profile.rig
    watch = LimitWatch(
        profile.limits,
        rig.sensor.range,
        rig.rate_hz,
        resolution_rad=rig.encoder.resolution_rad,
        peak_torque_nm=rig.motor.peak_torque_nm,
        continuous_torque_nm=rig.motor.continuous_torque_nm,
        thermal_time_constant_s=rig.motor.thermal_time_constant_s,
        tare_warning_nm=profile.session.tare_drift_nm,
    )
    watch.heat_nm2 = heat_nm2
    return watch


def remember_heat(profile: Profile, heat_nm2: float) -> None:
    """Write down how warm the motor is now, for the next connection of this user.

    Without a place for it, the next one takes the motor for cold.
    """
    path = _heat_file(profile)
    document = {"heat_nm2": heat_nm2, "boot_s": time.clock_gettime(time.CLOCK_BOOTTIME)}
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        fresh = path.with_suffix(".new")
        fresh.write_text(json.dumps(document), encoding="utf-8")
        fresh.replace(path)


def recalled_heat_nm2(profile: Profile) -> float:
    """Return how warm the motor is still after the last connection, in (N·m)²; 0.0: not known.

    It has cooled down since by its thermal time constant.
    """
    try:
        document = json.loads(_heat_file(profile).read_text("utf-8"))
        heat_nm2, boot_s = float(document["heat_nm2"]), float(document["boot_s"])
    except (OSError, ValueError, TypeError, KeyError):
        return 0.0
    passed_s = time.clock_gettime(time.CLOCK_BOOTTIME) - boot_s
    if not isfinite(heat_nm2) or not passed_s >= 0.0:  # of before the computer was started anew
        return 0.0
    motor = profile.rig.motor
    warmest_nm2 = motor.peak_torque_nm**2
    return min(max(0.0, heat_nm2), warmest_nm2) * exp(-passed_s / motor.thermal_time_constant_s)


def _heat_file(profile: Profile) -> Path:
    plain = "".join(c if c.isalnum() else "-" for c in profile.name).strip("-")
    return runtime_folder() / f"heat-{plain}.json"
