"""Tables of a record: whole-record fits, structures, Welch fits, damping by amplitude."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.report._bands import NORMAL_95
from analysis.report._table import (
    ABSENT,
    MARK,
    Cell,
    Column,
    Number,
    Table,
    count,
    estimate,
    footnotes,
    greyed,
    marked,
    number,
    unreported,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from analysis.identify import Headline, Quantity, RecordFit, Size
    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.results import Subject

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


_DAMPING = ("zeta", "alpha", "gamma", "lambda")


def structures_table(subject: Subject) -> Table:
    """All fits beside each other; orders that the data do not support are marked in each."""
    lowest = min(fit.cost for fit in subject.fits.values())
    withheld = subject.unsupported
    delta_bic = subject.verdict.delta_bic
    status = dict(subject.headline.structures)
    rows: list[tuple[Cell, ...]] = []
    for name, fit in subject.fits.items():
        its = status.get(name, "")
        rows.append(
            (
                name,
                its,
                *_damping(fit, withheld, excluded=its == "excluded"),
                *([number(delta_bic[name], ".4g")] if delta_bic else []),
                number(fit.cost / fit.degrees_of_freedom, ".4g"),
                count(fit.free_parameters),
                number(fit.cost),
                number(fit.cost - lowest),
                count(fit.degrees_of_freedom),
                " ".join(sorted(unreported(fit.structure, withheld))),
            )
        )
    return Table(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", numeric=False),
            Column("", "status", numeric=False),
            *(
                column
                for parameter in _DAMPING
                for column in (
                    Column(_heading(parameter), parameter),
                    Column("std", f"{parameter}_std"),
                )
            ),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Residual", "cost_per_degree_of_freedom"),
            Column("Free", "free_parameters"),
            Column("", "cost"),
            Column("", "cost_above_lowest"),
            Column("", "degrees_of_freedom"),
            Column("", "not_reported", numeric=False),
        ),
        tuple(rows),
        (
            *footnotes(withheld),
            "ΔBIC: Bayesian information criterion above the lowest; 10 is clear. Residual: its "
            "power over that of the noise, 1 if nothing but noise is left. Free: number of free "
            "parameters, those of rig and beam included. * rests on the edge of the range "
            "searched. The marked row is the one that the numbers are of. What the record excludes "
            "has numbers in the CSV file only, beside the sums of squares.",
        ),
        selected=list(subject.fits).index(subject.headline.name),
    )


def _damping(fit: RecordFit, withheld: Collection[str], *, excluded: bool) -> list[Number]:
    """Value and standard deviation of each parameter of the damping."""
    doubtful = unreported(fit.structure, withheld)
    shown: list[Number] = []
    for name in _DAMPING:
        if not fit.structure.has(name):
            shown += [number(None), number(None)]
            continue
        std = fit.std[name]
        free = name in fit.structure.free
        cells = estimate((fit.parameters[name], std if free else None), std, PARAMETERS[name][3])
        held = "*" if name in fit.at_bounds else ""
        value, spread = replace(cells[0], text=cells[0].text + held), cells[1]
        if excluded:
            shown += [replace(each, text=ABSENT, doubtful=True) for each in (value, spread)]
            continue
        shown += [marked(value), greyed(spread)] if name in doubtful else [value, spread]
    return shown


def _heading(name: str) -> str:
    """Symbol with its power of ten; the units, which depend on the orders, would be too long."""
    symbol, _meaning, unit, factor = PARAMETERS[name]
    return symbol if factor == 1.0 else f"{symbol} ({unit.split()[0]})"


_FACTORS = {"zeta": 1e5, "alpha": 1.0, "gamma": 1e2, "lambda": 1.0}
_HEADINGS = {"zeta": "ζ (1e-5)", "alpha": "α", "gamma": "γ (1e-2)", "lambda": "λ"}
_COEFFICIENT = {"zeta": "zeta", "alpha": "zeta", "gamma": "gamma", "lambda": "gamma"}


def welch_fits_table(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> Table:
    """Parameters and indices of every fit of the paper's route.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    return Table(
        "welch_fits",
        "Fits to Welch's estimate, as in the paper",
        (
            Column("Type", "type", numeric=False),
            Column("Weights", "weighting", numeric=False),
            *(
                column
                for name, heading in _HEADINGS.items()
                for column in (Column(heading, name), Column("std", f"{name}_std"))
            ),
            Column("MSE", "mse"),
            Column("WMSE", "wmse"),
            Column("MD", "md"),
        ),
        tuple(_fit_row(model, withheld) for model in analysis.models),
        (
            *footnotes(withheld),
            "MSE and WMSE in (N·m/rad)², MD in N·m/rad. std is the scatter of the measured "
            "response about the model. The bias of Welch's estimate on a chirp, which the window "
            "smears at the resonances, is not in it and is often larger: the whole-record fits "
            "above do not have it.",
        ),
    )


