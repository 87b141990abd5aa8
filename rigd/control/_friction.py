"""Motion of the closed loop with its nonlinear effects: friction, encoder steps, sensor noise.

The Coulomb friction is constant over a period and implicit: of all torques up to the Coulomb limit,
it is the one that brings the shaft's speed at the end of the period closest to zero. It therefore
holds a shaft at rest. The motor's torque is not limited.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop

RealArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Disturbances:
    """Friction, encoder step and sensor noise, which the linear closed loop does not contain."""

    coulomb_nm: float
    """Coulomb friction of the motor in N·m, at the output shaft."""
    encoder_step_rad: float
    """Step of the encoder in rad, at the output shaft; 0: an encoder without steps."""
    torque_noise_nm: float
    """Standard deviation in N·m of the noise of one reading of the coupling torque."""


@dataclass(frozen=True, slots=True, eq=False)
class DisturbedResponse:
    """Response of the closed loop with friction and noise: angle and mode torques at each tick.

    There is one response for each of several random draws of the noise.
    """

    angle_rad: RealArray
    """Angle of the output shaft in rad, shape (n, draws)."""
    mode_torque_nm: RealArray
    """Amplitude of the coupling torque in N·m of each of the lowest m modes, shape
    (n, m, draws)."""


def simulate_disturbed(
    closed_loop: ClosedLoop,
    reference_rad: RealArray,
    disturbances: Disturbances,
    *,
    mode_count: int,
    draw_count: int,
    seed: int = 0,
) -> DisturbedResponse:
    """Simulate the response to a reference from rest, with friction, encoder steps and noise.

    Parameters
    ----------
    closed_loop
        Closed loop with a beam.
    reference_rad
        Reference angle at each tick relative to the angle at rest, shape (n,).
    disturbances
        Friction, step of the encoder and noise of the sensor.
    mode_count
        Number of modes, from the first on, whose amplitudes are computed.
    draw_count
        Number of random realisations of the noise, and of the angle within an encoder step.
    seed
        Seed of the random numbers.
    """
    realisation, settings = closed_loop.realisation, closed_loop.model.settings
    assert realisation is not None
    command_opening, angle_opening, torque_opening = closed_loop.openings
    n, step_rad = reference_rad.size, disturbances.encoder_step_rad
    random_numbers = np.random.default_rng(seed)
    encoder_offset_rad = step_rad * random_numbers.uniform(-0.5, 0.5, draw_count)
    torque_noise_nm = random_numbers.normal(0.0, disturbances.torque_noise_nm, (n, draw_count))
    input_columns = np.stack(
        [
            closed_loop.b,
            command_opening.action_column,
            torque_opening.action_column,
            angle_opening.action_column,
        ],
        axis=1,
    )
    output_rows = np.stack([closed_loop.c[0], angle_opening.reading_row, closed_loop.c[3]])
    velocity_row, shaft_effect = closed_loop.c[1], closed_loop.shaft_torque_column[:, None]
    speed_per_torque = float(velocity_row @ closed_loop.shaft_torque_column)

    angle_rad, loop_inputs = np.empty((n, draw_count)), np.zeros((4, draw_count))
    # The pairs of states of the modes follow angle and velocity.
    mode_state_slice = slice(2, 2 + 2 * mode_count)
    mode_states = np.empty((n, 2 * mode_count, draw_count))
    loop_state = np.zeros((closed_loop.b.size, draw_count))
    for tick_number, tick_reference_rad in enumerate(reference_rad):
        angle_rad[tick_number], angle_reading_rad, friction_speed_rad_s = output_rows @ loop_state
        mode_states[tick_number] = loop_state[mode_state_slice]
        loop_inputs[0] = tick_reference_rad
        friction_speed_rad_s = (
            friction_speed_rad_s + closed_loop.d[3] * tick_reference_rad
        ) / settings.friction_velocity_rad_s
        loop_inputs[1] = settings.friction_compensation_nm * np.tanh(friction_speed_rad_s)
        loop_inputs[2] = torque_noise_nm[tick_number]
        if step_rad:
            loop_inputs[3] = (
                step_rad * np.rint((angle_reading_rad + encoder_offset_rad) / step_rad)
                - encoder_offset_rad
                - angle_reading_rad
            )
        loop_state = closed_loop.a @ loop_state + input_columns @ loop_inputs
        stopping_torque_nm = (velocity_row @ loop_state) / speed_per_torque
        loop_state -= shaft_effect * stopping_torque_nm.clip(
            -disturbances.coulomb_nm, disturbances.coulomb_nm
        )
    mode_weights = np.hypot(*realisation.c[: 2 * mode_count].reshape(-1, 2).T)[:, None]
    return DisturbedResponse(
        angle_rad, mode_weights * np.hypot(mode_states[:, ::2], mode_states[:, 1::2])
    )
