"""Checks of the stopping distance: how far the shaft still turns when nothing controls it.

The loop has failed, or receives no valid angle. The distance is the longest that the limits allow:
the shaft starts at the limit of the angle, moves outwards at the limit of the speed, and the peak
torque drives it on. The torque is removed after a time that depends on the failure:

* if the loop has stopped, the drive's watchdog no longer receives its heartbeat;
* if no new angles arrive, the loop continues with the last one, sends its heartbeat, and ends the
  session after ``limits.stale_ticks_in_a_row``;
* if the encoder has failed but still sends messages, the loop detects this from the torques on the
  shaft and ends the session, at full torque within `ENCODER_FAILURE_S`;
* if the loop was delayed, it reads the sensors again after the missed ticks, at most
  ``limits.missed_ticks_in_a_row``.

Each failure is checked separately, as if the others did not occur. The shaft then coasts to rest,
braked by friction alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import inf, isfinite, isinf, log1p
from typing import TYPE_CHECKING

from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.devices.parameters import RigParameters
from rigd.profile import Profile
from rigd.safety import ENCODER_FAILURE_S
from rigd.safety.limits import Limits

# Modules of devices that a rig does not have are not loaded: these checks precede every session.
if TYPE_CHECKING:
    from rigd.devices.parameters import Motor

_SIMULATION_STEP_S = 5e-5
"""Time step in seconds of the simulated motion under torque."""
_MAX_STOPPING_DISTANCE_RAD = 100.0
"""Stopping distance in rad above which it counts as infinite."""
_NEGLIGIBLE_VISCOUS_FRICTION_RATIO = 1e-6
"""Ratio of viscous to Coulomb friction torque below which viscous friction is neglected."""
_STOPPING_GROUP = "travel"
"""Group of the rows on the stopping distance."""
_LOOP_FAILS_LABEL = "if the loop fails"
"""Label of the row on the stopping distance after a failure of the loop."""
STOPPING_LOOP_FAILS_ROW = "travel_loop_fails"
"""Name of the row on the stopping distance after the loop has stopped."""
STOPPING_ENCODER_FAILS_ROW = "travel_encoder_fails"
"""Name of the row on the stopping distance after a failure of the encoder."""
STOPPING_NO_ANGLE_ROW = "travel_no_angle"
"""Name of the row on the stopping distance while no new angles arrive."""
STOPPING_MISSED_TICKS_ROW = "travel_missed_ticks"
"""Name of the row on the stopping distance during missed ticks."""


@dataclass(frozen=True, slots=True)
class StoppingDistance:
    """Stopping distance of the shaft after a failure: angle under torque, then while coasting."""

    driven_distance_rad: float
    """Angle that the shaft turns while the torque is still on; infinite above 100 rad."""
    coasting_distance_rad: float
    """Angle that the shaft turns without torque until friction has stopped it.

    It is infinite above 100 rad and without friction."""

    @property
    def total_distance_rad(self) -> float:
        """Angle in rad from the failure until the shaft is at rest."""
        return self.driven_distance_rad + self.coasting_distance_rad


@lru_cache(maxsize=64)
def max_stopping_distance(
    rig: RigParameters, limits: Limits, torque_duration_s: float, max_speed_rad_s: float = inf
) -> StoppingDistance:
    """Return the longest stopping distance that the limits allow while nothing controls the shaft.

    Parameters
    ----------
    rig, limits
        Parameters and limits of the profile.
    torque_duration_s
        Time for which the torque remains on; infinite if nothing removes it.
    max_speed_rad_s
        Speed above which the drive itself exerts no torque.

    Notes
    -----
    The beam acts in the worst way: it does not brake the motor while the torque is on, and it turns
    with the shaft like a rigid body afterwards.
    """
    if isinf(torque_duration_s):
        return StoppingDistance(inf, inf)
    motor, beam = rig.motor, rig.beam
    inertia_without_beam_kg_m2 = motor.inertia_kg_m2 + rig.sensor.tool_inertia_kg_m2
    inertia_with_beam_kg_m2 = inertia_without_beam_kg_m2 + beam.inertia_kg_m2
    speed_rad_s = limits.velocity_rad_s
    driven_distance_rad = 0.0
    step_count = round(torque_duration_s / _SIMULATION_STEP_S)
    for step_number in range(step_count):
        torque_nm = motor.peak_torque_nm - _friction_nm(rig, speed_rad_s)
        unlimited_speed_rad_s = max(
            0.0, speed_rad_s + torque_nm / inertia_without_beam_kg_m2 * _SIMULATION_STEP_S
        )
        previous_rad_s, speed_rad_s = speed_rad_s, min(unlimited_speed_rad_s, max_speed_rad_s)
        driven_distance_rad += 0.5 * (previous_rad_s + speed_rad_s) * _SIMULATION_STEP_S
        if speed_rad_s == previous_rad_s:  # it goes on like this
            driven_distance_rad += speed_rad_s * (step_count - 1 - step_number) * _SIMULATION_STEP_S
            break
        if driven_distance_rad > _MAX_STOPPING_DISTANCE_RAD:
            break
    if driven_distance_rad > _MAX_STOPPING_DISTANCE_RAD:
        return StoppingDistance(inf, inf)
    coasting_distance_rad = _coasting_distance_rad(inertia_with_beam_kg_m2, motor, speed_rad_s)
    return StoppingDistance(
        driven_distance_rad,
        coasting_distance_rad if coasting_distance_rad <= _MAX_STOPPING_DISTANCE_RAD else inf,
    )


def _coasting_distance_rad(inertia_kg_m2: float, motor: "Motor", speed_rad_s: float) -> float:
    """Return the angle in rad in which friction alone stops a rotating inertia.

    It is infinite if there is no friction.
    """
    viscous_nm_s_per_rad, coulomb_nm = motor.viscous_nm_s_per_rad, motor.coulomb_nm
    viscous_friction_ratio = (
        viscous_nm_s_per_rad * speed_rad_s / coulomb_nm if coulomb_nm > 0.0 else inf
    )
    if viscous_friction_ratio < _NEGLIGIBLE_VISCOUS_FRICTION_RATIO:
        return 0.5 * inertia_kg_m2 * speed_rad_s**2 / coulomb_nm
    if viscous_nm_s_per_rad == 0.0:
        return inf if speed_rad_s > 0.0 else 0.0
    coulomb_correction = (
        log1p(viscous_friction_ratio) / viscous_friction_ratio
        if isfinite(viscous_friction_ratio)
        else 0.0
    )
    return inertia_kg_m2 * speed_rad_s / viscous_nm_s_per_rad * (1.0 - coulomb_correction)


@dataclass(frozen=True, slots=True)
class _UncontrolledFailure:
    """A failure after which the torque remains on for a time while nothing controls the shaft."""

    name: str
    """Name of the check's row."""
    condition: str
    """Condition of the failure, as a clause for the operator ("if the encoder fails")."""
    torque_duration_s: float
    """Longest time for which the torque remains on."""
    torque_end_text: str
    """Limit or watchdog that removes the torque, with its key, as text for the operator."""
    profile_key: str
    """Key of the profile that determines the duration."""


