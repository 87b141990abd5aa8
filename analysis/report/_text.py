"""An analysis as text, for the terminal and for text files: verdict, tables, warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.console import Console, Group
from rich.padding import Padding
from rich.text import Text

from analysis.report import _record_tables as tables
from analysis.report._campaign_tables import paper_tables, shown_tables
from analysis.report._sentences import campaign_sentences, damping_sentences
from analysis.report._table import terminal_table

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from rich.console import RenderableType

    from analysis.campaigns import Campaign
    from analysis.paper import WelchAnalysis
    from analysis.report._table import Table
    from analysis.results import Subject

_WIDTH: Final = 120


def as_text(shown: RenderableType) -> str:
    """Return what a terminal would show, as plain text."""
    console = Console(width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


def tables_text(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> str:
    """Return `analysis_tables` as plain text."""
    return as_text(analysis_tables(analysis, withheld))


def analysis_tables(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> RenderableType:
    """Return the fits, the resonant peaks and the modes of one record, with its warnings.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    modes = tables.welch_modes_table(analysis)
    return Group(
        Text(f"{analysis.record.path.name}: Welch method (as in the paper)", style="italic"),
        "",
        *spaced(
            (
                tables.welch_fits_table(analysis, withheld),
                tables.peaks_table(analysis),
                *(() if modes is None else (modes,)),
            )
        ),
        *(Text(f"Warning: {warning}", style="yellow") for warning in analysis.warnings),
    )


def summary_table(analyses: Sequence[WelchAnalysis]) -> RenderableType:
    """Return what the Welch fits give over several files."""
    return terminal_table(tables.summary_table(analyses))


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
        *(Text(text, style="dim") for text in verdict.experiments),
    ]
    return Group(
        Text(f"{subject.name}: verdict", style="italic"),
        *(Padding(sentence, (0, 0, 0, 2)) for sentence in said),
        "",
        *spaced(
            (
                *(
                    make(subject)
                    for make in (tables.modes_table, tables.sizes_table, tables.parameters_table)
                ),
                *tables.amplitude_tables(subject),
            )
        ),
    )


def campaign_tables(campaign: Campaign, *, with_paper: bool = False) -> RenderableType:
    """Return the verdict, what it rests on, and the paper's Tables 3 to 5.

    Parameters
    ----------
    campaign : Campaign
    with_paper : bool
        Whether the paper's numbers stand beside these.
    """
    parts: list[RenderableType] = []
    said = campaign_sentences(campaign)
    if said:
        first, *others = said
        parts += [Text(first, style="bold"), *map(Text, others)]
        if campaign.verdict is not None and campaign.verdict.experiments:
            parts.append(Text("What would tell more:"))
            parts += [Text(f"  {advice}") for advice in campaign.verdict.experiments]
        parts.append("")
    parts += spaced((*shown_tables(campaign), *paper_tables(campaign, with_paper=with_paper)))
    parts += [
        Text(f"Warning: {session.path.name}: {warning}", style="yellow")
        for session in campaign.sessions
        for warning in session.warnings
    ]
    return Group(*parts)


def campaign_text(campaign: Campaign, *, with_paper: bool = False) -> str:
    """Return the same as plain text, with the files that were left out."""
    left_out = (Text(f"Left out: {failure.message}") for failure in campaign.failures)
    return as_text(Group(campaign_tables(campaign, with_paper=with_paper), *left_out))


def spaced(shown: Iterable[Table]) -> Iterator[RenderableType]:
    """Put an empty line after each table."""
    for table in shown:
        yield terminal_table(table)
        yield ""
