"""Planning of a session before any motion: stability of the loop, predicted peaks, limits."""

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, LoadedBeam
from rigd.beam.realisation import RealisationError
from rigd.beam.tip import TipMotion, tip_motion
from rigd.checks import Clearance, check_on_paper
from rigd.control import ClosedLoop, ControlDesignError, LoopResponse, stable_loop
from rigd.control.damper import design_damper
from rigd.engine.messages import Ending
from rigd.errors import UserError
from rigd.excitation import KINDS, BeamEstimate, Excitation, MovePlant, Value, make_excitation
from rigd.identified_beam import Use, read_identified_beam
from rigd.profile import Profile
from rigd.runner._move_plant import (
    loop_model_with,
    mode_poles,
    move_plant_of,
    torque_noise_nm,
    with_beam,
)
from rigd.runner._tip_slope import (
    NOT_IDENTIFYING,
    is_limited,
    slope_remedy,
    tip_document,
    tip_in_words,
)

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


_MOST_RAD = 2.0 * math.pi
"""Largest permitted amplitude of an excitation."""
_ROUNDS = 10
"""Steps of the search for the largest amplitude; three or four are needed."""
_NO_FORCE = (
    "Without sensor.shear_projection in the profile the contact force is not known: force_limit_n "
    "(--force-limit) ends nothing, and points are less precise."
)


class RefusedError(UserError):
    """A session would exceed limits of the profile; the message states them and the remedy."""


@dataclass(frozen=True, slots=True)
class SessionPrediction:
    """Predicted peak magnitudes of a session that starts at the rig's zero.

    The prediction uses the linear closed loop without torque limit: saturation shows as a peak
    above the motor's peak torque.
    """

    peak_angle_rad: float
    """Angle from the rig's zero."""
    peak_velocity_rad_s: float
    """Speed of the output shaft."""
    peak_torque_nm: float
    """Torque command at the output shaft."""
    peak_tracking_error_rad: float
    """Reference less angle."""
    peak_coupling_torque_nm: float
    """Torque between hub and antenna."""
    tip: TipMotion | None = None
    """Motion of the beam's free end in a vacuum; None without a beam, or where it is irrelevant."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Prediction of a session, and whether the limits allow it."""

    prediction: SessionPrediction
    """Predicted peaks."""
    warnings: tuple[str, ...]
    """Sentences for the operator."""
    tip_in_words: str
    """Description of the motion of the free end and of the validity of the linear model."""
    refused: str = ""
    """Reasons against running it, one line for each exceeded limit; empty if it may be run."""
    ending: Ending = field(default_factory=Ending)
    """Motion after the record, for the control process."""
    clearance: Clearance = field(default_factory=Clearance)
    """Results of the checks on paper."""


