"""Tables of the estimates pooled over all sessions, and of the sessions' homogeneity."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.campaigns import campaign_estimates, differing_fact_keys, fact_text, pooled_flags
from analysis.campaigns.labels import (
    format_p_value,
    format_percent,
    label_and_unit,
    symbol_with_unit,
)
from analysis.campaigns.specimen_sentences import MIXTURE_MARK, MIXTURE_NOTE, pooled_title
from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION
from analysis.models import STRUCTURES
from analysis.report.table import (
    TEXT_FORMAT,
    Cell,
    Column,
    Entry,
    Row,
    Table,
    count_cell,
    estimate_cells,
    flag_notes,
    flagged_cells,
    grey_cell,
    mark_cell,
    mode_flag,
    number_cell,
    unreported_parameters,
    unsupported_order_notes,
)
from rigd.units import decimals

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from analysis.campaigns import CampaignResult, Heterogeneity, Homogeneity, RankedStructure
    from analysis.campaigns.pooling import PooledEstimate, PooledParameter

_INERTIA_COLUMNS: Final = (
    Column("inertia (10⁻⁶ kg·m²)", "participation_kg_m2"),
    Column("std", "participation_std_kg_m2", std_of_previous=True),
)
"""Columns of a mode's effective inertia and its standard deviation."""
NOT_POOLED_NOTE: Final = (
    "In grey: not pooled, as fewer than two sessions determine its damping or not all were fitted."
)
"""Note below the table of structures on those that are not pooled."""


def structures_table(campaign: CampaignResult) -> Table:
    """Return the table of all structures' joint fits to all sessions, by increasing BIC.

    Structures that are not pooled follow the pooled ones.
    """

    def structure_row(ranked_structure: RankedStructure) -> Row:
        grey_if_not_pooled: Callable[[Cell], Cell] = (
            (lambda cell: cell) if ranked_structure.is_pooled else grey_cell
        )
        return {
            "type": Cell(ranked_structure.structure, ranked_structure.name),
            "fitted": grey_if_not_pooled(count_cell(ranked_structure.fitted_sessions)),
            "sessions": grey_if_not_pooled(count_cell(ranked_structure.determining_sessions)),
            "bic_above_lowest": grey_if_not_pooled(
                number_cell(ranked_structure.bic_above_lowest, ".1f")
            ),
            "misfit": grey_if_not_pooled(number_cell(ranked_structure.misfit)),
            "selected_alone": grey_if_not_pooled(count_cell(ranked_structure.selecting_sessions)),
            "pooled": ranked_structure.is_pooled,
        }

    return Table(
        "structures",
        pooled_title("Structures, whole records of all sessions together", campaign.homogeneity),
        (
            Column("type", "type", TEXT_FORMAT),
            Column("sessions fitted", "fitted"),
            Column("damping determined in", "sessions"),
            Column("selected in", "selected_alone"),
            Column("ΔBIC", "bic_above_lowest"),
            Column("residual (noise = 1)", "misfit"),
        ),
        tuple(map(structure_row, campaign.structures)),
        (
            "Each damping parameter has one value for all sessions, with a between-session "
            "variance where they differ, or one per session if some session does not determine "
            "it; delay, tool inertia, ρ/EI and EI have one per session.",
            *(
                ()
                if all(ranked_structure.is_pooled for ranked_structure in campaign.structures)
                else (NOT_POOLED_NOTE,)
            ),
        ),
        highlighted_row=0 if campaign.pooled else None,
    )


def leading_estimates(campaign: CampaignResult) -> list[PooledEstimate]:
    """Return the reported pooled estimate, then the one of the structure with the lowest BIC.

    The list has one element if both are the same, and none without a pooled estimate.
    """
    estimates_by_name = {
        estimate.name: estimate for estimate in (campaign.freest, *campaign.pooled[:1]) if estimate
    }
    return list(estimates_by_name.values())


