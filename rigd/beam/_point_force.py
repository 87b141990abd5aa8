"""Response of the beam to an angle of its root and to a force at a point, as in a touch.

The displacement ``y(x)`` from the line of angle zero obeys, in the Laplace domain::

    P y + Q y'''' = F delta(x - x_c),     y(0) = 0,  y'(0) = theta,  y''(L) = y'''(L) = 0

with ``P = rho s² + c_v s^lambda`` and ``Q = EI (1 + zeta s^alpha)``. The motor holds the root by
the torque ``-Q y''(0)`` and the base shear ``Q y'''(0)``, both as it exerts them on the beam.

As for Eq. 25, a single form would cancel at low and overflow at high frequency. Two are used, which
meet at ``|q| = 40`` for ``q = -L⁴ P / Q``:

* below, power series: with ``K_n(x) = sum_k (-P/Q)^k x^(4k+n) / (4k+n)!`` the solution is
  ``theta K_1(x) + M K_2(x) + V K_3(x)``, plus ``F/Q K_3(x - x_c)`` beyond the force; the two
  conditions at the tip give M and V;
* beyond, exponentials that never grow, ``exp(-b x)``, ``exp(-b (L - x))``, ``exp(-c x)`` and
  ``exp(-c (L - x))`` with ``b = (-P/Q)^(1/4)`` and ``c = ±j b``, and for the force the response of
  the beam without ends, ``A exp(-b r) + B exp(-c r)`` at the distance r. The four conditions make a
  system whose inverse does not depend on x_c.

References
----------
K. F. Graff, Wave Motion in Elastic Solids (1975), chapter 3.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam._model import Beam, Damping

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_SERIES_ARGUMENT = 40.0
"""Magnitude of q at which the power series are replaced by exponentials."""
_SERIES_TERM_COUNT = 9
"""Number of terms of each power series; the first omitted term is below 40^9 / 36! = 7e-28."""


class PointForceGrid:
    """Evaluates the beam's responses to a root angle and to a point force on a fixed grid of s.

    Parameters
    ----------
    s
        Laplace variable in rad/s, any shape; 0 gives the static response.
    beam, damping
        Parameters of the exact model.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, PointForceGrid
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> response = PointForceGrid([0.0], beam, Damping())
    >>> displacement_m_per_n = response.displacement_per_force(0.6, 0.6).real
    >>> print(displacement_m_per_n, round(0.6**3 / (3 * 0.0903), 6))
    [0.79734219] 0.797342
    """

    __slots__ = (
        "_b4",
        "_exponentials",
        "_large_q_indices",
        "_length_m",
        "_q_stiffness",
        "_shape",
        "_small_q_indices",
    )

    def __init__(self, s: ArrayLike, beam: Beam, damping: Damping) -> None:
        s_points = np.asarray(s, dtype=np.complex128)
        self._shape = s_points.shape
        s_points = s_points.ravel()
        inertial_term = beam.density_over_stiffness * s_points * s_points
        internal_factor = 1 + damping.zeta * s_points**damping.alpha
        self._length_m = beam.length_m
        self._q_stiffness: ComplexArray = beam.bending_stiffness_n_m2 * internal_factor
        self._b4: ComplexArray = (
            -(inertial_term + damping.gamma * s_points**damping.lambda_) / internal_factor
        )
        is_small = np.abs(self._b4) * beam.length_m**4 < _MAX_SERIES_ARGUMENT
        self._small_q_indices, self._large_q_indices = (
            np.flatnonzero(is_small),
            np.flatnonzero(~is_small),
        )
        self._exponentials = _ExponentialSolution(self._b4[self._large_q_indices], beam.length_m)

    def displacement_per_angle(self, x_m: ArrayLike, derivative_order: int = 0) -> ComplexArray:
        """Return the displacement of the beam per angle of its root, or its derivative by x.

        Parameters
        ----------
        x_m
            Distance from the motor's axis, any shape.
        derivative_order
            Order of the derivative with respect to x, 0 to 3.

        Returns
        -------
        complex ndarray, shape of s, then of `x_m`
            Displacement, or derivative, in m^(1 - order)/rad.
        """
        x = np.asarray(x_m, dtype=np.float64)
        displacement = np.empty((self._b4.size, x.size), dtype=np.complex128)
        b4 = self._b4[self._small_q_indices, None]
        moment, shear = self._root_derivatives(
            b4, b4 * self._series_at_tip(3), b4 * self._series_at_tip(2)
        )
        displacement[self._small_q_indices] = (
            _power_series(b4, x.ravel(), 1, derivative_order)
            + moment * _power_series(b4, x.ravel(), 2, derivative_order)
            + shear * _power_series(b4, x.ravel(), 3, derivative_order)
        )
        displacement[self._large_q_indices] = self._exponentials.response_per_angle(
            x.ravel(), derivative_order
        )
        return displacement.reshape((*self._shape, *x.shape))

    def displacement_per_force(
        self, x_m: ArrayLike, force_at_m: ArrayLike, derivative_order: int = 0
    ) -> ComplexArray:
        """Return the displacement of the beam per point force, or its derivative by x.

        The motor holds the root at angle zero.

        Parameters
        ----------
        x_m, force_at_m
            Positions of displacement and force, as distances from the motor's axis; broadcast
            against each other.
        derivative_order
            Order of the derivative with respect to `x_m`, 0 to 3; the third jumps at the force,
            where its value on the root's side is returned.

        Returns
        -------
        complex ndarray, shape of s, then of the distances
            Displacement, or derivative, in m^(1 - order)/N.
        """
        x, force_x = np.broadcast_arrays(
            np.asarray(x_m, np.float64), np.asarray(force_at_m, np.float64)
        )
        shape = x.shape
        x, force_x = x.ravel(), force_x.ravel()
        displacement = np.empty((self._b4.size, x.size), dtype=np.complex128)
        b4, stiffness = (
            self._b4[self._small_q_indices, None],
            self._q_stiffness[self._small_q_indices, None],
        )
        force_to_tip_m = self._length_m - force_x
        moment, shear = self._root_derivatives(
            b4, _power_series(b4, force_to_tip_m, 1), _power_series(b4, force_to_tip_m, 0)
        )
        term_beyond_force = np.where(
            x > force_x, _power_series(b4, np.maximum(x - force_x, 0.0), 3, derivative_order), 0.0
        )
        displacement[self._small_q_indices] = (
            moment * _power_series(b4, x, 2, derivative_order)
            + shear * _power_series(b4, x, 3, derivative_order)
            + term_beyond_force
        ) / stiffness
        displacement[self._large_q_indices] = (
            self._exponentials.response_per_force_over_stiffness(x, force_x, derivative_order)
            / self._q_stiffness[self._large_q_indices, None]
        )
        return displacement.reshape((*self._shape, *shape))

    def torque_per_angle(self) -> ComplexArray:
        """Return the motor's torque on the beam per angle (Eq. 25) in N·m/rad.

        The shape is that of the grid.
        """
        return -self._bending_stiffness() * self.displacement_per_angle(0.0, 2)

    def shear_per_angle(self) -> ComplexArray:
        """Return the shear force at the root per angle in N/rad, in the shape of the grid."""
        return self._bending_stiffness() * self.displacement_per_angle(0.0, 3)

    def torque_per_force(self, force_at_m: ArrayLike) -> ComplexArray:
        """Return the motor's torque on the beam per point force on it, in N·m/N.

        The shape is that of s, then of `force_at_m`.

        Parameters
        ----------
        force_at_m
            Position of the force, as a distance from the motor's axis.
        """
        force_x = np.asarray(force_at_m, dtype=np.float64)
        return -self._bending_stiffness(force_x.ndim) * self.displacement_per_force(
            np.zeros_like(force_x), force_x, 2
        )

    def shear_per_force(self, force_at_m: ArrayLike) -> ComplexArray:
        """Return the shear force at the root per point force on the beam, dimensionless.

        The shape is that of s, then of `force_at_m`.

        Parameters
        ----------
        force_at_m
            Position of the force, as a distance from the motor's axis.
        """
        force_x = np.asarray(force_at_m, dtype=np.float64)
        return self._bending_stiffness(force_x.ndim) * self.displacement_per_force(
            np.zeros_like(force_x), force_x, 3
        )

    def _bending_stiffness(self, appended_axis_count: int = 0) -> ComplexArray:
        """Return the complex bending stiffness Q in N·m², with axes of length 1 appended."""
        return self._q_stiffness.reshape(self._shape + (1,) * appended_axis_count)

    def _series_at_tip(self, series_index: int) -> ComplexArray:
        """Return the power series ``K_n`` at the tip at the s with small q, shape (low, 1)."""
        return _power_series(
            self._b4[self._small_q_indices, None], np.array([self._length_m]), series_index
        )

    def _root_derivatives(
        self, b4: ComplexArray, tip_moment: ComplexArray, tip_shear: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return y''(0) and y'''(0) of the beam whose moment and shear force at the tip are zero.

        `tip_moment` and `tip_shear` are y''(L) and y'''(L) of the solution without the terms in K_2
        and K_3 that y''(0) and y'''(0) multiply.
        """
        k0, k1, k3 = self._series_at_tip(0), self._series_at_tip(1), self._series_at_tip(3)
        determinant = k0 * k0 - b4 * k1 * k3
        moment: ComplexArray = (k1 * tip_shear - k0 * tip_moment) / determinant
        shear: ComplexArray = (b4 * k3 * tip_moment - k0 * tip_shear) / determinant
        return moment, shear