def peaks_table(analysis: WelchAnalysis) -> Table:
    """Measured resonant peaks, and by how much those of each model lie off them."""
    count = len(analysis.peaks)
    measured: tuple[Cell, ...] = (
        "measured",
        "",
        *(number(2 * math.pi * p.frequency_hz if p else None, ".3f") for p in analysis.peaks),
        *(number(p.magnitude_db if p else None, ".3f") for p in analysis.peaks),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            model.fit.structure.name,
            model.fit.weighting,
            *(number(d.frequency_rad_s if d else None, ".3f") for d in model.deviations),
            *(number(d.magnitude_db if d else None, ".3f") for d in model.deviations),
        )
        for model in analysis.models
    ]
    return Table(
        "welch_peaks",
        "Resonant peaks of Welch's estimate, and deviations of the models' peaks from them",
        (
            Column("Type", "type", numeric=False),
            Column("Weights", "weighting", numeric=False),
            *(Column(f"ω{n} (rad/s)", f"omega_{n}_rad_s") for n in range(1, count + 1)),
            *(Column(f"M{n} (dB)", f"magnitude_{n}_db") for n in range(1, count + 1)),
        ),
        (measured, *rows),
        ("First row: the peaks; below: absolute deviations, as in the paper's Table 4.",),
    )


def _fit_row(model: FittedModel, withheld: Collection[str]) -> tuple[Cell, ...]:
    fit = model.fit
    doubtful = unreported(fit.structure, withheld)
    shown: list[Cell] = []
    for name, factor in _FACTORS.items():
        cells: tuple[Number, ...] = (number(None), number(None))
        if name in fit.structure.free:
            std = None if fit.std is None else fit.std[name]
            cells = estimate((fit.parameters[name], std), std, factor)
        elif _COEFFICIENT[name] in fit.structure.free:
            cells = (number(fit.parameters[name], "g", factor), number(None))
        shown += (marked(cells[0]), greyed(cells[1])) if name in doubtful else cells
    indices = model.indices
    return (
        fit.structure.name,
        fit.weighting,
        *shown,
        *(number(value) for value in (indices.mse, indices.wmse, indices.md)),
    )


def amplitude_tables(subject: Subject) -> tuple[Table, ...]:
    """Damping ratios of free vibration by amplitude, if the record tells; else no table."""
    found = subject.verdict.damping_with_amplitude
    if not found:
        return ()
    rows = tuple(
        (
            count(at.mode),
            number(at.tip_amplitude_m, ".3g", 1e3),
            *estimate(
                (
                    at.damping_ratio,
                    at.std,
                    at.damping_ratio - NORMAL_95 * at.std,
                    at.damping_ratio + NORMAL_95 * at.std,
                ),
                at.std,
                100.0,
            ),
        )
        for at in found
    )
    return (
        Table(
            "damping_with_amplitude",
            "Damping of free vibration against the amplitude, air drag included",
            (
                Column("Mode", "mode"),
                Column("Tip amplitude (mm)", "tip_amplitude_m"),
                Column("Damping ratio (%)", "damping_ratio"),
                Column("std (%)", "damping_ratio_std"),
                Column("95 % from (%)", "damping_ratio_low"),
                Column("to (%)", "damping_ratio_high"),
            ),
            rows,
            ("Amplitude 0 is the beam without air, as in the table of the modes.",),
        ),
    )
