"""Linear law of the loop's controller as one state space: PID, or a controller of a package."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control._loop_model import LinearController, LoopModel
from rigd.control._pid import derivative_coefficients, design_pid, lowpass_coefficients

RealArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ControlLaw:
    """State space from reference, angle and coupling torque to torque and friction speed.

    The equations are ``x[k+1] = a x[k] + b w[k]`` and ``y[k] = c x[k] + d w[k]``. The inputs w are
    reference, angle (rad) and coupling torque (N·m). The outputs y are the torque without friction
    compensation (N·m) and the speed that the compensation uses (rad/s).
    """

    a: RealArray
    """State matrix, shape (n, n)."""
    b: RealArray
    """Input matrix, shape (n, 3)."""
    c: RealArray
    """Output matrix, shape (2, n)."""
    d: RealArray
    """Direct effect of the inputs on the outputs, shape (2, 3)."""


def control_law(model: LoopModel) -> ControlLaw:
    """Return the linear law of a loop's controller.

    Raise `ControlDesignError` if the PID cannot be designed.
    """
    controller = model.controller
    if controller is None:
        return _pid_law(model)
    a, b, c, d = (
        np.array(matrix) for matrix in (controller.a, controller.b, controller.c, controller.d)
    )
    if not model.shifts_reference:
        n = controller.order
        return ControlLaw(a, b, np.stack([c, np.zeros(n)]), np.stack([d, np.zeros(3)]))
    pid = _pid_law(model)
    reference_effect, direct_effect = pid.b[:, :1], pid.d[:, :1]
    return ControlLaw(
        np.block([[pid.a, reference_effect * c], [np.zeros((c.size, len(pid.a))), a]]),
        np.concatenate([pid.b + reference_effect * d, b]),
        np.concatenate([pid.c, direct_effect * c], axis=1),
        pid.d + direct_effect * d,
    )


def _pid_law(model: LoopModel) -> ControlLaw:
    """Return the law of the PID; its states are integral, derivative and two reference filters."""
    settings, rate_hz = model.settings, model.rate_hz
    gains = design_pid(model.motor_inertia_kg_m2, model.viscous_nm_s_per_rad, settings.pole_rad_s)
    integral_gain = gains.ki_nm_per_rad_s * (1.0 / rate_hz)
    derivative_decay, derivative_gain = derivative_coefficients(gains, rate_hz)
    b_p, b_d, kp = gains.setpoint_weight_p, gains.setpoint_weight_d, gains.kp_nm_per_rad
    lowpass_decay, lowpass_gain = lowpass_coefficients(settings, rate_hz)
    pole_rad_s = settings.pole_rad_s

    a, b, c, d = np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((2, 4)), np.zeros((2, 3))
    a[0, 0] = 1.0
    b[0, :2] = integral_gain, -integral_gain
    a[1, 1] = derivative_decay
    b[1, :2] = (
        (derivative_decay - 1.0) * derivative_gain * b_d,
        -(derivative_decay - 1.0) * derivative_gain,
    )
    # Low-pass filters: output = state + gain · input, next state = decay · output + gain · input.
    a[2, 2] = a[3, 3] = lowpass_decay
    a[3, 2] = lowpass_gain * (lowpass_decay + 1.0)
    b[2, 0] = lowpass_gain * (lowpass_decay + 1.0)
    b[3, 0] = lowpass_gain * lowpass_gain * (lowpass_decay + 1.0)
    # The integral carries Ki T/2 of the last error, the derivative its decayed last step.
    c[0, :2] = 1.0
    d[0] = (
        kp * b_p + 0.5 * integral_gain + derivative_gain * b_d,
        -(kp + 0.5 * integral_gain + derivative_gain),
        settings.feedforward_gain,
    )
    c[1, 2:] = pole_rad_s * (1.0 - lowpass_gain), -pole_rad_s
    d[1, 0] = pole_rad_s * (lowpass_gain - lowpass_gain * lowpass_gain)
    return ControlLaw(a, b, c, d)


class RunningLinearController:
    """Linear controller of a package, stepped once a tick.

    The anti-windup acts above `torque_limit_nm`, which is infinite for a shift of the reference.
    """

    __slots__ = (
        "_anti_windup",
        "_matrix",
        "_next_states",
        "_order",
        "_origin_rad",
        "_result",
        "_states_and_inputs",
        "_torque_limit_nm",
    )

    def __init__(self, controller: LinearController, torque_limit_nm: float) -> None:
        n = self._order = controller.order
        self._torque_limit_nm = torque_limit_nm
        self._anti_windup = np.array(controller.anti_windup) if controller.anti_windup else None
        self._matrix = np.zeros((n + 1, n + 3))
        self._matrix[:n, :n], self._matrix[:n, n:] = controller.a, controller.b
        self._matrix[n, :n], self._matrix[n, n:] = controller.c, controller.d
        self._states_and_inputs = np.zeros(n + 3)
        # Everything is allocated here, and nothing in a tick.
        self._result = np.zeros(n + 1)
        self._next_states = self._states_and_inputs[:n]
        self._origin_rad = 0.0

    def reset(self, angle_rad: float) -> None:
        """Set the states to zero; reference and angle then count from this angle."""
        self._states_and_inputs[:] = 0.0
        self._origin_rad = angle_rad

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Advance the states by a tick, and return the output."""
        n, states_and_inputs, result = self._order, self._states_and_inputs, self._result
        states_and_inputs[n] = reference_rad - self._origin_rad
        states_and_inputs[n + 1] = angle_rad - self._origin_rad
        states_and_inputs[n + 2] = coupling_torque_nm
        np.dot(self._matrix, states_and_inputs, out=result)
        self._next_states[:] = result[:n]
        controller_output = float(result[n])
        limit_nm = self._torque_limit_nm
        if self._anti_windup is not None and not -limit_nm <= controller_output <= limit_nm:
            limited_torque_nm = min(max(controller_output, -limit_nm), limit_nm)
            self._next_states += self._anti_windup * (limited_torque_nm - controller_output)
        return controller_output
