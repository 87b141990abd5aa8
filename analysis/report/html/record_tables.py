"""Tables of the whole-record fits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.report.html.table import ABSENT, Cell, Column, Table, count, estimate, number
from analysis.report.record_figure_bands import NORMAL_95

if TYPE_CHECKING:
    from analysis.report.html.subject import Subject
    from analysis.whole_record import DampingSize, RecordFit

_PARAMETERS: Final[dict[str, tuple[str, str, str, float]]] = {
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


def modes_table(subject: Subject) -> Table:
    """Frequencies and damping ratios of the selected fit."""
    rows: list[tuple[Cell, ...]] = []
    for mode in subject.fit.modes:
        f, f_std = mode.frequency_hz, mode.frequency_std_hz
        ratio, ratio_std = mode.damping_ratio, mode.damping_ratio_std
        half = NORMAL_95 * ratio_std
        rows.append(
            (
                count(mode.number),
                *estimate((f, f_std), f_std),
                *estimate((ratio, ratio_std, ratio - half, ratio + half), ratio_std, 100.0),
            )
        )
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
    )


def parameters_table(subject: Subject) -> Table:
    """Parameters of the selected fit with their uncertainty."""
    fit = subject.fit
    rows = tuple(
        _withheld_row(name) if name in subject.verdict.withheld else _parameter_row(fit, name)
        for name in fit.parameters
        if _has(fit, name)
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
    fit = subject.fit
    rows = [
        _size_row(what, symbol, unit, size)
        for what, symbol, unit, size in (
            ("internal", "ζ ω^α", "1", fit.internal),
            ("external", "γ ω^λ", "1/m⁴", fit.external),
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
        ("Coefficient and order are strongly correlated; these are not.",),
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


def structures_table(subject: Subject) -> Table:
    """All fits beside each other."""
    lowest = min(fit.cost for fit in subject.fits.values())
    delta_bic = subject.verdict.delta_bic
    rows: list[tuple[Cell, ...]] = []
    for name, fit in subject.fits.items():
        shown: list[Cell] = []
        for parameter in ("zeta", "alpha", "gamma", "lambda"):
            factor = _PARAMETERS[parameter][3]
            if not _has(fit, parameter):
                shown += [number(None), number(None)]
                continue
            std = fit.std[parameter]
            free = parameter in fit.structure.free
            value, spread = estimate(
                (fit.parameters[parameter], std if free else None), std, factor
            )
            held = "*" if parameter in fit.at_bounds else ""
            shown += [replace(value, text=value.text + held), spread]
        rows.append(
            (
                name,
                *shown,
                *([number(delta_bic[name], ".4g")] if delta_bic else []),
                number(fit.cost, ".6g"),
                number(fit.cost - lowest, ".4g"),
                count(fit.degrees_of_freedom),
                count(fit.free_parameters),
            )
        )
    return Table(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", numeric=False),
            *(
                column
                for parameter in ("zeta", "alpha", "gamma", "lambda")
                for column in (
                    Column(_heading(parameter), parameter),
                    Column("std", f"{parameter}_std"),
                )
            ),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Sum of squares", "cost"),
            Column("Excess", "cost_above_lowest"),
            Column("Expected", "degrees_of_freedom"),
            Column("Free", "free_parameters"),
        ),
        tuple(rows),
        (
            "ΔBIC: Bayesian information criterion above the lowest; 10 is clear. "
            "Sum of squares of the whitened residual; by how much it is above the lowest; what it "
            "would be by chance alone (degrees of freedom); number of free parameters, those of "
            "rig and beam included. * rests on the edge of the range searched. The marked row is "
            "the one selected.",
        ),
        selected=list(subject.fits).index(subject.verdict.selected),
    )


def _has(fit: RecordFit, name: str) -> bool:
    """Whether a parameter means anything in the fit's structure."""
    if name in ("zeta", "alpha"):
        return fit.structure.internal
    if name in ("gamma", "lambda"):
        return fit.structure.external
    return True


def _parameter_row(fit: RecordFit, name: str) -> tuple[Cell, ...]:
    default = (_symbol(name), "stiffness beyond the uniform beam's", "%", 100.0)
    symbol, meaning, unit, factor = _PARAMETERS.get(name, default)
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


def _withheld_row(name: str) -> tuple[Cell, ...]:
    symbol, meaning, unit, _factor = _PARAMETERS[name]
    unknown = [number(None)] * 4
    return (symbol, meaning, unit, *unknown, "not supported by the data")


def _size_row(what: str, symbol: str, unit: str, size: DampingSize) -> tuple[Cell, ...]:
    if size.omega_rad_s is None:
        symbol, unit = symbol[0], ABSENT
    return (
        what,
        symbol,
        unit,
        number(size.omega_rad_s, ".4g"),
        *estimate((size.value, size.std), size.std),
        number(size.std / size.value, "#.2g", 100.0),
    )


def _symbol(name: str) -> str:
    if name in _PARAMETERS:
        return _PARAMETERS[name][0]
    return f"δ{name.rsplit('_', 1)[-1]}"


def _heading(name: str) -> str:
    """Symbol with its power of ten; the units, which depend on the orders, would be too long."""
    symbol, _meaning, unit, factor = _PARAMETERS[name]
    return symbol if factor == 1.0 else f"{symbol} ({unit.split()[0]})"


def _correlation(own: bool, value: float) -> Cell:
    shown = number(value, ".3f")
    if own or abs(value) < _STRONG_CORRELATION:
        return shown
    return replace(shown, strong=True)
