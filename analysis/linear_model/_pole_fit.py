"""Realisation of a response by fixed poles: residues and direct terms by linear least squares.

The coupling torque per angular acceleration is approximated by a sum over poles::

    H(s) / s² ≈ sum_k c_k(s) + D + V / s + K / s²

with a pair of poles for each mode, some real poles for the branch cut of fractional orders, the
inertia D, and the integrals of the acceleration (velocity and angle) with V and K. The residual is
relative to the response. Poles are at the exact positions, or negative and real, so every fit is
stable. D, V and K of a beam are not negative, and a motor with the realised beam is not unstable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.linear_model._state_space import SignalNames, StateSpace, with_filter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.linear_model._dynamics import Dynamics

    RealArray = NDArray[np.float64]

InputKind = Literal["acceleration", "angle"]
"""Input of an exported model."""

INPUT_KINDS: Final[tuple[InputKind, ...]] = ("acceleration", "angle")
"""Possible inputs of an exported model."""

_INPUT_SIGNALS: Final = SignalNames(
    ("motor_angle", "motor_velocity", "motor_acceleration"), ("rad", "rad/s", "rad/s^2")
)
"""Names and units of the inputs."""

_OUTPUT_SIGNAL: Final = SignalNames(("coupling_torque",), ("N.m",))
"""Name and unit of the output."""

_FIT_POINT_COUNTS: Final = (200, 10)
"""Numbers of frequencies to which a state space is fitted: over the band, and around each pole and
zero."""

_CHECK_POINT_COUNTS: Final = (1200, 34)
"""Numbers of frequencies at which the error of a fit is checked: over the band, and around each
pole and zero."""
_BAND_MARGIN_FACTOR: Final = 1.1
"""Factor by which the range of frequencies with full weight exceeds the band at each end."""

_TAIL_FREQUENCY_FACTORS: Final = (500.0, 10.0)
"""Factors by which the range of frequencies with little weight exceeds the band, below and above.
"""
_TAIL_POINTS: Final = 25
"""Number of frequencies with little weight on each side of the band."""

_TAIL_WEIGHT: Final = 1e-5
"""Weight of the relative error at frequencies outside of the band."""

_MIN_RELATIVE_POLE_DISTANCE: Final = 3e-7
"""Smallest distance from a pole or zero, relative to the frequency, for a meaningful error."""
_ZERO_SCAN_POINTS: Final = 4000
"""Number of frequencies at which minima of the response are searched for."""

_MAX_NEWTON_ITERATIONS: Final = 30
"""Largest number of Newton iterations for the zeros."""

_RELATIVE_SINGULAR_VALUE_LIMIT: Final = 1e-10
"""Singular values below this fraction of the largest one count as zero in the least squares."""

_MAX_RELATIVE_ZERO_CHANGE: Final = 0.3
"""Largest relative distance of a zero from the start point of Newton's method."""
_MAX_GROWTH_PER_S: Final = 1e-2
"""Largest growth rate, in 1/s, at which a motor with the realised beam counts as stable."""


@dataclass(frozen=True, slots=True)
class PoleStructure:
    """States of a realisation: pole pairs, real poles and integrators, without coefficients.

    Attributes
    ----------
    pair_count : int
        Number of conjugate pairs of poles.
    added_real_poles_rad_s : tuple of float
        Negative real poles in addition to those of over-damped modes.
    integrator_count : int
        Number of integrals of the acceleration: 0, 1 (velocity) or 2 (velocity and angle).
    """

    pair_count: int
    added_real_poles_rad_s: tuple[float, ...]
    integrator_count: int


