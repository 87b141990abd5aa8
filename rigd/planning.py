"""What a session will do, before anything moves: stability of the loop, peaks, limits."""

from dataclasses import dataclass

from rigd.control import check_stability, close_loop
from rigd.excitation import Excitation
from rigd.profile import Profile
from rigd.safety import Prediction, predict, violations


class RefusedError(Exception):
    """A session would leave the limits of the profile; the message says which, and the remedy."""


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
        Let a session run saturated; no other limit can be forced.

    Raises
    ------
    RefusedError
        Naming every limit the session would leave.
    ControlDesignError
        If the loop is unstable.
    RealisationError
        If the beam's damping cannot be realised.
    """
    rig = profile.rig
    loop = close_loop(profile.loop_model())
    warning = check_stability(loop)
    prediction = predict(loop, excitation, torque_limit_nm=rig.motor.peak_torque_nm)
    found = violations(
        prediction,
        profile.limits,
        torque_limit_nm=rig.motor.peak_torque_nm,
        coupling_torque_limit_nm=_sensor_limit_nm(profile),
    )
    refusing = [v.sentence for v in found if not (force and v.may_be_forced)]
    if refusing:
        raise RefusedError("\n".join(refusing))
    forced = [v.sentence for v in found]
    return Plan(prediction, tuple([warning] if warning else []) + tuple(forced))


def _sensor_limit_nm(profile: Profile) -> float:
    """Coupling torque at which the first axis of the sensor reaches its limit.

    The wrench of a coupling torque is taken as the smallest one that projects to it.
    """
    sensor = profile.rig.sensor
    weight = sum(p * p for p in sensor.projection)
    used = profile.limits.sensor_range_percent / 100
    return min(
        used * limit * weight / abs(p)
        for p, limit in zip(sensor.projection, sensor.range, strict=True)
        if p != 0.0
    )