def session_count_text(estimate: PooledEstimate, campaign: CampaignResult) -> str:
    """Return how many sessions an estimate is pooled from, such as "7 of 10 sessions"."""
    session_total = len(campaign.sessions)
    return (
        f"{estimate.sessions}{f' of {session_total}' if estimate.sessions < session_total else ''}"
        " sessions"
    )


def exact_condition_text(campaign: CampaignResult) -> str:
    """Return a text for captions that the beam is assumed exactly uniform.

    It is empty if the pooled estimate does not depend on this assumption.
    """
    return (
        f", {EXACTLY_UNIFORM_CONDITION}"
        if campaign.modal and campaign.modal.replaces_beam_modes
        else ""
    )


def pooled_table(campaign: CampaignResult, only_estimate: PooledEstimate | None = None) -> Table:
    """Return the table of pooled estimates: the reported one first, then by increasing BIC.

    With `only_estimate` the table shows no other. Without it, as in the files, all estimates are in
    the table, followed by the structures that are not pooled, without values.
    """
    unsupported_orders = campaign.verdict.withheld_orders if campaign.verdict else frozenset[str]()
    homogeneity, headline = campaign.homogeneity, campaign.freest
    table_columns = (
        Column("parameter", "parameter", TEXT_FORMAT),
        Column("pooled", "value"), Column("std", "std", std_of_previous=True),
        Column("95 % from", "low_95"), Column("to", "high_95"),
        Column("one session's std", "within_std"), Column("between sessions", "between_std"),
        Column("p", "p_value"),
    )  # fmt: skip
    if only_estimate is None:
        ordered_estimates = sorted(
            campaign.pooled, key=lambda pooled_estimate: pooled_estimate is not headline
        )
        table_rows = [
            table_row
            for estimate in ordered_estimates
            for table_row in _pooled_rows(
                estimate, campaign, unsupported_orders, pooled_flags(campaign, estimate)
            )
        ]
        table_rows += [
            {
                "type": structure.structure,
                "name": structure.name,
                "headline": False,
                "sessions": structure.determining_sessions,
                "misfit": structure.misfit,
                "parameter": parameter,
                "reported": False,
            }
            for structure in campaign.structures
            if not structure.is_pooled
            for parameter in STRUCTURES[structure.structure].free
        ]
        return Table("pooled", "Pooled whole-record estimates", table_columns, tuple(table_rows))
    estimate_role = "freest structure"
    if only_estimate is not headline:
        estimate_role = "lowest BIC; valid only if it is the true one"
    estimate_role += exact_condition_text(campaign)
    table_notes = [
        "One session's std: standard deviation that a typical session states. Between sessions: "
        "standard deviation between sessions beyond that (τ). p: p-value of Cochran's Q. "
        f"Residual {only_estimate.misfit:.4g} times the noise."
    ]
    unreported_names = unreported_parameters(
        STRUCTURES[only_estimate.structure], unsupported_orders
    )
    if unreported_names:
        table_notes += unsupported_order_notes(unsupported_orders)
    flag_by_parameter = pooled_flags(campaign, only_estimate)
    table_notes += flag_notes(
        flag
        for parameter_name, flag in flag_by_parameter.items()
        if parameter_name in only_estimate.parameters_by_name
        and parameter_name not in unreported_names
        and not homogeneity.is_mixed(parameter_name)
    )
    if any(homogeneity.is_mixed(parameter.name) for parameter in only_estimate.parameters):
        table_notes.append(MIXTURE_NOTE)
    return Table(
        f"pooled_{only_estimate.name.replace(', ', '_').replace(' ', '_')}",
        pooled_title(
            f"Pooled over {session_count_text(only_estimate, campaign)}: "
            f"type {only_estimate.name} ({estimate_role})",
            homogeneity,
        ),
        table_columns,
        tuple(_pooled_rows(only_estimate, campaign, unsupported_orders, flag_by_parameter)),
        tuple(table_notes),
    )


