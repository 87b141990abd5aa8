"""Tables of the reference paper for a campaign, optionally with the paper's numbers in parentheses.

They are Tables 3 to 5, the numbers of Figure 7, and the bias of the Welch fits.
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
    NOT_REPORTED_MARK,
    TEXT_FORMAT,
    Cell,
    Column,
    Entry,
    Row,
    Table,
    estimate_cells,
    footnotes,
    number_cell,
    unreported_parameters,
)
from rigd.spectral import PAPER_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.campaigns import CampaignResult

FIT_NAME_COLUMNS: Final = (
    Column("type", "type", TEXT_FORMAT),
    Column("weights", "weighting", TEXT_FORMAT),
)
"""Columns that identify a Welch fit: type and weighting."""


def paper_tables(campaign: CampaignResult, *, with_paper: bool = False) -> tuple[Table, ...]:
    """Return the paper's tables from the campaign's Welch fits; nothing without Welch fits.

    On request they contain the paper's own numbers in parentheses.
    """
    if not campaign.nominal:
        return ()
    return (
        *(make_table(campaign, with_paper=with_paper) for make_table in (table3, table4, table5)),
        indices_table(campaign),
        *([bias_table(campaign)] if campaign.welch_biases else []),
    )


def welch_method_text(campaign: CampaignResult) -> str:
    """Return how the sessions' frequency responses were estimated, as text."""
    settings = campaign.settings
    counts = [session.segments for session in campaign.sessions]
    low, high = min(counts), max(counts)
    segments = f"{low}" if low == high else f"{low} to {high}"
    # The settings state all lengths, so that the rate has no effect.
    return estimate_text(settings.estimator, settings.segmentation(PAPER_RATE_HZ), segments)


