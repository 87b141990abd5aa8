"""Real-time settings of a rig's processes: each is tried, and what was obtained is recorded.

The control process gets all that a 1 kHz loop wants (:func:`obtain`). Supervisor and recorder get a
priority below the loop's and above that of every ordinary program (:class:`Precedence`), for nobody
stops a session whose supervisor waits for the processor behind a viewer.
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
"""Beginning of the report on a setting that was not granted."""
LOCKED = "locked"
"""The report on memory of which no part is ever waited for."""
WAKE_UP_US = 2
"""Idle states that take longer to leave are kept away. Halting is quicker than that; with 0 an idle
core would poll, and a rig that waits for its operator would heat the room."""

NICE = -10
"""Niceness of supervisor and recorder where the system grants no real-time priority."""

_MCL_CURRENT = 1
_MCL_FUTURE = 2
_PR_SET_TIMERSLACK = 29
_ISOLATED = "sys/devices/system/cpu/isolated"
_IDLE_STATES = "sys/devices/system/cpu"
_IDLE_STATES_BOUND = "dev/cpu_dma_latency"


def collect_no_garbage() -> str:
    """Turn the cyclic collector off: one run of it can take ten periods."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return "off"


def obtain(*, priority: int, cpu: int, root: Path = Path("/")) -> dict[str, str]:
    """Ask the system for what a 1 kHz loop wants, and report what it granted.

    Parameters
    ----------
    priority
        Priority under SCHED_FIFO, 1 to 99; 0 leaves the scheduling policy as it is.
    cpu
        The one core to run on; -1 for the last isolated one, or where none is isolated the last one
        this process may use.
    root
        Root of the file system.

    Returns
    -------
    dict
        One entry a setting: what was obtained, or "refused: " and the reason.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    wanted: dict[str, Callable[[], str]] = {
        "memory": lambda: lock_memory(libc),
        "timer_slack": lambda: _set_timer_slack(libc),
        "garbage_collector": collect_no_garbage,
        "cpu": lambda: _pin(cpu, root),
        "idle_states": lambda: _keep_awake(root),
    }
    if priority > 0:
        wanted["scheduling"] = lambda: _schedule(priority)
    return {name: _attempt(setting) for name, setting in wanted.items()}


def keep_off_loop(loop_cpu: int) -> None:
    """Keep this process off the loop's core, if it may use another one.

    The loop comes before it in any case, but not while the kernel clears or compacts memory for it.

    Parameters
    ----------
    loop_cpu
        ``realtime.cpu``, which says where the loop runs.
    """
    core, _ = _core_of_loop(loop_cpu, Path("/"))
    others = os.sched_getaffinity(0) - {core}
    if others:
        os.sched_setaffinity(0, others)


class Precedence:
    """Puts this process before the ordinary ones and behind the loop, until it is released.

    Where the real-time priority is granted the process also keeps off the loop's core if it may use
    another one. Whatever it starts meanwhile is an ordinary process again, but for the cores: who
    starts one hands it :attr:`cores_before`.

    Parameters
    ----------
    priority
        Priority under SCHED_RR; 0 leaves the scheduling policy as it is.
    loop_cpu
        ``realtime.cpu``, which says where the loop runs.
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
        self._put: Callable[[int], None] | None = None

    def take(self) -> dict[str, str]:
        """Ask for it and report what was granted.

        Returns
        -------
        dict
            ``scheduling`` and ``cores``: what was obtained, or "refused: " and the reason; empty if
            nothing was to be asked for.
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
        """Extend it to threads that were started since: they share the interpreter's lock."""
        if self._put is None:
            return
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(OSError):  # one that has just ended
                self._put(int(thread.name))

    def release(self) -> None:
        """Be an ordinary process again; harmless when repeated."""
        if self._put is None:
            return
        self._put = self._put_back
        self.cover()
        self._put = None

    def _try_realtime(self) -> str:
        self._put_first(0)
        self._put = self._put_first
        self.cover()
        return f"SCHED_RR {self._priority}"

    def _try_nice(self) -> str:
        self._put_nicely(0)
        self._put = self._put_nicely
        self.cover()
        return f"nice {NICE}"

    def _put_first(self, thread: int) -> None:
        # What is forked, a thread as well, starts with the ordinary policy.
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(thread, policy, os.sched_param(self._priority))
        if not self._others:
            return
        try:
            os.sched_setaffinity(thread, self._others)
        except OSError:  # the cores that it may use have become others meanwhile
            _be_ordinary(thread)
            raise

    def _put_nicely(self, thread: int) -> None:
        os.setpriority(os.PRIO_PROCESS, thread, NICE)
        _be_ordinary(thread)

    def _put_back(self, thread: int) -> None:
        _be_ordinary(thread)
        os.setpriority(os.PRIO_PROCESS, thread, max(0, os.getpriority(os.PRIO_PROCESS, thread)))
        os.sched_setaffinity(thread, self.cores_before)


