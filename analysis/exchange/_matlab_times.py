"""Rate and times that a MATLAB file has next to a channel: variables or fields t, Fs, dt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from analysis.exchange._source import ExchangeError, FileTimes
from rigd.text_table.titles import is_title_of_times, time_unit_s

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

_RATES: Final = (
    "fs", "fsamp", "fsample", "f_s", "rate_hz", "sample_rate", "samplerate", "sample_rate_hz",
    "sampling_rate", "samplingrate", "srate", "sampling_frequency", "samplingfrequency",
)  # fmt: skip
_PERIODS: Final = (
    "dt", "ts", "t_s", "delta_t", "deltat", "sample_time", "sampletime", "tsample",
)  # fmt: skip


def states_time(name: str) -> bool:
    """Whether a variable or field of that name has times, a rate or a period."""
    return is_title_of_times(name) or name.lower() in _RATES + _PERIODS


def stated_times(
    name: str,
    names: Sequence[str],
    length: int,
    siblings: Callable[[str], Iterable[str]],
    vector: Callable[[str], NDArray[Any]],
) -> tuple[float | None, FileTimes | None]:
    """Return the rate in Hz and the times that are stated nearest to a channel, None if none are.

    Parameters
    ----------
    name : str
        The channel.
    names : sequence of str
        Requested channels.
    length : int
        Samples of the channel.
    siblings : callable
        From a struct's name, "" for the file itself, to the names in it.
    vector : callable
        From a name to its values.
    """
    parent = name.rpartition("#")[0] or name
    while parent:
        parent = parent.rpartition(".")[0]
        rate_hz: float | None = None
        times: FileTimes | None = None
        for field in siblings(parent):
            other = f"{parent}.{field}" if parent else field
            if other in names or not states_time(field):
                continue
            try:
                values = vector(other)
            except ExchangeError:  # texts, structs
                continue
            if len(values) == 1 and values[0] > 0 and field.lower() in _RATES:
                rate_hz = float(values[0])
            elif len(values) == 1 and values[0] > 0 and field.lower() in _PERIODS:
                rate_hz = 1 / float(values[0])
            elif len(values) == length and is_title_of_times(field):
                times = FileTimes(other, values, time_unit_s(field.rpartition("_")[2]))
        if rate_hz is not None or times is not None:
            return rate_hz, times
    return None, None
