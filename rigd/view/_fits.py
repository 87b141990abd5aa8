"""Display of a session's fits: modes over time with their shrinking intervals, and a table.

During a session a new fit arrives every second or, if the session runs until a precision is
reached, after every segment of its excitation. A session file contains only the last fit, which the
table shows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.estimates import Estimate, ReportedMode, modes_from_json, unseen_modes_text
from rigd.session import Validity
from rigd.units import suffix_of, unit_of, with_percentage
from rigd.view._session_info import escape_markdown
from rigd.view.plots import GREY, ORANGE, SKY_BLUE, TIMELINE, Plot, PlotCurve, PlotSource, Values

if TYPE_CHECKING:
    from rerun import RecordingStream

Fit = Mapping[str, Any]
"""Fit of a model to a session's samples, as a JSON object (docs/online_fit.md)."""

FIT_TABLE_ENTITY: Final = "/fit_table"
"""Entity path in Rerun of the table with the last fit."""
_FIT_PLOTS_ENTITY: Final = "/fits"
"""Entity path in Rerun of the plots of fitted modes over time."""
_MAX_TABLE_FINDINGS: Final = 8
"""Largest number of findings that the table of a fit lists."""


@dataclass(frozen=True, slots=True)
class _PlottedQuantity:
    """Quantity of a mode that is plotted over time: frequency or damping ratio."""

    name: str
    """Name of the quantity in a fit's list of target precisions."""
    attribute_name: str
    """Name of the quantity among the attributes of an `ReportedMode`."""
    suffix: str
    """Unit as the suffix of the plot's component name in Rerun."""
    title: str
    """Title of the plot, without the number of the mode."""
    unit: str
    """Unit of the plotted values."""
    plot_unit_factor: float
    """Factor from the unit of the JSON document to the plotted unit."""

    def field_name(self, mode_number: int) -> str:
        """Return the name of the field that holds this quantity of a mode in `fit_record`."""
        return f"{self.name}_{mode_number}"


_QUANTITIES: Final = (
    _PlottedQuantity("damping", "damping_ratio", "percent", "Damping ratio", "%", 100.0),
    _PlottedQuantity("frequency", "frequency_hz", "hz", "Frequency", "Hz", 1.0),
)
"""Quantities that are plotted for each mode: damping ratio and frequency."""
_TARGET_LOW_INDEX, _TARGET_HIGH_INDEX, _LOW_INDEX, _HIGH_INDEX, _VALUE_INDEX = range(5)
"""Indices of the five values in each field of a fit's record; unknown values are NaN."""


def fit_source(mode_count: int, *, with_target_std: bool) -> PlotSource:
    """Return the plots over time of the fitted damping ratio and frequency of each mode.

    With `with_target_std` the limits of a requested precision are plotted too.
    """
    mode_plots = (
        _mode_plot(quantity, n, with_target_std=with_target_std)
        for n in range(1, mode_count + 1)
        for quantity in _QUANTITIES
    )
    return PlotSource(_FIT_PLOTS_ENTITY, tuple(mode_plots))


def _mode_plot(quantity: _PlottedQuantity, mode_number: int, *, with_target_std: bool) -> Plot:
    """Return the plot of a mode's frequency or damping ratio, with its 95 % interval over time."""
    field_name, unit_symbol = quantity.field_name(mode_number), quantity.unit

    def curve_values(records: npt.NDArray[Any], value_index: int) -> Values:
        quantity_values: Values = records[field_name][:, value_index]
        return quantity_values

    # Curves with the same name have one entry in the legend.
    target_label, interval_label = (
        f"requested, 95 % ({unit_symbol})",
        f"95 % interval ({unit_symbol})",
    )
    target_limit_curves = (
        PlotCurve(target_label, GREY, partial(curve_values, value_index=_TARGET_LOW_INDEX)),
        PlotCurve(target_label, GREY, partial(curve_values, value_index=_TARGET_HIGH_INDEX)),
    )
    return Plot(
        f"{quantity.name}_{mode_number}_{quantity.suffix}",
        f"{quantity.title} of mode {mode_number} ({unit_symbol})",
        (
            *(target_limit_curves if with_target_std else ()),
            PlotCurve(interval_label, ORANGE, partial(curve_values, value_index=_LOW_INDEX)),
            PlotCurve(interval_label, ORANGE, partial(curve_values, value_index=_HIGH_INDEX)),
            PlotCurve(
                f"estimate ({unit_symbol})",
                SKY_BLUE,
                partial(curve_values, value_index=_VALUE_INDEX),
                2.5,
            ),
        ),
    )


