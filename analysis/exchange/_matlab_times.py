"""Sampling rate and times of a channel from other variables or fields of a MATLAB file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from analysis.exchange._source import ExchangeError, FileTimes, first_times
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


def is_name_of_times(field_name: str) -> bool:
    """Return whether a variable or field of this name contains times, a rate or a sample period."""
    return is_title_of_times(field_name) or field_name.lower() in _RATE_NAMES + _PERIOD_NAMES


def stated_times(
    channel_name: str,
    channel_names: Sequence[str],
    sample_count: int,
    list_sibling_names: Callable[[str], Iterable[str]],
    read_vector: Callable[[str], NDArray[Any]],
) -> tuple[float | None, FileTimes | None]:
    """Return sampling rate and times of a channel, from the innermost struct that states either.

    `channel_names` are the requested channels, which are not searched. `sample_count` is the
    channel's number of samples. `sibling_names` returns the names of the fields of a struct, or of
    the variables of the file for an empty name. `read_vector` returns the values of a variable or
    field by its name. The rate in Hz or the times are None if not stated there.
    """
    parent_name = channel_name.rpartition("#")[0] or channel_name
    while parent_name:
        parent_name = parent_name.rpartition(".")[0]
        rate_hz: float | None = None
        possible_times: list[FileTimes] = []
        for field_name in list_sibling_names(parent_name):
            sibling_name = f"{parent_name}.{field_name}" if parent_name else field_name
            if sibling_name in channel_names or not is_name_of_times(field_name):
                continue
            try:
                sibling_values = read_vector(sibling_name)
            except ExchangeError:  # the variable is a text or a struct
                continue
            if (
                len(sibling_values) == 1
                and sibling_values[0] > 0
                and field_name.lower() in _RATE_NAMES
            ):
                rate_hz = float(sibling_values[0])
            elif (
                len(sibling_values) == 1
                and sibling_values[0] > 0
                and field_name.lower() in _PERIOD_NAMES
            ):
                rate_hz = 1 / float(sibling_values[0])
            elif len(sibling_values) == sample_count and is_title_of_times(field_name):
                possible_times.append(
                    FileTimes(
                        sibling_name, sibling_values, time_unit_s(field_name.rpartition("_")[2])
                    )
                )
        file_times = first_times(possible_times)
        if rate_hz is not None or file_times is not None:
            return rate_hz, file_times
    return None, None
