"""Planning of a session before any motion: loop stability, predicted peaks, and limits."""

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Plant, undamped_frequencies_rad_s
from rigd.beam.realisation import RealisationError
from rigd.beam.tip import TipMotion, tip_motion
from rigd.checks import OfflineCheckResult, run_offline_checks
from rigd.control import ClosedLoop, ControlDesignError, stable_loop
from rigd.control.damper import design_damper
from rigd.engine.messages import PostRecordPlan
from rigd.errors import UserError
from rigd.excitation import KINDS, BeamEstimate, Excitation, MovePlant, OptionValue, make_excitation
from rigd.identified_beam import BeamUse, read_identified_beam
from rigd.profile import Profile
from rigd.runner._move_plant import (
    loop_model_with,
    mode_poles,
    move_plant_of,
    torque_noise_nm,
)
from rigd.runner._tip_slope import (
    KINDS_WITH_TARGET_ANGLE,
    has_slope_limit,
    slope_remedy,
    tip_document,
    tip_in_words,
)

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


_MAX_AMPLITUDE_RAD = 2.0 * math.pi
"""Maximum amplitude in rad that `largest_amplitude` proposes."""
_MAX_AMPLITUDE_ITERATIONS = 10
"""Maximum number of iterations of the search for the largest amplitude, which takes 3 or 4."""
_UNKNOWN_FORCE_WARNING = (
    "Without sensor.shear_projection in the profile the contact force is not known: force_limit_n "
    "(--force-limit) has no effect, and points are less precise."
)
_STEP_FRACTION = 0.2
"""Fraction of the largest angle that the reference of a step reaches with its first change."""


class RefusedError(UserError):
    """Raised if a session is refused, for example because it would exceed limits."""


@dataclass(frozen=True, slots=True)
class SessionPrediction:
    """Predicted peak magnitudes of angle, speed and torques in a session.

    The prediction uses the linear closed loop without torque limit. A torque command that the drive
    would limit therefore appears as a peak above the motor's peak torque.
    """

    peak_angle_rad: float
    """Peak magnitude of the motor angle, relative to the rig's zero."""
    peak_velocity_rad_s: float
    """Peak speed of the output shaft."""
    peak_torque_nm: float
    """Peak magnitude of the torque command at the output shaft."""
    peak_tracking_error_rad: float
    """Peak magnitude of the tracking error (reference minus angle)."""
    peak_coupling_torque_nm: float
    """Peak magnitude of the torque between hub and antenna."""
    tip: TipMotion | None = None
    """Predicted motion of the beam's free end in a vacuum, or None if it was not predicted."""


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """Prediction of a session before any motion, and whether the session is allowed."""

    prediction: SessionPrediction
    """Predicted peak magnitudes."""
    warnings: tuple[str, ...]
    """Warnings for the operator, one sentence each."""
    tip_in_words: str
    """Sentence on the predicted motion of the beam's free end and the linear model's validity."""
    refusal_text: str = ""
    """Reasons to refuse the session, one line for each; empty if the session is allowed."""
    ending: PostRecordPlan = field(default_factory=PostRecordPlan)
    """Motion that the control process makes after the record, such as the return to the start."""
    offline_check_result: OfflineCheckResult = field(default_factory=OfflineCheckResult)
    """Results of the checks on the profile that need no device."""


