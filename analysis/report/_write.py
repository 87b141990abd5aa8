"""One record's report: a folder with page, figures, tables and the JSON document."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Final

from analysis.report import _record_tables as tables
from analysis.report._document import document, document_text
from analysis.report._equation import equations, latex
from analysis.report._folder import write_new
from analysis.report._table import Table, csv_text, latex_table
from analysis.report._text import tables_text
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from analysis.paper import WelchAnalysis
    from analysis.report._style import Picture
    from analysis.results import FigureFormat, RecordResult, WholeRecord

_WELCH_DESCRIPTION: Final = (
    "Frequency response by Welch's method, as in the paper, with the fits of each type and "
    "weighting, and the coherence."
)


_FOR_PAPERS: Final = ("modes", "parameters")
"""Tables that are there for LaTeX, too."""


def _write_page(
    result: RecordResult,
    whole: WholeRecord,
    folder: Path,
    on_step: Callable[[str], None],
    made_at: datetime | None,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
    paper_pictures: Sequence[Picture] = (),
) -> None:
    """Write ``report.html``, ``figures/`` and ``tables/``."""
    from analysis.report import _style as style
    from analysis.report._record_figures import illustrations
    from analysis.report._record_page import record_page

    pictures = []
    with style.styled():
        for shown in illustrations(whole):
            stem = folder / "figures" / shown.name
            pictures.append(style.save_picture(shown.figure, stem, shown.description, formats))
            on_step(f"figure {shown.name}")
    modes, of_record, of_paper = report_tables(result)
    for table in (modes, *of_record, *of_paper):
        write_new(folder / "tables" / f"{table.name}.csv", csv_text(table))
        if table.name in _FOR_PAPERS:
            write_new(folder / "tables" / f"{table.name}.tex", latex_table(table))
    write_new(folder / "tables" / "model.tex", latex(equations(whole)))
    made_at = made_at or datetime.now().astimezone()
    text = record_page(result, pictures, modes, of_record, made_at, paper_pictures, of_paper)
    write_new(folder / "report.html", text)


def report_tables(result: RecordResult) -> tuple[Table, tuple[Table, ...], tuple[Table, ...]]:
    """Make the table of modes, those of the whole-record fits, and those of the Welch method."""
    whole, welch = result.whole, result.welch
    assert whole is not None
    condition = tables.condition_table(whole)
    of_record = (
        tables.sizes_table(whole),
        tables.parameters_table(whole),
        *(() if condition is None else (condition,)),
        tables.correlations_table(whole),
        *tables.amplitude_tables(whole),
        tables.structures_table(whole),
    )
    of_paper = (
        ()
        if welch is None
        else (tables.welch_fits_table(welch, whole.unsupported), tables.peaks_table(welch))
    )
    return tables.modes_table(whole), of_record, of_paper


_FIGURES: Final = ("welch_signals", "welch_frf", "welch_torque")
_FIGURES_BESIDE_RECORD: Final = ("welch_frf",)
"""Figures of the Welch fits where the whole-record fit has its own of signals and torque."""


def write_report(
    result: RecordResult,
    folder: Path,
    on_step: Callable[[str], None] = lambda _done: None,
    made_at: datetime | None = None,
    formats: Sequence[FigureFormat] = DEFAULT_FORMATS,
) -> None:
    """Write ``figures/``, ``tables.txt``, ``analysis.json`` and, of a whole record, a page.

    The page ``report.html`` comes with ``tables/``. Every file's name is in lower case with
    underscores: ``figures/NAME.png``, ``.svg``, ``.pdf``; ``tables/NAME.csv``, ``.tex``.

    Parameters
    ----------
    result : RecordResult
    folder : Path
        An existing folder without these files.
    on_step : callable, optional
        Called with a few words after each figure.
    made_at : datetime, optional
        What the page calls its time; by default now.
    formats : sequence of str
        Formats of the figures.

    Raises
    ------
    OutputExistsError, OutputError
        If a file exists, or cannot be written.
    """
    whole = result.whole
    pictures: list[Picture] = []
    if result.welch is not None:
        names = figures_of_paper(paper=True, whole_record=whole is not None)
        pictures = _draw(result.welch, names, folder / "figures", on_step, formats)
    write_new(folder / "tables.txt", tables_text(result))
    if whole is not None:
        _write_page(result, whole, folder, on_step, made_at, formats, pictures)
    write_new(folder / "analysis.json", document_text(document([result])))


def figures_of_paper(*, paper: bool, whole_record: bool) -> tuple[str, ...]:
    """Name the figures of the Welch fits that a report has.

    Parameters
    ----------
    paper : bool
        Whether the Welch fits were run.
    whole_record : bool
        Whether the whole-record fits were run.
    """
    if not paper:
        return ()
    return _FIGURES_BESIDE_RECORD if whole_record else _FIGURES


def _draw(
    analysis: WelchAnalysis,
    names: Sequence[str],
    folder: Path,
    on_step: Callable[[str], None],
    formats: Sequence[FigureFormat],
) -> list[Picture]:
    from analysis.report import _style as style
    from analysis.report._frf_figure import frf_figure
    from analysis.report._signal_figures import paper_signals_figure, torque_figure

    drawn = dict(zip(_FIGURES, (paper_signals_figure, frf_figure, torque_figure), strict=True))
    pictures = []
    for name in names:
        with style.styled():
            figure = drawn[name](analysis)
            pictures.append(style.save_picture(figure, folder / name, _WELCH_DESCRIPTION, formats))
        on_step(f"figure {name}")
    return pictures
