"""One measurement of the loop: its figures, and the processor time it takes."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rigd.engine.shared_state import Phase

HELD = 0.999
"""Share of its ticks that a computer has to run in their periods to hold a rate."""
STALL_US = 2000.0
"""A wake-up that is as late as this was held up by no loop and no rate: the host of a virtual
machine took the processor away, or firmware did."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Processor time and page faults since a process began."""

    cpu_s: float
    """Processor time, s."""
    page_faults: int
    """Page faults, those that wait for a disk included."""


def usage_of(pid: int, proc: Path = Path("/proc")) -> Usage:
    """Return what a process of one thread has taken so far.

    The scheduler's own account counts nanoseconds; the usual one looks who runs at each of its
    ticks, which a loop in step with them can miss altogether.

    Parameters
    ----------
    pid
        Number of the process.
    proc
        Process table of the kernel.

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
        Process identifier.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._readings: list[tuple[float, Usage]] = []

    def look(self, phase: Phase) -> None:
        """Take a look, if the record is running."""
        if phase == Phase.RUNNING:
            try:
                usage = usage_of(self._pid)
            except OSError:
                return  # this kernel keeps no such account
            self._readings = [*self._readings[:1], (time.monotonic(), usage)]

    @property
    def cpu_percent(self) -> float | None:
        """Share of a core; None if there were not two looks."""
        if len(self._readings) < 2:
            return None
        (begin_s, first), (end_s, last) = self._readings
        return 100.0 * (last.cpu_s - first.cpu_s) / (end_s - begin_s)

    @property
    def page_faults(self) -> int | None:
        """Page faults between them."""
        if len(self._readings) < 2:
            return None
        return self._readings[1][1].page_faults - self._readings[0][1].page_faults


@dataclass(frozen=True, slots=True)
class Figures:
    """Percentiles, in µs."""

    p50: float
    """Median."""
    p90: float
    """90th percentile."""
    p99: float
    """99th percentile."""
    p999: float
    """99.9th percentile."""
    largest: float
    """Maximum."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One loop, run for some seconds."""

    name: str
    """What ran, and beside what."""
    rate_hz: float
    """Rate of the loop."""
    lateness_us: npt.NDArray[np.float64]
    """(n,) of every tick that was run: wake-up after the deadline that was waited for."""
    work_us: npt.NDArray[np.float64]
    """(n,) from the wake-up to the end of its work; empty where none was done."""
    scheduled: int
    """Ticks that were due."""
    missed: int
    """Ticks that were skipped."""
    cpu_percent: float | None = None
    """Load of one core by the process of the loop."""
    page_faults: int | None = None
    """Page faults of the loop's process; None: not counted."""

    @property
    def held(self) -> float:
        """Share of the scheduled ticks that were run in their periods."""
        return 1.0 - self.missed / self.scheduled

    @property
    def held_between_stalls(self) -> float:
        """The same, leaving out the ticks that passed while the computer stood still."""
        stalls_us = self.lateness_us[self.lateness_us >= STALL_US]
        passed = min(self.missed, int(np.floor(stalls_us * (self.rate_hz * 1e-6)).sum()))
        return 1.0 - (self.missed - passed) / (self.scheduled - passed)

    @property
    def stalls(self) -> int:
        """Number of stalls."""
        return int(np.count_nonzero(self.lateness_us >= STALL_US))


def figures(values_us: npt.NDArray[np.float64]) -> Figures:
    """Return the percentiles of at least one value.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.bench.measure import figures
    >>> found = figures(np.arange(101.0))
    >>> found.p50, found.p99, found.largest
    (50.0, 99.0, 100.0)
    """
    return Figures(*np.percentile(values_us, [50, 90, 99, 99.9, 100]).tolist())


def wake_ups_us(samples: npt.NDArray[np.void], rate_hz: float) -> npt.NDArray[np.float64]:
    """Return by how much each wake-up missed the deadline that was waited for.

    The lateness of a sample counts from the tick that was run, which after missed ticks is a later
    one than that which was waited for.

    Parameters
    ----------
    samples
        As recorded, with none lost.
    rate_hz
        Ticks a second.
    """
    ticks: npt.NDArray[np.int64] = samples["tick"].astype(np.int64)
    missed = np.diff(ticks, prepend=-1) - 1
    late_us: npt.NDArray[np.float64] = samples["lateness_ns"] * 1e-3 + missed * (1e6 / rate_hz)
    return late_us


def measurement(
    name: str,
    rate_hz: float,
    samples: npt.NDArray[np.void],
    *,
    scheduled: int,
    cpu_percent: float | None,
    page_faults: int | None,
) -> Measurement:
    """Return the measurement from the samples of a record.

    Parameters
    ----------
    name
        Name of the measurement.
    rate_hz
        Ticks a second.
    samples
        Samples of the record; ticks without a sample were missed.
    scheduled
        Ticks of the record.
    cpu_percent, page_faults
        Processor load and page faults of the control process.
    """
    return Measurement(
        name,
        rate_hz,
        wake_ups_us(samples, rate_hz),
        samples["work_ns"] * 1e-3,
        scheduled,
        scheduled - samples.size,
        cpu_percent,
        page_faults,
    )


def pooled(name: str, parts: list[Measurement]) -> Measurement:
    """Return several measurements of the same as one.

    Parameters
    ----------
    name
        Name of the measurement.
    parts
        Measurements at one rate, at least one.
    """
    costs = [part.cpu_percent for part in parts if part.cpu_percent is not None]
    faults = [part.page_faults for part in parts if part.page_faults is not None]
    return Measurement(
        name,
        parts[0].rate_hz,
        np.concatenate([part.lateness_us for part in parts]),
        np.concatenate([part.work_us for part in parts]),
        sum(part.scheduled for part in parts),
        sum(part.missed for part in parts),
        sum(costs) / len(costs) if costs else None,
        sum(faults) if faults else None,
    )
