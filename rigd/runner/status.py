"""Status of a rig and of a growing record, read from shared memory."""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine import Observer, Ring
from rigd.engine.channels import TOPICS
from rigd.engine.processes import PROCESSES, SUPERVISOR, Heartbeat
from rigd.engine.shared_state import Activity, Phase, StateField, activity
from rigd.live.address import LiveAddress
from rigd.runner._process_group import ProcessGroup
from rigd.session.layout import decode_samples

_WINDOW_S: Final = 1.0
"""Window of samples from which lateness and rate are computed."""


@dataclass(frozen=True, slots=True)
class SignalStatus:
    """Statistics of the running record, or of the last one."""

    rate_hz: float
    """Ticks per second over the last second, without missed ticks."""
    lateness_p50_us: float
    """Wake-up latency over the last second: median."""
    lateness_p99_us: float
    """Wake-up latency over the last second: 99th percentile."""
    work_p99_us: float
    """Execution time of a tick over the last second: 99th percentile."""
    tracking_error_rad: float
    """Present reference less angle."""
    peak_tracking_error_rad: float
    """Largest magnitude since the record began."""
    peak_coupling_torque_nm: float
    """Largest magnitude since the record began."""
    peak_torque_command_nm: float
    """Largest magnitude since the record began."""


class SignalWatch:
    """Observer of the samples in the ring; it may miss samples and never delays the loop.

    Parameters
    ----------
    rate_hz
        Rate of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._seen: tuple[Ring, Observer] | None = None
        self._recent: deque[npt.NDArray[Any]] = deque()
        self._peaks = np.zeros(3)

    def poll(self, ring: Ring) -> Callable[[], SignalStatus] | None:
        """Read the samples since the last call; return a function for the statistics, or None.

        The statistics are computed on request, which is less frequent than the calls.
        """
        if self._seen is None or self._seen[0] is not ring:
            recent = max(0, ring.written - round(_WINDOW_S * self._rate_hz))
            self._seen = ring, Observer(ring, recent)
        while block := self._seen[1].take(ring.capacity // 4):
            try:
                samples = decode_samples(block)
            except ValueError:
                continue  # overwritten while it was copied
            for part in np.split(samples, np.flatnonzero(samples["tick"] == 0)):
                self._take(part)
        if not self._recent:
            return None
        return partial(_figures, self._rate_hz, tuple(self._recent), self._peaks)

    def _take(self, samples: npt.NDArray[Any]) -> None:
        if samples.size == 0:
            return
        if samples["tick"][0] == 0:  # another record
            self._recent.clear()
            self._peaks = np.zeros(3)
        signals = (
            samples["angle_reference_rad"] - samples["angle_rad"],
            samples["coupling_torque_nm"],
            samples["torque_command_nm"],
        )
        self._peaks = np.maximum(self._peaks, [np.abs(signal).max() for signal in signals])
        self._recent.append(samples)
        oldest_ns = int(samples["t_ns"][-1]) - round(_WINDOW_S * 1e9)
        while self._recent[0]["t_ns"][-1] < oldest_ns:
            self._recent.popleft()


def _figures(
    rate_hz: float, parts: tuple[npt.NDArray[Any], ...], peaks: npt.NDArray[np.float64]
) -> SignalStatus:
    recent = np.concatenate(parts)
    last = recent[-1]
    span = int(last["tick"]) - int(recent["tick"][0]) + 1
    late_us = 1e-3 * np.percentile(recent["lateness_ns"], (50, 99))
    return SignalStatus(
        rate_hz=rate_hz * recent.size / span,
        lateness_p50_us=float(late_us[0]),
        lateness_p99_us=float(late_us[1]),
        work_p99_us=float(1e-3 * np.percentile(recent["work_ns"], 99)),
        tracking_error_rad=float(last["angle_reference_rad"] - last["angle_rad"]),
        peak_tracking_error_rad=float(peaks[0]),
        peak_coupling_torque_nm=float(peaks[1]),
        peak_torque_command_nm=float(peaks[2]),
    )


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """Status of one process of the table."""

    name: str
    """Name in the table of processes."""
    pid: int
    """Process id."""
    state: str
    """``running``, ``waiting`` (for a session), ``hung`` or ``ended``."""
    still_s: float
    """Time without a heartbeat, as observed by the last calls."""


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """Status of one topic of the table."""

    name: str
    """Name in the table of topics."""
    written: int
    """Records written since the memory was laid out."""
    rate_hz: float | None
    """Rate since the last call; None at the first call."""
    expected_hz: float | None
    """Rate expected during a record; None if none is expected."""
    waiting: int
    """Records that the recorder has not yet read."""


@dataclass(frozen=True, slots=True)
class RigStatus:
    """Status of the rig, as read from shared memory."""

    phase: Phase
    """Phase of the session."""
    activity: Activity
    """State of the session for its operator."""
    angle_rad: float
    """Angle from the rig's zero."""
    coupling_torque_nm: float
    """Measured torque after the tare."""
    torque_command_nm: float
    """Last torque command."""
    tick: int
    """Number of the last tick."""
    missed: int
    """Ticks missed so far."""
    late: int
    """Ticks that woke late so far."""
    lost: int
    """Samples lost so far."""
    bus_load_percent: float | None
    """Load of the busiest bus line; None without a bus."""
    bus_errors: int | None
    """Errors on all bus lines; None: not known."""
    sensor_status: int | None
    """Status word of the sensor; None: not known."""
    disk_free_mb: int | None
    """Free space on the disk of the session file; None before it is known."""
    view_dropped: int
    """Samples that the live view did not receive."""
    signals: Callable[[], SignalStatus] | None
    """Returns the statistics of the record; None before its first sample."""
    processes: tuple[ProcessStatus, ...]
    """Processes of the rig."""
    topics: tuple[TopicStatus, ...]
    """Traffic to the recorder."""
    live_view: LiveAddress | None = None
    """Address of the live view; None: there is none."""


