"""The state machine of CiA 402: what a statusword says, and the commands that change it."""

from enum import Enum
from typing import Final


class DriveState(Enum):
    """States of a drive, in the words of messages."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch-on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "no state of CiA 402"


DISABLE_VOLTAGE: Final = 0x00
SHUTDOWN: Final = 0x06
SWITCH_ON: Final = 0x07
ENABLE_OPERATION: Final = 0x0F
FAULT_RESET: Final = 0x80
"""Controlwords. A fault is reset by the rise of its bit."""

FAULT_BIT: Final = 0x0008
"""Set in fault and in fault reaction active."""
VOLTAGE_ENABLED: Final = 0x0010
"""The power stage is supplied; STO takes it from most drives."""
FOLLOWS_TARGET: Final = 0x1000
"""In cyclic synchronous torque mode: without it the drive ignores the target torque."""
STATE_BITS: Final = 0x006F
ENABLED: Final = 0x0027
"""Statusword in operation enabled, of its state bits."""

_TABLE: Final = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)


OFF: Final = (
    DriveState.NOT_READY,
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY,
    DriveState.SWITCHED_ON,
    DriveState.FAULT,
)
"""States in which the motor exerts no torque."""


def state_of(statusword: int) -> DriveState:
    """Return the state that a statusword tells."""
    for mask, value, state in _TABLE:
        if statusword & mask == value:
            return state
    return DriveState.UNKNOWN
