"""Cells of a table: numbers with a decimal point or comma, dates, rows of units."""

import re
from collections.abc import Callable, Sequence
from typing import Final

from rigd.text_table.titles import is_unit

POINT: Final = "."
COMMA: Final = ","

_UNSIGNED: Final = r"(?:\d+{mark}?\d*|{mark}\d+)(?:[eE][-+]?\d+)?"
_NOT_FINITE: Final = r"nan|inf|infinity"
_NUMBERS: Final = {
    mark: re.compile(
        rf"[-+]?(?:{_UNSIGNED.replace('{mark}', re.escape(mark))}|{_NOT_FINITE})",
        re.ASCII | re.IGNORECASE,
    )
    for mark in (POINT, COMMA)
}
_GROUPED: Final = {
    mark: re.compile(rf"[-+]?[1-9]\d{{0,2}}{re.escape(mark)}\d{{3}}") for mark in (POINT, COMMA)
}
_UP_TO_THREE_DIGITS: Final = re.compile(r"[-+]?\d{1,3}")
_DATE: Final = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}([ T_].*)?|(.*\d)?\d:\d\d(:\d.*)?")
_DECIMALS: Final = re.compile(r"\d+(?:[eE][-+]?\d+)?")
_LEADING_ZERO: Final = re.compile(r"0\d+.*")
_WHOLE: Final = re.compile(r"[-+]?\d+")
_COMMENT: Final = re.compile(r"\s*[#%]\s*")


def is_number(cell: str, mark: str) -> bool:
    """Return whether a cell is a number with that decimal sign, NaN or infinity."""
    return _NUMBERS[mark].fullmatch(cell.strip()) is not None


def is_any_number(cell: str) -> bool:
    """Return whether a cell is a number with a decimal point or a decimal comma."""
    return is_number(cell, POINT) or is_number(cell, COMMA)


def number_of(cell: str, mark: str) -> float:
    """Return the number of a cell; NaN for an empty cell.

    Raises
    ------
    ValueError
        If the cell is not a number with that decimal sign.
    """
    text = cell.strip()
    if not text:
        return float("nan")
    if not is_number(text, mark):
        raise ValueError(text)
    return float(text.replace(COMMA, POINT))


def quick_reader(mark: str) -> Callable[[str], float]:
    """Return the fastest converter of a cell to a number; it raises ValueError if in doubt."""
    return float if mark == POINT else _with_comma


def _with_comma(cell: str) -> float:
    if POINT in cell:
        raise ValueError(cell)
    return float(cell.replace(COMMA, POINT))


def is_date(cell: str) -> bool:
    """Return whether a cell resembles a date or a time of day."""
    return _DATE.fullmatch(cell.strip()) is not None


class ThousandsWatch:
    """Check of one column whose decimal signs could be thousands separators.

    Every cell with the sign has exactly three digits after it and no leading zero. Such a column is
    ambiguous if other cells, below 1000, have no sign.
    """

    def __init__(self, mark: str) -> None:
        self._mark = mark
        self.grouped_line = 0
        self.plain = False

    def settles(self, cell: str, line: int) -> bool:
        """Add a cell; return whether it shows that the sign is a decimal sign."""
        text = cell.strip()
        if self._mark not in text:
            self.plain = self.plain or _UP_TO_THREE_DIGITS.fullmatch(text) is not None
            return False
        if not _GROUPED[self._mark].fullmatch(text):
            return True
        self.grouped_line = self.grouped_line or line
        return False


def are_split_decimals(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether cells between commas are halves of numbers with decimal commas (0,025).

    Every line then has an even number of cells without a decimal sign. The second cell of each pair
    has no sign, and somewhere a leading zero, which no integer has.
    """
    zeros = False
    for row in rows:
        second = [cell.strip() for cell in row[1::2]]
        if not row or len(row) % 2 or not all(map(_DECIMALS.fullmatch, second)):
            return False
        if not all(_WHOLE.fullmatch(cell.strip()) for cell in row[::2]):
            return False
        zeros = zeros or any(_LEADING_ZERO.fullmatch(cell) for cell in second)
    return zeros


# Titles and units


def without_comment_mark(cell: str) -> str:
    """Return a title without the comment mark of numpy or MATLAB at the start of the line."""
    return _COMMENT.sub("", cell, count=1) if _COMMENT.match(cell) else cell


def is_comment(row: Sequence[str]) -> bool:
    """Return whether a line is a comment, or a rule such as dashes below the titles."""
    text = "".join(row).strip()
    return _COMMENT.match(text) is not None or set(text) <= set("-=_+|*: ")


def is_row_of_units(row: Sequence[str], columns: Sequence[int]) -> bool:
    """Return whether a line below the titles has units: at least one known unit and no number."""
    cells = [cell.strip() for cell in row]
    if any(is_any_number(cell) for cell in cells if cell and cell != "1"):
        return False
    return any(is_unit(row[column]) for column in columns if column < len(row))