class RigPreview:
    """Model of a rig's closed loop, with which excitations are designed before any motion.

    Parameters
    ----------
    profile
        Profile of the rig. The closed loop is computed when it is first needed.
    start_angle_rad
        Motor angle at the start of the session, relative to the rig's zero.
    """

    def __init__(self, profile: Profile, start_angle_rad: float = 0.0) -> None:
        self._profile = profile
        self.start_rad = start_angle_rad
        self._last_estimated_plant: tuple[Plant, MovePlant] | None = None

    @property
    def beam(self) -> Beam:
        """Beam that the profile states."""
        return self._profile.rig.beam

    @property
    def uniformity(self) -> float:
        """Relative standard deviation of the mode frequencies from those of a uniform beam."""
        return self._profile.uncertainty.uniformity_percent / 100.0

    @property
    def stated_estimate(self) -> BeamEstimate:
        """Beam estimate with the profile's values and sensor noise, to design excitations."""
        rig = self._profile.rig
        noise_density_nm2_per_hz = 2.0 * torque_noise_nm(self._profile) ** 2 / rig.rate_hz
        return BeamEstimate.from_plant(self._profile.plant, noise_density_nm2_per_hz)

    @cached_property
    def _closed_loop(self) -> ClosedLoop:
        """Stable closed loop with the beam of the profile."""
        return stable_loop(self._profile.loop_model())[0]

    def tracking_response(self, frequency_hz: RealArray) -> ComplexArray:
        """Return the closed loop's frequency response from reference angle to motor angle.

        The result has the shape of `frequency_hz`.
        """
        return self._closed_loop.response(frequency_hz)

    def fraction_of_limits(self, reference_rad: RealArray) -> float:
        """Return the largest ratio of a peak to its limit that a reference angle (n,) would cause.

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the predicted response overflows.
        """
        predicted_peaks, _ = _peaks_and_angle(self._closed_loop, reference_rad)
        unclippable_peaks, clippable_peaks = _limited_peaks(self._profile, predicted_peaks)
        return _largest_fraction(unclippable_peaks + clippable_peaks)

    def move_plant(self, path: str | Path, use: BeamUse) -> MovePlant:
        """Return the model of motor, beam and closed loop that is used to plan a move.

        Parameters
        ----------
        path
            Path of a document of ``analyze --json`` with an identified beam; empty for the beam of
            the profile.
        use
            Purpose of the model, which determines the effects that the identified beam may have.

        Raises
        ------
        IdentifiedBeamError
            If the document is invalid, or has an effect that this use does not model.
        ControlDesignError
            If the loop is unstable with the identified beam.
        RealisationError
            If the beam's damping cannot be realised by a model with poles.
        """
        identified_beam = read_identified_beam(path, self._profile.plant, use) if path else None
        loop_model = loop_model_with(self._profile, identified_beam)
        return move_plant_of(
            self._profile, loop_model, _sensor_limit_nm(self._profile), identified_beam
        )

    def tip_slope_rad(self, reference_rad: RealArray) -> float:
        """Return the predicted peak slope of the beam's free end for a reference angle (n,)."""
        angle_rad = self._closed_loop.simulate(reference_rad).angle_rad
        return tip_motion(self._profile.plant, angle_rad, self._profile.rig.rate_hz).slope_rad

    def plant_with(self, plant: Plant) -> MovePlant:
        """Return the model of motor, estimated beam and closed loop for the design of excitation.

        If the loop cannot be computed with the estimated damping, the damping of the profile is
        used. This affects the motor little, because the coupling torque is fed forward. The last
        model is cached.

        Parameters
        ----------
        plant
            Estimated beam with its clamp and tip. Its delay and tool inertia are replaced by those
            of the profile.

        Raises
        ------
        ControlDesignError
            If the loop is unstable with the estimated beam.
        RealisationError
            If neither damping can be realised by a model with poles.
        """
        if self._last_estimated_plant is not None and self._last_estimated_plant[0] == plant:
            return self._last_estimated_plant[1]
        profile, stated_plant = self._profile, self._profile.plant
        loop_model, coupling_limit_nm = profile.loop_model(), _sensor_limit_nm(profile)
        # An early estimate of the torque channel is less accurate than the profile.
        estimated_plant = replace(
            plant, delay_s=stated_plant.delay_s, tool_inertia_kg_m2=stated_plant.tool_inertia_kg_m2
        )
        try:
            move_plant = move_plant_of(
                profile, replace(loop_model, plant=estimated_plant), coupling_limit_nm
            )
        except (ControlDesignError, RealisationError):
            plant_with_stated_damping = replace(estimated_plant, damping=stated_plant.damping)
            move_plant = move_plant_of(
                profile, replace(loop_model, plant=plant_with_stated_damping), coupling_limit_nm
            )
        self._last_estimated_plant = plant, move_plant
        return move_plant


