"""Tables of the whole-record fits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.report.html.reported import MARK, greyed, marked
from analysis.report.html.table import Cell, Column, Table, count, estimate, number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.identify import Headline, Quantity, Size
    from analysis.report.html.subject import Subject

PARAMETERS: Final[dict[str, tuple[str, str, str, float]]] = {
    "zeta": ("ζ", "internal damping", "1e-5 s^α", 1e5),
    "alpha": ("α", "its order", "1", 1.0),
    "gamma": ("γ", "external damping", "1e-2 s^λ/m⁴", 1e2),
    "lambda": ("λ", "its order", "1", 1.0),
    "density_over_stiffness": ("ρ/EI", "density over stiffness", "1e-3 s²/m⁴", 1e3),
    "bending_stiffness_n_m2": ("EI", "bending stiffness", "N·m²", 1.0),
    "delay_s": ("τ", "torque older than angle", "µs", 1e6),
    "tool_inertia_kg_m2": ("J", "inertia of the clamp", "1e-6 kg·m²", 1e6),
    "root_compliance_rad_per_nm": ("c", "compliance of the clamp", "1e-3 rad/(N·m)", 1e3),
    "tip_mass_kg": ("m", "mass at the tip", "g", 1e3),
    "filter_time_constant_s": ("T", "first-order filter of the torque", "ms", 1e3),
    "second_order_filter_time_constant_s": ("T", "second-order filter of the torque", "ms", 1e3),
    "clock_rate_difference": ("ε", "torque's clock against the angle's", "ppm", 1e6),
    "drag": ("C_D d", "drag of the air", "mm", 1e3),
}
"""Symbol, meaning, unit shown, and how many of that make one SI unit."""

_STRONG_CORRELATION: Final = 0.9
_MARKED: Final = (
    f"{MARK} must not be taken for a property of the antenna; the remark says why. The number "
    "belongs to the model's curve."
)


def modes_table(subject: Subject) -> Table:
    """Frequencies and damping ratios; modes that do not show, or are doubtful, are marked."""
    told = subject.headline
    rows: list[tuple[Cell, ...]] = []
    for mode in told.modes:
        f, ratio = mode.frequency_hz, mode.damping_ratio
        row = (
            count(mode.number),
            *estimate((f.value, f.std), f.std),
            *estimate((ratio.value, ratio.std, *_ends(ratio)), ratio.std, 100.0),
        )
        rows.append(row if ratio.flag is None else (marked(row[0]), *map(greyed, row[1:])))
    return Table(
        "modes",
        f"Modes of the beam on a motor that stands still: type {told.name}",
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
        _reasons(mode.damping_ratio for mode in told.modes),
    )


def parameters_table(subject: Subject) -> Table:
    """All parameters with their uncertainty; those with a flag are marked, with the reason."""
    told = subject.headline
    return Table(
        "parameters",
        f"Parameters, type {told.name}",
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
        tuple(_parameter_row(told, name, each) for name, each in told.parameters.items()),
        (
            "std is one standard deviation; intervals of ζ, γ, ρ/EI and EI are symmetric in the "
            "logarithm. The CSV file has SI units.",
            *((_MARKED,) if told.flags else ()),
        ),
    )


def sizes_table(subject: Subject) -> Table:
    """Loss factors of either damping where they are uncorrelated with its order."""
    told = subject.headline
    return Table(
        "damping_sizes",
        "Loss factor of either damping at the frequency where it depends least on its order",
        (
            Column("Damping", "damping", numeric=False),
            Column("Quantity", "quantity", numeric=False),
            Column("at ω (rad/s)", "omega_rad_s"),
            Column("Value", "value"),
            Column("std", "std"),
            Column("std (%)", "relative_std"),
            Column("95 % from", "low"),
            Column("to", "high"),
        ),
        tuple(_size_row(told, each) for each in told.sizes),
        (
            "Coefficient and order are strongly correlated; a loss factor is known far better than "
            "either.",
            *_reasons(each.size for each in told.sizes),
        ),
    )


def condition_table(subject: Subject) -> Table | None:
    """Set what a simpler structure would give beside what is told; None if none would do."""
    told, simpler = subject.headline, subject.headline.simpler
    if simpler is None:
        return None
    taken = " and ".join(f"{PARAMETERS[name][0]} = {at:g}" for name, at in simpler.fixed.items())
    rows: list[tuple[Cell, ...]] = []
    for name, each in simpler.parameters.items():
        symbol, _meaning, unit, factor = _described(name)
        free = told.parameters[name]
        rows.append(
            (
                symbol,
                unit,
                *estimate((each.value, *_ends(each)), each.std, factor),
                *estimate((free.value, *_ends(free)), free.std, factor),
            )
        )
    return Table(
        "on_condition",
        f"If {taken or 'the rest'} is taken for granted: type {simpler.name}, which would do",
        (
            Column("Parameter", "parameter", numeric=False),
            Column("Unit shown", "unit_shown", numeric=False),
            Column("Then", "value_si"),
            Column("95 % from", "low_si"),
            Column("to", "high_si"),
            Column("Free", "free_value_si"),
            Column("95 % from", "free_low_si"),
            Column("to", "free_high_si"),
        ),
        tuple(rows),
        ("The intervals on the left hold only if what is taken for granted is true.",),
    )


def correlations_table(subject: Subject) -> Table:
    """Correlations of the determined parameters of the selected fit."""
    fit = subject.fit
    symbols = [_symbol(name) for name in fit.determined]
    return Table(
        "correlations",
        f"Correlations of the parameters, type {subject.headline.name}",
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


def _parameter_row(told: Headline, name: str, each: Quantity) -> tuple[Cell, ...]:
    symbol, meaning, unit, factor = _described(name)
    shown = estimate((each.value, each.std or None, *_ends(each)), each.std, factor)
    if each.flag is not None:
        shown = (marked(shown[0]), *map(greyed, shown[1:]))
    fixed = name not in told.fit.interval and name != "drag"
    return (symbol, meaning, unit, *shown, "fixed" if fixed else each.flag or "")


def _size_row(told: Headline, each: Size) -> tuple[Cell, ...]:
    size, internal = each.size, each.damping == "internal"
    symbol = "ζ ω^α sin(απ/2)" if internal else "γ ω^λ sin(λπ/2) / (ρ/EI ω²)"
    flag = size.flag
    if each.omega_rad_s is None:
        # Without its frequency a size is the coefficient for an order that was only assumed.
        flag = flag or told.parameters["zeta" if internal else "gamma"].flag
        symbol = symbol[0]
    at = number(each.omega_rad_s, ".4g")
    shown = [
        *estimate((size.value, size.std), size.std),
        number(None if size.std is None else size.std / size.value, "#.2g", 100.0),
        *estimate(_ends(size), size.std),
    ]
    if flag is not None:
        shown = [marked(shown[0]), *map(greyed, shown[1:])]
    return (each.damping, symbol, at, *shown)


def _ends(quantity: Quantity) -> tuple[float | None, float | None]:
    return quantity.interval_95 or (None, None)


def _reasons(quantities: Iterable[Quantity]) -> tuple[str, ...]:
    """Say once what each mark means."""
    reasons = dict.fromkeys(each.flag for each in quantities if each.flag is not None)
    return tuple(f"{MARK} {reason}." for reason in reasons)


def _described(name: str) -> tuple[str, str, str, float]:
    default = (_symbol(name), "stiffness beyond the uniform beam's", "%", 100.0)
    return PARAMETERS.get(name, default)


def _symbol(name: str) -> str:
    if name in PARAMETERS:
        return PARAMETERS[name][0]
    return f"δ{name.rsplit('_', 1)[-1]}"


def _correlation(own: bool, value: float) -> Cell:
    shown = number(value, ".3f")
    if own or abs(value) < _STRONG_CORRELATION:
        return shown
    return replace(shown, strong=True)
