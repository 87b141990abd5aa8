"""The page on a campaign: verdict, figures, tables, and how it was computed, in one file."""

from __future__ import annotations

import platform
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import matplotlib as mpl
import numpy as np

import rigd
from analysis.campaigns import (
    MIXTURE_MARK,
    MIXTURE_NOTE,
    best_models,
    by_model,
    label,
    lost_trials,
    probability,
    title,
    with_unit,
)
from analysis.models import STRUCTURES
from analysis.report import _campaign_tables as homogeneity_tables
from analysis.report import _paper_numbers as paper
from analysis.report._campaign_tables import (
    NOT_POOLED,
    likely_estimates,
    role,
    session_list_table,
    used,
    without_verdict,
)
from analysis.report._html import Markup, element, section, table, void
from analysis.report._record_page import STYLE
from analysis.report._table import (
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
    from collections.abc import Collection, Mapping
    from datetime import datetime

    from analysis.campaigns import (
        Campaign,
        Homogeneity,
        PooledEstimate,
        RankedStructure,
        SessionResult,
    )
    from analysis.report._table import Cell, Number

_TABLE_3: Final = {"zeta": ("ζ (10⁻⁴)", 1e4), "alpha": ("α", 1.0), "gamma": ("γ (10⁻¹)", 10.0),
                   "lambda": ("λ", 1.0)}  # fmt: skip
_STATISTICS: Final = ("mean", "median", "std", "min", "max")


def paper_tables(campaign: Campaign, *, with_paper: bool) -> tuple[Table, ...]:
    """Tables 3 to 5, if there are Welch fits; on request with the paper's own numbers beside."""
    if not campaign.nominal:
        return ()
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
        caption=title(
            f"Parameters over {len(campaign.sessions)} sessions by the paper's route (Table 3)",
            campaign.homogeneity,
        ),
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
        caption=title(
            "Mean deviation of the resonant peaks from the nominal model's (MDR, Table 4)",
            campaign.homogeneity,
        ),
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
        caption=title(
            "The two best nominal models (Table 5; their peaks are in Table 4)",
            campaign.homogeneity,
        ),
        columns=(
            Column("type, weights", "type", numeric=False), Column("α", "alpha"),
            Column("ζ (10⁻⁵)", "zeta"), Column("λ", "lambda"), Column("γ (10⁻²)", "gamma"),
            Column("WMSE ((N·m/rad)²)", "wmse"),
            *([Column("(paper)", "paper_wmse")] if with_paper else []),
        ),
        rows=tuple(rows),
    )  # fmt: skip


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
            *lost_trials(campaign.lost_trials, campaign.trials),
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


_CONTENTS: Final = (
    ("verdict", "Verdict"),
    ("figures", "Figures"),
    ("tables", "Tables"),
    ("paper", "The paper's route"),
    ("how", "How it was computed"),
)
_OF_RECORDS: Final = ("pooled", "validation")
"""Figures that go with the verdict; the others are the paper's."""


