"""Report of a campaign: text, one page, and a folder with figures, tables and JSON."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Final

from rich.console import Group
from rich.text import Text

from analysis.campaigns.sentences import lost_trials, specimens
from analysis.identify.headline import EXACT_CONDITION
from analysis.report._campaign_document import campaign_document
from analysis.report._campaign_tables import all_tables, main_tables, sessions_table, shown_tables
from analysis.report._document import document_text
from analysis.report._paper_tables import paper_tables, welch_text
from analysis.report._text import as_text, spaced
from analysis.report.folder import write_new
from analysis.report.table import csv_text
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from rich.console import RenderableType

    from analysis.campaigns import CampaignResult
    from analysis.report._page import Facts
    from analysis.report._style import Picture
    from analysis.results import FigureFormat

# Text

_NO_VERDICT: Final = (
    "No verdict on the whole records: two sessions are needed that determine a structure's damping."
)


def campaign_sentences(campaign: CampaignResult) -> tuple[str, ...]:
    """Return the verdict; without one, the statement on the specimen, and the reason.

    The second sentence, or the only one, is on the validity of the numbers.
    """
    sentences = _verdict_sentences(campaign)
    return (*sentences[:1], campaign.validity.sentence, *sentences[1:])


def _verdict_sentences(campaign: CampaignResult) -> tuple[str, ...]:
    if campaign.verdict is not None:
        return campaign.verdict.sentences
    has_estimates = any(each.record_estimates for each in campaign.sessions)
    return (
        *specimens(campaign.homogeneity),
        *([_NO_VERDICT] if has_estimates else []),
        *lost_trials(campaign.lost_trials, campaign.trials),
    )


def campaign_tables(
    campaign: CampaignResult, *, with_paper: bool = False, verbose: bool = True
) -> RenderableType:
    """Return the verdict, its basis, and the paper's Tables 3 to 5.

    Parameters
    ----------
    campaign : CampaignResult
    with_paper : bool
        Whether the paper's numbers are included.
    verbose : bool
        Whether all tables are shown; otherwise the verdict, the pooled modes and parameters, and
        with `with_paper` the tables of the paper.
    """
    parts: list[RenderableType] = []
    sentences = campaign_sentences(campaign)
    if sentences:
        first, *others = sentences
        parts += [Text(first, style="bold"), *map(Text, others)]
        if campaign.verdict is not None and campaign.verdict.experiments:
            parts.append(Text("Further experiments:"))
            parts += [Text(f"  {advice}") for advice in campaign.verdict.experiments]
        parts.append("")
    parts += spaced(shown_tables(campaign) if verbose else main_tables(campaign))
    if verbose or with_paper or campaign.headline is None:
        parts += spaced(paper_tables(campaign, with_paper=with_paper))
    parts += [
        Text(f"Warning: {session.name}: {warning}", style="yellow")
        for session in campaign.sessions
        for warning in session.warnings
    ]
    return Group(*parts)


def campaign_text(campaign: CampaignResult, *, with_paper: bool = False) -> str:
    """Return the tables as plain text, with the files that were left out.

    Parameters
    ----------
    campaign : CampaignResult
        The results.
    with_paper : bool
        Whether the paper's numbers are shown with them.
    """
    left_out = (Text(f"Left out: {failure.message}") for failure in campaign.failures)
    return as_text(Group(campaign_tables(campaign, with_paper=with_paper), *left_out))


# Page

_OF_RECORDS: Final = ("damping", "pooled_response", "pooled", "validation")
"""Figures that go with the verdict; the others are the paper's."""


