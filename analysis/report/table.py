"""Table that is defined once and rendered for terminal, LaTeX, CSV, JSON and HTML pages.

The template's macro `table` makes the HTML of a page from the same cells as all other outputs.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rigd.beam import COEFFICIENT_OF
from rigd.units import rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    import rich.table

    from analysis.models import Structure
    from rigd.estimates import ReportedMode
    from rigd.session import Validity

ABSENT_TEXT: Final = "–"
"""Text that a cell without a value shows."""
TEXT_FORMAT: Final = ""
"""Number format of a column that contains texts instead of numbers."""

CellValue = str | float | bool | None
"""Value of a cell in CSV and JSON files: in SI units, without formatting."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Cell of a table whose displayed text does not follow from its column's number format.

    Attributes
    ----------
    value : str, float, bool or None
        Value for programs, in SI units with all digits; None if it is unknown.
    text : str
        Text for people, in the unit that the table states.
    is_strong : bool
        Whether the text is emphasised.
    is_doubtful : bool
        Whether the value is shown in grey, because the data do not support it as a result.
    """

    value: CellValue
    text: str
    is_strong: bool = False
    is_doubtful: bool = False

    @property
    def is_number(self) -> bool:
        """Whether the cell's value is a number."""
        return isinstance(self.value, int | float) and not isinstance(self.value, bool)


Entry = Cell | CellValue
"""Cell of a table, or a value that is shown in its column's standard format."""
Row = Mapping[str, Entry]
"""Entries of a table's row by the keys of their columns."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table: heading, key and number format.

    Attributes
    ----------
    heading : str
        Heading for people. A column with an empty heading is written to files only.
    column_key : str
        Name for programs, with the SI unit: header in CSV, key in JSON.
    number_format : str
        Format of the column's numbers; `TEXT_FORMAT` if the column contains texts.
    display_factor : float
        Factor from SI units to the displayed unit.
    std_of_previous : bool
        Whether the column contains the standard deviations of the column before it. The terminal,
        which is narrow, shows them after a ± in the same column.
    """

    heading: str
    column_key: str
    number_format: str = ".4g"
    display_factor: float = 1.0
    std_of_previous: bool = False

    @property
    def is_numeric(self) -> bool:
        """Whether the column contains numbers."""
        return self.number_format != TEXT_FORMAT

    def displayed_cell(self, entry: Entry) -> Cell:
        """Return an entry of this column as a cell with the displayed text."""
        if isinstance(entry, Cell):
            return entry
        if isinstance(entry, bool):
            return Cell(entry, "yes" if entry else "no")
        if isinstance(entry, str):
            return Cell(entry, entry)
        return (
            count_cell(entry)
            if isinstance(entry, int)
            else number_cell(entry, self.number_format, self.display_factor)
        )


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a report: columns, rows and notes.

    Attributes
    ----------
    name : str
        Name of the CSV file without suffix, and key of the list of rows in JSON.
    caption : str
        Title of the table.
    columns : tuple of Column
        Displayed columns in their order. The first column identifies the row.
    rows : tuple of mapping of str to Entry
        Entries of each row by column key. Entries without a column are written to files only. A row
        may lack entries.
    notes : tuple of str
        Sentences below the table.
    highlighted_row : int or None
        Index of the row that is shown in bold.
    is_grouped : bool
        Whether the terminal shows a line between rows whose first cells differ.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    highlighted_row: int | None = None
    is_grouped: bool = False

    @classmethod
    def from_rows(
        cls,
        name: str,
        caption: str,
        columns: Sequence[Column],
        rows: Iterable[Sequence[Entry]],
        notes: Sequence[str] = (),
        *,
        highlighted_row: int | None = None,
        is_grouped: bool = False,
    ) -> Table:
        """Return a table from rows that are sequences of entries in the order of the columns.

        Parameters
        ----------
        name : str
            Name of the CSV file without suffix.
        caption : str
            Title.
        columns : sequence of Column
            The columns.
        rows : iterable of sequence
            Entries of each row, in the order of the columns.
        notes : sequence of str, optional
            Sentences below the table.
        highlighted_row : int, optional
            Index of the row that is shown in bold.
        is_grouped : bool
            Whether a line is drawn between rows whose first entries differ.
        """
        column_keys = [column.column_key for column in columns]
        keyed_rows = tuple(dict(zip(column_keys, row, strict=True)) for row in rows)
        return cls(
            name, caption, tuple(columns), keyed_rows, tuple(notes), highlighted_row, is_grouped
        )

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of all entries in the order of the rows: the header of the table's CSV file."""
        return tuple(
            dict.fromkeys(key for row in self.rows for key in row)
            or (column.column_key for column in self.columns)
        )

    @property
    def shown_columns(self) -> tuple[Column, ...]:
        """Columns of a table that have a heading and an entry in at least one row."""
        keys_with_entries = {key for row in self.rows for key, entry in row.items() if entry != ""}
        return tuple(
            column
            for column in self.columns
            if column.heading and (column.column_key in keys_with_entries or not self.rows)
        )

    @property
    def shown_rows(self) -> tuple[tuple[Cell, ...], ...]:
        """Cells of a table's displayed columns, row by row."""
        columns = self.shown_columns
        return tuple(
            tuple(column.displayed_cell(row.get(column.column_key, "")) for column in columns)
            for row in self.rows
        )


