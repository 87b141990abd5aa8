"""Tables of a campaign for the terminal and for text files."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.table import Table as RichTable
from rich.text import Text

from analysis.campaigns import (
    MIXTURE_MARK,
    MIXTURE_NOTE,
    best_models,
    by_model,
    in_dispute,
    label,
    lost_trials,
    percent,
    probability,
    specimens,
    title,
    told,
    with_unit,
)
from analysis.models import STRUCTURES
from analysis.report import _paper_numbers as paper
from analysis.report._table import MARK, Column, Table, count, footnotes, number, unreported
from analysis.report._text import with_spread

if TYPE_CHECKING:
    from collections.abc import Collection

    import rich.table
    from rich.console import RenderableType
    from rich.table import Table as RichTable

    from analysis.campaigns import (
        Campaign,
        CampaignVerdict,
        Heterogeneity,
        Homogeneity,
        PooledEstimate,
    )


def text_table(title: str) -> RichTable:
    """Make a table without rows, as wide as its title at least."""
    return RichTable(
        min_width=len(title),
        title=Text(title, style="bold"), title_justify="left", caption_justify="left",
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip


_CAPTION: Final = "Sessions, as their files state them"
_COLUMNS: Final = {
    "file": "file",
    "start_utc": "recorded (UTC)",
    "specimen": "specimen",
    "operator": "operator",
    "note": "note",
    "used": "used",
}
"""Key in CSV and JSON → heading."""

_ABSENT: Final = "–"


def session_list_rows(campaign: Campaign) -> list[dict[str, Any]]:
    """List all files, those that were left out behind the others.

    Parameters
    ----------
    campaign : Campaign
    """
    return [
        {
            "file": str(each.path),
            "start_utc": said.start_utc if said else "",
            "specimen": said.label if said else "",
            "operator": said.operator if said else "",
            "note": said.note if said else "",
            "used": used,
        }
        for used, group in ((True, campaign.sessions), (False, campaign.failures))
        for each in group
        for said in (each.experiment,)
    ]


def session_list_text(campaign: Campaign) -> rich.table.Table:
    """Make the table for the terminal."""
    table = text_table(_CAPTION)
    for heading in _COLUMNS.values():
        table.add_column(heading)
    for cells in _cells(campaign):
        table.add_row(*map(Text, cells))
    return table


def session_list_table(campaign: Campaign) -> Table:
    """Make the table for the page."""
    return Table(
        name="session_list",
        caption=_CAPTION,
        columns=tuple(Column(heading, key, numeric=False) for key, heading in _COLUMNS.items()),
        rows=tuple(_cells(campaign)),
    )


def _cells(campaign: Campaign) -> list[tuple[str, ...]]:
    paths = [each.path for each in campaign.sessions]
    paths += [each.path for each in campaign.failures]
    return [
        (
            path.name,
            *(str(row[key]) or _ABSENT for key in ("start_utc", "specimen", "operator", "note")),
            "yes" if row["used"] else "no",
        )
        for path, row in zip(paths, session_list_rows(campaign), strict=True)
    ]


_FACTORS: Final = {"zeta": ("ζ (1e-4)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (1e-1)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and factor of each parameter, the powers of ten of the paper's Table 3."""
_STATISTICS: Final = ("mean", "median", "std", "min", "max")
NO_VERDICT: Final = (
    "No verdict on the whole records: it takes two sessions that determine a structure's damping."
)
NOT_POOLED: Final = (
    "in grey: not pooled, since fewer than two sessions determine its damping, or not all tried it"
)


