"""Report of a campaign: text, an HTML page, and a folder with figures, tables and JSON."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Final

from rich.console import Group
from rich.text import Text

from analysis.campaigns.sentences import describe_failed_predictions
from analysis.campaigns.specimen_sentences import (
    describe_blocks,
    describe_specimens,
    describe_trends,
)
from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.report._campaign_document import campaign_document
from analysis.report._campaign_tables import all_tables, main_tables, sessions_table, shown_tables
from analysis.report._document import document_text
from analysis.report._paper_tables import paper_tables, welch_method_text
from analysis.report._shared_warnings import FileWarnings, shared_warnings
from analysis.report._text import as_text, warning_lines, with_empty_lines
from analysis.report.folder import write_new_file
from analysis.report.table import csv_text
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from rich.console import RenderableType

    from analysis.campaigns import CampaignResult
    from analysis.report._page import FactGroup
    from analysis.report._style import Illustration, Picture
    from analysis.results import FigureFormat

# Text

_NO_VERDICT_SENTENCE: Final = (
    "No verdict on the whole records: two sessions are needed that determine a structure's damping."
)
"""Sentence that states why there is no verdict."""


def campaign_sentences(campaign: CampaignResult) -> tuple[str, ...]:
    """Return the verdict on a campaign, and the validity of the linear model, as sentences.

    Without a verdict they state whether the sessions are of one specimen, and why there is no
    verdict. The second sentence (or the only one) states the validity.
    """
    verdict_sentences = _verdict_sentences(campaign)
    return (*verdict_sentences[:1], campaign.validity.sentence, *verdict_sentences[1:])


def _verdict_sentences(campaign: CampaignResult) -> tuple[str, ...]:
    """Return the verdict's sentences, or those on specimens and on why there is no verdict."""
    if campaign.verdict is not None:
        return campaign.verdict.sentences
    has_estimates = any(session.record_estimates for session in campaign.sessions)
    return (
        *describe_specimens(campaign.homogeneity),
        *describe_blocks(campaign.homogeneity, len(campaign.sessions)),
        *describe_trends(campaign.homogeneity),
        *([_NO_VERDICT_SENTENCE] if has_estimates else []),
        *describe_failed_predictions(campaign.failed_predictions, campaign.trials),
    )


def campaign_tables(
    campaign: CampaignResult, *, with_paper_values: bool = False, verbose: bool = True
) -> RenderableType:
    """Return a campaign's verdict, its tables and its warnings, for the terminal.

    Parameters
    ----------
    campaign : CampaignResult
        Results of all sessions.
    with_paper_values : bool
        Whether the paper's own numbers are included.
    verbose : bool
        Whether all tables are included. Otherwise only the verdict, the pooled modes and
        parameters, and with `with_paper_values` the tables of the paper.
    """
    text_parts: list[RenderableType] = []
    all_sentences = campaign_sentences(campaign)
    if all_sentences:
        first_sentence, *further_sentences = all_sentences
        text_parts += [Text(first_sentence, style="bold"), *map(Text, further_sentences)]
        if campaign.verdict is not None and campaign.verdict.experiments:
            text_parts.append(Text("Further experiments:"))
            text_parts += [Text(f"  {advice_text}") for advice_text in campaign.verdict.experiments]
        text_parts.append("")
    text_parts += with_empty_lines(shown_tables(campaign) if verbose else main_tables(campaign))
    if verbose or with_paper_values or campaign.freest is None:
        text_parts += with_empty_lines(paper_tables(campaign, with_paper_values=with_paper_values))
    text_parts += warning_lines(_session_warnings(campaign))
    return Group(*text_parts)


def _session_warnings(campaign: CampaignResult) -> list[str]:
    """Return the sessions' own warnings, each once."""
    return shared_warnings(
        [
            FileWarnings(session.name, session.path, session.warnings)
            for session in campaign.sessions
        ],
        "blocks" if campaign.homogeneity.is_one_session else "files",
    )


def campaign_text(campaign: CampaignResult, *, with_paper_values: bool = False) -> str:
    """Return a campaign's tables as plain text, with a list of the files that were excluded.

    Parameters
    ----------
    campaign : CampaignResult
        Results of all sessions.
    with_paper_values : bool
        Whether the paper's own numbers are included.
    """
    left_out_lines = (Text(f"Left out: {failure.message}") for failure in campaign.failures)
    return as_text(
        Group(campaign_tables(campaign, with_paper_values=with_paper_values), *left_out_lines)
    )


# Page