def with_validity(table: Table, validity: Validity) -> Table:
    """Add the validity of the linear model to a table: as a note, and as values in each row.

    The note is for people, and the values are for programs that read the files.

    Parameters
    ----------
    table : Table
        The table.
    validity : Validity
        Validity of the linear model.
    """
    validity_entries = {
        "predicted_peak_tip_slope_rad": validity.predicted_peak_tip_slope_rad,
        "linear_model_error": validity.linear_model_error,
    }
    rows_with_validity = tuple({**row, **validity_entries} for row in table.rows)
    return replace(table, rows=rows_with_validity, notes=(*table.notes, validity.sentence))


def csv_text(table: Table) -> str:
    """Return the text of a CSV file: keys as header, numbers in SI units with all digits.

    Unknown values are empty fields.
    """
    text_buffer = io.StringIO()
    csv_writer = csv.DictWriter(text_buffer, table.keys, lineterminator="\n")
    csv_writer.writeheader()
    csv_writer.writerows(json_rows(table))
    return text_buffer.getvalue()


def json_rows(table: Table) -> list[dict[str, CellValue]]:
    """Return a table's rows as dicts of JSON values; None for a value unknown or not finite."""
    return [{key: _file_value(entry) for key, entry in row.items()} for row in table.rows]


def _file_value(entry: Entry) -> CellValue:
    """Return an entry's value for CSV and JSON; None if it is a number that is not finite."""
    entry_value = entry.value if isinstance(entry, Cell) else entry
    return (
        None if isinstance(entry_value, float) and not math.isfinite(entry_value) else entry_value
    )


def terminal_table(table: Table) -> rich.table.Table:
    """Return a table for the terminal, at least as wide as its title."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    rich_table = RichTable(
        title=Text(table.caption, style="bold"), title_justify="left",
        caption=Text("\n".join(table.notes)) if table.notes else None, caption_justify="left",
        min_width=len(table.caption),
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip
    std_columns = [column.std_of_previous for column in table.shown_columns]
    for column in table.shown_columns:
        if not column.std_of_previous:
            rich_table.add_column(
                Text(column.heading), justify="right" if column.is_numeric else "left"
            )
    cell_rows = table.shown_rows
    for row_index, row in enumerate(cell_rows):
        row_cells: list[Text] = []
        for cell, is_std in zip(row, std_columns, strict=True):
            if not is_std:
                row_cells.append(Text(cell.text, style="dim italic" if cell.is_doubtful else ""))
            elif cell.value:
                # No space follows the ±, so that a narrow terminal breaks the line before it.
                row_cells[-1].append(f" ±{cell.text}")
        ends_group = (
            table.is_grouped
            and row[0].text != cell_rows[min(row_index + 1, len(cell_rows) - 1)][0].text
        )
        rich_table.add_row(
            *row_cells,
            end_section=ends_group,
            style="bold" if row_index == table.highlighted_row else "",
        )
    return rich_table


_LATEX_SYMBOLS: Final = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "Δ": "Delta", "ε": "varepsilon",
    "ζ": "zeta", "κ": "kappa", "λ": "lambda", "µ": "mu", "ξ": "xi", "π": "pi", "ρ": "rho",
    "τ": "tau", "ω": "omega", "·": "cdot", "±": "pm", "∝": "propto", "‖": "Vert",
    "ŷ": "hat{y}",
}  # fmt: skip
"""LaTeX commands of the letters and symbols of formulas."""
_LATEX_ESCAPES: Final = {
    **{each: f"\\{each}" for each in "&%#_{}$"},
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "†": r"\dag{}", "‡": r"\ddag{}",
    "–": "--",
}  # fmt: skip
"""LaTeX's escapes of special characters."""
_SUPERSCRIPT_DIGITS: Final = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
"""Translation table from superscript characters to digits and the minus sign."""
_LATEX_TOKENS: Final = re.compile(
    r"(?P<digits>\d+(?:\.\d+)?)e(?P<power>[+-]?\d+)|\^(?P<up>[^\W⁰¹²³⁴⁵⁶⁷⁸⁹]+)"
    rf"|(?P<raised>[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)|(?P<letter>[{''.join(_LATEX_SYMBOLS)}])(?P<index>\d*)"
    r"|(?P<minus>−)|(?P<stiffness>\bEI\b)|(?P<other>.)",
    re.DOTALL,
)
"""Pattern of those parts of a text that need LaTeX commands: powers, Greek letters and others."""


