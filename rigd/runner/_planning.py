"""Planning of a session, before anything moves: stability of the loop, peaks, limits."""

import inspect
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    SMALL_SLOPE_RAD,
    Beam,
    Damping,
    RealisationError,
    TipMotion,
    participation,
    poles,
    tip_motion,
)
from rigd.control import (
    ClosedLoop,
    ControlDesignError,
    LoopResponse,
    check_stability,
    close_loop,
    design_damper,
)
from rigd.engine import Ending
from rigd.errors import UserError
from rigd.excitation import (
    KINDS,
    Excitation,
    MovePlant,
    Value,
    make_excitation,
)
from rigd.identified_beam import read_identified_beam
from rigd.profile import Profile

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


_MOST_RAD = 2.0 * math.pi
"""Largest amplitude that an excitation takes."""
_ROUNDS = 10
"""Steps of the search for the largest amplitude; three or four are needed."""
_MOST_MODES = 6
"""Modes that a move leaves at rest; those above are too weak to be seen."""
_UNSURE = 0.01
"""Relative uncertainty of the frequencies of a profile's beam, which nobody states."""
_FILTERS = 1.2
"""Acceleration of a move's reference over what the peak torque does to the motor alone: some more,
for the loop follows it through its filters."""
_GOING = ("move", "touch")
"""Excitations that go to an angle: they know where they start, and have no amplitude."""
_SETTLED = 5.0
"""Time constants of the loop in which it follows up a reference."""
_NO_FORCE = (
    "Without sensor.shear_projection in the profile the contact force is not known: force_limit_n "
    "(--force-limit) ends nothing, and points are less precise."
)


class RefusedError(UserError):
    """A session would leave the limits of the profile; the message says which, and the remedy."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Largest magnitudes of a session that starts at the rig's zero, from the linear closed loop.

    The torque is not limited: what saturates shows as a peak beyond the motor's.
    """

    peak_angle_rad: float
    peak_velocity_rad_s: float
    peak_torque_nm: float
    peak_tracking_error_rad: float
    peak_coupling_torque_nm: float
    tip: TipMotion | None = None
    """Motion of the beam's free end in a vacuum; None without a beam, or where it is irrelevant."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a session is predicted to do, and whether the limits allow it."""

    prediction: Prediction
    """What the session is predicted to do."""
    warnings: tuple[str, ...]
    """Sentences for the operator."""
    tip_in_words: str
    """What the free end will do, and whether the linear model holds there."""
    refused: str = ""
    """Why it must not be run: a line for each limit that it would leave; empty if it may be run."""
    ending: Ending = field(default_factory=Ending)
    """What follows the record, for the control process."""


