"""Tables of a campaign for the terminal and for text files."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from analysis.campaigns import paper
from analysis.campaigns.nominal import best_models
from analysis.campaigns.pooled import best_estimate
from analysis.campaigns.pooled_figure import NAMES
from analysis.campaigns.validation import by_model
from analysis.report.tables import with_spread
from analysis.structures import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from analysis.campaigns.campaign import Campaign
    from analysis.campaigns.pooled import PooledEstimate

_FACTORS: Final = {"zeta": ("ζ (1e-4)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (1e-1)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and factor of each parameter, the powers of ten of the paper's Table 3."""
_STATISTICS: Final = ("mean", "median", "std", "min", "max")
_ABSENT: Final = "–"
_SIGNIFICANT: Final = 0.01
_CLOSE: Final = 1.02
_WRONG: Final = 1.5
"""Residual, in units of the noise, from which a structure is called wrong."""


def campaign_tables(campaign: Campaign, *, with_paper: bool = False) -> RenderableType:
    """Return Tables 3 to 5, the pooled estimate and the validation, with what they mean."""
    parts: list[RenderableType] = [
        statistics_table(campaign, with_paper=with_paper), "",
        peaks_table(campaign, with_paper=with_paper), "",
        best_table(campaign, with_paper=with_paper), "",
    ]  # fmt: skip
    if campaign.pooled:
        for estimate in likely_estimates(campaign.pooled):
            parts.extend((pooled_table(estimate), ""))
        parts.extend((Text(pooled_meaning(campaign)), ""))
    if campaign.validation:
        parts.extend((validation_table(campaign), ""))
    parts.extend(
        Text(f"Warning: {session.path.name}: {warning}", style="yellow")
        for session in campaign.sessions
        for warning in session.warnings
    )
    parts.extend(Text(f"Not used: {each.message}", style="red") for each in campaign.failures)
    return Group(*parts)


def tables_text(campaign: Campaign, *, with_paper: bool = False, width: int = 120) -> str:
    """Return the same as plain text."""
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(campaign_tables(campaign, with_paper=with_paper))
    return capture.get()


def statistics_table(campaign: Campaign, *, with_paper: bool) -> Table:
    """Table 3; the paper's numbers follow in parentheses."""
    table = _table(f"Parameters over {len(campaign.sessions)} sessions (Table 3)")
    for heading in ("type", "weights", "parameter", *_STATISTICS):
        table.add_column(heading, justify="right" if heading in _STATISTICS else "left")
    for number, each in enumerate(campaign.statistics):
        heading, factor = _FACTORS[each.parameter]
        told = paper.table3().get((each.structure, each.weighting, each.parameter))
        cells = []
        for name in _STATISTICS:
            text = f"{factor * getattr(each, name):.3f}"
            if with_paper and told is not None:
                text += f" ({factor * getattr(told, name):.4g})"
            cells.append(text)
        rest = f" *{each.at_bounds}" if each.at_bounds else ""
        following = campaign.statistics[number + 1 : number + 2]
        table.add_row(
            each.structure, each.weighting, heading + rest, *cells,
            end_section=not following or following[0].structure != each.structure,
        )  # fmt: skip
    notes = ["in parentheses: the paper's"] if with_paper else []
    if any(each.at_bounds for each in campaign.statistics):
        notes.append("*n: in n sessions on the edge of the range searched")
    table.caption = "; ".join(notes) or None
    return table


def peaks_table(campaign: Campaign, *, with_paper: bool) -> Table:
    """Table 4: mean deviation of the resonant peaks from those of the nominal models."""
    table = _table("Mean deviation of the resonant peaks from the nominal model's (Table 4)")
    for heading in ("type", "weights"):
        table.add_column(heading)
    modes = len(campaign.nominal[0].deviations)
    for quantity in ("ω{} (rad/s)", "M{} (dB)"):
        for mode in range(1, modes + 1):
            table.add_column(quantity.format(mode), justify="right")
    for model in campaign.nominal:
        cells = []
        for quantity in ("frequency_rad_s", "magnitude_db"):
            for deviation in model.deviations:
                value = getattr(deviation, quantity)
                text = f"{value:.3f}" if math.isfinite(value) else _ABSENT
                key = (model.structure, model.weighting, quantity, deviation.mode)
                if with_paper and key in paper.table4():
                    text += f" ({paper.table4()[key]:.3f})"
                cells.append(text)
        last = model.weighting == campaign.nominal[-1].weighting
        table.add_row(model.structure, model.weighting, *cells, end_section=last)
    table.caption = "in parentheses: the paper's" if with_paper else None
    return table


