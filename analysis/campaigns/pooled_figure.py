"""Whole-record estimates session by session, with what they say together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.labels import label, probability, with_unit
from analysis.campaigns.specimen_sentences import MIXTURE_MARK, title
from analysis.campaigns.tables import used
from analysis.models import STRUCTURES
from analysis.report import style
from analysis.report.html.reported import MARK, unreported

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.campaigns.campaign import Campaign
    from analysis.campaigns.pooled import PooledParameter

_COLUMNS: Final = 4
_POOLED: Final = "#C3DCED"
"""Of an interval: the pooled line's blue, but light and opaque."""


def pooled_figure(campaign: Campaign) -> Figure:
    """Draw each session's estimate with its 95 % interval over the pooled one, freest structure."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    estimate = campaign.headline
    assert estimate is not None
    withheld = campaign.verdict.withheld if campaign.verdict else ()
    doubtful = unreported(STRUCTURES[estimate.structure], withheld)
    note = f"  ·  {MARK} not reported: the data do not support it" if doubtful else ""
    if any(campaign.homogeneity.is_mixed(each.name) for each in estimate.parameters):
        note += f"  ·  {MIXTURE_MARK} mean of a mixture"
    rows = -(-len(estimate.parameters) // _COLUMNS)
    width_in, height_in = 13.0, 2.6 * rows + 1.35
    figure = style.new_figure(
        width_in, height_in,
        title(
            f"{used(estimate, campaign)} — pooled whole-record estimate, type {estimate.name}",
            campaign.homogeneity,
        ),
        f"freest type that the sessions support, residual {estimate.misfit:.3g} times the noise ·  "
        "p: probability of so much scatter if sessions differed by their own uncertainty alone"
        f"{note}",
    )  # fmt: skip
    grid = figure.add_gridspec(
        rows, _COLUMNS, left=0.06, right=0.99, top=1 - 1.2 / height_in, bottom=0.5 / height_in,
        wspace=0.42, hspace=0.4,
    )  # fmt: skip
    for number, parameter in enumerate(estimate.parameters):
        axes = figure.add_subplot(grid[number // _COLUMNS, number % _COLUMNS])
        _panel(campaign, estimate.name, parameter, axes, reported=parameter.name not in doubtful)
        if number + _COLUMNS >= len(estimate.parameters):
            axes.set_xlabel("Session", labelpad=1)
    figure.legend(
        handles=[
            Line2D([], [], color=style.INK, marker="o", markersize=3, linewidth=0.9,
                   label="session, ± 1.96 of its standard deviation"),
            Line2D([], [], color=style.BLUE, label="pooled"),
            Patch(facecolor=_POOLED, label="its 95 % interval"),
            Patch(facecolor=style.SHADE, label="true value in one more session, 95 %"),
        ],
        loc="upper left", ncols=4, borderaxespad=0.0,
        bbox_to_anchor=(0.3 / width_in, 1 - 0.62 / height_in),
    )  # fmt: skip
    return figure


def _panel(
    campaign: Campaign, name: str, parameter: PooledParameter, axes: Axes, *, reported: bool
) -> None:
    symbol, factor, _ = label(parameter.name)
    places, values, spreads = [], [], []
    for number, session in enumerate(campaign.sessions, start=1):
        for each in session.record_estimates:
            std = each.std.get(parameter.name)
            if each.name == name and std is not None:
                places.append(number)
                values.append(factor * each.parameters[parameter.name])
                spreads.append(1.96 * factor * std)
    axes.axhspan(*(factor * end for end in parameter.next_interval), color=style.SHADE, zorder=0.5)
    axes.axhspan(
        *(factor * end for end in parameter.interval),
        color=_POOLED if reported else style.FAINT,
        zorder=0.6,
    )
    ink, line = (style.INK, style.BLUE) if reported else (style.GREY, style.GREY)
    axes.axhline(factor * parameter.value, color=line)
    axes.errorbar(places, values, yerr=spreads, fmt="o", markersize=2.6, color=ink, linewidth=0.8)
    mark = "" if reported else MARK
    mark += MIXTURE_MARK if campaign.homogeneity.is_mixed(parameter.name) else ""
    chance = f"p = {probability(parameter.chance)}".replace("= <", "<")
    axes.set_title(f"{symbol}{mark}   {chance}")
    axes.set_ylabel(with_unit(parameter.name))
    axes.set_xlim(0.3, len(campaign.sessions) + 0.7)
    axes.set_xticks(np.unique(np.linspace(1, len(campaign.sessions), 6).round().astype(int)))
    axes.ticklabel_format(axis="y", useOffset=False)
