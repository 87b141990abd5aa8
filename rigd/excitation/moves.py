"""Paths of moves: quintic, paths that leave a beam at rest, slew, and braking.

A reference consists of one acceleration a tick: ``r[k] = dt² Σ_{j<k} (k - j) a[j]``. The closed
loop is linear. A mode with the pole s is therefore at rest after the move if the accelerations'
transform ``Σ a[j] exp(-s j dt)`` is zero, because the angle that follows the reference has the same
zero. With a zero of second order (the derivative of the transform is zero as well) little vibration
remains even if the pole is not well known. The poles are those of the closed loop with the motor
held, since its modes continue to ring.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.excitation._signals import require_positive

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

MAX_ROBUST_MODE_HZ = 60.0
"""Frequency in Hz below which a robust move has zeros of second order for the modes. Higher modes
are too weak to matter after a change of 1 % in their frequency."""

_MAX_RELATIVE_ACCELERATION = 24.0
"""Largest acceleration of a path, divided by ``distance / duration²``: four times a quintic's. A
path shorter than about half a period of a mode would exceed it, and then has fewer zeros."""


def quintic(duration_s: float, rate_hz: float) -> RealArray:
    """Return the minimum-jerk path from 0 to 1 at each tick, at rest at both ends, shape (n,).

    Parameters
    ----------
    duration_s
        Time in s from the last tick at 0 to the first tick at 1.
    rate_hz
        Ticks a second.

    Returns
    -------
    ndarray, shape (n,)
        ``u³ (10 - 15 u + 6 u²)`` at the n ticks after the start; the last value is 1.

    References
    ----------
    T. Flash and N. Hogan, Journal of Neuroscience 5 (1985) 1688.

    Examples
    --------
    >>> from rigd.excitation.moves import quintic
    >>> quintic(0.004, 1000.0).round(4)
    array([0.1035, 0.5   , 0.8965, 1.    ])
    """
    n = max(1, round(duration_s * rate_hz))
    u = np.arange(1, n + 1) / n
    unit_path: RealArray = u**3 * (10 - 15 * u + 6 * u**2)
    return unit_path


def vibration_free_path(duration_s: float, rate_hz: float, poles_rad_s: ComplexArray) -> RealArray:
    """Return the path from 0 to 1 of least mean-square acceleration that leaves all modes at rest.

    The path has zeros of second order at the poles if the time suffices, else zeros of first order.
    If the duration is less than about half a period of the slowest mode, the path is the quintic.

    Parameters
    ----------
    duration_s
        Time in s from the last tick at 0 to the first tick at 1.
    rate_hz
        Ticks a second.
    poles_rad_s
        Poles of the modes, shape (m,): one pole of each pair.

    Returns
    -------
    ndarray, shape (n,)
        Path at the n ticks after the start; the last value is 1.
    """
    n = max(1, round(duration_s * rate_hz))
    for order_of_zeros in (2, 1):
        constraint_matrix = np.concatenate(
            [
                _motion_map(n, rate_hz),
                residual_vibration_map(n, rate_hz, poles_rad_s, order_of_zeros),
            ]
        )
        if len(constraint_matrix) > n:
            continue
        unit_accelerations, is_solved = _least_norm_solution(
            constraint_matrix, np.array([0.0, 1.0])
        )
        if (
            is_solved
            and np.abs(unit_accelerations).max() * (n / rate_hz) ** 2 <= _MAX_RELATIVE_ACCELERATION
        ):
            return from_acceleration(unit_accelerations, rate_hz)
    return quintic(duration_s, rate_hz)


def slew(
    distance_rad: float,
    *,
    speed_rad_s: float,
    acceleration_rad_s2: float,
    rate_hz: float,
    poles_rad_s: ComplexArray,
) -> RealArray:
    """Return a reference at constant speed that excites no vibration, on the way or at the end.

    A pulse of acceleration that leaves all modes at rest starts the motion, and the same pulse with
    the other sign ends it. A pulse takes at least half a period of the slowest mode.

    Parameters
    ----------
    distance_rad
        Angle from start to end, of either sign.
    speed_rad_s
        Speed on the way. It is lower if the distance is too short to reach it.
    acceleration_rad_s2
        Largest acceleration; the pulses are lengthened to stay below it.
    rate_hz
        Ticks a second.
    poles_rad_s
        Poles of the modes, shape (m,): one pole of each pair.

    Returns
    -------
    ndarray, shape (n,)
        Reference at the n ticks after the start, relative to the angle there.

    Raises
    ------
    ExcitationError
        If speed or acceleration is not positive.
    """
    require_positive("speed_rad_s", speed_rad_s, "rad/s")
    require_positive("acceleration_rad_s2", acceleration_rad_s2, "rad/s²")
    lowest_mode_rad_s = float(np.abs(poles_rad_s.imag[poles_rad_s.imag != 0]).min(initial=np.inf))
    cruise_speed_rad_s = speed_rad_s
    pulse_ticks = max(4 * len(poles_rad_s), round(rate_hz * np.pi / lowest_mode_rad_s), 8)
    while True:
        start_pulse = _speed_change_pulse(pulse_ticks, rate_hz, poles_rad_s)
        # Both pulses together cover the distance of one at full speed.
        cruise_speed_rad_s = min(speed_rad_s, abs(distance_rad) * rate_hz / pulse_ticks)
        if (
            start_pulse is not None
            and cruise_speed_rad_s * np.abs(start_pulse).max() <= acceleration_rad_s2
        ):
            break
        pulse_ticks = pulse_ticks + max(1, pulse_ticks // 20)
    cruise_ticks = round(abs(distance_rad) / cruise_speed_rad_s * rate_hz) - pulse_ticks
    # With a whole number of cruise ticks the speed is slightly lower than requested.
    cruise_speed_rad_s = abs(distance_rad) * rate_hz / (pulse_ticks + cruise_ticks)
    accelerations_rad_s2 = np.concatenate([start_pulse, np.zeros(cruise_ticks), -start_pulse])
    return from_acceleration(
        np.copysign(cruise_speed_rad_s, distance_rad) * accelerations_rad_s2, rate_hz
    )


def _speed_change_pulse(
    tick_count: int, rate_hz: float, poles_rad_s: ComplexArray
) -> RealArray | None:
    """Return the accelerations (n,) of least norm that change the speed by 1 rad/s.

    They leave all modes at rest. Return None if `tick_count` ticks are too few.
    """
    constraint_matrix = np.concatenate(
        [
            _motion_map(tick_count, rate_hz)[:1],
            residual_vibration_map(tick_count, rate_hz, poles_rad_s, 1),
        ]
    )
    unit_pulse, is_solved = _least_norm_solution(constraint_matrix, np.array([1.0]))
    return unit_pulse if is_solved else None


def from_acceleration(acceleration_rad_s2: RealArray, rate_hz: float) -> RealArray:
    """Integrate accelerations twice to the reference angle in rad at the ticks after the start.

    Parameters
    ----------
    acceleration_rad_s2
        Acceleration in each tick, shape (n,).
    rate_hz
        Ticks a second.
    """
    reference_rad: RealArray = np.cumsum(np.cumsum(acceleration_rad_s2)) / rate_hz**2
    return reference_rad


def _motion_map(tick_count: int, rate_hz: float) -> RealArray:
    """Return the linear map, shape (2, n), from n accelerations to change of speed and distance."""
    ticks_to_end = tick_count - np.arange(tick_count)
    return np.stack([np.full(tick_count, 1.0 / rate_hz), ticks_to_end / rate_hz**2])


def residual_vibration_map(
    tick_count: int, rate_hz: float, poles_rad_s: ComplexArray, order_of_zeros: int
) -> RealArray:
    """Return the linear map from n accelerations to the modes' vibration after the last one.

    Its product with the accelerations is zero if the path leaves all modes at rest. Each mode has a
    row for the real part and one for the imaginary part of its complex state at the end of the
    path. With ``order_of_zeros`` 2 the modes below `MAX_ROBUST_MODE_HZ` have rows for the
    derivative by the pole as well. The shape is (rows, ticks).

    Parameters
    ----------
    tick_count
        Number of ticks of the path.
    rate_hz
        Ticks a second.
    poles_rad_s
        Poles of the modes, shape (m,): one pole of each pair.
    order_of_zeros
        Order of the zeros: 1 or 2.
    """
    time_to_end_s = (tick_count - np.arange(tick_count)) / rate_hz
    map_rows: list[RealArray] = []
    for mode_pole in poles_rad_s:
        pole_transform = np.exp(mode_pole * time_to_end_s) / rate_hz
        has_second_order_zero = (
            order_of_zeros > 1 and abs(mode_pole) < 2 * np.pi * MAX_ROBUST_MODE_HZ
        )
        for row in (
            (pole_transform, pole_transform * time_to_end_s / time_to_end_s[0])
            if has_second_order_zero
            else (pole_transform,)
        ):
            map_rows.append(row.real)
            if mode_pole.imag != 0.0:
                map_rows.append(row.imag)
    return np.array(map_rows).reshape(-1, tick_count)


def _least_norm_solution(
    constraint_matrix: RealArray, required_values: RealArray
) -> tuple[RealArray, bool]:
    """Return the least-squares solution a of ``linear_map @ a = wanted_values``, of least norm.

    The second result is whether a solves the equations within rounding errors.

    Rows beyond the length of `required_values` have the right-hand side 0.
    """
    right_hand_side = np.zeros(len(constraint_matrix))
    right_hand_side[: required_values.size] = required_values
    row_norms = np.linalg.norm(constraint_matrix, axis=1)
    least_norm = np.linalg.lstsq(
        constraint_matrix / row_norms[:, None], right_hand_side / row_norms, rcond=1e-12
    )[0]
    relative_residuals = np.abs(constraint_matrix @ least_norm - right_hand_side) / row_norms
    return least_norm, bool(relative_residuals.max() <= 1e-9 * np.linalg.norm(least_norm))


def modal_state(
    reference_rad: RealArray, rate_hz: float, poles_rad_s: ComplexArray
) -> ComplexArray:
    """Return the complex state of each mode's vibration at the end of a reference.

    It is the transform of the reference's accelerations at the mode's pole.

    Parameters
    ----------
    reference_rad
        Reference angle from rest on, shape (n,).
    rate_hz
        Ticks a second.
    poles_rad_s
        Poles of the modes, shape (m,).

    Returns
    -------
    ndarray, shape (m,)
        Complex state in rad/s; 0 if the mode is at rest.
    """
    accelerations_rad_s2 = np.diff(reference_rad, n=2, prepend=(reference_rad[0],) * 2) * rate_hz**2
    # r[k+1] - 2 r[k] + r[k-1] belongs to tick k: one before the sample in which it shows.
    time_to_end_s = np.arange(accelerations_rad_s2.size, 0, -1) / rate_hz
    modal_states: ComplexArray = (
        np.exp(np.outer(poles_rad_s, time_to_end_s)) @ accelerations_rad_s2 / rate_hz
    )
    return modal_states


# Braking


@dataclass(frozen=True, slots=True, eq=False)
class Braking:
    """Precomputed braking path, which can start at any tick without further planning.

    Speed and acceleration follow polynomials of time from their present values to zero, so neither
    jumps. The path is linear in speed and acceleration at the start, so a tick takes two products.
    """

    rate_hz: float
    """Ticks a second."""
    path_per_speed_s: tuple[float, ...]
    """Angle covered at the ticks after the start, per speed at the start; in s."""
    per_acceleration_s2: tuple[float, ...]
    """Angle covered at the ticks after the start, per acceleration at the start; in s²."""

    @property
    def duration_s(self) -> float:
        """Time in s from the start of braking to standstill."""
        return len(self.path_per_speed_s) / self.rate_hz

    def path(
        self, angle_rad: float, speed_rad_s: float, acceleration_rad_s2: float = 0.0
    ) -> list[float]:
        """Return the reference angle in rad at the ticks after the start of braking.

        The last angle is that at standstill.

        Parameters
        ----------
        angle_rad, speed_rad_s, acceleration_rad_s2
            Reference angle, speed and acceleration at the start of braking.
        """
        return [
            angle_rad + speed_rad_s * speed_factor_s + acceleration_rad_s2 * acceleration_factor_s2
            for speed_factor_s, acceleration_factor_s2 in zip(
                self.path_per_speed_s, self.per_acceleration_s2, strict=True
            )
        ]


def braking_path(duration_s: float, rate_hz: float) -> Braking:
    """Return the braking path that stops the motor within a given time from any speed.

    Parameters
    ----------
    duration_s
        Time in s to standstill. `rigd.excitation.shortest_braking` finds the shortest one within a
        rig's limits.
    rate_hz
        Ticks a second.

    Notes
    -----
    With ``u = t / duration``, speed v and acceleration a at the start, the speed is
    ``v (2 u³ - 3 u² + 1) + a duration (u³ - 2 u² + u)``. From constant speed the largest
    deceleration is ``1.5 v / duration`` and the way is ``v duration / 2``.

    Examples
    --------
    >>> from rigd.excitation.moves import braking_path
    >>> braking = braking_path(0.1, rate_hz=1000)
    >>> path_rad = braking.path(0.6, speed_rad_s=1.0)
    >>> round(path_rad[-1], 6)  # half the way of a motor that goes on
    0.65
    """
    require_positive("duration_s", duration_s, "s")
    n = max(2, round(duration_s * rate_hz))
    time_s = n / rate_hz
    u = np.arange(1, n + 1) / n
    path_per_speed_s = time_s * (u**4 / 2 - u**3 + u)
    path_per_acceleration_s2 = time_s**2 * (u**4 / 4 - 2 * u**3 / 3 + u**2 / 2)
    return Braking(
        rate_hz, tuple(path_per_speed_s.tolist()), tuple(path_per_acceleration_s2.tolist())
    )


def braked_reference(
    reference_rad: Sequence[float] | RealArray, tick: int, braking: Braking
) -> RealArray:
    """Return a reference up to a tick, followed by the braking path, as in the control loop.

    Parameters
    ----------
    reference_rad
        Reference angle at each tick, shape (n,).
    tick
        Last tick at which the reference is followed. It is at least 2, since speed and acceleration
        are differences of three angles.
    braking
        Braking path.

    Returns
    -------
    ndarray, shape (tick + 1 + m,)
        Angles of the reference and of the m ticks of the braking path. The last angle is that at
        standstill.
    """
    angle_two_ticks_before, angle_one_tick_before, present_angle = (
        float(angle_rad) for angle_rad in reference_rad[tick - 2 : tick + 1]
    )
    rate_hz = braking.rate_hz
    acceleration_rad_s2 = (
        present_angle - 2 * angle_one_tick_before + angle_two_ticks_before
    ) * rate_hz**2
    speed_rad_s = (present_angle - angle_one_tick_before) * rate_hz + acceleration_rad_s2 / (
        2 * rate_hz
    )
    return np.concatenate(
        [reference_rad[: tick + 1], braking.path(present_angle, speed_rad_s, acceleration_rad_s2)]
    )
