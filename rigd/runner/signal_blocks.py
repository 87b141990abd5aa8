"""Signals of a running record for viewers of the daemon, with gauges of their peaks and limits."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine import Ring, RingObserver
from rigd.engine.channels import Channels
from rigd.engine.shared_state import Phase, StateField
from rigd.gauges import Gauge, Gauges
from rigd.profile import Profile
from rigd.runner._live_view import gauge_limits
from rigd.session.layout import decode_samples

_SIGNAL_FIELDS: Final = ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
_MAX_BLOCK_TICKS: Final = 2500
"""Maximum number of ticks in a block, so that its signals in base64 fit a line of the socket."""
_MIN_GAUGES_INTERVAL_S: Final = 0.095
"""Minimum time in seconds between two updates of the gauges, which are slow to compute."""
_ABANDONED_AFTER_S: Final = 1.0
"""Time in seconds between two calls of `take` above which the samples in between are skipped."""


@dataclass(frozen=True, slots=True)
class SignalBlock:
    """Signals of consecutive ticks of a record, for viewers."""

    first_tick: int
    """Number of the first tick in the block."""
    t_ns: int
    """Time of the first tick, in nanoseconds since the session start."""
    signals: dict[str, npt.NDArray[np.float32]]
    """Angle, reference angle and coupling torque by field name, arrays (n,) with NaN at missed
    ticks. They are empty while no record is running."""
    gauges: dict[str, Gauge] | None = None
    """Peaks since the previous gauges, relative to their limits; None if these are too recent."""

    @property
    def tick_count(self) -> int:
        """Number of ticks in the block."""
        return self.signals[_SIGNAL_FIELDS[0]].size

    @property
    def last_tick(self) -> int:
        """Number of the last tick in the block."""
        return self.first_tick + self.tick_count - 1


class SignalBlockReader:
    """Reader of the samples in shared memory, for viewers.

    It may miss samples, and never delays the control loop.

    Parameters
    ----------
    profile
        Profile of the rig, with its limits.
    """

    def __init__(self, profile: Profile) -> None:
        rig = profile.rig
        self._period_ns = 1e9 / rig.rate_hz
        self._rate_hz = rig.rate_hz
        time_constant_s = rig.motor.thermal_time_constant_s
        self._gauges = Gauges(rig.rate_hz, gauge_limits(profile), time_constant_s)
        self._ring_and_observer: tuple[Ring, RingObserver] | None = None
        self._last_call_s = 0.0
        self._last_gauges_s = 0.0
        self._samples_since_gauges: list[npt.NDArray[Any]] = []
        """Samples of the record since the last update of the gauges."""
        self._last_cooling_s = time.monotonic()
        self._last_tick: int | None = None
        """Tick of the last sample that was read, or None before the first one."""

    def take(self, channels: Channels) -> list[SignalBlock]:
        """Return the signals since the last call, in blocks of consecutive ticks.

        The last block has gauges if the previous gauges are old enough.

        Parameters
        ----------
        channels
            Ring buffers and shared state of the rig's processes.
        """
        now_s = time.monotonic()
        sample_ring, shared_state = channels.samples, channels.shared_state
        if (
            self._ring_and_observer is None
            or self._ring_and_observer[0] is not sample_ring
            or now_s > self._last_call_s + _ABANDONED_AFTER_S
        ):
            self._ring_and_observer = sample_ring, RingObserver(sample_ring)
            self._last_tick = None
            self._samples_since_gauges = []
            self._gauges.forget_angle()
        self._last_call_s = now_s
        signal_blocks = list(
            self._read_blocks(self._ring_and_observer[1], sample_ring.written_count)
        )
        if now_s - self._last_gauges_s < _MIN_GAUGES_INTERVAL_S:
            return signal_blocks
        self._last_gauges_s = now_s
        latest_gauges = self._updated_gauges()
        if not signal_blocks:
            is_session_active = shared_state[StateField.PHASE] != Phase.PREPARING
            present_magnitudes = {
                "angle": abs(shared_state[StateField.ANGLE_NRAD]) * 1e-9
                if is_session_active
                else None,
                "torque_command": abs(shared_state[StateField.TORQUE_COMMAND_NNM]) * 1e-9,
                "i2t": self._cooled_torque_nm(0.0),
            }
            empty_signals = dict.fromkeys(_SIGNAL_FIELDS, np.empty(0, dtype=np.float32))
            latest_gauges = latest_gauges or self._gauges.with_limits(present_magnitudes)
            return [SignalBlock(0, 0, empty_signals, latest_gauges)]
        signal_blocks[-1] = replace(signal_blocks[-1], gauges=latest_gauges)
        return signal_blocks

    def _updated_gauges(self) -> dict[str, Gauge] | None:
        """Return the gauges for the samples since the last update, or None if there are none."""
        if not self._samples_since_gauges:
            return None
        sample_array = np.concatenate(self._samples_since_gauges)
        self._samples_since_gauges = []
        self._cooled_torque_nm(sample_array.size / self._rate_hz)
        return self._gauges.gauges_of_block(sample_array)

    def _read_blocks(self, observer: RingObserver, end_index: int) -> Iterator[SignalBlock]:
        """Yield the unread samples before position `end_index` of the ring buffer in blocks."""
        while observer.next_index < end_index:
            ring_bytes = observer.take(min(_MAX_BLOCK_TICKS, end_index - observer.next_index))
            try:
                sample_array = decode_samples(ring_bytes)
            except ValueError:
                continue  # overwritten while it was copied
            for sample_run in np.split(sample_array, np.flatnonzero(sample_array["tick"] == 0)):
                if sample_run.size:
                    yield self._signal_block(sample_run)

    def _signal_block(self, sample_array: npt.NDArray[Any]) -> SignalBlock:
        """Return samples as a block of signals, with NaN at missed ticks before or between them."""
        ticks = sample_array["tick"].astype(np.int64)
        first_tick, newest_tick = int(ticks[0]), int(ticks[-1])
        previous_tick, self._last_tick = self._last_tick, newest_tick
        if previous_tick is None or previous_tick >= first_tick:
            self._updated_gauges()  # includes the end of the previous record in the thermal model
            self._gauges.forget_angle()
        # Ticks missed between two blocks belong to the second block.
        elif first_tick - previous_tick <= _MAX_BLOCK_TICKS:
            first_tick = previous_tick + 1
        signals = {
            signal_name: sample_array[signal_name].astype(np.float32)
            for signal_name in _SIGNAL_FIELDS
        }
        if sample_array.size != newest_tick - first_tick + 1:
            for signal_name in _SIGNAL_FIELDS:
                values_with_gaps = np.full(newest_tick - first_tick + 1, np.nan, dtype=np.float32)
                values_with_gaps[ticks - first_tick] = signals[signal_name]
                signals[signal_name] = values_with_gaps
        self._samples_since_gauges.append(sample_array)
        t_ns = int(sample_array["t_ns"][0]) - round((int(ticks[0]) - first_tick) * self._period_ns)
        return SignalBlock(first_tick, t_ns, signals)

    def _cooled_torque_nm(self, sampled_duration_s: float) -> float:
        """Return the motor's rms torque (i²t) after it has cooled while there were no samples.

        `sampled_duration_s` is the part of the time since the last call for which there are
        samples.
        """
        now_s = time.monotonic()
        # Under the virtual clock a record is longer than the elapsed time.
        unsampled_duration_s = max(0.0, now_s - self._last_cooling_s - sampled_duration_s)
        self._last_cooling_s = now_s
        return self._gauges.cool_down(unsampled_duration_s)
