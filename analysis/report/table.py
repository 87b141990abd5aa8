"""A table, described once, and its output on the terminal, in LaTeX, CSV and JSON.

For a page the template's macro `table` makes it, from the same cells.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from analysis.models import COEFFICIENT_OF
from rigd.units import to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    import rich.table

    from analysis.models import Structure
    from rigd.session import Validity

ABSENT: Final = "–"
WORDS: Final = ""
"""Format of a column that holds no numbers."""

Value = str | float | bool | None


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell with a text of its own.

    Attributes
    ----------
    value : str, float, bool or None
        Value for programs: in SI units and in full; None if it is not known.
    text : str
        Text for people, in the unit that the table states.
    strong : bool
        Whether it is emphasised.
    doubtful : bool
        Whether it is not reported: shown in grey, as the data do not support it.
    """

    value: Value
    text: str
    strong: bool = False
    doubtful: bool = False

    @property
    def is_number(self) -> bool:
        """Whether the value is a number."""
        return isinstance(self.value, int | float) and not isinstance(self.value, bool)


Entry = Cell | Value
Row = Mapping[str, Entry]
"""Entries by their columns' keys."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column that people see.

    Attributes
    ----------
    heading : str
        Without one the column is in the files only.
    key : str
        Its name, with the SI unit, for programs: header in CSV, key in JSON.
    form : str
        Format of its numbers; `WORDS` of a column of words.
    factor : float
        By which a number in SI units is multiplied to be shown.
    spread : bool
        Whether it is the standard deviation of the column before it; on the terminal, which is
        narrow, it follows a ±.
    """

    heading: str
    key: str
    form: str = ".4g"
    factor: float = 1.0
    spread: bool = False

    @property
    def numeric(self) -> bool:
        """Whether it holds numbers."""
        return self.form != WORDS

    def shown(self, entry: Entry) -> Cell:
        """Return the cell that people see of an entry."""
        if isinstance(entry, Cell):
            return entry
        if isinstance(entry, bool):
            return Cell(entry, "yes" if entry else "no")
        if isinstance(entry, str):
            return Cell(entry, entry)
        return count(entry) if isinstance(entry, int) else number(entry, self.form, self.factor)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a report.

    Attributes
    ----------
    name : str
        Name of its CSV file, without the ending, and of the list of its rows in JSON.
    caption : str
    columns : tuple of Column
        Those that people see, in their order; the first one names the rows.
    rows : tuple of mapping of str to Entry
        By the columns' keys. Further entries of a row are for programs only. A row may lack
        entries.
    notes : tuple of str
        Sentences under it.
    selected : int or None
        Row that is marked.
    grouped : bool
        Whether rows with the same first cell belong together, and are ruled off on the terminal.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    selected: int | None = None
    grouped: bool = False

    @classmethod
    def of(
        cls,
        name: str,
        caption: str,
        columns: Sequence[Column],
        rows: Iterable[Sequence[Entry]],
        notes: Sequence[str] = (),
        *,
        selected: int | None = None,
        grouped: bool = False,
    ) -> Table:
        """Make a table whose rows have their entries in the order of the columns.

        Parameters
        ----------
        name : str
            Name of its file, without suffix.
        caption : str
            Title.
        columns : sequence of Column
            The columns.
        rows : iterable of sequence
            Entries of each row.
        notes : sequence of str, optional
            Sentences below it.
        selected : int, optional
            Number of the row that is marked.
        grouped : bool
            Whether rows with the same first entry are ruled off from the others.
        """
        keys = [column.key for column in columns]
        by_key = tuple(dict(zip(keys, row, strict=True)) for row in rows)
        return cls(name, caption, tuple(columns), by_key, tuple(notes), selected, grouped)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of all columns, as the rows have them."""
        return tuple(
            dict.fromkeys(key for row in self.rows for key in row)
            or (column.key for column in self.columns)
        )

    @property
    def shown_columns(self) -> tuple[Column, ...]:
        """The columns that have a heading, but those without an entry in any row."""
        filled = {key for row in self.rows for key, entry in row.items() if entry != ""}
        return tuple(
            column
            for column in self.columns
            if column.heading and (column.key in filled or not self.rows)
        )

    @property
    def shown_rows(self) -> tuple[tuple[Cell, ...], ...]:
        """Cells of these columns."""
        columns = self.shown_columns
        return tuple(
            tuple(column.shown(row.get(column.key, "")) for column in columns) for row in self.rows
        )


def with_validity(table: Table, validity: Validity) -> Table:
    """Add to a table the validity of the linear model for its numbers.

    People read it under the table; programs have it in each row.

    Parameters
    ----------
    table : Table
        The table.
    validity : Validity
        Validity of the linear model.
    """
    stated = {
        "predicted_peak_tip_slope_rad": validity.predicted_peak_tip_slope_rad,
        "linear_model_error": validity.linear_model_error,
    }
    rows = tuple({**row, **stated} for row in table.rows)
    return replace(table, rows=rows, notes=(*table.notes, validity.sentence))


def csv_text(table: Table) -> str:
    """Write a table as CSV: keys as header, numbers in SI units and full precision.

    Unknown values are empty fields.
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, table.keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(json_rows(table))
    return buffer.getvalue()