def fit_record(fit: Fit | None, mode_count: int) -> npt.NDArray[Any]:
    """Return a fit as a structured array (1,) with time and modes, for the plots of `fit_source`.

    The values of doubtful estimates, and of modes that the samples do not show, are NaN.

    Parameters
    ----------
    fit
        Fit as a JSON object; None if there is no fit yet.
    mode_count
        Number of modes in the plots; further modes of the fit are omitted.
    """
    record_fields = [
        (q.field_name(n), "<f8", (5,)) for n in range(1, mode_count + 1) for q in _QUANTITIES
    ]
    fit_values = np.zeros(1, [("t_ns", "<i8"), *record_fields])
    for quantity_name, *_ in record_fields:
        fit_values[quantity_name] = np.nan
    if fit is None:
        return fit_values
    fit_values["t_ns"] = round(1e9 * fit["duration_s"])
    target_stds = {
        (target_precision["quantity"], target_precision["mode"]): target_precision["asked_std"]
        for target_precision in _target_precisions(fit)
    }
    for mode in modes_from_json(fit.get("modes")):
        for quantity in _QUANTITIES if mode.number <= mode_count else ():
            estimate: Estimate = getattr(mode, quantity.attribute_name)
            if not mode.shown or estimate.flag or estimate.interval_95 is None:
                continue
            lower_limit, upper_limit = estimate.interval_95
            target_std = target_stds.get((quantity.name, mode.number))
            target_half_width = np.nan
            if target_std is not None and estimate.std:
                target_half_width = target_std * (upper_limit - lower_limit) / (2.0 * estimate.std)
            quantity_values = np.array(
                [
                    estimate.value - target_half_width,
                    estimate.value + target_half_width,
                    lower_limit,
                    upper_limit,
                    estimate.value,
                ]
            )
            fit_values[quantity.field_name(mode.number)] = (
                quantity.plot_unit_factor * quantity_values
            )
    return fit_values


def _target_precisions(fit: Fit) -> list[Mapping[str, Any]]:
    """Return the requested precisions of a fit, each with the estimate and its present precision.

    The list is empty if the session does not run until a precision is reached.
    """
    return list((fit.get("search") or {}).get("targets") or ())


# Table


def fit_table_markdown(fit: Fit | None) -> str:
    """Return a fit as Markdown: requested precisions, modes, parameters and findings."""
    if fit is None:
        return "No fit yet."
    search_document = fit.get("search") or {}
    paragraphs = []
    if search_document.get("reason"):
        paragraphs.append(f"**{escape_markdown(search_document['reason'])}**")
    target_precisions = _target_precisions(fit)
    if target_precisions:
        table_rows = [_target_row(target_precision) for target_precision in target_precisions]
        paragraphs.append(
            _markdown_table("requested", "value", "std", "requested std", table_rows=table_rows)
        )
    if not search_document.get("reason") and search_document.get("left_s") is not None:
        paragraphs.append(f"About **{search_document['left_s']:.0f} s** more.")
    if not search_document.get("reason") and search_document.get("piece"):
        paragraphs.append(f"Excited now: {escape_markdown(str(search_document['piece']))}")
    if fit.get("problem"):
        paragraphs.append(f"**After {fit['duration_s']:.1f} s:** {escape_markdown(fit['problem'])}")
    else:
        paragraphs.append(
            f"**Fit of the first {fit['duration_s']:.1f} s** (± 95 %, statistical only)"
        )
    modes = modes_from_json(fit.get("modes"))
    mode_rows = [_mode_row(mode) for mode in modes if mode.shown]
    if mode_rows:
        paragraphs.append(
            _markdown_table("mode", "frequency (Hz)", "damping ratio (%)", table_rows=mode_rows)
        )
    if modes_not_visible := unseen_modes_text(modes):
        paragraphs.append(f"Not visible so far: {modes_not_visible}.")
    if mode_rows:
        validity = Validity.from_document(fit.get("validity"))
        paragraphs.append(validity.sentence)
        if validity.uniform_beam is not None:
            paragraphs.append(validity.uniform_beam.sentence)
    table_rows = [
        _parameter_row(name, estimate)
        for name, document in fit.get("parameters", {}).items()
        if (estimate := Estimate.from_json(document)) is not None
    ]
    if table_rows:
        paragraphs.append(_markdown_table("parameter", "value", table_rows=table_rows))
    paragraphs += [
        escape_markdown(sentence) for sentence in fit.get("findings", ())[:_MAX_TABLE_FINDINGS]
    ]
    return "\n\n".join(paragraphs)


