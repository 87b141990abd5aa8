"""Layout of a table: separator, titles, row of units, and the first line of numbers."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Final

from rigd.text_table import _labview
from rigd.text_table._cells import (
    are_split_decimals,
    is_any_number,
    is_comment,
    is_date,
    is_row_of_units,
    without_comment_mark,
)
from rigd.text_table._errors import MissingColumnError, TableError
from rigd.text_table._head_rates import stated_rate_hz
from rigd.text_table._stamps import is_stamp
from rigd.text_table.titles import bare_unit, is_unit

MOST_HEAD_LINES: Final = 500
"""Number of lines at the beginning of a file in which the first line of numbers must be."""

BLANK_SEPARATOR: Final = " "
"""Separator that means any number of blanks."""
_SEPARATORS: Final = ("\t", ";", ",", "|")
"""Characters that may separate cells, without blanks."""
_SEPARATOR_NAMES: Final = {
    "\t": "tabs",
    ";": "semicolons",
    ",": "commas",
    "|": "bars",
    BLANK_SEPARATOR: "blanks",
}
"""Names of the separators in messages."""
_EXCEL_SEPARATOR_LINE: Final = "sep="
"""Beginning of the line with which Excel states the separator."""
_MOST_LINES_BELOW_TITLES: Final = 6
"""Largest number of lines between the titles and the first line of numbers."""
_NUMBERING_LINES: Final = 5
"""Number of rows below a row 1, 2, 3, … that are examined to find out if it numbers the columns."""


@dataclass(frozen=True, slots=True)
class TextRow:
    """Row of cells: one line of a file, or several lines with a line break inside quotes.

    Attributes
    ----------
    line : int
        Number of the row's first line, from 1.
    cells : list of str
        Texts of the cells without surrounding blanks.
    index : int
        Number of rows before this one, including empty rows.
    """

    line: int
    cells: list[str]
    index: int


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Layout of a table in a text file: separator, titles, units and first row of numbers.

    Attributes
    ----------
    separator : str
        Character between cells. A blank means any number of blanks.
    titles : tuple of str
        Title of each column; empty if the table has no titles.
    titles_line : int
        Number of the line with the titles; 0 if the table has no titles.
    units : tuple of str
        Units in the row below the titles; "" for an empty cell. Empty if there is no such row.
    width : int
        Number of cells in each row.
    optional_columns : int
        Number of columns at the end that a row may lack, such as the comment in LabVIEW's files.
    rows_before_numbers : int
        Number of rows before the first row of numbers.
    columns : tuple of int
        Indices of the requested columns, in the order of the request.
    first_cells : tuple of str
        Cells of the first row of numbers.
    labview : LabviewHead or None
        Head of the file if it is a LabVIEW measurement file.
    rate_hz : float or None
        Sampling rate stated in the head of another file; None if there is none.
    """

    separator: str
    titles: tuple[str, ...]
    titles_line: int
    units: tuple[str, ...]
    width: int
    optional_columns: int
    rows_before_numbers: int
    columns: tuple[int, ...]
    first_cells: tuple[str, ...]
    labview: "_labview.LabviewHead | None" = None
    rate_hz: float | None = None


def stated_separator(first_line: str) -> str | None:
    """Return the separator that Excel's line ``sep=;`` states; None for any other line."""
    text = first_line.rstrip("\r\n").strip('"')
    is_statement = (
        text[: len(_EXCEL_SEPARATOR_LINE)].lower() == _EXCEL_SEPARATOR_LINE
        and len(text) == len(_EXCEL_SEPARATOR_LINE) + 1
    )
    return text[-1] if is_statement else None