class LoopPreview:
    """Loop preview: what an excitation made for one rig may know of it.

    Parameters
    ----------
    profile
        Profile of the rig. Its closed loop is computed when first needed.
    start_rad
        Where the motor stands, from the rig's zero.
    """

    def __init__(self, profile: Profile, start_rad: float = 0.0) -> None:
        self._profile = profile
        self.start_rad = start_rad
        self._estimated: tuple[Beam, Damping, MovePlant] | None = None

    @property
    def beam(self) -> Beam:
        """The specimen as the profile has it."""
        return self._profile.rig.beam

    @cached_property
    def _loop(self) -> ClosedLoop:
        return close_loop(self._profile.loop_model())

    def tracking(self, frequency_hz: Real) -> Complex:
        """Angle over reference at some frequencies, of the shape given."""
        return self._loop.response(frequency_hz)

    def share_of_limits(self, reference_rad: Real) -> float:
        """Largest share of a limit that a reference (n,) is predicted to take.

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the response grows beyond all numbers.
        """
        response = self._loop.simulate(reference_rad)
        firm, forcible = _limited(self._profile, _peaks(reference_rad, response))
        return _share(firm + forcible)

    def move_plant(self, path: str | Path = "") -> MovePlant:
        """Return the rig for planning a move.

        Parameters
        ----------
        path
            Document of ``analyze --json``, whose beam takes the place of the profile's; empty: the
            profile's.

        Raises
        ------
        ExcitationError
            If the document is not what it should be.
        ControlDesignError
            If the loop is unstable with that beam.
        RealisationError
            If its damping cannot be realised.
        """
        if not path:
            rig = self._profile.rig
            return self._plant_with(rig.beam, rig.damping, _UNSURE)
        found = read_identified_beam(path, self.beam.length_m)
        return self._plant_with(found.beam, found.damping, found.frequency_uncertainty)

    def tip_slope_rad(self, reference_rad: Real) -> float:
        """Largest slope of the free end that is predicted for a reference (n,)."""
        angle_rad = self._loop.simulate(reference_rad).angle_rad
        rig = self._profile.rig
        return tip_motion(rig.beam, rig.damping, angle_rad, rig.rate_hz).slope_rad

    def plant_with(self, beam: Beam, damping: Damping) -> MovePlant:
        """Return the rig with an estimated beam, for the design of excitation.

        Where the loop cannot be computed with its damping, that of the profile is taken: the motor
        hardly moves otherwise for it, since the coupling torque is fed forward. The last one is
        kept: a decision asks for it several times.

        Parameters
        ----------
        beam, damping
            The beam as estimated.

        Raises
        ------
        ControlDesignError
            If the loop is unstable with that beam.
        RealisationError
            If no damping can be realised.
        """
        if self._estimated is not None and self._estimated[:2] == (beam, damping):
            return self._estimated[2]
        try:
            plant = self._plant_with(beam, damping, _UNSURE)
        except (ControlDesignError, RealisationError):
            plant = self._plant_with(beam, self._profile.rig.damping, _UNSURE)
        self._estimated = beam, damping, plant
        return plant

    def _plant_with(self, beam: Beam, damping: Damping, uncertainty: float) -> MovePlant:
        profile = self._profile
        model = replace(profile.loop_model(), beam=beam, damping=damping)
        # tanh of the speed is not linear: its largest value is taken off the torque.
        settings = replace(model.settings, friction_compensation_nm=0.0)
        loop = close_loop(replace(model, settings=settings))
        check_stability(loop)
        ringing = mode_poles(loop)
        # Torque of a mode of the beam for the angle's acceleration: a² rho omega sin(omega t).
        omega = np.abs(ringing)
        per_angle = participation(beam, ringing.size) * beam.density_kg_per_m * omega
        motor = profile.control_motor
        return MovePlant(
            rate_hz=model.rate_hz,
            respond=loop.simulate,
            poles_rad_s=ringing,
            torque_per_state_nm_s=per_angle * np.abs(loop.response(omega / (2.0 * math.pi))),
            frequency_uncertainty=np.full(ringing.size, uncertainty),
            settling_s=_SETTLED / settings.pole_rad_s,
            peak_torque_nm=motor.peak_torque_nm,
            friction_nm=profile.control.friction_compensation_nm,
            largest_acceleration_rad_s2=_FILTERS * motor.peak_torque_nm / motor.inertia_kg_m2,
            velocity_rad_s=profile.limits.velocity_rad_s,
            tracking_error_rad=profile.limits.tracking_error_rad,
            coupling_torque_nm=_sensor_limit_nm(profile),
            angle_rad=profile.limits.angle_rad,
        )


