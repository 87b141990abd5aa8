"""Reader of requested columns of a table, with checks of every cell and of the decimal sign."""

import csv
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    number_of,
)
from rigd.text_table._encoding import encodings
from rigd.text_table._errors import TableError
from rigd.text_table._layout import (
    MAX_HEAD_LINES,
    TableLayout,
    comma_in_single_message,
    find_layout,
    not_a_number_error,
    rows_of_cells,
    stated_separator,
    without_trailing_empty_cells,
    wrong_width_message,
)
from rigd.text_table._stamps import StampReader, is_stamp
from rigd.text_table.titles import is_title_of_times, stated_unit_of, time_unit_s

MAX_LINE_CHARACTERS: Final = 65_536
"""Largest number of characters in a line; a longer line is an error.

It is enough for hundreds of columns."""

_ENCODING_BYTES: Final = 4
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
    lines : ndarray of uint32, shape (n,)
        Number of each row's line in the file, from 1.
    width : int
        Number of columns in the table.
    times : TableTimes or None
        Column of times in addition to the requested columns; None if there is none.
    remark : str
        Remark on the file for the user; empty if there is none.
    """

    columns: Mapping[str, TableColumn]
    lines: npt.NDArray[np.uint32]
    width: int
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
    first_bytes = stream.read(_ENCODING_BYTES)
    last_decoding_error: UnicodeError | None = None
    for possible_encoding in encodings(first_bytes):
        try:
            return _read(stream, possible_encoding, requested_names, max_rows)
        except UnicodeError as found:
            last_decoding_error = last_decoding_error or found
        except csv.Error as found:
            raise TableError(f"is not a table of text ({found}).") from found
    raise TableError(
        "is not text in UTF-8, UTF-16 or Windows-1252; save it as UTF-8."
    ) from last_decoding_error


def _read(
    stream: BinaryIO, encoding: str, requested_names: Sequence[str], max_rows: int
) -> TextTable:
    """Read columns of a text with a given encoding."""
    with _open_lines(stream, encoding) as text_lines:
        table_layout = find_layout(_first_lines(text_lines), requested_names)
    first_cells = [table_layout.first_cells[column_index] for column_index in table_layout.columns]
    decimal_sign = (
        COMMA if any(COMMA in cell and not is_stamp(cell) for cell in first_cells) else POINT
    )
    try:
        return _read_columns(
            stream, encoding, table_layout, requested_names, max_rows, decimal_sign
        )
    except _DecimalCommaError:
        # Read again from the start: a point in earlier lines may not be a decimal point.
        return _read_columns(stream, encoding, table_layout, requested_names, max_rows, COMMA)


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
class _NumberRows:
    """Reader of rows of numbers that checks each row against the layout of the table."""

    layout: TableLayout
    requested_names: Sequence[str]
    decimal_sign: str
    """Decimal sign of the numbers."""
    columns_to_read: Sequence[int]
    """Indices of the columns to read, which are the requested ones and a column of times."""
    stamps: Mapping[int, StampReader] = field(default_factory=dict)
    """Readers of the columns to read that contain times of day."""
    checked_columns: Sequence[int] = ()
    """Indices of the columns with a number in the first row, whether requested or not."""
    thousands_checks: dict[int, ThousandsCheck] = field(default_factory=dict)
    """Checks for thousands separators in the columns to read."""
    sign_is_certain: bool = False
    """Whether a cell has shown that the expected sign is the decimal sign."""
    blank_line: int = 0
    """Number of the first empty line between lines of numbers; 0 if there is none."""
    blank_count: int = 0
    """Number of interruptions of the numbers by empty lines."""

    def __post_init__(self) -> None:
        first_cells = self.layout.first_cells
        number_columns = (c for c, cell in enumerate(first_cells) if is_any_number(cell))
        self.stamps = {c: StampReader() for c in self.columns_to_read if is_stamp(first_cells[c])}
        self.checked_columns = sorted({*self.columns_to_read, *number_columns} - {*self.stamps})
        self.thousands_checks = {
            c: ThousandsCheck(self.decimal_sign)
            for c in self.checked_columns
            if c in self.columns_to_read
        }

    def title(self, column_index: int) -> str:
        """Return the name of a requested column for messages; its number if it has no name."""
        if column_index in self.layout.columns:
            return self.requested_names[self.layout.columns.index(column_index)]
        return f"#{column_index + 1}"

    def fit(self, row: Sequence[str], line_number: int) -> list[str]:
        """Return a row with empty cells cut or added at its end to fit the table's columns.

        Raise TableError if this does not make it fit.
        """
        column_count = self.layout.width
        fitted_cells = without_trailing_empty_cells(row, column_count)
        if column_count - self.layout.optional_columns <= len(fitted_cells) < column_count:
            fitted_cells += [""] * (column_count - len(fitted_cells))
        if len(fitted_cells) != column_count:
            raise TableError(
                wrong_width_message(
                    line_number,
                    len(fitted_cells),
                    column_count,
                    self.layout.titles_line,
                    self.layout.separator,
                )
            )
        return fitted_cells

    def numbers(self, row: Sequence[str], line_number: int) -> list[float]:
        """Return the numbers in the checked cells of a row, or raise if a cell is not a number."""
        cell_numbers = []
        for column_index in self.checked_columns:
            cell = row[column_index].strip()
            if column_index not in self.columns_to_read:
                if cell and not is_any_number(cell):
                    raise TableError(
                        f"line {line_number}: column {column_index + 1} is not a number{{cell}}, "
                        "unlike in the lines above; remove the line if it is not a sample.",
                        cell,
                    )
                cell_numbers.append(float("nan"))
                continue
            try:
                cell_numbers.append(number_of(cell, self.decimal_sign))
            except ValueError:
                raise self._invalid_number_error(cell, column_index, line_number) from None
        return cell_numbers

    def stamp(self, row: Sequence[str], column_index: int, line_number: int) -> float:
        """Return the time stamp in a cell, in seconds since the column's first time stamp."""
        try:
            return self.stamps[column_index](row[column_index])
        except ValueError:
            cell = row[column_index]
        if is_stamp(cell):
            raise TableError(
                f"line {line_number}: '{self.title(column_index)}' is of another day{{cell}}, and "
                "the order of day and month is not clear; write the date as 2026-11-25.",
                cell,
            )
        raise not_a_number_error(line_number, self.title(column_index), cell)

    def _invalid_number_error(self, cell: str, column_index: int, line_number: int) -> Exception:
        """Return the error for a cell that is not a number with the expected decimal sign."""
        if self.decimal_sign == POINT and is_number(cell, COMMA):
            if self.layout.width == 1:
                return TableError(comma_in_single_message(line_number))
            return _DecimalCommaError()
        if is_number(cell, POINT):
            return TableError(
                f"line {line_number}: '{self.title(column_index)}' has a decimal point{{cell}}, "
                "and other numbers have decimal commas; save the file with one of them, and "
                "without "
                "separators between thousands.",
                cell,
            )
        return not_a_number_error(line_number, self.title(column_index), cell)

    def check_row_for_thousands(self, row: Sequence[str], line_number: int) -> None:
        """Update the checks for thousands separators with a row."""
        for column_index in tuple(self.thousands_checks):
            if self.thousands_checks[column_index].proves_decimal_sign(
                row[column_index], line_number
            ):
                del self.thousands_checks[column_index]
                self.sign_is_certain = True

    def check_thousands(self) -> None:
        """Raise TableError if a column's decimal signs may be thousands separators."""
        for column_index, thousands_check in self.thousands_checks.items():
            is_ambiguous = thousands_check.has_short_integer or (
                self.decimal_sign == COMMA and not self.sign_is_certain
            )
            if thousands_check.first_grouped_line and is_ambiguous:
                sign_noun = "commas" if self.decimal_sign == COMMA else "points"
                raise TableError(
                    f"line {thousands_check.first_grouped_line}: the {sign_noun} in "
                    f"'{self.title(column_index)}' may be decimal signs or separators between "
                    "thousands, as each has three digits behind it; save the file with decimal "
                    "points and "
                    "without separators between thousands."
                )


