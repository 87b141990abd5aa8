"""Motion of the closed loop with its nonlinear effects: friction, encoder steps, sensor noise.

The Coulomb friction is constant over a period and implicit: of all torques up to the Coulomb limit,
it is the one that brings the shaft's speed at the end of the period closest to zero. It therefore
holds a shaft at rest. The motor's torque is not limited.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop

Real = NDArray[np.float64]


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
    """Response of the closed loop with friction and noise, at each tick in several random draws."""

    angle_rad: Real
    """Angle of the output shaft in rad, shape (n, draws)."""
    mode_torque_nm: Real
    """Amplitude of the coupling torque in N·m of each of the lowest m modes, shape
    (n, m, draws)."""


def simulate_disturbed(
    loop: ClosedLoop,
    reference_rad: Real,
    disturbances: Disturbances,
    *,
    modes: int,
    draws: int,
    seed: int = 0,
) -> DisturbedResponse:
    """Simulate the response to a reference from rest, with friction, encoder steps and noise.

    Parameters
    ----------
    loop
        Closed loop with a beam.
    reference_rad
        Reference angle at each tick relative to the angle at rest, shape (n,).
    disturbances
        Friction, step of the encoder and noise of the sensor.
    modes
        Number of modes, from the first on, whose amplitudes are computed.
    draws
        Number of random realisations of the noise, and of the angle within an encoder step.
    seed
        Seed of the random numbers.
    """
    realisation, settings = loop.realisation, loop.model.settings
    assert realisation is not None
    command, angle_cut, torque_cut = loop.cuts
    n, step_rad = reference_rad.size, disturbances.encoder_step_rad
    random = np.random.default_rng(seed)
    offset_rad = step_rad * random.uniform(-0.5, 0.5, draws)
    noise = random.normal(0.0, disturbances.torque_noise_nm, (n, draws))
    actions = np.stack([loop.b, command.action, torque_cut.action, angle_cut.action], axis=1)
    rows = np.stack([loop.c[0], angle_cut.reading, loop.c[3]])
    velocity, shaft_effect = loop.c[1], loop.shaft_torque[:, None]
    speed_per_torque = float(velocity @ loop.shaft_torque)

    angle_rad, inputs = np.empty((n, draws)), np.zeros((4, draws))
    # The pairs of states of the modes follow angle and velocity.
    pairs = slice(2, 2 + 2 * modes)
    mode_states = np.empty((n, 2 * modes, draws))
    x = np.zeros((loop.b.size, draws))
    for tick, reference in enumerate(reference_rad):
        angle_rad[tick], reading, speed = rows @ x
        mode_states[tick] = x[pairs]
        inputs[0] = reference
        speed = (speed + loop.d[3] * reference) / settings.friction_velocity_rad_s
        inputs[1] = settings.friction_compensation_nm * np.tanh(speed)
        inputs[2] = noise[tick]
        if step_rad:
            inputs[3] = step_rad * np.rint((reading + offset_rad) / step_rad) - offset_rad - reading
        x = loop.a @ x + actions @ inputs
        friction = (velocity @ x) / speed_per_torque
        x -= shaft_effect * friction.clip(-disturbances.coulomb_nm, disturbances.coulomb_nm)
    weight = np.hypot(*realisation.c[: 2 * modes].reshape(-1, 2).T)[:, None]
    return DisturbedResponse(
        angle_rad, weight * np.hypot(mode_states[:, ::2], mode_states[:, 1::2])
    )
