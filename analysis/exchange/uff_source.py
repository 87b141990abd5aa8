"""Channels of a universal file: its data sets of type 58, by pyuff."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange.bounded_memory import bounded_memory
from analysis.exchange.errors import ExchangeError
from analysis.exchange.source import (
    SourceChannel,
    as_column,
    check_samples,
    missing_library,
    no_such_channel,
    not_in_time,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

ABSCISSA: Final = "abscissa"
"""Name of the channel of times that the data sets have in common."""

_MOST_SETS: Final = 10_000
_MARK: Final = b"    -1"
_TIME: Final = 17
"""Code of a time in the characteristics of an axis; in s, in every system of units."""


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read functions of time, as `analysis.exchange.source.read_source` asks for.

    A channel is ``#2``, the second data set of type 58, or the text of its first identification
    line if no other has the same; ``abscissa`` is the times of the first that is asked for.
    """
    try:
        import pyuff
    except ImportError as error:
        raise missing_library(path, "pyuff") from error
    try:
        with bounded_memory():
            return _functions(path, names, pyuff.UFF)
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # pyuff raises plain exceptions, and lets through others
        raise ExchangeError(
            f"{path}: is not a universal file, or is damaged ({error}); export it again."
        ) from error


def _functions(
    path: Path, names: Sequence[str], open_file: Callable[[str], Any]
) -> dict[str, SourceChannel]:
    _check_marks(path)
    file = open_file(str(path))
    places = [place for place, kind in enumerate(file.get_set_types()) if kind == 58]
    titles = [file.read_sets(place, header_only=True)["id1"] for place in places]
    numbers = {name: _number(path, name, titles) for name in names if name != ABSCISSA}
    if not numbers:
        raise ExchangeError(f"{path}: no channel but '{ABSCISSA}' was asked for.")
    channels, times = {}, []
    for name, number in numbers.items():
        function = file.read_sets(places[number])
        channels[name] = _channel(path, name, function)
        times.append(np.asarray(function["x"], dtype=np.float64))
    if ABSCISSA in names:
        channels[ABSCISSA] = SourceChannel(_common_times(path, list(numbers), times))
    return channels


def _check_marks(path: Path) -> None:
    """Refuse a file of nothing but the marks between data sets, which pyuff would all note."""
    if path.read_bytes().count(_MARK) > 2 * _MOST_SETS:
        raise ExchangeError(
            f"{path}: has more than {_MOST_SETS} data sets; export the session's channels alone."
        )


def _number(path: Path, name: str, titles: Sequence[str]) -> int:
    count = titles.count(name)
    if count == 1:
        return titles.index(name)
    if count > 1:
        raise ExchangeError(
            f"{path}: {count} data sets have the title '{name}'; give the number, such as "
            f"#{titles.index(name) + 1} for the first of them."
        )
    number = name.removeprefix("#")
    if name != number and number.isdecimal() and 0 < int(number) <= len(titles):
        return int(number) - 1
    raise no_such_channel(
        path, name, (f"#{place} {title}" for place, title in enumerate(titles, start=1))
    )


def _channel(path: Path, name: str, function: Mapping[str, Any]) -> SourceChannel:
    values = np.asarray(function["data"])
    if values.dtype.kind == "c":
        raise not_in_time(path, name)
    if len(values) != function["num_pts"]:
        raise ExchangeError(
            f"{path}: '{name}' has {len(values)} values and states {function['num_pts']}; the file "
            "is damaged or was written wrongly, export it again."
        )
    check_samples(path, f"The data set '{name}'", len(values))
    even = function["abscissa_spacing"] == 1 and function["abscissa_spec_data_type"] == _TIME
    increment_s = function["abscissa_inc"] if even else 0.0
    return SourceChannel(
        as_column(path, name, values),
        unit_label=function.get("ordinate_axis_units_lab", ""),
        rate_hz=1 / increment_s if increment_s > 0 else None,
    )


def _common_times(path: Path, names: Sequence[str], times: Sequence[Any]) -> Any:  # noqa: ANN401
    for name, each in zip(names, times, strict=True):
        if not np.array_equal(each, times[0]):
            raise ExchangeError(
                f"{path}: '{name}' has other times than '{names[0]}'; choose channels that were "
                "sampled together."
            )
    return times[0]
