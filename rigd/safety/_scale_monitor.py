"""Scale watch: ratio of the net torque on the shaft to its inertia times measured acceleration.

A wrong encoder step, gear, torque constant or inertia makes it differ from 1, a wrong sign makes it
negative. It is estimated while the shaft moves, in windows without a change of direction:

``u - Γ = r J θ'' + e Γ + F sign(θ') + B θ'``

with the ratio r, Coulomb and viscous friction F and B, and e for an error of the motor's torque
with an expected standard deviation of a quarter. Near a mode of the beam r and e are not
distinguishable, which widens the interval of r.
"""

from math import copysign, inf, sqrt

import numpy as np

from rigd.safety.limits import INTERLOCKS_BY_NAME, Violation

WINDOW_TICKS = 8
"""Length of a window in ticks, from the first mean speed to the second one.

The difference of the two gives the acceleration."""
SPEED_TICKS = 4
"""Number of ticks over which a mean speed is computed."""
_RELATIVE_TORQUE_ERROR_STD = 0.25
"""Expected standard deviation of the relative error of the motor's torque."""
_FORGETTING_FACTOR = 0.995
"""Weight of a window relative to the next window."""
_MIN_WINDOW_COUNT = 60.0
"""Smallest number of windows from which the ratio is checked."""
_MIN_TORQUE_STD_NM = 2e-3
"""Smallest standard deviation that is assumed of a window's mean torques, in N·m."""
_MIN_INERTIA_TORQUE_RMS_NM = 2e-2
"""Smallest rms of inertia times acceleration in N·m for an estimate.

Below it the encoder's steps distort the ratio."""
_FRICTION_PRIOR_PRECISION = 1.0
"""Inverse variance of the prior of viscous friction, in (rad/(N·m·s))²."""
_MIN_SIGNIFICANT_STDS = 4.0
"""Standard deviations by which the ratio has to exceed its limit to be a fault."""
_WINDOWS_PER_CHECK = 8
"""Number of windows from one check of the ratio to the next."""
_NEW_WINDOW_WEIGHTS = _FORGETTING_FACTOR ** np.arange(_WINDOWS_PER_CHECK - 1, -1, -1)
"""Weights of the windows since the last check."""


class ScaleMonitor:
    """Estimates the ratio of net torque to inertia times acceleration, and checks it.

    The estimate uses windows of `WINDOW_TICKS` ticks.

    Parameters
    ----------
    inertia_kg_m2
        Inertia of the motor.
    ratio_limit
        Ratio, or inverse ratio, above which there is a fault; infinite to check nothing.
    """

    __slots__ = ("_inertia_kg_m2", "_limit", "_moments", "_new_windows", "_windows")

    def __init__(self, inertia_kg_m2: float, ratio_limit: float) -> None:
        self._inertia_kg_m2 = inertia_kg_m2
        self._limit = ratio_limit
        self.reset()

    def reset(self) -> None:
        """Forget the means of all windows of ticks added so far."""
        # Sums of the products of [J θ'', Γ, sign(θ'), θ', u - Γ].
        self._moments = np.zeros((5, 5))
        self._windows = 0
        # Windows since the last check, which are not in the sums yet.
        self._new_windows: list[tuple[float, float, float, float, float]] = []

    def add_window(
        self,
        acceleration_rad_s2: float,
        speed_rad_s: float,
        coupling_nm: float,
        net_torque_nm: float,
    ) -> Violation | None:
        """Add a window's means to the estimate, and check the ratio from time to time.

        Parameters
        ----------
        acceleration_rad_s2, speed_rad_s
            Measured mean acceleration and speed.
        coupling_nm, net_torque_nm
            Mean coupling torque, and mean of motor minus coupling torque.

        Returns
        -------
        Violation or None
            Violation if the ratio is beyond its limit.
        """
        inertial_torque_nm = self._inertia_kg_m2 * acceleration_rad_s2
        new_windows = self._new_windows
        new_windows.append(
            (
                inertial_torque_nm,
                coupling_nm,
                copysign(1.0, speed_rad_s),
                speed_rad_s,
                net_torque_nm,
            )
        )
        if len(new_windows) < _WINDOWS_PER_CHECK:
            return None
        window_rows = np.array(new_windows)
        new_windows.clear()
        self._windows += _WINDOWS_PER_CHECK
        self._moments *= _FORGETTING_FACTOR**_WINDOWS_PER_CHECK
        self._moments += (_NEW_WINDOW_WEIGHTS * window_rows.T) @ window_rows
        return self._check_ratio() if self._windows >= _MIN_WINDOW_COUNT else None

    def estimate_ratio(self) -> tuple[float, float]:
        """Return the ratio of net torque to inertia times acceleration, and its standard deviation.

        They use the windows until the last check. The standard deviation is infinite if these do
        not determine the ratio.
        """
        moment_matrix = self._moments
        window_weight = float(moment_matrix[2, 2])
        if moment_matrix[0, 0] < window_weight * _MIN_INERTIA_TORQUE_RMS_NM**2:
            return 1.0, inf
        variance_nm2 = _MIN_TORQUE_STD_NM**2
        torque_ratio = ratio_std = inf
        for _ in range(2):
            information_matrix = moment_matrix[:4, :4] / variance_nm2
            information_matrix[1, 1] += 1.0 / _RELATIVE_TORQUE_ERROR_STD**2
            information_matrix[3, 3] += _FRICTION_PRIOR_PRECISION
            covariance = np.linalg.inv(information_matrix)
            solution = covariance @ (moment_matrix[:4, 4] / variance_nm2)
            residual_squares = (
                moment_matrix[4, 4]
                - 2 * solution @ moment_matrix[:4, 4]
                + solution @ moment_matrix[:4, :4] @ solution
            )
            torque_ratio, ratio_std = float(solution[0]), sqrt(max(0.0, float(covariance[0, 0])))
            variance_nm2 = max(_MIN_TORQUE_STD_NM**2, float(residual_squares) / window_weight)
        return torque_ratio, ratio_std

    def _check_ratio(self) -> Violation | None:
        """Return a violation if the torque ratio is significantly beyond its limit, else None."""
        ratio, ratio_std = self.estimate_ratio()
        interlock = INTERLOCKS_BY_NAME["scales"]
        lower_bound, upper_bound = (
            ratio - _MIN_SIGNIFICANT_STDS * ratio_std,
            ratio + _MIN_SIGNIFICANT_STDS * ratio_std,
        )
        ratio_limit = self._limit
        if lower_bound > ratio_limit:
            return interlock.violated(ratio, ratio_limit)
        if upper_bound < 1.0 / ratio_limit:
            return interlock.violated(ratio, 1.0 / ratio_limit, is_below=True)
        return None
