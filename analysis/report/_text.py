"""Results of an analysis as text, for the terminal and for text files."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rich.console import Console, Group
from rich.padding import Padding
from rich.text import Text

from analysis.applicability import WELCH_OMITTED_TEXT
from analysis.identify.headline import CONTRADICTED_FILE_REASON, EXACTLY_UNIFORM_CONDITION
from analysis.report import _fit_tables as fit_tables
from analysis.report import _record_tables as tables
from analysis.report.table import NOT_REPORTED_MARK, estimate_cells, terminal_table
from rigd.printable import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rich.console import RenderableType

    from analysis.identify.headline import Headline, ReportedLossFactor
    from analysis.report.table import Table
    from analysis.results import RecordResult, WholeRecord
    from rigd.estimates import Estimate, ReportedMode

_TERMINAL_WIDTH_CHARACTERS: Final = 120
"""Width of plain text in characters."""


def as_text(renderable: RenderableType) -> str:
    """Return one of Rich's renderables as plain text."""
    console = Console(width=_TERMINAL_WIDTH_CHARACTERS, color_system=None, force_terminal=False)
    with console.capture() as console_capture:
        console.print(renderable)
    return console_capture.get()


def result_text(
    result: RecordResult, *, verbose: bool, with_warnings: bool = True
) -> RenderableType:
    """Return the results of one record for the terminal: verdict, tables and warnings.

    Parameters
    ----------
    result : RecordResult
        Results of one record.
    verbose : bool
        Whether all tables are included. Otherwise the text contains the verdict, the modes and the
        parameters of damping and beam, or the Welch fits if there are no whole-record fits.
    with_warnings : bool
        Whether the text ends with the warnings (`shown_warnings`).
    """
    whole_record, welch_analysis = result.whole, result.welch
    text_parts: list[RenderableType] = []
    if whole_record is not None:
        text_parts.append(record_text(whole_record) if verbose else _main_results(whole_record))
    if welch_analysis is not None and verbose:
        text_parts.append(analysis_tables(result))
    elif welch_analysis is not None and whole_record is None:
        text_parts.append(Text(result.validity.sentence))
        text_parts += with_empty_lines((fit_tables.welch_fits_table(welch_analysis),))
    if with_warnings and (welch_analysis is None or not verbose):
        text_parts += warning_lines(shown_warnings(result))
    return Group(*text_parts)


def shown_warnings(result: RecordResult) -> list[str]:
    """Return the warnings of a record that are printed with its results.

    Parameters
    ----------
    result : RecordResult
        Results of one record.
    """
    if result.welch is not None:
        return list(result.warnings)
    # The reason for missing Welch fits was reported before.
    return [
        warning_text
        for warning_text in result.warnings
        if not warning_text.startswith(WELCH_OMITTED_TEXT)
    ]


_RIG_PARAMETERS: Final = ("delay_s", "tool_inertia_kg_m2")
"""Parameters of the rig, which the verdict names if they differ from the file's values."""


def _main_results(whole_record: WholeRecord) -> RenderableType:
    """Return the main results of a record for the terminal: verdict, modes and parameters."""
    parameter_table = tables.parameters_table(whole_record)
    parameter_names = tables.parameter_names(whole_record.headline)
    shown_rows = [
        row
        for parameter_name, row in zip(parameter_names, parameter_table.rows, strict=True)
        if parameter_name not in _RIG_PARAMETERS
    ]
    # The terminal has room for one column of text.
    omitted_column = "meaning" if any(row["remark"] for row in shown_rows) else "remark"
    shown_columns = tuple(
        table_column
        for table_column in parameter_table.columns
        if table_column.column_key != omitted_column
    )
    short_table = replace(parameter_table, columns=shown_columns, rows=tuple(shown_rows))
    mode_table = tables.modes_table(whole_record)
    return Group(
        *map(Text, whole_record.verdict.sentences),
        "",
        *with_empty_lines(
            (
                _with_mark_notes_only(mode_table),
                _with_mark_notes_only(short_table, caption=parameter_table.caption),
            )
        ),
    )


def _with_mark_notes_only(table: Table, caption: str = "") -> Table:
    """Return a table with only the notes that explain the marks of parameters not reported."""
    mark_notes = tuple(
        table_note for table_note in table.notes if table_note.startswith(NOT_REPORTED_MARK)
    )
    return replace(table, caption=caption, notes=mark_notes)


