"""Reference measurement with cyclictest of rt-tests, of the lowest latency on this computer."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator

import numpy as np

from rigd.bench.measure import LoopMeasurement
from rigd.engine.realtime import MAX_WAKE_UP_US
from rigd.errors import FailureError

PROGRAM_NAME = "cyclictest"
"""Name of the program, and of its measurement in reports."""
_MAX_HISTOGRAM_DELAY_US = 50_000
"""Largest delay of the histogram in µs."""
_TIMEOUT_MARGIN_S = 20.0
"""Longest time in seconds from the end of the measurement to the end of the program."""
_HISTOGRAM_BIN_PATTERN = re.compile(r"^(\d+)\s+(\d+)\s*$", re.MULTILINE)
"""Pattern of a bin in the program's output: delay in µs and count."""
_OVERFLOW_COUNT_PATTERN = re.compile(r"^# Histogram Overflows:\s*(\d+)", re.MULTILINE)
"""Pattern of the number of delays beyond the histogram."""
_LARGEST_DELAY_PATTERN = re.compile(r"^# Max Latencies:\s*(\d+)", re.MULTILINE)
"""Pattern of the largest delay in µs."""


class CyclictestError(FailureError):
    """Error if cyclictest cannot be run or its output is unexpected; the message says why."""


def is_installed() -> bool:
    """Return whether cyclictest is installed."""
    return shutil.which(PROGRAM_NAME) is not None


def run_cyclictest(
    rate_hz: float, duration_s: float, *, core_number: int, priority: int
) -> LoopMeasurement:
    """Measure the wake-up latency with cyclictest under the conditions of the loop.

    The program runs on the core `core_number` with the SCHED_FIFO priority `priority`; 0 means
    ordinary scheduling.
    """
    command_line = [
        *(PROGRAM_NAME, "--quiet", "--threads=1", f"--affinity={core_number}", "--mlockall"),
        *(f"--priority={priority}", f"--policy={'fifo' if priority else 'other'}"),
        *(f"--interval={round(1e6 / rate_hz)}", f"--loops={round(rate_hz * duration_s)}"),
        *(f"--histogram={_MAX_HISTOGRAM_DELAY_US}", f"--latency={MAX_WAKE_UP_US}"),
    ]
    try:
        completed_process = subprocess.run(
            command_line,
            capture_output=True,
            text=True,
            check=True,
            timeout=duration_s + _TIMEOUT_MARGIN_S,
            env=os.environ | {"LC_ALL": "C"},
        )
    except (OSError, subprocess.SubprocessError) as error:
        error_message = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise CyclictestError(
            error_message[-1] if error_message else "it failed without a message"
        ) from error
    return parse_measurement(completed_process.stdout, rate_hz)


def parse_measurement(program_output: str, rate_hz: float) -> LoopMeasurement:
    """Parse the output of ``cyclictest --histogram`` with one thread, and return its measurement.

    A wake-up one period or more late counts as missed ticks, because cyclictest also continues with
    the next deadline in the future. Delays beyond the histogram count as the largest delay.
    """
    delays_us = np.array(list(_delays_us(program_output)), dtype=np.float64)
    if not delays_us.size:
        raise CyclictestError("its output holds no histogram.")
    missed_ticks = int(np.floor(delays_us * rate_hz * 1e-6).sum())
    return LoopMeasurement(
        PROGRAM_NAME,
        rate_hz,
        delays_us,
        np.empty(0),
        scheduled_ticks=delays_us.size + missed_ticks,
        missed_ticks=missed_ticks,
    )


def _delays_us(program_output: str) -> Iterator[float]:
    """Yield all delays in µs of the histogram in the program's output."""
    for delay_us, delay_count in _HISTOGRAM_BIN_PATTERN.findall(program_output):
        yield from [float(delay_us)] * int(delay_count)
    overflow_match, largest_match = (
        _OVERFLOW_COUNT_PATTERN.search(program_output),
        _LARGEST_DELAY_PATTERN.search(program_output),
    )
    if overflow_match is not None and largest_match is not None:
        yield from [float(largest_match[1])] * int(overflow_match[1])