class RigPreview:
    """Preview of the closed loop of a rig, for the design of an excitation.

    Parameters
    ----------
    profile
        Profile of the rig. Its closed loop is computed when first needed.
    start_rad
        Motor angle at the start, from the rig's zero.
    """

    def __init__(self, profile: Profile, start_rad: float = 0.0) -> None:
        self._profile = profile
        self.start_rad = start_rad
        self._estimated: tuple[LoadedBeam, MovePlant] | None = None

    @property
    def beam(self) -> Beam:
        """Beam of the profile."""
        return self._profile.rig.beam

    @property
    def uniformity(self) -> float:
        """Relative standard deviation of the modes' frequencies from those of a uniform beam."""
        return self._profile.uncertainty.uniformity_percent / 100.0

    @property
    def stated_estimate(self) -> BeamEstimate:
        """Beam estimate with the values of the profile and the noise of the sensor, all free."""
        rig = self._profile.rig
        density_nm2_per_hz = 2.0 * torque_noise_nm(self._profile) ** 2 / rig.rate_hz
        tip_mass_kg = self._profile.loop_model().tip_mass_kg
        return BeamEstimate.stated(rig.beam, rig.damping, density_nm2_per_hz, tip_mass_kg)

    @cached_property
    def _loop(self) -> ClosedLoop:
        return stable_loop(self._profile.loop_model())[0]

    def tracking(self, frequency_hz: Real) -> Complex:
        """Return the frequency response from reference to angle, in the shape of the input."""
        return self._loop.response(frequency_hz)

    def fraction_of_limits(self, reference_rad: Real) -> float:
        """Return the largest predicted peak of a reference (n,) as a fraction of its limit.

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the response overflows.
        """
        response = self._loop.simulate(reference_rad)
        firm, forcible = _limited(self._profile, _peaks(reference_rad, response))
        return _largest_fraction(firm + forcible)

    def move_plant(self, path: str | Path, use: Use) -> MovePlant:
        """Return the rig model for the planning of a move.

        Parameters
        ----------
        path
            Document of ``analyze --json`` with the beam; empty: the beam of the profile.
        use
            Purpose of the beam.

        Raises
        ------
        IdentifiedBeamError
            If the document is invalid, or has an effect that this use does not model.
        ControlDesignError
            If the loop is unstable with that beam.
        RealisationError
            If its damping cannot be realised.
        """
        found = read_identified_beam(path, self.beam.length_m, use) if path else None
        model = loop_model_with(self._profile, found)
        return move_plant_of(self._profile, model, _sensor_limit_nm(self._profile), found)

    def tip_slope_rad(self, reference_rad: Real) -> float:
        """Return the largest predicted slope of the free end for a reference (n,)."""
        angle_rad = self._loop.simulate(reference_rad).angle_rad
        rig = self._profile.rig
        return tip_motion(rig.beam, rig.damping, angle_rad, rig.rate_hz).slope_rad

    def plant_with(self, beam: LoadedBeam) -> MovePlant:
        """Return the rig model with an estimated beam, for the design of excitation.

        If the loop cannot be computed with the estimated damping, that of the profile is used. The
        effect on the motor is small, because the coupling torque is fed forward. The last model is
        cached.

        Parameters
        ----------
        beam
            The estimated loaded beam.

        Raises
        ------
        ControlDesignError
            If the loop is unstable with that beam.
        RealisationError
            If no damping can be realised.
        """
        if self._estimated is not None and self._estimated[0] == beam:
            return self._estimated[1]
        profile = self._profile
        limit_nm = _sensor_limit_nm(profile)
        try:
            plant = move_plant_of(profile, with_beam(profile.loop_model(), beam), limit_nm)
        except (ControlDesignError, RealisationError):
            stated = replace(beam, damping=profile.rig.damping)
            plant = move_plant_of(profile, with_beam(profile.loop_model(), stated), limit_nm)
        self._estimated = beam, plant
        return plant


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
        Motor angle at the start, from the rig's zero; used only by a move.
    """
    if "tip_slope_rad" in inspect.signature(KINDS[kind]).parameters:
        parameters = {"tip_slope_rad": profile.limits.tip_slope_rad} | dict(parameters)
    return make_excitation(kind, parameters, profile.rig.rate_hz, RigPreview(profile, start_rad))


def plan_session(
    profile: Profile, excitation: Excitation, *, force: bool = False, accept: Sequence[str] = ()
) -> Plan:
    """Predict a session; raise if the checks on paper or the limits of the profile forbid it.

    Parameters
    ----------
    profile, excitation, force, accept
        See `predict_session`.

    Raises
    ------
    CheckFailedError, UnknownRowError
        If a check on paper fails and is not accepted, or `accept` has an unknown name.
    RefusedError
        If the session would exceed limits: names each of them and the largest possible amplitude.
    ControlDesignError, RealisationError, UnknownValueError
        As `predict_session`.
    """
    plan = predict_session(profile, excitation, force=force, accept=accept)
    plan.clearance.require()
    if plan.refused:
        raise RefusedError(plan.refused)
    return plan


def predict_session(
    profile: Profile, excitation: Excitation, *, force: bool = False, accept: Sequence[str] = ()
) -> Plan:
    """Check a session on paper, predict it, and compare it with the profile's limits.

    Parameters
    ----------
    profile, excitation
        Rig and excitation of the session.
    force
        Allow clipped torques of the motor or the sensor. No other limit can be forced, because
        exceeding it would end the session.
    accept
        Names of rows of `rigd check` that may fail.

    Raises
    ------
    UnknownRowError
        If `accept` has an unknown name.
    UnknownValueError
        If a value of the profile is unknown.
    ControlDesignError
        If the loop is unstable.
    RealisationError
        If the beam's damping cannot be realised.
    """
    clearance = check_on_paper(profile, accept)
    loop, unstable = stable_loop(loop_model_with(profile, excitation.model))
    prediction = predict(loop, excitation)
    firm, forcible = (
        [finding for limited in channels if (finding := limited.violation())]
        for channels in _limited(profile, prediction)
    )
    refusals = list(clearance.refusals)
    slope = _slope(profile, prediction) if is_limited(excitation) else None
    too_steep = slope is not None and slope.violation()
    if firm or too_steep or (forcible and not force):
        lower = _remedy(profile, excitation, force=force)
        refusals += [f"{finding}; {lower}." for finding in firm]
        if slope is not None and too_steep:
            remedy = slope_remedy(excitation, slope.value, slope.limit)
            refusals.append(f"{too_steep}; {lower}{remedy}.")
        refusals += [f"{finding}; {lower}, or allow clipping with --force." for finding in forcible]
    warnings = [*clearance.warnings, *([unstable] if unstable else [])]
    if not refusals:
        warnings += [f"{finding}: it will be clipped and flagged." for finding in forcible]
    if excitation.approach is not None and not any(profile.rig.sensor.shear_projection):
        warnings.append(_NO_FORCE)
    return Plan(
        prediction,
        warnings=tuple(warnings),
        tip_in_words=tip_in_words(prediction.tip, profile.rig.beam, excitation),
        refused="\n".join(refusals),
        ending=_ending(loop, stays=excitation.stays),
        clearance=clearance,
    )


def _remedy(profile: Profile, excitation: Excitation, *, force: bool) -> str:
    """Return the remedy for an excitation that would exceed the limits."""
    if excitation.kind in NOT_IDENTIFYING:
        return "go less far or slower"
    largest_rad = largest_amplitude(profile, excitation, force=force)
    return "lower the amplitude" + ("" if largest_rad is None else f" to {largest_rad:g} rad")


def _ending(loop: ClosedLoop, *, stays: bool) -> Ending:
    """Plan the motion after the record: a vibration-free return and active damping."""
    if loop.model.beam is None:
        return Ending(stays=stays)
    return Ending(stays, tuple(map(complex, mode_poles(loop)[1])), design_damper(loop))


def largest_amplitude(
    profile: Profile, excitation: Excitation, *, force: bool = False
) -> float | None:
    """Return the largest amplitude within all limits, with unchanged other parameters.

    Parameters
    ----------
    profile, excitation
        Rig and excitation. The amplitude is ignored.
    force
        Allow clipped torques, so that only the other limits count.

    Returns
    -------
    float or None
        Amplitude in rad, rounded down to three digits. None if the excitation has no amplitude
        (``hold``, ``file``), limits it by itself (``modes``, ``until``), or no amplitude is
        possible.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response overflows.
    RealisationError
        If the beam's damping cannot be realised.
    """
    if excitation.kind in ("modes", "until") or not _has_amplitude(excitation.kind):
        return None
    loop, _ = stable_loop(profile.loop_model())
    given_rad = abs(float(excitation.parameters["amplitude_rad"]))
    # Chirps have no exemption here: the proposed amplitude is in the range of the linear model.
    steepest = _slope(profile, predict(loop, excitation))

    def fraction_at(amplitude_rad: float) -> float:
        scale = amplitude_rad / given_rad
        reference_rad = excitation.reference_rad * scale
        firm, forcible = _limited(profile, _peaks(reference_rad, loop.simulate(reference_rad)))
        if steepest is not None:
            firm += (replace(steepest, value=steepest.value * scale),)
        return _largest_fraction(firm if force else firm + forcible)

    # All peaks are proportional to the amplitude, except for the friction compensation.
    amplitude_rad = min(given_rad, _MOST_RAD)
    for _ in range(_ROUNDS):
        fraction = fraction_at(amplitude_rad)
        if not 0.0 < fraction < math.inf:
            return None
        amplitude_rad = min(amplitude_rad / fraction, _MOST_RAD)
        if 0.999 < fraction <= 1.0:
            break
    digit_rad = 10.0 ** (math.floor(math.log10(amplitude_rad)) - 2)
    digits = math.floor(amplitude_rad / digit_rad)
    while digits > 0 and not fraction_at(digits * digit_rad) <= 1.0:
        digits -= 1
    return float(f"{digits * digit_rad:.3g}") if digits else None


def plan_document(profile: Profile, excitation: Excitation, plan: Plan) -> dict[str, Any]:
    """Return a plan for JSON.

    Parameters
    ----------
    profile, excitation
        Rig and excitation of the plan.
    plan
        Result of `predict_session` or `plan_session`.
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
        "tip": tip_document(plan.prediction.tip, profile.rig.beam),
        "limits": {
            "angle_rad": profile.limits.angle_rad,
            "velocity_rad_s": profile.limits.velocity_rad_s,
            "torque_nm": profile.rig.motor.peak_torque_nm,
            "tracking_error_rad": profile.limits.tracking_error_rad,
            "coupling_torque_nm": _sensor_limit_nm(profile),
            "tip_slope_rad": profile.limits.tip_slope_rad,
        },
        "refused": plan.refused or None,
        "failed_checks": [asdict(each) for each in plan.clearance.failed],
        "tip_in_words": plan.tip_in_words,
        "beam": asdict(profile.rig.beam),
        "damping": asdict(profile.rig.damping),
        "specimen_in_words": profile.specimen_in_words,
        "warnings": list(plan.warnings),
    }


