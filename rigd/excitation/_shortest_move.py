"""The shortest move that leaves no vibration within a rig's limits: a linear programme.

For a given duration the programme finds the accelerations that take the smallest fraction of the
limits of torque, speed, tracking error and sensor, and leave every mode at rest. At the shortest
duration that fraction is 1. The responses are those of the closed loop to a unit of acceleration:
all limits are linear in the accelerations, and Coulomb friction is subtracted from the torque.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, inf
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.excitation._residual_vibration import predict_end
from rigd.excitation._signals import (
    LIMIT_FRACTION,
    Excitation,
    ExcitationError,
    assemble,
    finite,
    lay_out_segments,
    within_a_turn,
)
from rigd.excitation.moves import (
    ROBUST_BELOW_HZ,
    Braking,
    braked,
    braking_path,
    from_acceleration,
    modal_state,
    quintic,
    zero_rows,
)
from rigd.identified_beam import MOVE, IdentifiedBeam, Use

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

LONGEST_S: Final = 60.0
"""A longer move is an error."""

_HELD_S: Final = 2e-3
"""Least time for which an acceleration is held; longer in long moves."""
_MOST_INTERVALS: Final = 60
_CLOSE: Final = 1.03
_NEARLY_ALL: Final = 0.93
"""The search ends at this ratio of a sufficient time to an insufficient one, or where the move
takes this fraction of the limits: a time shorter by 4 % would exceed them."""
_MOST_ROUNDS: Final = 14
_FARTHEST: Final = 0.98
"""Fraction of the angle limit at which a move may end; the remainder is for overshoot."""
_BACKWARD: Final = 0.01
"""Fraction of its mean speed with which a robust move may go backward."""
_LEAST_RAD: Final = 1e-3
_BRAKING_STARTS: Final = 16
_BRAKING_S: Final = (0.02, 5.0)


class Response(Protocol):
    """Response of the closed loop to a reference, as arrays (n,)."""

    @property
    def angle_rad(self) -> Real:
        """At the output shaft."""

    @property
    def velocity_rad_s(self) -> Real:
        """At the output shaft."""

    @property
    def torque_nm(self) -> Real:
        """The command, not limited."""

    @property
    def coupling_torque_nm(self) -> Real:
        """What the sensor measures."""


@dataclass(frozen=True, slots=True)
class MovePlant:
    """Model of a rig for planning a motion."""

    rate_hz: float
    """Ticks a second."""
    respond: Callable[[Real], Response]
    """Response of the closed loop to a reference (n,) from rest, without friction."""
    disturbed: Callable[[Real, int], tuple[Real, Real]]
    """Response to a reference (n,) from rest with friction, encoder steps and noise, in several
    draws: angle (n, draws), and amplitude of the torque of the lowest modes (n, modes, draws)."""
    poles_rad_s: Complex
    """Shape (m,): poles of the closed loop at the modes of the beam, one of each pair."""
    torque_per_state_nm_s: Real
    """Shape (m,): amplitude of the coupling torque per `modal_state` of a mode."""
    frequency_uncertainty: Real
    """Shape (m,): relative standard uncertainty of the modes' frequencies."""
    torque_noise_nm: float
    """Standard deviation of the noise of one reading of the coupling torque."""
    settling_s: float
    """Time in which the loop catches up with the reference."""
    peak_torque_nm: float
    """Largest torque of the motor."""
    friction_nm: float
    """Torque for friction, in addition to the linear response's."""
    largest_acceleration_rad_s2: float
    """Bound of the reference's acceleration, including the effect of the loop's filters."""
    velocity_rad_s: float
    """Limit of the speed."""
    tracking_error_rad: float
    """Limit of reference minus angle."""
    coupling_torque_nm: float
    """Range of the sensor."""
    angle_rad: float
    """Limit of the angle from the rig's zero, either way."""
    model: IdentifiedBeam | None = None
    """Beam of an analysis; None: the profile's, or an estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A planned move."""

    reference_rad: Real
    """Shape (n,): at the ticks after the start, relative to the angle there; the last one stays."""
    duration_s: float
    """Time of the reference."""
    limit_fraction: float
    """Largest predicted fraction of a limit; at most `LIMIT_FRACTION`."""
    residual_nm: float
    """Residual coupling torque of the modes in the linear loop: the sum of their amplitudes, each
    for a frequency that is wrong by its standard uncertainty."""
    quintic_residual_nm: float
    """The same for a quintic of the same duration."""


