"""Gain, phase, delay and modulus margin of the discrete closed loop at each of its openings.

A margin states how wrong one signal may be before the loop becomes unstable. There are three such
signals, each with a meaning of its own:

torque command
    Motor and drive: torque constant, gear, delay of the command. It contains the whole loop, the
    angle's PID and the coupling torque's feed-forward.
angle reading
    The loop for which the controller was designed: the PID around the motor, with the beam
    cancelled by the feed-forward.
torque reading
    The feed-forward alone: calibration, lever arm and delay of the sensor.

The feed-forward is positive feedback that cancels the beam. At resonances of the clamped beam the
loop gain of the feed-forward is -1 by design. The curve therefore passes close to the critical
point at the first and the third signal with any controller: with a command that is `k` times too
strong, ``1 - k`` times the beam's torque remains in the loop. A gain margin of 2 is impossible
there, since it would mean that the inverted torque of the beam acts on the motor. There the
tolerances of drive and sensor have to fit into the margin. The rules of thumb for a feedback loop
apply to the angle only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, nan, pi

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop, LoopOpening

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MIN_FREQUENCY_FRACTION = 1e-6
"""Lowest examined frequency, as a fraction of the sampling rate."""
_FREQUENCIES_PER_DECADE = 60
"""Number of examined frequencies in a decade, in addition to those near resonances."""
_RESONANCE_OFFSETS = np.geomspace(0.03, 100.0, 16)
"""Offsets of examined frequencies from a resonance to either side, in its half-widths."""
_MIN_RELATIVE_HALF_WIDTH = 1e-6
"""Smallest half-width of a resonance relative to its frequency, used for undamped modes."""
_MAX_EIGENVALUE_OF_DELAY = 1e-3
"""Magnitude of an eigenvalue below which it belongs to a delay, not to a resonance."""
_MAX_IMAGINARY_RATIO = 1e-3
"""Largest ratio of imaginary to real part with which the gain at either end of the frequencies
counts as real."""
_FREQUENCIES_PER_BLOCK = 128
"""Number of frequencies at which the gain is computed at once."""
_BISECTION_COUNT = 45
"""Number of bisections by which the zero of a function of frequency is found."""
_REFINEMENT_COUNT = 3
"""Number of times that the frequencies around the smallest distance are refined."""


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins at one signal of a stable loop, each with its frequency.

    A frequency is NaN if the margin is unlimited.
    """

    opening: str
    """Name of the signal."""
    gain_up: float
    """Smallest factor above 1 on the signal with which the loop becomes unstable; infinite if
    none."""
    gain_up_hz: float
    """Frequency in Hz at which the loop becomes unstable with the factor `gain_up`."""
    gain_down: float
    """Largest factor below 1 on the signal with which the loop becomes unstable; 0 if none."""
    gain_down_hz: float
    """Frequency in Hz at which the loop becomes unstable with the factor `gain_down`."""
    phase_rad: float
    """Smallest phase shift of the signal in either direction that makes the loop unstable, up to
    π."""
    phase_hz: float
    """Frequency in Hz at which the loop becomes unstable with this phase shift."""
    delay_s: float
    """Smallest additional delay of the signal that makes the loop unstable; infinite if none."""
    delay_hz: float
    """Frequency in Hz at which the loop becomes unstable with this delay."""
    modulus: float
    """Modulus margin: smallest distance of the open loop's gain from -1, the inverse of the largest
    sensitivity."""
    modulus_hz: float
    """Frequency in Hz of the smallest distance."""


def loop_margins(closed_loop: ClosedLoop) -> tuple[Margins, ...]:
    """Return the stability margins at each signal at which the loop can be opened.

    An additional delay counts as a phase shift. That is exact for whole periods, and otherwise to
    0.1 % at the frequencies of the beam.

    Parameters
    ----------
    closed_loop
        Stable loop; the margins of an unstable loop are meaningless.

    References
    ----------
    K. J. Åström and R. M. Murray, Feedback Systems, section 9.3.

    Examples
    --------
    >>> from rigd.control import close_loop, loop_margins
    >>> from rigd.profile import load_profile
    >>> for each in loop_margins(close_loop(load_profile("sim").loop_model())):
    ...     print(f"{each.opening}: modulus margin {each.modulus:.2f}")
    torque command: modulus margin 0.23
    angle reading: modulus margin 0.47
    torque reading: modulus margin 0.25
    """
    return tuple(_margins_at_opening(closed_loop, opening) for opening in closed_loop.openings)


