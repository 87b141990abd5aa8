"""The whole-record result as text for the terminal: the verdict first, then its numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from analysis.report.html.amplitude_table import amplitude_tables
from analysis.report.html.damping_sentences import damping_sentences
from analysis.report.html.record_tables import modes_table, parameters_table, sizes_table
from analysis.report.html.table import Number

if TYPE_CHECKING:
    from rich.console import RenderableType

    from analysis.report.html.subject import Subject
    from analysis.report.html.table import Cell, Table


def record_text(subject: Subject) -> RenderableType:
    """Return the verdict on one record, its parameters and its modes.

    Parameters
    ----------
    subject : Subject
        What was found in the whole record.
    """
    verdict = subject.verdict
    said = [
        *(Text(sentence, style="bold") for sentence in damping_sentences(subject.headline)),
        *map(Text, verdict.sentences),
    ]
    return Group(
        Text(f"{subject.name}: verdict", style="italic"),
        *(Padding(sentence, (0, 0, 0, 2)) for sentence in said),
        *(Padding(Text(text, style="dim"), (0, 0, 0, 2)) for text in verdict.experiments),
        "",
        *(
            part
            for table in (
                *(make(subject) for make in (modes_table, sizes_table, parameters_table)),
                *amplitude_tables(subject),
            )
            for part in (_text_table(table), "")
        ),
    )


def _text_table(table: Table) -> RichTable:
    shown = RichTable(title=table.caption, title_justify="left", box=box.SIMPLE_HEAD)
    for column in table.columns:
        shown.add_column(column.heading, justify="right" if column.numeric else "left")
    for row in table.rows:
        shown.add_row(*(_text(cell) for cell in row))
    if table.notes:
        shown.caption = " ".join(table.notes)
        shown.caption_justify = "left"
    return shown


def _text(cell: Cell) -> str | Text:
    if not isinstance(cell, Number):
        return cell
    return Text(cell.text, style="dim italic") if cell.doubtful else cell.text
