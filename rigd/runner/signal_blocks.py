"""Signals of a running record for viewers of the daemon, with gauges of their limits."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.engine import Observer, Ring
from rigd.engine.channels import Channels
from rigd.engine.shared_state import Phase, StateField
from rigd.profile import Profile
from rigd.runner._live_view import gauge_limits
from rigd.session.layout import decode_samples
from rigd.view import Gauge, Gauges

_FIELDS: Final = ("angle_rad", "angle_reference_rad", "coupling_torque_nm")
_MOST_TICKS: Final = 2500
"""Largest number of ticks of a block: in base64 its signals fit a line of the socket."""
_GAUGES_S: Final = 0.095
"""Shortest time between gauges, which cost more than the signals and are read by people."""
_ABANDONED_S: Final = 1.0
"""Time without a reader after which the samples in between are skipped."""


@dataclass(frozen=True, slots=True)
class SignalBlock:
    """Consecutive ticks of a record."""

    first_tick: int
    """Number of the first tick."""
    t_ns: int
    """Time of the first tick since the start of the session."""
    signals: dict[str, npt.NDArray[np.float32]]
    """Angle, its reference and the coupling torque by name, (n,) each; NaN at missed ticks. Between
    records n is 0."""
    gauges: dict[str, Gauge] | None = None
    """Peaks over all ticks since the last gauges; None if the last gauges are recent."""

    @property
    def count(self) -> int:
        """Number of ticks."""
        return self.signals[_FIELDS[0]].size

    @property
    def last_tick(self) -> int:
        """Number of the last tick."""
        return self.first_tick + self.count - 1


class SignalReader:
    """Reader of the samples in the ring for viewers; it may miss samples and never delays the loop.

    Parameters
    ----------
    profile
        Rig, with the limits.
    """

    def __init__(self, profile: Profile) -> None:
        rig = profile.rig
        self._period_ns = 1e9 / rig.rate_hz
        self._rate_hz = rig.rate_hz
        time_constant_s = rig.motor.thermal_time_constant_s
        self._gauges = Gauges(rig.rate_hz, gauge_limits(profile), time_constant_s)
        self._seen: tuple[Ring, Observer] | None = None
        self._read_s = 0.0
        self._gauged_s = 0.0
        self._ungauged: list[npt.NDArray[Any]] = []
        """Samples of the record since the last gauges."""
        self._heated_s = time.monotonic()
        self._last: int | None = None
        """Tick of the last sample of the record."""

    def take(self, channels: Channels) -> list[SignalBlock]:
        """Return the blocks since the last call; the last block has gauges if they are due.

        Parameters
        ----------
        channels
            Rings and shared state of the rig's processes.
        """
        now_s = time.monotonic()
        ring, shared_state = channels.samples, channels.shared_state
        if self._seen is None or self._seen[0] is not ring or now_s > self._read_s + _ABANDONED_S:
            self._seen = ring, Observer(ring)
            self._last = None
            self._ungauged = []
            self._gauges.forget_angle()
        self._read_s = now_s
        blocks = list(self._blocks(self._seen[1], ring.written))
        if now_s - self._gauged_s < _GAUGES_S:
            return blocks
        self._gauged_s = now_s
        gauges = self._take_gauges()
        if not blocks:
            at_work = shared_state[StateField.PHASE] != Phase.PREPARING
            peaks = {
                "angle": abs(shared_state[StateField.ANGLE_NRAD]) * 1e-9 if at_work else None,
                "torque_command": abs(shared_state[StateField.TORQUE_COMMAND_NNM]) * 1e-9,
                "i2t": self._cool(0.0),
            }
            nothing = dict.fromkeys(_FIELDS, np.empty(0, dtype=np.float32))
            gauges = gauges or self._gauges.with_limits(peaks)
            return [SignalBlock(0, 0, nothing, gauges)]
        blocks[-1] = replace(blocks[-1], gauges=gauges)
        return blocks

    def _take_gauges(self) -> dict[str, Gauge] | None:
        """Return the gauges of the samples since the last ones; None if there are none."""
        if not self._ungauged:
            return None
        samples = np.concatenate(self._ungauged)
        self._ungauged = []
        self._cool(samples.size / self._rate_hz)
        return self._gauges.take(samples)

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
        before, self._last = self._last, last
        if before is None or before >= first:
            self._take_gauges()  # the rest of the previous record has heated the motor
            self._gauges.forget_angle()
        # Ticks missed between two blocks belong to the second one.
        elif first - before <= _MOST_TICKS:
            first = before + 1
        signals = {name: samples[name].astype(np.float32) for name in _FIELDS}
        if samples.size != last - first + 1:
            for name in _FIELDS:
                every = np.full(last - first + 1, np.nan, dtype=np.float32)
                every[ticks - first] = signals[name]
                signals[name] = every
        self._ungauged.append(samples)
        t_ns = int(samples["t_ns"][0]) - round((int(ticks[0]) - first) * self._period_ns)
        return SignalBlock(first, t_ns, signals)

    def _cool(self, covered_s: float) -> float:
        """Cool the thermal model for the time since the last call that samples do not cover."""
        now_s = time.monotonic()
        # Under the virtual clock a record is longer than the elapsed time.
        passed_s = max(0.0, now_s - self._heated_s - covered_s)
        self._heated_s = now_s
        return self._gauges.cool(passed_s)