def rows_of_cells(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a text: number of the row's first line, and its cells."""
    if separator == BLANK_SEPARATOR:
        for number, line in enumerate(lines, 1):
            yield number, line.split()
        return
    csv_reader = csv.reader(lines, delimiter=separator)
    lines_before = 0
    for row in csv_reader:
        yield lines_before + 1, row
        lines_before = csv_reader.line_num


def without_trailing_empty_cells(row: Sequence[str], column_count: int) -> list[str]:
    """Return a row without the empty cells that follow the last column."""
    cells = list(row)
    while len(cells) > column_count and not cells[-1].strip():
        cells.pop()
    return cells


def wrong_width_message(
    line: int, cells: int, layout_width: int, titles_line: int, separator: str
) -> str:
    """Return the error message for a row with too many or too few cells."""
    expected_width = (
        f"line {titles_line} has {_count_with_noun(layout_width, 'title')}"
        if titles_line
        else f"the lines above have {layout_width}"
    )
    separator_name = _SEPARATOR_NAMES.get(separator, repr(separator))
    if cells > layout_width:
        cause = (
            "decimal commas in a file that separates by commas, an index without a title and a "
            "separator inside a text add cells"
            if separator == ","
            else "an index without a title, or a separator inside a text, adds cells"
        )
        remedy = "save the file with another separator or with decimal points, or name each column"
    else:
        cause = "a value is missing, a quotation does not end, or the line is not part of the table"
        remedy = "repair or remove the line; an unknown value is an empty cell"
    return (
        f"line {line} has {_count_with_noun(cells, 'cell')} between {separator_name}, and "
        f"{expected_width}: {cause}; {remedy}."
    )


def _count_with_noun(count: int, noun: str) -> str:
    """Return a number with a noun in singular or plural."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def find_layout(lines: Sequence[str], names: Sequence[str]) -> TableLayout:
    """Return the layout of the table in a file, from the first lines of the file.

    Parameters
    ----------
    lines : sequence of str
        First lines with their line ends, at most `MOST_HEAD_LINES`.
    names : sequence of str
        Titles of the requested columns, or numbers such as ``#3`` for the third column.

    Raises
    ------
    TableError
        If the file contains no table with these columns.
    """
    if not any(line.strip() for line in lines):
        raise TableError("is empty; export the record again.")
    separator_in_file = stated_separator(lines[0])
    if separator_in_file:
        lines = ["\n", *lines[1:]]
    labview_head = _labview.head_of(lines)
    if labview_head is not None:
        separator_in_file = labview_head.separator
    present_separators = [
        character for character in _SEPARATORS if any(character in line for line in lines)
    ]
    candidates = (
        [separator_in_file] if separator_in_file else [*present_separators, BLANK_SEPARATOR]
    )
    failures: list[_NotThisTableError] = []
    best_layout: TableLayout | None = None
    for separator in candidates:
        try:
            rows = [
                TextRow(line, [cell.strip() for cell in cells], index)
                for index, (line, cells) in enumerate(rows_of_cells(lines, separator))
            ]
        except csv.Error as error:
            failures.append(
                _NotThisTableError(_RANK_NO_ROWS, TableError(f"is no table ({error})."))
            )
            continue
        nonempty_rows = [row for row in rows if any(row.cells)]
        if labview_head is not None:
            nonempty_rows = [row for row in nonempty_rows if row.line > labview_head.last_line]
        try:
            layout = _layout_with_separator(nonempty_rows, separator, names, labview_head)
        except _NotThisTableError as unlikely:
            unlikely.separator = separator
            failures.append(unlikely)
            continue
        if separator == ",":
            _check_split_decimals(rows[layout.rows_before_numbers :], layout)
        if best_layout is None or layout.rows_before_numbers < best_layout.rows_before_numbers:
            best_layout = layout
    nearest_failure = max(failures, key=lambda failure: failure.rank, default=None)
    # A table that starts late does not count if earlier lines nearly form a table.
    has_earlier_titles = any(
        failed_layout.rank == _RANK_ALL_TITLES
        and best_layout
        and failed_layout.index < best_layout.rows_before_numbers
        and failed_layout.separator != BLANK_SEPARATOR
        for failed_layout in failures
    )
    if best_layout is None or has_earlier_titles:
        assert nearest_failure is not None
        raise nearest_failure.error
    if labview_head is None:
        return replace(
            best_layout, rate_hz=stated_rate_hz(lines[: best_layout.rows_before_numbers])
        )
    return best_layout


class _NotThisTableError(Exception):
    """Error: with a certain separator, the text is not the requested table.

    `rank` states how much of the table was found, and `error` is the error for the user.
    """

    def __init__(self, rank: int, error: TableError, row_index: int = MOST_HEAD_LINES) -> None:
        super().__init__()
        self.rank = rank
        self.error = error
        self.index = row_index
        self.separator = ""


_RANK_NO_ROWS, _RANK_NO_TITLES, _RANK_SOME_TITLES, _RANK_ALL_TITLES = range(4)
"""Ranks of failures. The error of the failure with the highest rank is reported."""


def _layout_with_separator(
    rows: Sequence[TextRow],
    separator: str,
    names: Sequence[str],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout:
    """Return the layout of the table for a given separator, or raise the most specific error."""
    column_numbers = [_column_number(name) for name in names]
    requested_titles = [
        name for name, number in zip(names, column_numbers, strict=True) if number is None
    ]
    if not rows:
        raise _NotThisTableError(_RANK_NO_ROWS, TableError("has no lines below its head."))
    failure: _NotThisTableError | None = None
    for index, row in enumerate(rows):
        if requested_titles and not _has_titles(row, requested_titles):
            continue
        try:
            if requested_titles:
                return _layout_below_titles(rows, index, separator, names, labview_head)
            layout = _layout_from_numbers(
                rows, index, separator, [n or 0 for n in column_numbers], labview_head
            )
            if layout is not None:
                return layout
        except _NotThisTableError as unlikely:
            if unlikely.index == MOST_HEAD_LINES:
                unlikely.index = row.index
            if not requested_titles:
                raise
            failure = failure or unlikely
    if failure is not None:
        raise failure
    if requested_titles:
        raise _missing_title_error(rows, requested_titles)
    raise _NotThisTableError(
        _RANK_NO_TITLES
        if max(len(row.cells) for row in rows) >= max(n or 0 for n in column_numbers)
        else 0,
        _no_numbers_error(rows, names),
    )


def _column_number(name: str) -> int | None:
    """Return the number in a name such as ``#3``; None for a title."""
    digits = name.removeprefix("#")
    return int(digits) if name != digits and digits.isdecimal() and int(digits) > 0 else None


def _plain_titles(row: TextRow) -> list[str]:
    """Return a row's titles without a comment mark and without empty titles at the end."""
    cells = without_trailing_empty_cells(row.cells, 0)
    if cells and cells[0] in ("#", "%"):  # with blanks as separator the mark is a separate cell
        return cells[1:]
    return [without_comment_mark(cell) if not index else cell for index, cell in enumerate(cells)]


def _has_titles(row: TextRow, names: Iterable[str]) -> bool:
    """Return whether a row contains all of the requested titles."""
    return all(name in row.cells or name in _plain_titles(row) for name in names)


def _layout_below_titles(
    rows: Sequence[TextRow],
    index: int,
    separator: str,
    names: Sequence[str],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout:
    """Return the layout of the table below a row of titles."""
    titles_row = rows[index]
    raw_titles, plain_titles = (
        without_trailing_empty_cells(titles_row.cells, 0),
        _plain_titles(titles_row),
    )
    titles = (
        raw_titles
        if all(name in raw_titles for name in names if _column_number(name) is None)
        else plain_titles
    )
    # "#" or "%" alone may mark a comment or be the title of an index.
    if len(plain_titles) < len(raw_titles):
        next_row = _next_row(rows, titles_row)
        titles = (
            raw_titles
            if next_row is None or len(next_row.cells) == len(raw_titles)
            else plain_titles
        )
    width = len(titles)
    columns = []
    for name in names:
        if titles.count(name) > 1:
            raise _NotThisTableError(
                _RANK_ALL_TITLES,
                TableError(
                    f"{titles.count(name)} columns are named '{name}' (line {titles_row.line}); "
                    f"give the number, such as #{titles.index(name) + 1} for the first of them."
                ),
            )
        number = _column_number(name)
        if name in titles:
            columns.append(titles.index(name))
        elif number is not None and number <= width:
            columns.append(number - 1)
        else:
            raise _NotThisTableError(
                _RANK_ALL_TITLES, MissingColumnError(name, titles, titles_row.line)
            )
    optional_columns = int(labview_head is not None and titles[-1] == _labview.COMMENT_TITLE)
    units: Sequence[str] = ()
    cells_above = rows[index - 1].cells if index else []
    if len(without_trailing_empty_cells(cells_above, width)) == width and all(
        is_unit(cell) for cell in cells_above if cell
    ):
        units = cells_above
    for row in rows[index + 1 : index + 2 + _MOST_LINES_BELOW_TITLES]:
        cells = without_trailing_empty_cells(row.cells, width)
        has_table_width = width - optional_columns <= len(cells) <= width
        if has_table_width and _is_data(cells, columns, _next_row(rows, row)):
            _check_single_column(row.line, cells)
            return TableLayout(
                separator=separator,
                titles=tuple(titles),
                titles_line=titles_row.line,
                units=tuple(bare_unit(cell) for cell in units),
                width=width,
                optional_columns=optional_columns,
                rows_before_numbers=row.index,
                columns=tuple(columns),
                first_cells=tuple(cells),
                labview=labview_head,
            )
        if len(cells) <= width and not units and is_row_of_units(cells, columns):
            units = cells + [""] * (width - len(cells))
            continue
        if is_comment(cells):
            continue
        error = _error_for_unexpected_row(row, cells, columns, names, titles_row, width, separator)
        raise _NotThisTableError(_RANK_ALL_TITLES, error, row.index)
    raise _NotThisTableError(
        _RANK_ALL_TITLES,
        TableError(
            f"has 0 samples: no line of numbers below the titles in line {titles_row.line}."
        ),
    )


def _check_single_column(line: int, cells: Sequence[str]) -> None:
    """Raise if a row with a single cell contains a comma, which may be a decimal comma."""
    if len(cells) == 1 and "," in cells[0]:
        raise _NotThisTableError(_RANK_ALL_TITLES, TableError(comma_in_single_message(line)))


def comma_in_single_message(line: int) -> str:
    """Return the error message for a table of one column with decimal commas."""
    return (
        f"line {line} has a comma, which separates two cells, and the table has one column; save "
        "the file with decimal points."
    )


def _next_row(rows: Sequence[TextRow], row: TextRow) -> TextRow | None:
    """Return the row after a given one; None if it is the last."""
    return next((other for other in rows if other.index > row.index), None)


def _is_data(cells: Sequence[str], columns: Sequence[int], next_row: TextRow | None) -> bool:
    """Return whether a row is one of numbers.

    It must have numbers in the requested columns, and no text where the next row has a number.
    """
    if max(columns) >= len(cells):
        return False
    requested_cells = [cells[column] for column in columns if cells[column]]
    if not all(is_any_number(cell) or is_stamp(cell) for cell in requested_cells):
        return False
    if not any(map(is_any_number, cells)):
        return False
    return next_row is None or not any(
        cell and not is_any_number(cell) and is_any_number(cell_below)
        for cell, cell_below in zip(cells, next_row.cells, strict=False)
    )


def _error_for_unexpected_row(
    row: TextRow,
    cells: Sequence[str],
    columns: Sequence[int],
    names: Sequence[str],
    titles_row: TextRow,
    width: int,
    separator: str,
) -> TableError:
    """Return the error for a row below the titles that is neither numbers nor units."""
    if len(cells) != width:
        return TableError(
            wrong_width_message(row.line, len(cells), width, titles_row.line, separator)
        )
    for name, column in zip(names, columns, strict=True):
        if cells[column] and not is_any_number(cells[column]) and not is_stamp(cells[column]):
            return not_a_number_error(row.line, name, cells[column])
    return TableError(
        f"line {row.line} has texts where the line below has numbers, and is no row of units; "
        "remove it."
    )


def not_a_number_error(line: int, name: str, cell: str) -> TableError:
    """Return the error for a cell that should be a number."""
    if is_date(cell):
        return TableError(
            f"line {line}: '{name}' is a date or a time of day{{cell}} that is not understood; "
            "write times as 2026-11-25 12:00:00.001 or in seconds, or leave them out and state the "
            "rate (--rate-hz).",
            cell,
        )
    return TableError(
        f"line {line}: '{name}' is not a number{{cell}}; below the titles and one line of units "
        "only numbers are allowed.",
        cell,
    )


def _layout_from_numbers(
    rows: Sequence[TextRow],
    index: int,
    separator: str,
    numbers: Sequence[int],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout | None:
    """Return the layout if a row is the first one with numbers; None if it is not.

    The requested columns are given by their numbers.
    """
    row, rows_above = (
        rows[index],
        list(takewhile(lambda other_row: other_row.index < rows[index].index, rows)),
    )
    columns = [number - 1 for number in numbers]
    if is_comment(row.cells):
        return None
    if not _is_data(row.cells, columns, _next_row(rows, row)) or _is_row_of_column_numbers(
        rows, index
    ):
        filled_columns = [c for c in columns if c < len(row.cells) and row.cells[c]]
        number_columns = [c for c in filled_columns if is_any_number(row.cells[c])]
        row_below = _next_row(rows, row)
        if (
            number_columns
            and len(number_columns) < len(filled_columns)
            and row_below is not None
            and len(row_below.cells) == len(row.cells)
            and not _is_row_of_column_numbers(rows, index)
        ):
            column = next(c for c in filled_columns if c not in number_columns)
            raise _NotThisTableError(
                _RANK_ALL_TITLES, not_a_number_error(row.line, f"#{column + 1}", row.cells[column])
            )
        return None
    units: Sequence[str] = ()
    last_rows_above = [
        without_trailing_empty_cells(other_row.cells, 0) for other_row in rows_above[-2:]
    ]
    if (
        len(last_rows_above) == 2
        and len(last_rows_above[0]) == len(last_rows_above[1])
        and is_row_of_units(last_rows_above[1], columns)
    ):
        units = rows_above.pop().cells
    titles: Sequence[str] = ()
    titles_line = 0
    optional_columns = 0
    if rows_above and (len(_plain_titles(rows_above[-1])) > 1 or len(row.cells) == 1):
        titles, titles_line = _plain_titles(rows_above[-1]), rows_above[-1].line
        optional_columns = int(labview_head is not None and titles[-1:] == [_labview.COMMENT_TITLE])
    if titles and not units and all(is_unit(title) for title in titles if title):
        units = titles
    cells = without_trailing_empty_cells(row.cells, len(titles)) if titles else row.cells
    if titles and not len(titles) - optional_columns <= len(cells) <= len(titles):
        if separator != BLANK_SEPARATOR or len(cells) > len(titles):
            raise _NotThisTableError(
                _RANK_ALL_TITLES,
                TableError(
                    wrong_width_message(row.line, len(cells), len(titles), titles_line, separator)
                ),
            )
        titles, titles_line = (), 0  # titles of several words cannot be separated
    width = len(titles) if titles else len(cells)
    _check_single_column(row.line, cells)
    return TableLayout(
        separator=separator,
        titles=tuple(titles),
        titles_line=titles_line,
        units=tuple(bare_unit(cell) for cell in [*units, *[""] * (width - len(units))][:width])
        if units
        else (),
        width=width,
        optional_columns=optional_columns,
        rows_before_numbers=row.index,
        columns=tuple(columns),
        first_cells=tuple(cells),
        labview=labview_head,
    )


def _is_row_of_column_numbers(rows: Sequence[TextRow], index: int) -> bool:
    """Return whether the first row contains the numbers of the columns instead of data.

    This is the case if it counts from 0 or 1, and no row below contains only integers.
    """
    cells = [cell for cell in rows[index].cells if cell]
    if index or len(cells) < 2:
        return False
    counts_upwards = any(cells == [str(first + n) for n in range(len(cells))] for first in (0, 1))
    rows_below = rows[1 : 1 + _NUMBERING_LINES]
    return (
        counts_upwards
        and bool(rows_below)
        and not any(
            all(cell.lstrip("+-").isdecimal() for cell in row.cells if cell) for row in rows_below
        )
    )


def _missing_title_error(rows: Sequence[TextRow], names: Sequence[str]) -> _NotThisTableError:
    """Return the error for a missing title, with the titles of the most probable row."""

    def count_found_names(row: TextRow) -> int:
        return sum(name in row.cells or name in _plain_titles(row) for name in names)

    best_row = max(rows, key=count_found_names)
    if count_found_names(best_row):
        titles = _plain_titles(best_row)
        name = next(title for title in names if title not in titles and title not in best_row.cells)
        return _NotThisTableError(
            _RANK_SOME_TITLES, MissingColumnError(name, titles, best_row.line)
        )
    index = next(
        (
            index
            for index, row in enumerate(rows)
            if all(map(is_any_number, filter(None, row.cells)))
        ),
        None,
    )
    if index is None:
        return _NotThisTableError(
            _RANK_NO_ROWS, MissingColumnError(names[0], _plain_titles(rows[0]), rows[0].line)
        )
    width = len(rows[index].cells)
    rows_above = [row for row in rows[:index] if len(_plain_titles(row)) == width]
    if rows_above:
        best_row = (
            rows_above[-2]
            if len(rows_above) > 1 and is_row_of_units(rows_above[-1].cells, range(width))
            else rows_above[-1]
        )
        titles, line = _plain_titles(best_row), best_row.line
    else:
        titles, line = [f"#{number}" for number in range(1, width + 1)], 0
    return _NotThisTableError(
        _RANK_NO_TITLES if width > 1 else _RANK_NO_ROWS, MissingColumnError(names[0], titles, line)
    )


def _no_numbers_error(rows: Sequence[TextRow], names: Sequence[str]) -> TableError:
    """Return the error for a table that has no row with numbers in the requested columns."""
    width = max(len(row.cells) for row in rows)
    for name in names:
        if (_column_number(name) or 0) > width:
            return MissingColumnError(name, [f"#{n}" for n in range(1, width + 1)], 0)
    return TableError(
        f"has 0 samples: none of its first {len(rows)} lines has numbers in all of the columns "
        f"{', '.join(names)}."
    )


def _check_split_decimals(rows: Sequence[TextRow], layout: TableLayout) -> None:
    """Raise TableError if commas in decimal numbers were taken as separators of cells."""
    nonempty_rows = [
        without_trailing_empty_cells(row.cells, layout.width) for row in rows if any(row.cells)
    ]
    if are_split_decimals(nonempty_rows):
        raise TableError(
            f"line {rows[0].line}: every second cell between commas looks like the decimals of the "
            "one before it; save the file with decimal points, or with semicolons or tabs between "
            "the columns."
        )
