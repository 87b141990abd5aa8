"""Motor and realised beam as one linear model, and its exact step under a held torque."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rigd.beam.state_space import Realisation

    Real = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CoupledModel:
    """``x' = a x + b τ`` of a motor that rigidly turns a beam; τ is the torque on the shaft in N·m.

    The state is angle (rad), angular velocity (rad/s), then the states of the beam. τ is the
    motor's torque less whatever friction is not in the model.
    """

    a: Real
    """(n, n)."""
    b: Real
    """(n,)."""
    angle: Real
    """(n,) row: angle in rad."""
    velocity: Real
    """(n,) row: angular velocity in rad/s."""
    acceleration: Real
    """(n,) row: angular acceleration in rad/s², to which τ adds `acceleration_per_torque`."""
    acceleration_per_torque: float
    beam_torque: Real
    """(n,) row: Γ, what the beam takes, in N·m; τ adds `beam_torque_per_torque`."""
    beam_torque_per_torque: float
    sensor_torque: Real
    """(n,) row: what a sensor between motor and clamp measures, ``Γ + J_tool θ''``, in N·m."""
    sensor_torque_per_torque: float
    sensed_torque: Real | None = None
    """(n,) row: what the sensor's filter lets through, in N·m; None: it has none."""


def with_filter(model: CoupledModel, corner_hz: float, order: int) -> CoupledModel:
    """Let the sensor's torque through a low-pass filter, of order 1 or 2 (Butterworth).

    The filter's states come last.
    """
    n, omega = model.b.size, 2 * math.pi * corner_hz
    a = np.zeros((n + order, n + order))
    b = np.zeros(n + order)
    a[:n, :n], b[:n] = model.a, model.b
    # x' = omega (u - x), or x' = omega y, y' = omega (u - x - sqrt(2) y)
    a[-1, :n] = omega * model.sensor_torque
    b[-1] = omega * model.sensor_torque_per_torque
    a[-1, n] = -omega
    if order == 2:
        a[n, n + 1] = omega
        a[n + 1, n + 1] = -math.sqrt(2) * omega
    none = np.zeros(order)
    return replace(
        model,
        a=a,
        b=b,
        angle=np.append(model.angle, none),
        velocity=np.append(model.velocity, none),
        acceleration=np.append(model.acceleration, none),
        beam_torque=np.append(model.beam_torque, none),
        sensor_torque=np.append(model.sensor_torque, none),
        sensed_torque=np.eye(1, n + order, n)[0],
    )


def couple(
    realisation: Realisation | None,
    *,
    motor_inertia_kg_m2: float,
    viscous_nm_s_per_rad: float = 0.0,
    tool_inertia_kg_m2: float = 0.0,
) -> CoupledModel:
    """Attach the beam, with the clamp's inertia in front of it, to a motor.

    Parameters
    ----------
    realisation
        The beam; None for the motor (and the clamp) alone.
    motor_inertia_kg_m2
        Of motor and gear, seen from the output shaft.
    viscous_nm_s_per_rad
        Viscous friction at the output shaft.
    tool_inertia_kg_m2
        Between sensor and beam.
    """
    beam_states = 0 if realisation is None else realisation.b.size
    n = 2 + beam_states
    rigid_torque = np.zeros(n)  # Γ but for its part that is proportional to θ''
    direct_inertia = 0.0
    a = np.zeros((n, n))
    angle, velocity = np.eye(2, n)
    if realisation is not None:
        rigid_torque[0] = realisation.direct_stiffness_nm_per_rad
        rigid_torque[1] = realisation.direct_viscosity_nm_s_per_rad
        rigid_torque[2:] = realisation.c
        direct_inertia = realisation.direct_inertia_kg_m2
        a[2:, 2:] = realisation.a

    total_inertia = motor_inertia_kg_m2 + tool_inertia_kg_m2 + direct_inertia
    acceleration = -(rigid_torque + viscous_nm_s_per_rad * velocity) / total_inertia
    a[0] = velocity
    a[1] = acceleration
    b = velocity / total_inertia
    if realisation is not None:
        a[2:] += np.outer(realisation.b, acceleration)
        b[2:] = realisation.b / total_inertia
    sensed_inertia = direct_inertia + tool_inertia_kg_m2
    return CoupledModel(
        a=a,
        b=b,
        angle=angle,
        velocity=velocity,
        acceleration=acceleration,
        acceleration_per_torque=1 / total_inertia,
        beam_torque=rigid_torque + direct_inertia * acceleration,
        beam_torque_per_torque=direct_inertia / total_inertia,
        sensor_torque=rigid_torque + sensed_inertia * acceleration,
        sensor_torque_per_torque=sensed_inertia / total_inertia,
    )


def propagator(model: CoupledModel, duration_s: float) -> tuple[Real, Real]:
    """``x(t + duration) = phi x(t) + gamma τ``, exact for a τ held over the duration.

    Returns
    -------
    phi : (n, n)
    gamma : (n,)
    """
    n = model.b.size
    extended = np.zeros((n + 1, n + 1))
    extended[:n, :n] = model.a * duration_s
    extended[:n, n] = model.b * duration_s
    exponential = expm(extended)
    return exponential[:n, :n], exponential[:n, n]


def held_inputs(model: CoupledModel, inputs: Real, duration_s: float) -> Real:
    """State that inputs of 1, held over a duration, leave behind, shape (n, inputs).

    Parameters
    ----------
    model
    inputs
        What each adds to the state's derivative, shape (n, inputs).
    duration_s
    """
    n, m = inputs.shape
    extended = np.zeros((n + m, n + m))
    extended[:n, :n] = model.a * duration_s
    extended[:n, n:] = inputs * duration_s
    return expm(extended)[:n, n:]


def expm(matrix: Real) -> Real:
    """Matrix exponential by scaling and squaring with the [13/13] Padé approximant.

    Algorithm 2.3 of N. J. Higham, SIAM J. Matrix Anal. Appl. 26 (2005) 1179, without its low-order
    cases. scipy has the same, but importing it takes longer than all else a fast session starts.
    """
    norm = float(np.linalg.norm(matrix, 1))
    squarings = max(0, math.ceil(math.log2(norm / 5.37))) if norm > 0 else 0
    x = matrix / 2.0**squarings
    x2 = x @ x
    x4 = x2 @ x2
    powers = np.stack([np.eye(len(x)), x2, x4, x2 @ x4])  # of x²: 0, 1, 2, 3
    coefficient = np.cumprod([1.0] + [(13 - k) / ((26 - k) * (k + 1)) for k in range(13)])
    even, odd = (
        np.tensordot(coefficient[parity:8:2], powers, 1)
        + powers[3] @ np.tensordot(coefficient[8 + parity :: 2], powers[1:], 1)
        for parity in (0, 1)
    )
    odd = x @ odd
    result: Real = np.linalg.solve(even - odd, even + odd)
    for _ in range(squarings):
        result = result @ result
    return result