def shortest_move(
    plant: MovePlant,
    distance_rad: float,
    *,
    start_rad: float = 0.0,
    robust: bool = False,
    ringing: Complex | None = None,
) -> Move:
    """Plan the shortest move that leaves no vibration.

    Parameters
    ----------
    plant
        The rig.
    distance_rad
        Angle from start to end, either sign.
    start_rad
        Angle of the start from the rig's zero.
    robust
        Zeros of second order for the modes below `ROBUST_BELOW_HZ`, to tolerate a 1 % frequency
        error, and no turning back; the move takes longer.
    ringing
        Shape (m,): state of the modes at the start as of `modal_state`, which the move cancels;
        None: they are at rest.

    Raises
    ------
    ExcitationError
        If no move of at most `LONGEST_S` stays within the limits.

    Notes
    -----
    W. E. Singhose and others describe input shapers as such zeros; the linear programme is that of
    T. D. Tuttle and W. P. Seering, Journal of Guidance, Control, and Dynamics 17 (1994) 1032, with
    the limits of the rig instead of an impulse's.
    """
    search = _MoveSearch(plant, distance_rad, start_rad, 2 if robust else 1, ringing)
    acceleration = search.shortest()
    reference = from_acceleration(acceleration, plant.rate_hz)
    n = reference.size
    usual = distance_rad * quintic(n / plant.rate_hz, plant.rate_hz)
    return Move(
        reference_rad=reference,
        duration_s=n / plant.rate_hz,
        limit_fraction=search.limit_fraction(reference),
        residual_nm=_residual_nm(plant, reference, ringing),
        quintic_residual_nm=_residual_nm(plant, usual, ringing),
    )


def _residual_nm(plant: MovePlant, reference: Real, ringing: Complex | None) -> float:
    """Sum the residual amplitudes of the modes, each frequency wrong by its uncertainty."""
    left = []
    for off in (-plant.frequency_uncertainty, plant.frequency_uncertainty):
        poles = plant.poles_rad_s * (1.0 + off)
        state = modal_state(np.concatenate([[0.0], reference]), plant.rate_hz, poles)
        if ringing is not None:
            state = state + ringing * np.exp(poles * reference.size / plant.rate_hz)
        left.append(np.abs(state) * plant.torque_per_state_nm_s)
    return float(np.maximum(*left).sum())


