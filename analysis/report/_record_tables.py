"""Tables of a record: modes, parameters, loss factors, damping by amplitude."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.identify.headline import EXACT_CONDITION
from analysis.models import QUANTITIES
from analysis.report._scales import scale_notes
from analysis.report._shown_model import ShownModel
from analysis.report.table import (
    MARK,
    WORDS,
    Cell,
    Column,
    Entry,
    Table,
    count_cell,
    estimate_cells,
    grey_cell,
    mark_cell,
    number_cell,
)
from analysis.statistics import NORMAL_95
from rigd.printable import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from analysis.identify.headline import (
        Estimates,
        Headline,
        ReportedLossFactor,
        ReportedMode,
        ReportedValue,
    )
    from analysis.results import WholeRecord

_STRONG_CORRELATION: Final = 0.9
_MARKED: Final = (
    f"{MARK} not a property of the antenna, for the reason in the remark: do not interpret. The "
    "number only describes the fitted curve."
)


def modes_table(whole: WholeRecord) -> Table:
    """Frequencies, damping ratios and effective inertias; those that are doubtful are marked."""
    headline = whole.headline
    known = any(mode.participation is not None for mode in headline.modes)
    rows: list[tuple[Entry, ...]] = []
    for mode in headline.modes:
        cells = *_mode_cells(mode), *_inertia(mode.participation)
        if mode.damping_ratio.flag is None:
            rows.append((mode.number, *cells, mode.source))
        else:
            rows.append((mark_cell(count_cell(mode.number)), *map(grey_cell, cells), mode.source))
    return Table.of(
        "modes",
        f"Modes with locked hub (clamped–free): {_modes_source(headline)}",
        (
            *_MODE,
            Column("Inertia (kg·mm²)" if known else "", "participation_kg_m2"),
            Column("std" if known else "", "participation_std_kg_m2"),
            Column("Source" if known else "", "source", WORDS),
        ),
        rows,
        (
            "Intervals are statistical only; no torque scale, length or density acts on "
            "frequencies and damping ratios.",
            *_modal_notes(whole),
            *_reasons(mode.damping_ratio for mode in headline.modes),
        ),
    )


def exact_modes_table(whole: WholeRecord) -> Table | None:
    """Modes of a uniform beam that predicts the modal constants; None without one."""
    headline = whole.headline
    test, exact = headline.uniform_beam, headline.exact
    if test is None or exact is None or test.status != "passed":
        return None
    modes = [mode for mode in exact.modes if mode.shown and mode.damping_ratio.flag is None]
    if not modes:
        return None
    return Table.of(
        "exact_geometry_modes",
        f"Modes {EXACT_CONDITION}: type {exact.name}",
        _MODE,
        ((mode.number, *_mode_cells(mode)) for mode in modes),
        ("A condition: narrower than the modal model, and right only if the beam is uniform.",),
    )


_MODE: Final = (
    Column("Mode", "mode"),
    Column("Frequency (Hz)", "frequency_hz"),
    Column("std (Hz)", "frequency_std_hz"),
    Column("Damping ratio (%)", "damping_ratio"),
    Column("std (%)", "damping_ratio_std"),
    Column("95 % from (%)", "damping_ratio_low_95"),
    Column("to (%)", "damping_ratio_high_95"),
)


def _mode_cells(mode: ReportedMode) -> tuple[Cell, ...]:
    """Fill the columns of `_MODE` but for the number."""
    return *_quantity_cells(mode.frequency_hz)[:2], *_quantity_cells(mode.damping_ratio, 100.0)


_SQUARE_MM: Final = 1e6


def _modes_source(headline: Headline) -> str:
    """Name the model that the modes of a headline are of."""
    return (
        "modal model"
        if any(m.source == "modal" for m in headline.modes)
        else f"type {headline.name}"
    )


def _inertia(participation: ReportedValue | None) -> tuple[Cell, Cell]:
    if participation is None:
        return number_cell(None), number_cell(None)
    value, std, *_ = _quantity_cells(participation, _SQUARE_MM)
    return value, std


def _modal_notes(whole: WholeRecord) -> Iterator[str]:
    """Describe the fit of the modal model, and its resonances that are not the beam's."""
    modal = whole.headline.modal
    if modal is None:
        return
    yield (
        "Inertia: effective inertia about the motor axis that takes part in the mode; it is "
        "proportional to the torque scale."
    )
    percent = ShownModel.of(whole.headline, whole.record).fit_percent(whole.analysis)
    yield f"Fit of the modal model {percent:.2f} % (NRMSE)."
    found = [
        f"{frequency_hz:.4g}"
        for mode, frequency_hz in zip(modal.numbers, modal.model.frequencies_hz, strict=True)
        if mode == 0
    ]
    if found:
        yield (
            f"The modal model has a further resonance at {listed(found)} Hz, which is not one of "
            "the beam's (sensor, mount)."
        )


