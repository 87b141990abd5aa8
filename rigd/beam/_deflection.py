"""Deflection of the beam from the measured motor angle, computed while it moves.

In a frame that turns with the motor the beam bends by ``w(x) = y(x) - x theta``, clamped at the
axis. The modes of the undamped clamped–free beam, which fractional damping does not couple, give::

    w(x) = -sum_i b_i phi_i(x) H_i theta,   H_i = P / (Q k_i⁴ + P),   b_i = ∫ x phi_i dx / L

with P, Q and k_i of `rigd.beam._modes`. H_i passes high frequencies and blocks a constant angle, so
samples of the angle suffice: nothing is differentiated, and the encoder's noise is not amplified,
except at the modes.

Each H_i is a sum over poles. For damping of first order it consists of the two poles of its mode,
with their exact residues; a fitted ladder of fixed real poles approximates the branch cut of
fractional orders. Every pole is discretised by impulse invariance, with a direct term that gives a
zero at standstill: for a sinusoid of frequency omega the error is ``(omega / rate)⁴ / 720``,
compared with ``(omega / rate)² / 12`` for linear interpolation between samples.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._modes import clamped_free_eigenvalues, mode_shape, poles_for_eigenvalues

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_CHUNK = 256
"""Samples processed at once: a table of this many powers of each pole is stored."""

_HIGHEST = 0.5
"""Fastest mode in use, as a fraction of the sampling rate: a faster one would be aliased to a
slower one."""

_LADDER = 10
"""Real poles for the branch cut, from `_SLOWEST_RAD_S` to the sampling rate: two a decade."""
_SLOWEST_RAD_S = 0.03
_FIT_FROM_HZ = 0.05
_FIT_TO = 0.1
"""End of the ladder's fit, as a fraction of the sampling rate."""
_SMALL = 0.01
"""Size of H below which the fit's absolute, not relative, error counts: deflections of a hundredth
of the rigid motion."""


class DeflectionFilter:
    """Deflection of the beam, relative to the tangent at its root.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    rate_hz
        Samples of the angle a second.
    modes
        Number of separate modes, without those too fast for the sampling rate. One more
        represents all others, approximated without inertia of their own.
    points
        Number of points along the beam.

    Attributes
    ----------
    x_m
        Positions of the deflection, shape (points,), in m from the motor's axis: 0 … length.

    Notes
    -----
    Compared with the boundary value problem in closed form, at 1 kHz, for the twelve dampings of
    the paper: within 0.1 % of the largest deflection along the beam from 0.2 to 50 Hz.
    """

    def __init__(
        self,
        beam: Beam,
        damping: Damping,
        rate_hz: float,
        *,
        modes: int = 4,
        points: int = 41,
    ) -> None:
        self.x_m: Real = np.linspace(0.0, beam.length_m, points)
        z = clamped_free_eigenvalues(modes + 1)
        pairs = poles_for_eigenvalues(z, beam, damping)
        followed = _followed(pairs, rate_hz)
        pairs, z = pairs[:followed], z[:followed]

        ladder = _ladder(damping, rate_hz)
        step: Complex = np.exp(np.concatenate([pairs.ravel(), ladder]) / rate_hz)
        # Row per mode, column per pole: weight of the pole in the mode.
        weights = np.zeros((z.size, step.size), dtype=np.complex128)
        for i, residues in enumerate(_residues(z, pairs, beam, damping)):
            weights[i, 2 * i : 2 * i + 2] = residues / rate_hz
        if ladder.size:
            weights[:, pairs.size :] = _cut(z, beam, damping, rate_hz, step, weights)

        # Powers of the poles, the highest first: effect of each sample of a chunk at its end.
        self._powers: Complex = step[:, None] ** np.arange(_CHUNK, -1, -1)
        self._shapes: Complex = -_shapes(beam, self.x_m / beam.length_m, z) @ weights
        self._direct: Real = -(self._shapes @ _standing(step)).real
        self._state: Complex = np.zeros(step.size, dtype=np.complex128)
        self._rest_rad: float | None = None

    def feed(self, angle_rad: Real) -> Real:
        """Process samples of the motor's angle, at the sampling rate and without gaps.

        The beam is assumed to be at rest before the first one.

        Parameters
        ----------
        angle_rad
            Shape (n,), n ≥ 1.

        Returns
        -------
        deflection_m
            At the last sample, shape (points,); positive in the direction of a positive angle.
        """
        if self._rest_rad is None:
            self._rest_rad = float(angle_rad[0])
        turned = angle_rad - self._rest_rad
        for start in range(0, turned.size, _CHUNK):
            chunk = turned[start : start + _CHUNK]
            powers = self._powers[:, _CHUNK - chunk.size :]
            self._state = powers[:, 0] * self._state + powers[:, 1:] @ chunk
        deflection: Real = (self._shapes @ self._state).real + self._direct * turned[-1]
        return deflection