_STATISTICS: Final = ("mean", "median", "std", "min", "max")
"""Statistics of a parameter over the sessions, as in Table 3."""
_TABLE_3_HEADINGS: Final = {"zeta": ("ζ (10⁻⁴ s^α)", 1e4), "alpha": ("α", 1.0),
                   "gamma": ("γ (10⁻¹ s^λ/m⁴)", 10.0), "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and factor of each parameter in Table 3, with the paper's powers of ten."""
_AT_LIMIT_NOTE: Final = "*n: at the limit of the search range in n sessions."
"""Note on estimates at the limit of the search range."""
_PARENTHESES_NOTE: Final = "In parentheses: the paper's."
"""Note on the numbers in parentheses."""


def table3(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Return the table of each parameter's statistics over the sessions (Table 3)."""
    rows: list[Row] = []
    for statistics in campaign.statistics:
        symbol, factor = _TABLE_3_HEADINGS[statistics.parameter]
        paper_values: dict[str, float | None] = {}
        if with_paper:
            paper_row = published_table3().get(
                (statistics.structure, statistics.weighting, statistics.parameter)
            )
            paper_values = {name: getattr(paper_row, name, None) for name in _STATISTICS}
        values = [getattr(statistics, name) for name in _STATISTICS]
        cells = dict(zip(_STATISTICS, estimate_cells(values, statistics.std, factor), strict=True))
        rows.append(
            {
                "type": statistics.structure,
                "weighting": statistics.weighting,
                "parameter": Cell(
                    statistics.parameter,
                    f"{symbol} *{statistics.at_bounds}" if statistics.at_bounds else symbol,
                ),
                **_cells_with_paper_values(cells, paper_values, ".4g", factor),
                "at_bounds": statistics.at_bounds,
                **_paper_entries(paper_values),
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
            *FIT_NAME_COLUMNS,
            Column("parameter", "parameter", TEXT_FORMAT),
            *(Column(name, name) for name in _STATISTICS),
        ),
        tuple(rows),
        (
            f"{welch_method_text(campaign)}; {campaign.settings.band_hz[0]:g} to "
            f"{campaign.settings.band_hz[1]:g} Hz.",
            *(
                [_AT_LIMIT_NOTE]
                if any(statistics.at_bounds for statistics in campaign.statistics)
                else []
            ),
            *([_PARENTHESES_NOTE] if with_paper else []),
        ),
        grouped=True,
    )


_PEAK_HEADINGS: Final = {"frequency_rad_s": "ω{} (rad/s)", "magnitude_db": "M{} (dB)"}
"""Headings of the deviations of a resonance peak, with the number of the mode."""


def table4(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Return the table of the resonance peaks' mean deviations (Table 4)."""
    types = list(dict.fromkeys(model.structure for model in campaign.nominal))
    weightings = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    deviations = {
        (quantity, deviation.mode, model.weighting, model.structure): getattr(deviation, quantity)
        for quantity in _PEAK_HEADINGS
        for model in campaign.nominal
        for deviation in model.deviations
    }
    rows: list[Row] = []
    for quantity, mode, weighting in sorted(
        {key[:3] for key in deviations}, key=lambda key: (*key[:2], weightings.index(key[2]))
    ):
        row_key = (quantity, mode, weighting)
        cells = {
            type_name: number_cell(deviations[*row_key, type_name], ".3g")
            for type_name in types
            if (*row_key, type_name) in deviations
        }
        paper_values = {
            each_type: published_table4().get((each_type, weighting, quantity, mode))
            for each_type in cells
            if with_paper
        }
        rows.append(
            {
                "quantity": Cell(quantity, _PEAK_HEADINGS[quantity].format(mode)),
                "mode": mode,
                "weighting": weighting,
                **_cells_with_paper_values(cells, paper_values, ".3f"),
                **_paper_entries(paper_values),
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
            Column("peak", "quantity", TEXT_FORMAT),
            Column("weights", "weighting", TEXT_FORMAT),
            *(Column(f"type {type_name}", type_name) for type_name in types),
        ),
        tuple(rows),
        (
            "A nominal model has the mean of the sessions' parameters.",
            *([_PARENTHESES_NOTE] if with_paper else []),
        ),
        grouped=True,
    )


_TABLE_5_FACTORS: Final = {"alpha": 1.0, "zeta": 1e5, "lambda": 1.0, "gamma": 1e2}
"""Factor of each parameter in Table 5, with the paper's powers of ten."""


def table5(campaign: CampaignResult, *, with_paper: bool = False) -> Table:
    """Return the table of the two best nominal models' parameters and WMSE (Table 5)."""
    rows: list[Row] = []
    std = {
        (statistics.structure, statistics.weighting, statistics.parameter): statistics.std
        for statistics in campaign.statistics
    }
    for model in best_models(campaign.nominal):
        paper_wmse = published_wmse().get((model.structure, model.weighting))
        paper_values = {"wmse": paper_wmse} if with_paper else {}
        rows.append(
            {
                "type": model.structure,
                "weighting": model.weighting,
                **{
                    name: estimate_cells(
                        [value],
                        std.get((model.structure, model.weighting, name)),
                        _TABLE_5_FACTORS[name],
                    )[0]
                    for name, value in model.parameters.items()
                },
                **_cells_with_paper_values(
                    {"wmse": number_cell(model.mean_wmse)}, paper_values, ".3f"
                ),
                **{
                    name: value
                    for deviation in model.deviations
                    for name, value in (
                        (f"mdr_omega_{deviation.mode}_rad_s", deviation.frequency_rad_s),
                        (f"mdr_magnitude_{deviation.mode}_db", deviation.magnitude_db),
                    )
                },
                **_paper_entries(paper_values),
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
            *FIT_NAME_COLUMNS, Column("α", "alpha"), Column("ζ (10⁻⁵ s^α)", "zeta"),
            Column("λ", "lambda"), Column("γ (10⁻² s^λ/m⁴)", "gamma"),
            Column("WMSE ((N·m/rad)²)", "wmse"),
        ),
        tuple(rows),
        (_PARENTHESES_NOTE,) if with_paper else (),
    )  # fmt: skip


_INDEX_HEADINGS: Final = {
    "mse": "MSE ((N·m/rad)²)", "wmse": "WMSE ((N·m/rad)²)", "md": "MD (N·m/rad)",
}  # fmt: skip
"""Headings of the paper's indices."""


def indices_table(campaign: CampaignResult) -> Table:
    """Return the table of the nominal models' distances from the sessions, as in Figure 7."""
    rows: list[Row] = []
    for model in campaign.nominal:
        row: dict[str, Entry] = {"type": model.structure, "weighting": model.weighting}
        for index in _INDEX_HEADINGS:
            values = np.array(
                [getattr(session_indices, index) for session_indices in model.indices]
            )
            std = float(values.std(ddof=1)) if values.size > 1 else None
            row[index], row[f"{index}_std"] = estimate_cells((float(values.mean()), std), std)
            row[f"{index}_median"] = float(np.median(values))
        rows.append({**row, "mixture": campaign.homogeneity.mixed})
    return Table(
        "nominal_indices",
        title("Distance of the nominal models from the sessions", campaign.homogeneity),
        (
            *FIT_NAME_COLUMNS,
            *(
                column
                for index, heading in _INDEX_HEADINGS.items()
                for column in (
                    Column(heading, index), Column("std", f"{index}_std", std_of_previous=True)
                )
            ),
        ),
        tuple(rows),
        ("Eqs. 28 to 30, mean and standard deviation over the sessions, as in Figure 7.",),
        grouped=True,
    )  # fmt: skip


def bias_table(campaign: CampaignResult) -> Table:
    """Return the table of the Welch fits' bias relative to pooled whole-record estimates."""
    unsupported_orders = campaign.verdict.withheld if campaign.verdict else frozenset[str]()
    rows: list[Row] = []
    for fit_bias in campaign.welch_biases:
        not_reported = unreported_parameters(STRUCTURES[fit_bias.structure], unsupported_orders)
        for parameter in fit_bias.parameters:
            symbol, factor = _TABLE_3_HEADINGS[parameter.parameter]
            welch = estimate_cells(
                (parameter.welch, parameter.welch_std), parameter.welch_std, factor
            )
            record = estimate_cells(
                (parameter.record, parameter.record_std), parameter.record_std, factor
            )
            cells: dict[str, Entry] = dict(
                zip(("welch", "welch_std", "record", "record_std"), (*welch, *record), strict=True)
            )
            rows.append(
                {
                    "type": fit_bias.structure,
                    "weighting": fit_bias.weighting,
                    "parameter": Cell(
                        parameter.parameter,
                        symbol + NOT_REPORTED_MARK * (parameter.parameter in not_reported),
                    ),
                    **cells,
                    "bias": estimate_cells((parameter.bias,), parameter.bias_std, factor)[0],
                    "bias_std": parameter.bias_std,
                    "significant": parameter.significant,
                    "reported": parameter.parameter not in not_reported,
                    "wmse": fit_bias.wmse,
                    "record_wmse": fit_bias.record_wmse,
                    "mixture": campaign.homogeneity.mixed,
                }
            )
    return Table(
        "welch_bias",
        title("Bias of the Welch fits against the whole records", campaign.homogeneity),
        (
            *FIT_NAME_COLUMNS, Column("parameter", "parameter", TEXT_FORMAT),
            Column("Welch, mean", "welch"), Column("std", "welch_std", std_of_previous=True),
            Column("whole records", "record"), Column("std", "record_std", std_of_previous=True),
            Column("difference", "bias"), Column("significant", "significant", TEXT_FORMAT),
        ),
        tuple(rows),
        (
            "Types whose whole-record residual is noise. Significant: other than zero at the 0.1 % "
            "level. A bias is the same in every session: it does not show in the std of Table 3.",
            *footnotes(unsupported_orders),
        ),
        grouped=True,
    )  # fmt: skip


def _cells_with_paper_values(
    cells: Mapping[str, Cell],
    paper_values: Mapping[str, float | None],
    number_format: str,
    factor: float = 1.0,
) -> dict[str, Entry]:
    """Return cells with the paper's numbers added in parentheses, where the paper states one."""
    paper_cells = {
        name: number_cell(value, number_format, factor) for name, value in paper_values.items()
    }
    return {
        name: replace(cell, text=f"{cell.text} ({paper_cells[name].text})")
        if paper_values.get(name) is not None
        else cell
        for name, cell in cells.items()
    }


def _paper_entries(paper_values: Mapping[str, float | None]) -> dict[str, Entry]:
    """Return the paper's numbers as table entries for files; their keys begin with ``paper_``."""
    return {f"paper_{name}": value for name, value in paper_values.items()}


# The paper's own numbers: "Fractional-Order Models of Damping Phenomena in a Flexible Sensing
# Antenna Used for Haptic Robot Navigation", twenty sessions of a carbon fibre link.


@dataclass(frozen=True, slots=True)
class PaperStatistics:
    """Row of the paper's Table 3: statistics of one parameter over the paper's twenty sessions."""

    mean: float
    median: float
    std: float
    min: float
    max: float


@cache
def published_table3() -> Mapping[tuple[str, str, str], PaperStatistics]:
    """Return the paper's Table 3, by type, weighting and parameter."""
    return {
        (row["type"], row["weighting"], row["parameter"]): PaperStatistics(
            **{name: float(row[name]) for name in ("mean", "median", "std", "min", "max")}
        )
        for row in _read_data_rows("paper_table3.csv")
    }


@cache
def published_table4() -> Mapping[tuple[str, str, str, int], float]:
    """Return the paper's Table 4, by type, weighting, quantity and mode.

    The names of the quantities are those of `MeanPeakDeviation`.
    """
    names = ("quantity", "mode", "weighting")
    return {
        (structure, row["weighting"], row["quantity"], int(row["mode"])): float(value)
        for row in _read_data_rows("paper_table4.csv")
        for structure, value in row.items()
        if structure not in names
    }


@cache
def published_wmse() -> Mapping[tuple[str, str], float]:
    """Return the paper's weighted mean square error of its two best models.

    The keys are type and weighting.
    """
    return {
        (row["type"], row["weighting"]): float(row["wmse"])
        for row in _read_data_rows("paper_table5.csv")
    }


def _read_data_rows(name: str) -> list[dict[str, str]]:
    """Return the rows of a data file of this package, by column name."""
    text = files("analysis.report").joinpath("data", name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
