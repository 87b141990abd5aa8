"""Limit monitor: the checks of the loop in every tick, and warnings near a limit."""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, inf, isfinite, sqrt

from rigd.safety.limits import BY_NAME, OVERLOADED, Limits, Violation

LOOK_EVERY = 64
"""Ticks between two checks of what changes slowly."""

SHARE_WINDOW_S = 10.0
"""Missed ticks and old readings are counted against at least this much time, so that one early
burst is not a fault."""

REARM_S = 1.0
"""How long a channel has to stay clear of its limit before it is announced as near it again."""

_UNSURE_TICKS = 3
"""After missed ticks the next latches come unevenly, and no jump can be told from that."""

_BLAMED_S = 0.005
"""A stall of the loop this long explains a limit that is exceeded right after it."""

_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_FORCES = 3
_Reading = tuple[str, str, str, float, float, float]
"""Name of the interlock, channel, unit, value, limit, level of the warning."""


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
    resolution_rad
        Resolution of the encoder.
    peak_torque_nm
        Peak torque of the motor: commands are cut there, and a warning begins.
    continuous_torque_nm, thermal_time_constant_s
        Continuous (rms) torque rating of the motor and its thermal time constant.
    tare_warning_nm
        Drift of the coupling torque's zero from which on there is a warning.

    Attributes
    ----------
    warning
        Whether something is near its limit, as of the last tick.
    tared_nm
        Coupling torque that was tared last, from which the next tare may not be far; None: none
        was since the rig was connected.
    """

    __slots__ = (
        "_angle_warning",
        "_before_that_rad",
        "_continuous_nm",
        "_elapsed",
        "_error_warning",
        "_heat_nm2",
        "_jump_rad",
        "_jump_warning",
        "_last_look_ns",
        "_limits",
        "_looks",
        "_missed_lately",
        "_missed_look",
        "_notices",
        "_peak_nm",
        "_per_tick2_rad",
        "_previous_angle_rad",
        "_previous_elapsed",
        "_previous_moved_rad",
        "_rate_hz",
        "_rearm_looks",
        "_saturated",
        "_share_near",
        "_share_window",
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
        # A difference of two movements has four readings in it, each half a step wrong.
        self._jump_rad = 2.0 * resolution_rad
        self._jump_warning = _part("encoder jump") * (self._per_tick2_rad + self._jump_rad)
        self._wrench_limits = tuple(limits.sensor_range_percent / 100 * r for r in sensor_range)
        self._wrench_warnings = tuple(_part("wrench range") * w for w in self._wrench_limits)
        self._share_window = SHARE_WINDOW_S * rate_hz
        self._rearm_looks = max(1, round(REARM_S * rate_hz / LOOK_EVERY))
        self._heat_nm2 = 0.0
        self._last_look_ns: int | None = None
        self._looks = 0
        self._warned: dict[str, int] = {}
        self._notices: list[str] = []
        self.tared_nm: float | None = None
        self.reset(0.0)

    @property
    def heat_nm2(self) -> float:
        """Mean square of the motor's torque over its thermal time constant, at the last look."""
        return self._heat_nm2

    @heat_nm2.setter
    def heat_nm2(self, heat_nm2: float) -> None:
        self._heat_nm2 = heat_nm2

    def reset(self, angle_rad: float) -> None:
        """Start from rest at ``angle_rad``; the motor is as warm as it was."""
        self._previous_angle_rad = angle_rad
        self._previous_moved_rad = self._before_that_rad = 0.0
        self._previous_elapsed = self._elapsed = 1
        self._stale_angles = 0
        self._stale_wrenches = 0
        self._saturated = 0
        self._unsure = 0
        self._missed_lately = self._missed_look = 0
        self._share_near = False
        self._slowly_near = False
        self.warning = False

    def skip(self, missed: int) -> None:
        """Tell the next check that ``missed`` ticks passed unseen: the speed is taken over them."""
        self._elapsed += missed
        if missed:
            self._missed_lately = missed + (self._missed_lately if self.after_missed else 0)
            self._missed_look = self._looks

    @property
    def after_missed(self) -> str:
        """Say how many ticks were missed just before, for who reports what came of it; or nothing.

        Just before is within the last 64 to 128 ticks.
        """
        missed = self._missed_lately
        if not missed or self._looks - self._missed_look > 1:
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
        """Check one tick's readings, before they are used.

        Parameters
        ----------
        reference_rad, angle_rad
            Relative to the rig's zero.
        wrench
            fx, fy, fz (N), tx, ty, tz (N·m).
        angle_stale
            The angle is an old one: no speed is taken from it.

        Returns
        -------
        Violation or None
            The worst of what is beyond its limit; `warning` is set if something is near it.
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
        self.warning = self._slowly_near or self._share_near
        self._share_near = False
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
            # The next new angle will have moved over this tick as well.
            self._elapsed += 1
        else:
            readings += self._movement(angle_rad)
        return self._judge(readings)

    def _movement(self, angle_rad: float) -> list[_Reading]:
        """Return speed and jump over the ticks since the last new angle, which is this one now."""
        elapsed, before_rad = self._elapsed, self._previous_moved_rad
        moved_rad = angle_rad - self._previous_angle_rad
        speed_rad_s = moved_rad * self._rate_hz / elapsed
        # A latch may be late by most of a period, and the next one is not: the shaft has then moved
        # for that much longer or shorter.
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
        """Check for how long readings have not come or were at the end of the sensor's range.

        It has to be called in every tick that has such a reading, and in the next. A controller
        that is fed an old angle turns the motor without limit, and neither speed nor tracking error
        would show it.

        Parameters
        ----------
        angle_stale, wrench_stale
            No new angle, or no new wrench, came in this tick.
        saturated
            The wrench is at the end of the sensor's range.
        """
        self._stale_angles = self._stale_angles + 1 if angle_stale else 0
        self._stale_wrenches = self._stale_wrenches + 1 if wrench_stale else 0
        self._saturated = self._saturated + 1 if saturated else 0
        if self._share_near:  # by a wrench alone, which the check of the angle has not seen
            self._share_near, self.warning = False, True
        limits = self._limits
        return self._judge(
            (
                _reading("stale angle", self._stale_angles, limits.stale_ticks_in_a_row),
                _reading("stale wrench", self._stale_wrenches, limits.stale_ticks_in_a_row),
                _reading("gauge saturation", self._saturated, limits.saturated_ticks_in_a_row),
            )
        )

    def check_torque(self, asked_nm: float) -> Violation | None:
        """Check what the controller asks for, wherever it is cut, before it is commanded."""
        limit_nm = self._limits.torque_command_nm
        return self._judge((("torque command", "", "", asked_nm, limit_nm, self._peak_nm),))

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
        return self._judge_share(
            _reading("missed ticks", missed, limits.missed_ticks_in_a_row),
            _reading(
                "missed share", self._percent(missed_so_far, scheduled), limits.missed_percent
            ),
        )

    def check_stale_share(
        self, stale_angles: int, stale_wrenches: int, scheduled: int
    ) -> Violation | None:
        """Check how many readings did not come, after a tick in which one did not.

        No run of them need be long: a drive that answers every third SYNC has none of more than
        two ticks, and yet the loop runs on old angles and the record is worth nothing.

        Parameters
        ----------
        stale_angles, stale_wrenches, scheduled
            Ticks with an old angle, ticks with an old wrench, and ticks scheduled, since the
            record's first.
        """
        limit = self._limits.stale_percent
        return self._judge_share(
            _reading("stale angle share", self._percent(stale_angles, scheduled), limit),
            _reading("stale wrench share", self._percent(stale_wrenches, scheduled), limit),
        )

    def _percent(self, ticks: int, scheduled: int) -> float:
        return 100.0 * ticks / max(scheduled, self._share_window)

    def _judge_share(self, *readings: _Reading) -> Violation | None:
        before, self.warning = self.warning, False
        violation = self._judge(readings)
        # The next sample carries it.
        self._share_near = self._share_near or self.warning
        self.warning = before or self.warning
        return violation

    def look(
        self,
        due_ns: int,
        torque_squares_nm2: float = 0.0,
        recorder_lag_s: float = 0.0,
        disk_free_mb: float = inf,
    ) -> Violation | None:
        """Check what changes slowly; to be called every `LOOK_EVERY` ticks, at rest too.

        Parameters
        ----------
        due_ns
            Time at which the present tick was due.
        torque_squares_nm2
            Sum over the ticks since the last call, of the torques exerted.
        recorder_lag_s
            Time by which the recorder is behind the loop.
        disk_free_mb
            Free space on the disk that holds the session file.
        """
        self._looks += 1
        if self._warned:
            gone = self._looks - self._rearm_looks
            self._warned = {name: last for name, last in self._warned.items() if last >= gone}
        elapsed_s = 0.0 if self._last_look_ns is None else (due_ns - self._last_look_ns) * 1e-9
        self._last_look_ns = due_ns
        self._heat_nm2 = self._heat_nm2 * exp(
            -max(0.0, elapsed_s) / self._time_constant_s
        ) + torque_squares_nm2 / (self._rate_hz * self._time_constant_s)
        before, self.warning = self.warning, False
        violation = self._judge(
            (
                _reading("i²t", sqrt(self._heat_nm2), self._continuous_nm),
                _reading("recorder lag", recorder_lag_s, self._limits.recorder_lag_s),
                _reading("disk space", disk_free_mb, self._limits.disk_free_mb),
            )
        )
        self._slowly_near, self.warning = self.warning, before or self.warning
        return violation

    def check_tare(self, drift_nm: float) -> Violation | None:
        """Check by how much the coupling torque's zero has moved, since the tare before."""
        limit_nm = self._limits.tare_drift_nm
        return self._judge((("tare drift", "", "", drift_nm, limit_nm, self._tare_warning_nm),))

    def take_notices(self) -> list[str]:
        """Return what has come near its limit since the last call, in words for the operator.

        A channel that stays near its limit, or keeps coming back to it, is told once.
        """
        notices, self._notices = self._notices, []
        return notices

    def _judge(self, readings: Sequence[_Reading]) -> Violation | None:
        """Return the reading that is furthest beyond its limit; no number at all is furthest."""
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
            self._warned[channel] = self._looks
        return None

    def _left(self, reading: _Reading) -> Violation:
        """Say what is beyond its limit, and of the beam only what is not the computer's doing."""
        violation, missed = _violation(reading, warns=False), self.after_missed
        if not missed or not BY_NAME[reading[0]].follows_missed_ticks:
            return violation
        if OVERLOADED not in missed:
            missed = f"{missed} {violation.remedy}"
        return replace(violation, remedy=missed)


def _part(name: str) -> float:
    """Part of its limit at which an interlock begins to warn."""
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
