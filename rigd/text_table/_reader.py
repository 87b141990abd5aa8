"""Reader of requested columns of a table, with checks of every cell and of the decimal sign."""

import csv
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import TextIOWrapper
from itertools import islice
from operator import itemgetter
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt

from rigd.text_table._cells import (
    COMMA,
    POINT,
    ThousandsCheck,
    fast_number_converter,
    is_any_number,
    is_number,
    parse_number,
)
from rigd.text_table._encoding import possible_encodings
from rigd.text_table._errors import TableError
from rigd.text_table._layout import (
    MAX_HEAD_LINES,
    TableLayout,
    comma_in_single_message,
    find_layout,
    not_a_number_error,
    stated_separator,
    wrong_width_message,
)
from rigd.text_table._rows import rows_of_cells, without_trailing_empty_cells
from rigd.text_table._stamps import StampReader, is_stamp
from rigd.text_table.titles import (
    are_times,
    is_title_of_times,
    is_unit_of_other_quantity,
    stated_unit_of,
    time_unit_s,
)

MAX_LINE_CHARACTERS: Final = 65_536
"""Largest number of characters in a line; a longer line is an error.

It is enough for hundreds of columns."""

_ENCODING_DETECTION_BYTES: Final = 4
"""Number of bytes from which the encoding is detected."""
_MAX_HEAD_CHARACTERS: Final = 1_000_000
"""Number of characters after which no further lines are read to detect the layout."""
_TIME_DIMENSIONS: Final = ("", "time", "zeit")
"""Values of the key X_Dimension for samples over time, in LabVIEW's files."""


@dataclass(frozen=True, slots=True)
class TableColumn:
    """Column of numbers from a text file.

    Attributes
    ----------
    values : ndarray of float, shape (n,)
        Numbers of the column; NaN for an empty cell.
    title : str
        Title of the column; empty if the table has no titles.
    unit : str
        Unit of the column in the file; empty if there is none.
    rate_hz : float or None
        Sampling rate stated in the head of the file; None if there is none.
    start_ns : int or None
        Time of the first sample stated in the head of the file, in ns; None if there is none.
    """

    values: npt.NDArray[np.float64]
    title: str = ""
    unit: str = ""
    rate_hz: float | None = None
    start_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TableTimes:
    """Column of times that was read in addition to the requested columns.

    Attributes
    ----------
    title : str
        Title of the column, or its number such as ``#1``.
    values : ndarray of float, shape (n,)
        Times in the unit of the file.
    unit_s : float or None
        Unit of the times in seconds; None if the file does not state it.
    """

    title: str
    values: npt.NDArray[np.float64]
    unit_s: float | None


@dataclass(frozen=True, slots=True)
class TextTable:
    """Requested columns of a table in a text file.

    Attributes
    ----------
    columns : mapping of str to TableColumn
        Columns by requested name, all with the same number of rows.
    line_numbers : ndarray of uint32, shape (n,)
        Number of each row's line in the file, from 1.
    column_count : int
        Number of columns in the table.
    times : TableTimes or None
        Column of times in addition to the requested columns; None if there is none.
    remark : str
        Remark on the file for the user; empty if there is none.
    """

    columns: Mapping[str, TableColumn]
    line_numbers: npt.NDArray[np.uint32]
    column_count: int
    times: TableTimes | None = None
    remark: str = ""


def read_table(stream: BinaryIO, requested_names: Sequence[str], *, max_rows: int) -> TextTable:
    r"""Read some columns of a table of numbers in a text file.

    The separator is a tab, a semicolon, a comma, a bar or blanks. The decimal sign is a point or a
    comma, the same in the whole file. The titles are the first line that contains all names and has
    as many cells as the lines of numbers below it. A line of units may follow. Every line of
    numbers has the same number of cells, except for empty cells after the last column.

    Parameters
    ----------
    stream : file, open for reading bytes
        The file must be seekable; it is not closed.
    requested_names : sequence of str
        Titles of the requested columns, or numbers such as ``#3`` for the third column.
    max_rows : int
        Number of rows after which reading ends. If the file has more rows, one more is returned.

    Returns
    -------
    TextTable

    Raises
    ------
    TableError
        If a line does not fit the table. The message states the line's number and the remedy.

    Examples
    --------
    >>> from io import BytesIO
    >>> from rigd.text_table import read_table
    >>> table = read_table(BytesIO(b"t;angle\ns;rad\n0;0,5\n1;0,7\n"), ["angle"], max_rows=10)
    >>> table.columns["angle"].values.tolist(), table.columns["angle"].unit
    ([0.5, 0.7], 'rad')
    """
    stream.seek(0)
    first_bytes = stream.read(_ENCODING_DETECTION_BYTES)
    last_decoding_error: UnicodeError | None = None
    for possible_encoding in possible_encodings(first_bytes):
        try:
            return _read_encoded_table(stream, possible_encoding, requested_names, max_rows)
        except UnicodeError as found:
            last_decoding_error = last_decoding_error or found
        except csv.Error as found:
            raise TableError(f"is not a table of text ({found}).") from found
    raise TableError(
        "is not text in UTF-8, UTF-16 or Windows-1252; save it as UTF-8."
    ) from last_decoding_error


