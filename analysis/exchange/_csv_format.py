"""CSV: channels of a text file, and a table as text."""

from __future__ import annotations

import csv
from array import array
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange._source import (
    ExchangeError,
    SourceChannel,
    check_samples,
    place_of,
)
from rigd.printable import printable
from rigd.session import MAX_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import BinaryIO, TextIO

    from analysis.exchange._table import Column, Table

    _Reader = Callable[[str], float]
    """Makes a number of a text, or raises ValueError."""


# Reading

_MAX_LINE: Final = 65_536
"""Longest line, characters: hundreds of columns. A longer one is not split into its cells."""

_SEPARATORS: Final = ("\t", ";", ",")
_BLANKS: Final = " "
_COMMENT: Final = ("#", "%")
"""What numpy and MATLAB put in front of a line of titles."""


def read(path: Path, names: Sequence[str]) -> Mapping[str, SourceChannel]:
    """Read columns of a text file in UTF-8, as `analysis.exchange._source.read_source` asks for.

    The separator is a tab, a semicolon or a comma, the first of them that the first line has, or
    blanks if neither that line nor the next has any of them. A column is named as the first line
    names it, or ``#3`` for the third; a first line of numbers is the first sample. An empty cell
    reads as NaN. Numbers have decimal points or, where the separator is another, decimal commas.
    """
    try:
        try:
            return _read(path, names, float)
        except _DecimalCommaError:
            # Anew, as a point in what was read so far may not be a decimal point.
            return _read(path, names, _with_comma)
    except UnicodeDecodeError as error:
        raise ExchangeError(
            f"{path}: is not text in UTF-8 (byte {error.start}); save it as CSV in UTF-8."
        ) from error
    except csv.Error as error:
        raise ExchangeError(f"{path}: is not a CSV file ({error}).") from error


class _DecimalCommaError(Exception):
    """A decimal comma in a file that is being read as one with decimal points."""


def _with_comma(text: str) -> float:
    """Read a number with a decimal comma, if any; ValueError if it is none, as of `float`."""
    if "." in text:
        raise ValueError(text)
    return float(text.replace(",", "."))


def _read(path: Path, names: Sequence[str], number: _Reader) -> Mapping[str, SourceChannel]:
    with path.open(encoding="utf-8-sig", newline="") as stream:
        return _channels(path, _bounded_lines(path, stream), names, number)


def _channels(
    path: Path, lines: Iterator[str], names: Sequence[str], number: _Reader
) -> Mapping[str, SourceChannel]:
    written = (line for line in lines if line.strip())
    first, second = next(written, None), next(written, "")
    if first is None:
        raise ExchangeError(f"{path}: is empty.")
    separator = _separator(first, second)
    rows = _rows(chain([first, second], written), separator)
    cells = [cell.strip() for cell in next(rows)]
    if separator != "," and not _is_sample(cells, number) and _is_sample(cells, _with_comma):
        raise _DecimalCommaError
    if _is_sample(cells, number):
        rows = chain([cells], rows)
        header = _numbers(len(cells))
    elif separator == _BLANKS:
        # Titles of several words each say no more which column is which.
        titles = cells[1:] if cells[0] in _COMMENT else cells
        count = len(second.split())
        header = titles if len(titles) == count else _numbers(count)
    else:
        header = cells
    columns = {name: place_of(path, name, header, "columns are named") for name in names}
    values = {name: array("d") for name in columns}
    wanted = [(column, values[name].append, name) for name, column in columns.items()]
    for row in rows:
        if not row:
            continue
        for column, append, name in wanted:
            try:
                append(number(row[column]))
            except (ValueError, IndexError):
                append(_odd_cell(path, row, column, name, len(values[name]), separator, number))
        if len(values[name]) > MAX_SAMPLES:
            check_samples(path, "The file", len(values[name]))
    return {name: SourceChannel(np.frombuffer(column)) for name, column in values.items()}


def _separator(first: str, second: str) -> str:
    """Find what stands between the cells of the first two lines that are not empty."""
    found = next((mark for mark in _SEPARATORS if mark in first), None)
    if found is not None:
        return found
    in_second = any(mark in second for mark in _SEPARATORS)
    cells = (second or first).split()
    blanks = not in_second and len(cells) > 1 and _is_sample(cells, float)
    return _BLANKS if blanks else ","


def _rows(lines: Iterable[str], separator: str) -> Iterator[list[str]]:
    if separator == _BLANKS:
        return map(str.split, lines)
    return csv.reader(lines, delimiter=separator)


def _numbers(count: int) -> list[str]:
    return [f"#{number}" for number in range(1, count + 1)]


def _is_sample(cells: Sequence[str], number: _Reader) -> bool:
    """Whether a line is one of numbers, some of which may be missing."""
    known = [cell for cell in cells if cell]
    return bool(known) and all(_is_number(cell, number) for cell in known)


def _bounded_lines(path: Path, stream: TextIO) -> Iterator[str]:
    while line := stream.readline(_MAX_LINE + 1):
        if len(line) > _MAX_LINE:
            raise ExchangeError(
                f"{path}: has a line of more than {_MAX_LINE} characters; a table has one line per "
                "sample and few channels. Export the session's channels alone."
            )
        yield line


def _odd_cell(
    path: Path,
    row: Sequence[str],
    column: int,
    name: str,
    before: int,
    separator: str,
    number: _Reader,
) -> float:
    """Return NaN for an empty cell, and say what is wrong with any other that is not a number."""
    place = f"sample {before + 1} of the column '{name}'"
    if column >= len(row):
        raise ExchangeError(
            f"{path}: {place} is missing: its line has {len(row)} columns and that one is number "
            f"{column + 1}; every line needs the same columns."
        )
    cell = row[column].strip()
    if not cell:
        return float("nan")
    if separator != "," and number is float and _is_number(cell, _with_comma):
        raise _DecimalCommaError
    if _is_number(cell, float):
        raise ExchangeError(
            f"{path}: {place} is '{printable(cell, 40)}', with a decimal point, and other numbers "
            "have decimal commas; save the file with one of them, and without separators between "
            "thousands."
        )
    raise ExchangeError(
        f"{path}: {place} is '{printable(cell, 40)}' and not a number; only numbers are allowed "
        "below the line with the names."
    )


def _is_number(text: str, number: _Reader) -> bool:
    try:
        number(text)
    except ValueError:
        return False
    return True


# Writing

_BLOCK: Final = 20_000


def write_csv(table: Table, stream: BinaryIO) -> None:
    """Write commas, decimal points and UTF-8; a complex column becomes two, real and imaginary."""
    columns = [part for column in (table.axis, *table.columns) for part in _real_parts(column)]
    stream.write((",".join(column.name for column in columns) + "\n").encode("utf-8"))
    for begin in range(0, len(table.axis.values), _BLOCK):
        texts = [map(repr, column.values[begin : begin + _BLOCK].tolist()) for column in columns]
        lines = "\n".join(map(",".join, zip(*texts, strict=True)))
        stream.write((lines + "\n").encode("ascii"))


def _real_parts(column: Column) -> Iterator[Column]:
    if not np.iscomplexobj(column.values):
        yield column
        return
    quantity, _, unit = column.name.partition("_")
    for part, values in (("real", column.values.real), ("imaginary", column.values.imag)):
        yield replace(column, name=f"{quantity}_{part}_{unit}", values=values)