def _be_ordinary(thread: int) -> None:
    # The mark stays: without a privilege it cannot be taken away, and it does no harm.
    policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread, policy, os.sched_param(0))


def isolated_cores(root: Path = Path("/")) -> frozenset[int]:
    """Return the cores that the kernel was told to leave alone (``isolcpus``)."""
    try:
        return cores_of((root / _ISOLATED).read_text())
    except (OSError, ValueError):
        return frozenset()


def cores_of(text: str) -> frozenset[int]:
    """Return the cores of a list as the kernel writes it: ``0-2,5``.

    Raises
    ------
    ValueError
        If it is none.
    """
    cores: set[int] = set()
    for part in filter(None, text.strip().split(",")):
        first, _, last = part.partition("-")
        cores.update(range(int(first), int(last or first) + 1))
    return frozenset(cores)


def page_faults() -> int:
    """Return how often this process has waited for a page of memory so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_minflt + usage.ru_majflt


def _attempt(setting: Callable[[], str]) -> str:
    try:
        return setting()
    except (OSError, AttributeError, ValueError) as error:
        return f"{REFUSED}{error}"


def lock_memory(libc: ctypes.CDLL) -> str:
    """Lock the memory of this process through `libc`, and return what was locked."""
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit == resource.RLIM_INFINITY or os.geteuid() == 0:
        _call(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE))
        return LOCKED
    # What is allocated beyond the limit would not be slow then, but fail in mid-session.
    _call(libc.mlockall(_MCL_CURRENT))
    return f"{LOCKED}, but for what is allocated later (limit of {limit / 1e6:.0f} MB)"


def _set_timer_slack(libc: ctypes.CDLL) -> str:
    _call(libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0))
    return "1 ns"


def _core_of_loop(cpu: int, root: Path) -> tuple[int, bool]:
    """Return the core that a control process chooses, and whether that one is isolated.

    Parameters
    ----------
    cpu
        As given to :func:`obtain`. One that is named is chosen whether it may be used or not.
    root
        Root of the file system.
    """
    if cpu >= 0:
        return cpu, False
    isolated = isolated_cores(root)
    if isolated:
        # They are not among those that a process may use until it asks for one by its number; so
        # whether it may use one is seen by asking.
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


def _keep_awake(root: Path) -> str:
    states = (root / _IDLE_STATES).glob("cpu[0-9]*/cpuidle/state[0-9]*/latency")
    if all(int(state.read_text()) <= WAKE_UP_US for state in states):
        return f"none slower than {WAKE_UP_US} µs"
    fd = os.open(root / _IDLE_STATES_BOUND, os.O_WRONLY | os.O_CLOEXEC)
    # It holds as long as the descriptor is open, which is as long as this process lives.
    os.write(fd, struct.pack("=i", WAKE_UP_US))
    return f"those that are left within {WAKE_UP_US} µs"


def _schedule(priority: int) -> str:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return f"SCHED_FIFO {priority}"


def _call(result: int) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
