"""Tables on whether sessions are of one specimen: what files state, and how quantities scatter."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from analysis.campaigns import (
    MIXTURE_MARK,
    MIXTURE_NOTE,
    in_dispute,
    label,
    percent,
    probability,
    told,
    with_unit,
)
from analysis.report._table import WORDS, Cell, Column, Row, Table, number
from rigd.units import decimals

if TYPE_CHECKING:
    from analysis.campaigns import CampaignResult, Heterogeneity, Homogeneity


def specimens_table(campaign: CampaignResult) -> Table:
    """Specimens as the files state them, the one of this campaign first."""
    specimens = campaign.homogeneity.specimens
    return Table(
        "specimens",
        "Specimens, as the files state them",
        (
            Column("this report's", "here", WORDS),
            *(Column(key, key, WORDS) for key in in_dispute(specimens)),
            Column("files", "files"),
            Column("their names", "names", WORDS),
        ),
        tuple(
            {
                **{key: Cell(value, told(key, value)) for key, value in each.facts.items()},
                "files": len(each.paths),
                "here": each is specimens[0],
                "names": Cell(
                    " ".join(path.name for path in each.paths),
                    ", ".join(path.name for path in each.paths),
                ),
            }
            for each in specimens
        ),
        selected=0,
    )


def homogeneity_table(campaign: CampaignResult) -> Table:
    """Scatter of each mode and parameter between sessions."""
    found = campaign.homogeneity

    def row(each: Heterogeneity) -> Row:
        _, factor, _ = label(each.quantity)
        return {
            "quantity": Cell(
                each.quantity, with_mark(with_unit(each.quantity), each.quantity, found)
            ),
            "sessions": len(each.values),
            "mean": number(each.mean, f".{_digits(each)}f", factor),
            "between_std": number(each.between_std, ".2g", factor),
            "between_in_own_std": each.own_stds,
            "cochran_q": each.cochran_q,
            "i_squared": replace(number(each.i_squared), text=percent(each.i_squared)),
            "p_value": chance_cell(each.chance),
            "mixture": each.mixed,
        }

    return Table(
        "homogeneity",
        f"Homogeneity of the sessions{f', by type {found.structure}' if found.structure else ''}",
        (
            Column("quantity", "quantity", WORDS), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("τ/s", "between_in_own_std", ".3g"),
            Column("Cochran's Q", "cochran_q", ".3g"),
            Column("I²", "i_squared"), Column("p", "p_value"),
        ),
        tuple(map(row, found.quantities)),
        (
            "Between sessions: standard deviation beyond the sessions' own uncertainties (τ). τ/s: "
            "the same over a typical session's own. I²: its share of the variance. p: p-value of "
            "Cochran's Q.",
            *([MIXTURE_NOTE] if found.mixed else []),
        ),
    )  # fmt: skip


def _digits(each: Heterogeneity) -> int:
    """Decimals that show the scatter, or what a session states as its uncertainty."""
    _, factor, _ = label(each.quantity)
    seen = factor * max(each.between_std, min(std for _, _, std in each.values))
    return min(decimals(seen), 9)


def chance_cell(chance: float) -> Cell:
    """Show a probability that may be too small for a number."""
    return replace(number(chance), text=probability(chance))


def with_mark(text: str, quantity: str, found: Homogeneity) -> str:
    """Mark a text if sessions differ in the quantity in kind."""
    return f"{text} {MIXTURE_MARK}" if found.is_mixed(quantity) else text
