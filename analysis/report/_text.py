"""An analysis as text, for the terminal and for text files: verdict, tables, warnings."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rich.console import Console, Group
from rich.padding import Padding
from rich.text import Text

from analysis.identify.headline import EXACT_CONDITION, MISREAD
from analysis.report import _fit_tables as fit_tables
from analysis.report import _record_tables as tables
from analysis.report.table import MARK, estimate_cells, terminal_table
from analysis.suited import LEFT_OUT
from rigd.printable import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rich.console import RenderableType

    from analysis.identify.headline import Headline, ReportedLossFactor, ReportedMode, ReportedValue
    from analysis.report.table import Table
    from analysis.results import RecordResult, WholeRecord

_WIDTH: Final = 120


def as_text(shown: RenderableType) -> str:
    """Return a renderable as plain text."""
    console = Console(width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


def result_text(result: RecordResult, *, verbose: bool) -> RenderableType:
    """Return what the terminal shows of one record.

    Parameters
    ----------
    result : RecordResult
    verbose : bool
        Whether that is everything; otherwise the verdict, the modes and the parameters of damping
        and beam, or without the whole record the Welch fits.
    """
    whole, welch = result.whole, result.welch
    shown: list[RenderableType] = []
    if whole is not None:
        shown.append(record_text(whole) if verbose else _main_results(whole))
    if welch is not None and verbose:
        shown.append(analysis_tables(result))
    elif welch is not None:
        if whole is None:
            shown.append(Text(result.validity.sentence))
            shown += spaced((fit_tables.welch_fits_table(welch),))
        shown += _warnings(result.warnings)
    else:
        # The reason for missing Welch fits was reported before.
        shown += _warnings(each for each in result.warnings if not each.startswith(LEFT_OUT))
    return Group(*shown)


_OF_RIG: Final = ("delay_s", "tool_inertia_kg_m2")
"""Parameters that the verdict names where they are not as the file states them."""


def _main_results(whole: WholeRecord) -> RenderableType:
    """Return the verdict, the modes, and the parameters under their condition."""
    parameters = tables.parameters_table(whole)
    names = tables.parameter_names(whole.headline)
    rows = [row for name, row in zip(names, parameters.rows, strict=True) if name not in _OF_RIG]
    # Room for one column of words.
    spare = "meaning" if any(row["remark"] for row in rows) else "remark"
    columns = tuple(each for each in parameters.columns if each.key != spare)
    brief = replace(parameters, columns=columns, rows=tuple(rows))
    modes = tables.modes_table(whole)
    return Group(
        *map(Text, whole.verdict.sentences),
        "",
        *spaced((_bare(modes), _bare(brief, caption=parameters.caption))),
    )


def _bare(table: Table, caption: str = "") -> Table:
    """Return a table with only those notes that explain marked numbers."""
    notes = tuple(note for note in table.notes if note.startswith(MARK))
    return replace(table, caption=caption, notes=notes)


def _warnings(sentences: Iterable[str]) -> list[Text]:
    return [Text(f"Warning: {sentence}", style="yellow") for sentence in sentences]


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
    modes = fit_tables.welch_modes_table(welch)
    return Group(
        Text(f"{result.name}: Welch method (as in the paper)", style="italic"),
        Text(result.validity.sentence),
        "",
        *spaced(
            (
                fit_tables.welch_fits_table(welch, result.unsupported),
                fit_tables.peaks_table(welch),
                *(() if modes is None else (modes,)),
            )
        ),
        *_warnings(result.warnings),
    )


def summary_table(results: Sequence[RecordResult]) -> RenderableType:
    """Return the Welch fits of several files in one table: those that were made."""
    found = [each.welch for each in results if each.welch is not None]
    table = fit_tables.summary_table(found)
    notes = [f"{each.name}: {each.validity.sentence}" for each in results if each.welch is not None]
    return terminal_table(replace(table, notes=(*table.notes, *notes)))


def record_text(whole: WholeRecord) -> RenderableType:
    """Return the verdict on one record, its parameters and its modes."""
    verdict = whole.verdict
    sentences = [
        *(Text(sentence, style="bold") for sentence in damping_sentences(whole.headline)),
        *map(Text, verdict.sentences),
        *(Text(text, style="dim") for text in verdict.experiments),
    ]
    return Group(
        Text(f"{whole.record.path.name}: verdict", style="italic"),
        *(Padding(sentence, (0, 0, 0, 2)) for sentence in sentences),
        "",
        record_tables(whole),
    )


def record_tables(whole: WholeRecord) -> RenderableType:
    """Return the modes, the sizes of the damping and the parameters of one record."""
    return Group(
        *spaced(
            (
                *(
                    table
                    for make in (
                        tables.modes_table,
                        tables.exact_modes_table,
                        tables.sizes_table,
                        tables.parameters_table,
                        tables.exact_geometry_table,
                    )
                    if (table := make(whole)) is not None
                ),
                *tables.amplitude_tables(whole),
            )
        )
    )


def spaced(shown: Iterable[Table]) -> Iterator[RenderableType]:
    """Put an empty line after each table."""
    for table in shown:
        yield terminal_table(table)
        yield ""


# Damping in sentences

_SMALL: Final = 1e-3
"""Sizes below are shown in the power of ten that zeta has in the paper."""

_SYMBOLS: Final = {
    "internal": ("ζ", "", "zeta", "alpha", "α"),
    "external": ("γ", " 1/m⁴", "gamma", "lambda", "λ"),
}


def damping_sentences(headline: Headline) -> tuple[str, ...]:
    """Describe the damping of the modes, and the internal and external damping.

    Modes that the record does not show are omitted, and all if no number is the antenna's. Where
    part of the record is unexplained the numbers are named as what they would be, without
    intervals.

    Returns
    -------
    tuple of str
        95 % intervals in brackets.
    """
    found = []
    if any(mode.damping_ratio.flag == MISREAD for mode in headline.modes):
        return ()
    shown = [_mode(mode) for mode in headline.modes if mode.shown]
    if not headline.explained:
        if not shown:
            return ()
        return (
            "Part of the record is unexplained. If that causes no bias, the antenna's damping "
            f"ratio would be {listed(shown)}.",
        )
    if shown:
        found.append(
            f"The antenna's damping ratio is {listed(shown)} (in brackets: 95 % intervals, "
            "statistical only)."
        )
    found.extend(
        f"The {each.damping} damping {_size(each)}{_order(headline, each)}."
        for each in headline.sizes
        # A coefficient for an assumed order is no property of the antenna.
        if each.size.flag is None and (each.omega_rad_s is not None or not _flagged(headline, each))
    )
    return tuple(found)


def _mode(mode: ReportedMode) -> str:
    ratio = mode.damping_ratio
    return f"{_percent(ratio)} at {mode.frequency_hz.value:.4g} Hz"


def _percent(ratio: ReportedValue) -> str:
    value, low, high = estimate_cells(
        (ratio.value, *(ratio.interval_95 or (None, None))), ratio.std, 100.0
    )
    if ratio.flag is not None:
        return f"{value.text} %"
    return f"{value.text} % ({low.text} to {high.text} %)"


def _size(each: ReportedLossFactor) -> str:
    coefficient, unit, *_names = _SYMBOLS[each.damping]
    size = each.size
    factor, tenth = (1e5, " · 10⁻⁵") if size.value < _SMALL else (1.0, "")
    value, low, high = estimate_cells(
        (size.value, *(size.interval_95 or (None, None))), size.std, factor
    )
    bounds = f"{value.text} ({low.text} to {high.text}){tenth}"
    if each.omega_rad_s is None:
        return f"is {coefficient}\u00a0=\u00a0{bounds}{unit}"
    return f"has a loss factor of {bounds} at {each.omega_rad_s / (2 * math.pi):.3g} Hz"


def _flagged(headline: Headline, each: ReportedLossFactor) -> bool:
    """Whether coefficient and order of a damping carry a flag."""
    return headline.parameters[_SYMBOLS[each.damping][2]].flag is not None


def _order(headline: Headline, each: ReportedLossFactor) -> str:
    *_others, name, symbol = _SYMBOLS[each.damping]
    order = headline.parameters[name]
    if headline.tolerant is None and name not in headline.fit.structure.free:
        return f", of the fixed order {symbol}\u00a0=\u00a0{order.value:g}"
    if order.interval_95 is None or order.flag is not None:
        return f"; its order {symbol} is not known"
    if headline.tolerant is not None:
        return ""  # the verdict has the slope of the loss, with its condition
    value, low, high = estimate_cells((order.value, *order.interval_95), order.std)
    condition = f", {EXACT_CONDITION}" if headline.modal is not None else ""
    return (
        f" and the order {symbol}\u00a0=\u00a0{value.text} ({low.text} to {high.text}{condition})"
    )
