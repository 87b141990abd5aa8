"""Every interlock: what is watched, against what, by whom, and what follows.

This table is what the checks, the messages and docs/safety.md agree on. The levels themselves stand
in the profile.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final


class Checked(Enum):
    """By whom an interlock is checked, and when."""

    TICK = "loop, every tick"
    LOOK = "loop, every 64 ticks"
    REST = "loop, at the tare before and after a session"
    DRIVE = "drive, and its driver in every tick"


class Action(Enum):
    """What follows when a limit is left."""

    FAULT = "torque off, session ends as fault"
    STOP = "torque off, session ends as stopped"


@dataclass(frozen=True, slots=True)
class Interlock:
    """One row of the table.

    Attributes
    ----------
    name
        Of the interlock.
    channel
        What is watched, as messages name it.
    unit
        Of value and limit; empty where there is nothing to measure.
    limit
        Key of the profile with the level that ends a session; empty likewise.
    warning
        Where a warning begins: a part of the limit, or a key of the profile; None: nowhere.
    checked, action
        By whom, and what follows.
    remedy
        What the operator is told to do.
    below
        The limit is the least that the value may be.
    follows_missed_ticks
        A loop that stood still can set it off, though nothing is wrong with the rig: the drive goes
        on exerting the last torque meanwhile.
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


OVERLOADED: Final = "The computer is overloaded: close other programs."
"""Said of whatever came of a computer that was too busy."""

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
        "Look for what disturbed the loop, or lower the amplitude.",
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
        "See that nothing holds the beam, or lower the amplitude.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "encoder jump",
        "encoder's jump",
        "rad",
        "limits.acceleration_rad_s2",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "No motor moves like this: look at encoder, its cable and shield, and set the zero anew.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "torque command",
        "torque that the controller asks for",
        "N·m",
        "limits.torque_command_nm",
        "motor.peak_torque_nm",
        Checked.TICK,
        Action.FAULT,
        "See that nothing holds the beam, and check the loop with rigd check.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "i²t",
        "motor's mean torque (i²t)",
        "N·m",
        "motor.continuous_torque_nm",
        0.8,
        Checked.LOOK,
        Action.FAULT,
        "Let the motor cool down for a minute, then ask for less.",
    ),
    Interlock(
        "wrench range",
        "sensor's {axis}",
        "N, N·m",
        "limits.sensor_range_percent",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "See that nothing holds or pulls the beam.",
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
        "See that nothing holds or pulls the beam, then look at the sensor's cable.",
    ),
    Interlock(
        "tare drift",
        "drift of the coupling torque's zero",
        "N·m",
        "limits.tare_drift_nm",
        "session.tare_drift_nm",
        Checked.REST,
        Action.FAULT,
        "See that nothing leans on the beam and let the sensor warm up.",
    ),
    Interlock(
        "stale angle",
        "run of ticks without a new angle",
        "ticks",
        "limits.stale_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        "Look at drive, cable and bus.",
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
        "Look at sensor, cable and line.",
        follows_missed_ticks=True,
    ),
    Interlock(
        "stale angle share",
        "part of ticks without a new angle",
        "%",
        "limits.stale_percent",
        0.5,
        Checked.TICK,
        Action.FAULT,
        "Look at drive (inhibit time of its TPDO), cable and bus, or allow the replies more time "
        "(acquisition.deadline_us).",
    ),
    Interlock(
        "stale wrench share",
        "part of ticks without a new wrench",
        "%",
        "limits.stale_percent",
        0.5,
        Checked.TICK,
        Action.FAULT,
        "Look at sensor, cable and line, or allow the replies more time (acquisition.deadline_us).",
    ),
    Interlock(
        "missed ticks",
        "run of missed ticks",
        "ticks",
        "limits.missed_ticks_in_a_row",
        0.8,
        Checked.TICK,
        Action.FAULT,
        OVERLOADED,
    ),
    Interlock(
        "missed share",
        "part of ticks missed",
        "%",
        "limits.missed_percent",
        0.8,
        Checked.TICK,
        Action.FAULT,
        OVERLOADED,
    ),
    Interlock(
        "bus-off",
        "CAN controller off the bus",
        "",
        "",
        None,
        Checked.DRIVE,
        Action.FAULT,
        "Look at cable, termination and bit rate.",
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
        "Find out who pressed it and why, release it, then rigd reset.",
    ),
    Interlock(
        "recorder lag",
        "recorder's lag",
        "s",
        "limits.recorder_lag_s",
        0.5,
        Checked.LOOK,
        Action.FAULT,
        "The disk is too slow, or the computer is overloaded: see what else writes to it.",
    ),
    Interlock(
        "disk space",
        "free space of the session's disk",
        "MB",
        "limits.disk_free_mb",
        10.0,
        Checked.LOOK,
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

BY_NAME: Final = {row.name: row for row in INTERLOCKS}
