"""The discrete 2DOF PID, one step a tick, in plain floats.

Everything is discretised by Tustin's rule. The two low-pass filters of the reference (for the
friction compensation) are the nominal closed loop ``1/(1 + s/p)²``, so that the compensated speed
is the one the motor is expected to have, not the one that is asked of it.
"""

from math import tanh

from rigd.control.design import ControlSettings, PidGains


class PidController:
    """2DOF PID with feed-forward of the coupling torque and compensation of Coulomb friction.

    After each step its terms stand in the attributes ``proportional_nm``, ``integral_nm``,
    ``derivative_nm``, ``feedforward_nm`` and ``friction_nm``, their sum in
    ``unlimited_torque_nm``, and ``saturated`` says whether that was limited; the integral then
    already holds the anti-windup's correction for the next step.

    Parameters
    ----------
    gains
        From :func:`rigd.control.design_pid`.
    settings
        Feed-forward gain, friction compensation and nominal pole.
    rate_hz
        Steps a second.
    torque_limit_nm
        Magnitude the returned torque never exceeds; the integral term follows it by
        back-calculation.
    """

    __slots__ = (
        "_b_d",
        "_b_p",
        "_coulomb_nm",
        "_decay_d",
        "_error",
        "_fast_rad",
        "_feedforward_gain",
        "_gain_d",
        "_half_ki_t",
        "_inverse_v0",
        "_kp",
        "_limit_nm",
        "_lowpass_decay",
        "_lowpass_gain",
        "_pole_rad_s",
        "_reference_rad",
        "_slow_rad",
        "_tracking_gain",
        "_weighted_error",
        "derivative_nm",
        "feedforward_nm",
        "friction_nm",
        "integral_nm",
        "proportional_nm",
        "saturated",
        "unlimited_torque_nm",
    )

    def __init__(
        self, gains: PidGains, settings: ControlSettings, rate_hz: float, torque_limit_nm: float
    ) -> None:
        period_s = 1.0 / rate_hz
        self._limit_nm = torque_limit_nm
        self._kp = gains.kp_nm_per_rad
        self._b_p = gains.setpoint_weight_p
        self._b_d = gains.setpoint_weight_d
        self._half_ki_t = 0.5 * gains.ki_nm_per_rad_s * period_s
        self._decay_d, self._gain_d = derivative_coefficients(gains, rate_hz)
        self._tracking_gain = period_s / gains.tracking_s
        self._feedforward_gain = settings.feedforward_gain
        self._coulomb_nm = settings.friction_compensation_nm
        self._inverse_v0 = 1.0 / settings.friction_velocity_rad_s
        self._pole_rad_s = settings.pole_rad_s
        self._lowpass_decay, self._lowpass_gain = lowpass_coefficients(settings, rate_hz)
        self.reset(0.0)

    def reset(self, angle_rad: float, torque_nm: float = 0.0) -> None:
        """Take over without a bump from rest at ``angle_rad`` under ``torque_nm``.

        The next step returns ``torque_nm`` if reference and angle are still ``angle_rad`` and the
        coupling torque is zero.
        """
        self.proportional_nm = self._kp * (self._b_p - 1.0) * angle_rad
        self.integral_nm = torque_nm - self.proportional_nm
        self.derivative_nm = 0.0
        self.feedforward_nm = 0.0
        self.friction_nm = 0.0
        self.unlimited_torque_nm = torque_nm
        self.saturated = False
        self._error = 0.0
        self._weighted_error = (self._b_d - 1.0) * angle_rad
        self._reference_rad = angle_rad
        self._fast_rad = angle_rad
        self._slow_rad = angle_rad

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the torque command in N·m for this tick's reference, angle and coupling torque."""
        error = reference_rad - angle_rad
        weighted_error = self._b_d * reference_rad - angle_rad
        proportional = self._kp * (self._b_p * reference_rad - angle_rad)
        integral = self.integral_nm + self._half_ki_t * (error + self._error)
        derivative = self._decay_d * self.derivative_nm + self._gain_d * (
            weighted_error - self._weighted_error
        )
        feedforward = self._feedforward_gain * coupling_torque_nm

        decay, gain = self._lowpass_decay, self._lowpass_gain
        fast = decay * self._fast_rad + gain * (reference_rad + self._reference_rad)
        slow = decay * self._slow_rad + gain * (fast + self._fast_rad)
        friction = self._coulomb_nm * tanh(self._pole_rad_s * (fast - slow) * self._inverse_v0)

        unlimited = proportional + integral + derivative + feedforward + friction
        torque = unlimited
        if unlimited > self._limit_nm:
            torque = self._limit_nm
        elif unlimited < -self._limit_nm:
            torque = -self._limit_nm

        self._error = error
        self._weighted_error = weighted_error
        self._reference_rad = reference_rad
        self._fast_rad = fast
        self._slow_rad = slow
        self.proportional_nm = proportional
        self.integral_nm = integral + self._tracking_gain * (torque - unlimited)
        self.derivative_nm = derivative
        self.feedforward_nm = feedforward
        self.friction_nm = friction
        self.unlimited_torque_nm = unlimited
        self.saturated = torque != unlimited
        return torque


def derivative_coefficients(gains: PidGains, rate_hz: float) -> tuple[float, float]:
    """Return decay and gain of ``d[k] = decay d[k-1] + gain (e[k] - e[k-1])``.

    Tustin's rule on ``Kd s/(1 + Tf s)``; d in N·m, gain in N·m/rad.
    """
    two_tf = 2.0 * gains.filter_s * rate_hz
    return (two_tf - 1.0) / (two_tf + 1.0), 2.0 * gains.kd_nm_s_per_rad * rate_hz / (two_tf + 1.0)


def lowpass_coefficients(settings: ControlSettings, rate_hz: float) -> tuple[float, float]:
    """Return decay and gain of ``x[k] = decay x[k-1] + gain (u[k] + u[k-1])``.

    Tustin's rule on ``1/(1 + s/p)``.
    """
    step = settings.pole_rad_s / rate_hz
    return (2.0 - step) / (2.0 + step), step / (2.0 + step)