def _power_series(
    b4: ComplexArray, x: RealArray, series_index: int, derivative_order: int = 0
) -> ComplexArray:
    """Return the power series ``K_n``, or a derivative of it, at the points x, shape (s, m).

    `b4` is ``-P/Q``, shape (s, 1); x has the shape (m,).
    """
    series_index -= derivative_order
    if series_index < 0:
        return b4 * _power_series(b4, x, series_index + 4)
    series_argument = b4 * x**4
    series_sum = np.full_like(
        series_argument, 1 / factorial(4 * (_SERIES_TERM_COUNT - 1) + series_index)
    )
    for k in range(_SERIES_TERM_COUNT - 2, -1, -1):
        series_sum *= series_argument
        series_sum += 1 / factorial(4 * k + series_index)
    return series_sum * x**series_index


@dataclass(init=False, slots=True)
class _ExponentialSolution:
    """Beam responses at large |q|, written as sums of exponentials that never grow."""

    _b: ComplexArray  # (s, 1)
    _kappa: ComplexArray  # (s, 1): c / b, which is j or -j
    _length_m: float
    _inverse: ComplexArray  # (s, 4, 4)

    def __init__(self, b4: ComplexArray, length_m: float) -> None:
        wave_number = b4**0.25
        self._length_m = length_m
        self._b = wave_number[:, None]
        self._kappa = np.where(wave_number.imag > 0, -1j, 1j)[:, None]  # so that Re c >= 0
        decay = np.exp(-wave_number * length_m)
        rotation = np.exp(-wave_number * self._kappa[:, 0] * length_m)
        unit_row, kappa = np.ones_like(wave_number), self._kappa[:, 0]
        # y(0), y'(0)/b, y''(L)/b², y'''(L)/b³ of the four functions: c² = -b².
        boundary_rows = [
            [unit_row, decay, unit_row, rotation],
            [-unit_row, decay, -kappa, kappa * rotation],
            [decay, unit_row, -rotation, -unit_row],
            [-decay, unit_row, kappa * rotation, -kappa],
        ]
        self._inverse = np.linalg.inv(np.moveaxis(np.array(boundary_rows), -1, 0)).astype(
            np.complex128
        )

    def response_per_angle(self, x: RealArray, derivative_order: int) -> ComplexArray:
        """Return the displacement per root angle at x, or its derivative by x; shape (s, m)."""
        return self._weighted_sum(
            self._inverse[:, :, 1, None] / self._b[:, :, None], x, derivative_order
        )

    def response_per_force_over_stiffness(
        self, x: RealArray, force_x: RealArray, derivative_order: int
    ) -> ComplexArray:
        """Return displacement times bending stiffness per point force, or its derivative by x.

        Point i of x, shape (m,), is displaced by the force at point i of `force_x`. The result has
        the shape (s, m).
        """
        b, c, kappa = self._b, self._kappa * self._b, self._kappa
        first_wave_amplitude = -1 / (4 * b**3)  # A, of the decaying wave
        second_wave_amplitude = -first_wave_amplitude / kappa  # B, of the other
        waves_at_root = (
            first_wave_amplitude * np.exp(-b * force_x),
            second_wave_amplitude * np.exp(-c * force_x),
        )
        waves_at_tip = (
            first_wave_amplitude * np.exp(-b * (self._length_m - force_x)),
            second_wave_amplitude * np.exp(-c * (self._length_m - force_x)),
        )
        direct_end_values = np.stack(
            [
                waves_at_root[0] + waves_at_root[1],
                waves_at_root[0] + kappa * waves_at_root[1],
                waves_at_tip[0] - waves_at_tip[1],
                -waves_at_tip[0] + kappa * waves_at_tip[1],
            ],
            axis=1,
        )
        distance_m = np.abs(x - force_x)
        derivative_sign = np.where(
            x > force_x, -1.0, 1.0
        )  # the sign of each derivative of exp(-b r)
        direct_response = (derivative_sign * b) ** derivative_order * first_wave_amplitude * np.exp(
            -b * distance_m
        ) + (derivative_sign * c) ** derivative_order * second_wave_amplitude * np.exp(
            -c * distance_m
        )
        coefficients = -self._inverse @ direct_end_values
        return direct_response + self._weighted_sum(coefficients, x, derivative_order)

    def _weighted_sum(
        self, coefficients: ComplexArray, x: RealArray, derivative_order: int
    ) -> ComplexArray:
        """Return the four exponential solutions' weighted sum; weights of shape (s, 4, m or 1)."""
        b, c = self._b, self._kappa * self._b
        distance_from_tip_m = self._length_m - x
        exponentials = (
            (-b) ** derivative_order * np.exp(-b * x),
            b**derivative_order * np.exp(-b * distance_from_tip_m),
            (-c) ** derivative_order * np.exp(-c * x),
            c**derivative_order * np.exp(-c * distance_from_tip_m),
        )
        weighted_sum: ComplexArray = sum(
            (coefficients[:, i] * exponential for i, exponential in enumerate(exponentials)),
            start=np.zeros((b.shape[0], x.size), dtype=np.complex128),
        )
        return weighted_sum