def best_table(campaign: Campaign, *, with_paper: bool) -> Table:
    """Table 5: parameters and weighted error of the two best nominal models."""
    table = _table("The two best nominal models (Table 5; peaks in Table 4)")
    for heading in ("type", "weights", "α", "ζ (1e-5)", "λ", "γ (1e-2)", "WMSE ((N·m/rad)²)"):
        table.add_column(heading, justify="left" if heading in ("type", "weights") else "right")
    for model in best_models(campaign.nominal):
        values = model.parameters
        told = paper.table5_wmse().get((model.structure, model.weighting))
        table.add_row(
            model.structure, model.weighting, f"{values['alpha']:.3f}",
            f"{1e5 * values['zeta']:.2f}", f"{values['lambda']:.3f}",
            f"{1e2 * values['gamma']:.2f}",
            f"{model.mean_wmse:.3f}" + (f" ({told:.3f})" if with_paper and told else ""),
        )  # fmt: skip
    return table


def likely_estimates(estimates: Sequence[PooledEstimate]) -> list[PooledEstimate]:
    """Return the best estimate, and after it those whose residual is next to as small."""
    best = best_estimate(estimates)
    close = [e for e in estimates if e is not best and e.misfit < _CLOSE * best.misfit]
    return [best, *sorted(close, key=lambda e: e.bic)]


def pooled_table(estimate: PooledEstimate) -> Table:
    """Pooled whole-record estimate of one structure."""
    table = _table(
        f"Pooled whole-record estimate, type {estimate.structure}, {estimate.sessions} sessions; "
        f"residual {estimate.misfit:.4g} times the noise, BIC {estimate.bic:.1f}"
    )
    table.add_column("parameter")
    for heading in ("pooled ±std", "95 % interval", "one session's std", "between sessions", "p"):
        table.add_column(heading, justify="right")
    for each in estimate.parameters:
        symbol, factor, unit = NAMES[each.name]
        low, high = (factor * end for end in each.interval)
        digits = max(2 - math.floor(math.log10(max(high - low, 1e-12))), 0)
        table.add_row(
            f"{symbol} ({unit})" if unit else symbol,
            with_spread(factor * each.value, factor * each.std),
            f"{low:.{digits}f} … {high:.{digits}f}",
            f"{factor * each.within_std:.2g}", f"{factor * each.between_std:.2g}",
            f"{each.chance:.2g}",
        )  # fmt: skip
    return table


def pooled_meaning(campaign: Campaign) -> str:
    """Say in words what the pooled estimate tells."""
    estimate = best_estimate(campaign.pooled)
    if estimate.misfit > _WRONG:
        first = (
            f"The residual of type {estimate.structure} is {estimate.misfit:.3g} times the noise: "
            "no structure tried describes the beam, and standard deviations mean little."
        )
    else:
        first = (
            f"Type {estimate.structure} has the lowest BIC, each session with parameters of its "
            "own; beyond noise it leaves nothing to describe."
        )
    for each in likely_estimates(campaign.pooled)[1:]:
        first += _objection(estimate, each)
    moved = [NAMES[e.name][0] for e in estimate.parameters if e.chance < _SIGNIFICANT]
    if not moved:
        second = (
            "Sessions differ by no more than their own uncertainties (p: probability of so much "
            "scatter by these alone); they repeat."
        )
    else:
        second = (
            f"Sessions differ by more than their own uncertainties in {', '.join(moved)} (p: "
            "probability of so much scatter by these alone): something changes between sessions, "
            "such as clamp, temperature or motor, and the interval of one session alone is too "
            "narrow for the specimen."
        )
    return f"{first} {second}"


def _objection(best: PooledEstimate, other: PooledEstimate) -> str:
    """Say if a type that frees an order finds, over all sessions, another value than the best's."""
    found = ""
    fixed = dict[str, float](STRUCTURES[best.structure].fixed.items())
    for each in other.parameters:
        held = fixed.get(each.name) if each.name in ("alpha", "lambda") else None
        low, high = each.interval
        if held and not low <= held <= high:
            found += (
                f" But all sessions together put {NAMES[each.name][0]} of type {other.structure} "
                f"between {low:.4f} and {high:.4f}, and not at {held:g}."
            )
    return found


def validation_table(campaign: Campaign) -> Table:
    """Errors of left-out sessions, the best model first."""
    table = _table("Each session predicted from the others: rms error of the torque, %")
    for heading in ("method", "type", "weights"):
        table.add_column(heading)
    for heading in ("mean", "worst", "own fit"):
        table.add_column(heading, justify="right")
    for method, structure, weighting, errors in by_model(campaign.validation):
        values = 100 * np.array([each.error for each in errors])
        own = [each.own_error for each in errors if each.own_error is not None]
        table.add_row(
            method, structure, weighting or "", f"{values.mean():.2f}", f"{values.max():.2f}",
            f"{100 * float(np.mean(own)):.2f}" if own else _ABSENT,
        )  # fmt: skip
    table.caption = "own fit: of the session's own whole-record fit, noise included"
    return table


def _table(title: str) -> Table:
    return Table(
        title=Text(title, style="bold"), title_justify="left", caption_justify="left",
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip
