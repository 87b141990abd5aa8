"""Controllers for the sessions of an identification: cautious for the trial, then by its result."""

from dataclasses import replace

from rigd.control import ControlDesignError, check_stability, close_loop
from rigd.identification.motor_estimate import MotorEstimate
from rigd.profile import Profile

_CAUTIOUS_POLES_RAD_S = (40.0, 50.0, 63.0)
"""At 40 rad/s the loop is stable for motors from a quarter to four times the inertia that the
profile states, and for command delays up to 2.4 ms. A quicker one minds the delay of a light motor
more; a slower one lets the beam take hold of the motor, and already 40 is too slow for the lightest
ones."""


def cautious(profile: Profile) -> Profile:
    """Return a profile with the slowest controller that holds its beam, and bears wrong data."""
    for pole_rad_s in _CAUTIOUS_POLES_RAD_S:
        if pole_rad_s < profile.control.pole_rad_s:
            slow = replace(profile, control=replace(profile.control, pole_rad_s=pole_rad_s))
            if _is_stable(slow):
                return slow
    return profile


def tuned(profile: Profile, estimate: MotorEstimate) -> Profile:
    """Return a profile whose controller fits an estimate.

    The commands keep their scale: inertia, friction and feed-forward are divided by it instead.
    Where the loop is not stable with the profile's pole, it gets a cautious one.
    """
    scale = estimate.torque_scale.value
    motor = replace(
        profile.rig.motor,
        inertia_kg_m2=estimate.inertia_kg_m2.value / scale,
        viscous_nm_s_per_rad=max(0.0, estimate.viscous_nm_s_per_rad.value) / scale,
    )
    control = replace(profile.control, feedforward_gain=profile.control.feedforward_gain / scale)
    fitted = replace(profile, design_motor=motor, control=control)
    return fitted if _is_stable(fitted) else cautious(fitted)


def _is_stable(profile: Profile) -> bool:
    try:
        check_stability(close_loop(profile.loop_model()))
    except ControlDesignError:
        return False
    return True
