"""Checks of profile and EDS file alone: closed loop, stopping distance, identifiers, sources.

Closed loop: stability, and the margins. The required value depends on what a margin protects
against (see :mod:`rigd.control._margins`). At the angle it is the rule of thumb for the gain of a
feedback loop, a factor of 2. At torque command and torque reading, where the beam is cancelled and
a factor of 2 cannot be had, it is the tolerance of a drive's torque constant and of a calibration,
taken twice: 20 %. The phase margin has to tolerate the largest rotation by such an error (an error
of 20 % across it: 11.5°), together with one period of delay at the second mode (16 Hz: 5.8°): 20°,
rounded up. The delay margin has to tolerate one period more than the profile states: a reading or a
command that is a tick late. A loop that misses this is a warning, not a failure: it is stable as
described, and whether the description is right is what such a session may be for.

Stopping distance: how far the shaft still turns when nothing controls it, because the loop has
failed or runs blind. It is the worst that the limits allow: at the limit of the angle, moving
outwards at the limit of the speed, with the peak torque pushing on. Three things end that, each
after its own time:

* the drive watches over the loop's heartbeat, and misses it when the loop has stopped;
* a loop whose angles do not come goes on with the last one, heartbeat included, and ends the
  session after ``limits.stale_ticks_in_a_row``;
* a loop whose encoder has failed, though its messages are fresh, ends the session by what the
  torques say of the shaft, at full torque within `ENCODER_FAILURE_S`;
* a loop that was delayed reads its sensors again after the ticks it missed, up to
  ``limits.missed_ticks_in_a_row`` of them.

Each is checked by itself, as if the others did not act. Then the shaft coasts to rest, braked by
its friction alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from inspect import signature
from math import degrees, inf, isfinite, isinf, log1p, log10, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING

from rigd.beam import Beam, undamped_frequencies_rad_s
from rigd.beam.realisation import RealisationError
from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.control import ControlDesignError, stable_loop
from rigd.control.contracts import ControllerError
from rigd.control.kinds import CONTROLLERS, make_controller
from rigd.devices import MAY_BE_UNKNOWN, is_simulated_here, unknown_values
from rigd.devices.kinds import DEVICES, selected_kinds
from rigd.devices.parameters import RigParameters
from rigd.excitation import chirp
from rigd.plugins import PluginError, plugin_errors
from rigd.profile import Profile
from rigd.safety import ENCODER_FAILURE_S
from rigd.safety.limits import Limits
from rigd.session.limits import MAX_SAMPLES

# Modules of devices that a rig does not have are not loaded: these checks precede every session.
if TYPE_CHECKING:
    from rigd.control import Margins
    from rigd.devices.canbus import BusLoad
    from rigd.devices.parameters import AtiSerial, Motor

# Closed loop

MIN_TORQUE_GAIN_FACTOR = 1.2
"""Smallest gain margin at torque command and torque reading, as a factor up and down."""
MIN_ANGLE_GAIN_FACTOR = 2.0
"""Smallest gain margin at the angle reading, as a factor up and down."""
MIN_PHASE_MARGIN_RAD = radians(20.0)
"""Smallest phase margin in rad without a warning."""
MIN_DELAY_MARGIN_PERIODS = 1.0
"""Smallest delay margin without a warning, in periods of the loop."""


STABILITY_ROW = "loop_stability"
"""Name of the row on the loop's stability."""


def stability_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the check result on whether the closed loop of a profile's rig is stable."""
    try:
        if not profile.is_loop_modelled:
            yield CheckRow(
                "loop",
                "stability",
                f'not checked: controller "{profile.control.controller}" states no matrices',
                "stable",
                CheckResult.WARNING,
                "Loop: neither stability nor margins are known, and sessions are predicted with "
                "the PID of [control]. Start with a small amplitude.",
                STABILITY_ROW,
            )
            return
        closed_loop, warning_text = stable_loop(profile.loop_model())
    except (ControlDesignError, RealisationError, PluginError) as error:
        yield CheckRow(
            "loop", "stability", str(error), "stable", CheckResult.FAIL, name=STABILITY_ROW
        )
        return
    found_text = f"closed loop stable, slowest pole {closed_loop.growth_per_s:.2g} 1/s"
    yield CheckRow(
        "loop",
        "stability",
        warning_text or found_text,
        "stable",
        grade(fail=False, warn=warning_text is not None),
        name=STABILITY_ROW,
    )


