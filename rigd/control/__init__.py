"""The motor's controller: design by pole placement, discrete step, and its closed loop."""

from rigd.control.closed_loop import (
    ClosedLoop,
    LoopModel,
    LoopResponse,
    check_stability,
    close_loop,
)
from rigd.control.pid import (
    ControlDesignError,
    ControlSettings,
    PidController,
    PidGains,
    design_pid,
)

__all__ = [
    "ClosedLoop",
    "ControlDesignError",
    "ControlSettings",
    "LoopModel",
    "LoopResponse",
    "PidController",
    "PidGains",
    "check_stability",
    "close_loop",
    "design_pid",
]
