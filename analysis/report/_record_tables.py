"""Tables of one record: modes, parameters, loss factors, and damping by amplitude."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.models import QUANTITIES
from analysis.report._scales import scale_notes
from analysis.report._shown_model import ShownModel
from analysis.report.table import (
    NOT_REPORTED_MARK,
    TEXT_FORMAT,
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
"""Least magnitude of a correlation of two parameters that is shown in bold."""
_MARK_NOTE: Final = (
    f"{NOT_REPORTED_MARK} not a property of the antenna, for the reason in the remark: do not "
    "interpret. The number only describes the fitted curve."
)
"""Note that explains the mark of flagged parameters."""


def modes_table(whole_record: WholeRecord) -> Table:
    """Return the table of modes: frequencies, damping ratios and effective inertias.

    Modes with a doubtful damping ratio are marked.
    """
    headline = whole_record.headline
    has_inertias = any(mode.participation is not None for mode in headline.modes)
    rows: list[tuple[Entry, ...]] = []
    for mode in headline.modes:
        cells = *_mode_cells(mode), *_inertia_cells(mode.participation)
        if mode.damping_ratio.flag is None:
            rows.append((mode.number, *cells, mode.source))
        else:
            rows.append((mark_cell(count_cell(mode.number)), *map(grey_cell, cells), mode.source))
    return Table.of(
        "modes",
        f"Modes with locked hub (clamped–free): {_modes_source(headline)}",
        (
            *_MODE_COLUMNS,
            Column("Inertia (kg·mm²)" if has_inertias else "", "participation_kg_m2"),
            Column("std" if has_inertias else "", "participation_std_kg_m2"),
            Column("Source" if has_inertias else "", "source", TEXT_FORMAT),
        ),
        rows,
        (
            "Intervals are statistical only; no torque scale, length or density acts on "
            "frequencies and damping ratios.",
            *_modal_notes(whole_record),
            *_reason_notes(mode.damping_ratio for mode in headline.modes),
        ),
    )


def exact_modes_table(whole_record: WholeRecord) -> Table | None:
    """Return the table of a uniform beam's modes; None if no such beam explains the record."""
    headline = whole_record.headline
    test, exact_estimates = headline.uniform_beam, headline.exact
    if test is None or exact_estimates is None or test.status != "passed":
        return None
    modes = [
        mode for mode in exact_estimates.modes if mode.shown and mode.damping_ratio.flag is None
    ]
    if not modes:
        return None
    return Table.of(
        "exact_geometry_modes",
        f"Modes {EXACTLY_UNIFORM_CONDITION}: type {exact_estimates.name}",
        _MODE_COLUMNS,
        ((mode.number, *_mode_cells(mode)) for mode in modes),
        ("A condition: narrower than the modal model, and right only if the beam is uniform.",),
    )


_MODE_COLUMNS: Final = (
    Column("Mode", "mode"),
    Column("Frequency (Hz)", "frequency_hz"),
    Column("std (Hz)", "frequency_std_hz"),
    Column("Damping ratio (%)", "damping_ratio"),
    Column("std (%)", "damping_ratio_std"),
    Column("95 % from (%)", "damping_ratio_low_95"),
    Column("to (%)", "damping_ratio_high_95"),
)
"""Columns of a mode's frequency and damping ratio with their uncertainties."""


def _mode_cells(mode: ReportedMode) -> tuple[Cell, ...]:
    """Return the cells of a mode's frequency and damping ratio, without the mode's number."""
    return *_quantity_cells(mode.frequency_hz)[:2], *_quantity_cells(mode.damping_ratio, 100.0)


_SQUARE_MM_PER_SQUARE_M: Final = 1e6
"""Number of square millimetres in a square metre."""


def _modes_source(headline: Headline) -> str:
    """Return the name of the model from which the reported modes are computed."""
    return (
        "modal model"
        if any(m.source == "modal" for m in headline.modes)
        else f"type {headline.name}"
    )


def _inertia_cells(participation: ReportedValue | None) -> tuple[Cell, Cell]:
    """Return the cells of a mode's effective inertia and of its standard deviation."""
    if participation is None:
        return number_cell(None), number_cell(None)
    value, std, *_ = _quantity_cells(participation, _SQUARE_MM_PER_SQUARE_M)
    return value, std


