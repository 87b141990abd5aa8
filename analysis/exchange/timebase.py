"""From time stamps to ticks: samples are equidistant in a session, and gaps are missing ticks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange.errors import ExchangeError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MAX_JITTER: Final = 0.1
"""Largest distance of a time stamp from its tick, in periods.

Held against the tick nearest to it, a stamp that is off by more makes the sample's place doubtful.
"""

MAX_SPAN: Final = 10
"""Most ticks for each sample, as for the analysis: beyond that there is more gap than record."""

MAX_GAPS: Final = 0.05
"""Largest share of steps from sample to sample that are longer than a tick. Where it is more, the
times are written too coarsely to tell the rate: milliseconds of a record at 700 Hz, say."""

RATES_HZ: Final = (0.1, 1e6)
"""Rates that a session may have."""

_RATE_DIGITS: Final = 9
"""Digits to which time stamps tell a rate: 1000 is meant where 1000.0000000002 is met."""


@dataclass(frozen=True, slots=True)
class Timebase:
    """Places of the samples.

    Attributes
    ----------
    ticks : ndarray of int, shape (n,)
        From 0 on, increasing.
    rate_hz : float
        Ticks per second.
    jitter : float
        Largest distance of a time stamp from its tick, in periods.
    """

    ticks: NDArray[np.int64]
    rate_hz: float
    jitter: float

    @property
    def missing(self) -> int:
        """Ticks between the first and the last that have no sample."""
        return int(self.ticks[-1]) + 1 - len(self.ticks)


def uniform(path: Path, samples: int, rate_hz: float) -> Timebase:
    """Place samples without a gap, at the rate that the user states."""
    _check_rate(path, rate_hz)
    return Timebase(np.arange(samples), rate_hz, 0.0)


def from_time_stamps(path: Path, channel: str, time_s: NDArray[np.float64]) -> Timebase:
    """Find the rate and the tick of each sample from its time.

    Parameters
    ----------
    path : Path
        For messages.
    channel : str
        Name of the channel of times, for messages.
    time_s : ndarray of float, shape (n,)
        n at least 2.

    Raises
    ------
    ExchangeError
        If times are not finite, do not increase, or are not equidistant apart from gaps.
    """
    stray = np.flatnonzero(~np.isfinite(time_s))
    if stray.size:
        raise ExchangeError(
            f"{path}: the time '{channel}' of sample {stray[0] + 1} is {time_s[stray[0]]}, so its "
            "place is unknown; repair the times, or give --rate-hz instead of --time if no sample "
            "is missing."
        )
    steps_s = np.diff(time_s)
    backward = np.flatnonzero(steps_s <= 0.0)
    if backward.size:
        first = int(backward[0])
        raise ExchangeError(
            f"{path}: the time '{channel}' does not increase from sample {first + 1} "
            f"({time_s[first]:.9g} s) to sample {first + 2} ({time_s[first + 1]:.9g} s); repair "
            "the times, or give --rate-hz instead of --time if the samples are equidistant."
        )
    # The median tells a step of one tick from a gap; the mean over all such steps is not at the
    # mercy of how finely the file writes its times, as the median itself is.
    single = steps_s < 1.5 * np.median(steps_s)
    steps = np.round(steps_s / steps_s[single].mean())
    gaps = np.count_nonzero(steps > 1) / len(steps)
    if gaps > MAX_GAPS:
        raise ExchangeError(
            f"{path}: the times '{channel}' advance unevenly, by {steps_s.min():.6g} to "
            f"{steps_s.max():.6g} s: {100 * gaps:.2g} % of the steps would be gaps. Write the "
            "times with more digits, resample the record to one rate, or give --rate-hz instead of "
            "--time if the samples are equidistant."
        )
    ticks = np.concatenate(([0.0], np.cumsum(steps)))
    if ticks[-1] + 1 > MAX_SPAN * len(ticks):
        raise ExchangeError(
            f"{path}: the times '{channel}' of the {len(ticks)} samples span {ticks[-1] + 1:.0f} "
            "periods, so most of the record is missing; cut the session out of the file."
        )
    period_s = _slope(ticks, time_s)
    rate_hz = float(f"{1 / period_s:.{_RATE_DIGITS}g}")
    _check_rate(path, rate_hz)
    deviation = (time_s - time_s[0]) * rate_hz - ticks
    deviation = np.abs(deviation - np.median(deviation))
    worst = int(np.argmax(deviation))
    if deviation[worst] > MAX_JITTER:
        raise ExchangeError(
            f"{path}: the times '{channel}' are not equidistant: sample {worst + 1} lies "
            f"{deviation[worst]:.2g} periods from where {rate_hz:g} Hz would have it. Resample the "
            "record to one rate, or give --rate-hz instead of --time if only the stamps are off."
        )
    return Timebase(ticks.astype(np.int64), rate_hz, float(deviation[worst]))


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Slope of the straight line through points, by least squares."""
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / (x @ x))


def _check_rate(path: Path, rate_hz: float) -> None:
    lowest_hz, highest_hz = RATES_HZ
    if not lowest_hz <= rate_hz <= highest_hz:
        raise ExchangeError(
            f"{path}: a rate of {rate_hz:g} Hz is none of a session, which are {lowest_hz:g} to "
            f"{highest_hz:g} Hz; check the unit of the time."
        )
