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
    MOST_HEAD_LINES,
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

MOST_LINE_CHARACTERS: Final = 65_536
"""Largest number of characters in a line; a longer line is an error.

It is enough for hundreds of columns."""

_ENCODING_BYTES: Final = 4
"""Number of bytes from which the encoding is detected."""
_MOST_HEAD_CHARACTERS: Final = 1_000_000
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


def read_table(stream: BinaryIO, names: Sequence[str], *, most_rows: int) -> TextTable:
    r"""Read some columns of a table of numbers in a text file.

    The separator is a tab, a semicolon, a comma, a bar or blanks. The decimal sign is a point or a
    comma, the same in the whole file. The titles are the first line that contains all names and has
    as many cells as the lines of numbers below it. A line of units may follow. Every line of
    numbers has the same number of cells, except for empty cells after the last column.

    Parameters
    ----------
    stream : file, open for reading bytes
        The file must be seekable; it is not closed.
    names : sequence of str
        Titles of the requested columns, or numbers such as ``#3`` for the third column.
    most_rows : int
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
    >>> table = read_table(BytesIO(b"t;angle\ns;rad\n0;0,5\n1;0,7\n"), ["angle"], most_rows=10)
    >>> table.columns["angle"].values.tolist(), table.columns["angle"].unit
    ([0.5, 0.7], 'rad')
    """
    stream.seek(0)
    first_bytes = stream.read(_ENCODING_BYTES)
    error: UnicodeError | None = None
    for encoding in encodings(first_bytes):
        try:
            return _read(stream, encoding, names, most_rows)
        except UnicodeError as found:
            error = error or found
        except csv.Error as found:
            raise TableError(f"is not a table of text ({found}).") from found
    raise TableError("is not text in UTF-8, UTF-16 or Windows-1252; save it as UTF-8.") from error


def _read(stream: BinaryIO, encoding: str, names: Sequence[str], most_rows: int) -> TextTable:
    """Read columns of a text with a given encoding."""
    with _open_lines(stream, encoding) as lines:
        layout = find_layout(_first_lines(lines), names)
    first_cells = [layout.first_cells[column] for column in layout.columns]
    decimal_sign = (
        COMMA if any(COMMA in cell and not is_stamp(cell) for cell in first_cells) else POINT
    )
    try:
        return _read_columns(stream, encoding, layout, names, most_rows, decimal_sign)
    except _DecimalCommaError:
        # Read again from the start: a point in earlier lines may not be a decimal point.
        return _read_columns(stream, encoding, layout, names, most_rows, COMMA)


def _first_lines(lines: Iterator[str]) -> list[str]:
    """Return the first lines of a file, from which the layout is detected."""
    first_lines: list[str] = []
    characters = 0
    for line in islice(lines, MOST_HEAD_LINES):
        first_lines.append(line)
        characters += len(line)
        if characters > _MOST_HEAD_CHARACTERS:
            break
    return first_lines


class _DecimalCommaError(Exception):
    """Error: a decimal comma was found while numbers were read with decimal points."""


@contextmanager
def _open_lines(stream: BinaryIO, encoding: str) -> Iterator[Iterator[str]]:
    """Provide the lines of a text file, decoded, as a context manager."""
    stream.seek(0)
    text = TextIOWrapper(stream, encoding, newline="")
    try:
        yield _lines_of_bounded_length(text)
    finally:
        text.detach()


def _lines_of_bounded_length(text: TextIOWrapper) -> Iterator[str]:
    """Yield the lines of a text, and raise TableError for a line that is too long."""
    number = 0
    while line := text.readline(MOST_LINE_CHARACTERS + 1):
        number += 1
        if len(line) > MOST_LINE_CHARACTERS:
            raise TableError(
                f"line {number}: a line of more than {MOST_LINE_CHARACTERS} characters; a table "
                "has one line per sample and few channels. Export the session's channels alone."
            )
        yield line


