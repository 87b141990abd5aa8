"""Gauges: largest values of a session's signals as fractions of their limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, isfinite, sqrt
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.session.layout import WRENCH_FIELDS, Status

Records = npt.NDArray[Any]
"""Structured array of samples, shape (n,)."""

WARNING_FRACTION: Final = 0.8
"""Fraction of a limit above which a gauge turns orange, as for the interlocks' warnings."""


GAUGE_UNITS: Final = {
    "angle": "rad",
    "velocity": "rad/s",
    "tracking_error": "rad",
    "torque_command": "N·m",
    "i2t": "N·m",
} | {field.partition("_")[0]: "N" if field.endswith("_n") else "N·m" for field in WRENCH_FIELDS}
"""Units of the gauges, by the name of the signal."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """Gauge of a signal: its largest magnitude, and the limit of this magnitude.

    Attributes
    ----------
    value
        Largest magnitude of the signal; None if unknown.
    limit
        Magnitude at which the session ends or the torque is clipped; None if the signal has no
        limit.
    unit
        Unit of the value and of the limit.
    """

    value: float | None
    limit: float | None
    unit: str

    @property
    def fraction(self) -> float | None:
        """Magnitude of the signal as a fraction of its limit; None if either is unknown."""
        return None if self.value is None or self.limit is None else self.value / self.limit


class Gauges:
    """Calculator of the largest magnitude of each signal in successive blocks of samples.

    The rms torque (i²t) is computed as if the motor were cold at the first sample.

    Parameters
    ----------
    rate_hz
        Scheduled ticks per second.
    limits
        Limits by the names of ``GAUGE_UNITS``. A signal with an absent or infinite limit has no
        limit.
    thermal_time_constant_s
        Time constant of the filter that averages the squared torque.
    """

    def __init__(
        self, rate_hz: float, limits: Mapping[str, float], thermal_time_constant_s: float = 10.0
    ) -> None:
        self._rate_hz = rate_hz
        self._limits = {
            name: signal_limit for name, signal_limit in limits.items() if isfinite(signal_limit)
        }
        self._time_constant_s = thermal_time_constant_s
        self._mean_squared_torque_nm2 = 0.0
        self._last_fresh_angle: tuple[int, float] | None = (
            None  # tick and angle of the last fresh reading
        )

    def gauges_of_block(self, samples: Records) -> dict[str, Gauge]:
        """Return the largest magnitudes in a block of samples, by the names of ``GAUGE_UNITS``.

        Parameters
        ----------
        samples
            Samples (n,) of ``SAMPLE_DTYPE``, in order. There may be gaps.
        """
        torque_nm = samples["torque_command_nm"]
        largest_magnitudes = {
            "angle": _largest_magnitude(samples["angle_rad"]),
            "velocity": _largest_magnitude(self._speeds_from_fresh_angles(samples)),
            "tracking_error": _largest_magnitude(
                samples["angle_reference_rad"] - samples["angle_rad"]
            ),
            "torque_command": _largest_magnitude(torque_nm),
            "i2t": self._update_rms_torque(torque_nm),
        } | {
            wrench_field.partition("_")[0]: _largest_magnitude(samples[wrench_field])
            for wrench_field in WRENCH_FIELDS
        }
        return self.with_limits(largest_magnitudes)

    def with_limits(self, magnitudes_by_signal: Mapping[str, float | None]) -> dict[str, Gauge]:
        """Return gauges with the given magnitudes and this session's limits, by signal name.

        Parameters
        ----------
        magnitudes_by_signal
            Magnitudes by signal name. A signal that is absent has an unknown magnitude.
        """
        return {
            signal_name: Gauge(
                magnitudes_by_signal.get(signal_name), self._limits.get(signal_name), unit
            )
            for signal_name, unit in GAUGE_UNITS.items()
        }

    def cool_down(self, duration_s: float) -> float:
        """Return the rms torque (i²t) in N·m after `duration_s` without torque.

        Parameters
        ----------
        duration_s
            Time during which the motor had no torque.
        """
        self._mean_squared_torque_nm2 *= exp(-duration_s / self._time_constant_s)
        return sqrt(self._mean_squared_torque_nm2)

    def forget_angle(self) -> None:
        """Forget the last motor angle, so that no speed is computed from angles of two records."""
        self._last_fresh_angle = None

    def _speeds_from_fresh_angles(self, samples: Records) -> npt.NDArray[np.float64]:
        """Return the speeds in rad/s between fresh readings of the angle, shape (n,).

        A repeated (stale) reading is omitted, because the speed after it would be doubled.
        """
        fresh_samples = samples[(samples["status"] & Status.ANGLE_STALE) == 0]
        fresh_ticks, angles_rad = fresh_samples["tick"].astype(np.int64), fresh_samples["angle_rad"]
        if self._last_fresh_angle is not None:
            fresh_ticks = np.append(self._last_fresh_angle[0], fresh_ticks)
            angles_rad = np.append(self._last_fresh_angle[1], angles_rad)
        if fresh_ticks.size:
            self._last_fresh_angle = int(fresh_ticks[-1]), float(angles_rad[-1])
        speeds_rad_s: npt.NDArray[np.float64] = (
            np.diff(angles_rad) / np.diff(fresh_ticks) * self._rate_hz
        )
        return speeds_rad_s

    def _update_rms_torque(self, torque_nm: npt.NDArray[np.float64]) -> float:
        """Update the rms torque (i²t) with commanded torques and return it in N·m."""
        known_torque_nm = torque_nm[np.isfinite(torque_nm)]
        time_constant_ticks = self._rate_hz * self._time_constant_s
        self._mean_squared_torque_nm2 *= exp(-torque_nm.size / time_constant_ticks)
        self._mean_squared_torque_nm2 += (
            float(known_torque_nm @ known_torque_nm) / time_constant_ticks
        )
        return sqrt(self._mean_squared_torque_nm2)


def _largest_magnitude(signal_values: npt.NDArray[np.float64]) -> float | None:
    """Return the largest magnitude of the finite values; None if there are none."""
    finite_values = signal_values[np.isfinite(signal_values)]
    return float(np.abs(finite_values).max()) if finite_values.size else None
