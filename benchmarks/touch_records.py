"""Records of an antenna that strikes an obstacle, by an independent simulation.

Neither the simulated rig nor the kernels of `rigd.touch` are used. The beam is a sum of clamped-
free modes on a motor, with damping of integer order (internal and external), integrated in steps of
some microseconds by the matrix exponential; the contact force is constant over a step and implicit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from rigd.beam import Beam, Damping, clamped_free_eigenvalues, mode_shape

Real = NDArray[np.float64]

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
DAMPED = Damping(zeta=7.1e-5, alpha=1.0, gamma=3.0e-2, lambda_=1.0)
MOTOR_INERTIA_KG_M2 = 2.0e-3
MOTOR_VISCOUS = 0.02
TORQUE_NOISE_NM = 5.0e-3
SHEAR_NOISE_N = 2.0e-2
ENCODER_STEP_RAD = 7.0e-5
RATE_HZ = 1000.0
POLE_RAD_S = 80.0
_CONVERGED_N = 1e-10
"""Forces of several obstacles are iterated until none changes by more."""


@dataclass(frozen=True)
class Obstacle:
    """An obstacle."""

    x_m: float
    angle_rad: float = 0.6
    stiffness_n_per_m: float = 3000.0
    damping_n_s_per_m: float = 0.0
    rate_rad_s: float = 0.0
    """Speed at which it moves with the antenna (positive) or towards it (negative)."""
    mobility_m_per_n_s: float = 0.0
    """Speed at which it yields, per force."""
    knock_n: float = 0.0
    """Peak of a half-sine pulse at the position of the obstacle, instead of a contact."""
    knock_s: float = 0.005


@dataclass(frozen=True)
class Slew:
    """Motion of the motor."""

    speed_rad_s: float = 1.0
    acceleration_rad_s2: float = 20.0


@dataclass(frozen=True)
class Struck:
    """One record at 1 kHz with noise and quantisation, and the truth."""

    angle_rad: Real
    torque_nm: Real
    shear_n: Real
    touch_s: float
    peak_n: float
    force_n: Real
    """Force of the obstacle on the antenna at the ticks; negative."""
    met_s: tuple[float, ...]
    """First contact with each obstacle; infinite without one."""


def simulate(
    obstacles: Sequence[Obstacle | tuple[Obstacle, ...]],
    slews: Sequence[Slew],
    *,
    duration_s: float = 1.2,
    beam: Beam = LINK,
    damping: Damping = DAMPED,
    seed: int = 1,
    noise: float = 1.0,
    steps: int = 64,
    modes: int = 28,
) -> list[Struck]:
    """Return one record per obstacle (or group of obstacles), integrated with `steps` a period.

    The slew begins after 50 ms at rest.
    """
    cases = [each if isinstance(each, tuple) else (each,) for each in obstacles]
    most = max(map(len, cases))
    nobody = Obstacle(x_m=beam.length_m / 2, angle_rad=np.inf)
    table = [case + (nobody,) * (most - len(case)) for case in cases]

    def of(name: str) -> Real:
        return np.array([[getattr(each, name) for each in row] for row in table])  # (m, o)

    m = len(cases)
    dt = 1 / RATE_HZ / steps
    step = _Step(beam, damping, modes, dt)
    x_c = of("x_m")
    push = np.stack(
        [
            np.concatenate([[x], [mode_shape(i + 1, x / beam.length_m) for i in range(modes)]])
            for x in x_c.ravel()
        ]
    ).reshape(m, most, modes + 1)  # generalised force of a unit force, and the displacement's row
    into = push @ step.by_force.T  # (m, o, states)
    own = np.einsum("moi,moi->mo", into[..., : modes + 1], push)  # y at x_c per held force
    cross = np.einsum("moi,mpi->mop", into[..., : modes + 1], push)
    k, c = of("stiffness_n_per_m"), of("damping_n_s_per_m")
    mobility, rate = of("mobility_m_per_n_s"), of("rate_rad_s") * x_c
    position = np.where(np.isfinite(of("angle_rad")), of("angle_rad"), 1e9) * x_c
    knock, knock_s = of("knock_n"), of("knock_s")
    law = k + c / dt
    state = np.zeros((m, 2 * (modes + 1)))
    before = np.full((m, most), -1.0)
    begun = np.full((m, most), np.inf)
    command = np.zeros(m)
    ticks = round(duration_s * RATE_HZ)
    out = np.zeros((4, ticks, m))
    touch = np.full(m, np.inf)
    peak = np.zeros(m)
    force = np.zeros((m, most))
    integral = np.zeros(m)
    speed = np.array([s.speed_rad_s for s in slews])
    acceleration = np.array([s.acceleration_rad_s2 for s in slews])
    rng = np.random.default_rng(seed)
    for tick in range(ticks):
        t = tick / RATE_HZ
        angle, velocity = state[:, 0], state[:, modes + 1]
        loads = np.einsum("mo,moi->mi", force, push)
        rates = state @ step.a[modes + 1 :].T + loads @ step.inverse_mass.T
        rates[:, :] += command[:, None] * step.inverse_mass[:, 0]
        carried = rates @ step.inertia.T + state[:, modes + 1 :] @ step.drag.T  # torque and shear
        torque = carried[:, 0] - (force * x_c).sum(1)
        shear = carried[:, 1] - force.sum(1)
        out[0, tick], out[1, tick], out[2, tick] = angle, torque, shear
        out[3, tick] = force.sum(1)
        measured = torque + rng.normal(0, noise * TORQUE_NOISE_NM, m)
        out[1, tick] = measured
        ref, ref_speed, ref_acc = _slewed(t - 0.05, speed, acceleration)
        error = ref - angle
        integral += error / RATE_HZ
        j, p = MOTOR_INERTIA_KG_M2, POLE_RAD_S
        command = (
            j * (ref_acc + 3 * p * (ref_speed - velocity) + 3 * p**2 * error + p**3 * integral)
            + MOTOR_VISCOUS * ref_speed
            + measured
        ).clip(-0.9, 0.9)
        for sub in range(steps):
            now = t + (sub + 1) * dt
            coming = state @ step.whole.T + command[:, None] * step.by_command
            y = np.einsum("mi,moi->mo", coming[:, : modes + 1], push)
            position = position + rate * dt
            gap = y - position  # penetration without the new force, positive inside
            if not (gap > 0).any() and not force.any() and not np.isfinite(begun[knock != 0]).any():
                state, before = coming, gap  # no contact
                continue
            begun = np.minimum(begun, np.where(gap > 0, now, np.inf))
            force = np.zeros((m, most))
            for _ in range(1 if most == 1 else 30):
                last = force
                others = (
                    np.einsum("op,...->...", np.ones((1, 1)), gap)
                    if most == 1
                    else (gap + np.einsum("mop,mp->mo", cross, force) - own * force)
                )
                giving = own + mobility * dt
                pressed = (law * others - c / dt * np.maximum(before, 0)) / (1 + law * giving)
                force = -np.where(others > 0, np.maximum(pressed, 0.0), 0.0)
                if np.abs(force - last).max() < _CONVERGED_N:
                    break
            pulse = knock * np.sin(np.pi * np.clip((now - begun) / knock_s, 0, 1))
            force = np.where(knock != 0, -np.where(np.isfinite(begun), pulse, 0.0), force)
            position = position - mobility * dt * force * (knock == 0)
            state = coming + np.einsum("mo,moi->mi", force, into)
            before = np.einsum("mi,moi->mo", state[:, : modes + 1], push) - position
            total = np.abs(force).sum(1)
            touch = np.where((total > 0) & ~np.isfinite(touch), now - dt, touch)
            peak = np.maximum(peak, total)
    out[2] += rng.normal(0, noise * SHEAR_NOISE_N, out[2].shape)
    out[0] = ENCODER_STEP_RAD * np.round(out[0] / ENCODER_STEP_RAD)
    return [
        Struck(
            out[0, :, i],
            out[1, :, i],
            out[2, :, i],
            float(touch[i]),
            float(peak[i]),
            out[3, :, i],
            tuple(begun[i, : len(cases[i])].tolist()),
        )
        for i in range(m)
    ]


def _slewed(t: float, speed: Real, acceleration: Real) -> tuple[Real, Real, Real]:
    """Return angle, speed and acceleration of a ramp after a constant acceleration."""
    t = max(t, 0.0)
    rise = speed / acceleration
    up = t < rise
    angle = np.where(up, acceleration * t * t / 2, speed * (t - rise / 2))
    return angle, np.where(up, acceleration * t, speed), np.where(up & (t > 0), acceleration, 0.0)


class _Step:
    """Motor and beam over one step; the state is angle and modes, then their rates."""

    def __init__(self, beam: Beam, damping: Damping, modes: int, dt: float) -> None:
        length, rho = beam.length_m, beam.density_kg_per_m
        z = clamped_free_eigenvalues(modes)
        c_v = damping.gamma * beam.bending_stiffness_n_m2
        # Integrals of x times a shape and of a shape, whose fourth derivative is (z/L)^4 times it.
        sign = np.where(np.arange(modes) % 2 == 0, 1.0, -1.0)
        ratio = (np.sinh(z) - np.sin(z)) / (np.cosh(z) + np.cos(z))
        first = 2 * sign * (length / z) ** 2
        mean = 2 * sign * ratio * length / z
        omega2 = (z / length) ** 4 / beam.density_over_stiffness
        n = modes + 1
        mass = np.zeros((n, n))
        mass[0, 0] = beam.inertia_kg_m2
        mass[0, 1:] = mass[1:, 0] = rho * first
        mass[1:, 1:] = rho * length * np.eye(modes)
        drag = mass * (c_v / rho)
        self.inertia = np.vstack([mass[0], np.concatenate([[rho * length**2 / 2], rho * mean])])
        self.drag = self.inertia * (c_v / rho)
        mass[0, 0] += MOTOR_INERTIA_KG_M2
        drag[0, 0] += MOTOR_VISCOUS
        stiffness = np.diag(np.concatenate([[0.0], rho * length * omega2]))
        drag = drag + damping.zeta * stiffness
        self.inverse_mass = np.linalg.inv(mass)
        a = np.zeros((2 * n, 2 * n))
        a[:n, n:] = np.eye(n)
        a[n:, :n] = -self.inverse_mass @ stiffness
        a[n:, n:] = -self.inverse_mass @ drag
        self.a = a
        held = np.zeros((3 * n, 3 * n))
        held[: 2 * n, : 2 * n] = a
        held[n : 2 * n, 2 * n :] = self.inverse_mass
        whole = expm(held * dt)
        self.whole = whole[: 2 * n, : 2 * n]
        self.by_force = whole[: 2 * n, 2 * n :]
        self.by_command = self.by_force[:, 0]
