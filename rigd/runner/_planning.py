"""Planning of a session, before anything moves: stability of the loop, peaks, limits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigd.beam import SMALL_SLOPE_RAD, Beam, TipMotion, tip_motion
from rigd.control import ClosedLoop, LoopResponse, check_stability, close_loop
from rigd.errors import UserError
from rigd.excitation import Excitation, Value, make_excitation
from rigd.profile import Profile

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


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
    """A session that stays within the limits."""

    prediction: Prediction
    """What the session is predicted to do."""
    warnings: tuple[str, ...]
    """Sentences for the operator."""
    tip_in_words: str
    """What the free end will do, and whether the linear model holds there."""


class LoopPreview:
    """Loop preview: what an excitation made for one rig may know of it.

    Parameters
    ----------
    profile
        Profile of the rig. Its closed loop is computed when first needed.
    """

    def __init__(self, profile: Profile) -> None:
        self._profile = profile

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
        return max(channel.value / channel.limit for channel in firm + forcible)


def excitation_for(profile: Profile, kind: str, parameters: Mapping[str, Value]) -> Excitation:
    """Make an excitation for a rig: see `rigd.excitation._named.make_excitation`.

    Parameters
    ----------
    profile
        Profile of the rig.
    kind, parameters
        Name and options of the excitation.
    """
    return make_excitation(kind, parameters, profile.rig.rate_hz, LoopPreview(profile))


def plan_session(profile: Profile, excitation: Excitation, *, force: bool = False) -> Plan:
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
    RefusedError
        Naming every limit the session would leave.
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
    if firm or (forcible and not force):
        refusals = [f"{finding}; lower the amplitude." for finding in firm]
        refusals += [
            f"{finding}; lower the amplitude, or let it be clipped with --force."
            for finding in forcible
        ]
        raise RefusedError("\n".join(refusals))
    clipped = [f"{finding}: it will be clipped and flagged." for finding in forcible]
    warnings = tuple(([unstable] if unstable else []) + clipped)
    return Plan(prediction, warnings, _tip_in_words(prediction, profile.rig.beam))


def predict(loop: ClosedLoop, excitation: Excitation) -> Prediction:
    """Predict the peaks of a session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response grows beyond all numbers.
    """
    response = loop.simulate(excitation.reference_rad)
    model = loop.model
    tip = None
    if model.beam is not None:
        tip = tip_motion(model.beam, model.damping, response.angle_rad, model.rate_hz)
    return _peaks(excitation.reference_rad, response, tip)


def _peaks(reference_rad: Real, response: LoopResponse, tip: TipMotion | None = None) -> Prediction:
    return Prediction(
        peak_angle_rad=_peak(response.angle_rad),
        peak_velocity_rad_s=_peak(response.velocity_rad_s),
        peak_torque_nm=_peak(response.torque_nm),
        peak_tracking_error_rad=_peak(reference_rad - response.angle_rad),
        peak_coupling_torque_nm=_peak(response.coupling_torque_nm),
        tip=tip,
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


def _tip_in_words(predicted: Prediction, beam: Beam) -> str:
    tip = predicted.tip
    if tip is None:
        return ""
    share = tip.deflection_m / beam.length_m
    motion = (
        f"Predicted tip motion: {tip.deflection_m:.3g} m from the line of the root "
        f"({100 * share:.2g} % of the length), {tip.speed_m_s:.3g} m/s through the air, slope "
        f"{tip.slope_rad:.2g} rad."
    )
    if not tip.slope_rad > SMALL_SLOPE_RAD:
        return motion
    lower = math.floor(100 * SMALL_SLOPE_RAD / tip.slope_rad) / 100
    within = f"; {lower:g} times the amplitude stays within" if lower > 0 else ""
    return (
        f"{motion} Slopes beyond {SMALL_SLOPE_RAD:g} rad are not small: the linear model leaves "
        f"out up to {100 * tip.slope_rad**2 / 3:.2g} % of what bends and moves, and air drag may "
        f"limit the motion{within}."
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
    """A predicted peak and its limit; a peak that is no number violates it."""

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
