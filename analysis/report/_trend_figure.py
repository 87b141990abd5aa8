"""Figure of a campaign's modes and parameters against time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.labels import format_hours, format_p_value, label_and_unit, symbol_with_unit
from analysis.report import _style as style
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.campaigns import CampaignResult, Heterogeneity

_PANELS_PER_ROW: Final = 3
"""Number of panels in a row."""
_PANEL_HEIGHT_IN: Final = 2.1
"""Height of a row of panels in inches."""


def trend_figure(campaign: CampaignResult) -> Figure:
    """Draw the sessions' modes and parameters against time, with 95 % intervals.

    A straight line shows a significant change with time. At least one quantity has a trend.
    """
    from matplotlib.lines import Line2D

    scatters = [scatter for scatter in campaign.homogeneity.quantities if scatter.trend]
    times_s = {
        session.name: session.experiment.middle_utc_s
        for session in campaign.sessions
        if session.experiment.middle_utc_s is not None
    }
    covered_h = (max(times_s.values()) - min(times_s.values())) / 3600
    row_count = -(-len(scatters) // _PANELS_PER_ROW)
    width_in, height_in = 13.0, _PANEL_HEIGHT_IN * row_count + 1.35
    kind_text = "blocks" if campaign.homogeneity.is_one_session else "sessions"
    figure = style.new_figure(
        width_in,
        height_in,
        f"Change with time over {format_hours(covered_h)}, {len(times_s)} {kind_text}",
        f"each fitted by itself  ·  parameters: type {campaign.homogeneity.structure}  ·  "
        "p: p-value of no change",
    )
    grid = figure.add_gridspec(
        row_count, _PANELS_PER_ROW, left=0.07, right=0.99, top=1 - 1.2 / height_in,
        bottom=0.5 / height_in, wspace=0.3, hspace=0.45,
    )  # fmt: skip
    for panel_number, scatter in enumerate(scatters):
        panel_axes = figure.add_subplot(
            grid[panel_number // _PANELS_PER_ROW, panel_number % _PANELS_PER_ROW]
        )
        _draw_trend(panel_axes, scatter, times_s)
        if panel_number + _PANELS_PER_ROW >= len(scatters):
            panel_axes.set_xlabel("Time (h)", labelpad=1)
    legend_handles = [
        Line2D([], [], color=style.INK, marker="o", markersize=3, linewidth=0.9,
               label=f"{kind_text.removesuffix('s')}, ± 1.96 of its standard deviation"),
    ]  # fmt: skip
    if any(scatter.has_significant_trend for scatter in scatters):
        legend_handles.append(Line2D([], [], color=style.VERMILION, label="significant change"))
    style.add_legend(figure, legend_handles, column_count=len(legend_handles))
    return figure


def _draw_trend(axes: Axes, scatter: Heterogeneity, times_s: Mapping[str, float]) -> None:
    """Draw the estimates of one quantity against time, and the line through them."""
    assert scatter.trend is not None
    quantity_label, display_factor, _ = label_and_unit(scatter.quantity)
    file_names, estimates, stds = zip(*scatter.session_estimates, strict=True)
    first_s = min(times_s.values())
    session_s = np.array([times_s[name] for name in file_names])
    axes.errorbar(
        (session_s - first_s) / 3600,
        display_factor * np.array(estimates),
        yerr=NORMAL_95 * display_factor * np.array(stds),
        fmt="o",
        markersize=2.6,
        color=style.INK,
        linewidth=0.8,
    )
    if scatter.has_significant_trend:
        ends_s = session_s.min(), session_s.max()
        axes.plot(
            [(end_s - first_s) / 3600 for end_s in ends_s],
            [display_factor * scatter.trend.value_at(end_s) for end_s in ends_s],
            color=style.VERMILION,
        )
    p_value_text = f"p = {format_p_value(scatter.trend.p_value)}".replace("= <", "<")
    axes.set_title(f"{quantity_label}   {p_value_text}")
    axes.set_ylabel(symbol_with_unit(scatter.quantity))
    axes.ticklabel_format(axis="y", useOffset=False)
