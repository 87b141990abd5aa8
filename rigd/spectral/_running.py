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

Real = NDArray[np.float64]

LEAST_FRACTION: Final = 0.25
"""Least fraction of a segment for an estimate: shorter ones have too little resolution."""


@dataclass(frozen=True, slots=True)
class RunningEstimate:
    """Estimate of a response so far.

    Attributes
    ----------
    response : FrequencyResponse
        Response; its coherence is None until there are two whole segments.
    excited : ndarray of bool, shape (n,)
        Bins of the response that the reference has excited; elsewhere it shows noise and leakage.

    final : bool
        Whether the record is complete; then this is the estimate of `welch_response`.
    """

    response: FrequencyResponse
    excited: NDArray[np.bool_]
    final: bool


class RunningResponse:
    """H1 estimate of a growing record; at its end equal to `welch_response`, except for rounding.

    Whole segments are averaged as in Welch's method, each with a Hamming window. Until the end the
    newest samples, at most a segment of them, count as one more segment with its own window length:
    the response then includes the newest part of the record.

    Parameters
    ----------
    rate_hz : float
        Sampling rate.
    samples : int
        Length of the whole record.
    last_hz : float
        Highest frequency of the response.
    segmentation : Segmentation, optional
        By default from `segmentation_of` for that length.

    Raises
    ------
    SpectralError
        If the lengths of the segmentation are inconsistent.
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
        """Add samples; the result does not depend on their number per call.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing, 0 at the record's first sample. Gaps of up to `LONGEST_GAP_S` are
            interpolated, segments with a longer one left out. Samples from before and after the
            record are allowed too: they close gaps at its ends, and one from after it marks it as
            complete.
        reference, input_, output : array_like, shape (n,)
            A tick with a value that is not finite counts as missing. No trend is removed: the input
            should be relative to its value at rest, since an offset leaks into the lowest bins.
        """
        for first, segment in self._segments.feed(ticks, np.stack((reference, input_, output))):
            self._add(segment, self._sums, self._reference_power)
            self._summed_up_to = first + self._length

    def estimate(self) -> RunningEstimate | None:
        """Return the estimate from the samples so far; None while these are too few."""
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
        """Return whether the newest samples count in addition to the whole segments."""
        if self._segments.end == self._summed_up_to or (final and self._sums.segments):
            return False
        return newest >= LEAST_FRACTION * self._length

    def _add(
        self,
        segment: NDArray[np.float64],
        sums: CrossSpectra,
        reference_power: NDArray[np.float64],
    ) -> None:
        """Add a segment (3, n) of reference, input and output to the sums."""
        window = np.hamming(segment.shape[1])
        reference, input_, output = segment
        # The mean angle excites nothing, but its power would exceed that of the motion.
        moving = reference - np.average(reference, weights=window)
        reference_power += power(self._transform(moving * window))
        sums.add(self._transform(input_ * window), self._transform(output * window))


# Segments of a growing record

LONGEST_GAP_S: Final = 0.1
"""Longest gap that is interpolated linearly; a segment with a longer one is left out."""


class Segments:
    """Segments of equal length from blocks of any length.

    Segment k begins at tick ``k * hop``.

    Parameters
    ----------
    channels : int
        Values per tick.
    length, hop : int
        Length of a segment, and distance from its start to the next one's, in ticks.
    longest_gap : int
        Longest run of missing ticks that is interpolated.
    end : int, optional
        Tick before which the record ends. Samples outside the record, before tick 0 or from here
        on, only close a gap at its edge.

    Attributes
    ----------
    end : int
        Tick after the newest sample of the record.
    over : bool
        Whether a sample has arrived that is the record's last or later.
    """

    def __init__(
        self, channels: int, length: int, hop: int, *, longest_gap: int, end: int | None = None
    ) -> None:
        self.end = 0
        self.over = False
        self._length, self._hop = length, hop
        self._limit = end
        self._gaps = _GapFilling(longest_gap)
        # The newest samples are the columns from `_used - available` to `_used`; when the array is
        # full, those that may still be needed move to the front.
        self._room = np.empty((channels, 3 * length))
        self._used = 0
        self._available = 0
        self._next = 0

    def feed(self, ticks: ArrayLike, values: ArrayLike) -> Iterator[tuple[int, Real]]:
        """Add samples and yield the segments that they complete, one by one.

        Use a segment before the next one, which overwrites it, and consume the whole iteration,
        which adds the samples.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing, also from call to call.
        values : array_like, shape (channels, n)
            A tick with a value that is not finite counts as missing.

        Yields
        ------
        first : int
            First tick of the segment.
        segment : ndarray of float, shape (channels, length)
            A view.
        """
        for first, block in self._gaps.fill(ticks, values):
            start, stop = max(first, 0), first + block.shape[1]
            if self._limit is not None:
                self.over = stop >= self._limit
                stop = min(stop, self._limit)
            if start < stop:
                yield from self._take(start, block[:, start - first : stop - first])

    def newest(self, most: int) -> Real:
        """Return the newest samples (channels, n) without a gap, at most so many; a view."""
        return self._room[:, self._used - min(most, self._available) : self._used]

    def _take(self, first: int, block: Real) -> Iterator[tuple[int, Real]]:
        """Add a block without gaps."""
        if first != self.end:
            self.end = first
            self._available = 0
            self._next = -(-first // self._hop) * self._hop
        taken = 0
        while taken < block.shape[1]:
            due = self._next + self._length
            part = block[:, taken : taken + min(due - self.end, self._length)]
            taken += part.shape[1]
            self._append(part)
            if self.end == due:
                yield self._next, self.newest(self._length)
                self._next += self._hop

    def _append(self, part: Real) -> None:
        """Add samples to the newest, at most a segment of them."""
        count = part.shape[1]
        if self._used + count > self._room.shape[1]:
            newest = self.newest(self._length)
            self._room[:, : newest.shape[1]] = newest
            self._used = newest.shape[1]
        self._room[:, self._used : self._used + count] = part
        self._used += count
        self._available = min(self._available + count, self._length)
        self.end += count


class _GapFilling:
    """Interpolates short gaps, and shows long ones as a jump of the tick."""

    def __init__(self, longest_gap: int) -> None:
        self._longest = longest_gap
        self._last: tuple[NDArray[np.int64], Real] | None = None

    def fill(self, ticks: ArrayLike, values: ArrayLike) -> Iterator[tuple[int, Real]]:
        """Yield blocks without gaps: their first tick, and the values (channels, n)."""
        known_ticks = np.asarray(ticks, dtype=np.int64)
        known = np.asarray(values, dtype=np.float64)
        is_known = np.isfinite(known).all(axis=0)
        if not is_known.all():
            known_ticks, known = known_ticks[is_known], known[:, is_known]
        if known_ticks.size == 0:
            return
        last = self._last
        if last is None and 0 < known_ticks[0] <= self._longest:
            # There is nothing from which to interpolate: the first values are held.
            known_ticks = np.concatenate(([0], known_ticks))
            known = np.concatenate((known[:, :1], known), axis=1)
        elif last is not None:
            known_ticks = np.concatenate((last[0], known_ticks))
            known = np.concatenate((last[1], known), axis=1)
        self._last = known_ticks[-1:].copy(), known[:, -1:].copy()
        breaks = 1 + np.flatnonzero(np.diff(known_ticks) > self._longest + 1)
        for start, stop in pairwise([0, *breaks, known_ticks.size]):
            first, block = _interpolated(known_ticks[start:stop], known[:, start:stop])
            if start == 0 and last is not None:  # yielded with the previous block
                first, block = first + 1, block[:, 1:]
            if block.shape[1]:
                yield first, block


def _interpolated(ticks: NDArray[np.int64], values: Real) -> tuple[int, Real]:
    """Return the first tick, and interpolated values on every tick up to the last."""
    first, last = int(ticks[0]), int(ticks[-1])
    if last - first + 1 == ticks.size:
        return first, values
    every = np.arange(first, last + 1)
    return first, np.stack([np.interp(every, ticks, channel) for channel in values])


# Excited bins

LEAST_POWER: Final = 2e-3
"""Least power of an excited bin, relative to the largest.

