"""Fits of the record: modes over time with their shrinking intervals, and a table of the last fit.

During a session a new fit arrives every second, or with every segment of a search for a target
precision. A recorded file contains only the last fit, which is shown as a table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.session import Validity
from rigd.session.online_fit import unseen_modes
from rigd.units import suffix_of, unit_of, with_half_width, with_percentage
from rigd.view._session_info import plain
from rigd.view.plots import GREY, ORANGE, SKY_BLUE, TIMELINE, Plot, PlotCurve, Source, Values

if TYPE_CHECKING:
    from rerun import RecordingStream

Fit = Mapping[str, Any]
"""Fit of a session's record as in JSON documents (docs/online_fit.md)."""

TABLE: Final = "/fit_table"
"""Entity path in Rerun of the table with the last fit."""
_PLOTS_ENTITY: Final = "/fits"
"""Entity path in Rerun of the plots of fitted modes over time."""
_MOST_FINDINGS: Final = 8
"""Largest number of findings that the table of a fit lists."""


@dataclass(frozen=True, slots=True)
class _Quantity:
    """Quantity of a mode that is plotted over time: its names, unit and scale."""

    name: str
    """Name of the quantity in the target precisions of a search."""
    key: str
    """Key of the quantity in the JSON document of a mode."""
    suffix: str
    """Suffix of the plot's component name in Rerun, which ends in the unit."""
    title: str
    """Title of the plot, without the mode."""
    unit: str
    """Unit of the plotted values."""
    factor: float
    """Factor from the unit of the JSON document to the plotted unit."""

    def field(self, mode: int) -> str:
        """Return the name of the field with this quantity of a mode in the record of a fit."""
        return f"{self.name}_{mode}"


_QUANTITIES: Final = (
    _Quantity("damping", "damping_ratio", "percent", "Damping ratio", "%", 100.0),
    _Quantity("frequency", "frequency_hz", "hz", "Frequency", "Hz", 1.0),
)
"""Quantities that are plotted for each mode: damping ratio and frequency."""
_TARGET_LOW_INDEX, _TARGET_HIGH_INDEX, _LOW_INDEX, _HIGH_INDEX, _VALUE_INDEX = range(5)
"""Indices of the five values in each field of a fit's record; unknown values are NaN."""


def fit_source(modes: int, *, with_targets: bool) -> Source:
    """Return the plots of damping ratio and frequency over time, for each of the first modes.

    Parameters
    ----------
    modes
        Number of modes.
    with_targets
        Whether the session may have target precisions.
    """
    plots = (
        _plot(quantity, n, with_targets=with_targets)
        for n in range(1, modes + 1)
        for quantity in _QUANTITIES
    )
    return Source(_PLOTS_ENTITY, tuple(plots))


def _plot(quantity: _Quantity, mode: int, *, with_targets: bool) -> Plot:
    """Return the plot of a mode's frequency or damping ratio, with its 95 % interval over time."""
    field, unit = quantity.field(mode), quantity.unit

    def values(records: npt.NDArray[Any], column: int) -> Values:
        column_values: Values = records[field][:, column]
        return column_values

    # Curves with the same name have one entry in the legend.
    target, interval = f"asked for, 95 % ({unit})", f"95 % interval ({unit})"
    target_ends = (
        PlotCurve(target, GREY, partial(values, column=_TARGET_LOW_INDEX)),
        PlotCurve(target, GREY, partial(values, column=_TARGET_HIGH_INDEX)),
    )
    return Plot(
        f"{quantity.name}_{mode}_{quantity.suffix}",
        f"{quantity.title} of mode {mode} ({unit})",
        (
            *(target_ends if with_targets else ()),
            PlotCurve(interval, ORANGE, partial(values, column=_LOW_INDEX)),
            PlotCurve(interval, ORANGE, partial(values, column=_HIGH_INDEX)),
            PlotCurve(f"estimate ({unit})", SKY_BLUE, partial(values, column=_VALUE_INDEX), 2.5),
        ),
    )


def fit_record(fit: Fit | None, modes: int) -> npt.NDArray[Any]:
    """Return a fit as one record (1,) with time and modes, for the plots of `fit_source`.

    Doubtful values and modes that are not visible in the samples are NaN.

    Parameters
    ----------
    fit
        Fit as in JSON documents; None if there is no fit yet.
    modes
        Number of modes in the plots; further modes of the fit are omitted.
    """
    fields = [(q.field(n), "<f8", (5,)) for n in range(1, modes + 1) for q in _QUANTITIES]
    record = np.zeros(1, [("t_ns", "<i8"), *fields])
    for name, *_ in fields:
        record[name] = np.nan
    if fit is None:
        return record
    record["t_ns"] = round(1e9 * fit["duration_s"])
    target_stds = {
        (target["quantity"], target["mode"]): target["asked_std"] for target in _targets(fit)
    }
    for mode in fit.get("modes", ()):
        for quantity in _QUANTITIES if mode["mode"] <= modes else ():
            estimate = mode[quantity.key]
            interval = estimate["interval_95"]
            if not mode.get("shown", True) or estimate["flag"] or interval is None:
                continue
            value, (low, high) = estimate["value"], interval
            target_std = target_stds.get((quantity.name, mode["mode"]))
            target_half_width = np.nan
            if target_std is not None and estimate["std"]:
                target_half_width = target_std * (high - low) / (2.0 * estimate["std"])
            field_values = np.array(
                [value - target_half_width, value + target_half_width, low, high, value]
            )
            record[quantity.field(mode["mode"])] = quantity.factor * field_values
    return record


