"""Tables of what all sessions give together, and of whether they are of one specimen."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.campaigns import campaign_numbers, fact_text, in_dispute
from analysis.campaigns.sentences import (
    MIXTURE_MARK,
    MIXTURE_NOTE,
    label,
    percent,
    probability,
    title,
    with_unit,
)
from analysis.identify.headline import EXACT_CONDITION
from analysis.models import STRUCTURES
from analysis.report.table import (
    MARK,
    WORDS,
    Cell,
    Column,
    Entry,
    Row,
    Table,
    count,
    estimate,
    footnotes,
    greyed,
    marked,
    number,
    unreported,
)
from rigd.units import decimals

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from analysis.campaigns import CampaignResult, Heterogeneity, Homogeneity, RankedStructure
    from analysis.campaigns.pooling import PooledEstimate, PooledParameter

_PARTICIPATION: Final = (
    Column("inertia (10⁻⁶ kg·m²)", "participation_kg_m2"),
    Column("std", "participation_std_kg_m2", spread=True),
)
NOT_POOLED: Final = (
    "In grey: not pooled, as fewer than two sessions determine its damping or not all were fitted."
)


def structures_table(campaign: CampaignResult) -> Table:
    """All structures on all whole records together, those pooled first, the lowest BIC first."""

    def row(each: RankedStructure) -> Row:
        grey: Callable[[Cell], Cell] = (lambda cell: cell) if each.pooled else greyed
        return {
            "type": Cell(each.structure, each.name),
            "fitted": grey(count(each.fitted)),
            "sessions": grey(count(each.determined)),
            "bic_above_lowest": grey(number(each.bic_above_lowest, ".1f")),
            "misfit": grey(number(each.misfit)),
            "selected_alone": grey(count(each.selected_alone)),
            "pooled": each.pooled,
        }

    return Table(
        "structures",
        title("Structures, whole records of all sessions together", campaign.homogeneity),
        (
            Column("type", "type", WORDS),
            Column("sessions fitted", "fitted"),
            Column("damping determined in", "sessions"),
            Column("selected in", "selected_alone"),
            Column("ΔBIC", "bic_above_lowest"),
            Column("residual (noise = 1)", "misfit"),
        ),
        tuple(map(row, campaign.structures)),
        (
            "Damping and stiffness corrections have one value for all sessions, with a "
            "between-session variance where they differ; settings of the rig have one per session.",
            *(() if all(each.pooled for each in campaign.structures) else (NOT_POOLED,)),
        ),
        selected=0 if campaign.pooled else None,
    )


def likely_estimates(campaign: CampaignResult) -> list[PooledEstimate]:
    """Return the headline's estimate, and the one of the lowest BIC, which is conditional."""
    found = {each.name: each for each in (campaign.headline, *campaign.pooled[:1]) if each}
    return list(found.values())


def used(estimate: PooledEstimate, campaign: CampaignResult) -> str:
    """Say of how many sessions an estimate is, and of how many it is not."""
    every = len(campaign.sessions)
    return f"{estimate.sessions}{f' of {every}' if estimate.sessions < every else ''} sessions"


def exactly(campaign: CampaignResult) -> str:
    """Return the condition of the types' pooled estimates, nothing where they are the headline."""
    return f", {EXACT_CONDITION}" if campaign.modal and campaign.modal.leads else ""


def pooled_table(campaign: CampaignResult, only: PooledEstimate | None = None) -> Table:
    """Pooled whole-record estimates, the headline's first, then the lowest BIC first.

    Parameters
    ----------
    campaign : CampaignResult
    only : PooledEstimate, optional
        The one to be shown. Without it, as in the files, all of them, and behind them what is not
        pooled, without values.
    """
    withheld = campaign.verdict.withheld if campaign.verdict else frozenset[str]()
    found, headline = campaign.homogeneity, campaign.headline
    columns = (
        Column("parameter", "parameter", WORDS),
        Column("pooled", "value"), Column("std", "std", spread=True),
        Column("95 % from", "low_95"), Column("to", "high_95"),
        Column("one session's std", "within_std"), Column("between sessions", "between_std"),
        Column("p", "p_value"),
    )  # fmt: skip
    if only is None:
        pooled = sorted(campaign.pooled, key=lambda each: each is not headline)
        rows = [
            _pooled_row(estimate, each, campaign, withheld)
            for estimate in pooled
            for each in estimate.parameters
        ]
        rows += [
            {
                "type": each.structure,
                "name": each.name,
                "headline": False,
                "sessions": each.determined,
                "misfit": each.misfit,
                "parameter": parameter,
                "reported": False,
            }
            for each in campaign.structures
            if not each.pooled
            for parameter in STRUCTURES[each.structure].free
        ]
        return Table("pooled", "Pooled whole-record estimates", columns, tuple(rows))
    role = "freest structure"
    if only is not headline:
        role = "lowest BIC; valid only if it is the true one"
    role += exactly(campaign)
    notes = [
        "One session's std: standard deviation that a typical session states. Between sessions: "
        "standard deviation between sessions beyond that (τ). p: p-value of Cochran's Q. "
        f"Residual {only.misfit:.4g} times the noise."
    ]
    if unreported(STRUCTURES[only.structure], withheld):
        notes += footnotes(withheld)
    if any(found.is_mixed(each.name) for each in only.parameters):
        notes.append(MIXTURE_NOTE)
    return Table(
        f"pooled_{only.name.replace(', ', '_').replace(' ', '_')}",
        title(f"Pooled over {used(only, campaign)}: type {only.name} ({role})", found),
        columns,
        tuple(_pooled_row(only, each, campaign, withheld) for each in only.parameters),
        tuple(notes),
    )


