"""Residual tests: whiteness, coherence with the input, harmonics of the sweep.

Chance is ruled out at one level throughout (`SIGNIFICANT_STD`). The cumulative periodogram of a
white residual is a straight line but for a Kolmogorov statistic (Bartlett's test). A residual that
is coherent with the angle is linear dynamics that the model lacks.

A linear beam responds at the drive frequency, and rings at frequencies that the sweep has passed. A
response at twice or three times the drive frequency is nonlinear. This test needs no model.

References
----------
M. S. Bartlett, An Introduction to Stochastic Processes (1955): the cumulative periodogram.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.statistics import KOLMOGOROV_95, chi_square_deviate, kolmogorov_p_value

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Chance

SIGNIFICANT_STD: Final = 5.0
"""Standard deviations from which chance is ruled out: 3 in 10 million for all tests together."""


def largest_of(count: int) -> float:
    """Return the limit of half the square of a deviate, for the largest of `count` values."""
    return SIGNIFICANT_STD**2 / 2 + math.log(max(count, 1))


# Whiteness, and coherence with the input

_LEVEL: Final = 1e-6
"""Probability of chance: what `SIGNIFICANT_STD` means for the other tests."""

_DOUBTFUL: Final = 0.01
"""The same where a false alarm costs only computing time."""

_WINDOWS: Final = (8, 32)
_LOUD: Final = 1.4
"""Power over that of the noise, which is itself known to 10-20 % only."""

_COHERENT_BINS: Final = 9
_DRIVEN: Final = 0.1
"""Power of the angle relative to what is usual around it, from which a bin counts as driven."""

_LOUDEST: Final = 4.0
"""Where the whitened residual is limited: chance exceeds it once in 3000 bins."""

_LONGEST_LAG_S: Final = 1.0

_NEIGHBOURS: Final = 64
"""Bins over which the angle's power is averaged: more than lie between two lines of a multisine."""


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Tests of the whitened residual's power (Bartlett's cumulative periodogram).

    Attributes
    ----------
    distance : float
        Largest distance of the cumulative periodogram from the straight line.
    band : float
        Within which it stays in 95 % of the records that hold nothing but noise.
    probability : float
        Probability of such a distance by chance.
    loudest_hz : tuple of float
        Edges of the window that is loudest for its width.
    loudest_ratio : float
        Its power over that of the noise.
    loud : bool
        Whether chance is ruled out there.
    """

    distance: float
    band: float
    probability: float
    loudest_hz: tuple[float, float]
    loudest_ratio: float
    loud: bool

    @property
    def white(self) -> bool:
        """Return whether the residual is consistent with noise alone."""
        return self.probability > _LEVEL and not self.loud

    @property
    def all_but_white(self) -> bool:
        """Return whether chance exceeds the residual in one record of 100."""
        return self.probability > _DOUBTFUL and not self.loud


@dataclass(frozen=True, slots=True)
class InputRelation:
    """Tests of whether the residual still follows the angle: linear dynamics outside the model.

    Attributes
    ----------
    coherence : float
        Squared coherence of residual and angle over nine neighbouring bins, where it is least
        likely to be chance.
    at_hz : float
        Where.
    local : bool
        Whether chance is ruled out there.
    deviate : float
        Deviate of the coherence over the whole band, in standard deviations beyond chance.
    correlation : float
        Largest correlation of residual and angle, both whitened, in standard deviations.
    lag_s : float
        Where; negative: the residual comes before the angle.
    related : bool
        Whether chance is ruled out by any of the three.
    """

    coherence: float
    at_hz: float
    local: bool
    deviate: float
    correlation: float
    lag_s: float
    related: bool


def cumulative_periodogram(residual: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the fraction of the power up to each bin, shape (K,), of a whitened residual.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.identify.residual_tests import cumulative_periodogram
    >>> print(cumulative_periodogram(np.array([1, 1j, -1, 1])))
    [0.25 0.5  0.75 1.  ]
    """
    power = np.cumsum(residual.real**2 + residual.imag**2)
    cumulative: NDArray[np.float64] = power / power[-1]
    return cumulative