def excitation_for(
    profile: Profile,
    excitation_kind: str,
    excitation_parameters: Mapping[str, OptionValue],
    start_angle_rad: float = 0.0,
) -> Excitation:
    """Return the excitation with the given kind and parameters for the rig of a profile.

    Parameters
    ----------
    profile
        Profile of the rig.
    excitation_kind, excitation_parameters
        Name and parameters of the excitation, as for `rigd.excitation.make_excitation`.
    start_angle_rad
        Motor angle at the start of the session, relative to the rig's zero. Only moves need it.
    """
    if "tip_slope_rad" in inspect.signature(KINDS[excitation_kind]).parameters:
        excitation_parameters = {"tip_slope_rad": profile.limits.tip_slope_rad} | dict(
            excitation_parameters
        )
    return make_excitation(
        excitation_kind,
        excitation_parameters,
        profile.rig.rate_hz,
        RigPreview(profile, start_angle_rad),
    )


def plan_session(
    profile: Profile,
    excitation: Excitation,
    *,
    allows_saturation: bool = False,
    accepted_row_names: Sequence[str] = (),
) -> SessionPlan:
    """Return the plan of a session; raise if checks or limits of the profile forbid the session.

    Parameters
    ----------
    profile, excitation, allows_saturation, accepted_row_names
        See `predict_session`.

    Raises
    ------
    CheckFailedError, UnknownRowError
        If a check of the profile fails and is not accepted, or `accepted_row_names` contains an
        unknown name.
    RefusedError
        If the session would exceed limits. The message names these limits and the largest possible
        amplitude.
    ControlDesignError, RealisationError, UnknownValueError
        As `predict_session` does.
    """
    plan = predict_session(
        profile,
        excitation,
        allows_saturation=allows_saturation,
        accepted_row_names=accepted_row_names,
    )
    plan.offline_check_result.require_passed()
    if plan.refusal_text:
        raise RefusedError(plan.refusal_text)
    return plan


