"""The limits of a profile."""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le

Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True, slots=True)
class Limits:
    """What ends a session; from which part of it on there is a warning, the table says.

    The angle is relative to the rig's zero; all but the free space of the disk are magnitudes that
    must not be exceeded.
    """

    angle_rad: Positive
    stop_angle_rad: Positive
    """Where the shaft is stopped by force, or something tears; nothing checks it in a session, but
    the rig has to come to rest by itself between `angle_rad` and here."""
    velocity_rad_s: Positive
    acceleration_rad_s2: Positive
    """More than the motor can do to the shaft: an angle that shows more has jumped."""
    tracking_error_rad: Positive
    """Reference minus measured angle."""
    torque_command_nm: Positive
    """What the controller asks for, before it is cut to the motor's peak torque."""
    sensor_range_percent: Annotated[float, Gt(0), Le(200)]
    """Of the range of each of the sensor's axes; above 100 a clipped reading ends nothing (it is
    flagged in its sample)."""
    saturated_ticks_in_a_row: Annotated[int, Ge(1)]
    """Ticks for which the sensor may report an axis or a gauge at the end of its range."""
    stale_ticks_in_a_row: Annotated[int, Ge(1)]
    """Ticks for which an old angle or wrench may stand in for one that did not come."""
    missed_ticks_in_a_row: Annotated[int, Ge(1)]
    missed_percent: Annotated[float, Gt(0), Le(100)]
    """Of all ticks scheduled so far, counted as if they were at least ten seconds' worth."""
    tare_drift_nm: Positive
    """Change of the coupling torque's zero over a session, or since the one before."""
    recorder_lag_s: Positive
    """Time by which the recorder may be behind the loop."""
    disk_free_mb: Positive
    """Free space of the disk that the session goes to, below which it ends; 1 MB is 10⁶ bytes."""
    stale_percent: Annotated[float, Gt(0), Le(100)] = field(
        default=1.0, metadata={"optional": True}
    )
    """Of all ticks scheduled so far, counted as `missed_percent` is: those whose angle is an old
    one, and likewise those whose wrench is. ``analyze`` takes no record with more than 1 %."""