_WHOLE_RECORD_FIGURES: Final = ("trends", "damping", "pooled_response", "pooled", "validation")
"""Names of the whole-record fits' figures, which follow the verdict on the page. The other figures
correspond to the reference paper's."""


def campaign_page(
    campaign: CampaignResult,
    pictures: Sequence[Picture],
    made_at: datetime,
    *,
    with_paper_values: bool,
) -> str:
    """Return the HTML page with the results of a campaign.

    Parameters
    ----------
    campaign : CampaignResult
        Results of all sessions.
    pictures : sequence of Picture
        Figures of the campaign.
    made_at : datetime
        Date and time of the report, with a time zone.
    with_paper_values : bool
        Whether the paper's own numbers are included.

    Returns
    -------
    str
        HTML document that refers to no other files.
    """
    from analysis.report._page import render_page, version_facts

    session_paths = [session.path for session in campaign.sessions]
    all_sentences = campaign_sentences(campaign)
    return render_page(
        "campaign.html",
        title=f"{len(session_paths)} blocks of a session"
        if campaign.homogeneity.is_one_session
        else f"Campaign of {len(session_paths)} sessions",
        files=f"{session_paths[0].name} to {session_paths[-1].name}, "
        f"in {session_paths[0].absolute().parent}"
        if len(set(session_paths)) > 1
        else str(session_paths[0].absolute()),
        first=all_sentences[:1],
        sentences=all_sentences[1:],
        experiments=campaign.verdict.experiments if campaign.verdict else (),
        warnings=_warning_texts(campaign),
        pictures=[picture for picture in pictures if picture.name in _WHOLE_RECORD_FIGURES],
        tables=(*shown_tables(campaign), sessions_table(campaign)),
        paper_pictures=[
            picture for picture in pictures if picture.name not in _WHOLE_RECORD_FIGURES
        ],
        paper_tables=paper_tables(campaign, with_paper_values=with_paper_values),
        how=[*_collect_facts(campaign), version_facts(made_at)],
    )


def _warning_texts(campaign: CampaignResult) -> list[str]:
    """Return all warnings: excluded files, failed predictions, and the sessions' own warnings."""
    return [
        *(f"Left out: {failure.message}" for failure in campaign.failures),
        *(
            f"Not predicted from the others: {lost_trial.source}: {lost_trial.reason}"
            for lost_trial in campaign.failed_predictions
        ),
        *_session_warnings(campaign),
    ]


