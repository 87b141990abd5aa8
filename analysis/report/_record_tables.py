"""Tables of a record: whole-record fits, structures, damping by amplitude; Welch fits."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Final

from analysis.models import QUANTITIES
from analysis.paper import LARGEST_SHIFT
from analysis.report._document import response_fit_percent
from analysis.report._scales import scale_notes
from analysis.report._table import (
    ABSENT,
    MARK,
    WORDS,
    Cell,
    Column,
    Entry,
    Table,
    count,
    estimate,
    footnotes,
    greyed,
    marked,
    number,
    unreported,
)
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from analysis.identify import Headline, Quantity, Size
    from analysis.models import Structure
    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.results import WholeRecord

_STRONG_CORRELATION: Final = 0.9
_MARKED: Final = (
    f"{MARK} not a property of the antenna, for the reason in the remark: do not interpret. The "
    "number only describes the fitted curve."
)


def modes_table(whole: WholeRecord) -> Table:
    """Frequencies and damping ratios; modes that do not show, or are doubtful, are marked."""
    told = whole.headline
    rows: list[tuple[Entry, ...]] = []
    for mode in told.modes:
        f, ratio = mode.frequency_hz, mode.damping_ratio
        cells = (*estimate((f.value, f.std), f.std), *_told(ratio, 100.0))
        if ratio.flag is None:
            rows.append((mode.number, *cells))
        else:
            rows.append((marked(count(mode.number)), *map(greyed, cells)))
    return Table.of(
        "modes",
        f"Modes with locked hub (clamped–free): type {told.name}",
        (
            Column("Mode", "mode"),
            Column("Frequency (Hz)", "frequency_hz"),
            Column("std (Hz)", "frequency_std_hz"),
            Column("Damping ratio (%)", "damping_ratio"),
            Column("std (%)", "damping_ratio_std"),
            Column("95 % from (%)", "damping_ratio_low_95"),
            Column("to (%)", "damping_ratio_high_95"),
        ),
        rows,
        (
            "Intervals are statistical only; no torque scale, length or density acts on "
            "frequencies and damping ratios.",
            *_reasons(mode.damping_ratio for mode in told.modes),
        ),
    )


def parameters_table(whole: WholeRecord) -> Table:
    """All parameters with their uncertainty; those with a flag are marked, with the reason.

    Where the file states how well the scales are known, the intervals that include them stand
    beside the statistical ones.
    """
    told = whole.headline
    combined = whole.combined
    including_scales = (
        Column("", "combined_std"),
        Column("with scales: from", "combined_low_95"),
        Column("to", "combined_high_95"),
    )
    return Table.of(
        "parameters",
        f"Parameters, type {told.name}",
        (
            Column("Parameter", "parameter", WORDS),
            Column("Meaning", "meaning", WORDS),
            Column("Unit", "unit", WORDS),
            Column("Value", "value"),
            Column("std", "std"),
            Column("95 % from", "low_95"),
            Column("to", "high_95"),
            *(including_scales if combined else ()),
            Column("Remark", "remark", WORDS),
        ),
        (_parameter_row(told, name, each, combined) for name, each in told.parameters.items()),
        (
            "std is one standard deviation; intervals of ζ, γ, ρ/EI and EI are symmetric in the "
            f"logarithm. The CSV file has SI units. Fit {whole.analysis.fit_percent(told.fit):.2f} "
            "% (NRMSE).",
            *scale_notes(whole),
            *((_MARKED,) if told.flags else ()),
        ),
    )


def sizes_table(whole: WholeRecord) -> Table:
    """Loss factors of either damping where they are uncorrelated with its order."""
    told = whole.headline
    return Table.of(
        "damping_sizes",
        "Loss factor of either damping at its pivot frequency",
        (
            Column("Damping", "damping", WORDS),
            Column("Quantity", "quantity", WORDS),
            Column("at ω (rad/s)", "omega_rad_s"),
            Column("Value", "value"),
            Column("std", "std"),
            Column("std (%)", "relative_std"),
            Column("95 % from", "low_95"),
            Column("to", "high_95"),
        ),
        (_size_row(told, each) for each in told.sizes),
        (
            "Coefficient and order are strongly correlated; a loss factor is known far better than "
            "either.",
            *_reasons(each.size for each in told.sizes),
        ),
    )


def condition_table(whole: WholeRecord) -> Table | None:
    """Set what a simpler structure would give beside what is told; None if none would do."""
    told, simpler = whole.headline, whole.headline.simpler
    if simpler is None:
        return None
    taken = " and ".join(f"{QUANTITIES[name][0]} = {at:g}" for name, at in simpler.fixed.items())
    rows: list[tuple[Entry, ...]] = []
    for name, each in simpler.parameters.items():
        symbol, _meaning, unit, factor = _described(name)
        free = told.parameters[name]
        rows.append(
            (
                Cell(name, symbol),
                _unit_cell(unit),
                *estimate((each.value, *_ends(each)), each.std, factor),
                *estimate((free.value, *_ends(free)), free.std, factor),
            )
        )
    return Table.of(
        "on_condition",
        f"If {taken or 'the rest'} is assumed: type {simpler.name} (sufficient)",
        (
            Column("Parameter", "parameter", WORDS),
            Column("Unit", "unit", WORDS),
            Column("Assumed", "value"),
            Column("95 % from", "low_95"),
            Column("to", "high_95"),
            Column("Free", "free_value"),
            Column("95 % from", "free_low_95"),
            Column("to", "free_high_95"),
        ),
        rows,
        ("The intervals on the left hold only if the assumption is true.",),
    )


def correlations_table(whole: WholeRecord) -> Table:
    """Correlations of the determined parameters of the selected fit."""
    fit = whole.fit
    symbols = [_symbol(name) for name in fit.determined]
    return Table.of(
        "correlations",
        f"Correlations of the parameters, type {whole.headline.name}",
        (
            Column("Parameter", "parameter", WORDS),
            *(Column(symbol, name) for symbol, name in zip(symbols, fit.determined, strict=True)),
        ),
        (
            (Cell(name, symbol), *(_correlation(i == j, value) for j, value in enumerate(row)))
            for i, (name, symbol, row) in enumerate(
                zip(fit.determined, symbols, fit.correlation.tolist(), strict=True)
            )
        ),
        ("For ζ, γ, ρ/EI and EI, of their logarithms. Bold: 0.9 or more.",),
    )


def _parameter_row(
    told: Headline, name: str, each: Quantity, combined: Mapping[str, Quantity]
) -> tuple[Entry, ...]:
    symbol, meaning, unit, factor = _described(name)
    shown = estimate((each.value, each.std or None, *_ends(each)), each.std, factor)
    if combined:
        # A parameter that goes with no scale has the same interval with them.
        both = combined.get(name, each)
        shown += estimate((both.std or None, *_ends(both)), both.std, factor)
    if each.flag is not None:
        shown = (marked(shown[0]), *map(greyed, shown[1:]))
    fixed = name not in told.fit.interval and name != "drag"
    return (
        Cell(name, symbol),
        meaning,
        _unit_cell(unit),
        *shown,
        "fixed" if fixed else each.flag or "",
    )


_SI: Final = {"µs": "s", "ms": "s", "g": "kg", "mm": "m", "ppm": "1", "%": "1"}


def _unit_cell(shown: str) -> Cell:
    """Show a unit; for programs it is the SI unit, which their numbers have."""
    power, _, unit = shown.rpartition(" ")
    return Cell(_SI.get(shown, unit if power.startswith("1e") else shown), shown)


def _size_row(told: Headline, each: Size) -> tuple[Entry, ...]:
    size, internal = each.size, each.damping == "internal"
    symbol = "ζ ω^α sin(απ/2)" if internal else "γ ω^λ sin(λπ/2) / (ρ/EI ω²)"
    flag = size.flag
    if each.omega_rad_s is None:
        # Without its frequency a size is the coefficient for an order that was only assumed.
        flag = flag or told.parameters["zeta" if internal else "gamma"].flag
        symbol = symbol[0]
    value, std, low, high = _told(size)
    relative = number(None if size.std is None else size.std / size.value, "#.2g", 100.0)
    others: tuple[Cell, ...] = (std, relative, low, high)
    if flag is not None:
        value, others = marked(value), tuple(map(greyed, others))
    return (each.damping, symbol, each.omega_rad_s, value, *others)


def _told(each: Quantity, factor: float = 1.0) -> tuple[Cell, ...]:
    """Show a quantity, its standard deviation and the ends of its interval."""
    return estimate((each.value, each.std, *_ends(each)), each.std, factor)


def _ends(quantity: Quantity) -> tuple[float | None, float | None]:
    return quantity.interval_95 or (None, None)


def _reasons(quantities: Iterable[Quantity]) -> tuple[str, ...]:
    """Say once what each mark means."""
    reasons = dict.fromkeys(each.flag for each in quantities if each.flag is not None)
    return tuple(f"{MARK} {reason}." for reason in reasons)


def _described(name: str) -> tuple[str, str, str, float]:
    default = (_symbol(name), "stiffness beyond the uniform beam's", "%", 100.0)
    return QUANTITIES.get(name, default)


def _symbol(name: str) -> str:
    if name in QUANTITIES:
        return QUANTITIES[name][0]
    return f"δ{name.rsplit('_', 1)[-1]}"


def _correlation(own: bool, value: float) -> Cell:
    shown = number(value, ".3f")
    if own or abs(value) < _STRONG_CORRELATION:
        return shown
    return replace(shown, strong=True)


_DAMPING: Final = ("zeta", "alpha", "gamma", "lambda")
_ON_THE_EDGE: Final = "* at the limit of the search range: not determined by the data."


def structures_table(whole: WholeRecord) -> Table:
    """All fits beside each other; orders that the data do not support are marked in each."""
    lowest = min(fit.cost for fit in whole.fits.values())
    withheld = whole.unsupported
    delta_bic = whole.delta_bic
    status = dict(whole.headline.structures)
    rows: list[tuple[Entry, ...]] = []
    for name, fit in whole.fits.items():
        its = status.get(name, "")
        damping = _damping_cells(
            fit.structure, fit.parameters, fit.std, withheld=withheld, at_bounds=fit.at_bounds
        )
        rows.append(
            (
                name,
                its,
                *(map(_left_out, damping) if its == "excluded" else damping),
                *([delta_bic[name]] if delta_bic else []),
                whole.analysis.fit_percent(fit),
                fit.cost / fit.degrees_of_freedom,
                fit.free_parameters,
                fit.cost,
                fit.cost - lowest,
                fit.degrees_of_freedom,
                " ".join(sorted(unreported(fit.structure, withheld))),
            )
        )
    return Table.of(
        "structures",
        "All structures on the whole record",
        (
            Column("Type", "type", WORDS),
            Column("", "status", WORDS),
            *_damping_columns(),
            *([Column("ΔBIC", "delta_bic")] if delta_bic else []),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            Column("Residual", "cost_per_degree_of_freedom"),
            Column("Free", "free_parameters"),
            Column("", "cost"),
            Column("", "cost_above_lowest"),
            Column("", "degrees_of_freedom"),
            Column("", "not_reported", WORDS),
        ),
        rows,
        (
            *footnotes(withheld),
            "ΔBIC: Bayesian information criterion above the lowest; 10 = decisive. Fit: NRMSE "
            "of the torque in the band, 100 (1 − ‖y − ŷ‖ / ‖y − mean of y‖). Residual: its power "
            "over that of the noise, 1 if nothing but noise is left. Free: number of free "
            "parameters, those of rig and beam included. * rests on the edge of the range "
            "searched. The marked row is the one reported. What the record excludes "
            "has numbers in the CSV file only, beside the sums of squares.",
        ),
        selected=list(whole.fits).index(whole.headline.name),
    )


def _left_out(cell: Cell) -> Cell:
    """Keep a number for programs only."""
    return cell if cell.value is None else replace(cell, text=ABSENT, doubtful=True)


def _damping_columns() -> list[Column]:
    """Value and standard deviation of each parameter of the damping."""
    return [
        column
        for name in _DAMPING
        for column in (
            Column(_heading(name), name), Column("std", f"{name}_std", spread=True),
        )
    ]  # fmt: skip


def _damping_cells(
    structure: Structure,
    parameters: Mapping[str, float],
    std: Mapping[str, float | None] | None,
    *,
    withheld: Collection[str] = (),
    at_bounds: Collection[str] = (),
) -> list[Cell]:
    """Fill these columns: what is fixed has no standard deviation, what is absent has a dash."""
    doubtful = unreported(structure, withheld)
    shown: list[Cell] = []
    for name in _DAMPING:
        if not structure.has(name):
            shown += [number(None), number(None)]
            continue
        its_std = std[name] if std is not None and name in structure.free else None
        value, spread = estimate((parameters[name], its_std), its_std, QUANTITIES[name][3])
        if name in at_bounds:
            value = replace(value, text=f"{value.text}*")
        shown += [marked(value), greyed(spread)] if name in doubtful else [value, spread]
    return shown


def _heading(name: str) -> str:
    """Symbol with its power of ten; the units, which depend on the orders, would be too long."""
    symbol, _meaning, unit, factor = QUANTITIES[name]
    return symbol if factor == 1.0 else f"{symbol} ({unit.split()[0]})"


_NAMES: Final = (Column("Type", "type", WORDS), Column("Weights", "weighting", WORDS))
_INDICES: Final = ("mse", "wmse", "md")
_INDEX_UNITS: Final = "MSE and WMSE in (N·m/rad)², MD in N·m/rad."


def welch_fits_table(analysis: WelchAnalysis, withheld: Collection[str] = ()) -> Table:
    """Parameters and indices of every Welch fit.

    Parameters
    ----------
    analysis : WelchAnalysis
    withheld : collection of str
        Orders that the whole record does not support: they are marked.
    """
    fits = [model.fit for model in analysis.models]
    return Table.of(
        "welch_fits",
        "Fits to Welch's estimate, as in the paper",
        (
            *_NAMES,
            *_damping_columns(),
            Column("Fit (%)", "nrmse_percent", ".2f"),
            *(Column(name.upper(), name) for name in _INDICES),
        ),
        (
            (
                *_names(model),
                *_damping_cells(
                    fit.structure, fit.parameters, fit.std, withheld=withheld,
                    at_bounds=fit.at_bounds,
                ),
                response_fit_percent(analysis, model),
                *(getattr(model.indices, name) for name in _INDICES),
            )
            for fit, model in zip(fits, analysis.models, strict=True)
        ),
        (
            *footnotes(withheld),
            f"Fit: NRMSE of the complex response in the band. {_INDEX_UNITS} std (±): one standard "
            "deviation, from the scatter of the response about the model. The bias of Welch's "
            "estimate on a chirp, which the window smears at the resonances, is not in it and is "
            "often larger: whole-record fits do not have it.",
            *([_ON_THE_EDGE] if any(fit.at_bounds for fit in fits) else []),
        ),
        grouped=True,
    )  # fmt: skip


def summary_table(analyses: Sequence[WelchAnalysis]) -> Table:
    """Mean and standard deviation over the files of each fit's parameters and indices."""
    rows: list[tuple[Entry, ...]] = []
    for models in zip(*(analysis.models for analysis in analyses), strict=True):
        fits = [model.fit for model in models]
        parameters, indices = (
            {key: [values[key] for values in of_files] for key in keys}
            for keys, of_files in (
                (_DAMPING, [fit.parameters for fit in fits]),
                (_INDICES, [asdict(model.indices) for model in models]),
            )
        )
        rows.append(
            (
                *_names(models[0]),
                *_damping_cells(
                    fits[0].structure,
                    {name: fmean(values) for name, values in parameters.items()},
                    {name: _stdev(values) for name, values in parameters.items()},
                ),
                *(
                    cell
                    for values in indices.values()
                    for cell in estimate((fmean(values), _stdev(values)), _stdev(values))
                ),
            )
        )
    return Table.of(
        "welch_summary",
        f"Mean ± standard deviation over {len(analyses)} files",
        (
            *_NAMES,
            *_damping_columns(),
            *(
                column
                for name in _INDICES
                for column in (
                    Column(name.upper(), name), Column("std", f"{name}_std", spread=True),
                )
            ),
        ),
        rows,
        (_INDEX_UNITS,),
        grouped=True,
    )  # fmt: skip


