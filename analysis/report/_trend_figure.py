"""Figure of a campaign's modes and parameters against time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.labels import format_p_value, label_and_unit, symbol_with_unit
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
    first_s = min(times_s.values())
    times_h = {name: (time_s - first_s) / 3600 for name, time_s in times_s.items()}
    row_count = -(-len(scatters) // _PANELS_PER_ROW)
    width_in, height_in = 13.0, _PANEL_HEIGHT_IN * row_count + 1.35
    kind_text = "blocks" if campaign.homogeneity.is_one_session else "sessions"
    figure = style.new_figure(
        width_in,
        height_in,
        f"Change with time over {max(times_h.values()):.3g} h, {len(times_h)} {kind_text}",
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
        _draw_trend(panel_axes, scatter, times_h)
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


def _draw_trend(axes: Axes, scatter: Heterogeneity, times_h: Mapping[str, float]) -> None:
    """Draw the estimates of one quantity against time, and the line through them."""
    assert scatter.trend is not None
    quantity_label, display_factor, _ = label_and_unit(scatter.quantity)
    file_names, estimates, stds = zip(*scatter.session_estimates, strict=True)
    session_h, values = np.array([times_h[name] for name in file_names]), np.array(estimates)
    axes.errorbar(
        session_h,
        display_factor * values,
        yerr=NORMAL_95 * display_factor * np.array(stds),
        fmt="o",
        markersize=2.6,
        color=style.INK,
        linewidth=0.8,
    )
    if scatter.has_significant_trend:
        weights = 1 / np.array(stds) ** 2
        mean_h, mean_value = weights @ session_h / weights.sum(), weights @ values / weights.sum()
        ends_h = np.array([session_h.min(), session_h.max()])
        line_values = mean_value + scatter.trend.slope_per_h * (ends_h - mean_h)
        axes.plot(ends_h, display_factor * line_values, color=style.VERMILION)
    p_value_text = f"p = {format_p_value(scatter.trend.p_value)}".replace("= <", "<")
    axes.set_title(f"{quantity_label}   {p_value_text}")
    axes.set_ylabel(symbol_with_unit(scatter.quantity))
    axes.ticklabel_format(axis="y", useOffset=False)
