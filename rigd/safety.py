"""Limits: what a session may do, predicted before it and checked in every tick.

The software stops a session that leaves its limits; it is no safety function. That is the wired
STO of the drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Protocol

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

WARNING_FRACTION = 0.8
"""Part of a limit from which on samples carry a warning."""

MISSED_WINDOW_S = 10.0
"""Missed ticks are counted against at least this much time, so that one early burst is no fault."""

_WRENCH_AXES = (
    ("fx", "N"),
    ("fy", "N"),
    ("fz", "N"),
    ("tx", "N·m"),
    ("ty", "N·m"),
    ("tz", "N·m"),
)


@dataclass(frozen=True, slots=True)
class Limits:
    """What ends a session at once; at 80 % of a limit a sample carries a warning.

    The angle is relative to the rig's zero; all are magnitudes.
    """

    angle_rad: Annotated[float, Gt(0)]
    velocity_rad_s: Annotated[float, Gt(0)]
    tracking_error_rad: Annotated[float, Gt(0)]
    """Reference minus measured angle."""
    sensor_range_percent: Annotated[float, Gt(0), Le(200)]
    """Of the range of each of the sensor's axes; above 100 a clipped reading ends nothing (it is
    flagged in its sample)."""
    missed_ticks_in_a_row: Annotated[int, Ge(1)]
    missed_percent: Annotated[float, Gt(0), Le(100)]
    """Of all ticks scheduled so far, counted as if they were at least ten seconds' worth."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A limit that was left."""

    channel: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        """Return one sentence for the operator."""
        if not isfinite(self.value):
            return f"The {self.channel} is not a number: no usable reading came from its device."
        return (
            f"The {self.channel} of {self.value:.4g} {self.unit} exceeds its limit of "
            f"{self.limit:.4g} {self.unit}."
        )


class LimitWatch:
    """The check of every tick, and of the ticks that were missed.

    As long as nothing is near a limit it costs a few comparisons; details are looked for only
    once these fail. Comparisons are written so that a reading that is not a number fails them.

    Parameters
    ----------
    limits
        The limits of the profile.
    sensor_range
        Range of fx, fy, fz (N), tx, ty, tz (N·m).
    rate_hz
        Ticks a second.

    Attributes
    ----------
    warning
        Whether the last check found something at 80 % of its limit or more.
    """

    __slots__ = (
        "_angle_warning",
        "_elapsed",
        "_error_warning",
        "_limits",
        "_missed_window",
        "_previous_angle_rad",
        "_rate_hz",
        "_step_warning",
        "_wrench_limits",
        "_wrench_warnings",
        "warning",
    )

    def __init__(self, limits: Limits, sensor_range: Sequence[float], rate_hz: float) -> None:
        self._limits = limits
        self._rate_hz = rate_hz
        self._angle_warning = WARNING_FRACTION * limits.angle_rad
        self._error_warning = WARNING_FRACTION * limits.tracking_error_rad
        self._step_warning = WARNING_FRACTION * limits.velocity_rad_s / rate_hz
        self._wrench_limits = tuple(limits.sensor_range_percent / 100 * r for r in sensor_range)
        self._wrench_warnings = tuple(WARNING_FRACTION * limit for limit in self._wrench_limits)
        self._missed_window = MISSED_WINDOW_S * rate_hz
        self.reset(0.0)

    def reset(self, angle_rad: float) -> None:
        """Start from rest at ``angle_rad``."""
        self._previous_angle_rad = angle_rad
        self._elapsed = 1
        self.warning = False

    def skip(self, missed: int) -> None:
        """Tell the next check that ``missed`` ticks passed unseen: the speed is taken over them."""
        self._elapsed += missed

    def check(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: tuple[float, float, float, float, float, float],
    ) -> Violation | None:
        """Check one tick's readings, before they are used.

        Parameters
        ----------
        reference_rad, angle_rad
            Relative to the rig's zero.
        wrench
            fx, fy, fz (N), tx, ty, tz (N·m).

        Returns
        -------
        Violation or None
            The worst of what is beyond its limit; `warning` is set from 80 % on.
        """
        moved = angle_rad - self._previous_angle_rad
        elapsed = self._elapsed
        self._previous_angle_rad = angle_rad
        self._elapsed = 1
        a, e, v = self._angle_warning, self._error_warning, self._step_warning * elapsed
        w0, w1, w2, w3, w4, w5 = self._wrench_warnings
        fx, fy, fz, tx, ty, tz = wrench
        if (
            -a < angle_rad < a
            and -e < reference_rad - angle_rad < e
            and -v < moved < v
            and -w0 < fx < w0
            and -w1 < fy < w1
            and -w2 < fz < w2
            and -w3 < tx < w3
            and -w4 < ty < w4
            and -w5 < tz < w5
        ):
            self.warning = False
            return None
        self.warning = True
        limits = self._limits
        return _worst(
            (
                ("angle", angle_rad, limits.angle_rad, "rad"),
                ("speed", moved * self._rate_hz / elapsed, limits.velocity_rad_s, "rad/s"),
                ("tracking error", reference_rad - angle_rad, limits.tracking_error_rad, "rad"),
                *(
                    (f"sensor's {axis}", value, limit, unit)
                    for (axis, unit), value, limit in zip(
                        _WRENCH_AXES, wrench, self._wrench_limits, strict=True
                    )
                ),
            )
        )

    def check_missed(self, missed: int, missed_so_far: int, scheduled: int) -> Violation | None:
        """Check missed ticks; the next speed is then taken over them too.

        Parameters
        ----------
        missed
            Ticks missed in a row just now.
        missed_so_far, scheduled
            Ticks missed and ticks scheduled since the record's first.
        """
        self.skip(missed)
        limits = self._limits
        percent = 100.0 * missed_so_far / max(scheduled, self._missed_window)
        return _worst(
            (
                ("run of missed ticks", missed, limits.missed_ticks_in_a_row, "ticks"),
                ("part of ticks missed", percent, limits.missed_percent, "%"),
            )
        )