@dataclass(slots=True)
class _NumberRows:
    """Reader of rows of numbers that checks each row against the layout of the table."""

    layout: TableLayout
    names: Sequence[str]
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
    """Number of the first empty line between lines of numbers; 0 without one."""
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

    def title(self, column: int) -> str:
        """Return the name of a requested column for messages; its number if it has no name."""
        if column in self.layout.columns:
            return self.names[self.layout.columns.index(column)]
        return f"#{column + 1}"

    def fit(self, row: Sequence[str], line: int) -> list[str]:
        """Return a row with the table's number of cells, or raise TableError."""
        width = self.layout.width
        cells = without_trailing_empty_cells(row, width)
        if width - self.layout.optional_columns <= len(cells) < width:
            cells += [""] * (width - len(cells))
        if len(cells) != width:
            raise TableError(
                wrong_width_message(
                    line, len(cells), width, self.layout.titles_line, self.layout.separator
                )
            )
        return cells

    def numbers(self, row: Sequence[str], line: int) -> list[float]:
        """Return the numbers in the checked cells of a row, or raise if a cell is not a number."""
        values = []
        for column in self.checked_columns:
            cell = row[column].strip()
            if column not in self.columns_to_read:
                if cell and not is_any_number(cell):
                    raise TableError(
                        f"line {line}: column {column + 1} is not a number{{cell}}, unlike in the "
                        "lines above; remove the line if it is not a sample.",
                        cell,
                    )
                values.append(float("nan"))
                continue
            try:
                values.append(number_of(cell, self.decimal_sign))
            except ValueError:
                raise self._invalid_number_error(cell, column, line) from None
        return values

    def stamp(self, row: Sequence[str], column: int, line: int) -> float:
        """Return the time stamp in a cell, in seconds since the column's first time stamp."""
        try:
            return self.stamps[column](row[column])
        except ValueError:
            cell = row[column]
        if is_stamp(cell):
            raise TableError(
                f"line {line}: '{self.title(column)}' is of another day{{cell}}, and the order of "
                "day and month is not clear; write the date as 2026-11-25.",
                cell,
            )
        raise not_a_number_error(line, self.title(column), cell)

    def _invalid_number_error(self, cell: str, column: int, line: int) -> Exception:
        """Return the error for a cell that is not a number with the expected decimal sign."""
        if self.decimal_sign == POINT and is_number(cell, COMMA):
            if self.layout.width == 1:
                return TableError(comma_in_single_message(line))
            return _DecimalCommaError()
        if is_number(cell, POINT):
            return TableError(
                f"line {line}: '{self.title(column)}' has a decimal point{{cell}}, and other "
                "numbers have decimal commas; save the file with one of them, and without "
                "separators between thousands.",
                cell,
            )
        return not_a_number_error(line, self.title(column), cell)

    def check_row_for_thousands(self, row: Sequence[str], line: int) -> None:
        """Update the checks for thousands separators with a row."""
        for column in tuple(self.thousands_checks):
            if self.thousands_checks[column].proves_decimal_sign(row[column], line):
                del self.thousands_checks[column]
                self.sign_is_certain = True

    def check_thousands(self) -> None:
        """Raise TableError if a column's decimal signs may be thousands separators."""
        for column, thousands_check in self.thousands_checks.items():
            is_ambiguous = thousands_check.plain or (
                self.decimal_sign == COMMA and not self.sign_is_certain
            )
            if thousands_check.grouped_line and is_ambiguous:
                sign_noun = "commas" if self.decimal_sign == COMMA else "points"
                raise TableError(
                    f"line {thousands_check.grouped_line}: the {sign_noun} in "
                    f"'{self.title(column)}' may be decimal signs or separators between thousands, "
                    "as each has three digits behind it; save the file with decimal points and "
                    "without separators between thousands."
                )