def latex_text(text: str) -> str:
    r"""Return a cell's text as LaTeX: Greek letters and powers as mathematics, the rest escaped.

    Examples
    --------
    >>> from analysis.report.table import latex_text
    >>> print(latex_text("1e-5 s^α"), latex_text("ρ/EI"), latex_text("−7.2 %"))
    $10^{-5}$ s$^{\alpha}$ $\rho$/$EI$ $-$7.2 \%
    """
    latex_source = "".join(map(_latex_token, _LATEX_TOKENS.finditer(text)))
    return latex_source.replace("$$", "")


def _latex_token(token: re.Match[str]) -> str:
    """Return the LaTeX of one match of `_LATEX_TOKENS`."""
    token_groups = token.groupdict()
    if token_groups["power"]:
        factor_text = "" if token_groups["digits"] == "1" else rf"{token_groups['digits']} \cdot "
        return f"${factor_text}10^{{{int(token_groups['power'])}}}$"
    if token_groups["up"]:
        exponent_text = "".join(
            f"\\{_LATEX_SYMBOLS[exponent_character]} "
            if exponent_character in _LATEX_SYMBOLS
            else exponent_character
            for exponent_character in token_groups["up"]
        )
        return f"$^{{{exponent_text.rstrip()}}}$"
    if token_groups["raised"]:
        return f"$^{{{token_groups['raised'].translate(_SUPERSCRIPT_DIGITS)}}}$"
    if token_groups["letter"]:
        subscript_text = f"_{{{token_groups['index']}}}" if token_groups["index"] else ""
        return rf"$\{_LATEX_SYMBOLS[token_groups['letter']]}{subscript_text}$"
    if token_groups["minus"] or token_groups["stiffness"]:
        return "$-$" if token_groups["minus"] else "$EI$"
    return _LATEX_ESCAPES.get(token_groups["other"], token_groups["other"])


def latex_table(table: Table) -> str:
    r"""Return a table as a LaTeX ``table`` environment with the rules of the package booktabs.

    The notes follow below the table.
    """
    columns = table.shown_columns
    column_alignment = "".join("r" if column.is_numeric else "l" for column in columns)
    latex_lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{latex_text(table.caption)}}}",
        rf"  \label{{tab:{table.name}}}",
        rf"  \begin{{tabular}}{{@{{}}{column_alignment}@{{}}}}",
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
    return "\n".join(latex_lines) + "\n"


def number_cell(
    number: float | None, number_format: str = ".4g", display_factor: float = 1.0
) -> Cell:
    """Return a cell that shows a number; a dash if the number is unknown or not finite.

    Parameters
    ----------
    number : float or None
        The number, in SI units.
    number_format : str
        Format of the number, as for the function `format`.
    display_factor : float
        Factor from SI units to the displayed unit.
    """
    if number is None or not math.isfinite(number):
        return Cell(None, ABSENT_TEXT)
    return Cell(float(number), f"{display_factor * number:{number_format}}".replace("-", "−"))


def count_cell(whole_number: int) -> Cell:
    """Return a cell that shows a whole number."""
    return Cell(whole_number, str(whole_number))


