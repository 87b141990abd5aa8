"""Noise spectrum of the torque, from the residual of a fit: smooth, and narrow-band lines.

The spectrum is smoothed by medians over blocks of bins. The residual of a wrong model at a mode, or
a hum at one frequency, does not raise a median. A line is a group of bins far above the spectrum
that lasts through the whole record.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCKS: Final = 24
_FEWEST_BINS: Final = 40
_FINE_BINS: Final = 60
_PEAK_BINS: Final = 12
_PEAK: Final = 2.4
"""Mean power over so many bins, relative to the smooth one, that chance exceeds in one record of a
hundred."""

_MEDIAN_OVER_MEAN: Final = float(np.log(2.0))

_LINE: Final = 20.0
"""Power over that of the noise from which a bin is significant: chance exceeds it once in 5e8
bins."""

_GUARD: Final = 16
"""Bins to either side of a line that resolve its duration: parts of 1/32 of the record."""

_EIGHTHS: Final = 8
_STEADY: Final = 0.3
"""Least power in any eighth of the record, relative to the mean, of a line that is always there."""


@dataclass(frozen=True, slots=True)
class NoiseLine:
    """An oscillation of one frequency, all through the record, that the motor did not cause."""

    frequency_hz: float
    """Frequency of the sinusoid."""
    amplitude_nm: float
    """Its amplitude in the torque."""


@dataclass(frozen=True, slots=True)
class NoiseSpectrum:
    """Noise in the torque, as estimated from a residual.

    Attributes
    ----------
    power : ndarray, shape (K,)
        Expected ``|residual|²`` of each bin.
    counts : ndarray of bool, shape (K,)
        Bins that are compared; False at the lines.
    lines : tuple of NoiseLine
    """

    power: NDArray[np.float64]
    counts: NDArray[np.bool_]
    lines: tuple[NoiseLine, ...]

    @property
    def weight(self) -> NDArray[np.float64]:
        """Return the whitening factor of the residual (parts of variance 1); 0 at the lines."""
        weight: NDArray[np.float64] = np.sqrt(2 / self.power) * self.counts
        return weight


def noise_of(
    residual: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
    samples: int,
    known_fraction: float = 1.0,
    near_mode: NDArray[np.bool_] | None = None,
) -> NoiseSpectrum:
    """Separate noise and hum in a residual.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Transform of `samples` samples in N·m, on neighbouring bins.
    frequency_hz : ndarray, shape (K,)
    samples : int
    known_fraction : float
        Fraction of the samples at which the residual is known; it is 0 at the others.
    near_mode : ndarray of bool, shape (K,), optional
        Bins that are compared in any case, with the skirts of adjacent lines; without this no line
        is searched for. An excluded resonance is not fitted, and would therefore always appear as a
        line.
    """
    power = smooth_power(residual) / known_fraction
    counts = np.ones(power.size, dtype=bool)
    lines: list[NoiseLine] = []
    if near_mode is None:
        return NoiseSpectrum(power, counts, ())
    for part in _standing_out(residual, power):
        own = np.abs(residual[part]) ** 2
        if near_mode[part][np.argmax(own)] or not _steady(residual, part):
            continue
        counts[part] &= near_mode[part]
        lines.append(
            NoiseLine(
                frequency_hz=float(own @ frequency_hz[part] / own.sum()),
                amplitude_nm=float(2 * np.sqrt(own.sum()) / (samples * known_fraction)),
            )
        )
    return NoiseSpectrum(power, counts, tuple(lines))


def smooth_power(residual: NDArray[np.complex128], *, finely: bool = False) -> NDArray[np.float64]:
    """Return the smooth power of a residual's spectrum, shape (K,): the mean ``|residual|²``.

    The power of noise in one bin is exponentially distributed, so its mean is the median over ln 2.
    The median of a block ignores the residual of a wrong model at a mode, and a hum at one
    frequency, which are not noise. The logarithm is interpolated between block centres. Blocks are
    narrower at low frequency, where drift makes the spectrum steep.

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
        Spectrum on neighbouring bins.
    finely : bool
        Whether all blocks are narrow, which follow a peak in the noise.
    """
    power = residual.real**2 + residual.imag**2
    edges = _fine_edges(power.size) if finely else _edges(power.size)
    logs = np.array(
        [
            np.log(max(float(np.median(power[a:b])), np.finfo(float).tiny) / _MEDIAN_OVER_MEAN)
            for a, b in itertools.pairwise(edges)
        ]
    )
    middles = (edges[:-1] + edges[1:] - 1) / 2
    smooth: NDArray[np.float64] = np.exp(np.interp(np.arange(power.size), middles, logs))
    return smooth


def with_peaks(
    residual: NDArray[np.complex128], power: NDArray[np.float64], where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the noise power with peaks narrower than the blocks of `smooth_power`, (K,).

    Parameters
    ----------
    residual : ndarray of complex, shape (K,)
    power : ndarray, shape (K,)
        Smooth.
    where : ndarray of bool, shape (K,)
        Where a peak may be.
    """
    ratio = (residual.real**2 + residual.imag**2) / power
    local = np.convolve(ratio, np.full(_PEAK_BINS, 1 / _PEAK_BINS), mode="same")
    # Around each significant bin, as far as the mean over so many bins includes it.
    out = np.convolve(local > _PEAK, np.ones(2 * _PEAK_BINS + 1), mode="same") > 0
    return np.where(out & where, power * np.maximum(local, 1.0), power)


def _edges(bins: int) -> NDArray[np.intp]:
    """Return the block borders: widths grow with frequency, from `_FEWEST_BINS` up."""
    positions = bins * np.linspace(0, 1, _BLOCKS + 1) ** 2
    edges = [0]
    for position in positions[1:-1]:
        if position - edges[-1] >= _FEWEST_BINS and bins - position >= _FEWEST_BINS:
            edges.append(round(float(position)))
    return np.array([*edges, bins])


def _fine_edges(bins: int) -> NDArray[np.intp]:
    """Return the borders of equal blocks of `_FINE_BINS` or a little more."""
    return np.linspace(0, bins, max(bins // _FINE_BINS, 1) + 1).round().astype(np.intp)


def _standing_out(residual: NDArray[np.complex128], power: NDArray[np.float64]) -> list[slice]:
    """Find groups of bins far above the noise, each with its skirts.

    A line leaks into its neighbours as 1 / distance: at three times the distance at which it is
    significant the leakage is below the noise.
    """
    bins = np.flatnonzero(np.abs(residual) ** 2 > _LINE * power)
    if bins.size == 0:
        return []
    groups = np.split(bins, np.flatnonzero(np.diff(bins) > _GUARD // 2) + 1)
    parts = []
    for group in groups:
        first, last = int(group[0]), int(group[-1])
        skirt = max(last - first, 2)
        parts.append(slice(max(first - skirt, 0), last + skirt + 1))
    return parts


def _steady(residual: NDArray[np.complex128], part: slice) -> bool:
    """Return whether a line lasts through the whole record.

    The residual of a wrong model at a mode begins when the sweep passes the mode, and decays.
    """
    around = residual[max(part.start - _GUARD, 0) : part.stop + _GUARD]
    length = _EIGHTHS * (-(-4 * around.size // _EIGHTHS))
    envelope = np.abs(np.fft.ifft(around, length)) ** 2
    eighths = envelope.reshape(_EIGHTHS, -1).mean(axis=1)
    return bool(eighths.min() > _STEADY * eighths.mean())