class StatusWatch:
    """Observer of a rig; it derives rates from consecutive calls.

    Parameters
    ----------
    rate_hz
        Rate of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._pulses = {process: Heartbeat() for process in PROCESSES}
        self._written: tuple[float, tuple[int, ...]] | None = None
        self._signals = SignalWatch(rate_hz)

    def read(self, group: ProcessGroup) -> RigStatus:
        """Return the present status."""
        shared_state = group.channels.shared_state
        load_ppm = shared_state.known(StateField.BUS_LOAD_PPM)
        return RigStatus(
            phase=Phase(shared_state[StateField.PHASE]),
            activity=activity(shared_state),
            angle_rad=shared_state[StateField.ANGLE_NRAD] * 1e-9,
            coupling_torque_nm=shared_state[StateField.COUPLING_TORQUE_NNM] * 1e-9,
            torque_command_nm=shared_state[StateField.TORQUE_COMMAND_NNM] * 1e-9,
            tick=shared_state[StateField.SCHEDULED],
            missed=shared_state[StateField.MISSED],
            late=shared_state[StateField.LATE],
            lost=shared_state[StateField.LOST],
            bus_load_percent=None if load_ppm is None else load_ppm * 1e-4,
            bus_errors=shared_state.known(StateField.BUS_ERRORS),
            sensor_status=shared_state.known(StateField.SENSOR_STATUS),
            disk_free_mb=shared_state[StateField.DISK_FREE_MB] or None,
            view_dropped=shared_state[StateField.LIVE_DROPPED],
            signals=self._signals.poll(group.channels.samples),
            processes=tuple(self._processes(group)),
            topics=tuple(self._topics(group)),
        )

    def _topics(self, group: ProcessGroup) -> Iterator[TopicStatus]:
        rings, now_s = group.channels.rings, time.monotonic()
        written = tuple(ring.written for ring in rings)
        before_s, before = self._written or (now_s, written)
        self._written = now_s, written
        passed_s = now_s - before_s
        for topic, ring, now, first in zip(TOPICS, rings, written, before, strict=True):
            # New processes have new rings, whose counts start at 0.
            rate_hz = (now - first) / passed_s if passed_s > 0.0 and now >= first else None
            expected_hz = topic.expected_hz(self._rate_hz)
            yield TopicStatus(topic.name, now, rate_hz, expected_hz, ring.waiting)

    def _processes(self, group: ProcessGroup) -> Iterator[ProcessStatus]:
        shared_state, now_s = group.channels.shared_state, time.monotonic()
        for process in PROCESSES:
            still_s = self._pulses[process].stalled_for(shared_state[process.beat], now_s)
            if process is SUPERVISOR:
                yield ProcessStatus(process.name, os.getpid(), "running", still_s)
                continue
            if process not in group:
                continue
            child = group[process]
            if not child.running:
                state = "ended"
            elif not group.has_job(process):
                state = "waiting"
            elif process.hung_after_s is not None and still_s > process.hung_after_s:
                state = "hung"
            else:
                state = "running"
            yield ProcessStatus(process.name, child.pid, state, still_s)