def _collect_facts(campaign: CampaignResult) -> list[FactGroup]:
    """Return groups of facts on specimen and estimators, for the HTML page."""
    settings, (first_hz, last_hz) = campaign.settings, campaign.record_band_hz
    stated_beam = campaign.sessions[0].beam
    fact_groups = [
        (
            "Specimen, as the files state it",
            [
                ("beam length", f"{stated_beam.length_m:g} m"),
                ("beam density", f"{stated_beam.density_kg_per_m:g} kg/m"),
                ("bending stiffness", f"{stated_beam.bending_stiffness_n_m2:g} N·m²"),
            ],
        ),
        (
            "Whole records",
            [
                (
                    "estimator",
                    "output error: the torque that the exact model (Eq. 25) predicts from the "
                    "measured angle minus the measured torque, whitened by the noise model",
                ),
                ("band", f"{first_hz:g} to {last_hz:g} Hz"),
                (
                    "pooled",
                    "random effects: sessions with their own covariances, and a between-session "
                    "variance of each parameter (DerSimonian and Laird); Student's t",
                ),
                *_geometry_facts(campaign),
                (
                    "structure",
                    "the freest on the beam of the lowest Bayesian information criterion of all "
                    "sessions together, the same for all sessions",
                ),
            ],
        ),
        (
            "Welch method (as in the paper)",
            [
                ("estimator", welch_method_text(campaign)),
                ("band", f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz"),
                ("types", ", ".join(settings.types)),
                ("weights", ", ".join(settings.weightings)),
            ],
        ),
    ]
    if not campaign.nominal:
        del fact_groups[2]
    if not campaign.sessions[0].record_estimates:
        del fact_groups[1]
    return fact_groups


def _geometry_facts(campaign: CampaignResult) -> list[tuple[str, str]]:
    """Return facts (name, text) on the tolerance of the beam's geometry, if one is stated."""
    if campaign.modal is None or not campaign.modal.replaces_beam_modes:
        return []
    return [
        (
            "modes and parameters",
            "modal constants (frequency, damping ratio, residue of each mode) pooled over the "
            "sessions; a beam fitted to these, with the tolerance of the geometry added to their "
            f"covariance; {EXACTLY_UNIFORM_CONDITION}: the pooled estimates of the types",
        )
    ]


# Folder


def write_campaign(
    campaign: CampaignResult,
    folder: Path,
    *,
    with_paper_values: bool = False,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    on_step: Callable[[str], None] = lambda _step_text: None,
) -> None:
    """Write the report of a campaign into a folder.

    It consists of ``report.html``, ``figures/``, ``tables/*.csv``, ``tables.txt`` and
    ``campaign.json``.

    Parameters
    ----------
    campaign : CampaignResult
        Results of all sessions.
    folder : Path
        Existing folder that contains none of these files.
    with_paper_values : bool
        Whether the paper's own numbers are included.
    formats : sequence of str
        Formats of the figures.
    on_step : callable, optional
        Function that is called after each figure with a short text.

    Raises
    ------
    OutputExistsError, OutputError
        If a file exists or cannot be written.
    """
    from analysis.report._style import save_pictures

    illustrations = list(_illustrations(campaign))
    pictures = save_pictures(illustrations, folder / "figures", formats, on_step)
    for table_name, report_table in all_tables(
        campaign, with_paper_values=with_paper_values
    ).items():
        write_new_file(folder / "tables" / f"{table_name}.csv", csv_text(report_table))
    document_json = document_text(campaign_document(campaign, with_paper_values=with_paper_values))
    write_new_file(folder / "campaign.json", document_json)
    write_new_file(
        folder / "tables.txt", campaign_text(campaign, with_paper_values=with_paper_values)
    )
    made_at = datetime.now().astimezone()
    page_html = campaign_page(campaign, pictures, made_at, with_paper_values=with_paper_values)
    write_new_file(folder / "report.html", page_html)


def _illustrations(campaign: CampaignResult) -> Iterator[Illustration]:
    """Yield the figures of a campaign's report, except those for which there are no data."""
    from analysis.report._campaign_figures import (
        best_models_figure,
        fit_index_figure,
        nominal_models_figure,
        pooled_parameters_figure,
        validation_figure,
    )
    from analysis.report._pooled_figures import damping_figure, response_figure
    from analysis.report._style import Illustration
    from analysis.report._trend_figure import trend_figure

    scatters = campaign.homogeneity.quantities
    if any(scatter.has_significant_trend for scatter in scatters) or (
        campaign.homogeneity.is_one_session and any(scatter.trend for scatter in scatters)
    ):
        yield Illustration(
            "trends",
            partial(trend_figure, campaign),
            "Modes and parameters of each session against time, with 95 % intervals; straight "
            "lines where the change with time is significant.",
        )
    if campaign.freest is not None and campaign.modes:
        yield Illustration(
            "damping",
            partial(damping_figure, campaign),
            "Damping ratios of all sessions' modes against frequency, and the pooled ones with "
            "their 95 % intervals; below, each mode enlarged.",
        )
    if campaign.freest is not None:
        yield Illustration(
            "pooled_response",
            partial(response_figure, campaign),
            "Frequency response of the pooled estimate over that of every session: magnitude, "
            "phase, and half-width of the 95 % band.",
        )
        yield Illustration(
            "pooled",
            partial(pooled_parameters_figure, campaign),
            "Whole-record estimate of each session with its 95 % interval, and the pooled one.",
        )
    if campaign.validation:
        yield Illustration(
            "validation",
            partial(validation_figure, campaign),
            "Each session's torque predicted from the other sessions: error by model.",
        )
    if not campaign.nominal:
        return
    yield Illustration(
        "figure5_signals",
        partial(_draw_example_signals, campaign),
        "Reference, angle and torque of the first session (Figure 5 of the paper).",
    )
    yield Illustration(
        "figure6_nominal",
        partial(nominal_models_figure, campaign),
        "Measured responses of all sessions, and the nominal models of each type (Figure 6).",
    )
    yield Illustration(
        "figure7_indices",
        partial(fit_index_figure, campaign),
        "Mean square error, its weighted kind and maximum deviation of each nominal model "
        "over the sessions (Figure 7).",
    )
    yield Illustration(
        "figure8_best",
        partial(best_models_figure, campaign),
        "Measured responses of all sessions, and the two best nominal models (Figure 8).",
    )


def _draw_example_signals(campaign: CampaignResult) -> Figure:
    """Draw the first session's signals as an example, as the paper does."""
    from analysis.paper.welch_analysis import analyse
    from analysis.record import load_record
    from analysis.report._signal_figures import paper_signals_figure as signals_figure

    source = campaign.sessions[0].source
    record = load_record(source.path, source.part_s)
    return signals_figure(analyse(record, replace(campaign.settings, types=())))
