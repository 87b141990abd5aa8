"""Real-time settings of a rig's processes, with text on whether the system granted each setting.

The control process gets all settings for a 1 kHz loop (:func:`apply_realtime`). Supervisor and
recorder get a priority below the loop's and above that of every ordinary program
(:class:`RaisedPriority`), so that a session can be stopped even if a viewer occupies the processor.
"""

import contextlib
import ctypes
import gc
import os
import resource
import struct
from collections.abc import Callable
from pathlib import Path

REFUSED_PREFIX = "refused: "
"""Prefix of the text for a real-time setting that the system did not grant; the reason follows."""
MEMORY_LOCKED = "locked"
"""Text for a granted lock of the process's memory, which prevents page faults."""
MAX_WAKE_UP_US = 2
"""Longest exit latency in µs of the idle states that a core may use; slower states are disabled.
The halt state is faster than 2 µs. With 0 an idle core would poll and consume power."""

SUPERVISION_NICENESS = -10
"""Niceness of supervisor and recorder if the system grants no real-time priority."""

_MCL_CURRENT = 1
"""Flag of ``mlockall``: lock the memory that is allocated now."""
_MCL_FUTURE = 2
"""Flag of ``mlockall``: lock memory that is allocated later."""
_PR_SET_TIMERSLACK = 29
"""Operation of ``prctl`` that sets the timer slack."""
_ISOLATED_CORES_FILE = "sys/devices/system/cpu/isolated"
"""File that lists the kernel's isolated cores."""
_IDLE_STATES_FOLDER = "sys/devices/system/cpu"
"""Folder with the idle states of each core."""
_IDLE_LATENCY_DEVICE = "dev/cpu_dma_latency"
"""Device file that limits the exit latency of idle states while it is open."""


def disable_garbage_collection() -> str:
    """Turn off Python's cyclic garbage collector, which can take ten periods; return "off"."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return "off"


def apply_realtime(*, priority: int, cpu: int, root_folder: Path = Path("/")) -> dict[str, str]:
    """Apply the real-time settings of a 1 kHz loop, and return the result of each setting.

    Parameters
    ----------
    priority
        Priority under SCHED_FIFO, 1 to 99; 0 leaves the scheduling policy unchanged.
    cpu
        Core to run on; -1: the last isolated core or, if none is isolated, the last core that this
        process may use.
    root_folder
        Root of the file system, which tests replace.

    Returns
    -------
    dict
        One entry per setting: the granted value, or "refused: " and the reason.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    setting_functions: dict[str, Callable[[], str]] = {
        "memory": lambda: lock_memory(libc),
        "timer_slack": lambda: _set_timer_slack(libc),
        "garbage_collector": disable_garbage_collection,
        "cpu": lambda: _pin_to_loop_core(cpu, root_folder),
        "idle_states": lambda: _limit_idle_states(root_folder),
    }
    if priority > 0:
        setting_functions["scheduling"] = lambda: _set_fifo_priority(priority)
    return {
        setting_name: _try_setting(apply_setting)
        for setting_name, apply_setting in setting_functions.items()
    }


def pin_off_loop_core(loop_cpu: int) -> None:
    """Restrict this process to cores other than the control loop's, if there are others.

    The loop has a higher priority than this process, but not than the kernel while it clears or
    compacts memory for this process.

    Parameters
    ----------
    loop_cpu
        Core of the loop, as in ``realtime.cpu``.
    """
    core, _ = _core_of_loop(loop_cpu, Path("/"))
    other_cores = os.sched_getaffinity(0) - {core}
    if other_cores:
        os.sched_setaffinity(0, other_cores)