def mode_poles(loop: ClosedLoop) -> Complex:
    """Return the poles of a closed loop that are the modes of its beam, one of each pair.

    What rings on while the motor is held is the closed loop: its poles lie near those of the beam
    with locked hub, and where the loop damps them they differ.

    Parameters
    ----------
    loop
        Closed loop with a beam.

    Returns
    -------
    ndarray, shape (m,)
        In rad/s, of the lowest modes that oscillate and lie within reach of the ticks.

    Raises
    ------
    RealisationError
        If the damping leaves the beam no such modes.
    """
    model = loop.model
    assert model.beam is not None
    try:
        locked = poles(model.beam, model.damping, _MOST_MODES)[:, 0]
    except ArithmeticError as error:
        raise RealisationError(f"The damping is too strong for the model: {error}") from None
    oscillating = (locked.imag != 0.0) & (np.abs(locked) < 0.5 * math.pi * model.rate_hz)
    return np.array(
        [loop.poles_rad_s[np.argmin(np.abs(loop.poles_rad_s - s))] for s in locked[oscillating]]
    )


def excitation_for(
    profile: Profile, kind: str, parameters: Mapping[str, Value], start_rad: float = 0.0
) -> Excitation:
    """Make an excitation for a rig: see `rigd.excitation._named.make_excitation`.

    Parameters
    ----------
    profile
        Profile of the rig.
    kind, parameters
        Name and options of the excitation.
    start_rad
        Where the motor stands, from the rig's zero; only a move asks for it.
    """
    return make_excitation(kind, parameters, profile.rig.rate_hz, LoopPreview(profile, start_rad))


def plan_session(profile: Profile, excitation: Excitation, *, force: bool = False) -> Plan:
    """Predict a session and refuse one that would leave the profile's limits.

    Parameters
    ----------
    profile, excitation, force
        See `predict_session`.

    Raises
    ------
    RefusedError
        Naming every limit the session would leave, and the largest amplitude that passes.
    ControlDesignError, RealisationError
        As `predict_session`.
    """
    plan = predict_session(profile, excitation, force=force)
    if plan.refused:
        raise RefusedError(plan.refused)
    return plan


def predict_session(profile: Profile, excitation: Excitation, *, force: bool = False) -> Plan:
    """Predict a session and compare it with the profile's limits.

    Parameters
    ----------
    profile, excitation
        Rig and excitation of the session.
    force
        Let torques be clipped, of the motor or of the sensor. No other limit can be forced: leaving
        it would end the session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable.
    RealisationError
        If the beam's damping cannot be realised.
    """
    loop = close_loop(profile.loop_model())
    unstable = check_stability(loop)
    prediction = predict(loop, excitation)
    firm, forcible = (
        [finding for limited in channels if (finding := limited.violation())]
        for channels in _limited(profile, prediction)
    )
    refusals: list[str] = []
    if firm or (forcible and not force):
        lower = _remedy(profile, excitation, force=force)
        refusals = [f"{finding}; {lower}." for finding in firm]
        refusals += [f"{finding}; {lower}, or allow clipping with --force." for finding in forcible]
    warnings = [unstable] if unstable else []
    if not refusals:
        warnings += [f"{finding}: it will be clipped and flagged." for finding in forcible]
    if excitation.approach is not None and not any(profile.rig.sensor.shear_projection):
        warnings.append(_NO_FORCE)
    return Plan(
        prediction,
        warnings=tuple(warnings),
        tip_in_words=_tip_in_words(prediction, profile.rig.beam, excitation.kind),
        refused="\n".join(refusals),
        ending=_ending(loop, stays=excitation.stays),
    )


def _remedy(profile: Profile, excitation: Excitation, *, force: bool) -> str:
    """Say what of an excitation is to be changed where it would leave the limits."""
    if excitation.kind in _GOING:
        return "go less far or slower"
    largest_rad = largest_amplitude(profile, excitation, force=force)
    return "lower the amplitude" + ("" if largest_rad is None else f" to {largest_rad:g} rad")


def _ending(loop: ClosedLoop, *, stays: bool) -> Ending:
    """Plan what follows the record: a return that leaves the beam at rest, and active damping."""
    if loop.model.beam is None:
        return Ending(stays=stays)
    return Ending(stays, tuple(map(complex, mode_poles(loop))), design_damper(loop))