def margin_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield results on the stability margins of the closed loop; skipped if it is unstable."""
    from rigd.control import loop_margins

    skip_reason = ""
    try:
        if profile.is_loop_modelled:
            closed_loop, warning_text = stable_loop(profile.loop_model())
            if warning_text is not None:
                skip_reason = "the loop is not stable"
        else:
            skip_reason = "the controller states no matrices"
    except (ControlDesignError, RealisationError, PluginError):
        skip_reason = "the loop is not stable"
    if skip_reason:
        yield CheckRow("loop", "margins", skip_reason, "", CheckResult.SKIPPED)
        return
    period_s = 1.0 / profile.rig.rate_hz
    for opening_margins in loop_margins(closed_loop):
        min_gain_factor = (
            MIN_ANGLE_GAIN_FACTOR
            if opening_margins.opening == "angle reading"
            else MIN_TORQUE_GAIN_FACTOR
        )
        yield from _margin_rows(
            opening_margins, min_gain_factor, MIN_DELAY_MARGIN_PERIODS * period_s
        )


def _margin_rows(
    margins: "Margins", min_gain_factor: float, min_delay_s: float
) -> Iterator[CheckRow]:
    """Yield check results on the stability margins at one signal of the loop."""
    row_group = f"loop, {margins.opening}"
    gain_up_text = (
        "any"
        if margins.gain_up == inf
        else _with_frequency(_decibels(margins.gain_up), margins.gain_up_hz)
    )
    gain_down_text = (
        "any"
        if margins.gain_down == 0.0
        else _with_frequency(_decibels(margins.gain_down), margins.gain_down_hz)
    )
    yield CheckRow(
        row_group,
        "gain margin",
        f"{gain_down_text} / {gain_up_text}",
        f"{_decibels(1 / min_gain_factor)} / {_decibels(min_gain_factor)}",
        grade(
            fail=False,
            warn=margins.gain_up < min_gain_factor or margins.gain_down > 1 / min_gain_factor,
        ),
    )
    yield CheckRow(
        row_group,
        "phase margin",
        _with_frequency(f"{degrees(margins.phase_rad):.1f}°", margins.phase_hz),
        f"{degrees(MIN_PHASE_MARGIN_RAD):.0f}°",
        grade(fail=False, warn=margins.phase_rad < MIN_PHASE_MARGIN_RAD),
    )
    yield CheckRow(
        row_group,
        "delay margin",
        "any"
        if margins.delay_s == inf
        else _with_frequency(f"{margins.delay_s * 1e3:.2f} ms", margins.delay_hz),
        f"{min_delay_s * 1e3:.2f} ms",
        grade(fail=False, warn=margins.delay_s < min_delay_s),
    )
    yield CheckRow(
        row_group,
        "modulus margin",
        _with_frequency(f"{margins.modulus:.2f}", margins.modulus_hz),
        "",
        CheckResult.OK,
    )


def _decibels(gain: float) -> str:
    """Format a gain factor of the loop in decibels with its sign."""
    return f"{20 * log10(gain):+.1f} dB"


def _with_frequency(value_text: str, frequency_hz: float) -> str:
    """Append a frequency in Hz in brackets to a value's text, unless the frequency is NaN."""
    return value_text if frequency_hz != frequency_hz else f"{value_text} ({frequency_hz:.1f} Hz)"


# Stopping distance

_TIME_STEP_S = 5e-5
"""Time step in seconds of the simulated motion under torque."""
_MAX_STOPPING_DISTANCE_RAD = 100.0
"""Stopping distance in rad above which it counts as infinite."""
_NEGLIGIBLE_VISCOUS_RATIO = 1e-6
"""Ratio of viscous to Coulomb friction torque below which viscous friction is neglected."""
_STOPPING_GROUP = "travel"
"""Group of the rows on the stopping distance."""
_LOOP_FAILS_LABEL = "if the loop fails"
"""Label of the row on the stopping distance after a failure of the loop."""
STOPPING_LOOP_FAILS_ROW = "travel_loop_fails"
"""Name of the row on the stopping distance after the loop has stopped."""
STOPPING_ENCODER_FAILS_ROW = "travel_encoder_fails"
"""Name of the row on the stopping distance after a failure of the encoder."""
STOPPING_NO_ANGLE_ROW = "travel_no_angle"
"""Name of the row on the stopping distance while no new angles arrive."""
STOPPING_MISSED_TICKS_ROW = "travel_missed_ticks"
"""Name of the row on the stopping distance during missed ticks."""


