"""An analysis as text, for the terminal and for text files: verdict, tables, warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.console import Console, Group
from rich.padding import Padding
from rich.text import Text

from analysis.report import _record_tables as tables
from analysis.report._sentences import damping_sentences
from analysis.report._table import terminal_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rich.console import RenderableType

    from analysis.report._table import Table
    from analysis.results import RecordResult, WholeRecord

_WIDTH: Final = 120


def as_text(shown: RenderableType) -> str:
    """Return what a terminal would show, as plain text."""
    console = Console(width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


def tables_text(result: RecordResult) -> str:
    """Return what a terminal would show of the Welch fits, without them of the whole record."""
    if result.welch is not None:
        return as_text(analysis_tables(result))
    return "" if result.whole is None else as_text(record_text(result.whole))


def analysis_tables(result: RecordResult) -> RenderableType:
    """Return the Welch fits, the resonant peaks and the modes of one record, with its warnings.

    Orders that its whole record does not support are marked.
    """
    welch = result.welch
    assert welch is not None
    modes = tables.welch_modes_table(welch)
    return Group(
        Text(f"{result.name}: the paper's route", style="italic"),
        "",
        *spaced(
            (
                tables.welch_fits_table(welch, result.unsupported),
                tables.peaks_table(welch),
                *(() if modes is None else (modes,)),
            )
        ),
        *(Text(f"Warning: {warning}", style="yellow") for warning in result.warnings),
    )


def summary_table(results: Sequence[RecordResult]) -> RenderableType:
    """Return what the paper's route gives over several files, as far as it was gone."""
    found = [each.welch for each in results if each.welch is not None]
    return terminal_table(tables.summary_table(found))


def record_text(whole: WholeRecord) -> RenderableType:
    """Return the verdict on one record, its parameters and its modes."""
    verdict = whole.verdict
    said = [
        *(Text(sentence, style="bold") for sentence in damping_sentences(whole.headline)),
        *map(Text, verdict.sentences),
        *(Text(text, style="dim") for text in verdict.experiments),
    ]
    return Group(
        Text(f"{whole.record.path.name}: verdict", style="italic"),
        *(Padding(sentence, (0, 0, 0, 2)) for sentence in said),
        "",
        *spaced(
            (
                *(
                    make(whole)
                    for make in (tables.modes_table, tables.sizes_table, tables.parameters_table)
                ),
                *tables.amplitude_tables(whole),
            )
        ),
    )


def spaced(shown: Iterable[Table]) -> Iterator[RenderableType]:
    """Put an empty line after each table."""
    for table in shown:
        yield terminal_table(table)
        yield ""