def open_loop_gain(
    closed_loop: ClosedLoop, opening: LoopOpening, phase_per_tick_rad: RealArray
) -> ComplexArray:
    """Return the complex gain L of the loop opened at one signal, at some frequencies, shape (m,).

    The sensitivity of the closed loop is ``1/(1 + L)``. `phase_per_tick_rad` is the angular
    frequency times the period; π is half the sampling rate.
    """
    n = opening.action_column.size
    open_loop_matrix = closed_loop.a - np.outer(opening.action_column, opening.reading_row)
    complex_gain = np.empty(phase_per_tick_rad.shape, complex)
    for first_index in range(0, phase_per_tick_rad.size, _FREQUENCIES_PER_BLOCK):
        z = np.exp(1j * phase_per_tick_rad[first_index : first_index + _FREQUENCIES_PER_BLOCK])[
            :, np.newaxis, np.newaxis
        ]
        repeated_action_column = np.broadcast_to(
            opening.action_column[:, np.newaxis], (z.size, n, 1)
        )
        state_responses = np.linalg.solve(z * np.eye(n) - open_loop_matrix, repeated_action_column)
        complex_gain[first_index : first_index + _FREQUENCIES_PER_BLOCK] = -(
            state_responses[:, :, 0] @ opening.reading_row
        )
    return complex_gain


def _margins_at_opening(closed_loop: ClosedLoop, opening: LoopOpening) -> Margins:
    """Return the stability margins of a closed loop opened at one signal."""

    def gain_curve(phase_per_tick_rad: RealArray) -> ComplexArray:
        return open_loop_gain(closed_loop, opening, phase_per_tick_rad)

    rate_hz = closed_loop.model.rate_hz
    angular_frequencies = _examined_frequencies(closed_loop, opening)
    complex_gain = gain_curve(angular_frequencies)

    crossing_phase_rad, real_gain = _negative_real_crossings(
        gain_curve, angular_frequencies, complex_gain
    )
    gain_factors = -1.0 / real_gain
    gain_up_phase_rad, gain_up = _smallest_with_frequency(
        crossing_phase_rad, np.where(gain_factors > 1.0, gain_factors, inf)
    )
    gain_down_phase_rad, gain_down = _smallest_with_frequency(
        crossing_phase_rad, np.where(gain_factors <= 1.0, -gain_factors, inf)
    )

    unity_phase_rad = _sign_changes(
        lambda gain_values: np.abs(gain_values) - 1.0, gain_curve, angular_frequencies, complex_gain
    )
    lag_rad = (np.angle(gain_curve(unity_phase_rad)) + pi) % (2.0 * pi)
    phase_margin_at_rad, phase_rad = _smallest_with_frequency(
        unity_phase_rad, np.minimum(lag_rad, 2.0 * pi - lag_rad)
    )
    delay_phase_rad, delay_s = _smallest_with_frequency(
        unity_phase_rad, lag_rad / unity_phase_rad / rate_hz
    )

    modulus_phase_rad, modulus = _distance_to_critical_point(
        gain_curve, angular_frequencies, complex_gain
    )
    phase_rad_to_hz = rate_hz / (2.0 * pi)
    return Margins(
        opening=opening.name,
        gain_up=gain_up,
        gain_up_hz=gain_up_phase_rad * phase_rad_to_hz,
        gain_down=0.0 if gain_down == inf else -gain_down,
        gain_down_hz=gain_down_phase_rad * phase_rad_to_hz,
        phase_rad=min(phase_rad, pi),
        phase_hz=phase_margin_at_rad * phase_rad_to_hz,
        delay_s=delay_s,
        delay_hz=delay_phase_rad * phase_rad_to_hz,
        modulus=modulus,
        modulus_hz=modulus_phase_rad * phase_rad_to_hz,
    )


GainCurve = Callable[[RealArray], ComplexArray]
"""Function that returns the open loop's gain at angular frequencies times the period."""