def _targets(fit: Fit) -> list[Mapping[str, Any]]:
    """Return the target precisions of a fit's search; an empty list without a search."""
    return list((fit.get("search") or {}).get("targets") or ())


# Table


def fit_table(fit: Fit | None) -> str:
    """Return a Markdown table of a fit: target and reached precisions, modes and parameters.

    Parameters
    ----------
    fit
        Fit as in JSON documents; None if there is no fit yet.
    """
    if fit is None:
        return "No fit yet."
    search = fit.get("search") or {}
    paragraphs = []
    if search.get("reason"):
        paragraphs.append(f"**{plain(search['reason'])}**")
    targets = _targets(fit)
    if targets:
        rows = [_target_row(parameter_item) for parameter_item in targets]
        paragraphs.append(_markdown_table("asked for", "value", "std", "asked std", rows=rows))
    if not search.get("reason") and search.get("left_s") is not None:
        paragraphs.append(f"About **{search['left_s']:.0f} s** more.")
    if not search.get("reason") and search.get("piece"):
        paragraphs.append(f"Excited now: {plain(str(search['piece']))}")
    if fit.get("problem"):
        paragraphs.append(f"**After {fit['duration_s']:.1f} s:** {plain(fit['problem'])}")
    else:
        paragraphs.append(
            f"**Fit of the first {fit['duration_s']:.1f} s** (± 95 %, statistical only)"
        )
    modes = [_mode_row(mode) for mode in fit.get("modes", ()) if mode.get("shown", True)]
    if modes:
        paragraphs.append(
            _markdown_table("mode", "frequency (Hz)", "damping ratio (%)", rows=modes)
        )
    modes_not_visible = unseen_modes(fit.get("modes", ()))
    if modes_not_visible:
        paragraphs.append(f"Not visible so far: {modes_not_visible}.")
    if modes:
        validity = Validity.of_document(fit.get("validity"))
        paragraphs.append(validity.sentence)
        if validity.uniform_beam is not None:
            paragraphs.append(validity.uniform_beam.sentence)
    rows = [_parameter_row(*parameter_item) for parameter_item in fit.get("parameters", {}).items()]
    if rows:
        paragraphs.append(_markdown_table("parameter", "value", rows=[row for row in rows if row]))
    paragraphs += [plain(sentence) for sentence in fit.get("findings", ())[:_MOST_FINDINGS]]
    return "\n\n".join(paragraphs)


def _markdown_table(*headings: str, rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table with the given column heads and rows."""
    lines = (headings, ("---",) * len(headings), *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _target_row(target: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the table row of a target precision: name, value, reached and target deviation."""
    value, std, target_std = target["value"], target["std"], target["asked_std"]
    if value is None:
        return plain(target["name"]), "–", "–", "–"
    if std is None:
        return plain(target["name"]), f"{value:.4g}", "doubtful", with_percentage(target_std, value)
    check_mark = " ✓" if std <= target_std else ""
    return (
        plain(target["name"]),
        f"{value:.4g}",
        f"**{with_percentage(std, value)}**{check_mark}",
        with_percentage(target_std, value),
    )


def _mode_row(mode: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the table row of a mode: its number, frequency and damping ratio with intervals."""
    hz, damping = mode["frequency_hz"], mode["damping_ratio"]
    return (
        str(mode["mode"]),
        with_half_width(hz["value"], hz["interval_95"]) + _doubt_suffix(hz),
        with_half_width(damping["value"], damping["interval_95"], 100.0) + _doubt_suffix(damping),
    )


def _parameter_row(name: str, estimate: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the table row of a fitted parameter: its name, and its value with interval."""
    value, interval = estimate["value"], estimate["interval_95"]
    if value is None:
        return ()
    # Small numbers, such as zeta, have a power of ten, the same for value and interval.
    magnitude = (
        abs(value) if interval is None else max(abs(value), (interval[1] - interval[0]) / 2.0)
    )
    power = 0 if magnitude == 0 or magnitude >= 1e-2 else int(np.floor(np.log10(magnitude)))
    text = with_half_width(value, interval, 10.0**-power)
    if power:
        text = f"({text})·10{str(power).translate(_SUPERSCRIPTS)}"
    label = name.removesuffix(suffix_of(name)).replace("_", " ")
    return label, f"{text} {unit_of(name)}".rstrip() + _doubt_suffix(estimate)


_SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""Translation table from digits and the minus sign to their superscript characters."""


def _doubt_suffix(estimate: Mapping[str, Any]) -> str:
    """Return why an estimate is doubtful, in brackets; an empty text if it is not."""
    return f" (doubtful: {plain(estimate['flag'])})" if estimate.get("flag") else ""


def send_table(stream: "RecordingStream", fit: Fit | None) -> None:
    """Send the table of a fit to Rerun, at the time of the fit's last sample."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=0.0 if fit is None else fit["duration_s"])
    stream.log(TABLE, rr.TextDocument(fit_table(fit), media_type=rr.MediaType.MARKDOWN))