def largest_amplitude(
    profile: Profile, excitation: Excitation, *, force: bool = False
) -> float | None:
    """Return the largest amplitude that all limits allow, the other parameters as they are.

    Parameters
    ----------
    profile, excitation
        Rig and excitation, whatever its amplitude.
    force
        Torques may be clipped: only what cannot be forced counts.

    Returns
    -------
    float or None
        In rad, rounded down to three digits; None where the excitation has no amplitude of its own
        (``hold``, ``file``), keeps it within the limits by itself (``modes``, ``until``), or none
        would do.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response grows beyond all numbers.
    RealisationError
        If the beam's damping cannot be realised.
    """
    if excitation.kind in ("modes", "until") or not _has_amplitude(excitation.kind):
        return None
    loop = close_loop(profile.loop_model())
    given_rad = abs(float(excitation.parameters["amplitude_rad"]))

    def share_at(amplitude_rad: float) -> float:
        reference_rad = excitation.reference_rad * (amplitude_rad / given_rad)
        firm, forcible = _limited(profile, _peaks(reference_rad, loop.simulate(reference_rad)))
        return _share(firm if force else firm + forcible)

    # All peaks are proportional to the amplitude, but for the friction compensation in the torque.
    amplitude_rad = min(given_rad, _MOST_RAD)
    for _ in range(_ROUNDS):
        share = share_at(amplitude_rad)
        if not 0.0 < share < math.inf:
            return None
        amplitude_rad = min(amplitude_rad / share, _MOST_RAD)
        if 0.999 < share <= 1.0:
            break
    digit_rad = 10.0 ** (math.floor(math.log10(amplitude_rad)) - 2)
    digits = math.floor(amplitude_rad / digit_rad)
    while digits > 0 and not share_at(digits * digit_rad) <= 1.0:
        digits -= 1
    return float(f"{digits * digit_rad:.3g}") if digits else None


