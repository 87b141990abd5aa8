"""Tables of a campaign for the terminal, its page, CSV and JSON: which there are, and the lists.

Lists are those of the sessions and of the predictions.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.campaigns import by_model
from analysis.campaigns.sentences import label, lost_trials
from analysis.report._paper_tables import NAMES, paper_tables
from analysis.report._pooled_tables import (
    homogeneity_table,
    likely_estimates,
    modes_table,
    pooled_table,
    specimens_table,
    structures_table,
    tolerant_table,
    uniform_beam_table,
)
from analysis.report.table import ABSENT, WORDS, Cell, Column, Entry, Row, Table
from rigd.session.user_metadata import META_PREFIX
from rigd.units import suffix_of, unit_of

if TYPE_CHECKING:
    from analysis.campaigns import CampaignResult, SessionAnalysis


def shown_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the tables of the whole records for terminal and page, the most important first."""
    found = campaign.homogeneity
    estimates = likely_estimates(campaign)
    scatter = [homogeneity_table(campaign)] if found.quantities else []
    return (
        session_list_table(campaign),
        *([specimens_table(campaign)] if len(found.specimens) > 1 else []),
        *(scatter if found.mixed else []),
        *headline_tables(campaign),
        *([uniform_beam_table(campaign)] if campaign.modal else []),
        *(pooled_table(campaign, each) for each in estimates[1:]),
        *([structures_table(campaign)] if campaign.structures else []),
        *([validation_summary(campaign)] if campaign.validation else []),
        *([] if found.mixed else scatter),
    )


def main_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the tables that the terminal shows by default: pooled modes and parameters."""
    return headline_tables(campaign) if campaign.headline else ()


def headline_tables(campaign: CampaignResult) -> tuple[Table, ...]:
    """Return the main tables: modes, parameters with a tolerance of the geometry, pooled fit."""
    made = (
        modes_table(campaign),
        tolerant_table(campaign),
        *(pooled_table(campaign, each) for each in likely_estimates(campaign)[:1]),
    )
    return tuple(table for table in made if table.rows)


def all_tables(campaign: CampaignResult, *, with_paper: bool = False) -> dict[str, Table]:
    """Return every table of the files by its name, without empty ones."""
    made = (
        *paper_tables(campaign, with_paper=with_paper),
        session_list_table(campaign),
        sessions_welch_table(campaign),
        sessions_record_table(campaign),
        structures_table(campaign),
        *([specimens_table(campaign)] if len(campaign.homogeneity.specimens) > 1 else []),
        homogeneity_table(campaign),
        tolerant_table(campaign),
        uniform_beam_table(campaign),
        pooled_table(campaign),
        modes_table(campaign),
        validation_table(campaign),
    )
    return {table.name: table for table in made if table.rows}


def session_list_table(campaign: CampaignResult) -> Table:
    """Return the table of all files, excluded ones last."""

    def text_cell(text: str) -> Cell:
        return Cell(text, text or ABSENT)

    headings = ("file", "recorded (UTC)", "specimen", "operator", "note")
    keys = ("file", "start_utc", "specimen", "operator", "note")
    stated = (
        *(each.experiment for each in campaign.sessions),
        *(each.experiment for each in campaign.failures),
    )
    added = dict.fromkeys(name for its in stated if its for name in its.added)
    return Table.of(
        "session_list",
        "Sessions, as their files state them",
        (
            *(Column(heading, key, WORDS) for heading, key in zip(headings, keys, strict=True)),
            *map(_added_column, added),
            Column("used", "used", WORDS),
        ),
        (
            (
                Cell(str(each.path), each.name),
                text_cell(its.start_utc if its else ""),
                text_cell(its.label if its else ""),
                text_cell(its.operator if its else ""),
                text_cell(its.note if its else ""),
                *(_added_cell(its.added.get(name) if its else None) for name in added),
                used,
            )
            for used, group in ((True, campaign.sessions), (False, campaign.failures))
            for each in group
            for its in (each.experiment,)
        ),
    )


def _added_column(name: str) -> Column:
    """Column of metadata that users added, with the unit that its name ends in."""
    unit = unit_of(name)
    words = name.removesuffix(suffix_of(name)).replace("_", " ")
    return Column(f"{words} ({unit})" if unit else words, f"{META_PREFIX}{name}", WORDS)


def _added_cell(value: float | str | None) -> Cell:
    if value is None:
        return Cell(None, ABSENT)
    return Cell(value, value if isinstance(value, str) else f"{value:g}")


def sessions_welch_table(campaign: CampaignResult) -> Table:
    """Every session's Welch fits, and the distance of the nominal models."""
    rows = [
        {
            "file": str(session.path),
            "type": fit.structure,
            "weighting": fit.weighting,
            **fit.parameters,
            "cost": fit.cost,
            "at_bounds": " ".join(fit.at_bounds),
            **{f"nominal_{name}": value for name, value in asdict(model.indices[index]).items()},
        }
        for index, session in enumerate(campaign.sessions)
        for fit, model in zip(session.welch_fits, campaign.nominal, strict=True)
    ]
    return _for_programs("sessions_welch", rows)