def predict_session(
    profile: Profile,
    excitation: Excitation,
    *,
    allows_saturation: bool = False,
    accepted_row_names: Sequence[str] = (),
) -> SessionPlan:
    """Return the plan of a session, whose field `refusal_text` states why it is refused, if it is.

    Parameters
    ----------
    profile, excitation
        Profile of the rig, and excitation of the session.
    allows_saturation
        Whether the torques of motor and sensor may be clipped. All other limits always apply,
        because exceeding them would end the session.
    accepted_row_names
        Names of rows of `rigd check` that may fail.

    Raises
    ------
    UnknownRowError
        If `accepted_row_names` contains an unknown name.
    UnknownValueError
        If a required value of the profile is stated as unknown.
    ControlDesignError
        If the loop is unstable.
    RealisationError
        If the beam's damping cannot be realised by a model with poles.
    """
    offline_check = run_offline_checks(profile, accepted_row_names)
    closed_loop, instability_warning = stable_loop(loop_model_with(profile, excitation.model))
    prediction = predict(closed_loop, excitation)
    violations, torque_violations = (
        [
            violation_text
            for limited_peak in limited_peaks
            if (violation_text := limited_peak.violation_text())
        ]
        for limited_peaks in _limited_peaks(profile, prediction)
    )
    refusals = list(offline_check.refusals)
    tip_slope = _limited_tip_slope(profile, prediction) if has_slope_limit(excitation) else None
    slope_violation = tip_slope is not None and tip_slope.violation_text()
    if violations or slope_violation or (torque_violations and not allows_saturation):
        amplitude_advice = _amplitude_advice(
            profile, excitation, allows_saturation=allows_saturation
        )
        refusals += [f"{violation_text}; {amplitude_advice}." for violation_text in violations]
        if tip_slope is not None and slope_violation:
            slope_advice = slope_remedy(excitation, tip_slope.value, tip_slope.limit)
            refusals.append(f"{slope_violation}; {amplitude_advice}{slope_advice}.")
        refusals += [
            f"{violation_text}; {amplitude_advice}, or allow clipping with --force."
            for violation_text in torque_violations
        ]
    warnings = [*offline_check.warnings, *([instability_warning] if instability_warning else [])]
    if not profile.is_loop_modelled:
        warnings.append(
            f'The peaks are predicted with the PID of [control]: controller "'
            f'{profile.control.controller}" states no matrices.'
        )
    if not refusals:
        warnings += [
            f"{violation_text}: it will be clipped and flagged."
            for violation_text in torque_violations
        ]
    if excitation.limits_force and not any(profile.rig.sensor.shear_projection):
        warnings.append(_UNKNOWN_FORCE_WARNING)
    if short_rest_warning := _short_rest_warning(profile, excitation):
        warnings.append(short_rest_warning)
    return SessionPlan(
        prediction,
        warnings=tuple(warnings),
        tip_in_words=tip_in_words(prediction.tip, profile.rig.beam, excitation),
        refusal_text="\n".join(refusals),
        ending=_motion_after_record(
            closed_loop, stays_at_end=excitation.stays, is_controller_known=profile.is_loop_modelled
        ),
        offline_check_result=offline_check,
    )


def _amplitude_advice(profile: Profile, excitation: Excitation, *, allows_saturation: bool) -> str:
    """Return advice, as part of an error message, on how to change an excitation within limits."""
    if excitation.kind in KINDS_WITH_TARGET_ANGLE:
        return "reduce the angle or the speed"
    largest_amplitude_rad = largest_amplitude(
        profile, excitation, allows_saturation=allows_saturation
    )
    return "lower the amplitude" + (
        "" if largest_amplitude_rad is None else f" to {largest_amplitude_rad:g} rad"
    )


def _motion_after_record(
    closed_loop: ClosedLoop, *, stays_at_end: bool, is_controller_known: bool
) -> PostRecordPlan:
    """Return the plan for the motion after the record: active damping, then the return.

    `stays_at_end` states that the motor does not return to its start. `is_controller_known` must be
    False if the controller is not known, for which active damping cannot be designed.
    """
    if closed_loop.model.plant is None:
        return PostRecordPlan(stays=stays_at_end)
    damper = design_damper(closed_loop) if is_controller_known else None
    return PostRecordPlan(stays_at_end, tuple(map(complex, mode_poles(closed_loop)[1])), damper)


