"""Motion of the closed loop with what is not linear: Coulomb friction, encoder steps, sensor noise.

The friction is constant over a period and implicit: the torque, of at most the Coulomb friction,
that takes the shaft's speed at the end of the period nearest to zero. A shaft at rest is so held at
rest. The motor's torque is not limited.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop

Real = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Disturbances:
    """What the linear closed loop leaves out."""

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
        Number of realisations of the noise, and of where in a step of the encoder the motor stands.
    seed
        Of these draws.
    """
    realisation, settings = loop.realisation, loop.model.settings
    assert realisation is not None
    noise = np.random.default_rng(seed)
    command, angle_cut, torque_cut = loop.cuts
    step_rad = disturbances.encoder_step_rad
    place_rad = step_rad * noise.uniform(-0.5, 0.5, draws)
    # By control setting, not by disturbance: the controller compensates what it was set to.
    speed = np.zeros(loop.b.size)
    n = reference_rad.size
    angle_rad = np.empty((n, draws))
    first = 2 + 2 * np.array([np.flatnonzero(realisation.modes == k)[0] for k in range(modes)])
    weight = np.hypot(realisation.c[first - 2], realisation.c[first - 1])[:, None]
    amplitude = np.empty((n, modes, draws))
    velocity, pushed = loop.c[1], loop.shaft_torque
    per_torque = velocity @ pushed
    x = np.zeros((loop.b.size, draws))
    rows = np.stack([loop.c[0], angle_cut.reading, loop.c[3]])
    for tick, reference in enumerate(reference_rad):
        angle_rad[tick], reading, speed = rows @ x
        amplitude[tick] = weight * np.hypot(x[first], x[first + 1])
        speed = (speed + loop.d[3] * reference) / settings.friction_velocity_rad_s
        compensation = settings.friction_compensation_nm * np.tanh(speed)
        x = loop.a @ x
        x += (loop.b * reference)[:, None]
        x += np.outer(command.action, compensation)
        x += np.outer(torque_cut.action, noise.normal(0.0, disturbances.torque_noise_nm, draws))
        if step_rad:
            rounded = step_rad * np.round((reading + place_rad) / step_rad) - place_rad
            x += np.outer(angle_cut.action, rounded - reading)
        friction = np.clip(
            (velocity @ x) / per_torque, -disturbances.coulomb_nm, disturbances.coulomb_nm
        )
        x -= np.outer(pushed, friction)
    return DisturbedResponse(angle_rad, amplitude)
