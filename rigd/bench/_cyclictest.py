"""Peer of the loop: cyclictest of rt-tests, the least latency of a program on this computer."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator

import numpy as np

from rigd.bench.measure import Measurement
from rigd.engine.realtime import WAKE_UP_US
from rigd.errors import FailureError

NAME = "cyclictest"
_LARGEST_US = 50_000
_MARGIN_S = 20.0
_BIN = re.compile(r"^(\d+)\s+(\d+)\s*$", re.MULTILINE)
_OVERFLOWS = re.compile(r"^# Histogram Overflows:\s*(\d+)", re.MULTILINE)
_LARGEST = re.compile(r"^# Max Latencies:\s*(\d+)", re.MULTILINE)


class CyclictestError(FailureError):
    """It could not be run, or tells something else than expected; the message says why."""


def installed() -> bool:
    """Whether cyclictest is installed."""
    return shutil.which(NAME) is not None


def run(rate_hz: float, seconds: float, *, cpu: int, priority: int) -> Measurement:
    """Run it as the loop runs: the same core, policy, priority and interval.

    Parameters
    ----------
    rate_hz
        Wake-ups a second.
    seconds
        Duration of the measurement.
    cpu
        The core.
    priority
        Priority under SCHED_FIFO; 0 for the ordinary policy.

    Raises
    ------
    CyclictestError
        If that fails.
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


def measured(output: str, rate_hz: float) -> Measurement:
    """Return the measurement in its histogram.

    A wake-up that comes a period late or later stands for as many ticks that a loop would have
    missed: cyclictest, too, goes on with the next deadline that is still ahead.

    Parameters
    ----------
    output
        Printed by ``cyclictest --histogram`` with one thread: lines of a delay in whole µs and
        how often it came; what is beyond the histogram is counted as the largest delay of all.
    rate_hz
        Wake-ups a second.

    Raises
    ------
    CyclictestError
        If there is no histogram in it.
    """
    delays_us = np.array(list(_delays(output)), dtype=np.float64)
    if not delays_us.size:
        raise CyclictestError("its output holds no histogram.")
    missed = int(np.floor(delays_us * rate_hz * 1e-6).sum())
    return Measurement(
        NAME, rate_hz, delays_us, np.empty(0), scheduled=delays_us.size + missed, missed=missed
    )


def _delays(output: str) -> Iterator[float]:
    for delay_us, count in _BIN.findall(output):
        yield from [float(delay_us)] * int(count)
    overflows, largest = _OVERFLOWS.search(output), _LARGEST.search(output)
    if overflows is not None and largest is not None:
        yield from [float(largest[1])] * int(overflows[1])
