"""Layout of a table: separator, titles, row of units, and the first line of numbers."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Final

from rigd.text_table import _labview
from rigd.text_table._cells import (
    are_split_decimals,
    is_any_number,
    is_comment_row,
    is_date,
    is_row_of_units,
)
from rigd.text_table._errors import MissingColumnError, TableError
from rigd.text_table._head_rates import stated_rate_hz
from rigd.text_table._rows import (
    BLANK_SEPARATOR,
    TextRow,
    has_number,
    has_titles,
    is_row_of_column_numbers,
    is_row_of_numbers,
    is_value,
    row_after,
    rows_after,
    rows_of_cells,
    titles_in_row,
    without_trailing_empty_cells,
)
from rigd.text_table.titles import bare_unit, is_unit, stated_unit_of, titles_by_units

MAX_HEAD_LINES: Final = 500
"""Number of lines at the beginning of a file that are searched for the first line of numbers."""

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
_MAX_LINES_BELOW_TITLES: Final = 6
"""Largest number of lines between the titles and the first line of numbers."""


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Layout of a table in a text file: separator, titles, units and first row of numbers.

    Attributes
    ----------
    separator : str
        Character between cells. A blank means any number of blanks.
    titles : tuple of str
        Title of each column; empty if the table has no titles.
    titles_line_number : int
        Number of the line with the titles; 0 if the table has no titles.
    units : tuple of str
        Units in the row below the titles; "" for an empty cell. Empty if there is no such row.
    column_count : int
        Number of cells in each row.
    optional_column_count : int
        Number of columns at the end that a row may lack, such as the comment in LabVIEW's files.
    row_count_before_numbers : int
        Number of rows before the first row of numbers.
    requested_column_indices : tuple of int
        Indices of the requested columns, in the order of the request.
    first_row_cells : tuple of str
        Cells of the first row of numbers.
    labview_head : LabviewHead or None
        Head of the file if it is a LabVIEW measurement file.
    rate_hz : float or None
        Sampling rate stated in the head of another file; None if there is none.
    """

    separator: str
    titles: tuple[str, ...]
    titles_line_number: int
    units: tuple[str, ...]
    column_count: int
    optional_column_count: int
    row_count_before_numbers: int
    requested_column_indices: tuple[int, ...]
    first_row_cells: tuple[str, ...]
    labview_head: "_labview.LabviewHead | None" = None
    rate_hz: float | None = None


def stated_separator(first_line: str) -> str | None:
    """Return the separator that Excel's line ``sep=;`` states; None for any other line."""
    line_text = first_line.rstrip("\r\n").strip('"')
    is_separator_statement = (
        line_text[: len(_EXCEL_SEPARATOR_LINE)].lower() == _EXCEL_SEPARATOR_LINE
        and len(line_text) == len(_EXCEL_SEPARATOR_LINE) + 1
    )
    return line_text[-1] if is_separator_statement else None


def wrong_width_message(
    line_number: int,
    cell_count: int,
    expected_cell_count: int,
    titles_line_number: int,
    separator: str,
) -> str:
    """Return the error message for a row with too many or too few cells."""
    expected_width_text = (
        f"line {titles_line_number} has {_count_with_noun(expected_cell_count, 'title')}"
        if titles_line_number
        else f"the lines above have {expected_cell_count}"
    )
    separator_name = _SEPARATOR_NAMES.get(separator, repr(separator))
    if cell_count > expected_cell_count:
        cause_text = (
            "decimal commas in a file that separates by commas, an index without a title and a "
            "separator inside a text add cells"
            if separator == ","
            else "an index without a title, or a separator inside a text, adds cells"
        )
        remedy_text = (
            "save the file with another separator or with decimal points, or name each column"
        )
    else:
        cause_text = (
            "a value is missing, a quotation does not end, or the line is not part of the table"
        )
        remedy_text = "repair or remove the line; an unknown value is an empty cell"
    return (
        f"line {line_number} has {_count_with_noun(cell_count, 'cell')} between {separator_name}, "
        f"and {expected_width_text}: {cause_text}; {remedy_text}."
    )


