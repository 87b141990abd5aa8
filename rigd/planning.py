"""What a session will do, before anything moves: stability of the loop, peaks, limits."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control import ClosedLoop, check_stability, close_loop
from rigd.excitation import Excitation
from rigd.profile import Profile

Real = NDArray[np.float64]


class RefusedError(Exception):
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


@dataclass(frozen=True, slots=True)
class Plan:
    """A session that may be run."""

    prediction: Prediction
    warnings: tuple[str, ...]


def plan_session(profile: Profile, excitation: Excitation, *, force: bool = False) -> Plan:
    """Predict a session and compare it with the profile's limits.

    Parameters
    ----------
    profile, excitation
        What is to be run.
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
    firm, forcible = _violations(profile, prediction)
    if firm or (forcible and not force):
        refusals = [f"{finding}; lower the amplitude." for finding in firm]
        refusals += [
            f"{finding}; lower the amplitude, or let it be clipped with --force."
            for finding in forcible
        ]
        raise RefusedError("\n".join(refusals))
    clipped = [f"{finding}: it will be clipped and flagged." for finding in forcible]
    return Plan(prediction, tuple(([unstable] if unstable else []) + clipped))


def predict(loop: ClosedLoop, excitation: Excitation) -> Prediction:
    """Predict the peaks of a session.

    Raises
    ------
    ControlDesignError
        If the loop is unstable and the response grows beyond all numbers.
    """
    response = loop.simulate(excitation.reference_rad)
    return Prediction(
        peak_angle_rad=_peak(response.angle_rad),
        peak_velocity_rad_s=_peak(response.velocity_rad_s),
        peak_torque_nm=_peak(response.torque_nm),
        peak_tracking_error_rad=_peak(excitation.reference_rad - response.angle_rad),
        peak_coupling_torque_nm=_peak(response.coupling_torque_nm),
    )


def _violations(profile: Profile, predicted: Prediction) -> tuple[list[str], list[str]]:
    """Return what no session may do, and what clips a torque; a peak that is no number violates."""
    limits, motor = profile.limits, profile.rig.motor
    firm = (
        ("angle", predicted.peak_angle_rad, limits.angle_rad, "rad", "limits.angle_rad"),
        (
            "speed",
            predicted.peak_velocity_rad_s,
            limits.velocity_rad_s,
            "rad/s",
            "limits.velocity_rad_s",
        ),
        (
            "tracking error",
            predicted.peak_tracking_error_rad,
            limits.tracking_error_rad,
            "rad",
            "limits.tracking_error_rad",
        ),
    )
    forcible = (
        (
            "coupling torque",
            predicted.peak_coupling_torque_nm,
            _sensor_limit_nm(profile),
            "N·m",
            "sensor.range",
        ),
        ("torque", predicted.peak_torque_nm, motor.peak_torque_nm, "N·m", "motor.peak_torque_nm"),
    )
    found_firm, found_forcible = (
        [
            f"The predicted peak {channel} of {value:.4g} {unit} exceeds {limit:.4g} {unit} ({key})"
            for channel, value, limit, unit, key in channels
            if not value <= limit
        ]
        for channels in (firm, forcible)
    )
    return found_firm, found_forcible


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
