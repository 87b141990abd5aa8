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

from analysis.campaigns import MAX_REFERENCE_MISFIT, best_models
from analysis.campaigns.specimen_sentences import pooled_title
from analysis.models import STRUCTURES, estimator_text
from analysis.report.table import (
    NOT_REPORTED_MARK,
    TEXT_FORMAT,
    Cell,
    Column,
    Entry,
    Row,
    Table,
    estimate_cells,
    number_cell,
    unreported_parameters,
    unsupported_order_notes,
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


def paper_tables(campaign: CampaignResult, *, with_paper_values: bool = False) -> tuple[Table, ...]:
    """Return the reference paper's tables with the numbers of the campaign's Welch fits.

    The tuple is empty if the campaign has no Welch fits. With `with_paper_values` the tables also
    contain the numbers that the paper publishes, in parentheses.
    """
    if not campaign.nominal:
        return ()
    return (
        *(
            make_table(campaign, with_paper_values=with_paper_values)
            for make_table in (table3, table4, table5)
        ),
        fit_indices_table(campaign),
        *([bias_table(campaign)] if campaign.welch_biases else []),
    )


def welch_method_text(campaign: CampaignResult) -> str:
    """Return a text that states how the sessions' frequency responses were estimated."""
    settings = campaign.settings
    segment_counts = [session.segments for session in campaign.sessions]
    min_segments, max_segments = min(segment_counts), max(segment_counts)
    segments_text = (
        f"{min_segments}" if min_segments == max_segments else f"{min_segments} to {max_segments}"
    )
    # The settings state all lengths, so that the rate has no effect.
    return estimator_text(settings.estimator, settings.segmentation(PAPER_RATE_HZ), segments_text)


_STATISTIC_NAMES: Final = ("mean", "median", "std", "min", "max")
"""Statistics of a parameter over the sessions, as in Table 3."""
_TABLE_3_HEADINGS: Final = {"zeta": ("ζ (10⁻⁴ s^α)", 1e4), "alpha": ("α", 1.0),
                   "gamma": ("γ (10⁻¹ s^λ/m⁴)", 10.0), "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and display factor (a power of ten, as in the paper) of each parameter in Table 3."""
_AT_LIMIT_NOTE: Final = "*n: at the limit of the search range in n sessions."
"""Note on estimates at the limit of the search range."""
_PARENTHESES_NOTE: Final = "In parentheses: the values of the paper."
"""Note on the numbers in parentheses."""


def table3(campaign: CampaignResult, *, with_paper_values: bool = False) -> Table:
    """Return the table of each parameter's statistics over the sessions (Table 3)."""
    table_rows: list[Row] = []
    for statistics in campaign.statistics:
        parameter_symbol, display_factor = _TABLE_3_HEADINGS[statistics.parameter]
        paper_values: dict[str, float | None] = {}
        if with_paper_values:
            paper_row = published_table3().get(
                (statistics.structure, statistics.weighting, statistics.parameter)
            )
            paper_values = {
                statistic_name: getattr(paper_row, statistic_name, None)
                for statistic_name in _STATISTIC_NAMES
            }
        statistic_values = [
            getattr(statistics, statistic_name) for statistic_name in _STATISTIC_NAMES
        ]
        statistic_cells = dict(
            zip(
                _STATISTIC_NAMES,
                estimate_cells(statistic_values, statistics.std, display_factor),
                strict=True,
            )
        )
        table_rows.append(
            {
                "type": statistics.structure,
                "weighting": statistics.weighting,
                "parameter": Cell(
                    statistics.parameter,
                    f"{parameter_symbol} *{statistics.at_bounds}"
                    if statistics.at_bounds
                    else parameter_symbol,
                ),
                **_cells_with_paper_values(statistic_cells, paper_values, ".4g", display_factor),
                "at_bounds": statistics.at_bounds,
                **_paper_entries(paper_values),
                "mixture": campaign.homogeneity.is_mixture,
            }
        )
    return Table(
        "table3",
        pooled_title(
            f"Parameters over {len(campaign.sessions)} sessions (Table 3)",
            campaign.homogeneity,
        ),
        (
            *FIT_NAME_COLUMNS,
            Column("parameter", "parameter", TEXT_FORMAT),
            *(Column(statistic_name, statistic_name) for statistic_name in _STATISTIC_NAMES),
        ),
        tuple(table_rows),
        (
            f"{welch_method_text(campaign)}; {campaign.settings.band_hz[0]:g} to "
            f"{campaign.settings.band_hz[1]:g} Hz.",
            *(
                [_AT_LIMIT_NOTE]
                if any(statistics.at_bounds for statistics in campaign.statistics)
                else []
            ),
            *([_PARENTHESES_NOTE] if with_paper_values else []),
        ),
        is_grouped=True,
    )


_PEAK_HEADINGS: Final = {"frequency_rad_s": "ω{} (rad/s)", "magnitude_db": "M{} (dB)"}
"""Headings of a resonance peak's deviations, with a placeholder for the mode's number."""


def table4(campaign: CampaignResult, *, with_paper_values: bool = False) -> Table:
    """Return the table of mean deviations of the models' resonance peaks from the measured ones.

    It corresponds to the paper's Table 4.
    """
    type_names = list(dict.fromkeys(nominal_model.structure for nominal_model in campaign.nominal))
    weightings = list(dict.fromkeys(nominal_model.weighting for nominal_model in campaign.nominal))
    deviation_by_key = {
        (peak_quantity, deviation.mode, nominal_model.weighting, nominal_model.structure): getattr(
            deviation, peak_quantity
        )
        for peak_quantity in _PEAK_HEADINGS
        for nominal_model in campaign.nominal
        for deviation in nominal_model.deviations
    }
    table_rows: list[Row] = []
    for peak_quantity, mode_number, weighting in sorted(
        {key[:3] for key in deviation_by_key}, key=lambda key: (*key[:2], weightings.index(key[2]))
    ):
        row_key = (peak_quantity, mode_number, weighting)
        deviation_cells = {
            type_name: number_cell(deviation_by_key[*row_key, type_name], ".3g")
            for type_name in type_names
            if (*row_key, type_name) in deviation_by_key
        }
        paper_values = {
            other_type: published_table4().get((other_type, weighting, peak_quantity, mode_number))
            for other_type in deviation_cells
            if with_paper_values
        }
        table_rows.append(
            {
                "quantity": Cell(peak_quantity, _PEAK_HEADINGS[peak_quantity].format(mode_number)),
                "mode": mode_number,
                "weighting": weighting,
                **_cells_with_paper_values(deviation_cells, paper_values, ".3f"),
                **_paper_entries(paper_values),
                "mixture": campaign.homogeneity.is_mixture,
            }
        )
    return Table(
        "table4",
        pooled_title(
            "Mean deviation of the resonant peaks from the nominal model's (MDR, Table 4)",
            campaign.homogeneity,
        ),
        (
            Column("peak", "quantity", TEXT_FORMAT),
            Column("weights", "weighting", TEXT_FORMAT),
            *(Column(f"type {type_name}", type_name) for type_name in type_names),
        ),
        tuple(table_rows),
        (
            "A nominal model has the mean of the sessions' parameters.",
            *([_PARENTHESES_NOTE] if with_paper_values else []),
        ),
        is_grouped=True,
    )


_TABLE_5_DISPLAY_FACTORS: Final = {"alpha": 1.0, "zeta": 1e5, "lambda": 1.0, "gamma": 1e2}
"""Display factor of each parameter in Table 5: a power of ten, as in the paper."""


def table5(campaign: CampaignResult, *, with_paper_values: bool = False) -> Table:
    """Return the table of the two best nominal models' parameters and WMSE (Table 5)."""
    table_rows: list[Row] = []
    std_by_parameter = {
        (statistics.structure, statistics.weighting, statistics.parameter): statistics.std
        for statistics in campaign.statistics
    }
    for model in best_models(campaign.nominal):
        paper_wmse = published_wmse().get((model.structure, model.weighting))
        paper_values = {"wmse": paper_wmse} if with_paper_values else {}
        table_rows.append(
            {
                "type": model.structure,
                "weighting": model.weighting,
                **{
                    value_name: estimate_cells(
                        [model_value],
                        std_by_parameter.get((model.structure, model.weighting, value_name)),
                        _TABLE_5_DISPLAY_FACTORS[value_name],
                    )[0]
                    for value_name, model_value in model.parameters.items()
                },
                **_cells_with_paper_values(
                    {"wmse": number_cell(model.mean_wmse)}, paper_values, ".3f"
                ),
                **{
                    value_name: model_value
                    for deviation in model.deviations
                    for value_name, model_value in (
                        (f"mdr_omega_{deviation.mode}_rad_s", deviation.frequency_rad_s),
                        (f"mdr_magnitude_{deviation.mode}_db", deviation.magnitude_db),
                    )
                },
                **_paper_entries(paper_values),
                "mixture": campaign.homogeneity.is_mixture,
            }
        )
    return Table(
        "table5",
        pooled_title(
            "The two best nominal models (Table 5; their peaks are in Table 4)",
            campaign.homogeneity,
        ),
        (
            *FIT_NAME_COLUMNS, Column("α", "alpha"), Column("ζ (10⁻⁵ s^α)", "zeta"),
            Column("λ", "lambda"), Column("γ (10⁻² s^λ/m⁴)", "gamma"),
            Column("WMSE ((N·m/rad)²)", "wmse"),
        ),
        tuple(table_rows),
        (_PARENTHESES_NOTE,) if with_paper_values else (),
    )  # fmt: skip


_FIT_INDEX_HEADINGS: Final = {
    "mse": "MSE ((N·m/rad)²)", "wmse": "WMSE ((N·m/rad)²)", "md": "MD (N·m/rad)",
}  # fmt: skip
"""Headings of the paper's indices."""


def fit_indices_table(campaign: CampaignResult) -> Table:
    """Return the table of the distances between nominal models and sessions, as in Figure 7."""
    table_rows: list[Row] = []
    for model in campaign.nominal:
        row: dict[str, Entry] = {"type": model.structure, "weighting": model.weighting}
        for index_name in _FIT_INDEX_HEADINGS:
            index_values = np.array(
                [getattr(session_indices, index_name) for session_indices in model.indices]
            )
            std = float(index_values.std(ddof=1)) if index_values.size > 1 else None
            row[index_name], row[f"{index_name}_std"] = estimate_cells(
                (float(index_values.mean()), std), std
            )
            row[f"{index_name}_median"] = float(np.median(index_values))
        table_rows.append({**row, "mixture": campaign.homogeneity.is_mixture})
    return Table(
        "nominal_indices",
        pooled_title("Distance of the nominal models from the sessions", campaign.homogeneity),
        (
            *FIT_NAME_COLUMNS,
            *(
                value_column
                for index_name, index_heading in _FIT_INDEX_HEADINGS.items()
                for value_column in (
                    Column(index_heading, index_name),
                    Column("std", f"{index_name}_std", std_of_previous=True)
                )
            ),
        ),
        tuple(table_rows),
        ("Eqs. 28 to 30, mean and standard deviation over the sessions, as in Figure 7.",),
        is_grouped=True,
    )  # fmt: skip


def bias_table(campaign: CampaignResult) -> Table:
    """Return the table of the Welch fits' bias relative to pooled whole-record estimates."""
    unsupported_orders = campaign.verdict.withheld_orders if campaign.verdict else frozenset[str]()
    table_rows: list[Row] = []
    for fit_bias in campaign.welch_biases:
        unreported_names = unreported_parameters(STRUCTURES[fit_bias.structure], unsupported_orders)
        for parameter in fit_bias.parameters:
            parameter_symbol, display_factor = _TABLE_3_HEADINGS[parameter.parameter]
            welch_cell = estimate_cells(
                (parameter.welch_mean, parameter.welch_std), parameter.welch_std, display_factor
            )
            record_cell = estimate_cells(
                (parameter.record_estimate, parameter.record_std),
                parameter.record_std,
                display_factor,
            )
            bias_cells: dict[str, Entry] = dict(
                zip(
                    ("welch", "welch_std", "record", "record_std"),
                    (*welch_cell, *record_cell),
                    strict=True,
                )
            )
            table_rows.append(
                {
                    "type": fit_bias.structure,
                    "weighting": fit_bias.weighting,
                    "parameter": Cell(
                        parameter.parameter,
                        parameter_symbol
                        + NOT_REPORTED_MARK * (parameter.parameter in unreported_names),
                    ),
                    **bias_cells,
                    "bias": estimate_cells((parameter.bias,), parameter.bias_std, display_factor)[
                        0
                    ],
                    "bias_std": parameter.bias_std,
                    "significant": parameter.is_significant,
                    "reported": parameter.parameter not in unreported_names,
                    "wmse": fit_bias.wmse,
                    "record_wmse": fit_bias.record_wmse,
                    "mixture": campaign.homogeneity.is_mixture,
                }
            )
    return Table(
        "welch_bias",
        pooled_title("Bias of the Welch fits against the whole records", campaign.homogeneity),
        (
            *FIT_NAME_COLUMNS, Column("parameter", "parameter", TEXT_FORMAT),
            Column("Welch, mean", "welch"), Column("std", "welch_std", std_of_previous=True),
            Column("whole records", "record"), Column("std", "record_std", std_of_previous=True),
            Column("difference", "bias"), Column("significant", "significant", TEXT_FORMAT),
        ),
        tuple(table_rows),
        (
            "Types whose whole-record residual has at most "
            f"{MAX_REFERENCE_MISFIT:g} times the power of the noise. Significant: other than zero "
            "at the 0.1 % level. A bias is the same in every session: it does not show in the std "
            "of Table 3.",
            *unsupported_order_notes(unsupported_orders),
        ),
        is_grouped=True,
    )  # fmt: skip


def _cells_with_paper_values(
    own_cells: Mapping[str, Cell],
    paper_values: Mapping[str, float | None],
    number_format: str,
    display_factor: float = 1.0,
) -> dict[str, Entry]:
    """Return cells with the paper's numbers added in parentheses, where the paper states one."""
    paper_cells = {
        cell_key: number_cell(paper_value, number_format, display_factor)
        for cell_key, paper_value in paper_values.items()
    }
    return {
        cell_key: replace(own_cell, text=f"{own_cell.text} ({paper_cells[cell_key].text})")
        if paper_values.get(cell_key) is not None
        else own_cell
        for cell_key, own_cell in own_cells.items()
    }


def _paper_entries(paper_values: Mapping[str, float | None]) -> dict[str, Entry]:
    """Return the paper's numbers as entries of a row for files, with keys ``paper_…``."""
    return {f"paper_{value_name}": paper_value for value_name, paper_value in paper_values.items()}


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
    """Return the statistics in the paper's Table 3 by type, weighting and parameter."""
    return {
        (row["type"], row["weighting"], row["parameter"]): PaperStatistics(
            **{
                statistic_name: float(row[statistic_name])
                for statistic_name in ("mean", "median", "std", "min", "max")
            }
        )
        for row in _read_data_rows("paper_table3.csv")
    }


@cache
def published_table4() -> Mapping[tuple[str, str, str, int], float]:
    """Return the mean deviations of the peaks in the paper's Table 4.

    The key is (name of the model type, weighting, quantity, number of the mode).

    The names of the quantities are those of `MeanPeakDeviation`.
    """
    key_names = ("quantity", "mode", "weighting")
    return {
        (type_name, row["weighting"], row["quantity"], int(row["mode"])): float(deviation_value)
        for row in _read_data_rows("paper_table4.csv")
        for type_name, deviation_value in row.items()
        if type_name not in key_names
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


def _read_data_rows(file_name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file of this package, each as a dict by column name."""
    file_text = files("analysis.report").joinpath("data", file_name).read_text(encoding="utf-8")
    return list(csv.DictReader(file_text.splitlines()))
