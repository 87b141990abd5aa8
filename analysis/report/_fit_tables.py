"""Tables of the fits of one record: all whole-record fits, and all Welch fits."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Final

from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.paper.welch_analysis import LARGEST_FREQUENCY_SHIFT
from analysis.report._document import response_fit_percent
from analysis.report.table import (
    ABSENT_TEXT,
    TEXT_FORMAT,
    Cell,
    Column,
    Entry,
    Table,
    estimate_cells,
    grey_cell,
    mark_cell,
    number_cell,
    unreported_parameters,
    unsupported_order_notes,
)
from rigd.beam import DAMPING_PARAMETERS, PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from analysis.models import Structure
    from analysis.paper.welch_analysis import FittedModel, WelchAnalysis
    from analysis.results import WholeRecord

_AT_LIMIT_NOTE: Final = "* at the limit of the search range: not determined by the data."
"""Note on estimates at the limit of the search range."""


def structures_table(whole_record: WholeRecord) -> Table:
    """Return the table of all whole-record fits, with one row for each damping structure.

    Fractional orders that the data do not determine have a mark (†).
    """
    lowest_cost = min(fit.cost for fit in whole_record.fits.values())
    unsupported_orders = whole_record.unsupported_orders
    delta_bic = whole_record.delta_bic
    status_by_name = dict(whole_record.headline.structures)
    table_rows: list[tuple[Entry, ...]] = []
    for structure_name, fit in whole_record.fits.items():
        fit_status = status_by_name.get(structure_name, "")
        damping_cells = _damping_cells(
            fit.structure,
            fit.parameters,
            fit.std,
            unsupported_orders=unsupported_orders,
            at_bounds=fit.at_bounds,
        )
        table_rows.append(
            (
                structure_name,
                fit_status,
                *(map(_hidden_cell, damping_cells) if fit_status == "excluded" else damping_cells),
                *([delta_bic[structure_name]] if delta_bic else []),
                whole_record.analysis.fit_percent(fit),
                fit.cost / fit.degrees_of_freedom,
                fit.free_parameter_count,
                fit.cost,
                fit.cost - lowest_cost,
                fit.degrees_of_freedom,
                " ".join(sorted(unreported_parameters(fit.structure, unsupported_orders))),
            )
        )
    return Table.from_rows(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", TEXT_FORMAT),
            Column("", "status", TEXT_FORMAT),
            *_damping_columns(),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            Column("Residual", "cost_per_degree_of_freedom"),
            Column("Free", "free_parameters"),
            Column("", "cost"),
            Column("", "cost_above_lowest"),
            Column("", "degrees_of_freedom"),
            Column("", "not_reported", TEXT_FORMAT),
        ),
        table_rows,
        (
            *unsupported_order_notes(unsupported_orders),
            "ΔBIC: Bayesian information criterion above the lowest; 10 = decisive. Fit: NRMSE of "
            "the torque in the band, 100 (1 − ‖y − ŷ‖ / ‖y − mean of y‖). Residual: its power "
            "over that of the noise, 1 if nothing but noise is left. Free: number of free "
            "parameters, including those of rig and beam. * at the limit of the search range. "
            f"The marked row is {_highlighted_row_text(whole_record)}. The numbers of excluded "
            "structures are in the CSV file only, with the sums of squares.",
        ),
        highlighted_row=list(whole_record.fits).index(whole_record.headline.name),
    )


def added_structures_tables(whole_record: WholeRecord) -> tuple[Table, ...]:
    """Return the table of the fits of structures from installed packages; empty without any."""
    if not whole_record.added_fits:
        return ()
    table_rows: list[tuple[Entry, ...]] = [
        (
            fit.structure.name,
            parameter.symbol,
            fit.parameters[parameter.name],
            fit.std.get(parameter.name),
            parameter.unit or "1",
            parameter.meaning + (" *" if parameter.name in fit.at_bounds else ""),
            fit.delta_bic,
            whole_record.analysis.fit_percent(fit),
            parameter.name,
            fit.package,
            fit.compared_with,
        )
        for fit in whole_record.added_fits
        for parameter in fit.structure.parameters
    ]
    table = Table.from_rows(
        "added_structures",
        "Structures of installed packages on the whole record",
        (
            Column("Structure", "structure", TEXT_FORMAT),
            Column("", "symbol", TEXT_FORMAT),
            Column("Value", "value"),
            Column("std", "std", std_of_previous=True),
            Column("Unit", "unit", TEXT_FORMAT),
            Column("Meaning", "meaning", TEXT_FORMAT),
            Column("ΔBIC", "delta_bic"),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            Column("", "parameter", TEXT_FORMAT),
            Column("", "package", TEXT_FORMAT),
            Column("", "compared_with", TEXT_FORMAT),
        ),
        table_rows,
        (
            "ΔBIC: Bayesian information criterion above the lowest of types I to VII. These "
            "structures are compared with the types, but are not candidates of the verdict. * at "
            "the limit of the search range.",
        ),
        is_grouped=True,
    )
    return (table,)


def _highlighted_row_text(whole_record: WholeRecord) -> str:
    """Return the part of a note that states which fit the highlighted row of the table shows."""
    return (
        "the one reported"
        if whole_record.headline.exact is None
        else f"of the values {EXACTLY_UNIFORM_CONDITION}"
    )


def _hidden_cell(cell: Cell) -> Cell:
    """Return a cell that is displayed as a dash, but whose number is written to the CSV file."""
    return cell if cell.value is None else replace(cell, text=ABSENT_TEXT, is_doubtful=True)


def _damping_columns() -> list[Column]:
    """Return two columns for each damping parameter: its value and its standard deviation."""
    return [
        value_column
        for parameter_name in DAMPING_PARAMETERS
        for value_column in (
            Column(_parameter_heading(parameter_name), parameter_name),
            Column("std", f"{parameter_name}_std", std_of_previous=True),
        )
    ]  # fmt: skip


def _damping_cells(
    structure: Structure,
    parameters: Mapping[str, float],
    std: Mapping[str, float | None] | None,
    *,
    unsupported_orders: Collection[str] = (),
    at_bounds: Collection[str] = (),
) -> list[Cell]:
    """Return the cells of the damping parameters' values and standard deviations.

    Fixed values have no standard deviation. Parameters that the structure lacks are dashes.
    """
    unreported_names = unreported_parameters(structure, unsupported_orders)
    parameter_cells: list[Cell] = []
    for parameter_name in DAMPING_PARAMETERS:
        if not structure.has_damping_of(parameter_name):
            parameter_cells += [number_cell(None), number_cell(None)]
            continue
        parameter_std = (
            std[parameter_name] if std is not None and parameter_name in structure.free else None
        )
        value_cell, std_cell = estimate_cells(
            (parameters[parameter_name], parameter_std),
            parameter_std,
            PARAMETERS[parameter_name].display_factor,
        )
        if parameter_name in at_bounds:
            value_cell = replace(value_cell, text=f"{value_cell.text}*")
        parameter_cells += (
            [mark_cell(value_cell), grey_cell(std_cell)]
            if parameter_name in unreported_names
            else [value_cell, std_cell]
        )
    return parameter_cells


def _parameter_heading(parameter_name: str) -> str:
    """Return the heading of a damping parameter: symbol and power of ten.

    The units are omitted, because they depend on the orders and would be too long.
    """
    parameter_definition = PARAMETERS[parameter_name]
    if parameter_definition.display_factor == 1.0:
        return parameter_definition.symbol
    return f"{parameter_definition.symbol} ({parameter_definition.display_unit.split()[0]})"


_NAME_COLUMNS: Final = (
    Column("Type", "type", TEXT_FORMAT),
    Column("Weights", "weighting", TEXT_FORMAT),
)
"""Columns that identify a Welch fit: type and weighting."""
_FIT_INDEX_NAMES: Final = ("mse", "wmse", "md")
"""Names of the paper's indices."""
_FIT_INDEX_UNITS_NOTE: Final = "MSE and WMSE in (N·m/rad)², MD in N·m/rad."
"""Note on the units of the indices."""


