"""Limit monitor: the loop's checks of every tick against the rig's limits, with warnings."""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, inf, isfinite, sqrt

from rigd.safety.limits import INTERLOCKS_BY_NAME, OVERLOADED_ADVICE, Limits, Violation

SLOW_CHECK_TICKS = 64
"""Number of ticks from one check of slowly changing quantities to the next."""

FRACTION_WINDOW_S = 10.0
"""Shortest time in seconds that the fractions of missed ticks and old readings refer to.

With a shorter time one early burst would be a fault."""

WARNING_REARM_S = 1.0
"""Time in seconds for which a channel must be below its warning level before the next warning."""

_NO_JUMP_CHECK_TICKS = 3
"""Number of ticks after missed ticks in which no jump of the angle is checked.

Readings of the encoder are then taken at irregular times."""

_MIN_STALL_S = 0.005
"""Shortest stall of the loop in seconds that is reported as the cause of a later violation."""

_WRENCH_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
"""Names of the force-torque sensor's axes in messages."""
_FORCE_AXIS_COUNT = 3
"""Number of axes that measure a force; they come before the torques."""
_CheckedValue = tuple[str, str, str, float, float, float]
"""Checked value: name of the interlock, channel, unit, value, limit and warning level.

If channel or unit is empty, that of the interlock applies."""


class LimitMonitor:
    """Compares the readings of every tick with the limits of the rig.

    Without a value near its limit a tick costs a few comparisons; only if these fail are details
    computed. A reading that is not a number fails every comparison.

    Parameters
    ----------
    limits
        Limits of the rig's profile.
    sensor_range
        Measuring range of the sensor's axes fx, fy, fz (N), tx, ty, tz (N·m).
    rate_hz
        Loop rate in ticks per second.
    resolution_rad
        Resolution of the encoder.
    peak_torque_nm
        Peak torque of the motor: commands are limited to it, with a warning.
    continuous_torque_nm, thermal_time_constant_s
        Continuous (rms) torque rating of the motor and its thermal time constant.
    tare_warning_nm
        Drift of the coupling torque's zero that causes a warning.

    Attributes
    ----------
    warning
        Whether a value was near its limit in the last tick.
    tared_nm
        Coupling torque at the last tare, with which the next tare is compared, or None if there was
        no tare since the rig was connected.
    """

    __slots__ = (
        "_angle_warning",
        "_continuous_nm",
        "_elapsed_ticks",
        "_error_warning",
        "_fraction_near",
        "_fraction_window",
        "_heat_nm2",
        "_jump_rad",
        "_jump_warning",
        "_last_missed_check",
        "_last_slow_check_ns",
        "_last_warnings",
        "_limits",
        "_notices",
        "_peak_nm",
        "_per_tick2_rad",
        "_previous_angle_rad",
        "_previous_elapsed_ticks",
        "_previous_moved_rad",
        "_rate_hz",
        "_rearm_checks",
        "_recently_missed",
        "_saturated_ticks",
        "_second_last_moved_rad",
        "_slow_checks",
        "_slow_value_near",
        "_stale_angles",
        "_stale_wrenches",
        "_step_warning",
        "_tare_warning_nm",
        "_ticks_without_jump_check",
        "_time_constant_s",
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
        self._angle_warning = _warning_fraction("angle") * limits.angle_rad
        self._error_warning = _warning_fraction("tracking error") * limits.tracking_error_rad
        self._step_warning = _warning_fraction("velocity") * limits.velocity_rad_s / rate_hz
        self._per_tick2_rad = limits.acceleration_rad_s2 / rate_hz**2
        # A difference of two movements contains four readings, each wrong by half a step.
        self._jump_rad = 2.0 * resolution_rad
        self._jump_warning = _warning_fraction("encoder jump") * (
            self._per_tick2_rad + self._jump_rad
        )
        self._wrench_limits = tuple(limits.sensor_range_percent / 100 * r for r in sensor_range)
        self._wrench_warnings = tuple(
            _warning_fraction("wrench range") * w for w in self._wrench_limits
        )
        self._fraction_window = FRACTION_WINDOW_S * rate_hz
        self._rearm_checks = max(1, round(WARNING_REARM_S * rate_hz / SLOW_CHECK_TICKS))
        self._heat_nm2 = 0.0
        self._last_slow_check_ns: int | None = None
        self._slow_checks = 0
        self._last_warnings: dict[str, int] = {}
        self._notices: list[str] = []
        self.tared_nm: float | None = None
        self.reset(0.0)

    @property
    def heat_nm2(self) -> float:
        """Mean square of the motor's torque in (N·m)², a measure of its temperature.

        It is averaged over the motor's thermal time constant, up to the last slow check.
        """
        return self._heat_nm2

    @heat_nm2.setter
    def heat_nm2(self, heat_nm2: float) -> None:
        self._heat_nm2 = heat_nm2

    def reset(self, angle_rad: float) -> None:
        """Forget all readings and start again with the shaft at rest at ``angle_rad``.

        The estimate of the motor's temperature is retained.
        """
        self._previous_angle_rad = angle_rad
        self._previous_moved_rad = self._second_last_moved_rad = 0.0
        self._previous_elapsed_ticks = self._elapsed_ticks = 1
        self._stale_angles = 0
        self._stale_wrenches = 0
        self._saturated_ticks = 0
        self._ticks_without_jump_check = 0
        self._recently_missed = self._last_missed_check = 0
        self._fraction_near = False
        self._slow_value_near = False
        self.warning = False

    def skip(self, missed_ticks: int) -> None:
        """Register missed ticks; the next check computes the shaft's speed over them."""
        self._elapsed_ticks += missed_ticks
        if missed_ticks:
            self._recently_missed = missed_ticks + (
                self._recently_missed if self.missed_ticks_text else 0
            )
            self._last_missed_check = self._slow_checks

    @property
    def missed_ticks_text(self) -> str:
        """Sentence for the operator on ticks that were missed just before, or an empty string.

        It counts ticks missed within the last 64 to 128 ticks.
        """
        missed_tick_count = self._recently_missed
        if not missed_tick_count or self._slow_checks - self._last_missed_check > 1:
            return ""
        ticks_text = (
            "1 missed tick" if missed_tick_count == 1 else f"{missed_tick_count} missed ticks"
        )
        if missed_tick_count < _MIN_STALL_S * self._rate_hz:
            return f"It came after {ticks_text}."
        return f"It came after {ticks_text}. {OVERLOADED_ADVICE}"

    def check(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: tuple[float, float, float, float, float, float],
        *,
        angle_stale: bool = False,
    ) -> Violation | None:
        """Check the readings of one tick before the controller uses them.

        Parameters
        ----------
        reference_rad, angle_rad
            Reference and measured angle, relative to the rig's zero.
        wrench
            Force-torque reading fx, fy, fz (N), tx, ty, tz (N·m).
        angle_stale
            Whether the angle is not of this tick; it then gives no speed.

        Returns
        -------
        Violation or None
            Violation furthest beyond its limit, or None. `warning` is set if a value is near its
            limit.
        """
        moved_rad, previous_moved_rad = (
            angle_rad - self._previous_angle_rad,
            self._previous_moved_rad,
        )
        a, e, v, j = (
            self._angle_warning,
            self._error_warning,
            self._step_warning,
            self._jump_warning,
        )
        w0, w1, w2, w3, w4, w5 = self._wrench_warnings
        fx, fy, fz, tx, ty, tz = wrench
        if (
            self._elapsed_ticks == 1
            and -a < angle_rad < a
            and -e < reference_rad - angle_rad < e
            and -v < moved_rad < v
            and -j < moved_rad - previous_moved_rad < j
            and -w0 < fx < w0
            and -w1 < fy < w1
            and -w2 < fz < w2
            and -w3 < tx < w3
            and -w4 < ty < w4
            and -w5 < tz < w5
            and not angle_stale
        ):
            self._previous_angle_rad = angle_rad
            self._second_last_moved_rad = previous_moved_rad
            self._previous_moved_rad = moved_rad
            self._previous_elapsed_ticks = 1
            self._ticks_without_jump_check = 0
            self.warning = self._slow_value_near
            return None
        return self._check_in_detail(reference_rad, angle_rad, wrench, angle_stale)

    def _check_in_detail(
        self,
        reference_rad: float,
        angle_rad: float,
        wrench: Sequence[float],
        angle_stale: bool,
    ) -> Violation | None:
        """Return the worst violation in a tick in which a value may be near or beyond its limit."""
        self.warning = self._slow_value_near or self._fraction_near
        self._fraction_near = False
        limits = self._limits
        error_rad = reference_rad - angle_rad
        checked_values: list[_CheckedValue] = [
            ("angle", "", "", angle_rad, limits.angle_rad, self._angle_warning),
            ("tracking error", "", "", error_rad, limits.tracking_error_rad, self._error_warning),
        ]
        checked_values += (
            (
                "wrench range",
                f"sensor's {axis_name}",
                "N" if i < _FORCE_AXIS_COUNT else "N·m",
                axis_value,
                axis_limit,
                warning_level,
            )
            for i, (axis_name, axis_value, axis_limit, warning_level) in enumerate(
                zip(_WRENCH_AXES, wrench, self._wrench_limits, self._wrench_warnings, strict=True)
            )
        )
        if angle_stale:
            # The movement of the next new angle includes this tick.
            self._elapsed_ticks += 1
        else:
            checked_values += self._speed_and_jump(angle_rad)
        return self._assess_values(checked_values)

    def _speed_and_jump(self, angle_rad: float) -> list[_CheckedValue]:
        """Return the shaft's speed, and the jump of the angle, since the last new angle.

        `angle_rad` is the new angle, with which the next one is compared.
        """
        elapsed_ticks, previous_moved_rad = self._elapsed_ticks, self._previous_moved_rad
        movement_rad = angle_rad - self._previous_angle_rad
        speed_rad_s = movement_rad * self._rate_hz / elapsed_ticks
        # One latch of the encoder may be late by most of a period and the next one not: the time
        # between them is longer or shorter by that much.
        max_jump_rad = (
            self._per_tick2_rad * elapsed_ticks * (elapsed_ticks + self._previous_elapsed_ticks) / 2
            + self._jump_rad
            + abs(previous_moved_rad)
            + abs(self._second_last_moved_rad)
        )
        jump_rad = movement_rad - elapsed_ticks * previous_moved_rad
        if elapsed_ticks > 1:
            self._ticks_without_jump_check = _NO_JUMP_CHECK_TICKS
        elif self._ticks_without_jump_check:
            self._ticks_without_jump_check -= 1
        self._previous_angle_rad = angle_rad
        self._second_last_moved_rad, self._previous_moved_rad = (
            previous_moved_rad,
            movement_rad / elapsed_ticks,
        )
        self._previous_elapsed_ticks, self._elapsed_ticks = elapsed_ticks, 1
        velocity_limit_rad_s = self._limits.velocity_rad_s
        velocity_warning_rad_s = _warning_fraction("velocity") * velocity_limit_rad_s
        checked_values: list[_CheckedValue] = [
            ("velocity", "", "", speed_rad_s, velocity_limit_rad_s, velocity_warning_rad_s)
        ]
        if not self._ticks_without_jump_check:
            jump_warning_rad = _warning_fraction("encoder jump") * max_jump_rad
            checked_values.append(
                ("encoder jump", "", "", jump_rad, max_jump_rad, jump_warning_rad)
            )
        return checked_values

    def check_stale(
        self, angle_stale: bool, wrench_stale: bool, saturated: bool = False
    ) -> Violation | None:
        """Return a violation if readings are old, or at the sensor's limit, for too many ticks.

        It is called in every tick with such a reading, and in the next one. A controller that uses
        an old angle turns the motor without limit, and neither speed nor tracking error would show
        it.

        Parameters
        ----------
        angle_stale, wrench_stale
            Whether no new angle, or no new wrench, arrived in this tick.
        saturated
            Whether the wrench is at the end of the sensor's range.
        """
        self._stale_angles = self._stale_angles + 1 if angle_stale else 0
        self._stale_wrenches = self._stale_wrenches + 1 if wrench_stale else 0
        self._saturated_ticks = self._saturated_ticks + 1 if saturated else 0
        if self._fraction_near:  # set by an old wrench, for which `_check_in_detail` is not called
            self._fraction_near, self.warning = False, True
        limits = self._limits
        return self._assess_values(
            (
                _checked_value("stale angle", self._stale_angles, limits.stale_ticks_in_a_row),
                _checked_value("stale wrench", self._stale_wrenches, limits.stale_ticks_in_a_row),
                _checked_value(
                    "gauge saturation", self._saturated_ticks, limits.saturated_ticks_in_a_row
                ),
            )
        )

    def check_torque(self, requested_torque_nm: float) -> Violation | None:
        """Return a violation if the controller requests a torque above its limit, else None."""
        torque_limit_nm = self._limits.torque_command_nm
        return self._assess_values(
            (("torque command", "", "", requested_torque_nm, torque_limit_nm, self._peak_nm),)
        )

    def check_missed(
        self, consecutive_missed_ticks: int, session_missed_ticks: int, scheduled_ticks: int
    ) -> Violation | None:
        """Return a violation if too many ticks were missed in a row or in the session, else None.

        The next speed is computed over the missed ticks, too.

        Parameters
        ----------
        consecutive_missed_ticks
            Number of consecutive ticks missed just now.
        session_missed_ticks, scheduled_ticks
            Numbers of missed and of scheduled ticks since the record's first.
        """
        self.skip(consecutive_missed_ticks)
        limits = self._limits
        return self._assess_fraction(
            _checked_value("missed ticks", consecutive_missed_ticks, limits.missed_ticks_in_a_row),
            _checked_value(
                "missed share",
                self._percentage(session_missed_ticks, scheduled_ticks),
                limits.missed_percent,
            ),
        )

    def check_stale_fraction(
        self, stale_angles: int, stale_wrenches: int, scheduled_ticks: int
    ) -> Violation | None:
        """Check the percentages of ticks without a new angle and without a new wrench.

        It is called after a tick with an old reading. The runs of old readings may be short: a
        drive that answers every third SYNC never misses more than two in a row, yet the loop uses
        old angles and the record is useless.

        Parameters
        ----------
        stale_angles, stale_wrenches, scheduled_ticks
            Numbers of ticks with an old angle, of ticks with an old wrench, and of scheduled ticks,
            since the record's first.
        """
        stale_percent_limit = self._limits.stale_percent
        return self._assess_fraction(
            _checked_value(
                "stale angle share",
                self._percentage(stale_angles, scheduled_ticks),
                stale_percent_limit,
            ),
            _checked_value(
                "stale wrench share",
                self._percentage(stale_wrenches, scheduled_ticks),
                stale_percent_limit,
            ),
        )

    def _percentage(self, counted_ticks: int, scheduled_ticks: int) -> float:
        """Return ticks in per cent of the scheduled ticks, or of those in 10 s if more."""
        return 100.0 * counted_ticks / max(scheduled_ticks, self._fraction_window)

    def _assess_fraction(self, *checked_values: _CheckedValue) -> Violation | None:
        """Return the violation by the percentage furthest beyond its limit, or None.

        The next recorded sample gets a warning flag if a percentage is near its limit.
        """
        previous_warning, self.warning = self.warning, False
        violation = self._assess_values(checked_values)
        # The next sample is flagged.
        self._fraction_near = self._fraction_near or self.warning
        self.warning = previous_warning or self.warning
        return violation

    def check_slow(
        self,
        due_ns: int,
        torque_squares_nm2: float = 0.0,
        recorder_lag_s: float = 0.0,
        disk_free_mb: float = inf,
    ) -> Violation | None:
        """Check the motor's load, the recorder's lag and the free disk space.

        It is called every `SLOW_CHECK_TICKS` ticks, also at rest.

        Parameters
        ----------
        due_ns
            Scheduled time of the present tick.
        torque_squares_nm2
            Sum of the squared torques over the ticks since the last call.
        recorder_lag_s
            Time by which the recorder is behind the loop.
        disk_free_mb
            Free space on the disk that holds the session file.
        """
        self._slow_checks += 1
        if self._last_warnings:
            oldest_recent_check = self._slow_checks - self._rearm_checks
            self._last_warnings = {
                channel_name: last_check
                for channel_name, last_check in self._last_warnings.items()
                if last_check >= oldest_recent_check
            }
        elapsed_s = (
            0.0 if self._last_slow_check_ns is None else (due_ns - self._last_slow_check_ns) * 1e-9
        )
        self._last_slow_check_ns = due_ns
        self._heat_nm2 = self._heat_nm2 * exp(
            -max(0.0, elapsed_s) / self._time_constant_s
        ) + torque_squares_nm2 / (self._rate_hz * self._time_constant_s)
        previous_warning, self.warning = self.warning, False
        violation = self._assess_values(
            (
                _checked_value("i²t", sqrt(self._heat_nm2), self._continuous_nm),
                _checked_value("recorder lag", recorder_lag_s, self._limits.recorder_lag_s),
                _checked_value("disk space", disk_free_mb, self._limits.disk_free_mb),
            )
        )
        self._slow_value_near, self.warning = self.warning, previous_warning or self.warning
        return violation

    def check_tare(self, drift_nm: float) -> Violation | None:
        """Return a violation if the coupling torque's zero drifted too far since the last tare."""
        drift_limit_nm = self._limits.tare_drift_nm
        return self._assess_values(
            (("tare drift", "", "", drift_nm, drift_limit_nm, self._tare_warning_nm),)
        )

    def take_notices(self) -> list[str]:
        """Return and clear the warnings on channels that came near their limits.

        A channel that stays near its limit, or returns to it repeatedly, is reported once.
        """
        new_notices, self._notices = self._notices, []
        return new_notices

    def _assess_values(self, checked_values: Sequence[_CheckedValue]) -> Violation | None:
        """Return the violation furthest beyond its limit, and register warnings.

        A value that is not a number counts as infinitely far beyond its limit.
        """
        worst_value, worst_ratio = None, 1.0
        warned_values = []
        for checked_value in checked_values:
            interlock_name, _, _, measured_value, limit_value, warning_level = checked_value
            if INTERLOCKS_BY_NAME[interlock_name].below:
                limit_ratio, is_near_limit = (
                    limit_value / measured_value if measured_value > 0.0 else inf,
                    measured_value <= warning_level,
                )
            else:
                magnitude = abs(measured_value) if isfinite(measured_value) else inf
                limit_ratio, is_near_limit = magnitude / limit_value, magnitude >= warning_level
            if limit_ratio > worst_ratio:
                worst_value, worst_ratio = checked_value, limit_ratio
            elif is_near_limit:
                warned_values.append(checked_value)
        if worst_value is not None:
            self.warning = True
            return self._violation_with_cause(worst_value)
        for checked_value in warned_values:
            self.warning = True
            channel_name = checked_value[1] or checked_value[0]
            if channel_name not in self._last_warnings:
                self._notices.append(str(_make_violation(checked_value, is_warning=True)))
            self._last_warnings[channel_name] = self._slow_checks
        return None

    def _violation_with_cause(self, checked_value: _CheckedValue) -> Violation:
        """Return the violation of a limit, with advice that mentions ticks missed just before."""
        violation, missed_text = (
            _make_violation(checked_value, is_warning=False),
            self.missed_ticks_text,
        )
        if not missed_text or not INTERLOCKS_BY_NAME[checked_value[0]].follows_missed_ticks:
            return violation
        if OVERLOADED_ADVICE not in missed_text:
            missed_text = f"{missed_text} {violation.remedy}"
        return replace(violation, remedy=missed_text)


def _warning_fraction(interlock_name: str) -> float:
    """Return the warning level of an interlock as a fraction of its limit."""
    warning_fraction = INTERLOCKS_BY_NAME[interlock_name].warning
    assert isinstance(warning_fraction, float)
    return warning_fraction


def _checked_value(interlock_name: str, measured_value: float, limit_value: float) -> _CheckedValue:
    """Return a value to check, with the channel, unit and warning level of its interlock."""
    return (
        interlock_name,
        "",
        "",
        measured_value,
        limit_value,
        _warning_fraction(interlock_name) * limit_value,
    )


def _make_violation(checked_value: _CheckedValue, *, is_warning: bool) -> Violation:
    """Return the violation of a reading's limit, or of its warning level if `is_warning`."""
    interlock_name, channel_text, unit, measured_value, limit_value, warning_level = checked_value
    interlock = INTERLOCKS_BY_NAME[interlock_name]
    return Violation(
        channel_text or interlock.channel,
        measured_value,
        limit_value,
        unit or interlock.unit,
        "" if is_warning else interlock.remedy,
        interlock.limit,
        below=interlock.below,
        warning=warning_level if is_warning else None,
    )
