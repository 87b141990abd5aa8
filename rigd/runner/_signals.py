"""Signals of a running record for viewers of the daemon, and how near they are to their limits."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from math import exp, isfinite, sqrt
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine import Channels, Observer, Phase, Ring, Word
from rigd.profile import Profile
from rigd.session import decode_samples

_FIELDS: Final = ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
_WRENCH: Final = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
_MOST_TICKS: Final = 2500
"""Most ticks of a block: in base64 its signals take less than a line of the socket."""
_ABANDONED_S: Final = 1.0
"""Nobody has looked for so long: what came meanwhile is left out."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """A signal beside its limit."""

    value: float | None
    """Largest magnitude; None where it is not known at the moment."""
    limit: float
    """Magnitude at which the session ends, or the torque is clipped."""
    unit: str
    """Unit of both."""

    @property
    def fraction(self) -> float | None:
        """Value as a fraction of the limit."""
        return None if self.value is None else self.value / self.limit


@dataclass(frozen=True, slots=True)
class SignalBlock:
    """Ticks of a record, one after the other."""

    first_tick: int
    """Number of the first one."""
    t_ns: int
    """Its time since the start of the session."""
    signals: dict[str, npt.NDArray[np.float32]]
    """Angle, its reference and the coupling torque by name, (n,) each; missed ticks are NaN. No
    tick at all between records."""
    gauges: dict[str, Gauge]
    """Peaks over these ticks."""

    @property
    def count(self) -> int:
        """Number of ticks."""
        return self.signals[_FIELDS[0]].size

    @property
    def last_tick(self) -> int:
        """Number of the last one."""
        return self.first_tick + self.count - 1


class SignalReader:
    """Reads the samples in the ring as viewers want them; it may miss some and delays nobody.

    Parameters
    ----------
    profile
        Rig, with the limits.
    """

    def __init__(self, profile: Profile) -> None:
        rig, limits = profile.rig, profile.limits
        self._period_ns = 1e9 / rig.rate_hz
        self._rate_hz = rig.rate_hz
        self._time_constant_s = rig.motor.thermal_time_constant_s
        used = limits.sensor_range_percent / 100.0
        self._limits = {
            "angle": (limits.angle_rad, "rad"),
            "velocity": (limits.velocity_rad_s, "rad/s"),
            "tracking_error": (limits.tracking_error_rad, "rad"),
            "torque_command": (rig.motor.peak_torque_nm, "N·m"),
            "i2t": (rig.motor.continuous_torque_nm, "N·m"),
        } | {
            name.partition("_")[0]: (used * full, "N" if name.endswith("_n") else "N·m")
            for name, full in zip(_WRENCH, rig.sensor.range, strict=True)
        }
        self._seen: tuple[Ring, Observer] | None = None
        self._looked_s = 0.0
        self._heat_nm2 = 0.0
        self._heated_s = time.monotonic()
        self._last: tuple[int, float] | None = None
        """Tick and angle of the last sample of the record."""

    def take(self, channels: Channels) -> list[SignalBlock]:
        """Return what has come since the last look, at least the gauges as they are now.

        Parameters
        ----------
        channels
            The rings and words of the rig's processes.
        """
        now_s = time.monotonic()
        ring, board = channels.samples, channels.board
        if self._seen is None or self._seen[0] is not ring or now_s > self._looked_s + _ABANDONED_S:
            self._seen = ring, Observer(ring)
            self._last = None
        self._looked_s = now_s
        blocks = list(self._blocks(self._seen[1], ring.written))
        if not blocks:
            at_work = board[Word.PHASE] is not Phase.PREPARING
            peaks = {
                "angle": abs(board[Word.ANGLE_NRAD]) * 1e-9 if at_work else None,
                "torque_command": abs(board[Word.TORQUE_COMMAND_NNM]) * 1e-9,
                "i2t": self._warm(0.0, 0.0),
            }
            nothing = dict.fromkeys(_FIELDS, np.empty(0, dtype=np.float32))
            blocks.append(SignalBlock(0, 0, nothing, self._gauges(peaks)))
        return blocks

    def _blocks(self, observer: Observer, end: int) -> Iterator[SignalBlock]:
        while observer.next < end:
            block = observer.take(min(_MOST_TICKS, end - observer.next))
            try:
                samples = decode_samples(block)
            except ValueError:
                continue  # overwritten while it was copied
            for part in np.split(samples, np.flatnonzero(samples["tick"] == 0)):
                if part.size:
                    yield self._block(part)

    def _block(self, samples: npt.NDArray[Any]) -> SignalBlock:
        ticks = samples["tick"].astype(np.int64)
        first, last = int(ticks[0]), int(ticks[-1])
        angle_rad = samples["angle_rad"]
        before, self._last = self._last, (last, float(angle_rad[-1]))
        known_ticks, known_rad = ticks, angle_rad
        if before is not None and before[0] < first:
            known_ticks = np.concatenate(([before[0]], ticks))
            known_rad = np.concatenate(([before[1]], angle_rad))
            # Ticks missed between two blocks belong to the second one.
            if first - before[0] <= _MOST_TICKS:
                first = before[0] + 1
        signals = {}
        for name in _FIELDS:
            signals[name] = np.full(last - first + 1, np.nan, dtype=np.float32)
            signals[name][ticks - first] = samples[name]
        moved_rad_s = np.diff(known_rad) / np.diff(known_ticks) * self._rate_hz
        torque_nm = samples["torque_command_nm"]
        squares_nm2 = float(np.dot(torque_nm, torque_nm))
        peaks = {
            "angle": _peak(angle_rad),
            "velocity": _peak(moved_rad_s),
            "tracking_error": _peak(samples["angle_reference_rad"] - angle_rad),
            "torque_command": _peak(torque_nm),
            "i2t": self._warm(squares_nm2, samples.size / self._rate_hz),
        } | {name.partition("_")[0]: _peak(samples[name]) for name in _WRENCH}
        t_ns = int(samples["t_ns"][0]) - round((int(ticks[0]) - first) * self._period_ns)
        return SignalBlock(first, t_ns, signals, self._gauges(peaks))

    def _warm(self, squares_nm2: float, over_s: float) -> float:
        """Return the rms torque as the motor's heat has it: see `rigd.safety.LimitWatch`."""
        now_s = time.monotonic()
        # Not in real time, a record has more time in it than has passed.
        passed_s = max(over_s, now_s - self._heated_s)
        self._heated_s = now_s
        self._heat_nm2 *= exp(-passed_s / self._time_constant_s)
        self._heat_nm2 += squares_nm2 / (self._rate_hz * self._time_constant_s)
        return sqrt(self._heat_nm2)

    def _gauges(self, peaks: dict[str, float | None]) -> dict[str, Gauge]:
        return {
            name: Gauge(peaks.get(name), limit, unit)
            for name, (limit, unit) in self._limits.items()
        }


def _peak(values: npt.NDArray[np.float64]) -> float | None:
    """Return the largest magnitude; None without any that is a number."""
    if values.size == 0:
        return None
    peak = float(np.fmax.reduce(np.abs(values)))
    return peak if isfinite(peak) else None
