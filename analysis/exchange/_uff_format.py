"""Universal files (UFF): channels of data sets of type 58, and a table as such sets.

Reading is by pyuff. Writing, in text or binary, is by hand from the definition of the University of
Cincinnati (SDRL), as the libraries there are state the wrong number of bytes for complex values or
write abscissae with six digits only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    as_column,
    bounded_memory,
    channel_index,
    check_samples,
    missing_library,
    not_in_time,
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
"""Name of the channel of times that the data sets have in common."""

_MOST_SETS: Final = 10_000
_MARK: Final = b"    -1"
_TIME: Final = 17
"""Code of a time in the characteristics of an axis; in s, in every system of units."""
_SAME_STEP: Final = 1e-3
"""Largest difference between the steps of two data sets that begin at different times, in steps."""


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read functions of time, as `analysis.exchange._source.read_source` asks for.

    A channel is ``#2``, the second data set of type 58, or the text of its first identification
    line if no other has the same; ``abscissa`` is the times of the first requested one.
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
        channels[name] = _channel(path, name, function, stamps, timed=ABSCISSA in names)
        times.append(stamps)
        units.append(_abscissa_unit(function))
    if ABSCISSA in names:
        first = next(iter(channels.values()))
        channels[ABSCISSA] = SourceChannel(
            _common_times(path, channels, times),
            unit_label=units[0],
            rate_hz=None if units[0] else _even_rate_hz(function, 1.0),
            start_ns=first.start_ns,
        )
    return channels


def _check_marks(path: Path) -> None:
    """Refuse a file of nothing but the marks between data sets, which pyuff would all note."""
    if path.read_bytes().count(_MARK) > 2 * _MOST_SETS:
        raise ExchangeError(
            f"{path}: has more than {_MOST_SETS} data sets; export the session's channels alone."
        )


def _channel(
    path: Path, name: str, function: Mapping[str, Any], stamps: NDArray[np.float64], *, timed: bool
) -> SourceChannel:
    values = np.asarray(function["data"])
    if values.dtype.kind == "c":
        raise not_in_time(path, name)
    unit = _abscissa_unit(function)
    _check_time_response(path, name, function, unit)
    if len(values) != function["num_pts"]:
        raise ExchangeError(
            f"{path}: '{name}' has {len(values)} values and states {function['num_pts']}; the file "
            "is damaged or was written incorrectly; export it again."
        )
    check_samples(path, f"The data set '{name}'", len(values))
    unit_s = time_unit_s(unit)
    is_time = unit_s is not None or function["abscissa_spec_data_type"] == _TIME
    even = function["abscissa_spacing"] == 1
    start_s = float(stamps[0]) * (unit_s or 1.0) if len(stamps) else math.nan
    label = _text(function, "ordinate_axis_units_lab")
    return SourceChannel(
        as_column(path, name, values),
        unit_label=label or stated_unit_of(_text(function, "ordinate_axis_lab")),
        rate_hz=_even_rate_hz(function, unit_s or 1.0) if is_time and not timed else None,
        start_ns=round(start_s * 1e9) if math.isfinite(start_s) else None,
        times=FileTimes(ABSCISSA, stamps, unit_s) if is_time and not even and not timed else None,
    )


def _text(function: Mapping[str, Any], key: str) -> str:
    """Return a label of a data set, "" where it has none."""
    text = str(function.get(key) or "").strip()
    return "" if text.upper() == "NONE" else text


def _abscissa_unit(function: Mapping[str, Any]) -> str:
    """Return what a data set states of the unit of its abscissa, "" if nothing."""
    return _text(function, "abscissa_axis_units_lab") or stated_unit_of(
        _text(function, "abscissa_axis_lab")
    )


def _even_rate_hz(function: Mapping[str, Any], unit_s: float) -> float | None:
    increment_s = function["abscissa_inc"] * unit_s if function["abscissa_spacing"] == 1 else 0.0
    return 1 / increment_s if increment_s > 0 else None


def _check_time_response(path: Path, name: str, function: Mapping[str, Any], unit: str) -> None:
    """Refuse spectra and other functions that are none of time."""
    kind, axis = function["func_type"], function["abscissa_spec_data_type"]
    label = _text(function, "abscissa_axis_lab")
    text = ""
    if kind not in (_GENERAL_FUNCTION, _TIME_RESPONSE):
        text = f"its function type is {kind}{_named(kind, _FUNCTION_TYPES)}"
    elif axis not in (_UNKNOWN, _GENERAL, _TIME):
        text = f"its abscissa is of type {axis}{_named(axis, _ABSCISSA_TYPES)}"
    elif axis != _TIME and (
        unit.lower() in ("hz", "khz", "rpm", "rad/s") or label.lower().startswith("freq")
    ):
        text = f"its abscissa is '{label or unit}'"
    if text:
        raise ExchangeError(
            f"{path}: '{name}' is not a function of time: {text}. A session is made of measured "
            "samples: give angle and torque over time."
        )


def _named(code: int, names: Mapping[int, str]) -> str:
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
_ABSCISSA_TYPES: Final = {18: "frequency", 19: "rpm", 20: "order"}


def _common_times(path: Path, channels: Mapping[str, SourceChannel], times: Sequence[Any]) -> Any:  # noqa: ANN401
    """Return the times of the first channel, which those of all others are, but for their start."""
    names = list(channels)
    for name, each in zip(names, times, strict=True):
        begin, first_begin = channels[name].start_ns, channels[names[0]].start_ns
        length = min(len(each), len(times[0]))
        shifted = np.diff(each[:length]) - np.diff(times[0][:length])
        period = np.median(np.diff(times[0])) if len(times[0]) > 1 else 0.0
        uneven = bool(np.abs(shifted).max(initial=0.0) > _SAME_STEP * period)
        if not np.array_equal(each, times[0]) and (uneven or begin is None or first_begin == begin):
            raise ExchangeError(
                f"{path}: '{name}' has other times than '{names[0]}'; choose channels that were "
                "sampled together."
            )
    return times[0]


# Writing

_EVEN_IN_TEXT, _EVEN_IN_BINARY = 1e-2, 1e-6
"""Largest error of an abscissa, in spacings, at which first value and increment stand for all: the
format has six digits for either. In binary the abscissae themselves are the better choice."""

_SAME_INCREMENT: Final = 1e-10
"""Relative error of the increment at which, in binary, a short record determines its rate as
well."""

_GENERAL_FUNCTION, _TIME_RESPONSE, _FREQUENCY_RESPONSE, _COHERENCE = 0, 1, 4, 6
_TIME_AXIS, _FREQUENCY_AXIS, _GENERAL, _UNKNOWN = 17, 18, 1, 0
_REAL_DOUBLE, _COMPLEX_DOUBLE = 4, 6

_EXPONENTS: Final = {"N.m": (1, 1), "N": (0, 1)}
"""Unit → its powers of length and force."""

_SI_UNITS: Final = (
    "    -1\n   164\n"
    "         1  SI: Metre (newton)         2\n"
    + "".join(f"{value:25.16E}".replace("E", "D") for value in (1.0, 1.0, 1.0))
    + "\n"
    + f"{273.15:25.16E}".replace("E", "D")
    + "\n    -1\n"
)


def write_uff58(table: ExportTable, stream: BinaryIO, *, binary: bool) -> None:
    """Write the units (data set 164: SI) and a function for each column.

    Times and frequencies are given by first value and increment, or, where six digits of these are
    not enough and in a record with gaps, one by one.

    Parameters
    ----------
    table : ExportTable
        Integer columns (ticks, flags) are left out: the format cannot store them.
    stream : file, open for writing bytes
    binary : bool
        Whether numbers are written as 8-byte floats (58b) or with 13 digits.

    Raises
    ------
    ExchangeError
        If abscissae have to be given one by one and six digits, all that text has, are too few.
    """
    axis = np.asarray(table.axis.values, dtype=np.float64)
    if binary:
        even = _is_even(axis, _EVEN_IN_BINARY) and _six_digits_make_the_increment(axis)
    else:
        even = _is_even(axis, _EVEN_IN_TEXT)
    if not even and not binary and not _six_digits_do(axis):
        raise ExchangeError(
            f"{table.source}: its {table.axis.title.lower()} is not equidistant enough for UFF58 "
            "in text, which has six digits for it; write it with --binary, or as .csv or .mat."
        )
    stream.write(_SI_UNITS.encode("ascii"))
    for column in table.columns:
        if column.values.dtype.kind in "fc":
            body = _body(axis, column.values, even=even, binary=binary)
            header = _header(table, axis, column, even, len(body) if binary else None)
            stream.write(header.encode("ascii") + body + b"    -1\n")


def _is_even(axis: NDArray[np.float64], tolerance: float) -> bool:
    """Whether the header's digits of first value and increment make every abscissa."""
    if len(axis) < 2:
        return True
    first, increment = _start_and_increment(axis)
    made = float(f"{first:.5e}") + float(f"{increment:.5e}") * np.arange(len(axis))
    return bool(np.abs(made - axis).max() <= tolerance * increment)


