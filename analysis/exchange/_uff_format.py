"""Reading and writing of universal files (UFF): functions of time in data sets of type 58.

The package pyuff reads the files. Text and binary files are written here from the definition of the
University of Cincinnati (SDRL), because existing libraries state a wrong number of bytes for
complex values, or write abscissae with only six digits.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    bounded_memory,
    channel_index,
    check_samples,
    missing_library_error,
    not_in_time_error,
    real_vector,
)
from rigd.printable import printable
from rigd.text_table.titles import stated_unit_of, time_unit_s

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from analysis.exchange._table import ExportColumn, ExportTable


# Reading

ABSCISSA: Final = "abscissa"
"""Name of the channel of times that is common to the requested data sets."""

_MOST_DATA_SETS: Final = 10_000
"""Largest number of data sets in a file that is read."""
_SET_DELIMITER: Final = b"    -1"
"""Line that begins and ends each data set."""
_TIME_CODE: Final = 17
"""Code of a time axis; its unit is the second in every system of units."""
_STEP_TOLERANCE: Final = 1e-3
"""Largest difference between the time steps of two data sets, relative to the step."""


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read functions of time from a universal file (see `analysis.exchange.read_source`).

    A channel is named ``#2`` (the second data set of type 58) or by its first identification line,
    if this is unique. The channel ``abscissa`` has the times of the first requested data set.
    """
    try:
        import pyuff
    except ImportError as error:
        raise missing_library_error(path, "pyuff") from error
    try:
        with bounded_memory():
            return _read_channels(path, names, pyuff.UFF)
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # pyuff raises many types
        raise ExchangeError(
            f"{path}: is not a universal file, or is damaged ({error}); export it again."
        ) from error


def _read_channels(
    path: Path, names: Sequence[str], open_file: Callable[[str], Any]
) -> dict[str, SourceChannel]:
    """Return the requested channels from their data sets."""
    _check_set_count(path)
    file = open_file(str(path))
    set_numbers = [number for number, kind in enumerate(file.get_set_types()) if kind == 58]
    titles = [file.read_sets(number, header_only=True)["id1"] for number in set_numbers]
    numbers = {
        name: channel_index(path, name, titles, "data sets have the title", numbered=True)
        for name in names
        if name != ABSCISSA
    }
    if not numbers:
        raise ExchangeError(f"{path}: no channel but '{ABSCISSA}' was requested.")
    channels, times, units = {}, [], []
    for name, number in numbers.items():
        function = file.read_sets(set_numbers[number])
        stamps = np.asarray(function["x"], dtype=np.float64)
        channels[name] = _source_channel(path, name, function, stamps, timed=ABSCISSA in names)
        times.append(stamps)
        units.append(_abscissa_unit(function))
    if ABSCISSA in names:
        first_channel = next(iter(channels.values()))
        channels[ABSCISSA] = SourceChannel(
            _common_times(path, channels, times),
            unit_label=units[0],
            rate_hz=None if units[0] else _even_rate_hz(function, 1.0),
            start_ns=first_channel.start_ns,
        )
    return channels


def _check_set_count(path: Path) -> None:
    """Raise if a file has too many data sets; pyuff would store the position of each."""
    if path.read_bytes().count(_SET_DELIMITER) > 2 * _MOST_DATA_SETS:
        raise ExchangeError(
            f"{path}: has more than {_MOST_DATA_SETS} data sets; export the session's channels "
            "alone."
        )


def _source_channel(
    path: Path, name: str, function: Mapping[str, Any], stamps: NDArray[np.float64], *, timed: bool
) -> SourceChannel:
    """Return one channel; `timed` states whether the user requests the times as a channel."""
    values = np.asarray(function["data"])
    if values.dtype.kind == "c":
        raise not_in_time_error(path, name)
    unit = _abscissa_unit(function)
    _check_time_response(path, name, function, unit)
    if len(values) != function["num_pts"]:
        raise ExchangeError(
            f"{path}: '{name}' has {len(values)} values and states {function['num_pts']}; the file "
            "is damaged or was written incorrectly; export it again."
        )
    check_samples(path, f"The data set '{name}'", len(values))
    unit_s = time_unit_s(unit)
    is_time = unit_s is not None or function["abscissa_spec_data_type"] == _TIME_CODE
    is_even = function["abscissa_spacing"] == 1
    start_s = float(stamps[0]) * (unit_s or 1.0) if len(stamps) else math.nan
    label = _label_text(function, "ordinate_axis_units_lab")
    return SourceChannel(
        real_vector(path, name, values),
        unit_label=label or stated_unit_of(_label_text(function, "ordinate_axis_lab")),
        rate_hz=_even_rate_hz(function, unit_s or 1.0) if is_time and not timed else None,
        start_ns=round(start_s * 1e9) if math.isfinite(start_s) else None,
        times=FileTimes(ABSCISSA, stamps, unit_s)
        if is_time and not is_even and not timed
        else None,
    )


