"""Names of a control process in the process table, one for each activity; quick to import."""

from collections.abc import Sequence
from typing import Final

CONTROL_MODULE: Final = "rigd.engine.control_process"
"""Module of the control process, run as ``python -m CONTROL_MODULE PID`` with the process id of its
supervisor."""

CONNECTING_NAME: Final = "rigd connecting"
"""Name of the control process in the process table before its devices are connected."""
IDLE_NAME: Final = "rigd idle"
"""Name of the control process in the process table from when the drive has shown that it is off."""
SESSION_NAME: Final = "rigd session"
"""Name of the control process in the process table from the start of a session until the drive has
shown that it is off."""


def supervisor_of_control(command: Sequence[str]) -> int | None:
    """Return the process id of a control process's supervisor, or None for other processes.

    Parameters
    ----------
    command
        Command line of any process, as a list of arguments.
    """
    if tuple(command[-3:-1]) != ("-m", CONTROL_MODULE) or not command[-1].isdecimal():
        return None
    return int(command[-1])
