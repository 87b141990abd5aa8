"""Tables on whether sessions are of one specimen, for the terminal and for the page."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.campaigns.experiment import in_dispute, told
from analysis.campaigns.labels import label, probability, with_unit
from analysis.campaigns.specimen_sentences import MIXTURE_MARK, MIXTURE_NOTE, percent
from analysis.campaigns.text_table import text_table
from analysis.report.html.table import Column, Table, count, number

if TYPE_CHECKING:
    import rich.table

    from analysis.campaigns.homogeneity import Heterogeneity, Homogeneity

_SPECIMENS: Final = "Specimens, as the files state them"
_SCATTER_NOTE: Final = (
    "Between sessions: scatter beyond their own uncertainties. I²: share of the variance that is "
    "such scatter. p: probability of so much by the uncertainties alone."
)


def specimens_text_table(found: Homogeneity) -> rich.table.Table:
    """Specimens that the files state, the one of this campaign first."""
    table = text_table(_SPECIMENS)
    for heading in _specimen_headings(found):
        table.add_column(heading)
    for row in _specimen_cells(found):
        table.add_row(*row)
    return table


def specimens_table(found: Homogeneity) -> Table:
    """Make the same for the page."""
    headings = _specimen_headings(found)
    return Table(
        name="specimens",
        caption=_SPECIMENS,
        columns=tuple(Column(heading, heading, numeric=False) for heading in headings),
        rows=tuple(_specimen_cells(found)),
        selected=0,
    )


def _specimen_headings(found: Homogeneity) -> tuple[str, ...]:
    return ("specimen", *in_dispute(found.specimens), "files", "their names")


def _specimen_cells(found: Homogeneity) -> list[tuple[str, ...]]:
    keys = in_dispute(found.specimens)
    return [
        (
            f"{place}" if place > 1 else "1 (this report)",
            *(told(key, each.facts[key]) for key in keys),
            str(len(each.paths)),
            ", ".join(path.name for path in each.paths),
        )
        for place, each in enumerate(found.specimens, start=1)
    ]


def scatter_text_table(found: Homogeneity) -> rich.table.Table:
    """Scatter of each mode and parameter between sessions."""
    table = text_table(_scatter(found))
    table.add_column("quantity")
    for heading in ("sessions", "mean", "between sessions", "in own std", "Q", "I²", "p"):
        table.add_column(heading, justify="right")
    for each in found.quantities:
        _, factor, _ = label(each.quantity)
        table.add_row(
            _name(each), str(len(each.values)), f"{factor * each.mean:.{_digits(each)}f}",
            f"{factor * each.between_std:.2g}", f"{each.own_stds:.3g}", f"{each.cochran_q:.3g}",
            percent(each.i_squared), probability(each.chance),
        )  # fmt: skip
    table.caption = MIXTURE_NOTE
    return table


def scatter_table(found: Homogeneity) -> Table:
    """Make the same for the page."""
    return Table(
        name="homogeneity",
        caption=_scatter(found),
        columns=(
            Column("quantity", "quantity", numeric=False), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("in own std", "between_in_own_std"), Column("Cochran's Q", "cochran_q"),
            Column("I²", "i_squared"), Column("p", "chance"),
        ),
        rows=tuple(
            (
                _name(each), count(len(each.values)),
                number(each.mean, f".{_digits(each)}f", label(each.quantity)[1]),
                number(each.between_std, ".2g", label(each.quantity)[1]),
                number(each.own_stds, ".3g"), number(each.cochran_q, ".3g"),
                replace(number(each.i_squared, ".3g"), text=percent(each.i_squared)),
                replace(number(each.chance, ".2g"), text=probability(each.chance)),
            )
            for each in found.quantities
        ),
        notes=(_SCATTER_NOTE, *([MIXTURE_NOTE] if found.mixed else [])),
    )  # fmt: skip


def _scatter(found: Homogeneity) -> str:
    by = f", all by type {found.structure}" if found.structure else ""
    return f"Sessions compared{by}"


def _name(each: Heterogeneity) -> str:
    return f"{with_unit(each.quantity)} {MIXTURE_MARK if each.mixed else ''}".rstrip()


def _digits(each: Heterogeneity) -> int:
    """Decimals that show the scatter, or what a session states as its uncertainty."""
    _, factor, _ = label(each.quantity)
    seen = factor * max(each.between_std, min(std for _, _, std in each.values))
    return min(max(1 - math.floor(math.log10(seen)), 0), 9)
