"""Probing move: strokes at two speeds within tight bounds, on a rig with unverified scales.

A wrong scale or sign makes every limit wrong by the same factor, so no check here relies on one
alone. The shaft is driven by its speed, slowly at first. The coupling torque is independent of
encoder and motor: in every tick it is compared with the torque of the profile's beam at the
measured angle, and the move ends where they differ. The torque rises slowly enough that this
comparison stops the shaft of a frozen or coarse encoder within a tenth of a radian.

A speed controller at the same shaft as the beam is stable for a motor with a fifth to five times
the inertia, because motor, beam and damping are passive; nothing is fed forward.
"""

from cmath import exp
from dataclasses import dataclass
from enum import Enum
from math import inf, pi

from rigd.beam import Beam, Damping, participation, poles

MEASURED = ("motor.inertia_kg_m2", "motor.rated_torque_nm", "encoder.resolution_rad")
"""Values of a profile that need no probing move if all have the source "measured"."""


# Beam at the measured angle

_MODES = 4
"""Modes of the beam that the strokes excite; the inertia of the others follows at once."""
_REST_RAD_S = 300.0
"""Angular frequency of a heavily damped model of the tool and the higher modes."""


@dataclass(frozen=True, slots=True)
class ProbedRig:
    """Data of a profile that a probing move uses or verifies."""

    rate_hz: float
    """Ticks a second."""
    beam: Beam
    """Nominal beam."""
    damping: Damping
    """Its nominal damping."""
    tool_inertia_kg_m2: float
    """Inertia between sensor and beam."""
    inertia_kg_m2: float
    """Inertia of the motor."""
    rated_torque_nm: float
    """Rated torque of the motor."""
    peak_torque_nm: float
    """Largest torque that may be commanded."""
    resolution_rad: float
    """Encoder step."""
    command_delay_s: float
    """Delay from the tick of a command to the tick whose angle shows its torque."""
    angle_limit_rad: float
    """Limit of the angle, to either side of the rig's zero."""
    velocity_limit_rad_s: float
    """Limit of the speed."""


class BeamFollower:
    """Torque of the profile's beam at a measured angle, tick by tick from rest.

    Each mode is an oscillator driven by the angle; fractional damping is only approximated, with an
    error of 5 % of the torque.

    Parameters
    ----------
    rig
        Rig with the beam.
    """

    def __init__(self, rig: ProbedRig) -> None:
        beam = rig.beam
        inertias = participation(beam, _MODES) * beam.density_kg_per_m
        rest = beam.inertia_kg_m2 - float(inertias.sum()) + rig.tool_inertia_kg_m2
        own = poles(beam, rig.damping, _MODES)[:, 0]
        modes = [
            (complex(pole), float(inertia))
            for pole, inertia in zip(own, inertias, strict=True)
            if pole.imag > 0.0
        ]
        self._parts: list[tuple[complex, complex, complex, float]] = []
        for pole, inertia in [*modes, (_REST_RAD_S * (-0.7 + 0.714j), rest)]:
            square = abs(pole) ** 2
            residue = (square - 2.0 * pole.real * pole) / (2j * pole.imag)
            steps = _held_line(pole, residue, 1.0 / rig.rate_hz)
            self._parts.append((*steps, inertia * square))
        self._states = [0j] * len(self._parts)
        self._angle_rad = 0.0

    def step(self, angle_rad: float) -> float:
        """Return the torque at the next tick, N·m.

        Parameters
        ----------
        angle_rad
            Angle relative to the initial position at rest.
        """
        before_rad, self._angle_rad = self._angle_rad, angle_rad
        states, torque_nm = self._states, 0.0
        for number, (turn, first, last, stiffness) in enumerate(self._parts):
            state = states[number] = turn * states[number] + first * before_rad + last * angle_rad
            torque_nm += stiffness * (angle_rad - 2.0 * state.real)
        return torque_nm


def _held_line(
    pole: complex, residue: complex, period_s: float
) -> tuple[complex, complex, complex]:
    """Return the step of ``z' = pole z + residue u`` for a straight line u over a period.

    The new state is ``a z + b u_before + c u_now``.
    """
    turn = exp(pole * period_s)
    constant = (turn - 1.0) / pole
    slope = (turn - 1.0 - pole * period_s) / (pole * pole * period_s)
    return turn, residue * (constant - slope), residue * slope


# Plan

