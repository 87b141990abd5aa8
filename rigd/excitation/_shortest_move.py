"""The shortest move that leaves no vibration within a rig's limits: a linear programme.

For a given duration the programme finds the accelerations that use the smallest fraction of the
limits of torque, speed, tracking error and sensor, and leave every mode at rest. At the shortest
duration that fraction is 1. The responses are those of the closed loop to a unit of acceleration:
all limits are linear in the accelerations, and Coulomb friction is subtracted from the torque.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.excitation._signals import MAX_PLANNED_LIMIT_FRACTION, ExcitationError
from rigd.excitation.moves import (
    MAX_ROBUST_MODE_HZ,
    Braking,
    braked_reference,
    braking_path,
    from_acceleration,
    modal_state,
    quintic,
    residual_vibration_map,
)
from rigd.identified_beam import IdentifiedBeam

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

LONGEST_MOVE_S: Final = 60.0
"""Longest duration of a move in s; a longer one is an error."""

_MIN_ACCELERATION_INTERVAL_S: Final = 2e-3
"""Shortest time in s for which the acceleration is constant; it is longer in long moves."""
_MAX_ACCELERATION_INTERVALS: Final = 60
"""Largest number of intervals of constant acceleration, the unknowns of the linear programme."""
_CONVERGED_DURATION_RATIO: Final = 1.03
"""Ratio of a sufficient duration to an insufficient one at which the search for the shortest move
ends."""
_CONVERGED_LIMIT_FRACTION: Final = 0.93
"""Fraction of the limits that a move must use for the search to end: a duration shorter by 4 %
would exceed the limits."""
_MAX_TRIED_DURATIONS: Final = 14
"""Largest number of durations that the search tries."""
_MAX_BACKWARD_SPEED_FRACTION: Final = 0.01
"""Largest backward speed of a robust move, as a fraction of its mean speed."""
_BRAKING_START_COUNT: Final = 16
"""Number of ticks, spread over a reference, from which braking is simulated."""
_BRAKING_DURATIONS_S: Final = (0.02, 5.0)
"""Shortest and longest duration in s of a braking path that is tried."""


class PlannedResponse(Protocol):
    """Interface to the closed loop's response to a reference: arrays (n,), one value a tick."""

    @property
    def angle_rad(self) -> RealArray:
        """Angle of the output shaft in rad."""

    @property
    def velocity_rad_s(self) -> RealArray:
        """Speed of the output shaft in rad/s."""

    @property
    def torque_nm(self) -> RealArray:
        """Torque command in N·m without the limit of the motor."""

    @property
    def coupling_torque_nm(self) -> RealArray:
        """Coupling torque in N·m that the sensor measures."""


@dataclass(frozen=True, slots=True)
class MovePlant:
    """Linear model of the closed loop, with the rig's limits, for planning a motion."""

    rate_hz: float
    """Ticks a second."""
    respond: Callable[[RealArray], PlannedResponse]
    """Function that returns the response of the closed loop to a reference in rad, shape (n,), from
    rest and without friction."""
    respond_disturbed: Callable[[RealArray, int], tuple[RealArray, RealArray]]
    """Function that returns the response to a reference in rad, shape (n,), from rest with
    friction, encoder steps and noise, in several random draws. The second argument is the number of
    lowest modes. The result is the angle in rad, shape (n, draws), and the amplitude of each mode's
    coupling torque in N·m, shape (n, modes, draws)."""
    poles_rad_s: ComplexArray
    """Poles of the closed loop at the modes of the beam, one of each pair; shape (m,)."""
    torque_per_state_nm_s: RealArray
    """Amplitude of the coupling torque per `modal_state` of a mode, in N·m·s; shape (m,)."""
    frequency_uncertainty: RealArray
    """Relative standard uncertainty of the modes' frequencies, shape (m,)."""
    torque_noise_nm: float
    """Standard deviation in N·m of the noise of one reading of the coupling torque."""
    settling_s: float
    """Time in s after which the angle of the closed loop has reached the reference."""
    peak_torque_nm: float
    """Largest torque of the motor in N·m."""
    friction_nm: float
    """Torque in N·m against friction, which adds to the torque of the linear response."""
    max_acceleration_rad_s2: float
    """Upper bound of the reference's acceleration, including the effect of the loop's filters."""
    max_velocity_rad_s: float
    """Limit of the speed."""
    max_tracking_error_rad: float
    """Limit of the tracking error, reference minus angle."""
    max_coupling_torque_nm: float
    """Range of the sensor's coupling torque in N·m."""
    max_angle_rad: float
    """Limit of the angle from the rig's zero, to either side."""
    model: IdentifiedBeam | None = None
    """Beam of an analysis; None: the beam of the profile, or an estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Planned move of the motor to another angle, with its predicted residual vibration."""

    reference_rad: RealArray
    """Reference angle at the ticks after the start, relative to the start angle; shape (n,). The
    last angle is that of the end of the move."""
    duration_s: float
    """Duration of the move in s."""
    limit_fraction: float
    """Largest fraction of a limit that the move is predicted to use, at most
    `MAX_PLANNED_LIMIT_FRACTION`."""
    residual_nm: float
    """Coupling torque in N·m of the vibration after the move in the linear loop: the sum of the
    modes' amplitudes, each for a frequency that is wrong by its standard uncertainty."""
    quintic_residual_nm: float
    """Coupling torque in N·m of the vibration after a quintic path of the same duration."""