def _has_amplitude(kind: str) -> bool:
    """Return whether an excitation has an amplitude among its parameters."""
    return "amplitude_rad" in inspect.signature(KINDS[kind]).parameters


def _sweep_in_words(excitation: Excitation) -> str:
    """Describe the sweep of a chirp or the path of a move or search; else return an empty text."""
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
    back = ""
    if excitation.parameters.get("there_and_back"):
        back = f" and back, {float(excitation.parameters['duration_s']):g} s each way"
    return f"sweeps{down} from {start_hz:g} to {stop_hz:g} Hz{back}"


def _move_in_words(parameters: Mapping[str, float | int | str]) -> str:
    """Describe target, duration and predicted residual vibration of a move."""
    by_rad, angle_rad, duration_s, fraction, residual_nm, floor_nm, off_nm, quintic_nm = (
        float(parameters[name])
        for name in (
            *("by_rad", "angle_rad", "duration_s", "limits_share", "residual_nm"),
            *("residual_floor_nm", "frequency_residual_nm", "quintic_residual_nm"),
        )
    )
    arrival = "more than 1 s after that"
    if "arrival_s" in parameters:
        arrival = f"after {1e3 * float(parameters['arrival_s']):.0f} ms"
    left = f"{1e3 * residual_nm:.2g} mN·m"
    if residual_nm < floor_nm:
        left = f"below what the sensor shows ({1e3 * floor_nm:.2g} mN·m)"
    if off_nm > max(residual_nm, floor_nm):
        left += (
            f", {1e3 * off_nm:.2g} mN·m if the beam's frequencies are wrong by their uncertainty"
        )
    return (
        f"moves by {by_rad:.4g} rad to {angle_rad:.4g} rad in {1e3 * duration_s:.0f} ms, the angle "
        f"within 1 mrad {arrival} ({100 * fraction:.0f} % of the limits); vibration left {left}; "
        f"a quintic of the same time leaves {1e3 * quintic_nm:.3g} mN·m (beam of "
        f"{parameters['file'] or 'profile'})"
    )


