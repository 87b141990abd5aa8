"""Real-time settings of the control process: each is tried, and what was obtained is recorded."""

import ctypes
import gc
import os
from collections.abc import Callable

REFUSED = "refused: "
"""How the report on a setting begins that was not granted."""

_MCL_CURRENT_AND_FUTURE = 3
_PR_SET_TIMERSLACK = 29


def collect_no_garbage() -> str:
    """Turn the cyclic collector off: one run of it can take ten periods."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return "off"


def obtain(*, priority: int, cpu: int) -> dict[str, str]:
    """Ask the system for what a 1 kHz loop wants, and report what it granted.

    Parameters
    ----------
    priority
        Of SCHED_FIFO, 1 to 99; 0 leaves the scheduling policy as it is.
    cpu
        The one core to run on; -1 for the last one this process may use.

    Returns
    -------
    dict
        One entry a setting: what was obtained, or "refused: " and the reason.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    wanted: dict[str, Callable[[], str]] = {
        "memory": lambda: _lock_memory(libc),
        "timer_slack": lambda: _set_timer_slack(libc),
        "garbage_collector": collect_no_garbage,
        "cpu": lambda: _pin(cpu),
    }
    if priority > 0:
        wanted["scheduling"] = lambda: _schedule(priority)
    return {name: _attempt(setting) for name, setting in wanted.items()}


def _attempt(setting: Callable[[], str]) -> str:
    try:
        return setting()
    except (OSError, AttributeError, ValueError) as error:
        return f"{REFUSED}{error}"


def _lock_memory(libc: ctypes.CDLL) -> str:
    _call(libc.mlockall(_MCL_CURRENT_AND_FUTURE))
    return "locked"


def _set_timer_slack(libc: ctypes.CDLL) -> str:
    _call(libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0))
    return "1 ns"


def _pin(cpu: int) -> str:
    if cpu < 0:
        cpu = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpu})
    return str(cpu)


def _schedule(priority: int) -> str:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return f"SCHED_FIFO {priority}"


def _call(result: int) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
