"""One record's report: a folder with page, figures, tables and the JSON document."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Final

from analysis.report._document import document, document_text
from analysis.report._folder import OutputError, write_new
from analysis.report._html import drawing, photograph, svg_text
from analysis.report._record_page import NAMES, illustrations, page
from analysis.report._record_tables import (
    amplitude_tables,
    condition_table,
    correlations_table,
    modes_table,
    parameters_table,
    peaks_table,
    sizes_table,
    structures_table,
    welch_fits_table,
)
from analysis.report._table import Table, csv_text

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from rich.console import RenderableType

    from analysis.paper import WelchAnalysis
    from analysis.report._html import Markup
    from analysis.results import Subject

FIGURES: Final = NAMES
_WELCH_FIGURE: Final = "frf"
_WELCH_DESCRIPTION: Final = (
    "Frequency response by Welch's method, as in the paper, with the fits of each type and "
    "weighting, and the coherence."
)


def write_html_report(
    subject: Subject,
    folder: Path,
    on_step: Callable[[str], None] = lambda _done: None,
    made_at: datetime | None = None,
) -> None:
    """Write ``report.html``, ``figures/*.png`` and ``.svg``, and ``tables/*.csv``.

    Parameters
    ----------
    subject : Subject
    folder : Path
        An existing folder without these files. The paper's figure ``frf.png`` is shown in the
        report if it is there, as `analysis.report._write.write_report` leaves it.
    on_step : callable, optional
        Called with a few words after each figure.
    made_at : datetime, optional
        What the report calls its time; by default now.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    from analysis.report import _style as style

    drawings = []
    with style.styled():
        for shown in illustrations(subject):
            target = folder / "figures" / f"{shown.name}.png"
            try:
                target.parent.mkdir(exist_ok=True)
                style.save(shown.figure, target)
            except OSError as error:
                raise OutputError(
                    f"{target} cannot be written: {error.strerror or error}."
                ) from error
            svg = svg_text(shown.figure)
            write_new(target.with_suffix(".svg"), svg)
            drawings.append(drawing(svg, shown.name, shown.description))
            on_step(f"figure {shown.name}")
    modes, tables, of_paper = report_tables(subject)
    for table in (modes, *tables, *of_paper):
        write_new(folder / "tables" / f"{table.name}.csv", csv_text(table))
    paper: list[Markup | Table] = [
        *_welch_figure(folder, shown=subject.welch is not None),
        *of_paper,
    ]
    made_at = made_at or datetime.now().astimezone()
    write_new(folder / "report.html", page(subject, drawings, modes, tables, paper, made_at))


def report_tables(subject: Subject) -> tuple[Table, tuple[Table, ...], tuple[Table, ...]]:
    """Make the table of modes, those of the whole-record fits, and those of the paper's route."""
    condition = condition_table(subject)
    tables = (
        sizes_table(subject),
        parameters_table(subject),
        *(() if condition is None else (condition,)),
        correlations_table(subject),
        *amplitude_tables(subject),
        structures_table(subject),
    )
    welch = subject.welch
    of_paper = (
        () if welch is None else (welch_fits_table(welch, subject.unsupported), peaks_table(welch))
    )
    return modes_table(subject), tables, of_paper


def _welch_figure(folder: Path, *, shown: bool) -> list[Markup]:
    picture = folder / f"{_WELCH_FIGURE}.png"
    if not shown or not picture.exists():
        return []
    return [photograph(picture.read_bytes(), f"welch_{_WELCH_FIGURE}", _WELCH_DESCRIPTION)]


_FIGURES: Final = ("signals", "frf", "torque")
_FIGURES_BESIDE_RECORD: Final = ("frf",)
"""Of the paper's route, where the whole-record fit has signals and torque of its own."""

TEXT_WIDTH: Final = 120


def write_report(
    analysis: WelchAnalysis | None,
    folder: Path,
    on_step: Callable[[str], None] = lambda _done: None,
    subject: Subject | None = None,
) -> None:
    """Write figures, ``tables.txt``, ``analysis.json`` and, of a whole record, all in HTML.

    Parameters
    ----------
    analysis : WelchAnalysis or None
        The paper's route; None if it was not gone, and only `subject` is reported.
    folder : Path
        An existing folder without these files.
    on_step : callable, optional
        Called with a few words after each figure.
    subject : Subject, optional
        The whole-record fits: with them, what `write_html_report` writes, in the place of
        ``signals.png`` and ``torque.png``.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    if analysis is not None:
        _draw(
            analysis,
            figures_of_paper(paper=True, whole_record=subject is not None),
            folder,
            on_step,
        )
    write_new(folder / "tables.txt", _text(analysis, subject))
    if subject is not None:
        write_html_report(subject, folder, on_step)
    analyses = () if analysis is None else (analysis,)
    subjects = () if subject is None else (subject,)
    write_new(folder / "analysis.json", document_text(document(analyses, subjects=subjects)))


def figures_of_paper(*, paper: bool, whole_record: bool) -> tuple[str, ...]:
    """Name the figures of the paper's route that a report has."""
    if not paper:
        return ()
    return _FIGURES_BESIDE_RECORD if whole_record else _FIGURES


def _draw(
    analysis: WelchAnalysis, names: Collection[str], folder: Path, on_step: Callable[[str], None]
) -> None:
    from analysis.report import _style as style
    from analysis.report._frf_figure import frf_figure
    from analysis.report._signal_figures import paper_signals_figure as signals_figure
    from analysis.report._signal_figures import torque_figure

    drawn = {"signals": signals_figure, "frf": frf_figure, "torque": torque_figure}
    for name in names:
        with style.styled():
            figure = drawn[name](analysis)
            try:
                style.save(figure, folder / f"{name}.png")
            except OSError as error:
                raise OutputError(
                    f"{folder / name}.png cannot be written: {error.strerror or error}."
                ) from error
        on_step(f"figure {name}")


def _text(analysis: WelchAnalysis | None, subject: Subject | None) -> str:
    """Return the tables of the paper's route, or without it those of the whole record."""
    if analysis is not None:
        return tables_text(analysis, () if subject is None else subject.withheld)
    if subject is None:
        return ""
    from analysis.report._text import record_text

    return _as_text(record_text(subject))


def tables_text(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> str:
    """Return the tables as plain text, with orders marked that the data do not support."""
    from analysis.report._text import analysis_tables

    return _as_text(analysis_tables(analysis, withheld))


def _as_text(shown: RenderableType) -> str:
    from rich.console import Console

    console = Console(width=TEXT_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()
