"""The lowest bins of a padded transform, without the rest of it.

L. I. Bluestein, "A linear filtering approach to the computation of discrete Fourier transform",
IEEE Trans. Audio Electroacoust. 18 (1970) 451-455.
"""

import numpy as np
from numpy.typing import NDArray


def bins_up_to(last_hz: float, nfft: int, rate_hz: float) -> int:
    """Return how many bins a transform has from 0 to a frequency, included."""
    # A rounding error in the caller's arithmetic must not cost the last one.
    return 1 + min(nfft // 2, int(last_hz * nfft / rate_hz * (1 + 1e-9)))


class LowBins:
    """Transform that equals ``np.fft.rfft(x, nfft)[:bins]`` to rounding.

    With ``2 n k = n² + k² − (k − n)²`` the sum over n becomes a convolution with a chirp, which two
    short transforms carry out. Of 17 266 samples padded to 160 000 the bins up to 60 Hz take a
    quarter of the time that all bins take.

    Parameters
    ----------
    length : int
        Most samples that will be given.
    nfft : int
        Length of the padded transform, at least `length`.
    bins : int
        How many are wanted, from frequency 0 on; at most ``nfft // 2 + 1``.
    """

    def __init__(self, length: int, nfft: int, bins: int) -> None:
        self._bins = bins
        size = _fast_length(length + bins - 1)
        n = np.arange(max(length, bins))
        # The phase is reduced while it is a whole number, which is exact.
        self._chirp = np.exp(-1j * np.pi * (n * n % (2 * nfft)) / nfft)
        kernel = np.zeros(size, dtype=np.complex128)
        kernel[:bins] = self._chirp[:bins].conj()
        kernel[size - length + 1 :] = self._chirp[length - 1 : 0 : -1].conj()
        self._kernel = np.fft.fft(kernel)
        # Held, because memory of this size is dear to get anew.
        self._work = np.empty(size, dtype=np.complex128)
        self._transform = np.empty(size, dtype=np.complex128)

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Transform the samples (n,) into a new array (bins,)."""
        self._work[x.size :] = 0.0
        np.multiply(x, self._chirp[: x.size], out=self._work[: x.size])
        np.fft.fft(self._work, out=self._transform)
        self._transform *= self._kernel
        np.fft.ifft(self._transform, out=self._work)
        low: NDArray[np.complex128] = self._work[: self._bins] * self._chirp[: self._bins]
        return low


def _fast_length(least: int) -> int:
    """Smallest length of at least `least` without a prime factor above 5."""
    best = 1 << (least - 1).bit_length()
    fives = 1
    while fives < best:
        odd = fives
        while odd < best:
            best = min(best, odd << (-(-least // odd) - 1).bit_length())
            odd *= 3
        fives *= 5
    return best