def _label_text(function: Mapping[str, Any], key: str) -> str:
    """Return a label of a data set, or an empty text without a label."""
    text = str(function.get(key) or "").strip()
    return "" if text.upper() == "NONE" else text


def _abscissa_unit(function: Mapping[str, Any]) -> str:
    """Return the unit of a data set's abscissa as stated, or an empty text."""
    return _label_text(function, "abscissa_axis_units_lab") or stated_unit_of(
        _label_text(function, "abscissa_axis_lab")
    )


def _even_rate_hz(function: Mapping[str, Any], unit_s: float) -> float | None:
    """Return the sampling rate of a data set with a constant increment, else None."""
    increment_s = function["abscissa_inc"] * unit_s if function["abscissa_spacing"] == 1 else 0.0
    return 1 / increment_s if increment_s > 0 else None


def _check_time_response(path: Path, name: str, function: Mapping[str, Any], unit: str) -> None:
    """Raise if a data set is a spectrum or another function that is not of time."""
    function_type, axis = function["func_type"], function["abscissa_spec_data_type"]
    label = _label_text(function, "abscissa_axis_lab")
    contradiction = ""
    if function_type not in (_GENERAL_FUNCTION, _TIME_RESPONSE):
        contradiction = (
            f"its function type is {function_type}{_code_name(function_type, _FUNCTION_TYPES)}"
        )
    elif axis not in (_UNKNOWN_AXIS, _GENERAL_AXIS, _TIME_CODE):
        contradiction = f"its abscissa is of type {axis}{_code_name(axis, _ABSCISSA_TYPES)}"
    elif axis != _TIME_CODE and (
        unit.lower() in ("hz", "khz", "rpm", "rad/s") or label.lower().startswith("freq")
    ):
        contradiction = f"its abscissa is '{label or unit}'"
    if contradiction:
        raise ExchangeError(
            f"{path}: '{name}' is not a function of time: {contradiction}. A session is made of "
            "measured "
            "samples: give angle and torque over time."
        )


def _code_name(code: int, names: Mapping[int, str]) -> str:
    """Return the name of a code in parentheses, or an empty text if it has no name."""
    return f" ({names[code]})" if code in names else ""


_FUNCTION_TYPES: Final = {
    2: "auto spectrum",
    3: "cross spectrum",
    4: "frequency response",
    5: "transmissibility",
    6: "coherence",
    7: "auto correlation",
    8: "cross correlation",
    9: "power spectral density",
    10: "energy spectral density",
    11: "probability density",
    12: "spectrum",
    13: "cumulative distribution",
}
"""Names of function types that are not functions of time, by their codes."""
_ABSCISSA_TYPES: Final = {18: "frequency", 19: "rpm", 20: "order"}
"""Names of abscissa types that are not times, by their codes."""


def _common_times(path: Path, channels: Mapping[str, SourceChannel], times: Sequence[Any]) -> Any:  # noqa: ANN401
    """Return the times of the first channel; raise if the other channels have other steps."""
    names = list(channels)
    for name, set_times in zip(names, times, strict=True):
        begin, first_begin = channels[name].start_ns, channels[names[0]].start_ns
        length = min(len(set_times), len(times[0]))
        step_differences = np.diff(set_times[:length]) - np.diff(times[0][:length])
        period = np.median(np.diff(times[0])) if len(times[0]) > 1 else 0.0
        differs = bool(np.abs(step_differences).max(initial=0.0) > _STEP_TOLERANCE * period)
        if not np.array_equal(set_times, times[0]) and (
            differs or begin is None or first_begin == begin
        ):
            raise ExchangeError(
                f"{path}: '{name}' has other times than '{names[0]}'; choose channels that were "
                "sampled together."
            )
    return times[0]


