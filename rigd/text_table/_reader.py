"""Reader of the columns of a table, with checks of the cells and the decimal sign."""

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
    ThousandsWatch,
    is_any_number,
    is_number,
    number_of,
    quick_reader,
)
from rigd.text_table._encoding import encodings
from rigd.text_table._errors import TableError
from rigd.text_table._layout import (
    HEAD_LINES,
    TableLayout,
    comma_in_single,
    find_layout,
    fitted,
    not_a_number,
    rows_of,
    stated_separator,
    wrong_width,
)
from rigd.text_table._stamps import StampReader, is_stamp
from rigd.text_table.titles import is_title_of_times, stated_unit_of, time_unit_s

MAX_LINE: Final = 65_536
"""Longest line, characters, enough for hundreds of columns; longer lines are not split."""

_HEAD_BYTES: Final = 4
_HEAD_CHARACTERS: Final = 1_000_000
_X_DIMENSIONS: Final = ("", "time", "zeit")


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column of numbers.

    Attributes
    ----------
    values : ndarray of float, shape (n,)
        NaN for an empty cell.
    title : str
        "" if the table has no titles.
    unit : str
        Unit in the file, "" if none.
    rate_hz : float or None
        Sampling rate in the head of the file, None if there is none.
    start_ns : int or None
        Time of the first sample in the head of the file, ns; None if there is none.
    """

    values: npt.NDArray[np.float64]
    title: str = ""
    unit: str = ""
    rate_hz: float | None = None
    start_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TableTimes:
    """A column of times in addition to the requested columns.

    Attributes
    ----------
    title : str
        Title of the column, or ``#1``.
    values : ndarray of float, shape (n,)
        Times in the unit of the file.
    unit_s : float or None
        Unit in seconds, None if the file does not state it.
    """

    title: str
    values: npt.NDArray[np.float64]
    unit_s: float | None


@dataclass(frozen=True, slots=True)
class TextTable:
    """Requested columns of a text file.

    Attributes
    ----------
    columns : mapping of str to TableColumn
        Columns by requested name; all of the same length.
    lines : ndarray of uint32, shape (n,)
        Line number of each row in the file, from 1.
    width : int
        Number of columns of the table.
    times : TableTimes or None
        A column of times in addition to the requested ones, if any.
    remark : str
        Remark on the file for the user, "" if none.
    """

    columns: Mapping[str, TableColumn]
    lines: npt.NDArray[np.uint32]
    width: int
    times: TableTimes | None = None
    remark: str = ""


def read_table(stream: BinaryIO, names: Sequence[str], *, most_rows: int) -> TextTable:
    r"""Read some columns of a text file.

    The separator is a tab, a semicolon, a comma, a bar or blanks. The decimal sign is a point or a
    comma, the same in the whole file. The titles are the first line with all names and as many
    cells as the lines of numbers below it. A line of units may follow. Every line of numbers has
    the same number of cells, except for empty ones after the last column.

    Parameters
    ----------
    stream : file, open for reading bytes
        The file must be seekable; it is not closed.
    names : sequence of str
        Titles, or ``#3`` for the third column.
    most_rows : int
        Number of rows after which reading ends; one more row is returned if there are more.

    Returns
    -------
    TextTable

    Raises
    ------
    TableError
        If a line does not fit the table; the message has its number and the remedy.

    Examples
    --------
    >>> from io import BytesIO
    >>> from rigd.text_table import read_table
    >>> table = read_table(BytesIO(b"t;angle\ns;rad\n0;0,5\n1;0,7\n"), ["angle"], most_rows=10)
    >>> table.columns["angle"].values.tolist(), table.columns["angle"].unit
    ([0.5, 0.7], 'rad')
    """
    stream.seek(0)
    head = stream.read(_HEAD_BYTES)
    error: UnicodeError | None = None
    for encoding in encodings(head):
        try:
            return _read(stream, encoding, names, most_rows)
        except UnicodeError as found:
            error = error or found
        except csv.Error as found:
            raise TableError(f"is not a table of text ({found}).") from found
    raise TableError("is not text in UTF-8, UTF-16 or Windows-1252; save it as UTF-8.") from error


def _read(stream: BinaryIO, encoding: str, names: Sequence[str], most_rows: int) -> TextTable:
    with _lines(stream, encoding) as lines:
        layout = find_layout(_head(lines), names)
    first = [layout.first[column] for column in layout.columns]
    mark = COMMA if any(COMMA in cell and not is_stamp(cell) for cell in first) else POINT
    try:
        return _columns(stream, encoding, layout, names, most_rows, mark)
    except _DecimalCommaError:
        # Read again from the start: a point in earlier lines may not be a decimal point.
        return _columns(stream, encoding, layout, names, most_rows, COMMA)


def _head(lines: Iterator[str]) -> list[str]:
    """Return the first lines, for the detection of the layout."""
    head: list[str] = []
    characters = 0
    for line in islice(lines, HEAD_LINES):
        head.append(line)
        characters += len(line)
        if characters > _HEAD_CHARACTERS:
            break
    return head


class _DecimalCommaError(Exception):
    """A decimal comma was found while reading with decimal points."""


@contextmanager
def _lines(stream: BinaryIO, encoding: str) -> Iterator[Iterator[str]]:
    """Yield the lines of a text; Excel's statement of the separator becomes an empty line."""
    stream.seek(0)
    text = TextIOWrapper(stream, encoding, newline="")
    try:
        yield _bounded(text)
    finally:
        text.detach()