def welch_fits_table(analysis: WelchAnalysis, unsupported_orders: Collection[str] = ()) -> Table:
    """Return the table of the parameters and indices of all Welch fits of a record.

    Orders of damping that the whole record does not support have a mark in the table.
    """
    fits = [model.fit for model in analysis.models]
    return Table.from_rows(
        "welch_fits",
        "Fits to Welch's estimate, as in the paper",
        (
            *_NAME_COLUMNS,
            *_damping_columns(),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            *(Column(index_name.upper(), index_name) for index_name in _FIT_INDEX_NAMES),
            Column("", "not_reported", TEXT_FORMAT),
        ),
        (
            (
                *_type_and_weighting(model),
                *_damping_cells(
                    fit.structure, fit.parameters, fit.std, unsupported_orders=unsupported_orders,
                    at_bounds=fit.at_bounds,
                ),
                response_fit_percent(analysis, model),
                *(getattr(model.indices, index_name) for index_name in _FIT_INDEX_NAMES),
                " ".join(sorted(unreported_parameters(fit.structure, unsupported_orders))),
            )
            for fit, model in zip(fits, analysis.models, strict=True)
        ),
        (
            *unsupported_order_notes(unsupported_orders),
            f"Fit: NRMSE of the complex response in the band. {_FIT_INDEX_UNITS_NOTE} std (±): "
            "one standard deviation, from the scatter of the response about the model. The bias "
            "of Welch's estimate on a chirp, which the window smears at the resonances, is not "
            "included and is often larger; whole-record fits do not have it.",
            *([_AT_LIMIT_NOTE] if any(fit.at_bounds for fit in fits) else []),
        ),
        is_grouped=True,
    )  # fmt: skip