def _worst(channels: Sequence[tuple[str, float, float, str]]) -> Violation | None:
    """Return the channel that is furthest beyond its limit; no number at all is furthest."""
    worst, worst_ratio = None, 1.0
    for channel in channels:
        _, value, limit, _ = channel
        ratio = abs(value) / limit if isfinite(value) else float("inf")
        if ratio > worst_ratio:
            worst, worst_ratio = channel, ratio
    return None if worst is None else Violation(*worst)


class _Response(Protocol):
    @property
    def angle_rad(self) -> FloatArray: ...
    @property
    def velocity_rad_s(self) -> FloatArray: ...
    @property
    def torque_nm(self) -> FloatArray: ...
    @property
    def coupling_torque_nm(self) -> FloatArray: ...


class _Loop(Protocol):
    def simulate(self, reference_rad: FloatArray) -> _Response: ...


class _Excitation(Protocol):
    @property
    def reference_rad(self) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class Prediction:
    """Largest magnitudes of a session, from the linear closed loop (torque not limited)."""

    peak_angle_rad: float
    """Relative to the rig's zero, start angle included."""
    peak_velocity_rad_s: float
    peak_torque_nm: float
    peak_tracking_error_rad: float
    peak_coupling_torque_nm: float
    saturated_ticks: int
    """Ticks whose torque command lies beyond the limit."""


@dataclass(frozen=True, slots=True)
class PredictedViolation:
    """A limit that a session is predicted to leave."""

    sentence: str
    may_be_forced: bool
    """True for torques: command and reading are then clipped and flagged. Angle, speed and tracking
    error end the session when they are left, so forcing it would be no use."""


def predict(
    loop: _Loop,
    excitation: _Excitation,
    *,
    torque_limit_nm: float,
    start_angle_rad: float = 0.0,
) -> Prediction:
    """Predict the peaks of a session.

    Parameters
    ----------
    loop
        The closed loop (:class:`rigd.control.ClosedLoop`).
    excitation
        Its reference, relative to ``start_angle_rad`` (:class:`rigd.excitation.Excitation`).
    torque_limit_nm
        The motor's peak torque.
    start_angle_rad
        Where the session starts, relative to the rig's zero.
    """
    response = loop.simulate(excitation.reference_rad)
    return Prediction(
        peak_angle_rad=_peak(response.angle_rad + start_angle_rad),
        peak_velocity_rad_s=_peak(response.velocity_rad_s),
        peak_torque_nm=_peak(response.torque_nm),
        peak_tracking_error_rad=_peak(excitation.reference_rad - response.angle_rad),
        peak_coupling_torque_nm=_peak(response.coupling_torque_nm),
        saturated_ticks=int(np.count_nonzero(np.abs(response.torque_nm) > torque_limit_nm)),
    )


def violations(
    prediction: Prediction,
    limits: Limits,
    *,
    torque_limit_nm: float,
    coupling_torque_limit_nm: float,
) -> list[PredictedViolation]:
    """Compare a prediction with the limits.

    Parameters
    ----------
    prediction
        From :func:`predict`.
    limits
        The limits of the profile.
    torque_limit_nm
        The motor's peak torque: beyond it the command saturates, which may be forced.
    coupling_torque_limit_nm
        Coupling torque at which the sensor leaves its range: beyond it the reading is clipped,
        which may be forced too.

    Returns
    -------
    list of PredictedViolation
        Empty if the session stays within all limits. A peak that is not a number violates.
    """
    found = []
    for channel, value, limit, unit, key, forced in (
        ("angle", prediction.peak_angle_rad, limits.angle_rad, "rad", "limits.angle_rad", False),
        (
            "speed",
            prediction.peak_velocity_rad_s,
            limits.velocity_rad_s,
            "rad/s",
            "limits.velocity_rad_s",
            False,
        ),
        (
            "tracking error",
            prediction.peak_tracking_error_rad,
            limits.tracking_error_rad,
            "rad",
            "limits.tracking_error_rad",
            False,
        ),
        (
            "coupling torque",
            prediction.peak_coupling_torque_nm,
            coupling_torque_limit_nm,
            "N·m",
            "sensor.range",
            True,
        ),
        (
            "torque",
            prediction.peak_torque_nm,
            torque_limit_nm,
            "N·m",
            "motor.peak_torque_nm",
            True,
        ),
    ):
        if not value <= limit:
            sentence = (
                f"The predicted peak {channel} of {value:.4g} {unit} exceeds {limit:.4g} {unit} "
                f"({key}); lower the amplitude"
            )
            sentence += ", or force the session to run clipped." if forced else "."
            found.append(PredictedViolation(sentence, may_be_forced=forced))
    return found


def _peak(values: FloatArray) -> float:
    return float(np.max(np.abs(values)))
