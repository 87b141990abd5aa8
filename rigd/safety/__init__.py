"""Limits and interlocks: what ends a session, what warns, and what the operator is told.

The software stops a session that leaves its limits; it is no safety function. That is the wired
STO of the drive (docs/safety.md).
"""

from rigd.safety.interlocks import INTERLOCKS, Action, Checked, Interlock
from rigd.safety.limits import Limits
from rigd.safety.violation import Violation
from rigd.safety.watch import LOOK_EVERY, LimitWatch

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
