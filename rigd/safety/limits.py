"""Limits of the rig, and the table of interlocks.

For every interlock the table states the monitored quantity, the limit, the process that checks it,
and the action; the checks, the messages and docs/safety.md agree on it. The profile has the levels.
"""

from dataclasses import dataclass, field
from enum import Enum
from math import isfinite
from typing import Annotated, Final

from annotated_types import Ge, Gt, Le, Lt

from rigd.beam.tip import SMALL_TIP_SLOPE_RAD

Positive = Annotated[float, Gt(0)]
"""Type of a number above 0."""
PercentageBelow100 = Annotated[float, Gt(0), Lt(100)]
"""Type of a percentage above 0 and below 100."""

RECORDER_BUFFER_S = 16.0
"""Duration in s of the samples that shared memory buffers while the disk stalls."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the rig that end a session when they are exceeded.

    The angle is relative to the rig's zero. All limits are largest magnitudes, except the free
    space of the disk. `INTERLOCKS` has the levels of the warnings.
    """

    angle_rad: Positive
    """Largest angle of the motor on either side of the rig's zero."""
    stop_angle_rad: Positive
    """Angle of the mechanical stop, or the angle at which a part tears.

    No check in a session uses it, but the rig has to come to rest by itself between `angle_rad` and
    this angle."""
    velocity_rad_s: Positive
    """Largest speed of the output shaft in either direction."""
    acceleration_rad_s2: Positive
    """Largest plausible acceleration, above any that the motor can cause.

    An angle that shows a larger acceleration has jumped."""
    tracking_error_rad: Positive
    """Largest difference between reference and measured angle."""
    torque_command_nm: Positive
    """Largest torque that the controller may request, before the motor's peak torque limits it."""
    sensor_range_percent: Annotated[float, Gt(0), Le(200)]
    """Largest reading of each sensor axis, as a percentage of its measuring range.

    Above 100 a clipped reading does not end the session; it is flagged in its sample."""
    saturated_ticks_in_a_row: Annotated[int, Ge(1)]
    """Consecutive ticks for which a sensor axis or gauge may be at the end of its range."""
    stale_ticks_in_a_row: Annotated[int, Ge(1)]
    """Consecutive ticks for which an old angle or wrench may replace a missing one."""
    missed_ticks_in_a_row: Annotated[int, Ge(1)]
    """Consecutive ticks that the loop may miss."""
    missed_percent: PercentageBelow100
    """Largest percentage of missed ticks in the ticks scheduled so far, of at least ten seconds."""
    tare_drift_nm: Positive
    """Largest change of the coupling torque's zero in a session, or since the previous session."""
    recorder_lag_s: Positive
    """Longest delay of the recorder behind the loop, less than shared memory buffers."""
    disk_free_mb: Positive
    """Free space on the session's disk below which the session ends; 1 MB is 10⁶ bytes."""
    standstill_torque_nm: Annotated[float, Ge(0)] = field(default=0.0, metadata={"optional": True})
    """Net torque on the shaft (motor minus coupling torque) that exceeds any friction.

    An encoder that shows no movement at a larger net torque has failed. 0 means five times
    ``motor.coulomb_nm``."""
    torque_ratio: Annotated[float, Gt(1)] = field(default=2.0, metadata={"optional": True})
    """Largest ratio of the net torque on the shaft to its inertia times measured acceleration.

    The inverse ratio has the same limit. The ratio is 1 if all scales of encoder and motor are
    right."""
    stale_percent: PercentageBelow100 = field(default=1.0, metadata={"optional": True})
    """Largest percentage of old angles, and of old wrenches, in the ticks scheduled so far.

    It is counted as for `missed_percent`. ``analyze`` accepts no record with more than 5 %."""
    tip_slope_rad: Positive = field(default=SMALL_TIP_SLOPE_RAD, metadata={"optional": True})
    """Largest slope of the antenna's tip that an identification may cause.

    The predicted slope is checked before the session. Above the default the linear model is not
    exact."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A quantity that exceeds its limit or is near it, with the message for the operator.

    Attributes
    ----------
    channel, value, limit, unit
        Monitored quantity, its value, its limit, and their unit.
    remedy
        Advice for the operator, a sentence, or an empty string.
    key
        Key of the limit in the profile, or an empty string.
    below
        Whether the value must not fall below the limit, instead of exceeding it.
    warning
        Level of the warning if the limit itself is not exceeded, otherwise None.

    Examples
    --------
    >>> from rigd.safety.limits import Violation
    >>> print(Violation("angle", 1.02, 1.0, "rad", key="limits.angle_rad"))
    Angle 1.02 rad exceeds limit 1 rad (limits.angle_rad).
    """

    channel: str
    value: float
    limit: float
    unit: str
    remedy: str = ""
    key: str = ""
    below: bool = False
    warning: float | None = None

    def __str__(self) -> str:
        """Return the message for the operator, one or two sentences."""
        if not isfinite(self.value):
            return f"The {self.channel} is not a number: no usable reading came from its device."
        remedy_text = f" {self.remedy}" if self.remedy else ""
        channel_text = f"{self.channel[0].upper()}{self.channel[1:]}"
        value_text, limit_text = (
            f"{number:.4g} {self.unit}".rstrip() for number in (self.value, self.limit)
        )
        if self.warning is not None:
            warning_side = "below" if self.below else "above"
            key_text = f", {self.key}" if self.key else ""
            return (
                f"{channel_text} {value_text} {warning_side} warning level "
                f"{self.warning:.4g} {self.unit} "
                f"(limit {self.limit:.4g}{key_text}).{remedy_text}"
            )
        relation = "below" if self.below else "exceeds"
        key_text = f" ({self.key})" if self.key else ""
        return f"{channel_text} {value_text} {relation} limit {limit_text}{key_text}.{remedy_text}"


