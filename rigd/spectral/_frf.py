"""Frequency responses and their estimators: Welch, instrumental variable, whole record.

H1, H2, Hv
    Welch's method [1]_: auto- and cross-spectra of the two records, summed over overlapping
    windowed segments, and ratios of the sums [2]_. The default segmentation is the paper's.
Hiv
    Response within a control loop, with the loop's reference as instrument [3]_. A controller that
    feeds a measured output back lets the sensor's noise move the input. Noise and input are then
    correlated, and the estimates that average products of the two are biased: H1 by the fraction of
    the input's power that the noise causes. The reference is independent of the noise, so the
    cross-spectra with it average the noise out.
FFT
    Empirical transfer function estimate: ratio of the transforms of the whole records [4]_. The
    paper compares Welch's estimate with it.

References
----------
.. [1] P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE
   Trans. Audio Electroacoust. 15 (1967) 70-73.
.. [2] J. S. Bendat and A. G. Piersol, "Random Data".
.. [3] P. E. Wellstead, "Non-parametric methods of system identification", Automatica 17 (1981)
   55-69.
.. [4] L. Ljung, "System Identification", section 6.3.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral._window import WINDOW

Estimator = Literal["h1", "h2", "hv", "iv", "fft"]
"""Names of the estimators of a frequency response."""


class SpectralError(ValueError):
    """Error if a record or a setting does not allow the estimation of a frequency response."""


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """Estimated frequency response: ratio of output to input in each frequency bin.

    Attributes
    ----------
    frequency_hz : ndarray of float, shape (n,)
        Frequencies of the bins, increasing.
    response : ndarray of complex, shape (n,)
        Output over input, in the unit of the output per unit of the input. An output that lags the
        input has a negative phase. NaN in a bin in which the input has no power.
    coherence : ndarray of float, shape (n,), or None
        Ordinary coherence, 0 to 1; None with fewer than two segments, for which it has no meaning.
    segments : int
        Number of averaged segments.
    estimator : {"h1", "h2", "hv", "iv", "fft"}
        Estimator of the response.
    """

    frequency_hz: NDArray[np.float64]
    response: NDArray[np.complex128]
    coherence: NDArray[np.float64] | None
    segments: int
    estimator: Estimator

    def band(self, first_hz: float, last_hz: float) -> "FrequencyResponse":
        """Return the response in the bins from `first_hz` to `last_hz`, both included.

        Parameters
        ----------
        first_hz, last_hz : float
            Lowest and highest frequency.

        Raises
        ------
        SpectralError
            If no bin lies in the band.
        """
        # Rounding errors of the caller must not lose the bin at either end.
        tolerance_hz = 1e-9 * max(abs(first_hz), abs(last_hz))
        first_bin = int(np.searchsorted(self.frequency_hz, first_hz - tolerance_hz, side="left"))
        end_bin = int(np.searchsorted(self.frequency_hz, last_hz + tolerance_hz, side="right"))
        if first_bin >= end_bin:
            raise SpectralError(
                f"The band {first_hz:g} to {last_hz:g} Hz holds no bin of a frequency response "
                f"that runs from {self.frequency_hz[0]:g} to {self.frequency_hz[-1]:g} Hz; "
                "choose a band inside it."
            )
        return replace(
            self,
            frequency_hz=self.frequency_hz[first_bin:end_bin],
            response=self.response[first_bin:end_bin],
            coherence=None if self.coherence is None else self.coherence[first_bin:end_bin],
        )

    def without_delays(self, *, input_delay_s: float, output_delay_s: float) -> "FrequencyResponse":
        """Return the response corrected for the delays of the input and output channels.

        Parameters
        ----------
        input_delay_s, output_delay_s : float
            Age of a sample at its time stamp, in s. Positive: the value is older than the stamp.

        Notes
        -----
        The delays are pure shifts in time, so the response is multiplied by
        ``exp(j omega (output_delay - input_delay))``.
        """
        advance_s = output_delay_s - input_delay_s
        phase_shift = np.exp(2j * np.pi * advance_s * self.frequency_hz)
        return replace(self, response=self.response * phase_shift)


def checked_records(
    input_: ArrayLike, output: ArrayLike, rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the records of input and output as arrays of floats; raise SpectralError if invalid.

    They must have one dimension, equal length and finite values, and the input must not be zero.
    The message names the record and the problem.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise SpectralError(f"The sampling rate must be a positive number of Hz, not {rate_hz!r}.")
    x = np.asarray(input_, dtype=np.float64)
    y = np.asarray(output, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape:
        raise SpectralError(
            "Input and output must be two records of one dimension and equal length; "
            f"their shapes are {x.shape} and {y.shape}."
        )
    for record_name, record in (("input", x), ("output", y)):
        if not np.isfinite(record).all():
            invalid_count = int(np.count_nonzero(~np.isfinite(record)))
            raise SpectralError(
                f"{invalid_count} of {record.size} samples of the {record_name} are NaN or "
                "infinite; fill or cut them before estimating a frequency response."
            )
    if not x.any():
        raise SpectralError(
            f"The input is zero in all of its {x.size} samples: nothing was excited, "
            "so there is no frequency response to estimate."
        )
    return x, y


# Segments of a record

PAPER_RATE_HZ: Final = 1000.0
"""Sampling rate of the reference paper's records, in hertz."""
PAPER_SEGMENT_LENGTH: Final = 17266
"""Number of samples in a segment of the reference paper's Welch estimate."""
PAPER_OVERLAP: Final = 2590
"""Number of samples in the overlap of the reference paper's segments."""
PAPER_NFFT: Final = 160_000
"""Number of samples of the reference paper's zero-padded transforms."""
PAPER_SEGMENTS: Final = 8
"""Number of segments in the reference paper's records."""
PAPER_OVERLAP_FRACTION: Final = 0.15
"""Overlap of the reference paper's segments, as a fraction of a segment."""


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Length and overlap of the segments of Welch's method, and length of their transform."""

    segment_length: int = PAPER_SEGMENT_LENGTH
    """Number of samples in a segment."""
    overlap: int = PAPER_OVERLAP
    """Number of samples that adjacent segments have in common."""
    nfft: int = PAPER_NFFT
    """Number of samples of the zero-padded transform, at least those of a segment."""


