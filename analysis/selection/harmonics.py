"""Residual at multiples of the frequency that the sweep has at that moment.

A linear beam answers at the frequency it is driven at, and rings at frequencies that the sweep has
passed. Twice or three times the drive's frequency is another matter: something is not linear. No
model of it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.chance import SURE, largest_of, of_chi_square

if TYPE_CHECKING:
    from numpy.typing import NDArray

MULTIPLES: Final = (2, 3)
_BLOCK_S: Final = 1.0
_LOWEST_HZ: Final = 2.0
"""Below, a block cannot tell a frequency from its double."""

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
        Of its power along the whole sweep, in standard deviations beyond chance.
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
    """Look along the sweep; empty if the angle is no sweep.

    Parameters
    ----------
    angle_rad, residual : ndarray, shape (n,)
        Angle, and whitened residual of variance 1 per sample were it white to half the rate.
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
        deviate = of_chi_square(float(chi_square.sum()), 2 * chi_square.size)
        largest = int(np.argmax(chi_square))
        found.append(
            Harmonic(
                multiple=multiple,
                deviate=deviate,
                drive_hz=float(drive_hz[inside][largest]),
                present=bool(
                    deviate > SURE or chi_square[largest] / 2 > largest_of(chi_square.size)
                ),
            )
        )
    return tuple(found)


def in_time(residual: NDArray[np.complex128], bins: slice, samples: int) -> NDArray[np.float64]:
    """Whitened residual as a signal, shape (samples,), of variance 1 were it white throughout."""
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    spectrum[bins] = residual
    values: NDArray[np.float64] = np.fft.irfft(spectrum, samples) * np.sqrt(samples / 2)
    return values


def _analytic(values: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Signal whose transform vanishes at negative frequencies, shape (n,)."""
    spectrum = np.fft.fft(values - values.mean())
    n = values.size
    spectrum[(n + 1) // 2 :] = 0
    spectrum[1 : (n + 1) // 2] *= 2
    analytic: NDArray[np.complex128] = np.fft.ifft(spectrum)
    return analytic