def plan_document(profile: Profile, excitation: Excitation, plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON documents have it.

    Parameters
    ----------
    profile, excitation
        Rig and excitation that the plan is for.
    plan
        What `predict_session` or `plan_session` returned.
    """
    return {
        "excitation": excitation.kind,
        "sweep": _sweep_in_words(excitation),
        "profile": profile.name,
        "parameters": dict(excitation.parameters),
        "segments": {name: list(ends) for name, ends in excitation.segments.items()},
        "record_s": excitation.reference_rad.size / profile.rig.rate_hz,
        "ends_itself": excitation.search is not None,
        **asdict(plan.prediction),
        "limits": {
            "angle_rad": profile.limits.angle_rad,
            "velocity_rad_s": profile.limits.velocity_rad_s,
            "torque_nm": profile.rig.motor.peak_torque_nm,
            "tracking_error_rad": profile.limits.tracking_error_rad,
            "coupling_torque_nm": _sensor_limit_nm(profile),
            "tip_slope_rad": SMALL_SLOPE_RAD,
        },
        "refused": plan.refused or None,
        "tip_in_words": plan.tip_in_words,
        "beam": asdict(profile.rig.beam),
        "damping": asdict(profile.rig.damping),
        "specimen_in_words": profile.specimen_in_words,
        "warnings": list(plan.warnings),
    }


def _has_amplitude(kind: str) -> bool:
    """Whether an excitation takes its amplitude as an option."""
    return "amplitude_rad" in inspect.signature(KINDS[kind]).parameters


def _sweep_in_words(excitation: Excitation) -> str:
    """Say from where to where a chirp sweeps, and where a move or a search goes; else nothing."""
    if excitation.kind == "move":
        return _move_in_words(excitation.parameters)
    if excitation.kind == "touch":
        return _search_in_words(excitation.parameters)
    if excitation.search is not None:
        return _scan_in_words(excitation)
    if excitation.kind != "chirp":
        return ""
    start_hz, stop_hz = (float(excitation.parameters[key]) for key in ("start_hz", "stop_hz"))
    down = " down" if stop_hz < start_hz else ""
    return f"sweeps{down} from {start_hz:g} to {stop_hz:g} Hz"


def _move_in_words(parameters: Mapping[str, float | int | str]) -> str:
    """Say where a move goes, how long it takes, and what vibration it is predicted to leave."""
    by_rad, angle_rad, duration_s, share, residual_nm, quintic_nm = (
        float(parameters[name])
        for name in (
            *("by_rad", "angle_rad", "duration_s"),
            *("limits_share", "residual_nm", "quintic_residual_nm"),
        )
    )
    return (
        f"moves by {by_rad:.4g} rad to {angle_rad:.4g} rad in {1e3 * duration_s:.0f} ms "
        f"({100 * share:.0f} % of the limits), vibration left {1e3 * residual_nm:.2g} mN·m "
        f"(quintic {1e3 * quintic_nm:.3g}; beam of {parameters['file'] or 'profile'})"
    )


def _search_in_words(parameters: Mapping[str, float | int | str]) -> str:
    """Say how far and how fast a search for an obstacle goes."""
    passes = int(parameters["passes"])
    return (
        f"goes to {float(parameters['angle_rad']):.4g} rad at {parameters['speed_rad_s']:g} rad/s"
        f"{f', {passes} times' if passes > 1 else ''}, brakes within "
        f"{1e3 * float(parameters['braking_s']):.0f} ms of a touch (beam of "
        f"{parameters['file'] or 'profile'})"
    )


def _scan_in_words(excitation: Excitation) -> str:
    """Say what a session begins with that goes on until a precision is reached, and which."""
    assert excitation.search is not None
    start_hz, stop_hz, scan_s, amplitude_rad = (
        float(excitation.parameters[name])
        for name in ("start_hz", "stop_hz", "scan_s", "amplitude_rad")
    )
    asked = ", ".join(str(target) for target in excitation.search.targets)
    return (
        f"scans {start_hz:g} to {stop_hz:g} Hz in {scan_s:g} s at up to {amplitude_rad:.3g} rad, "
        f"then excites what tells most until {asked} (standard deviation)"
    )


def predict(loop: ClosedLoop, excitation: Excitation) -> Prediction:
    """Predict the peaks of a session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response grows beyond all numbers.
    """
    response = loop.simulate(excitation.reference_rad)
    peaks = _peaks(excitation.reference_rad, response)
    angle_rad = response.angle_rad.copy()
    del response  # an hour of it takes 150 MB, and the tip as much again
    model = loop.model
    if model.beam is not None:
        tip = tip_motion(model.beam, model.damping, angle_rad, model.rate_hz)
        peaks = replace(peaks, tip=tip)
    if excitation.kind not in _GOING:
        return peaks
    start_rad = float(excitation.parameters["angle_rad"]) - float(excitation.parameters["by_rad"])
    return replace(peaks, peak_angle_rad=_peak(start_rad + angle_rad))


def _peaks(reference_rad: Real, response: LoopResponse) -> Prediction:
    return Prediction(
        peak_angle_rad=_peak(response.angle_rad),
        peak_velocity_rad_s=_peak(response.velocity_rad_s),
        peak_torque_nm=_peak(response.torque_nm),
        peak_tracking_error_rad=_peak(reference_rad - response.angle_rad),
        peak_coupling_torque_nm=_peak(response.coupling_torque_nm),
    )


def predicted_metadata(profile: Profile, predicted: Prediction) -> dict[str, str]:
    """Return the predicted peaks and their limits as a session's file has them.

    Parameters
    ----------
    profile
        Profile of the rig, with its limits.
    predicted
        What the session is predicted to do.

    Returns
    -------
    dict of str to str
        ``predicted_peak_…`` and ``limit_…``, their units in the names.
    """
    firm, forcible = _limited(profile, predicted)
    metadata = {}
    for peak in (*firm, *forcible):
        metadata[f"predicted_peak_{_KEYS[peak.name]}"] = repr(peak.value)
        metadata[f"limit_{_KEYS[peak.name]}"] = repr(peak.limit)
    return metadata


def _tip_in_words(predicted: Prediction, beam: Beam, kind: str) -> str:
    tip = predicted.tip
    if tip is None:
        return ""
    share = tip.deflection_m / beam.length_m
    motion = (
        f"Predicted tip deflection: {tip.deflection_m:.3g} m ({100 * share:.2g} % of the length), "
        f"tip speed {tip.speed_m_s:.3g} m/s, slope {tip.slope_rad:.2g} rad."
    )
    if not tip.slope_rad > SMALL_SLOPE_RAD:
        return motion
    lower = math.floor(100 * SMALL_SLOPE_RAD / tip.slope_rad) / 100
    scales = lower > 0 and kind not in _GOING
    within = f"; {lower:g} times the amplitude stays within" if scales else ""
    return (
        f"{motion} At slopes above {SMALL_SLOPE_RAD:g} rad the linear model is not exact (error "
        f"up to {100 * tip.slope_rad**2 / 3:.2g} %), and air drag may limit the motion{within}."
    )


_KEYS = {
    "angle": "angle_rad",
    "speed": "velocity_rad_s",
    "tracking error": "tracking_error_rad",
    "coupling torque": "coupling_torque_nm",
    "torque": "torque_nm",
}
"""Names of the limited peaks as keys of metadata."""


@dataclass(frozen=True, slots=True)
class _Limited:
    """A predicted peak and its limit; a peak that is not a number violates it."""

    name: str
    value: float
    limit: float
    unit: str
    key: str

    def violation(self) -> str | None:
        if self.value <= self.limit:
            return None
        return (
            f"The predicted peak {self.name} of {self.value:.4g} {self.unit} exceeds "
            f"{self.limit:.4g} {self.unit} ({self.key})"
        )


def _limited(
    profile: Profile, predicted: Prediction
) -> tuple[tuple[_Limited, ...], tuple[_Limited, ...]]:
    """Return what no session may exceed, and what clips a torque."""
    limits, motor = profile.limits, profile.rig.motor
    firm = (
        _Limited("angle", predicted.peak_angle_rad, limits.angle_rad, "rad", "limits.angle_rad"),
        _Limited(
            "speed",
            predicted.peak_velocity_rad_s,
            limits.velocity_rad_s,
            "rad/s",
            "limits.velocity_rad_s",
        ),
        _Limited(
            "tracking error",
            predicted.peak_tracking_error_rad,
            limits.tracking_error_rad,
            "rad",
            "limits.tracking_error_rad",
        ),
    )
    forcible = (
        _Limited(
            "coupling torque",
            predicted.peak_coupling_torque_nm,
            _sensor_limit_nm(profile),
            "N·m",
            "sensor.range",
        ),
        _Limited(
            "torque", predicted.peak_torque_nm, motor.peak_torque_nm, "N·m", "motor.peak_torque_nm"
        ),
    )
    return firm, forcible


def _share(channels: tuple[_Limited, ...]) -> float:
    """Return the largest predicted peak as a share of its limit; NaN if one is not a number."""
    shares = [channel.value / channel.limit for channel in channels]
    return math.nan if any(map(math.isnan, shares)) else max(shares)


def _sensor_limit_nm(profile: Profile) -> float:
    """Coupling torque at which the first axis of the sensor reaches its limit, or its range.

    The wrench of a coupling torque is taken as the smallest one that projects to it.
    """
    sensor = profile.rig.sensor
    weight = sum(p * p for p in sensor.projection)
    used = min(1.0, profile.limits.sensor_range_percent / 100)
    return min(
        used * limit * weight / abs(p)
        for p, limit in zip(sensor.projection, sensor.range, strict=True)
        if p != 0.0
    )


def _peak(values: Real) -> float:
    return float(np.max(np.abs(values)))