def campaign_tables(campaign: Campaign, *, with_paper: bool = False) -> RenderableType:
    """Return the verdict, what it rests on, and the paper's Tables 3 to 5."""
    parts: list[RenderableType] = []
    if campaign.verdict is not None:
        parts.extend((verdict_text(campaign.verdict), ""))
    else:
        for sentence in without_verdict(campaign):
            parts.extend((Text(sentence, style="bold"), ""))
    parts.extend((session_list_text(campaign), ""))
    found = campaign.homogeneity
    if len(found.specimens) > 1:
        parts.extend((specimens_text_table(found), ""))
    if found.mixed:
        parts.extend((scatter_text_table(found), ""))
    withheld = campaign.verdict.withheld if campaign.verdict else ()
    for estimate in likely_estimates(campaign):
        parts.extend((pooled_table(estimate, campaign, withheld), ""))
    if campaign.structures:
        parts.extend((candidates_table(campaign), ""))
    if campaign.validation:
        parts.extend((validation_table(campaign), ""))
    if campaign.nominal:
        parts.extend(
            (
                statistics_table(campaign, with_paper=with_paper), "",
                peaks_table(campaign, with_paper=with_paper), "",
                best_table(campaign, with_paper=with_paper), "",
            )
        )  # fmt: skip
    parts.extend(
        Text(f"Warning: {session.path.name}: {warning}", style="yellow")
        for session in campaign.sessions
        for warning in session.warnings
    )
    return Group(*parts)


def without_verdict(campaign: Campaign) -> list[str]:
    """Say what a verdict would have said first, and why there is none."""
    asked = any(each.record_estimates for each in campaign.sessions)
    return [
        *specimens(campaign.homogeneity),
        *([NO_VERDICT] if asked else []),
        *lost_trials(campaign.lost_trials, campaign.trials),
    ]


def tables_text(campaign: Campaign, *, with_paper: bool = False, width: int = 120) -> str:
    """Return the same as plain text, with the files that were left out."""
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(campaign_tables(campaign, with_paper=with_paper))
        for failure in campaign.failures:
            console.print(Text(f"Left out: {failure.message}"))
    return capture.get()


def statistics_table(campaign: Campaign, *, with_paper: bool) -> RichTable:
    """Table 3; the paper's numbers follow in parentheses."""
    count = len(campaign.sessions)
    table = text_table(title(f"Parameters over {count} sessions (Table 3)", campaign.homogeneity))
    for heading in ("type", "weights", "parameter", *_STATISTICS):
        table.add_column(heading, justify="right" if heading in _STATISTICS else "left")
    for place, each in enumerate(campaign.statistics):
        heading, factor = _FACTORS[each.parameter]
        told = paper.table3().get((each.structure, each.weighting, each.parameter))
        cells = []
        for name in _STATISTICS:
            text = f"{factor * getattr(each, name):.3f}"
            if with_paper and told is not None:
                text += f" ({factor * getattr(told, name):.4g})"
            cells.append(text)
        rest = f" *{each.at_bounds}" if each.at_bounds else ""
        following = campaign.statistics[place + 1 : place + 2]
        table.add_row(
            each.structure, each.weighting, heading + rest, *cells,
            end_section=not following or following[0].structure != each.structure,
        )  # fmt: skip
    notes = ["in parentheses: the paper's"] if with_paper else []
    if any(each.at_bounds for each in campaign.statistics):
        notes.append("*n: in n sessions on the edge of the range searched")
    table.caption = "; ".join(notes) or None
    return table


def peaks_table(campaign: Campaign, *, with_paper: bool) -> RichTable:
    """Table 4: mean deviation of the resonant peaks from those of the nominal models."""
    table = text_table(
        title(
            "Mean deviation of the resonant peaks from the nominal model's (Table 4)",
            campaign.homogeneity,
        )
    )
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


def best_table(campaign: Campaign, *, with_paper: bool) -> RichTable:
    """Table 5: parameters and weighted error of the two best nominal models."""
    table = text_table(
        title("The two best nominal models (Table 5; peaks in Table 4)", campaign.homogeneity)
    )
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


def verdict_text(verdict: CampaignVerdict) -> Text:
    """Write the verdict, one sentence a line, and what would tell more."""
    first, *others = verdict.sentences
    text = Text(first, style="bold")
    for sentence in others:
        text.append(f"\n{sentence}", style="not bold")
    if verdict.experiments:
        text.append("\nWhat would tell more:", style="not bold")
        for advice in verdict.experiments:
            text.append(f"\n  {advice}", style="not bold")
    return text