class PoleFit:
    """Least-squares fits of one response by state spaces of any pole structure.

    The search for zeros starts from those of `similar_fit`, a fit of almost the same dynamics.
    """

    def __init__(self, dynamics: Dynamics, similar_fit: PoleFit | None = None) -> None:
        self.dynamics = dynamics
        low_hz, high_hz = dynamics.band_hz
        start_zeros = self._response_minima() if similar_fit is None else similar_fit.zeros
        self.zeros: NDArray[np.complex128] = self._find_zeros(start_zeros)
        wide_band_hz = (low_hz / _BAND_MARGIN_FACTOR, high_hz * _BAND_MARGIN_FACTOR)
        band_frequency_hz = self._dense_frequencies(wide_band_hz, _FIT_POINT_COUNTS)
        tail_frequency_hz = np.concatenate(
            [
                np.geomspace(low_hz / _TAIL_FREQUENCY_FACTORS[0], wide_band_hz[0], _TAIL_POINTS),
                np.geomspace(wide_band_hz[1], high_hz * _TAIL_FREQUENCY_FACTORS[1], _TAIL_POINTS),
            ]
        )
        if dynamics.motor_inertia_kg_m2 is None:  # a modal model is meant for its band alone
            tail_frequency_hz = tail_frequency_hz[:0]
        frequency_hz = np.concatenate([band_frequency_hz, tail_frequency_hz])
        is_usable = self._is_apart_from_poles_and_zeros(frequency_hz)
        self._s = imaginary_axis(frequency_hz[is_usable])
        self._in_band = (np.arange(frequency_hz.size) < band_frequency_hz.size)[is_usable]
        point_weight = np.where(self._in_band, 1.0, _TAIL_WEIGHT)
        torque_per_acceleration = dynamics.response(self._s) / self._s**2
        self._point_scale = point_weight / np.abs(torque_per_acceleration)
        self._weighted_target_response = (
            torque_per_acceleration - dynamics.tool_inertia_kg_m2
        ) * self._point_scale
        self._pair_basis = [
            self._pair_basis_functions(upper_pole) for upper_pole in dynamics.pole_pairs
        ]

    @cached_property
    def check_points_s(self) -> NDArray[np.complex128]:
        """Return the points s in rad/s at which the error of a fitted state space is checked."""
        check_frequency_hz = self._dense_frequencies(self.dynamics.band_hz, _CHECK_POINT_COUNTS)
        return imaginary_axis(
            check_frequency_hz[self._is_apart_from_poles_and_zeros(check_frequency_hz)]
        )

    @cached_property
    def exact_response(self) -> NDArray[np.complex128]:
        """Return the exact response at `check_points_s`, without delay, in N·m/rad."""
        return self.dynamics.filtered_response(self.check_points_s)

    def real_poles(self, pole_structure: PoleStructure) -> tuple[float, ...]:
        """Return all real poles of a pole structure in rad/s, those of over-damped modes first."""
        return (*self.dynamics.real_poles, *pole_structure.added_real_poles_rad_s)

    def solve(self, pole_structure: PoleStructure) -> tuple[NDArray[np.float64], float]:
        """Fit the coefficients of a pole structure to the response.

        Return the coefficients (residues, then D, and V and K if the structure has these
        integrators), and the largest relative error in the band, at the points of the fit.
        """
        real_poles = self.real_poles(pole_structure)
        direct_term_count = 1 + pole_structure.integrator_count
        basis_functions = np.concatenate(
            [
                *self._pair_basis[: pole_structure.pair_count],
                [1 / (self._s - real_pole) for real_pole in real_poles]
                or np.empty((0, self._s.size)),
                [self._s**-power_of_s for power_of_s in range(direct_term_count)],
            ]
        )
        basis_functions = basis_functions * self._point_scale
        bounded_coefficient_count = (
            direct_term_count if self.dynamics.motor_inertia_kg_m2 is not None else 0
        )
        fit_coefficients = _least_squares(
            basis_functions, self._weighted_target_response, bounded_coefficient_count
        )
        weighted_residual = fit_coefficients @ basis_functions - self._weighted_target_response
        return fit_coefficients, float(np.abs(weighted_residual[self._in_band]).max())

    def system(
        self,
        pole_structure: PoleStructure,
        fit_coefficients: NDArray[np.float64],
        input_kind: InputKind,
    ) -> StateSpace:
        """Return the state space of a fit, with tool inertia, filters and delay.

        The coefficients are those of `solve`. The input is "acceleration", or "angle" for angle,
        velocity and acceleration.
        """
        state_space = self._system_without_filters(pole_structure, fit_coefficients, input_kind)
        for time_constant_s, filter_order in self.dynamics.torque_filters:
            state_space = with_filter(state_space, time_constant_s, filter_order)
        return replace(state_space, delay_s=self.dynamics.delay_s)

    def relative_error(self, state_space: StateSpace) -> NDArray[np.float64]:
        """Return the relative error of a state space at each point of `check_points_s`.

        The state space is a realisation in continuous time.
        """
        return np.abs(angle_response(state_space, self.check_points_s) / self.exact_response - 1)

    def is_stable_on_motor(
        self, pole_structure: PoleStructure, fit_coefficients: NDArray[np.float64]
    ) -> bool:
        """Return whether a frictionless motor of the beam's inertia is stable with the fitted beam.

        The coefficients are those of `solve`.
        """
        motor_inertia_kg_m2 = self.dynamics.motor_inertia_kg_m2
        if motor_inertia_kg_m2 is None:
            return True
        state_space = self._system_without_filters(pole_structure, fit_coefficients, "acceleration")
        coupled_state_matrix = state_space.a - state_space.b @ state_space.c / (
            motor_inertia_kg_m2 + state_space.d.item()
        )
        return bool(
            np.linalg.eigvals(coupled_state_matrix).real.max(initial=0.0) <= _MAX_GROWTH_PER_S
        )

    def _system_without_filters(
        self,
        pole_structure: PoleStructure,
        fit_coefficients: NDArray[np.float64],
        input_kind: InputKind,
    ) -> StateSpace:
        """Return the state space of a fit with tool inertia, without filters and delay."""
        upper_poles, real_poles = (
            self.dynamics.pole_pairs[: pole_structure.pair_count],
            self.real_poles(pole_structure),
        )
        pole_count = 2 * upper_poles.size + len(real_poles)
        a = np.zeros((pole_count, pole_count))
        pair_rows = np.arange(0, 2 * upper_poles.size, 2)
        a[pair_rows, pair_rows] = a[pair_rows + 1, pair_rows + 1] = upper_poles.real
        a[pair_rows, pair_rows + 1] = upper_poles.imag
        a[pair_rows + 1, pair_rows] = -upper_poles.imag
        real_rows = np.arange(2 * upper_poles.size, pole_count)
        a[real_rows, real_rows] = real_poles
        b = np.ones((pole_count, 1))
        b[pair_rows + 1] = 0.0
        c = fit_coefficients[None, :pole_count]
        inertia_coefficient, viscosity_coefficient, stiffness_coefficient = np.append(
            fit_coefficients[pole_count:], np.zeros(2)
        )[:3].tolist()
        inertia_coefficient += self.dynamics.tool_inertia_kg_m2
        state_names = [
            f"{mode_name}_{state_suffix}"
            for mode_name in self.dynamics.pair_names[: upper_poles.size]
            for state_suffix in "ab"
        ]
        state_names += [
            f"relaxation_{pole_number}" for pole_number in range(1, len(real_poles) + 1)
        ]
        if input_kind == "angle":
            # s² / (s - p) = s + p + p² / (s - p)
            stiffness_coefficient += (c @ a @ b).item()
            viscosity_coefficient += (c @ b).item()
            return StateSpace(
                a,
                np.pad(b, ((0, 0), (0, 2))),
                c @ a @ a,
                np.array([[stiffness_coefficient, viscosity_coefficient, inertia_coefficient]]),
                _INPUT_SIGNALS,
                _OUTPUT_SIGNAL,
                SignalNames(tuple(state_names), ("rad.s",) * pole_count),
            )
        # Velocity v and angle q are integrals of the input u: v' = u, q' = v.
        k = pole_structure.integrator_count
        a = np.pad(a, (0, k))
        if k == 2:
            a[pole_count + 1, pole_count] = 1.0
        b = np.append(b, np.eye(k, 1), axis=0)
        return StateSpace(
            a,
            b,
            np.append(c, np.array([[viscosity_coefficient, stiffness_coefficient]])[:, :k], axis=1),
            np.array([[inertia_coefficient]]),
            SignalNames(_INPUT_SIGNALS.names[2:], _INPUT_SIGNALS.units[2:]),
            _OUTPUT_SIGNAL,
            SignalNames(
                (*state_names, *("motor_velocity", "motor_angle")[:k]),
                (*("rad/s",) * pole_count, *("rad/s", "rad")[:k]),
            ),
        )

    def _pair_basis_functions(self, upper_pole: complex) -> NDArray[np.complex128]:
        """Return the responses of the two states of a conjugate pole pair, shape (2, points).

        They are the basis functions of the fit.
        """
        shifted_s = self._s - upper_pole.real
        return np.array([shifted_s, np.full_like(shifted_s, -upper_pole.imag)]) / (
            shifted_s * shifted_s + upper_pole.imag**2
        )

    # Points

    def _poles_and_zeros(self) -> NDArray[np.complex128]:
        """Return the complex poles and zeros of the response to be fitted, in rad/s."""
        return np.concatenate([self.dynamics.pole_pairs, self.zeros])

    def _dense_frequencies(
        self, band_hz: tuple[float, float], point_counts: tuple[int, int]
    ) -> RealArray:
        """Return frequencies in a band, in hertz, that are dense near the poles and zeros.

        `point_counts` are their numbers over the band and within 3 half widths of a pole or zero.
        """
        poles_and_zeros_rad_s = self._poles_and_zeros()
        half_width_rad_s = np.maximum(
            np.abs(poles_and_zeros_rad_s.real), 1e-4 * np.abs(poles_and_zeros_rad_s)
        )
        relative_offsets = np.linspace(-3, 3, point_counts[1])
        near_poles_and_zeros_hz = (
            poles_and_zeros_rad_s.imag[:, None] + half_width_rad_s[:, None] * relative_offsets
        ).ravel() / (2 * np.pi)
        frequencies_hz = np.concatenate(
            [np.geomspace(*band_hz, point_counts[0]), near_poles_and_zeros_hz]
        )
        return np.sort(
            frequencies_hz[(frequencies_hz >= band_hz[0]) & (frequencies_hz <= band_hz[1])]
        )

    def _is_apart_from_poles_and_zeros(self, frequency_hz: RealArray) -> NDArray[np.bool_]:
        """Return a mask of the frequencies that are far enough from every pole and zero.

        Nearer ones are not used, because a relative error means nothing at a zero.
        """
        omega_rad_s = 2 * np.pi * frequency_hz
        distance_rad_s = np.abs(1j * omega_rad_s[:, None] - self._poles_and_zeros()).min(
            axis=1, initial=np.inf
        )
        is_far_enough: NDArray[np.bool_] = (
            distance_rad_s > _MIN_RELATIVE_POLE_DISTANCE * omega_rad_s
        )
        return is_far_enough

    def _response_minima(self) -> NDArray[np.complex128]:
        """Return the points s = j omega of the local minima of the torque per acceleration."""
        low_hz, high_hz = self.dynamics.band_hz
        s = imaginary_axis(np.geomspace(low_hz / 2, high_hz * 2, _ZERO_SCAN_POINTS))
        response_magnitude = np.abs(self.dynamics.response(s) / s**2)
        minimum_indices = (
            np.flatnonzero(
                (response_magnitude[1:-1] < response_magnitude[:-2])
                & (response_magnitude[1:-1] < response_magnitude[2:])
            )
            + 1
        )
        return s[minimum_indices]

    def _find_zeros(self, start_points: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the zeros of the response that Newton's method finds near the start points."""
        s, response_of = start_points.copy(), self.dynamics.response
        if not s.size:
            return s
        for _ in range(_MAX_NEWTON_ITERATIONS):
            difference_step = 1e-6 * np.abs(s)
            response_above, response_below = response_of(
                np.concatenate([s + difference_step, s - difference_step])
            ).reshape(2, -1)
            newton_step = (
                difference_step
                * (response_above + response_below)
                / np.where(response_above == response_below, 1.0, response_above - response_below)
            )
            s = s - newton_step
            has_left_start_point = np.abs(s / start_points - 1) > _MAX_RELATIVE_ZERO_CHANGE
            s[has_left_start_point] = start_points[has_left_start_point]
            if (
                np.abs(newton_step)[~has_left_start_point] < 1e-9 * np.abs(s)[~has_left_start_point]
            ).all():
                break
        return s


def imaginary_axis(frequency_hz: RealArray) -> NDArray[np.complex128]:
    """Return s = j omega in rad/s for each frequency."""
    return np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128)