def summary_table(analyses: Sequence[WelchAnalysis]) -> Table:
    """Return the table of the Welch fits' means and standard deviations over several files."""
    table_rows: list[tuple[Entry, ...]] = []
    for same_models in zip(*(welch_analysis.models for welch_analysis in analyses), strict=True):
        model_fits = [model.fit for model in same_models]
        parameter_values, index_values = (
            {key: [file_values[key] for file_values in results_of_files] for key in fit_keys}
            for fit_keys, results_of_files in (
                (DAMPING_PARAMETERS, [fit.parameters for fit in model_fits]),
                (_FIT_INDEX_NAMES, [asdict(model.indices) for model in same_models]),
            )
        )
        table_rows.append(
            (
                *_type_and_weighting(same_models[0]),
                *_damping_cells(
                    model_fits[0].structure,
                    {
                        value_name: fmean(file_values)
                        for value_name, file_values in parameter_values.items()
                    },
                    {
                        value_name: _stdev_or_nan(file_values)
                        for value_name, file_values in parameter_values.items()
                    },
                ),
                *(
                    mean_cell
                    for file_values in index_values.values()
                    for mean_cell in estimate_cells(
                        (fmean(file_values), _stdev_or_nan(file_values)), _stdev_or_nan(file_values)
                    )
                ),
            )
        )
    return Table.from_rows(
        "welch_summary",
        f"Mean ± standard deviation over {len(analyses)} files",
        (
            *_NAME_COLUMNS,
            *_damping_columns(),
            *(
                table_column
                for value_name in _FIT_INDEX_NAMES
                for table_column in (
                    Column(value_name.upper(), value_name),
                    Column("std", f"{value_name}_std", std_of_previous=True),
                )
            ),
        ),
        table_rows,
        (_FIT_INDEX_UNITS_NOTE,),
        is_grouped=True,
    )  # fmt: skip


def _stdev_or_nan(sample_values: list[float]) -> float:
    """Return the standard deviation of several values; NaN for a single one."""
    return stdev(sample_values) if len(sample_values) > 1 else math.nan


def _type_and_weighting(model: FittedModel) -> tuple[str, str]:
    """Return the type and the weighting of a Welch fit."""
    return model.fit.structure.name, model.fit.weighting