def _uncontrolled_failures(profile: Profile) -> tuple[_UncontrolledFailure, ...]:
    """Return the failures after which the torque remains on for a time without control."""
    rig, limits, drive_settings = profile.rig, profile.limits, profile.rig.cia402
    assert drive_settings is not None
    stale_ticks, missed_ticks = limits.stale_ticks_in_a_row, limits.missed_ticks_in_a_row
    is_own_watchdog = drive_settings.watchdog_s > drive_settings.heartbeat_timeout_s
    watchdog_key = "cia402.own_watchdog_s" if is_own_watchdog else "cia402.heartbeat_timeout_s"
    return (
        _UncontrolledFailure(
            STOPPING_LOOP_FAILS_ROW,
            _LOOP_FAILS_LABEL,
            drive_settings.watchdog_s,
            f"of the drive's watchdog ({watchdog_key})",
            watchdog_key,
        ),
        # The tick that finds one old angle too many removes the torque, after the command's delay.
        _UncontrolledFailure(
            STOPPING_NO_ANGLE_ROW,
            "if no angle comes",
            (stale_ticks + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {stale_ticks} old angles (limits.stale_ticks_in_a_row)",
            "limits.stale_ticks_in_a_row",
        ),
        _UncontrolledFailure(
            STOPPING_ENCODER_FAILS_ROW,
            "if the encoder fails",
            ENCODER_FAILURE_S + 2 / rig.rate_hz + rig.actuation.delay_s,
            "of the encoder watch",
            "limits.standstill_torque_nm",
        ),
        _UncontrolledFailure(
            STOPPING_MISSED_TICKS_ROW,
            "if ticks are missed",
            (missed_ticks + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {missed_ticks} missed ticks (limits.missed_ticks_in_a_row)",
            "limits.missed_ticks_in_a_row",
        ),
    )


def stopping_distance_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield results that compare the stopping distance after each failure with the free angle.

    The free angle is that between the limit of the angle and the mechanical stop.
    """
    rig, limits, drive_settings = profile.rig, profile.limits, profile.rig.cia402
    if drive_settings is None:
        skip_reason = "the drive is part of this program and ends with it"
        yield CheckRow(
            _STOPPING_GROUP,
            _LOOP_FAILS_LABEL,
            skip_reason,
            "",
            CheckResult.SKIPPED,
            name=STOPPING_LOOP_FAILS_ROW,
        )
        return
    uncontrolled_failures = _uncontrolled_failures(profile)
    stopping_margin_rad = limits.stop_angle_rad - limits.angle_rad
    margin_text = (
        f"at most {stopping_margin_rad:.2f} rad (limits.stop_angle_rad - limits.angle_rad)"
    )
    has_no_watchdog = isinf(drive_settings.watchdog_s)
    if has_no_watchdog:
        uncontrolled_failures = tuple(
            uncontrolled_failure
            for uncontrolled_failure in uncontrolled_failures
            if not isinf(uncontrolled_failure.torque_duration_s)
        )
        yield CheckRow(
            _STOPPING_GROUP,
            f"worst, {_LOOP_FAILS_LABEL}",
            "without bound: the profile accepts a drive without a watchdog",
            margin_text,
            CheckResult.WARNING,
            f"Travel {_LOOP_FAILS_LABEL}: nothing but the wired stop ends it "
            '(cia402.accept_without = ["watchdog"]).',
            STOPPING_LOOP_FAILS_ROW,
        )
    has_speed_limit = drive_settings.max_speed_rad_s > 0
    highest_speed_rad_s = drive_settings.max_speed_rad_s if has_speed_limit else inf
    stopping_distances = [
        max_stopping_distance(
            rig, limits, uncontrolled_failure.torque_duration_s, highest_speed_rad_s
        )
        for uncontrolled_failure in uncontrolled_failures
    ]
    worst_index = max(
        range(len(uncontrolled_failures)),
        key=lambda failure_index: stopping_distances[failure_index].total_distance_rad,
    )
    for failure_index, (uncontrolled_failure, stopping_distance) in enumerate(
        zip(uncontrolled_failures, stopping_distances, strict=True)
    ):
        exceeds_margin = not stopping_distance.total_distance_rad <= stopping_margin_rad
        detail_text = ""
        if failure_index == worst_index:
            distance_without_limit = max_stopping_distance(
                rig, limits, uncontrolled_failure.torque_duration_s
            )
            detail_text = (
                ""
                if has_no_watchdog
                else f"Travel: the worst is {uncontrolled_failure.condition}. "
            )
            detail_text += (
                "It relies on the drive's own speed limit of "
                f"{drive_settings.max_speed_rad_s:g} rad/s "
                "(object 6080); without it, it would be "
                f"{_format_angle(distance_without_limit.total_distance_rad)}."
                if has_speed_limit
                else "The drive's own speed limit (object 6080) is not set; "
                "cia402.max_speed_rad_s shortens it."
            )
        if exceeds_margin:
            detail_text += (
                f" Travel {uncontrolled_failure.condition}: lower "
                f"{uncontrolled_failure.profile_key}, "
                "cia402.max_speed_rad_s, "
                "limits.velocity_rad_s or limits.angle_rad."
            )
        worst_prefix = "worst, " if failure_index == worst_index and not has_no_watchdog else ""
        yield CheckRow(
            _STOPPING_GROUP,
            f"{worst_prefix}{uncontrolled_failure.condition}",
            f"{_format_angle(stopping_distance.total_distance_rad)}: "
            f"{_format_angle(stopping_distance.driven_distance_rad)} in the "
            f"{uncontrolled_failure.torque_duration_s * 1e3:g} ms "
            f"{uncontrolled_failure.torque_end_text}, "
            f"{_format_angle(stopping_distance.coasting_distance_rad)} coasting",
            margin_text,
            grade(fail=exceeds_margin),
            detail_text.strip(),
            uncontrolled_failure.name,
        )


def _format_angle(angle_rad: float) -> str:
    """Format an angle in rad; an infinite one as "more than 100 rad"."""
    return (
        f"more than {_MAX_STOPPING_DISTANCE_RAD:g} rad"
        if isinf(angle_rad)
        else f"{angle_rad:.2f} rad"
    )


def _friction_nm(rig: RigParameters, speed_rad_s: float) -> float:
    """Return the friction torque of the motor at a speed in N·m."""
    return rig.motor.viscous_nm_s_per_rad * speed_rad_s + rig.motor.coulomb_nm