def _markdown_table(*column_headings: str, table_rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table with the given column headings and rows."""
    table_lines = (column_headings, ("---",) * len(column_headings), *table_rows)
    return "\n".join(f"| {' | '.join(row_cells)} |" for row_cells in table_lines)


def _target_row(target_precision: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a table row: name, estimate, and its reached and requested standard deviation."""
    estimated_value, reached_std, target_std = (
        target_precision["value"],
        target_precision["std"],
        target_precision["asked_std"],
    )
    if estimated_value is None:
        return escape_markdown(target_precision["name"]), "–", "–", "–"
    if reached_std is None:
        return (
            escape_markdown(target_precision["name"]),
            f"{estimated_value:.4g}",
            "doubtful",
            with_percentage(target_std, estimated_value),
        )
    check_mark = " ✓" if reached_std <= target_std else ""
    return (
        escape_markdown(target_precision["name"]),
        f"{estimated_value:.4g}",
        f"**{with_percentage(reached_std, estimated_value)}**{check_mark}",
        with_percentage(target_std, estimated_value),
    )


def _mode_row(mode: ReportedMode) -> tuple[str, ...]:
    """Return the table row of a mode: its number, frequency and damping ratio with intervals."""
    return (
        str(mode.number),
        mode.frequency_hz.text() + _doubt_suffix(mode.frequency_hz),
        mode.damping_ratio.text(100.0) + _doubt_suffix(mode.damping_ratio),
    )


def _parameter_row(parameter_name: str, estimate: Estimate) -> tuple[str, ...]:
    """Return the table row of a fitted parameter: its name, and its value with interval."""
    interval_95 = estimate.interval_95
    # Small numbers, such as zeta, have a power of ten, the same for value and interval.
    largest_magnitude = (
        abs(estimate.value)
        if interval_95 is None
        else max(abs(estimate.value), (interval_95[1] - interval_95[0]) / 2.0)
    )
    power_of_ten = (
        0
        if largest_magnitude == 0 or largest_magnitude >= 1e-2
        else int(np.floor(np.log10(largest_magnitude)))
    )
    value_text = estimate.text(10.0**-power_of_ten)
    if power_of_ten:
        value_text = f"({value_text})·10{str(power_of_ten).translate(_SUPERSCRIPTS)}"
    parameter_label = parameter_name.removesuffix(suffix_of(parameter_name)).replace("_", " ")
    return parameter_label, f"{value_text} {unit_of(parameter_name)}".rstrip() + _doubt_suffix(
        estimate
    )


_SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""Translation table from digits and the minus sign to their superscript characters."""


def _doubt_suffix(estimate: Estimate) -> str:
    """Return the reason to doubt an estimate, as a text to append; empty if there is none."""
    return f" (doubtful: {escape_markdown(estimate.flag)})" if estimate.flag else ""


def send_table(stream: "RecordingStream", fit: Fit | None) -> None:
    """Send the table of a fit to Rerun, at the time of the fit's last sample."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=0.0 if fit is None else fit["duration_s"])
    stream.log(
        FIT_TABLE_ENTITY, rr.TextDocument(fit_table_markdown(fit), media_type=rr.MediaType.MARKDOWN)
    )