def _stdev(values: list[float]) -> float:
    return stdev(values) if len(values) > 1 else math.nan


def _names(model: FittedModel) -> tuple[str, str]:
    return model.fit.structure.name, model.fit.weighting


def peaks_table(analysis: WelchAnalysis) -> Table:
    """Measured resonant peaks, and by how much those of each model lie off them."""
    modes = range(1, len(analysis.peaks) + 1)
    measured = (
        *(2 * math.pi * p.frequency_hz if p else None for p in analysis.peaks),
        *(p.magnitude_db if p else None for p in analysis.peaks),
    )
    return Table.of(
        "welch_peaks",
        "Resonant peaks of Welch's estimate, and deviations of the models' peaks from them",
        (
            *_NAMES,
            *(Column(f"ω{n} (rad/s)", f"omega_{n}_rad_s", ".3f") for n in modes),
            *(Column(f"M{n} (dB)", f"magnitude_{n}_db", ".3f") for n in modes),
        ),
        (
            ("measured", "", *measured),
            *(
                (
                    *_names(model),
                    *(d.frequency_rad_s if d else None for d in model.deviations),
                    *(d.magnitude_db if d else None for d in model.deviations),
                )
                for model in analysis.models
            ),
        ),
        ("First row: the peaks; below: absolute deviations, as in the paper's Table 4.",),
        selected=0,
        grouped=True,
    )