class RaisedPriority:
    """Raised priority of this process: above ordinary programs and below the control loop.

    The raised priority lasts from :meth:`request_priority` to :meth:`restore_priority`. If it
    is granted as real-time priority, the process also leaves the loop's core if it may use another
    one. Child processes have ordinary priority but inherit the cores: start them with
    :attr:`cores_before`.

    Parameters
    ----------
    realtime_priority
        Priority under SCHED_RR; 0 leaves the scheduling policy unchanged.
    loop_cpu
        Core of the loop, as in ``realtime.cpu``.
    root_folder
        Root of the file system, which tests replace.

    Attributes
    ----------
    cores_before
        Cores that this process could use before it left the loop's core.
    """

    def __init__(
        self, realtime_priority: int, loop_cpu: int, *, root_folder: Path = Path("/")
    ) -> None:
        self._priority = realtime_priority
        self.cores_before = frozenset(os.sched_getaffinity(0))
        core, _ = _core_of_loop(loop_cpu, root_folder)
        self._other_cores = self.cores_before - {core}
        self._apply_priority: Callable[[int], None] | None = None

    def request_priority(self) -> dict[str, str]:
        """Request the raised priority; return which settings the system granted.

        Returns
        -------
        dict
            ``scheduling`` and ``cores``: the granted values, or "refused: " and the reason; empty
            if nothing was requested.
        """
        if self._priority == 0:
            return {}
        scheduling_result = _try_setting(self._raise_to_realtime)
        if not scheduling_result.startswith(REFUSED_PREFIX):
            return {
                "scheduling": scheduling_result,
                "cores": _format_cores(self._other_cores or self.cores_before),
            }
        niceness_result = _try_setting(self._raise_by_niceness)
        if not niceness_result.startswith(REFUSED_PREFIX):
            return {"scheduling": f"{niceness_result} (SCHED_RR {scheduling_result})"}
        return {"scheduling": scheduling_result}

    def raise_priority_of_new_threads(self) -> None:
        """Give the threads that were started since `request_priority` the priority of the process.

        All threads need it, because they compete for one interpreter lock.
        """
        if self._apply_priority is None:
            return
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(OSError):  # one that has just ended
                self._apply_priority(int(thread.name))

    def restore_priority(self) -> None:
        """Return to ordinary priority; calling this again has no effect."""
        if self._apply_priority is None:
            return
        self._apply_priority = self._restore_thread_priority
        self.raise_priority_of_new_threads()
        self._apply_priority = None

    def _raise_to_realtime(self) -> str:
        """Set the real-time priority SCHED_RR for all threads, and return its description."""
        self._set_realtime_priority(0)
        self._apply_priority = self._set_realtime_priority
        self.raise_priority_of_new_threads()
        return f"SCHED_RR {self._priority}"

    def _raise_by_niceness(self) -> str:
        """Set the niceness `SUPERVISION_NICENESS` for all threads, and return its description."""
        self._set_niceness(0)
        self._apply_priority = self._set_niceness
        self.raise_priority_of_new_threads()
        return f"nice {SUPERVISION_NICENESS}"

    def _set_realtime_priority(self, thread_id: int) -> None:
        """Set the real-time priority of a thread, and restrict it to cores without the loop."""
        # Forked processes and new threads start with the ordinary policy.
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(thread_id, policy, os.sched_param(self._priority))
        if not self._other_cores:
            return
        try:
            os.sched_setaffinity(thread_id, self._other_cores)
        except OSError:  # the set of usable cores has changed meanwhile
            _set_ordinary_policy(thread_id)
            raise

    def _set_niceness(self, thread_id: int) -> None:
        """Set the niceness `SUPERVISION_NICENESS` and the ordinary policy of a thread."""
        os.setpriority(os.PRIO_PROCESS, thread_id, SUPERVISION_NICENESS)
        _set_ordinary_policy(thread_id)

    def _restore_thread_priority(self, thread_id: int) -> None:
        """Set ordinary priority and the original cores of a thread."""
        _set_ordinary_policy(thread_id)
        os.setpriority(
            os.PRIO_PROCESS, thread_id, max(0, os.getpriority(os.PRIO_PROCESS, thread_id))
        )
        os.sched_setaffinity(thread_id, self.cores_before)


def _set_ordinary_policy(thread_id: int) -> None:
    """Set the ordinary scheduling policy of a thread."""
    # The flag stays: removing it needs a privilege, and it is harmless.
    policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread_id, policy, os.sched_param(0))


def isolated_cores(root_folder: Path = Path("/")) -> frozenset[int]:
    """Return the processor cores that the kernel isolates (``isolcpus``); empty if unknown."""
    try:
        return parse_core_list((root_folder / _ISOLATED_CORES_FILE).read_text())
    except (OSError, ValueError):
        return frozenset()