def _read_columns(
    stream: BinaryIO,
    encoding: str,
    layout: TableLayout,
    requested_names: Sequence[str],
    max_rows: int,
    decimal_sign: str,
) -> TextTable:
    """Read the requested columns and the column of times, with a given decimal sign."""
    times_column = _times_column(layout)
    columns_to_read = sorted({*layout.columns, *(() if times_column is None else (times_column,))})
    number_rows = _NumberRows(layout, requested_names, decimal_sign, columns_to_read)
    values_by_column = {column_index: array("d") for column_index in columns_to_read}
    number_appends = [
        (values_by_column[column_index].append, number_rows.checked_columns.index(column_index))
        for column_index in columns_to_read
        if column_index not in number_rows.stamps
    ]
    stamp_appends = [
        (values_by_column[column_index].append, column_index) for column_index in number_rows.stamps
    ]
    pick_cells, convert_cell = (
        itemgetter(*number_rows.checked_columns),
        fast_number_converter(decimal_sign),
    )
    has_single_column = len(number_rows.checked_columns) == 1
    line_numbers = array("I")
    empty_lines: list[int] = []
    blank_line = 0
    with _open_lines(stream, encoding) as text_lines:
        for line_number, row in islice(
            rows_of_cells(_skip_excel_separator_line(text_lines), layout.separator),
            layout.rows_before_numbers,
            None,
        ):
            if len(row) != layout.width:
                if not any(cell.strip() for cell in row) and len(row) < 2:
                    blank_line = blank_line or line_number
                    continue
                row = number_rows.fit(row, line_number)  # noqa: PLW2901 - the row as the table has it
            try:
                numbers = (
                    [convert_cell(pick_cells(row))]
                    if has_single_column
                    else list(map(convert_cell, pick_cells(row)))
                )
                if any("_" in row[column_index] for column_index in number_rows.checked_columns):
                    numbers = number_rows.numbers(row, line_number)  # Python would read 1_000
            except ValueError:
                if not any(cell.strip() for cell in row):
                    empty_lines.append(line_number)
                    continue
                numbers = number_rows.numbers(row, line_number)
            if blank_line:
                if layout.width == 1:
                    raise TableError(
                        f"line {blank_line} is empty, so a value is missing or another record "
                        "begins there; repair or remove it."
                    )
                number_rows.blank_line = number_rows.blank_line or blank_line
                number_rows.blank_count += 1
                blank_line = 0
            if number_rows.thousands_checks:
                number_rows.check_row_for_thousands(row, line_number)
            if empty_lines:
                for column_index in columns_to_read:
                    values_by_column[column_index].extend(len(empty_lines) * [float("nan")])
                line_numbers.extend(empty_lines)
                empty_lines = []
            for append_value, cell_index in number_appends:
                append_value(numbers[cell_index])
            for append_value, column_index in stamp_appends:
                append_value(number_rows.stamp(row, column_index, line_number))
            line_numbers.append(line_number)
            if len(line_numbers) > max_rows:
                break
    number_rows.check_thousands()
    return _text_table(
        layout,
        requested_names,
        values_by_column,
        np.frombuffer(line_numbers, np.uint32),
        times_column,
        number_rows,
    )


