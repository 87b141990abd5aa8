"""Background work: gives way to all else, takes one thread, ends with whoever started it."""

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
"""Environment in which numpy starts no threads."""

OWN_PYTHON: Final = (sys.executable, "-P")
"""Begins the command line of a program of this project: a file where the operator works may have
the name of any module, and is none of it."""

_LOWEST_PRIORITY: Final = 19


def use_one_thread() -> None:
    """Let numpy start no threads, in this process and in those that it starts.

    They gain nothing on matrices as small as ours, and cost a tenth of a fit's time. With a
    real-time priority they do harm: the threads of one calculation, all kept off the loop's core,
    wait for each other by turning in a circle, so that what takes a second took a minute and
    nothing else ran on that core.

    numpy looks at the environment once, when it is imported: this has to come before.
    """
    os.environ.update(SINGLE_THREADED)


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


def processor_use(pid: int) -> tuple[bool, float] | None:
    """Return how a process stands with the processors.

    Parameters
    ----------
    pid
        Number of the process.

    Returns
    -------
    tuple of bool and float, or None
        Whether it runs or waits for a processor, rather than for anything else; and the processor
        time that it has used, in s. None if that is not known: it has ended, or is not on Linux.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        # After the program's name, which may hold anything: state, and from there on numbers.
        fields = stat.rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, ValueError, IndexError):
        return None
    return fields[0] == "R", ticks / os.sysconf("SC_CLK_TCK")


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


def begin_background(parser: "ArgumentParser") -> "Namespace":
    """Begin a program that works for another one: it is killed first, and takes one thread.

    Parameters
    ----------
    parser
        Command line of the program; ``--parent`` is added, with which it ends.

    Returns
    -------
    argparse.Namespace
        What the command line says.
    """
    parser.add_argument("--parent", type=int, help="End with the process of this number.")
    arguments = parser.parse_args()
    if arguments.parent is not None:
        end_with(arguments.parent)
    killed_first()
    use_one_thread()
    return arguments
