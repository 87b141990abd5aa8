"""Results of a measurement of the loop: latency percentiles and processor time."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rigd.engine.shared_state import Phase

MIN_HELD_FRACTION = 0.999
"""Smallest fraction of ticks that must run within their periods so that the loop holds a rate."""
MIN_STALL_US = 2000.0
"""Smallest wake-up latency in µs that counts as a stall.

Firmware or the host of a virtual machine causes such delays, not the loop or its rate."""


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """Processor time in s and number of page faults of a process since its start."""

    cpu_s: float
    """Processor time that the process has used."""
    page_faults: int
    """Number of page faults, including those that wait for a disk."""


def process_usage(pid: int, proc_folder: Path = Path("/proc")) -> ProcessUsage:
    """Return the processor time and page faults of a process with one thread since its start.

    The time is taken from the scheduler's statistics, in nanoseconds. The usual statistics sample
    the running process at each scheduler tick, and can miss a loop in step with these ticks.

    Parameters
    ----------
    pid
        Process id.
    proc_folder
        Folder with the kernel's process table.

    Raises
    ------
    OSError
        If the process has ended.
    """
    # The process's name, in brackets, may contain any character.
    stat_fields = (proc_folder / str(pid) / "stat").read_text().rpartition(")")[2].split()
    cpu_ns = int((proc_folder / str(pid) / "schedstat").read_text().split()[0])
    return ProcessUsage(cpu_ns * 1e-9, int(stat_fields[7]) + int(stat_fields[9]))


class UsageMeter:
    """Meter of the processor time and page faults of the control process during a record.

    Parameters
    ----------
    pid
        Process id of the control process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._readings: list[tuple[float, ProcessUsage]] = []

    def sample_usage(self, phase: Phase) -> None:
        """Read the processor time and page faults so far, if the session's record is running."""
        if phase == Phase.RUNNING:
            try:
                present_usage = process_usage(self._pid)
            except OSError:
                return  # this kernel has no such statistics
            self._readings = [*self._readings[:1], (time.monotonic(), present_usage)]

    @property
    def cpu_percent(self) -> float | None:
        """Load of a processor core by the process in percent; None before the second reading."""
        if len(self._readings) < 2:
            return None
        (begin_s, first_usage), (end_s, last_usage) = self._readings
        return 100.0 * (last_usage.cpu_s - first_usage.cpu_s) / (end_s - begin_s)

    @property
    def page_faults(self) -> int | None:
        """Number of page faults from first to last reading; None before the second reading."""
        if len(self._readings) < 2:
            return None
        return self._readings[1][1].page_faults - self._readings[0][1].page_faults


@dataclass(frozen=True, slots=True)
class LatencyPercentiles:
    """Percentiles of a series of delays in µs."""

    p50: float
    """Median of the delays in µs."""
    p90: float
    """90th percentile of the delays in µs."""
    p99: float
    """99th percentile of the delays in µs."""
    p999: float
    """99.9th percentile of the delays in µs."""
    largest: float
    """Largest delay in µs."""


@dataclass(frozen=True, slots=True)
class LoopMeasurement:
    """Wake-up latencies, execution times and missed ticks of a loop, measured for some seconds."""

    name: str
    """Name of the measurement, which states the load."""
    rate_hz: float
    """Rate of the loop."""
    latencies_us: npt.NDArray[np.float64]
    """Wake-up latency of every tick that was run, shape (n,)."""
    execution_times_us: npt.NDArray[np.float64]
    """Execution time of every tick, shape (n,), or an empty array if the loop did no work."""
    scheduled_ticks: int
    """Number of scheduled ticks."""
    missed_ticks: int
    """Number of missed ticks."""
    cpu_percent: float | None = None
    """Load of one core by the loop's process in percent, or None if it was not measured."""
    page_faults: int | None = None
    """Number of page faults of the loop's process, or None if they were not counted."""

    @property
    def held_fraction(self) -> float:
        """Fraction of scheduled ticks that were run within their periods."""
        return 1.0 - self.missed_ticks / self.scheduled_ticks

    @property
    def held_fraction_between_stalls(self) -> float:
        """Fraction of scheduled ticks outside of stalls that were run within their periods."""
        stalls_us = self.latencies_us[self.latencies_us >= MIN_STALL_US]
        stalled_ticks = min(
            self.missed_ticks, int(np.floor(stalls_us * (self.rate_hz * 1e-6)).sum())
        )
        return 1.0 - (self.missed_ticks - stalled_ticks) / (self.scheduled_ticks - stalled_ticks)

    @property
    def stall_count(self) -> int:
        """Number of wake-up latencies of at least `MIN_STALL_US`."""
        return int(np.count_nonzero(self.latencies_us >= MIN_STALL_US))