def _followed(pairs: Complex, rate_hz: float) -> int:
    """Return the number of modes, from the first on, with poles slow enough for the rate."""
    slow = np.abs(pairs[:, 0].imag) < 2 * np.pi * _HIGHEST * rate_hz
    usable = slow & ~np.isnan(pairs[:, 0])
    return usable.size if usable.all() else int(np.argmin(usable))


def _ladder(damping: Damping, rate_hz: float) -> Real:
    """Return real poles in rad/s for the branch cut; none if there is no cut."""
    internal_integer = damping.zeta == 0 or damping.alpha in (0, 1)
    external_integer = damping.gamma == 0 or damping.lambda_ in (0, 1)
    if internal_integer and external_integer:
        return np.zeros(0)
    poles: Real = -np.geomspace(_SLOWEST_RAD_S, rate_hz, _LADDER)
    return poles


def _standing(step: Complex) -> Complex:
    """Return the state of the discrete poles for a constant angle of 1."""
    state: Complex = 1 / (1 - step)
    return state


def _loads(s: Complex, z: Real, beam: Beam, damping: Damping) -> tuple[Complex, Complex, Complex]:
    """Return P and ``Q k⁴`` of the modes, both over EI, and ``s d/ds`` of their sum."""
    inertial = beam.density_over_stiffness * s * s
    external = damping.gamma * s**damping.lambda_
    internal = damping.zeta * s**damping.alpha
    k_fourth = (z / beam.length_m) ** 4
    slope = 2 * inertial + damping.lambda_ * external + damping.alpha * internal * k_fourth
    return inertial + external, (1 + internal) * k_fourth, slope


def _residues(z: Real, pairs: Complex, beam: Beam, damping: Damping) -> Complex:
    """Return residues of H_i at its mode's poles, shape (modes, 2), in rad/s."""
    load, _, slope = _loads(pairs, z[:, None], beam, damping)
    residues: Complex = load * pairs / slope
    return residues


def _cut(
    z: Real, beam: Beam, damping: Damping, rate_hz: float, step: Complex, weights: Complex
) -> Real:
    """Fit the weights of the ladder (the last poles) in each mode to the residual of the pairs."""
    frequency_hz = np.geomspace(_FIT_FROM_HZ, max(_FIT_TO * rate_hz, 2 * _FIT_FROM_HZ), 200)
    s = 2j * np.pi * frequency_hz[:, None]
    load, spring, _ = _loads(s, z, beam, damping)
    exact = load / (spring + load)
    columns = 1 / (1 - step * np.exp(-s / rate_hz)) - _standing(step)
    missing = exact - columns @ weights.T
    cut = np.empty((z.size, _LADDER))
    for i in range(z.size):
        weight = 1 / (np.abs(exact[:, i, None]) + _SMALL)
        matrix, target = columns[:, -_LADDER:] * weight, missing[:, i, None] * weight
        cut[i] = np.linalg.lstsq(
            np.concatenate([matrix.real, matrix.imag]),
            np.concatenate([target.real, target.imag])[:, 0],
        )[0]
    return cut


def _shapes(beam: Beam, x: Real, z: Real) -> Real:
    """Return ``b_i phi_i`` at x = 0…1 for the used modes, shape (x.size, z.size), in m.

    The last one includes all later modes by their low-frequency sum: the ``b_i phi_i / k_i⁴`` of
    all modes add up to the bend under a load that grows like x.
    """
    numbers = np.arange(1, z.size + 1)
    factors = 2 * (-1.0) ** (numbers - 1) / z**2
    shapes = np.zeros((x.size, z.size))
    for i, factor in enumerate(factors):
        shapes[:, i] = factor * mode_shape(i + 1, x)
    if z.size:
        under_load = x**2 * (x**3 - 10 * x + 20) / 120
        shapes[:, -1] = z[-1] ** 4 * (under_load - shapes[:, :-1] @ z[:-1] ** -4.0)
    scaled: Real = beam.length_m * shapes
    return scaled
