"""Tables of a campaign for the page."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns import sentences
from analysis.campaigns.labels import label, probability, with_unit
from analysis.campaigns.specimen_sentences import MIXTURE_MARK, MIXTURE_NOTE, title
from analysis.campaigns.tables import NOT_POOLED, role, used
from analysis.campaigns.validation import by_model
from analysis.models import STRUCTURES
from analysis.report.html.reported import footnotes, greyed, marked, unreported
from analysis.report.html.table import Column, Table, count, estimate, number

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.campaigns.campaign import Campaign
    from analysis.campaigns.homogeneity import Homogeneity
    from analysis.campaigns.pooled import PooledEstimate
    from analysis.campaigns.ranking import RankedStructure
    from analysis.campaigns.session import SessionResult
    from analysis.report.html.table import Cell, Number


def parameters_table(
    pooled: PooledEstimate, campaign: Campaign, withheld: Collection[str]
) -> Table:
    """Pooled estimate of one structure."""
    rows: list[tuple[Cell, ...]] = []
    found = campaign.homogeneity
    doubtful = unreported(STRUCTURES[pooled.structure], withheld)
    for each in pooled.parameters:
        _, factor, _ = label(each.name)
        low, high = each.interval
        value, std, lowest, highest = estimate((each.value, each.std, low, high), each.std, factor)
        rows.append(
            (
                _marked(with_unit(each.name), each.name, found),
                _shown(value, withheld=each.name in doubtful, mixed=found.is_mixed(each.name)),
                std,
                lowest,
                highest,
                number(each.within_std, ".2g", factor),
                number(each.between_std, ".2g", factor),
                replace(number(each.chance, ".2g"), text=probability(each.chance)),
            )
        )  # fmt: skip
    notes = [
        "One session's std: what a session states as its own. Between sessions: scatter beyond "
        "that. p: probability of so much scatter by the sessions' own uncertainties alone."
    ]
    if doubtful:
        notes += footnotes(withheld)
    if any(found.is_mixed(each.name) for each in pooled.parameters):
        notes.append(MIXTURE_NOTE)
    return Table(
        name=f"pooled_{pooled.name.replace(', ', '_').replace(' ', '_')}",
        caption=title(
            f"Pooled over {used(pooled, campaign)}: type {pooled.name} ({role(pooled, campaign)})",
            found,
        ),
        columns=(
            Column("parameter", "parameter", numeric=False),
            Column("pooled", "value"), Column("std", "std"),
            Column("95 % from", "low_95"), Column("to", "high_95"),
            Column("one session's std", "within_std"), Column("between sessions", "between_std"),
            Column("p", "chance"),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )  # fmt: skip


def _shown(value: Number, *, withheld: bool, mixed: bool) -> Number:
    """Let the eye stop at what can be used only."""
    if withheld:
        return marked(value)
    return greyed(value) if mixed else replace(value, strong=True)


def _marked(text: str, quantity: str, found: Homogeneity) -> str:
    return f"{text} {MIXTURE_MARK}" if found.is_mixed(quantity) else text


def modes_table(pooled: PooledEstimate, found: Homogeneity) -> Table:
    """Modes of the structure that the numbers are of."""
    rows = []
    mixed = False
    for mode in pooled.modes:
        frequency = estimate((mode.frequency_hz, mode.frequency_std_hz), mode.frequency_std_hz)
        ratio = estimate((mode.damping_ratio, mode.damping_ratio_std), mode.damping_ratio_std, 100)
        frequency, ratio = (
            (replace(mean, text=_marked(mean.text, f"{quantity}_{mode.number}", found)), std)
            for quantity, (mean, std) in (("frequency_hz", frequency), ("damping_ratio", ratio))
        )
        mixed = mixed or any(each.text.endswith(MIXTURE_MARK) for each in (frequency[0], ratio[0]))
        rows.append(
            (
                count(mode.number), *frequency, number(mode.frequency_between_std_hz, ".2g"),
                *ratio, number(mode.damping_ratio_between_std, ".2g", 100),
            )
        )  # fmt: skip
    return Table(
        name="pooled_modes",
        caption=title(
            "Modes of the beam on a motor that stands still, mean of the sessions", found
        ),
        columns=(
            Column("mode", "mode"),
            Column("frequency (Hz)", "frequency_hz"), Column("std", "frequency_std_hz"),
            Column("between sessions", "frequency_between_std_hz"),
            Column("damping ratio (%)", "damping_ratio"), Column("std", "damping_ratio_std"),
            Column("between sessions", "damping_ratio_between_std"),
        ),
        rows=tuple(rows),
        notes=(MIXTURE_NOTE,) if mixed else (),
    )  # fmt: skip


def structures_table(campaign: Campaign) -> Table:
    """All structures fitted, those pooled first, the lowest BIC of all sessions first."""

    def row(each: RankedStructure) -> tuple[Cell, ...]:
        numbers = (
            number(each.bic_above_lowest, ".1f"), number(each.misfit, ".4g"), count(each.fitted),
            count(each.determined), count(each.selected_alone),
        )  # fmt: skip
        return (each.name, *(numbers if each.pooled else map(greyed, numbers)))

    every = all(each.pooled for each in campaign.structures)
    return Table(
        name="structures",
        caption=title(
            "Structures on the whole records of all sessions together", campaign.homogeneity
        ),
        columns=(
            Column("type", "type", numeric=False),
            Column("BIC above the lowest", "bic_above_lowest"),
            Column("residual (noise = 1)", "misfit"),
            Column("sessions fitted", "fitted"),
            Column("sessions that determine it", "sessions"),
            Column("selected alone by", "selected_alone"),
        ),
        rows=tuple(map(row, campaign.structures)),
        notes=(
            "Damping and the modes' offsets are the specimen's, one value for all sessions (and "
            "a scatter between them, where they differ); settings of the rig are each session's.",
            *(() if every else (f"{NOT_POOLED[0].upper()}{NOT_POOLED[1:]}.",)),
        ),
        selected=0 if campaign.pooled else None,
    )  # fmt: skip


def validation_table(campaign: Campaign) -> Table:
    """Errors of left-out sessions, the best model first."""
    rows: list[tuple[Cell, ...]] = []
    for method, name, weighting, errors in by_model(campaign.validation):
        values = [each.error for each in errors]
        own = [each.own_error for each in errors if each.own_error is not None]
        rows.append(
            (
                f"type {name}",
                "whole record" if method == "record" else f"Welch, {weighting}",
                f"{len(values)} of {campaign.trials}",
                number(float(np.mean(values)), ".2f", 100), number(max(values), ".2f", 100),
                number(float(np.mean(own)) if own else None, ".2f", 100),
            )
        )  # fmt: skip
    return Table(
        name="validation",
        caption="Each session predicted from the others: rms error of the torque",
        columns=(
            Column("model", "type", numeric=False), Column("estimate", "method", numeric=False),
            Column("sessions", "sessions"), Column("mean (%)", "error"),
            Column("worst (%)", "worst"), Column("session's own fit (%)", "own_error"),
        ),
        rows=tuple(rows),
        notes=(
            "The session's own fit has the noise in it, too: nothing predicts better.",
            *sentences.lost_trials(campaign.lost_trials, campaign.trials),
        ),
    )  # fmt: skip


def sessions_table(campaign: Campaign) -> Table:
    """Every session with its own verdict, then those left out."""

    def row(session: SessionResult) -> tuple[Cell, ...]:
        verdict = session.verdict
        found = [each.kind for each in verdict.findings] if verdict else []
        return (
            session.path.name,
            f"type {session.selected}" if session.selected else "–",
            "–" if verdict is None else "noise" if verdict.adequate else "more than noise",
            ", ".join(dict.fromkeys(found)) or "–",
        )

    leading = campaign.homogeneity.leading
    groups = leading.groups if leading else ()
    group_of = {name: f"{place}" for place, names in enumerate(groups, 1) for name in names}
    left_out = [(each.path.name, "left out", "–", each.message) for each in campaign.failures]
    return Table(
        name="sessions",
        caption="Sessions, and what each says by itself",
        columns=tuple(
            Column(heading, key, numeric=False)
            for heading, key in (
                ("file", "file"), ("selects", "selected"), ("what is left", "left"),
                ("found beside the beam", "findings"), ("group" if groups else "", "group"),
            )
        ),
        rows=tuple(
            (*cells, group_of.get(str(cells[0]), "–"))
            for cells in (*map(row, campaign.sessions), *left_out)
        ),
        notes=(f"Group: by the {label(leading.quantity)[0]}.",) if leading and groups else (),
    )  # fmt: skip