def _modal_notes(whole_record: WholeRecord) -> Iterator[str]:
    """Yield notes on the fit of the modal model and on its resonances that are not the beam's."""
    modal_fit = whole_record.headline.modal
    if modal_fit is None:
        return
    yield (
        "Inertia: effective inertia about the motor axis that takes part in the mode; it is "
        "proportional to the torque scale."
    )
    percent = ShownModel.of(whole_record.headline, whole_record.record).fit_percent(
        whole_record.analysis
    )
    yield f"Fit of the modal model {percent:.2f} % (NRMSE)."
    further_hz = [
        f"{frequency_hz:.4g}"
        for mode, frequency_hz in zip(
            modal_fit.numbers, modal_fit.model.frequencies_hz, strict=True
        )
        if mode == 0
    ]
    if further_hz:
        yield (
            f"The modal model has a further resonance at {listed(further_hz)} Hz, which is not one "
            "of the beam's (sensor, mount)."
        )


def parameters_table(whole_record: WholeRecord) -> Table:
    """Return the table of all parameters with uncertainties; flagged ones are marked.

    If the file states the uncertainties of the scales, the table also contains intervals that
    include them. The last column states the reason for a mark.
    """
    headline = whole_record.headline
    values_with_scales = whole_record.combined
    including_scales = (
        Column("", "combined_std"),
        Column("with scales: from", "combined_low_95"),
        Column("to", "combined_high_95"),
    )
    fit_note = ""
    if headline.tolerant is None:
        fit_note = f" Fit {whole_record.analysis.fit_percent(headline.fit):.2f} % (NRMSE)."
    return Table.of(
        "parameters",
        f"Parameters{_condition_text(headline)}",
        (*_PARAMETER_COLUMNS, *(including_scales if values_with_scales else ()), _REMARK_COLUMN),
        (
            _parameter_row(
                name,
                headline.parameters[name],
                values_with_scales,
                is_fixed=_is_fixed(headline, name),
            )
            for name in parameter_names(headline)
        ),
        (
            f"{_UNCERTAINTY_NOTE}{fit_note}",
            *scale_notes(whole_record),
            *((_MARK_NOTE,) if headline.flags else ()),
        ),
    )


_PARAMETER_COLUMNS: Final = (
    Column("Parameter", "parameter", TEXT_FORMAT),
    Column("Meaning", "meaning", TEXT_FORMAT),
    Column("Unit", "unit", TEXT_FORMAT),
    Column("Value", "value"),
    Column("std", "std"),
    Column("95 % from", "low_95"),
    Column("to", "high_95"),
)
"""Columns of a parameter: symbol, meaning, unit, value and uncertainty."""
_REMARK_COLUMN: Final = Column("Remark", "remark", TEXT_FORMAT)
"""Column with the reason for a parameter's mark."""
_UNCERTAINTY_NOTE: Final = (
    "std is one standard deviation; intervals of ρ/EI and EI, and on an exactly uniform beam those "
    "of ζ and γ, are symmetric in the logarithm. The CSV file has SI units."
)
"""Note on standard deviations and intervals."""


def parameter_names(headline: Headline) -> tuple[str, ...]:
    """Return the names of the reported parameters in the order damping, beam, rig."""
    exact_parameters = () if headline.exact is None else headline.exact.parameters
    return tuple(dict.fromkeys((*(name for name in exact_parameters if name in headline.parameters),
                                *headline.parameters)))  # fmt: skip


def _condition_text(headline: Headline) -> str:
    """Return the condition under which a table's parameters hold, for the table's caption."""
    tolerant_estimate = headline.tolerant
    if tolerant_estimate is None:
        exact = "" if headline.modal is None else f", {EXACTLY_UNIFORM_CONDITION}"
        return f", type {headline.name}{exact}"
    if tolerant_estimate.basis == "geometry":
        percent = 100 * tolerant_estimate.uniformity
        return f" if each mode lies where that of a uniform beam does, to {percent:g} %"
    if tolerant_estimate.basis == "losses":
        return " by damping ratios and residue phases alone, whatever the positions of the modes"
    return " of the beam that fits the losses best: it does not explain them"


def exact_geometry_table(whole_record: WholeRecord) -> Table | None:
    """Return the table of an exactly uniform beam's parameters.

    It is None if the main table shows these parameters.
    """
    exact_estimates = whole_record.headline.exact
    if exact_estimates is None:
        return None
    flags = [parameter.flag for parameter in exact_estimates.parameters.values() if parameter.flag]
    return Table.of(
        "exact_geometry",
        f"Parameters {EXACTLY_UNIFORM_CONDITION}: type {exact_estimates.name}",
        (*_PARAMETER_COLUMNS, _REMARK_COLUMN),
        (
            _parameter_row(
                name, parameter, {}, is_fixed=_is_fixed(whole_record.headline, name, exact=True)
            )
            for name, parameter in exact_estimates.parameters.items()
        ),
        (
            "A condition, not a result: no antenna is known to be uniform to 1e-5. "
            f"Fit {whole_record.analysis.fit_percent(whole_record.fit):.2f} % (NRMSE).",
            *((_MARK_NOTE,) if flags else ()),
        ),
    )