def _search_in_words(parameters: Mapping[str, float | int | str]) -> str:
    """Describe range and speed of a search for an obstacle."""
    passes = int(parameters["passes"])
    return (
        f"goes to {float(parameters['angle_rad']):.4g} rad at {parameters['speed_rad_s']:g} rad/s"
        f"{f', {passes} times' if passes > 1 else ''}, brakes within "
        f"{1e3 * float(parameters['braking_s']):.0f} ms of a touch (beam of "
        f"{parameters['file'] or 'profile'})"
    )


def _scan_in_words(excitation: Excitation) -> str:
    """Describe the first scan and the targets of a session with a precision search."""
    assert excitation.search is not None
    start_hz, stop_hz, scan_s, amplitude_rad = (
        float(excitation.parameters[name])
        for name in ("start_hz", "stop_hz", "scan_s", "amplitude_rad")
    )
    targets = ", ".join(str(target) for target in excitation.search.targets)
    return (
        f"scans {start_hz:g} to {stop_hz:g} Hz in {scan_s:g} s at up to {amplitude_rad:.3g} rad, "
        f"then chooses the most informative excitation until {targets} (standard deviation)"
    )


def predict(loop: ClosedLoop, excitation: Excitation) -> SessionPrediction:
    """Predict the peaks of a session.

    Parameters
    ----------
    loop
        Linear closed loop of the rig.
    excitation
        Excitation of the session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response overflows.
    """
    response = loop.simulate(excitation.reference_rad)
    peaks = _peaks(excitation.reference_rad, response)
    angle_rad = response.angle_rad.copy()
    del response  # an hour of it takes 150 MB, and the tip as much again
    model = loop.model
    if model.beam is not None:
        tip = tip_motion(
            model.beam,
            model.damping,
            angle_rad,
            model.rate_hz,
            tip_mass_kg=model.tip_mass_kg,
            root_compliance_rad_per_nm=model.root_compliance_rad_per_nm,
        )
        peaks = replace(peaks, tip=tip)
    if excitation.kind not in NOT_IDENTIFYING:
        return peaks
    start_rad = float(excitation.parameters["angle_rad"]) - float(excitation.parameters["by_rad"])
    return replace(peaks, peak_angle_rad=_peak(start_rad + angle_rad))


