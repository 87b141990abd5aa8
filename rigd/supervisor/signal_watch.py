"""How well a record is going, from its samples as they pass: lateness, errors, peaks."""

from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine.ring import Observer, Ring
from rigd.session.format import decode_samples

_WINDOW_S: Final = 1.0
"""Of samples by which lateness and rate are told."""


@dataclass(frozen=True, slots=True)
class SignalStatus:
    """Figures of a record that is being made, or of the last one."""

    rate_hz: float
    """Ticks a second over the last second, without those that were missed."""
    lateness_p50_us: float
    """Over the last second; likewise:"""
    lateness_p99_us: float
    work_p99_us: float
    tracking_error_rad: float
    """Reference less angle, now."""
    peak_tracking_error_rad: float
    """Largest magnitude since the record began; likewise:"""
    peak_coupling_torque_nm: float
    peak_torque_command_nm: float


class SignalWatch:
    """Looks at the samples in the ring, as one who may miss some and holds nobody up.

    Parameters
    ----------
    rate_hz
        Of the rig.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._seen: tuple[Ring, Observer] | None = None
        self._recent: deque[npt.NDArray[Any]] = deque()
        self._peaks = np.zeros(3)

    def look(self, ring: Ring) -> SignalStatus | None:
        """Take what has come since the last look; None as long as nothing has."""
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
        return self._status() if self._recent else None

    def _take(self, samples: npt.NDArray[Any]) -> None:
        if samples.size == 0:
            return
        if samples["tick"][0] == 0:  # another record
            self._recent.clear()
            self._peaks[:] = 0.0
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

    def _status(self) -> SignalStatus:
        recent = np.concatenate(self._recent)
        last = recent[-1]
        span = int(last["tick"]) - int(recent["tick"][0]) + 1
        late_us = 1e-3 * np.percentile(recent["lateness_ns"], (50, 99))
        return SignalStatus(
            rate_hz=self._rate_hz * recent.size / span,
            lateness_p50_us=float(late_us[0]),
            lateness_p99_us=float(late_us[1]),
            work_p99_us=float(1e-3 * np.percentile(recent["work_ns"], 99)),
            tracking_error_rad=float(last["angle_reference_rad"] - last["angle_rad"]),
            peak_tracking_error_rad=float(self._peaks[0]),
            peak_coupling_torque_nm=float(self._peaks[1]),
            peak_torque_command_nm=float(self._peaks[2]),
        )
