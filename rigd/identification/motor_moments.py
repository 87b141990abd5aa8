"""The motor's equation as linear rows: moments of the readings, frequency by frequency.

The motor's equation, with the torque held between commands,

    ``s u(t - D) = J θ'' + B θ' + C sign(θ') + z + τ_c``,

is multiplied by smooth test functions ``w(t) exp(-iωt)`` and integrated by parts, so that no
reading is differentiated. All integrals are exact for a command that changes at any moment of a
period. The measured coupling torque τ_c stands alone on its side because it carries the noise.
"""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

SCALE, INERTIA, VISCOUS, COULOMB, DELAY, ZERO = range(6)
"""Where the unknowns stand; from the last on, one zero of the torque for each session."""

_FLANK = 0.15
"""Part of a window in which the test functions rise, and fall."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Rate and delays of the readings, and where the search for the command's delay begins."""

    rate_hz: float
    angle_delay_s: float
    torque_delay_s: float
    actuation_delay_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """Repeats of one motion, each array (r, n)."""

    angle_rad: Real
    torque_command_nm: Real
    coupling_torque_nm: Real
    direction: float
    top_hz: float
    session: int


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Moments of a stack: ``y = x p``, a row a repeat and frequency."""

    y: Complex
    """(r, m), of the coupling torque."""
    x: Complex
    """(r, m, p), of what belongs to each unknown."""


def moments(stack: Stack, timing: Timing, delay_s: float, scale: float, unknowns: int) -> Rows:
    """Integrate a stack with the test functions; times count from the window's first angle."""
    period_s = 1.0 / timing.rate_hz
    repeats, n = stack.angle_rad.shape
    length_s = n * period_s
    bins = int(stack.top_hz * length_s) + 1
    omega = 2.0 * pi / length_s * np.arange(bins)
    tick_s: Real = np.arange(n, dtype=np.float64) * period_s

    def transform(weight: Real, signal: Real, shift_s: float) -> Complex:
        spectrum = np.fft.rfft(weight * signal, axis=-1)[..., :bins]
        result: Complex = period_s * np.exp(-1j * omega * shift_s) * spectrum
        return result

    angle = stack.angle_rad - stack.angle_rad.mean(axis=1, keepdims=True)
    w, w1, w2 = _test_window(tick_s, length_s)
    angle_0, angle_1, angle_2 = (transform(weight, angle, 0.0) for weight in (w, w1, w2))
    speed = -(angle_1 - 1j * omega * angle_0)
    acceleration = angle_2 - 2j * omega * angle_1 - omega**2 * angle_0
    constant = np.broadcast_to(transform(w, np.ones(n), 0.0), (repeats, bins))

    age_s = timing.angle_delay_s - timing.torque_delay_s
    y = transform(_test_window(tick_s + age_s, length_s)[0], stack.coupling_torque_nm, age_s)

    # A command stands for a period: its middle, and the integral over the period round it.
    middle_s = delay_s + 0.5 * period_s
    w, w1, _ = _test_window(tick_s + middle_s, length_s)
    held = np.sinc(omega * period_s / (2.0 * pi))
    command = held * transform(w, stack.torque_command_nm, middle_s)
    slope = held * transform(w1, stack.torque_command_nm, middle_s) - 1j * omega * command

    x = np.zeros((repeats, bins, unknowns), dtype=complex)
    x[..., SCALE] = command
    x[..., INERTIA] = -acceleration
    x[..., VISCOUS] = -speed
    x[..., COULOMB] = -stack.direction * constant
    x[..., DELAY] = scale * slope
    x[..., ZERO + stack.session] = -constant
    return Rows(y, x)


def _test_window(t: Real, length_s: float) -> tuple[Real, Real, Real]:
    """Window of a length, smooth to its third derivative, and its first two; zero outside."""
    flank_s = _FLANK * length_s
    nearest = np.minimum(t, length_s - t)
    x = np.clip(nearest / flank_s, 0.0, 1.0)
    sign = np.where(t < 0.5 * length_s, 1.0, -1.0)
    w = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
    w1 = sign * 140.0 * (x * (1.0 - x)) ** 3 / flank_s
    w2 = 420.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x) / flank_s**2
    return w, w1, w2
