"""Auto- and cross-spectra of two records, summed over segments, and what follows from the sums.

H1, H2 and Hv: J. S. Bendat and A. G. Piersol, "Random Data".
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rigd.spectral.response import FrequencyResponse


@dataclass(slots=True)
class CrossSpectra:
    """Sums over segments, bin by bin.

    Common factors of the densities (rate, power of the window, number of segments) cancel in every
    ratio that is formed, so they are left out.

    Attributes
    ----------
    sxx, syy : ndarray of float, shape (n,)
        Of the input's and the output's squared magnitudes.
    sxy : ndarray of complex, shape (n,)
        Of the input's conjugate times the output.
    segments : int
        How many were added.
    """

    sxx: NDArray[np.float64]
    syy: NDArray[np.float64]
    sxy: NDArray[np.complex128]
    segments: int = 0

    @classmethod
    def of_nothing(cls, bins: int) -> "CrossSpectra":
        """Return sums to begin with."""
        return cls(np.zeros(bins), np.zeros(bins), np.zeros(bins, dtype=np.complex128))

    def copy(self) -> "CrossSpectra":
        """Return sums of the same segments, to be added to apart from these."""
        return CrossSpectra(self.sxx.copy(), self.syy.copy(), self.sxy.copy(), self.segments)

    def add(self, fx: NDArray[np.complex128], fy: NDArray[np.complex128]) -> None:
        """Add a segment by the transforms (n,) of its input and its output."""
        self.sxx += power(fx)
        self.syy += power(fy)
        self.sxy += fx.conj() * fy
        self.segments += 1

    def response(
        self, frequency_hz: NDArray[np.float64], estimator: Literal["h1", "h2", "hv"]
    ) -> FrequencyResponse:
        """Return the response on the bins `frequency_hz` (n,); NaN where the input has no power."""
        return FrequencyResponse(
            frequency_hz=frequency_hz,
            response=self._ratio(estimator),
            coherence=self._coherence() if self.segments > 1 else None,
            segments=self.segments,
            estimator=estimator,
        )

    def _ratio(self, estimator: Literal["h1", "h2", "hv"]) -> NDArray[np.complex128]:
        """Return output over input."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if estimator == "h1":
                return self.sxy / self.sxx
            if estimator == "h2":
                # Syx, the conjugate of Sxy, is what leaves the phase as H1 has it.
                return self.syy / self.sxy.conj()
            return self.sxy / np.abs(self.sxy) * np.sqrt(self.syy / self.sxx)

    def _coherence(self) -> NDArray[np.float64]:
        """Return the ordinary coherence, 0 where either record has no power."""
        both = self.sxx * self.syy
        coherence = np.divide(power(self.sxy), both, out=np.zeros_like(both), where=both > 0)
        return np.minimum(coherence, 1.0)  # Cauchy-Schwarz, up to rounding


def power(transform: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the squared magnitude."""
    return transform.real**2 + transform.imag**2
