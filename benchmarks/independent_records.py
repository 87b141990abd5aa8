"""Records of beams with known parameters, made by code independent of the evaluated code.

Nothing here is taken from `rigd` or `analysis`. Eq. 25 of the paper is written with hyperbolic
functions, and its poles are the zeros of the denominator. The torque is the Laplace transform of
the angle times Eq. 25, on a grid four times as fine as the record's, with separate decay and
padding; the noise has its own generator.

A record is 136 s at 1 kHz: 1 s of rest, a chirp of 0.025 rad from 0.05 to 50 Hz in 120 s behind a
motor loop of 20 Hz, 15 s of ring-down. The encoder has steps of 7e-5 rad, the sensor steps of
1.25e-4 N·m and white noise.
"""

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

RATE_HZ = 1000.0
REST_S, SWEEP_S, RECORD_S = 1.0, 120.0, 136.0
FIRST_HZ, LAST_HZ, AMPLITUDE_RAD = 0.05, 50.0, 0.025
LENGTH_M, DENSITY_KG_PER_M, STIFFNESS_N_M2 = 0.98, 4.7e-3, 0.090275
"""Link of the paper, as the file states it."""

_FINER = 4
_DECAY = 14.0
_PADDED = 2.0
"""Aliases on the padded grid have decayed by exp(-14) = 1e-6; rounding has grown by 1e3."""

_LOOP_RAD_S = 2 * math.pi * 20.0
_SHAKEN_S = 8.0
_SHAKEN_RAD = 4e-3
_ENCODER_RAD, _SENSOR_NM = 7e-5, 1.25e-4


@dataclass(frozen=True, slots=True)
class Truth:
    """A beam, its damping and its instruments.

    Attributes
    ----------
    zeta, alpha : float
        Internal damping: the stiffness is multiplied by ``1 + zeta s^alpha``.
    gamma, lambda_ : float
        External damping: ``gamma s^lambda`` is added to ``rho/EI s²``.
    density_over_stiffness : float
        rho/EI in s²/m⁴.
    bending_stiffness_n_m2 : float
    delay_s : float
        Delay of the torque with respect to the angle.
    tool_inertia_kg_m2 : float
    offsets : tuple of float
        Relative rise of the stiffness of modes 2, 3, … over the uniform beam.
    """

    zeta: float
    alpha: float
    gamma: float
    lambda_: float
    density_over_stiffness: float = DENSITY_KG_PER_M / STIFFNESS_N_M2
    bending_stiffness_n_m2: float = STIFFNESS_N_M2
    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    offsets: tuple[float, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """True values by the names of the analyzer."""
        return {
            "zeta": self.zeta,
            "alpha": self.alpha,
            "gamma": self.gamma,
            "lambda": self.lambda_,
            "density_over_stiffness": self.density_over_stiffness,
            "bending_stiffness_n_m2": self.bending_stiffness_n_m2,
            "delay_s": self.delay_s,
            "tool_inertia_kg_m2": self.tool_inertia_kg_m2,
        }

    def internal_loss(self, omega_rad_s: float) -> float:
        """Return the loss factor by internal damping, without its square."""
        return float((self.zeta * (1j * omega_rad_s) ** self.alpha).imag)

    def external_loss(self, omega_rad_s: float) -> float:
        """Return the loss factor by external damping, relative to the undamped inertia."""
        lost = (self.gamma * (1j * omega_rad_s) ** self.lambda_).imag
        return float(lost / (self.density_over_stiffness * omega_rad_s**2))

    def inertial(self, s: Complex) -> Complex:
        """Return ``rho/EI s² + gamma s^lambda``."""
        return self.density_over_stiffness * s**2 + self.gamma * s**self.lambda_

    def elastic(self, s: Complex) -> Complex:
        """Return ``1 + zeta s^alpha``."""
        return 1 + self.zeta * s**self.alpha

    def torque_per_angle(self, s: Complex) -> Complex:
        """Return the torque on beam and tool over the angle, in N·m/rad, without delay.

        This is Eq. 25 of the paper, with ``z = beta L``; its terms of modes 2, 3, … are replaced by
        those of modes with another stiffness.
        """
        inertial, elastic = self.inertial(s), self.elastic(s)
        z = (-inertial / elastic) ** 0.25 * LENGTH_M
        numerator = np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z)
        response = -elastic * z * numerator / (1 + np.cos(z) * np.cosh(z)) / LENGTH_M
        for number, offset in enumerate(self.offsets, start=2):
            nominal = (characteristic(number) / LENGTH_M) ** 4
            weight = 4 / (LENGTH_M * nominal)
            for stiffness, sign in ((nominal, -1.0), (nominal * (1 + offset), 1.0)):
                held = elastic * stiffness
                response = response + sign * weight * inertial * held / (held + inertial)
        return self.bending_stiffness_n_m2 * response + self.tool_inertia_kg_m2 * s**2

    def pole(self, number: int) -> complex:
        """Return the pole of a mode with locked hub, upper half plane, in rad/s.

        It is a zero of the denominator of Eq. 25, found by the secant method.
        """
        offset = self.offsets[number - 2] if 2 <= number < 2 + len(self.offsets) else 0.0
        shift = (1 + offset) ** 0.25
        undamped = (characteristic(number) * shift / LENGTH_M) ** 2
        undamped /= math.sqrt(self.density_over_stiffness)

        def denominator(s: complex) -> complex:
            at = np.array(s)
            z = complex((-self.inertial(at) / self.elastic(at)) ** 0.25) * LENGTH_M / shift
            return 1 + cmath.cos(z) * cmath.cosh(z)

        before, here = complex(-1e-3 * undamped, 0.999 * undamped), complex(0.0, undamped)
        at_before = denominator(before)
        for _ in range(50):
            at_here = denominator(here)
            step = at_here * (here - before) / (at_here - at_before) if at_here else 0.0
            before, at_before, here = here, at_here, here - step
            if abs(step) < 1e-13 * undamped:
                return here
        raise ArithmeticError(f"no pole of mode {number} near {undamped} rad/s")

    def frequency_hz(self, number: int) -> float:
        """Return the frequency of a mode's free decay."""
        return self.pole(number).imag / (2 * math.pi)

    def damping_ratio(self, number: int) -> float:
        """Return the damping ratio of a mode."""
        pole = self.pole(number)
        return -pole.real / abs(pole)

    def loss_factor(self, frequency_hz: Real) -> Real:
        """Return the energy lost per radian over the stored energy, by material and medium."""
        s = 2j * np.pi * np.asarray(frequency_hz)
        inertial, elastic = self.inertial(s), self.elastic(s)
        total: Real = elastic.imag / elastic.real - inertial.imag / inertial.real
        return total


