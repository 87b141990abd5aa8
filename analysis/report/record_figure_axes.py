"""Logarithmic axes that span a few decades or less than one: plain numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plain_logarithmic(axes: Axes, low: float, high: float) -> None:
    """Make the vertical axis logarithmic from `low` to `high`, with as many labels as it bears."""
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    if high < 5 * low:
        axes.yaxis.set_major_locator(MaxNLocator(4))
    else:
        digits = (1.0, 2.0, 5.0) if high < 1000 * low else (1.0,)
        axes.yaxis.set_major_locator(LogLocator(subs=digits, numticks=12))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