def _pooled_rows(
    pooled_estimate: PooledEstimate,
    campaign: CampaignResult,
    unsupported_orders: Collection[str],
    flag_by_parameter: Mapping[str, str],
) -> Iterator[Row]:
    """Yield the rows of an estimate's parameters in the table of pooled estimates."""
    for parameter in pooled_estimate.parameters:
        yield _pooled_row(
            pooled_estimate,
            parameter,
            campaign,
            unsupported_orders,
            flag_by_parameter.get(parameter.name),
        )


def _pooled_row(
    pooled_estimate: PooledEstimate,
    parameter: PooledParameter,
    campaign: CampaignResult,
    unsupported_orders: Collection[str],
    flag: str | None,
) -> Row:
    """Return the row of a parameter in the table of pooled estimates."""
    homogeneity = campaign.homogeneity
    _, display_factor, _ = label_and_unit(parameter.name)
    value_cell, std_cell, low_cell, high_cell = estimate_cells(
        (parameter.value, parameter.std, *parameter.interval), parameter.std, display_factor
    )
    is_reported = parameter.name not in unreported_parameters(
        STRUCTURES[pooled_estimate.structure], unsupported_orders
    )
    if not is_reported or (flag and not homogeneity.is_mixed(parameter.name)):
        value_cell = mark_cell(value_cell)
    else:
        # Only usable values are bold, so that they catch the eye.
        value_cell = (
            grey_cell(value_cell)
            if homogeneity.is_mixed(parameter.name)
            else replace(value_cell, is_strong=True)
        )
    return {
        "type": pooled_estimate.structure,
        "name": pooled_estimate.name,
        "headline": pooled_estimate is campaign.freest,
        "sessions": pooled_estimate.sessions,
        "bic": pooled_estimate.bic,
        "misfit": pooled_estimate.misfit,
        "parameter": Cell(
            parameter.name,
            with_mixture_mark(symbol_with_unit(parameter.name), parameter.name, homogeneity),
        ),
        "value": value_cell,
        "std": std_cell,
        "low_95": low_cell,
        "high_95": high_cell,
        "within_std": number_cell(parameter.within_session_std, ".2g", display_factor),
        "between_std": number_cell(parameter.between_session_std, ".2g", display_factor),
        "p_value": p_value_cell(parameter.heterogeneity_p_value),
        "next_low_95": parameter.next_session_interval[0],
        "next_high_95": parameter.next_session_interval[1],
        "reported": is_reported,
        "mixture": homogeneity.is_mixed(parameter.name),
        "flag": flag,
    }


