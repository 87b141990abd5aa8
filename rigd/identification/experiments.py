"""Excitations of the sessions that identify a motor: passes at constant speed, with a multisine.

Friction changes in an unknown way when a motor reverses: sticking, wind-up, backlash. Therefore
the shaft moves to and fro at constant speed, with smooth turns, and the estimate uses the inside
of each pass, where the speed does not change sign and Coulomb friction is constant. The multisine
is added to fast passes and changes their speed by at most half. All cycles of passes are the same,
except for an offset of some encoder steps, so that cycles can be averaged and their scatter
estimated.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import ceil, floor, pi

import numpy as np
from numpy.typing import NDArray

from rigd.control import ClosedLoop, close_loop
from rigd.excitation import Excitation, ExcitationError
from rigd.profile import Profile

RealArray = NDArray[np.float64]

TRIAL_EXCITATION = "motor-trial"
"""Name of the excitation of the short session that precedes the other sessions."""
MULTISINE_EXCITATION = "motor-multisine"
"""Name of the excitation with a multisine on fast passes."""
SPEEDS_EXCITATION = "motor-speeds"
"""Name of the excitation with passes at four constant speeds."""

HIGHEST_FREQUENCY_HZ = {TRIAL_EXCITATION: 33.0, MULTISINE_EXCITATION: 33.0, SPEEDS_EXCITATION: 3.4}
"""Highest frequency in Hz of the shaft's or the beam's motion, by the name of the excitation."""

_MAX_PASS_SPEED_RAD_S = 1.0
"""Largest speed of a pass in rad/s."""
_SPEED_LIMIT_FRACTION = 0.5
"""Largest speed of a pass as a fraction of the profile's speed limit.

The remainder is reserved for the multisine and for errors of the motor's data."""
_USED_STROKE_FRACTION = 0.93
"""Fraction of the stroke that the passes use.

The remainder is reserved for multisine, offsets and overshoot."""
_RELATIVE_PASS_SPEEDS = (0.1, 0.3, 0.6, 1.0)
"""Speeds of the passes of the excitation `SPEEDS_EXCITATION`, relative to the fastest pass."""
_SPEED_MODULATION = {TRIAL_EXCITATION: 0.2, MULTISINE_EXCITATION: 0.5}
"""Largest change of a pass's speed by the multisine, as a fraction, for each excitation.

It is small in the trial, in which the motor's data are uncertain: the speed must not reverse even
if the inertia is a quarter of that stated in the profile."""
_CYCLE_COUNTS = {TRIAL_EXCITATION: 6, MULTISINE_EXCITATION: 16, SPEEDS_EXCITATION: 5}
"""Number of cycles of passes for each excitation."""
_MULTISINE_BAND_HZ = (1.6, 32.0)
"""Lowest and highest frequency of the multisine in Hz.

In this band, the beam's clamped-free modes make the beam's torque differ from that of an inertia,
so that the scale of the motor's torque is identifiable. Above 32 Hz, the encoder's steps hide the
acceleration."""
_MIN_MULTISINE_FRACTION = 0.1
"""Smallest accepted factor by which the multisine is reduced to respect the torque limit."""
_OFFSET_RANGE_ENCODER_STEPS = 40.0
"""Range of the offsets of the cycles, in encoder steps.

It is so large that the encoder's rounding errors do not repeat from cycle to cycle."""
_GOLDEN_FRACTION = 0.618033988749895
"""Golden ratio minus 1, whose multiples modulo 1 are evenly distributed."""


@dataclass(frozen=True, slots=True)
class PassSchedule:
    """Speeds and durations of the passes of a session, which define its motion.

    Each pass consists of a turn, a settling time, and the window that is evaluated.
    """

    speeds_rad_s: tuple[float, ...]
    """Speeds of the passes of a cycle; each speed is run forward, then back."""
    cycles: int
    """Number of cycles in the session."""
    rest_s: float = 0.5
    """Duration of the rest at the beginning."""
    approach_s: float = 2.0
    """Duration of the motion to the angle at which the passes begin."""
    turn_s: float = 0.4
    """Duration of the turn before each pass."""
    settle_s: float = 0.15
    """Duration of the settling time after each turn."""
    window_s: float = 1.2
    """Duration of the evaluated window of a pass."""
    end_s: float = 0.5
    """Duration of the rest at the end."""


@dataclass(frozen=True, slots=True)
class SpeedPass:
    """Evaluated window of a pass at constant nominal speed."""

    first_tick: int
    """First tick of the window."""
    end_tick: int
    """Tick after the last one of the window."""
    speed_rad_s: float
    """Nominal speed of the pass, with its sign."""
    cycle_index: int
    """Index of the pass's cycle, from 0."""


def passes_of_schedule(schedule: PassSchedule, rate_hz: float) -> list[SpeedPass]:
    """Return the evaluated window of each pass of a session, in order of time.

    Parameters
    ----------
    schedule
        Schedule of the session.
    rate_hz
        Rate of the samples.
    """
    turn_ticks, settle_ticks, window_ticks = (
        round(time_s * rate_hz)
        for time_s in (schedule.turn_s, schedule.settle_s, schedule.window_s)
    )
    start_tick = round(schedule.rest_s * rate_hz) + round(schedule.approach_s * rate_hz)
    speed_passes = []
    for cycle_number in range(schedule.cycles):
        for speed_rad_s in schedule.speeds_rad_s:
            for signed_speed_rad_s in (speed_rad_s, -speed_rad_s):
                start_tick += turn_ticks + settle_ticks
                speed_passes.append(
                    SpeedPass(
                        start_tick, start_tick + window_ticks, signed_speed_rad_s, cycle_number
                    )
                )
                start_tick += window_ticks
    return speed_passes


def trial_excitation(profile: Profile, *, torque_percent: float, stroke_rad: float) -> Excitation:
    """Return the excitation of the trial, a short session with little speed modulation.

    The controller of the other sessions is designed from the estimate of the trial. The excitation
    and its errors are otherwise those of `multisine_excitation`.

    Parameters
    ----------
    profile
        Profile of the rig.
    torque_percent, stroke_rad
        Limits of torque and angle as for `multisine_excitation`.
    """
    return _passes_with_multisine(TRIAL_EXCITATION, profile, torque_percent, stroke_rad)


def multisine_excitation(
    profile: Profile, *, torque_percent: float, stroke_rad: float
) -> Excitation:
    """Return passes to and fro with a multisine that is scaled to the allowed torque.

    The predicted speed has equal amplitudes at all harmonics of the window, with the phases of
    M. R. Schroeder (IEEE Trans. Inf. Theory 16 (1970) 85).

    Parameters
    ----------
    profile
        Profile of the rig; its loop shapes the reference and predicts the peaks.
    torque_percent
        Largest allowed torque, as predicted, in percent of the motor's rated torque.
    stroke_rad
        Largest allowed angle, as predicted, to each side of the start.

    Raises
    ------
    ExcitationError
        If an option is out of range or too little torque is left for the multisine.
    ControlDesignError
        If the profile's loop cannot be closed.
    """
    return _passes_with_multisine(MULTISINE_EXCITATION, profile, torque_percent, stroke_rad)


def _passes_with_multisine(
    excitation_name: str, profile: Profile, torque_percent: float, stroke_rad: float
) -> Excitation:
    """Return the excitation of the trial or of the multisine: passes with a multisine."""
    allowed_torque_nm = _torque_limit(profile, torque_percent)
    closed_loop = close_loop(profile.loop_model())
    pass_schedule = _fit_schedule(excitation_name, (1.0,), profile, stroke_rad)
    passes_reference_rad = _passes_reference(pass_schedule, profile)
    multisine_rad = _multisine_reference(
        pass_schedule, closed_loop, _SPEED_MODULATION[excitation_name]
    )
    passes_peak_torque_nm = _peak_torque(closed_loop, passes_reference_rad)
    peak_torque_nm = _peak_torque(closed_loop, passes_reference_rad + multisine_rad)
    multisine_fraction = 1.0
    if peak_torque_nm > allowed_torque_nm:
        # The peak is a convex function of the fraction, below the straight line between the two.
        multisine_fraction = (allowed_torque_nm - passes_peak_torque_nm) / (
            peak_torque_nm - passes_peak_torque_nm
        )
    if multisine_fraction < _MIN_MULTISINE_FRACTION:
        sufficient_torque_nm = passes_peak_torque_nm + _MIN_MULTISINE_FRACTION * (
            peak_torque_nm - passes_peak_torque_nm
        )
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: of {allowed_torque_nm:.3g} N·m the passes alone "
            f"take {passes_peak_torque_nm:.3g} N·m, and too little is left for the multisine; "
            f"allow at least {_rounded_torque_percent(profile, sufficient_torque_nm)} % or a "
            "shorter --stroke-rad."
        )
    return _checked_excitation(
        excitation_name,
        pass_schedule,
        profile,
        closed_loop,
        passes_reference_rad + multisine_fraction * multisine_rad,
        torque_percent,
        stroke_rad,
    )


