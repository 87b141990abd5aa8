"""Gauges: signals of a session as fractions of their limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, isfinite, sqrt
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.session.layout import WRENCH_FIELDS, Status

Records = npt.NDArray[Any]

NEAR: Final = 0.8
"""Fraction of a limit above which a gauge is near it, as for the interlocks' warnings."""


UNITS: Final = {
    "angle": "rad",
    "velocity": "rad/s",
    "tracking_error": "rad",
    "torque_command": "N·m",
    "i2t": "N·m",
} | {field.partition("_")[0]: "N" if field.endswith("_n") else "N·m" for field in WRENCH_FIELDS}
"""Units of the gauges, by name."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """A signal with its limit.

    Attributes
    ----------
    value
        Largest magnitude; None if unknown.
    limit
        Magnitude at which the session ends or the torque is clipped; None without a limit.
    unit
        Unit of both.
    """

    value: float | None
    limit: float | None
    unit: str

    @property
    def fraction(self) -> float | None:
        """Value as a fraction of the limit; None if either is unknown."""
        return None if self.value is None or self.limit is None else self.value / self.limit


class Gauges:
    """Peaks of the samples with their limits, block by block.

    The rms torque (i²t) assumes a cold motor at the first sample.

    Parameters
    ----------
    rate_hz
        Scheduled ticks per second.
    limits
        Limits by the names of ``UNITS``; an absent or infinite one is no limit.
    thermal_time_constant_s
        Time constant of the rms torque.
    """

    def __init__(
        self, rate_hz: float, limits: Mapping[str, float], thermal_time_constant_s: float = 10.0
    ) -> None:
        self._rate_hz = rate_hz
        self._limits = {name: limit for name, limit in limits.items() if isfinite(limit)}
        self._time_constant_s = thermal_time_constant_s
        self._heat_nm2 = 0.0
        self._last: tuple[int, float] | None = None  # tick and angle of the last fresh reading

    def take(self, samples: Records) -> dict[str, Gauge]:
        """Return the peaks of a block by the names of ``UNITS``.

        Parameters
        ----------
        samples
            (n,) of ``SAMPLE_DTYPE``, in order; there may be gaps.
        """
        torque_nm = samples["torque_command_nm"]
        peaks = {
            "angle": _peak(samples["angle_rad"]),
            "velocity": _peak(self._speeds_rad_s(samples)),
            "tracking_error": _peak(samples["angle_reference_rad"] - samples["angle_rad"]),
            "torque_command": _peak(torque_nm),
            "i2t": self._rms_nm(torque_nm),
        } | {field.partition("_")[0]: _peak(samples[field]) for field in WRENCH_FIELDS}
        return self.with_limits(peaks)

    def with_limits(self, values: Mapping[str, float | None]) -> dict[str, Gauge]:
        """Return values with their limits, by the names of ``UNITS``.

        Parameters
        ----------
        values
            Magnitudes by name; an absent one is unknown.
        """
        return {
            name: Gauge(values.get(name), self._limits.get(name), unit)
            for name, unit in UNITS.items()
        }

    def cool(self, duration_s: float) -> float:
        """Return the rms torque (i²t) after the motor has cooled without torque.

        Parameters
        ----------
        duration_s
            Time without samples.
        """
        self._heat_nm2 *= exp(-duration_s / self._time_constant_s)
        return sqrt(self._heat_nm2)

    def forget_angle(self) -> None:
        """Forget the last angle, because the next sample is of another record."""
        self._last = None

    def _speeds_rad_s(self, samples: Records) -> npt.NDArray[np.float64]:
        """Return the speeds between fresh angles: a stale one would double the next speed."""
        fresh = samples[(samples["status"] & Status.ANGLE_STALE) == 0]
        ticks, angles_rad = fresh["tick"].astype(np.int64), fresh["angle_rad"]
        if self._last is not None:
            ticks = np.append(self._last[0], ticks)
            angles_rad = np.append(self._last[1], angles_rad)
        if ticks.size:
            self._last = int(ticks[-1]), float(angles_rad[-1])
        speeds: npt.NDArray[np.float64] = np.diff(angles_rad) / np.diff(ticks) * self._rate_hz
        return speeds

    def _rms_nm(self, torque_nm: npt.NDArray[np.float64]) -> float:
        known = torque_nm[np.isfinite(torque_nm)]
        ticks = self._rate_hz * self._time_constant_s
        self._heat_nm2 *= exp(-torque_nm.size / ticks)
        self._heat_nm2 += float(known @ known) / ticks
        return sqrt(self._heat_nm2)


def _peak(values: npt.NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.abs(known).max()) if known.size else None
