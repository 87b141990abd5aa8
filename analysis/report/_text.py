"""An analysis as text for the terminal: tables and verdict."""

from __future__ import annotations

import math
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Final

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from analysis.paper import LARGEST_SHIFT
from analysis.report._record_page import damping_sentences
from analysis.report._record_tables import (
    amplitude_tables,
    modes_table,
    parameters_table,
    sizes_table,
)
from analysis.report._table import MARK, Number, footnotes, unreported

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from rich.console import RenderableType

    from analysis.paper import FittedModel, Peak, WelchAnalysis
    from analysis.report._table import Cell, Table
    from analysis.results import Subject
    from rigd.beam import Mode

_COLUMNS: Final = (("zeta", "ζ (1e-5)", 1e5), ("alpha", "α", 1.0), ("gamma", "γ (1e-2)", 1e2),
                   ("lambda", "λ", 1.0))  # fmt: skip
"""Parameter, heading and factor: the powers of ten of the paper's Table 5."""
_COEFFICIENT: Final = {"zeta": "zeta", "alpha": "zeta", "gamma": "gamma", "lambda": "gamma"}
_ABSENT: Final = "–"
_LEFT: Final = "‡"


def analysis_tables(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> RenderableType:
    """Return the fits, the resonant peaks and the modes of one record, with its warnings.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    parts: list[RenderableType] = [fits_table(analysis, withheld), "", peaks_table(analysis), ""]
    if any(model.modes for model in analysis.models):
        parts.extend((welch_modes_table(analysis), ""))
    notes = [
        *footnotes(withheld),
        "± is one standard deviation from the scatter of the measured response about the model; "
        "the bias of the estimate itself (leakage of the window) is not in it.",
    ]
    if any(model.fit.at_bounds for model in analysis.models):
        notes.append("* rests on the edge of the range searched: the data do not determine it.")
    parts.append(Text("\n".join(notes), style="dim"))
    parts.extend(Text(f"Warning: {warning}", style="yellow") for warning in analysis.warnings)
    return Group(*parts)


def fits_table(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> RichTable:
    """Parameters with standard deviation, and the indices of fit."""
    table = _fits_table(f"{analysis.record.path.name}: fits")
    for model in analysis.models:
        indices = model.indices
        doubtful = unreported(model.fit.structure, withheld)
        table.add_row(
            *_names(model),
            *(
                Text(f"{_parameter_text(model, name, factor)}{MARK}", style="dim")
                if name in doubtful
                else _parameter_text(model, name, factor)
                for name, _heading, factor in _COLUMNS
            ),
            *(f"{value:.4g}" for value in (indices.mse, indices.wmse, indices.md)),
            end_section=_is_last_of_type(model, analysis.models),
        )
    return table


def peaks_table(analysis: WelchAnalysis) -> RichTable:
    """Measured resonant peaks, and how far each model's lie from them, as the paper's Table 4."""
    table = _table(f"{analysis.record.path.name}: resonant peaks")
    for quantity in ("ω{} (rad/s)", "M{} (dB)"):
        for number in range(1, len(analysis.peaks) + 1):
            table.add_column(quantity.format(number), justify="right")
    table.add_row(
        "measured", "",
        *(_peak_text(peak, frequency=True) for peak in analysis.peaks),
        *(_peak_text(peak, frequency=False) for peak in analysis.peaks),
        style="bold", end_section=True,
    )  # fmt: skip
    for model in analysis.models:
        table.add_row(
            *_names(model),
            *(_ABSENT if d is None else f"{d.frequency_rad_s:.3f}" for d in model.deviations),
            *(_ABSENT if d is None else f"{d.magnitude_db:.3f}" for d in model.deviations),
            end_section=_is_last_of_type(model, analysis.models),
        )
    table.caption = "rows below the measured peaks: absolute deviation of the model's from them"
    return table


def welch_modes_table(analysis: WelchAnalysis) -> RichTable:
    """Frequencies and damping ratios of the modes from each model's poles."""
    table = _table(f"{analysis.record.path.name}: modes")
    count = max(len(model.modes) for model in analysis.models)
    for quantity in ("f{} (Hz)", "ξ{} (%)"):
        for number in range(1, count + 1):
            table.add_column(quantity.format(number), justify="right")
    for model in analysis.models:
        table.add_row(
            *_names(model),
            *_of_modes(model, count, lambda mode: f"{mode.frequency_hz:.4f}"),
            *_of_modes(model, count, lambda mode: f"{100 * mode.damping_ratio:.4g}"),
            end_section=_is_last_of_type(model, analysis.models),
        )
    told = ["from the poles of the fitted model; ξ is the damping ratio"]
    shown = [
        each for model in analysis.models for each in zip(model.modes, model.followed, strict=True)
    ]
    if any(not followed and mode.damping_ratio < 1 for mode, followed in shown):
        told.append(
            f"{_LEFT} more than {100 * LARGEST_SHIFT:g} % off the undamped beam's: the fit does "
            "not follow this resonance. The number belongs to its curve, not to the antenna."
        )
    vibrates = [mode.damping_ratio < 1 for mode, _ in shown]
    if not all(vibrates) or not all(model.modes for model in analysis.models):
        told.append(f"{_ABSENT} damped so strongly by this fit that nothing vibrates")
    table.caption = "\n".join(told)
    return table


def _of_modes(model: FittedModel, count: int, text: Callable[[Mode], str]) -> list[str | Text]:
    """Write something of each mode; what is not the antenna's is marked, or left out."""
    return [
        _ABSENT
        if mode.damping_ratio >= 1
        else text(mode)
        if followed
        else Text(f"{text(mode)}{_LEFT}", style="dim")
        for mode, followed in zip(model.modes, model.followed, strict=True)
    ] or [_ABSENT] * count


def summary_table(analyses: Sequence[WelchAnalysis]) -> RichTable:
    """Mean and standard deviation over the files of each fit's parameters and indices."""
    table = _fits_table(f"mean ± standard deviation over {len(analyses)} files")
    for models in zip(*(analysis.models for analysis in analyses), strict=True):
        table.add_row(
            *_names(models[0]),
            *(
                _mean_text([factor * model.fit.parameters[name] for model in models])
                if name in models[0].fit.structure.free
                else _parameter_text(models[0], name, factor)
                for name, _heading, factor in _COLUMNS
            ),
            _mean_text([model.indices.mse for model in models]),
            _mean_text([model.indices.wmse for model in models]),
            _mean_text([model.indices.md for model in models]),
            end_section=_is_last_of_type(models[0], analyses[0].models),
        )
    return table


def with_spread(value: float, std: float | None) -> str:
    """Write a value with its standard deviation, both to the latter's second digit.

    No space follows the ±, so that a narrow terminal breaks the line before it, if anywhere.
    """
    if std is None or not math.isfinite(std) or std <= 0.0:
        return f"{value:.5g}"
    decimals = max(1 - math.floor(math.log10(std)), 0)
    if decimals > 6:
        return f"{value:.5g} ±{std:.1e}"
    return f"{value:.{decimals}f} ±{std:.{decimals}f}"


def _fits_table(title: str) -> RichTable:
    """Columns of the parameters and of the indices, no rows yet."""
    table = _table(title)
    for _parameter, heading, _factor in _COLUMNS:
        table.add_column(heading, justify="right", min_width=7)
    for heading in ("MSE", "WMSE", "MD"):
        table.add_column(heading, justify="right")
    table.caption = "MSE and WMSE in (N·m/rad)², MD in N·m/rad"
    return table


def _table(title: str) -> RichTable:
    """Column of a fit's type and of its weights, no rows yet."""
    table = RichTable(
        title=Text(title, style="bold"), title_justify="left", caption_justify="left",
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip
    for heading in ("type", "weights"):
        table.add_column(heading, no_wrap=True)
    return table


def _names(model: FittedModel) -> tuple[str, str]:
    return model.fit.structure.name, model.fit.weighting


def _is_last_of_type(model: FittedModel, models: Sequence[FittedModel]) -> bool:
    same = [other for other in models if other.fit.structure.name == model.fit.structure.name]
    return same[-1].fit.weighting == model.fit.weighting


def _parameter_text(model: FittedModel, name: str, factor: float) -> str:
    fit = model.fit
    value = factor * fit.parameters[name]
    if name not in fit.structure.free:
        return f"{value:g}" if _COEFFICIENT[name] in fit.structure.free else _ABSENT
    std = None if fit.std is None else factor * fit.std[name]
    return with_spread(value, std) + ("*" if name in fit.at_bounds else "")


def _mean_text(values: list[float]) -> str:
    return with_spread(fmean(values), stdev(values) if len(values) > 1 else None)


def _peak_text(peak: Peak | None, *, frequency: bool) -> str:
    if peak is None:
        return _ABSENT
    return f"{2 * math.pi * peak.frequency_hz:.3f}" if frequency else f"{peak.magnitude_db:.3f}"


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
