"""Welch's estimate of a frequency response, with the segmentation the paper used.

P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans.
Audio Electroacoust. 15 (1967) 70-73.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rigd.spectral.cross_spectra import CrossSpectra
from rigd.spectral.records import checked_records
from rigd.spectral.response import FrequencyResponse, SpectralError
from rigd.spectral.segmentation import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_SEGMENT_LENGTH,
    check_segmentation,
    segment_count,
)
from rigd.spectral.windows import window_named


def welch_response(
    input_: ArrayLike,
    output: ArrayLike,
    rate_hz: float,
    *,
    segment_length: int = PAPER_SEGMENT_LENGTH,
    overlap: int = PAPER_OVERLAP,
    nfft: int = PAPER_NFFT,
    window: str = "hamming",
    estimator: Literal["h1", "h2", "hv"] = "h1",
) -> FrequencyResponse:
    """Frequency response from averaged cross- and auto-spectra of windowed segments.

    Parameters
    ----------
    input_, output : array_like, shape (n,)
    rate_hz : float
        Sampling rate.
    segment_length, overlap : int
        In samples. The defaults are the paper's: eight segments of a record of 120 000.
    nfft : int
        Length of the transform in samples, at least `segment_length`: segments are padded with
        zeros, which puts bins closer together without resolving more.
    window : {"hamming", "hann", "rectangular"}
        Symmetric. No trend is removed from the segments.
    estimator : {"h1", "h2", "hv"}
        H1 = Sxy/Sxx is biased low by noise on the input, H2 = Syy/Syx high by noise on the
        output. Hv, their geometric mean, has the phase of both and lies between them; unlike
        the one from total least squares it does not depend on the units of the two records.

    Returns
    -------
    FrequencyResponse
        ``nfft // 2 + 1`` bins from 0 to half the rate.

    Raises
    ------
    SpectralError
        If the record is shorter than one segment, or a record or setting makes no sense.
    """
    x, y = checked_records(input_, output, rate_hz)
    check_segmentation(segment_length, overlap, nfft)
    if estimator not in ("h1", "h2", "hv"):
        raise SpectralError(f"There is no estimator {estimator!r}; choose one of h1, h2, hv.")
    taper = window_named(window)(segment_length)
    count = segment_count(x.size, segment_length, overlap)
    if count == 0:
        raise SpectralError(
            f"The record has {x.size} samples ({x.size / rate_hz:g} s), fewer than one Welch "
            f"segment of {segment_length} ({segment_length / rate_hz:g} s); "
            "record for longer or ask for shorter segments."
        )
    bins = nfft // 2 + 1
    sums = CrossSpectra.of_nothing(bins)
    # Held, because memory of this size is dear to get anew.
    fx, fy = np.empty((2, bins), dtype=np.complex128)
    # One segment at a time stays in the cache, which a whole batch does not.
    for k in range(count):
        segment = slice(start := k * (segment_length - overlap), start + segment_length)
        np.fft.rfft(x[segment] * taper, nfft, out=fx)
        np.fft.rfft(y[segment] * taper, nfft, out=fy)
        sums.add(fx, fy)
    return sums.response(np.arange(bins) * rate_hz / nfft, estimator)
