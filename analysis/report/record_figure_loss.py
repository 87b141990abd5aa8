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
    from collections.abc import Collection

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from analysis.identify import RecordFit

_POINTS: Final = 400
_LOOKS: Final = {
    "internal (material)": (style.VERMILION, (0, (4, 2))),
    "external (surroundings)": (style.GREEN, (0, (1, 1.2))),
    "total": (style.BLUE, "-"),
}
_SPAN: Final = 300.0
"""Largest ratio of the axis's ends: what is smaller yet does not matter beside the total."""


def loss_figure(
    name: str,
    fit: RecordFit,
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    *,
    withheld: Collection[str] = (),
) -> Figure:
    """Draw internal, external and total loss factor, and twice the damping ratio of each mode.

    Parameters
    ----------
    name : str
        What the title calls the record.
    fit : RecordFit
        With the modes that are drawn.
    axis_hz : tuple of float
        First and last frequency of the axis, positive.
    supported_hz : tuple of float or None
        Band in which the data support the curves: there are none beyond. None: nowhere.
    withheld : collection of str
        Orders that the data do not support: then the total is not split into its parts.
    """
    modes = fit.modes
    figure = style.new_figure(
        11.0, 4.8, f"{name} — loss factor",
        f"type {fit.structure.name}  ·  shaded: 95 % bands  ·  points: twice the damping ratio of "
        f"each mode with its 95 % interval  ·  grey: {_grey(withheld)}",
    )  # fmt: skip
    axes = figure.add_axes((0.075, 0.105, 0.91, 0.70))
    drawn = _curves(axes, fit, axis_hz, supported_hz, withheld)
    if modes:
        axes.errorbar(
            [mode.frequency_hz for mode in modes], [2 * mode.damping_ratio for mode in modes],
            [2 * NORMAL_95 * mode.damping_ratio_std for mode in modes],
            fmt="o", color=style.INK, markersize=4.0, capsize=3.0, elinewidth=1.0,
            label="modes", zorder=5,
        )  # fmt: skip
    for edge_hz, end_hz in _beyond(axis_hz, supported_hz, [mode.frequency_hz for mode in modes]):
        axes.axvspan(edge_hz, end_hz, color="#F4F4F4", linewidth=0, zorder=0)
    style.frequency_axis(axes, axis_hz)
    points = [2 * mode.damping_ratio for mode in modes]
    # Of curves what they mostly are: a total may rise without bound towards an end.
    top = max([*points, *(float(np.nanquantile(value, 0.98)) for value in drawn)], default=1.0)
    low = min([*points, *(float(np.nanmin(value)) for value in drawn)], default=top)
    plain_logarithmic(axes, max(low / 2, 3 * top / _SPAN), 3 * top)
    axes.set_ylabel("Loss factor (1)")
    axes.set_xlabel("Frequency (Hz)", labelpad=1)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="upper left", bbox_to_anchor=(0.075, 0.875), ncols=4,
            borderaxespad=0.0,
        )  # fmt: skip
    return figure


def _grey(withheld: Collection[str]) -> str:
    """Say what the shaded parts of the axis are."""
    if withheld:
        return "not drawn, an order that the data do not support would decide there"
    return "outside the modes, extrapolated; no curve where nothing was excited"


def _curves(
    axes: Axes,
    fit: RecordFit,
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    withheld: Collection[str],
) -> list[NDArray[np.float64]]:
    """Draw the loss factors where the data support them; return the values drawn."""
    if supported_hz is None:
        return []
    first_hz, last_hz = max(axis_hz[0], supported_hz[0]), min(axis_hz[1], supported_hz[1])
    if first_hz >= last_hz:
        return []
    factors = loss_factors(fit, np.geomspace(first_hz, last_hz, _POINTS))
    curves = dict(zip(_LOOKS, (factors.internal, factors.external, factors.total), strict=True))
    both = None not in curves.values()
    drawn = []
    for (label, factor), order in zip(curves.items(), ("alpha", "lambda", None), strict=True):
        # Parts of which one is not known are not told apart; alone, a part is the total.
        if factor is None or (order is not None and (not both or withheld)):
            continue
        color, dash = _LOOKS[label]
        axes.fill_between(
            factors.frequency_hz, *factor.limits(), color=color, alpha=0.2, linewidth=0
        )
        axes.plot(factors.frequency_hz, factor.value, color=color, linestyle=dash, label=label)
        drawn.append(factor.value)
    return drawn


def _beyond(
    axis_hz: tuple[float, float],
    supported_hz: tuple[float, float] | None,
    modes_hz: list[float],
) -> list[tuple[float, float]]:
    """Parts of the axis outside the modes, or outside of what is drawn if that is less."""
    if not modes_hz:
        return [axis_hz]
    first_hz, last_hz = modes_hz[0], modes_hz[-1]
    if supported_hz is not None:
        first_hz, last_hz = max(first_hz, supported_hz[0]), min(last_hz, supported_hz[1])
    return [(axis_hz[0], first_hz), (last_hz, axis_hz[1])]
