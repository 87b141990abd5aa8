"""The band of interest at a rate that just holds it: zero-phase low-pass, every D-th sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_ATTENUATION_DB: Final = 100.0
_RATE_OVER_BAND: Final = 2.4
"""Least decimated rate per highest frequency: below 2.4 the filter becomes long."""


@dataclass(frozen=True, slots=True)
class Decimation:
    """A linear-phase low-pass filter, centred, and the samples that are kept after it.

    Attributes
    ----------
    factor : int
        One sample in so many is kept.
    kernel : ndarray, shape (2 reach factor + 1,)
        The filter: passes `highest_hz`, and 100 dB less from half the new rate on.
    reach : int
        Samples of the new rate to either side that the filter sees.
    rate_hz : float
        The new rate.
    """

    factor: int
    kernel: NDArray[np.float64]
    reach: int
    rate_hz: float

    @classmethod
    def to_band(cls, rate_hz: float, highest_hz: float) -> Decimation:
        """Choose the lowest rate that holds 0 to `highest_hz`, which is at most 0.4 `rate_hz`."""
        factor = max(int(rate_hz / (_RATE_OVER_BAND * highest_hz)), 1)
        new_rate_hz = rate_hz / factor
        stop_hz = new_rate_hz / 2
        # Kaiser's formulas for the length of the filter and the shape of its window.
        width = 2 * np.pi * (stop_hz - highest_hz) / rate_hz
        half = (_ATTENUATION_DB - 7.95) / (2 * 2.285 * width)
        reach = int(np.ceil(half / factor))
        ticks = np.arange(-reach * factor, reach * factor + 1)
        cutoff = (stop_hz + highest_hz) / rate_hz  # twice the middle of the transition
        kernel = cutoff * np.sinc(cutoff * ticks)
        kernel *= np.kaiser(ticks.size, 0.1102 * (_ATTENUATION_DB - 8.7))
        return cls(factor, kernel / kernel.sum(), reach, new_rate_hz)

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter and thin out.

        Parameters
        ----------
        values : ndarray, shape (n,)
            Taken as 0 before and after.

        Returns
        -------
        ndarray, shape (m,)
            Sample `reach` is the one at the first value; so many precede it.
        """
        length = values.size + self.kernel.size - 1
        padded = fast_length(length)
        spectrum = np.fft.rfft(values, padded) * np.fft.rfft(self.kernel, padded)
        return np.fft.irfft(spectrum, padded)[: length : self.factor].copy()

    def inside(self, ticks: int) -> slice:
        """Select samples of `apply` for which the filter saw nothing but the record's `ticks`."""
        return slice(2 * self.reach, (ticks - 1) // self.factor + 1)


def fast_length(at_least: int) -> int:
    """Least number not below `at_least` whose prime factors are at most 11: a fast transform."""
    length = max(at_least, 1)
    while not _is_smooth(length):
        length += 1
    return length


def fast_length_below(at_most: int) -> int:
    """Largest number not above `at_most` (1 or more) whose prime factors are at most 11."""
    length = at_most
    while not _is_smooth(length):
        length -= 1
    return length


def _is_smooth(number: int) -> bool:
    for factor in (2, 3, 5, 7, 11):
        while number % factor == 0:
            number //= factor
    return number == 1
