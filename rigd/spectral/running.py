"""Welch's estimate of a frequency response while the record still grows."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral.cross_spectra import CrossSpectra, power
from rigd.spectral.excited import excited_bins
from rigd.spectral.low_bins import LowBins, bins_up_to
from rigd.spectral.response import FrequencyResponse
from rigd.spectral.segmentation import Segmentation, check_segmentation, segmentation_of
from rigd.spectral.segments import LONGEST_GAP_S, Segments

LEAST_SHARE: Final = 0.25
"""Of a segment, before it tells anything: shorter ones do not resolve what they show."""


@dataclass(frozen=True, slots=True)
class RunningEstimate:
    """What is known of a response so far.

    Attributes
    ----------
    response : FrequencyResponse
        Its coherence is None until there are two whole segments.
    excited : ndarray of bool, shape (n,)
        Bins of the response where the reference has been; what it shows elsewhere is noise and
        what leaks.
    final : bool
        Whether the record is at its end; then this is the estimate of `welch_response`.
    """

    response: FrequencyResponse
    excited: NDArray[np.bool_]
    final: bool


class RunningResponse:
    """H1 of a record that grows; at its end it is that of `welch_response`, to rounding.

    Whole segments are averaged as Welch does, each under a Hamming window. Until the end the newest
    samples, as many as make a segment or as there are, count as one more with a window of its own
    length: so the response reaches as far as the record, not as the last whole segment.

    Parameters
    ----------
    rate_hz : float
        Sampling rate.
    samples : int
        Length of the whole record.
    last_hz : float
        The response is estimated up to here.
    segmentation : Segmentation, optional
        By default what `segmentation_of` makes of a record of that length.

    Raises
    ------
    SpectralError
        If the lengths of the segmentation make no sense together.
    """

    def __init__(
        self,
        rate_hz: float,
        samples: int,
        *,
        last_hz: float,
        segmentation: Segmentation | None = None,
    ) -> None:
        chosen = segmentation or segmentation_of(samples, rate_hz)
        self._length, self._nfft = chosen.segment_length, chosen.nfft
        check_segmentation(self._length, chosen.overlap, self._nfft)
        bins = bins_up_to(last_hz, self._nfft, rate_hz)
        self._frequency_hz = np.arange(bins) * rate_hz / self._nfft
        self._transform = LowBins(self._length, self._nfft, bins)
        self._segments = Segments(
            3,
            self._length,
            self._length - chosen.overlap,
            longest_gap=round(LONGEST_GAP_S * rate_hz),
            end=samples,
        )
        self._sums = CrossSpectra.of_nothing(bins)
        self._reference_power = np.zeros(bins)
        self._summed_up_to = 0

    def feed(
        self, ticks: ArrayLike, reference: ArrayLike, input_: ArrayLike, output: ArrayLike
    ) -> None:
        """Take samples; the result does not depend on how many come at a time.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing, 0 at the record's first sample. Gaps of up to `LONGEST_GAP_S` are
            interpolated, segments with a longer one left out. Samples from before the record and
            from after it may be given too: they close gaps at its ends, and one from after it tells
            that it is over.
        reference, input_, output : array_like, shape (n,)
            A tick with a value that is not finite counts as missing. No trend is removed: the input
            should be counted from where it is at rest, or that leaks into the lowest bins.
        """
        for first, segment in self._segments.feed(ticks, np.stack((reference, input_, output))):
            self._add(segment, self._sums, self._reference_power)
            self._summed_up_to = first + self._length

    def estimate(self) -> RunningEstimate | None:
        """Estimate from what has come; None as long as that is too little."""
        final = self._segments.over
        sums, reference_power = self._sums, self._reference_power
        newest = self._segments.newest(self._length)
        shortest = self._length
        if self._is_to_be_added(newest.shape[1], final):
            sums, reference_power = sums.copy(), reference_power.copy()
            self._add(newest, sums, reference_power)
            shortest = newest.shape[1]
        if sums.segments == 0:
            return None
        response = sums.response(self._frequency_hz, "h1")
        if self._sums.segments < 2:
            # The newest samples overlap the one segment: averaged with itself, all is coherent.
            response = replace(response, coherence=None)
        return RunningEstimate(
            response=response,
            excited=excited_bins(reference_power, -(-self._nfft // shortest)),
            final=final,
        )

    def _is_to_be_added(self, newest: int, final: bool) -> bool:
        """Whether so many newest samples count beside the whole segments."""
        if self._segments.end == self._summed_up_to or (final and self._sums.segments):
            return False
        return newest >= LEAST_SHARE * self._length

    def _add(
        self,
        segment: NDArray[np.float64],
        sums: CrossSpectra,
        reference_power: NDArray[np.float64],
    ) -> None:
        """Add a segment (3, n) of reference, input and output to the sums given."""
        window = np.hamming(segment.shape[1])
        reference, input_, output = segment
        # Where the motor stands excites nothing, but would outshine what does.
        moving = reference - np.average(reference, weights=window)
        reference_power += power(self._transform(moving * window))
        sums.add(self._transform(input_ * window), self._transform(output * window))