def percentiles(delays_us: npt.NDArray[np.float64]) -> LatencyPercentiles:
    """Return the percentiles of delays in µs, of which there must be at least one.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.bench.measure import percentiles
    >>> found = percentiles(np.arange(101.0))
    >>> found.p50, found.p99, found.largest
    (50.0, 99.0, 100.0)
    """
    return LatencyPercentiles(*np.percentile(delays_us, [50, 90, 99, 99.9, 100]).tolist())


def wake_up_latencies_us(
    sample_records: npt.NDArray[np.void], rate_hz: float
) -> npt.NDArray[np.float64]:
    """Return the wake-up latency of each sample in µs, relative to the awaited deadline.

    The lateness in a sample is relative to the tick that was run. After missed ticks this tick is
    later than the awaited one.

    Parameters
    ----------
    sample_records
        Recorded samples, without those that the recorder lost.
    rate_hz
        Loop rate in ticks per second.
    """
    tick_numbers: npt.NDArray[np.int64] = sample_records["tick"].astype(np.int64)
    missed_ticks = np.diff(tick_numbers, prepend=-1) - 1
    latencies_us: npt.NDArray[np.float64] = sample_records["lateness_ns"] * 1e-3 + missed_ticks * (
        1e6 / rate_hz
    )
    return latencies_us


def measurement_from_samples(
    name: str,
    rate_hz: float,
    sample_records: npt.NDArray[np.void],
    *,
    scheduled_ticks: int,
    cpu_percent: float | None,
    page_faults: int | None,
) -> LoopMeasurement:
    """Return the measurement of a loop from the samples of its record.

    Parameters
    ----------
    name
        Name of the measurement.
    rate_hz
        Loop rate in ticks per second.
    sample_records
        Samples of the record; ticks without a sample were missed.
    scheduled_ticks
        Number of scheduled ticks.
    cpu_percent, page_faults
        Processor load and page faults of the control process.
    """
    return LoopMeasurement(
        name,
        rate_hz,
        wake_up_latencies_us(sample_records, rate_hz),
        sample_records["work_ns"] * 1e-3,
        scheduled_ticks,
        scheduled_ticks - sample_records.size,
        cpu_percent,
        page_faults,
    )


def pool_measurements(name: str, measurements: list[LoopMeasurement]) -> LoopMeasurement:
    """Combine several measurements of the same loop into one.

    Parameters
    ----------
    name
        Name of the measurement.
    measurements
        Measurements at one rate, at least one.
    """
    cpu_loads_percent = [
        measurement.cpu_percent
        for measurement in measurements
        if measurement.cpu_percent is not None
    ]
    page_fault_counts = [
        measurement.page_faults
        for measurement in measurements
        if measurement.page_faults is not None
    ]
    return LoopMeasurement(
        name,
        measurements[0].rate_hz,
        np.concatenate([measurement.latencies_us for measurement in measurements]),
        np.concatenate([measurement.execution_times_us for measurement in measurements]),
        sum(measurement.scheduled_ticks for measurement in measurements),
        sum(measurement.missed_ticks for measurement in measurements),
        sum(cpu_loads_percent) / len(cpu_loads_percent) if cpu_loads_percent else None,
        sum(page_fault_counts) if page_fault_counts else None,
    )
