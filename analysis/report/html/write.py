"""Writing a report: the page, its figures as files and its tables as CSV."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Final

from analysis.report.folder import OutputError, write_new
from analysis.report.html.amplitude_table import amplitude_tables
from analysis.report.html.drawing import drawing, photograph, svg_text
from analysis.report.html.figures import NAMES, illustrations
from analysis.report.html.page import page
from analysis.report.html.record_tables import (
    condition_table,
    correlations_table,
    modes_table,
    parameters_table,
    sizes_table,
)
from analysis.report.html.structures_table import structures_table
from analysis.report.html.table import Table, csv_text
from analysis.report.html.welch_tables import peaks_table, welch_fits_table

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from analysis.report.html.markup import Markup
    from analysis.report.html.subject import Subject

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
        report if it is there, as `analysis.report.write.write_report` leaves it.
    on_step : callable, optional
        Called with a few words after each figure.
    made_at : datetime, optional
        What the report calls its time; by default now.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    from analysis.report import style

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
