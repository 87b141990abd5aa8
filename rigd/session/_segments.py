"""Segments of a record, and the frequency of a linear sweep at a tick."""

from collections.abc import Mapping


def segments_until(
    segments: Mapping[str, tuple[int, int]], first_excluded_tick: int
) -> dict[str, tuple[int, int]]:
    """Return the segments of a record cut to the part before a tick.

    Segments that begin at the tick or later are omitted.

    Parameters
    ----------
    segments : mapping of str to (int, int)
        Segment name → first tick and end tick (exclusive).
    first_excluded_tick : int
        First tick that no longer belongs to the record.
    """
    return {
        segment_name: (first_tick, min(end_tick, first_excluded_tick))
        for segment_name, (first_tick, end_tick) in segments.items()
        if first_tick < first_excluded_tick
    }


def sweep_frequency_hz(
    segments: Mapping[str, tuple[int, int]], start_and_end_hz: tuple[float, float], tick: int
) -> float | None:
    """Return the frequency of a linear sweep at a tick, or None before and after the sweep.

    Parameters
    ----------
    segments : mapping of str to (int, int)
        ``sweep`` → first tick and end tick (exclusive). If the sweep returns to its start
        frequency, also ``there`` for its first half and ``back`` for its second half.
    start_and_end_hz : tuple of float
        Frequencies in Hz at the start and the end of the sweep, or of its first half.
    tick : int
        Tick of the record.

    Examples
    --------
    >>> from rigd.session import sweep_frequency_hz
    >>> both = {"sweep": (0, 200), "there": (0, 100), "back": (100, 200)}
    >>> [sweep_frequency_hz(both, (0.0, 50.0), tick) for tick in (50, 150, 200)]
    [25.0, 25.0, None]
    """
    start_hz, stop_hz = start_and_end_hz
    first_half_ticks = segments.get("there", segments["sweep"])
    for (first_tick, end), begin_hz, end_hz in (
        (first_half_ticks, start_hz, stop_hz),
        (segments.get("back", (0, 0)), stop_hz, start_hz),
    ):
        if first_tick <= tick < end:
            return begin_hz + (end_hz - begin_hz) * (tick - first_tick) / (end - first_tick)
    return None


def linear_sweep_band_hz(
    excitation_kind: str, excitation_parameters: Mapping[str, float | int | str]
) -> tuple[float, float] | None:
    """Return the frequencies at the start and end of a linear sweep; None for other excitations.

    Parameters
    ----------
    excitation_kind, excitation_parameters
        Name of the excitation, and its parameters: name → number, or text as in a session file.
    """
    if excitation_kind != "chirp":
        return None
    try:
        return float(excitation_parameters["start_hz"]), float(excitation_parameters["stop_hz"])
    except (KeyError, ValueError):
        return None
