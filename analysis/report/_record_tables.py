"""Tables of one record: modes, parameters, loss factors, and damping by amplitude."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.identify.scales import SCALE_EXPONENTS, density_check, parameters_compensate_scales
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
    flag_notes,
    flagged_cells,
    mode_flag,
    number_cell,
)
from analysis.statistics import NORMAL_95
from rigd.beam import parameter_named
from rigd.printable import listed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from analysis.identify.headline import Estimates, Headline, ReportedLossFactor
    from analysis.results import WholeRecord
    from rigd.estimates import Estimate, ReportedMode

_SCALE_NAMES: Final = {"torque_scale": "torque scale", "length": "length"}
"""Names of the scales in notes, by key."""
_SUPERSCRIPTS: Final = str.maketrans("-123456789", "⁻¹²³⁴⁵⁶⁷⁸⁹")
"""Translation table from digits and the minus sign to superscripts."""
_STRONG_CORRELATION: Final = 0.9
"""Least magnitude of a correlation of two parameters that is shown in bold."""
_MARK_NOTE: Final = (
    f"{NOT_REPORTED_MARK} not a property of the antenna, for the reason in the remark: do not "
    "interpret. The number only describes the fitted curve."
)
"""Note that explains the symbol of flagged parameters."""


def modes_table(whole_record: WholeRecord) -> Table:
    """Return the table of modes: frequencies, damping ratios and effective inertias.

    Doubtful numbers have a mark (†). If both frequency and damping ratio of a mode are doubtful,
    its number has the mark.
    """
    headline = whole_record.headline
    has_inertias = any(mode.participation is not None for mode in headline.modes)
    return Table.from_rows(
        "modes",
        f"Modes with locked hub (clamped–free): {_source_of_modes(headline)}",
        (
            *_MODE_COLUMNS,
            Column("Inertia (kg·mm²)" if has_inertias else "", "participation_kg_m2"),
            Column("std" if has_inertias else "", "participation_std_kg_m2"),
            Column("Source" if has_inertias else "", "source", TEXT_FORMAT),
            _FILE_REMARK_COLUMN,
        ),
        map(_mode_row, headline.modes),
        (
            "Intervals are statistical only; frequencies and damping ratios do not depend on "
            "torque scale, length or density.",
            *_modal_notes(whole_record),
            *flag_notes(
                estimate.flag
                for mode in headline.modes
                for estimate in (mode.damping_ratio, mode.frequency_hz, mode.participation)
                if estimate is not None
            ),
        ),
    )


def exact_modes_table(whole_record: WholeRecord) -> Table | None:
    """Return the table of a uniform beam's modes; None if no such beam explains the record."""
    headline = whole_record.headline
    uniformity_test, exact_estimates = headline.uniform_beam, headline.exact
    if uniformity_test is None or exact_estimates is None or uniformity_test.status != "passed":
        return None
    shown_mode_values = [
        mode for mode in exact_estimates.modes if mode.shown and mode.damping_ratio.flag is None
    ]
    if not shown_mode_values:
        return None
    return Table.from_rows(
        "exact_geometry_modes",
        f"Modes {EXACTLY_UNIFORM_CONDITION}: type {exact_estimates.name}",
        _MODE_COLUMNS,
        ((mode.number, *_mode_cells(mode)) for mode in shown_mode_values),
        (
            "A condition, not a result: narrower intervals than those of the modal model, valid "
            "only if the beam is uniform.",
        ),
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


def _mode_row(mode: ReportedMode) -> tuple[Entry, ...]:
    """Return the row of a mode in the table of modes, with marks at doubtful numbers."""
    frequency_flag, damping_flag = mode.frequency_hz.flag, mode.damping_ratio.flag
    mode_cells, inertia_cells = _mode_cells(mode), _inertia_cells(mode.participation)
    source_and_flag = mode.source, mode_flag(mode) or ""
    if damping_flag is not None and frequency_flag is not None:
        marked_cells = flagged_cells(
            (count_cell(mode.number), *mode_cells, *inertia_cells), damping_flag
        )
        return *marked_cells, *source_and_flag
    return (
        mode.number,
        *flagged_cells(mode_cells[:2], frequency_flag),
        *flagged_cells(mode_cells[2:], damping_flag),
        *flagged_cells(inertia_cells, mode.participation.flag if mode.participation else None),
        *source_and_flag,
    )


def _mode_cells(mode: ReportedMode) -> tuple[Cell, ...]:
    """Return the cells of a mode's frequency and damping ratio, without the mode's number."""
    return *_quantity_cells(mode.frequency_hz)[:2], *_quantity_cells(mode.damping_ratio, 100.0)


_SQUARE_MM_PER_SQUARE_M: Final = 1e6
"""Number of square millimetres in a square metre."""


def _source_of_modes(headline: Headline) -> str:
    """Return the name of the model from which the reported modes are computed."""
    return (
        "modal model"
        if any(m.source == "modal" for m in headline.modes)
        else f"type {headline.name}"
    )


def _inertia_cells(participation: Estimate | None) -> tuple[Cell, Cell]:
    """Return the cells of a mode's effective inertia and of its standard deviation."""
    if participation is None:
        return number_cell(None), number_cell(None)
    value_cell, std_cell, *_ = _quantity_cells(participation, _SQUARE_MM_PER_SQUARE_M)
    return value_cell, std_cell


def _modal_notes(whole_record: WholeRecord) -> Iterator[str]:
    """Yield notes on the fit of the modal model, and on resonances that are not the beam's."""
    modal_fit = whole_record.headline.modal
    if modal_fit is None:
        return
    yield (
        "Inertia: effective inertia about the motor axis that takes part in the mode; it is "
        "proportional to the torque scale."
    )
    nrmse_percent = ShownModel.from_headline(
        whole_record.headline, whole_record.record
    ).fit_percent(whole_record.analysis)
    yield f"Fit of the modal model {nrmse_percent:.2f} % (NRMSE)."
    other_resonances_hz = [
        f"{frequency_hz:.4g}"
        for mode_number, frequency_hz in zip(
            modal_fit.mode_numbers, modal_fit.model.frequencies_hz, strict=True
        )
        if mode_number == 0
    ]
    if other_resonances_hz:
        yield (
            f"The modal model has a further resonance at {listed(other_resonances_hz)} Hz, which "
            "is not one of the beam's (sensor, mount)."
        )


def parameters_table(whole_record: WholeRecord) -> Table:
    """Return the table of all reported parameters with uncertainties.

    If the file states the uncertainties of the scales, additional intervals include these
    uncertainties. Parameters that are not properties of the antenna have a mark, and the last
    column states why.
    """
    headline = whole_record.headline
    parameters_with_scales = whole_record.parameters_with_scales
    scale_columns = (
        Column("", "combined_std"),
        Column("with scales: from", "combined_low_95"),
        Column("to", "combined_high_95"),
    )
    fit_note = ""
    if headline.tolerant is None:
        fit_note = f" Fit {whole_record.analysis.fit_percent(headline.fit):.2f} % (NRMSE)."
    return Table.from_rows(
        "parameters",
        f"Parameters{_condition_text(headline)}",
        (*_PARAMETER_COLUMNS, *(scale_columns if parameters_with_scales else ()), _REMARK_COLUMN),
        (
            _parameter_row(
                parameter_name,
                headline.parameters[parameter_name],
                parameters_with_scales,
                is_fixed=_is_fixed(headline, parameter_name),
            )
            for parameter_name in parameter_names(headline)
        ),
        (
            f"{_UNCERTAINTY_NOTE}{fit_note}",
            *_scale_notes(whole_record),
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
"""Column with the reason why a parameter has a mark."""
_FILE_REMARK_COLUMN: Final = replace(_REMARK_COLUMN, heading="")
"""The same column of tables whose notes state the reason."""
_UNCERTAINTY_NOTE: Final = (
    "std is one standard deviation; intervals of ρ/EI and EI, and on an exactly uniform beam those "
    "of ζ and γ, are symmetric in the logarithm. The CSV file has SI units."
)
"""Note on standard deviations and intervals."""


def parameter_names(headline: Headline) -> tuple[str, ...]:
    """Return the names of the reported parameters: first damping, then beam, then rig."""
    exact_parameters = () if headline.exact is None else headline.exact.parameters
    return tuple(dict.fromkeys((*(key for key in exact_parameters if key in headline.parameters),
                                *headline.parameters)))  # fmt: skip


def _condition_text(headline: Headline) -> str:
    """Return the condition under which a table's parameters hold, for the table's caption."""
    tolerant_estimate = headline.tolerant
    if tolerant_estimate is None:
        condition_text = "" if headline.modal is None else f", {EXACTLY_UNIFORM_CONDITION}"
        return f", type {headline.name}{condition_text}"
    if tolerant_estimate.basis == "geometry":
        tolerance_percent = 100 * tolerant_estimate.uniformity
        return f" if the mode frequencies are those of a uniform beam to {tolerance_percent:g} %"
    if tolerant_estimate.basis == "losses":
        return " by damping ratios and residue phases alone, whatever the positions of the modes"
    return " of the beam that fits the losses best: it does not explain them"


def _scale_notes(whole_record: WholeRecord) -> Iterator[str]:
    """Yield notes that state which uncertainties of scales the intervals include or omit."""
    if not parameters_compensate_scales(whole_record.fit):
        held_parameters = ", ".join(
            parameter_named(scale_key).symbol for scale_key in whole_record.fixed_parameters
        )
        yield (
            f"Intervals are statistical only: the file's values of {held_parameters}, "
            "which were held, the torque scale and the length are assumed exact."
        )
        return
    stated_uncertainty = whole_record.record.uncertainty
    known_scales = [
        f"{scale_name} {100 * stated_uncertainty[scale_key]:.3g} %"
        for scale_key, scale_name in _SCALE_NAMES.items()
        if scale_key in stated_uncertainty
    ]
    unknown_scales = [
        scale_name
        for scale_key, scale_name in _SCALE_NAMES.items()
        if scale_key not in stated_uncertainty
    ]
    if known_scales:
        yield (
            "With scales: 95 % intervals that include the relative standard uncertainty of "
            f"{' and '.join(known_scales)}, in quadrature; the others are statistical only."
        )
    if unknown_scales:
        yield (
            f"{'Not included' if known_scales else 'Intervals are statistical only. Not included'}"
            f": the uncertainty of {' and '.join(unknown_scales)}, which the file does not state."
        )
    yield (
        f"A wrong scale shows as {_scale_dependence_note(whole_record)}; no other parameter "
        "depends on these, and none on the stated density."
    )
    density_result = density_check(
        whole_record.fit, whole_record.record.beam.density_kg_per_m, stated_uncertainty
    )
    if density_result is None:
        return
    value_std_pairs = (
        (density_result.found_kg_per_m, density_result.found_std_kg_per_m),
        (density_result.stated_kg_per_m, density_result.stated_std_kg_per_m),
    )
    (found_value, found_std), (stated_value, stated_std) = (
        estimate_cells(value_std_pair, value_std_pair[1], 1e3) for value_std_pair in value_std_pairs
    )
    yield (
        f"Mass per length from the record, ρ/EI times EI: {found_value.text} ± {found_std.text} "
        f"g/m (std); stated: {stated_value.text} ± {stated_std.text} g/m. "
        + (
            "They agree."
            if density_result.agree
            else "The difference is significant (95 %): check torque scale, length and stated "
            "density; a tip mass or a soft clamp acts alike."
        )
    )


def _scale_dependence_note(whole_record: WholeRecord) -> str:
    """Return a text that states each parameter's dependence on the scales as powers of scales."""
    return ", ".join(
        f"{parameter_named(name).symbol} ∝ {_product_text(SCALE_EXPONENTS[name])}"
        for name in whole_record.headline.parameters
        if name in SCALE_EXPONENTS
    )


def _product_text(exponents: Mapping[str, int]) -> str:
    """Return the text of a product of powers of scales, from their exponents."""
    return " · ".join(
        _SCALE_NAMES[scale_name]
        + ("" if scale_power == 1 else str(scale_power).translate(_SUPERSCRIPTS))
        for scale_name, scale_power in exponents.items()
    )


def exact_geometry_table(whole_record: WholeRecord) -> Table | None:
    """Return the table of an exactly uniform beam's parameters.

    Return None if these are the parameters of the main table.
    """
    exact_estimates = whole_record.headline.exact
    if exact_estimates is None:
        return None
    flag_texts = [
        parameter.flag for parameter in exact_estimates.parameters.values() if parameter.flag
    ]
    return Table.from_rows(
        "exact_geometry",
        f"Parameters {EXACTLY_UNIFORM_CONDITION}: type {exact_estimates.name}",
        (*_PARAMETER_COLUMNS, _REMARK_COLUMN),
        (
            _parameter_row(
                parameter_name,
                parameter,
                {},
                is_fixed=_is_fixed(whole_record.headline, parameter_name, with_exact_geometry=True),
            )
            for parameter_name, parameter in exact_estimates.parameters.items()
        ),
        (
            "A condition, not a result: no antenna is known to be uniform to 1e-5. "
            f"Fit {whole_record.analysis.fit_percent(whole_record.fit):.2f} % (NRMSE).",
            *((_MARK_NOTE,) if flag_texts else ()),
        ),
    )


def _is_fixed(
    headline: Headline, parameter_name: str, *, with_exact_geometry: bool = False
) -> bool:
    """Return whether a parameter was held at a fixed value in its fit."""
    if (
        headline.tolerant is not None
        and not with_exact_geometry
        and parameter_name in headline.tolerant.values
    ):
        return False
    return parameter_name not in headline.fit.interval and parameter_name != "drag"


def loss_factors_table(whole_record: WholeRecord) -> Table:
    """Return the table of internal and external loss factors at their pivot frequencies.

    At its pivot frequency, a loss factor is not correlated with the order of the damping.
    """
    headline = whole_record.headline
    flags = [_loss_factor_flag(headline, loss_factor) for loss_factor in headline.sizes]
    return Table.from_rows(
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
            _FILE_REMARK_COLUMN,
        ),
        map(_loss_factor_row, headline.sizes, flags),
        (
            "Coefficient and order are strongly correlated; a loss factor is known far better than "
            "either.",
            *flag_notes(flags),
        ),
    )


def simpler_structure_table(whole_record: WholeRecord) -> Table | None:
    """Return the table that compares the parameters of a simpler structure with the reported ones.

    Return None if no structure with fewer free parameters is sufficient for the record.
    """
    headline: Estimates = whole_record.headline.exact or whole_record.headline
    simpler_estimates = headline.simpler
    if simpler_estimates is None:
        return None
    assumption_text = " and ".join(
        f"{parameter_named(parameter_name).symbol} = {fixed_value:g}"
        for parameter_name, fixed_value in simpler_estimates.fixed.items()
    )
    table_rows: list[tuple[Entry, ...]] = []
    for parameter_name, simpler_value in simpler_estimates.parameters.items():
        parameter_definition = parameter_named(parameter_name)
        display_factor = parameter_definition.display_factor
        free_estimate = headline.parameters.get(parameter_name)
        table_rows.append(
            (
                Cell(parameter_name, parameter_definition.symbol),
                _unit_cell(parameter_definition.display_unit),
                *flagged_cells(
                    estimate_cells(
                        (simpler_value.value, *_interval_ends(simpler_value)),
                        simpler_value.std,
                        display_factor,
                    ),
                    simpler_value.flag,
                ),
                *(
                    [number_cell(None)] * 3
                    if free_estimate is None
                    else flagged_cells(
                        estimate_cells(
                            (free_estimate.value, *_interval_ends(free_estimate)),
                            free_estimate.std,
                            display_factor,
                        ),
                        free_estimate.flag,
                    )
                ),
                simpler_value.flag or (free_estimate.flag if free_estimate else None) or "",
            )
        )
    return Table.from_rows(
        "on_condition",
        f"If {assumption_text or 'the rest'} is assumed: type {simpler_estimates.name} "
        "(sufficient)",
        (
            Column("Parameter", "parameter", TEXT_FORMAT),
            Column("Unit", "unit", TEXT_FORMAT),
            Column("Assumed", "value"),
            Column("95 % from", "low_95"),
            Column("to", "high_95"),
            Column("Free", "free_value"),
            Column("95 % from", "free_low_95"),
            Column("to", "free_high_95"),
            _REMARK_COLUMN,
        ),
        table_rows,
        (
            "The intervals on the left hold only if the assumption is true"
            + (f", and both {EXACTLY_UNIFORM_CONDITION}." if whole_record.headline.exact else "."),
            *((_MARK_NOTE,) if any(row[-1] for row in table_rows) else ()),
        ),
    )


def correlations_table(whole_record: WholeRecord) -> Table:
    """Return the table of correlations between the determined parameters of the selected fit."""
    fit = whole_record.fit
    parameter_symbols = [
        parameter_named(parameter_name).symbol for parameter_name in fit.determined
    ]
    return Table.from_rows(
        "correlations",
        "Correlations of the parameters on an exactly uniform beam, "
        f"type {whole_record.headline.name}",
        (
            Column("Parameter", "parameter", TEXT_FORMAT),
            *(
                Column(parameter_symbol, parameter_name)
                for parameter_symbol, parameter_name in zip(
                    parameter_symbols, fit.determined, strict=True
                )
            ),
        ),
        (
            (
                Cell(parameter_name, parameter_symbol),
                *(
                    _correlation_cell(i == j, correlation_value)
                    for j, correlation_value in enumerate(row)
                ),
            )
            for i, (parameter_name, parameter_symbol, row) in enumerate(
                zip(fit.determined, parameter_symbols, fit.correlation.tolist(), strict=True)
            )
        ),
        ("For ζ, γ, ρ/EI and EI, of their logarithms. Bold: 0.9 or more.",),
    )


def _parameter_row(
    parameter_name: str,
    parameter: Estimate,
    parameters_with_scales: Mapping[str, Estimate],
    *,
    is_fixed: bool,
) -> tuple[Entry, ...]:
    """Return the row of a parameter in a table: symbol, meaning, unit, values and remark."""
    definition = parameter_named(parameter_name)
    display_factor = definition.display_factor
    value_cells = estimate_cells(
        (parameter.value, parameter.std or None, *_interval_ends(parameter)),
        parameter.std,
        display_factor,
    )
    if parameters_with_scales:
        # A parameter that depends on no scale has the same interval with scales.
        estimate_with_scales = parameters_with_scales.get(parameter_name, parameter)
        value_cells += estimate_cells(
            (estimate_with_scales.std or None, *_interval_ends(estimate_with_scales)),
            estimate_with_scales.std,
            display_factor,
        )
    return (
        Cell(parameter_name, definition.symbol),
        definition.meaning,
        _unit_cell(definition.display_unit),
        *flagged_cells(value_cells, parameter.flag),
        "; ".join(filter(None, ("fixed" if is_fixed else None, parameter.flag))),
    )


_SI_UNITS: Final = {"µs": "s", "ms": "s", "g": "kg", "mm": "m", "ppm": "1", "%": "1"}
"""SI unit for each displayed unit that is not an SI unit."""


def _unit_cell(unit_text: str) -> Cell:
    """Return the cell that displays a unit; for programs its value is the SI unit."""
    power_text, _, unit_symbol = unit_text.rpartition(" ")
    return Cell(
        _SI_UNITS.get(unit_text, unit_symbol if power_text.startswith("1e") else unit_text),
        unit_text,
    )


def _loss_factor_flag(headline: Headline, loss_factor: ReportedLossFactor) -> str | None:
    """Return the flag of the loss factor of internal or external damping, or None."""
    if loss_factor.size.flag is not None or loss_factor.omega_rad_s is not None:
        return loss_factor.size.flag
    # Without a pivot frequency the value is the coefficient for an order that was only assumed.
    return headline.parameters["zeta" if loss_factor.damping == "internal" else "gamma"].flag


def _loss_factor_row(loss_factor: ReportedLossFactor, flag_text: str | None) -> tuple[Entry, ...]:
    """Return the table row of the loss factor of internal or external damping."""
    loss_size, is_internal = loss_factor.size, loss_factor.damping == "internal"
    loss_symbol = "ζ ω^α sin(απ/2)" if is_internal else "γ ω^λ sin(λπ/2) / (ρ/EI ω²)"
    if loss_factor.omega_rad_s is None:
        loss_symbol = loss_symbol[0]
    value_cell, std_cell, low_cell, high_cell = _quantity_cells(loss_size)
    relative_std_cell = number_cell(
        None if loss_size.std is None else loss_size.std / loss_size.value, "#.2g", 100.0
    )
    value_cells = (value_cell, std_cell, relative_std_cell, low_cell, high_cell)
    return (
        loss_factor.damping,
        loss_symbol,
        loss_factor.omega_rad_s,
        *flagged_cells(value_cells, flag_text),
        flag_text or "",
    )


def _quantity_cells(reported_value: Estimate, display_factor: float = 1.0) -> tuple[Cell, ...]:
    """Return the cells of a quantity, its standard deviation and the ends of its interval."""
    return estimate_cells(
        (reported_value.value, reported_value.std, *_interval_ends(reported_value)),
        reported_value.std,
        display_factor,
    )


def _interval_ends(reported_value: Estimate) -> tuple[float | None, float | None]:
    """Return the ends of a quantity's 95 % interval; (None, None) without an interval."""
    return reported_value.interval_95 or (None, None)


def _correlation_cell(is_diagonal: bool, correlation_value: float) -> Cell:
    """Return the cell of a correlation, in bold if it is strong and not on the diagonal."""
    correlation_cell = number_cell(correlation_value, ".3f")
    if is_diagonal or abs(correlation_value) < _STRONG_CORRELATION:
        return correlation_cell
    return replace(correlation_cell, is_strong=True)


def amplitude_tables(whole_record: WholeRecord) -> tuple[Table, ...]:
    """Return the table of damping ratios in free vibration by amplitude; empty without data."""
    damping_by_amplitude = whole_record.verdict.damping_with_amplitude
    if not damping_by_amplitude:
        return ()
    table_rows: list[tuple[Entry, ...]] = []
    for amplitude_estimate in damping_by_amplitude:
        damping_ratio, std, half_width = (
            amplitude_estimate.damping_ratio,
            amplitude_estimate.std,
            NORMAL_95 * amplitude_estimate.std,
        )
        ratio_cells = estimate_cells(
            (damping_ratio, std, damping_ratio - half_width, damping_ratio + half_width), std, 100.0
        )
        table_rows.append(
            (amplitude_estimate.mode, amplitude_estimate.tip_amplitude_m, *ratio_cells)
        )
    return (
        Table.from_rows(
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
            table_rows,
            ("Amplitude 0 is the beam without air, as in the table of the modes.",),
        ),
    )