def largest_amplitude(
    profile: Profile, excitation: Excitation, *, allows_saturation: bool = False
) -> float | None:
    """Return the largest amplitude with which an excitation stays within all limits.

    All other parameters of the excitation stay the same.

    Parameters
    ----------
    profile, excitation
        Profile of the rig, and excitation; the amplitude of the excitation is ignored.
    allows_saturation
        Whether torques may be clipped, so that the torque limits are ignored.

    Returns
    -------
    float or None
        Amplitude in rad, rounded down to three digits. None if the excitation has no amplitude
        (``hold``, ``file``), chooses its own amplitude (``modes``, ``until``), or no amplitude is
        possible.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the predicted response overflows.
    RealisationError
        If the beam's damping cannot be realised by a model with poles.
    """
    if excitation.kind in ("modes", "until") or not _has_amplitude(excitation.kind):
        return None
    closed_loop, _ = stable_loop(profile.loop_model())
    stated_amplitude_rad = abs(float(excitation.parameters["amplitude_rad"]))
    # Chirps are not exempt here, so that the linear model is valid for the proposed amplitude.
    tip_slope = _limited_tip_slope(profile, predict(closed_loop, excitation))

    def largest_fraction_at(amplitude_rad: float) -> float:
        amplitude_scale = amplitude_rad / stated_amplitude_rad
        reference_rad = excitation.reference_rad * amplitude_scale
        predicted_peaks, _ = _peaks_and_angle(closed_loop, reference_rad)
        unclippable_peaks, clippable_peaks = _limited_peaks(profile, predicted_peaks)
        if tip_slope is not None:
            unclippable_peaks += (replace(tip_slope, value=tip_slope.value * amplitude_scale),)
        return _largest_fraction(
            unclippable_peaks if allows_saturation else unclippable_peaks + clippable_peaks
        )

    # All peaks are proportional to the amplitude, except for the friction compensation.
    amplitude_rad = min(stated_amplitude_rad, _MAX_AMPLITUDE_RAD)
    for _ in range(_MAX_AMPLITUDE_ITERATIONS):
        limit_fraction = largest_fraction_at(amplitude_rad)
        if not 0.0 < limit_fraction < math.inf:
            return None
        amplitude_rad = min(amplitude_rad / limit_fraction, _MAX_AMPLITUDE_RAD)
        if 0.999 < limit_fraction <= 1.0:
            break
    digit_step_rad = 10.0 ** (math.floor(math.log10(amplitude_rad)) - 2)
    digit_count = math.floor(amplitude_rad / digit_step_rad)
    while digit_count > 0 and not largest_fraction_at(digit_count * digit_step_rad) <= 1.0:
        digit_count -= 1
    return float(f"{digit_count * digit_step_rad:.3g}") if digit_count else None


def plan_document(profile: Profile, excitation: Excitation, plan: SessionPlan) -> dict[str, Any]:
    """Return the plan of a session as a dictionary for JSON.

    Parameters
    ----------
    profile, excitation
        Profile of the rig, and excitation of the session.
    plan
        Result of `predict_session` or `plan_session`.
    """
    return {
        "excitation": excitation.kind,
        "sweep": excitation.motion,
        "profile": profile.name,
        "parameters": dict(excitation.parameters),
        "segments": {
            name: list(segment_ticks) for name, segment_ticks in excitation.segments.items()
        },
        "record_s": excitation.reference_rad.size / profile.rig.rate_hz,
        "ends_itself": excitation.ends_itself,
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
        "refused": plan.refusal_text or None,
        "failed_checks": [
            asdict(failed_check) for failed_check in plan.offline_check_result.failed
        ],
        "tip_in_words": plan.tip_in_words,
        "beam": asdict(profile.rig.beam),
        "damping": asdict(profile.rig.damping),
        "specimen_in_words": profile.specimen_in_words,
        "warnings": list(plan.warnings),
    }


def _has_amplitude(excitation_kind: str) -> bool:
    """Return whether a kind of excitation has a parameter ``amplitude_rad``."""
    return "amplitude_rad" in inspect.signature(KINDS[excitation_kind]).parameters


def predict(closed_loop: ClosedLoop, excitation: Excitation) -> SessionPrediction:
    """Return the peaks of angle, speed and torques that are predicted for a session.

    Parameters
    ----------
    closed_loop
        Linear closed loop of the rig.
    excitation
        Excitation of the session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the predicted response overflows.
    """
    predicted_peaks, angle_rad = _peaks_and_angle(closed_loop, excitation.reference_rad)
    loop_model = closed_loop.model
    if loop_model.plant is not None:
        tip = tip_motion(loop_model.plant, angle_rad, loop_model.rate_hz)
        predicted_peaks = replace(predicted_peaks, tip=tip)
    if excitation.kind not in KINDS_WITH_TARGET_ANGLE:
        return predicted_peaks
    start_angle_rad = float(excitation.parameters["angle_rad"]) - float(
        excitation.parameters["by_rad"]
    )
    return replace(predicted_peaks, peak_angle_rad=_peak_magnitude(start_angle_rad + angle_rad))