def _read_columns(
    stream: BinaryIO,
    encoding: str,
    layout: TableLayout,
    names: Sequence[str],
    most_rows: int,
    decimal_sign: str,
) -> TextTable:
    """Read the requested columns and the column of times, with a given decimal sign."""
    times_column = _times_column(layout)
    columns_to_read = sorted({*layout.columns, *(() if times_column is None else (times_column,))})
    rows = _NumberRows(layout, names, decimal_sign, columns_to_read)
    values = {column: array("d") for column in columns_to_read}
    number_appends = [
        (values[column].append, rows.checked_columns.index(column))
        for column in columns_to_read
        if column not in rows.stamps
    ]
    stamp_appends = [(values[column].append, column) for column in rows.stamps]
    pick_cells, convert = itemgetter(*rows.checked_columns), fast_number_converter(decimal_sign)
    has_single_column = len(rows.checked_columns) == 1
    line_numbers = array("I")
    empty_lines: list[int] = []
    blank_line = 0
    with _open_lines(stream, encoding) as lines:
        for line, row in islice(
            rows_of_cells(_skip_excel_separator_line(lines), layout.separator),
            layout.rows_before_numbers,
            None,
        ):
            if len(row) != layout.width:
                if not any(cell.strip() for cell in row) and len(row) < 2:
                    blank_line = blank_line or line
                    continue
                row = rows.fit(row, line)  # noqa: PLW2901 - the row as the table has it
            try:
                numbers = (
                    [convert(pick_cells(row))]
                    if has_single_column
                    else list(map(convert, pick_cells(row)))
                )
                if any("_" in row[column] for column in rows.checked_columns):
                    numbers = rows.numbers(row, line)  # Python would read 1_000
            except ValueError:
                if not any(cell.strip() for cell in row):
                    empty_lines.append(line)
                    continue
                numbers = rows.numbers(row, line)
            if blank_line:
                if layout.width == 1:
                    raise TableError(
                        f"line {blank_line} is empty, so a value is missing or another record "
                        "begins there; repair or remove it."
                    )
                rows.blank_line = rows.blank_line or blank_line
                rows.blank_count += 1
                blank_line = 0
            if rows.thousands_checks:
                rows.check_row_for_thousands(row, line)
            if empty_lines:
                for column in columns_to_read:
                    values[column].extend(len(empty_lines) * [float("nan")])
                line_numbers.extend(empty_lines)
                empty_lines = []
            for append, index in number_appends:
                append(numbers[index])
            for append, column in stamp_appends:
                append(rows.stamp(row, column, line))
            line_numbers.append(line)
            if len(line_numbers) > most_rows:
                break
    rows.check_thousands()
    return _text_table(
        layout, names, values, np.frombuffer(line_numbers, np.uint32), times_column, rows
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
    for column, cell in enumerate(layout.first_cells):
        if column in layout.columns or not (is_any_number(cell) or is_stamp(cell)):
            continue
        if is_stamp(cell):
            return column
        if not layout.titles:
            return column if column == 0 else None
        title = layout.titles[column]
        if is_title_of_times(title) or _time_unit_s(layout, column) is not None:
            return column
    return None


def _time_unit_s(layout: TableLayout, column: int) -> float | None:
    """Return the length of a time column's unit in seconds; None if the file states no unit."""
    unit = time_unit_s(_unit_in_file(layout, column))
    if unit is None and layout.titles and is_title_of_times(layout.titles[column]):
        unit = time_unit_s(layout.titles[column].rpartition("_")[2])
    return unit


def _unit_in_file(layout: TableLayout, column: int) -> str:
    """Return the unit of a column that the file states; "s" for times of day."""
    if is_stamp(layout.first_cells[column]):
        return "s"
    in_row = layout.units[column] if layout.units else ""
    in_head = layout.labview.text("Y_Unit_Label", column) if layout.labview else ""
    in_title = stated_unit_of(layout.titles[column]) if layout.titles else ""
    return in_row or in_head or in_title


def _text_table(
    layout: TableLayout,
    names: Sequence[str],
    values: Mapping[int, "array[float]"],
    lines: npt.NDArray[np.uint32],
    times_column: int | None,
    rows: _NumberRows,
) -> TextTable:
    """Return the table from the values that were read."""
    columns = {}
    for name, column in zip(names, layout.columns, strict=True):
        period_s = start_ns = None
        if layout.labview is not None:
            dimension = layout.labview.text("X_Dimension", column)
            if dimension.lower() not in _TIME_DIMENSIONS:
                raise TableError(
                    f"'{name}' is not a function of time by the X_Dimension of the head{{cell}}; "
                    "give measured samples.",
                    dimension,
                )
            period_s = layout.labview.number("Delta_X", column)
            start_ns = layout.labview.start_ns(column)
        columns[name] = TableColumn(
            values=np.frombuffer(values[column]),
            title=layout.titles[column] if layout.titles else "",
            unit=_unit_in_file(layout, column),
            rate_hz=1 / period_s if period_s and period_s > 0 else layout.rate_hz,
            start_ns=start_ns,
        )
    table_times = None
    if (
        times_column is not None
        and np.isfinite(time_values := np.frombuffer(values[times_column])).any()
    ):
        title = layout.titles[times_column] if layout.titles else f"#{times_column + 1}"
        table_times = TableTimes(title, time_values, _time_unit_s(layout, times_column))
    return TextTable(columns, lines, layout.width, table_times, _blank_lines_remark(rows))