@dataclass(frozen=True, slots=True)
class StoppingDistance:
    """Stopping distance of the shaft after a failure: angle under torque, then while coasting."""

    driven_rad: float
    """Angle that the shaft turns while the torque is still on; infinite above 100 rad."""
    coasting_rad: float
    """Angle that the shaft turns without torque until friction has stopped it.

    It is infinite above 100 rad and without friction."""

    @property
    def total_rad(self) -> float:
        """Angle in rad from the failure until the shaft is at rest."""
        return self.driven_rad + self.coasting_rad


@lru_cache(maxsize=64)
def max_stopping_distance(
    rig: RigParameters, limits: Limits, torque_on_s: float, max_speed_rad_s: float = inf
) -> StoppingDistance:
    """Return the longest stopping distance that the limits allow while nothing controls the shaft.

    Parameters
    ----------
    rig, limits
        Parameters and limits of the profile.
    torque_on_s
        Time for which the torque remains on; infinite if nothing removes it.
    max_speed_rad_s
        Speed above which the drive itself exerts no torque.

    Notes
    -----
    The beam acts in the worst way: it does not brake the motor while the torque is on, and it turns
    with the shaft like a rigid body afterwards.
    """
    if isinf(torque_on_s):
        return StoppingDistance(inf, inf)
    motor, beam = rig.motor, rig.beam
    without_beam_kg_m2 = motor.inertia_kg_m2 + rig.sensor.tool_inertia_kg_m2
    with_beam_kg_m2 = without_beam_kg_m2 + beam.density_kg_per_m * beam.length_m**3 / 3
    speed_rad_s = limits.velocity_rad_s
    under_torque_rad = 0.0
    step_count = round(torque_on_s / _TIME_STEP_S)
    for step_number in range(step_count):
        torque_nm = motor.peak_torque_nm - _friction_nm(rig, speed_rad_s)
        faster_rad_s = max(0.0, speed_rad_s + torque_nm / without_beam_kg_m2 * _TIME_STEP_S)
        previous_rad_s, speed_rad_s = speed_rad_s, min(faster_rad_s, max_speed_rad_s)
        under_torque_rad += 0.5 * (previous_rad_s + speed_rad_s) * _TIME_STEP_S
        if speed_rad_s == previous_rad_s:  # it goes on like this
            under_torque_rad += speed_rad_s * (step_count - 1 - step_number) * _TIME_STEP_S
            break
        if under_torque_rad > _MAX_STOPPING_DISTANCE_RAD:
            break
    if under_torque_rad > _MAX_STOPPING_DISTANCE_RAD:
        return StoppingDistance(inf, inf)
    coasting_rad = _coasting_rad(with_beam_kg_m2, motor, speed_rad_s)
    return StoppingDistance(
        under_torque_rad, coasting_rad if coasting_rad <= _MAX_STOPPING_DISTANCE_RAD else inf
    )


def _coasting_rad(inertia_kg_m2: float, motor: "Motor", speed_rad_s: float) -> float:
    """Return the angle in rad in which friction alone stops a rotating inertia.

    It is infinite if there is no friction.
    """
    viscous_nm_s_per_rad, coulomb_nm = motor.viscous_nm_s_per_rad, motor.coulomb_nm
    viscous_ratio = viscous_nm_s_per_rad * speed_rad_s / coulomb_nm if coulomb_nm > 0.0 else inf
    if viscous_ratio < _NEGLIGIBLE_VISCOUS_RATIO:
        return 0.5 * inertia_kg_m2 * speed_rad_s**2 / coulomb_nm
    if viscous_nm_s_per_rad == 0.0:
        return inf if speed_rad_s > 0.0 else 0.0
    coulomb_correction = log1p(viscous_ratio) / viscous_ratio if isfinite(viscous_ratio) else 0.0
    return inertia_kg_m2 * speed_rad_s / viscous_nm_s_per_rad * (1.0 - coulomb_correction)


@dataclass(frozen=True, slots=True)
class _UncontrolledFailure:
    """A failure after which the torque remains on for a time while nothing controls the shaft."""

    name: str
    """Name of the check's row."""
    what: str
    """Condition of the failure, as a clause for the operator ("if the encoder fails")."""
    duration_s: float
    """Longest time for which the torque remains on."""
    ended_by: str
    """Limit or watchdog that removes the torque, with its key, as text for the operator."""
    key: str
    """Key of the profile that determines the duration."""