def parse_core_list(core_list_text: str) -> frozenset[int]:
    """Return the core numbers in a list in the kernel's format, such as ``0-2,5``.

    Raises
    ------
    ValueError
        If the text is no such list.
    """
    core_numbers: set[int] = set()
    for core_range in filter(None, core_list_text.strip().split(",")):
        first_core, _, last_core = core_range.partition("-")
        core_numbers.update(range(int(first_core), int(last_core or first_core) + 1))
    return frozenset(core_numbers)


def page_faults() -> int:
    """Return the number of page faults of this process so far."""
    resource_usage = resource.getrusage(resource.RUSAGE_SELF)
    return resource_usage.ru_minflt + resource_usage.ru_majflt


def _try_setting(apply_setting: Callable[[], str]) -> str:
    """Apply a setting and return its result, or "refused: " and the reason of the failure."""
    try:
        return apply_setting()
    except (OSError, AttributeError, ValueError) as error:
        return f"{REFUSED_PREFIX}{error}"


def lock_memory(libc: ctypes.CDLL) -> str:
    """Lock the memory of this process against paging; return a text that states how much.

    `libc` is the C library with the function ``mlockall``.
    """
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit_bytes == resource.RLIM_INFINITY or os.geteuid() == 0:
        _check_return_code(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE))
        return MEMORY_LOCKED
    # With MCL_FUTURE, an allocation beyond the limit would fail in mid-session.
    _check_return_code(libc.mlockall(_MCL_CURRENT))
    return (
        f"{MEMORY_LOCKED}, except for memory that is allocated later (limit of "
        f"{limit_bytes / 1e6:.0f} MB)"
    )


def _set_timer_slack(libc: ctypes.CDLL) -> str:
    """Set the smallest timer slack, so that sleeps end on time, and return its value as text."""
    _check_return_code(libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0))
    return "1 ns"


def _core_of_loop(loop_cpu: int, root_folder: Path) -> tuple[int, bool]:
    """Return the core on which the control process runs, and whether the kernel isolates it."""
    if loop_cpu >= 0:  # chosen whether it may be used or not
        return loop_cpu, False
    isolated_core_numbers = isolated_cores(root_folder)
    if isolated_core_numbers:
        # Isolated cores are not in a process's affinity until it requests one: try it.
        allowed_cores = os.sched_getaffinity(0)
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {max(isolated_core_numbers)})
            os.sched_setaffinity(0, allowed_cores)
            return max(isolated_core_numbers), True
    return max(os.sched_getaffinity(0)), False


def _format_cores(cores: frozenset[int]) -> str:
    """Return the numbers of cores as text, separated by commas."""
    return ",".join(map(str, sorted(cores)))


def _pin_to_loop_core(loop_cpu: int, root_folder: Path) -> str:
    """Restrict this process to the core of the loop; return the number of the core as text."""
    core, isolated = _core_of_loop(loop_cpu, root_folder)
    os.sched_setaffinity(0, {core})
    return f"{core}, isolated" if isolated else str(core)


def _limit_idle_states(root_folder: Path) -> str:
    """Disable slow idle states of the cores until this process ends; return text on the result."""
    latency_files = (root_folder / _IDLE_STATES_FOLDER).glob(
        "cpu[0-9]*/cpuidle/state[0-9]*/latency"
    )
    if all(int(latency_file.read_text()) <= MAX_WAKE_UP_US for latency_file in latency_files):
        return f"none slower than {MAX_WAKE_UP_US} µs"
    fd = os.open(root_folder / _IDLE_LATENCY_DEVICE, os.O_WRONLY | os.O_CLOEXEC)
    # The bound holds while the descriptor is open, until this process ends.
    os.write(fd, struct.pack("=i", MAX_WAKE_UP_US))
    return f"the remaining ones within {MAX_WAKE_UP_US} µs"


def _set_fifo_priority(realtime_priority: int) -> str:
    """Set the real-time policy SCHED_FIFO for this process, and return it as text."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(realtime_priority))
    return f"SCHED_FIFO {realtime_priority}"


def _check_return_code(return_code: int) -> None:
    """Raise the C library's last error if the return code of a call is not 0."""
    if return_code != 0:
        error_number = ctypes.get_errno()
        raise OSError(error_number, os.strerror(error_number))
