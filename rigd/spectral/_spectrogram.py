"""Spectrogram of a signal that arrives in blocks: amplitude over frequency and time."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral._running import LONGEST_GAP_S, Segments, bins_up_to

LEAST_DB: Final = -200.0
"""Level of silence."""

_PADDING: Final = 4
"""Length of the transforms over that of the window: the level of a sine between two bins is then
low by at most 0.1 dB."""


class RunningSpectrogram:
    """Columns of levels, one every step, under a Hann window.

    A sine of amplitude A has the level 20 log10 A at its frequency, in dB re 1 of the signal's
    unit; a constant A has it at frequency 0.

    Parameters
    ----------
    rate_hz : float
        Sampling rate.
    window_s, step_s : float
        Length of the window, and time between two columns.
    last_hz : float
        Highest frequency shown.

    Attributes
    ----------
    frequency_hz : ndarray of float, shape (m,)
        Frequencies from 0 on.
    """

    def __init__(
        self,
        rate_hz: float,
        *,
        window_s: float = 1.0,
        step_s: float = 0.25,
        last_hz: float = 60.0,
    ) -> None:
        length = max(4, round(window_s * rate_hz))
        self._rate_hz = rate_hz
        self._nfft = _PADDING * length
        bins = bins_up_to(last_hz, self._nfft, rate_hz)
        self.frequency_hz = np.arange(bins) * rate_hz / self._nfft
        window = np.hanning(length)
        # One-sided: the half of an amplitude at the negative frequency is added.
        self._window = window * (2.0 / window.sum())
        self._segments = Segments(
            1,
            length,
            max(1, round(step_s * rate_hz)),
            longest_gap=round(LONGEST_GAP_S * rate_hz),
        )

    def feed(self, ticks: ArrayLike, values: ArrayLike) -> list[tuple[float, NDArray[np.float64]]]:
        """Add samples and return the columns that they complete.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing, from 0 on. Gaps of up to `LONGEST_GAP_S` are interpolated; a longer one
            leaves out the columns whose window it touches.
        values : array_like, shape (n,)
            One that is not finite counts as missing.

        Returns
        -------
        list of (time_s, level_db)
            The time of the window's middle since tick 0, and the levels (m,), none below
            `LEAST_DB`.
        """
        return [
            ((first + (segment.shape[1] - 1) / 2) / self._rate_hz, self._level_db(segment[0]))
            for first, segment in self._segments.feed(ticks, np.asarray(values)[np.newaxis])
        ]

    def _level_db(self, segment: NDArray[np.float64]) -> NDArray[np.float64]:
        amplitude = np.abs(
            np.fft.rfft(segment * self._window, self._nfft)[: self.frequency_hz.size]
        )
        amplitude[0] /= 2.0  # a constant has no negative frequency
        least = 10.0 ** (LEAST_DB / 20.0)
        level_db: NDArray[np.float64] = 20.0 * np.log10(np.maximum(amplitude, least))
        return level_db