# Table of interlocks


class Checked(Enum):
    """Process that checks an interlock, and the times of its checks."""

    TICK = "loop, every tick"
    SLOW_CHECK = "loop, every 64 ticks"
    REST = "loop, at the tare before and after a session"
    DRIVE = "drive, and its driver in every tick"


class Action(Enum):
    """Consequence of an interlock's violation for the session."""

    FAULT = "torque off, session ends as fault"
    STOP = "torque off, session ends as stopped"


@dataclass(frozen=True, slots=True)
class Interlock:
    """One row of the table of interlocks: monitored quantity, limit, check and consequence.

    Attributes
    ----------
    name
        Name of the interlock.
    channel
        Name of the monitored quantity in messages.
    unit
        Unit of value and limit, or an empty string if nothing is measured.
    limit
        Key of the limit in the profile, or an empty string if nothing is measured.
    warning
        Level of the warning: a fraction of the limit, or a key of the profile. None for no warning.
    checked, action
        Process that checks the interlock, and the consequence of a violation.
    remedy
        Advice for the operator.
    below
        Whether the limit is the smallest allowed value, not the largest.
    follows_missed_ticks
        Whether a stall of the loop can trigger the interlock of a sound rig, because the drive
        continues to exert the last torque.
    """

    name: str
    channel: str
    unit: str
    limit: str
    warning: float | str | None
    checked: Checked
    action: Action
    remedy: str
    below: bool = False
    follows_missed_ticks: bool = False

    def violated(
        self,
        measured_value: float,
        limit_value: float,
        channel_name: str = "",
        *,
        is_below: bool = False,
    ) -> Violation:
        """Return the violation of this interlock by a measured value.

        Parameters
        ----------
        measured_value, limit_value
            Measured value, and the limit that it exceeds.
        channel_name
            Text that replaces ``{channel}`` in the name of the quantity.
        is_below
            Whether the value is below the limit.
        """
        channel_text = self.channel.format(channel=channel_name) if channel_name else self.channel
        return Violation(
            channel_text,
            measured_value,
            limit_value,
            self.unit,
            self.remedy,
            self.limit,
            below=is_below,
        )


OVERLOADED_ADVICE: Final = "The computer is overloaded: close other programs."
"""Advice for the operator on a violation caused by a busy computer."""

_ENCODER_FAILED: Final = (  # Advice for the operator on a failed encoder.
    "The encoder does not follow the torque: check the encoder, its cable and its coupling to the "
    "shaft, and that nothing blocks the shaft or the motor; then reset the rig and set the zero "
    "again."
)

_SENSOR_FAILED: Final = (  # Advice for the operator on a failed force-torque sensor.
    "Readings of a working sensor differ by their noise: check the sensor, its cable and its box."
)

