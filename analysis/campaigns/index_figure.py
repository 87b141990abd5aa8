"""Box plots of the nominal models' distance from the sessions: the paper's Figure 7."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report import style
from analysis.report.frf_figure import line_styles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.campaigns.campaign import Campaign

_PANELS: Final = (
    ("mse", "(a) Mean square error", "MSE ((N·m/rad)²)"),
    ("wmse", "(b) Mean square error, weighted with 1/ω", "WMSE ((N·m/rad)²)"),
    ("md", "(c) Maximum deviation", "MD (N·m/rad)"),
)
_FLIER_SIZE: Final = 3.0


def index_figure(campaign: Campaign) -> Figure:
    """Draw MSE, WMSE and MD of every nominal model over the sessions (Eqs. 28-30)."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    types = list(dict.fromkeys(model.structure for model in campaign.nominal))
    weightings = list(dict.fromkeys(model.weighting for model in campaign.nominal))
    colors = {name: look["color"] for name, look in line_styles(tuple(weightings)).items()}
    width_in, height_in = 13.0, 4.9
    figure = style.new_figure(
        width_in, height_in,
        f"{len(campaign.sessions)} sessions — how far each is from the nominal models",
        "boxes: quartiles over the sessions, whiskers to 1.5 times their distance",
    )  # fmt: skip
    grid = figure.add_gridspec(
        1, 3, left=0.055, right=0.99, top=1 - 1.2 / height_in, bottom=0.45 / height_in, wspace=0.2
    )
    width = 0.72 / len(weightings)
    for column, (index, title, label) in enumerate(_PANELS):
        axes = figure.add_subplot(grid[column])
        for model in campaign.nominal:
            offset = weightings.index(model.weighting) - (len(weightings) - 1) / 2
            place = types.index(model.structure) + offset * width
            values = np.array([getattr(each, index) for each in model.indices])
            color = colors[model.weighting]
            axes.boxplot(
                [values], positions=[place], widths=0.8 * width, patch_artist=True,
                showmeans=True, manage_ticks=False,
                boxprops={"facecolor": "white", "edgecolor": color},
                whiskerprops={"color": color}, capprops={"color": color},
                medianprops={"color": "#C00000", "linewidth": 1.2},
                meanprops={
                    "marker": "o", "markerfacecolor": style.GREEN, "markeredgecolor": style.GREEN,
                    "markersize": _FLIER_SIZE,
                },
                flierprops={
                    "marker": "x", "markeredgecolor": color, "markersize": _FLIER_SIZE,
                },
            )  # fmt: skip
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xticks(range(len(types)), [f"Type {name}" for name in types])
        axes.grid(visible=False, axis="x")
        axes.set_title(title)
        axes.set_ylabel(label)
    keys = [Patch(facecolor="white", edgecolor=colors[w], label=f"weights {w}") for w in weightings]
    marks = [
        Line2D([], [], color="#C00000", label="median"),
        Line2D([], [], color=style.GREEN, marker="o", linestyle="", markersize=4, label="mean"),
    ]
    figure.legend(
        handles=[*keys, *marks], loc="upper left", ncols=len(keys) + 2, borderaxespad=0.0,
        bbox_to_anchor=(0.3 / width_in, 1 - 0.62 / height_in),
    )  # fmt: skip
    return figure
