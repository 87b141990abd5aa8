"""Loss factor against frequency with its 95 % band: the damping as a function, not as parameters.

The parameters of a fractional damping are correlated and hard to compare; what they make together
at one frequency is neither.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report import style
from analysis.report.record_figure_axes import plain_logarithmic
from analysis.report.record_figure_bands import NORMAL_95, loss_factors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.report.record_figure_bands import LossFactor
    from analysis.whole_record import RecordFit

_POINTS: Final = 400
_LOOKS: Final = {
    "internal (material)": (style.VERMILION, (0, (4, 2))),
    "external (surroundings)": (style.GREEN, (0, (1, 1.2))),
    "total": (style.BLUE, "-"),
}
_SPAN: Final = 300.0
"""Largest ratio of the axis's ends: what is smaller yet does not matter beside the total."""


def loss_figure(name: str, fit: RecordFit, band_hz: tuple[float, float]) -> Figure:
    """Draw internal, external and total loss factor, and twice the damping ratio of each mode.

    Parameters
    ----------
    name : str
        What the title calls the record.
    fit : RecordFit
    band_hz : tuple of float
        First and last frequency drawn, positive.
    """
    factors = loss_factors(fit, np.geomspace(*band_hz, _POINTS))
    figure = style.new_figure(
        11.0, 4.8, f"{name} — loss factor",
        f"type {fit.structure.name}  ·  shaded: 95 % bands  ·  points: twice the damping ratio of "
        "each mode with its 95 % interval  ·  grey: outside the modes, extrapolated",
    )  # fmt: skip
    axes = figure.add_axes((0.075, 0.105, 0.91, 0.70))
    curves = dict(zip(_LOOKS, (factors.internal, factors.external, factors.total), strict=True))
    for label, factor in curves.items():
        if factor is not None and (label == "total" or None not in curves.values()):
            _curve(axes, factors.frequency_hz, factor, label)
    if fit.modes:
        frequency_hz = np.array([mode.frequency_hz for mode in fit.modes])
        axes.errorbar(
            frequency_hz, [2 * mode.damping_ratio for mode in fit.modes],
            [2 * NORMAL_95 * mode.damping_ratio_std for mode in fit.modes],
            fmt="o", color=style.INK, markersize=4.0, capsize=3.0, elinewidth=1.0,
            label="modes", zorder=5,
        )  # fmt: skip
        for edge, end in ((frequency_hz[0], band_hz[0]), (frequency_hz[-1], band_hz[1])):
            axes.axvspan(edge, end, color="#F4F4F4", linewidth=0, zorder=0)
    style.frequency_axis(axes, band_hz)
    top = max(
        float(np.nanquantile(factors.total.value, 0.98)),
        *(2 * mode.damping_ratio for mode in fit.modes),
    )
    shown = [factor.value for factor in curves.values() if factor is not None]
    bottom = max(min(float(np.nanmin(value)) for value in shown) / 1.5, 3 * top / _SPAN)
    plain_logarithmic(axes, bottom, 3 * top)
    axes.set_ylabel("Loss factor (1)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(0.075, 0.875),
        ncols=4, borderaxespad=0.0,
    )  # fmt: skip
    return figure


def _curve(axes: Axes, frequency_hz: np.ndarray, factor: LossFactor, label: str) -> None:
    color, dash = _LOOKS[label]
    axes.fill_between(frequency_hz, *factor.limits(), color=color, alpha=0.2, linewidth=0)
    axes.plot(frequency_hz, factor.value, color=color, linestyle=dash, label=label)