def _pooled_row(
    pooled: PooledEstimate,
    each: PooledParameter,
    campaign: CampaignResult,
    withheld: Collection[str],
) -> Row:
    found = campaign.homogeneity
    _, factor, _ = label(each.name)
    value, std, low, high = estimate((each.value, each.std, *each.interval), each.std, factor)
    reported = each.name not in unreported(STRUCTURES[pooled.structure], withheld)
    if not reported:
        value = marked(value)
    else:
        # Let the eye stop at what can be used only.
        value = greyed(value) if found.is_mixed(each.name) else replace(value, strong=True)
    return {
        "type": pooled.structure,
        "name": pooled.name,
        "headline": pooled is campaign.headline,
        "sessions": pooled.sessions,
        "bic": pooled.bic,
        "misfit": pooled.misfit,
        "parameter": Cell(each.name, with_mark(with_unit(each.name), each.name, found)),
        "value": value,
        "std": std,
        "low_95": low,
        "high_95": high,
        "within_std": number(each.within_std, ".2g", factor),
        "between_std": number(each.between_std, ".2g", factor),
        "p_value": chance_cell(each.chance),
        "next_low_95": each.next_interval[0],
        "next_high_95": each.next_interval[1],
        "reported": reported,
        "mixture": found.is_mixed(each.name),
    }


def tolerant_table(campaign: CampaignResult) -> Table:
    """Parameters of all sessions with a tolerance of the geometry, with those of an exact beam.

    Without rows where no tolerance is stated.
    """
    modal, numbers = campaign.modal, campaign_numbers(campaign)
    tolerant = modal.tolerant if modal else None
    columns = (
        Column("parameter", "parameter", WORDS), Column("value", "value"),
        Column("std", "std", spread=True),
        Column("95 % from", "low_95"), Column("to", "high_95"),
        Column(EXACT_CONDITION, "exact"), Column("std", "exact_std", spread=True),
    )  # fmt: skip
    if modal is None or tolerant is None or numbers is None:
        return Table("parameters", "", columns, ())
    exact = numbers.exact.parameters if numbers.exact else {}
    rows: list[Row] = []
    for name, quantity in numbers.parameters.items():
        _, factor, _ = label(name)
        low, high = quantity.interval_95 or (None, None)
        value, *others = estimate(
            (quantity.value, quantity.std, low, high), quantity.std or None, factor
        )
        its = exact.get(name)
        of_exact = estimate((its.value, its.std), its.std, factor) if its else (None, None)
        rows.append(
            {
                "parameter": Cell(name, with_mark(with_unit(name), name, campaign.homogeneity)),
                "value": marked(value) if quantity.flag else replace(value, strong=True),
                **dict(zip(("std", "low_95", "high_95"), others, strict=True)),
                **dict(zip(("exact", "exact_std"), of_exact, strict=True)),
                "uniformity_percent": 100 * tolerant.uniformity,
                "basis": tolerant.basis,
                "flag": quantity.flag,
            }
        )
    flags = dict.fromkeys(each.flag for each in numbers.parameters.values() if each.flag)
    return Table(
        "parameters",
        title(
            f"Parameters from the modal constants of {modal.sessions} sessions"
            + (
                f", uniform to {100 * tolerant.uniformity:g} %"
                if tolerant.basis == "geometry"
                else ""
            ),
            campaign.homogeneity,
        ),
        columns,
        tuple(rows),
        (
            "The tolerance of the geometry is common to all sessions: more of them do not reduce "
            "it.",
            *(f"{MARK} {flag}." for flag in flags),
        ),
    )


def uniform_beam_table(campaign: CampaignResult) -> Table:
    """Modal constants of all sessions against those of the uniform beam that fits best."""
    modal, found = campaign.modal, campaign.homogeneity
    test = modal.uniform_beam if modal else None
    rows: list[Row] = []
    for constant in test.as_json()["constants"] if test else ():
        measured, std, predicted = (constant[key] for key in ("measured", "std", "predicted"))
        value, spread, theirs = estimate((measured, std, predicted), std)
        rows.append(
            {
                "mode": constant["mode"],
                "constant": Cell(constant["name"], constant["name"].replace("_", " ")),
                "measured": value,
                "std": spread,
                "predicted": theirs,
                "deviation": (measured - predicted) / std,
            }
        )
    return Table(
        "uniform_beam",
        title("Modal constants, and those of the uniform beam that fits best", found),
        (
            Column("mode", "mode"), Column("constant", "constant", WORDS),
            Column("measured", "measured"), Column("std", "std", spread=True),
            Column("uniform beam", "predicted"), Column("difference (std)", "deviation", ".1f"),
        ),
        tuple(rows),
    )  # fmt: skip