def candidates_table(campaign: Campaign) -> RichTable:
    """All structures fitted, those pooled first, the lowest BIC first."""
    table = text_table(
        title("Structures on the whole records of all sessions together", campaign.homogeneity)
    )
    table.add_column("type")
    for heading in ("fitted", "determined", "BIC above the lowest", "residual (noise = 1)",
                    "selected alone"):  # fmt: skip
        table.add_column(heading, justify="right")
    for each in campaign.structures:
        bic = each.bic_above_lowest
        table.add_row(
            each.name, str(each.fitted), str(each.determined),
            _ABSENT if bic is None else f"{bic:.1f}", f"{each.misfit:.4g}",
            str(each.selected_alone), style="" if each.pooled else "dim",
        )  # fmt: skip
    table.caption = (
        "in how many sessions it was fitted, determines its damping, and has the lowest BIC alone"
    )
    if not all(each.pooled for each in campaign.structures):
        table.caption += f"; {NOT_POOLED}"
    return table


def likely_estimates(campaign: Campaign) -> list[PooledEstimate]:
    """Return the headline's estimate, and the one of the lowest BIC, which is conditional."""
    found = {each.name: each for each in (campaign.headline, *campaign.pooled[:1]) if each}
    return list(found.values())


def role(estimate: PooledEstimate, campaign: Campaign) -> str:
    """Say what an estimate shown is for."""
    if estimate is campaign.headline:
        return "freest structure"
    return "lowest BIC, conditional on its being the true one"


def used(estimate: PooledEstimate, campaign: Campaign) -> str:
    """Say of how many sessions an estimate is, and of how many it is not."""
    every = len(campaign.sessions)
    return f"{estimate.sessions}{f' of {every}' if estimate.sessions < every else ''} sessions"


def pooled_table(
    estimate: PooledEstimate, campaign: Campaign, withheld: Collection[str] = ()
) -> RichTable:
    """Pooled whole-record estimate of one structure; orders withheld and mixtures are marked."""
    found = campaign.homogeneity
    table = text_table(
        title(
            f"Pooled whole-record estimate, type {estimate.name}, {used(estimate, campaign)} "
            f"({role(estimate, campaign)}); residual {estimate.misfit:.4g} times the noise",
            found,
        )
    )
    table.add_column("parameter")
    for heading in ("pooled ±std", "95 % interval", "one session's std", "between sessions", "p"):
        table.add_column(heading, justify="right")
    doubtful = unreported(STRUCTURES[estimate.structure], withheld)
    for each in estimate.parameters:
        _, factor, _ = label(each.name)
        low, high = (factor * end for end in each.interval)
        digits = max(2 - math.floor(math.log10(max(high - low, 1e-12))), 0)
        marked = each.name in doubtful
        marks = (MARK if marked else "") + (MIXTURE_MARK if found.is_mixed(each.name) else "")
        table.add_row(
            f"{with_unit(each.name)} {marks}".rstrip(),
            with_spread(factor * each.value, factor * each.std),
            f"{low:.{digits}f} … {high:.{digits}f}",
            f"{factor * each.within_std:.2g}", f"{factor * each.between_std:.2g}",
            probability(each.chance), style="dim" if marked else "",
        )  # fmt: skip
    notes = footnotes(withheld) if doubtful else ()
    if any(found.is_mixed(each.name) for each in estimate.parameters):
        notes = (*notes, MIXTURE_NOTE)
    table.caption = " ".join(notes) or None
    return table


def validation_table(campaign: Campaign) -> RichTable:
    """Errors of left-out sessions, the best model first."""
    table = text_table("Each session predicted from the others: rms error of the torque, %")
    for heading in ("method", "type", "weights"):
        table.add_column(heading)
    for heading in ("sessions", "mean", "worst", "own fit"):
        table.add_column(heading, justify="right")
    for method, structure, weighting, errors in by_model(campaign.validation):
        values = 100 * np.array([each.error for each in errors])
        own = [each.own_error for each in errors if each.own_error is not None]
        table.add_row(
            method, structure, weighting or "", f"{values.size} of {campaign.trials}",
            f"{values.mean():.2f}", f"{values.max():.2f}",
            f"{100 * float(np.mean(own)):.2f}" if own else _ABSENT,
        )  # fmt: skip
    notes = [
        "own fit: of the session's own whole-record fit, noise included",
        *lost_trials(campaign.lost_trials, campaign.trials),
    ]
    table.caption = ". ".join(notes)
    return table