def _count_with_noun(count: int, noun: str) -> str:
    """Return a number with a noun in singular or plural."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def find_layout(lines: Sequence[str], requested_names: Sequence[str]) -> TableLayout:
    """Return the layout of the table in a file, from the first lines of the file.

    There are at most `MAX_HEAD_LINES` lines, with their line ends. Columns are requested by their
    titles, or by numbers such as ``#3`` for the third. Raise `TableError` if there is no such
    table.
    """
    if not any(line_text.strip() for line_text in lines):
        raise TableError("is empty; export the record again.")
    separator_in_file = stated_separator(lines[0])
    if separator_in_file:
        lines = ["\n", *lines[1:]]
    labview_head = _labview.parse_labview_head(lines)
    if labview_head is not None:
        separator_in_file = labview_head.separator
    present_separators = [
        separator_character
        for separator_character in _SEPARATORS
        if any(separator_character in line_text for line_text in lines)
    ]
    candidate_separators = (
        [separator_in_file] if separator_in_file else [*present_separators, BLANK_SEPARATOR]
    )
    failed_attempts: list[_NotThisTableError] = []
    best_layout: TableLayout | None = None
    for separator in candidate_separators:
        try:
            text_rows = [
                TextRow(line_number, [cell.strip() for cell in cells], row_index)
                for row_index, (line_number, cells) in enumerate(rows_of_cells(lines, separator))
            ]
        except csv.Error as error:
            failed_attempts.append(
                _NotThisTableError(_RANK_NO_ROWS, TableError(f"is no table ({error})."))
            )
            continue
        nonempty_rows = [row for row in text_rows if any(row.cells)]
        if labview_head is not None:
            nonempty_rows = [
                row for row in nonempty_rows if row.line_number > labview_head.last_line_number
            ]
        try:
            possible_layout = _layout_with_separator(
                nonempty_rows, separator, requested_names, labview_head
            )
        except _NotThisTableError as failure:
            failure.separator = separator
            failed_attempts.append(failure)
            continue
        if separator == ",":
            _check_split_decimals(text_rows[possible_layout.row_count_before_numbers :])
        if (
            best_layout is None
            or possible_layout.row_count_before_numbers < best_layout.row_count_before_numbers
        ):
            best_layout = possible_layout
    nearest_failure = max(failed_attempts, key=lambda failure: failure.rank, default=None)
    # A table that starts late does not count if earlier lines nearly form a table.
    has_earlier_titles = any(
        failure.rank == _RANK_ALL_TITLES
        and best_layout
        and failure.row_index < best_layout.row_count_before_numbers
        and failure.separator != BLANK_SEPARATOR
        for failure in failed_attempts
    )
    if best_layout is None or has_earlier_titles:
        assert nearest_failure is not None
        raise nearest_failure.error
    if labview_head is None:
        return replace(
            best_layout, rate_hz=stated_rate_hz(lines[: best_layout.row_count_before_numbers])
        )
    return best_layout


class _NotThisTableError(Exception):
    """Error if a text, split at a certain separator, is not the requested table.

    `rank` states how much of the table was found, and `error` is the error for the user.
    """

    def __init__(self, rank: int, error: TableError, row_index: int = MAX_HEAD_LINES) -> None:
        super().__init__()
        self.rank = rank
        self.error = error
        self.row_index = row_index
        self.separator = ""


_RANK_NO_ROWS, _RANK_NO_TITLES, _RANK_SOME_TITLES, _RANK_ALL_TITLES = range(4)
"""Ranks of failures, by how much of the table was found. The failure of the separator with the
highest rank is reported."""


def _layout_with_separator(
    rows: Sequence[TextRow],
    separator: str,
    requested_names: Sequence[str],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout:
    """Return the layout of the table if split at a separator, or raise the most specific error."""
    column_numbers = [_column_number(column_name) for column_name in requested_names]
    requested_titles = [
        column_name
        for column_name, column_number in zip(requested_names, column_numbers, strict=True)
        if column_number is None
    ]
    if not rows:
        raise _NotThisTableError(_RANK_NO_ROWS, TableError("has no lines below its header."))
    first_failure: _NotThisTableError | None = None
    for row_index, row in enumerate(rows):
        if requested_titles and not has_titles(row, requested_titles):
            continue
        try:
            if requested_titles:
                return _layout_below_titles(
                    rows, row_index, separator, requested_names, labview_head
                )
            found_layout = _layout_from_numbers(
                rows, row_index, separator, [n or 0 for n in column_numbers], labview_head
            )
            if found_layout is not None:
                return found_layout
        except _NotThisTableError as failure:
            if failure.row_index == MAX_HEAD_LINES:
                failure.row_index = row.row_index
            if not requested_titles:
                raise
            first_failure = first_failure or failure
    if first_failure is not None:
        raise first_failure
    if requested_titles:
        raise _missing_title_error(rows, requested_titles)
    raise _NotThisTableError(
        _RANK_NO_TITLES
        if max(len(row.cells) for row in rows) >= max(n or 0 for n in column_numbers)
        else 0,
        _no_numbers_error(rows, requested_names),
    )


def _column_number(column_name: str) -> int | None:
    """Return the number in a name such as ``#3``; None for a title."""
    number_text = column_name.removeprefix("#")
    return (
        int(number_text)
        if column_name != number_text and number_text.isdecimal() and int(number_text) > 0
        else None
    )


