"""Gain, phase, delay and modulus margin of the discrete closed loop at each of its cuts.

A margin states how wrong one signal may be before the loop becomes unstable. There are three such
signals, and they answer different questions:

torque command
    Motor and drive: torque constant, gear, delay of the command. It contains the whole loop, the
    angle's PID and the coupling torque's feed-forward.
angle reading
    The loop for which the controller was designed: the PID around the motor, with the beam
    cancelled by the feed-forward.
torque reading
    The feed-forward alone: calibration, lever arm and delay of the sensor.

The feed-forward is positive feedback that cancels the beam. Where the clamped beam resonates, its
loop gain is -1 by design. The curve therefore passes close to the critical point at the first and
the third signal with any controller: a command that is `k` times too strong leaves ``1 - k`` times
the beam in the loop. A gain margin of 2 is impossible there; it would mean a motor that feels the
inverted beam. There the tolerances of drive and sensor have to fit into the margin. The rules of
thumb for a feedback loop apply to the angle only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, nan, pi

import numpy as np
from numpy.typing import NDArray

from rigd.control._closed_loop import ClosedLoop, Cut

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_LOWEST = 1e-6
"""Lowest examined frequency, as a fraction of the sampling rate."""
_PER_DECADE = 60
_OFFSETS = np.geomspace(0.03, 100.0, 16)
"""Offsets of frequencies on both sides of a resonance, in its half-widths."""
_SHARPEST = 1e-6
"""Half-width assumed for a resonance without damping, as a fraction of its frequency."""
_DEAD = 1e-3
"""Magnitude of an eigenvalue below which it belongs to a delay, not to a resonance."""
_ALMOST_REAL = 1e-3
_AT_ONCE = 128
_HALVINGS = 45
_ZOOMS = 3


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins at one signal of a stable loop, each with its frequency.

    A frequency is NaN if there is no limit.
    """

    cut: str
    """The signal."""
    gain_up: float
    """Factor (above 1) on the signal at which the loop becomes unstable; infinite if none does."""
    gain_up_hz: float
    """Frequency of that limit."""
    gain_down: float
    """Factor (below 1) at which it becomes unstable; 0 if none does."""
    gain_down_hz: float
    """Frequency of that limit."""
    phase_rad: float
    """Smallest phase shift in either direction that makes it unstable, up to π."""
    phase_hz: float
    """Frequency of that limit."""
    delay_s: float
    """Smallest additional delay at which it becomes unstable; infinite if none does."""
    delay_hz: float
    """Frequency of that limit."""
    modulus: float
    """Smallest distance of the loop's gain from -1, the inverse of the largest sensitivity."""
    modulus_hz: float
    """Frequency of that distance."""


def loop_margins(loop: ClosedLoop) -> tuple[Margins, ...]:
    """Return the margins at each of the loop's cuts.

    An additional delay counts as a phase shift. That is exact for whole periods, and otherwise to
    0.1 % at the frequencies of the beam.

    Parameters
    ----------
    loop
        A stable loop: the margins of an unstable one are meaningless.

    References
    ----------
    K. J. Åström and R. M. Murray, Feedback Systems, section 9.3.

    Examples
    --------
    >>> from rigd.control import close_loop, loop_margins
    >>> from rigd.profile import load_profile
    >>> for each in loop_margins(close_loop(load_profile("sim").loop_model())):
    ...     print(f"{each.cut}: modulus margin {each.modulus:.2f}")
    torque command: modulus margin 0.23
    angle reading: modulus margin 0.47
    torque reading: modulus margin 0.25
    """
    return tuple(_margins(loop, cut) for cut in loop.cuts)


def open_loop_gain(loop: ClosedLoop, cut: Cut, phase_rad: Real) -> Complex:
    """Return the loop's gain L at a cut; the loop closes as ``1/(1 + L)``.

    Parameters
    ----------
    loop, cut
        One of the loop's cuts.
    phase_rad
        Frequency times period, shape (m,): π is half the sampling rate.

    Returns
    -------
    ndarray
        Complex, shape (m,).
    """
    n = cut.action.size
    opened = loop.a - np.outer(cut.action, cut.reading)
    gain = np.empty(phase_rad.shape, complex)
    for first in range(0, phase_rad.size, _AT_ONCE):
        z = np.exp(1j * phase_rad[first : first + _AT_ONCE])[:, np.newaxis, np.newaxis]
        action = np.broadcast_to(cut.action[:, np.newaxis], (z.size, n, 1))
        states = np.linalg.solve(z * np.eye(n) - opened, action)
        gain[first : first + _AT_ONCE] = -(states[:, :, 0] @ cut.reading)
    return gain