def shortest_move(
    plant: MovePlant,
    distance_rad: float,
    *,
    start_rad: float = 0.0,
    robust: bool = False,
    initial_modal_states: ComplexArray | None = None,
) -> Move:
    """Plan the shortest move within a rig's limits that leaves no vibration.

    Parameters
    ----------
    plant
        Model of the rig.
    distance_rad
        Angle from start to end, of either sign.
    start_rad
        Start angle from the rig's zero.
    robust
        Whether the move has zeros of second order for the modes below `MAX_ROBUST_MODE_HZ`, to
        tolerate a 1 % frequency error, and does not turn back. It then takes longer.
    initial_modal_states
        Complex state of the modes at the start as `modal_state` returns it, shape (m,), which the
        move cancels; None: the modes are at rest.

    Raises
    ------
    ExcitationError
        If no move of at most `LONGEST_MOVE_S` stays within the limits.

    Notes
    -----
    W. E. Singhose and others describe input shapers as such zeros; the linear programme is that of
    T. D. Tuttle and W. P. Seering, Journal of Guidance, Control, and Dynamics 17 (1994) 1032, with
    the limits of the rig instead of an impulse's.
    """
    move_search = _MoveSearch(
        plant, distance_rad, start_rad, 2 if robust else 1, initial_modal_states
    )
    accelerations_rad_s2 = move_search.shortest_accelerations()
    reference_rad = from_acceleration(accelerations_rad_s2, plant.rate_hz)
    n = reference_rad.size
    quintic_rad = distance_rad * quintic(n / plant.rate_hz, plant.rate_hz)
    return Move(
        reference_rad=reference_rad,
        duration_s=n / plant.rate_hz,
        limit_fraction=move_search.limit_fraction(reference_rad),
        residual_nm=_residual_torque_nm(plant, reference_rad, initial_modal_states),
        quintic_residual_nm=_residual_torque_nm(plant, quintic_rad, initial_modal_states),
    )


def _residual_torque_nm(
    plant: MovePlant, reference_rad: RealArray, initial_states: ComplexArray | None
) -> float:
    """Return the largest coupling torque in N·m of the beam's vibration after a move.

    It is the sum of the modes' amplitudes, each for a frequency wrong by its uncertainty.
    """
    residuals_nm = []
    for frequency_error in (-plant.frequency_uncertainty, plant.frequency_uncertainty):
        shifted_poles = plant.poles_rad_s * (1.0 + frequency_error)
        modal_states = modal_state(
            np.concatenate([[0.0], reference_rad]), plant.rate_hz, shifted_poles
        )
        if initial_states is not None:
            modal_states = modal_states + initial_states * np.exp(
                shifted_poles * reference_rad.size / plant.rate_hz
            )
        residuals_nm.append(np.abs(modal_states) * plant.torque_per_state_nm_s)
    return float(np.maximum(*residuals_nm).sum())


