"""One record's report: a folder with figures, tables as text, and the JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.report.document import document, document_text
from analysis.report.folder import OutputError, write_new

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from analysis.report.html import Subject
    from analysis.welch_route import WelchAnalysis

FIGURES: Final = ("signals", "frf", "torque")
FIGURES_BESIDE_RECORD: Final = ("frf",)
"""Of the paper's route, where the whole-record fit has signals and torque of its own."""

TEXT_WIDTH: Final = 120


def write_report(
    analysis: WelchAnalysis,
    folder: Path,
    on_step: Callable[[str], None] = lambda _done: None,
    subject: Subject | None = None,
) -> None:
    """Write figures, ``tables.txt``, ``analysis.json`` and, of a whole record, all in HTML.

    Parameters
    ----------
    analysis : WelchAnalysis
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
    from analysis.report import style
    from analysis.report.frf_figure import frf_figure
    from analysis.report.signals_figure import signals_figure
    from analysis.report.torque_figure import torque_figure

    drawn = {"signals": signals_figure, "frf": frf_figure, "torque": torque_figure}
    for name in FIGURES if subject is None else FIGURES_BESIDE_RECORD:
        with style.styled():
            figure = drawn[name](analysis)
            try:
                style.save(figure, folder / f"{name}.png")
            except OSError as error:
                raise OutputError(
                    f"{folder / name}.png cannot be written: {error.strerror or error}."
                ) from error
        on_step(f"figure {name}")
    withheld = () if subject is None else subject.verdict.withheld
    write_new(folder / "tables.txt", tables_text(analysis, withheld))
    if subject is not None:
        from analysis.report.html.write import write_html_report

        write_html_report(subject, folder, on_step)
    subjects = () if subject is None else (subject,)
    write_new(folder / "analysis.json", document_text(document([analysis], subjects=subjects)))


def tables_text(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> str:
    """Return the tables as plain text, with orders marked that the data do not support."""
    from rich.console import Console

    from analysis.report.tables import analysis_tables

    console = Console(width=TEXT_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(analysis_tables(analysis, withheld))
    return capture.get()