def _peaks_and_angle(
    closed_loop: ClosedLoop, reference_rad: RealArray
) -> tuple[SessionPrediction, RealArray]:
    """Return the peak magnitudes in the response to a reference (n,), and the angle (n,) in rad.

    The response is computed in chunks, because the response of an hour would take 150 MB.
    """
    angle_rad = np.empty(reference_rad.size)
    peak_magnitudes = np.zeros(5)
    chunk_end = 0
    for chunk in closed_loop.simulate_in_chunks(reference_rad):
        chunk_begin, chunk_end = chunk_end, chunk_end + chunk.angle_rad.size
        angle_rad[chunk_begin:chunk_end] = chunk.angle_rad
        signals = (
            chunk.angle_rad,
            chunk.velocity_rad_s,
            chunk.torque_nm,
            reference_rad[chunk_begin:chunk_end] - chunk.angle_rad,
            chunk.coupling_torque_nm,
        )
        peak_magnitudes = np.maximum(
            peak_magnitudes, [_peak_magnitude(signal) for signal in signals]
        )
    angle, velocity, torque, tracking_error, coupling_torque = map(float, peak_magnitudes)
    prediction = SessionPrediction(angle, velocity, torque, tracking_error, coupling_torque)
    return prediction, angle_rad


def predicted_metadata(
    profile: Profile, prediction: SessionPrediction, excitation: Excitation
) -> dict[str, str]:
    """Return the predicted peaks and their limits as metadata of a session file.

    Parameters
    ----------
    profile
        Profile of the rig, with its limits.
    prediction
        Predicted peaks of the session.
    excitation
        Excitation of the session. The stated peak of the tip slope includes segments that are
        planned during the session.

    Returns
    -------
    dict of str to str
        Keys ``predicted_peak_…`` and ``limit_…`` with their units → numbers as texts.
    """
    unclippable_peaks, clippable_peaks = _limited_peaks(profile, prediction)
    metadata = {}
    tip_slope = _limited_tip_slope(profile, prediction)
    if tip_slope is not None:
        largest_tip_slope_rad = max(tip_slope.value, excitation.later_tip_slope_rad)
        tip_slope = replace(tip_slope, value=largest_tip_slope_rad)
    for limited_peak in (
        *unclippable_peaks,
        *clippable_peaks,
        *(() if tip_slope is None else (tip_slope,)),
    ):
        metadata[f"predicted_peak_{_METADATA_KEY_BY_PEAK[limited_peak.name]}"] = repr(
            limited_peak.value
        )
        metadata[f"limit_{_METADATA_KEY_BY_PEAK[limited_peak.name]}"] = repr(limited_peak.limit)
    return metadata


_METADATA_KEY_BY_PEAK = {
    "angle": "angle_rad",
    "speed": "velocity_rad_s",
    "tracking error": "tracking_error_rad",
    "coupling torque": "coupling_torque_nm",
    "torque": "torque_nm",
    "tip slope": "tip_slope_rad",
}
"""Name of a limited peak → its metadata key without ``predicted_peak_`` or ``limit_``."""


@dataclass(frozen=True, slots=True)
class _LimitedPeak:
    """Predicted peak of a quantity, and its limit in the profile; a NaN peak exceeds the limit."""

    name: str
    value: float
    limit: float
    unit: str
    limit_key: str

    def violation_text(self) -> str | None:
        """Return text that states how the peak exceeds the limit, or None if it does not."""
        if self.value <= self.limit:
            return None
        return (
            f"The predicted peak {self.name} of {self.value:.4g} {self.unit} exceeds "
            f"{self.limit:.4g} {self.unit} ({self.limit_key})"
        )