def tolerance_table(campaign: CampaignResult) -> Table:
    """Return the table of a campaign's parameters for a beam that is uniform within a tolerance.

    It also contains the parameters of an exactly uniform beam. It has no rows if no tolerance of
    the beam's geometry is stated.
    """
    modal_result, reported_numbers = campaign.modal, campaign_estimates(campaign)
    tolerant_estimate = modal_result.tolerant if modal_result else None
    table_columns = (
        Column("parameter", "parameter", TEXT_FORMAT), Column("value", "value"),
        Column("std", "std", std_of_previous=True),
        Column("95 % from", "low_95"), Column("to", "high_95"),
        Column(EXACTLY_UNIFORM_CONDITION, "exact"),
        Column("std", "exact_std", std_of_previous=True),
    )  # fmt: skip
    if modal_result is None or tolerant_estimate is None or reported_numbers is None:
        return Table("parameters", "", table_columns, ())
    exact_parameters = reported_numbers.exact.parameters if reported_numbers.exact else {}
    flags = [
        parameter.flag
        for parameters in (reported_numbers.parameters, exact_parameters)
        for parameter in parameters.values()
    ]
    table_rows: list[Row] = []
    for parameter_name, reported_value in reported_numbers.parameters.items():
        _, display_factor, _ = label_and_unit(parameter_name)
        lower_limit, upper_limit = reported_value.interval_95 or (None, None)
        value_cell, *further_cells = estimate_cells(
            (reported_value.value, reported_value.std, lower_limit, upper_limit),
            reported_value.std or None,
            display_factor,
        )
        exact_estimate = exact_parameters.get(parameter_name)
        exact_cells = (
            estimate_cells(
                (exact_estimate.value, exact_estimate.std), exact_estimate.std, display_factor
            )
            if exact_estimate
            else (number_cell(None), number_cell(None))
        )
        table_rows.append(
            {
                "parameter": Cell(
                    parameter_name,
                    with_mixture_mark(
                        symbol_with_unit(parameter_name), parameter_name, campaign.homogeneity
                    ),
                ),
                "value": mark_cell(value_cell)
                if reported_value.flag
                else replace(value_cell, is_strong=True),
                **dict(zip(("std", "low_95", "high_95"), further_cells, strict=True)),
                **dict(
                    zip(
                        ("exact", "exact_std"),
                        flagged_cells(exact_cells, exact_estimate.flag if exact_estimate else None),
                        strict=True,
                    )
                ),
                "uniformity_percent": 100 * tolerant_estimate.uniformity,
                "basis": tolerant_estimate.basis,
                "flag": reported_value.flag,
                "exact_flag": exact_estimate.flag if exact_estimate else None,
            }
        )
    return Table(
        "parameters",
        pooled_title(
            f"Parameters from the modal constants of {modal_result.sessions} sessions"
            + (
                f", uniform to {100 * tolerant_estimate.uniformity:g} %"
                if tolerant_estimate.basis == "geometry"
                else ""
            ),
            campaign.homogeneity,
        ),
        table_columns,
        tuple(table_rows),
        (
            "The tolerance of the geometry is common to all sessions: more of them do not reduce "
            "it.",
            *flag_notes(flags),
        ),
    )


def uniform_beam_table(campaign: CampaignResult) -> Table:
    """Return the table of pooled modal constants and those of the best uniform beam."""
    modal_result, homogeneity = campaign.modal, campaign.homogeneity
    uniformity_test = modal_result.uniform_beam if modal_result else None
    table_rows: list[Row] = []
    for modal_constant in uniformity_test.as_json()["constants"] if uniformity_test else ():
        measured_value, std, predicted_value = (
            modal_constant[key] for key in ("measured", "std", "predicted")
        )
        measured_cell, std_cell, predicted_cell = estimate_cells(
            (measured_value, std, predicted_value), std
        )
        table_rows.append(
            {
                "mode": modal_constant["mode"],
                "constant": Cell(modal_constant["name"], modal_constant["name"].replace("_", " ")),
                "measured": measured_cell,
                "std": std_cell,
                "predicted": predicted_cell,
                "deviation": (measured_value - predicted_value) / std,
            }
        )
    return Table(
        "uniform_beam",
        pooled_title("Modal constants, and those of the uniform beam that fits best", homogeneity),
        (
            Column("mode", "mode"), Column("constant", "constant", TEXT_FORMAT),
            Column("measured", "measured"), Column("std", "std", std_of_previous=True),
            Column("uniform beam", "predicted"), Column("difference (std)", "deviation", ".1f"),
        ),
        tuple(table_rows),
    )  # fmt: skip


