"""Frequency response of a record that still grows, by Welch's method.

Samples arrive in blocks of any length and are cut into segments, with short gaps interpolated. Each
segment adds to the sums of `rigd.spectral._frf`; at any time these give the response, its
coherence, and the bins excited so far. Only the lowest bins of each padded transform are of
interest, and Bluestein's algorithm [1]_ computes them without the others.

References
----------
.. [1] L. I. Bluestein, "A linear filtering approach to the computation of discrete Fourier
   transform", IEEE Trans. Audio Electroacoust. 18 (1970) 451-455.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.spectral._frf import (
    CrossSpectra,
    FrequencyResponse,
    Segmentation,
    check_segmentation,
    power,
    segmentation_of,
)
from rigd.spectral._window import WINDOW

RealArray = NDArray[np.float64]
"""Array of real numbers."""

MIN_SEGMENT_FRACTION: Final = 0.25
"""Smallest number of samples from which a response is estimated, as a fraction of a segment.

Fewer samples have too little resolution."""


@dataclass(frozen=True, slots=True)
class RunningEstimate:
    """Frequency response estimated from the samples so far.

    Attributes
    ----------
    response : FrequencyResponse
        Estimated response. Its coherence is None until there are two whole segments.
    is_excited : ndarray of bool, shape (n,)
        Whether the reference has excited each bin of the response. Other bins contain noise and
        leakage.

    is_final : bool
        Whether the record is complete. The estimate is then equal to that of `welch_response`.
    """

    response: FrequencyResponse
    is_excited: NDArray[np.bool_]
    is_final: bool


class RunningResponse:
    """H1 estimate of the frequency response of a growing record.

    Whole segments are averaged as in Welch's method, each with `WINDOW`. Until the record
    ends, its newest samples, at most a segment of them, count as an additional segment with a
    window of their length, so that the response includes the newest part of the record. At the end
    of the record the estimate is equal to that of `welch_response`, except for rounding.

    Parameters
    ----------
    rate_hz : float
        Sampling rate.
    record_length : int
        Number of samples in the complete record.
    last_hz : float
        Highest frequency of the response.
    segmentation : Segmentation, optional
        Lengths of the segments. Default: those of `segmentation_of` for the complete record.

    Raises
    ------
    SpectralError
        If the lengths of the segmentation are inconsistent.
    """

    def __init__(
        self,
        rate_hz: float,
        record_length: int,
        *,
        last_hz: float,
        segmentation: Segmentation | None = None,
    ) -> None:
        used_segmentation = segmentation or segmentation_of(record_length, rate_hz)
        self._length, self._nfft = used_segmentation.segment_length, used_segmentation.nfft
        check_segmentation(self._length, used_segmentation.overlap, self._nfft)
        bin_count = bins_up_to(last_hz, self._nfft, rate_hz)
        self._frequency_hz = np.arange(bin_count) * rate_hz / self._nfft
        self._transform = LowBinTransform(self._length, self._nfft, bin_count)
        self._segments = Segments(
            3,
            self._length,
            self._length - used_segmentation.overlap,
            longest_gap_ticks=round(LONGEST_GAP_S * rate_hz),
            end_tick=record_length,
        )
        self._sums = CrossSpectra.empty(bin_count)
        self._reference_power = np.zeros(bin_count)
        self._summed_up_to = 0

    def feed(
        self, ticks: ArrayLike, reference: ArrayLike, input_: ArrayLike, output: ArrayLike
    ) -> None:
        """Add samples. The estimate does not depend on how the samples are divided into calls.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing numbers of the samples, 0 at the record's first sample. Gaps of up to
            `LONGEST_GAP_S` are interpolated; segments with a longer gap are omitted. Samples from
            before and after the record are allowed. They close gaps at its ends, and a sample from
            after the record marks the record as complete.
        reference, input_, output : array_like, shape (n,)
            Values of each tick. A tick with a value that is not finite counts as missing. No trend
            is removed. The input should be relative to its value at rest, since an offset leaks
            into the lowest bins.
        """
        for first_tick, segment in self._segments.feed(
            ticks, np.stack((reference, input_, output))
        ):
            self._add_segment(segment, self._sums, self._reference_power)
            self._summed_up_to = first_tick + self._length

    def estimate(self) -> RunningEstimate | None:
        """Return the response estimated from all samples so far; None if these are too few."""
        is_final = self._segments.over
        summed_spectra, reference_power = self._sums, self._reference_power
        newest_samples = self._segments.newest_samples(self._length)
        shortest_segment_length = self._length
        if self._is_newest_segment_used(newest_samples.shape[1], is_final):
            summed_spectra, reference_power = summed_spectra.copy(), reference_power.copy()
            self._add_segment(newest_samples, summed_spectra, reference_power)
            shortest_segment_length = newest_samples.shape[1]
        if summed_spectra.segments == 0:
            return None
        response = summed_spectra.response(self._frequency_hz, "h1")
        if self._sums.segments < 2:
            # The newest samples overlap the one segment: averaged with itself, all is coherent.
            response = replace(response, coherence=None)
        return RunningEstimate(
            response=response,
            is_excited=excited_bins(reference_power, -(-self._nfft // shortest_segment_length)),
            is_final=is_final,
        )

    def _is_newest_segment_used(self, newest_count: int, is_final: bool) -> bool:
        """Return whether the newest samples count as a segment in addition to whole segments."""
        if self._segments.end == self._summed_up_to or (is_final and self._sums.segments):
            return False
        return newest_count >= MIN_SEGMENT_FRACTION * self._length

    def _add_segment(
        self,
        segment: NDArray[np.float64],
        summed_spectra: CrossSpectra,
        reference_power: NDArray[np.float64],
    ) -> None:
        """Add a segment (3, n) of reference, input and output to the two sums, in place."""
        weights = WINDOW.weights(segment.shape[1])
        reference, input_, output = segment
        # The mean angle excites nothing, but its power would exceed that of the motion.
        reference_deviation = reference - np.average(reference, weights=weights)
        reference_power += power(self._transform(reference_deviation * weights))
        summed_spectra.add(self._transform(input_ * weights), self._transform(output * weights))


# Segments of a growing record

LONGEST_GAP_S: Final = 0.1
"""Longest gap in seconds that is interpolated linearly. Segments with a longer gap are omitted."""


class Segments:
    """Splitter of samples that arrive in blocks of any length into segments of equal length.

    Segment k begins at tick ``k * hop_ticks``. Gaps of at most `longest_gap_ticks` missing ticks
    are interpolated. There are `channel_count` values per tick. `end_tick` is the first tick after
    the record. Samples outside the record, before tick 0 or from this tick on, are only used to
    close gaps at the ends of the record.

    Attributes
    ----------
    end : int
        Tick after the newest sample of the record.
    over : bool
        Whether the record's last sample or a later one has arrived.
    """

    def __init__(
        self,
        channel_count: int,
        segment_length: int,
        hop_ticks: int,
        *,
        longest_gap_ticks: int,
        end_tick: int | None = None,
    ) -> None:
        self.end = 0
        self.over = False
        self._length, self._hop = segment_length, hop_ticks
        self._limit = end_tick
        self._gaps = _GapFiller(longest_gap_ticks)
        # The newest samples are the columns from `_used - available` to `_used`; when the array is
        # full, those that may still be needed move to the front.
        self._buffer = np.empty((channel_count, 3 * segment_length))
        self._used = 0
        self._available = 0
        self._next = 0

    def feed(self, ticks: ArrayLike, channel_values: ArrayLike) -> Iterator[tuple[int, RealArray]]:
        """Add samples and yield the first tick and the values of each segment that they complete.

        The samples have increasing numbers, also from call to call, and values of the shape
        (channels, n). A tick with a value that is not finite counts as missing.

        A segment, shape (channels, length), is a view of the internal array. It must be used before
        the next one is requested, which overwrites it. The iteration must be consumed completely,
        because it adds the samples.
        """
        for first_tick, sample_block in self._gaps.fill(ticks, channel_values):
            block_start, end_tick = max(first_tick, 0), first_tick + sample_block.shape[1]
            if self._limit is not None:
                self.over = end_tick >= self._limit
                end_tick = min(end_tick, self._limit)
            if block_start < end_tick:
                yield from self._add_block(
                    block_start, sample_block[:, block_start - first_tick : end_tick - first_tick]
                )

    def newest_samples(self, max_samples: int) -> RealArray:
        """Return the newest samples without a gap, shape (channels, n), at most `max_samples`.

        The array is a view of the internal array.
        """
        return self._buffer[:, self._used - min(max_samples, self._available) : self._used]

    def _add_block(
        self, first_tick: int, sample_block: RealArray
    ) -> Iterator[tuple[int, RealArray]]:
        """Add samples without gaps; yield the first tick and the data of each complete segment."""
        if first_tick != self.end:
            self.end = first_tick
            self._available = 0
            self._next = -(-first_tick // self._hop) * self._hop
        added_count = 0
        while added_count < sample_block.shape[1]:
            segment_end = self._next + self._length
            block_part = sample_block[
                :, added_count : added_count + min(segment_end - self.end, self._length)
            ]
            added_count += block_part.shape[1]
            self._append_samples(block_part)
            if self.end == segment_end:
                yield self._next, self.newest_samples(self._length)
                self._next += self._hop

    def _append_samples(self, new_samples: RealArray) -> None:
        """Append samples to the internal array, which stores at least the newest segment."""
        new_count = new_samples.shape[1]
        if self._used + new_count > self._buffer.shape[1]:
            newest_samples = self.newest_samples(self._length)
            self._buffer[:, : newest_samples.shape[1]] = newest_samples
            self._used = newest_samples.shape[1]
        self._buffer[:, self._used : self._used + new_count] = new_samples
        self._used += new_count
        self._available = min(self._available + new_count, self._length)
        self.end += new_count


class _GapFiller:
    """Filler of gaps in blocks of samples: short gaps are interpolated, long gaps split a block."""

    def __init__(self, max_gap_ticks: int) -> None:
        self._longest = max_gap_ticks
        self._last: tuple[NDArray[np.int64], RealArray] | None = None

    def fill(self, ticks: ArrayLike, channel_values: ArrayLike) -> Iterator[tuple[int, RealArray]]:
        """Yield blocks without gaps: their first tick and their values (channels, n)."""
        known_ticks = np.asarray(ticks, dtype=np.int64)
        known_values = np.asarray(channel_values, dtype=np.float64)
        is_known = np.isfinite(known_values).all(axis=0)
        if not is_known.all():
            known_ticks, known_values = known_ticks[is_known], known_values[:, is_known]
        if known_ticks.size == 0:
            return
        last_sample = self._last
        if last_sample is None and 0 < known_ticks[0] <= self._longest:
            # There is nothing from which to interpolate: the first values are held.
            known_ticks = np.concatenate(([0], known_ticks))
            known_values = np.concatenate((known_values[:, :1], known_values), axis=1)
        elif last_sample is not None:
            known_ticks = np.concatenate((last_sample[0], known_ticks))
            known_values = np.concatenate((last_sample[1], known_values), axis=1)
        self._last = known_ticks[-1:].copy(), known_values[:, -1:].copy()
        block_starts = 1 + np.flatnonzero(np.diff(known_ticks) > self._longest + 1)
        for block_start, block_end in pairwise([0, *block_starts, known_ticks.size]):
            first_tick, sample_block = _interpolate_to_ticks(
                known_ticks[block_start:block_end], known_values[:, block_start:block_end]
            )
            if block_start == 0 and last_sample is not None:  # yielded with the previous block
                first_tick, sample_block = first_tick + 1, sample_block[:, 1:]
            if sample_block.shape[1]:
                yield first_tick, sample_block


def _interpolate_to_ticks(
    known_ticks: NDArray[np.int64], known_values: RealArray
) -> tuple[int, RealArray]:
    """Return the first tick, and interpolated values at every tick from the first to the last."""
    first_tick, last_tick = int(known_ticks[0]), int(known_ticks[-1])
    if last_tick - first_tick + 1 == known_ticks.size:
        return first_tick, known_values
    all_ticks = np.arange(first_tick, last_tick + 1)
    return first_tick, np.stack(
        [np.interp(all_ticks, known_ticks, channel_values) for channel_values in known_values]
    )


# Excited bins


def excited_bins(reference_power: NDArray[np.float64], resolution_bins: int) -> NDArray[np.bool_]:
    """Return a mask of the bins in which the reference has power that does not leak from others.

    The bins of `reference_power` are those from frequency 0 on. `resolution_bins` is the frequency
    resolution, the inverse length of the shortest window. A dip that is at most twice as wide is a
    ripple of the window, and counts as excited. At each end of an excited band, `resolution_bins`
    bins are excluded because of leakage.
    """
    largest_power = reference_power.max(initial=0.0)
    if not largest_power > 0.0:
        return np.zeros(reference_power.shape, dtype=np.bool_)
    without_dips = _is_near_marked(
        reference_power > WINDOW.min_relative_power * largest_power, resolution_bins
    )
    return ~_is_near_marked(~without_dips, 2 * resolution_bins)


def _is_near_marked(is_marked: NDArray[np.bool_], distance_bins: int) -> NDArray[np.bool_]:
    """Return a mask of the bins at most `distance_bins` away from a bin of the mask `is_marked`.

    Beyond the first and the last bin, the mask is continued with the value of that bin.
    """
    marked_counts = np.cumsum(np.pad(is_marked, (distance_bins + 1, distance_bins), mode="edge"))
    is_near: NDArray[np.bool_] = (
        marked_counts[2 * distance_bins + 1 :] > marked_counts[: -2 * distance_bins - 1]
    )
    return is_near


# Lowest bins of a transform


def bins_up_to(last_hz: float, transform_length: int, rate_hz: float) -> int:
    """Return the number of bins of a transform from 0 to `last_hz`, both included."""
    # Rounding errors of the caller must not lose the last bin.
    return 1 + min(transform_length // 2, int(last_hz * transform_length / rate_hz * (1 + 1e-9)))


class LowBinTransform:
    """Fourier transform in the lowest bins: ``np.fft.rfft(x, nfft)[:bins]`` except for rounding.

    With ``2 n k = n² + k² − (k − n)²`` the sum over n becomes a convolution with a chirp, which two
    short transforms compute. For 17 266 samples padded to 160 000 the bins up to 60 Hz take a
    quarter of the time of all bins. If the padding is so short that this would take longer, all
    bins are computed.

    At most `sample_count` samples can be transformed. They are padded to `nfft` samples, at least
    `sample_count`. There are at most ``nfft // 2 + 1`` bins.
    """

    def __init__(self, sample_count: int, nfft: int, bin_count: int) -> None:
        self._bins, self._nfft = bin_count, nfft
        convolution_length = _fast_length(sample_count + bin_count - 1)
        # A real transform takes half the time of a complex one, and two of these would be needed.
        self._all = (
            np.empty(nfft // 2 + 1, dtype=np.complex128) if nfft < 4 * convolution_length else None
        )
        if self._all is not None:
            return
        n = np.arange(max(sample_count, bin_count))
        # The phase is reduced as a whole number, which is exact.
        self._chirp = np.exp(-1j * np.pi * (n * n % (2 * nfft)) / nfft)
        chirp_kernel = np.zeros(convolution_length, dtype=np.complex128)
        chirp_kernel[:bin_count] = self._chirp[:bin_count].conj()
        chirp_kernel[convolution_length - sample_count + 1 :] = self._chirp[
            sample_count - 1 : 0 : -1
        ].conj()
        self._kernel = np.fft.fft(chirp_kernel)
        # Allocated once, because allocating this much memory again is slow.
        self._work = np.empty(convolution_length, dtype=np.complex128)
        self._transform = np.empty(convolution_length, dtype=np.complex128)

    def __call__(self, samples: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the lowest bins (bins,) of the transform of samples (n,), as a new array."""
        if self._all is not None:
            return np.fft.rfft(samples, self._nfft, out=self._all)[: self._bins].copy()
        self._work[samples.size :] = 0.0
        np.multiply(samples, self._chirp[: samples.size], out=self._work[: samples.size])
        np.fft.fft(self._work, out=self._transform)
        self._transform *= self._kernel
        np.fft.ifft(self._transform, out=self._work)
        lowest_bins: NDArray[np.complex128] = self._work[: self._bins] * self._chirp[: self._bins]
        return lowest_bins


def _fast_length(min_length: int) -> int:
    """Return the smallest length of at least `min_length` that has no prime factor above 5."""
    best_length = 1 << (min_length - 1).bit_length()
    power_of_five = 1
    while power_of_five < best_length:
        odd_factor = power_of_five
        while odd_factor < best_length:
            best_length = min(
                best_length, odd_factor << (-(-min_length // odd_factor) - 1).bit_length()
            )
            odd_factor *= 3
        power_of_five *= 5
    return best_length
