"""Tables of a campaign for the page."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns import paper
from analysis.campaigns.labels import label, with_unit
from analysis.campaigns.nominal import best_models
from analysis.campaigns.validation import by_model
from analysis.report.html.reported import footnotes, marked, unreported
from analysis.report.html.table import Column, Table, count, estimate, number
from analysis.structures import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.campaigns.campaign import Campaign
    from analysis.campaigns.pooled import PooledEstimate
    from analysis.campaigns.session import SessionResult
    from analysis.report.html.table import Cell

_TABLE_3: Final = {"zeta": ("ζ (10⁻⁴)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (10⁻¹)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
_STATISTICS: Final = ("mean", "median", "std", "min", "max")


def parameters_table(pooled: PooledEstimate, withheld: Collection[str], *, first: bool) -> Table:
    """Pooled estimate of one structure; the first one is the selected."""
    rows: list[tuple[Cell, ...]] = []
    doubtful = unreported(STRUCTURES[pooled.structure], withheld)
    for each in pooled.parameters:
        _, factor, _ = label(each.name)
        low, high = each.interval
        value, std, lowest, highest = estimate((each.value, each.std, low, high), each.std, factor)
        rows.append(
            (
                with_unit(each.name),
                marked(value) if each.name in doubtful else replace(value, strong=True),
                std,
                lowest,
                highest,
                number(each.within_std, ".2g", factor),
                number(each.between_std, ".2g", factor),
                number(each.chance, ".2g"),
            )
        )  # fmt: skip
    notes = [
        "One session's std: what a session states as its own. Between sessions: scatter beyond "
        "that. p: probability of so much scatter by the sessions' own uncertainties alone."
    ]
    if doubtful:
        notes += footnotes(withheld)
    what = "selected" if first else "cannot be told from it"
    return Table(
        name=f"pooled_{pooled.name.replace(', ', '_').replace(' ', '_')}",
        caption=f"Pooled over {pooled.sessions} sessions: type {pooled.name} ({what})",
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


def modes_table(pooled: PooledEstimate) -> Table:
    """Modes of the selected structure."""
    rows = []
    for mode in pooled.modes:
        frequency = estimate((mode.frequency_hz, mode.frequency_std_hz), mode.frequency_std_hz)
        ratio = estimate((mode.damping_ratio, mode.damping_ratio_std), mode.damping_ratio_std, 100)
        rows.append(
            (
                count(mode.number), *frequency, number(mode.frequency_between_std_hz, ".2g"),
                *ratio, number(mode.damping_ratio_between_std, ".2g", 100),
            )
        )  # fmt: skip
    return Table(
        name="pooled_modes",
        caption="Modes of the beam on a motor that stands still, mean of the sessions",
        columns=(
            Column("mode", "mode"),
            Column("frequency (Hz)", "frequency_hz"), Column("std", "frequency_std_hz"),
            Column("between sessions", "frequency_between_std_hz"),
            Column("damping ratio (%)", "damping_ratio"), Column("std", "damping_ratio_std"),
            Column("between sessions", "damping_ratio_between_std"),
        ),
        rows=tuple(rows),
    )  # fmt: skip


def structures_table(campaign: Campaign) -> Table:
    """All structures, the lowest BIC of all sessions first."""
    alone = campaign.verdict.alone if campaign.verdict else {}
    lowest = campaign.pooled[0].bic
    return Table(
        name="structures",
        caption="Structures on the whole records of all sessions together",
        columns=(
            Column("type", "type", numeric=False),
            Column("BIC above the lowest", "bic_above_lowest"),
            Column("residual (noise = 1)", "misfit"),
            Column("sessions that determine it", "sessions"),
            Column("selected alone by", "selected_alone"),
        ),
        rows=tuple(
            (
                each.name, number(each.bic - lowest, ".1f"), number(each.misfit, ".4g"),
                count(each.sessions), count(alone.get(each.name, 0)),
            )
            for each in campaign.pooled
        ),
        notes=(
            "Damping and the modes' offsets are the specimen's, one value for all sessions (and "
            "a scatter between them, where they differ); settings of the rig are each session's.",
        ),
        selected=0,
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
                number(float(np.mean(values)), ".2f", 100), number(max(values), ".2f", 100),
                number(float(np.mean(own)) if own else None, ".2f", 100),
            )
        )  # fmt: skip
    return Table(
        name="validation",
        caption="Each session predicted from the others: rms error of the torque",
        columns=(
            Column("model", "type", numeric=False), Column("estimate", "method", numeric=False),
            Column("mean (%)", "error"), Column("worst (%)", "worst"),
            Column("session's own fit (%)", "own_error"),
        ),
        rows=tuple(rows),
        notes=("The session's own fit has the noise in it, too: nothing predicts better.",),
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

    left_out = [(each.path.name, "left out", "–", each.message) for each in campaign.failures]
    return Table(
        name="sessions",
        caption="Sessions, and what each says by itself",
        columns=tuple(
            Column(heading, key, numeric=False)
            for heading, key in (
                ("file", "file"), ("selects", "selected"), ("what is left", "left"),
                ("found beside the beam", "findings"),
            )
        ),
        rows=(*map(row, campaign.sessions), *left_out),
    )  # fmt: skip


def paper_tables(campaign: Campaign, *, with_paper: bool) -> tuple[Table, ...]:
    """Tables 3 to 5; on request with the paper's own numbers in columns of their own."""
    return (
        _table_3(campaign, with_paper=with_paper),
        _table_4(campaign, with_paper=with_paper),
        _table_5(campaign, with_paper=with_paper),
    )