def parameters_table(whole: WholeRecord) -> Table:
    """All parameters with their uncertainty; those with a flag are marked, with the reason.

    Where the file states how well the scales are known, the intervals that include them are shown
    with the statistical ones.
    """
    headline = whole.headline
    combined = whole.combined
    including_scales = (
        Column("", "combined_std"),
        Column("with scales: from", "combined_low_95"),
        Column("to", "combined_high_95"),
    )
    fit = ""
    if headline.tolerant is None:
        fit = f" Fit {whole.analysis.fit_percent(headline.fit):.2f} % (NRMSE)."
    return Table.of(
        "parameters",
        f"Parameters{_condition(headline)}",
        (*_PARAMETER, *(including_scales if combined else ()), _REMARK),
        (
            _parameter_row(name, headline.parameters[name], combined, fixed=_fixed(headline, name))
            for name in parameter_names(headline)
        ),
        (f"{_STD}{fit}", *scale_notes(whole), *((_MARKED,) if headline.flags else ())),
    )


_PARAMETER: Final = (
    Column("Parameter", "parameter", WORDS),
    Column("Meaning", "meaning", WORDS),
    Column("Unit", "unit", WORDS),
    Column("Value", "value"),
    Column("std", "std"),
    Column("95 % from", "low_95"),
    Column("to", "high_95"),
)
_REMARK: Final = Column("Remark", "remark", WORDS)
_STD: Final = (
    "std is one standard deviation; intervals of ρ/EI and EI, and on an exactly uniform beam those "
    "of ζ and γ, are symmetric in the logarithm. The CSV file has SI units."
)


def parameter_names(headline: Headline) -> tuple[str, ...]:
    """Return the names of a headline's parameters: damping, beam, rig."""
    first = () if headline.exact is None else headline.exact.parameters
    return tuple(dict.fromkeys((*(name for name in first if name in headline.parameters),
                                *headline.parameters)))  # fmt: skip


def _condition(headline: Headline) -> str:
    """Describe the condition under which the parameters of a table hold."""
    found = headline.tolerant
    if found is None:
        exact = "" if headline.modal is None else f", {EXACT_CONDITION}"
        return f", type {headline.name}{exact}"
    if found.basis == "geometry":
        percent = 100 * found.uniformity
        return f" if each mode lies where that of a uniform beam does, to {percent:g} %"
    if found.basis == "losses":
        return " by damping ratios and residue phases alone, whatever the positions of the modes"
    return " of the beam that fits the losses best: it does not explain them"


def exact_geometry_table(whole: WholeRecord) -> Table | None:
    """Parameters on condition that the beam is exactly uniform; None where these are reported."""
    exact = whole.headline.exact
    if exact is None:
        return None
    flags = [each.flag for each in exact.parameters.values() if each.flag]
    return Table.of(
        "exact_geometry",
        f"Parameters {EXACT_CONDITION}: type {exact.name}",
        (*_PARAMETER, _REMARK),
        (
            _parameter_row(name, each, {}, fixed=_fixed(whole.headline, name, exact=True))
            for name, each in exact.parameters.items()
        ),
        (
            "A condition, not a result: no antenna is known to be uniform to 1e-5. "
            f"Fit {whole.analysis.fit_percent(whole.fit):.2f} % (NRMSE).",
            *((_MARKED,) if flags else ()),
        ),
    )


def _fixed(headline: Headline, name: str, *, exact: bool = False) -> bool:
    """Whether a parameter was held at a value in the fit that it is of."""
    if headline.tolerant is not None and not exact and name in headline.tolerant.values:
        return False
    return name not in headline.fit.interval and name != "drag"


