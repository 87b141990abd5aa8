"""Pole-placement design of the motor's 2DOF PID with low-pass filters.

The motor seen from its output shaft is ``G_m = K/(s (s + g))`` with ``K = 1/J`` and ``g = B/J``.
The beam does not appear in it: its measured coupling torque is fed forward.
"""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le


class ControlDesignError(ValueError):
    """The controller asked for cannot be designed, or its closed loop is unstable."""


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """What a profile chooses about the controller."""

    pole_rad_s: Annotated[float, Gt(0)]
    """All four poles of the nominal closed loop lie at minus this."""
    feedforward_gain: Annotated[float, Ge(0), Le(2)]
    """Part of the measured coupling torque that is added to the command; 1 cancels the beam."""
    friction_compensation_nm: Annotated[float, Ge(0)]
    """Coulomb friction the controller assumes; 0 switches the compensation off."""
    friction_velocity_rad_s: Annotated[float, Gt(0)]
    """Reference speed over which the compensation changes sign."""


@dataclass(frozen=True, slots=True)
class PidGains:
    """2DOF PID ``u = Kp (b r - y) + Ki/s (r - y) + Kd s/(1 + Tf s) (c r - y)``."""

    kp_nm_per_rad: float
    ki_nm_per_rad_s: float
    kd_nm_s_per_rad: float
    filter_s: float
    setpoint_weight_p: float
    setpoint_weight_d: float

    @property
    def tracking_s(self) -> float:
        """Time constant of the anti-windup's back-calculation: the integral time ``Kp/Ki``."""
        return self.kp_nm_per_rad / self.ki_nm_per_rad_s


def design_pid(
    motor_inertia_kg_m2: float, viscous_nm_s_per_rad: float, pole_rad_s: float
) -> PidGains:
    """Place all four poles of motor and controller at ``-pole_rad_s``.

    The feedback is ``(a2 s² + a1 s + a0)/(s (s + a3))`` and the reference path has the same
    denominator and the numerator ``p² (s + p)²/K``, which leaves ``1/(1 + s/p)²`` from reference
    to angle.

    Parameters
    ----------
    motor_inertia_kg_m2, viscous_nm_s_per_rad
        The motor alone, at the output shaft.
    pole_rad_s
        The distance p of the poles from the origin.

    Returns
    -------
    PidGains
        The same controller written as a parallel PID with set-point weights b and c.

    Raises
    ------
    ControlDesignError
        If p is too small beside the motor's own ``g = B/J``: the filter's time constant is
        positive only for ``p > g/4`` and the proportional gain only for ``p > 4 g/15``.
    """
    gain = 1.0 / motor_inertia_kg_m2
    g = viscous_nm_s_per_rad * gain
    p = pole_rad_s
    if p <= 4.0 * g / 15.0:
        raise ControlDesignError(
            f"control.pole_rad_s = {p:g} rad/s is too slow for this motor, whose own pole is at "
            f"{g:g} rad/s; choose more than {4.0 * g / 15.0:.4g} rad/s."
        )
    a3 = 4.0 * p - g
    a2 = (6.0 * p**2 - 4.0 * p * g + g**2) / gain
    a1 = 4.0 * p**3 / gain
    a0 = p**4 / gain
    b1 = 2.0 * p**3 / gain
    b2 = p**2 / gain
    ki = a0 / a3
    kp = (a1 - ki) / a3
    kd = (a2 - kp) / a3
    b = (b1 - ki) / (kp * a3)
    return PidGains(
        kp_nm_per_rad=kp,
        ki_nm_per_rad_s=ki,
        kd_nm_s_per_rad=kd,
        filter_s=1.0 / a3,
        setpoint_weight_p=b,
        # At p = g/3 there is no derivative part, neither of the angle nor of the reference.
        setpoint_weight_d=(b2 - b * kp) / (kd * a3) if kd else 0.0,
    )
