"""2DOF PID with low-pass filters: its design by pole placement, and its discrete step.

The motor seen from its output shaft is ``G_m = K/(s (s + g))`` with ``K = 1/J`` and ``g = B/J``.
The beam does not appear in the design: its measured coupling torque is fed forward.

The discrete controller takes one step a tick, in plain floats. Everything is discretised by
Tustin's rule. The two low-pass filters of the reference (for the friction compensation) are the
nominal closed loop ``1/(1 + s/p)²``, so that the compensated speed is the expected speed of the
motor, not the requested one.
"""

from dataclasses import dataclass, field
from math import tanh
from typing import Annotated

from annotated_types import Ge, Gt, Le, MinLen

from rigd.errors import UserError

SHIPPED_CONTROLLER = "pid"
"""Name of the controller that comes with rigd."""
_OPTIONAL_SETTING = {"optional": True}
"""Metadata of a field whose key a profile may omit."""


class ControlDesignError(UserError, ValueError):
    """Error if the angle controller cannot be designed, or its closed loop is unstable."""


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """Settings of the angle controller in a profile."""

    pole_rad_s: Annotated[float, Gt(0)]
    """Distance of the nominal closed loop's four poles from the origin; they are real."""
    feedforward_gain: Annotated[float, Ge(0), Le(2)]
    """Fraction of the measured coupling torque that is added to the command; 1 cancels the beam."""
    friction_compensation_nm: Annotated[float, Ge(0)]
    """Coulomb friction that the controller compensates; 0 switches the compensation off."""
    friction_velocity_rad_s: Annotated[float, Gt(0)]
    """Speed at which the compensation reaches 76 % of its largest torque (the tanh of 1)."""
    controller: Annotated[str, MinLen(1)] = field(
        default=SHIPPED_CONTROLLER, metadata=_OPTIONAL_SETTING
    )
    """Name of the controller: "pid", or one that an installed package adds."""


@dataclass(frozen=True, slots=True)
class PidGains:
    """Gains of a PID controller with two degrees of freedom.

    The torque is ``u = Kp (b r - y) + Ki/s (r - y) + Kd s/(1 + Tf s) (c r - y)`` for the reference
    r and the angle y.
    """

    kp_nm_per_rad: float
    """Proportional gain Kp."""
    ki_nm_per_rad_s: float
    """Integral gain Ki."""
    kd_nm_s_per_rad: float
    """Derivative gain Kd."""
    filter_s: float
    """Time constant Tf of the derivative's filter."""
    setpoint_weight_p: float
    """Set-point weight b of the proportional part."""
    setpoint_weight_d: float
    """Set-point weight c of the derivative part."""

    @property
    def tracking_s(self) -> float:
        """Time constant in s of the anti-windup's back-calculation: the integral time ``Kp/Ki``."""
        return self.kp_nm_per_rad / self.ki_nm_per_rad_s


def design_pid(
    motor_inertia_kg_m2: float, viscous_nm_s_per_rad: float, pole_rad_s: float
) -> PidGains:
    """Return the gains that put all four poles of motor and controller at ``-pole_rad_s``.

    The feedback is ``(a2 s² + a1 s + a0)/(s (s + a3))``. The reference path has the same
    denominator and the numerator ``p² (s + p)²/K``: the response from reference to angle is
    ``1/(1 + s/p)²``.

    Parameters
    ----------
    motor_inertia_kg_m2, viscous_nm_s_per_rad
        Inertia and viscous friction of the motor alone, at the output shaft.
    pole_rad_s
        Distance p of the poles from the origin.

    Returns
    -------
    PidGains
        The same controller as a parallel PID with set-point weights b and c.

    Raises
    ------
    ControlDesignError
        If p is too small compared with the motor's own ``g = B/J``: the filter's time constant is
        positive only for ``p > g/4`` and the proportional gain only for ``p > 4 g/15``.

    References
    ----------
    K. J. Åström and R. M. Murray, Feedback Systems, Princeton: pole placement and set-point
    weights.

    Examples
    --------
    >>> from rigd.control import design_pid
    >>> gains = design_pid(motor_inertia_kg_m2=2e-3, viscous_nm_s_per_rad=1e-2, pole_rad_s=80)
    >>> print(f"{gains.kp_nm_per_rad:.2f} N·m/rad, {gains.tracking_s * 1e3:.1f} ms")
    12.18 N·m/rad, 46.8 ms
    """
    motor_gain = 1.0 / motor_inertia_kg_m2
    g = viscous_nm_s_per_rad * motor_gain
    p = pole_rad_s
    if p <= 4.0 * g / 15.0:
        raise ControlDesignError(
            f"control.pole_rad_s = {p:g} rad/s is too slow for this motor, whose own pole is at "
            f"{g:g} rad/s; choose more than {4.0 * g / 15.0:.4g} rad/s."
        )
    a3 = 4.0 * p - g
    a2 = (6.0 * p**2 - 4.0 * p * g + g**2) / motor_gain
    a1 = 4.0 * p**3 / motor_gain
    a0 = p**4 / motor_gain
    b1 = 2.0 * p**3 / motor_gain
    b2 = p**2 / motor_gain
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


