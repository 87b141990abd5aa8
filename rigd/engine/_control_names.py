"""Names by which the process table shows a control process, and what it does; quick to import."""

from collections.abc import Sequence
from typing import Final

CONTROL_MODULE: Final = "rigd.engine.control_process"
"""Run as ``python -m CONTROL_MODULE NUMBER``, with the number of its supervisor."""

CONNECTING_NAME: Final = "rigd connecting"
"""Short name of the process before its devices are connected."""
IDLE_NAME: Final = "rigd idle"
"""Short name while the drive is disabled."""
SESSION_NAME: Final = "rigd session"
"""Short name from the start of a session until the drive is disabled again."""


def supervisor_of_control(command: Sequence[str]) -> int | None:
    """Return the number of the supervisor of a control process, by the command line of the latter.

    Parameters
    ----------
    command
        Command line of any process; None is returned if it is no control process.
    """
    if tuple(command[-3:-1]) != ("-m", CONTROL_MODULE) or not command[-1].isdecimal():
        return None
    return int(command[-1])