def _is_fixed(headline: Headline, name: str, *, exact: bool = False) -> bool:
    """Return whether a parameter was held at a fixed value in its fit."""
    if headline.tolerant is not None and not exact and name in headline.tolerant.values:
        return False
    return name not in headline.fit.interval and name != "drag"


def loss_factors_table(whole_record: WholeRecord) -> Table:
    """Return the table of internal and external loss factors at their pivot frequencies.

    There, the loss factor is not correlated with the order of the damping.
    """
    headline = whole_record.headline
    return Table.of(
        "damping_sizes",
        "Loss factor of either damping at its pivot frequency",
        (
            Column("Damping", "damping", TEXT_FORMAT),
            Column("Quantity", "quantity", TEXT_FORMAT),
            Column("at ω (rad/s)", "omega_rad_s"),
            Column("Value", "value"),
            Column("std", "std"),
            Column("std (%)", "relative_std"),
            Column("95 % from", "low_95"),
            Column("to", "high_95"),
        ),
        (_loss_factor_row(headline, loss_factor) for loss_factor in headline.sizes),
        (
            "Coefficient and order are strongly correlated; a loss factor is known far better than "
            "either.",
            *_reason_notes(loss_factor.size for loss_factor in headline.sizes),
        ),
    )


def simpler_structure_table(whole_record: WholeRecord) -> Table | None:
    """Return the table that compares reported values with a simpler structure's.

    It is None if no simpler structure is sufficient.
    """
    headline: Estimates = whole_record.headline.exact or whole_record.headline
    simpler_estimates = headline.simpler
    if simpler_estimates is None:
        return None
    assumption = " and ".join(
        f"{QUANTITIES[name][0]} = {at:g}" for name, at in simpler_estimates.fixed.items()
    )
    rows: list[tuple[Entry, ...]] = []
    for name, value in simpler_estimates.parameters.items():
        symbol, _meaning, unit, factor = _parameter_description(name)
        free_value = headline.parameters.get(name)
        rows.append(
            (
                Cell(name, symbol),
                _unit_cell(unit),
                *estimate_cells((value.value, *_interval_ends(value)), value.std, factor),
                *(
                    [number_cell(None)] * 3
                    if free_value is None
                    else estimate_cells(
                        (free_value.value, *_interval_ends(free_value)), free_value.std, factor
                    )
                ),
            )
        )
    return Table.of(
        "on_condition",
        f"If {assumption or 'the rest'} is assumed: type {simpler_estimates.name} (sufficient)",
        (
            Column("Parameter", "parameter", TEXT_FORMAT),
            Column("Unit", "unit", TEXT_FORMAT),
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
            + (f", and both {EXACTLY_UNIFORM_CONDITION}." if whole_record.headline.exact else "."),
        ),
    )


def correlations_table(whole_record: WholeRecord) -> Table:
    """Return the table of correlations between the determined parameters of the selected fit."""
    fit = whole_record.fit
    symbols = [_parameter_symbol(name) for name in fit.determined]
    return Table.of(
        "correlations",
        "Correlations of the parameters on an exactly uniform beam, "
        f"type {whole_record.headline.name}",
        (
            Column("Parameter", "parameter", TEXT_FORMAT),
            *(Column(symbol, name) for symbol, name in zip(symbols, fit.determined, strict=True)),
        ),
        (
            (Cell(name, symbol), *(_correlation_cell(i == j, value) for j, value in enumerate(row)))
            for i, (name, symbol, row) in enumerate(
                zip(fit.determined, symbols, fit.correlation.tolist(), strict=True)
            )
        ),
        ("For ζ, γ, ρ/EI and EI, of their logarithms. Bold: 0.9 or more.",),
    )