def whiteness(residual: NDArray[np.complex128], frequency_hz: NDArray[np.float64]) -> Whiteness:
    """Test a whitened residual for whiteness.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Whitened; only bins that are compared.
    frequency_hz : ndarray, shape (K,)
    """
    count = residual.size
    line = np.arange(1, count + 1) / count
    distance = float(np.abs(cumulative_periodogram(residual) - line).max())
    power = residual.real**2 + residual.imag**2
    sums = np.concatenate([[0.0], np.cumsum(power)])
    loudest, edges, ratio, loud = -math.inf, (0.0, 0.0), 1.0, False
    for width in _WINDOWS:
        if width >= count:
            continue
        total = sums[width:] - sums[:-width]
        i = int(np.argmax(total))
        deviate = chi_square_deviate(float(total[i]), 2 * width)
        if deviate > loudest:
            loudest = deviate
            edges = (float(frequency_hz[i]), float(frequency_hz[i + width - 1]))
            ratio = float(total[i]) / (2 * width)
        loud |= deviate > SIGNIFICANT_STD + 0.5 and float(total[i]) / (2 * width) > _LOUD
    return Whiteness(
        distance=distance,
        band=KOLMOGOROV_95 / math.sqrt(count),
        probability=kolmogorov_p_value(distance * math.sqrt(count)),
        loudest_hz=edges,
        loudest_ratio=ratio,
        loud=loud,
    )


