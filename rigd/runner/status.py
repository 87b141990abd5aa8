"""Status of a rig and statistics of the session in progress, read from shared memory."""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine import Ring, RingObserver
from rigd.engine.channels import TOPICS
from rigd.engine.processes import Heartbeat
from rigd.engine.shared_state import Activity, Phase, StateField, activity
from rigd.engine.workers import PROCESSES, SUPERVISOR
from rigd.live.address import LiveAddress
from rigd.runner._process_group import ProcessGroup
from rigd.session.layout import decode_samples

_STATISTICS_WINDOW_S: Final = 1.0
"""Time span in seconds of the latest samples from which latency and rate are computed."""


@dataclass(frozen=True, slots=True)
class SignalStatus:
    """Statistics of the running record, or of the last record while none is running."""

    rate_hz: float
    """Number of recorded ticks per second in the last second, without missed ticks."""
    lateness_p50_us: float
    """Median wake-up latency of the control loop in the last second."""
    lateness_p99_us: float
    """99th percentile of the control loop's wake-up latency in the last second."""
    work_p99_us: float
    """99th percentile of the execution time of a tick in the last second."""
    tracking_error_rad: float
    """Present tracking error: reference minus angle."""
    peak_tracking_error_rad: float
    """Largest magnitude of the tracking error in the record so far."""
    peak_coupling_torque_nm: float
    """Largest magnitude of the coupling torque in the record so far."""
    peak_torque_command_nm: float
    """Largest magnitude of the torque command in the record so far."""


class SignalStatisticsReader:
    """Reader of the samples in shared memory, which computes statistics of the record.

    It may miss samples, and never delays the control loop.

    Parameters
    ----------
    rate_hz
        Sample rate of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._ring_and_observer: tuple[Ring, RingObserver] | None = None
        self._recent_samples: deque[npt.NDArray[Any]] = deque()
        self._peaks = np.zeros(3)

    def poll(self, ring: Ring) -> Callable[[], SignalStatus] | None:
        """Read the samples since the last call, and return a function that computes statistics.

        Returns None before the first sample. The caller computes the statistics only when it needs
        them, which is less often than it polls.
        """
        if self._ring_and_observer is None or self._ring_and_observer[0] is not ring:
            window_position = max(
                0, ring.written_count - round(_STATISTICS_WINDOW_S * self._rate_hz)
            )
            self._ring_and_observer = ring, RingObserver(ring, window_position)
        while ring_bytes := self._ring_and_observer[1].take(ring.capacity // 4):
            try:
                sample_array = decode_samples(ring_bytes)
            except ValueError:
                continue  # overwritten while it was copied
            for sample_run in np.split(sample_array, np.flatnonzero(sample_array["tick"] == 0)):
                self._include_samples(sample_run)
        if not self._recent_samples:
            return None
        return partial(_signal_statistics, self._rate_hz, tuple(self._recent_samples), self._peaks)

    def _include_samples(self, samples: npt.NDArray[Any]) -> None:
        """Update peaks and latest samples with new samples; reset both at tick 0 of a record."""
        if samples.size == 0:
            return
        if samples["tick"][0] == 0:  # another record
            self._recent_samples.clear()
            self._peaks = np.zeros(3)
        signals = (
            samples["angle_reference_rad"] - samples["angle_rad"],
            samples["coupling_torque_nm"],
            samples["torque_command_nm"],
        )
        self._peaks = np.maximum(self._peaks, [np.abs(signal).max() for signal in signals])
        self._recent_samples.append(samples)
        window_begin_ns = int(samples["t_ns"][-1]) - round(_STATISTICS_WINDOW_S * 1e9)
        while self._recent_samples[0]["t_ns"][-1] < window_begin_ns:
            self._recent_samples.popleft()


def _signal_statistics(
    rate_hz: float, sample_blocks: tuple[npt.NDArray[Any], ...], peaks: npt.NDArray[np.float64]
) -> SignalStatus:
    """Return the statistics of the samples of the last second, with the peaks of the record."""
    window_samples = np.concatenate(sample_blocks)
    last_sample = window_samples[-1]
    tick_span = int(last_sample["tick"]) - int(window_samples["tick"][0]) + 1
    latency_percentiles_us = 1e-3 * np.percentile(window_samples["lateness_ns"], (50, 99))
    return SignalStatus(
        rate_hz=rate_hz * window_samples.size / tick_span,
        lateness_p50_us=float(latency_percentiles_us[0]),
        lateness_p99_us=float(latency_percentiles_us[1]),
        work_p99_us=float(1e-3 * np.percentile(window_samples["work_ns"], 99)),
        tracking_error_rad=float(last_sample["angle_reference_rad"] - last_sample["angle_rad"]),
        peak_tracking_error_rad=float(peaks[0]),
        peak_coupling_torque_nm=float(peaks[1]),
        peak_torque_command_nm=float(peaks[2]),
    )


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """Status of one process of the rig."""

    name: str
    """Name of the process, such as ``control`` or ``recorder``."""
    pid: int
    """Process id."""
    state: str
    """State of the process: ``running``, ``waiting`` (for a session), ``hung`` or ``ended``."""
    still_s: float
    """Time in seconds since the last heartbeat of the process, as observed so far."""


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """Status of one topic, through which the control process passes messages to the recorder."""

    name: str
    """Name of the topic, such as ``/rig/sample``."""
    written: int
    """Number of messages written since the shared memory was allocated."""
    rate_hz: float | None
    """Number of messages per second since the previous status; None for the first status."""
    expected_hz: float | None
    """Expected number of messages per second during a record, or None if irregular."""
    waiting: int
    """Number of messages that the recorder has not read yet."""


@dataclass(frozen=True, slots=True)
class RigStatus:
    """Present status of a connected rig and of its session."""

    phase: Phase
    """Phase of the session."""
    activity: Activity
    """What the rig is doing, in terms for the operator."""
    angle_rad: float
    """Motor angle relative to the rig's zero."""
    coupling_torque_nm: float
    """Measured coupling torque after the tare."""
    torque_command_nm: float
    """Last torque command to the drive."""
    tick: int
    """Number of ticks of the record that were due so far."""
    missed: int
    """Number of ticks that the control loop missed so far."""
    late: int
    """Number of ticks so far for which the control loop woke up late."""
    lost: int
    """Number of samples so far that could not be recorded."""
    bus_load_percent: float | None
    """Load of the busiest bus line in percent, or None without a bus."""
    bus_errors: int | None
    """Number of errors on all bus lines, or None if unknown."""
    sensor_status: int | None
    """Status word of the force-torque sensor, or None if unknown."""
    disk_free_mb: int | None
    """Free space in MB on the disk of the session file, or None if it is not known yet."""
    view_dropped: int
    """Number of samples that the live view did not receive."""
    signals: Callable[[], SignalStatus] | None
    """Function that computes statistics of the record, or None before the first sample."""
    processes: tuple[ProcessStatus, ...]
    """Status of each process of the rig."""
    topics: tuple[TopicStatus, ...]
    """Status of each topic, through which the recorder gets its messages."""
    live_view: LiveAddress | None = None
    """Address of the live view, or None if there is none."""


