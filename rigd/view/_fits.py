"""Fits of the record: modes over time with their shrinking intervals, and a table of the last fit.

During a session a fit comes every second, or with every segment of a search for a precision. A
recorded file has only the last fit, which is shown as a table.
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
"""Fit as in JSON documents (docs/online_fit.md)."""

TABLE: Final = "/fit_table"
_ENTITY: Final = "/fits"
_MOST_FINDINGS: Final = 8


@dataclass(frozen=True, slots=True)
class _Quantity:
    name: str
    """Name as in the targets of a search."""
    key: str
    """Key in a mode of a fit."""
    suffix: str
    """Suffix of the component's name."""
    title: str
    unit: str
    factor: float

    def field(self, mode: int) -> str:
        return f"{self.name}_{mode}"


_QUANTITIES: Final = (
    _Quantity("damping", "damping_ratio", "percent", "Damping ratio", "%", 100.0),
    _Quantity("frequency", "frequency_hz", "hz", "Frequency", "Hz", 1.0),
)
_TARGET_LOW, _TARGET_HIGH, _LOW, _HIGH, _VALUE = range(5)
"""Columns of a field of a fit's record; unknown values are NaN."""


def fit_source(modes: int, *, with_targets: bool) -> Source:
    """Return the plots of the first modes, for each the damping ratio and then the frequency.

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
    return Source(_ENTITY, tuple(plots))


def _plot(quantity: _Quantity, mode: int, *, with_targets: bool) -> Plot:
    field, unit = quantity.field(mode), quantity.unit

    def values(records: npt.NDArray[Any], column: int) -> Values:
        found: Values = records[field][:, column]
        return found

    # Curves with the same name have one entry in the legend.
    target, interval = f"asked for, 95 % ({unit})", f"95 % interval ({unit})"
    target_ends = (
        PlotCurve(target, GREY, partial(values, column=_TARGET_LOW)),
        PlotCurve(target, GREY, partial(values, column=_TARGET_HIGH)),
    )
    return Plot(
        f"{quantity.name}_{mode}_{quantity.suffix}",
        f"{quantity.title} of mode {mode} ({unit})",
        (
            *(target_ends if with_targets else ()),
            PlotCurve(interval, ORANGE, partial(values, column=_LOW)),
            PlotCurve(interval, ORANGE, partial(values, column=_HIGH)),
            PlotCurve(f"estimate ({unit})", SKY_BLUE, partial(values, column=_VALUE), 2.5),
        ),
    )


def fit_record(fit: Fit | None, modes: int) -> npt.NDArray[Any]:
    """Return the record of a fit for the plots of `fit_source`, shape (1,), with ``t_ns``.

    Modes that the record does not show and doubtful values are NaN.

    Parameters
    ----------
    fit
        Fit; None: there is none yet.
    modes
        Number of modes in the plots.
    """
    fields = [(q.field(n), "<f8", (5,)) for n in range(1, modes + 1) for q in _QUANTITIES]
    record = np.zeros(1, [("t_ns", "<i8"), *fields])
    for name, *_ in fields:
        record[name] = np.nan
    if fit is None:
        return record
    record["t_ns"] = round(1e9 * fit["duration_s"])
    stds = {(each["quantity"], each["mode"]): each["asked_std"] for each in _targets(fit)}
    for mode in fit.get("modes", ()):
        for quantity in _QUANTITIES if mode["mode"] <= modes else ():
            found = mode[quantity.key]
            ends = found["interval_95"]
            if not mode.get("shown", True) or found["flag"] or ends is None:
                continue
            value, (low, high) = found["value"], ends
            target_std = stds.get((quantity.name, mode["mode"]))
            half = np.nan
            if target_std is not None and found["std"]:
                half = target_std * (high - low) / (2.0 * found["std"])
            shown = np.array([value - half, value + half, low, high, value])
            record[quantity.field(mode["mode"])] = quantity.factor * shown
    return record


def _targets(fit: Fit) -> list[Mapping[str, Any]]:
    return list((fit.get("search") or {}).get("targets") or ())


# Table


def fit_table(fit: Fit | None) -> str:
    """Return a fit as Markdown: target precisions and those reached, modes, parameters.

    Parameters
    ----------
    fit
        Fit; None: there is none yet.
    """
    if fit is None:
        return "No fit yet."
    search = fit.get("search") or {}
    parts = []
    if search.get("reason"):
        parts.append(f"**{plain(search['reason'])}**")
    targets = _targets(fit)
    if targets:
        rows = [_target_row(each) for each in targets]
        parts.append(_markdown("asked for", "value", "std", "asked std", rows=rows))
    if not search.get("reason") and search.get("left_s") is not None:
        parts.append(f"About **{search['left_s']:.0f} s** more.")
    if not search.get("reason") and search.get("piece"):
        parts.append(f"Excited now: {plain(str(search['piece']))}")
    if fit.get("problem"):
        parts.append(f"**After {fit['duration_s']:.1f} s:** {plain(fit['problem'])}")
    else:
        parts.append(f"**Fit of the first {fit['duration_s']:.1f} s** (± 95 %, statistical only)")
    modes = [_mode_row(mode) for mode in fit.get("modes", ()) if mode.get("shown", True)]
    if modes:
        parts.append(_markdown("mode", "frequency (Hz)", "damping ratio (%)", rows=modes))
    unseen = unseen_modes(fit.get("modes", ()))
    if unseen:
        parts.append(f"Not visible so far: {unseen}.")
    if modes:
        validity = Validity.of_document(fit.get("validity"))
        parts.append(validity.sentence)
        if validity.uniform_beam is not None:
            parts.append(validity.uniform_beam.sentence)
    rows = [_parameter_row(*each) for each in fit.get("parameters", {}).items()]
    if rows:
        parts.append(_markdown("parameter", "value", rows=[row for row in rows if row]))
    parts += [plain(sentence) for sentence in fit.get("findings", ())[:_MOST_FINDINGS]]
    return "\n\n".join(parts)


def _markdown(*heads: str, rows: list[tuple[str, ...]]) -> str:
    lines = (heads, ("---",) * len(heads), *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _target_row(target: Mapping[str, Any]) -> tuple[str, ...]:
    value, std, target_std = target["value"], target["std"], target["asked_std"]
    if value is None:
        return plain(target["name"]), "–", "–", "–"
    if std is None:
        return plain(target["name"]), f"{value:.4g}", "doubtful", with_percentage(target_std, value)
    reached = " ✓" if std <= target_std else ""
    return (
        plain(target["name"]),
        f"{value:.4g}",
        f"**{with_percentage(std, value)}**{reached}",
        with_percentage(target_std, value),
    )


def _mode_row(mode: Mapping[str, Any]) -> tuple[str, ...]:
    hz, damping = mode["frequency_hz"], mode["damping_ratio"]
    return (
        str(mode["mode"]),
        with_half_width(hz["value"], hz["interval_95"]) + _doubt(hz),
        with_half_width(damping["value"], damping["interval_95"], 100.0) + _doubt(damping),
    )


def _parameter_row(name: str, found: Mapping[str, Any]) -> tuple[str, ...]:
    value, ends = found["value"], found["interval_95"]
    if value is None:
        return ()
    # Small numbers, such as zeta, have a power of ten, the same for value and interval.
    size = abs(value) if ends is None else max(abs(value), (ends[1] - ends[0]) / 2.0)
    power = 0 if size == 0 or size >= 1e-2 else int(np.floor(np.log10(size)))
    text = with_half_width(value, ends, 10.0**-power)
    if power:
        text = f"({text})·10{str(power).translate(_RAISED)}"
    words = name.removesuffix(suffix_of(name)).replace("_", " ")
    return words, f"{text} {unit_of(name)}".rstrip() + _doubt(found)


_RAISED: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _doubt(found: Mapping[str, Any]) -> str:
    return f" (doubtful: {plain(found['flag'])})" if found.get("flag") else ""


def send_table(stream: "RecordingStream", fit: Fit | None) -> None:
    """Show the table of a fit from the end of its samples on, or a note that there is none."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=0.0 if fit is None else fit["duration_s"])
    stream.log(TABLE, rr.TextDocument(fit_table(fit), media_type=rr.MediaType.MARKDOWN))