def _layout_below_titles(
    rows: Sequence[TextRow],
    titles_row_index: int,
    separator: str,
    requested_names: Sequence[str],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout:
    """Return the layout of the table below a row of titles, or raise an error for the user."""
    titles_row = rows[titles_row_index]
    raw_titles, plain_titles = (
        without_trailing_empty_cells(titles_row.cells, 0),
        titles_in_row(titles_row),
    )
    titles = (
        raw_titles
        if all(
            column_name in raw_titles
            for column_name in requested_names
            if _column_number(column_name) is None
        )
        else plain_titles
    )
    # "#" or "%" alone may mark a comment or be the title of an index.
    if len(plain_titles) < len(raw_titles):
        next_row = row_after(rows, titles_row)
        titles = (
            raw_titles
            if next_row is None or len(next_row.cells) == len(raw_titles)
            else plain_titles
        )
    column_count = len(titles)
    column_indices = []
    for column_name in requested_names:
        if titles.count(column_name) > 1:
            raise _NotThisTableError(
                _RANK_ALL_TITLES,
                TableError(
                    f"{titles.count(column_name)} columns are named '{column_name}' (line "
                    f"{titles_row.line_number}); give the number, such as "
                    f"#{titles.index(column_name) + 1} for the first of "
                    "them."
                ),
            )
        column_number = _column_number(column_name)
        if column_name in titles:
            column_indices.append(titles.index(column_name))
        elif column_number is not None and column_number <= column_count:
            column_indices.append(column_number - 1)
        else:
            raise _NotThisTableError(
                _RANK_ALL_TITLES, MissingColumnError(column_name, titles, titles_row.line_number)
            )
    optional_column_count = int(
        labview_head is not None and titles[-1] == _labview.COMMENT_COLUMN_TITLE
    )
    units: Sequence[str] = ()
    cells_above = rows[titles_row_index - 1].cells if titles_row_index else []
    if len(without_trailing_empty_cells(cells_above, column_count)) == column_count and all(
        is_unit(cell) for cell in cells_above if cell
    ):
        units = cells_above
    for row in rows[titles_row_index + 1 : titles_row_index + 2 + _MAX_LINES_BELOW_TITLES]:
        row_cells = without_trailing_empty_cells(row.cells, column_count)
        has_table_width = column_count - optional_column_count <= len(row_cells) <= column_count
        if has_table_width and is_row_of_numbers(row_cells, column_indices, rows_after(rows, row)):
            _check_single_column(row.line_number, row_cells)
            return TableLayout(
                separator=separator,
                titles=tuple(titles),
                titles_line_number=titles_row.line_number,
                units=tuple(bare_unit(cell) for cell in units),
                column_count=column_count,
                optional_column_count=optional_column_count,
                row_count_before_numbers=row.row_index,
                requested_column_indices=tuple(column_indices),
                first_row_cells=tuple(row_cells),
                labview_head=labview_head,
            )
        if (
            len(row_cells) <= column_count
            and not units
            and is_row_of_units(row_cells, column_indices)
        ):
            units = row_cells + [""] * (column_count - len(row_cells))
            continue
        if is_comment_row(row_cells):
            continue
        row_error = _error_for_unexpected_row(
            row, row_cells, column_indices, requested_names, titles_row, column_count, separator
        )
        raise _NotThisTableError(_RANK_ALL_TITLES, row_error, row.row_index)
    raise _NotThisTableError(
        _RANK_ALL_TITLES,
        TableError(
            f"has 0 samples: no line of numbers below the titles in line {titles_row.line_number}."
        ),
    )


def _check_single_column(line_number: int, row_cells: Sequence[str]) -> None:
    """Raise if a row with a single cell contains a comma, which may be a decimal comma."""
    if len(row_cells) == 1 and "," in row_cells[0]:
        raise _NotThisTableError(_RANK_ALL_TITLES, TableError(comma_in_single_message(line_number)))


def comma_in_single_message(line_number: int) -> str:
    """Return the error message for a table of one column with decimal commas."""
    return (
        f"line {line_number} has a comma, which separates two cells, and the table has one "
        "column; save the file with decimal points."
    )


def _error_for_unexpected_row(
    row: TextRow,
    row_cells: Sequence[str],
    column_indices: Sequence[int],
    requested_names: Sequence[str],
    titles_row: TextRow,
    column_count: int,
    separator: str,
) -> TableError:
    """Return the error for a row below the titles that is neither numbers nor units."""
    if len(row_cells) != column_count:
        return TableError(
            wrong_width_message(
                row.line_number, len(row_cells), column_count, titles_row.line_number, separator
            )
        )
    for column_name, column_index in zip(requested_names, column_indices, strict=True):
        if row_cells[column_index] and not is_value(row_cells[column_index]):
            return not_a_number_error(row.line_number, column_name, row_cells[column_index])
    return _texts_above_numbers_error(row)


def _texts_above_numbers_error(row: TextRow) -> TableError:
    """Return the error for a row with texts at the head of a column of numbers."""
    return TableError(
        f"line {row.line_number} has texts where the line below has numbers, and is not a row of "
        "units; remove it."
    )


def not_a_number_error(line_number: int, column_name: str, cell_text: str) -> TableError:
    """Return the error for a cell that should be a number."""
    if is_date(cell_text):
        return TableError(
            f"line {line_number}: '{column_name}' is a date or a time of day{{cell}} that is not "
            "understood; write times as 2026-11-25 12:00:00.001 or in seconds, or leave them out "
            "and state the rate (--rate-hz).",
            cell_text,
        )
    return TableError(
        f"line {line_number}: '{column_name}' is not a number{{cell}}; below the titles and one "
        "line of units only numbers are allowed.",
        cell_text,
    )


def _layout_from_numbers(
    rows: Sequence[TextRow],
    row_index: int,
    separator: str,
    column_numbers: Sequence[int],
    labview_head: "_labview.LabviewHead | None",
) -> TableLayout | None:
    """Return the layout if the row at `row_index` is the first one with numbers; else None.

    The requested columns are given by their numbers.
    """
    row, rows_above = (
        rows[row_index],
        list(takewhile(lambda other_row: other_row.row_index < rows[row_index].row_index, rows)),
    )
    column_indices = [number - 1 for number in column_numbers]
    if is_comment_row(row.cells):
        return None
    if not is_row_of_numbers(
        row.cells, column_indices, rows_after(rows, row)
    ) or is_row_of_column_numbers(rows, row_index):
        filled_column_indices = [c for c in column_indices if c < len(row.cells) and row.cells[c]]
        number_column_indices = [c for c in filled_column_indices if is_any_number(row.cells[c])]
        row_below = row_after(rows, row)
        if (
            number_column_indices
            and len(number_column_indices) < len(filled_column_indices)
            and row_below is not None
            and len(row_below.cells) == len(row.cells)
            and not is_row_of_column_numbers(rows, row_index)
        ):
            column_index = next(c for c in filled_column_indices if c not in number_column_indices)
            raise _NotThisTableError(
                _RANK_ALL_TITLES,
                not_a_number_error(
                    row.line_number, f"#{column_index + 1}", row.cells[column_index]
                ),
            )
        return None
    _check_rows_below_titles(rows_above, column_indices)
    units: Sequence[str] = ()
    last_rows_above = [
        without_trailing_empty_cells(other_row.cells, 0) for other_row in rows_above[-2:]
    ]
    if (
        len(last_rows_above) == 2
        and len(last_rows_above[0]) == len(last_rows_above[1])
        and is_row_of_units(last_rows_above[1], column_indices)
    ):
        units = rows_above.pop().cells
    titles: Sequence[str] = ()
    titles_line_number = 0
    optional_column_count = 0
    if rows_above and len(row.cells) == 1:
        titles, titles_line_number = _title_of_single_column(rows_above)
    elif rows_above and len(titles_in_row(rows_above[-1])) > 1:
        titles, titles_line_number = titles_in_row(rows_above[-1]), rows_above[-1].line_number
        optional_column_count = int(
            labview_head is not None and titles[-1:] == [_labview.COMMENT_COLUMN_TITLE]
        )
    if titles and not units and all(is_unit(title) for title in titles if title):
        units = titles
    row_cells = without_trailing_empty_cells(row.cells, len(titles)) if titles else row.cells
    if titles and not len(titles) - optional_column_count <= len(row_cells) <= len(titles):
        if separator != BLANK_SEPARATOR or len(row_cells) > len(titles):
            raise _NotThisTableError(
                _RANK_ALL_TITLES,
                TableError(
                    wrong_width_message(
                        row.line_number, len(row_cells), len(titles), titles_line_number, separator
                    )
                ),
            )
        # Titles of several words can only be separated behind their units.
        titles = titles_by_units(" ".join(titles))
        if len(titles) != len(row_cells):
            titles, titles_line_number = (), 0
    column_count = len(titles) if titles else len(row_cells)
    _check_single_column(row.line_number, row_cells)
    return TableLayout(
        separator=separator,
        titles=tuple(titles),
        titles_line_number=titles_line_number,
        units=tuple(
            bare_unit(cell) for cell in [*units, *[""] * (column_count - len(units))][:column_count]
        )
        if units
        else (),
        column_count=column_count,
        optional_column_count=optional_column_count,
        row_count_before_numbers=row.row_index,
        requested_column_indices=tuple(column_indices),
        first_row_cells=tuple(row_cells),
        labview_head=labview_head,
    )


def _check_rows_below_titles(rows_above: Sequence[TextRow], column_indices: Sequence[int]) -> None:
    """Raise if a row above the numbers, such as settings or statistics, is below the titles."""
    if len(rows_above) < 2 or not has_number(rows_above[-1], column_indices):
        return
    for row in rows_above[:-1]:
        if len(row.cells) == len(rows_above[-1].cells) and not has_number(row, column_indices):
            raise _NotThisTableError(_RANK_ALL_TITLES, _texts_above_numbers_error(rows_above[-1]))


def _title_of_single_column(rows_above: Sequence[TextRow]) -> tuple[Sequence[str], int]:
    """Return the title of a table of one column, and its line number; nothing if it has none.

    The title is the last line above the numbers that states no sampling rate, as one text. A line
    of several words with a comment mark is a remark unless it names a unit.
    """
    for row in reversed(rows_above):
        words = titles_in_row(row)
        title = " ".join(words).strip('"')
        if stated_rate_hz([title]) is not None:
            continue
        ends_in_unit = (
            len(words) > 1
            and len(words[-1]) > 1
            and is_unit(words[-1])
            and not is_any_number(words[-2])
        )
        if (
            len(words) > 1
            and is_comment_row(row.cells)
            and not (ends_in_unit or stated_unit_of(title))
        ):
            break
        return [title], row.line_number
    return (), 0


def _missing_title_error(
    rows: Sequence[TextRow], requested_names: Sequence[str]
) -> _NotThisTableError:
    """Return the error for a requested title that no row has.

    Its message contains the titles of the row that is most probably the one with titles.
    """

    def count_found_names(row: TextRow) -> int:
        return sum(
            requested_name in row.cells or requested_name in titles_in_row(row)
            for requested_name in requested_names
        )

    likely_titles_row = max(rows, key=count_found_names)
    if count_found_names(likely_titles_row):
        titles = titles_in_row(likely_titles_row)
        missing_name = next(
            title
            for title in requested_names
            if title not in titles and title not in likely_titles_row.cells
        )
        return _NotThisTableError(
            _RANK_SOME_TITLES,
            MissingColumnError(missing_name, titles, likely_titles_row.line_number),
        )
    row_index = next(
        (
            row_index
            for row_index, row in enumerate(rows)
            if all(map(is_any_number, filter(None, row.cells)))
        ),
        None,
    )
    if row_index is None:
        return _NotThisTableError(
            _RANK_NO_ROWS,
            MissingColumnError(requested_names[0], titles_in_row(rows[0]), rows[0].line_number),
        )
    column_count = len(rows[row_index].cells)
    rows_above = [row for row in rows[:row_index] if len(titles_in_row(row)) == column_count]
    if rows_above:
        likely_titles_row = (
            rows_above[-2]
            if len(rows_above) > 1 and is_row_of_units(rows_above[-1].cells, range(column_count))
            else rows_above[-1]
        )
        titles, titles_line_number = titles_in_row(likely_titles_row), likely_titles_row.line_number
    else:
        titles, titles_line_number = (
            [f"#{column_number}" for column_number in range(1, column_count + 1)],
            0,
        )
    return _NotThisTableError(
        _RANK_NO_TITLES if column_count > 1 else _RANK_NO_ROWS,
        MissingColumnError(requested_names[0], titles, titles_line_number),
    )


def _no_numbers_error(rows: Sequence[TextRow], requested_names: Sequence[str]) -> TableError:
    """Return the error for a table that has no row with numbers in the requested columns."""
    max_cell_count = max(len(row.cells) for row in rows)
    for column_name in requested_names:
        if (_column_number(column_name) or 0) > max_cell_count:
            return MissingColumnError(
                column_name, [f"#{n}" for n in range(1, max_cell_count + 1)], 0
            )
    return TableError(
        f"has 0 samples: none of its first {len(rows)} lines has numbers in all of the columns "
        f"{', '.join(requested_names)}."
    )


def _check_split_decimals(rows: Sequence[TextRow]) -> None:
    """Raise TableError if commas in decimal numbers were taken as separators of cells."""
    nonempty_rows = [without_trailing_empty_cells(row.cells, 0) for row in rows if any(row.cells)]
    if are_split_decimals(nonempty_rows):
        raise TableError(
            f"line {rows[0].line_number}: every second cell between commas looks like the decimals "
            "of the one before it; save the file with decimal points, or with semicolons or tabs "
            "between the columns."
        )