# Writing

_TEXT_TOLERANCE, _BINARY_TOLERANCE = 1e-2, 1e-6
"""Largest error of an abscissa, in increments, up to which first value and increment are written
instead of all abscissae. Both have six digits; all abscissae of a binary file are exact."""

_INCREMENT_TOLERANCE: Final = 1e-10
"""Relative error of the increment, written with six digits, up to which a binary file states the
increment instead of all abscissae."""

_GENERAL_FUNCTION, _TIME_RESPONSE, _FREQUENCY_RESPONSE, _COHERENCE = 0, 1, 4, 6
"""Codes of the function type in the header of a data set."""
_TIME_AXIS, _FREQUENCY_AXIS, _GENERAL_AXIS, _UNKNOWN_AXIS = 17, 18, 1, 0
"""Codes of the data type of an axis in the header of a data set."""
_REAL_DOUBLE, _COMPLEX_DOUBLE = 4, 6
"""Codes of the number format in the header of a data set."""

_UNIT_EXPONENTS: Final = {"N.m": (1, 1), "N": (0, 1)}
"""Exponents of length and force in a unit."""

_SI_UNITS_SET: Final = (
    "    -1\n   164\n"
    "         1  SI: Metre (newton)         2\n"
    + "".join(f"{value:25.16E}".replace("E", "D") for value in (1.0, 1.0, 1.0))
    + "\n"
    + f"{273.15:25.16E}".replace("E", "D")
    + "\n    -1\n"
)
"""Data set 164, which states SI units."""


def write_uff58(table: ExportTable, stream: BinaryIO, *, binary: bool) -> None:
    """Write a table to a universal file: units (data set 164) and a function per column (58).

    Times and frequencies are stated by first value and increment. In a record with gaps, or if six
    digits are not enough for these, each abscissa is written.

    Parameters
    ----------
    table : ExportTable
        Columns to be written; integer columns (ticks, flags) are left out, as the format cannot
        store them.
    stream : file, open for writing bytes
        Destination.
    binary : bool
        Whether numbers are written as 8-byte floats (58b) or as text with 13 digits.

    Raises
    ------
    ExchangeError
        If each abscissa has to be written and the six digits of the text format are not enough.
    """
    axis = np.asarray(table.axis.values, dtype=np.float64)
    if binary:
        is_even = _is_reproducible(axis, _BINARY_TOLERANCE) and _is_increment_exact(axis)
    else:
        is_even = _is_reproducible(axis, _TEXT_TOLERANCE)
    if not is_even and not binary and not _are_abscissae_distinct(axis):
        raise ExchangeError(
            f"{table.source}: its {table.axis.title.lower()} is not equidistant enough for UFF58 "
            "in text, which has six digits for it; write it with --binary, or as .csv or .mat."
        )
    stream.write(_SI_UNITS_SET.encode("ascii"))
    for column in table.columns:
        if column.values.dtype.kind in "fc":
            encoded_values = _encode_body(axis, column.values, is_even=is_even, binary=binary)
            header = _header_text(
                table, axis, column, is_even, len(encoded_values) if binary else None
            )
            stream.write(header.encode("ascii") + encoded_values + b"    -1\n")


def _is_reproducible(axis: NDArray[np.float64], tolerance: float) -> bool:
    """Return whether first value and increment, with six digits, reproduce every abscissa."""
    if len(axis) < 2:
        return True
    start, increment = _start_and_increment(axis)
    reproduced = float(f"{start:.5e}") + float(f"{increment:.5e}") * np.arange(len(axis))
    return bool(np.abs(reproduced - axis).max() <= tolerance * increment)


def _is_increment_exact(axis: NDArray[np.float64]) -> bool:
    """Return whether six digits are enough for the increment of a binary file."""
    _, increment = _start_and_increment(axis)
    return abs(float(f"{increment:.5e}") - increment) <= _INCREMENT_TOLERANCE * increment


def _are_abscissae_distinct(axis: NDArray[np.float64]) -> bool:
    """Return whether six digits are enough to write each abscissa as text."""
    rounded = np.array([f"{value:.5e}" for value in axis.tolist()], dtype=np.float64)
    return bool(np.abs(rounded - axis).max() <= _TEXT_TOLERANCE * np.diff(axis).min())