def warning_lines(sentences: Iterable[str]) -> list[Text]:
    """Return warning sentences as yellow lines of text.

    Parameters
    ----------
    sentences : iterable of str
        Warnings.
    """
    return [Text(f"Warning: {sentence}", style="yellow") for sentence in sentences]


def tables_text(result: RecordResult) -> str:
    """Return the tables of the Welch fits as plain text, or those of the whole-record fits."""
    if result.welch is not None:
        return as_text(analysis_tables(result))
    return "" if result.whole is None else as_text(record_text(result.whole))


def analysis_tables(result: RecordResult) -> RenderableType:
    """Return the tables of a record's Welch fits, resonance peaks and modes, and its warnings.

    Orders of damping that the whole record does not support have a mark.
    """
    welch_analysis = result.welch
    assert welch_analysis is not None
    mode_table = fit_tables.welch_modes_table(welch_analysis)
    return Group(
        Text(f"{result.name}: Welch method (as in the paper)", style="italic"),
        Text(result.validity.sentence),
        "",
        *with_empty_lines(
            (
                fit_tables.welch_fits_table(welch_analysis, result.unsupported_orders),
                fit_tables.peaks_table(welch_analysis),
                *(() if mode_table is None else (mode_table,)),
            )
        ),
        *warning_lines(result.warnings),
    )


def summary_table(results: Sequence[RecordResult]) -> RenderableType:
    """Return the table of the Welch fits' means and standard deviations over several files."""
    welch_analyses = [result.welch for result in results if result.welch is not None]
    fit_summary = fit_tables.summary_table(welch_analyses)
    validity_notes = [
        f"{result.name}: {result.validity.sentence}"
        for result in results
        if result.welch is not None
    ]
    return terminal_table(replace(fit_summary, notes=(*fit_summary.notes, *validity_notes)))


def record_text(whole_record: WholeRecord) -> RenderableType:
    """Return the verdict on one whole record, and its tables."""
    record_verdict = whole_record.verdict
    verdict_sentences = [
        *(Text(sentence, style="bold") for sentence in damping_sentences(whole_record.headline)),
        *map(Text, record_verdict.sentences),
        *(Text(advice, style="dim") for advice in record_verdict.experiments),
    ]
    return Group(
        Text(f"{whole_record.record.path.name}: verdict", style="italic"),
        *(Padding(sentence, (0, 0, 0, 2)) for sentence in verdict_sentences),
        "",
        record_tables(whole_record),
    )


def record_tables(whole_record: WholeRecord) -> RenderableType:
    """Return the tables of one whole record: modes, loss factors and parameters."""
    return Group(
        *with_empty_lines(
            (
                *(
                    table
                    for make_table in (
                        tables.modes_table,
                        tables.exact_modes_table,
                        tables.loss_factors_table,
                        tables.parameters_table,
                        tables.exact_geometry_table,
                    )
                    if (table := make_table(whole_record)) is not None
                ),
                *tables.amplitude_tables(whole_record),
                *fit_tables.added_structures_tables(whole_record),
            )
        )
    )


def with_empty_lines(tables_to_show: Iterable[Table]) -> Iterator[RenderableType]:
    """Yield tables for the terminal, each followed by an empty line."""
    for table in tables_to_show:
        yield terminal_table(table)
        yield ""


# Damping in sentences

_MIN_PLAIN_VALUE: Final = 1e-3
"""Value below which a damping coefficient is written with the paper's power of ten for zeta."""

_DAMPING_SYMBOLS: Final = {
    "internal": ("ζ", "", "zeta", "alpha", "α"),
    "external": ("γ", " 1/m⁴", "gamma", "lambda", "λ"),
}
"""Coefficient, unit, parameter names and symbol of internal and external damping."""