def segmentation_of(sample_count: int, rate_hz: float) -> Segmentation:
    """Return the default segmentation for a record of known length.

    Segments and zero-padded transforms have the durations of the reference paper's. A record that
    is shorter than one such segment is divided, like the paper's record, into eight segments with
    15 % overlap; if it is too short for that, it is a single segment.

    Parameters
    ----------
    sample_count
        Number of samples in the record.
    rate_hz
        Sampling rate.
    """
    rate_ratio = rate_hz / PAPER_RATE_HZ
    segment_length, overlap = (
        round(PAPER_SEGMENT_LENGTH * rate_ratio),
        round(PAPER_OVERLAP * rate_ratio),
    )
    if segment_length < 2 or segment_count(sample_count, segment_length, overlap) == 0:
        try:
            segment_length, overlap = segment_lengths(
                sample_count, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION
            )
        except SpectralError:
            segment_length, overlap = max(sample_count, 2), 0
    return Segmentation(
        segment_length, overlap, max(round(PAPER_NFFT * rate_ratio), segment_length)
    )


def segment_count(sample_count: int, segment_length: int, overlap: int) -> int:
    """Return the number of whole segments in a record. The samples after the last are not used.

    Parameters
    ----------
    sample_count
        Number of samples in the record.
    segment_length, overlap
        Number of samples in a segment, and in the overlap of adjacent segments.

    Examples
    --------
    >>> from rigd.spectral import segment_count
    >>> segment_count(120_000, 17266, 2590)
    8
    """
    return max(0, (sample_count - overlap) // (segment_length - overlap))


def segment_lengths(
    sample_count: int, segment_total: int, overlap_fraction: float
) -> tuple[int, int]:
    """Return the largest segment length, and the overlap, that give a number of segments.

    The overlap is rounded to the nearest sample. If it were rounded down, as is usual, eight
    segments with 15 % overlap would exceed a record of 120 000 samples by five samples. Seven
    segments would be averaged without a message, the estimate would end at 105.3 s, and the third
    resonance of a 120 s chirp would be lost.

    Parameters
    ----------
    sample_count
        Number of samples in the record.
    segment_total
        Number of segments.
    overlap_fraction
        Overlap as a fraction of the segment, from 0 to below 1.

    Returns
    -------
    (segment_length, overlap) : tuple of int
        Numbers of samples. ``segment_lengths(120_000, 8, 0.15) == (17266, 2590)`` are those of the
        reference paper.

    Raises
    ------
    SpectralError
        If the record is too short for that many segments.

    Examples
    --------
    >>> from rigd.spectral import segment_lengths
    >>> segment_lengths(120_000, 8, 0.15)
    (17266, 2590)
    """
    if segment_total < 1 or not 0 <= overlap_fraction < 1:
        raise SpectralError(
            "Welch needs at least one segment and an overlap from 0 to below 1 (a fraction of the "
            f"segment), not {segment_total} segments with an overlap of {overlap_fraction:g}."
        )

    def end_of_last_segment(segment_length: int) -> int:
        return segment_length + (segment_total - 1) * (
            segment_length - round(overlap_fraction * segment_length)
        )

    # The end grows with the length except for rounding, so start above and decrease.
    segment_length = (
        int(sample_count / (1 + (segment_total - 1) * (1 - overlap_fraction))) + segment_total + 1
    )
    while segment_length > 1 and end_of_last_segment(segment_length) > sample_count:
        segment_length -= 1
    overlap = round(overlap_fraction * segment_length)
    if (
        segment_length < 2
        or overlap >= segment_length
        or end_of_last_segment(segment_length) > sample_count
    ):
        raise SpectralError(
            f"A record of {sample_count} samples is too short for {segment_total} segments "
            f"with an overlap of {overlap_fraction:.0%}; ask for fewer segments."
        )
    return segment_length, overlap


def check_segmentation(segment_length: int, overlap: int, nfft: int) -> None:
    """Raise SpectralError if the lengths of a segmentation are inconsistent."""
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


# Estimators


@dataclass(slots=True)
class CrossSpectra:
    """Auto- and cross-spectra of input and output in each bin, summed over segments.

    Common factors of the spectral densities (rate, power of the window, number of segments) cancel
    in every ratio and are omitted.

    Attributes
    ----------
    sxx, syy : ndarray of float, shape (n,)
        Summed squared magnitudes of the input's and the output's transform.
    sxy : ndarray of complex, shape (n,)
        Sum of the conjugate of the input's transform times the output's transform.
    segments : int
        Number of segments in the sums.
    """

    sxx: NDArray[np.float64]
    syy: NDArray[np.float64]
    sxy: NDArray[np.complex128]
    segments: int = 0

    @classmethod
    def empty(cls, bin_count: int) -> "CrossSpectra":
        """Return sums of spectra over no segments, which are zero in each frequency bin."""
        return cls(
            np.zeros(bin_count), np.zeros(bin_count), np.zeros(bin_count, dtype=np.complex128)
        )

    def copy(self) -> "CrossSpectra":
        """Return an independent copy of the summed spectra."""
        return CrossSpectra(self.sxx.copy(), self.syy.copy(), self.sxy.copy(), self.segments)

    def add(
        self, input_transform: NDArray[np.complex128], output_transform: NDArray[np.complex128]
    ) -> None:
        """Add a segment, given the transforms (n,) of its input and its output."""
        self.sxx += power(input_transform)
        self.syy += power(output_transform)
        self.sxy += input_transform.conj() * output_transform
        self.segments += 1

    def response(
        self, frequency_hz: NDArray[np.float64], estimator: Literal["h1", "h2", "hv"]
    ) -> FrequencyResponse:
        """Return the frequency response on the bins `frequency_hz` (n,).

        It is NaN in bins in which the input has no power.
        """
        return FrequencyResponse(
            frequency_hz=frequency_hz,
            response=self._spectra_ratio(estimator),
            coherence=self._coherence() if self.segments > 1 else None,
            segments=self.segments,
            estimator=estimator,
        )

    def _spectra_ratio(self, estimator: Literal["h1", "h2", "hv"]) -> NDArray[np.complex128]:
        """Return the estimated ratio of output to input in each frequency bin."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if estimator == "h1":
                return self.sxy / self.sxx
            if estimator == "h2":
                # Syx, the conjugate of Sxy, gives the same phase as H1.
                return self.syy / self.sxy.conj()
            return self.sxy / np.abs(self.sxy) * np.sqrt(self.syy / self.sxx)

    def _coherence(self) -> NDArray[np.float64]:
        """Return the ordinary coherence in each bin; 0 where input or output has no power."""
        power_product = self.sxx * self.syy
        bin_coherence = np.divide(
            power(self.sxy),
            power_product,
            out=np.zeros_like(power_product),
            where=power_product > 0,
        )
        return np.minimum(bin_coherence, 1.0)  # Cauchy-Schwarz, up to rounding


def power(transform: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the squared magnitudes of a transform."""
    return transform.real**2 + transform.imag**2


def welch_response(
    input_: ArrayLike,
    output: ArrayLike,
    rate_hz: float,
    *,
    segment_length: int = PAPER_SEGMENT_LENGTH,
    overlap: int = PAPER_OVERLAP,
    nfft: int = PAPER_NFFT,
    estimator: Literal["h1", "h2", "hv"] = "h1",
) -> FrequencyResponse:
    """Return the frequency response from averaged spectra of windowed segments (Welch's method).

    The window is `WINDOW`. No trend is removed from the segments.

    Parameters
    ----------
    input_, output : array_like, shape (n,)
        Records of input and output.
    rate_hz : float
        Sampling rate.
    segment_length, overlap : int
        Numbers of samples. The defaults are the reference paper's: eight segments of a record of
        120 000 samples.
    nfft : int
        Number of samples of the transform, at least `segment_length`. Segments are padded with
        zeros, which puts the bins closer together without a higher resolution.
    estimator : {"h1", "h2", "hv"}
        H1 = Sxy/Sxx is biased low by noise in the input. H2 = Syy/Syx is biased high by noise in
        the output. Hv is their geometric mean. It has the phase of both and a magnitude between
        them. Unlike the total least squares estimate it does not depend on the units of the two
        records.

    Returns
    -------
    FrequencyResponse
        Response in ``nfft
        2 + 1`` bins from 0 to half the sampling rate.

    Raises
    ------
    SpectralError
        If the record is shorter than one segment, or a record or setting is invalid.

    References
    ----------
    P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE
    Trans. Audio Electroacoust. 15 (1967) 70-73.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.spectral import welch_response
    >>> x = np.random.default_rng(1).standard_normal(10_000)
    >>> y = 2 * np.roll(x, 1)  # a gain of 2, one sample late
    >>> found = welch_response(x, y, 1000.0, segment_length=500, overlap=250, nfft=500)
    >>> gain, lag_rad = abs(found.response[50]), -np.angle(found.response[50])
    >>> print(f"{found.frequency_hz[50]:g} Hz: {gain:.2f}, {lag_rad:.2f} rad")
    100 Hz: 2.00, 0.63 rad
    """
    x, y = checked_records(input_, output, rate_hz)
    check_segmentation(segment_length, overlap, nfft)
    if estimator not in ("h1", "h2", "hv"):
        raise SpectralError(f"There is no estimator {estimator!r}; choose one of h1, h2, hv.")
    segment_weights = WINDOW.weights(segment_length)
    segment_total = segment_count(x.size, segment_length, overlap)
    if segment_total == 0:
        raise SpectralError(
            f"The record has {x.size} samples ({x.size / rate_hz:g} s), fewer than one Welch "
            f"segment of {segment_length} ({segment_length / rate_hz:g} s); "
            "record for longer or ask for shorter segments."
        )
    bin_count = nfft // 2 + 1
    summed_spectra = CrossSpectra.empty(bin_count)
    # Allocated once, because allocating this much memory again is slow.
    fx, fy = np.empty((2, bin_count), dtype=np.complex128)
    # One segment at a time stays in the cache, unlike a whole batch.
    for k in range(segment_total):
        segment = slice(
            segment_start := k * (segment_length - overlap), segment_start + segment_length
        )
        np.fft.rfft(x[segment] * segment_weights, nfft, out=fx)
        np.fft.rfft(y[segment] * segment_weights, nfft, out=fy)
        summed_spectra.add(fx, fy)
    return summed_spectra.response(np.arange(bin_count) * rate_hz / nfft, estimator)


def fft_response(
    input_: ArrayLike, output: ArrayLike, rate_hz: float, nfft: int | None = None
) -> FrequencyResponse:
    """Return the ratio of the transforms of whole records, without window and averaging.

    If the system is at rest at the beginning and at the end of the record, there is no leakage, and
    the estimate has no bias. Noise is not averaged out.

    Parameters
    ----------
    input_, output : array_like, shape (n,)
        Records of input and output.
    rate_hz : float
        Sampling rate.
    nfft : int, optional
        Number of samples of the transform, at least n. The records are padded with zeros. Default
        n.

    Returns
    -------
    FrequencyResponse
        Response in ``nfft
        2 + 1`` bins, without coherence, which needs several segments.

    Raises
    ------
    SpectralError
        If a record contains values that are not finite, the input is zero, or `nfft` is too short.

    References
    ----------
    L. Ljung, System Identification, 2nd edition, section 6.3: empirical transfer function estimate.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.spectral import fft_response
    >>> x = np.array([1.0, 0.0, 0.0, 0.0])
    >>> print(fft_response(x, 3 * x, rate_hz=4.0).response)
    [3.+0.j 3.+0.j 3.+0.j]
    """
    x, y = checked_records(input_, output, rate_hz)
    transform_length = x.size if nfft is None else nfft
    if transform_length < x.size:
        raise SpectralError(
            f"nfft = {transform_length} samples is shorter than the record of {x.size}: "
            "the whole record is transformed, never cut; choose it at least as long."
        )
    fx = np.fft.rfft(x, transform_length)
    fy = np.fft.rfft(y, transform_length)
    with np.errstate(divide="ignore", invalid="ignore"):
        spectra_ratio = fy / fx
    return FrequencyResponse(
        frequency_hz=np.arange(fx.size) * rate_hz / transform_length,
        response=spectra_ratio,
        coherence=None,
        segments=1,
        estimator="fft",
    )


def instrumental_response(
    reference: ArrayLike,
    input_: ArrayLike,
    output: ArrayLike,
    rate_hz: float,
    *,
    segment_length: int = PAPER_SEGMENT_LENGTH,
    overlap: int = PAPER_OVERLAP,
    nfft: int = PAPER_NFFT,
) -> FrequencyResponse:
    """Return the response ``Hiv = Sry / Srx`` from input to output of a control loop.

    S are cross-spectra of reference r, input x and output y. With the reference as the instrument,
    noise in the input is averaged out.

    Parameters
    ----------
    reference : array_like, shape (n,)
        Reference of the control loop, in any unit and with any delay: both cancel.
    input_, output : array_like, shape (n,)
        Records of input and output.
    rate_hz, segment_length, overlap, nfft
        See `rigd.spectral.welch_response`.

    Returns
    -------
    FrequencyResponse
        Response with the coherence of reference and output.

    Raises
    ------
    SpectralError
        As `rigd.spectral.welch_response`, and if the reference is zero throughout.

    References
    ----------
    P. E. Wellstead, "Non-parametric methods of system identification", Automatica 17 (1981) 55-69.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.spectral import instrumental_response, welch_response
    >>> reference, noise = np.random.default_rng(1).standard_normal((2, 100_000))
    >>> input_ = reference - 0.5 * noise  # a controller feeds the noise back
    >>> output = 3 * input_ + noise
    >>> lengths = {"segment_length": 500, "overlap": 250, "nfft": 500}
    >>> h1 = welch_response(input_, output, 1000.0, **lengths)
    >>> hiv = instrumental_response(reference, input_, output, 1000.0, **lengths)
    >>> print(f"{np.median(h1.response.real):.1f}, {np.median(hiv.response.real):.1f}")
    2.6, 3.0
    """
    checked_records(input_, output, rate_hz)
    if not np.any(reference):
        raise SpectralError(
            "The reference is zero throughout, so nothing followed it; choose another estimator."
        )
    reference_to_input, reference_to_output = (
        welch_response(
            reference,
            channel_values,
            rate_hz,
            segment_length=segment_length,
            overlap=overlap,
            nfft=nfft,
        )
        for channel_values in (input_, output)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        response = reference_to_output.response / reference_to_input.response
    return FrequencyResponse(
        frequency_hz=reference_to_output.frequency_hz,
        response=response,
        coherence=reference_to_output.coherence,
        segments=reference_to_output.segments,
        estimator="iv",
    )
