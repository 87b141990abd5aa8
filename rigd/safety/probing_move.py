"""Probing move: strokes at two speeds within tight bounds, on a rig with unverified scales.

A wrong scale or sign makes every limit wrong by the same factor, so no check here relies on a
single scale. The speed of the shaft is controlled, slow at first. The coupling torque is
independent of encoder and motor: in every tick it is compared with the torque of the profile's beam
at the measured angle, and the move ends where they differ. The torque rises slowly enough that this
comparison stops the shaft of a frozen or coarse encoder within a tenth of a radian.

A speed controller at the same shaft as the beam is stable for a motor with a fifth to five times
the inertia, because motor, beam and damping are passive; nothing is fed forward.
"""

from cmath import exp
from dataclasses import dataclass
from enum import Enum
from math import inf, pi

from rigd.beam import Beam, Damping, participation, poles

PROBED_KEYS = ("motor.inertia_kg_m2", "motor.rated_torque_nm", "encoder.resolution_rad")
"""Keys of the profile that a probing move verifies.

The move is not needed if all of them have the source "measured"."""


# Beam at the measured angle

_BEAM_MODE_COUNT = 4
"""Number of the beam's modes that the strokes excite."""
_HIGHER_MODES_RAD_S = 300.0
"""Angular frequency in rad/s of the damped oscillator that models tool and higher modes."""


@dataclass(frozen=True, slots=True)
class ProbedRig:
    """Values of a rig's profile that the probing move before a session uses or verifies."""

    rate_hz: float
    """Loop rate in ticks per second."""
    beam: Beam
    """Nominal beam."""
    damping: Damping
    """Nominal damping of the beam."""
    tool_inertia_kg_m2: float
    """Inertia of the parts between sensor and beam."""
    inertia_kg_m2: float
    """Inertia of motor and gear at the output shaft."""
    rated_torque_nm: float
    """Rated torque of the motor."""
    peak_torque_nm: float
    """Largest torque that may be commanded."""
    resolution_rad: float
    """Angle of one encoder step."""
    command_delay_s: float
    """Delay from a torque command to the first angle that shows the torque's effect."""
    angle_limit_rad: float
    """Largest angle on either side of the rig's zero."""
    velocity_limit_rad_s: float
    """Largest speed of the output shaft."""


class BeamTorqueFilter:
    """Computes the coupling torque of the profile's beam from the measured angle, tick by tick.

    The beam is at rest in the beginning. Each mode is an oscillator driven by the angle. Fractional
    damping is only approximated, with an error of 5 % of the torque.

    Parameters
    ----------
    rig
        Values of the profile, with the beam.
    """

    def __init__(self, rig: ProbedRig) -> None:
        beam = rig.beam
        inertias = participation(beam, _BEAM_MODE_COUNT) * beam.density_kg_per_m
        remaining_inertia = beam.inertia_kg_m2 - float(inertias.sum()) + rig.tool_inertia_kg_m2
        beam_poles = poles(beam, rig.damping, _BEAM_MODE_COUNT)[:, 0]
        beam_modes = [
            (complex(mode_pole), float(mode_inertia))
            for mode_pole, mode_inertia in zip(beam_poles, inertias, strict=True)
            if mode_pole.imag > 0.0
        ]
        self._oscillators: list[tuple[complex, complex, complex, float]] = []
        for mode_pole, mode_inertia in [
            *beam_modes,
            (_HIGHER_MODES_RAD_S * (-0.7 + 0.714j), remaining_inertia),
        ]:
            squared_magnitude = abs(mode_pole) ** 2
            mode_residue = (squared_magnitude - 2.0 * mode_pole.real * mode_pole) / (
                2j * mode_pole.imag
            )
            step_coefficients = _linear_input_step(mode_pole, mode_residue, 1.0 / rig.rate_hz)
            self._oscillators.append((*step_coefficients, mode_inertia * squared_magnitude))
        self._states = [0j] * len(self._oscillators)
        self._angle_rad = 0.0

    def step(self, angle_rad: float) -> float:
        """Advance the beam by a tick with a new angle, and return its coupling torque in N·m.

        Parameters
        ----------
        angle_rad
            Angle relative to the initial position at rest.
        """
        previous_rad, self._angle_rad = self._angle_rad, angle_rad
        mode_states, torque_nm = self._states, 0.0
        for mode_index, (step_factor, previous_factor, present_factor, stiffness) in enumerate(
            self._oscillators
        ):
            mode_state = mode_states[mode_index] = (
                step_factor * mode_states[mode_index]
                + previous_factor * previous_rad
                + present_factor * angle_rad
            )
            torque_nm += stiffness * (angle_rad - 2.0 * mode_state.real)
        return torque_nm


