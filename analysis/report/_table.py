"""A table once, for HTML and for CSV: each number in full, and as it is shown."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from analysis.models import COEFFICIENT_OF

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from analysis.models import Structure

ABSENT: Final = "–"


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a table.

    Attributes
    ----------
    value : float or None
        In SI units and in full; None if it is not known.
    text : str
        As it is shown, in the unit that the table states.
    strong : bool
        Whether the eye should stop at it.
    doubtful : bool
        Whether it is not reported: shown in grey, as the data do not support it.
    """

    value: float | None
    text: str
    strong: bool = False
    doubtful: bool = False


Cell = Number | str


@dataclass(frozen=True, slots=True)
class Column:
    """A column: heading as people read it, and as programs do (name with unit).

    Without a heading it is in the file only: it tells programs what people see otherwise.
    """

    heading: str
    key: str
    numeric: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a report.

    Attributes
    ----------
    name : str
        Of its CSV file, without the ending.
    caption : str
    columns : tuple of Column
        The first one names the rows.
    rows : tuple of tuple of Cell
    notes : tuple of str
        Sentences under it.
    selected : int or None
        Row that is marked.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    selected: int | None = None


def csv_text(table: Table) -> str:
    """Write a table as CSV: keys as header, numbers in SI units and full precision."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([column.key for column in table.columns])
    for row in table.rows:
        writer.writerow([_plain(cell) for cell in row])
    return buffer.getvalue()


def number(value: float | None, form: str = ".4g", factor: float = 1.0) -> Number:
    """Show `value` times `factor` in a format; a dash if it is not known or not finite."""
    if value is None or not math.isfinite(value):
        return Number(None, ABSENT)
    return Number(float(value), f"{factor * value:{form}}".replace("-", "−"))


def count(value: int) -> Number:
    """Show a whole number."""
    return Number(value, str(value))


def estimate(
    values: Sequence[float | None], std: float | None, factor: float = 1.0
) -> tuple[Number, ...]:
    """Show numbers that are uncertain by `std`, all to its second digit."""
    if std is None or not math.isfinite(std) or std <= 0:
        return tuple(number(value, ".5g", factor) for value in values)
    decimals = max(1 - math.floor(math.log10(factor * std)), 0)
    form = f".{decimals}f" if decimals <= 7 else ".4g"
    return tuple(number(value, form, factor) for value in values)


def _plain(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell
    return "" if cell.value is None else repr(cell.value)


MARK: Final = "†"

_SYMBOLS: Final = {"alpha": "α", "lambda": "λ"}


def unreported(structure: Structure, withheld: Collection[str]) -> frozenset[str]:
    """Parameters of a fit whose numbers say nothing of the antenna.

    Parameters
    ----------
    structure : Structure
        Of the fit.
    withheld : collection of str
        Orders that the data do not support, "alpha" or "lambda".

    Returns
    -------
    frozenset of str
        Each of these orders that the structure has, and its coefficient: that holds for this
        order only, as its very unit shows.
    """
    return frozenset(
        name for order in withheld for name in (order, COEFFICIENT_OF[order]) if structure.has(name)
    )


def marked(number: Number) -> Number:
    """Mark a number that is not reported; a dash needs no mark."""
    return greyed(number if number.value is None else replace(number, text=number.text + MARK))


def greyed(number: Number) -> Number:
    """Show a number in grey, such as what belongs to one that is marked."""
    return replace(number, doubtful=number.value is not None)


def footnotes(withheld: Collection[str]) -> tuple[str, ...]:
    """Say what the mark means, if it occurs."""
    if not withheld:
        return ()
    orders = " or ".join(_SYMBOLS[order] for order in sorted(withheld))
    return (
        f"{MARK} not reported: the data support no order {orders}. The number belongs to its "
        "curve, not to the antenna.",
    )
