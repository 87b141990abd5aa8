"""Frequency response from one transform of the whole record.

The empirical transfer function estimate of L. Ljung, "System Identification", section 6.3. The
paper compares Welch's estimate with it.
"""

import numpy as np
from numpy.typing import ArrayLike

from rigd.spectral.records import checked_records
from rigd.spectral.response import FrequencyResponse, SpectralError


def fft_response(
    input_: ArrayLike, output: ArrayLike, rate_hz: float, nfft: int | None = None
) -> FrequencyResponse:
    """Ratio of the Fourier transforms of output and input, no window, no averaging.

    Nothing leaks if the system is at rest before the first sample and at rest again before the
    last; then the estimate has no bias at all. It has no averaging against noise either.

    Parameters
    ----------
    input_, output : array_like, shape (n,)
    rate_hz : float
    nfft : int, optional
        Length of the transform, at least n; the record is padded with zeros. Default n.

    Returns
    -------
    FrequencyResponse
        ``nfft // 2 + 1`` bins, without coherence: one record has none.

    Raises
    ------
    SpectralError
        If a record holds values that are not finite, the input is zero, or `nfft` is too short.
    """
    x, y = checked_records(input_, output, rate_hz)
    length = x.size if nfft is None else nfft
    if length < x.size:
        raise SpectralError(
            f"nfft = {length} samples is shorter than the record of {x.size}: "
            "the whole record is transformed, never cut; choose it at least as long."
        )
    fx = np.fft.rfft(x, length)
    fy = np.fft.rfft(y, length)
    with np.errstate(divide="ignore", invalid="ignore"):
        response = fy / fx
    return FrequencyResponse(
        frequency_hz=np.arange(fx.size) * rate_hz / length,
        response=response,
        coherence=None,
        segments=1,
        estimator="fft",
    )
