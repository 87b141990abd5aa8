"""Reference of the loop: cyclictest of rt-tests, the lowest latency on this computer."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator

import numpy as np

from rigd.bench.measure import LoopMeasurement
from rigd.engine.realtime import WAKE_UP_US
from rigd.errors import FailureError

NAME = "cyclictest"
_LARGEST_US = 50_000
_MARGIN_S = 20.0
_BIN = re.compile(r"^(\d+)\s+(\d+)\s*$", re.MULTILINE)
_OVERFLOWS = re.compile(r"^# Histogram Overflows:\s*(\d+)", re.MULTILINE)
_LARGEST = re.compile(r"^# Max Latencies:\s*(\d+)", re.MULTILINE)


class CyclictestError(FailureError):
    """cyclictest could not be run, or its output is unexpected; the message states the reason."""


def installed() -> bool:
    """Whether cyclictest is installed."""
    return shutil.which(NAME) is not None


def run(rate_hz: float, seconds: float, *, cpu: int, priority: int) -> LoopMeasurement:
    """Run cyclictest on the core of the loop, with its policy, priority and interval.

    `priority` is that of SCHED_FIFO; 0 means the ordinary policy.
    """
    command = [
        *(NAME, "--quiet", "--threads=1", f"--affinity={cpu}", "--mlockall"),
        *(f"--priority={priority}", f"--policy={'fifo' if priority else 'other'}"),
        *(f"--interval={round(1e6 / rate_hz)}", f"--loops={round(rate_hz * seconds)}"),
        *(f"--histogram={_LARGEST_US}", f"--latency={WAKE_UP_US}"),
    ]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=True,
            timeout=seconds + _MARGIN_S,
            env=os.environ | {"LC_ALL": "C"},
        )
    except (OSError, subprocess.SubprocessError) as error:
        message = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise CyclictestError(message[-1] if message else "it failed without a message") from error
    return measured(done.stdout, rate_hz)


def measured(output: str, rate_hz: float) -> LoopMeasurement:
    """Return the measurement from the output of ``cyclictest --histogram`` with one thread.

    A wake-up one period or more late counts as missed ticks, because cyclictest also continues with
    the next deadline in the future. Delays beyond the histogram count as the largest delay.
    """
    delays_us = np.array(list(_delays(output)), dtype=np.float64)
    if not delays_us.size:
        raise CyclictestError("its output holds no histogram.")
    missed = int(np.floor(delays_us * rate_hz * 1e-6).sum())
    return LoopMeasurement(
        NAME, rate_hz, delays_us, np.empty(0), scheduled=delays_us.size + missed, missed=missed
    )


def _delays(output: str) -> Iterator[float]:
    for delay_us, count in _BIN.findall(output):
        yield from [float(delay_us)] * int(count)
    overflows, largest = _OVERFLOWS.search(output), _LARGEST.search(output)
    if overflows is not None and largest is not None:
        yield from [float(largest[1])] * int(overflows[1])
