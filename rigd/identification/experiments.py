"""The sessions that identify a motor: a multisine on passes at constant speed, and slow passes.

Friction jumps where a motor turns round, and nobody knows how: sticking, wind-up, backlash. So the
shaft sweeps to and fro at constant speed, with smooth turns, and the estimate uses the inside of
each pass, where the speed does not change sign and Coulomb friction is a constant. The multisine
rides on fast passes and moves the speed by at most half of it. Every cycle of passes is the same,
but for an offset of some encoder steps, so that cycles can be averaged and their scatter estimated.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import ceil, floor, pi

import numpy as np
from numpy.typing import NDArray

from rigd.control import ClosedLoop, close_loop
from rigd.excitation import Excitation, ExcitationError
from rigd.profile import Profile

Real = NDArray[np.float64]

TRIAL = "motor-trial"
MULTISINE = "motor-multisine"
SPEEDS = "motor-speeds"
"""Kinds of the sessions."""

TOP_HZ = {TRIAL: 33.0, MULTISINE: 33.0, SPEEDS: 3.4}
"""Highest frequency in Hz of the shaft's motion, or of the beam's swing after a turn, by kind."""

_MAX_SPEED_RAD_S = 1.0
_LIMIT_FRACTION = 0.5
"""Fraction of the profile's speed limit: the rest is for multisine and errors of the motor's
data."""
_STROKE_FRACTION = 0.93
"""Fraction of the stroke for the passes; the rest is for multisine, offsets and overshoot."""
_SPEED_PARTS = (0.1, 0.3, 0.6, 1.0)
_MODULATION = {TRIAL: 0.2, MULTISINE: 0.5}
"""Part of the speed that the multisine modulates. The trial knows little of the motor: a quarter of
the inertia that the profile states must not yet reverse the speed."""
_CYCLES = {TRIAL: 6, MULTISINE: 16, SPEEDS: 5}
_BAND_HZ = (1.6, 32.0)
"""The beam's clamped-free modes in it make its torque unlike an inertia's, so that the scale of the
motor's own torque shows; below 32 Hz the encoder's steps do not yet hide the acceleration."""
_LEAST_MULTISINE = 0.1
_OFFSET_STEPS = 40.0
"""Encoder steps: enough for its roundings not to repeat from cycle to cycle."""
_GOLDEN = 0.618033988749895


@dataclass(frozen=True, slots=True)
class PassSchedule:
    """Schedule of the shaft's motion, which defines all passes of a session.

    Each pass is a turn, a time to settle, and the window that is evaluated.
    """

    speeds_rad_s: tuple[float, ...]
    """Speeds of a cycle; each is run forward, then back."""
    cycles: int
    """Number of cycles."""
    rest_s: float = 0.5
    """Rest at the beginning."""
    approach_s: float = 2.0
    """To the end of the stroke where the passes begin."""
    turn_s: float = 0.4
    """Turn before each pass."""
    settle_s: float = 0.15
    """Time to settle after a turn."""
    window_s: float = 1.2
    """Window of a pass."""
    end_s: float = 0.5
    """Way back and rest at the end."""


@dataclass(frozen=True, slots=True)
class SpeedPass:
    """A window of constant nominal speed."""

    first: int
    """Its first tick."""
    end: int
    """The tick after its last."""
    speed_rad_s: float
    """Signed."""
    cycle: int
    """Number of its cycle, from 0 on."""


def lay_out_passes(layout: PassSchedule, rate_hz: float) -> list[SpeedPass]:
    """Return the passes of a session in their order.

    Parameters
    ----------
    layout
        Layout of the session.
    rate_hz
        Rate of the samples.
    """
    turn, settle, window = (
        round(time_s * rate_hz) for time_s in (layout.turn_s, layout.settle_s, layout.window_s)
    )
    tick = round(layout.rest_s * rate_hz) + round(layout.approach_s * rate_hz)
    passes = []
    for cycle in range(layout.cycles):
        for speed in layout.speeds_rad_s:
            for signed in (speed, -speed):
                tick += turn + settle
                passes.append(SpeedPass(tick, tick + window, signed, cycle))
                tick += window
    return passes


def trial_session(profile: Profile, *, torque_percent: float, stroke_rad: float) -> Excitation:
    """Make a short multisine session with little motion, to design the others' controller by.

    See :func:`multisine_session`.

    Parameters
    ----------
    profile
        Profile of the rig.
    torque_percent, stroke_rad
        As for `multisine_session`.
    """
    return _ride(TRIAL, profile, torque_percent, stroke_rad)


def multisine_session(profile: Profile, *, torque_percent: float, stroke_rad: float) -> Excitation:
    """Make passes to and fro with a multisine on them, scaled to the torque allowed.

    The multisine's speed is equal on all harmonics of the window, as the profile's closed loop
    answers to it, with the phases of M. R. Schroeder (IEEE Trans. Inf. Theory 16 (1970) 85).

    Parameters
    ----------
    profile
        Profile of the rig; its loop shapes the reference and predicts the peaks.
    torque_percent
        Largest predicted torque, in percent of the motor's rated torque.
    stroke_rad
        Largest predicted angle to either side of the start.

    Raises
    ------
    ExcitationError
        If an option is out of range or leaves too little to be measured.
    ControlDesignError
        If the profile's loop cannot be closed.
    """
    return _ride(MULTISINE, profile, torque_percent, stroke_rad)


def _ride(kind: str, profile: Profile, torque_percent: float, stroke_rad: float) -> Excitation:
    limit_nm = _torque_limit(profile, torque_percent)
    loop = close_loop(profile.loop_model())
    layout = _fit(kind, (1.0,), profile, stroke_rad)
    carrier = _carrier(layout, profile)
    ride = _multisine(layout, loop, _MODULATION[kind])
    alone_nm = _peak_torque(loop, carrier)
    together_nm = _peak_torque(loop, carrier + ride)
    fraction = 1.0
    if together_nm > limit_nm:
        # The peak is convex in the fraction: below the straight line between the two.
        fraction = (limit_nm - alone_nm) / (together_nm - alone_nm)
    if fraction < _LEAST_MULTISINE:
        needed_nm = alone_nm + _LEAST_MULTISINE * (together_nm - alone_nm)
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: of {limit_nm:.3g} N·m the passes alone take "
            f"{alone_nm:.3g} N·m, and too little is left for the multisine; allow at least "
            f"{_percent(profile, needed_nm)} % or a shorter --stroke-rad."
        )
    return _excitation(
        kind, layout, profile, loop, carrier + fraction * ride, torque_percent, stroke_rad
    )


def speeds_session(profile: Profile, *, torque_percent: float, stroke_rad: float) -> Excitation:
    """Make passes to and fro at four constant speeds.

    Parameters, and what is raised, as for :func:`multisine_session`.

    Parameters
    ----------
    profile
        Profile of the rig.
    torque_percent, stroke_rad
        As for `multisine_session`.
    """
    limit_nm = _torque_limit(profile, torque_percent)
    loop = close_loop(profile.loop_model())
    layout = _fit(SPEEDS, _SPEED_PARTS, profile, stroke_rad)
    reference = _carrier(layout, profile)
    peak_nm = _peak_torque(loop, reference)
    if peak_nm > limit_nm:
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: the turns take {peak_nm:.3g} N·m and only "
            f"{limit_nm:.3g} N·m are allowed; allow at least {_percent(profile, peak_nm)} % or a "
            "shorter --stroke-rad."
        )
    return _excitation(SPEEDS, layout, profile, loop, reference, torque_percent, stroke_rad)


def read_layout(metadata: Mapping[str, str]) -> PassSchedule | None:
    """Return the layout stated in the metadata of a session; None for any other session."""
    if metadata.get("excitation") not in TOP_HZ:
        return None
    try:
        speeds = tuple(float(text) for text in metadata["speeds_rad_s"].split())
        times = {name: float(metadata[name]) for name in _TIMES}
        return PassSchedule(speeds, int(metadata["cycles"]), **times)
    except (KeyError, ValueError):
        return None


_TIMES = ("rest_s", "approach_s", "turn_s", "settle_s", "window_s", "end_s")


def _torque_limit(profile: Profile, torque_percent: float) -> float:
    if not 0.0 < torque_percent <= 100.0:
        raise ExcitationError(
            f"--torque-percent {torque_percent:g}: must be more than 0 and at most 100 % of the "
            "rated torque."
        )
    return torque_percent / 100 * profile.rig.motor.rated_torque_nm


def _percent(profile: Profile, torque_nm: float) -> int:
    return ceil(101 * torque_nm / profile.rig.motor.rated_torque_nm)


def _fit(kind: str, parts: tuple[float, ...], profile: Profile, stroke_rad: float) -> PassSchedule:
    """Choose the speed so that the passes fit into the stroke, and the speed into its limit."""
    limits = profile.limits
    if not 0.0 < stroke_rad <= limits.angle_rad:
        raise ExcitationError(
            f"--stroke-rad {stroke_rad:g}: must be more than 0 and at most limits.angle_rad = "
            f"{limits.angle_rad:g} rad."
        )
    cycles = _CYCLES[kind]
    travel_s = float(np.ptp(_path(PassSchedule(parts, 1), profile.rig.rate_hz)))
    speed = min(
        _MAX_SPEED_RAD_S,
        _LIMIT_FRACTION * limits.velocity_rad_s,
        2 * _STROKE_FRACTION * stroke_rad / travel_s,
    )
    return PassSchedule(tuple(part * speed for part in parts), cycles)


def _path(layout: PassSchedule, rate_hz: float) -> Real:
    """Angle of the passes from the end of the approach on, beginning at 0."""
    turn, settle, window = (
        round(time_s * rate_hz) for time_s in (layout.turn_s, layout.settle_s, layout.window_s)
    )
    change = _smooth(np.arange(turn) / turn)
    segments: list[Real] = []
    before = 0.0
    for speed in [s for v in layout.speeds_rad_s for s in (v, -v)] * layout.cycles:
        segments.append(before + (speed - before) * change)
        segments.append(np.full(settle + window, speed))
        before = speed
    segments.append(before * (1.0 - change))
    speeds = np.concatenate(segments)
    path: Real = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]))]) / rate_hz
    return path


def _carrier(layout: PassSchedule, profile: Profile) -> Real:
    """Return the reference without a multisine: rest, approach, passes, end."""
    rate_hz = profile.rig.rate_hz
    path = _path(layout, rate_hz)
    path -= 0.5 * (path.max() + path.min())
    rest, approach, end = (
        round(time_s * rate_hz) for time_s in (layout.rest_s, layout.approach_s, layout.end_s)
    )
    way = path[0] * _smooth(np.arange(approach) / approach)
    reference = np.concatenate([np.zeros(rest), way, path, np.full(end, path[-1])])
    _add_offsets(reference, layout, profile)
    return reference


def _add_offsets(reference: Real, layout: PassSchedule, profile: Profile) -> None:
    """Move each cycle by its own fraction of some encoder steps, in the turn before it."""
    rate_hz = profile.rig.rate_hz
    turn = round(layout.turn_s * rate_hz)
    before = round((layout.turn_s + layout.settle_s) * rate_hz)
    change = _smooth(np.arange(turn) / turn)
    offset = 0.0
    seen = -1
    for run in lay_out_passes(layout, rate_hz):
        if run.cycle == seen:
            continue
        seen = run.cycle
        part = _GOLDEN * (seen + 1)
        following = _OFFSET_STEPS * profile.rig.encoder.resolution_rad * (part - floor(part) - 0.5)
        start = run.first - before
        reference[start : start + turn] += (following - offset) * change
        reference[start + turn :] += following - offset
        offset = following


def _multisine(layout: PassSchedule, loop: ClosedLoop, modulation: float) -> Real:
    """Return the reference whose response modulates the speed of the passes by a fraction."""
    rate_hz = loop.model.rate_hz
    window = round(layout.window_s * rate_hz)
    step_hz = rate_hz / window
    numbers = np.arange(ceil(_BAND_HZ[0] / step_hz), floor(_BAND_HZ[1] / step_hz) + 1)
    frequency_hz = numbers.astype(np.float64) * step_hz
    phase = -pi * np.arange(numbers.size) * np.arange(1, numbers.size + 1) / numbers.size
    speed = np.zeros(window // 2 + 1, dtype=complex)
    speed[numbers] = np.exp(1j * phase)
    peak = float(np.max(np.abs(np.fft.irfft(speed, window))))
    speed *= modulation * layout.speeds_rad_s[0] / peak
    spectrum = np.zeros_like(speed)
    spectrum[numbers] = speed[numbers] / (2j * pi * frequency_hz) / loop.response(frequency_hz)
    period = np.fft.irfft(spectrum, window)

    turn, settle = round(layout.turn_s * rate_hz), round(layout.settle_s * rate_hz)
    half = turn // 2
    rise = _smooth(np.arange(half) / half)
    gate = np.concatenate([rise, np.ones(settle + window), 1.0 - rise])
    gated = np.resize(np.roll(period, half + settle), gate.size) * gate
    passes = lay_out_passes(layout, rate_hz)
    total = passes[-1].end + turn + round(layout.end_s * rate_hz)
    reference = np.zeros(total)
    for run in passes:
        start = run.first - settle - half
        reference[start : start + gated.size] += gated
    return reference


def _smooth(x: Real) -> Real:
    """Rise from 0 to 1 over x in [0, 1], slope and curvature zero at both ends."""
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def _peak_torque(loop: ClosedLoop, reference: Real) -> float:
    return float(np.max(np.abs(loop.simulate(reference).torque_nm)))


def _excitation(
    kind: str,
    layout: PassSchedule,
    profile: Profile,
    loop: ClosedLoop,
    reference: Real,
    torque_percent: float,
    stroke_rad: float,
) -> Excitation:
    peak_rad = float(np.max(np.abs(loop.simulate(reference).angle_rad)))
    if peak_rad > stroke_rad:
        raise ExcitationError(
            f"--stroke-rad {stroke_rad:g}: the predicted peak angle is {peak_rad:.3g} rad; allow "
            "more."
        )
    rate_hz = profile.rig.rate_hz
    reference.flags.writeable = False
    rest = round(layout.rest_s * rate_hz)
    end = reference.size - round(layout.end_s * rate_hz)
    parameters = {
        **asdict(layout),
        "speeds_rad_s": " ".join(repr(speed) for speed in layout.speeds_rad_s),
        "torque_percent": torque_percent,
        "stroke_rad": stroke_rad,
        # The controller's, which are not those of the profile's file after the trial.
        "control_inertia_kg_m2": profile.control_motor.inertia_kg_m2,
        "control_viscous_nm_s_per_rad": profile.control_motor.viscous_nm_s_per_rad,
        "control_pole_rad_s": profile.control.pole_rad_s,
        "control_feedforward_gain": profile.control.feedforward_gain,
    }
    segments = {"rest": (0, rest), "sweep": (rest, end), "ring_down": (end, reference.size)}
    return Excitation(kind, parameters, rate_hz, reference, segments)
