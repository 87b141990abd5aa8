"""The paper's Tables 3 to 5 of a campaign, on request with its own numbers in parentheses."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Final

from analysis.campaigns import best_models, title
from analysis.report._table import WORDS, Cell, Column, Entry, Row, Table, number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.campaigns import CampaignResult

NAMES: Final = (Column("type", "type", WORDS), Column("weights", "weighting", WORDS))


def paper_tables(campaign: CampaignResult, *, with_paper: bool = False) -> tuple[Table, ...]:
    """Tables 3 to 5, if there are Welch fits; on request with the paper's own numbers beside."""
    if not campaign.nominal:
        return ()
    return tuple(make(campaign, with_paper=with_paper) for make in (table3, table4, table5))


_STATISTICS: Final = ("mean", "median", "std", "min", "max")
_TABLE_3: Final = {"zeta": ("ζ (10⁻⁴)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (10⁻¹)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and factor of each parameter, the powers of ten of the paper's Table 3."""
_ON_THE_EDGE: Final = "*n: at the limit of the search range in n sessions."
_IN_PARENTHESES: Final = "In parentheses: the paper's."


def table3(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Statistics of the parameters."""
    rows: list[Row] = []
    for each in campaign.statistics:
        symbol, factor = _TABLE_3[each.parameter]
        theirs: dict[str, float | None] = {}
        if with_paper:
            papers = papers_table3().get((each.structure, each.weighting, each.parameter))
            theirs = {name: getattr(papers, name, None) for name in _STATISTICS}
        shown = {name: number(getattr(each, name), ".3f", factor) for name in _STATISTICS}
        rows.append(
            {
                "type": each.structure,
                "weighting": each.weighting,
                "parameter": Cell(
                    each.parameter, f"{symbol} *{each.at_bounds}" if each.at_bounds else symbol
                ),
                **_beside(shown, theirs, ".4g", factor),
                "at_bounds": each.at_bounds,
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table3",
        title(
            f"Parameters over {len(campaign.sessions)} sessions (Table 3)",
            campaign.homogeneity,
        ),
        (
            *NAMES,
            Column("parameter", "parameter", WORDS),
            *(Column(name, name) for name in _STATISTICS),
        ),
        tuple(rows),
        (
            *([_ON_THE_EDGE] if any(each.at_bounds for each in campaign.statistics) else []),
            *([_IN_PARENTHESES] if with_paper else []),
        ),
        grouped=True,
    )


_PEAKS: Final = {"frequency_rad_s": "ω{} (rad/s)", "magnitude_db": "M{} (dB)"}


def table4(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Mean deviation of the resonant peaks; types in columns, as in the paper."""
    types = list(dict.fromkeys(model.structure for model in campaign.nominal))
    weightings = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    deviations = {
        (quantity, each.mode, model.weighting, model.structure): getattr(each, quantity)
        for quantity in _PEAKS
        for model in campaign.nominal
        for each in model.deviations
    }
    rows: list[Row] = []
    for quantity, mode, weighting in sorted(
        {key[:3] for key in deviations}, key=lambda key: (*key[:2], weightings.index(key[2]))
    ):
        its = (quantity, mode, weighting)
        shown = {
            each: number(deviations[*its, each], ".3f")
            for each in types
            if (*its, each) in deviations
        }
        theirs = {
            each: papers_table4().get((each, weighting, quantity, mode))
            for each in shown
            if with_paper
        }
        rows.append(
            {
                "quantity": Cell(quantity, _PEAKS[quantity].format(mode)),
                "mode": mode,
                "weighting": weighting,
                **_beside(shown, theirs, ".3f"),
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table4",
        title(
            "Mean deviation of the resonant peaks from the nominal model's (MDR, Table 4)",
            campaign.homogeneity,
        ),
        (
            Column("peak", "quantity", WORDS),
            Column("weights", "weighting", WORDS),
            *(Column(f"type {each}", each) for each in types),
        ),
        tuple(rows),
        (
            "A nominal model has the mean of the sessions' parameters.",
            *([_IN_PARENTHESES] if with_paper else []),
        ),
        grouped=True,
    )


def table5(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Parameters and performance of the two best nominal models."""
    rows: list[Row] = []
    for model in best_models(campaign.nominal):
        told_wmse = papers_wmse().get((model.structure, model.weighting))
        theirs = {"wmse": told_wmse} if with_paper else {}
        rows.append(
            {
                "type": model.structure,
                "weighting": model.weighting,
                **{f"{name}": value for name, value in model.parameters.items()},
                **_beside({"wmse": number(model.mean_wmse, ".3f")}, theirs, ".3f"),
                **{
                    name: value
                    for each in model.deviations
                    for name, value in (
                        (f"mdr_omega_{each.mode}_rad_s", each.frequency_rad_s),
                        (f"mdr_magnitude_{each.mode}_db", each.magnitude_db),
                    )
                },
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table5",
        title(
            "The two best nominal models (Table 5; their peaks are in Table 4)",
            campaign.homogeneity,
        ),
        (
            *NAMES, Column("α", "alpha", ".3f"), Column("ζ (10⁻⁵)", "zeta", ".2f", 1e5),
            Column("λ", "lambda", ".3f"), Column("γ (10⁻²)", "gamma", ".2f", 1e2),
            Column("WMSE ((N·m/rad)²)", "wmse"),
        ),
        tuple(rows),
        (_IN_PARENTHESES,) if with_paper else (),
    )  # fmt: skip


def _beside(
    shown: Mapping[str, Cell], theirs: Mapping[str, float | None], form: str, factor: float = 1.0
) -> dict[str, Entry]:
    """Add the paper's numbers that there are, in parentheses."""
    told = {name: number(value, form, factor) for name, value in theirs.items()}
    return {
        name: replace(cell, text=f"{cell.text} ({told[name].text})")
        if theirs.get(name) is not None
        else cell
        for name, cell in shown.items()
    }


def _papers(theirs: Mapping[str, float | None]) -> dict[str, Entry]:
    """Give the paper's numbers to programs, too."""
    return {f"paper_{name}": value for name, value in theirs.items()}


# The paper's own numbers: "Fractional-Order Models of Damping Phenomena in a Flexible Sensing
# Antenna Used for Haptic Robot Navigation", twenty sessions of a carbon fibre link.


@dataclass(frozen=True, slots=True)
class PaperStatistics:
    """One row of Table 3."""

    mean: float
    median: float
    std: float
    min: float
    max: float


@cache
def papers_table3() -> Mapping[tuple[str, str, str], PaperStatistics]:
    """Statistics by type, weighting and parameter."""
    return {
        (row["type"], row["weighting"], row["parameter"]): PaperStatistics(
            **{name: float(row[name]) for name in ("mean", "median", "std", "min", "max")}
        )
        for row in _rows_of("paper_table3.csv")
    }


@cache
def papers_table4() -> Mapping[tuple[str, str, str, int], float]:
    """Mean deviations by type, weighting, quantity (as `MeanPeakDeviation` names it) and mode."""
    names = ("quantity", "mode", "weighting")
    return {
        (structure, row["weighting"], row["quantity"], int(row["mode"])): float(value)
        for row in _rows_of("paper_table4.csv")
        for structure, value in row.items()
        if structure not in names
    }


@cache
def papers_wmse() -> Mapping[tuple[str, str], float]:
    """Weighted mean square error of the two best models, by type and weighting."""
    return {
        (row["type"], row["weighting"]): float(row["wmse"]) for row in _rows_of("paper_table5.csv")
    }


def _rows_of(name: str) -> list[dict[str, str]]:
    text = files("analysis.report").joinpath("data", name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