def _examined_frequencies(closed_loop: ClosedLoop, opening: LoopOpening) -> RealArray:
    """Return the frequencies at which margins are searched, in rad per tick, increasing.

    They are dense around the resonances of the open and the closed loop.
    """
    open_loop_matrix = closed_loop.a - np.outer(opening.action_column, opening.reading_row)
    resonance_poles = np.concatenate(
        [np.linalg.eigvals(state_matrix) for state_matrix in (open_loop_matrix, closed_loop.a)]
    )
    resonance_poles = np.log(
        resonance_poles[np.abs(resonance_poles) > _MAX_EIGENVALUE_OF_DELAY].astype(complex)
    )
    resonance_poles = resonance_poles[(resonance_poles.imag > 0.0) & (resonance_poles.imag < pi)]
    half_widths = np.maximum(
        np.abs(resonance_poles.real), _MIN_RELATIVE_HALF_WIDTH * resonance_poles.imag
    )
    frequency_offsets = half_widths[:, np.newaxis] * np.concatenate(
        [-_RESONANCE_OFFSETS, [0.0], _RESONANCE_OFFSETS]
    )
    lowest_phase_per_tick_rad = 2.0 * pi * _MIN_FREQUENCY_FRACTION
    decade_grid = np.geomspace(
        lowest_phase_per_tick_rad,
        pi,
        round(_FREQUENCIES_PER_DECADE * np.log10(pi / lowest_phase_per_tick_rad)),
    )
    angular_frequencies = np.concatenate(
        [decade_grid, (resonance_poles.imag[:, np.newaxis] + frequency_offsets).ravel()]
    )
    return np.unique(
        angular_frequencies[
            (angular_frequencies >= lowest_phase_per_tick_rad) & (angular_frequencies <= pi)
        ]
    )


def _negative_real_crossings(
    gain_curve: GainCurve, phase_per_tick_rad: RealArray, curve_gain: ComplexArray
) -> tuple[RealArray, RealArray]:
    """Return the frequencies at which the open loop's gain is real and negative, and the gains."""
    crossings = _sign_changes(np.imag, gain_curve, phase_per_tick_rad, curve_gain)
    # The curve ends at frequency 0 and half the sampling rate, where the gain is always real.
    end_indices = [
        end
        for end in (0, -1)
        if abs(curve_gain[end].imag) < _MAX_IMAGINARY_RATIO * abs(curve_gain[end].real)
    ]
    crossing_frequencies = np.concatenate([crossings, phase_per_tick_rad[end_indices]])
    real_gains = np.concatenate([gain_curve(crossings).real, curve_gain[end_indices].real])
    return crossing_frequencies[real_gains < 0.0], real_gains[real_gains < 0.0]


def _sign_changes(
    real_function: Callable[[ComplexArray], RealArray],
    gain_curve: GainCurve,
    phase_per_tick_rad: RealArray,
    curve_gain: ComplexArray,
) -> RealArray:
    """Return the frequencies at which a real function of the open loop's gain changes its sign."""
    is_negative = np.signbit(real_function(curve_gain))
    interval_indices = np.flatnonzero(is_negative[:-1] != is_negative[1:])
    lower_frequencies, upper_frequencies = (
        phase_per_tick_rad[interval_indices],
        phase_per_tick_rad[interval_indices + 1],
    )
    for _ in range(_BISECTION_COUNT):
        middle_frequencies = 0.5 * (lower_frequencies + upper_frequencies)
        is_before_zero = (
            np.signbit(real_function(gain_curve(middle_frequencies)))
            == is_negative[interval_indices]
        )
        lower_frequencies, upper_frequencies = (
            np.where(is_before_zero, middle_frequencies, lower_frequencies),
            np.where(is_before_zero, upper_frequencies, middle_frequencies),
        )
    zero_frequencies: RealArray = 0.5 * (lower_frequencies + upper_frequencies)
    return zero_frequencies


def _smallest_with_frequency(
    value_frequencies: RealArray, candidate_values: RealArray
) -> tuple[float, float]:
    """Return the frequency of the smallest value, and the value; NaN and infinity if all are inf.

    `value_frequencies` contains the frequency of each value.
    """
    if candidate_values.size == 0 or candidate_values.min() == inf:
        return nan, inf
    smallest_index = int(candidate_values.argmin())
    return float(value_frequencies[smallest_index]), float(candidate_values[smallest_index])


def _distance_to_critical_point(
    gain_curve: GainCurve, phase_per_tick_rad: RealArray, curve_gain: ComplexArray
) -> tuple[float, float]:
    """Return the frequency at which the open loop's gain is closest to -1, and the distance."""
    for _ in range(_REFINEMENT_COUNT):
        nearest_index = int(np.abs(1.0 + curve_gain).argmin())
        lower_frequency, upper_frequency = (
            phase_per_tick_rad[max(nearest_index - 1, 0)],
            phase_per_tick_rad[min(nearest_index + 1, phase_per_tick_rad.size - 1)],
        )
        phase_per_tick_rad = np.linspace(lower_frequency, upper_frequency, 21)
        curve_gain = gain_curve(phase_per_tick_rad)
    return _smallest_with_frequency(phase_per_tick_rad, np.abs(1.0 + curve_gain))