def _linear_input_step(
    pole: complex, residue: complex, period_s: float
) -> tuple[complex, complex, complex]:
    """Return the coefficients a, b, c of the exact step of ``z' = pole z + residue u``.

    The new state is ``a z + b u_before + c u_now`` if u is a straight line over the period.
    """
    step_factor = exp(pole * period_s)
    constant_term = (step_factor - 1.0) / pole
    slope_term = (step_factor - 1.0 - pole * period_s) / (pole * pole * period_s)
    return step_factor, residue * (constant_term - slope_term), residue * slope_term


# Plan

_FIRST_STROKE_SPEED_RAD_S = 0.4
"""Speed of the first strokes in rad/s; the second strokes are twice as fast."""
_FIRST_STROKE_TRAVEL_RAD = 0.16
"""Travel of the first strokes in rad, if the limits of speed and angle allow it."""
_TORQUE_RISE_RATED_TORQUES_PER_S = 0.4
"""Rise of the torque until the shaft moves, in rated torques per second.

A slower rise would not stop a shaft with a frozen encoder any earlier: the beam's torque is then
smaller at the same speed."""
_SPEED_RAMP_S = 0.06
"""Time in seconds in which a stroke reaches its speed, or comes to rest."""
_MIN_CRUISE_S = 0.35
"""Approximate shortest time in seconds from the start of a stroke until it slows down."""
_MAX_SPEED_FRACTION = 0.2
"""Largest speed of a fast stroke, as a fraction of the profile's limit."""
_MAX_TRAVEL_FRACTION = 0.25
"""Largest travel of a fast stroke, as a fraction of the profile's limit of the angle."""
_BLOCKED_TORQUE_FRACTION = 0.5
"""Fraction of the rated torque at which a shaft that has not moved counts as blocked."""


@dataclass(frozen=True, slots=True)
class ProbePlan:
    """Speeds, durations and torques of a probing move, on the profile's scales."""

    speed_rad_s: float
    """Speed of the first pair of strokes; the second pair is twice as fast."""
    cruise_s: float
    """Time from the start of a stroke until it slows down.

    It is a whole number of periods of the beam's first mode, so that the end of the stroke cancels
    the vibration of the start."""
    torque_limit_nm: float
    """Largest torque that the move commands."""
    torque_rise_nm_per_s: float
    """Rate at which the torque rises until the shaft moves."""

    @property
    def fast_speed_rad_s(self) -> float:
        """Speed of the second pair of strokes, in rad/s."""
        return 2.0 * self.speed_rad_s

    @property
    def travel_rad(self) -> float:
        """Travel of a stroke of the second, faster pair, in rad."""
        return self.fast_speed_rad_s * self.cruise_s

    @property
    def travel_bound_rad(self) -> float:
        """Angle in rad from the start of the probing move beyond which the move ends."""
        return 1.5 * self.travel_rad + 0.05

    @property
    def velocity_bound_rad_s(self) -> float:
        """Speed in rad/s above which the probing move ends."""
        return 2.5 * self.fast_speed_rad_s