def _uncontrolled_failures(profile: Profile) -> tuple[_UncontrolledFailure, ...]:
    """Return the failures after which the torque remains on for a time without control."""
    rig, limits, drive_settings = profile.rig, profile.limits, profile.rig.cia402
    assert drive_settings is not None
    stale_ticks, missed_ticks = limits.stale_ticks_in_a_row, limits.missed_ticks_in_a_row
    own_watchdog = drive_settings.watchdog_s > drive_settings.heartbeat_timeout_s
    watchdog_key = "cia402.own_watchdog_s" if own_watchdog else "cia402.heartbeat_timeout_s"
    return (
        _UncontrolledFailure(
            STOPPING_LOOP_FAILS_ROW,
            _LOOP_FAILS_LABEL,
            drive_settings.watchdog_s,
            f"of the drive's watchdog ({watchdog_key})",
            watchdog_key,
        ),
        # The tick that finds one old angle too many removes the torque, after the command's delay.
        _UncontrolledFailure(
            STOPPING_NO_ANGLE_ROW,
            "if no angle comes",
            (stale_ticks + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {stale_ticks} old angles (limits.stale_ticks_in_a_row)",
            "limits.stale_ticks_in_a_row",
        ),
        _UncontrolledFailure(
            STOPPING_ENCODER_FAILS_ROW,
            "if the encoder fails",
            ENCODER_FAILURE_S + 2 / rig.rate_hz + rig.actuation.delay_s,
            "of the encoder watch",
            "limits.standstill_torque_nm",
        ),
        _UncontrolledFailure(
            STOPPING_MISSED_TICKS_ROW,
            "if ticks are missed",
            (missed_ticks + 1) / rig.rate_hz + rig.actuation.delay_s,
            f"of {missed_ticks} missed ticks (limits.missed_ticks_in_a_row)",
            "limits.missed_ticks_in_a_row",
        ),
    )


def stopping_distance_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield results that compare the stopping distance after each failure with the free angle.

    The free angle is that between the limit of the angle and the mechanical stop.
    """
    rig, limits, drive_settings = profile.rig, profile.limits, profile.rig.cia402
    if drive_settings is None:
        skip_reason = "the drive is part of this program and ends with it"
        yield CheckRow(
            _STOPPING_GROUP,
            _LOOP_FAILS_LABEL,
            skip_reason,
            "",
            CheckResult.SKIPPED,
            name=STOPPING_LOOP_FAILS_ROW,
        )
        return
    uncontrolled_failures = _uncontrolled_failures(profile)
    margin_rad = limits.stop_angle_rad - limits.angle_rad
    bound_text = f"at most {margin_rad:.2f} rad (limits.stop_angle_rad - limits.angle_rad)"
    has_no_bound = isinf(drive_settings.watchdog_s)
    if has_no_bound:
        uncontrolled_failures = tuple(
            uncontrolled_failure
            for uncontrolled_failure in uncontrolled_failures
            if not isinf(uncontrolled_failure.duration_s)
        )
        yield CheckRow(
            _STOPPING_GROUP,
            f"worst, {_LOOP_FAILS_LABEL}",
            "without bound: the profile accepts a drive without a watchdog",
            bound_text,
            CheckResult.WARNING,
            f"Travel {_LOOP_FAILS_LABEL}: nothing but the wired stop ends it "
            '(cia402.accept_without = ["watchdog"]).',
            STOPPING_LOOP_FAILS_ROW,
        )
    has_speed_limit = drive_settings.max_speed_rad_s > 0
    highest_rad_s = drive_settings.max_speed_rad_s if has_speed_limit else inf
    travels = [
        max_stopping_distance(rig, limits, uncontrolled_failure.duration_s, highest_rad_s)
        for uncontrolled_failure in uncontrolled_failures
    ]
    longest_index = max(
        range(len(uncontrolled_failures)),
        key=lambda failure_index: travels[failure_index].total_rad,
    )
    for failure_index, (uncontrolled_failure, stopping_travel) in enumerate(
        zip(uncontrolled_failures, travels, strict=True)
    ):
        exceeds_margin = not stopping_travel.total_rad <= margin_rad
        detail_text = ""
        if failure_index == longest_index:
            unlimited_failures = max_stopping_distance(rig, limits, uncontrolled_failure.duration_s)
            detail_text = (
                "" if has_no_bound else f"Travel: the worst is {uncontrolled_failure.what}. "
            )
            detail_text += (
                "It relies on the drive's own speed limit of "
                f"{drive_settings.max_speed_rad_s:g} rad/s "
                "(object 6080); without it, it would be "
                f"{_format_angle(unlimited_failures.total_rad)}."
                if has_speed_limit
                else "The drive's own speed limit (object 6080) is not set; "
                "cia402.max_speed_rad_s shortens it."
            )
        if exceeds_margin:
            detail_text += (
                f" Travel {uncontrolled_failure.what}: lower {uncontrolled_failure.key}, "
                "cia402.max_speed_rad_s, "
                "limits.velocity_rad_s or limits.angle_rad."
            )
        worst_failure = "worst, " if failure_index == longest_index and not has_no_bound else ""
        yield CheckRow(
            _STOPPING_GROUP,
            f"{worst_failure}{uncontrolled_failure.what}",
            f"{_format_angle(stopping_travel.total_rad)}: "
            f"{_format_angle(stopping_travel.driven_rad)} in the "
            f"{uncontrolled_failure.duration_s * 1e3:g} ms {uncontrolled_failure.ended_by}, "
            f"{_format_angle(stopping_travel.coasting_rad)} coasting",
            bound_text,
            grade(fail=exceeds_margin),
            detail_text.strip(),
            uncontrolled_failure.name,
        )


def _format_angle(angle_rad: float) -> str:
    """Format an angle in rad; an infinite one as "more than 100 rad"."""
    return (
        f"more than {_MAX_STOPPING_DISTANCE_RAD:g} rad"
        if isinf(angle_rad)
        else f"{angle_rad:.2f} rad"
    )


def _friction_nm(rig: RigParameters, speed_rad_s: float) -> float:
    """Return the friction torque of the motor at a speed in N·m."""
    return rig.motor.viscous_nm_s_per_rad * speed_rad_s + rig.motor.coulomb_nm


# EDS file

EDS_ROW = "eds"
"""Name of the rows on the drive's EDS file."""


def eds_rows(path: Path, rig: RigParameters | None) -> Iterator[CheckRow]:
    """Yield the check results that compare a drive's EDS file with the requirements on a drive.

    Parameters
    ----------
    path
        Path of the EDS file.
    rig
        Parameters of the rig in which the drive is to be used, or None for any rig.
    """
    from rigd.devices.cia402 import Grade, check_suitability
    from rigd.devices.eds import EdsError, read_eds

    result_by_grade = {
        Grade.FITS: CheckResult.OK,
        Grade.SUBSTITUTED: CheckResult.OK,
        Grade.ASK: CheckResult.SKIPPED,
        Grade.ACCEPTED: CheckResult.WARNING,
        Grade.DOUBT: CheckResult.WARNING,
        Grade.REFUSED: CheckResult.FAIL,
    }
    try:
        node_id = rig.cia402.node_id if rig is not None and rig.cia402 is not None else 1
        eds = read_eds(path, node_id)
    except EdsError as error:
        yield CheckRow("EDS", "file", str(error), "", CheckResult.FAIL, name=EDS_ROW)
        return
    yield CheckRow("EDS", "file", str(path), "", CheckResult.OK, name=EDS_ROW)
    for finding in check_suitability(eds, rig).findings:
        yield CheckRow(
            "EDS",
            finding.what,
            finding.found,
            finding.wanted,
            result_by_grade[finding.grade],
            finding.sentence,
            EDS_ROW,
        )


def drive_file_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield check results on the EDS file that the profile names; none if it names no file."""
    drive_settings = profile.rig.cia402
    if drive_settings is not None and drive_settings.eds:
        yield from eds_rows(Path(drive_settings.eds), profile.rig)


# Profile and wiring

HIGH_BUS_LOAD = 0.7
"""Bus load, as a fraction, above which there is a warning.

An additional device, or repeated frames after a disturbance, would not fit."""


def profile_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield check results on the profile's name and its assumed, not verified, numbers."""
    yield CheckRow("profile", profile.name, str(profile.path), "", CheckResult.OK)
    assumed_keys = [
        key for key, number_source in profile.sources.items() if number_source == "assumed"
    ]
    yield CheckRow(
        "profile",
        "unverified profile values",
        f"{len(assumed_keys)} of {len(profile.sources)}",
        "none",
        grade(fail=False, warn=bool(assumed_keys)),
        f"Assumed: {', '.join(assumed_keys)}." if assumed_keys else "",
    )


def record_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the result on the longest possible record, and whether a default chirp fits into it."""
    chirp_parameters = signature(chirp).parameters
    limit_text = f"no more than {MAX_SAMPLES} samples can be analysed, exported or replayed"
    default_chirp_s = sum(
        float(chirp_parameters[parameter_name].default)
        for parameter_name in ("rest_s", "duration_s", "ring_down_s")
    )
    longest_s = MAX_SAMPLES / profile.rig.rate_hz
    yield CheckRow(
        "profile",
        "longest record",
        f"{longest_s:g} s at {profile.rig.rate_hz:g} Hz",
        f"{default_chirp_s:g} s (run chirp)",
        grade(fail=False, warn=longest_s < default_chirp_s),
        f"A chirp of {default_chirp_s:g} s is refused: {limit_text}."
        if longest_s < default_chirp_s
        else "",
    )


_GRAVITY_M_PER_S2 = 9.81
"""Gravitational acceleration in m/s²."""
_AXIAL_LOAD_COEFFICIENT = 1.5709
"""Stiffness that the beam's axial weight adds to mode 1, over its modal mass, in units of g/L.

It is Rayleigh's quotient of a clamped-free beam: the integral of (1 - x) φ'(x)² over that of φ(x)²,
x from 0 to 1."""
_EXAMPLE_TILT_DEG = 0.5
"""Inclination in degrees of the example in the advice on the axis."""


def axis_tilt_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the result on the measured inclination of the motor's axis; it refuses no session."""
    if is_simulated_here(profile.rig):
        found_text, detail_text, check_result = (
            "the simulated rig has no gravity",
            "",
            CheckResult.SKIPPED,
        )
    elif profile.axis_tilt_deg is None:
        found_text, check_result = "not known", CheckResult.WARNING
        shift_percent = _tilt_shift_percent(profile.rig.beam, _EXAMPLE_TILT_DEG)
        detail_text = (
            "Axis plumb: gravity along the beam shifts its modes, mode 1 by "
            f"{shift_percent:.2g} % for "
            f"{_EXAMPLE_TILT_DEG:g}°, which an analysis can mistake for damping or for a mass at "
            "the tip. Measure the inclination of the motor's flange along the resting beam with a "
            "level, and state it as rig.axis_tilt_deg (positive: the tip is lower)."
        )
    else:
        shift_percent = _tilt_shift_percent(profile.rig.beam, profile.axis_tilt_deg)
        found_text = f"{profile.axis_tilt_deg:g}° off, mode 1 shifted by {shift_percent:+.2g} %"
        detail_text, check_result = "", CheckResult.OK
    yield CheckRow("profile", "axis plumb", found_text, "measured", check_result, detail_text)


def _tilt_shift_percent(beam: Beam, tilt_deg: float) -> float:
    """Return the first-order change in per cent of mode 1's frequency by gravity along the beam."""
    first_rad_s = undamped_frequencies_rad_s(beam, 1)[0]
    axial_gravity_m_per_s2 = _GRAVITY_M_PER_S2 * sin(radians(tilt_deg))
    relative_shift = (
        _AXIAL_LOAD_COEFFICIENT * axial_gravity_m_per_s2 / (2.0 * beam.length_m * first_rad_s**2)
    )
    return float(100.0 * relative_shift)


UNKNOWN_VALUES_ROW = "unknown_values"
"""Name of the rows on required values that the profile states as unknown."""


def unknown_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield a failed row for each value that every session needs and the profile lacks."""
    for key in unknown_values(profile.rig):
        remedy_text = f"{key}: enter its value in {profile.path} ({MAY_BE_UNKNOWN[key]})."
        yield CheckRow(
            "profile", key, "unknown", "a value", CheckResult.FAIL, remedy_text, UNKNOWN_VALUES_ROW
        )


CAN_IDENTIFIERS_ROW, CAN_LOAD_ROW, SERIAL_LOAD_ROW = "can_identifiers", "can_load", "serial_load"
"""Names of the rows on colliding CAN identifiers, on the bus load, and on the serial line's load.
"""


def wiring_rows(rig: RigParameters) -> Iterator[CheckRow]:
    """Yield results on the CAN identifiers and on the load of the CAN bus and the serial line."""
    if rig.can is not None:
        from rigd.devices.canbus import bus_load, check_identifiers

        collisions = check_identifiers(rig)
        for id_collision in collisions:
            yield _identifier_row(id_collision, CheckResult.FAIL)
        if not collisions:
            yield _identifier_row("no collision", CheckResult.OK)
        yield _bus_row(bus_load(rig), rig.can.bitrate_bit_s)
    if rig.ati_serial is not None:
        yield _line_row(rig.ati_serial)


DEVICE_ROW = "device_settings"
"""Name of the rows that installed packages add for their devices."""


def added_device_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the rows that the kinds of the profile's devices declare."""
    for kind in selected_kinds(profile.rig.devices):
        owner = DEVICES.owner(kind.name)
        if owner is not None:
            yield CheckRow("devices", kind.name, owner.label, "", CheckResult.OK)
        if kind.check_rows is not None:
            with plugin_errors(owner):
                for row in kind.check_rows(profile.rig):
                    yield replace(row, name=DEVICE_ROW)


CONTROLLER_ROW = "controller"
"""Name of the rows on the controller that an installed package adds."""
_LARGEST_START_FRACTION = 1e-6
"""Largest torque of a controller at rest, as a fraction of the motor's peak torque."""


def added_controller_rows(profile: Profile) -> Iterator[CheckRow]:
    """Yield the rows on the controller of an installed package; none for the shipped one."""
    name = profile.control.controller
    owner = CONTROLLERS.owner(name)
    if owner is None:
        return
    yield CheckRow("controller", name, owner.label, "", CheckResult.OK)
    rig = profile.controlled_rig()
    row_label, wanted_text = "torque after a reset", "0 N·m"
    try:
        start_torques_nm = []
        controller = make_controller(rig)
        for start_rad in (0.0, profile.limits.angle_rad):
            controller.reset(start_rad)
            controller.step(start_rad, start_rad, 0.0)
            start_torques_nm.append(abs(controller.unlimited_torque_nm))
        kind = CONTROLLERS.load(owner)
        with plugin_errors(owner):
            declared_rows = () if kind.check_rows is None else tuple(kind.check_rows(rig))
    except (ControllerError, ControlDesignError, PluginError) as error:
        yield CheckRow(
            "controller", row_label, str(error), wanted_text, CheckResult.FAIL, name=CONTROLLER_ROW
        )
        return
    largest_nm = max(start_torques_nm)
    yield CheckRow(
        "controller",
        row_label,
        f"{largest_nm:.3g} N·m",
        wanted_text,
        grade(fail=not largest_nm <= _LARGEST_START_FRACTION * rig.torque_limit_nm),
        name=CONTROLLER_ROW,
    )
    for row in declared_rows:
        yield replace(row, name=CONTROLLER_ROW)


def _identifier_row(found_text: str, check_result: CheckResult) -> CheckRow:
    """Return the check result on the CAN identifiers."""
    return CheckRow(
        "CAN bus", "identifiers", found_text, "no collision", check_result, name=CAN_IDENTIFIERS_ROW
    )


def _bus_row(bus_load: "BusLoad", bitrate_bit_s: int) -> CheckRow:
    """Return the check result on the load of the CAN bus."""
    from rigd.devices.canbus import MAX_LOAD

    frames_text = ", ".join(
        f"{t.what} ({t.can_id:#05x}, {t.length} bytes, {t.rate_hz:g} Hz)" for t in bus_load.traffic
    )
    return CheckRow(
        "CAN bus",
        "load",
        f"{100 * bus_load.worst:.1f} % at worst, {100 * bus_load.plain:.1f} % without stuffing",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=bus_load.worst > MAX_LOAD, warn=bus_load.worst > HIGH_BUS_LOAD),
        f"At {bitrate_bit_s / 1e3:g} kbit/s: {frames_text}.",
        CAN_LOAD_ROW,
    )


def _line_row(serial_settings: "AtiSerial") -> CheckRow:
    """Return the check result on the load of the serial line."""
    from rigd.devices.ati import RECORD_BITS
    from rigd.devices.canbus import MAX_LOAD

    line_load = RECORD_BITS * serial_settings.stream_hz / serial_settings.baud
    return CheckRow(
        "serial line",
        "load",
        f"{100 * line_load:.1f} % of {serial_settings.baud} bit/s",
        f"at most {100 * MAX_LOAD:.0f} %",
        grade(fail=line_load > MAX_LOAD),
        name=SERIAL_LOAD_ROW,
    )
