"""The frequency response as a first-class object, and the error of this package."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Estimator = Literal["h1", "h2", "hv", "iv", "fft"]


class SpectralError(ValueError):
    """A record or a setting from which no frequency response can be estimated."""


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """Estimated ratio of output to input, bin by bin.

    Attributes
    ----------
    frequency_hz : ndarray of float, shape (n,)
        Increasing.
    response : ndarray of complex, shape (n,)
        Output over input, in the unit of the one per unit of the other. An output that lags the
        input has a negative phase. NaN in a bin where the input has no power at all.
    coherence : ndarray of float, shape (n,), or None
        Ordinary coherence, 0 to 1; None where fewer than two segments leave it without meaning.
    segments : int
        Number of segments that were averaged.
    estimator : {"h1", "h2", "hv", "iv", "fft"}
    """

    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    coherence: NDArray[np.float64] | None
    segments: int
    estimator: Estimator

    def band(self, first_hz: float, last_hz: float) -> "FrequencyResponse":
        """Bins from `first_hz` to `last_hz`, both included.

        Raises
        ------
        SpectralError
            If no bin lies in the band.
        """
        # A rounding error in the caller's arithmetic must not cost the bin at either end.
        slack = 1e-9 * max(abs(first_hz), abs(last_hz))
        first = int(np.searchsorted(self.frequency_hz, first_hz - slack, side="left"))
        end = int(np.searchsorted(self.frequency_hz, last_hz + slack, side="right"))
        if first >= end:
            raise SpectralError(
                f"The band {first_hz:g} to {last_hz:g} Hz holds no bin of a frequency response "
                f"that runs from {self.frequency_hz[0]:g} to {self.frequency_hz[-1]:g} Hz; "
                "choose a band inside it."
            )
        return replace(
            self,
            frequency_hz=self.frequency_hz[first:end],
            response=self.response[first:end],
            coherence=None if self.coherence is None else self.coherence[first:end],
        )

    def without_delays(self, *, input_delay_s: float, output_delay_s: float) -> "FrequencyResponse":
        """Return the response between the quantities themselves, given the age of their samples.

        Parameters
        ----------
        input_delay_s, output_delay_s : float
            Age of a sample at the time it is stamped with, in s; positive: the value is older.

        Notes
        -----
        The delays are pure shifts in time, so the response is multiplied by
        ``exp(j omega (output_delay - input_delay))``.
        """
        advance_s = output_delay_s - input_delay_s
        shift = np.exp(2j * np.pi * advance_s * self.frequency_hz)
        return replace(self, response=self.response * shift)