_SPEED_RAD_S = 0.4
"""Speed of the first strokes; the second ones are twice as fast."""
_STROKE_RAD = 0.16
"""Travel of the first strokes, where the speed limit and the room allow it."""
_TORQUE_RISE_PER_S = 0.4
"""Rise of the torque until the shaft moves, in rated torques a second. A slower one would not stop
a shaft with a frozen encoder any earlier: the beam's torque is then smaller at the same speed."""
_RAMP_S = 0.06
_LEAST_CRUISE_S = 0.35
_SPEED_LIMIT_PART = 0.2
_ROOM_PART = 0.25
"""Largest fractions of the profile's limits that a stroke of the second speed uses."""
_TORQUE_PART = 0.5
"""Fraction of the rated torque at which a shaft that has not moved counts as blocked."""


@dataclass(frozen=True, slots=True)
class ProbePlan:
    """Plan of a probing move, in the profile's units."""

    speed_rad_s: float
    """Speed of the first pair of strokes; that of the second pair is twice as high."""
    cruise_s: float
    """From the start of a stroke to the start of its end: a whole number of periods of the beam's
    first mode, so that the end cancels the vibration of the start."""
    torque_limit_nm: float
    """Largest torque."""
    torque_rise_nm_per_s: float
    """Rise of the torque until the shaft moves."""

    @property
    def fast_rad_s(self) -> float:
        """Speed of the second pair of strokes."""
        return 2.0 * self.speed_rad_s

    @property
    def travel_rad(self) -> float:
        """Travel of a stroke of the second pair."""
        return self.fast_rad_s * self.cruise_s

    @property
    def bound_rad(self) -> float:
        """Angle from the start beyond which the move ends."""
        return 1.5 * self.travel_rad + 0.05

    @property
    def velocity_bound_rad_s(self) -> float:
        """Speed above which the move ends."""
        return 2.5 * self.fast_rad_s


def plan_probe(rig: ProbedRig) -> ProbePlan:
    """Plan the strokes of a probing move.

    Parameters
    ----------
    rig
        Data of the profile.
    """
    first = abs(complex(poles(rig.beam, rig.damping, 1)[0, 0]))
    period_s = 2.0 * pi / first
    cruise_s = period_s * max(1, round(_LEAST_CRUISE_S / period_s + 0.3))
    fast_rad_s = min(
        2.0 * _SPEED_RAD_S,
        2.0 * _STROKE_RAD / cruise_s,
        _SPEED_LIMIT_PART * rig.velocity_limit_rad_s,
        _ROOM_PART * rig.angle_limit_rad / cruise_s,
    )
    torque_nm = min(_TORQUE_PART * rig.rated_torque_nm, rig.peak_torque_nm)
    return ProbePlan(
        0.5 * fast_rad_s, cruise_s, torque_nm, _TORQUE_RISE_PER_S * rig.rated_torque_nm
    )


# The move


class ProbeEnd(Enum):
    """Reason for the end of a probing move."""

    COMPLETE = "all strokes were made"
    BLOCKED = "the shaft did not move"
    REVERSED = "the encoder counts against the torque"
    STILL = "the encoder stands still while the beam pulls"
    PULLED = "the coupling torque is not the beam's at the measured angle"
    AWAY = "the shaft left the bounds of the move"


_BANDWIDTH_RAD_S = 25.0
_INTEGRAL_RAD_S = 6.0
"""Bandwidth of the speed controller, for the profile's inertia of motor and beam."""
_SPEED_S = 0.004
"""Time over which the speed is measured."""
_SMOOTH_S = 0.012
"""Time constant of the comparison with the beam."""
_MOVED_STEPS = 8
"""Encoder steps that count as a motion: the number is valid for any size of the step."""
_LEAST_MOVED_RAD = 2e-4
_PULL_NM = 8e-3
_PULL_NOISE = 2.0
_PULL_PART = 0.6
"""Difference from the beam's torque that ends the move: the largest of a floor, of so many standard
deviations at rest, and of a fraction of that torque."""
_STILL_S = 0.025
"""Time without a new angle after which an encoder counts as frozen if the beam pulls."""
_PAUSE_S = 0.15
_LONGEST_S = 5.0
"""Longest time for a stroke; a sound one takes less."""
_KNOWN_FRICTION = 0.7
"""Fraction of the torque of the last stroke at which the next one begins."""
_EARLY_BAND = 0.5, 2.0
"""Ratios of coupling torque and beam with which a further stroke begins."""


