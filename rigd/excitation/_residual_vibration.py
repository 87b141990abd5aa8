"""Vibration predicted after a move, and the least vibration that the sensor can show."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.excitation.moves import MAX_ROBUST_MODE_HZ

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

ARRIVAL_TOLERANCE_RAD: Final = 1e-3
"""Distance in rad from the end of a move within which the angle counts as arrived."""

_MIN_SIMULATED_S: Final = 1.0
"""Shortest time in s after the reference for which the motion is simulated."""
_MIN_RING_DOWN_S: Final = 1.0
"""Duration in s that a shorter ring-down is replaced with to compute the sensor's noise floor."""
_SQUARED_AMPLITUDE_QUANTILE_999: Final = 13.8
"""Square of the amplitude a that noise exceeds once in 1000 times, over the variance of its cosine
or sine component: exp(-a²/2) = 0.001."""


class DisturbedRig(Protocol):
    """Interface to a rig's predicted behaviour with friction, encoder steps and noise."""

    @property
    def rate_hz(self) -> float:
        """Ticks a second."""

    @property
    def respond_disturbed(self) -> Callable[[RealArray, int], tuple[RealArray, RealArray]]:
        """Function that simulates the rig, of a reference, shape (n,), and a number of modes.

        It returns the angle in rad, shape (n, draws), and the amplitude of each mode's coupling
        torque in N·m, shape (n, modes, draws), for several random draws.
        """

    @property
    def poles_rad_s(self) -> ComplexArray:
        """Poles of the modes in rad/s, shape (m,)."""

    @property
    def settling_s(self) -> float:
        """Time in s after which the angle of the closed loop has reached the reference."""

    @property
    def torque_noise_nm(self) -> float:
        """Standard deviation in N·m of the noise of one reading of the coupling torque."""


@dataclass(frozen=True, slots=True)
class MoveEnd:
    """Predicted arrival time and residual vibration of a move.

    The vibration is the root of the sum of squares of the amplitudes of the modes below
    `MAX_ROBUST_MODE_HZ`, in the coupling torque, at the end of the reference. The modes above have
    decayed when the motor has arrived.
    """

    arrival_s: float | None
    """Time in s from the start of the move after which the angle stays within
    `ARRIVAL_TOLERANCE_RAD` of its end; None: the motor arrives more than a second after the end of
    the reference."""
    residual_nm: float
    """Coupling torque in N·m of the residual vibration, with friction, encoder steps and noise."""
    noise_floor_nm: float
    """Amplitude in N·m of the coupling torque that noise of the sensor alone exceeds in one of 1000
    ring-downs. A smaller vibration cannot be detected."""


def predict_move_end(rig: DisturbedRig, reference_rad: RealArray, ring_down_s: float) -> MoveEnd:
    """Predict when the motor arrives at the end of a move, and the vibration after it.

    The reference is relative to the start angle, at the ticks after the start.
    """
    rate_hz, end_tick = rig.rate_hz, reference_rad.size
    ringing_poles = rig.poles_rad_s[np.abs(rig.poles_rad_s) < 2 * np.pi * MAX_ROBUST_MODE_HZ]
    if not ringing_poles.size:
        ringing_poles = rig.poles_rad_s[:1]
    decay_per_s = -ringing_poles.real
    # The loop has followed up and the motor is at rest; from here the amplitudes only decay.
    measurement_tick = end_tick + round(2 * rig.settling_s * rate_hz)
    held_angle_rad = np.full(
        max(measurement_tick - end_tick + 1, round(_MIN_SIMULATED_S * rate_hz)), reference_rad[-1]
    )
    angles_rad, mode_torques_nm = rig.respond_disturbed(
        np.concatenate([[0.0], reference_rad, held_angle_rad]), ringing_poles.size
    )
    ticks_outside = np.flatnonzero(
        (np.abs(angles_rad - reference_rad[-1]) > ARRIVAL_TOLERANCE_RAD).any(axis=1)
    )
    arrival_tick = int(ticks_outside[-1]) + 1 if ticks_outside.size else 0
    mode_amplitudes = (
        mode_torques_nm[measurement_tick]
        * np.exp(decay_per_s * (measurement_tick - end_tick) / rate_hz)[:, None]
    )
    # Variance of a decaying cosine's amplitude in white noise, by least squares.
    first_s, last_s = max(arrival_tick - end_tick, 0) / rate_hz, max(ring_down_s, _MIN_RING_DOWN_S)
    decay_factors = [
        np.exp(-2 * decay_per_s * time_s) for time_s in (first_s, max(last_s, 2 * first_s))
    ]
    amplitude_variances = (
        rig.torque_noise_nm**2 * 4 * decay_per_s / (decay_factors[0] - decay_factors[1]) / rate_hz
    )
    return MoveEnd(
        arrival_s=arrival_tick / rate_hz if arrival_tick < angles_rad.shape[0] - 1 else None,
        residual_nm=float(np.sqrt((mode_amplitudes**2).sum(axis=0).mean())),
        noise_floor_nm=float(np.sqrt(_SQUARED_AMPLITUDE_QUANTILE_999 * amplitude_variances.sum())),
    )