def _bounded(text: TextIOWrapper) -> Iterator[str]:
    number = 0
    while line := text.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise TableError(
                f"line {number}: a line of more than {MAX_LINE} characters; a table has one line "
                "per sample and few channels. Export the session's channels alone."
            )
        yield line


@dataclass(slots=True)
class _NumberRows:
    """Reader of rows of numbers, each checked against the layout."""

    layout: TableLayout
    names: Sequence[str]
    mark: str
    wanted: Sequence[int]
    """Requested columns."""
    stamps: Mapping[int, StampReader] = field(default_factory=dict)
    """Columns of `wanted` with times of day."""
    checked: Sequence[int] = ()
    """Columns with a number in the first row, requested or not."""
    watches: dict[int, ThousandsWatch] = field(default_factory=dict)
    settled: bool = False
    """Whether a cell has shown that the mark is the decimal sign."""
    blank_line: int = 0
    blank_count: int = 0

    def __post_init__(self) -> None:
        first = self.layout.first
        numeric = (c for c, cell in enumerate(first) if is_any_number(cell))
        self.stamps = {c: StampReader() for c in self.wanted if is_stamp(first[c])}
        self.checked = sorted({*self.wanted, *numeric} - {*self.stamps})
        self.watches = {c: ThousandsWatch(self.mark) for c in self.checked if c in self.wanted}

    def title(self, column: int) -> str:
        """Return the name of a requested column for messages."""
        if column in self.layout.columns:
            return self.names[self.layout.columns.index(column)]
        return f"#{column + 1}"

    def fit(self, row: Sequence[str], line: int) -> list[str]:
        """Return a row with the number of cells of the table, or raise."""
        width = self.layout.width
        cells = fitted(row, width)
        if width - self.layout.optional <= len(cells) < width:
            cells += [""] * (width - len(cells))
        if len(cells) != width:
            raise TableError(
                wrong_width(line, len(cells), width, self.layout.titles_line, self.layout.separator)
            )
        return cells

    def numbers(self, row: Sequence[str], line: int) -> list[float]:
        """Return the numbers of the checked cells of a row; raise for an invalid cell."""
        found = []
        for column in self.checked:
            cell = row[column].strip()
            if column not in self.wanted:
                if cell and not is_any_number(cell):
                    raise TableError(
                        f"line {line}: column {column + 1} is not a number{{cell}}, unlike in the "
                        "lines above; remove the line if it is not a sample.",
                        cell,
                    )
                found.append(float("nan"))
                continue
            try:
                found.append(number_of(cell, self.mark))
            except ValueError:
                raise self._odd(cell, column, line) from None
        return found

    def stamp(self, row: Sequence[str], column: int, line: int) -> float:
        """Return a time of day in seconds after the first one."""
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
        raise not_a_number(line, self.title(column), cell)

    def _odd(self, cell: str, column: int, line: int) -> Exception:
        if self.mark == POINT and is_number(cell, COMMA):
            if self.layout.width == 1:
                return TableError(comma_in_single(line))
            return _DecimalCommaError()
        if is_number(cell, POINT):
            return TableError(
                f"line {line}: '{self.title(column)}' has a decimal point{{cell}}, and other "
                "numbers have decimal commas; save the file with one of them, and without "
                "separators between thousands.",
                cell,
            )
        return not_a_number(line, self.title(column), cell)

    def watch(self, row: Sequence[str], line: int) -> None:
        """Check a row for thousands separators."""
        for column in tuple(self.watches):
            if self.watches[column].settles(row[column], line):
                del self.watches[column]
                self.settled = True

    def check_thousands(self) -> None:
        """Raise for columns whose decimal signs could be thousands separators."""
        for column, watch in self.watches.items():
            doubtful = watch.plain or (self.mark == COMMA and not self.settled)
            if watch.grouped_line and doubtful:
                sign = "commas" if self.mark == COMMA else "points"
                raise TableError(
                    f"line {watch.grouped_line}: the {sign} in '{self.title(column)}' may be "
                    "decimal signs or separators between thousands, as each has three digits "
                    "behind it; save the file with decimal points and without separators between "
                    "thousands."
                )


