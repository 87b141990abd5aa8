"""How far the shaft still turns when the loop fails and the drive has to switch itself off.

The worst that the limits allow: at the limit of the angle, moving outwards at the limit of the
speed, with the peak torque pushing on. The drive watches over the loop's heartbeat; until it misses
it, the torque stays. Then the shaft runs out, held back by its friction alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from rigd.checks.rows import Row, Verdict, grade
from rigd.devices.parameters import RigParameters
from rigd.profile import Profile
from rigd.safety import Limits

_STEP_S = 5e-5
_FOR_EVER_RAD = 100.0
_GROUP = "travel"


@dataclass(frozen=True, slots=True)
class Travel:
    """Angles from where the loop fails, in rad."""

    driven_rad: float
    """While the torque is still on."""
    coasting_rad: float
    """After it; infinite if no friction ends it."""

    @property
    def total_rad(self) -> float:
        """Angle to where the shaft stands."""
        return self.driven_rad + self.coasting_rad


def worst_travel(
    rig: RigParameters, limits: Limits, watchdog_s: float, max_speed_rad_s: float = inf
) -> Travel:
    """Return the worst travel after a failure of the loop.

    Parameters
    ----------
    rig, limits
        Of the profile.
    watchdog_s
        For how long the torque stays on.
    max_speed_rad_s
        Above which the drive by itself exerts no torque.

    Notes
    -----
    What is not known is taken at its worst: while the torque is on the beam does not hold the motor
    back, and after it all of the beam turns on with the shaft, as if it were rigid.
    """
    motor, beam = rig.motor, rig.beam
    light_kg_m2 = motor.inertia_kg_m2 + rig.sensor.tool_inertia_kg_m2
    heavy_kg_m2 = light_kg_m2 + beam.density_kg_per_m * beam.length_m**3 / 3
    speed_rad_s = limits.velocity_rad_s
    driven_rad = 0.0
    for _ in range(round(watchdog_s / _STEP_S)):
        torque_nm = motor.peak_torque_nm - _friction_nm(rig, speed_rad_s)
        faster_rad_s = max(0.0, speed_rad_s + torque_nm / light_kg_m2 * _STEP_S)
        before_rad_s, speed_rad_s = speed_rad_s, min(faster_rad_s, max_speed_rad_s)
        driven_rad += 0.5 * (before_rad_s + speed_rad_s) * _STEP_S
    coasting_rad = 0.0
    while speed_rad_s > 0.0:
        slower_rad_s = speed_rad_s - _friction_nm(rig, speed_rad_s) / heavy_kg_m2 * _STEP_S
        coasting_rad += 0.5 * (speed_rad_s + max(0.0, slower_rad_s)) * _STEP_S
        if coasting_rad > _FOR_EVER_RAD or slower_rad_s == speed_rad_s:
            return Travel(driven_rad, inf)
        speed_rad_s = slower_rad_s
    return Travel(driven_rad, coasting_rad)


def travel_rows(profile: Profile) -> Iterator[Row]:
    """Compare the worst travel with what is left behind the limit of the angle."""
    rig, limits, drive = profile.rig, profile.limits, profile.rig.cia402
    what = "worst, if the loop fails"
    if drive is None:
        why = "the drive is part of this program and ends with it"
        yield Row(_GROUP, what, why, "", Verdict.SKIPPED)
        return
    watchdog_s = drive.heartbeat_timeout_s
    free = worst_travel(rig, limits, watchdog_s)
    limited = drive.max_speed_rad_s > 0
    travel = worst_travel(rig, limits, watchdog_s, drive.max_speed_rad_s) if limited else free
    margin_rad = limits.stop_angle_rad - limits.angle_rad
    if limited:
        detail = (
            f"Travel: counts on the drive's own speed limit of {drive.max_speed_rad_s:g} rad/s "
            f"(object 6080); without it, it would be {free.total_rad:.2f} rad."
        )
    else:
        detail = (
            "Travel: the drive's own speed limit (object 6080) is not set; "
            "cia402.max_speed_rad_s shortens it."
        )
    if travel.total_rad > margin_rad:
        detail += (
            " Lower cia402.heartbeat_timeout_s, cia402.max_speed_rad_s, limits.velocity_rad_s or "
            "limits.angle_rad."
        )
    yield Row(
        _GROUP,
        what,
        f"{travel.total_rad:.2f} rad: {travel.driven_rad:.2f} rad in the {watchdog_s * 1e3:g} ms "
        f"of the drive's watchdog, {travel.coasting_rad:.2f} rad running out",
        f"at most {margin_rad:.2f} rad (limits.stop_angle_rad - limits.angle_rad)",
        grade(fail=not travel.total_rad <= margin_rad),
        detail,
    )


def _friction_nm(rig: RigParameters, speed_rad_s: float) -> float:
    return rig.motor.viscous_nm_s_per_rad * speed_rad_s + rig.motor.coulomb_nm
