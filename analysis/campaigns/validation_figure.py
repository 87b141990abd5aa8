"""How well each model predicts a session that it has not seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.validation import by_model
from analysis.report import style
from analysis.report.frf_figure import line_styles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.campaigns.campaign import Campaign

_ROW_IN: Final = 0.27


def validation_figure(campaign: Campaign) -> Figure:
    """Draw every left-out session's error, model by model, the best at the top."""
    from matplotlib.lines import Line2D

    models = by_model(campaign.validation)
    weightings = campaign.settings.weightings
    colors = {w: look["color"] for w, look in line_styles(weightings).items()}
    width_in, height_in = 9.0, _ROW_IN * len(models) + 1.75
    figure = style.new_figure(
        width_in, height_in, f"{_predicted(campaign)} sessions — each predicted from the others",
        "rms of predicted minus measured torque over that of the measured torque, "
        f"{campaign.record_band_hz[0]:g} to {campaign.record_band_hz[1]:g} Hz",
    )  # fmt: skip
    axes = figure.add_axes(
        (2.0 / width_in, 0.5 / height_in, 1 - 2.2 / width_in, _ROW_IN * len(models) / height_in)
    )
    rng = np.random.default_rng(0)  # so that equal errors lie side by side
    for row, (_, _, weighting, errors) in enumerate(models):
        color = style.GREEN if weighting is None else colors[weighting]
        values = 100 * np.array([each.error for each in errors])
        axes.plot(
            values, row + rng.uniform(-0.18, 0.18, values.size), "o", color=color, markersize=2.6,
            alpha=0.6,
        )  # fmt: skip
        own = [each.own_error for each in errors if each.own_error is not None]
        if own:
            axes.plot([100 * float(np.mean(own))], [row], "|", color=style.INK, markersize=11)
    axes.set_yticks(range(len(models)), [_name(*model[:3]) for model in models])
    axes.set_ylim(len(models) - 0.4, -0.6)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = [t for t in (d * 10.0**e for e in range(-3, 4) for d in (1, 2, 5)) if low <= t <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("Error (%)", labelpad=1)
    handles = [
        Line2D([], [], color=style.GREEN, marker="o", linestyle="", markersize=3.5,
               label="pooled whole-record estimate"),
        Line2D([], [], color=style.INK, marker="|", linestyle="", markersize=9,
               label="mean of the sessions' own fits"),
        *(Line2D([], [], color=colors[w], marker="o", linestyle="", markersize=3.5,
                 label=f"nominal model, weights {w}") for w in weightings),
    ]  # fmt: skip
    figure.legend(
        handles=handles, loc="upper left", ncols=2, borderaxespad=0.0,
        bbox_to_anchor=(0.3 / width_in, 1 - 0.6 / height_in),
    )  # fmt: skip
    return figure


def _predicted(campaign: Campaign) -> str:
    done = campaign.trials - len(campaign.lost_trials)
    return f"{done} of {campaign.trials}" if campaign.lost_trials else str(done)


def _name(_method: str, structure: str, weighting: str | None) -> str:
    return f"{structure}: {'whole record' if weighting is None else f'Welch, {weighting}'}"
