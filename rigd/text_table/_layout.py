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

HEAD_LINES: Final = 500
"""Largest line number of the first line of numbers."""

BLANKS: Final = " "
_SEPARATORS: Final = ("\t", ";", ",", "|")
_NAMES: Final = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "bars", BLANKS: "blanks"}
_EXCEL: Final = "sep="
_BETWEEN: Final = 6
"""Largest number of lines between the titles and the first line of numbers."""
_NUMBERING_LINES: Final = 5


@dataclass(frozen=True, slots=True)
class TextRow:
    """A row of cells: one line of the file, or several with line breaks in a quoted cell.

    Attributes
    ----------
    line : int
        Number of its first line, from 1.
    cells : list of str
        Cells without surrounding blanks.
    index : int
        Number of rows before it, including empty ones.
    """

    line: int
    cells: list[str]
    index: int


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Layout of a table in a text.

    Attributes
    ----------
    separator : str
        Character between cells; a blank means any number of blanks.
    titles : tuple of str
        Title of each column, empty without titles.
    titles_line : int
        Line of the titles, 0 without titles.
    units : tuple of str
        Units of the row below the titles, "" for an empty cell.
    width : int
        Number of cells of each line.
    optional : int
        Number of optional columns at the end: the comment of LabVIEW's text files.
    skip : int
        Number of rows before the first row of numbers.
    columns : tuple of int
        Indices of the requested columns, in their order.
    first : tuple of str
        Cells of the first row of numbers.
    labview : LabviewHead or None
        Head of a LabVIEW measurement file.
    rate_hz : float or None
        Sampling rate in another head.
    """

    separator: str
    titles: tuple[str, ...]
    titles_line: int
    units: tuple[str, ...]
    width: int
    optional: int
    skip: int
    columns: tuple[int, ...]
    first: tuple[str, ...]
    labview: "_labview.LabviewHead | None" = None
    rate_hz: float | None = None


def stated_separator(first_line: str) -> str | None:
    """Return the separator of Excel's line ``sep=;``, None for another line."""
    text = first_line.rstrip("\r\n").strip('"')
    is_statement = text[: len(_EXCEL)].lower() == _EXCEL and len(text) == len(_EXCEL) + 1
    return text[-1] if is_statement else None


