"""Limits and interlocks: what ends a session, what warns, and what the operator is told.

The software stops a session that leaves its limits; it is no safety function. That is the wired
STO of the drive (docs/safety.md).
"""

from rigd.safety.limits import INTERLOCKS, Action, Checked, Interlock, Limits, Violation
from rigd.safety.monitor import LOOK_EVERY, LimitWatch

__all__ = [
    "INTERLOCKS",
    "LOOK_EVERY",
    "Action",
    "Checked",
    "Interlock",
    "LimitWatch",
    "Limits",
    "Violation",
]