def peaks_table(analysis: WelchAnalysis) -> Table:
    """Return the table of measured resonance peaks and each model's deviations from them."""
    mode_numbers = range(1, len(analysis.peaks) + 1)
    measured_values = (
        *(2 * math.pi * p.frequency_hz if p else None for p in analysis.peaks),
        *(p.magnitude_db if p else None for p in analysis.peaks),
    )
    return Table.from_rows(
        "welch_peaks",
        "Resonant peaks of Welch's estimate, and deviations of the models' peaks from them",
        (
            *_NAME_COLUMNS,
            *(Column(f"ω{n} (rad/s)", f"omega_{n}_rad_s", ".3f") for n in mode_numbers),
            *(Column(f"M{n} (dB)", f"magnitude_{n}_db", ".3f") for n in mode_numbers),
        ),
        (
            ("measured", "", *measured_values),
            *(
                (
                    *_type_and_weighting(model),
                    *(d.frequency_rad_s if d else None for d in model.deviations),
                    *(d.magnitude_db if d else None for d in model.deviations),
                )
                for model in analysis.models
            ),
        ),
        ("First row: the peaks; below: absolute deviations, as in the paper's Table 4.",),
        highlighted_row=0,
        is_grouped=True,
    )


_FAR_MODE_MARK: Final = "‡"
"""Symbol after a mode whose frequency is far from the undamped beam's."""


def welch_modes_table(analysis: WelchAnalysis) -> Table | None:
    """Return the table of modes from each Welch fit's poles; None if no fit has modes.

    A mode far from the undamped beam's has a mark (‡). An overdamped mode is shown as a dash.
    """
    fitted_models = analysis.models
    max_modes = max((len(fitted_model.modes) for fitted_model in fitted_models), default=0)
    if not max_modes:
        return None

    def mode_value_cells(
        fitted_model: FittedModel, value_name: str, number_format: str, display_factor: float = 1.0
    ) -> list[Cell]:
        mode_cells = []
        for mode, is_followed in zip(
            fitted_model.modes, fitted_model.are_near_undamped, strict=True
        ):
            cell = number_cell(
                getattr(mode, value_name) if mode.damping_ratio < 1 else None,
                number_format,
                display_factor,
            )
            if cell.value is not None and not is_followed:
                cell = grey_cell(replace(cell, text=cell.text + _FAR_MODE_MARK))
            mode_cells.append(cell)
        return mode_cells or [number_cell(None)] * max_modes

    modes_with_flags = [
        mode_with_flag
        for fitted_model in fitted_models
        for mode_with_flag in zip(fitted_model.modes, fitted_model.are_near_undamped, strict=True)
    ]
    is_underdamped = [mode.damping_ratio < 1 for mode, _ in modes_with_flags]
    table_notes = ["From the poles of the fitted model; ξ is the damping ratio."]
    if any(not is_followed and mode.damping_ratio < 1 for mode, is_followed in modes_with_flags):
        table_notes.append(
            f"{_FAR_MODE_MARK} more than {100 * LARGEST_FREQUENCY_SHIFT:g} % off the undamped "
            "beam's: the fit does not follow this resonance. The number only describes the fitted "
            "curve."
        )
    if not all(is_underdamped) or not all(fitted_model.modes for fitted_model in fitted_models):
        table_notes.append(f"{ABSENT_TEXT} overdamped in this fit.")
    return Table.from_rows(
        "welch_modes",
        "Modes of the fits to Welch's estimate",
        (
            *_NAME_COLUMNS,
            *(Column(f"f{n} (Hz)", f"frequency_{n}_hz") for n in range(1, max_modes + 1)),
            *(Column(f"ξ{n} (%)", f"damping_ratio_{n}") for n in range(1, max_modes + 1)),
        ),
        (
            (
                *_type_and_weighting(fitted_model),
                *mode_value_cells(fitted_model, "frequency_hz", ".4f"),
                *mode_value_cells(fitted_model, "damping_ratio", ".4g", 100.0),
            )
            for fitted_model in fitted_models
        ),
        table_notes,
        is_grouped=True,
    )
