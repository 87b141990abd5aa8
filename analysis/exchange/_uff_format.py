"""Reading and writing of universal files (UFF): functions of time in data sets of type 58.

The package pyuff reads the files. Text and binary files are written here from the definition of the
University of Cincinnati (SDRL), because existing libraries state a wrong number of bytes for
complex values, or write abscissae with only six digits.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    FileTimes,
    SourceChannel,
    bounded_memory,
    channel_index,
    check_sample_count,
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

_MAX_DATA_SETS: Final = 10_000
"""Largest number of data sets in a file that is read."""
_SET_DELIMITER: Final = b"    -1"
"""Line that begins and ends each data set."""
_BINARY_HEADER_PATTERN: Final = re.compile(rb"^ {4}-1 *\r?\n {4}58b +\d+ +(\d+)", re.MULTILINE)
"""Pattern of the beginning of a binary data set, with the format of its numbers."""
_NUMBER_FORMAT_NAMES: Final = {1: "DEC VMS", 3: "IBM 370"}
"""Names of formats of binary numbers other than IEEE 754, by their codes."""
_UNITS_SET_TYPE: Final = 164
"""Type of the data set that states the units of a file."""
_SI_UNITS_CODE: Final = 1
"""Code of SI units in that data set."""
_TIME_AXIS_CODE: Final = 17
"""Code of a time axis; its unit is the second in every system of units."""
_RELATIVE_STEP_TOLERANCE: Final = 1e-3
"""Largest difference between the time steps of two data sets, relative to the step."""


def read(path: Path, channel_names: Sequence[str]) -> Mapping[str, SourceChannel]:
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
            return _read_channels(path, channel_names, pyuff.UFF)
    except (ExchangeError, OSError, MemoryError):
        raise
    except Exception as error:  # pyuff raises many types
        raise ExchangeError(
            f"{path}: is not a universal file, or is damaged ({error}); export it again."
        ) from error


def _read_channels(
    path: Path, channel_names: Sequence[str], open_file: Callable[[str], Any]
) -> dict[str, SourceChannel]:
    """Return the requested channels from their data sets."""
    _check_sets(path)
    uff_file = open_file(str(path))
    units_remark = _units_remark(uff_file)
    channel_set_numbers = [
        set_number for set_number, set_type in enumerate(uff_file.get_set_types()) if set_type == 58
    ]
    set_titles = [
        uff_file.read_sets(set_number, header_only=True)["id1"]
        for set_number in channel_set_numbers
    ]
    set_index_by_channel = {
        channel_name: channel_index(
            path, channel_name, set_titles, "data sets have the title", list_numbers=True
        )
        for channel_name in channel_names
        if channel_name != ABSCISSA
    }
    if not set_index_by_channel:
        raise ExchangeError(f"{path}: no channel but '{ABSCISSA}' was requested.")
    channels, abscissae, abscissa_units = {}, [], []
    for channel_name, set_number in set_index_by_channel.items():
        data_set = uff_file.read_sets(channel_set_numbers[set_number])
        set_abscissae = np.asarray(data_set["x"], dtype=np.float64)
        channels[channel_name] = _source_channel(
            path, channel_name, data_set, set_abscissae, is_time_requested=ABSCISSA in channel_names
        )
        if not channels[channel_name].unit_label:
            channels[channel_name] = replace(channels[channel_name], remark=units_remark)
        abscissae.append(set_abscissae)
        abscissa_units.append(_abscissa_unit(data_set))
    if ABSCISSA in channel_names:
        first_channel = next(iter(channels.values()))
        channels[ABSCISSA] = SourceChannel(
            _common_times(path, channels, abscissae),
            unit_label=abscissa_units[0],
            rate_hz=None if abscissa_units[0] else _evenly_spaced_rate_hz(data_set, 1.0),
            start_ns=first_channel.start_ns,
        )
    return channels


def _check_sets(path: Path) -> None:
    """Raise if a file has too many data sets, or numbers that pyuff does not decode.

    pyuff would store the position of each data set, and decodes all binary numbers by IEEE 754.
    """
    file_bytes = path.read_bytes()
    if file_bytes.count(_SET_DELIMITER) > 2 * _MAX_DATA_SETS:
        raise ExchangeError(
            f"{path}: has more than {_MAX_DATA_SETS} data sets; export the session's channels "
            "alone."
        )
    for binary_header in _BINARY_HEADER_PATTERN.finditer(file_bytes):
        number_format = int(binary_header[1])
        if number_format not in (0, 2):
            raise ExchangeError(
                f"{path}: a binary data set has numbers of format {number_format}"
                f"{_code_name_suffix(number_format, _NUMBER_FORMAT_NAMES)}, which is not read; "
                "export the file as text, or with numbers by IEEE 754."
            )


def _units_remark(uff_file: Any) -> str:  # noqa: ANN401
    """Return a remark on the units that data set 164 states; empty if they are SI or unknown."""
    for set_number, set_type in enumerate(uff_file.get_set_types()):
        if set_type != _UNITS_SET_TYPE:
            continue
        units_set = uff_file.read_sets(set_number)
        has_si_factors = (units_set["length"], units_set["force"]) == (1.0, 1.0)
        if units_set["units_code"] == _SI_UNITS_CODE or has_si_factors:
            continue
        description = printable(str(units_set["units_description"]).strip(), 40)
        return (
            f"Data set {_UNITS_SET_TYPE} of the file states the units '{description}', and not "
            "every channel states its own; such channels were read in the units as stated."
        )
    return ""


def _source_channel(
    path: Path,
    channel_name: str,
    data_set: Mapping[str, Any],
    set_abscissae: NDArray[np.float64],
    *,
    is_time_requested: bool,
) -> SourceChannel:
    """Return a data set as a channel; `set_abscissae` are its times.

    If `is_time_requested`, the user requests the abscissae as a channel of times, so the channel
    states no rate and no times of its own.
    """
    set_values = np.asarray(data_set["data"])
    if set_values.dtype.kind == "c":
        raise not_in_time_error(path, channel_name)
    abscissa_unit = _abscissa_unit(data_set)
    _check_function_of_time(path, channel_name, data_set, abscissa_unit)
    if len(set_values) != data_set["num_pts"]:
        raise ExchangeError(
            f"{path}: '{channel_name}' has {len(set_values)} values and states "
            f"{data_set['num_pts']}; the "
            "file is damaged or was written incorrectly; export it again."
        )
    check_sample_count(path, f"The data set '{channel_name}'", len(set_values))
    unit_s = time_unit_s(abscissa_unit)
    is_time_axis = unit_s is not None or data_set["abscissa_spec_data_type"] == _TIME_AXIS_CODE
    is_evenly_spaced = data_set["abscissa_spacing"] == 1
    # A step of 1 without a unit may count samples.
    may_be_times = (
        not is_time_axis
        and not abscissa_unit
        and data_set["func_type"] == _TIME_RESPONSE
        and not (is_evenly_spaced and data_set["abscissa_inc"] == 1.0)
    )
    start_s = float(set_abscissae[0]) * (unit_s or 1.0) if len(set_abscissae) else math.nan
    unit_label = _label_text(data_set, "ordinate_axis_units_lab")
    return SourceChannel(
        real_vector(path, channel_name, set_values),
        unit_label=unit_label or stated_unit_of(_label_text(data_set, "ordinate_axis_lab")),
        rate_hz=_evenly_spaced_rate_hz(data_set, unit_s or 1.0)
        if is_time_axis and not is_time_requested
        else None,
        start_ns=round(start_s * 1e9) if math.isfinite(start_s) else None,
        times=FileTimes(ABSCISSA, set_abscissae, unit_s)
        if ((is_time_axis and not is_evenly_spaced) or may_be_times) and not is_time_requested
        else None,
        title=str(data_set["id1"]).strip(),
    )


def _label_text(data_set: Mapping[str, Any], label_key: str) -> str:
    """Return a label of a data set, or an empty text if it has none."""
    label_text = str(data_set.get(label_key) or "").strip()
    return "" if label_text.upper() == "NONE" else label_text


def _abscissa_unit(data_set: Mapping[str, Any]) -> str:
    """Return the stated unit of a data set's abscissa, or an empty text if none is stated."""
    return _label_text(data_set, "abscissa_axis_units_lab") or stated_unit_of(
        _label_text(data_set, "abscissa_axis_lab")
    )