def input_relation(
    residual: NDArray[np.complex128],
    angle: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
) -> InputRelation:
    """Test a residual for a linear relation to the angle.

    Parameters
    ----------
    residual, angle : ndarray of complex, shape (K,)
        Whitened residual and transform of the angle.
    frequency_hz : ndarray, shape (K,)
        Equally spaced.
    """
    # Where the motor was not driven, the angle is what the loop makes of the torque's noise: such
    # bins would say that the residual follows the angle, and count for next to nothing here.
    power = np.abs(angle) ** 2
    neighbours = min(_NEIGHBOURS, power.size)
    around = np.convolve(power, np.full(neighbours, 1 / neighbours), mode="same")
    driven = angle / np.sqrt(np.maximum(around, np.finfo(float).tiny))
    # A hum is not linear dynamics, however large.
    limited = residual / np.maximum(np.abs(residual) / _LOUDEST, 1.0)
    cross = limited * driven.conj()
    blocks = residual.size // _COHERENT_BINS
    first = np.arange(0, blocks * _COHERENT_BINS, _COHERENT_BINS)

    def added(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
        total: NDArray[np.complex128] = np.add.reduceat(values[: blocks * _COHERENT_BINS], first)
        return total

    of_angle = added(driven * driven.conj()).real
    used = np.flatnonzero(of_angle > _DRIVEN * _COHERENT_BINS)
    most = added(limited * limited.conj()).real[used] * of_angle[used]
    coherence = np.abs(added(cross)[used]) ** 2 / np.maximum(most, np.finfo(float).tiny)
    # Under chance (1 - coherence)^(m - 1) is uniform, whatever the angle.
    surprise = -(_COHERENT_BINS - 1) * np.log1p(-np.minimum(coherence, 1 - 1e-12))
    worst = int(np.argmax(surprise))
    local = bool(surprise[worst] > largest_of(used.size))
    deviate = chi_square_deviate(2 * float(surprise.sum()), 2 * used.size)

    spacing_hz = float(frequency_hz[1] - frequency_hz[0])
    length = 4 * residual.size
    lags = np.fft.ifft(cross, length)
    at_s = np.fft.fftfreq(length, spacing_hz)  # bins are spaced as the lags' inverse
    carrier = np.exp(2j * np.pi * frequency_hz[0] * at_s)
    correlation = np.abs((lags * carrier).real) * length / np.linalg.norm(driven)
    correlation[np.abs(at_s) > _LONGEST_LAG_S] = 0.0
    at = int(np.argmax(correlation))
    tried = int(np.count_nonzero(correlation))
    return InputRelation(
        coherence=float(coherence[worst]),
        at_hz=float(frequency_hz[first[used[worst]] + _COHERENT_BINS // 2]),
        local=local,
        deviate=deviate,
        correlation=float(correlation[at]),
        lag_s=float(at_s[at]),
        related=bool(
            local or deviate > SIGNIFICANT_STD or correlation[at] ** 2 / 2 > largest_of(tried)
        ),
    )


# Harmonics of the sweep

MULTIPLES: Final = (2, 3)
_BLOCK_S: Final = 1.0
_LOWEST_HZ: Final = 2.0
"""Below, a block does not resolve a frequency and its double."""

_STEADY: Final = 0.3
_FEWEST_BLOCKS: Final = 5


@dataclass(frozen=True, slots=True)
class Harmonic:
    """Residual at one multiple of the sweep's frequency.

    Attributes
    ----------
    multiple : int
        2 or 3.
    deviate : float
        Deviate of its power along the whole sweep, in standard deviations beyond chance.
    drive_hz : float
        Frequency of the drive at which it is largest.
    present : bool
        Whether chance is ruled out, for the whole or there.
    """

    multiple: int
    deviate: float
    drive_hz: float
    present: bool


def harmonics(
    angle_rad: NDArray[np.float64],
    residual: NDArray[np.float64],
    rate_hz: float,
    band_hz: tuple[float, float],
) -> tuple[Harmonic, ...]:
    """Test along the sweep for harmonics; return nothing if the angle is not a sweep.

    Parameters
    ----------
    angle_rad, residual : ndarray, shape (n,)
        Angle, and whitened residual (variance 1 per sample if white up to half the rate).
    rate_hz : float
    band_hz : tuple of float
        In which the residual is known.
    """
    length = round(_BLOCK_S * rate_hz)
    blocks = angle_rad.size // length
    analytic = _analytic(angle_rad)[: blocks * length].reshape(blocks, length)
    phase = np.unwrap(np.angle(analytic), axis=1)
    drive_hz = (phase[:, -1] - phase[:, 0]) / (2 * np.pi * (length - 1) / rate_hz)
    size = np.abs(analytic).mean(axis=1)
    # Of a sweep the frequency of a block hardly varies: its phase is a smooth curve.
    time = np.linspace(-1, 1, length)
    curve = np.polynomial.polynomial.polyfit(time, phase.T, 2)
    off = np.abs(phase - np.polynomial.polynomial.polyval(time, curve)).mean(axis=1)
    usable = (off < _STEADY) & (size > _STEADY * np.median(size)) & (drive_hz > _LOWEST_HZ)
    window = np.hanning(length)
    parts = residual[: blocks * length].reshape(blocks, length) * window
    found = []
    for multiple in MULTIPLES:
        inside = (
            usable & (multiple * drive_hz > band_hz[0] + 2) & (multiple * drive_hz < band_hz[1] - 2)
        )
        if np.count_nonzero(inside) < _FEWEST_BLOCKS:
            continue
        turned = np.sum(parts[inside] * np.exp(-1j * multiple * phase[inside]), axis=1)
        chi_square = 2 * np.abs(turned) ** 2 / np.sum(window**2)
        deviate = chi_square_deviate(float(chi_square.sum()), 2 * chi_square.size)
        largest = int(np.argmax(chi_square))
        found.append(
            Harmonic(
                multiple=multiple,
                deviate=deviate,
                drive_hz=float(drive_hz[inside][largest]),
                present=bool(
                    deviate > SIGNIFICANT_STD
                    or chi_square[largest] / 2 > largest_of(chi_square.size)
                ),
            )
        )
    return tuple(found)


def _analytic(values: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the analytic signal (no negative frequencies), shape (n,)."""
    spectrum = np.fft.fft(values - values.mean())
    n = values.size
    spectrum[(n + 1) // 2 :] = 0
    spectrum[1 : (n + 1) // 2] *= 2
    analytic: NDArray[np.complex128] = np.fft.ifft(spectrum)
    return analytic