def modes_table(campaign: CampaignResult) -> Table:
    """Return the table of pooled modes: means and standard deviations between sessions."""
    homogeneity, reported_numbers = campaign.homogeneity, campaign_estimates(campaign)
    reported_modes = {
        mode.number: mode for mode in (reported_numbers.modes if reported_numbers else ())
    }
    table_rows: list[Row] = []
    marked_flags: list[str | None] = []
    for pooled_mode in campaign.modes:
        mode_cells: dict[str, Entry] = {"mode": pooled_mode.number}
        reported_mode = reported_modes.get(pooled_mode.number)
        for quantity_key, std, between_std_name, display_factor in (
            ("frequency_hz", "frequency_std_hz", "frequency_between_std_hz", 1.0),
            ("damping_ratio", "damping_ratio_std", "damping_ratio_between_std", 100.0),
        ):
            std_value = getattr(pooled_mode, std)
            value_cells = estimate_cells(
                (getattr(pooled_mode, quantity_key), std_value), std_value, display_factor
            )
            quantity_name = f"{quantity_key}_{pooled_mode.number}"
            if reported_mode is not None and not homogeneity.is_mixed(quantity_name):
                marked_flags.append(getattr(reported_mode, quantity_key).flag)
                value_cells = flagged_cells(value_cells, marked_flags[-1])
            mean_value, mode_cells[std] = value_cells
            value_text = with_mixture_mark(mean_value.text, quantity_name, homogeneity)
            mode_cells[quantity_key] = replace(mean_value, text=value_text)
            mode_cells[between_std_name] = number_cell(
                getattr(pooled_mode, between_std_name), ".2g", display_factor
            )
        std_value = pooled_mode.participation_std_kg_m2
        inertia = reported_mode.participation if reported_mode else None
        inertia_cell, std_cell = flagged_cells(
            estimate_cells((pooled_mode.participation_kg_m2, std_value), std_value, 1e6),
            inertia.flag if inertia else None,
        )
        mode_cells |= {"participation_kg_m2": inertia_cell, "participation_std_kg_m2": std_cell}
        table_rows.append(
            {
                **mode_cells,
                "source": pooled_mode.source,
                "frequency_mixture": homogeneity.is_mixed(f"frequency_hz_{pooled_mode.number}"),
                "damping_ratio_mixture": homogeneity.is_mixed(
                    f"damping_ratio_{pooled_mode.number}"
                ),
                "flag": mode_flag(reported_mode) if reported_mode else None,
            }
        )
    has_mixture = any(
        row["frequency_mixture"] or row["damping_ratio_mixture"] for row in table_rows
    )
    return Table(
        "pooled_modes",
        pooled_title("Modes with locked hub (clamped–free), mean of the sessions", homogeneity),
        (
            Column("mode", "mode"),
            Column("frequency (Hz)", "frequency_hz"),
            Column("std", "frequency_std_hz", std_of_previous=True),
            Column("between sessions", "frequency_between_std_hz"),
            Column("damping ratio (%)", "damping_ratio"),
            Column("std", "damping_ratio_std", std_of_previous=True),
            Column("between sessions", "damping_ratio_between_std"),
            *(_INERTIA_COLUMNS if any(row["source"] == "modal" for row in table_rows) else ()),
        ),
        tuple(table_rows),
        (*flag_notes(marked_flags), *((MIXTURE_NOTE,) if has_mixture else ())),
    )


# Homogeneity


def specimens_table(campaign: CampaignResult) -> Table:
    """Return the table of the specimens that the files state, the campaign's own as first row."""
    stated_specimens = campaign.homogeneity.specimens
    return Table(
        "specimens",
        "Specimens, as the files state them",
        (
            Column("this report's", "here", TEXT_FORMAT),
            *(Column(key, key, TEXT_FORMAT) for key in differing_fact_keys(stated_specimens)),
            Column("files", "files"),
            Column("their names", "names", TEXT_FORMAT),
        ),
        tuple(
            {
                **{
                    key: Cell(stated_value, fact_text(key, stated_value))
                    for key, stated_value in specimen.facts.items()
                },
                "files": len(specimen.file_names),
                "here": specimen is stated_specimens[0],
                "names": Cell(" ".join(specimen.file_names), ", ".join(specimen.file_names)),
            }
            for specimen in stated_specimens
        ),
        highlighted_row=0,
    )