def _read_encoded_table(
    stream: BinaryIO, encoding: str, requested_names: Sequence[str], max_rows: int
) -> TextTable:
    """Read columns of a text with a given encoding."""
    with _open_lines(stream, encoding) as text_lines:
        first_lines = _first_lines(text_lines)
    table_layout = find_layout(first_lines, requested_names)
    first_cells = [
        table_layout.first_row_cells[column_index]
        for column_index in table_layout.requested_column_indices
    ]
    decimal_sign = (
        COMMA if any(COMMA in cell and not is_stamp(cell) for cell in first_cells) else POINT
    )
    times_column_index = _find_times_column_index(table_layout, first_lines)
    try:
        return _read_columns(
            stream,
            encoding,
            table_layout,
            requested_names,
            max_rows,
            decimal_sign,
            times_column_index,
        )
    except _DecimalCommaError:
        # Read again from the start: a point in earlier lines may not be a decimal point.
        return _read_columns(
            stream, encoding, table_layout, requested_names, max_rows, COMMA, times_column_index
        )


def _first_lines(lines: Iterator[str]) -> list[str]:
    """Return the first lines of a file, from which the layout is detected."""
    first_lines: list[str] = []
    character_count = 0
    for text_line in islice(lines, MAX_HEAD_LINES):
        first_lines.append(text_line)
        character_count += len(text_line)
        if character_count > _MAX_HEAD_CHARACTERS:
            break
    return first_lines


class _DecimalCommaError(Exception):
    """Error: a decimal comma was found while numbers were read with decimal points."""


@contextmanager
def _open_lines(stream: BinaryIO, encoding: str) -> Iterator[Iterator[str]]:
    """Provide the decoded lines of a text file from its start, without closing the file."""
    stream.seek(0)
    text_stream = TextIOWrapper(stream, encoding, newline="")
    try:
        yield _lines_of_bounded_length(text_stream)
    finally:
        text_stream.detach()


def _lines_of_bounded_length(text_stream: TextIOWrapper) -> Iterator[str]:
    """Yield the lines of a text, and raise TableError for a line that is too long."""
    line_number = 0
    while text_line := text_stream.readline(MAX_LINE_CHARACTERS + 1):
        line_number += 1
        if len(text_line) > MAX_LINE_CHARACTERS:
            raise TableError(
                f"line {line_number}: a line of more than {MAX_LINE_CHARACTERS} characters; a "
                "table has one line per sample and few channels. Export the session's channels "
                "alone."
            )
        yield text_line


@dataclass(slots=True)
class _NumberRowReader:
    """Reader of rows of numbers that checks each row against the layout of the table."""

    layout: TableLayout
    requested_names: Sequence[str]
    decimal_sign: str
    """Decimal sign of the numbers."""
    column_indices_to_read: Sequence[int]
    """Indices of the columns to read, which are the requested ones and a column of times."""
    stamp_readers: Mapping[int, StampReader] = field(default_factory=dict)
    """Readers of the columns to read that contain times of day."""
    checked_column_indices: Sequence[int] = ()
    """Indices of the columns with a number in the first row, whether requested or not."""
    thousands_checks: dict[int, ThousandsCheck] = field(default_factory=dict)
    """Checks for thousands separators in the columns to read."""
    is_sign_certain: bool = False
    """Whether a cell has shown that the expected sign is the decimal sign."""
    blank_line_number: int = 0
    """Number of the first empty line between lines of numbers; 0 if there is none."""
    blank_interruption_count: int = 0
    """Number of interruptions of the numbers by empty lines."""

    def __post_init__(self) -> None:
        first_cells = self.layout.first_row_cells
        number_column_indices = (c for c, cell in enumerate(first_cells) if is_any_number(cell))
        self.stamp_readers = {
            c: StampReader() for c in self.column_indices_to_read if is_stamp(first_cells[c])
        }
        self.checked_column_indices = sorted(
            {*self.column_indices_to_read, *number_column_indices} - {*self.stamp_readers}
        )
        self.thousands_checks = {
            c: ThousandsCheck(self.decimal_sign)
            for c in self.checked_column_indices
            if c in self.column_indices_to_read
        }

    def column_name(self, column_index: int) -> str:
        """Return the name of a requested column for messages; its number if it has no name."""
        if column_index in self.layout.requested_column_indices:
            return self.requested_names[self.layout.requested_column_indices.index(column_index)]
        return f"#{column_index + 1}"

    def fit_row(self, row: Sequence[str], line_number: int) -> list[str]:
        """Return a row with empty cells cut or added at its end to fit the table's columns.

        Raise TableError if this does not make it fit.
        """
        column_count = self.layout.column_count
        fitted_cells = without_trailing_empty_cells(row, column_count)
        if column_count - self.layout.optional_column_count <= len(fitted_cells) < column_count:
            fitted_cells += [""] * (column_count - len(fitted_cells))
        if len(fitted_cells) != column_count:
            raise TableError(
                wrong_width_message(
                    line_number,
                    len(fitted_cells),
                    column_count,
                    self.layout.titles_line_number,
                    self.layout.separator,
                )
            )
        return fitted_cells

    def parse_numbers(self, row: Sequence[str], line_number: int) -> list[float]:
        """Return the numbers in the checked cells of a row, or raise if a cell is not a number."""
        cell_numbers = []
        for column_index in self.checked_column_indices:
            cell = row[column_index].strip()
            if column_index not in self.column_indices_to_read:
                if cell and not is_any_number(cell):
                    raise TableError(
                        f"line {line_number}: column {column_index + 1} is not a number{{cell}}, "
                        "unlike in the lines above; remove the line if it is not a sample.",
                        cell,
                    )
                cell_numbers.append(float("nan"))
                continue
            try:
                cell_numbers.append(parse_number(cell, self.decimal_sign))
            except ValueError:
                raise self._invalid_number_error(cell, column_index, line_number) from None
        return cell_numbers

    def parse_stamp(self, row: Sequence[str], column_index: int, line_number: int) -> float:
        """Return the time stamp in a cell, in seconds since the column's first time stamp."""
        try:
            return self.stamp_readers[column_index](row[column_index])
        except ValueError:
            cell = row[column_index]
        if is_stamp(cell):
            raise TableError(
                f"line {line_number}: '{self.column_name(column_index)}' is of another "
                f"day{{cell}}, and the order of day and month is not clear; write the date as "
                "2026-11-25.",
                cell,
            )
        raise not_a_number_error(line_number, self.column_name(column_index), cell)

    def _invalid_number_error(self, cell: str, column_index: int, line_number: int) -> Exception:
        """Return the error for a cell that is not a number with the expected decimal sign."""
        if self.decimal_sign == POINT and is_number(cell, COMMA):
            if self.layout.column_count == 1:
                return TableError(comma_in_single_message(line_number))
            return _DecimalCommaError()
        if is_number(cell, POINT):
            return TableError(
                f"line {line_number}: '{self.column_name(column_index)}' has a decimal "
                f"point{{cell}}, and other numbers have decimal commas; save the file with one of "
                "them, and without separators between thousands.",
                cell,
            )
        return not_a_number_error(line_number, self.column_name(column_index), cell)

    def check_row_for_thousands(self, row: Sequence[str], line_number: int) -> None:
        """Update the checks for thousands separators with a row."""
        for column_index in tuple(self.thousands_checks):
            if self.thousands_checks[column_index].proves_decimal_sign(
                row[column_index], line_number
            ):
                del self.thousands_checks[column_index]
                self.is_sign_certain = True

    def check_thousands(self) -> None:
        """Raise TableError if a column's decimal signs may be thousands separators."""
        for column_index, thousands_check in self.thousands_checks.items():
            is_ambiguous = thousands_check.has_short_integer or (
                self.decimal_sign == COMMA and not self.is_sign_certain
            )
            if thousands_check.first_grouped_line and is_ambiguous:
                sign_noun = "commas" if self.decimal_sign == COMMA else "points"
                raise TableError(
                    f"line {thousands_check.first_grouped_line}: the {sign_noun} in "
                    f"'{self.column_name(column_index)}' may be decimal signs or separators "
                    "between thousands, as each has three digits behind it; save the file with "
                    "decimal points and without separators between thousands."
                )