def _table_3(campaign: Campaign, *, with_paper: bool) -> Table:
    rows = []
    for each in campaign.statistics:
        symbol, factor = _TABLE_3[each.parameter]
        told = paper.table3().get((each.structure, each.weighting, each.parameter))
        cells: list[Cell] = [f"{each.structure}, {each.weighting}: {symbol}"]
        for name in _STATISTICS:
            cells.append(number(getattr(each, name), ".3f", factor))
            if with_paper:
                cells.append(number(None if told is None else getattr(told, name), ".4g", factor))
        rows.append((*cells, count(each.at_bounds)))
    columns = [Column("type, weights: parameter", "parameter", numeric=False)]
    for name in _STATISTICS:
        columns.append(Column(name, name))
        if with_paper:
            columns.append(Column("(paper)", f"paper_{name}"))
    return Table(
        name="table3",
        caption=f"Parameters over {len(campaign.sessions)} sessions by the paper's route (Table 3)",
        columns=(*columns, Column("at bounds", "at_bounds")),
        rows=tuple(rows),
        notes=("At bounds: sessions in which it rests on the edge of the range searched.",),
    )


def _table_4(campaign: Campaign, *, with_paper: bool) -> Table:
    modes = [each.mode for each in campaign.nominal[0].deviations]
    parts = [("frequency_rad_s", "ω{} (rad/s)"), ("magnitude_db", "M{} (dB)")]
    columns = [Column("type, weights", "type", numeric=False)]
    for quantity, heading in parts:
        for mode in modes:
            columns.append(Column(heading.format(mode), f"{quantity}_{mode}"))
            if with_paper:
                columns.append(Column("(paper)", f"paper_{quantity}_{mode}"))
    rows = []
    for model in campaign.nominal:
        cells: list[Cell] = [f"{model.structure}, {model.weighting}"]
        for quantity, _ in parts:
            for deviation in model.deviations:
                cells.append(number(getattr(deviation, quantity), ".3f"))
                if with_paper:
                    key = (model.structure, model.weighting, quantity, deviation.mode)
                    cells.append(number(paper.table4().get(key), ".3f"))
        rows.append(tuple(cells))
    return Table(
        name="table4",
        caption="Mean deviation of the resonant peaks from the nominal model's (MDR, Table 4)",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=("A nominal model has the mean of the sessions' parameters.",),
    )


def _table_5(campaign: Campaign, *, with_paper: bool) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for model in best_models(campaign.nominal):
        values = model.parameters
        told = paper.table5_wmse().get((model.structure, model.weighting))
        rows.append(
            (
                f"{model.structure}, {model.weighting}", number(values["alpha"], ".3f"),
                number(values["zeta"], ".2f", 1e5), number(values["lambda"], ".3f"),
                number(values["gamma"], ".2f", 1e2), number(model.mean_wmse, ".3f"),
                *([number(told, ".3f")] if with_paper else []),
            )
        )  # fmt: skip
    return Table(
        name="table5",
        caption="The two best nominal models (Table 5; their peaks are in Table 4)",
        columns=(
            Column("type, weights", "type", numeric=False), Column("α", "alpha"),
            Column("ζ (10⁻⁵)", "zeta"), Column("λ", "lambda"), Column("γ (10⁻²)", "gamma"),
            Column("WMSE ((N·m/rad)²)", "wmse"),
            *([Column("(paper)", "paper_wmse")] if with_paper else []),
        ),
        rows=tuple(rows),
    )  # fmt: skip
