"""Real-time settings of a rig's processes: each is requested, and the result is recorded.

The control process gets all settings for a 1 kHz loop (:func:`apply_realtime`). Supervisor and
recorder get a priority below the loop's and above that of every ordinary program
(:class:`Precedence`), so that a session can be stopped even if a viewer occupies the processor.
"""

import contextlib
import ctypes
import gc
import os
import resource
import struct
from collections.abc import Callable
from pathlib import Path

REFUSED = "refused: "
"""Prefix of the report on a setting that was not granted."""
LOCKED = "locked"
"""Report on memory that is locked, so that it causes no page faults."""
WAKE_UP_US = 2
"""Idle states with a longer exit latency are disabled. Halting is faster than that; with 0 an idle
core would poll and consume power."""

NICE = -10
"""Niceness of supervisor and recorder where the system grants no real-time priority."""

_MCL_CURRENT = 1
_MCL_FUTURE = 2
_PR_SET_TIMERSLACK = 29
_ISOLATED = "sys/devices/system/cpu/isolated"
_IDLE_STATES = "sys/devices/system/cpu"
_IDLE_STATES_BOUND = "dev/cpu_dma_latency"


def collect_no_garbage() -> str:
    """Turn off the cyclic garbage collector, whose run can take ten periods."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return "off"


def apply_realtime(*, priority: int, cpu: int, root: Path = Path("/")) -> dict[str, str]:
    """Apply the real-time settings of a 1 kHz loop, and return which were granted.

    Parameters
    ----------
    priority
        Priority under SCHED_FIFO, 1 to 99; 0 leaves the scheduling policy as it is.
    cpu
        Core to run on; -1: the last isolated one, or the last one that this process may use if none
        is isolated.
    root
        Root of the file system.

    Returns
    -------
    dict
        One entry per setting: the granted value, or "refused: " and the reason.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    wanted: dict[str, Callable[[], str]] = {
        "memory": lambda: lock_memory(libc),
        "timer_slack": lambda: _set_timer_slack(libc),
        "garbage_collector": collect_no_garbage,
        "cpu": lambda: _pin(cpu, root),
        "idle_states": lambda: _limit_idle_states(root),
    }
    if priority > 0:
        wanted["scheduling"] = lambda: _schedule(priority)
    return {name: _attempt(setting) for name, setting in wanted.items()}


def pin_off_loop_core(loop_cpu: int) -> None:
    """Restrict this process to cores other than the loop's, if it may use any.

    The loop has the higher priority in any case, but not over the kernel that clears or compacts
    memory for this process.

    Parameters
    ----------
    loop_cpu
        Core of the loop, as in ``realtime.cpu``.
    """
    core, _ = _core_of_loop(loop_cpu, Path("/"))
    others = os.sched_getaffinity(0) - {core}
    if others:
        os.sched_setaffinity(0, others)


class Precedence:
    """Priority of this process above ordinary programs and below the loop, until its release.

    If the real-time priority is granted, the process also avoids the loop's core where it may use
    another one. Its children are ordinary processes, but inherit the cores: give them
    :attr:`cores_before`.

    Parameters
    ----------
    priority
        Priority under SCHED_RR; 0 leaves the scheduling policy as it is.
    loop_cpu
        Core of the loop, as in ``realtime.cpu``.
    root
        Root of the file system.

    Attributes
    ----------
    cores_before
        Cores that this process could use before it left the loop's core.
    """

    def __init__(self, priority: int, loop_cpu: int, *, root: Path = Path("/")) -> None:
        self._priority = priority
        self.cores_before = frozenset(os.sched_getaffinity(0))
        core, _ = _core_of_loop(loop_cpu, root)
        self._others = self.cores_before - {core}
        self._apply: Callable[[int], None] | None = None

    def take(self) -> dict[str, str]:
        """Request the priority and return what was granted.

        Returns
        -------
        dict
            ``scheduling`` and ``cores``: the granted values, or "refused: " and the reason; empty
            if nothing was requested.
        """
        if self._priority == 0:
            return {}
        obtained = _attempt(self._try_realtime)
        if not obtained.startswith(REFUSED):
            return {"scheduling": obtained, "cores": _list_of(self._others or self.cores_before)}
        nice = _attempt(self._try_nice)
        if not nice.startswith(REFUSED):
            return {"scheduling": f"{nice} (SCHED_RR {obtained})"}
        return {"scheduling": obtained}

    def cover(self) -> None:
        """Extend the priority to new threads, which hold the same interpreter lock."""
        if self._apply is None:
            return
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(OSError):  # one that has just ended
                self._apply(int(thread.name))

    def release(self) -> None:
        """Return to ordinary priority; repeatable."""
        if self._apply is None:
            return
        self._apply = self._restore
        self.cover()
        self._apply = None

    def _try_realtime(self) -> str:
        self._set_realtime(0)
        self._apply = self._set_realtime
        self.cover()
        return f"SCHED_RR {self._priority}"

    def _try_nice(self) -> str:
        self._set_nice(0)
        self._apply = self._set_nice
        self.cover()
        return f"nice {NICE}"

    def _set_realtime(self, thread: int) -> None:
        # Forked processes and new threads start with the ordinary policy.
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(thread, policy, os.sched_param(self._priority))
        if not self._others:
            return
        try:
            os.sched_setaffinity(thread, self._others)
        except OSError:  # the set of usable cores has changed meanwhile
            _set_ordinary(thread)
            raise

    def _set_nice(self, thread: int) -> None:
        os.setpriority(os.PRIO_PROCESS, thread, NICE)
        _set_ordinary(thread)

    def _restore(self, thread: int) -> None:
        _set_ordinary(thread)
        os.setpriority(os.PRIO_PROCESS, thread, max(0, os.getpriority(os.PRIO_PROCESS, thread)))
        os.sched_setaffinity(thread, self.cores_before)