def campaign_page(
    campaign: CampaignResult, pictures: Sequence[Picture], made_at: datetime, *, with_paper: bool
) -> str:
    """Return a campaign's report.

    Parameters
    ----------
    campaign : CampaignResult
    pictures : sequence of Picture
    made_at : datetime
        Date of the report, with a time zone.
    with_paper : bool
        Whether the paper's numbers are included.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    from analysis.report._page import page, versions

    paths = [each.path for each in campaign.sessions]
    sentences = campaign_sentences(campaign)
    return page(
        "campaign.html",
        title=f"Campaign of {len(paths)} sessions",
        files=f"{paths[0].name} to {paths[-1].name}, in {paths[0].absolute().parent}",
        first=sentences[:1],
        sentences=sentences[1:],
        experiments=campaign.verdict.experiments if campaign.verdict else (),
        warnings=_warnings(campaign),
        pictures=[each for each in pictures if each.name in _OF_RECORDS],
        tables=(*shown_tables(campaign), sessions_table(campaign)),
        paper_pictures=[each for each in pictures if each.name not in _OF_RECORDS],
        paper_tables=paper_tables(campaign, with_paper=with_paper),
        how=[*_how(campaign), versions(made_at)],
    )


def _warnings(campaign: CampaignResult) -> list[str]:
    return [
        *(f"Left out: {each.message}" for each in campaign.failures),
        *(
            f"Not predicted from the others: {each.path}: {each.reason}"
            for each in campaign.lost_trials
        ),
        *(
            f"{session.name}: {warning}"
            for session in campaign.sessions
            for warning in session.warnings
        ),
    ]


def _how(campaign: CampaignResult) -> list[Facts]:
    """Collect the facts on specimen and estimators."""
    settings, (first_hz, last_hz) = campaign.settings, campaign.record_band_hz
    beam = campaign.sessions[0].beam
    parts = [
        (
            "Specimen, as the files state it",
            [
                ("beam length", f"{beam.length_m:g} m"),
                ("beam density", f"{beam.density_kg_per_m:g} kg/m"),
                ("bending stiffness", f"{beam.bending_stiffness_n_m2:g} N·m²"),
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
                *_of_geometry(campaign),
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
                ("estimator", welch_text(campaign)),
                ("band", f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz"),
                ("types", ", ".join(settings.types)),
                ("weights", ", ".join(settings.weightings)),
            ],
        ),
    ]
    if not campaign.nominal:
        del parts[2]
    if not campaign.sessions[0].record_estimates:
        del parts[1]
    return parts


def _of_geometry(campaign: CampaignResult) -> list[tuple[str, str]]:
    """Describe the model of modes and parameters if a tolerance of the geometry is stated."""
    if campaign.modal is None or not campaign.modal.leads:
        return []
    return [
        (
            "modes and parameters",
            "modal constants (frequency, damping ratio, residue of each mode) pooled over the "
            "sessions; a beam fitted to these, with the tolerance of the geometry added to their "
            f"covariance; {EXACT_CONDITION}: the pooled estimates of the types",
        )
    ]


# Folder


def write_campaign(
    campaign: CampaignResult,
    folder: Path,
    *,
    with_paper: bool = False,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    on_step: Callable[[str], None] = lambda _done: None,
) -> None:
    """Write the page ``report.html``, ``figures/``, ``tables/*.csv``, text and JSON.

    Parameters
    ----------
    campaign : CampaignResult
    folder : Path
        An existing folder without these files.
    with_paper : bool
        Whether the paper's numbers are included.
    formats : sequence of str
        Formats of the figures.
    on_step : callable, optional
        Called with a figure's name after each.

    Raises
    ------
    OutputExistsError, OutputError
        A file exists, or cannot be written.
    """
    from analysis.report import _style as style

    pictures = []
    for name, (draw, description) in _figures(campaign).items():
        with style.styled():
            figure = draw()
            pictures.append(
                style.save_picture(figure, folder / "figures" / name, description, formats)
            )
        on_step(f"figure {name}")
    for name, table in all_tables(campaign, with_paper=with_paper).items():
        write_new(folder / "tables" / f"{name}.csv", csv_text(table))
    text = document_text(campaign_document(campaign, with_paper=with_paper))
    write_new(folder / "campaign.json", text)
    write_new(folder / "tables.txt", campaign_text(campaign, with_paper=with_paper))
    made_at = datetime.now().astimezone()
    html = campaign_page(campaign, pictures, made_at, with_paper=with_paper)
    write_new(folder / "report.html", html)


def _figures(campaign: CampaignResult) -> dict[str, tuple[Callable[[], Figure], str]]:
    """Return the figures for which there are data by name, with their descriptions."""
    from analysis.report._campaign_figures import (
        best_figure,
        index_figure,
        nominal_figure,
        pooled_figure,
        validation_figure,
    )
    from analysis.report._pooled_figures import damping_figure, response_figure

    found: dict[str, tuple[Callable[[], Figure], str]] = {}
    if campaign.headline is not None and campaign.modes:
        found["damping"] = (
            partial(damping_figure, campaign),
            "Damping ratios of all sessions' modes against frequency, and the pooled ones with "
            "their 95 % intervals; below, each mode enlarged.",
        )
    if campaign.headline is not None:
        found["pooled_response"] = (
            partial(response_figure, campaign),
            "Frequency response of the pooled estimate over that of every session: magnitude, "
            "phase, and half-width of the 95 % band.",
        )
        found["pooled"] = (
            partial(pooled_figure, campaign),
            "Whole-record estimate of each session with its 95 % interval, and the pooled one.",
        )
    if campaign.validation:
        found["validation"] = (
            partial(validation_figure, campaign),
            "Each session's torque predicted from the other sessions: error by model.",
        )
    if not campaign.nominal:
        return found
    return found | {
        "figure5_signals": (
            partial(_signals, campaign),
            "Reference, angle and torque of the first session (Figure 5 of the paper).",
        ),
        "figure6_nominal": (
            partial(nominal_figure, campaign),
            "Measured responses of all sessions, and the nominal models of each type (Figure 6).",
        ),
        "figure7_indices": (
            partial(index_figure, campaign),
            "Mean square error, its weighted kind and maximum deviation of each nominal model "
            "over the sessions (Figure 7).",
        ),
        "figure8_best": (
            partial(best_figure, campaign),
            "Measured responses of all sessions, and the two best nominal models (Figure 8).",
        ),
    }


def _signals(campaign: CampaignResult) -> Figure:
    """Draw the first session's signals as an example, as the paper does."""
    from analysis.paper import analyse
    from analysis.record import load_record
    from analysis.report._signal_figures import paper_signals_figure as signals_figure

    record = load_record(campaign.sessions[0].path)
    return signals_figure(analyse(record, replace(campaign.settings, types=())))