def sessions_record_table(campaign: CampaignResult) -> Table:
    """Every session's whole-record fits."""
    rows = [
        {
            "file": str(session.path),
            "type": each.structure,
            **each.parameters,
            **{
                _std_key(name): value if name in each.free else None
                for name, value in each.std.items()
            },
            "cost": each.cost,
            "degrees_of_freedom": each.degrees_of_freedom,
            "bic": each.bic,
            "at_bounds": " ".join(each.at_bounds),
        }
        for session in campaign.sessions
        for each in session.record_estimates
    ]
    return _for_programs("sessions_record", rows)


def _std_key(parameter: str) -> str:
    """Return the name of a parameter's standard deviation, with the unit last: ``delay_std_s``."""
    unit = suffix_of(parameter)
    return f"{parameter.removesuffix(unit)}_std{unit}"


def _for_programs(name: str, rows: list[dict[str, Any]]) -> Table:
    """Make a table of files only."""
    return Table(name, "", (), tuple(rows))


def validation_table(campaign: CampaignResult) -> Table:
    """Return the errors of each session predicted from the others, then the lost trials."""
    rows: list[dict[str, Any]] = [
        {
            "file": str(each.path),
            "method": each.method,
            "type": each.name,
            "weighting": each.weighting,
            "error": each.error,
            "own_error": each.own_error,
            "nrmse_percent": None if each.own_error is None else 100 * (1 - each.own_error),
            "lost": None,
        }
        for each in campaign.validation
    ]
    rows += [{"file": str(each.path), "lost": each.reason} for each in campaign.lost_trials]
    return _for_programs("validation", rows)


def validation_summary(campaign: CampaignResult) -> Table:
    """Fit, and leave-one-out error, of each model over the sessions, the best model first."""
    rows: list[Row] = []
    for method, name, weighting, errors in by_model(campaign.validation):
        values = [each.error for each in errors]
        own = [each.own_error for each in errors if each.own_error is not None]
        rows.append(
            {
                "method": method,
                "type": name,
                "weighting": weighting or "",
                "sessions": f"{len(values)} of {campaign.trials}",
                "nrmse_percent": 100 * (1 - float(np.mean(own))) if own else None,
                "own_error": float(np.mean(own)) if own else None,
                "error": float(np.mean(values)),
                "worst": max(values),
            }
        )
    return Table(
        "validation",
        "Leave-one-out validation: rms error of the torque, mean over the sessions",
        (
            Column("method", "method", WORDS), *NAMES, Column("sessions", "sessions"),
            Column("fit (NRMSE, %)", "nrmse_percent", ".2f"),
            Column("in-sample error (%)", "own_error", ".2f", 100.0),
            Column("leave-one-out error (%)", "error", ".2f", 100.0),
            Column("worst (%)", "worst", ".2f", 100.0),
        ),
        tuple(rows),
        (
            "Fit: 100 (1 − ‖y − ŷ‖ / ‖y − mean of y‖), each session by its own whole-record fit: "
            "100 % less the in-sample error. Both errors include the noise of the torque.",
            *lost_trials(campaign.lost_trials, campaign.trials),
        ),
    )  # fmt: skip


def sessions_table(campaign: CampaignResult) -> Table:
    """Return the table of sessions with their own verdicts, then those left out."""
    leading = campaign.homogeneity.leading
    groups = leading.groups if leading else ()
    group_of = {name: f"{index}" for index, names in enumerate(groups, 1) for name in names}
    name = campaign.headline.name if campaign.headline else None
    tried = {
        each.path: each
        for each in campaign.validation
        if (each.method, each.name) == ("record", name)
    }

    def row(session: SessionAnalysis) -> tuple[Entry, ...]:
        verdict, trial = session.verdict, tried.get(session.path)
        own = trial.own_error if trial else None
        found = [each.kind for each in verdict.findings] if verdict else []
        return (
            session.name,
            f"type {session.selected}" if session.selected else ABSENT,
            None if own is None else 100 * (1 - own),
            trial.error if trial else None,
            ABSENT if verdict is None else "noise" if verdict.adequate else "more than noise",
            ", ".join(dict.fromkeys(found)) or ABSENT,
        )

    left_out: list[tuple[Entry, ...]] = [
        (each.name, "left out", None, None, ABSENT, each.message) for each in campaign.failures
    ]
    return Table.of(
        "sessions",
        "Sessions, each by itself",
        (
            Column("file", "file", WORDS), Column("selects", "selected", WORDS),
            Column("fit (NRMSE, %)" if tried else "", "nrmse_percent", ".2f"),
            Column("leave-one-out error (%)" if tried else "", "error", ".2f", 100.0),
            Column("residual", "left", WORDS),
            Column("other effects", "findings", WORDS),
            Column("group" if groups else "", "group", WORDS),
        ),
        (
            (*cells, group_of.get(str(cells[0]), ABSENT))
            for cells in (*map(row, campaign.sessions), *left_out)
        ),
        (
            *((f"Fit and error: of type {name}.",) if tried else ()),
            *((f"Group: by the {label(leading.quantity)[0]}.",) if leading and groups else ()),
        ),
    )  # fmt: skip