def rows_of(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the first line and the cells of each row."""
    if separator == BLANKS:
        for number, line in enumerate(lines, 1):
            yield number, line.split()
        return
    reader = csv.reader(lines, delimiter=separator)
    before = 0
    for row in reader:
        yield before + 1, row
        before = reader.line_num


def fitted(row: Sequence[str], width: int) -> list[str]:
    """Return a row without the empty cells after the last column."""
    cells = list(row)
    while len(cells) > width and not cells[-1].strip():
        cells.pop()
    return cells


def wrong_width(line: int, cells: int, layout_width: int, titles_line: int, separator: str) -> str:
    """Return the message for a line with too many or too few cells."""
    table = (
        f"line {titles_line} has {_counted(layout_width, 'title')}"
        if titles_line
        else f"the lines above have {layout_width}"
    )
    between = _NAMES.get(separator, repr(separator))
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
        f"line {line} has {_counted(cells, 'cell')} between {between}, and {table}: {cause}; "
        f"{remedy}."
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def find_layout(lines: Sequence[str], names: Sequence[str]) -> TableLayout:
    """Find the table in the first lines of a file.

    Parameters
    ----------
    lines : sequence of str
        At most `HEAD_LINES`, with their ends.
    names : sequence of str
        Titles of the requested columns, or ``#3`` for the third.

    Raises
    ------
    TableError
        If there is no such table.
    """
    if not any(line.strip() for line in lines):
        raise TableError("is empty; export the record again.")
    stated = stated_separator(lines[0])
    if stated:
        lines = ["\n", *lines[1:]]
    labview = _labview.head_of(lines)
    if labview is not None:
        stated = labview.separator
    present = [mark for mark in _SEPARATORS if any(mark in line for line in lines)]
    candidates = [stated] if stated else [*present, BLANKS]
    failures: list[_UnlikelyError] = []
    found: TableLayout | None = None
    for separator in candidates:
        try:
            rows = [
                TextRow(line, [cell.strip() for cell in cells], index)
                for index, (line, cells) in enumerate(rows_of(lines, separator))
            ]
        except csv.Error as error:
            failures.append(_UnlikelyError(_NO_ROWS, TableError(f"is no table ({error}).")))
            continue
        written = [row for row in rows if any(row.cells)]
        if labview is not None:
            written = [row for row in written if row.line > labview.last_line]
        try:
            layout = _layout(written, separator, names, labview)
        except _UnlikelyError as unlikely:
            unlikely.separator = separator
            failures.append(unlikely)
            continue
        if separator == ",":
            _check_split_decimals(rows[layout.skip :], layout)
        if found is None or layout.skip < found.skip:
            found = layout
    worst = max(failures, key=lambda failure: failure.rank, default=None)
    # A table that starts late does not count if earlier lines nearly form a table.
    early = any(
        each.rank == _TITLES and found and each.index < found.skip and each.separator != BLANKS
        for each in failures
    )
    if found is None or early:
        assert worst is not None
        raise worst.error
    if labview is None:
        return replace(found, rate_hz=stated_rate_hz(lines[: found.skip]))
    return found


class _UnlikelyError(Exception):
    """Separator with which the text is not the requested table; `rank`: how near it is."""

    def __init__(self, rank: int, error: TableError, index: int = HEAD_LINES) -> None:
        super().__init__()
        self.rank = rank
        self.error = error
        self.index = index
        self.separator = ""


_NO_ROWS, _NO_TITLES, _SOME_TITLES, _TITLES = range(4)
"""Ranks of failures: the message of the highest rank is shown."""


def _layout(
    rows: Sequence[TextRow],
    separator: str,
    names: Sequence[str],
    labview: "_labview.LabviewHead | None",
) -> TableLayout:
    numbers = [_number(name) for name in names]
    titled = [name for name, number in zip(names, numbers, strict=True) if number is None]
    if not rows:
        raise _UnlikelyError(_NO_ROWS, TableError("has no lines below its head."))
    failure: _UnlikelyError | None = None
    for index, row in enumerate(rows):
        if titled and not _has_titles(row, titled):
            continue
        try:
            if titled:
                return _below_titles(rows, index, separator, names, labview)
            found = _with_numbers(rows, index, separator, [n or 0 for n in numbers], labview)
            if found is not None:
                return found
        except _UnlikelyError as unlikely:
            if unlikely.index == HEAD_LINES:
                unlikely.index = row.index
            if not titled:
                raise
            failure = failure or unlikely
    if failure is not None:
        raise failure
    if titled:
        raise _missing(rows, titled)
    raise _UnlikelyError(
        _NO_TITLES if max(len(row.cells) for row in rows) >= max(n or 0 for n in numbers) else 0,
        _no_numbers(rows, names),
    )


def _number(name: str) -> int | None:
    """Return 3 for ``#3``, None for a title."""
    digits = name.removeprefix("#")
    return int(digits) if name != digits and digits.isdecimal() and int(digits) > 0 else None


def _plain_titles(row: TextRow) -> list[str]:
    """Return the titles of a row without comment mark and without empty titles at the end."""
    cells = fitted(row.cells, 0)
    if cells and cells[0] in ("#", "%"):  # with blanks as separator the mark is a separate cell
        return cells[1:]
    return [without_comment_mark(cell) if not index else cell for index, cell in enumerate(cells)]


def _has_titles(row: TextRow, names: Iterable[str]) -> bool:
    return all(name in row.cells or name in _plain_titles(row) for name in names)


def _below_titles(
    rows: Sequence[TextRow],
    index: int,
    separator: str,
    names: Sequence[str],
    labview: "_labview.LabviewHead | None",
) -> TableLayout:
    """Return the layout of the table whose titles are in one row."""
    head = rows[index]
    raw, plain = fitted(head.cells, 0), _plain_titles(head)
    titles = raw if all(name in raw for name in names if _number(name) is None) else plain
    if len(plain) < len(raw):  # a single mark may be that of a comment or the title of an index
        below = _next(rows, head)
        titles = raw if below is None or len(below.cells) == len(raw) else plain
    width = len(titles)
    columns = []
    for name in names:
        if titles.count(name) > 1:
            raise _UnlikelyError(
                _TITLES,
                TableError(
                    f"{titles.count(name)} columns are named '{name}' (line {head.line}); give the "
                    f"number, such as #{titles.index(name) + 1} for the first of them."
                ),
            )
        number = _number(name)
        if name in titles:
            columns.append(titles.index(name))
        elif number is not None and number <= width:
            columns.append(number - 1)
        else:
            raise _UnlikelyError(_TITLES, MissingColumnError(name, titles, head.line))
    optional = int(labview is not None and titles[-1] == _labview.COMMENT)
    units: Sequence[str] = ()
    above = rows[index - 1].cells if index else []
    if len(fitted(above, width)) == width and all(is_unit(cell) for cell in above if cell):
        units = above
    for row in rows[index + 1 : index + 2 + _BETWEEN]:
        cells = fitted(row.cells, width)
        fits = width - optional <= len(cells) <= width
        if fits and _is_data(cells, columns, _next(rows, row)):
            _check_single(row.line, cells)
            return TableLayout(
                separator=separator,
                titles=tuple(titles),
                titles_line=head.line,
                units=tuple(bare_unit(cell) for cell in units),
                width=width,
                optional=optional,
                skip=row.index,
                columns=tuple(columns),
                first=tuple(cells),
                labview=labview,
            )
        if len(cells) <= width and not units and is_row_of_units(cells, columns):
            units = cells + [""] * (width - len(cells))
            continue
        if is_comment(cells):
            continue
        error = _not_data(row, cells, columns, names, head, width, separator)
        raise _UnlikelyError(_TITLES, error, row.index)
    raise _UnlikelyError(
        _TITLES,
        TableError(f"has 0 samples: no line of numbers below the titles in line {head.line}."),
    )


def _check_single(line: int, cells: Sequence[str]) -> None:
    if len(cells) == 1 and "," in cells[0]:
        raise _UnlikelyError(_TITLES, TableError(comma_in_single(line)))


def comma_in_single(line: int) -> str:
    """Return the message for a single column with decimal commas."""
    return (
        f"line {line} has a comma, which separates two cells, and the table has one column; save "
        "the file with decimal points."
    )


def _next(rows: Sequence[TextRow], row: TextRow) -> TextRow | None:
    return next((each for each in rows if each.index > row.index), None)


def _is_data(cells: Sequence[str], columns: Sequence[int], below: TextRow | None) -> bool:
    """Return whether a row has numbers in the requested columns and no text unlike the next row."""
    if max(columns) >= len(cells):
        return False
    own = [cells[column] for column in columns if cells[column]]
    if not all(is_any_number(cell) or is_stamp(cell) for cell in own):
        return False
    if not any(map(is_any_number, cells)):
        return False
    return below is None or not any(
        cell and not is_any_number(cell) and is_any_number(other)
        for cell, other in zip(cells, below.cells, strict=False)
    )


def _not_data(
    row: TextRow,
    cells: Sequence[str],
    columns: Sequence[int],
    names: Sequence[str],
    head: TextRow,
    width: int,
    separator: str,
) -> TableError:
    """Return the error for a first row below the titles without numbers."""
    if len(cells) != width:
        return TableError(wrong_width(row.line, len(cells), width, head.line, separator))
    for name, column in zip(names, columns, strict=True):
        if cells[column] and not is_any_number(cells[column]) and not is_stamp(cells[column]):
            return not_a_number(row.line, name, cells[column])
    return TableError(
        f"line {row.line} has texts where the line below has numbers, and is no row of units; "
        "remove it."
    )


def not_a_number(line: int, name: str, cell: str) -> TableError:
    """Return the error for a cell that is not a number."""
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


def _with_numbers(
    rows: Sequence[TextRow],
    index: int,
    separator: str,
    numbers: Sequence[int],
    labview: "_labview.LabviewHead | None",
) -> TableLayout | None:
    """Return the layout if this row is the first row of numbers, for columns given by number."""
    row, above = rows[index], list(takewhile(lambda each: each.index < rows[index].index, rows))
    columns = [number - 1 for number in numbers]
    if is_comment(row.cells):
        return None
    if not _is_data(row.cells, columns, _next(rows, row)) or _numbers_the_columns(rows, index):
        partly = [c for c in columns if c < len(row.cells) and row.cells[c]]
        known = [c for c in partly if is_any_number(row.cells[c])]
        following = _next(rows, row)
        if (
            known
            and len(known) < len(partly)
            and following is not None
            and len(following.cells) == len(row.cells)
            and not _numbers_the_columns(rows, index)
        ):
            column = next(c for c in partly if c not in known)
            raise _UnlikelyError(
                _TITLES, not_a_number(row.line, f"#{column + 1}", row.cells[column])
            )
        return None
    units: Sequence[str] = ()
    last = [fitted(each.cells, 0) for each in above[-2:]]
    if len(last) == 2 and len(last[0]) == len(last[1]) and is_row_of_units(last[1], columns):
        units = above.pop().cells
    titles: Sequence[str] = ()
    titles_line = 0
    optional = 0
    if above and (len(_plain_titles(above[-1])) > 1 or len(row.cells) == 1):
        titles, titles_line = _plain_titles(above[-1]), above[-1].line
        optional = int(labview is not None and titles[-1:] == [_labview.COMMENT])
    if titles and not units and all(is_unit(title) for title in titles if title):
        units = titles
    cells = fitted(row.cells, len(titles)) if titles else row.cells
    if titles and not len(titles) - optional <= len(cells) <= len(titles):
        if separator != BLANKS or len(cells) > len(titles):
            raise _UnlikelyError(
                _TITLES,
                TableError(wrong_width(row.line, len(cells), len(titles), titles_line, separator)),
            )
        titles, titles_line = (), 0  # titles of several words cannot be separated
    width = len(titles) if titles else len(cells)
    _check_single(row.line, cells)
    return TableLayout(
        separator=separator,
        titles=tuple(titles),
        titles_line=titles_line,
        units=tuple(bare_unit(cell) for cell in [*units, *[""] * (width - len(units))][:width])
        if units
        else (),
        width=width,
        optional=optional,
        skip=row.index,
        columns=tuple(columns),
        first=tuple(cells),
        labview=labview,
    )


def _numbers_the_columns(rows: Sequence[TextRow], index: int) -> bool:
    """Return whether the first row numbers the columns: no row below has only integers."""
    cells = [cell for cell in rows[index].cells if cell]
    if index or len(cells) < 2:
        return False
    counted = any(cells == [str(first + n) for n in range(len(cells))] for first in (0, 1))
    below = rows[1 : 1 + _NUMBERING_LINES]
    return (
        counted
        and bool(below)
        and not any(
            all(cell.lstrip("+-").isdecimal() for cell in row.cells if cell) for row in below
        )
    )


def _missing(rows: Sequence[TextRow], names: Sequence[str]) -> _UnlikelyError:
    """Return the error for a missing title, with the most probable line of titles."""

    def found(row: TextRow) -> int:
        return sum(name in row.cells or name in _plain_titles(row) for name in names)

    best = max(rows, key=found)
    if found(best):
        titles = _plain_titles(best)
        name = next(each for each in names if each not in titles and each not in best.cells)
        return _UnlikelyError(_SOME_TITLES, MissingColumnError(name, titles, best.line))
    index = next(
        (
            index
            for index, row in enumerate(rows)
            if all(map(is_any_number, filter(None, row.cells)))
        ),
        None,
    )
    if index is None:
        return _UnlikelyError(
            _NO_ROWS, MissingColumnError(names[0], _plain_titles(rows[0]), rows[0].line)
        )
    width = len(rows[index].cells)
    above = [row for row in rows[:index] if len(_plain_titles(row)) == width]
    if above:
        best = (
            above[-2]
            if len(above) > 1 and is_row_of_units(above[-1].cells, range(width))
            else above[-1]
        )
        titles, line = _plain_titles(best), best.line
    else:
        titles, line = [f"#{number}" for number in range(1, width + 1)], 0
    return _UnlikelyError(
        _NO_TITLES if width > 1 else _NO_ROWS, MissingColumnError(names[0], titles, line)
    )


def _no_numbers(rows: Sequence[TextRow], names: Sequence[str]) -> TableError:
    """Return the error for a table without numbers in the requested columns."""
    width = max(len(row.cells) for row in rows)
    for name in names:
        if (_number(name) or 0) > width:
            return MissingColumnError(name, [f"#{n}" for n in range(1, width + 1)], 0)
    return TableError(
        f"has 0 samples: none of its first {len(rows)} lines has numbers in all of the columns "
        f"{', '.join(names)}."
    )


def _check_split_decimals(rows: Sequence[TextRow], layout: TableLayout) -> None:
    written = [fitted(row.cells, layout.width) for row in rows if any(row.cells)]
    if are_split_decimals(written):
        raise TableError(
            f"line {rows[0].line}: every second cell between commas looks like the decimals of the "
            "one before it; save the file with decimal points, or with semicolons or tabs between "
            "the columns."
        )
