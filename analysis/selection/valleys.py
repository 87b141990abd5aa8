"""Valleys of a profile likelihood: which values it admits, and how many explain it equally."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHI_SQUARE_95: Final = 3.841458820694124
"""Deviance that the true value exceeds once in twenty records (one degree of freedom)."""

RIDGE: Final = 0.5
"""Deviance by which a ridge must rise over the higher of two valleys to part them: far more than
the refits' tolerance."""


def valleys(values: NDArray[np.float64], deviance: NDArray[np.float64]) -> tuple[float, ...]:
    """Bottoms of the valleys that the 95 % limit admits, the lowest first.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Increasing.
    deviance : ndarray, shape (n,)
        Above the lowest.
    """
    padded = np.concatenate([[np.inf], deviance, [np.inf]])
    lows = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    lows = lows[deviance[lows] < CHI_SQUARE_95]
    kept: list[int] = []
    for low in lows[np.argsort(deviance[lows], kind="stable")].tolist():
        ridges = (deviance[min(low, k) : max(low, k) + 1].max() for k in kept)
        if all(ridge > deviance[low] + RIDGE for ridge in ridges):
            kept.append(low)
    return tuple(values[kept].tolist())


def admitted(
    values: NDArray[np.float64], deviance: NDArray[np.float64]
) -> tuple[tuple[float, float], bool, bool]:
    """Find the ends of all that the 95 % limit admits, ridges between valleys included.

    Returns
    -------
    interval : tuple of float
    open_below, open_above : bool
        Whether the limit is never crossed on that side.
    """
    inside = np.flatnonzero(deviance <= CHI_SQUARE_95)
    first, last = int(inside[0]), int(inside[-1])
    low = values[0] if first == 0 else _crossing_at(values, deviance, first, first - 1)
    high = values[-1] if last == values.size - 1 else _crossing_at(values, deviance, last, last + 1)
    return (float(low), float(high)), first == 0, last == values.size - 1


def crossing(inside: float, outside: float, below: float, above: float) -> float:
    """Where the limit is crossed between two values; the root of a deviance is all but linear.

    Parameters
    ----------
    inside, outside : float
        Values on either side of the limit.
    below, above : float
        Their deviances.
    """
    low, high = math.sqrt(max(below, 0.0)), math.sqrt(max(above, 0.0))
    share = (math.sqrt(CHI_SQUARE_95) - low) / (high - low)
    return inside + share * (outside - inside)


def gaps(known: list[float], span: tuple[float, float], spacing: float) -> list[float]:
    """Values within a span, equally spaced, that lie outside of all that is known."""
    grid = np.arange(span[0] + spacing / 2, span[1], spacing).tolist()
    low, high = min(known), max(known)
    return [value for value in grid if value < low - spacing / 4 or value > high + spacing / 4]


def dips(curve: dict[float, float]) -> list[float]:
    """Places on a coarse curve that are lower than both neighbours, the ends included."""
    places = sorted(curve)
    heights = [math.inf, *(curve[place] for place in places), math.inf]
    return [
        place
        for place, (before, here, after) in zip(
            places, zip(heights, heights[1:], heights[2:], strict=False), strict=True
        )
        if here <= before and here <= after
    ]


def _crossing_at(
    values: NDArray[np.float64], deviance: NDArray[np.float64], inside: int, outside: int
) -> float:
    return crossing(
        float(values[inside]),
        float(values[outside]),
        float(deviance[inside]),
        float(deviance[outside]),
    )