Above the leakage of a Hamming window (−43 dB in its side lobes, and its pedestal of 0.08 where the
record ends in mid-chirp), below the power of a chirp where two of the paper's segments join
(−15 dB).
"""


def excited_bins(power: NDArray[np.float64], resolution_bins: int) -> NDArray[np.bool_]:
    """Return the bins with power of the reference itself, not leaked from their neighbours.

    Parameters
    ----------
    power : ndarray of float, shape (n,)
        Power of the reference, on bins from frequency 0 on.
    resolution_bins : int
        Bins per inverse length of the shortest window of the power. A dip no wider than twice that
        is a ripple of the window and counts as excited; at either end of a band so many bins are
        excluded because of leakage.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    largest = power.max(initial=0.0)
    if not largest > 0.0:
        return np.zeros(power.shape, dtype=np.bool_)
    closed = _any_near(power > LEAST_POWER * largest, resolution_bins)
    return ~_any_near(~closed, 2 * resolution_bins)


def _any_near(marked: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return whether any bin within the reach is marked, with constant continuation at the ends."""
    counts = np.cumsum(np.pad(marked, (reach + 1, reach), mode="edge"))
    near: NDArray[np.bool_] = counts[2 * reach + 1 :] > counts[: -2 * reach - 1]
    return near


# Lowest bins of a transform


def bins_up_to(last_hz: float, nfft: int, rate_hz: float) -> int:
    """Return the number of bins of a transform from 0 to a frequency, included."""
    # Rounding errors of the caller must not lose the last bin.
    return 1 + min(nfft // 2, int(last_hz * nfft / rate_hz * (1 + 1e-9)))


class LowBins:
    """Transform that equals ``np.fft.rfft(x, nfft)[:bins]`` to rounding.

    With ``2 n k = n² + k² − (k − n)²`` the sum over n becomes a convolution with a chirp, computed
    by two short transforms. For 17 266 samples padded to 160 000 the bins up to 60 Hz take a
    quarter of the time of all bins. With so little padding that it would take longer, all bins are
    computed.

    Parameters
    ----------
    length : int
        Largest number of samples.
    nfft : int
        Length of the padded transform, at least `length`.
    bins : int
        Number of bins, from frequency 0 on; at most ``nfft // 2 + 1``.
    """

    def __init__(self, length: int, nfft: int, bins: int) -> None:
        self._bins, self._nfft = bins, nfft
        size = _fast_length(length + bins - 1)
        # A real transform takes half the time of a complex one, of which there would be two.
        self._all = np.empty(nfft // 2 + 1, dtype=np.complex128) if nfft < 4 * size else None
        if self._all is not None:
            return
        n = np.arange(max(length, bins))
        # The phase is reduced as a whole number, which is exact.
        self._chirp = np.exp(-1j * np.pi * (n * n % (2 * nfft)) / nfft)
        kernel = np.zeros(size, dtype=np.complex128)
        kernel[:bins] = self._chirp[:bins].conj()
        kernel[size - length + 1 :] = self._chirp[length - 1 : 0 : -1].conj()
        self._kernel = np.fft.fft(kernel)
        # Allocated once, because allocating this much memory again is slow.
        self._work = np.empty(size, dtype=np.complex128)
        self._transform = np.empty(size, dtype=np.complex128)

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Transform the samples (n,) into a new array (bins,)."""
        if self._all is not None:
            return np.fft.rfft(x, self._nfft, out=self._all)[: self._bins].copy()
        self._work[x.size :] = 0.0
        np.multiply(x, self._chirp[: x.size], out=self._work[: x.size])
        np.fft.fft(self._work, out=self._transform)
        self._transform *= self._kernel
        np.fft.ifft(self._transform, out=self._work)
        low: NDArray[np.complex128] = self._work[: self._bins] * self._chirp[: self._bins]
        return low


def _fast_length(least: int) -> int:
    """Return the smallest length of at least `least` without a prime factor above 5."""
    best = 1 << (least - 1).bit_length()
    fives = 1
    while fives < best:
        odd = fives
        while odd < best:
            best = min(best, odd << (-(-least // odd) - 1).bit_length())
            odd *= 3
        fives *= 5
    return best
