"""Segments of a record, and the frequency of a sweep in them."""

from collections.abc import Mapping


def segments_until(segments: Mapping[str, tuple[int, int]], end: int) -> dict[str, tuple[int, int]]:
    """Cut segments off at a tick; those that begin there or later are left out.

    Parameters
    ----------
    segments : mapping of str to (int, int)
        Name → first tick and end (exclusive).
    end : int
        First tick that is left out.
    """
    return {
        name: (first, min(last, end)) for name, (first, last) in segments.items() if first < end
    }


def sweep_frequency_hz(
    segments: Mapping[str, tuple[int, int]], ends_hz: tuple[float, float], tick: int
) -> float | None:
    """Return the frequency of a linear sweep at a tick; None before and after it.

    Parameters
    ----------
    segments : mapping of str to (int, int)
        ``sweep`` → first tick and end (exclusive); of a sweep there and back, ``there`` and
        ``back``.
    ends_hz : tuple of float
        Frequencies at the start and at the end of the (first) sweep.
    tick : int
        Tick of the record.

    Examples
    --------
    >>> from rigd.session import sweep_frequency_hz
    >>> both = {"sweep": (0, 200), "there": (0, 100), "back": (100, 200)}
    >>> [sweep_frequency_hz(both, (0.0, 50.0), tick) for tick in (50, 150, 200)]
    [25.0, 25.0, None]
    """
    start_hz, stop_hz = ends_hz
    there = segments.get("there", segments["sweep"])
    for (first, end), begin_hz, end_hz in (
        (there, start_hz, stop_hz),
        (segments.get("back", (0, 0)), stop_hz, start_hz),
    ):
        if first <= tick < end:
            return begin_hz + (end_hz - begin_hz) * (tick - first) / (end - first)
    return None
