"""Tables 3 to 5 of the paper for a campaign's page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.campaigns import paper
from analysis.campaigns.nominal import best_models
from analysis.campaigns.specimen_sentences import title
from analysis.report.html.table import Column, Table, count, number

if TYPE_CHECKING:
    from analysis.campaigns.campaign import Campaign
    from analysis.report.html.table import Cell

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
