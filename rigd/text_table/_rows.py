"""Rows of a text table: their cells, and whether these are titles, numbers or texts."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import dropwhile, islice
from typing import Final

from rigd.text_table._cells import is_any_number, without_comment_mark
from rigd.text_table._stamps import is_stamp

BLANK_SEPARATOR: Final = " "
"""Separator that means any number of blanks."""
_TEXT_CHECK_ROWS: Final = 20
"""Number of rows below a row with texts that are read to decide whether it belongs to the
numbers."""
_NUMBERING_CHECK_ROWS: Final = 5
"""Number of rows below a row 1, 2, 3, … that are read to decide whether it numbers the columns."""


@dataclass(frozen=True, slots=True)
class TextRow:
    """Row of cells: one line of a file, or several lines if quoted cells contain line breaks.

    Attributes
    ----------
    line_number : int
        Number of the row's first line, from 1.
    cells : list of str
        Texts of the cells without surrounding blanks.
    row_index : int
        Number of rows before this one, including empty rows.
    """

    line_number: int
    cells: list[str]
    row_index: int


def rows_of_cells(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a text: number of the row's first line, and its cells."""
    if separator == BLANK_SEPARATOR:
        for line_number, row_cells in enumerate(lines, 1):
            yield line_number, row_cells.split()
        return
    csv_reader = csv.reader(lines, delimiter=separator)
    lines_before_row = 0
    for row in csv_reader:
        yield lines_before_row + 1, row
        lines_before_row = csv_reader.line_num


def without_trailing_empty_cells(row: Sequence[str], column_count: int) -> list[str]:
    """Return a row without the empty cells that follow the last column."""
    row_cells = list(row)
    while len(row_cells) > column_count and not row_cells[-1].strip():
        row_cells.pop()
    return row_cells


def titles_in_row(row: TextRow) -> list[str]:
    """Return the titles in a row without a leading comment mark and trailing empty titles."""
    title_cells = without_trailing_empty_cells(row.cells, 0)
    if title_cells and title_cells[0] in (
        "#",
        "%",
    ):  # with blanks as separator the mark is a separate cell
        return title_cells[1:]
    return [
        without_comment_mark(cell) if not cell_index else cell
        for cell_index, cell in enumerate(title_cells)
    ]


def has_titles(row: TextRow, requested_titles: Iterable[str]) -> bool:
    """Return whether a row contains all of the requested titles."""
    return all(
        requested_title in row.cells or requested_title in titles_in_row(row)
        for requested_title in requested_titles
    )


def row_after(rows: Sequence[TextRow], earlier_row: TextRow) -> TextRow | None:
    """Return the row after a given one; None if it is the last."""
    return next(iter(rows_after(rows, earlier_row)), None)


def rows_after(rows: Sequence[TextRow], earlier_row: TextRow) -> Sequence[TextRow]:
    """Return the rows after a given one, at most `_TEXT_CHECK_ROWS`."""
    later_rows = (row for row in rows if row.row_index > earlier_row.row_index)
    return list(islice(later_rows, _TEXT_CHECK_ROWS))


def is_value(cell: str) -> bool:
    """Return whether a cell is a number or a time stamp."""
    return is_any_number(cell) or is_stamp(cell)


def is_row_of_numbers(
    row_cells: Sequence[str], column_indices: Sequence[int], rows_below: Sequence[TextRow]
) -> bool:
    """Return whether a row is one of the table's rows of numbers.

    It must have numbers in the requested columns, and no text at the head of a column of numbers.
    """
    if max(column_indices) >= len(row_cells):
        return False
    requested_cells = [
        row_cells[column_index] for column_index in column_indices if row_cells[column_index]
    ]
    if not all(map(is_value, requested_cells)):
        return False
    if not any(map(is_any_number, row_cells)):
        return False
    return not any(
        cell
        and not is_value(cell)
        and _are_numbers_below(
            [row.cells[column_index] if column_index < len(row.cells) else "" for row in rows_below]
        )
        for column_index, cell in enumerate(row_cells)
    )


def _are_numbers_below(cells: Sequence[str]) -> bool:
    """Return whether cells below a text are numbers: the first, or all from the first number."""
    cells_from_value = list(dropwhile(lambda cell: not is_value(cell), cells))
    return bool(cells_from_value) and (
        len(cells_from_value) == len(cells) or all(map(is_value, cells_from_value))
    )


def has_number(row: TextRow, column_indices: Sequence[int]) -> bool:
    """Return whether a row has a number in one of the columns."""
    return any(is_any_number(row.cells[c]) for c in column_indices if c < len(row.cells))


def is_row_of_column_numbers(text_rows: Sequence[TextRow], row_index: int) -> bool:
    """Return whether a row is the first one and contains the column numbers instead of data.

    This is the case if it counts from 0 or 1, and no row below contains only integers.
    """
    filled_cells = [cell for cell in text_rows[row_index].cells if cell]
    if row_index or len(filled_cells) < 2:
        return False
    counts_upwards = any(
        filled_cells == [str(first_number + n) for n in range(len(filled_cells))]
        for first_number in (0, 1)
    )
    rows_below = text_rows[1 : 1 + _NUMBERING_CHECK_ROWS]
    return (
        counts_upwards
        and bool(rows_below)
        and not any(
            all(cell.lstrip("+-").isdecimal() for cell in row.cells if cell) for row in rows_below
        )
    )
