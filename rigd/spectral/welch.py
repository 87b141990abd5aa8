"""Welch's estimate of a frequency response, with the segmentation the paper used.

P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans.
Audio Electroacoust. 15 (1967) 70-73; H1, H2 and Hv: J. S. Bendat and A. G. Piersol, "Random Data".
"""

from collections.abc import Callable
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral.records import checked_records
from rigd.spectral.response import FrequencyResponse, SpectralError

PAPER_SEGMENT_LENGTH: Final = 17266
PAPER_OVERLAP: Final = 2590
PAPER_NFFT: Final = 160_000

# All symmetric, as MATLAB's are by default; scipy's are periodic unless told otherwise.
_WINDOWS: Final[dict[str, Callable[[int], NDArray[np.float64]]]] = {
    "hamming": np.hamming,
    "hann": np.hanning,
    "rectangular": np.ones,
}


def segment_count(samples: int, segment_length: int, overlap: int) -> int:
    """Whole segments that fit a record; what is left over at its end goes unused."""
    return max(0, (samples - overlap) // (segment_length - overlap))


def segment_lengths(samples: int, segments: int, overlap_fraction: float) -> tuple[int, int]:
    """Longest segments that fit a record `segments` times, and their overlap in samples.

    The overlap is rounded to the nearest sample. Rounding it down, as is usual, makes eight
    segments of 15 % overlap miss a record of 120 000 samples by five: seven are then averaged
    without a word, the record ends at 105.3 s and the third resonance of a 120 s chirp is lost.

    Returns
    -------
    (segment_length, overlap) : tuple of int
        ``segment_lengths(120_000, 8, 0.15) == (17266, 2590)``, the paper's.

    Raises
    ------
    SpectralError
        If the record is too short for that many segments.
    """
    if segments < 1 or not 0 <= overlap_fraction < 1:
        raise SpectralError(
            "Welch needs at least one segment and an overlap from 0 to below 1 (a fraction of the "
            f"segment), not {segments} segments with an overlap of {overlap_fraction:g}."
        )

    def end_of_last(length: int) -> int:
        return length + (segments - 1) * (length - round(overlap_fraction * length))

    # The end grows with the length but for jumps of rounding, so start above and walk down.
    length = int(samples / (1 + (segments - 1) * (1 - overlap_fraction))) + segments + 1
    while length > 1 and end_of_last(length) > samples:
        length -= 1
    overlap = round(overlap_fraction * length)
    if length < 2 or overlap >= length or end_of_last(length) > samples:
        raise SpectralError(
            f"A record of {samples} samples is too short for {segments} segments "
            f"with an overlap of {overlap_fraction:.0%}; ask for fewer segments."
        )
    return length, overlap


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
    _check_settings(segment_length, overlap, nfft, window, estimator)
    count = segment_count(x.size, segment_length, overlap)
    if count == 0:
        raise SpectralError(
            f"The record has {x.size} samples ({x.size / rate_hz:g} s), fewer than one Welch "
            f"segment of {segment_length} ({segment_length / rate_hz:g} s); "
            "record for longer or ask for shorter segments."
        )
    taper = _WINDOWS[window](segment_length)
    bins = nfft // 2 + 1
    sxx, syy = np.zeros(bins), np.zeros(bins)
    sxy = np.zeros(bins, dtype=np.complex128)
    # Common factors of the densities (rate, power of the window, number of segments) cancel in
    # every ratio below. One segment at a time stays in the cache, which a whole batch does not.
    for k in range(count):
        segment = slice(start := k * (segment_length - overlap), start + segment_length)
        fx = np.fft.rfft(x[segment] * taper, nfft)
        fy = np.fft.rfft(y[segment] * taper, nfft)
        sxx += fx.real**2 + fx.imag**2
        syy += fy.real**2 + fy.imag**2
        sxy += fx.conj() * fy
    return FrequencyResponse(
        frequency_hz=np.arange(bins) * rate_hz / nfft,
        response=_ratio(estimator, sxx, syy, sxy),
        coherence=_coherence(sxx, syy, sxy) if count > 1 else None,
        segments=count,
        estimator=estimator,
    )


def _ratio(
    estimator: Literal["h1", "h2", "hv"],
    sxx: NDArray[np.float64],
    syy: NDArray[np.float64],
    sxy: NDArray[np.complex128],
) -> NDArray[np.complex128]:
    """Output over input from the summed spectra; NaN where the input has no power."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if estimator == "h1":
            return sxy / sxx
        if estimator == "h2":
            # Syx, the conjugate of Sxy, is what leaves the phase as H1 has it.
            return syy / sxy.conj()
        return sxy / np.abs(sxy) * np.sqrt(syy / sxx)


def _coherence(
    sxx: NDArray[np.float64], syy: NDArray[np.float64], sxy: NDArray[np.complex128]
) -> NDArray[np.float64]:
    """Ordinary coherence, 0 where either record has no power."""
    power = sxx * syy
    cross = sxy.real**2 + sxy.imag**2
    coherence = np.divide(cross, power, out=np.zeros_like(power), where=power > 0)
    return np.minimum(coherence, 1.0)  # Cauchy-Schwarz, up to rounding


def _check_settings(
    segment_length: int, overlap: int, nfft: int, window: str, estimator: str
) -> None:
    if segment_length < 2 or not 0 <= overlap < segment_length:
        raise SpectralError(
            "A Welch segment needs at least 2 samples and an overlap from 0 to below its length, "
            f"not a length of {segment_length} with an overlap of {overlap} samples."
        )
    if nfft < segment_length:
        raise SpectralError(
            f"nfft = {nfft} samples is shorter than a segment of {segment_length}: "
            "segments are padded to nfft, never cut; choose it at least as long."
        )
    if window not in _WINDOWS:
        raise SpectralError(f"There is no window {window!r}; choose one of {', '.join(_WINDOWS)}.")
    if estimator not in ("h1", "h2", "hv"):
        raise SpectralError(f"There is no estimator {estimator!r}; choose one of h1, h2, hv.")
