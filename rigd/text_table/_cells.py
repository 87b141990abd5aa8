"""Cells of a table: recognition of numbers with either decimal sign, dates and units."""

import re
from collections.abc import Callable, Sequence
from typing import Final

from rigd.text_table.titles import is_unit

POINT: Final = "."
"""Decimal point."""
COMMA: Final = ","
"""Decimal comma."""

_UNSIGNED_NUMBER_PATTERN: Final = r"(?:\d+{mark}?\d*|{mark}\d+)(?:[eE][-+]?\d+)?"
"""Pattern of a finite number without sign, in which {mark} is replaced by the decimal sign."""
_NOT_FINITE_PATTERN: Final = r"nan|inf|infinity"
"""Pattern of NaN and infinity."""
_NUMBER_PATTERNS: Final = {
    decimal_sign: re.compile(
        rf"[-+]?(?:{_UNSIGNED_NUMBER_PATTERN.replace('{mark}', re.escape(decimal_sign))}"
        rf"|{_NOT_FINITE_PATTERN})",
        re.ASCII | re.IGNORECASE,
    )
    for decimal_sign in (POINT, COMMA)
}
"""Patterns of numbers, by decimal sign."""
_THREE_DECIMALS_PATTERNS: Final = {
    decimal_sign: re.compile(rf"[-+]?[1-9]\d{{0,2}}{re.escape(decimal_sign)}\d{{3}}")
    for decimal_sign in (POINT, COMMA)
}
"""Patterns of numbers with exactly three digits after the decimal sign, by decimal sign."""
_SHORT_INTEGER_PATTERN: Final = re.compile(r"[-+]?\d{1,3}")
"""Pattern of an integer of at most three digits."""
_DATE_PATTERN: Final = re.compile(
    r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}([ T_].*)?|(.*\d)?\d:\d\d(:\d.*)?"
)
"""Pattern of a date or a time of day."""
_DECIMAL_DIGITS_PATTERN: Final = re.compile(r"\d+(?:[eE][-+]?\d+)?")
"""Pattern of the digits after a decimal sign."""
_LEADING_ZERO_PATTERN: Final = re.compile(r"0\d+.*")
"""Pattern of digits that begin with a zero."""
_INTEGER_PATTERN: Final = re.compile(r"[-+]?\d+")
"""Pattern of an integer."""
_COMMENT_PATTERN: Final = re.compile(r"\s*[#%]\s*")
"""Pattern of a comment mark at the start of a line."""


def is_number(cell: str, decimal_sign: str) -> bool:
    """Return whether a cell is NaN, infinity or a number with a given decimal sign."""
    return _NUMBER_PATTERNS[decimal_sign].fullmatch(cell.strip()) is not None


def is_any_number(cell: str) -> bool:
    """Return whether a cell is a number with a decimal point or a decimal comma."""
    return is_number(cell, POINT) or is_number(cell, COMMA)


def parse_number(cell: str, decimal_sign: str) -> float:
    """Return the number in a cell; NaN for an empty cell.

    Raise `ValueError` if the cell is not a number with that decimal sign.
    """
    cell_text = cell.strip()
    if not cell_text:
        return float("nan")
    if not is_number(cell_text, decimal_sign):
        raise ValueError(cell_text)
    return float(cell_text.replace(COMMA, POINT))


def fast_number_converter(decimal_sign: str) -> Callable[[str], float]:
    """Return a fast function that converts a cell to its number, for cells without underscores.

    Unlike `parse_number`, the function raises ValueError for an empty cell, and reads 1_000 as
    1000.
    """
    return float if decimal_sign == POINT else _number_with_comma


def _number_with_comma(cell: str) -> float:
    """Return the number in a cell with a decimal comma, or raise ValueError."""
    if POINT in cell:
        raise ValueError(cell)
    return float(cell.replace(COMMA, POINT))


def is_date(cell: str) -> bool:
    """Return whether a cell resembles a date or a time of day."""
    return _DATE_PATTERN.fullmatch(cell.strip()) is not None


class ThousandsCheck:
    """Check of one column for decimal signs that could be thousands separators.

    The signs are ambiguous if each has exactly three digits after it, no number has a leading zero,
    and other cells contain numbers below 1000 without the sign.
    """

    def __init__(self, decimal_sign: str) -> None:
        self._decimal_sign = decimal_sign
        self.first_grouped_line = 0
        self.has_short_integer = False

    def proves_decimal_sign(self, cell: str, line_number: int) -> bool:
        """Record a cell; return whether it proves that the sign is no thousands separator."""
        cell_text = cell.strip()
        if self._decimal_sign not in cell_text:
            self.has_short_integer = (
                self.has_short_integer or _SHORT_INTEGER_PATTERN.fullmatch(cell_text) is not None
            )
            return False
        if not _THREE_DECIMALS_PATTERNS[self._decimal_sign].fullmatch(cell_text):
            return True
        self.first_grouped_line = self.first_grouped_line or line_number
        return False


def are_split_decimals(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether commas in decimal numbers (0,025) were taken as separators of cells.

    They were if every line consists of pairs of cells, an integer and the digits after the comma.
    One column without decimal points may precede, separate or follow the pairs. In at least one
    pair these digits must begin with a zero (025), unlike an integer.
    """
    cell_count = len(rows[0]) if rows else 0
    if any(len(row) != cell_count for row in rows):
        return False
    if cell_count % 2 == 0:
        return _are_pairs(rows)
    return any(
        not any(POINT in row[single_index] for row in rows)
        and _are_pairs([[*row[:single_index], *row[single_index + 1 :]] for row in rows])
        for single_index in range(0, cell_count, 2)
    )


def _are_pairs(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether all cells are pairs of an integer and decimals, some of them led by a zero."""
    has_leading_zero = False
    for row in rows:
        decimal_cells = [cell.strip() for cell in row[1::2]]
        if not all(map(_DECIMAL_DIGITS_PATTERN.fullmatch, decimal_cells)):
            return False
        if not all(_INTEGER_PATTERN.fullmatch(cell.strip()) for cell in row[::2]):
            return False
        has_leading_zero = has_leading_zero or any(
            _LEADING_ZERO_PATTERN.fullmatch(cell) for cell in decimal_cells
        )
    return has_leading_zero


# Titles and units


def without_comment_mark(cell: str) -> str:
    """Return the first title of a line without the comment mark (# or %) before it."""
    return _COMMENT_PATTERN.sub("", cell, count=1) if _COMMENT_PATTERN.match(cell) else cell


def is_comment_row(row: Sequence[str]) -> bool:
    """Return whether a line is a comment or a horizontal rule, such as dashes below the titles."""
    line_text = "".join(row).strip()
    return _COMMENT_PATTERN.match(line_text) is not None or set(line_text) <= set("-=_+|*: ")


def is_row_of_units(row: Sequence[str], column_indices: Sequence[int]) -> bool:
    """Return whether a line below the titles is a row of units.

    It is one if it contains no number (except 1) and has a known unit in one of the columns.
    """
    stripped_cells = [cell.strip() for cell in row]
    if any(is_any_number(cell) for cell in stripped_cells if cell and cell != "1"):
        return False
    return any(
        is_unit(row[column_index]) for column_index in column_indices if column_index < len(row)
    )