def _skip_excel_separator_line(lines: Iterator[str]) -> Iterator[str]:
    """Yield the lines, with an empty line instead of Excel's separator line (``sep=;``).

    The empty line preserves the numbers of the following lines.
    """
    first_line = next(lines, "")
    yield "\n" if stated_separator(first_line) else first_line
    yield from lines


def _blank_lines_remark(rows: _NumberRows) -> str:
    """Return the remark on empty lines between the numbers; empty if there are none."""
    if not rows.blank_count:
        return ""
    return (
        f"The lines of numbers are interrupted by empty lines, {rows.blank_count} times, first in "
        f"line {rows.blank_line}; they were read as one record without a gap."
    )


def _times_column(layout: TableLayout) -> int | None:
    """Return the index of a column of times that is not requested; None if there is none."""
    for column_index, cell in enumerate(layout.first_cells):
        if column_index in layout.columns or not (is_any_number(cell) or is_stamp(cell)):
            continue
        if is_stamp(cell):
            return column_index
        if not layout.titles:
            return column_index if column_index == 0 else None
        column_title = layout.titles[column_index]
        if is_title_of_times(column_title) or _time_unit_s(layout, column_index) is not None:
            return column_index
    return None


def _time_unit_s(layout: TableLayout, column_index: int) -> float | None:
    """Return the length of a time column's unit in seconds; None if the file states no unit."""
    unit_length_s = time_unit_s(_unit_in_file(layout, column_index))
    if unit_length_s is None and layout.titles and is_title_of_times(layout.titles[column_index]):
        unit_length_s = time_unit_s(layout.titles[column_index].rpartition("_")[2])
    return unit_length_s


def _unit_in_file(layout: TableLayout, column_index: int) -> str:
    """Return the unit of a column that the file states; "s" for times of day."""
    if is_stamp(layout.first_cells[column_index]):
        return "s"
    unit_in_row = layout.units[column_index] if layout.units else ""
    unit_in_head = layout.labview.text("Y_Unit_Label", column_index) if layout.labview else ""
    unit_in_title = stated_unit_of(layout.titles[column_index]) if layout.titles else ""
    return unit_in_row or unit_in_head or unit_in_title


def _text_table(
    layout: TableLayout,
    requested_names: Sequence[str],
    values_by_column: Mapping[int, "array[float]"],
    line_numbers: npt.NDArray[np.uint32],
    times_column: int | None,
    rows: _NumberRows,
) -> TextTable:
    """Return the values that were read as a table with titles, units, rates and times."""
    table_columns = {}
    for requested_name, column_index in zip(requested_names, layout.columns, strict=True):
        period_s = start_ns = None
        if layout.labview is not None:
            x_dimension = layout.labview.text("X_Dimension", column_index)
            if x_dimension.lower() not in _TIME_DIMENSIONS:
                raise TableError(
                    f"'{requested_name}' is not a function of time by the X_Dimension of the "
                    f"header{{cell}}; give measured samples.",
                    x_dimension,
                )
            period_s = layout.labview.number("Delta_X", column_index)
            start_ns = layout.labview.start_ns(column_index)
        table_columns[requested_name] = TableColumn(
            values=np.frombuffer(values_by_column[column_index]),
            title=layout.titles[column_index] if layout.titles else "",
            unit=_unit_in_file(layout, column_index),
            rate_hz=1 / period_s if period_s and period_s > 0 else layout.rate_hz,
            start_ns=start_ns,
        )
    table_times = None
    if (
        times_column is not None
        and np.isfinite(time_values := np.frombuffer(values_by_column[times_column])).any()
    ):
        times_title = layout.titles[times_column] if layout.titles else f"#{times_column + 1}"
        table_times = TableTimes(times_title, time_values, _time_unit_s(layout, times_column))
    return TextTable(
        table_columns, line_numbers, layout.width, table_times, _blank_lines_remark(rows)
    )
