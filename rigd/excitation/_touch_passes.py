"""Passes in search of an obstacle: out at a constant speed until the beam touches it, and back.

Each pass has its own block of time: rest, way out, pause, way back without an obstacle. When the
loop detects a touch, it replaces the rest of the reference in this block (`reference_after_touch`):
the motor brakes, holds, and returns to the beginning of the pass. A session therefore has the same
number of ticks with and without a touch. Neither way excites a vibration.
"""

from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import doc
from numpy.typing import NDArray

from rigd.excitation._move import MoveRig
from rigd.excitation._options import RestS, RingDownS, documented
from rigd.excitation._shortest_move import shortest_braking
from rigd.excitation._signals import (
    Excitation,
    ExcitationError,
    assemble_reference,
    check_ticks,
    lay_out_segments,
    require_finite,
    require_not_negative,
    require_positive,
    require_within_turn,
)
from rigd.excitation.moves import Braking, slew, vibration_free_path
from rigd.identified_beam import TOUCH_USE

RealArray = NDArray[np.float64]

_PEAK_OVER_MEAN_SPEED = 2.0
"""Ratio of the largest speed to the mean speed on the way back: that of a minimum-jerk path, with a
margin."""


@dataclass(frozen=True, slots=True)
class TouchPass:
    """Ticks at which one pass in search of an obstacle begins, turns back and ends."""

    begin_tick: int
    """Tick at which the way out begins; the rest before it belongs to the pass."""
    return_tick: int
    """Tick at which the way back begins."""
    end_tick: int
    """First tick after the pass."""


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """Passes of a search for an obstacle, and how the motor brakes and returns after a touch."""

    passes: tuple[TouchPass, ...]
    """Passes in the order of time."""
    braking: Braking
    """Path on which the motor brakes after a touch."""
    hold_ticks: int
    """Number of ticks from a touch to the way back."""
    return_path: RealArray
    """Path of the way back from 0 to 1, at the ticks after its start."""
    force_limit_n: float
    """Contact force in N above which the torque is switched off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchExcitation(Excitation):
    """Excitation during which the loop watches for touches.

    Attributes
    ----------
    approach
        Passes of the search, and the reaction to a touch.
    """

    approach: Approach

    @property
    def shows_modes(self) -> bool:
        """Whether a record of the excitation can show the beam's modes: it cannot."""
        return False

    @property
    def limits_force(self) -> bool:
        """Whether a contact force ends the session: it does."""
        return True


