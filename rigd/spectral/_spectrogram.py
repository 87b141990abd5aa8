"""Spectrogram of a signal that arrives in blocks: level over frequency and time."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral._running import LONGEST_GAP_S, Segments, bins_up_to

MIN_LEVEL_DB: Final = -200.0
"""Level of silence, in dB: lower levels are raised to it."""

_TRANSFORM_TO_WINDOW_LENGTH: Final = 4
"""Ratio of the transform's length to the window's.

With this ratio, the level of a sine between two bins is at most 0.1 dB too low."""


class RunningSpectrogram:
    """Spectrogram of a signal that arrives in blocks, with one column of levels per time step.

    The window is Hann's. A sine of amplitude A has the level 20 log10 A at its frequency, in dB re
    1 of the signal's unit. A constant A has this level at frequency 0.

    Parameters
    ----------
    rate_hz : float
        Sampling rate.
    window_s, step_s : float
        Length of the window, and time between two columns.
    last_hz : float
        Highest frequency of the columns.

    Attributes
    ----------
    frequency_hz : ndarray of float, shape (m,)
        Frequencies of a column's levels, from 0 on.
    """

    def __init__(
        self,
        rate_hz: float,
        *,
        window_s: float = 1.0,
        step_s: float = 0.25,
        last_hz: float = 60.0,
    ) -> None:
        window_length = max(4, round(window_s * rate_hz))
        self._rate_hz = rate_hz
        self._nfft = _TRANSFORM_TO_WINDOW_LENGTH * window_length
        bin_count = bins_up_to(last_hz, self._nfft, rate_hz)
        self.frequency_hz = np.arange(bin_count) * rate_hz / self._nfft
        hann_window = np.hanning(window_length)
        # One-sided spectrum: half of each amplitude is at the negative frequency.
        self._window = hann_window * (2.0 / hann_window.sum())
        self._segments = Segments(
            1,
            window_length,
            max(1, round(step_s * rate_hz)),
            longest_gap_ticks=round(LONGEST_GAP_S * rate_hz),
        )

    def feed(
        self, ticks: ArrayLike, signal_values: ArrayLike
    ) -> list[tuple[float, NDArray[np.float64]]]:
        """Add samples and return the columns (time in s, levels in dB) that they complete.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing numbers of the samples, from 0 on. Gaps of up to `LONGEST_GAP_S` are
            interpolated. Columns whose window contains a longer gap are omitted.
        signal_values : array_like, shape (n,)
            Samples of the signal. A value that is not finite counts as missing.

        Returns
        -------
        list of (time_s, level_db)
            Time of the middle of the column's window since tick 0, and levels (m,) of at least
            `MIN_LEVEL_DB`.
        """
        return [
            ((first_tick + (segment.shape[1] - 1) / 2) / self._rate_hz, self._levels_db(segment[0]))
            for first_tick, segment in self._segments.feed(
                ticks, np.asarray(signal_values)[np.newaxis]
            )
        ]

    def _levels_db(self, segment: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a segment's levels in the frequency bins (m,), in dB re 1 of the signal's unit."""
        bin_amplitudes = np.abs(
            np.fft.rfft(segment * self._window, self._nfft)[: self.frequency_hz.size]
        )
        bin_amplitudes[0] /= 2.0  # a constant has no negative frequency
        least_amplitude = 10.0 ** (MIN_LEVEL_DB / 20.0)
        level_db: NDArray[np.float64] = 20.0 * np.log10(np.maximum(bin_amplitudes, least_amplitude))
        return level_db