def _read_columns(
    stream: BinaryIO,
    encoding: str,
    layout: TableLayout,
    requested_names: Sequence[str],
    max_rows: int,
    decimal_sign: str,
    times_column_index: int | None,
) -> TextTable:
    """Read the requested columns and the column of times, with a given decimal sign."""
    column_indices_to_read = sorted(
        {
            *layout.requested_column_indices,
            *(() if times_column_index is None else (times_column_index,)),
        }
    )
    row_reader = _NumberRowReader(layout, requested_names, decimal_sign, column_indices_to_read)
    values_by_column = {column_index: array("d") for column_index in column_indices_to_read}
    number_appenders = [
        (
            values_by_column[column_index].append,
            row_reader.checked_column_indices.index(column_index),
        )
        for column_index in column_indices_to_read
        if column_index not in row_reader.stamp_readers
    ]
    stamp_appenders = [
        (values_by_column[column_index].append, column_index)
        for column_index in row_reader.stamp_readers
    ]
    pick_cells, convert_cell = (
        itemgetter(*row_reader.checked_column_indices),
        fast_number_converter(decimal_sign),
    )
    has_single_column = len(row_reader.checked_column_indices) == 1
    line_numbers = array("I")
    empty_line_numbers: list[int] = []
    blank_line_number = 0
    with _open_lines(stream, encoding) as text_lines:
        for line_number, row in islice(
            rows_of_cells(_skip_excel_separator_line(text_lines), layout.separator),
            layout.row_count_before_numbers,
            None,
        ):
            if len(row) != layout.column_count:
                if not any(cell.strip() for cell in row) and len(row) < 2:
                    blank_line_number = blank_line_number or line_number
                    continue
                row = row_reader.fit_row(row, line_number)  # noqa: PLW2901 - the row as the table has it
            try:
                row_numbers = (
                    [convert_cell(pick_cells(row))]
                    if has_single_column
                    else list(map(convert_cell, pick_cells(row)))
                )
                if any(
                    "_" in row[column_index] for column_index in row_reader.checked_column_indices
                ):
                    row_numbers = row_reader.parse_numbers(
                        row, line_number
                    )  # Python would read 1_000
            except ValueError:
                if not any(cell.strip() for cell in row):
                    empty_line_numbers.append(line_number)
                    continue
                row_numbers = row_reader.parse_numbers(row, line_number)
            if blank_line_number:
                if layout.column_count == 1:
                    raise TableError(
                        f"line {blank_line_number} is empty, so a value is missing or another "
                        "record begins there; repair or remove it."
                    )
                row_reader.blank_line_number = row_reader.blank_line_number or blank_line_number
                row_reader.blank_interruption_count += 1
                blank_line_number = 0
            if row_reader.thousands_checks:
                row_reader.check_row_for_thousands(row, line_number)
            if empty_line_numbers:
                for column_index in column_indices_to_read:
                    values_by_column[column_index].extend(len(empty_line_numbers) * [float("nan")])
                line_numbers.extend(empty_line_numbers)
                empty_line_numbers = []
            for append_value, cell_index in number_appenders:
                append_value(row_numbers[cell_index])
            for append_value, column_index in stamp_appenders:
                append_value(row_reader.parse_stamp(row, column_index, line_number))
            line_numbers.append(line_number)
            if len(line_numbers) > max_rows:
                break
    row_reader.check_thousands()
    return _build_text_table(
        layout,
        requested_names,
        values_by_column,
        np.frombuffer(line_numbers, np.uint32),
        times_column_index,
        row_reader,
    )


def _skip_excel_separator_line(lines: Iterator[str]) -> Iterator[str]:
    """Yield the lines, with an empty line instead of Excel's separator line (``sep=;``).

    The empty line preserves the numbers of the following lines.
    """
    first_line = next(lines, "")
    yield "\n" if stated_separator(first_line) else first_line
    yield from lines


def _blank_lines_remark(row_reader: _NumberRowReader) -> str:
    """Return the remark on empty lines between the numbers; empty if there are none."""
    if not row_reader.blank_interruption_count:
        return ""
    return (
        "The lines of numbers are interrupted by empty lines, "
        f"{row_reader.blank_interruption_count} times, first in "
        f"line {row_reader.blank_line_number}; they were read as one record without a gap."
    )


