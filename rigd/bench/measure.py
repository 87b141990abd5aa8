"""One measurement of the loop: latency percentiles and processor time."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rigd.engine.shared_state import Phase

HELD = 0.999
"""Fraction of ticks that must run within their periods for a rate to hold."""
STALL_US = 2000.0
"""Latency above which neither the loop nor the rate is the cause, but firmware or the host of a
virtual machine."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Processor time and page faults since the start of a process."""

    cpu_s: float
    """Processor time, s."""
    page_faults: int
    """Page faults, including those that wait for a disk."""


def usage_of(pid: int, proc: Path = Path("/proc")) -> Usage:
    """Return the usage of a process with one thread so far.

    The statistics of the scheduler count nanoseconds. The usual ones sample the running process at
    each scheduler tick, and can miss a loop that is synchronous with these ticks.

    Parameters
    ----------
    pid
        Number of the process.
    proc
        Process table of the kernel.

    Raises
    ------
    OSError
        If the process has ended.
    """
    # The name, in brackets, may contain any character.
    fields = (proc / str(pid) / "stat").read_text().rpartition(")")[2].split()
    cpu_ns = int((proc / str(pid) / "schedstat").read_text().split()[0])
    return Usage(cpu_ns * 1e-9, int(fields[7]) + int(fields[9]))


class UsageMeter:
    """Meter of the usage of the control process during a running record.

    Parameters
    ----------
    pid
        Process identifier.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._readings: list[tuple[float, Usage]] = []

    def sample(self, phase: Phase) -> None:
        """Read the usage if the record is running."""
        if phase == Phase.RUNNING:
            try:
                usage = usage_of(self._pid)
            except OSError:
                return  # this kernel has no such statistics
            self._readings = [*self._readings[:1], (time.monotonic(), usage)]

    @property
    def cpu_percent(self) -> float | None:
        """Load of a core in percent; None with fewer than two readings."""
        if len(self._readings) < 2:
            return None
        (begin_s, first), (end_s, last) = self._readings
        return 100.0 * (last.cpu_s - first.cpu_s) / (end_s - begin_s)

    @property
    def page_faults(self) -> int | None:
        """Page faults between the first and the last reading; None with fewer than two."""
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
class LoopMeasurement:
    """LoopMeasurement of one loop for some seconds."""

    name: str
    """Name of the measurement, with the load."""
    rate_hz: float
    """Rate of the loop."""
    lateness_us: npt.NDArray[np.float64]
    """Wake-up latency of every tick that was run, (n,)."""
    work_us: npt.NDArray[np.float64]
    """Execution time from the wake-up to the end of the work, (n,); empty without work."""
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
        """Fraction of scheduled ticks that were run within their periods."""
        return 1.0 - self.missed / self.scheduled

    @property
    def held_between_stalls(self) -> float:
        """The same fraction without the ticks during stalls."""
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
    """Return the wake-up latency of each sample in µs, relative to the awaited deadline.

    The lateness in a sample is relative to the tick that was run. After missed ticks this tick is
    later than the awaited one.

    Parameters
    ----------
    samples
        Recorded samples, without lost ones.
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
) -> LoopMeasurement:
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
    return LoopMeasurement(
        name,
        rate_hz,
        wake_ups_us(samples, rate_hz),
        samples["work_ns"] * 1e-3,
        scheduled,
        scheduled - samples.size,
        cpu_percent,
        page_faults,
    )


def pooled(name: str, parts: list[LoopMeasurement]) -> LoopMeasurement:
    """Return the pooled measurement of several measurements of the same loop.

    Parameters
    ----------
    name
        Name of the measurement.
    parts
        Measurements at one rate, at least one.
    """
    costs = [part.cpu_percent for part in parts if part.cpu_percent is not None]
    faults = [part.page_faults for part in parts if part.page_faults is not None]
    return LoopMeasurement(
        name,
        parts[0].rate_hz,
        np.concatenate([part.lateness_us for part in parts]),
        np.concatenate([part.work_us for part in parts]),
        sum(part.scheduled for part in parts),
        sum(part.missed for part in parts),
        sum(costs) / len(costs) if costs else None,
        sum(faults) if faults else None,
    )