def constant_speeds_excitation(
    profile: Profile, *, torque_percent: float, stroke_rad: float
) -> Excitation:
    """Return passes to and fro at four constant speeds.

    Parameters
    ----------
    profile
        Profile of the rig.
    torque_percent, stroke_rad
        Limits of torque and angle as for `multisine_excitation`.

    Raises
    ------
    ExcitationError
        If an option is out of range, or the turns need more torque than allowed.
    ControlDesignError
        If the profile's loop cannot be closed.
    """
    torque_limit_nm = _torque_limit(profile, torque_percent)
    closed_loop = close_loop(profile.loop_model())
    pass_schedule = _fit_schedule(SPEEDS_EXCITATION, _RELATIVE_PASS_SPEEDS, profile, stroke_rad)
    reference_rad = _passes_reference(pass_schedule, profile)
    peak_torque_nm = _peak_torque(closed_loop, reference_rad)
    if peak_torque_nm > torque_limit_nm:
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: the turns take {peak_torque_nm:.3g} N·m and "
            f"only {torque_limit_nm:.3g} N·m are allowed; allow at least "
            f"{_rounded_torque_percent(profile, peak_torque_nm)} % or a shorter --stroke-rad."
        )
    return _checked_excitation(
        SPEEDS_EXCITATION,
        pass_schedule,
        profile,
        closed_loop,
        reference_rad,
        torque_percent,
        stroke_rad,
    )


def read_schedule(metadata: Mapping[str, str]) -> PassSchedule | None:
    """Return the schedule in the metadata of a session, or None for any other excitation."""
    if metadata.get("excitation") not in HIGHEST_FREQUENCY_HZ:
        return None
    try:
        speeds_rad_s = tuple(float(speed_text) for speed_text in metadata["speeds_rad_s"].split())
        durations_s = {field_name: float(metadata[field_name]) for field_name in _DURATION_FIELDS}
        return PassSchedule(speeds_rad_s, int(metadata["cycles"]), **durations_s)
    except (KeyError, ValueError):
        return None


_DURATION_FIELDS = ("rest_s", "approach_s", "turn_s", "settle_s", "window_s", "end_s")
"""Fields of `PassSchedule` that are durations."""


def _torque_limit(profile: Profile, torque_percent: float) -> float:
    """Return the allowed motor torque in N·m; raise ExcitationError for an invalid percentage."""
    if not 0.0 < torque_percent <= 100.0:
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: must be more than 0 and at most 100 % of the "
            "rated torque."
        )
    return torque_percent / 100 * profile.rig.motor.rated_torque_nm


def _rounded_torque_percent(profile: Profile, torque_nm: float) -> int:
    """Return a torque plus a margin of 1 %, in percent of the rated torque, rounded up."""
    return ceil(101 * torque_nm / profile.rig.motor.rated_torque_nm)


def _fit_schedule(
    excitation_name: str, relative_speeds: tuple[float, ...], profile: Profile, stroke_rad: float
) -> PassSchedule:
    """Return a schedule whose passes are as fast as stroke and speed limit allow.

    `relative_speeds` are the speeds of a cycle relative to the fastest.
    """
    limits = profile.limits
    if not 0.0 < stroke_rad <= limits.angle_rad:
        raise ExcitationError(
            f"--stroke-rad {stroke_rad:g}: must be more than 0 and at most limits.angle_rad = "
            f"{limits.angle_rad:g} rad."
        )
    cycle_count = _CYCLE_COUNTS[excitation_name]
    travel_per_speed_s = float(
        np.ptp(_passes_path(PassSchedule(relative_speeds, 1), profile.rig.rate_hz))
    )
    max_pass_speed_rad_s = min(
        _MAX_PASS_SPEED_RAD_S,
        _SPEED_LIMIT_FRACTION * limits.velocity_rad_s,
        2 * _USED_STROKE_FRACTION * stroke_rad / travel_per_speed_s,
    )
    return PassSchedule(
        tuple(relative_speed * max_pass_speed_rad_s for relative_speed in relative_speeds),
        cycle_count,
    )