def _evenly_spaced_rate_hz(data_set: Mapping[str, Any], unit_s: float) -> float | None:
    """Return the sampling rate of a data set with equidistant abscissae, or else None."""
    increment_s = data_set["abscissa_inc"] * unit_s if data_set["abscissa_spacing"] == 1 else 0.0
    return 1 / increment_s if increment_s > 0 else None


def _check_function_of_time(
    path: Path, channel_name: str, data_set: Mapping[str, Any], abscissa_unit: str
) -> None:
    """Raise if a data set is a spectrum or another function that is not of time."""
    function_type, axis_type = data_set["func_type"], data_set["abscissa_spec_data_type"]
    axis_label = _label_text(data_set, "abscissa_axis_lab")
    contradiction = ""
    if function_type not in (_GENERAL_FUNCTION, _TIME_RESPONSE):
        contradiction = (
            "its function type is "
            f"{function_type}{_code_name_suffix(function_type, _FUNCTION_TYPE_NAMES)}"
        )
    elif axis_type not in (_UNKNOWN_AXIS, _GENERAL_AXIS, _TIME_AXIS_CODE):
        contradiction = (
            "its abscissa is of type "
            f"{axis_type}{_code_name_suffix(axis_type, _ABSCISSA_TYPE_NAMES)}"
        )
    elif axis_type != _TIME_AXIS_CODE and (
        abscissa_unit.lower() in ("hz", "khz", "rpm", "rad/s")
        or axis_label.lower().startswith("freq")
    ):
        contradiction = f"its abscissa is '{axis_label or abscissa_unit}'"
    if contradiction:
        raise ExchangeError(
            f"{path}: '{channel_name}' is not a function of time: {contradiction}. A session is "
            "made of measured samples: give angle and torque over time."
        )