class _MoveSearch:
    """Search for the shortest time, with one linear programme for each candidate."""

    def __init__(
        self,
        plant: MovePlant,
        distance_rad: float,
        start_rad: float,
        order: int,
        ringing: Complex | None,
    ) -> None:
        self._plant = plant
        self._distance_rad = distance_rad
        self._start_rad = start_rad
        self._order = order
        self._ringing = ringing
        self._unit = _UnitResponse(plant)
        rung_nm = 0.0
        if ringing is not None:
            rung_nm = float(np.abs(ringing) @ plant.torque_per_state_nm_s)
        # The remaining vibration is fed forward to the motor, and is in the sensor's reading.
        self._limits = {
            "torque": LIMIT_FRACTION * plant.peak_torque_nm - plant.friction_nm - rung_nm,
            "velocity": LIMIT_FRACTION * plant.velocity_rad_s,
            "tracking": LIMIT_FRACTION * plant.tracking_error_rad,
            "coupling": LIMIT_FRACTION * plant.coupling_torque_nm - rung_nm,
        }
        if min(self._limits.values()) <= 0.0:
            raise ExcitationError(
                "Friction and the vibration at the start leave nothing of motor.peak_torque_nm or "
                "sensor.range for a move; wait until the beam is at rest."
            )

    def shortest(self) -> Real:
        """Return the accelerations (n,) of the shortest move.

        Raises
        ------
        ExcitationError
            If it would take more than `LONGEST_S`.
        """
        rate_hz = self._plant.rate_hz
        most = round(LONGEST_S * rate_hz)
        slowest_rad_s = float(np.abs(self._plant.poles_rad_s).min())
        n = round((1.0 if self._order == 1 else 2.35) * rate_hz * np.pi / slowest_rad_s)
        too_short, found, fraction_short, fraction_found = 8, most + 1, inf, 0.0
        best: Real | None = None
        for _ in range(_MOST_ROUNDS):
            fraction, acceleration = self._least_limit_fraction(n)
            if fraction <= 1.0:
                found, fraction_found, best = n, fraction, acceleration
            else:
                too_short, fraction_short = n, fraction
            if fraction_found >= _NEARLY_ALL or found <= max(_CLOSE * too_short, too_short + 1):
                break
            if too_short >= most:
                break
            n = _next(too_short, found, fraction_short, fraction_found, n, fraction, self._order)
            n = min(n, most)
        if best is None:
            raise ExcitationError(
                f"No move of at most {LONGEST_S:g} s by {self._distance_rad:g} rad stays within "
                "the limits of the profile; choose a smaller angle, or check limits.velocity_rad_s."
            )
        return best

    def _least_limit_fraction(self, n: int) -> tuple[float, Real | None]:
        """Return the smallest fraction of the limits for n ticks, and its accelerations (n,).

        The fraction is infinite without a solution.
        """
        from scipy.optimize import linprog

        plant, rate_hz = self._plant, self._plant.rate_hz
        held = max(1, round(_HELD_S * rate_hz))
        intervals = min(ceil(n / held), _MOST_INTERVALS)
        edges = np.round(np.linspace(0, n, intervals + 1)).astype(int)
        scale = plant.largest_acceleration_rad_s2

        zeros = zero_rows(n, rate_hz, plant.poles_rad_s, self._order)
        per_interval = np.add.reduceat(zeros, edges[:-1], axis=1) * scale
        steps = np.diff(edges) / rate_hz
        # The centre of an interval's held acceleration, as `from_acceleration` sums them up.
        left_s = (n - (edges[:-1] + edges[1:] - 1) / 2) / rate_hz
        equal = np.concatenate([[steps * scale], [steps * left_s * scale], per_interval])
        goal = np.zeros(len(equal))
        goal[1] = self._distance_rad
        if self._ringing is not None:
            goal[2:] = np.negative(self._ringing_rows(n))
        size = np.linalg.norm(equal, axis=1)

        limited, bounded, bounds = self._responses(n, edges, scale)
        limited = np.concatenate([limited, np.eye(intervals)])
        fraction_column = -np.ones((len(limited), 1))
        none = np.zeros((len(bounded), 1))
        least = np.block([[limited, fraction_column], [-limited, fraction_column], [bounded, none]])
        below = np.concatenate([np.zeros(2 * len(limited)), bounds])
        found = linprog(
            np.append(np.zeros(intervals), 1.0),
            A_ub=least,
            b_ub=below,
            A_eq=np.column_stack([equal / size[:, None], np.zeros(len(equal))]),
            b_eq=goal / size,
            bounds=[(None, None)] * intervals + [(0.0, None)],
            method="highs-ds",
        )
        if found.x is None or found.status != 0:
            return inf, None
        return float(found.fun), np.repeat(found.x[:-1] * scale, np.diff(edges))

    def _ringing_rows(self, n: int) -> list[float]:
        """Return the vibration of the initial state at the end, in the order of `zero_rows`."""
        assert self._ringing is not None
        rows: list[float] = []
        for pole, state in zip(self._plant.poles_rad_s, self._ringing, strict=True):
            later = state * np.exp(pole * n / self._plant.rate_hz)
            # The row of the derivative weighs the start by 1.
            twice = self._order > 1 and abs(pole) < 2 * np.pi * ROBUST_BELOW_HZ
            for _ in range(2 if twice else 1):
                rows += [later.real, later.imag] if pole.imag != 0.0 else [later.real]
        return rows

    def _responses(self, n: int, edges: NDArray[np.intp], scale: float) -> tuple[Real, Real, Real]:
        """Return rows over the intervals: fractions of limits; bounded quantities and their bounds.

        A robust move from rest does not turn back: it goes directly to its end, and the friction
        of the motor, whose sign the controller takes from the reference, does not reverse. One
        that cancels a vibration has to go to and fro, as the shortest does, within the limit of
        the angle.
        """
        plant = self._plant
        end = n + round(plant.settling_s * plant.rate_hz)
        # The ends of all intervals and the ticks between them: the solution exploits every gap.
        middles = np.round((edges[:-1] + edges[1:]) / 2).astype(int)
        tail = np.arange(n, end, max(1, ceil(n / len(edges))))[: _MOST_INTERVALS // 2]
        fine = np.unique(np.concatenate([edges, middles if n > 2 * len(edges) else [], tail]))
        fine = fine.astype(int)
        coarse = fine[::2]
        unit = self._unit.up_to(end)
        rows = [
            _over_intervals(unit[name], edges, coarse if name == "coupling" else fine)
            * (scale / self._limits[name])
            for name in self._limits
        ]
        if self._order > 1 and self._ringing is None:
            forward = np.copysign(scale, self._distance_rad)
            backward = -forward * _over_intervals(unit["velocity"], edges, coarse)
            mean_rad_s = abs(self._distance_rad) * plant.rate_hz / n
            return np.concatenate(rows), backward, np.full(len(coarse), _BACKWARD * mean_rad_s)
        angle = scale * _over_intervals(unit["angle"], edges, coarse)
        free_rad = plant.angle_rad - self._start_rad, plant.angle_rad + self._start_rad
        return np.concatenate(rows), np.vstack([angle, -angle]), np.repeat(free_rad, len(coarse))

    def limit_fraction(self, reference: Real) -> float:
        """Return the largest fraction of a limit that a reference takes, over all ticks."""
        plant = self._plant
        held = round(plant.settling_s * plant.rate_hz)
        whole = np.concatenate([[0.0], reference, np.full(held, reference[-1])])
        response = plant.respond(whole)
        peaks = (
            (np.abs(response.torque_nm).max() + plant.friction_nm) / plant.peak_torque_nm,
            np.abs(response.velocity_rad_s).max() / plant.velocity_rad_s,
            np.abs(whole - response.angle_rad).max() / plant.tracking_error_rad,
            np.abs(response.coupling_torque_nm).max() / plant.coupling_torque_nm,
            np.abs(self._start_rad + response.angle_rad).max() / plant.angle_rad,
        )
        return float(max(peaks))


def _next(
    too_short: int,
    found: int,
    fraction_short: float,
    fraction_found: float,
    n: int,
    fraction: float,
    order: int,
) -> int:
    """Choose the number of ticks to try next, from the fractions of the limits on either side.

    The fraction falls with a power of the time: about the third, and more where the modes, not the
    distance, determine the time.
    """
    if fraction_found == 0.0:  # none has sufficed yet
        return int(max(n + 2, round(1.03 * n * min(fraction, 4.0) ** 0.3)))
    if fraction_short == inf and n == found:
        guess = round(n * max(fraction, 0.02) ** (0.08 if order > 1 else 0.22))
    elif fraction_short == inf:
        guess = round((too_short * found) ** 0.5)
    else:
        power = np.log(fraction_short / fraction_found) / np.log(found / too_short)
        guess = round(1.004 * found * fraction_found ** (1.0 / power))
    return int(min(max(guess, too_short + 1), found - 1))


class _UnitResponse:
    """Responses to a reference of acceleration 1, computed up to the needed length."""

    def __init__(self, plant: MovePlant) -> None:
        self._plant = plant
        self._rows: dict[str, Real] = {}
        self._ticks = 0

    def up_to(self, ticks: int) -> dict[str, Real]:
        """Return the rows at least up to the given number of ticks."""
        if ticks > self._ticks:
            self._ticks = max(2 * ticks, 1024)
            one = from_acceleration(np.ones(self._ticks), self._plant.rate_hz)
            reference = np.concatenate([[0.0], one[:-1]])
            response = self._plant.respond(reference)
            self._rows = {
                "torque": response.torque_nm,
                "velocity": response.velocity_rad_s,
                "tracking": reference - response.angle_rad,
                "coupling": response.coupling_torque_nm,
                "angle": response.angle_rad,
            }
        return self._rows


def _over_intervals(unit: Real, edges: NDArray[np.intp], ticks: NDArray[np.intp]) -> Real:
    """Return the response (ticks, intervals) to an acceleration of 1 in each interval."""
    since = ticks[:, None] - edges
    begun: Real = np.where(since >= 0, unit[np.maximum(since, 0)], 0.0)
    return begun[:, :-1] - begun[:, 1:]


# Braking


def shortest_braking(plant: MovePlant, reference_rad: Real) -> Braking:
    """Return the shortest braking path that stays within the torque limit from any tick.

    Parameters
    ----------
    plant
        The rig.
    reference_rad
        Shape (n,): reference from rest, which may have to be braked.

    Raises
    ------
    ExcitationError
        If no braking path of at most 5 s does.

    Notes
    -----
    The closed loop is simulated from starts all along the reference. After them the torque is
    linear in speed and acceleration of the reference at the start.
    """
    held = np.zeros(round(plant.settling_s * plant.rate_hz))
    starts = np.unique(np.linspace(2, reference_rad.size - 1, _BRAKING_STARTS).astype(int))
    free_nm = plant.peak_torque_nm - plant.friction_nm
    duration_s, longest_s = _BRAKING_S
    while duration_s <= longest_s:
        braking = braking_path(duration_s, plant.rate_hz)
        fraction = 0.0
        for tick in starts:
            path = braked(reference_rad, int(tick), braking)
            response = plant.respond(np.concatenate([path, held + path[-1]]))
            fraction = max(fraction, float(np.abs(response.torque_nm).max()) / free_nm)
            if fraction > 1.0:
                break
        if fraction <= 1.0:
            return braking
        duration_s *= min(max(fraction, 1.1), 1.5)
    raise ExcitationError(
        f"The reference cannot be braked within {longest_s:g} s by motor.peak_torque_nm = "
        f"{plant.peak_torque_nm:g} N·m; lower its speed."
    )


# Excitation


class MoveRig(Protocol):
    """Interface to a rig for which a move is planned."""

    @property
    def start_rad(self) -> float:
        """Present angle of the motor, from the rig's zero."""

    def move_plant(self, path: str | Path, use: Use) -> MovePlant:
        """Return the rig for planning, with the beam of an analysis; without a path the profile's.

        Parameters
        ----------
        path
            Document of ``analyze --json``, or empty.
        use
            Purpose of the beam.
        """


def move(
    *,
    rate_hz: float,
    angle_rad: float | None = None,
    by_rad: float | None = None,
    path: str | Path = "",
    robust: int = 0,
    rest_s: float = 1.0,
    ring_down_s: float = 5.0,
    rig: MoveRig | None = None,
) -> Excitation:
    """Move to an angle in the shortest time that leaves no vibration; the motor stays there.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    angle_rad
        Final angle, from the rig's zero.
    by_rad
        Distance, instead of `angle_rad`; either sign.
    path
        JSON written by ``analyze --json``, whose beam the move is planned for; empty: the
        profile's.
    robust
        1: the move tolerates a 1 % frequency error and does not turn back, but takes longer.
        0: the shortest.
    rest_s, ring_down_s
        Time before and after the move.
    rig
        The rig.

    Raises
    ------
    ExcitationError
        If not exactly one angle is given, or the move would leave the limits.
    IdentifiedBeamError
        If the file is invalid, or has an effect that a move does not take into account.
    """
    if rig is None:
        raise ExcitationError("A move is planned for a rig; run it with its profile.")
    if (angle_rad is None) == (by_rad is None):
        raise ExcitationError("Give either angle_rad or by_rad (rad): where to, or by how much.")
    for option, value_rad in (("angle_rad", angle_rad), ("by_rad", by_rad)):
        if value_rad is not None:
            finite(option, value_rad, "rad")
    if robust not in (0, 1):
        raise ExcitationError(f"robust = {robust} is neither 0 nor 1; choose one.")
    start_rad = rig.start_rad
    target_rad = start_rad + by_rad if angle_rad is None else angle_rad  # type: ignore[operator]
    within_a_turn("angle_rad" if by_rad is None else "by_rad", target_rad - start_rad)
    plant = rig.move_plant(path, MOVE)
    farthest_rad = _FARTHEST * plant.angle_rad
    if not abs(target_rad) <= farthest_rad:
        raise ExcitationError(
            f"The move would end at {target_rad:.4g} rad, and limits.angle_rad = "
            f"{plant.angle_rad:g} rad allows {farthest_rad:.4g} rad from the zero to either side; "
            f"choose at most that{'' if by_rad is None else _by_at_most(farthest_rad, start_rad)}."
        )
    distance_rad = target_rad - start_rad
    if abs(distance_rad) < _LEAST_RAD:
        raise ExcitationError(
            f"The motor stands at {start_rad:.4g} rad already, and a move is of {_LEAST_RAD:g} rad "
            "at least; choose another angle."
        )
    planned = shortest_move(plant, distance_rad, start_rad=start_rad, robust=bool(robust))
    segments = lay_out_segments(rate_hz, rest_s, planned.duration_s, ring_down_s)
    end = predict_end(plant, planned.reference_rad, ring_down_s)
    parameters: dict[str, float | int | str] = {
        "angle_rad": target_rad,
        "by_rad": distance_rad,
        "file": Path(path).name if path else "",
        "robust": robust,
        "duration_s": planned.duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "limits_share": planned.limit_fraction,
        "residual_nm": end.residual_nm,
        "residual_floor_nm": end.floor_nm,
        "frequency_residual_nm": planned.residual_nm,
        "quintic_residual_nm": planned.quintic_residual_nm,
    }
    if end.arrival_s is not None:
        parameters["arrival_s"] = end.arrival_s
    made = assemble("move", parameters, rate_hz, segments, planned.reference_rad)
    return replace(made, stays=True, model=plant.model)


def _by_at_most(farthest_rad: float, start_rad: float) -> str:
    """Describe the largest allowed distance from the present angle."""
    low, high = -farthest_rad - start_rad, farthest_rad - start_rad
    return f", that is by {low:.4g} to {high:.4g} rad from {start_rad:.4g} rad"