_SPECIMENS: Final = "Specimens, as the files state them"
_SCATTER_NOTE: Final = (
    "Between sessions: scatter beyond their own uncertainties. I²: share of the variance that is "
    "such scatter. p: probability of so much by the uncertainties alone."
)


def specimens_text_table(found: Homogeneity) -> rich.table.Table:
    """Specimens that the files state, the one of this campaign first."""
    table = text_table(_SPECIMENS)
    for heading in _specimen_headings(found):
        table.add_column(heading)
    for row in _specimen_cells(found):
        table.add_row(*row)
    return table


def specimens_table(found: Homogeneity) -> Table:
    """Make the same for the page."""
    headings = _specimen_headings(found)
    return Table(
        name="specimens",
        caption=_SPECIMENS,
        columns=tuple(Column(heading, heading, numeric=False) for heading in headings),
        rows=tuple(_specimen_cells(found)),
        selected=0,
    )


def _specimen_headings(found: Homogeneity) -> tuple[str, ...]:
    return ("specimen", *in_dispute(found.specimens), "files", "their names")


def _specimen_cells(found: Homogeneity) -> list[tuple[str, ...]]:
    keys = in_dispute(found.specimens)
    return [
        (
            f"{place}" if place > 1 else "1 (this report)",
            *(told(key, each.facts[key]) for key in keys),
            str(len(each.paths)),
            ", ".join(path.name for path in each.paths),
        )
        for place, each in enumerate(found.specimens, start=1)
    ]


def scatter_text_table(found: Homogeneity) -> rich.table.Table:
    """Scatter of each mode and parameter between sessions."""
    table = text_table(_scatter(found))
    table.add_column("quantity")
    for heading in ("sessions", "mean", "between sessions", "in own std", "Q", "I²", "p"):
        table.add_column(heading, justify="right")
    for each in found.quantities:
        _, factor, _ = label(each.quantity)
        table.add_row(
            _name(each), str(len(each.values)), f"{factor * each.mean:.{_digits(each)}f}",
            f"{factor * each.between_std:.2g}", f"{each.own_stds:.3g}", f"{each.cochran_q:.3g}",
            percent(each.i_squared), probability(each.chance),
        )  # fmt: skip
    table.caption = MIXTURE_NOTE
    return table


def scatter_table(found: Homogeneity) -> Table:
    """Make the same for the page."""
    return Table(
        name="homogeneity",
        caption=_scatter(found),
        columns=(
            Column("quantity", "quantity", numeric=False), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("in own std", "between_in_own_std"), Column("Cochran's Q", "cochran_q"),
            Column("I²", "i_squared"), Column("p", "chance"),
        ),
        rows=tuple(
            (
                _name(each), count(len(each.values)),
                number(each.mean, f".{_digits(each)}f", label(each.quantity)[1]),
                number(each.between_std, ".2g", label(each.quantity)[1]),
                number(each.own_stds, ".3g"), number(each.cochran_q, ".3g"),
                replace(number(each.i_squared, ".3g"), text=percent(each.i_squared)),
                replace(number(each.chance, ".2g"), text=probability(each.chance)),
            )
            for each in found.quantities
        ),
        notes=(_SCATTER_NOTE, *([MIXTURE_NOTE] if found.mixed else [])),
    )  # fmt: skip


def _scatter(found: Homogeneity) -> str:
    by = f", all by type {found.structure}" if found.structure else ""
    return f"Sessions compared{by}"


def _name(each: Heterogeneity) -> str:
    return f"{with_unit(each.quantity)} {MIXTURE_MARK if each.mixed else ''}".rstrip()


def _digits(each: Heterogeneity) -> int:
    """Decimals that show the scatter, or what a session states as its uncertainty."""
    _, factor, _ = label(each.quantity)
    seen = factor * max(each.between_std, min(std for _, _, std in each.values))
    return min(max(1 - math.floor(math.log10(seen)), 0), 9)