def _passes_path(schedule: PassSchedule, rate_hz: float) -> RealArray:
    """Return the angle in rad at each tick of all passes, relative to the end of the approach."""
    turn_ticks, settle_ticks, window_ticks = (
        round(time_s * rate_hz)
        for time_s in (schedule.turn_s, schedule.settle_s, schedule.window_s)
    )
    speed_rise = _smooth_rise(np.arange(turn_ticks) / turn_ticks)
    speed_segments: list[RealArray] = []
    previous_speed = 0.0
    for pass_speed in [s for v in schedule.speeds_rad_s for s in (v, -v)] * schedule.cycles:
        speed_segments.append(previous_speed + (pass_speed - previous_speed) * speed_rise)
        speed_segments.append(np.full(settle_ticks + window_ticks, pass_speed))
        previous_speed = pass_speed
    speed_segments.append(previous_speed * (1.0 - speed_rise))
    speed_samples = np.concatenate(speed_segments)
    path_rad: RealArray = (
        np.concatenate([[0.0], np.cumsum(0.5 * (speed_samples[1:] + speed_samples[:-1]))]) / rate_hz
    )
    return path_rad


def _passes_reference(schedule: PassSchedule, profile: Profile) -> RealArray:
    """Return the reference angle in rad without a multisine: rest, approach, passes, end."""
    rate_hz = profile.rig.rate_hz
    path_rad = _passes_path(schedule, rate_hz)
    path_rad -= 0.5 * (path_rad.max() + path_rad.min())
    rest_ticks, approach_ticks, end_ticks = (
        round(time_s * rate_hz) for time_s in (schedule.rest_s, schedule.approach_s, schedule.end_s)
    )
    approach_rad = path_rad[0] * _smooth_rise(np.arange(approach_ticks) / approach_ticks)
    reference_rad = np.concatenate(
        [np.zeros(rest_ticks), approach_rad, path_rad, np.full(end_ticks, path_rad[-1])]
    )
    _add_offsets(reference_rad, schedule, profile)
    return reference_rad


def _add_offsets(reference_rad: RealArray, schedule: PassSchedule, profile: Profile) -> None:
    """Add a different offset of some encoder steps to each cycle of a reference angle, in place.

    The offset changes in the turn before the cycle.
    """
    rate_hz = profile.rig.rate_hz
    turn_ticks = round(schedule.turn_s * rate_hz)
    ticks_before_window = round((schedule.turn_s + schedule.settle_s) * rate_hz)
    offset_rise = _smooth_rise(np.arange(turn_ticks) / turn_ticks)
    offset_rad = 0.0
    last_cycle = -1
    for speed_pass in passes_of_schedule(schedule, rate_hz):
        if speed_pass.cycle_index == last_cycle:
            continue
        last_cycle = speed_pass.cycle_index
        cycle_fraction = _GOLDEN_FRACTION * (last_cycle + 1)
        next_offset_rad = (
            _OFFSET_RANGE_ENCODER_STEPS
            * profile.rig.encoder.resolution_rad
            * (cycle_fraction - floor(cycle_fraction) - 0.5)
        )
        first_sample = speed_pass.first_tick - ticks_before_window
        reference_rad[first_sample : first_sample + turn_ticks] += (
            next_offset_rad - offset_rad
        ) * offset_rise
        reference_rad[first_sample + turn_ticks :] += next_offset_rad - offset_rad
        offset_rad = next_offset_rad


