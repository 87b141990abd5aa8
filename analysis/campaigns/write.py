"""A campaign's folder: figures as PNG and SVG, tables as CSV, text and JSON."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from analysis.campaigns.rows import all_tables, campaign_document, csv_text
from analysis.report.document import document_text
from analysis.report.folder import OutputError, write_new

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from matplotlib.figure import Figure

    from analysis.campaigns.campaign import Campaign


def write_campaign(
    campaign: Campaign,
    folder: Path,
    *,
    with_paper: bool = False,
    on_step: Callable[[str], None] = lambda _done: None,
) -> None:
    """Write every figure and table.

    Parameters
    ----------
    campaign : Campaign
    folder : Path
        An existing folder without these files.
    with_paper : bool
        Whether the paper's numbers stand beside these.
    on_step : callable, optional
        Called with a figure's name after each.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    from analysis.campaigns.tables import tables_text
    from analysis.report import style

    for name, draw in _figures(campaign):
        with style.styled():
            figure = draw()
            for suffix in ("png", "svg"):
                _save(figure, folder / f"{name}.{suffix}")
        on_step(f"figure {name}")
    for name, rows in all_tables(campaign, with_paper=with_paper).items():
        write_new(folder / f"{name}.csv", csv_text(rows))
    text = document_text(campaign_document(campaign, with_paper=with_paper))
    write_new(folder / "campaign.json", text)
    write_new(folder / "tables.txt", tables_text(campaign, with_paper=with_paper))


def _figures(campaign: Campaign) -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Names and drawings, those for which there are data."""
    from analysis.campaigns.index_figure import index_figure
    from analysis.campaigns.pooled_figure import pooled_figure
    from analysis.campaigns.response_figures import best_figure, nominal_figure
    from analysis.campaigns.validation_figure import validation_figure

    yield "figure5_signals", lambda: _signals(campaign)
    yield "figure6_nominal", lambda: nominal_figure(campaign)
    yield "figure7_indices", lambda: index_figure(campaign)
    yield "figure8_best", lambda: best_figure(campaign)
    if campaign.pooled:
        yield "pooled", lambda: pooled_figure(campaign)
    if campaign.validation:
        yield "validation", lambda: validation_figure(campaign)


def _signals(campaign: Campaign) -> Figure:
    """Draw the first session's signals as an example, as the paper does."""
    from analysis.record import load_record
    from analysis.report.signals_figure import signals_figure
    from analysis.welch_route import analyse

    record = load_record(campaign.sessions[0].path)
    return signals_figure(analyse(record, replace(campaign.settings, types=())))


def _save(figure: Figure, path: Path) -> None:
    try:
        with path.open("xb") as stream:
            figure.savefig(
                stream, format=path.suffix[1:],
                metadata={"Date": None} if path.suffix == ".svg" else None,
            )  # fmt: skip
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