def _margins(loop: ClosedLoop, cut: Cut) -> Margins:
    def curve(phase_rad: Real) -> Complex:
        return open_loop_gain(loop, cut, phase_rad)

    rate_hz = loop.model.rate_hz
    frequencies = _frequencies(loop, cut)
    gain = curve(frequencies)

    real_at, real_gain = _where_real(curve, frequencies, gain)
    factor = -1.0 / real_gain
    up_at, up = _smallest(real_at, np.where(factor > 1.0, factor, inf))
    down_at, down = _smallest(real_at, np.where(factor <= 1.0, -factor, inf))

    unity_at = _zeros(lambda value: np.abs(value) - 1.0, curve, frequencies, gain)
    lag_rad = (np.angle(curve(unity_at)) + pi) % (2.0 * pi)
    phase_at, phase_rad = _smallest(unity_at, np.minimum(lag_rad, 2.0 * pi - lag_rad))
    delay_at, delay_s = _smallest(unity_at, lag_rad / unity_at / rate_hz)

    modulus_at, modulus = _smallest_distance(curve, frequencies, gain)
    to_hz = rate_hz / (2.0 * pi)
    return Margins(
        cut=cut.name,
        gain_up=up,
        gain_up_hz=up_at * to_hz,
        gain_down=0.0 if down == inf else -down,
        gain_down_hz=down_at * to_hz,
        phase_rad=min(phase_rad, pi),
        phase_hz=phase_at * to_hz,
        delay_s=delay_s,
        delay_hz=delay_at * to_hz,
        modulus=modulus,
        modulus_hz=modulus_at * to_hz,
    )


Curve = Callable[[Real], Complex]
"""The loop's gain over frequency times period."""


def _frequencies(loop: ClosedLoop, cut: Cut) -> Real:
    """Return frequencies times period, dense around the resonances of open and closed loop."""
    opened = loop.a - np.outer(cut.action, cut.reading)
    poles = np.concatenate([np.linalg.eigvals(matrix) for matrix in (opened, loop.a)])
    poles = np.log(poles[np.abs(poles) > _DEAD].astype(complex))
    poles = poles[(poles.imag > 0.0) & (poles.imag < pi)]
    half_width = np.maximum(np.abs(poles.real), _SHARPEST * poles.imag)
    offsets = half_width[:, np.newaxis] * np.concatenate([-_OFFSETS, [0.0], _OFFSETS])
    lowest = 2.0 * pi * _LOWEST
    spread = np.geomspace(lowest, pi, round(_PER_DECADE * np.log10(pi / lowest)))
    frequencies = np.concatenate([spread, (poles.imag[:, np.newaxis] + offsets).ravel()])
    return np.unique(frequencies[(frequencies >= lowest) & (frequencies <= pi)])


def _where_real(curve: Curve, frequencies: Real, gain: Complex) -> tuple[Real, Real]:
    """Return frequencies at which the gain is real and negative, and its values there."""
    inner = _zeros(np.imag, curve, frequencies, gain)
    # The curve ends at frequency 0 and half the sampling rate, where the gain is always real.
    ends = [end for end in (0, -1) if abs(gain[end].imag) < _ALMOST_REAL * abs(gain[end].real)]
    at = np.concatenate([inner, frequencies[ends]])
    real = np.concatenate([curve(inner).real, gain[ends].real])
    return at[real < 0.0], real[real < 0.0]


def _zeros(
    function: Callable[[Complex], Real], curve: Curve, frequencies: Real, gain: Complex
) -> Real:
    """Return where a real function of the gain changes its sign."""
    negative = np.signbit(function(gain))
    first = np.flatnonzero(negative[:-1] != negative[1:])
    low, high = frequencies[first], frequencies[first + 1]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        before = np.signbit(function(curve(middle))) == negative[first]
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    zeros: Real = 0.5 * (low + high)
    return zeros


def _smallest(at: Real, values: Real) -> tuple[float, float]:
    """Return position and size of the smallest value; NaN and infinity if there is none."""
    if values.size == 0 or values.min() == inf:
        return nan, inf
    index = int(values.argmin())
    return float(at[index]), float(values[index])


def _smallest_distance(curve: Curve, frequencies: Real, gain: Complex) -> tuple[float, float]:
    """Return where the gain is closest to -1, and the distance."""
    for _ in range(_ZOOMS):
        nearest = int(np.abs(1.0 + gain).argmin())
        low, high = (
            frequencies[max(nearest - 1, 0)],
            frequencies[min(nearest + 1, frequencies.size - 1)],
        )
        frequencies = np.linspace(low, high, 21)
        gain = curve(frequencies)
    return _smallest(frequencies, np.abs(1.0 + gain))