def damping_sentences(headline: Headline) -> tuple[str, ...]:
    """Return sentences on the damping ratios, and on the internal and external damping.

    Modes that are not visible are omitted. The tuple is empty if no number is a property of the
    antenna. If the model does not explain the whole record, the damping ratios are stated with this
    reservation and without intervals. The 95 % intervals are in brackets.
    """
    damping_texts = []
    if any(mode.damping_ratio.flag == CONTRADICTED_FILE_REASON for mode in headline.modes):
        return ()
    visible_modes = [_mode_text(mode) for mode in headline.modes if mode.shown]
    if not headline.is_explained:
        if not visible_modes:
            return ()
        return (
            "Part of the record is unexplained. If that causes no bias, the antenna's damping "
            f"ratio would be {listed(visible_modes)}.",
        )
    if visible_modes:
        damping_texts.append(
            f"The antenna's damping ratio is {listed(visible_modes)} (in brackets: 95 % intervals, "
            "statistical only)."
        )
    damping_texts.extend(
        f"The {loss_factor.damping} damping "
        f"{_loss_text(loss_factor)}{_order_text(headline, loss_factor)}."
        for loss_factor in headline.sizes
        # A coefficient for an assumed order is no property of the antenna.
        if loss_factor.size.flag is None
        and (
            loss_factor.omega_rad_s is not None
            or not _coefficient_is_flagged(headline, loss_factor)
        )
    )
    return tuple(damping_texts)


def _mode_text(mode: ReportedMode) -> str:
    """Return a mode's damping ratio and frequency as text."""
    damping_ratio = mode.damping_ratio
    return f"{_percent_text(damping_ratio)} at {mode.frequency_hz.value:.4g} Hz"


def _percent_text(damping_ratio: Estimate) -> str:
    """Return a damping ratio in percent as text, with its interval unless it is flagged."""
    value_cell, lower_cell, upper_cell = estimate_cells(
        (damping_ratio.value, *(damping_ratio.interval_95 or (None, None))),
        damping_ratio.std,
        100.0,
    )
    if damping_ratio.flag is not None:
        return f"{value_cell.text} %"
    return f"{value_cell.text} % ({lower_cell.text} to {upper_cell.text} %)"


def _loss_text(loss_factor: ReportedLossFactor) -> str:
    """Return the part of a sentence with a damping's loss factor, or its coefficient if unknown."""
    coefficient_symbol, unit_text, *_names = _DAMPING_SYMBOLS[loss_factor.damping]
    pivot_loss_factor = loss_factor.size
    display_factor, power_of_ten = (
        (1e5, " · 10⁻⁵") if pivot_loss_factor.value < _MIN_PLAIN_VALUE else (1.0, "")
    )
    value_cell, lower_cell, upper_cell = estimate_cells(
        (pivot_loss_factor.value, *(pivot_loss_factor.interval_95 or (None, None))),
        pivot_loss_factor.std,
        display_factor,
    )
    interval_text = f"{value_cell.text} ({lower_cell.text} to {upper_cell.text}){power_of_ten}"
    if loss_factor.omega_rad_s is None:
        return f"is {coefficient_symbol}\u00a0=\u00a0{interval_text}{unit_text}"
    return (
        f"has a loss factor of {interval_text} at {loss_factor.omega_rad_s / (2 * math.pi):.3g} Hz"
    )


def _coefficient_is_flagged(headline: Headline, loss_factor: ReportedLossFactor) -> bool:
    """Return whether a damping's coefficient is flagged as not a property of the antenna."""
    return headline.parameters[_DAMPING_SYMBOLS[loss_factor.damping][2]].flag is not None


def _order_text(headline: Headline, loss_factor: ReportedLossFactor) -> str:
    """Return the end of a sentence with the fractional order of a damping.

    It is empty if the parameters are estimated with a tolerance of the beam's geometry.
    """
    *_others, order_name, order_symbol = _DAMPING_SYMBOLS[loss_factor.damping]
    order_value = headline.parameters[order_name]
    if headline.tolerant is None and order_name not in headline.fit.structure.free:
        return f", of the fixed order {order_symbol}\u00a0=\u00a0{order_value.value:g}"
    if order_value.interval_95 is None or order_value.flag is not None:
        return f"; its order {order_symbol} is not known"
    if headline.tolerant is not None:
        return ""  # the verdict has the slope of the loss, with its condition
    value_cell, lower_cell, upper_cell = estimate_cells(
        (order_value.value, *order_value.interval_95), order_value.std
    )
    condition_text = f", {EXACTLY_UNIFORM_CONDITION}" if headline.modal is not None else ""
    return (
        f" and the order {order_symbol}\u00a0=\u00a0{value_cell.text} "
        f"({lower_cell.text} to {upper_cell.text}{condition_text})"
    )