# Discrete controller


class PidController:
    """PID controller of the motor's angle, with feed-forward and friction compensation.

    It has two degrees of freedom. The measured coupling torque is fed forward, and Coulomb friction
    is compensated. After each step its terms are in the attributes ``proportional_nm``,
    ``integral_nm``, ``derivative_nm``, ``feedforward_nm`` and ``friction_nm``, and their sum in
    ``unlimited_torque_nm``. The attribute ``saturated`` states whether the sum was limited. The
    integral then already contains the anti-windup's correction for the next step.

    Parameters
    ----------
    gains
        Gains from :func:`rigd.control.design_pid`.
    settings
        Feed-forward gain, friction compensation and nominal pole.
    rate_hz
        Steps a second.
    torque_limit_nm
        Largest magnitude of the returned torque; the integral term follows it by
        back-calculation.

    Examples
    --------
    >>> from rigd.control import ControlSettings, PidController, design_pid
    >>> gains = design_pid(motor_inertia_kg_m2=2e-3, viscous_nm_s_per_rad=1e-2, pole_rad_s=80)
    >>> settings = ControlSettings(80, feedforward_gain=1, friction_compensation_nm=0,
    ...                            friction_velocity_rad_s=0.1)
    >>> controller = PidController(gains, settings, rate_hz=1000, torque_limit_nm=2)
    >>> torque_nm = controller.step(reference_rad=0.01, angle_rad=0, coupling_torque_nm=0)
    >>> print(f"{torque_nm:.3f} N·m")
    0.120 N·m
    """

    __slots__ = (
        "_derivative_decay",
        "_derivative_gain",
        "_feedforward_gain",
        "_filtered_once_rad",
        "_filtered_twice_rad",
        "_friction_compensation_nm",
        "_half_integral_gain",
        "_inverse_friction_velocity",
        "_last_error",
        "_last_reference_rad",
        "_last_weighted_error",
        "_lowpass_decay",
        "_lowpass_gain",
        "_pole_rad_s",
        "_proportional_gain",
        "_setpoint_weight_d",
        "_setpoint_weight_p",
        "_tracking_gain",
        "derivative_nm",
        "feedforward_nm",
        "friction_nm",
        "integral_nm",
        "proportional_nm",
        "saturated",
        "torque_limit_nm",
        "unlimited_torque_nm",
    )

    def __init__(
        self, gains: PidGains, settings: ControlSettings, rate_hz: float, torque_limit_nm: float
    ) -> None:
        period_s = 1.0 / rate_hz
        self.torque_limit_nm = torque_limit_nm
        self._proportional_gain = gains.kp_nm_per_rad
        self._setpoint_weight_p = gains.setpoint_weight_p
        self._setpoint_weight_d = gains.setpoint_weight_d
        self._half_integral_gain = 0.5 * gains.ki_nm_per_rad_s * period_s
        self._derivative_decay, self._derivative_gain = derivative_coefficients(gains, rate_hz)
        self._tracking_gain = period_s / gains.tracking_s
        self._feedforward_gain = settings.feedforward_gain
        self._friction_compensation_nm = settings.friction_compensation_nm
        self._inverse_friction_velocity = 1.0 / settings.friction_velocity_rad_s
        self._pole_rad_s = settings.pole_rad_s
        self._lowpass_decay, self._lowpass_gain = lowpass_coefficients(settings, rate_hz)
        self.reset(0.0)

    @property
    def terms_nm(self) -> tuple[float, float, float, float, float]:
        """Terms of the last torque: proportional, integral, derivative, feed-forward, friction."""
        return (
            self.proportional_nm,
            self.integral_nm,
            self.derivative_nm,
            self.feedforward_nm,
            self.friction_nm,
        )

    def reset(self, angle_rad: float) -> None:
        """Set the controller's state to rest at an angle, so that the torque does not jump.

        The next step returns no torque if reference and angle are still equal to this angle and the
        coupling torque is zero.
        """
        self.proportional_nm = self._proportional_gain * (self._setpoint_weight_p - 1.0) * angle_rad
        self.integral_nm = -self.proportional_nm
        self.derivative_nm = 0.0
        self.feedforward_nm = 0.0
        self.friction_nm = 0.0
        self.unlimited_torque_nm = 0.0
        self.saturated = False
        self._last_error = 0.0
        self._last_weighted_error = (self._setpoint_weight_d - 1.0) * angle_rad
        self._last_reference_rad = angle_rad
        self._filtered_once_rad = angle_rad
        self._filtered_twice_rad = angle_rad

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Compute the terms of the controller for a tick, and return the torque command in N·m.

        Parameters
        ----------
        reference_rad, angle_rad
            Reference and measured angle.
        coupling_torque_nm
            Measured coupling torque, which is fed forward.
        """
        error_rad = reference_rad - angle_rad
        weighted_error_rad = self._setpoint_weight_d * reference_rad - angle_rad
        proportional_nm = self._proportional_gain * (
            self._setpoint_weight_p * reference_rad - angle_rad
        )
        integral_nm = self.integral_nm + self._half_integral_gain * (error_rad + self._last_error)
        derivative_nm = self._derivative_decay * self.derivative_nm + self._derivative_gain * (
            weighted_error_rad - self._last_weighted_error
        )
        feedforward_nm = self._feedforward_gain * coupling_torque_nm

        lowpass_decay, lowpass_gain = self._lowpass_decay, self._lowpass_gain
        filtered_once_rad = lowpass_decay * self._filtered_once_rad + lowpass_gain * (
            reference_rad + self._last_reference_rad
        )
        filtered_twice_rad = lowpass_decay * self._filtered_twice_rad + lowpass_gain * (
            filtered_once_rad + self._filtered_once_rad
        )
        friction_nm = self._friction_compensation_nm * tanh(
            self._pole_rad_s
            * (filtered_once_rad - filtered_twice_rad)
            * self._inverse_friction_velocity
        )

        unlimited_nm = proportional_nm + integral_nm + derivative_nm + feedforward_nm + friction_nm
        torque_nm = unlimited_nm
        if unlimited_nm > self.torque_limit_nm:
            torque_nm = self.torque_limit_nm
        elif unlimited_nm < -self.torque_limit_nm:
            torque_nm = -self.torque_limit_nm

        self._last_error = error_rad
        self._last_weighted_error = weighted_error_rad
        self._last_reference_rad = reference_rad
        self._filtered_once_rad = filtered_once_rad
        self._filtered_twice_rad = filtered_twice_rad
        self.proportional_nm = proportional_nm
        self.integral_nm = integral_nm + self._tracking_gain * (torque_nm - unlimited_nm)
        self.derivative_nm = derivative_nm
        self.feedforward_nm = feedforward_nm
        self.friction_nm = friction_nm
        self.unlimited_torque_nm = unlimited_nm
        self.saturated = torque_nm != unlimited_nm
        return torque_nm


def derivative_coefficients(gains: PidGains, rate_hz: float) -> tuple[float, float]:
    """Return decay and gain of the discrete derivative term.

    The term is ``d[k] = decay d[k-1] + gain (e[k] - e[k-1])`` for the error e, which is
    ``Kd s/(1 + Tf s)`` by Tustin's rule. The term d is in N·m, the gain in N·m/rad.
    """
    filter_half_periods = 2.0 * gains.filter_s * rate_hz
    return (filter_half_periods - 1.0) / (
        filter_half_periods + 1.0
    ), 2.0 * gains.kd_nm_s_per_rad * rate_hz / (filter_half_periods + 1.0)


def lowpass_coefficients(settings: ControlSettings, rate_hz: float) -> tuple[float, float]:
    """Return decay and gain of the discrete low-pass filter of the reference.

    The filter is ``x[k] = decay x[k-1] + gain (u[k] + u[k-1])`` for the input u, which is
    ``1/(1 + s/p)`` by Tustin's rule.
    """
    pole_times_period = settings.pole_rad_s / rate_hz
    return (2.0 - pole_times_period) / (2.0 + pole_times_period), pole_times_period / (
        2.0 + pole_times_period
    )