def estimate_cells(
    estimate_values: Sequence[float | None], std: float | None, display_factor: float = 1.0
) -> tuple[Cell, ...]:
    """Return cells that show numbers rounded to the second digit of their standard deviation.

    Parameters
    ----------
    estimate_values : sequence of float or None
        The numbers, in SI units.
    std : float or None
        Common standard deviation of all numbers, in SI units.
    display_factor : float
        Factor from SI units to the displayed unit.
    """
    return tuple(
        number_cell(estimate_value, display_factor=display_factor)
        if estimate_value is None or not math.isfinite(estimate_value)
        else Cell(
            estimate_value,
            rounded_to_uncertainty((estimate_value,), std or 0.0, display_factor)[0].replace(
                "-", "−"
            ),
        )
        for estimate_value in estimate_values
    )


NOT_REPORTED_MARK: Final = "†"
"""Symbol after a number that is not a reported result."""

_ORDER_SYMBOLS: Final = {"alpha": "α", "lambda": "λ"}
"""Symbols of the fractional orders by parameter name."""


def unreported_parameters(
    structure: Structure, unsupported_orders: Collection[str]
) -> frozenset[str]:
    """Return the names of a fit's parameters that are not properties of the antenna.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    unsupported_orders : collection of str
        Fractional orders that the data do not support: "alpha" or "lambda".

    Returns
    -------
    frozenset of str
        The unsupported orders that the structure has, and the coefficients that belong to them. A
        coefficient is valid only together with its order, on which its unit depends.
    """
    return frozenset(
        parameter_name
        for order_name in unsupported_orders
        for parameter_name in (order_name, COEFFICIENT_OF[order_name])
        if structure.has_damping_of(parameter_name)
    )


def mark_cell(cell: Cell) -> Cell:
    """Return a cell in grey with the symbol † for "not reported", which a dash does not get."""
    return grey_cell(
        cell if cell.value is None else replace(cell, text=cell.text + NOT_REPORTED_MARK)
    )


def grey_cell(cell: Cell) -> Cell:
    """Return a cell in grey, for example the standard deviation of a number with the symbol †."""
    return replace(cell, is_doubtful=cell.value is not None)


def flagged_cells(cells: Sequence[Cell], flag: str | None) -> tuple[Cell, ...]:
    """Return a number's cells with the mark † at the first and all in grey, if it has a flag.

    Parameters
    ----------
    cells : sequence of Cell
        Number, standard deviation and ends of the interval.
    flag : str or None
        Reason why the number is not a property of the antenna. None changes nothing.
    """
    if flag is None:
        return tuple(cells)
    return mark_cell(cells[0]), *map(grey_cell, cells[1:])


def flag_notes(flags: Iterable[str | None]) -> tuple[str, ...]:
    """Return notes on the mark † that state each different flag once.

    Parameters
    ----------
    flags : iterable of str or None
        Reasons why numbers have the mark; None for a number without it.
    """
    return tuple(f"{NOT_REPORTED_MARK} {flag}." for flag in dict.fromkeys(flags) if flag)


def mode_flag(mode: ReportedMode) -> str | None:
    """Return the flags of a mode's numbers as one text; None if it has none.

    Parameters
    ----------
    mode : ReportedMode
        Mode. The text names the numbers unless frequency and damping ratio have the same flag.
    """
    if mode.frequency_hz.flag == mode.damping_ratio.flag is not None:
        return mode.flag
    return (
        "; ".join(
            f"{quantity_name}: {estimate.flag}"
            for quantity_name, estimate in (
                ("frequency", mode.frequency_hz),
                ("damping ratio", mode.damping_ratio),
                ("inertia", mode.participation),
            )
            if estimate is not None and estimate.flag
        )
        or None
    )


def unsupported_order_notes(unsupported_orders: Collection[str]) -> tuple[str, ...]:
    """Return the note on the symbol † as a tuple; empty if all orders are supported."""
    if not unsupported_orders:
        return ()
    order_symbols = " or ".join(
        _ORDER_SYMBOLS[order_name] for order_name in sorted(unsupported_orders)
    )
    return (
        f"{NOT_REPORTED_MARK} not reported: the data support no order {order_symbols}. The number "
        "describes the fitted curve, not the antenna.",
    )