def _find_times_column_index(layout: TableLayout, first_lines: Sequence[str]) -> int | None:
    """Return the index of a column of times that is not requested; None if there is none.

    If several columns have such a title or unit, it is the first whose values increase at first.
    """
    candidate_indices = [
        column_index
        for column_index in range(len(layout.first_row_cells))
        if column_index not in layout.requested_column_indices
        and _may_be_times(layout, column_index)
    ]
    if not layout.titles:
        return next(iter(candidate_indices), None)
    first_rows = [
        row
        for _, row in islice(
            rows_of_cells(_skip_excel_separator_line(iter(first_lines)), layout.separator),
            layout.row_count_before_numbers,
            None,
        )
    ]
    for column_index in candidate_indices:
        if are_times(_first_values(first_rows, column_index)):
            return column_index
    return next((c for c in candidate_indices if is_title_of_times(layout.titles[c])), None)


def _may_be_times(layout: TableLayout, column_index: int) -> bool:
    """Return whether a column may have times by its title, its unit and its first cell."""
    first_cell = layout.first_row_cells[column_index]
    if is_stamp(first_cell):
        return True
    if not is_any_number(first_cell):
        return False
    if not layout.titles:
        return column_index == 0
    if is_unit_of_other_quantity(_unit_in_file(layout, column_index)):
        return False
    return (
        is_title_of_times(layout.titles[column_index])
        or _time_unit_s(layout, column_index) is not None
    )


def _first_values(rows: Sequence[Sequence[str]], column_index: int) -> npt.NDArray[np.float64]:
    """Return the numbers or times of day of a column in some rows, without invalid cells."""
    read_stamp = StampReader()
    values = []
    for row in rows:
        cell = row[column_index].strip() if column_index < len(row) else ""
        with suppress(ValueError):
            values.append(
                read_stamp(cell)
                if is_stamp(cell)
                else parse_number(cell, COMMA if COMMA in cell else POINT)
            )
    return np.array(values, dtype=np.float64)


def _time_unit_s(layout: TableLayout, column_index: int) -> float | None:
    """Return the length of a time column's unit in seconds; None if the file states no unit."""
    unit_length_s = time_unit_s(_unit_in_file(layout, column_index))
    if unit_length_s is None and layout.titles and is_title_of_times(layout.titles[column_index]):
        unit_length_s = time_unit_s(layout.titles[column_index].rpartition("_")[2])
    return unit_length_s


def _unit_in_file(layout: TableLayout, column_index: int) -> str:
    """Return the unit of a column that the file states; "s" for times of day."""
    if is_stamp(layout.first_row_cells[column_index]):
        return "s"
    unit_in_row = layout.units[column_index] if layout.units else ""
    unit_in_head = (
        layout.labview_head.head_text("Y_Unit_Label", column_index) if layout.labview_head else ""
    )
    unit_in_title = stated_unit_of(layout.titles[column_index]) if layout.titles else ""
    return unit_in_row or unit_in_head or unit_in_title


def _build_text_table(
    layout: TableLayout,
    requested_names: Sequence[str],
    values_by_column: Mapping[int, "array[float]"],
    line_numbers: npt.NDArray[np.uint32],
    times_column_index: int | None,
    row_reader: _NumberRowReader,
) -> TextTable:
    """Return the values that were read as a table with titles, units, rates and times."""
    table_columns = {}
    for requested_name, column_index in zip(
        requested_names, layout.requested_column_indices, strict=True
    ):
        period_s = start_ns = None
        if layout.labview_head is not None:
            x_dimension = layout.labview_head.head_text("X_Dimension", column_index)
            if x_dimension.lower() not in _TIME_DIMENSIONS:
                raise TableError(
                    f"'{requested_name}' is not a function of time by the X_Dimension of the "
                    f"header{{cell}}; give measured samples.",
                    x_dimension,
                )
            period_s = layout.labview_head.head_number("Delta_X", column_index)
            start_ns = layout.labview_head.start_ns(column_index)
        table_columns[requested_name] = TableColumn(
            values=np.frombuffer(values_by_column[column_index]),
            title=layout.titles[column_index] if layout.titles else "",
            unit=_unit_in_file(layout, column_index),
            rate_hz=1 / period_s if period_s and period_s > 0 else layout.rate_hz,
            start_ns=start_ns,
        )
    table_times = None
    if (
        times_column_index is not None
        and np.isfinite(time_values := np.frombuffer(values_by_column[times_column_index])).any()
    ):
        times_title = (
            layout.titles[times_column_index] if layout.titles else f"#{times_column_index + 1}"
        )
        table_times = TableTimes(times_title, time_values, _time_unit_s(layout, times_column_index))
    return TextTable(
        table_columns,
        line_numbers,
        layout.column_count,
        table_times,
        _blank_lines_remark(row_reader),
    )