def _short_rest_warning(profile: Profile, excitation: Excitation) -> str:
    """Return a warning if the beam rests for less than a period before a step, else "".

    Otherwise the decay after the step may be that of a beam that was ringing before.
    """
    distance_rad = np.abs(excitation.reference_rad - excitation.reference_rad[0])
    first_tick = int(np.argmax(distance_rad > 0))
    is_step = distance_rad[first_tick] > _STEP_FRACTION * distance_rad.max()
    rest_s = first_tick / profile.rig.rate_hz
    period_s = 2 * math.pi / undamped_frequencies_rad_s(profile.rig.beam, 1)[0]
    if not (is_step and excitation.shows_modes) or rest_s >= period_s:
        return ""
    least_rest_s = math.ceil(10 * period_s) / 10
    return (
        f"The motor steps {rest_s:g} s after the record begins. analyze may not distinguish its "
        "effect from a vibration that was there before: rest for at least a period of mode 1 "
        f"(--rest {least_rest_s:g})."
    )


def _limited_peaks(
    profile: Profile, prediction: SessionPrediction
) -> tuple[tuple[_LimitedPeak, ...], tuple[_LimitedPeak, ...]]:
    """Return the peaks whose limits always apply, then the torque peaks that may be clipped."""
    limits, motor_parameters = profile.limits, profile.rig.motor
    unclippable_peaks = (
        _LimitedPeak(
            "angle", prediction.peak_angle_rad, limits.angle_rad, "rad", "limits.angle_rad"
        ),
        _LimitedPeak(
            "speed",
            prediction.peak_velocity_rad_s,
            limits.velocity_rad_s,
            "rad/s",
            "limits.velocity_rad_s",
        ),
        _LimitedPeak(
            "tracking error",
            prediction.peak_tracking_error_rad,
            limits.tracking_error_rad,
            "rad",
            "limits.tracking_error_rad",
        ),
    )
    clippable_peaks = (
        _LimitedPeak(
            "coupling torque",
            prediction.peak_coupling_torque_nm,
            _sensor_limit_nm(profile),
            "N·m",
            "sensor.range",
        ),
        _LimitedPeak(
            "torque",
            prediction.peak_torque_nm,
            motor_parameters.peak_torque_nm,
            "N·m",
            "motor.peak_torque_nm",
        ),
    )
    return unclippable_peaks, clippable_peaks


def _limited_tip_slope(profile: Profile, prediction: SessionPrediction) -> _LimitedPeak | None:
    """Return the predicted tip slope and its limit for identification, or None without a beam."""
    if prediction.tip is None:
        return None
    limit_key, limit_rad = "limits.tip_slope_rad", profile.limits.tip_slope_rad
    return _LimitedPeak("tip slope", prediction.tip.slope_rad, limit_rad, "rad", limit_key)


def _largest_fraction(limited_peaks: tuple[_LimitedPeak, ...]) -> float:
    """Return the largest ratio of a predicted peak to its limit, or NaN if a peak is NaN."""
    limit_fractions = [limited_peak.value / limited_peak.limit for limited_peak in limited_peaks]
    return math.nan if any(map(math.isnan, limit_fractions)) else max(limit_fractions)


def _sensor_limit_nm(profile: Profile) -> float:
    """Return the coupling torque in N·m at which a sensor axis reaches its limit.

    The smallest of all wrenches with the same coupling torque is assumed.
    """
    sensor = profile.rig.sensor
    projection_norm_squared = sum(p * p for p in sensor.projection)
    usable_fraction = min(1.0, profile.limits.sensor_range_percent / 100)
    return min(
        usable_fraction * axis_limit * projection_norm_squared / abs(p)
        for p, axis_limit in zip(sensor.projection, sensor.range, strict=True)
        if p != 0.0
    )


def _peak_magnitude(signal_values: RealArray) -> float:
    """Return the largest magnitude in an array."""
    return float(np.max(np.abs(signal_values)))