class ProbingMove:
    """Controller of a probing move; a tick takes some microseconds.

    Parameters
    ----------
    rig
        Data of the profile.
    plan
        From `plan_probe`.
    start_rad
        Angle at which the shaft is at rest.
    torque_noise_nm
        Standard deviation of the coupling torque at rest.

    Attributes
    ----------
    end : ProbeEnd or None
        Reason for the end of the move; None: it continues.
    missed : int
        Ticks that were missed before the next step.
    angles_rad, torques_nm, coupling_nm : list of float
        The record: angle from the start, torque commanded at this tick, coupling torque; one entry
        per period, with missed ticks interpolated.
    """

    saturated = False
    unlimited_torque_nm = 0.0

    def __init__(
        self, rig: ProbedRig, plan: ProbePlan, start_rad: float, torque_noise_nm: float
    ) -> None:
        rate_hz = rig.rate_hz
        self._plan = plan
        self._start_rad = start_rad
        self._period_s = 1.0 / rate_hz
        self._follower = BeamFollower(rig)
        inertia = rig.inertia_kg_m2 + rig.beam.inertia_kg_m2 + rig.tool_inertia_kg_m2
        bandwidth = min(_BANDWIDTH_RAD_S, 0.05 * rate_hz)
        self._gain = inertia * bandwidth
        self._integral_gain = self._gain * min(_INTEGRAL_RAD_S, 0.25 * bandwidth)
        self._span = max(2, round(_SPEED_S * rate_hz))
        self._smooth = 1.0 / (1.0 + _SMOOTH_S * rate_hz)
        self._pull_nm = max(_PULL_NM, _PULL_NOISE * torque_noise_nm)
        self._moved_rad = max(_MOVED_STEPS * rig.resolution_rad, _LEAST_MOVED_RAD)
        toward = -1.0 if start_rad > 0.0 else 1.0
        self._strokes = [
            (side * toward, speed)
            for speed in (plan.speed_rad_s, plan.fast_rad_s)
            for side in (1.0, -1.0)
        ]
        self._stroke = 0
        self._from_rad = 0.0
        self._moving_since: int | None = None
        self._began = 0
        self._integral_nm = 0.0
        self._known_nm = 0.0
        self._torque_nm = 0.0
        self._smooth_coupling_nm = self._smooth_beam_nm = 0.0
        self._reach_nm = 0.0
        self._squares = self._products = 0.0
        self.end: ProbeEnd | None = None
        self.missed = 0
        self.angles_rad: list[float] = []
        self.torques_nm: list[float] = []
        self.coupling_nm: list[float] = []

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the torque of this tick, N·m; 0 after the end of the move.

        Parameters
        ----------
        reference_rad
            Not used: the move has its own.
        angle_rad, coupling_torque_nm
            Readings of this tick.
        """
        del reference_rad
        angle_rad -= self._start_rad
        if self.missed and self.angles_rad:
            self._fill_in(angle_rad, coupling_torque_nm)
        self._compare(angle_rad, coupling_torque_nm)
        if self.end is None:
            self._check(angle_rad)
        torque_nm = 0.0 if self.end is not None else self._drive(angle_rad)
        self._torque_nm = self.unlimited_torque_nm = torque_nm
        self._note(angle_rad, torque_nm, coupling_torque_nm)
        return torque_nm

    def _fill_in(self, angle_rad: float, coupling_torque_nm: float) -> None:
        """Interpolate the readings of missed ticks linearly; the torque was held."""
        before_rad, before_nm = self.angles_rad[-1], self.coupling_nm[-1]
        for tick in range(1, self.missed + 1):
            part = tick / (self.missed + 1)
            between_rad = before_rad + part * (angle_rad - before_rad)
            between_nm = before_nm + part * (coupling_torque_nm - before_nm)
            self._compare(between_rad, between_nm)
            self._note(between_rad, self._torque_nm, between_nm)
        self.missed = 0

    def _note(self, angle_rad: float, torque_nm: float, coupling_nm: float) -> None:
        self.angles_rad.append(angle_rad)
        self.torques_nm.append(torque_nm)
        self.coupling_nm.append(coupling_nm)

    def _compare(self, angle_rad: float, coupling_nm: float) -> None:
        """Update the beam's torque, and compare it with the sensor's."""
        beam_nm = self._follower.step(angle_rad)
        self._smooth_beam_nm += self._smooth * (beam_nm - self._smooth_beam_nm)
        self._smooth_coupling_nm += self._smooth * (coupling_nm - self._smooth_coupling_nm)
        self._squares += self._smooth_beam_nm**2
        self._products += self._smooth_beam_nm * self._smooth_coupling_nm
        # Uses the largest torque of the last third of a second, so that zero crossings count.
        fade = 1.0 - 3.0 * self._period_s
        self._reach_nm = max(abs(self._smooth_beam_nm), fade * self._reach_nm)
        difference_nm = abs(self._smooth_coupling_nm - self._smooth_beam_nm)
        if self.end is None and difference_nm > max(self._pull_nm, _PULL_PART * self._reach_nm):
            self.end = ProbeEnd.STILL if self._is_still(angle_rad) else ProbeEnd.PULLED

    def _is_still(self, angle_rad: float) -> bool:
        recent = self.angles_rad[-max(3, self._ticks(_STILL_S)) :]
        return all(each == angle_rad for each in recent)

    def _check(self, angle_rad: float) -> None:
        """End a move outside its bounds."""
        plan = self._plan
        if (
            abs(angle_rad) > plan.bound_rad
            or abs(self._speed_rad_s) > plan.velocity_bound_rad_s
            or self._now - self._began > self._ticks(_LONGEST_S)
        ):
            self.end = ProbeEnd.AWAY

    @property
    def _now(self) -> int:
        return len(self.angles_rad)

    def _ticks(self, duration_s: float) -> int:
        return round(duration_s / self._period_s)

    def _drive(self, angle_rad: float) -> float:
        """Return the torque of the present stroke."""
        side, speed = self._strokes[self._stroke]
        plan = self._plan
        if self._moving_since is None:
            return self._start_stroke(side, side * (angle_rad - self._from_rad))
        elapsed_s = (self._now - self._moving_since) * self._period_s
        wanted = _rise(elapsed_s / _RAMP_S) - _rise((elapsed_s - plan.cruise_s) / _RAMP_S)
        if elapsed_s < plan.cruise_s:
            self._known_nm = abs(self._integral_nm)
        elif elapsed_s > plan.cruise_s + _RAMP_S + _PAUSE_S:
            return self._next(angle_rad)
        return self._regulate(side * speed * wanted)

    def _start_stroke(self, side: float, moved_rad: float) -> float:
        """Raise the torque until the shaft moves."""
        if moved_rad < -self._moved_rad and self._stroke == 0:
            self.end = ProbeEnd.REVERSED
            return 0.0
        if moved_rad > self._moved_rad:
            self._moving_since = self._now
            return self._integral_nm
        self._integral_nm += side * self._plan.torque_rise_nm_per_s * self._period_s
        if abs(self._integral_nm) > self._plan.torque_limit_nm:
            self.end = ProbeEnd.BLOCKED
            return 0.0
        return self._integral_nm

    def _next(self, angle_rad: float) -> float:
        """Start the next stroke, if the strokes so far leave no doubt of the scales."""
        self._stroke += 1
        ratio = self._products / self._squares if self._squares else inf
        if self._stroke == len(self._strokes):
            self.end = ProbeEnd.COMPLETE
        elif not _EARLY_BAND[0] < ratio < _EARLY_BAND[1]:
            self.end = ProbeEnd.PULLED
        if self.end is not None:
            return 0.0
        self._from_rad, self._moving_since, self._began = angle_rad, None, self._now
        self._integral_nm = self._strokes[self._stroke][0] * _KNOWN_FRICTION * self._known_nm
        return self._integral_nm

    def _regulate(self, wanted_rad_s: float) -> float:
        """Return the torque that brings the shaft to a speed."""
        error_rad_s = wanted_rad_s - self._speed_rad_s
        limit_nm = self._plan.torque_limit_nm
        self._integral_nm += self._integral_gain * self._period_s * error_rad_s
        self._integral_nm = min(max(self._integral_nm, -limit_nm), limit_nm)
        return min(max(self._gain * error_rad_s + self._integral_nm, -limit_nm), limit_nm)

    @property
    def _speed_rad_s(self) -> float:
        """Return the speed over the last ticks."""
        angles, span = self.angles_rad, self._span
        if len(angles) <= span:
            return 0.0
        return (angles[-1] - angles[-1 - span]) / (span * self._period_s)


def _rise(x: float) -> float:
    """Return a smooth rise from 0 to 1 over x in [0, 1]."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