def _peaks(reference_rad: Real, response: LoopResponse) -> SessionPrediction:
    return SessionPrediction(
        peak_angle_rad=_peak(response.angle_rad),
        peak_velocity_rad_s=_peak(response.velocity_rad_s),
        peak_torque_nm=_peak(response.torque_nm),
        peak_tracking_error_rad=_peak(reference_rad - response.angle_rad),
        peak_coupling_torque_nm=_peak(response.coupling_torque_nm),
    )


def predicted_metadata(
    profile: Profile, predicted: SessionPrediction, excitation: Excitation
) -> dict[str, str]:
    """Return the predicted peaks and their limits as metadata of a session file.

    Parameters
    ----------
    profile
        Profile of the rig, with its limits.
    predicted
        Prediction of the session.
    excitation
        Excitation of the session. Segments planned during the session have their own slope limit.

    Returns
    -------
    dict of str to str
        ``predicted_peak_…`` and ``limit_…``, with units in the names.
    """
    firm, forcible = _limited(profile, predicted)
    metadata = {}
    slope = _slope(profile, predicted)
    if slope is not None and excitation.search is not None:
        slope = replace(slope, value=max(slope.value, excitation.search.tip_slope_rad))
    for peak in (*firm, *forcible, *(() if slope is None else (slope,))):
        metadata[f"predicted_peak_{_KEYS[peak.name]}"] = repr(peak.value)
        metadata[f"limit_{_KEYS[peak.name]}"] = repr(peak.limit)
    return metadata


_KEYS = {
    "angle": "angle_rad",
    "speed": "velocity_rad_s",
    "tracking error": "tracking_error_rad",
    "coupling torque": "coupling_torque_nm",
    "torque": "torque_nm",
    "tip slope": "tip_slope_rad",
}
"""Metadata keys of the limited peaks."""


@dataclass(frozen=True, slots=True)
class _Limited:
    """Predicted peak and its limit; a NaN peak violates the limit."""

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
    profile: Profile, predicted: SessionPrediction
) -> tuple[tuple[_Limited, ...], tuple[_Limited, ...]]:
    """Return the firm limits with their peaks, and those that only clip a torque."""
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


def _slope(profile: Profile, predicted: SessionPrediction) -> _Limited | None:
    """Return the predicted tip slope with its limit for an identification; None without a beam."""
    if predicted.tip is None:
        return None
    key, limit_rad = "limits.tip_slope_rad", profile.limits.tip_slope_rad
    return _Limited("tip slope", predicted.tip.slope_rad, limit_rad, "rad", key)


def _largest_fraction(channels: tuple[_Limited, ...]) -> float:
    """Return the largest predicted peak as a fraction of its limit; NaN if a peak is NaN."""
    fractions = [channel.value / channel.limit for channel in channels]
    return math.nan if any(map(math.isnan, fractions)) else max(fractions)


def _sensor_limit_nm(profile: Profile) -> float:
    """Return the coupling torque at which an axis of the sensor first reaches limit or range.

    The wrench of a coupling torque is the smallest one that projects to it.
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
