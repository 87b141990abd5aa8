"""Tables of a campaign, for the terminal, its page, CSV and JSON.

Beside the paper's Tables 3 to 5 its own numbers stand in parentheses, on request.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

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
    title,
    told,
    with_unit,
)
from analysis.models import STRUCTURES
from analysis.report import _paper_numbers as paper
from analysis.report._table import (
    ABSENT,
    WORDS,
    Cell,
    Column,
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
    from collections.abc import Callable, Collection, Mapping

    from analysis.campaigns import (
        Campaign,
        Heterogeneity,
        Homogeneity,
        PooledEstimate,
        PooledParameter,
        RankedStructure,
        SessionResult,
    )
    from analysis.report._table import Entry

    Row = Mapping[str, Entry]

_NAMES: Final = (Column("type", "type", WORDS), Column("weights", "weighting", WORDS))


def shown_tables(campaign: Campaign) -> tuple[Table, ...]:
    """Tables of the whole records that terminal and page show, what matters most first."""
    found = campaign.homogeneity
    estimates = likely_estimates(campaign)
    scatter = [homogeneity_table(campaign)] if found.quantities else []
    return (
        session_list_table(campaign),
        *([specimens_table(campaign)] if len(found.specimens) > 1 else []),
        *(scatter if found.mixed else []),
        *(pooled_table(campaign, each) for each in estimates[:1]),
        *([modes_table(campaign)] if campaign.headline and campaign.headline.modes else []),
        *(pooled_table(campaign, each) for each in estimates[1:]),
        *([structures_table(campaign)] if campaign.structures else []),
        *([validation_summary(campaign)] if campaign.validation else []),
        *([] if found.mixed else scatter),
    )


def paper_tables(campaign: Campaign, *, with_paper: bool = False) -> tuple[Table, ...]:
    """Tables 3 to 5, if there are Welch fits; on request with the paper's own numbers beside."""
    if not campaign.nominal:
        return ()
    return tuple(make(campaign, with_paper=with_paper) for make in (table3, table4, table5))


def all_tables(campaign: Campaign, *, with_paper: bool = False) -> dict[str, Table]:
    """Every table of the files by its name, without those that are empty."""
    made = (
        *paper_tables(campaign, with_paper=with_paper),
        session_list_table(campaign),
        sessions_welch_table(campaign),
        sessions_record_table(campaign),
        structures_table(campaign),
        *([specimens_table(campaign)] if len(campaign.homogeneity.specimens) > 1 else []),
        homogeneity_table(campaign),
        pooled_table(campaign),
        modes_table(campaign),
        validation_table(campaign),
    )
    return {table.name: table for table in made if table.rows}