def _parameter_row(
    name: str,
    parameter: ReportedValue,
    values_with_scales: Mapping[str, ReportedValue],
    *,
    is_fixed: bool,
) -> tuple[Entry, ...]:
    """Return the row of a parameter in a table: symbol, meaning, unit, values and remark."""
    symbol, meaning, unit, factor = _parameter_description(name)
    cells = estimate_cells(
        (parameter.value, parameter.std or None, *_interval_ends(parameter)), parameter.std, factor
    )
    if values_with_scales:
        # A parameter that depends on no scale has the same interval with scales.
        with_scale_uncertainty = values_with_scales.get(name, parameter)
        cells += estimate_cells(
            (with_scale_uncertainty.std or None, *_interval_ends(with_scale_uncertainty)),
            with_scale_uncertainty.std,
            factor,
        )
    if parameter.flag is not None:
        cells = (mark_cell(cells[0]), *map(grey_cell, cells[1:]))
    return (
        Cell(name, symbol),
        meaning,
        _unit_cell(unit),
        *cells,
        "fixed" if is_fixed else parameter.flag or "",
    )


_SI_UNITS: Final = {"µs": "s", "ms": "s", "g": "kg", "mm": "m", "ppm": "1", "%": "1"}
"""SI units of the units that tables show."""


def _unit_cell(unit_text: str) -> Cell:
    """Return the cell of a unit, with the SI unit for programs, whose numbers are in SI units."""
    power, _, unit = unit_text.rpartition(" ")
    return Cell(_SI_UNITS.get(unit_text, unit if power.startswith("1e") else unit_text), unit_text)


def _loss_factor_row(headline: Headline, loss_factor: ReportedLossFactor) -> tuple[Entry, ...]:
    """Return the table row of the loss factor of internal or external damping."""
    size, internal = loss_factor.size, loss_factor.damping == "internal"
    symbol = "ζ ω^α sin(απ/2)" if internal else "γ ω^λ sin(λπ/2) / (ρ/EI ω²)"
    flag = size.flag
    if loss_factor.omega_rad_s is None:
        # Without a pivot frequency the value is the coefficient for an order that was only assumed.
        flag = flag or headline.parameters["zeta" if internal else "gamma"].flag
        symbol = symbol[0]
    value, std, low, high = _quantity_cells(size)
    relative_std = number_cell(None if size.std is None else size.std / size.value, "#.2g", 100.0)
    further_cells: tuple[Cell, ...] = (std, relative_std, low, high)
    if flag is not None:
        value, further_cells = mark_cell(value), tuple(map(grey_cell, further_cells))
    return (loss_factor.damping, symbol, loss_factor.omega_rad_s, value, *further_cells)


def _quantity_cells(quantity: ReportedValue, factor: float = 1.0) -> tuple[Cell, ...]:
    """Return the cells of a quantity, its standard deviation and the ends of its interval."""
    return estimate_cells(
        (quantity.value, quantity.std, *_interval_ends(quantity)), quantity.std, factor
    )


def _interval_ends(quantity: ReportedValue) -> tuple[float | None, float | None]:
    """Return the ends of a quantity's 95 % interval; None twice without an interval."""
    return quantity.interval_95 or (None, None)


def _reason_notes(quantities: Iterable[ReportedValue]) -> tuple[str, ...]:
    """Return a note for each reason for which quantities are marked."""
    reasons = dict.fromkeys(quantity.flag for quantity in quantities if quantity.flag is not None)
    return tuple(f"{NOT_REPORTED_MARK} {reason}." for reason in reasons)


def _parameter_description(name: str) -> tuple[str, str, str, float]:
    """Return the symbol, meaning, unit and factor of a parameter."""
    default = (_parameter_symbol(name), "stiffness beyond the uniform beam's", "%", 100.0)
    return QUANTITIES.get(name, default)


def _parameter_symbol(name: str) -> str:
    """Return the symbol of a parameter; of a stiffness correction, δ and the mode's number."""
    if name in QUANTITIES:
        return QUANTITIES[name][0]
    return f"δ{name.rsplit('_', 1)[-1]}"


def _correlation_cell(is_diagonal: bool, value: float) -> Cell:
    """Return the cell of a correlation, in bold if it is strong and of two different parameters."""
    cell = number_cell(value, ".3f")
    if is_diagonal or abs(value) < _STRONG_CORRELATION:
        return cell
    return replace(cell, strong=True)


def amplitude_tables(whole_record: WholeRecord) -> tuple[Table, ...]:
    """Return a table of the damping ratio in free vibration by amplitude; nothing without data."""
    damping_by_amplitude = whole_record.verdict.damping_with_amplitude
    if not damping_by_amplitude:
        return ()
    rows: list[tuple[Entry, ...]] = []
    for at in damping_by_amplitude:
        ratio, std, half_width = at.damping_ratio, at.std, NORMAL_95 * at.std
        cells = estimate_cells((ratio, std, ratio - half_width, ratio + half_width), std, 100.0)
        rows.append((at.mode, at.tip_amplitude_m, *cells))
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