def json_rows(table: Table) -> list[dict[str, Value]]:
    """Return the rows as plain values by their keys; None for what is not known or not finite."""
    return [{key: _plain(entry) for key, entry in row.items()} for row in table.rows]


def _plain(entry: Entry) -> Value:
    value = entry.value if isinstance(entry, Cell) else entry
    return None if isinstance(value, float) and not math.isfinite(value) else value


def terminal_table(table: Table) -> rich.table.Table:
    """Make a table for the terminal, at least as wide as its title."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(
        title=Text(table.caption, style="bold"), title_justify="left",
        caption=Text("\n".join(table.notes)) if table.notes else None, caption_justify="left",
        min_width=len(table.caption),
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip
    spreads = [column.spread for column in table.shown_columns]
    for column in table.shown_columns:
        if not column.spread:
            shown.add_column(Text(column.heading), justify="right" if column.numeric else "left")
    rows = table.shown_rows
    for index, row in enumerate(rows):
        cells: list[Text] = []
        for cell, spread in zip(row, spreads, strict=True):
            if not spread:
                cells.append(Text(cell.text, style="dim italic" if cell.doubtful else ""))
            elif cell.value:
                # No space follows the ±, so that a narrow terminal breaks the line before it.
                cells[-1].append(f" ±{cell.text}")
        ends = table.grouped and row[0].text != rows[min(index + 1, len(rows) - 1)][0].text
        shown.add_row(*cells, end_section=ends, style="bold" if index == table.selected else "")
    return shown


_LETTERS: Final = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "Δ": "Delta", "ε": "varepsilon",
    "ζ": "zeta", "κ": "kappa", "λ": "lambda", "µ": "mu", "ξ": "xi", "π": "pi", "ρ": "rho",
    "τ": "tau", "ω": "omega", "·": "cdot", "±": "pm", "∝": "propto", "‖": "Vert",
    "ŷ": "hat{y}",
}  # fmt: skip
_ESCAPED: Final = {
    **{each: f"\\{each}" for each in "&%#_{}$"},
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "†": r"\dag{}", "‡": r"\ddag{}",
    "–": "--",
}  # fmt: skip
_RAISED: Final = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_LATEX_TOKENS: Final = re.compile(
    r"(?P<digits>\d+(?:\.\d+)?)e(?P<power>[+-]?\d+)|\^(?P<up>[^\W⁰¹²³⁴⁵⁶⁷⁸⁹]+)"
    rf"|(?P<raised>[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)|(?P<letter>[{''.join(_LETTERS)}])(?P<index>\d*)"
    r"|(?P<minus>−)|(?P<stiffness>\bEI\b)|(?P<other>.)",
    re.DOTALL,
)


def latex_text(text: str) -> str:
    r"""Write a cell's text for LaTeX: letters of formulas as mathematics, the rest escaped.

    Examples
    --------
    >>> from analysis.report.table import latex_text
    >>> print(latex_text("1e-5 s^α"), latex_text("ρ/EI"), latex_text("−7.2 %"))
    $10^{-5}$ s$^{\alpha}$ $\rho$/$EI$ $-$7.2 \%
    """
    found = "".join(map(_latex_token, _LATEX_TOKENS.finditer(text)))
    return found.replace("$$", "")


def _latex_token(token: re.Match[str]) -> str:
    part = token.groupdict()
    if part["power"]:
        digits = "" if part["digits"] == "1" else rf"{part['digits']} \cdot "
        return f"${digits}10^{{{int(part['power'])}}}$"
    if part["up"]:
        up = "".join(f"\\{_LETTERS[each]} " if each in _LETTERS else each for each in part["up"])
        return f"$^{{{up.rstrip()}}}$"
    if part["raised"]:
        return f"$^{{{part['raised'].translate(_RAISED)}}}$"
    if part["letter"]:
        index = f"_{{{part['index']}}}" if part["index"] else ""
        return rf"$\{_LETTERS[part['letter']]}{index}$"
    if part["minus"] or part["stiffness"]:
        return "$-$" if part["minus"] else "$EI$"
    return _ESCAPED.get(part["other"], part["other"])


def latex_table(table: Table) -> str:
    r"""Write a table as LaTeX's ``table``, with the rules of the package booktabs.

    Notes stand under it.
    """
    columns = table.shown_columns
    alignment = "".join("r" if column.numeric else "l" for column in columns)
    lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{latex_text(table.caption)}}}",
        rf"  \label{{tab:{table.name}}}",
        rf"  \begin{{tabular}}{{@{{}}{alignment}@{{}}}}",
        r"    \toprule",
        f"    {' & '.join(latex_text(column.heading) for column in columns)} \\\\",
        r"    \midrule",
        *(
            f"    {' & '.join(latex_text(cell.text) for cell in row)} \\\\"
            for row in table.shown_rows
        ),
        r"    \bottomrule",
        r"  \end{tabular}",
        *(rf"  \par\footnotesize {latex_text(note)}" for note in table.notes),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def number(value: float | None, form: str = ".4g", factor: float = 1.0) -> Cell:
    """Return a cell that shows a number; a dash if it is not known or not finite.

    Parameters
    ----------
    value : float or None
        The number, in SI units.
    form : str
        Format, as of `format`.
    factor : float
        Factor of the number shown.
    """
    if value is None or not math.isfinite(value):
        return Cell(None, ABSENT)
    return Cell(float(value), f"{factor * value:{form}}".replace("-", "−"))


def count(value: int) -> Cell:
    """Show a whole number."""
    return Cell(value, str(value))


def estimate(
    values: Sequence[float | None], std: float | None, factor: float = 1.0
) -> tuple[Cell, ...]:
    """Return cells that show numbers to the second digit of their standard deviation.

    Parameters
    ----------
    values : sequence of float or None
        The numbers, in SI units.
    std : float or None
        Standard deviation of all of them.
    factor : float
        Factor of the numbers shown.
    """
    return tuple(
        number(value, factor=factor)
        if value is None or not math.isfinite(value)
        else Cell(value, to_uncertainty((value,), std or 0.0, factor)[0].replace("-", "−"))
        for value in values
    )


MARK: Final = "†"

_SYMBOLS: Final = {"alpha": "α", "lambda": "λ"}


def unreported(structure: Structure, withheld: Collection[str]) -> frozenset[str]:
    """Return the parameters of a fit that are not properties of the antenna.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
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


def marked(cell: Cell) -> Cell:
    """Mark a number that is not reported; a dash needs no mark."""
    return greyed(cell if cell.value is None else replace(cell, text=cell.text + MARK))


def greyed(cell: Cell) -> Cell:
    """Return a cell in grey, such as those that belong to a marked number."""
    return replace(cell, doubtful=cell.value is not None)


def footnotes(withheld: Collection[str]) -> tuple[str, ...]:
    """Return the meaning of the mark, if it occurs."""
    if not withheld:
        return ()
    orders = " or ".join(_SYMBOLS[order] for order in sorted(withheld))
    return (
        f"{MARK} not reported: the data support no order {orders}. The number belongs to its "
        "curve, not to the antenna.",
    )
