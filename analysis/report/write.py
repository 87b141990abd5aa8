"""One record's report: a folder with figures, tables as text, and the JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.report.document import document, document_text
from analysis.report.folder import OutputError, write_new

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from rich.console import RenderableType

    from analysis.paper import WelchAnalysis
    from analysis.report.html import Subject

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
        from analysis.report.html.write import write_html_report

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
    from analysis.report import style
    from analysis.report.frf_figure import frf_figure
    from analysis.report.signals_figure import signals_figure
    from analysis.report.torque_figure import torque_figure

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
    from analysis.report.record_text import record_text

    return _as_text(record_text(subject))


def tables_text(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> str:
    """Return the tables as plain text, with orders marked that the data do not support."""
    from analysis.report.tables import analysis_tables

    return _as_text(analysis_tables(analysis, withheld))


def _as_text(shown: RenderableType) -> str:
    from rich.console import Console

    console = Console(width=TEXT_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()