INTERLOCKS: Final = (
    Interlock(
        "angle",
        "angle",
        "rad",
        "limits.angle_rad",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Turn the motor back towards its zero, or lower the amplitude.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "velocity",
        "speed",
        "rad/s",
        "limits.velocity_rad_s",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Find what disturbed the loop, or lower the amplitude.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "tracking error",
        "tracking error",
        "rad",
        "limits.tracking_error_rad",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Check that nothing holds the beam, or lower the amplitude.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "encoder jump",
        "encoder jump",
        "rad",
        "limits.acceleration_rad_s2",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Implausible motion: check the encoder, its cable and shield, and set the zero again.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "frozen encoder",
        "net torque while the encoder stands still",
        "N·m",
        "limits.standstill_torque_nm",
        None,
        Checked.TICK,
        Action.FAULT,
        _ENCODER_FAILED,
    ),
    Interlock(
        "stopped encoder",
        "torque that the sudden stop of the encoder would have required",
        "N·m",
        "limits.standstill_torque_nm",
        None,
        Checked.TICK,
        Action.FAULT,
        _ENCODER_FAILED,
    ),
    Interlock(
        "repeated angle",
        "number of encoder readings that repeat the one before while the shaft moves",
        "in 32 ticks",
        "",
        None,
        Checked.TICK,
        Action.FAULT,
        _ENCODER_FAILED,
    ),
    Interlock(
        "scales",
        "ratio of the net torque on the shaft to its inertia times its measured acceleration",
        "",
        "limits.torque_ratio",
        None,
        Checked.TICK,
        Action.FAULT,
        "Encoder step, gear, rated torque, inertia or a sign in the profile is wrong: run rigd "
        "check, then rigd identify motor.",
    ),
    Interlock(
        "torque command",
        "torque command",
        "N·m",
        "limits.torque_command_nm",
        "motor.peak_torque_nm",
        Checked.TICK,
        Action.FAULT,
        "Check that nothing holds the beam; check the loop with rigd check.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "i²t",
        "motor's rms torque (i²t)",
        "N·m",
        "motor.continuous_torque_nm",
        0.8,
        Checked.SLOW_CHECK,
        Action.FAULT,
        "Let the motor cool down for a minute, then lower the amplitude.",
    ),
    Interlock(
        "wrench range",
        "sensor's {axis}",
        "N, N·m",
        "limits.sensor_range_percent",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Check that nothing holds or pulls the beam.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "gauge saturation",
        "run of ticks with a saturated sensor",
        "ticks",
        "limits.saturated_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Check that nothing holds or pulls the beam, then check the sensor cable.",
    ),
    Interlock(
        "tare drift",
        "drift of the coupling torque's zero",
        "N·m",
        "limits.tare_drift_nm",
        "session.tare_drift_nm",
        Checked.REST,
        Action.FAULT,
        "Check that nothing leans on the beam and let the sensor warm up.",
    ),
    Interlock(
        "frozen sensor",
        "run of identical readings of all sensor channels",
        "ticks",
        "",
        None,
        Checked.TICK,
        Action.FAULT,
        _SENSOR_FAILED,
    ),
    Interlock(
        "frozen channel",
        "run of identical readings of the sensor's {channel}",
        "ticks",
        "",
        None,
        Checked.TICK,
        Action.FAULT,
        _SENSOR_FAILED,
    ),
    Interlock(
        "repeated wrench",
        "percentage of readings of the sensor's {channel} that repeat the one before",
        "%",
        "",
        None,
        Checked.TICK,
        Action.FAULT,
        _SENSOR_FAILED,
    ),
    Interlock(
        "stale angle",
        "run of ticks without a new angle",
        "ticks",
        "limits.stale_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Check drive, cable and bus.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "stale wrench",
        "run of ticks without a new wrench",
        "ticks",
        "limits.stale_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Check sensor, cable and line.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "stale angle share",
        "percentage of ticks without a new angle",
        "%",
        "limits.stale_percent",
        0.5,
        Checked.TICK,
        Action.FAULT,
        "Check the drive (inhibit time of its TPDO), cable and bus, or allow the replies more time "
        "(acquisition.deadline_us).",
    ),
    Interlock(
        "stale wrench share",
        "percentage of ticks without a new wrench",
        "%",
        "limits.stale_percent",
        0.5,
        Checked.TICK,
        Action.FAULT,
        "Check sensor, cable and line, or allow the replies more time (acquisition.deadline_us).",
    ),
    Interlock(
        "missed ticks",
        "run of missed ticks",
        "ticks",
        "limits.missed_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        OVERLOADED_ADVICE,
    ),
    Interlock(
        "missed share",
        "percentage of missed ticks",
        "%",
        "limits.missed_percent",
        0.8,
        Checked.TICK,
        Action.FAULT,
        OVERLOADED_ADVICE,
    ),
    Interlock(
        "bus-off",
        "CAN controller off the bus",
        "",
        "",
        None,
        Checked.DRIVE,
        Action.FAULT,
        "Check cable, termination and bit rate.",
    ),
    Interlock(
        "emergency message",
        "emergency message of the drive (EMCY), or its fault state",
        "",
        "",
        None,
        Checked.DRIVE,
        Action.FAULT,
        "Remove the cause, then rigd reset.",
    ),
    Interlock(
        "wired stop",
        "wired stop (STO) of the drive",
        "",
        "",
        None,
        Checked.DRIVE,
        Action.FAULT,
        "Find out who pressed it and why, or whether the supply of STO or motor failed or another "
        "program switched the drive off. Release it; if a daemon runs the rig, then rigd reset.",
    ),
    Interlock(
        "recorder lag",
        "recorder backlog",
        "s",
        "limits.recorder_lag_s",
        0.5,
        Checked.SLOW_CHECK,
        Action.FAULT,
        "The disk is too slow, or the computer is overloaded: check what else writes to it.",
    ),
    Interlock(
        "disk space",
        "free space on the session's disk",
        "MB",
        "limits.disk_free_mb",
        10.0,
        Checked.SLOW_CHECK,
        Action.FAULT,
        "Make room, or choose another folder.",
        below=True,
    ),
    Interlock(
        "operator stop",
        "operator's stop: rigd stop, Ctrl-C, a signal",
        "",
        "",
        None,
        Checked.TICK,
        Action.STOP,
        "None is needed: start again.",
    ),
)

"""Table of interlocks, in the order of docs/safety.md."""

INTERLOCKS_BY_NAME: Final = {row.name: row for row in INTERLOCKS}
"""Map from an interlock's name to its row of `INTERLOCKS`."""
