"""Sampling rate and times of a channel from other variables or fields of a MATLAB file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from analysis.exchange._source import ExchangeError, FileTimes
from rigd.text_table.titles import is_title_of_times, time_unit_s

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

_RATE_NAMES: Final = (
    "fs", "fsamp", "fsample", "f_s", "rate_hz", "sample_rate", "samplerate", "sample_rate_hz",
    "sampling_rate", "samplingrate", "srate", "sampling_frequency", "samplingfrequency",
)  # fmt: skip
"""Names, in lower case, of variables with a sampling rate in Hz."""
_PERIOD_NAMES: Final = (
    "dt", "ts", "t_s", "delta_t", "deltat", "sample_time", "sampletime", "tsample",
)  # fmt: skip
"""Names, in lower case, of variables with a sample period in seconds."""


def states_time(name: str) -> bool:
    """Return whether a variable or field with this name has times, a rate or a period."""
    return is_title_of_times(name) or name.lower() in _RATE_NAMES + _PERIOD_NAMES


def stated_times(
    name: str,
    names: Sequence[str],
    length: int,
    siblings: Callable[[str], Iterable[str]],
    vector: Callable[[str], NDArray[Any]],
) -> tuple[float | None, FileTimes | None]:
    """Return sampling rate and times of a channel, from its struct or the structs that contain it.

    `names` are the requested channels, which are not searched. `length` is the channel's number of
    samples. `siblings` returns the names of the fields of a struct, or of the variables of the file
    for an empty name. `vector` returns the values of a name. Both results are None without such a
    statement in the file.
    """
    parent = name.rpartition("#")[0] or name
    while parent:
        parent = parent.rpartition(".")[0]
        rate_hz: float | None = None
        times: FileTimes | None = None
        for field in siblings(parent):
            sibling = f"{parent}.{field}" if parent else field
            if sibling in names or not states_time(field):
                continue
            try:
                values = vector(sibling)
            except ExchangeError:  # the variable is a text or a struct
                continue
            if len(values) == 1 and values[0] > 0 and field.lower() in _RATE_NAMES:
                rate_hz = float(values[0])
            elif len(values) == 1 and values[0] > 0 and field.lower() in _PERIOD_NAMES:
                rate_hz = 1 / float(values[0])
            elif len(values) == length and is_title_of_times(field):
                times = FileTimes(sibling, values, time_unit_s(field.rpartition("_")[2]))
        if rate_hz is not None or times is not None:
            return rate_hz, times
    return None, None
