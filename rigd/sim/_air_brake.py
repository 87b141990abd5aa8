"""Drag of the air on the simulated beam, tick by tick.

The force per metre at the points of a `DragGrid` acts on the modes, whose poles are those of the
beam's realisation, and by its moment on the shaft; the speeds at the points follow from the state.
The force over the coming period is not known at its start: what is held is the mean over the period
of the parabola through the last three forces.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    AIR_DENSITY_KG_PER_M3,
    Beam,
    Damping,
    DragGrid,
    clamped_free_eigenvalues,
    mode_mean,
)
from rigd.beam.realisation import CoupledModel, Realisation

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_MODES = 5
"""The fifth of the paper's link is at 145 Hz: three times the end of its sweep."""
_POINTS = 16
_MEAN_OF_PARABOLA = (23 / 12, -16 / 12, 5 / 12)
"""The newest force first (Adams and Bashforth)."""


class AirBrake:
    """Air around a beam.

    Parameters
    ----------
    beam, damping, realisation
        The beam's. The first oscillating poles of the realisation are those of the first modes.
    drag_m
        ``C_D d``.

    Attributes
    ----------
    speed
        Row by row the speeds at the points (m/s) by the state of `attached`, shape (points, n).
    """

    __slots__ = (
        "_force_m",
        "_forces",
        "_grid",
        "_magnitude",
        "_moment_m2",
        "_newest",
        "_per_square",
        "_poles",
        "_shear_of_mode",
        "_torque_of_mode",
        "_weights",
        "speed",
    )

    def __init__(
        self, beam: Beam, damping: Damping, realisation: Realisation, drag_m: float
    ) -> None:
        poles = realisation.poles_rad_s[realisation.poles_rad_s.imag > 0][:_MODES]
        modes = poles.size
        self._poles = poles
        self._grid = grid = DragGrid.of(beam, modes, _POINTS)
        k_fourth = (clamped_free_eigenvalues(modes) / beam.length_m) ** 4
        inertial = beam.density_over_stiffness * poles**2
        external = damping.gamma * poles**damping.lambda_
        internal = damping.zeta * poles**damping.alpha * k_fourth
        load = inertial + external
        slope = (2 * inertial + damping.lambda_ * external + damping.alpha * internal) / poles
        leverage_m2 = beam.length_m * grid.leverage_m
        self._torque_of_mode = _rows(leverage_m2 * load / slope).sum(axis=0)
        self._moment_m2 = leverage_m2 @ grid.to_modes - grid.to_moment
        mean_m = beam.length_m * mode_mean(modes)
        self._shear_of_mode = _rows(mean_m * load / slope).sum(axis=0)
        self._force_m = mean_m @ grid.to_modes - grid.weight_m

        states = 2 + realisation.b.size
        self.speed: Real = np.zeros((_POINTS, states + 2 * modes))
        self.speed[:, 1] = grid.x_m
        driven = _rows(-grid.leverage_m * load / slope / poles)
        self.speed[:, 2 : 2 + 2 * modes] = grid.shapes.T @ driven
        pushed = _rows(poles / slope / beam.bending_stiffness_n_m2)
        self.speed[:, states:] = grid.shapes.T @ pushed

        self._forces = np.zeros((3, _POINTS))
        self._magnitude = np.zeros(_POINTS)
        self._newest = 0
        # The forces are in a ring buffer: one set of weights for each position of the newest.
        backwards = (newest - np.arange(3) for newest in range(3))
        self._weights = [np.array(_MEAN_OF_PARABOLA)[back % 3] for back in backwards]
        self._per_square = -0.5 * AIR_DENSITY_KG_PER_M3 * drag_m

    def attached(self, model: CoupledModel) -> tuple[CoupledModel, Real]:
        """Extend motor and beam by the effect of the force on the modes.

        Returns
        -------
        model
            With two more states a mode, which act on the shaft.
        of_force
            What the force per metre at the points adds to the state's derivative, (n, points).
        """
        n, more = model.b.size, 2 * self._poles.size
        a = np.zeros((n + more, n + more))
        a[:n, :n] = model.a
        a[:n, n:] = -np.outer(model.b, self._torque_of_mode)
        even = np.arange(n, n + more, 2)
        a[even, even] = a[even + 1, even + 1] = self._poles.real
        a[even, even + 1] = self._poles.imag
        a[even + 1, even] = -self._poles.imag
        of_force = np.zeros((n + more, _POINTS))
        of_force[:n] = -np.outer(model.b, self._moment_m2)
        of_force[even] = self._grid.to_modes

        def row(own: Real, per_torque: float = 0.0, direct: float = 0.0) -> Real:
            return np.concatenate([own, (direct - per_torque) * self._torque_of_mode])

        extended = replace(
            model,
            a=a,
            b=np.concatenate([model.b, np.zeros(more)]),
            angle=row(model.angle),
            velocity=row(model.velocity),
            acceleration=row(model.acceleration, model.acceleration_per_torque),
            beam_torque=row(model.beam_torque, model.beam_torque_per_torque, 1.0),
            sensor_torque=row(model.sensor_torque, model.sensor_torque_per_torque, 1.0),
            shear=np.append(
                model.shear,
                self._shear_of_mode - model.shear_per_torque * self._torque_of_mode,
            ),
        )
        return extended, of_force

    def feel(self, speed_m_s: Real) -> tuple[float, float]:
        """Set the speeds at an instant, shape (points,), and return their immediate effect.

        Returns
        -------
        torque_nm, shear_n : float
            Immediate effect of the force on the beam's torque and shear, with the modes unchanged.
        """
        self._newest = (self._newest + 1) % 3
        force = self._forces[self._newest]
        np.absolute(speed_m_s, self._magnitude)
        np.multiply(self._magnitude, speed_m_s, force)
        force *= self._per_square
        return float(self._moment_m2.dot(force)), float(self._force_m.dot(force))

    def hold(self, out: Real) -> None:
        """Write the force per metre to be held over the coming period, shape (points,), N/m."""
        self._weights[self._newest].dot(self._forces, out)


def _rows(gains: Complex) -> Real:
    """Rows that take ``2 Re(gain z)`` from the two states of each pole's z, shape (m, 2 m).

    They are the real part of z and the negative of its imaginary part.
    """
    rows = np.zeros((gains.size, 2 * gains.size))
    number = np.arange(gains.size)
    rows[number, 2 * number] = 2 * gains.real
    rows[number, 2 * number + 1] = 2 * gains.imag
    return rows
