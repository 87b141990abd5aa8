"""Names of a control process in the process table, by its activity; quick to import."""

from collections.abc import Sequence
from typing import Final

CONTROL_MODULE: Final = "rigd.engine.control_process"
"""Run as ``python -m CONTROL_MODULE PID``, with the process id of its supervisor."""

CONNECTING_NAME: Final = "rigd connecting"
"""Short name of the process before its devices are connected."""
IDLE_NAME: Final = "rigd idle"
"""Short name while the drive is disabled."""
SESSION_NAME: Final = "rigd session"
"""Short name from the start of a session until the drive is disabled again."""


def supervisor_of_control(command: Sequence[str]) -> int | None:
    """Return the process id of a control process's supervisor, from its command line.

    Parameters
    ----------
    command
        Command line of any process. If it is no control process, the result is None.
    """
    if tuple(command[-3:-1]) != ("-m", CONTROL_MODULE) or not command[-1].isdecimal():
        return None
    return int(command[-1])
