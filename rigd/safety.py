"""Limits: what a session may do, checked in every tick.

The software stops a session that leaves its limits; it is no safety function. That is the wired
STO of the drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Annotated

from annotated_types import Ge, Gt, Le

WARNING_FRACTION = 0.8
"""Part of a limit from which on samples carry a warning."""

MISSED_WINDOW_S = 10.0
"""Missed ticks are counted against at least this much time, so that one early burst is no fault."""

_WRENCH_AXES = (
    ("fx", "N"),
    ("fy", "N"),
    ("fz", "N"),
    ("tx", "N·m"),
    ("ty", "N·m"),
    ("tz", "N·m"),
)


@dataclass(frozen=True, slots=True)
class Limits:
    """What ends a session at once; at 80 % of a limit a sample carries a warning.

    The angle is relative to the rig's zero; all are magnitudes.
    """

    angle_rad: Annotated[float, Gt(0)]
    velocity_rad_s: Annotated[float, Gt(0)]
    tracking_error_rad: Annotated[float, Gt(0)]
    """Reference minus measured angle."""
    sensor_range_percent: Annotated[float, Gt(0), Le(200)]
    """Of the range of each of the sensor's axes; above 100 a clipped reading ends nothing (it is
    flagged in its sample)."""
    stale_ticks_in_a_row: Annotated[int, Ge(1)]
    """Ticks for which an old angle or wrench may stand in for one that did not come."""
    missed_ticks_in_a_row: Annotated[int, Ge(1)]
    missed_percent: Annotated[float, Gt(0), Le(100)]
    """Of all ticks scheduled so far, counted as if they were at least ten seconds' worth."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A limit that was left."""

    channel: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        """Return one sentence for the operator."""
        if not isfinite(self.value):
            return f"The {self.channel} is not a number: no usable reading came from its device."
        return (
            f"The {self.channel} of {self.value:.4g} {self.unit} exceeds its limit of "
            f"{self.limit:.4g} {self.unit}."
        )


class LimitWatch:
    """The check of every tick, and of the ticks that were missed.

    As long as nothing is near a limit it costs a few comparisons; details are looked for only
    once these fail. Comparisons are written so that a reading that is not a number fails them.

    Parameters
    ----------
    limits
        The limits of the profile.
    sensor_range
        Range of fx, fy, fz (N), tx, ty, tz (N·m).
    rate_hz
        Ticks a second.

    Attributes
    ----------
    warning
        Whether the last check found something at 80 % of its limit or more.
    """

    __slots__ = (
        "_angle_warning",
        "_elapsed",
        "_error_warning",
        "_limits",
        "_missed_window",
        "_previous_angle_rad",
        "_rate_hz",
        "_stale_angles",
        "_stale_wrenches",
        "_step_warning",
        "_wrench_limits",
        "_wrench_warnings",
        "warning",
    )

    def __init__(self, limits: Limits, sensor_range: Sequence[float], rate_hz: float) -> None:
        self._limits = limits
        self._rate_hz = rate_hz
        self._angle_warning = WARNING_FRACTION * limits.angle_rad
        self._error_warning = WARNING_FRACTION * limits.tracking_error_rad
        self._step_warning = WARNING_FRACTION * limits.velocity_rad_s / rate_hz
        self._wrench_limits = tuple(limits.sensor_range_percent / 100 * r for r in sensor_range)
        self._wrench_warnings = tuple(WARNING_FRACTION * limit for limit in self._wrench_limits)
        self._missed_window = MISSED_WINDOW_S * rate_hz
        self.reset(0.0)

    def reset(self, angle_rad: float) -> None:
        """Start from rest at ``angle_rad``."""
        self._previous_angle_rad = angle_rad
        self._elapsed = 1
        self._stale_angles = 0
        self._stale_wrenches = 0
        self.warning = False

    def skip(self, missed: int) -> None:
        """Tell the next check that ``missed`` ticks passed unseen: the speed is taken over them."""
        self._elapsed += missed

    def check(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: tuple[float, float, float, float, float, float],
        *,
        angle_stale: bool = False,
    ) -> Violation | None:
        """Check one tick's readings, before they are used.

        Parameters
        ----------
        reference_rad, angle_rad
            Relative to the rig's zero.
        wrench
            fx, fy, fz (N), tx, ty, tz (N·m).
        angle_stale
            The angle is an old one: no speed is taken from it.

        Returns
        -------
        Violation or None
            The worst of what is beyond its limit; `warning` is set from 80 % on.
        """
        moved = angle_rad - self._previous_angle_rad
        elapsed = self._elapsed
        if angle_stale:
            # The next new angle will have moved over this tick as well.
            self._elapsed = elapsed + 1
        else:
            self._previous_angle_rad = angle_rad
            self._elapsed = 1
        a, e, v = self._angle_warning, self._error_warning, self._step_warning * elapsed
        w0, w1, w2, w3, w4, w5 = self._wrench_warnings
        fx, fy, fz, tx, ty, tz = wrench
        if (
            -a < angle_rad < a
            and -e < reference_rad - angle_rad < e
            and -v < moved < v
            and -w0 < fx < w0
            and -w1 < fy < w1
            and -w2 < fz < w2
            and -w3 < tx < w3
            and -w4 < ty < w4
            and -w5 < tz < w5
        ):
            self.warning = False
            return None
        self.warning = True
        limits = self._limits
        return _worst(
            (
                ("angle", angle_rad, limits.angle_rad, "rad"),
                ("speed", moved * self._rate_hz / elapsed, limits.velocity_rad_s, "rad/s"),
                ("tracking error", reference_rad - angle_rad, limits.tracking_error_rad, "rad"),
                *(
                    (f"sensor's {axis}", value, limit, unit)
                    for (axis, unit), value, limit in zip(
                        _WRENCH_AXES, wrench, self._wrench_limits, strict=True
                    )
                ),
            )
        )

    def check_stale(self, angle_stale: bool, wrench_stale: bool) -> Violation | None:
        """Check for how long readings have not come, in every tick that lacks one and in the next.

        A controller that is fed an old angle turns the motor without limit, and neither speed nor
        tracking error would show it.
        """
        self._stale_angles = self._stale_angles + 1 if angle_stale else 0
        self._stale_wrenches = self._stale_wrenches + 1 if wrench_stale else 0
        limit = self._limits.stale_ticks_in_a_row
        return _worst(
            (
                ("run of ticks without a new angle", self._stale_angles, limit, "ticks"),
                ("run of ticks without a new wrench", self._stale_wrenches, limit, "ticks"),
            )
        )

    def check_missed(self, missed: int, missed_so_far: int, scheduled: int) -> Violation | None:
        """Check missed ticks; the next speed is then taken over them too.

        Parameters
        ----------
        missed
            Ticks missed in a row just now.
        missed_so_far, scheduled
            Ticks missed and ticks scheduled since the record's first.
        """
        self.skip(missed)
        limits = self._limits
        percent = 100.0 * missed_so_far / max(scheduled, self._missed_window)
        return _worst(
            (
                ("run of missed ticks", missed, limits.missed_ticks_in_a_row, "ticks"),
                ("part of ticks missed", percent, limits.missed_percent, "%"),
            )
        )


def _worst(channels: Sequence[tuple[str, float, float, str]]) -> Violation | None:
    """Return the channel that is furthest beyond its limit; no number at all is furthest."""
    worst, worst_ratio = None, 1.0
    for channel in channels:
        _, value, limit, _ = channel
        ratio = abs(value) / limit if isfinite(value) else float("inf")
        if ratio > worst_ratio:
            worst, worst_ratio = channel, ratio
    return None if worst is None else Violation(*worst)