class StatusReader:
    """Reader of a rig's status, which computes message rates from one call to the next.

    Parameters
    ----------
    rate_hz
        Sample rate of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._heartbeats = {process: Heartbeat() for process in PROCESSES}
        self._last_time_and_counts: tuple[float, tuple[int, ...]] | None = None
        self._signals = SignalStatisticsReader(rate_hz)

    def read(self, group: ProcessGroup) -> RigStatus:
        """Return the present status of the rig that these processes operate."""
        shared_state = group.channels.shared_state
        bus_load_ppm = shared_state.known_value(StateField.BUS_LOAD_PPM)
        return RigStatus(
            phase=Phase(shared_state[StateField.PHASE]),
            activity=activity(shared_state),
            angle_rad=shared_state[StateField.ANGLE_NRAD] * 1e-9,
            coupling_torque_nm=shared_state[StateField.COUPLING_TORQUE_NNM] * 1e-9,
            torque_command_nm=shared_state[StateField.TORQUE_COMMAND_NNM] * 1e-9,
            tick=shared_state[StateField.SCHEDULED_TICKS],
            missed=shared_state[StateField.MISSED_TICKS],
            late=shared_state[StateField.LATE_TICKS],
            lost=shared_state[StateField.LOST_SAMPLES],
            bus_load_percent=None if bus_load_ppm is None else bus_load_ppm * 1e-4,
            bus_errors=shared_state.known_value(StateField.BUS_ERRORS),
            sensor_status=shared_state.known_value(StateField.SENSOR_STATUS),
            disk_free_mb=shared_state[StateField.DISK_FREE_MB] or None,
            view_dropped=shared_state[StateField.LIVE_SAMPLES_DROPPED],
            signals=self._signals.poll(group.channels.samples),
            processes=tuple(self._process_statuses(group)),
            topics=tuple(self._topic_statuses(group)),
        )

    def _topic_statuses(self, group: ProcessGroup) -> Iterator[TopicStatus]:
        """Yield the status of each topic, with its message rate since the last call."""
        topic_rings, now_s = group.channels.rings, time.monotonic()
        written_counts = tuple(topic_ring.written_count for topic_ring in topic_rings)
        previous_s, previous_counts = self._last_time_and_counts or (now_s, written_counts)
        self._last_time_and_counts = now_s, written_counts
        elapsed_s = now_s - previous_s
        for topic, topic_ring, written_count, previous_count in zip(
            TOPICS, topic_rings, written_counts, previous_counts, strict=True
        ):
            # New processes have new rings, whose counts start at 0.
            rate_hz = (
                (written_count - previous_count) / elapsed_s
                if elapsed_s > 0.0 and written_count >= previous_count
                else None
            )
            expected_hz = topic.expected_hz(self._rate_hz)
            yield TopicStatus(
                topic.name, written_count, rate_hz, expected_hz, topic_ring.waiting_count
            )

    def _process_statuses(self, group: ProcessGroup) -> Iterator[ProcessStatus]:
        """Yield the status of each started process, with the time since its last heartbeat."""
        shared_state, now_s = group.channels.shared_state, time.monotonic()
        for process in PROCESSES:
            assert process.beat is not None
            silence_s = self._heartbeats[process].stalled_for(shared_state[process.beat], now_s)
            if process is SUPERVISOR:
                yield ProcessStatus(process.name, os.getpid(), "running", silence_s)
                continue
            if process not in group:
                continue
            child_process = group[process]
            if not child_process.running:
                process_state = "ended"
            elif not group.has_job(process):
                process_state = "waiting"
            elif process.max_silence_s is not None and silence_s > process.max_silence_s:
                process_state = "hung"
            else:
                process_state = "running"
            yield ProcessStatus(process.name, child_process.pid, process_state, silence_s)
