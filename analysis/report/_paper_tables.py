"""The paper's tables of a campaign, on request with its own numbers in parentheses.

Tables 3 to 5, the numbers of its Figure 7, and the bias of the Welch fits that they rest on.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns import best_models
from analysis.campaigns.sentences import title
from analysis.models import STRUCTURES, estimate_text
from analysis.report.table import (
    MARK,
    WORDS,
    Cell,
    Column,
    Entry,
    Row,
    Table,
    estimate,
    footnotes,
    number,
    unreported,
)
from rigd.spectral import PAPER_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.campaigns import CampaignResult

NAMES: Final = (Column("type", "type", WORDS), Column("weights", "weighting", WORDS))


def paper_tables(campaign: CampaignResult, *, with_paper: bool = False) -> tuple[Table, ...]:
    """Return the tables of the Welch fits, if any; on request with the paper's own numbers."""
    if not campaign.nominal:
        return ()
    return (
        *(make(campaign, with_paper=with_paper) for make in (table3, table4, table5)),
        indices_table(campaign),
        *([bias_table(campaign)] if campaign.welch_biases else []),
    )


def welch_text(campaign: CampaignResult) -> str:
    """Describe how the frequency responses of the sessions were estimated."""
    settings = campaign.settings
    counts = [each.segments for each in campaign.sessions]
    low, high = min(counts), max(counts)
    segments = f"{low}" if low == high else f"{low} to {high}"
    # Of the settings as used, no length is left open to depend on the rate.
    return estimate_text(settings.estimator, settings.segmentation(PAPER_RATE_HZ), segments)


_STATISTICS: Final = ("mean", "median", "std", "min", "max")
_TABLE_3: Final = {"zeta": ("ζ (10⁻⁴ s^α)", 1e4), "alpha": ("α", 1.0),
                   "gamma": ("γ (10⁻¹ s^λ/m⁴)", 10.0), "lambda": ("λ", 1.0)}  # fmt: skip
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
        values = [getattr(each, name) for name in _STATISTICS]
        shown = dict(zip(_STATISTICS, estimate(values, each.std, factor), strict=True))
        rows.append(
            {
                "type": each.structure,
                "weighting": each.weighting,
                "parameter": Cell(
                    each.parameter, f"{symbol} *{each.at_bounds}" if each.at_bounds else symbol
                ),
                **_with_papers(shown, theirs, ".4g", factor),
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
            f"{welch_text(campaign)}; {campaign.settings.band_hz[0]:g} to "
            f"{campaign.settings.band_hz[1]:g} Hz.",
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
            each: number(deviations[*its, each], ".3g")
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
                **_with_papers(shown, theirs, ".3f"),
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


_TABLE_5: Final = {"alpha": 1.0, "zeta": 1e5, "lambda": 1.0, "gamma": 1e2}
"""Factor of each parameter in Table 5."""


def table5(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Parameters and performance of the two best nominal models."""
    rows: list[Row] = []
    std = {
        (each.structure, each.weighting, each.parameter): each.std for each in campaign.statistics
    }
    for model in best_models(campaign.nominal):
        paper_wmse = papers_wmse().get((model.structure, model.weighting))
        theirs = {"wmse": paper_wmse} if with_paper else {}
        rows.append(
            {
                "type": model.structure,
                "weighting": model.weighting,
                **{
                    name: estimate(
                        [value], std.get((model.structure, model.weighting, name)), _TABLE_5[name]
                    )[0]
                    for name, value in model.parameters.items()
                },
                **_with_papers({"wmse": number(model.mean_wmse)}, theirs, ".3f"),
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
            *NAMES, Column("α", "alpha"), Column("ζ (10⁻⁵ s^α)", "zeta"),
            Column("λ", "lambda"), Column("γ (10⁻² s^λ/m⁴)", "gamma"),
            Column("WMSE ((N·m/rad)²)", "wmse"),
        ),
        tuple(rows),
        (_IN_PARENTHESES,) if with_paper else (),
    )  # fmt: skip


_INDICES: Final = {
    "mse": "MSE ((N·m/rad)²)", "wmse": "WMSE ((N·m/rad)²)", "md": "MD (N·m/rad)",
}  # fmt: skip


def indices_table(campaign: CampaignResult) -> Table:
    """Distance of each nominal model from the sessions' responses: the numbers of Figure 7."""
    rows: list[Row] = []
    for model in campaign.nominal:
        row: dict[str, Entry] = {"type": model.structure, "weighting": model.weighting}
        for index in _INDICES:
            values = np.array([getattr(each, index) for each in model.indices])
            std = float(values.std(ddof=1)) if values.size > 1 else None
            row[index], row[f"{index}_std"] = estimate((float(values.mean()), std), std)
            row[f"{index}_median"] = float(np.median(values))
        rows.append({**row, "mixture": campaign.homogeneity.mixed})
    return Table(
        "nominal_indices",
        title("Distance of the nominal models from the sessions", campaign.homogeneity),
        (
            *NAMES,
            *(
                column
                for index, heading in _INDICES.items()
                for column in (
                    Column(heading, index), Column("std", f"{index}_std", spread=True)
                )
            ),
        ),
        tuple(rows),
        ("Eqs. 28 to 30, mean and standard deviation over the sessions, as in Figure 7.",),
        grouped=True,
    )  # fmt: skip


def bias_table(campaign: CampaignResult) -> Table:
    """Bias of the Welch fits against the pooled whole-record estimates."""
    withheld = campaign.verdict.withheld if campaign.verdict else frozenset[str]()
    rows: list[Row] = []
    for fits in campaign.welch_biases:
        doubtful = unreported(STRUCTURES[fits.structure], withheld)
        for each in fits.parameters:
            symbol, factor = _TABLE_3[each.parameter]
            welch = estimate((each.welch, each.welch_std), each.welch_std, factor)
            record = estimate((each.record, each.record_std), each.record_std, factor)
            cells: dict[str, Entry] = dict(
                zip(("welch", "welch_std", "record", "record_std"), (*welch, *record), strict=True)
            )
            rows.append(
                {
                    "type": fits.structure,
                    "weighting": fits.weighting,
                    "parameter": Cell(each.parameter, symbol + MARK * (each.parameter in doubtful)),
                    **cells,
                    "bias": estimate((each.bias,), each.bias_std, factor)[0],
                    "bias_std": each.bias_std,
                    "significant": each.significant,
                    "reported": each.parameter not in doubtful,
                    "wmse": fits.wmse,
                    "record_wmse": fits.record_wmse,
                    "mixture": campaign.homogeneity.mixed,
                }
            )
    return Table(
        "welch_bias",
        title("Bias of the Welch fits against the whole records", campaign.homogeneity),
        (
            *NAMES, Column("parameter", "parameter", WORDS),
            Column("Welch, mean", "welch"), Column("std", "welch_std", spread=True),
            Column("whole records", "record"), Column("std", "record_std", spread=True),
            Column("difference", "bias"), Column("significant", "significant", WORDS),
        ),
        tuple(rows),
        (
            "Types whose whole-record residual is noise. Significant: other than zero at the 0.1 % "
            "level. A bias is the same in every session: it does not show in the std of Table 3.",
            *footnotes(withheld),
        ),
        grouped=True,
    )  # fmt: skip


def _with_papers(
    shown: Mapping[str, Cell], theirs: Mapping[str, float | None], form: str, factor: float = 1.0
) -> dict[str, Entry]:
    """Add the paper's numbers that there are, in parentheses."""
    papers = {name: number(value, form, factor) for name, value in theirs.items()}
    return {
        name: replace(cell, text=f"{cell.text} ({papers[name].text})")
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
