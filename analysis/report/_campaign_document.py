"""Results of a campaign as one JSON document, without NaN: unknown values are null."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from analysis.campaigns import headlines
from analysis.report._campaign_tables import all_tables
from analysis.report._document import program_versions
from analysis.report.table import json_rows
from analysis.results import finite_json

if TYPE_CHECKING:
    from analysis.campaigns import CampaignResult, RecordEstimate, SessionAnalysis
    from analysis.identify import ModeEstimate, RecordFit
    from analysis.paper import FrfFit
    from analysis.paper.welch_analysis import FitIndices, FittedModel


def campaign_document(
    campaign: CampaignResult, *, with_paper_values: bool = False
) -> dict[str, Any]:
    """Return the results of a campaign as one JSON document.

    Parameters
    ----------
    campaign : Campaign
        Results of all sessions.
    with_paper_values : bool
        Whether the tables include the numbers that the reference paper publishes.

    Returns
    -------
    dict
        ``headlines`` of each session and, with ``file`` null, of all sessions together;
        ``validity`` of the linear model for the least valid session; ``verdict`` on all sessions
        (null without whole-record estimates); ``files`` with the length of the beam and the verdict
        on each; ``errors`` (files that are left out, with reasons); ``one_specimen``, and the
        ``groups`` of sessions if they are not of one specimen; ``trials`` of the validation: how
        many were requested, completed and lost; ``fits`` and ``modes`` of single sessions; and the
        tables by the names of their CSV files. All numbers are finite.
    """
    leading_quantity = campaign.homogeneity.leading_scatter
    document_content: dict[str, Any] = finite_json(
        {
            "versions": program_versions(),
            "headlines": headlines(campaign),
            "validity": campaign.validity.as_json(),
            "verdict": None if campaign.verdict is None else asdict(campaign.verdict),
            "settings": asdict(campaign.settings) | {"record_band_hz": campaign.record_band_hz},
            "files": [
                {
                    **session_analysis.source.as_json(),
                    "beam_length_m": session_analysis.beam.length_m,
                    "validity": session_analysis.validity.as_json(),
                    "warnings": session_analysis.warnings,
                    "welch_segments": session_analysis.segments or None,
                    "verdict": None
                    if session_analysis.verdict is None
                    else session_analysis.verdict.as_json(),
                }
                for session_analysis in campaign.sessions
            ],
            "one_specimen": campaign.homogeneity.is_one_specimen,
            "groups": leading_quantity
            and {"quantity": leading_quantity.quantity, "files": leading_quantity.session_groups},
            "trials": {
                "asked": campaign.trials,
                "done": campaign.trials - len(campaign.failed_predictions),
                "lost": [
                    {**trial.source.as_json(), "reason": trial.reason}
                    for trial in campaign.failed_predictions
                ],
            },
            "errors": [
                {**failure.source.as_json(), "message": failure.message}
                for failure in campaign.failures
            ],
            "fits": [
                fit
                for session_analysis in campaign.sessions
                for fit in (
                    *(
                        _welch_fit_json(session_analysis, model)
                        for model in session_analysis.welch_models
                    ),
                    *(
                        _record_fit_json(session_analysis, estimate)
                        for estimate in session_analysis.record_estimates
                    ),
                )
            ],
            "modes": [
                _mode_json(session_analysis, estimate, mode)
                for session_analysis in campaign.sessions
                for estimate in session_analysis.record_estimates
                if estimate.name == session_analysis.selected_structure
                for mode in estimate.fit.modes
            ],
            **{
                table_name: json_rows(report_table)
                for table_name, report_table in all_tables(
                    campaign, with_paper_values=with_paper_values
                ).items()
            },
        }
    )
    return document_content


def _fit_identity_json(
    session: SessionAnalysis, estimator: str, structure_name: str
) -> dict[str, Any]:
    """Return the entries that identify a session's fit: file, estimator, type and weighting."""
    return {
        **session.source.as_json(), "estimator": estimator, "type": structure_name,
        "weighting": None,
    }  # fmt: skip


def _welch_fit_json(session: SessionAnalysis, model: FittedModel) -> dict[str, Any]:
    """Return the JSON object of a model that is fitted to a session's Welch response."""
    fit = model.fit
    return {
        **_fit_identity_json(session, "welch", fit.structure.name),
        "weighting": fit.weighting,
        **_fit_values_json(fit, model.indices),
    }


def _record_fit_json(session: SessionAnalysis, estimate: RecordEstimate) -> dict[str, Any]:
    """Return the JSON object of the model that is fitted to a session's whole record."""
    return {
        **_fit_identity_json(session, "record", estimate.name),
        "candidate": estimate.name,
        **_fit_values_json(estimate.fit, estimate.indices),
    }


def _fit_values_json(fit: FrfFit | RecordFit, indices: FitIndices) -> dict[str, Any]:
    """Return the entries of a fit's JSON object with parameters, accuracy and indices."""
    return {
        "parameters": fit.parameters,
        "std": fit.std_of_free_parameters,
        "cost": fit.cost,
        "at_bounds": fit.at_bounds,
        "indices": asdict(indices),
    }


def _mode_json(
    session: SessionAnalysis, estimate: RecordEstimate, mode: ModeEstimate
) -> dict[str, Any]:
    """Return the JSON object of a mode of a session's whole-record fit."""
    mode_values = asdict(mode)
    return _fit_identity_json(session, "record", estimate.name) | {
        "mode": mode_values.pop("number"),
        **mode_values,
    }