class _MoveSearch:
    """Search for the shortest move of the motor, with a linear programme for each duration."""

    def __init__(
        self,
        plant: MovePlant,
        distance_rad: float,
        start_rad: float,
        order_of_zeros: int,
        initial_states: ComplexArray | None,
    ) -> None:
        self._plant = plant
        self._distance_rad = distance_rad
        self._start_rad = start_rad
        self._order_of_zeros = order_of_zeros
        self._initial_states = initial_states
        self._unit_response = _UnitResponse(plant)
        ringing_torque_nm = 0.0
        if initial_states is not None:
            ringing_torque_nm = float(np.abs(initial_states) @ plant.torque_per_state_nm_s)
        # The remaining vibration is fed forward to the motor, and is in the sensor's reading.
        self._limits = {
            "torque": MAX_PLANNED_LIMIT_FRACTION * plant.peak_torque_nm
            - plant.friction_nm
            - ringing_torque_nm,
            "velocity": MAX_PLANNED_LIMIT_FRACTION * plant.max_velocity_rad_s,
            "tracking": MAX_PLANNED_LIMIT_FRACTION * plant.max_tracking_error_rad,
            "coupling": MAX_PLANNED_LIMIT_FRACTION * plant.max_coupling_torque_nm
            - ringing_torque_nm,
        }
        if min(self._limits.values()) <= 0.0:
            raise ExcitationError(
                "Friction and the vibration at the start leave nothing of motor.peak_torque_nm or "
                "sensor.range for a move; wait until the beam is at rest."
            )

    def shortest_accelerations(self) -> RealArray:
        """Return the accelerations of the shortest move in rad/s², shape (n,).

        Raise `ExcitationError` if the move would take more than `LONGEST_MOVE_S`.
        """
        rate_hz = self._plant.rate_hz
        longest_ticks = round(LONGEST_MOVE_S * rate_hz)
        lowest_pole_rad_s = float(np.abs(self._plant.poles_rad_s).min())
        move_ticks = round(
            (1.0 if self._order_of_zeros == 1 else 2.35) * rate_hz * np.pi / lowest_pole_rad_s
        )
        too_short_ticks, sufficient_ticks, limit_fraction_too_short, limit_fraction_sufficient = (
            8,
            longest_ticks + 1,
            inf,
            0.0,
        )
        best_accelerations: RealArray | None = None
        for _ in range(_MAX_TRIED_DURATIONS):
            used_limit_fraction, accelerations = self._least_limit_fraction(move_ticks)
            if used_limit_fraction <= 1.0:
                sufficient_ticks, limit_fraction_sufficient, best_accelerations = (
                    move_ticks,
                    used_limit_fraction,
                    accelerations,
                )
            else:
                too_short_ticks, limit_fraction_too_short = move_ticks, used_limit_fraction
            if limit_fraction_sufficient >= _CONVERGED_LIMIT_FRACTION or sufficient_ticks <= max(
                _CONVERGED_DURATION_RATIO * too_short_ticks, too_short_ticks + 1
            ):
                break
            if too_short_ticks >= longest_ticks:
                break
            move_ticks = _next_duration_ticks(
                too_short_ticks,
                sufficient_ticks,
                limit_fraction_too_short,
                limit_fraction_sufficient,
                move_ticks,
                used_limit_fraction,
                self._order_of_zeros,
            )
            move_ticks = min(move_ticks, longest_ticks)
        if best_accelerations is None:
            raise ExcitationError(
                f"No move of at most {LONGEST_MOVE_S:g} s by {self._distance_rad:g} rad stays "
                "within the limits of the profile; choose a smaller angle, or check "
                "limits.velocity_rad_s."
            )
        return best_accelerations

    def _least_limit_fraction(self, move_ticks: int) -> tuple[float, RealArray | None]:
        """Solve the linear programme for a move of n ticks.

        Return the smallest fraction of the limits that such a move uses, and its accelerations in
        rad/s², shape (n,). If there is no such move, return infinity and None.
        """
        from scipy.optimize import linprog

        plant, rate_hz = self._plant, self._plant.rate_hz
        interval_ticks = max(1, round(_MIN_ACCELERATION_INTERVAL_S * rate_hz))
        interval_count = min(ceil(move_ticks / interval_ticks), _MAX_ACCELERATION_INTERVALS)
        edge_ticks = np.round(np.linspace(0, move_ticks, interval_count + 1)).astype(int)
        acceleration_scale = plant.max_acceleration_rad_s2

        vibration_map = residual_vibration_map(
            move_ticks, rate_hz, plant.poles_rad_s, self._order_of_zeros
        )
        vibration_per_interval = (
            np.add.reduceat(vibration_map, edge_ticks[:-1], axis=1) * acceleration_scale
        )
        interval_s = np.diff(edge_ticks) / rate_hz
        # The centre of an interval's held acceleration, as `from_acceleration` sums them up.
        time_to_end_s = (move_ticks - (edge_ticks[:-1] + edge_ticks[1:] - 1) / 2) / rate_hz
        equality_matrix = np.concatenate(
            [
                [interval_s * acceleration_scale],
                [interval_s * time_to_end_s * acceleration_scale],
                vibration_per_interval,
            ]
        )
        equality_values = np.zeros(len(equality_matrix))
        equality_values[1] = self._distance_rad
        if self._initial_states is not None:
            equality_values[2:] = np.negative(self._ringing_rows(move_ticks))
        row_norms = np.linalg.norm(equality_matrix, axis=1)

        limit_fraction_map, bounded_map, bound_values = self._inequalities(
            move_ticks, edge_ticks, acceleration_scale
        )
        limit_fraction_map = np.concatenate([limit_fraction_map, np.eye(interval_count)])
        fraction_column = -np.ones((len(limit_fraction_map), 1))
        zero_column = np.zeros((len(bounded_map), 1))
        inequality_matrix = np.block(
            [
                [limit_fraction_map, fraction_column],
                [-limit_fraction_map, fraction_column],
                [bounded_map, zero_column],
            ]
        )
        upper_bounds = np.concatenate([np.zeros(2 * len(limit_fraction_map)), bound_values])
        optimum = linprog(
            np.append(np.zeros(interval_count), 1.0),
            A_ub=inequality_matrix,
            b_ub=upper_bounds,
            A_eq=np.column_stack(
                [equality_matrix / row_norms[:, None], np.zeros(len(equality_matrix))]
            ),
            b_eq=equality_values / row_norms,
            bounds=[(None, None)] * interval_count + [(0.0, None)],
            method="highs-ds",
        )
        if optimum.x is None or optimum.status != 0:
            return inf, None
        return float(optimum.fun), np.repeat(
            optimum.x[:-1] * acceleration_scale, np.diff(edge_ticks)
        )

    def _ringing_rows(self, move_ticks: int) -> list[float]:
        """Return the modes' complex states to which the initial vibration decays during a move.

        Real and imaginary parts are in the order of the rows of `residual_vibration_map`.
        """
        assert self._initial_states is not None
        state_rows: list[float] = []
        for mode_pole, mode_state in zip(
            self._plant.poles_rad_s, self._initial_states, strict=True
        ):
            end_state = mode_state * np.exp(mode_pole * move_ticks / self._plant.rate_hz)
            # The row of the derivative weighs the start by 1.
            has_second_order_zero = (
                self._order_of_zeros > 1 and abs(mode_pole) < 2 * np.pi * MAX_ROBUST_MODE_HZ
            )
            for _ in range(2 if has_second_order_zero else 1):
                state_rows += (
                    [end_state.real, end_state.imag] if mode_pole.imag != 0.0 else [end_state.real]
                )
        return state_rows

    def _inequalities(
        self, move_ticks: int, edge_ticks: NDArray[np.intp], acceleration_scale: float
    ) -> tuple[RealArray, RealArray, RealArray]:
        """Return the inequalities of the linear programme for a move of n ticks.

        They are linear maps from the acceleration in each interval: to fractions of the limits,
        and to quantities with fixed bounds. The third array contains these bounds.

        A robust move from rest does not turn back: it goes directly to its end, and the friction
        of the motor, whose sign the controller takes from the reference, does not reverse. A move
        that cancels a vibration, and the shortest move, go to and fro within the limit of the
        angle.
        """
        plant = self._plant
        end_tick = move_ticks + round(plant.settling_s * plant.rate_hz)
        # The ends of all intervals and the ticks between them: the solution exploits every gap.
        interval_middles = np.round((edge_ticks[:-1] + edge_ticks[1:]) / 2).astype(int)
        settling_ticks = np.arange(
            move_ticks, end_tick, max(1, ceil(move_ticks / len(edge_ticks)))
        )[: _MAX_ACCELERATION_INTERVALS // 2]
        checked_ticks = np.unique(
            np.concatenate(
                [
                    edge_ticks,
                    interval_middles if move_ticks > 2 * len(edge_ticks) else [],
                    settling_ticks,
                ]
            )
        )
        checked_ticks = checked_ticks.astype(int)
        every_second_tick = checked_ticks[::2]
        unit_responses = self._unit_response.responses_for_ticks(end_tick)
        limited_rows = [
            _interval_responses(
                unit_responses[limit_name],
                edge_ticks,
                every_second_tick if limit_name == "coupling" else checked_ticks,
            )
            * (acceleration_scale / self._limits[limit_name])
            for limit_name in self._limits
        ]
        if self._order_of_zeros > 1 and self._initial_states is None:
            forward_scale = np.copysign(acceleration_scale, self._distance_rad)
            backward_speed_map = -forward_scale * _interval_responses(
                unit_responses["velocity"], edge_ticks, every_second_tick
            )
            mean_speed_rad_s = abs(self._distance_rad) * plant.rate_hz / move_ticks
            return (
                np.concatenate(limited_rows),
                backward_speed_map,
                np.full(len(every_second_tick), _MAX_BACKWARD_SPEED_FRACTION * mean_speed_rad_s),
            )
        angle_map = acceleration_scale * _interval_responses(
            unit_responses["angle"], edge_ticks, every_second_tick
        )
        angle_margins_rad = (
            plant.max_angle_rad - self._start_rad,
            plant.max_angle_rad + self._start_rad,
        )
        return (
            np.concatenate(limited_rows),
            np.vstack([angle_map, -angle_map]),
            np.repeat(angle_margins_rad, len(every_second_tick)),
        )

    def limit_fraction(self, reference_rad: RealArray) -> float:
        """Return the largest fraction of a rig's limit that the response to a reference reaches."""
        plant = self._plant
        settling_tick_count = round(plant.settling_s * plant.rate_hz)
        extended_reference_rad = np.concatenate(
            [[0.0], reference_rad, np.full(settling_tick_count, reference_rad[-1])]
        )
        loop_response = plant.respond(extended_reference_rad)
        peak_fractions = (
            (np.abs(loop_response.torque_nm).max() + plant.friction_nm) / plant.peak_torque_nm,
            np.abs(loop_response.velocity_rad_s).max() / plant.max_velocity_rad_s,
            np.abs(extended_reference_rad - loop_response.angle_rad).max()
            / plant.max_tracking_error_rad,
            np.abs(loop_response.coupling_torque_nm).max() / plant.max_coupling_torque_nm,
            np.abs(self._start_rad + loop_response.angle_rad).max() / plant.max_angle_rad,
        )
        return float(max(peak_fractions))


def _next_duration_ticks(
    too_short_ticks: int,
    sufficient_ticks: int,
    limit_fraction_too_short: float,
    limit_fraction_sufficient: float,
    move_ticks: int,
    used_limit_fraction: float,
    order_of_zeros: int,
) -> int:
    """Return the duration in ticks that the search for the shortest move tries next.

    `too_short_ticks` and `sufficient_ticks` are the longest insufficient and the shortest
    sufficient duration, with the fractions of the limits that they use. The fraction falls with a
    power of the duration: about the third, and more if the modes, not the distance, determine the
    duration.
    """
    if limit_fraction_sufficient == 0.0:  # none has sufficed yet
        return int(
            max(move_ticks + 2, round(1.03 * move_ticks * min(used_limit_fraction, 4.0) ** 0.3))
        )
    if limit_fraction_too_short == inf and move_ticks == sufficient_ticks:
        guessed_ticks = round(
            move_ticks * max(used_limit_fraction, 0.02) ** (0.08 if order_of_zeros > 1 else 0.22)
        )
    elif limit_fraction_too_short == inf:
        guessed_ticks = round((too_short_ticks * sufficient_ticks) ** 0.5)
    else:
        duration_power = np.log(limit_fraction_too_short / limit_fraction_sufficient) / np.log(
            sufficient_ticks / too_short_ticks
        )
        guessed_ticks = round(
            1.004 * sufficient_ticks * limit_fraction_sufficient ** (1.0 / duration_power)
        )
    return int(min(max(guessed_ticks, too_short_ticks + 1), sufficient_ticks - 1))


class _UnitResponse:
    """Responses of torque, speed and angle to a reference acceleration of 1 rad/s²."""

    def __init__(self, plant: MovePlant) -> None:
        self._plant = plant
        self._rows: dict[str, RealArray] = {}
        self._ticks = 0

    def responses_for_ticks(self, tick_count: int) -> dict[str, RealArray]:
        """Return the response of each quantity by name, for at least the given number of ticks."""
        if tick_count > self._ticks:
            self._ticks = max(2 * tick_count, 1024)
            unit_reference_rad = from_acceleration(np.ones(self._ticks), self._plant.rate_hz)
            reference_rad = np.concatenate([[0.0], unit_reference_rad[:-1]])
            loop_response = self._plant.respond(reference_rad)
            self._rows = {
                "torque": loop_response.torque_nm,
                "velocity": loop_response.velocity_rad_s,
                "tracking": reference_rad - loop_response.angle_rad,
                "coupling": loop_response.coupling_torque_nm,
                "angle": loop_response.angle_rad,
            }
        return self._rows


def _interval_responses(
    unit_responses: RealArray, edge_ticks: NDArray[np.intp], response_ticks: NDArray[np.intp]
) -> RealArray:
    """Return the response at some ticks to an acceleration of 1 rad/s² in one interval only.

    The shape is (ticks, intervals). `unit_responses` is the response to a constant acceleration of
    1, and `edge_ticks` are the ticks at which the intervals begin and end.
    """
    ticks_since_edge = response_ticks[:, None] - edge_ticks
    step_response: RealArray = np.where(
        ticks_since_edge >= 0, unit_responses[np.maximum(ticks_since_edge, 0)], 0.0
    )
    return step_response[:, :-1] - step_response[:, 1:]


# Braking


def shortest_braking(plant: MovePlant, reference_rad: RealArray) -> Braking:
    """Return the shortest braking path that needs no more than the motor's peak torque.

    Parameters
    ----------
    plant
        Model of the rig.
    reference_rad
        Reference angle from rest, shape (n,), which may have to be braked at any tick.

    Raises
    ------
    ExcitationError
        If every braking path of at most 5 s needs more torque.

    Notes
    -----
    The closed loop is simulated with braking from ticks all along the reference. During braking the
    torque is linear in speed and acceleration of the reference at the start.
    """
    zero_reference = np.zeros(round(plant.settling_s * plant.rate_hz))
    start_ticks = np.unique(
        np.linspace(2, reference_rad.size - 1, _BRAKING_START_COUNT).astype(int)
    )
    available_torque_nm = plant.peak_torque_nm - plant.friction_nm
    duration_s, longest_s = _BRAKING_DURATIONS_S
    while duration_s <= longest_s:
        braking_law = braking_path(duration_s, plant.rate_hz)
        torque_fraction = 0.0
        for start_tick in start_ticks:
            braked_path_rad = braked_reference(reference_rad, int(start_tick), braking_law)
            loop_response = plant.respond(
                np.concatenate([braked_path_rad, zero_reference + braked_path_rad[-1]])
            )
            torque_fraction = max(
                torque_fraction, float(np.abs(loop_response.torque_nm).max()) / available_torque_nm
            )
            if torque_fraction > 1.0:
                break
        if torque_fraction <= 1.0:
            return braking_law
        duration_s *= min(max(torque_fraction, 1.1), 1.5)
    raise ExcitationError(
        f"The reference cannot be braked within {longest_s:g} s by motor.peak_torque_nm = "
        f"{plant.peak_torque_nm:g} N·m; lower its speed."
    )
