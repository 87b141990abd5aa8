"""Limit monitor: the checks of the loop in every tick, and warnings near a limit."""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, inf, isfinite, sqrt

from rigd.safety.limits import BY_NAME, OVERLOADED, Limits, Violation

SLOW_CHECK_TICKS = 64
"""Ticks between two checks of slowly changing quantities."""

FRACTION_WINDOW_S = 10.0
"""Missed ticks and old readings are counted over at least this time, so that one early burst is not
a fault."""

REARM_S = 1.0
"""Time for which a channel has to stay clear of its limit before the next warning."""

_UNSURE_TICKS = 3
"""After missed ticks the next latches are irregular, and do not show a jump of the angle."""

_BLAMED_S = 0.005
"""A stall of the loop this long explains a limit that is exceeded right after it."""

_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_FORCES = 3
_Reading = tuple[str, str, str, float, float, float]
"""Name of the interlock, channel, unit, value, limit, level of the warning."""


class LimitWatch:
    """Checks of every tick, and of missed ticks.

    Without a value near its limit a tick costs a few comparisons; only if these fail are details
    computed. A reading that is not a number fails every comparison.

    Parameters
    ----------
    limits
        The limits of the profile.
    sensor_range
        Range of fx, fy, fz (N), tx, ty, tz (N·m).
    rate_hz
        Ticks a second.
    resolution_rad
        Resolution of the encoder.
    peak_torque_nm
        Peak torque of the motor: commands are limited to it, with a warning.
    continuous_torque_nm, thermal_time_constant_s
        Continuous (rms) torque rating of the motor and its thermal time constant.
    tare_warning_nm
        Drift of the coupling torque's zero from which there is a warning.

    Attributes
    ----------
    warning
        Whether a value is near its limit, as of the last tick.
    tared_nm
        Coupling torque of the last tare, to which the next one is compared; None: none since the
        rig was connected.
    """

    __slots__ = (
        "_angle_warning",
        "_before_that_rad",
        "_continuous_nm",
        "_elapsed",
        "_error_warning",
        "_fraction_near",
        "_fraction_window",
        "_heat_nm2",
        "_jump_rad",
        "_jump_warning",
        "_last_slow_check_ns",
        "_limits",
        "_missed_at_check",
        "_missed_lately",
        "_notices",
        "_peak_nm",
        "_per_tick2_rad",
        "_previous_angle_rad",
        "_previous_elapsed",
        "_previous_moved_rad",
        "_rate_hz",
        "_rearm_checks",
        "_saturated",
        "_slow_checks",
        "_slowly_near",
        "_stale_angles",
        "_stale_wrenches",
        "_step_warning",
        "_tare_warning_nm",
        "_time_constant_s",
        "_unsure",
        "_warned",
        "_wrench_limits",
        "_wrench_warnings",
        "tared_nm",
        "warning",
    )

    def __init__(
        self,
        limits: Limits,
        sensor_range: Sequence[float],
        rate_hz: float,
        *,
        resolution_rad: float,
        peak_torque_nm: float,
        continuous_torque_nm: float,
        thermal_time_constant_s: float,
        tare_warning_nm: float,
    ) -> None:
        self._limits = limits
        self._rate_hz = rate_hz
        self._peak_nm = peak_torque_nm
        self._continuous_nm = continuous_torque_nm
        self._time_constant_s = thermal_time_constant_s
        self._tare_warning_nm = tare_warning_nm
        self._angle_warning = _part("angle") * limits.angle_rad
        self._error_warning = _part("tracking error") * limits.tracking_error_rad
        self._step_warning = _part("velocity") * limits.velocity_rad_s / rate_hz
        self._per_tick2_rad = limits.acceleration_rad_s2 / rate_hz**2
        # A difference of two movements contains four readings, each wrong by half a step.
        self._jump_rad = 2.0 * resolution_rad
        self._jump_warning = _part("encoder jump") * (self._per_tick2_rad + self._jump_rad)
        self._wrench_limits = tuple(limits.sensor_range_percent / 100 * r for r in sensor_range)
        self._wrench_warnings = tuple(_part("wrench range") * w for w in self._wrench_limits)
        self._fraction_window = FRACTION_WINDOW_S * rate_hz
        self._rearm_checks = max(1, round(REARM_S * rate_hz / SLOW_CHECK_TICKS))
        self._heat_nm2 = 0.0
        self._last_slow_check_ns: int | None = None
        self._slow_checks = 0
        self._warned: dict[str, int] = {}
        self._notices: list[str] = []
        self.tared_nm: float | None = None
        self.reset(0.0)

    @property
    def heat_nm2(self) -> float:
        """Mean square of the motor's torque over its thermal time constant, at the last check."""
        return self._heat_nm2

    @heat_nm2.setter
    def heat_nm2(self, heat_nm2: float) -> None:
        self._heat_nm2 = heat_nm2

    def reset(self, angle_rad: float) -> None:
        """Start from rest at ``angle_rad``; the motor's temperature is unchanged."""
        self._previous_angle_rad = angle_rad
        self._previous_moved_rad = self._before_that_rad = 0.0
        self._previous_elapsed = self._elapsed = 1
        self._stale_angles = 0
        self._stale_wrenches = 0
        self._saturated = 0
        self._unsure = 0
        self._missed_lately = self._missed_at_check = 0
        self._fraction_near = False
        self._slowly_near = False
        self.warning = False

    def skip(self, missed: int) -> None:
        """Pass the number of missed ticks to the next check, which takes the speed over them."""
        self._elapsed += missed
        if missed:
            self._missed_lately = missed + (self._missed_lately if self.after_missed else 0)
            self._missed_at_check = self._slow_checks

    @property
    def after_missed(self) -> str:
        """Return how many ticks were missed just before, in words; or nothing.

        Just before means within the last 64 to 128 ticks.
        """
        missed = self._missed_lately
        if not missed or self._slow_checks - self._missed_at_check > 1:
            return ""
        ticks = "1 missed tick" if missed == 1 else f"{missed} missed ticks"
        if missed < _BLAMED_S * self._rate_hz:
            return f"It came after {ticks}."
        return f"It came after {ticks}. {OVERLOADED}"

    def check(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: tuple[float, float, float, float, float, float],
        *,
        angle_stale: bool = False,
    ) -> Violation | None:
        """Check one tick's readings before their use.

        Parameters
        ----------
        reference_rad, angle_rad
            Relative to the rig's zero.
        wrench
            fx, fy, fz (N), tx, ty, tz (N·m).
        angle_stale
            Whether the angle is an old one, which gives no speed.

        Returns
        -------
        Violation or None
            The worst violation; `warning` is set if a value is near its limit.
        """
        moved, before = angle_rad - self._previous_angle_rad, self._previous_moved_rad
        a, e, v, j = (
            self._angle_warning,
            self._error_warning,
            self._step_warning,
            self._jump_warning,
        )
        w0, w1, w2, w3, w4, w5 = self._wrench_warnings
        fx, fy, fz, tx, ty, tz = wrench
        if (
            self._elapsed == 1
            and -a < angle_rad < a
            and -e < reference_rad - angle_rad < e
            and -v < moved < v
            and -j < moved - before < j
            and -w0 < fx < w0
            and -w1 < fy < w1
            and -w2 < fz < w2
            and -w3 < tx < w3
            and -w4 < ty < w4
            and -w5 < tz < w5
            and not angle_stale
        ):
            self._previous_angle_rad = angle_rad
            self._before_that_rad = before
            self._previous_moved_rad = moved
            self._previous_elapsed = 1
            self._unsure = 0
            self.warning = self._slowly_near
            return None
        return self._check_closely(reference_rad, angle_rad, wrench, angle_stale)

    def _check_closely(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: Sequence[float],
        angle_stale: bool,
    ) -> Violation | None:
        self.warning = self._slowly_near or self._fraction_near
        self._fraction_near = False
        limits = self._limits
        error_rad = reference_rad - angle_rad
        readings: list[_Reading] = [
            ("angle", "", "", angle_rad, limits.angle_rad, self._angle_warning),
            ("tracking error", "", "", error_rad, limits.tracking_error_rad, self._error_warning),
        ]
        readings += (
            ("wrench range", f"sensor's {axis}", "N" if i < _FORCES else "N·m", value, limit, near)
            for i, (axis, value, limit, near) in enumerate(
                zip(_AXES, wrench, self._wrench_limits, self._wrench_warnings, strict=True)
            )
        )
        if angle_stale:
            # The movement of the next new angle includes this tick.
            self._elapsed += 1
        else:
            readings += self._movement(angle_rad)
        return self._assess(readings)

    def _movement(self, angle_rad: float) -> list[_Reading]:
        """Return speed and jump over the ticks since the last new angle; this is the new one."""
        elapsed, before_rad = self._elapsed, self._previous_moved_rad
        moved_rad = angle_rad - self._previous_angle_rad
        speed_rad_s = moved_rad * self._rate_hz / elapsed
        # A latch may be late by most of a period, and the next one is not: the shaft then moves for
        # that much longer or shorter.
        possible_rad = (
            self._per_tick2_rad * elapsed * (elapsed + self._previous_elapsed) / 2
            + self._jump_rad
            + abs(before_rad)
            + abs(self._before_that_rad)
        )
        jump_rad = moved_rad - elapsed * before_rad
        if elapsed > 1:
            self._unsure = _UNSURE_TICKS
        elif self._unsure:
            self._unsure -= 1
        self._previous_angle_rad = angle_rad
        self._before_that_rad, self._previous_moved_rad = before_rad, moved_rad / elapsed
        self._previous_elapsed, self._elapsed = elapsed, 1
        limit_rad_s = self._limits.velocity_rad_s
        near_rad_s = _part("velocity") * limit_rad_s
        readings: list[_Reading] = [("velocity", "", "", speed_rad_s, limit_rad_s, near_rad_s)]
        if not self._unsure:
            near_rad = _part("encoder jump") * possible_rad
            readings.append(("encoder jump", "", "", jump_rad, possible_rad, near_rad))
        return readings

    def check_stale(
        self, angle_stale: bool, wrench_stale: bool, saturated: bool = False
    ) -> Violation | None:
        """Check the time for which readings are missing or at the end of the sensor's range.

        Called in every tick with such a reading, and in the next. A controller that uses an old
        angle turns the motor without limit, and neither speed nor tracking error would show it.


        Parameters
        ----------
        angle_stale, wrench_stale
            Whether no new angle, or no new wrench, arrived in this tick.
        saturated
            Whether the wrench is at the end of the sensor's range.
        """
        self._stale_angles = self._stale_angles + 1 if angle_stale else 0
        self._stale_wrenches = self._stale_wrenches + 1 if wrench_stale else 0
        self._saturated = self._saturated + 1 if saturated else 0
        if self._fraction_near:  # by a wrench alone, which the angle's check does not include
            self._fraction_near, self.warning = False, True
        limits = self._limits
        return self._assess(
            (
                _reading("stale angle", self._stale_angles, limits.stale_ticks_in_a_row),
                _reading("stale wrench", self._stale_wrenches, limits.stale_ticks_in_a_row),
                _reading("gauge saturation", self._saturated, limits.saturated_ticks_in_a_row),
            )
        )

    def check_torque(self, requested_nm: float) -> Violation | None:
        """Check the controller's request before it is limited and commanded."""
        limit_nm = self._limits.torque_command_nm
        return self._assess((("torque command", "", "", requested_nm, limit_nm, self._peak_nm),))

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
        return self._assess_fraction(
            _reading("missed ticks", missed, limits.missed_ticks_in_a_row),
            _reading(
                "missed share", self._percent(missed_so_far, scheduled), limits.missed_percent
            ),
        )

    def check_stale_fraction(
        self, stale_angles: int, stale_wrenches: int, scheduled: int
    ) -> Violation | None:
        """Check the fraction of missing readings, after a tick with one.

        Their runs may be short: a drive that answers every third SYNC has none of more than two
        ticks, yet the loop uses old angles and the record is useless.

        Parameters
        ----------
        stale_angles, stale_wrenches, scheduled
            Ticks with an old angle, ticks with an old wrench, and ticks scheduled, since the
            record's first.
        """
        limit = self._limits.stale_percent
        return self._assess_fraction(
            _reading("stale angle share", self._percent(stale_angles, scheduled), limit),
            _reading("stale wrench share", self._percent(stale_wrenches, scheduled), limit),
        )

    def _percent(self, ticks: int, scheduled: int) -> float:
        return 100.0 * ticks / max(scheduled, self._fraction_window)

    def _assess_fraction(self, *readings: _Reading) -> Violation | None:
        before, self.warning = self.warning, False
        violation = self._assess(readings)
        # The next sample is flagged.
        self._fraction_near = self._fraction_near or self.warning
        self.warning = before or self.warning
        return violation

    def check_slow(
        self,
        due_ns: int,
        torque_squares_nm2: float = 0.0,
        recorder_lag_s: float = 0.0,
        disk_free_mb: float = inf,
    ) -> Violation | None:
        """Check slowly changing quantities; called every `SLOW_CHECK_TICKS` ticks, at rest too.

        Parameters
        ----------
        due_ns
            Time at which the present tick was due.
        torque_squares_nm2
            Sum of the squared torques over the ticks since the last call.
        recorder_lag_s
            Time by which the recorder is behind the loop.
        disk_free_mb
            Free space on the disk that holds the session file.
        """
        self._slow_checks += 1
        if self._warned:
            gone = self._slow_checks - self._rearm_checks
            self._warned = {name: last for name, last in self._warned.items() if last >= gone}
        elapsed_s = (
            0.0 if self._last_slow_check_ns is None else (due_ns - self._last_slow_check_ns) * 1e-9
        )
        self._last_slow_check_ns = due_ns
        self._heat_nm2 = self._heat_nm2 * exp(
            -max(0.0, elapsed_s) / self._time_constant_s
        ) + torque_squares_nm2 / (self._rate_hz * self._time_constant_s)
        before, self.warning = self.warning, False
        violation = self._assess(
            (
                _reading("i²t", sqrt(self._heat_nm2), self._continuous_nm),
                _reading("recorder lag", recorder_lag_s, self._limits.recorder_lag_s),
                _reading("disk space", disk_free_mb, self._limits.disk_free_mb),
            )
        )
        self._slowly_near, self.warning = self.warning, before or self.warning
        return violation

    def check_tare(self, drift_nm: float) -> Violation | None:
        """Check the change of the coupling torque's zero since the previous tare."""
        limit_nm = self._limits.tare_drift_nm
        return self._assess((("tare drift", "", "", drift_nm, limit_nm, self._tare_warning_nm),))

    def take_notices(self) -> list[str]:
        """Return the channels that came near their limits since the last call, in words.

        A channel that stays near its limit, or returns to it repeatedly, is reported once.
        """
        notices, self._notices = self._notices, []
        return notices

    def _assess(self, readings: Sequence[_Reading]) -> Violation | None:
        """Return the reading furthest beyond its limit; one that is not a number is furthest."""
        worst, worst_ratio = None, 1.0
        near = []
        for reading in readings:
            name, _, _, value, limit, warning = reading
            if BY_NAME[name].below:
                ratio, is_near = limit / value if value > 0.0 else inf, value <= warning
            else:
                size = abs(value) if isfinite(value) else inf
                ratio, is_near = size / limit, size >= warning
            if ratio > worst_ratio:
                worst, worst_ratio = reading, ratio
            elif is_near:
                near.append(reading)
        if worst is not None:
            self.warning = True
            return self._left(worst)
        for reading in near:
            self.warning = True
            channel = reading[1] or reading[0]
            if channel not in self._warned:
                self._notices.append(str(_violation(reading, warns=True)))
            self._warned[channel] = self._slow_checks
        return None

    def _left(self, reading: _Reading) -> Violation:
        """Return the violation, with the computer's stall as its cause if there was one."""
        violation, missed = _violation(reading, warns=False), self.after_missed
        if not missed or not BY_NAME[reading[0]].follows_missed_ticks:
            return violation
        if OVERLOADED not in missed:
            missed = f"{missed} {violation.remedy}"
        return replace(violation, remedy=missed)


def _part(name: str) -> float:
    """Return the fraction of its limit at which an interlock begins to warn."""
    part = BY_NAME[name].warning
    assert isinstance(part, float)
    return part


def _reading(name: str, value: float, limit: float) -> _Reading:
    return name, "", "", value, limit, _part(name) * limit


def _violation(reading: _Reading, *, warns: bool) -> Violation:
    name, channel, unit, value, limit, warning = reading
    row = BY_NAME[name]
    return Violation(
        channel or row.channel,
        value,
        limit,
        unit or row.unit,
        "" if warns else row.remedy,
        row.limit,
        below=row.below,
        warning=warning if warns else None,
    )
