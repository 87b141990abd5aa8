"""What a process takes of the computer while a session is recorded, seen from outside."""

import time
from dataclasses import dataclass
from pathlib import Path

from rigd.engine.board import Phase


@dataclass(frozen=True, slots=True)
class Usage:
    """Since a process began."""

    cpu_s: float
    page_faults: int


def usage_of(pid: int, proc: Path = Path("/proc")) -> Usage:
    """Return what a process of one thread has taken so far.

    The scheduler's own account counts nanoseconds; the usual one looks who runs at each of its
    ticks, which a loop in step with them can miss altogether.

    Raises
    ------
    OSError
        If it has ended.
    """
    # The name, in brackets, may hold anything.
    fields = (proc / str(pid) / "stat").read_text().rpartition(")")[2].split()
    cpu_ns = int((proc / str(pid) / "schedstat").read_text().split()[0])
    return Usage(cpu_ns * 1e-9, int(fields[7]) + int(fields[9]))


class UsageMeter:
    """Takes the usage of the control process from the first to the last look at a running record.

    Parameters
    ----------
    pid
        Of the process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._looks: list[tuple[float, Usage]] = []

    def look(self, phase: Phase) -> None:
        """Take a look, if the record is running."""
        if phase == Phase.RUNNING:
            try:
                usage = usage_of(self._pid)
            except OSError:
                return  # this kernel keeps no such account
            self._looks = [*self._looks[:1], (time.monotonic(), usage)]

    @property
    def cpu_percent(self) -> float | None:
        """Share of a core; None if there were not two looks."""
        if len(self._looks) < 2:
            return None
        (begin_s, first), (end_s, last) = self._looks
        return 100.0 * (last.cpu_s - first.cpu_s) / (end_s - begin_s)

    @property
    def page_faults(self) -> int | None:
        """Page faults between them."""
        if len(self._looks) < 2:
            return None
        return self._looks[1][1].page_faults - self._looks[0][1].page_faults
