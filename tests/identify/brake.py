"""Drag on a beam, solved independently of the package: speeds in closed form, steps in time.

The speeds that the motor makes come from the boundary value problem along the beam, frequency by
frequency; the modes' equations under the force are integrated by Runge and Kutta's method.
"""

import numpy as np

from rigd.beam import clamped_free_eigenvalues, mode_shape

HIGHEST_HZ = 200.0
HALF_AIR_DENSITY_KG_PER_M3 = 0.6


def driven_speed(angle_rad, rate_hz, beam, damping, x_m):
    """Speeds (2 n, points) without drag, at twice the rate."""
    n = angle_rad.size
    sigma = 6.0 * rate_hz / n
    t = np.arange(n) / rate_hz
    frequency_hz = np.fft.rfftfreq(2 * n, 1 / rate_hz)
    s = (sigma + 2j * np.pi * frequency_hz)[frequency_hz < HIGHEST_HZ]
    turned = np.fft.rfft(angle_rad * np.exp(-sigma * t), 2 * n)[: s.size]
    shapes = boundary_values(s, beam, damping, x_m)
    grown = np.exp(sigma * np.arange(2 * n) / (2 * rate_hz))
    speed = np.empty((2 * n, x_m.size))
    for column, shape in zip(speed.T, shapes, strict=True):
        column[:] = np.fft.irfft(2 * shape * s * turned, 4 * n)[: 2 * n] * grown
    return speed


def boundary_values(s, beam, damping, x_m):
    """Displacement over angle, (points, s): clamped on the shaft that turns, free at the tip."""
    inertia = beam.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    wave = (-inertia / (1 + damping.zeta * s**damping.alpha)) ** 0.25
    roots = np.array([1j, -1j, -1, 1])[:, None]
    exponent = roots * wave
    origin = np.where(exponent.real > 0, beam.length_m, 0.0)
    rows = np.empty((s.size, 4, 4), dtype=complex)
    for row, (at, order) in enumerate(((0.0, 0), (0.0, 1), (beam.length_m, 2), (beam.length_m, 3))):
        rows[:, row] = (roots**order * np.exp(exponent * (at - origin))).T
    right = np.zeros((s.size, 4, 1), dtype=complex)
    right[:, 1, 0] = 1 / wave
    factors = np.linalg.solve(rows, right)[:, :, 0].T
    return np.array([np.sum(factors * np.exp(exponent * (x - origin)), axis=0) for x in x_m])


def drag_torque(angle_rad, rate_hz, beam, damping, constant_m, slowing=0.0, modes=5, points=24):
    """Torque (n,) that drag adds, for damping of first order."""
    assert damping.lambda_ == damping.alpha == 1
    node, weight = np.polynomial.legendre.leggauss(points)
    x, dx = 0.5 * (node + 1) * beam.length_m, 0.5 * weight * beam.length_m
    driven = driven_speed(angle_rad, rate_hz, beam, damping, x)
    z = clamped_free_eigenvalues(modes)
    shapes = np.array([mode_shape(i + 1, x / beam.length_m) for i in range(modes)])
    mode_weights = (shapes * dx / beam.length_m).T
    leverage = mode_weights.T @ x
    elastic = beam.bending_stiffness_n_m2 * (z / beam.length_m) ** 4
    density = beam.density_kg_per_m
    external = damping.gamma * beam.bending_stiffness_n_m2
    viscous = external + elastic * damping.zeta
    step = 1 / rate_hz
    q, v = np.zeros((2, modes))
    torque = np.zeros(angle_rad.size)

    def slope(q, v, air):
        speed = air + v @ shapes
        size = np.abs(speed)
        drag = constant_m * size + slowing * np.cbrt(size) if slowing else constant_m * size
        force = -HALF_AIR_DENSITY_KG_PER_M3 * drag * speed
        modal = force @ mode_weights
        return (modal - viscous * v - elastic * q) / density, force, modal

    for i in range(angle_rad.size - 1):
        a1, force, modal = slope(q, v, driven[2 * i])
        inertial = modal - elastic * (q + damping.zeta * v)
        torque[i] = beam.length_m * (leverage @ inertial) - (x * dx) @ force
        v2 = v + step / 2 * a1
        a2, *_ = slope(q + step / 2 * v, v2, driven[2 * i + 1])
        v3 = v + step / 2 * a2
        a3, *_ = slope(q + step / 2 * v2, v3, driven[2 * i + 1])
        v4 = v + step * a3
        a4, *_ = slope(q + step * v3, v4, driven[2 * i + 2])
        q = q + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return torque