def sizes_table(whole: WholeRecord) -> Table:
    """Loss factors of either damping where they are uncorrelated with its order."""
    headline = whole.headline
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
        (_size_row(headline, each) for each in headline.sizes),
        (
            "Coefficient and order are strongly correlated; a loss factor is known far better than "
            "either.",
            *_reasons(each.size for each in headline.sizes),
        ),
    )


def condition_table(whole: WholeRecord) -> Table | None:
    """Compare the reported values with those of a simpler structure; None if none suffices."""
    headline: Estimates = whole.headline.exact or whole.headline
    simpler = headline.simpler
    if simpler is None:
        return None
    taken = " and ".join(f"{QUANTITIES[name][0]} = {at:g}" for name, at in simpler.fixed.items())
    rows: list[tuple[Entry, ...]] = []
    for name, each in simpler.parameters.items():
        symbol, _meaning, unit, factor = _described(name)
        free = headline.parameters.get(name)
        rows.append(
            (
                Cell(name, symbol),
                _unit_cell(unit),
                *estimate_cells((each.value, *_ends(each)), each.std, factor),
                *(
                    [number_cell(None)] * 3
                    if free is None
                    else estimate_cells((free.value, *_ends(free)), free.std, factor)
                ),
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
        (
            "The intervals on the left hold only if the assumption is true"
            + (f", and both {EXACT_CONDITION}." if whole.headline.exact else "."),
        ),
    )


def correlations_table(whole: WholeRecord) -> Table:
    """Correlations of the determined parameters of the selected fit."""
    fit = whole.fit
    symbols = [_symbol(name) for name in fit.determined]
    return Table.of(
        "correlations",
        f"Correlations of the parameters on an exactly uniform beam, type {whole.headline.name}",
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
    name: str, each: ReportedValue, combined: Mapping[str, ReportedValue], *, fixed: bool
) -> tuple[Entry, ...]:
    symbol, meaning, unit, factor = _described(name)
    shown = estimate_cells((each.value, each.std or None, *_ends(each)), each.std, factor)
    if combined:
        # A parameter that goes with no scale has the same interval with them.
        both = combined.get(name, each)
        shown += estimate_cells((both.std or None, *_ends(both)), both.std, factor)
    if each.flag is not None:
        shown = (mark_cell(shown[0]), *map(grey_cell, shown[1:]))
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


def _size_row(headline: Headline, each: ReportedLossFactor) -> tuple[Entry, ...]:
    size, internal = each.size, each.damping == "internal"
    symbol = "ζ ω^α sin(απ/2)" if internal else "γ ω^λ sin(λπ/2) / (ρ/EI ω²)"
    flag = size.flag
    if each.omega_rad_s is None:
        # Without its frequency a size is the coefficient for an order that was only assumed.
        flag = flag or headline.parameters["zeta" if internal else "gamma"].flag
        symbol = symbol[0]
    value, std, low, high = _quantity_cells(size)
    relative = number_cell(None if size.std is None else size.std / size.value, "#.2g", 100.0)
    others: tuple[Cell, ...] = (std, relative, low, high)
    if flag is not None:
        value, others = mark_cell(value), tuple(map(grey_cell, others))
    return (each.damping, symbol, each.omega_rad_s, value, *others)


def _quantity_cells(each: ReportedValue, factor: float = 1.0) -> tuple[Cell, ...]:
    """Return the cells of a quantity, its standard deviation and the ends of its interval."""
    return estimate_cells((each.value, each.std, *_ends(each)), each.std, factor)


def _ends(quantity: ReportedValue) -> tuple[float | None, float | None]:
    return quantity.interval_95 or (None, None)


def _reasons(quantities: Iterable[ReportedValue]) -> tuple[str, ...]:
    """List the meaning of each mark once."""
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
    shown = number_cell(value, ".3f")
    if own or abs(value) < _STRONG_CORRELATION:
        return shown
    return replace(shown, strong=True)


def amplitude_tables(whole: WholeRecord) -> tuple[Table, ...]:
    """Return the damping ratios of free vibration by amplitude; no table without them."""
    found = whole.verdict.damping_with_amplitude
    if not found:
        return ()
    rows: list[tuple[Entry, ...]] = []
    for at in found:
        ratio, std, half = at.damping_ratio, at.std, NORMAL_95 * at.std
        shown = estimate_cells((ratio, std, ratio - half, ratio + half), std, 100.0)
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