def _six_digits_make_the_increment(axis: NDArray[np.float64]) -> bool:
    _, increment = _start_and_increment(axis)
    return abs(float(f"{increment:.5e}") - increment) <= _SAME_INCREMENT * increment


def _six_digits_do(axis: NDArray[np.float64]) -> bool:
    written = np.array([f"{value:.5e}" for value in axis.tolist()], dtype=np.float64)
    return bool(np.abs(written - axis).max() <= _EVEN_IN_TEXT * np.diff(axis).min())


def _start_and_increment(axis: NDArray[np.float64]) -> tuple[float, float]:
    if len(axis) < 2:
        return float(axis[0]), 0.0
    return float(axis[0]), float(axis[-1] - axis[0]) / (len(axis) - 1)


def _body(
    axis: NDArray[np.float64], values: NDArray[np.generic], *, even: bool, binary: bool
) -> bytes:
    """Values of a function, with its abscissae if these are uneven."""
    parts: list[NDArray[np.generic]] = [] if even else [axis]
    parts += [values.real, values.imag] if values.dtype.kind == "c" else [values]
    numbers = np.column_stack(parts).astype("<f8", copy=False)
    if binary:
        return numbers.tobytes()
    forms = ["%20.12E"] * numbers.shape[1]
    if not even:
        forms[0] = "%13.5E"
    # Four numbers to a line, but for abscissae with complex values: three.
    repeat = 1 if len(forms) == 3 else 4 // len(forms)
    whole = len(numbers) - len(numbers) % repeat
    line, rest = "".join(forms * repeat) + "\n", "".join(forms * (len(numbers) - whole))
    text = line * (whole // repeat) % tuple(numbers[:whole].ravel().tolist())
    text += f"{rest}\n" % tuple(numbers[whole:].ravel().tolist()) if rest else ""
    return text.encode("ascii")


def _header(
    table: ExportTable,
    axis: NDArray[np.float64],
    column: ExportColumn,
    even: bool,
    size: int | None,
) -> str:
    """Eleven lines, after the mark and the type; `size` is that of a binary body in bytes."""
    is_complex = column.values.dtype.kind == "c"
    if table.axis.unit == "Hz":
        function, axis_type = (_FREQUENCY_RESPONSE if is_complex else _COHERENCE), _FREQUENCY_AXIS
    else:
        function, axis_type = _TIME_RESPONSE, _TIME_AXIS
    first, increment = _start_and_increment(axis) if even else (0.0, 0.0)
    kind = (
        "    58"
        if size is None
        else f"    58b{1:6d}{2:6d}{11:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    )
    form = _COMPLEX_DOUBLE if is_complex else _REAL_DOUBLE
    title, _, below_title = column.title.partition(" / ")
    unit, _, below = column.unit.partition("/")
    lines = [
        "    -1",
        f"{kind:80}",
        *(f"{_ascii(text):80.80}" for text in _identification(table, column)),
        f"{function:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{0:10d}{0:4d} {'NONE':10}{0:10d}{0:4d}",
        f"{form:10d}{len(axis):10d}{int(even):10d}{first:13.5E}{increment:13.5E}{0.0:13.5E}",
        _characteristics(axis_type, (0, 0), table.axis.title, table.axis.unit),
        _characteristics(_GENERAL, _EXPONENTS.get(unit, (0, 0)), title, unit),
        _characteristics(_GENERAL if below else _UNKNOWN, (0, 0), below_title, below),
        _characteristics(_UNKNOWN, (0, 0), "", ""),
    ]
    return "\n".join(lines) + "\n"


def _identification(table: ExportTable, column: ExportColumn) -> tuple[str, ...]:
    """Five lines of text: name, source, how, date (unknown), exporter."""
    how = ", ".join(
        f"{key} {table.information[key]}"
        for key in ("rate_hz", "estimator", "segments", "segment_length_samples", "overlap_samples")
        if key in table.information
    )
    return column.name, table.source, how or "NONE", "NONE", table.information["exported_by"]


def _characteristics(kind: int, exponents: tuple[int, int], title: str, unit: str) -> str:
    length, force = exponents
    return f"{kind:10d}{length:5d}{force:5d}{0:5d} {title or 'NONE':20.20} {unit or 'NONE':20.20}"


def _ascii(text: str) -> str:
    return printable(text).encode("ascii", "replace").decode()