def modes_table(campaign: CampaignResult) -> Table:
    """Modes over all sessions."""
    found = campaign.homogeneity
    rows: list[Row] = []
    for mode in campaign.modes:
        shown: dict[str, Entry] = {"mode": mode.number}
        for name, std, between, factor in (
            ("frequency_hz", "frequency_std_hz", "frequency_between_std_hz", 1.0),
            ("damping_ratio", "damping_ratio_std", "damping_ratio_between_std", 100.0),
        ):
            its = getattr(mode, std)
            mean, shown[std] = estimate((getattr(mode, name), its), its, factor)
            text = with_mark(mean.text, f"{name}_{mode.number}", found)
            shown[name] = replace(mean, text=text)
            shown[between] = number(getattr(mode, between), ".2g", factor)
        its = mode.participation_std_kg_m2
        value, spread = estimate((mode.participation_kg_m2, its), its, 1e6)
        shown |= {"participation_kg_m2": value, "participation_std_kg_m2": spread}
        rows.append(
            {
                **shown,
                "source": mode.source,
                "frequency_mixture": found.is_mixed(f"frequency_hz_{mode.number}"),
                "damping_ratio_mixture": found.is_mixed(f"damping_ratio_{mode.number}"),
            }
        )
    mixed = any(row["frequency_mixture"] or row["damping_ratio_mixture"] for row in rows)
    return Table(
        "pooled_modes",
        title("Modes with locked hub (clamped–free), mean of the sessions", found),
        (
            Column("mode", "mode"),
            Column("frequency (Hz)", "frequency_hz"),
            Column("std", "frequency_std_hz", spread=True),
            Column("between sessions", "frequency_between_std_hz"),
            Column("damping ratio (%)", "damping_ratio"),
            Column("std", "damping_ratio_std", spread=True),
            Column("between sessions", "damping_ratio_between_std"),
            *(_PARTICIPATION if any(row["source"] == "modal" for row in rows) else ()),
        ),
        tuple(rows),
        (MIXTURE_NOTE,) if mixed else (),
    )


# Homogeneity


def specimens_table(campaign: CampaignResult) -> Table:
    """Specimens as the files state them, the one of this campaign first."""
    specimens = campaign.homogeneity.specimens
    return Table(
        "specimens",
        "Specimens, as the files state them",
        (
            Column("this report's", "here", WORDS),
            *(Column(key, key, WORDS) for key in in_dispute(specimens)),
            Column("files", "files"),
            Column("their names", "names", WORDS),
        ),
        tuple(
            {
                **{key: Cell(value, fact_text(key, value)) for key, value in each.facts.items()},
                "files": len(each.files),
                "here": each is specimens[0],
                "names": Cell(" ".join(each.files), ", ".join(each.files)),
            }
            for each in specimens
        ),
        selected=0,
    )


def homogeneity_table(campaign: CampaignResult) -> Table:
    """Scatter of each mode and parameter between sessions."""
    found = campaign.homogeneity

    def row(each: Heterogeneity) -> Row:
        _, factor, _ = label(each.quantity)
        return {
            "quantity": Cell(
                each.quantity, with_mark(with_unit(each.quantity), each.quantity, found)
            ),
            "sessions": len(each.values),
            "mean": number(each.mean, f".{_digits(each)}f", factor),
            "between_std": number(each.between_std, ".2g", factor),
            "between_in_own_std": each.own_stds,
            "cochran_q": each.cochran_q,
            "i_squared": replace(number(each.i_squared), text=percent(each.i_squared)),
            "p_value": chance_cell(each.chance),
            "mixture": each.mixed,
        }

    return Table(
        "homogeneity",
        f"Homogeneity of the sessions{f', by type {found.structure}' if found.structure else ''}",
        (
            Column("quantity", "quantity", WORDS), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("τ/s", "between_in_own_std", ".3g"),
            Column("Cochran's Q", "cochran_q", ".3g"),
            Column("I²", "i_squared"), Column("p", "p_value"),
        ),
        tuple(map(row, found.quantities)),
        (
            "Between sessions: standard deviation beyond the sessions' own uncertainties (τ). τ/s: "
            "the same over a typical session's own. I²: its share of the variance. p: p-value of "
            "Cochran's Q.",
            *([MIXTURE_NOTE] if found.mixed else []),
        ),
    )  # fmt: skip


def _digits(each: Heterogeneity) -> int:
    """Decimals that show the scatter, or what a session states as its uncertainty."""
    _, factor, _ = label(each.quantity)
    seen = factor * max(each.between_std, min(std for _, _, std in each.values))
    return min(decimals(seen), 9)


def chance_cell(chance: float) -> Cell:
    """Show a probability that may be too small for a number."""
    return replace(number(chance), text=probability(chance))


def with_mark(text: str, quantity: str, found: Homogeneity) -> str:
    """Mark a text if sessions differ in the quantity in kind."""
    return f"{text} {MIXTURE_MARK}" if found.is_mixed(quantity) else text