def _set_ordinary(thread: int) -> None:
    # The flag stays: removing it needs a privilege, and it is harmless.
    policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread, policy, os.sched_param(0))


def isolated_cores(root: Path = Path("/")) -> frozenset[int]:
    """Return the isolated cores of the kernel (``isolcpus``)."""
    try:
        return cores_of((root / _ISOLATED).read_text())
    except (OSError, ValueError):
        return frozenset()


def cores_of(text: str) -> frozenset[int]:
    """Return the cores in a list in the kernel's format: ``0-2,5``.

    Raises
    ------
    ValueError
        If the text is no such list.
    """
    cores: set[int] = set()
    for part in filter(None, text.strip().split(",")):
        first, _, last = part.partition("-")
        cores.update(range(int(first), int(last or first) + 1))
    return frozenset(cores)


def page_faults() -> int:
    """Return the number of page faults of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_minflt + usage.ru_majflt


def _attempt(setting: Callable[[], str]) -> str:
    try:
        return setting()
    except (OSError, AttributeError, ValueError) as error:
        return f"{REFUSED}{error}"


def lock_memory(libc: ctypes.CDLL) -> str:
    """Lock the memory of this process through `libc`, and report which part was locked."""
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit == resource.RLIM_INFINITY or os.geteuid() == 0:
        _call(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE))
        return LOCKED
    # With MCL_FUTURE, an allocation beyond the limit would fail in mid-session.
    _call(libc.mlockall(_MCL_CURRENT))
    return f"{LOCKED}, but for what is allocated later (limit of {limit / 1e6:.0f} MB)"


def _set_timer_slack(libc: ctypes.CDLL) -> str:
    _call(libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0))
    return "1 ns"


def _core_of_loop(cpu: int, root: Path) -> tuple[int, bool]:
    """Return the core that a control process chooses, and whether it is isolated."""
    if cpu >= 0:  # chosen whether it may be used or not
        return cpu, False
    isolated = isolated_cores(root)
    if isolated:
        # Isolated cores are not in a process's affinity until it requests one: try it.
        before = os.sched_getaffinity(0)
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {max(isolated)})
            os.sched_setaffinity(0, before)
            return max(isolated), True
    return max(os.sched_getaffinity(0)), False


def _list_of(cores: frozenset[int]) -> str:
    return ",".join(map(str, sorted(cores)))


def _pin(cpu: int, root: Path) -> str:
    core, isolated = _core_of_loop(cpu, root)
    os.sched_setaffinity(0, {core})
    return f"{core}, isolated" if isolated else str(core)


def _limit_idle_states(root: Path) -> str:
    states = (root / _IDLE_STATES).glob("cpu[0-9]*/cpuidle/state[0-9]*/latency")
    if all(int(state.read_text()) <= WAKE_UP_US for state in states):
        return f"none slower than {WAKE_UP_US} µs"
    fd = os.open(root / _IDLE_STATES_BOUND, os.O_WRONLY | os.O_CLOEXEC)
    # The bound holds while the descriptor is open, until this process ends.
    os.write(fd, struct.pack("=i", WAKE_UP_US))
    return f"those that are left within {WAKE_UP_US} µs"


def _schedule(priority: int) -> str:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return f"SCHED_FIFO {priority}"


def _call(result: int) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
