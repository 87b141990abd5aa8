"""How far the shaft still turns when nobody looks at it: the loop has failed, or runs blind.

The worst that the limits allow: at the limit of the angle, moving outwards at the limit of the
speed, with the peak torque pushing on. Three things end that, each after its own time:

* the drive watches over the loop's heartbeat, and misses it when the loop has stopped;
* a loop whose angles do not come goes on with the last one, heartbeat included, and ends the
  session after ``limits.stale_ticks_in_a_row``;
* a loop that was held up looks again after the ticks it missed, up to
  ``limits.missed_ticks_in_a_row`` of them.

Each is judged by itself, as if the others did not act. Then the shaft runs out, held back by its
friction alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isinf

from rigd.checks.rows import Row, Verdict, grade
from rigd.devices.parameters import RigParameters
from rigd.profile import Profile
from rigd.safety import Limits

_STEP_S = 5e-5
_FOR_EVER_RAD = 100.0
_GROUP = "travel"
_LOOP_FAILS = "if the loop fails"


@dataclass(frozen=True, slots=True)
class Travel:
    """Angles from where the loop fails, in rad."""

    driven_rad: float
    """While the torque is still on; infinite beyond 100 rad."""
    coasting_rad: float
    """After it; infinite likewise, and if no friction ends it."""

    @property
    def total_rad(self) -> float:
        """Angle to where the shaft stands."""
        return self.driven_rad + self.coasting_rad


def worst_travel(
    rig: RigParameters, limits: Limits, blind_s: float, max_speed_rad_s: float = inf
) -> Travel:
    """Return the worst travel while nobody looks.

    Parameters
    ----------
    rig, limits
        Of the profile.
    blind_s
        For how long the torque stays on; infinite if nothing ends it.
    max_speed_rad_s
        Above which the drive by itself exerts no torque.

    Notes
    -----
    What is not known is taken at its worst: while the torque is on the beam does not hold the motor
    back, and after it all of the beam turns on with the shaft, as if it were rigid.
    """
    if isinf(blind_s):
        return Travel(inf, inf)
    motor, beam = rig.motor, rig.beam
    light_kg_m2 = motor.inertia_kg_m2 + rig.sensor.tool_inertia_kg_m2
    heavy_kg_m2 = light_kg_m2 + beam.density_kg_per_m * beam.length_m**3 / 3
    speed_rad_s = limits.velocity_rad_s
    driven_rad = 0.0
    steps = round(blind_s / _STEP_S)
    for step in range(steps):
        torque_nm = motor.peak_torque_nm - _friction_nm(rig, speed_rad_s)
        faster_rad_s = max(0.0, speed_rad_s + torque_nm / light_kg_m2 * _STEP_S)
        before_rad_s, speed_rad_s = speed_rad_s, min(faster_rad_s, max_speed_rad_s)
        driven_rad += 0.5 * (before_rad_s + speed_rad_s) * _STEP_S
        if speed_rad_s == before_rad_s:  # it goes on like this
            driven_rad += speed_rad_s * (steps - 1 - step) * _STEP_S
            break
        if driven_rad > _FOR_EVER_RAD:
            break
    if driven_rad > _FOR_EVER_RAD:
        return Travel(inf, inf)
    coasting_rad = 0.0
    while speed_rad_s > 0.0:
        slower_rad_s = speed_rad_s - _friction_nm(rig, speed_rad_s) / heavy_kg_m2 * _STEP_S
        coasting_rad += 0.5 * (speed_rad_s + max(0.0, slower_rad_s)) * _STEP_S
        if coasting_rad > _FOR_EVER_RAD or slower_rad_s == speed_rad_s:
            return Travel(driven_rad, inf)
        speed_rad_s = slower_rad_s
    return Travel(driven_rad, coasting_rad)


@dataclass(frozen=True, slots=True)
class _Blindness:
    """One way in which nobody looks at the shaft while the torque stays on."""

    what: str
    duration_s: float
    ended_by: str
    """What ends it, with its key."""
    key: str


def _ways(profile: Profile) -> tuple[_Blindness, ...]:
    rig, limits, drive = profile.rig, profile.limits, profile.rig.cia402
    assert drive is not None
    stale, missed = limits.stale_ticks_in_a_row, limits.missed_ticks_in_a_row
    own = drive.watchdog_s > drive.heartbeat_timeout_s
    watchdog = "cia402.own_watchdog_s" if own else "cia402.heartbeat_timeout_s"
    return (
        _Blindness(
            _LOOP_FAILS,
            drive.watchdog_s,
            f"of the drive's watchdog ({watchdog})",
            watchdog,
        ),
        # The tick that finds one too many switches off, and its command has its own delay.
        _Blindness(
            "if no angle comes",
            (stale + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {stale} old angles (limits.stale_ticks_in_a_row)",
            "limits.stale_ticks_in_a_row",
        ),
        _Blindness(
            "if ticks are missed",
            (missed + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {missed} missed ticks (limits.missed_ticks_in_a_row)",
            "limits.missed_ticks_in_a_row",
        ),
    )


def travel_rows(profile: Profile) -> Iterator[Row]:
    """Compare the worst travel of each way with what is left behind the limit of the angle."""
    rig, limits, drive = profile.rig, profile.limits, profile.rig.cia402
    if drive is None:
        why = "the drive is part of this program and ends with it"
        yield Row(_GROUP, _LOOP_FAILS, why, "", Verdict.SKIPPED)
        return
    ways = _ways(profile)
    margin_rad = limits.stop_angle_rad - limits.angle_rad
    bound = f"at most {margin_rad:.2f} rad (limits.stop_angle_rad - limits.angle_rad)"
    unbounded = isinf(drive.watchdog_s)
    if unbounded:
        ways = tuple(way for way in ways if not isinf(way.duration_s))
        yield Row(
            _GROUP,
            f"worst, {_LOOP_FAILS}",
            "without bound: the profile accepts a drive without a watchdog",
            bound,
            Verdict.WARNING,
            f"Travel {_LOOP_FAILS}: nothing but the wired stop ends it "
            '(cia402.accept_without = ["watchdog"]).',
        )
    limited = drive.max_speed_rad_s > 0
    most_rad_s = drive.max_speed_rad_s if limited else inf
    travels = [worst_travel(rig, limits, way.duration_s, most_rad_s) for way in ways]
    longest = max(range(len(ways)), key=lambda number: travels[number].total_rad)
    for number, (way, travel) in enumerate(zip(ways, travels, strict=True)):
        too_far = not travel.total_rad <= margin_rad
        detail = ""
        if number == longest:
            free = worst_travel(rig, limits, way.duration_s)
            detail = "" if unbounded else f"Travel: the worst is {way.what}. "
            detail += (
                f"It counts on the drive's own speed limit of {drive.max_speed_rad_s:g} rad/s "
                f"(object 6080); without it, it would be {_angle(free.total_rad)}."
                if limited
                else "The drive's own speed limit (object 6080) is not set; "
                "cia402.max_speed_rad_s shortens it."
            )
        if too_far:
            detail += (
                f" Travel {way.what}: lower {way.key}, cia402.max_speed_rad_s, "
                "limits.velocity_rad_s or limits.angle_rad."
            )
        worst = "worst, " if number == longest and not unbounded else ""
        yield Row(
            _GROUP,
            f"{worst}{way.what}",
            f"{_angle(travel.total_rad)}: {_angle(travel.driven_rad)} in the "
            f"{way.duration_s * 1e3:g} ms {way.ended_by}, {_angle(travel.coasting_rad)} "
            "running out",
            bound,
            grade(fail=too_far),
            detail.strip(),
        )


def _angle(angle_rad: float) -> str:
    return f"more than {_FOR_EVER_RAD:g} rad" if isinf(angle_rad) else f"{angle_rad:.2f} rad"


def _friction_nm(rig: RigParameters, speed_rad_s: float) -> float:
    return rig.motor.viscous_nm_s_per_rad * speed_rad_s + rig.motor.coulomb_nm
