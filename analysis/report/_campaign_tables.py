"""Tables of a campaign: the tables of each output, and those with a row for each session."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.campaigns import group_errors_by_model
from analysis.campaigns.labels import label_and_unit
from analysis.campaigns.sentences import describe_failed_predictions
from analysis.report._paper_tables import FIT_NAME_COLUMNS, paper_tables
from analysis.report._pooled_tables import (
    homogeneity_table,
    leading_estimates,
    modes_table,
    pooled_table,
    specimens_table,
    structures_table,
    tolerance_table,
    uniform_beam_table,
)
from analysis.report.table import ABSENT_TEXT, TEXT_FORMAT, Cell, Column, Entry, Row, Table
from rigd.session.user_metadata import META_PREFIX
from rigd.units import suffix_of, unit_of

if TYPE_CHECKING:
    from analysis.campaigns import CampaignResult, SessionAnalysis


def shown_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the tables of the whole-record fits for terminal and page, in their order there."""
    homogeneity = campaign.homogeneity
    estimates = leading_estimates(campaign)
    scatter_tables = [homogeneity_table(campaign)] if homogeneity.quantities else []
    return (
        session_list_table(campaign),
        *([specimens_table(campaign)] if len(homogeneity.specimens) > 1 else []),
        *(scatter_tables if homogeneity.is_mixture else []),
        *headline_tables(campaign),
        *([uniform_beam_table(campaign)] if campaign.modal else []),
        *(pooled_table(campaign, estimate) for estimate in estimates[1:]),
        *([structures_table(campaign)] if campaign.structures else []),
        *([validation_summary(campaign)] if campaign.validation else []),
        *([] if homogeneity.is_mixture else scatter_tables),
    )


def main_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the tables that the terminal shows by default: pooled modes and parameters."""
    return headline_tables(campaign) if campaign.freest else ()


def headline_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the main tables: pooled modes, parameters with a tolerance, and the pooled fit."""
    possible_tables = (
        modes_table(campaign),
        tolerance_table(campaign),
        *(pooled_table(campaign, estimate) for estimate in leading_estimates(campaign)[:1]),
    )
    return tuple(report_table for report_table in possible_tables if report_table.rows)


def all_tables(campaign: CampaignResult, *, with_paper_values: bool = False) -> dict[str, Table]:
    """Return the tables that are written to files, except empty ones, by table name."""
    possible_tables = (
        *paper_tables(campaign, with_paper_values=with_paper_values),
        session_list_table(campaign),
        sessions_welch_table(campaign),
        sessions_record_table(campaign),
        structures_table(campaign),
        *([specimens_table(campaign)] if len(campaign.homogeneity.specimens) > 1 else []),
        homogeneity_table(campaign),
        tolerance_table(campaign),
        uniform_beam_table(campaign),
        pooled_table(campaign),
        modes_table(campaign),
        validation_table(campaign),
    )
    return {
        report_table.name: report_table for report_table in possible_tables if report_table.rows
    }


def session_list_table(campaign: CampaignResult) -> Table:
    """Return the table of all files with the metadata that each states, excluded files last."""

    def text_cell(cell_text: str) -> Cell:
        return Cell(cell_text, cell_text or ABSENT_TEXT)

    column_headings = ("file", "recorded (UTC)", "specimen", "operator", "note")
    column_keys = ("file", "start_utc", "specimen", "operator", "note")
    experiments = (
        *(session.experiment for session in campaign.sessions),
        *(session.experiment for session in campaign.failures),
    )
    metadata_names = dict.fromkeys(
        metadata_name
        for experiment in experiments
        if experiment
        for metadata_name in experiment.added_metadata
    )
    return Table.from_rows(
        "session_list",
        "Sessions, as their files state them",
        (
            *(
                Column(column_heading, key, TEXT_FORMAT)
                for column_heading, key in zip(column_headings, column_keys, strict=True)
            ),
            *map(_added_metadata_column, metadata_names),
            Column("used", "used", TEXT_FORMAT),
        ),
        (
            (
                Cell(str(session.source), session.name),
                text_cell(experiment.start_utc if experiment else ""),
                text_cell(experiment.specimen_label if experiment else ""),
                text_cell(experiment.operator if experiment else ""),
                text_cell(experiment.note if experiment else ""),
                *(
                    _added_metadata_cell(
                        experiment.added_metadata.get(metadata_name) if experiment else None
                    )
                    for metadata_name in metadata_names
                ),
                is_used,
            )
            for is_used, column_group in ((True, campaign.sessions), (False, campaign.failures))
            for session in column_group
            for experiment in (session.experiment,)
        ),
    )


def _added_metadata_column(metadata_name: str) -> Column:
    """Return the table column of a metadata key that users added, with the unit in its name."""
    unit_symbol = unit_of(metadata_name)
    column_heading = metadata_name.removesuffix(suffix_of(metadata_name)).replace("_", " ")
    return Column(
        f"{column_heading} ({unit_symbol})" if unit_symbol else column_heading,
        f"{META_PREFIX}{metadata_name}",
        TEXT_FORMAT,
    )


def _added_metadata_cell(metadata_value: float | str | None) -> Cell:
    """Return the table cell of a metadata value that users added; a dash if there is none."""
    if metadata_value is None:
        return Cell(None, ABSENT_TEXT)
    return Cell(
        metadata_value, metadata_value if isinstance(metadata_value, str) else f"{metadata_value:g}"
    )


def sessions_welch_table(campaign: CampaignResult) -> Table:
    """Return the table of every session's Welch fits, with the distance from the nominal models."""
    table_rows = [
        {
            **session.source.as_json(),
            "type": model.fit.structure.name,
            "weighting": model.fit.weighting,
            **model.fit.parameters,
            "cost": model.fit.cost,
            "at_bounds": " ".join(model.fit.at_bounds),
            **{
                f"nominal_{index_name}": index_value
                for index_name, index_value in asdict(nominal_model.indices[session_index]).items()
            },
        }
        for session_index, session in enumerate(campaign.sessions)
        for model, nominal_model in zip(session.welch_models, campaign.nominal, strict=True)
    ]
    return _file_only_table("sessions_welch", table_rows)


def sessions_record_table(campaign: CampaignResult) -> Table:
    """Return the table of every session's whole-record fits."""
    table_rows = [
        {
            **session.source.as_json(),
            "type": estimate.name,
            **estimate.fit.parameters,
            **{_std_key(name): std for name, std in estimate.fit.std_of_free_parameters.items()},
            "cost": estimate.fit.cost,
            "degrees_of_freedom": estimate.fit.degrees_of_freedom,
            "bic": estimate.bic,
            "at_bounds": " ".join(estimate.fit.at_bounds),
        }
        for session in campaign.sessions
        for estimate in session.record_estimates
    ]
    return _file_only_table("sessions_record", table_rows)


def _std_key(parameter_key: str) -> str:
    """Return the key of a parameter's standard deviation, with the unit last: ``delay_std_s``."""
    unit_suffix = suffix_of(parameter_key)
    return f"{parameter_key.removesuffix(unit_suffix)}_std{unit_suffix}"


def _file_only_table(table_name: str, table_rows: list[dict[str, Any]]) -> Table:
    """Return a table that is written to files only."""
    return Table(table_name, "", (), tuple(table_rows))


def validation_table(campaign: CampaignResult) -> Table:
    """Return the table of errors with which each session is predicted from the other sessions.

    Sessions that could not be predicted are the last rows.
    """
    table_rows: list[dict[str, Any]] = [
        {
            **prediction.source.as_json(),
            "method": prediction.method,
            "type": prediction.name,
            "weighting": prediction.weighting,
            "error": prediction.error,
            "own_error": prediction.own_error,
            "nrmse_percent": None
            if prediction.own_error is None
            else 100 * (1 - prediction.own_error),
            "lost": None,
        }
        for prediction in campaign.validation
    ]
    table_rows += [
        {**failed_trial.source.as_json(), "lost": failed_trial.reason}
        for failed_trial in campaign.failed_predictions
    ]
    return _file_only_table("validation", table_rows)