def homogeneity_table(campaign: CampaignResult) -> Table:
    """Return the table of the scatter between sessions of modal quantities and parameters."""
    homogeneity = campaign.homogeneity

    def scatter_row(scatter: Heterogeneity) -> Row:
        _, display_factor, _ = label_and_unit(scatter.quantity)
        return {
            "quantity": Cell(
                scatter.quantity,
                with_mixture_mark(
                    symbol_with_unit(scatter.quantity), scatter.quantity, homogeneity
                ),
            ),
            "sessions": len(scatter.session_estimates),
            "mean": number_cell(scatter.mean, f".{_decimals_of_scatter(scatter)}f", display_factor),
            "between_std": number_cell(scatter.between_session_std, ".2g", display_factor),
            "between_in_own_std": scatter.relative_between_session_std,
            "cochran_q": scatter.cochran_q,
            "i_squared": replace(
                number_cell(scatter.i_squared), text=format_percent(scatter.i_squared)
            ),
            "p_value": p_value_cell(scatter.p_value),
            **_trend_cells(scatter, display_factor),
            "mixture": scatter.is_mixture,
        }

    has_trends = any(scatter.trend for scatter in homogeneity.quantities)
    return Table(
        "homogeneity",
        "Homogeneity of the sessions"
        f"{f', by type {homogeneity.structure}' if homogeneity.structure else ''}",
        (
            Column("quantity", "quantity", TEXT_FORMAT), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("τ/s", "between_in_own_std", ".3g"),
            Column("Cochran's Q", "cochran_q", ".3g"),
            Column("I²", "i_squared"), Column("p", "p_value"),
            Column("change per hour" if has_trends else "", "trend_per_h"),
            Column("std" if has_trends else "", "trend_std_per_h", std_of_previous=True),
            Column("its p" if has_trends else "", "trend_p_value"),
        ),
        tuple(map(scatter_row, homogeneity.quantities)),
        (
            "Between sessions: standard deviation beyond the sessions' own uncertainties (τ). τ/s: "
            "the same over a typical session's own. I²: its share of the variance. p: p-value of "
            "Cochran's Q. Modes are those of the modal model, if sessions have one.",
            *(
                ["Change per hour: slope of a straight line. Its p: p-value of no change."]
                if has_trends
                else []
            ),
            *([MIXTURE_NOTE] if homogeneity.is_mixture else []),
        ),
    )  # fmt: skip


def _trend_cells(scatter: Heterogeneity, display_factor: float) -> Row:
    """Return the cells of the change of a quantity with time; they are empty if it is unknown."""
    if scatter.trend is None:
        return {}
    slope_cell, std_cell = estimate_cells(
        (scatter.trend.slope_per_h, scatter.trend.slope_std_per_h),
        scatter.trend.slope_std_per_h,
        display_factor,
    )
    return {
        "trend_per_h": slope_cell,
        "trend_std_per_h": std_cell,
        "trend_p_value": p_value_cell(scatter.trend.p_value),
    }


def _decimals_of_scatter(scatter: Heterogeneity) -> int:
    """Return the number of decimals with which a quantity's mean over the sessions is shown.

    It follows from the scatter between the sessions, or from the smallest standard deviation of a
    session if that is larger.
    """
    _, display_factor, _ = label_and_unit(scatter.quantity)
    shown_std = display_factor * max(
        scatter.between_session_std, min(std for _, _, std in scatter.session_estimates)
    )
    return min(decimals(shown_std), 9)


def p_value_cell(p_value: float) -> Cell:
    """Return a cell with a p-value; a very small one is displayed as a bound, such as "< 1e-99"."""
    return replace(number_cell(p_value), text=format_p_value(p_value))


def with_mixture_mark(cell_text: str, quantity_name: str, homogeneity: Homogeneity) -> str:
    """Return a quantity's text, with a mark if the sessions form groups with different values.

    `quantity_name` is the name of the quantity.
    """
    return f"{cell_text} {MIXTURE_MARK}" if homogeneity.is_mixed(quantity_name) else cell_text
