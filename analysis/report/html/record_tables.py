"""Tables of the whole-record fits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.report.html.reported import MARK, footnotes, greyed, has, marked, unreported
from analysis.report.html.table import ABSENT, Cell, Column, Table, count, estimate, number
from analysis.report.record_figure_bands import NORMAL_95

if TYPE_CHECKING:
    from analysis.report.html.subject import Subject
    from analysis.whole_record import DampingSize, RecordFit

PARAMETERS: Final[dict[str, tuple[str, str, str, float]]] = {
    "zeta": ("ζ", "internal damping", "1e-5 s^α", 1e5),
    "alpha": ("α", "its order", "1", 1.0),
    "gamma": ("γ", "external damping", "1e-2 s^λ/m⁴", 1e2),
    "lambda": ("λ", "its order", "1", 1.0),
    "density_over_stiffness": ("ρ/EI", "density over stiffness", "1e-3 s²/m⁴", 1e3),
    "bending_stiffness_n_m2": ("EI", "bending stiffness", "N·m²", 1.0),
    "delay_s": ("τ", "torque older than angle", "µs", 1e6),
    "tool_inertia_kg_m2": ("J", "inertia of the clamp", "1e-6 kg·m²", 1e6),
}
"""Symbol, meaning, unit shown, and how many of that make one SI unit."""

_STRONG_CORRELATION: Final = 0.9
_HOLDS_FOR: Final = {"zeta": "depends on α", "gamma": "depends on λ"}


def modes_table(subject: Subject) -> Table:
    """Frequencies and damping ratios of the selected fit; modes that do not show are marked."""
    rows: list[tuple[Cell, ...]] = []
    visible = subject.visible_modes
    for mode in subject.fit.modes:
        f, f_std = mode.frequency_hz, mode.frequency_std_hz
        ratio, ratio_std = mode.damping_ratio, mode.damping_ratio_std
        half = NORMAL_95 * ratio_std
        row = (
            count(mode.number),
            *estimate((f, f_std), f_std),
            *estimate((ratio, ratio_std, ratio - half, ratio + half), ratio_std, 100.0),
        )
        shows = mode.number in visible
        rows.append(row if shows else (marked(row[0]), *map(greyed, row[1:])))
    return Table(
        "modes",
        f"Modes of the beam on a motor that stands still: type {subject.verdict.selected}",
        (
            Column("Mode", "mode"),
            Column("Frequency (Hz)", "frequency_hz"),
            Column("std (Hz)", "frequency_std_hz"),
            Column("Damping ratio (%)", "damping_ratio"),
            Column("std (%)", "damping_ratio_std"),
            Column("95 % from (%)", "damping_ratio_low"),
            Column("to (%)", "damping_ratio_high"),
        ),
        tuple(rows),
        ()
        if len(visible) == len(rows)
        else (f"{MARK} computed from the model: the record does not show this mode.",),
    )


def parameters_table(subject: Subject) -> Table:
    """Parameters of the selected fit with their uncertainty."""
    fit = subject.fit
    doubtful = unreported(fit.structure, subject.verdict.withheld)
    rows = tuple(
        _unreported_row(name) if name in doubtful else _parameter_row(fit, name)
        for name in fit.parameters
        if has(fit.structure, name)
    )
    return Table(
        "parameters",
        f"Parameters, type {subject.verdict.selected}",
        (
            Column("Parameter", "parameter", numeric=False),
            Column("Meaning", "meaning", numeric=False),
            Column("Unit shown", "unit_shown", numeric=False),
            Column("Value", "value_si"),
            Column("std", "std_si"),
            Column("95 % from", "low_si"),
            Column("to", "high_si"),
            Column("Remark", "remark", numeric=False),
        ),
        rows,
        (
            "std is one standard deviation; intervals of ζ, γ, ρ/EI and EI are symmetric in the "
            "logarithm. The CSV file has SI units.",
        ),
    )


def sizes_table(subject: Subject) -> Table:
    """Sizes of the damping where they are uncorrelated with its orders."""
    fit, withheld = subject.fit, subject.verdict.withheld
    rows = [
        # Without its frequency a size is the coefficient for an order that was only assumed.
        _size_row(what, symbol, unit, size, doubtful=size.omega_rad_s is None and order in withheld)
        for what, symbol, unit, size, order in (
            ("internal", "ζ ω^α", "1", fit.internal, "alpha"),
            ("external", "γ ω^λ", "1/m⁴", fit.external, "lambda"),
        )
        if size is not None
    ]
    return Table(
        "damping_sizes",
        "Size of the damping at the frequency where it does not depend on the order found",
        (
            Column("Damping", "damping", numeric=False),
            Column("Quantity", "quantity", numeric=False),
            Column("Unit", "unit", numeric=False),
            Column("at ω (rad/s)", "omega_rad_s"),
            Column("Value", "value"),
            Column("std", "std"),
            Column("std (%)", "relative_std"),
        ),
        tuple(rows),
        ("Coefficient and order are strongly correlated; these are not.", *footnotes(withheld)),
    )


def correlations_table(subject: Subject) -> Table:
    """Correlations of the determined parameters of the selected fit."""
    fit = subject.fit
    symbols = [_symbol(name) for name in fit.determined]
    return Table(
        "correlations",
        f"Correlations of the parameters, type {subject.verdict.selected}",
        (
            Column("Parameter", "parameter", numeric=False),
            *(Column(symbol, name) for symbol, name in zip(symbols, fit.determined, strict=True)),
        ),
        tuple(
            (symbol, *(_correlation(i == j, value) for j, value in enumerate(row)))
            for i, (symbol, row) in enumerate(zip(symbols, fit.correlation.tolist(), strict=True))
        ),
        ("Of ζ, γ, ρ/EI and EI the logarithms. Bold: 0.9 or more.",),
    )


def _parameter_row(fit: RecordFit, name: str) -> tuple[Cell, ...]:
    default = (_symbol(name), "stiffness beyond the uniform beam's", "%", 100.0)
    symbol, meaning, unit, factor = PARAMETERS.get(name, default)
    std = fit.std[name]
    low, high = fit.interval.get(name) or (None, None)
    free = name in fit.interval
    if name in fit.at_bounds:
        status = "at the edge of its range"
    elif not free:
        status = "fixed"
    else:
        status = "" if name in fit.determined else "not determined by the data"
    shown = estimate((fit.parameters[name], std if free else None, low, high), std, factor)
    return (symbol, meaning, unit, *shown, status)


def _unreported_row(name: str) -> tuple[Cell, ...]:
    symbol, meaning, unit, _factor = PARAMETERS[name]
    unknown = [number(None)] * 4
    remark = _HOLDS_FOR.get(name, "not supported by the data")
    return (symbol, meaning, unit, *unknown, remark)


def _size_row(
    what: str, symbol: str, unit: str, size: DampingSize, *, doubtful: bool
) -> tuple[Cell, ...]:
    if size.omega_rad_s is None:
        symbol, unit = symbol[0], ABSENT
    at = number(size.omega_rad_s, ".4g")
    value, std = estimate((size.value, size.std), size.std)
    relative = number(size.std / size.value, "#.2g", 100.0)
    if doubtful:
        value, std, relative = marked(value), greyed(std), greyed(relative)
    return (what, symbol, unit, at, value, std, relative)


def _symbol(name: str) -> str:
    if name in PARAMETERS:
        return PARAMETERS[name][0]
    return f"δ{name.rsplit('_', 1)[-1]}"


def _correlation(own: bool, value: float) -> Cell:
    shown = number(value, ".3f")
    if own or abs(value) < _STRONG_CORRELATION:
        return shown
    return replace(shown, strong=True)
