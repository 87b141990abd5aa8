"""A record that comes in blocks, with ticks missing, cut into evenly spaced segments."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Real = NDArray[np.float64]

LONGEST_GAP_S: Final = 0.1
"""Longest gap that is interpolated linearly; a segment with a longer one is left out."""


class Segments:
    """Segments of equal length, whatever blocks the samples come in.

    Segment k begins at tick ``k * hop``.

    Parameters
    ----------
    channels : int
        Values a tick.
    length, hop : int
        Of a segment, and from the start of one to that of the next, in ticks.
    longest_gap : int
        Most missing ticks in a row that are interpolated.
    end : int, optional
        Tick before which the record ends. What lies outside the record, before tick 0 or from here
        on, is used for nothing but to close a gap at its edge.

    Attributes
    ----------
    end : int
        Tick after the newest sample of the record.
    over : bool
        Whether a sample has come that is the record's last or later.
    """

    def __init__(
        self, channels: int, length: int, hop: int, *, longest_gap: int, end: int | None = None
    ) -> None:
        self.end = 0
        self.over = False
        self._length, self._hop = length, hop
        self._limit = end
        self._gaps = _GapFilling(longest_gap)
        # The newest samples are the columns from `_used - stretch` to `_used`; when the room is
        # used up, those that may still be needed move to the front.
        self._room = np.empty((channels, 3 * length))
        self._used = 0
        self._stretch = 0
        self._next = 0

    def feed(self, ticks: ArrayLike, values: ArrayLike) -> Iterator[tuple[int, Real]]:
        """Take samples and hand out, one by one, the segments they complete.

        A segment has to be used before the next is asked for, and the iteration has to be carried
        to its end: it is what takes the samples.

        Parameters
        ----------
        ticks : array_like of int, shape (n,)
            Increasing, also from call to call.
        values : array_like, shape (channels, n)
            A tick with a value that is not finite counts as missing.

        Yields
        ------
        first : int
            Tick the segment begins at.
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
        return self._room[:, self._used - min(most, self._stretch) : self._used]

    def _take(self, first: int, block: Real) -> Iterator[tuple[int, Real]]:
        """Take a block without gaps."""
        if first != self.end:
            self.end = first
            self._stretch = 0
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
            kept = self.newest(self._length)
            self._room[:, : kept.shape[1]] = kept
            self._used = kept.shape[1]
        self._room[:, self._used : self._used + count] = part
        self._used += count
        self._stretch = min(self._stretch + count, self._length)
        self.end += count


class _GapFilling:
    """Interpolates across short gaps, and tells of long ones by a jump of the tick."""

    def __init__(self, longest_gap: int) -> None:
        self._longest = longest_gap
        self._last: tuple[NDArray[np.int64], Real] | None = None

    def fill(self, ticks: ArrayLike, values: ArrayLike) -> Iterator[tuple[int, Real]]:
        """Hand out blocks without gaps: their first tick, and the values (channels, n)."""
        known_ticks = np.asarray(ticks, dtype=np.int64)
        known = np.asarray(values, dtype=np.float64)
        is_known = np.isfinite(known).all(axis=0)
        if not is_known.all():
            known_ticks, known = known_ticks[is_known], known[:, is_known]
        if known_ticks.size == 0:
            return
        last = self._last
        if last is None and 0 < known_ticks[0] <= self._longest:
            # There is nothing to interpolate from: the first values are held.
            known_ticks = np.concatenate(([0], known_ticks))
            known = np.concatenate((known[:, :1], known), axis=1)
        elif last is not None:
            known_ticks = np.concatenate((last[0], known_ticks))
            known = np.concatenate((last[1], known), axis=1)
        self._last = known_ticks[-1:].copy(), known[:, -1:].copy()
        breaks = 1 + np.flatnonzero(np.diff(known_ticks) > self._longest + 1)
        for start, stop in pairwise([0, *breaks, known_ticks.size]):
            first, block = _interpolated(known_ticks[start:stop], known[:, start:stop])
            if start == 0 and last is not None:  # handed out when it came
                first, block = first + 1, block[:, 1:]
            if block.shape[1]:
                yield first, block


def _interpolated(ticks: NDArray[np.int64], values: Real) -> tuple[int, Real]:
    """Return the first tick, and the values on every tick from the first to the last."""
    first, last = int(ticks[0]), int(ticks[-1])
    if last - first + 1 == ticks.size:
        return first, values
    every = np.arange(first, last + 1)
    return first, np.stack([np.interp(every, ticks, channel) for channel in values])