def validation_summary(campaign: CampaignResult) -> Table:
    """Return the table of each model's fit and leave-one-out error, the best model first."""
    table_rows: list[Row] = []
    for fit_method, type_name, weighting, model_errors in group_errors_by_model(
        campaign.validation
    ):
        session_errors = [session_error.error for session_error in model_errors]
        own_errors = [
            session_error.own_error
            for session_error in model_errors
            if session_error.own_error is not None
        ]
        table_rows.append(
            {
                "method": fit_method,
                "type": type_name,
                "weighting": weighting or "",
                "sessions": f"{len(session_errors)} of {campaign.trials}",
                "nrmse_percent": 100 * (1 - float(np.mean(own_errors))) if own_errors else None,
                "own_error": float(np.mean(own_errors)) if own_errors else None,
                "error": float(np.mean(session_errors)),
                "worst": max(session_errors),
            }
        )
    return Table(
        "validation",
        "Leave-one-out validation: rms error of the torque, mean over the sessions",
        (
            Column("method", "method", TEXT_FORMAT), *FIT_NAME_COLUMNS,
            Column("sessions", "sessions"),
            Column("fit (NRMSE, %)", "nrmse_percent", ".2f"),
            Column("in-sample error (%)", "own_error", ".2f", 100.0),
            Column("leave-one-out error (%)", "error", ".2f", 100.0),
            Column("worst (%)", "worst", ".2f", 100.0),
        ),
        tuple(table_rows),
        (
            "Fit: 100 (1 − ‖y − ŷ‖ / ‖y − mean of y‖), each session by its own whole-record fit: "
            "100 % less the in-sample error. Both errors include the noise of the torque.",
            *describe_failed_predictions(campaign.failed_predictions, campaign.trials),
        ),
    )  # fmt: skip


def sessions_table(campaign: CampaignResult) -> Table:
    """Return the table with one row for each session's verdict and for each excluded file."""
    leading_quantity = campaign.homogeneity.leading_scatter
    session_groups = leading_quantity.session_groups if leading_quantity else ()
    group_by_file = {
        file_name: f"{group_number}"
        for group_number, group_files in enumerate(session_groups, 1)
        for file_name in group_files
    }
    structure_name = campaign.freest.name if campaign.freest else None
    trials_by_source = {
        prediction.source: prediction
        for prediction in campaign.validation
        if (prediction.method, prediction.name) == ("record", structure_name)
    }

    def session_row(session: SessionAnalysis) -> tuple[Entry, ...]:
        verdict, trial = session.verdict, trials_by_source.get(session.source)
        own_error = trial.own_error if trial else None
        finding_kinds = [finding.kind for finding in verdict.findings] if verdict else []
        return (
            session.name,
            f"type {session.selected_structure}" if session.selected_structure else ABSENT_TEXT,
            None if own_error is None else 100 * (1 - own_error),
            trial.error if trial else None,
            ABSENT_TEXT if verdict is None else "noise" if verdict.adequate else "more than noise",
            ", ".join(dict.fromkeys(finding_kinds)) or ABSENT_TEXT,
        )

    excluded_rows: list[tuple[Entry, ...]] = [
        (failure.name, "left out", None, None, ABSENT_TEXT, failure.message)
        for failure in campaign.failures
    ]
    return Table.from_rows(
        "sessions",
        "Sessions, each by itself",
        (
            Column("file", "file", TEXT_FORMAT), Column("selects", "selected", TEXT_FORMAT),
            Column("fit (NRMSE, %)" if trials_by_source else "", "nrmse_percent", ".2f"),
            Column("leave-one-out error (%)" if trials_by_source else "", "error", ".2f", 100.0),
            Column("residual", "left", TEXT_FORMAT),
            Column("other effects", "findings", TEXT_FORMAT),
            Column("group" if session_groups else "", "group", TEXT_FORMAT),
        ),
        (
            (*row_cells, group_by_file.get(str(row_cells[0]), ABSENT_TEXT))
            for row_cells in (*map(session_row, campaign.sessions), *excluded_rows)
        ),
        (
            *((f"Fit and error: of type {structure_name}.",) if trials_by_source else ()),
            *(
                (f"Group: by the {label_and_unit(leading_quantity.quantity)[0]}.",)
                if leading_quantity and session_groups
                else ()
            ),
        ),
    )  # fmt: skip
