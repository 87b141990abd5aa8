"""Motion of the closed loop with its nonlinear effects: friction, encoder steps, sensor noise.

The Coulomb friction is constant over a period and implicit: the torque, up to its limit, that
brings the shaft's speed at the end of the period closest to zero. It therefore holds a shaft at
rest. The motor's torque is not limited.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop

Real = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Disturbances:
    """Effects that the linear closed loop does not contain."""

    coulomb_nm: float
    """Coulomb friction of the motor, at the output shaft."""
    encoder_step_rad: float
    """Step of the encoder, at the output shaft; 0: none."""
    torque_noise_nm: float
    """Standard deviation of the noise of one reading of the coupling torque."""


@dataclass(frozen=True, slots=True, eq=False)
class DisturbedResponse:
    """Response of the loop with disturbances, tick by tick, in several draws of the noise."""

    angle_rad: Real
    """Shape (n, draws)."""
    mode_torque_nm: Real
    """Shape (n, m, draws): amplitude of the coupling torque of each of the lowest m modes."""


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
        Shape (n,), relative to the angle at rest.
    disturbances
        Friction, step of the encoder and noise of the sensor.
    modes
        Number of modes, from the first on, whose amplitudes are computed.
    draws
        Number of realisations of the noise, and of the angle within an encoder step.
    seed
        Seed of the draws.
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
    velocity, pushed = loop.c[1], loop.shaft_torque[:, None]
    per_torque = float(velocity @ loop.shaft_torque)

    angle_rad, inputs = np.empty((n, draws)), np.zeros((4, draws))
    # The pairs of states of the modes follow angle and velocity.
    pairs = slice(2, 2 + 2 * modes)
    in_modes = np.empty((n, 2 * modes, draws))
    x = np.zeros((loop.b.size, draws))
    for tick, reference in enumerate(reference_rad):
        angle_rad[tick], reading, speed = rows @ x
        in_modes[tick] = x[pairs]
        inputs[0] = reference
        speed = (speed + loop.d[3] * reference) / settings.friction_velocity_rad_s
        inputs[1] = settings.friction_compensation_nm * np.tanh(speed)
        inputs[2] = noise[tick]
        if step_rad:
            inputs[3] = step_rad * np.rint((reading + offset_rad) / step_rad) - offset_rad - reading
        x = loop.a @ x + actions @ inputs
        friction = (velocity @ x) / per_torque
        x -= pushed * friction.clip(-disturbances.coulomb_nm, disturbances.coulomb_nm)
    weight = np.hypot(*realisation.c[: 2 * modes].reshape(-1, 2).T)[:, None]
    return DisturbedResponse(angle_rad, weight * np.hypot(in_modes[:, ::2], in_modes[:, 1::2]))
