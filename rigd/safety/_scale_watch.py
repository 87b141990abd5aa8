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

from rigd.safety.limits import BY_NAME, Violation

WINDOW_TICKS = 8
"""Ticks from one mean speed to the next."""
SPEED_TICKS = 4
"""Ticks over which a mean speed is computed."""
_TORQUE_ERROR = 0.25
_MEMORY = 0.995
"""Weight of a window relative to the next one."""
_LEAST_WINDOWS = 60.0
_NOISE_NM = 2e-3
"""Least standard deviation of a window's torques."""
_LEAST_NM = 2e-2
"""Rms torque of the acceleration below which the encoder's steps distort the ratio."""
_FRICTION_SPREAD = 1.0
"""Inverse variance of the prior of viscous friction, in (rad/(N·m·s))²."""
_SURE = 4.0
"""Standard deviations by which the ratio has to exceed its limit."""
_CHECK_WINDOWS = 8


class ScaleWatch:
    """Estimates the ratio from windows of `WINDOW_TICKS`, and compares it with its limit.

    Parameters
    ----------
    inertia_kg_m2
        Inertia of the motor.
    limit
        Ratio, or inverse ratio, that is a fault; infinite: none.
    """

    __slots__ = ("_inertia_kg_m2", "_limit", "_normal", "_windows")

    def __init__(self, inertia_kg_m2: float, limit: float) -> None:
        self._inertia_kg_m2 = inertia_kg_m2
        self._limit = limit
        self.reset()

    def reset(self) -> None:
        """Start over."""
        # Sums of the products of [J θ'', Γ, sign(θ'), θ', u - Γ].
        self._normal = np.zeros((5, 5))
        self._windows = 0

    def add(
        self, acceleration_rad_s2: float, speed_rad_s: float, coupling_nm: float, net_nm: float
    ) -> Violation | None:
        """Add a window, and check the ratio after every few of them.

        Parameters
        ----------
        acceleration_rad_s2, speed_rad_s
            Mean acceleration and speed, as measured.
        coupling_nm, net_nm
            Means of the coupling torque, and of motor minus coupling torque.
        """
        inertia_nm = self._inertia_kg_m2 * acceleration_rad_s2
        row = np.array((inertia_nm, coupling_nm, copysign(1.0, speed_rad_s), speed_rad_s, net_nm))
        self._normal *= _MEMORY
        self._normal += row[:, None] * row
        self._windows += 1
        if self._windows < _LEAST_WINDOWS or self._windows % _CHECK_WINDOWS:
            return None
        return self._check()

    def estimate(self) -> tuple[float, float]:
        """Return the ratio and its standard deviation, infinite without information."""
        normal = self._normal
        weight = float(normal[2, 2])
        if normal[0, 0] < weight * _LEAST_NM**2:
            return 1.0, inf
        variance_nm2 = _NOISE_NM**2
        ratio = deviation = inf
        for _ in range(2):
            left = normal[:4, :4] / variance_nm2
            left[1, 1] += 1.0 / _TORQUE_ERROR**2
            left[3, 3] += _FRICTION_SPREAD
            covariance = np.linalg.inv(left)
            found = covariance @ (normal[:4, 4] / variance_nm2)
            squares = normal[4, 4] - 2 * found @ normal[:4, 4] + found @ normal[:4, :4] @ found
            ratio, deviation = float(found[0]), sqrt(max(0.0, float(covariance[0, 0])))
            variance_nm2 = max(_NOISE_NM**2, float(squares) / weight)
        return ratio, deviation

    def _check(self) -> Violation | None:
        ratio, deviation = self.estimate()
        row = BY_NAME["scales"]
        low, high = ratio - _SURE * deviation, ratio + _SURE * deviation
        limit = self._limit
        if low > limit:
            return row.violated(ratio, limit)
        if high < 1.0 / limit:
            return row.violated(ratio, 1.0 / limit, below=True)
        return None