def _columns(
    stream: BinaryIO,
    encoding: str,
    layout: TableLayout,
    names: Sequence[str],
    most_rows: int,
    mark: str,
) -> TextTable:
    times = _times_column(layout)
    wanted = sorted({*layout.columns, *(() if times is None else (times,))})
    rows = _NumberRows(layout, names, mark, wanted)
    values = {column: array("d") for column in wanted}
    appends = [
        (values[column].append, rows.checked.index(column))
        for column in wanted
        if column not in rows.stamps
    ]
    stamps = [(values[column].append, column) for column in rows.stamps]
    pick, quick = itemgetter(*rows.checked), quick_reader(mark)
    single = len(rows.checked) == 1
    numbers_of_lines = array("I")
    empty: list[int] = []
    blank_line = 0
    with _lines(stream, encoding) as lines:
        for line, row in islice(
            rows_of(_without_statement(lines), layout.separator), layout.skip, None
        ):
            if len(row) != layout.width:
                if not any(cell.strip() for cell in row) and len(row) < 2:
                    blank_line = blank_line or line
                    continue
                row = rows.fit(row, line)  # noqa: PLW2901 - the row as the table has it
            try:
                numbers = [quick(pick(row))] if single else list(map(quick, pick(row)))
                if any("_" in row[column] for column in rows.checked):
                    numbers = rows.numbers(row, line)  # Python would read 1_000
            except ValueError:
                if not any(cell.strip() for cell in row):
                    empty.append(line)
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
            if rows.watches:
                rows.watch(row, line)
            if empty:
                for column in wanted:
                    values[column].extend(len(empty) * [float("nan")])
                numbers_of_lines.extend(empty)
                empty = []
            for append, index in appends:
                append(numbers[index])
            for append, column in stamps:
                append(rows.stamp(row, column, line))
            numbers_of_lines.append(line)
            if len(numbers_of_lines) > most_rows:
                break
    rows.check_thousands()
    return _table(layout, names, values, np.frombuffer(numbers_of_lines, np.uint32), times, rows)


def _without_statement(lines: Iterator[str]) -> Iterator[str]:
    """Replace Excel's statement of the separator by an empty line to preserve line numbers."""
    first = next(lines, "")
    yield "\n" if stated_separator(first) else first
    yield from lines


def _remark(rows: _NumberRows) -> str:
    if not rows.blank_count:
        return ""
    return (
        f"The lines of numbers are interrupted by empty lines, {rows.blank_count} times, first in "
        f"line {rows.blank_line}; they were read as one record without a gap."
    )


def _times_column(layout: TableLayout) -> int | None:
    """Return the index of a column of times that is not requested, or None."""
    for column, cell in enumerate(layout.first):
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
    unit = time_unit_s(_unit(layout, column))
    if unit is None and layout.titles and is_title_of_times(layout.titles[column]):
        unit = time_unit_s(layout.titles[column].rpartition("_")[2])
    return unit


def _unit(layout: TableLayout, column: int) -> str:
    """Return the unit of a column in the file; seconds for times of day."""
    if is_stamp(layout.first[column]):
        return "s"
    in_row = layout.units[column] if layout.units else ""
    in_head = layout.labview.text("Y_Unit_Label", column) if layout.labview else ""
    in_title = stated_unit_of(layout.titles[column]) if layout.titles else ""
    return in_row or in_head or in_title


def _table(
    layout: TableLayout,
    names: Sequence[str],
    values: Mapping[int, "array[float]"],
    lines: npt.NDArray[np.uint32],
    times: int | None,
    rows: _NumberRows,
) -> TextTable:
    columns = {}
    for name, column in zip(names, layout.columns, strict=True):
        period_s = start_ns = None
        if layout.labview is not None:
            dimension = layout.labview.text("X_Dimension", column)
            if dimension.lower() not in _X_DIMENSIONS:
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
            unit=_unit(layout, column),
            rate_hz=1 / period_s if period_s and period_s > 0 else layout.rate_hz,
            start_ns=start_ns,
        )
    found = None
    if times is not None and np.isfinite(stamps := np.frombuffer(values[times])).any():
        title = layout.titles[times] if layout.titles else f"#{times + 1}"
        found = TableTimes(title, stamps, _time_unit_s(layout, times))
    return TextTable(columns, lines, layout.width, found, _remark(rows))