def _start_and_increment(axis: NDArray[np.float64]) -> tuple[float, float]:
    """Return the first abscissa and the mean increment."""
    if len(axis) < 2:
        return float(axis[0]), 0.0
    return float(axis[0]), float(axis[-1] - axis[0]) / (len(axis) - 1)


def _encode_body(
    axis: NDArray[np.float64], values: NDArray[np.generic], *, is_even: bool, binary: bool
) -> bytes:
    """Return the encoded values of a function, with its abscissae unless these are even."""
    parts: list[NDArray[np.generic]] = [] if is_even else [axis]
    parts += [values.real, values.imag] if values.dtype.kind == "c" else [values]
    numbers = np.column_stack(parts).astype("<f8", copy=False)
    if binary:
        return numbers.tobytes()
    formats = ["%20.12E"] * numbers.shape[1]
    if not is_even:
        formats[0] = "%13.5E"
    # A line has four numbers, or three for complex values with their abscissa.
    rows_per_line = 1 if len(formats) == 3 else 4 // len(formats)
    full_rows = len(numbers) - len(numbers) % rows_per_line
    full_line, last_line = (
        "".join(formats * rows_per_line) + "\n",
        "".join(formats * (len(numbers) - full_rows)),
    )
    text = full_line * (full_rows // rows_per_line) % tuple(numbers[:full_rows].ravel().tolist())
    text += f"{last_line}\n" % tuple(numbers[full_rows:].ravel().tolist()) if last_line else ""
    return text.encode("ascii")


def _header_text(
    table: ExportTable,
    axis: NDArray[np.float64],
    column: ExportColumn,
    is_even: bool,
    size: int | None,
) -> str:
    """Return the header of a data set; `size` is the length of a binary body in bytes."""
    is_complex = column.values.dtype.kind == "c"
    if table.axis.unit == "Hz":
        function_type, axis_type = (
            (_FREQUENCY_RESPONSE if is_complex else _COHERENCE),
            _FREQUENCY_AXIS,
        )
    else:
        function_type, axis_type = _TIME_RESPONSE, _TIME_AXIS
    start, increment = _start_and_increment(axis) if is_even else (0.0, 0.0)
    set_type = (
        "    58"
        if size is None
        else f"    58b{1:6d}{2:6d}{11:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    )
    data_type = _COMPLEX_DOUBLE if is_complex else _REAL_DOUBLE
    title, _, divisor_title = column.title.partition(" / ")
    unit, _, divisor_unit = column.unit.partition("/")
    lines = [
        "    -1",
        f"{set_type:80}",
        *(f"{_ascii_text(text):80.80}" for text in _identification_lines(table, column)),
        f"{function_type:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{0:10d}{0:4d} {'NONE':10}{0:10d}{0:4d}",
        f"{data_type:10d}{len(axis):10d}{int(is_even):10d}{start:13.5E}{increment:13.5E}{0.0:13.5E}",
        _axis_line(axis_type, (0, 0), table.axis.title, table.axis.unit),
        _axis_line(_GENERAL_AXIS, _UNIT_EXPONENTS.get(unit, (0, 0)), title, unit),
        _axis_line(
            _GENERAL_AXIS if divisor_unit else _UNKNOWN_AXIS, (0, 0), divisor_title, divisor_unit
        ),
        _axis_line(_UNKNOWN_AXIS, (0, 0), "", ""),
    ]
    return "\n".join(lines) + "\n"


def _identification_lines(table: ExportTable, column: ExportColumn) -> tuple[str, ...]:
    """Return the five identification lines: name, source, settings, date (unknown), exporter."""
    settings = ", ".join(
        f"{key} {table.information[key]}"
        for key in ("rate_hz", "estimator", "segments", "segment_length_samples", "overlap_samples")
        if key in table.information
    )
    return column.name, table.source, settings or "NONE", "NONE", table.information["exported_by"]


def _axis_line(axis_type: int, exponents: tuple[int, int], title: str, unit: str) -> str:
    """Return the line of a header that describes an axis."""
    length, force = exponents
    return (
        f"{axis_type:10d}{length:5d}{force:5d}{0:5d} {title or 'NONE':20.20} {unit or 'NONE':20.20}"
    )


def _ascii_text(text: str) -> str:
    """Return a text with characters outside ASCII replaced."""
    return printable(text).encode("ascii", "replace").decode()
