"""Background work: lowest priority, one thread, ends with the process that started it."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rigd.runtime._stop_signals import signal_when_orphaned

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace

SINGLE_THREADED: Final = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment variables that stop numpy from starting threads."""

OWN_PYTHON: Final = (sys.executable, "-P")
"""Start of the command line of a program of this project. With -P no file of the working folder is
imported by mistake."""

_LOWEST_PRIORITY: Final = 19


def use_one_thread() -> None:
    """Stop numpy from starting threads, in this process and its children.

    Threads do not speed up small matrices, and cost a tenth of the time of a fit. With real-time
    priority they are harmful: threads of one calculation wait for each other in busy loops and
    block their core, so that one second becomes one minute.

    Call this before the first import of numpy, which reads the environment only once.
    """
    os.environ.update(SINGLE_THREADED)


def prefer_oom_kill() -> None:
    """Make this process and its children the first victims of the OOM killer."""
    with suppress(OSError):  # not on Linux
        Path("/proc/self/oom_score_adj").write_text("1000")


def give_way(pid: int = 0) -> None:
    """Run a process and its children only while no other process needs the processor.

    Parameters
    ----------
    pid
        Number of the process; 0: this one.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _LOWEST_PRIORITY)
    with suppress(OSError, AttributeError):  # not everywhere
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def processor_use(pid: int) -> tuple[bool, float] | None:
    """Return the scheduling state and processor time of a process.

    Parameters
    ----------
    pid
        Number of the process.

    Returns
    -------
    tuple of bool and float, or None
        Whether the process runs or waits for a processor, and its processor time in s. None if this
        is not known: the process has ended, or the system is not Linux.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        # The state and numbers follow the program's name, which may contain any character.
        fields = stat.rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, ValueError, IndexError):
        return None
    return fields[0] == "R", ticks / os.sysconf("SC_CLK_TCK")


def die_with_parent(parent: int) -> None:
    """End this process when its parent ends, in whatever way.

    Parameters
    ----------
    parent
        Process id of the parent. If it has already ended, this process ends at once.
    """
    signal_when_orphaned(signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


def begin_background(parser: "ArgumentParser") -> "Namespace":
    """Set up a background program: one thread, first victim of the OOM killer; parse its options.

    Parameters
    ----------
    parser
        Command line of the program. The option ``--parent`` is added: the program ends with that
        process.

    Returns
    -------
    argparse.Namespace
        The parsed options.
    """
    parser.add_argument("--parent", type=int, help="End with the process of this number.")
    arguments = parser.parse_args()
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    prefer_oom_kill()
    use_one_thread()
    return arguments