@documented
def touch(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    angle_rad: Annotated[float, doc("Farthest angle from the rig's zero.")],
    speed_rad_s: Annotated[float, doc("Speed on the way out.")] = 1.0,
    acceleration_rad_s2: Annotated[
        float,
        doc("Largest acceleration of the reference at the beginning and end of the way out."),
    ] = 20.0,
    passes: Annotated[int, doc("Number of passes.")] = 1,
    hold_s: Annotated[
        float,
        doc("Time in s from a touch to the way back; without a touch, time at the farthest angle."),
    ] = 0.5,
    settle_s: Annotated[float, doc("Time in s at rest before each pass.")] = 1.0,
    force_limit_n: Annotated[
        float,
        doc(
            "Contact force above which the torque is switched off and the session ends as a "
            "fault. It is checked if the rig measures the base shear."
        ),
    ] = 10.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 1.0,
    path: Annotated[
        str | Path,
        doc(
            "JSON written by ``analyze --json`` with the beam whose predicted torque is "
            "compared with the measured torque; empty: the beam of the profile."
        ),
    ] = "",
    rig: Annotated[MoveRig | None, doc("Rig that is moved.")] = None,
) -> TouchExcitation:
    """Return an excitation that moves the beam until it touches an obstacle, and then back.

    Raises
    ------
    ExcitationError
        If an option is not finite or out of range, or the rig cannot brake from that speed.
    IdentifiedBeamError
        If the file is invalid, or has an effect that a search for touches does not take into
        account.
    """
    if rig is None:
        raise ExcitationError("touch is made for a rig; none was given.")
    require_finite("angle_rad", angle_rad, "rad")
    require_within_turn("angle_rad", angle_rad)
    distance_rad = angle_rad - rig.start_rad
    if distance_rad == 0.0:
        raise ExcitationError(
            f"angle_rad = {angle_rad:g} rad is the angle at which the motor is now; give another "
            "angle."
        )
    require_positive("speed_rad_s", speed_rad_s, "rad/s")
    require_positive("acceleration_rad_s2", acceleration_rad_s2, "rad/s²")
    require_positive("force_limit_n", force_limit_n, "N")
    require_positive("hold_s", hold_s, "s")
    require_not_negative("settle_s", settle_s)
    if passes < 1:
        raise ExcitationError(f"passes = {passes} must be at least 1.")
    min_duration_s = settle_s + abs(distance_rad) / speed_rad_s + hold_s
    check_ticks("The session", passes * min_duration_s * rate_hz, rate_hz)
    move_plant = rig.move_plant(path, TOUCH_USE)
    outward_path_rad = slew(
        distance_rad,
        speed_rad_s=speed_rad_s,
        acceleration_rad_s2=acceleration_rad_s2,
        rate_hz=rate_hz,
        poles_rad_s=move_plant.poles_rad_s,
    )
    braking = shortest_braking(move_plant, np.concatenate([[0.0, 0.0], outward_path_rad]))
    hold_ticks = ceil(hold_s * rate_hz)
    if hold_s < braking.duration_s:
        raise ExcitationError(
            f"hold_s = {hold_s:g} s ends before the motor has stopped, which takes "
            f"{braking.duration_s:.3g} s; hold longer."
        )
    lowest_pole_rad_s = float(np.abs(move_plant.poles_rad_s).min(initial=np.inf))
    # At least one period of the slowest mode: a path that leaves it at rest is then gentle.
    return_duration_s = max(
        _PEAK_OVER_MEAN_SPEED * abs(distance_rad) / speed_rad_s, 2 * np.pi / lowest_pole_rad_s
    )
    return_path = vibration_free_path(return_duration_s, rate_hz, move_plant.poles_rad_s)
    rest_rad = np.zeros(ceil(settle_s * rate_hz))
    single_pass_rad = np.concatenate(
        [
            rest_rad,
            outward_path_rad,
            np.full(hold_ticks, distance_rad),
            distance_rad * (1.0 - return_path),
        ]
    )
    check_ticks("The session", passes * single_pass_rad.size, rate_hz)
    segment_ticks = lay_out_segments(
        rate_hz, rest_s, passes * single_pass_rad.size / rate_hz, ring_down_s
    )
    sweep_begin = segment_ticks["sweep"][0]
    approach = Approach(
        passes=tuple(
            TouchPass(
                begin_tick=pass_begin + rest_rad.size,
                return_tick=pass_begin + single_pass_rad.size - return_path.size,
                end_tick=pass_begin + single_pass_rad.size,
            )
            for pass_begin in range(
                sweep_begin, sweep_begin + passes * single_pass_rad.size, single_pass_rad.size
            )
        ),
        braking=braking,
        hold_ticks=hold_ticks,
        return_path=return_path,
        force_limit_n=force_limit_n,
    )
    parameters: dict[str, float | int | str] = {
        "angle_rad": angle_rad,
        "speed_rad_s": speed_rad_s,
        "acceleration_rad_s2": acceleration_rad_s2,
        "passes": passes,
        "hold_s": hold_s,
        "settle_s": settle_s,
        "force_limit_n": force_limit_n,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "file": str(path),
        "by_rad": distance_rad,
        "braking_s": braking.duration_s,
    }
    return TouchExcitation(
        kind="touch",
        parameters=parameters,
        rate_hz=rate_hz,
        reference_rad=assemble_reference(segment_ticks, np.tile(single_pass_rad, passes)),
        segments=segment_ticks,
        model=move_plant.model,
        motion=(
            f"goes to {angle_rad:.4g} rad at {speed_rad_s:g} rad/s"
            f"{f', {passes} times' if passes > 1 else ''}, brakes within "
            f"{1e3 * braking.duration_s:.0f} ms of a touch (beam of {path or 'profile'})"
        ),
        approach=approach,
    )


def reference_after_touch(
    approach: Approach,
    pass_end_tick: int,
    tick: int,
    recent_angles_rad: tuple[float, float, float],
    start_rad: float,
) -> RealArray:
    """Return the reference for the rest of a pass after a touch: brake, hold, and return.

    Parameters
    ----------
    approach
        Passes and reaction to a touch.
    pass_end_tick
        First tick after the pass.
    tick
        Tick at which the touch was detected, before the way back begins.
    recent_angles_rad
        Reference angles two ticks before `tick`, one tick before it, and at it.
    start_rad
        Reference angle at the beginning of the pass.

    Returns
    -------
    ndarray of shape (pass_end_tick - tick - 1,)
        Reference angles in rad at the ticks after `tick`.
    """
    braking, return_path = approach.braking, approach.return_path
    angle_two_ticks_before, angle_one_tick_before, present_angle = recent_angles_rad
    acceleration_rad_s2 = (
        present_angle - 2 * angle_one_tick_before + angle_two_ticks_before
    ) * braking.rate_hz**2
    speed_rad_s = (
        present_angle - angle_one_tick_before
    ) * braking.rate_hz + acceleration_rad_s2 / (2 * braking.rate_hz)
    reference_rad = np.full(pass_end_tick - tick - 1, start_rad)
    braking_path_rad = braking.path(present_angle, speed_rad_s, acceleration_rad_s2)
    return_index = reference_rad.size - return_path.size
    held_ticks = min(approach.hold_ticks, return_index)
    held_angle_rad = braking_path_rad[-1]
    reference_rad[:held_ticks] = held_angle_rad
    # A touch during the pause needs no braking; the remaining pause follows.
    reference_rad[: min(held_ticks, len(braking_path_rad))] = braking_path_rad[:held_ticks]
    reference_rad[held_ticks : held_ticks + return_path.size] = (
        held_angle_rad + (start_rad - held_angle_rad) * return_path
    )
    return reference_rad