def _multisine_reference(
    schedule: PassSchedule, closed_loop: ClosedLoop, speed_modulation: float
) -> RealArray:
    """Return the reference angle in rad of the multisine alone.

    In response to it, the loop changes the speed of the passes by at most the fraction
    `speed_modulation`.
    """
    rate_hz = closed_loop.model.rate_hz
    window_ticks = round(schedule.window_s * rate_hz)
    step_hz = rate_hz / window_ticks
    harmonic_numbers = np.arange(
        ceil(_MULTISINE_BAND_HZ[0] / step_hz), floor(_MULTISINE_BAND_HZ[1] / step_hz) + 1
    )
    frequency_hz = harmonic_numbers.astype(np.float64) * step_hz
    phases_rad = (
        -pi
        * np.arange(harmonic_numbers.size)
        * np.arange(1, harmonic_numbers.size + 1)
        / harmonic_numbers.size
    )
    speed_spectrum = np.zeros(window_ticks // 2 + 1, dtype=complex)
    speed_spectrum[harmonic_numbers] = np.exp(1j * phases_rad)
    peak_speed = float(np.max(np.abs(np.fft.irfft(speed_spectrum, window_ticks))))
    speed_spectrum *= speed_modulation * schedule.speeds_rad_s[0] / peak_speed
    reference_spectrum = np.zeros_like(speed_spectrum)
    reference_spectrum[harmonic_numbers] = (
        speed_spectrum[harmonic_numbers]
        / (2j * pi * frequency_hz)
        / closed_loop.response(frequency_hz)
    )
    period_rad = np.fft.irfft(reference_spectrum, window_ticks)

    turn_ticks, settle_ticks = round(schedule.turn_s * rate_hz), round(schedule.settle_s * rate_hz)
    half_turn_ticks = turn_ticks // 2
    rise_samples = _smooth_rise(np.arange(half_turn_ticks) / half_turn_ticks)
    envelope_samples = np.concatenate(
        [rise_samples, np.ones(settle_ticks + window_ticks), 1.0 - rise_samples]
    )
    windowed_rad = (
        np.resize(np.roll(period_rad, half_turn_ticks + settle_ticks), envelope_samples.size)
        * envelope_samples
    )
    speed_passes = passes_of_schedule(schedule, rate_hz)
    sample_count = speed_passes[-1].end_tick + turn_ticks + round(schedule.end_s * rate_hz)
    reference_rad = np.zeros(sample_count)
    for speed_pass in speed_passes:
        first_sample = speed_pass.first_tick - settle_ticks - half_turn_ticks
        reference_rad[first_sample : first_sample + windowed_rad.size] += windowed_rad
    return reference_rad


def _smooth_rise(x: RealArray) -> RealArray:
    """Return a polynomial that rises from 0 to 1 for x from 0 to 1.

    Its slope and curvature are zero at both ends.
    """
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def _peak_torque(closed_loop: ClosedLoop, reference_rad: RealArray) -> float:
    """Return the motor's largest predicted torque in N·m for a reference angle in rad."""
    return float(np.max(np.abs(closed_loop.simulate(reference_rad).torque_nm)))


def _checked_excitation(
    excitation_name: str,
    schedule: PassSchedule,
    profile: Profile,
    closed_loop: ClosedLoop,
    reference_rad: RealArray,
    torque_percent: float,
    stroke_rad: float,
) -> Excitation:
    """Return an excitation; raise ExcitationError if the angle predicted for it is too large."""
    peak_angle_rad = float(np.max(np.abs(closed_loop.simulate(reference_rad).angle_rad)))
    if peak_angle_rad > stroke_rad:
        raise ExcitationError(
            f"--stroke-rad {stroke_rad:g}: the predicted peak angle is {peak_angle_rad:.3g} rad; "
            "allow more."
        )
    rate_hz = profile.rig.rate_hz
    reference_rad.flags.writeable = False
    rest_ticks = round(schedule.rest_s * rate_hz)
    end_tick = reference_rad.size - round(schedule.end_s * rate_hz)
    stored_parameters = {
        **asdict(schedule),
        "speeds_rad_s": " ".join(repr(speed_rad_s) for speed_rad_s in schedule.speeds_rad_s),
        "torque_percent": torque_percent,
        "stroke_rad": stroke_rad,
        # Settings of the controller, which differ from the profile's file after the trial.
        "control_inertia_kg_m2": profile.control_motor.inertia_kg_m2,
        "control_viscous_nm_s_per_rad": profile.control_motor.viscous_nm_s_per_rad,
        "control_pole_rad_s": profile.control.pole_rad_s,
        "control_feedforward_gain": profile.control.feedforward_gain,
    }
    segment_ticks = {
        "rest": (0, rest_ticks),
        "sweep": (rest_ticks, end_tick),
        "ring_down": (end_tick, reference_rad.size),
    }
    return Excitation(excitation_name, stored_parameters, rate_hz, reference_rad, segment_ticks)