_LEFT: Final = "‡"


def welch_modes_table(analysis: WelchAnalysis) -> Table | None:
    """Frequencies and damping ratios of the modes from each model's poles; None without any.

    What is not the antenna's is marked, or left out.
    """
    models = analysis.models
    modes = max((len(model.modes) for model in models), default=0)
    if not modes:
        return None

    def cells(model: FittedModel, name: str, form: str, factor: float = 1.0) -> list[Cell]:
        made = []
        for mode, followed in zip(model.modes, model.followed, strict=True):
            cell = number(getattr(mode, name) if mode.damping_ratio < 1 else None, form, factor)
            if cell.value is not None and not followed:
                cell = greyed(replace(cell, text=cell.text + _LEFT))
            made.append(cell)
        return made or [number(None)] * modes

    shown = [each for model in models for each in zip(model.modes, model.followed, strict=True)]
    vibrates = [mode.damping_ratio < 1 for mode, _ in shown]
    notes = ["From the poles of the fitted model; ξ is the damping ratio."]
    if any(not followed and mode.damping_ratio < 1 for mode, followed in shown):
        notes.append(
            f"{_LEFT} more than {100 * LARGEST_SHIFT:g} % off the undamped beam's: the fit does "
            "not follow this resonance. The number only describes the fitted curve."
        )
    if not all(vibrates) or not all(model.modes for model in models):
        notes.append(f"{ABSENT} overdamped in this fit.")
    return Table.of(
        "welch_modes",
        "Modes of the fits to Welch's estimate",
        (
            *_NAMES,
            *(Column(f"f{n} (Hz)", f"frequency_{n}_hz") for n in range(1, modes + 1)),
            *(Column(f"ξ{n} (%)", f"damping_ratio_{n}") for n in range(1, modes + 1)),
        ),
        (
            (
                *_names(model),
                *cells(model, "frequency_hz", ".4f"),
                *cells(model, "damping_ratio", ".4g", 100.0),
            )
            for model in models
        ),
        notes,
        grouped=True,
    )


def amplitude_tables(whole: WholeRecord) -> tuple[Table, ...]:
    """Damping ratios of free vibration by amplitude, if the record tells; else no table."""
    found = whole.verdict.damping_with_amplitude
    if not found:
        return ()
    rows: list[tuple[Entry, ...]] = []
    for at in found:
        ratio, std, half = at.damping_ratio, at.std, NORMAL_95 * at.std
        shown = estimate((ratio, std, ratio - half, ratio + half), std, 100.0)
        rows.append((at.mode, at.tip_amplitude_m, *shown))
    return (
        Table.of(
            "damping_with_amplitude",
            "Damping of free vibration against the amplitude, air drag included",
            (
                Column("Mode", "mode"),
                Column("Tip amplitude (mm)", "tip_amplitude_m", ".3g", 1e3),
                Column("Damping ratio (%)", "damping_ratio"),
                Column("std (%)", "damping_ratio_std"),
                Column("95 % from (%)", "damping_ratio_low_95"),
                Column("to (%)", "damping_ratio_high_95"),
            ),
            rows,
            ("Amplitude 0 is the beam without air, as in the table of the modes.",),
        ),
    )