def campaign_page(
    campaign: Campaign, figures: Mapping[str, Markup], made_at: datetime, *, with_paper: bool
) -> str:
    """Put a campaign's report together.

    Parameters
    ----------
    campaign : Campaign
    figures : mapping of str to Markup
        By the names of their files.
    made_at : datetime
        When, with a time zone.
    with_paper : bool
        Whether the paper's numbers stand beside these.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    shown = [figures[name] for name in _OF_RECORDS if name in figures]
    of_paper = [figure for name, figure in figures.items() if name not in _OF_RECORDS]
    tables = _tables(campaign)
    titles = {
        name: title
        for name, title in _CONTENTS
        if (name != "verdict" or campaign.verdict or without_verdict(campaign))
        and (name != "figures" or shown)
        and (name != "paper" or campaign.nominal)
    }
    links = [element("li", element("a", title, href=f"#{name}")) for name, title in titles.items()]
    title = f"Campaign of {len(campaign.sessions)} sessions"
    paths = [each.path for each in campaign.sessions]
    head = element(
        "head",
        void("meta", charset="utf-8"),
        void("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{title}: damping"),
        Markup(f"<style>\n{STYLE.read_text(encoding='utf-8')}</style>"),
    )
    body = element(
        "body",
        element(
            "header",
            element("h1", title),
            element("p", f"{paths[0].name} to {paths[-1].name}, in {paths[0].absolute().parent}"),
        ),
        element("nav", element("ul", *links), aria_label="Contents"),
        element(
            "main",
            _verdict(campaign, titles["verdict"]) if "verdict" in titles else "",
            _warnings(campaign),
            section("figures", titles["figures"], *shown) if shown else "",
            section("tables", titles["tables"], *tables),
            section(
                "paper", titles["paper"], *of_paper,
                *map(table, paper_tables(campaign, with_paper=with_paper)),
            )
            if "paper" in titles
            else "",
            section("how", titles["how"], *_how(campaign, made_at)),
        ),
    )  # fmt: skip
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _verdict(campaign: Campaign, title: str) -> Markup:
    verdict = campaign.verdict
    if verdict is None:
        return section(
            "verdict", title, *(element("p", each) for each in without_verdict(campaign))
        )
    first, *others = verdict.sentences
    said = [element("p", first, class_="damping"), *(element("p", each) for each in others)]
    advice = [element("li", each) for each in verdict.experiments]
    more = [element("p", "What would tell more:"), element("ul", *advice)] if advice else []
    return section("verdict", title, *said, *more)


def _warnings(campaign: Campaign) -> Markup:
    items = [element("li", f"Left out: {each.message}") for each in campaign.failures]
    items += [
        element("li", f"Not predicted from the others: {each.path}: {each.reason}")
        for each in campaign.lost_trials
    ]
    items += [
        element("li", f"{session.path.name}: {warning}")
        for session in campaign.sessions
        for warning in session.warnings
    ]
    return section("warnings", "Read this too", element("ul", *items)) if items else Markup("")


def _tables(campaign: Campaign) -> list[Markup]:
    withheld = campaign.verdict.withheld if campaign.verdict else frozenset[str]()
    found = campaign.homogeneity
    made = [session_list_table(campaign)]
    if len(found.specimens) > 1:
        made.append(homogeneity_tables.specimens_table(found))
    if found.mixed:
        made.append(homogeneity_tables.scatter_table(found))
    for place, each in enumerate(likely_estimates(campaign)):
        made.append(parameters_table(each, campaign, withheld))
        if place == 0 and each.modes:
            made.append(modes_table(each, found))
    if campaign.structures:
        made.append(structures_table(campaign))
    if campaign.validation:
        made.append(validation_table(campaign))
    if found.quantities and not found.mixed:
        made.append(homogeneity_tables.scatter_table(found))
    return [table(each) for each in (*made, sessions_table(campaign))]


def _how(campaign: Campaign, made_at: datetime) -> list[Markup]:
    settings, (first_hz, last_hz) = campaign.settings, campaign.record_band_hz
    beam = campaign.sessions[0].beam
    parts = [
        (
            "Specimen, as the files state it",
            [
                ("beam length", f"{beam.length_m:g} m"),
                ("beam density", f"{beam.density_kg_per_m:g} kg/m"),
                ("bending stiffness", f"{beam.bending_stiffness_n_m2:g} N·m²"),
            ],
        ),
        (
            "Whole records",
            [
                (
                    "estimator",
                    "output error: the torque that the exact model (Eq. 25) makes of the measured "
                    "angle against the measured one, whitened with the noise found",
                ),
                ("band", f"{first_hz:g} to {last_hz:g} Hz"),
                (
                    "pooled",
                    "random effects: sessions with their own covariances, and a scatter of each "
                    "parameter between them (DerSimonian and Laird); Student's t",
                ),
                (
                    "structure",
                    "the freest on the beam of the lowest Bayesian information criterion of all "
                    "sessions together, the same for all sessions",
                ),
            ],
        ),
        (
            "The paper's route",
            [
                ("estimator", settings.estimator),
                ("band", f"{settings.band_hz[0]:g} to {settings.band_hz[1]:g} Hz"),
                ("types", ", ".join(settings.types)),
                ("weights", ", ".join(settings.weightings)),
            ],
        ),
        (
            "Versions",
            [
                ("report made", made_at.isoformat(timespec="seconds")),
                ("rigd", rigd.__version__),
                ("Python", platform.python_version()),
                ("numpy", np.__version__),
                ("matplotlib", mpl.__version__),
            ],
        ),
    ]
    if not campaign.nominal:
        del parts[2]
    if not campaign.sessions[0].record_estimates:
        del parts[1]
    return [_facts(title, facts) for title, facts in parts]


def _facts(title: str, facts: list[tuple[str, str]]) -> Markup:
    rows = [
        element("tr", element("th", name, scope="row"), element("td", value))
        for name, value in facts
    ]
    made = element("table", element("caption", title), element("tbody", *rows))
    return element("div", made, class_="table")
