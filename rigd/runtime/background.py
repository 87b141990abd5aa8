"""Background programs, which have low priority and one thread, and end with their parent."""

import gc
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from rigd.runtime._stop_signals import signal_when_orphaned

SINGLE_THREADED: Final = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment variables that stop NumPy from starting threads."""

OWN_PYTHON: Final = (sys.executable, "-P")
"""First words of the command line that runs a Python module of this project. With -P no file of the
working folder is imported by mistake."""

_MAX_NICENESS: Final = 19
"""Niceness with the lowest priority."""


def use_one_thread() -> None:
    """Stop NumPy from starting threads, in this process and its children.

    Threads do not speed up small matrices, and take a tenth of the time of a fit. With real-time
    priority they are harmful: the threads of one calculation wait for each other in busy loops and
    block their core, so that a calculation of one second takes one minute.

    Call this before the first import of NumPy, which reads the environment only once.
    """
    os.environ.update(SINGLE_THREADED)


def collect_garbage_rarely() -> None:
    """Make Python search for cyclic garbage after 50 000 new objects instead of 700.

    Imports leave no garbage, and searching for it takes a tenth of the start of a command.
    """
    gc.set_threshold(50_000)


RUN_PROGRAM: Final = (
    *OWN_PYTHON,
    "-c",
    "from rigd.runtime.background import run_program; run_program()",
)
"""First words of a command line that starts a program and ends it with its parent.

The process id of the parent and the program's own command line follow them."""


def run_program() -> None:
    """Replace this process by the program on the command line, and end it with its parent.

    The command line begins with `RUN_PROGRAM`.
    """
    die_with_parent(int(sys.argv[1]))
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which the page ignores
    os.execv(sys.argv[2], sys.argv[2:])


def prefer_oom_kill(pid: int) -> None:
    """Make Linux end a process and its children first if memory runs out (OOM killer).

    Parameters
    ----------
    pid
        Process id.
    """
    with suppress(OSError):  # not on Linux
        Path(f"/proc/{pid}/oom_score_adj").write_text("1000")


def set_idle_priority(pid: int = 0) -> None:
    """Give a process and its children idle priority: they run while no other process needs to.

    Parameters
    ----------
    pid
        Process id, or 0 for this process.
    """
    with suppress(OSError, AttributeError):  # AttributeError on Windows
        os.setpriority(os.PRIO_PROCESS, pid, _MAX_NICENESS)
    with suppress(OSError, AttributeError):  # not everywhere
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def processor_use(pid: int) -> tuple[bool, float] | None:
    """Return whether a process is runnable, and the processor time in s that it has used.

    Parameters
    ----------
    pid
        Process id.

    Returns
    -------
    tuple of bool and float, or None
        Whether the process runs or waits for a processor, and its processor time in seconds. None
        if the process has ended, or the system is not Linux.
    """
    try:
        stat_text = Path(f"/proc/{pid}/stat").read_text()
        # The state and numbers follow the program's name, which may contain any character.
        stat_fields = stat_text.rpartition(")")[2].split()
        used_clock_ticks = int(stat_fields[11]) + int(stat_fields[12])
    except (OSError, ValueError, IndexError):
        return None
    return stat_fields[0] == "R", used_clock_ticks / os.sysconf("SC_CLK_TCK")


def die_with_parent(parent_pid: int) -> None:
    """Make the system end this process when its parent ends, for whatever reason.

    Parameters
    ----------
    parent_pid
        Process id of the parent. If it has already ended, this process ends at once.
    """
    signal_when_orphaned(signal.SIGKILL)
    if os.getppid() != parent_pid:
        sys.exit(1)
