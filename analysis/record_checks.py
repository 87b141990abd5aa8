"""What makes a session unfit for analysis, found before anything is computed of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MAX_UNKNOWN_SHARE = 0.05
"""Largest share of angle or torque that may be missing or flagged: one limit for import, loading
and estimation. Whole-record fits stand so much of it (within their own uncertainty at 4.5 %)."""

MAX_GAP_S = 0.1
"""Longest single gap in the sweep that is interpolated; a longer one is refused."""

MAX_SPAN = 10
"""Most ticks per recorded sample: a file with next to no samples in its span would only fill the
memory, and no sweep in it could be analysed."""

MAX_TICKS = 2_400_000
"""Longest record: 40 minutes at 1 kHz. An analysis was measured to take 0.29 kB a sample beside
0.16 GB (0.53 GB for 1.27 million), and is to do with 1 GB."""

MAX_VALUE = 1e9
"""Largest angle in rad, or torque in N·m: squares of what is far beyond would overflow."""

MAX_CLOCK_ERROR = 1e-3
"""Largest relative difference between the rate stated and the rate of the time stamps."""


class RecordError(ValueError):
    """A session that was read but cannot be analysed; the message names file, cause and remedy."""


def check_span(path: Path, ticks: NDArray[np.int64]) -> None:
    """Refuse a span of ticks that is all but empty, or too long."""
    span = int(ticks[-1] - ticks[0]) + 1
    if span > MAX_SPAN * len(ticks):
        raise RecordError(
            f"{path}: only {len(ticks)} of the {span} ticks from {ticks[0]} to {ticks[-1]} have a "
            "sample, too few to analyse; record the session again."
        )
    if span > MAX_TICKS:
        raise RecordError(
            f"{path}: the record spans {span} ticks, and no more than {MAX_TICKS} fit into the "
            "memory that an analysis may take; record shorter sessions, which can be analysed "
            "together."
        )


def check_clock(
    path: Path, ticks: NDArray[np.int64], t_ns: NDArray[np.int64], rate_hz: float
) -> None:
    """Refuse time stamps that run backwards or contradict the rate."""
    if len(ticks) < 2:
        return
    # Compared, not subtracted: a difference of what a file states may overflow.
    back = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
    if back.size:
        place = int(back[0])
        raise RecordError(
            f"{path}: the time stamp t_ns goes from {t_ns[place]} ns at tick {ticks[place]} to "
            f"{t_ns[place + 1]} ns at tick {ticks[place + 1]}, but time must go forward; it does "
            f"not at {back.size} of {len(ticks)} samples. Whoever writes the file must correct it."
        )
    elapsed_ns = max(int(t_ns[-1]) - int(t_ns[0]), 1)
    rate_of_stamps_hz = 1e9 * int(ticks[-1] - ticks[0]) / elapsed_ns
    if abs(rate_of_stamps_hz / rate_hz - 1.0) > MAX_CLOCK_ERROR:
        raise RecordError(
            f"{path}: rate_hz is {rate_hz:g} Hz, but the time stamps t_ns advance at "
            f"{rate_of_stamps_hz:g} ticks per second; correct whichever is wrong."
        )


def check_finite(
    path: Path, field: str, values: NDArray[np.float64], ticks: NDArray[np.int64]
) -> None:
    """Refuse values that are not finite, or that no rig has."""
    large = np.flatnonzero(np.abs(values) > MAX_VALUE)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise RecordError(
            f"{path}: {field} is {values[bad[0]]} at tick {ticks[bad[0]]} and not finite in "
            f"{bad.size} of {len(values)} samples; no estimate is made from such a record."
        )
    if large.size:
        raise RecordError(
            f"{path}: {field} is {values[large[0]]:g} at tick {ticks[large[0]]} and beyond "
            f"±{MAX_VALUE:g} in {large.size} of {len(values)} samples; no rig has such values, "
            "correct whatever wrote the file."
        )


def check_sensor(path: Path, torque_nm: NDArray[np.float64]) -> None:
    """Refuse a torque that is one and the same throughout: noise alone would move it."""
    if torque_nm.size > 1 and np.ptp(torque_nm) == 0.0:
        raise RecordError(
            f"{path}: coupling_torque_nm is {torque_nm[0]:g} N·m in every sample, so the sensor "
            "gave nothing; check its connection and record the session again."
        )


def check_fillable(
    path: Path, channel: str, unknown: NDArray[np.bool_], first_tick: int, rate_hz: float
) -> None:
    """Refuse a channel of the sweep of which too much, or too much at once, would be filled in.

    Parameters
    ----------
    path : Path
    channel : str
        What messages call it.
    unknown : ndarray of bool, shape (n,)
        Samples of the sweep without a value of their own.
    first_tick : int
        Of the sweep.
    rate_hz : float
    """
    much = too_much_unknown(f"the {channel} in the sweep", int(unknown.sum()), len(unknown))
    if much:
        raise RecordError(f"{path}: {much}")
    run, start = longest_run(unknown)
    if run > MAX_GAP_S * rate_hz:
        raise RecordError(
            f"{path}: {run} ticks of the {channel} in a row are missing or stale from tick "
            f"{first_tick + start} on ({1e3 * run / rate_hz:.0f} ms), longer than the "
            f"{1e3 * MAX_GAP_S:g} ms that are interpolated; record the session again."
        )


def too_much_unknown(what: str, unknown: int, of: int) -> str | None:
    """Say that more than `MAX_UNKNOWN_SHARE` of a channel is unknown; None if it is not.

    Parameters
    ----------
    what : str
        The channel, as the message calls it.
    unknown, of : int
        Samples without a value of their own, and all.
    """
    if unknown <= MAX_UNKNOWN_SHARE * of:
        return None
    return (
        f"{unknown} of {of} samples ({100 * unknown / of:.2g} %) of {what} are missing or flagged, "
        f"more than the {100 * MAX_UNKNOWN_SHARE:g} % that an analysis tolerates; record the "
        "session again."
    )


def longest_run(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Length and start of the longest run of True, (0, 0) without any."""
    edges = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if starts.size == 0:
        return 0, 0
    longest = int(np.argmax(ends - starts))
    return int(ends[longest] - starts[longest]), int(starts[longest])