def plan_probe(rig: ProbedRig) -> ProbePlan:
    """Return the plan of a probing move within the profile's limits.

    Parameters
    ----------
    rig
        Values of the profile.
    """
    first_pole_rad_s = abs(complex(poles(rig.beam, rig.damping, 1)[0, 0]))
    first_mode_period_s = 2.0 * pi / first_pole_rad_s
    cruise_s = first_mode_period_s * max(1, round(_MIN_CRUISE_S / first_mode_period_s + 0.3))
    fast_speed_rad_s = min(
        2.0 * _FIRST_STROKE_SPEED_RAD_S,
        2.0 * _FIRST_STROKE_TRAVEL_RAD / cruise_s,
        _MAX_SPEED_FRACTION * rig.velocity_limit_rad_s,
        _MAX_TRAVEL_FRACTION * rig.angle_limit_rad / cruise_s,
    )
    torque_limit_nm = min(_BLOCKED_TORQUE_FRACTION * rig.rated_torque_nm, rig.peak_torque_nm)
    return ProbePlan(
        0.5 * fast_speed_rad_s,
        cruise_s,
        torque_limit_nm,
        _TORQUE_RISE_RATED_TORQUES_PER_S * rig.rated_torque_nm,
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


_SPEED_CONTROLLER_BANDWIDTH_RAD_S = 25.0
"""Bandwidth of the speed controller in rad/s, for the profile's inertia of motor and beam."""
_INTEGRAL_RATE_RAD_S = 6.0
"""Ratio of the speed controller's integral to its proportional gain, in rad/s."""
_SPEED_WINDOW_S = 0.004
"""Time in seconds over which the speed is measured."""
_COMPARISON_TIME_CONSTANT_S = 0.012
"""Time constant in seconds of the filter before the coupling torque is compared."""
_MIN_MOVEMENT_ENCODER_STEPS = 8
"""Smallest movement that proves motion of the shaft, in encoder steps of any size."""
_MIN_MOVEMENT_RAD = 2e-4
"""Smallest movement in rad that proves motion of the shaft."""
_MIN_TORQUE_DIFFERENCE_NM = 8e-3
"""Smallest difference in N·m between coupling torque and beam's torque that ends the move."""
_MIN_TORQUE_DIFFERENCE_STDS = 2.0
"""Smallest difference between coupling torque and beam's torque that ends the move.

It is in standard deviations of the coupling torque at rest."""
_MIN_TORQUE_DIFFERENCE_FRACTION = 0.6
"""Smallest difference between coupling torque and beam's torque that ends the move.

It is a fraction of the largest recent torque of the beam."""
_FROZEN_ENCODER_S = 0.025
"""Time in seconds without a new angle after which the encoder counts as frozen if the beam pulls.
"""
_STROKE_PAUSE_S = 0.15
"""Pause in seconds after a stroke."""
_MAX_STROKE_S = 5.0
"""Time in seconds after which a stroke that has not finished ends the move."""
_INITIAL_TORQUE_FRACTION = 0.7
"""Torque at which a stroke begins, as a fraction of the torque that moved the previous one."""
_COUPLING_RATIO_BAND = 0.5, 2.0
"""Smallest and largest ratio of coupling torque and beam's torque for a further stroke."""


class ProbingMove:
    """Controls the motor during a probing move, and records angle and torques.

    Parameters
    ----------
    rig
        Values of the profile.
    plan
        Plan of the move, as returned by `plan_probe`.
    torque_noise_nm
        Standard deviation of the coupling torque at rest.

    Attributes
    ----------
    end : ProbeEnd or None
        Reason for the end of the move, or None while it continues.
    missed : int
        Number of ticks that were missed before the next step.
    angles_rad, torques_nm, coupling_nm : list of float
        Record of the angle from the start, the commanded torque and the coupling torque, with one
        entry per tick. Missed ticks are interpolated.
    """

    saturated = False
    unlimited_torque_nm = 0.0
    terms_nm = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __init__(self, rig: ProbedRig, plan: ProbePlan, torque_noise_nm: float) -> None:
        rate_hz = rig.rate_hz
        self._rig = rig
        self._plan = plan
        self.torque_limit_nm = plan.torque_limit_nm
        self._period_s = 1.0 / rate_hz
        inertia_kg_m2 = rig.inertia_kg_m2 + rig.beam.inertia_kg_m2 + rig.tool_inertia_kg_m2
        bandwidth_rad_s = min(_SPEED_CONTROLLER_BANDWIDTH_RAD_S, 0.05 * rate_hz)
        self._gain = inertia_kg_m2 * bandwidth_rad_s
        self._integral_gain = self._gain * min(_INTEGRAL_RATE_RAD_S, 0.25 * bandwidth_rad_s)
        self._speed_ticks = max(2, round(_SPEED_WINDOW_S * rate_hz))
        self._filter_gain = 1.0 / (1.0 + _COMPARISON_TIME_CONSTANT_S * rate_hz)
        self._min_difference_nm = max(
            _MIN_TORQUE_DIFFERENCE_NM, _MIN_TORQUE_DIFFERENCE_STDS * torque_noise_nm
        )
        self._min_movement_rad = max(
            _MIN_MOVEMENT_ENCODER_STEPS * rig.resolution_rad, _MIN_MOVEMENT_RAD
        )
        self.reset(0.0)

    def reset(self, angle_rad: float) -> None:
        """Set the move to its start, with the shaft at rest at an angle."""
        self._start_rad = angle_rad
        self._beam_follower = BeamTorqueFilter(self._rig)
        first_stroke_side = -1.0 if angle_rad > 0.0 else 1.0
        self._strokes = [
            (stroke_side * first_stroke_side, speed_rad_s)
            for speed_rad_s in (self._plan.speed_rad_s, self._plan.fast_speed_rad_s)
            for stroke_side in (1.0, -1.0)
        ]
        self._stroke_index = 0
        self._stroke_start_rad = 0.0
        self._moving_since_tick: int | None = None
        self._stroke_start = 0
        self._integral_nm = 0.0
        self._stroke_torque_nm = 0.0
        self._torque_nm = 0.0
        self._smooth_coupling_nm = self._smooth_beam_nm = 0.0
        self._recent_beam_nm = 0.0
        self._beam_squares = self._beam_coupling_products = 0.0
        self.end: ProbeEnd | None = None
        self.missed = 0
        self.angles_rad: list[float] = []
        self.torques_nm: list[float] = []
        self.coupling_nm: list[float] = []

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the torque to command in this tick in N·m, or 0 after the end of the move.

        Parameters
        ----------
        reference_rad
            Not used: the move has its own reference.
        angle_rad, coupling_torque_nm
            Angle and coupling torque measured in this tick.
        """
        del reference_rad
        angle_rad -= self._start_rad
        if self.missed and self.angles_rad:
            self._record_missed_ticks(angle_rad, coupling_torque_nm)
        self._compare_coupling_torque(angle_rad, coupling_torque_nm)
        if self.end is None:
            self._check_bounds(angle_rad)
        torque_nm = 0.0 if self.end is not None else self._stroke_torque(angle_rad)
        self._torque_nm = self.unlimited_torque_nm = torque_nm
        self._record_tick(angle_rad, torque_nm, coupling_torque_nm)
        return torque_nm

    def _record_missed_ticks(self, angle_rad: float, coupling_torque_nm: float) -> None:
        """Record missed ticks with linearly interpolated readings and the last torque."""
        previous_rad, before_nm = self.angles_rad[-1], self.coupling_nm[-1]
        for tick_number in range(1, self.missed + 1):
            time_fraction = tick_number / (self.missed + 1)
            interpolated_angle_rad = previous_rad + time_fraction * (angle_rad - previous_rad)
            interpolated_torque_nm = before_nm + time_fraction * (coupling_torque_nm - before_nm)
            self._compare_coupling_torque(interpolated_angle_rad, interpolated_torque_nm)
            self._record_tick(interpolated_angle_rad, self._torque_nm, interpolated_torque_nm)
        self.missed = 0

    def _record_tick(self, angle_rad: float, torque_nm: float, coupling_nm: float) -> None:
        """Append angle, commanded torque and coupling torque of a tick to the record."""
        self.angles_rad.append(angle_rad)
        self.torques_nm.append(torque_nm)
        self.coupling_nm.append(coupling_nm)

    def _compare_coupling_torque(self, angle_rad: float, coupling_nm: float) -> None:
        """End the move if the measured coupling torque differs too much from the beam's torque."""
        beam_torque_nm = self._beam_follower.step(angle_rad)
        self._smooth_beam_nm += self._filter_gain * (beam_torque_nm - self._smooth_beam_nm)
        self._smooth_coupling_nm += self._filter_gain * (coupling_nm - self._smooth_coupling_nm)
        self._beam_squares += self._smooth_beam_nm**2
        self._beam_coupling_products += self._smooth_beam_nm * self._smooth_coupling_nm
        # The tolerance uses the largest torque of the last third of a second, since the torque is
        # small at zero crossings.
        torque_decay_factor = 1.0 - 3.0 * self._period_s
        self._recent_beam_nm = max(
            abs(self._smooth_beam_nm), torque_decay_factor * self._recent_beam_nm
        )
        difference_nm = abs(self._smooth_coupling_nm - self._smooth_beam_nm)
        if self.end is None and difference_nm > max(
            self._min_difference_nm, _MIN_TORQUE_DIFFERENCE_FRACTION * self._recent_beam_nm
        ):
            self.end = ProbeEnd.STILL if self._is_encoder_frozen(angle_rad) else ProbeEnd.PULLED

    def _is_encoder_frozen(self, angle_rad: float) -> bool:
        """Return whether the encoder has shown the same angle for `_FROZEN_ENCODER_S`."""
        recent_angles_rad = self.angles_rad[-max(3, self._ticks_in(_FROZEN_ENCODER_S)) :]
        return all(angle == angle_rad for angle in recent_angles_rad)

    def _check_bounds(self, angle_rad: float) -> None:
        """End the move if angle, speed or duration exceeds its bound."""
        plan = self._plan
        if (
            abs(angle_rad) > plan.travel_bound_rad
            or abs(self._speed_rad_s) > plan.velocity_bound_rad_s
            or self._tick_count - self._stroke_start > self._ticks_in(_MAX_STROKE_S)
        ):
            self.end = ProbeEnd.AWAY

    @property
    def _tick_count(self) -> int:
        """Number of recorded ticks."""
        return len(self.angles_rad)

    def _ticks_in(self, duration_s: float) -> int:
        """Return the number of ticks in a duration."""
        return round(duration_s / self._period_s)

    def _stroke_torque(self, angle_rad: float) -> float:
        """Return the torque in N·m that this tick of the present stroke requires."""
        stroke_side, stroke_rad_s = self._strokes[self._stroke_index]
        plan = self._plan
        if self._moving_since_tick is None:
            return self._breakaway_torque(
                stroke_side, stroke_side * (angle_rad - self._stroke_start_rad)
            )
        elapsed_s = (self._tick_count - self._moving_since_tick) * self._period_s
        speed_fraction = _smooth_step(elapsed_s / _SPEED_RAMP_S) - _smooth_step(
            (elapsed_s - plan.cruise_s) / _SPEED_RAMP_S
        )
        if elapsed_s < plan.cruise_s:
            self._stroke_torque_nm = abs(self._integral_nm)
        elif elapsed_s > plan.cruise_s + _SPEED_RAMP_S + _STROKE_PAUSE_S:
            return self._start_next_stroke(angle_rad)
        return self._speed_controller_torque(stroke_side * stroke_rad_s * speed_fraction)

    def _breakaway_torque(self, stroke_side: float, movement_rad: float) -> float:
        """Return the torque in N·m until the shaft breaks away; it rises from tick to tick."""
        if movement_rad < -self._min_movement_rad and self._stroke_index == 0:
            self.end = ProbeEnd.REVERSED
            return 0.0
        if movement_rad > self._min_movement_rad:
            self._moving_since_tick = self._tick_count
            return self._integral_nm
        self._integral_nm += stroke_side * self._plan.torque_rise_nm_per_s * self._period_s
        if abs(self._integral_nm) > self._plan.torque_limit_nm:
            self.end = ProbeEnd.BLOCKED
            return 0.0
        return self._integral_nm

    def _start_next_stroke(self, angle_rad: float) -> float:
        """Start the next stroke and return its first torque in N·m, or end the move.

        The move ends after the last stroke, or if the coupling torque differs too much from the
        beam's torque in the strokes so far.
        """
        self._stroke_index += 1
        coupling_ratio = (
            self._beam_coupling_products / self._beam_squares if self._beam_squares else inf
        )
        if self._stroke_index == len(self._strokes):
            self.end = ProbeEnd.COMPLETE
        elif not _COUPLING_RATIO_BAND[0] < coupling_ratio < _COUPLING_RATIO_BAND[1]:
            self.end = ProbeEnd.PULLED
        if self.end is not None:
            return 0.0
        self._stroke_start_rad, self._moving_since_tick, self._stroke_start = (
            angle_rad,
            None,
            self._tick_count,
        )
        self._integral_nm = (
            self._strokes[self._stroke_index][0] * _INITIAL_TORQUE_FRACTION * self._stroke_torque_nm
        )
        return self._integral_nm

    def _speed_controller_torque(self, target_speed_rad_s: float) -> float:
        """Return the speed controller's torque in N·m for a wanted speed."""
        error_rad_s = target_speed_rad_s - self._speed_rad_s
        torque_limit_nm = self._plan.torque_limit_nm
        self._integral_nm += self._integral_gain * self._period_s * error_rad_s
        self._integral_nm = min(max(self._integral_nm, -torque_limit_nm), torque_limit_nm)
        return min(
            max(self._gain * error_rad_s + self._integral_nm, -torque_limit_nm), torque_limit_nm
        )

    @property
    def _speed_rad_s(self) -> float:
        """Mean speed of the shaft over the last ticks in rad/s."""
        angles, speed_ticks = self.angles_rad, self._speed_ticks
        if len(angles) <= speed_ticks:
            return 0.0
        return (angles[-1] - angles[-1 - speed_ticks]) / (speed_ticks * self._period_s)


def _smooth_step(x: float) -> float:
    """Return the value at `x` of a smooth curve that rises from 0 at x = 0 to 1 at x = 1."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