_STATISTICS: Final = ("mean", "median", "std", "min", "max")
_TABLE_3: Final = {"zeta": ("ζ (10⁻⁴)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (10⁻¹)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
"""Heading and factor of each parameter, the powers of ten of the paper's Table 3."""
_ON_THE_EDGE: Final = "*n: in n sessions on the edge of the range searched."
_IN_PARENTHESES: Final = "In parentheses: the paper's."


def table3(campaign: Campaign, *, with_paper: bool = False) -> Table:
    """Statistics of the parameters."""
    rows: list[Row] = []
    for each in campaign.statistics:
        symbol, factor = _TABLE_3[each.parameter]
        theirs: dict[str, float | None] = {}
        if with_paper:
            papers = paper.table3().get((each.structure, each.weighting, each.parameter))
            theirs = {name: getattr(papers, name, None) for name in _STATISTICS}
        shown = {name: number(getattr(each, name), ".3f", factor) for name in _STATISTICS}
        rows.append(
            {
                "type": each.structure,
                "weighting": each.weighting,
                "parameter": Cell(
                    each.parameter, f"{symbol} *{each.at_bounds}" if each.at_bounds else symbol
                ),
                **_beside(shown, theirs, ".4g", factor),
                "at_bounds": each.at_bounds,
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table3",
        title(
            f"Parameters over {len(campaign.sessions)} sessions (Table 3)",
            campaign.homogeneity,
        ),
        (
            *_NAMES,
            Column("parameter", "parameter", WORDS),
            *(Column(name, name) for name in _STATISTICS),
        ),
        tuple(rows),
        (
            *([_ON_THE_EDGE] if any(each.at_bounds for each in campaign.statistics) else []),
            *([_IN_PARENTHESES] if with_paper else []),
        ),
        grouped=True,
    )


_PEAKS: Final = {"frequency_rad_s": "ω{} (rad/s)", "magnitude_db": "M{} (dB)"}


def table4(campaign: Campaign, *, with_paper: bool = False) -> Table:
    """Mean deviation of the resonant peaks; types in columns, as in the paper."""
    types = list(dict.fromkeys(model.structure for model in campaign.nominal))
    weightings = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    deviations = {
        (quantity, each.mode, model.weighting, model.structure): getattr(each, quantity)
        for quantity in _PEAKS
        for model in campaign.nominal
        for each in model.deviations
    }
    rows: list[Row] = []
    for quantity, mode, weighting in sorted(
        {key[:3] for key in deviations}, key=lambda key: (*key[:2], weightings.index(key[2]))
    ):
        its = (quantity, mode, weighting)
        shown = {
            each: number(deviations[*its, each], ".3f")
            for each in types
            if (*its, each) in deviations
        }
        theirs = {
            each: paper.table4().get((each, weighting, quantity, mode))
            for each in shown
            if with_paper
        }
        rows.append(
            {
                "quantity": Cell(quantity, _PEAKS[quantity].format(mode)),
                "mode": mode,
                "weighting": weighting,
                **_beside(shown, theirs, ".3f"),
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table4",
        title(
            "Mean deviation of the resonant peaks from the nominal model's (MDR, Table 4)",
            campaign.homogeneity,
        ),
        (
            Column("peak", "quantity", WORDS),
            Column("weights", "weighting", WORDS),
            *(Column(f"type {each}", each) for each in types),
        ),
        tuple(rows),
        (
            "A nominal model has the mean of the sessions' parameters.",
            *([_IN_PARENTHESES] if with_paper else []),
        ),
        grouped=True,
    )


def table5(campaign: Campaign, *, with_paper: bool = False) -> Table:
    """Parameters and performance of the two best nominal models."""
    rows: list[Row] = []
    for model in best_models(campaign.nominal):
        told_wmse = paper.table5_wmse().get((model.structure, model.weighting))
        theirs = {"wmse": told_wmse} if with_paper else {}
        rows.append(
            {
                "type": model.structure,
                "weighting": model.weighting,
                **{f"{name}": value for name, value in model.parameters.items()},
                **_beside({"wmse": number(model.mean_wmse, ".3f")}, theirs, ".3f"),
                **{
                    name: value
                    for each in model.deviations
                    for name, value in (
                        (f"mdr_omega{each.mode}_rad_s", each.frequency_rad_s),
                        (f"mdr_magnitude{each.mode}_db", each.magnitude_db),
                    )
                },
                **_papers(theirs),
                "mixture": campaign.homogeneity.mixed,
            }
        )
    return Table(
        "table5",
        title(
            "The two best nominal models (Table 5; their peaks are in Table 4)",
            campaign.homogeneity,
        ),
        (
            *_NAMES, Column("α", "alpha", ".3f"), Column("ζ (10⁻⁵)", "zeta", ".2f", 1e5),
            Column("λ", "lambda", ".3f"), Column("γ (10⁻²)", "gamma", ".2f", 1e2),
            Column("WMSE ((N·m/rad)²)", "wmse"),
        ),
        tuple(rows),
        (_IN_PARENTHESES,) if with_paper else (),
    )  # fmt: skip


def _beside(
    shown: Mapping[str, Cell], theirs: Mapping[str, float | None], form: str, factor: float = 1.0
) -> dict[str, Entry]:
    """Add the paper's numbers that there are, in parentheses."""
    told = {name: number(value, form, factor) for name, value in theirs.items()}
    return {
        name: replace(cell, text=f"{cell.text} ({told[name].text})")
        if theirs.get(name) is not None
        else cell
        for name, cell in shown.items()
    }


def _papers(theirs: Mapping[str, float | None]) -> dict[str, Entry]:
    """Give the paper's numbers to programs, too."""
    return {f"paper_{name}": value for name, value in theirs.items()}


def session_list_table(campaign: Campaign) -> Table:
    """All files, those that were left out behind the others."""

    def said(text: str) -> Cell:
        return Cell(text, text or ABSENT)

    headings = ("file", "recorded (UTC)", "specimen", "operator", "note", "used")
    keys = ("file", "start_utc", "specimen", "operator", "note", "used")
    return Table.of(
        "session_list",
        "Sessions, as their files state them",
        [Column(heading, key, WORDS) for heading, key in zip(headings, keys, strict=True)],
        (
            (
                Cell(str(each.path), each.path.name),
                said(its.start_utc if its else ""),
                said(its.label if its else ""),
                said(its.operator if its else ""),
                said(its.note if its else ""),
                used,
            )
            for used, group in ((True, campaign.sessions), (False, campaign.failures))
            for each in group
            for its in (each.experiment,)
        ),
    )


def sessions_welch_table(campaign: Campaign) -> Table:
    """Every session's Welch fits, and the nominal models' distance from it."""
    rows = [
        {
            "file": str(session.path),
            "type": fit.structure,
            "weighting": fit.weighting,
            **fit.parameters,
            "cost": fit.cost,
            "at_bounds": " ".join(fit.at_bounds),
            **{f"nominal_{name}": value for name, value in asdict(model.indices[place]).items()},
        }
        for place, session in enumerate(campaign.sessions)
        for fit, model in zip(session.welch_fits, campaign.nominal, strict=True)
    ]
    return _for_programs("sessions_welch", rows)


def sessions_record_table(campaign: Campaign) -> Table:
    """Every session's whole-record fits."""
    rows = [
        {
            "file": str(session.path),
            "type": each.structure,
            "uniform": each.uniform,
            **each.parameters,
            **{
                f"{name}_std": value if name in each.free else None
                for name, value in each.std.items()
            },
            "cost": each.cost,
            "degrees_of_freedom": each.degrees_of_freedom,
            "bic": each.bic,
            "at_bounds": " ".join(each.at_bounds),
        }
        for session in campaign.sessions
        for each in session.record_estimates
    ]
    return _for_programs("sessions_record", rows)


def _for_programs(name: str, rows: list[dict[str, Any]]) -> Table:
    """Make a table of files only."""
    return Table(name, "", (), tuple(rows))


NOT_POOLED: Final = (
    "In grey: not pooled, since fewer than two sessions determine its damping, or not all tried it."
)


def structures_table(campaign: Campaign) -> Table:
    """All structures on all whole records together, those pooled first, the lowest BIC first."""

    def row(each: RankedStructure) -> Row:
        grey: Callable[[Cell], Cell] = (lambda cell: cell) if each.pooled else greyed
        return {
            "type": Cell(each.structure, each.name),
            "uniform": each.uniform,
            "fitted": grey(count(each.fitted)),
            "sessions": grey(count(each.determined)),
            "bic_above_lowest": grey(number(each.bic_above_lowest, ".1f")),
            "misfit": grey(number(each.misfit)),
            "selected_alone": grey(count(each.selected_alone)),
            "pooled": each.pooled,
        }

    return Table(
        "structures",
        title("Structures on the whole records of all sessions together", campaign.homogeneity),
        (
            Column("type", "type", WORDS),
            Column("sessions fitted", "fitted"),
            Column("that determine it", "sessions"),
            Column("that select it alone", "selected_alone"),
            Column("BIC above the lowest", "bic_above_lowest"),
            Column("residual (noise = 1)", "misfit"),
        ),
        tuple(map(row, campaign.structures)),
        (
            "Damping and the modes' offsets are the specimen's, one value for all sessions (and a "
            "scatter between them, where they differ); settings of the rig are each session's.",
            *(() if all(each.pooled for each in campaign.structures) else (NOT_POOLED,)),
        ),
        selected=0 if campaign.pooled else None,
    )


def specimens_table(campaign: Campaign) -> Table:
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
                **{key: Cell(value, told(key, value)) for key, value in each.facts.items()},
                "files": len(each.paths),
                "here": each is specimens[0],
                "names": Cell(
                    " ".join(path.name for path in each.paths),
                    ", ".join(path.name for path in each.paths),
                ),
            }
            for each in specimens
        ),
        selected=0,
    )


def homogeneity_table(campaign: Campaign) -> Table:
    """Scatter of each mode and parameter between sessions."""
    found = campaign.homogeneity

    def row(each: Heterogeneity) -> Row:
        _, factor, _ = label(each.quantity)
        return {
            "quantity": Cell(
                each.quantity, _marked(with_unit(each.quantity), each.quantity, found)
            ),
            "sessions": len(each.values),
            "mean": number(each.mean, f".{_digits(each)}f", factor),
            "between_std": number(each.between_std, ".2g", factor),
            "between_in_own_std": each.own_stds,
            "cochran_q": each.cochran_q,
            "i_squared": replace(number(each.i_squared), text=percent(each.i_squared)),
            "chance": _chance(each.chance),
            "mixture": each.mixed,
        }

    return Table(
        "homogeneity",
        f"Sessions compared{f', all by type {found.structure}' if found.structure else ''}",
        (
            Column("quantity", "quantity", WORDS), Column("sessions", "sessions"),
            Column("mean", "mean"), Column("between sessions", "between_std"),
            Column("τ/s", "between_in_own_std", ".3g"),
            Column("Cochran's Q", "cochran_q", ".3g"),
            Column("I²", "i_squared"), Column("p", "chance"),
        ),
        tuple(map(row, found.quantities)),
        (
            "Between sessions: scatter beyond their own uncertainties. I²: share of the variance "
            "that is such scatter. p: probability of so much by the uncertainties alone.",
            *([MIXTURE_NOTE] if found.mixed else []),
        ),
    )  # fmt: skip


def _digits(each: Heterogeneity) -> int:
    """Decimals that show the scatter, or what a session states as its uncertainty."""
    _, factor, _ = label(each.quantity)
    seen = factor * max(each.between_std, min(std for _, _, std in each.values))
    return min(max(1 - math.floor(math.log10(seen)), 0), 9)


def _chance(chance: float) -> Cell:
    return replace(number(chance), text=probability(chance))


def _marked(text: str, quantity: str, found: Homogeneity) -> str:
    return f"{text} {MIXTURE_MARK}" if found.is_mixed(quantity) else text


def likely_estimates(campaign: Campaign) -> list[PooledEstimate]:
    """Return the headline's estimate, and the one of the lowest BIC, which is conditional."""
    found = {each.name: each for each in (campaign.headline, *campaign.pooled[:1]) if each}
    return list(found.values())


def used(estimate: PooledEstimate, campaign: Campaign) -> str:
    """Say of how many sessions an estimate is, and of how many it is not."""
    every = len(campaign.sessions)
    return f"{estimate.sessions}{f' of {every}' if estimate.sessions < every else ''} sessions"


def pooled_table(campaign: Campaign, only: PooledEstimate | None = None) -> Table:
    """Pooled whole-record estimates, the headline's first, then the lowest BIC first.

    Parameters
    ----------
    campaign : Campaign
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
        Column("p", "chance"),
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
                "uniform": each.uniform,
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
        role = "lowest BIC, conditional on its being the true one"
    notes = [
        "One session's std: what a session states as its own. Between sessions: scatter beyond "
        "that. p: probability of so much scatter by the sessions' own uncertainties alone. "
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
    pooled: PooledEstimate, each: PooledParameter, campaign: Campaign, withheld: Collection[str]
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
        "uniform": pooled.uniform,
        "name": pooled.name,
        "headline": pooled is campaign.headline,
        "sessions": pooled.sessions,
        "bic": pooled.bic,
        "misfit": pooled.misfit,
        "parameter": Cell(each.name, _marked(with_unit(each.name), each.name, found)),
        "value": value,
        "std": std,
        "low_95": low,
        "high_95": high,
        "within_std": number(each.within_std, ".2g", factor),
        "between_std": number(each.between_std, ".2g", factor),
        "chance": _chance(each.chance),
        "next_low_95": each.next_interval[0],
        "next_high_95": each.next_interval[1],
        "reported": reported,
        "mixture": found.is_mixed(each.name),
    }


def modes_table(campaign: Campaign) -> Table:
    """Modes over all sessions, of the structure that the numbers are of."""
    found = campaign.homogeneity
    rows: list[Row] = []
    for mode in campaign.headline.modes if campaign.headline else ():
        shown: dict[str, Entry] = {"number": mode.number}
        for name, std, between, factor in (
            ("frequency_hz", "frequency_std_hz", "frequency_between_std_hz", 1.0),
            ("damping_ratio", "damping_ratio_std", "damping_ratio_between_std", 100.0),
        ):
            its = getattr(mode, std)
            mean, shown[std] = estimate((getattr(mode, name), its), its, factor)
            text = _marked(mean.text, f"{name}_{mode.number}", found)
            shown[name] = replace(mean, text=text)
            shown[between] = number(getattr(mode, between), ".2g", factor)
        rows.append(
            {
                **{name: shown[name] for name in asdict(mode)},
                "frequency_mixture": found.is_mixed(f"frequency_hz_{mode.number}"),
                "damping_ratio_mixture": found.is_mixed(f"damping_ratio_{mode.number}"),
            }
        )
    mixed = any(row["frequency_mixture"] or row["damping_ratio_mixture"] for row in rows)
    return Table(
        "pooled_modes",
        title("Modes with locked hub (clamped–free), mean of the sessions", found),
        (
            Column("mode", "number"),
            Column("frequency (Hz)", "frequency_hz"),
            Column("std", "frequency_std_hz", spread=True),
            Column("between sessions", "frequency_between_std_hz"),
            Column("damping ratio (%)", "damping_ratio"),
            Column("std", "damping_ratio_std", spread=True),
            Column("between sessions", "damping_ratio_between_std"),
        ),
        tuple(rows),
        (MIXTURE_NOTE,) if mixed else (),
    )


def validation_table(campaign: Campaign) -> Table:
    """Errors of each session predicted from the others, then the trials that were lost."""
    rows: list[dict[str, Any]] = [
        {
            "file": str(each.path),
            "method": each.method,
            "type": each.name,
            "weighting": each.weighting,
            "error": each.error,
            "own_error": each.own_error,
            "lost": None,
        }
        for each in campaign.validation
    ]
    rows += [{"file": str(each.path), "lost": each.reason} for each in campaign.lost_trials]
    return _for_programs("validation", rows)


def validation_summary(campaign: Campaign) -> Table:
    """Error of each model over the sessions that it was to predict, the best model first."""
    rows: list[Row] = []
    for method, name, weighting, errors in by_model(campaign.validation):
        values = [each.error for each in errors]
        own = [each.own_error for each in errors if each.own_error is not None]
        rows.append(
            {
                "method": method,
                "type": name,
                "weighting": weighting or "",
                "sessions": f"{len(values)} of {campaign.trials}",
                "error": float(np.mean(values)),
                "worst": max(values),
                "own_error": float(np.mean(own)) if own else None,
            }
        )
    return Table(
        "validation",
        "Each session predicted from the others: rms error of the torque",
        (
            Column("method", "method", WORDS), *_NAMES, Column("sessions", "sessions"),
            Column("mean (%)", "error", ".2f", 100.0), Column("worst (%)", "worst", ".2f", 100.0),
            Column("session's own fit (%)", "own_error", ".2f", 100.0),
        ),
        tuple(rows),
        (
            "The session's own whole-record fit has the noise in it, too: nothing predicts better.",
            *lost_trials(campaign.lost_trials, campaign.trials),
        ),
    )  # fmt: skip


def sessions_table(campaign: Campaign) -> Table:
    """Every session with its own verdict, then those left out."""
    leading = campaign.homogeneity.leading
    groups = leading.groups if leading else ()
    group_of = {name: f"{place}" for place, names in enumerate(groups, 1) for name in names}

    def row(session: SessionResult) -> tuple[str, ...]:
        verdict = session.verdict
        found = [each.kind for each in verdict.findings] if verdict else []
        return (
            session.path.name,
            f"type {session.selected}" if session.selected else ABSENT,
            ABSENT if verdict is None else "noise" if verdict.adequate else "more than noise",
            ", ".join(dict.fromkeys(found)) or ABSENT,
        )

    left_out = [(each.path.name, "left out", ABSENT, each.message) for each in campaign.failures]
    return Table.of(
        "sessions",
        "Sessions, and what each says by itself",
        (
            Column("file", "file", WORDS), Column("selects", "selected", WORDS),
            Column("residual", "left", WORDS),
            Column("other effects", "findings", WORDS),
            Column("group" if groups else "", "group", WORDS),
        ),
        (
            (*cells, group_of.get(cells[0], ABSENT))
            for cells in (*map(row, campaign.sessions), *left_out)
        ),
        (f"Group: by the {label(leading.quantity)[0]}.",) if leading and groups else (),
    )  # fmt: skip