def _code_name_suffix(code: int, code_names: Mapping[int, str]) -> str:
    """Return the name of a code in parentheses, or an empty text if it has no name."""
    return f" ({code_names[code]})" if code in code_names else ""


_FUNCTION_TYPE_NAMES: Final = {
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
_ABSCISSA_TYPE_NAMES: Final = {18: "frequency", 19: "rpm", 20: "order"}
"""Names of abscissa types that are not times, by their codes."""


def _common_times(
    path: Path, channels: Mapping[str, SourceChannel], abscissae_of_sets: Sequence[Any]
) -> Any:  # noqa: ANN401
    """Return the abscissae of the first channel if they are valid for all channels.

    Raise ExchangeError if the abscissae of another channel have other increments, or are shifted
    although both channels state the same start or none.
    """
    channel_names = list(channels)
    for channel_name, set_times in zip(channel_names, abscissae_of_sets, strict=True):
        set_start, first_start = (
            channels[channel_name].start_ns,
            channels[channel_names[0]].start_ns,
        )
        sample_count = min(len(set_times), len(abscissae_of_sets[0]))
        step_differences = np.diff(set_times[:sample_count]) - np.diff(
            abscissae_of_sets[0][:sample_count]
        )
        mean_step = (
            np.median(np.diff(abscissae_of_sets[0])) if len(abscissae_of_sets[0]) > 1 else 0.0
        )
        step_differs = bool(
            np.abs(step_differences).max(initial=0.0) > _RELATIVE_STEP_TOLERANCE * mean_step
        )
        if not np.array_equal(set_times, abscissae_of_sets[0]) and (
            step_differs or set_start is None or first_start == set_start
        ):
            raise ExchangeError(
                f"{path}: '{channel_name}' has other times than '{channel_names[0]}'; choose "
                "channels that were sampled together."
            )
    return abscissae_of_sets[0]


# Writing

_TEXT_TOLERANCE, _BINARY_TOLERANCE = 1e-2, 1e-6
"""Largest error of an abscissa, in increments, at which a text file or a binary file states first
value and increment, with six digits each, instead of all abscissae."""

_INCREMENT_TOLERANCE: Final = 1e-10
"""Largest relative error of an increment of six digits at which a binary file states the increment
instead of all abscissae."""

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

    Times and frequencies are stated by first value and increment, with six digits each. In a record
    with gaps, or if six digits are not enough, each abscissa is written. Numbers are 8-byte floats
    if `binary` (58b), else text with 13 digits. Integer columns (ticks, flags) are left out, as the
    format cannot store them. Raise `ExchangeError` if each abscissa has to be written as text and
    six digits do not distinguish neighbours.
    """
    abscissae = np.asarray(table.axis.values, dtype=np.float64)
    if binary:
        is_evenly_spaced = _is_reproducible(abscissae, _BINARY_TOLERANCE) and _is_increment_exact(
            abscissae
        )
    else:
        is_evenly_spaced = _is_reproducible(abscissae, _TEXT_TOLERANCE)
    if not is_evenly_spaced and not binary and not _are_abscissae_distinct(abscissae):
        raise ExchangeError(
            f"{table.source}: its {table.axis.title.lower()} is not equidistant enough for UFF58 "
            "in text, which has six digits for it; write it with --binary, or as .csv or .mat."
        )
    stream.write(_SI_UNITS_SET.encode("ascii"))
    for column in table.columns:
        if column.values.dtype.kind in "fc":
            encoded_values = _encode_body(
                abscissae, column.values, is_evenly_spaced=is_evenly_spaced, binary=binary
            )
            header_text = _header_text(
                table, abscissae, column, is_evenly_spaced, len(encoded_values) if binary else None
            )
            stream.write(header_text.encode("ascii") + encoded_values + b"    -1\n")


def _is_reproducible(abscissae: NDArray[np.float64], relative_tolerance: float) -> bool:
    """Return whether first abscissa and increment, rounded to six digits, reproduce each abscissa.

    `relative_tolerance` is the largest permitted error, as a fraction of the increment.
    """
    if len(abscissae) < 2:
        return True
    first_abscissa, increment = _first_abscissa_and_increment(abscissae)
    rounded_abscissae = float(f"{first_abscissa:.5e}") + float(f"{increment:.5e}") * np.arange(
        len(abscissae)
    )
    return bool(np.abs(rounded_abscissae - abscissae).max() <= relative_tolerance * increment)


def _is_increment_exact(abscissae: NDArray[np.float64]) -> bool:
    """Return whether six digits state the increment exactly enough for a binary file."""
    _, increment = _first_abscissa_and_increment(abscissae)
    return abs(float(f"{increment:.5e}") - increment) <= _INCREMENT_TOLERANCE * increment


def _are_abscissae_distinct(abscissae: NDArray[np.float64]) -> bool:
    """Return whether six digits are enough to write each abscissa as text."""
    rounded_abscissae = np.array(
        [f"{abscissa:.5e}" for abscissa in abscissae.tolist()], dtype=np.float64
    )
    return bool(
        np.abs(rounded_abscissae - abscissae).max() <= _TEXT_TOLERANCE * np.diff(abscissae).min()
    )


def _first_abscissa_and_increment(abscissae: NDArray[np.float64]) -> tuple[float, float]:
    """Return the first abscissa and the mean increment."""
    if len(abscissae) < 2:
        return float(abscissae[0]), 0.0
    return float(abscissae[0]), float(abscissae[-1] - abscissae[0]) / (len(abscissae) - 1)


def _encode_body(
    abscissae: NDArray[np.float64],
    column_values: NDArray[np.generic],
    *,
    is_evenly_spaced: bool,
    binary: bool,
) -> bytes:
    """Return the encoded values of a function, with its abscissae unless these are equidistant."""
    real_columns: list[NDArray[np.generic]] = [] if is_evenly_spaced else [abscissae]
    real_columns += (
        [column_values.real, column_values.imag]
        if column_values.dtype.kind == "c"
        else [column_values]
    )
    number_table = np.column_stack(real_columns).astype("<f8", copy=False)
    if binary:
        return number_table.tobytes()
    number_formats = ["%20.12E"] * number_table.shape[1]
    if not is_evenly_spaced:
        number_formats[0] = "%13.5E"
    # A line has four numbers, or three for complex values with their abscissa.
    rows_per_line = 1 if len(number_formats) == 3 else 4 // len(number_formats)
    rows_in_full_lines = len(number_table) - len(number_table) % rows_per_line
    full_line, last_line = (
        "".join(number_formats * rows_per_line) + "\n",
        "".join(number_formats * (len(number_table) - rows_in_full_lines)),
    )
    body_text = (
        full_line
        * (rows_in_full_lines // rows_per_line)
        % tuple(number_table[:rows_in_full_lines].ravel().tolist())
    )
    body_text += (
        f"{last_line}\n" % tuple(number_table[rows_in_full_lines:].ravel().tolist())
        if last_line
        else ""
    )
    return body_text.encode("ascii")


def _header_text(
    table: ExportTable,
    abscissae: NDArray[np.float64],
    column: ExportColumn,
    is_evenly_spaced: bool,
    body_length_bytes: int | None,
) -> str:
    """Return the header of a data set; `body_bytes` is the length of a binary body in bytes."""
    is_complex = column.values.dtype.kind == "c"
    if table.axis.unit == "Hz":
        function_type, axis_type = (
            (_FREQUENCY_RESPONSE if is_complex else _COHERENCE),
            _FREQUENCY_AXIS,
        )
    else:
        function_type, axis_type = _TIME_RESPONSE, _TIME_AXIS
    first_abscissa, increment = (
        _first_abscissa_and_increment(abscissae) if is_evenly_spaced else (0.0, 0.0)
    )
    set_type = (
        "    58"
        if body_length_bytes is None
        else f"    58b{1:6d}{2:6d}{11:12d}{body_length_bytes:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    )
    data_type = _COMPLEX_DOUBLE if is_complex else _REAL_DOUBLE
    quantity_title, _, divisor_title = column.title.partition(" / ")
    quantity_unit, _, divisor_unit = column.unit.partition("/")
    header_lines = [
        "    -1",
        f"{set_type:80}",
        *(f"{_ascii_text(line_text):80.80}" for line_text in _identification_lines(table, column)),
        f"{function_type:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{0:10d}{0:4d} {'NONE':10}{0:10d}{0:4d}",
        f"{data_type:10d}{len(abscissae):10d}{int(is_evenly_spaced):10d}{first_abscissa:13.5E}{increment:13.5E}{0.0:13.5E}",
        _axis_line(axis_type, (0, 0), table.axis.title, table.axis.unit),
        _axis_line(
            _GENERAL_AXIS, _UNIT_EXPONENTS.get(quantity_unit, (0, 0)), quantity_title, quantity_unit
        ),
        _axis_line(
            _GENERAL_AXIS if divisor_unit else _UNKNOWN_AXIS, (0, 0), divisor_title, divisor_unit
        ),
        _axis_line(_UNKNOWN_AXIS, (0, 0), "", ""),
    ]
    return "\n".join(header_lines) + "\n"


def _identification_lines(table: ExportTable, column: ExportColumn) -> tuple[str, ...]:
    """Return the five identification lines: name, source, settings, date (unknown), exporter."""
    settings_text = ", ".join(
        f"{key} {table.information[key]}"
        for key in ("rate_hz", "estimator", "segments", "segment_length_samples", "overlap_samples")
        if key in table.information
    )
    return (
        column.name,
        table.source,
        settings_text or "NONE",
        "NONE",
        table.information["exported_by"],
    )


def _axis_line(
    axis_type: int, unit_exponents: tuple[int, int], axis_title: str, axis_unit: str
) -> str:
    """Return the line of a header that describes an axis."""
    length_exponent, force_exponent = unit_exponents
    return (
        f"{axis_type:10d}{length_exponent:5d}{force_exponent:5d}{0:5d} "
        f"{axis_title or 'NONE':20.20} {axis_unit or 'NONE':20.20}"
    )


def _ascii_text(text: str) -> str:
    """Return a text with every character outside ASCII replaced by an ASCII one."""
    return printable(text).encode("ascii", "replace").decode()
