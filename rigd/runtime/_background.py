"""Background work: what gives way to everything else, and ends with the process that started it."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from rigd.runtime._signals import signal_when_orphaned

_LOWEST_PRIORITY: Final = 19


def killed_first() -> None:
    """Have the system kill this process before any other when memory runs out (OOM killer).

    What it starts inherits that.
    """
    with suppress(OSError):  # not on Linux
        Path("/proc/self/oom_score_adj").write_text("1000")


def give_way(pid: int = 0) -> None:
    """Have a process, and what it starts, run only while nothing else wants the processor.

    Parameters
    ----------
    pid
        Number of the process; 0: this one.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _LOWEST_PRIORITY)
    with suppress(OSError, AttributeError):  # not everywhere
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def end_with(parent: int) -> None:
    """Have this process end with the one that started it, however that ends.

    Parameters
    ----------
    parent
        Number of that process. If it has ended by now, so does this one.
    """
    signal_when_orphaned(signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)