def angle_response(state_space: StateSpace, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the response of a state space to the motor angle, without its delay, in N·m/rad.

    The system is in continuous time. Its inputs are the acceleration, or angle, velocity and
    acceleration. The points s are in rad/s.
    """
    motion_per_angle = np.array([np.ones_like(s), s, s * s])[-state_space.d.shape[1] :]
    torque_response: NDArray[np.complex128] = np.einsum(
        "km,mk->k", state_space.response(s)[:, 0], motion_per_angle
    )
    return torque_response


def _least_squares(
    basis_functions: NDArray[np.complex128],
    target_response: NDArray[np.complex128],
    bounded_coefficient_count: int,
) -> NDArray[np.float64]:
    """Return real least-squares coefficients, the last `bounded_count` of them not negative."""
    real_matrix = np.concatenate([basis_functions.real, basis_functions.imag], axis=1).T
    real_target = np.concatenate([target_response.real, target_response.imag])
    column_norms = np.linalg.norm(real_matrix, axis=0)
    real_matrix = real_matrix / column_norms
    used_column_indices = np.arange(column_norms.size)
    first_bounded_index = column_norms.size - bounded_coefficient_count
    while True:
        scaled_solution = np.zeros(column_norms.size)
        scaled_solution[used_column_indices] = np.linalg.lstsq(
            real_matrix[:, used_column_indices], real_target, rcond=_RELATIVE_SINGULAR_VALUE_LIMIT
        )[0]
        bounded_coefficients = scaled_solution[first_bounded_index:]
        if not (bounded_coefficients < 0).any():
            coefficients: NDArray[np.float64] = scaled_solution / column_norms
            return coefficients
        used_column_indices = used_column_indices[
            used_column_indices != first_bounded_index + np.argmin(bounded_coefficients)
        ]