@dataclass(frozen=True, slots=True)
class Exact:
    """Record of ideal instruments, at `RATE_HZ`.

    Attributes
    ----------
    truth : Truth
    reference_rad, angle_rad, torque_nm : ndarray, shape (n,)
    """

    truth: Truth
    reference_rad: Real
    angle_rad: Real
    torque_nm: Real

    def noisy(self, noise_nm: float, seed: int) -> tuple[Real, Real]:
        """Return angle and torque with noise and quantisation.

        Parameters
        ----------
        noise_nm : float
            Standard deviation of the torque's white noise.
        seed : int
        """
        generator = np.random.Generator(np.random.SFC64(seed))
        noise = noise_nm * generator.standard_normal(self.torque_nm.size)
        return (
            np.round(self.angle_rad / _ENCODER_RAD) * _ENCODER_RAD,
            np.round((self.torque_nm + noise) / _SENSOR_NM) * _SENSOR_NM,
        )


def characteristic(number: int) -> float:
    """Return the root of ``1 + cos z cosh z`` of a mode, counted from 1, by bisection."""
    low, high = (number - 1) * math.pi, number * math.pi
    rising = 1 + math.cos(high) * math.cosh(high) > 0
    for _ in range(200):
        middle = (low + high) / 2
        if (1 + math.cos(middle) * math.cosh(middle) > 0) == rising:
            high = middle
        else:
            low = middle
    return (low + high) / 2


def exact(truth: Truth, *, last_hz: float = LAST_HZ, ringing: bool = False) -> Exact:
    """Return a record without noise.

    Parameters
    ----------
    truth : Truth
    last_hz : float
        Last frequency of the sweep.
    ringing : bool
        Whether mode 1 rings, because the motor shook it until 1 s before the record.
    """
    before_s = _SHAKEN_S if ringing else 0.0
    rate_hz = _FINER * RATE_HZ
    count = round((before_s + RECORD_S) * rate_hz)
    t = np.arange(count) / rate_hz - before_s - REST_S
    slope = (last_hz - FIRST_HZ) / (2 * SWEEP_S)
    chirp = AMPLITUDE_RAD * np.sin(2 * np.pi * (FIRST_HZ + slope * t) * t)
    reference = np.where((t >= 0) & (t < SWEEP_S), chirp, 0.0)
    shaken = t < -REST_S - 1.0
    since_s = t[shaken] + before_s + REST_S
    reference[shaken] = _SHAKEN_RAD * np.sin(2 * np.pi * truth.frequency_hz(1) * since_s)
    return driven(truth, reference, first=round(before_s * rate_hz))


def driven(truth: Truth, reference_rad: Real, first: int = 0) -> Exact:
    """Return a record without noise of a motor that follows any reference, from rest.

    Parameters
    ----------
    truth : Truth
    reference_rad : ndarray, shape (n,)
        At four times `RATE_HZ`.
    first : int
        Sample of the reference at which the record begins.
    """
    rate_hz, count = _FINER * RATE_HZ, reference_rad.size
    points = round(_PADDED * count)
    sigma = _DECAY * rate_hz / points
    decay = np.exp(-sigma * np.arange(count) / rate_hz)
    s = sigma + 2j * np.pi * np.fft.rfftfreq(points, 1 / rate_hz)
    angle = np.fft.rfft(reference_rad * decay, points)
    angle /= 1 + 1.4 * s / _LOOP_RAD_S + (s / _LOOP_RAD_S) ** 2
    torque = angle * truth.torque_per_angle(s) * np.exp(-s * truth.delay_s)
    record = slice(first, count, _FINER)
    return Exact(
        truth,
        reference_rad[record],
        np.fft.irfft(angle, points)[record] / decay[record],
        np.fft.irfft(torque, points)[record] / decay[record],
    )
