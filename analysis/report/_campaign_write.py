"""A campaign's folder: the page, figures as PNG and SVG, tables as CSV, text and JSON."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING

from analysis.report._campaign_document import campaign_document
from analysis.report._campaign_tables import all_tables
from analysis.report._campaign_text import campaign_text
from analysis.report._document import document_text
from analysis.report._folder import write_new
from analysis.report._table import csv_text
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from analysis.campaigns import CampaignResult
    from analysis.results import FigureFormat


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
        Whether the paper's numbers stand beside these.
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
    from analysis.report._campaign_page import campaign_page

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
    page = campaign_page(campaign, pictures, made_at, with_paper=with_paper)
    write_new(folder / "report.html", page)


def _figures(campaign: CampaignResult) -> dict[str, tuple[Callable[[], Figure], str]]:
    """Drawings by name, with what is seen in them: those for which there are data."""
    from analysis.report._campaign_figures import (
        best_figure,
        index_figure,
        nominal_figure,
        pooled_figure,
        validation_figure,
    )
    from analysis.report._pooled_figures import damping_figure, response_figure

    found: dict[str, tuple[Callable[[], Figure], str]] = {}
    if campaign.headline is not None and campaign.headline.modes:
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
