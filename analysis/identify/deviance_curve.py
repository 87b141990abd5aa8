"""Interval and local minima of a deviance that is known at some values of a damping order."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHI_SQUARE_95: Final = 3.841458820694124
"""Deviance that the true value exceeds once in twenty records (one degree of freedom)."""

MIN_BARRIER_DEVIANCE: Final = 0.5
"""Deviance by which a barrier must exceed the higher of two local minima to separate them. It is
far larger than the tolerance of the refits."""


def local_minima(
    order_values: NDArray[np.float64], deviances: NDArray[np.float64]
) -> tuple[float, ...]:
    """Return the order values at the local minima of the deviance within the 95 % limit.

    The one with the lowest deviance is first.

    Parameters
    ----------
    order_values : ndarray of float, shape (n,)
        Values of the order, increasing.
    deviances : ndarray of float, shape (n,)
        Deviance at each value, minus the lowest one.
    """
    padded_deviances = np.concatenate([[np.inf], deviances, [np.inf]])
    minimum_indices = np.flatnonzero(
        (padded_deviances[1:-1] <= padded_deviances[:-2])
        & (padded_deviances[1:-1] < padded_deviances[2:])
    )
    minimum_indices = minimum_indices[deviances[minimum_indices] < CHI_SQUARE_95]
    distinct_indices: list[int] = []
    for low in minimum_indices[np.argsort(deviances[minimum_indices], kind="stable")].tolist():
        barrier_deviances = (
            deviances[min(low, index) : max(low, index) + 1].max() for index in distinct_indices
        )
        if all(
            barrier_deviance > deviances[low] + MIN_BARRIER_DEVIANCE
            for barrier_deviance in barrier_deviances
        ):
            distinct_indices.append(low)
    return tuple(order_values[distinct_indices].tolist())


def order_interval_95(
    order_values: NDArray[np.float64], deviances: NDArray[np.float64]
) -> tuple[tuple[float, float], bool, bool]:
    """Return the interval of the order values whose deviance is within the 95 % limit.

    Barriers of higher deviance between them are included.

    Parameters
    ----------
    order_values : ndarray of float, shape (n,)
        Values of the order, increasing.
    deviances : ndarray of float, shape (n,)
        Deviance at each value, minus the lowest one.

    Returns
    -------
    interval : tuple of float
        Smallest and largest admitted value.
    open_below, open_above : bool
        Whether the deviance stays within the limit down to the first, and up to the last value.
    """
    inside_indices = np.flatnonzero(deviances <= CHI_SQUARE_95)
    first_inside, last_inside = int(inside_indices[0]), int(inside_indices[-1])
    lower_end = (
        order_values[0]
        if first_inside == 0
        else _limit_crossing_between(order_values, deviances, first_inside, first_inside - 1)
    )
    upper_end = (
        order_values[-1]
        if last_inside == order_values.size - 1
        else _limit_crossing_between(order_values, deviances, last_inside, last_inside + 1)
    )
    return (
        (float(lower_end), float(upper_end)),
        first_inside == 0,
        last_inside == order_values.size - 1,
    )


def order_at_deviance_limit(
    inside_value: float, outside_value: float, deviance_inside: float, deviance_outside: float
) -> float:
    """Interpolate the value at which a deviance crosses the 95 % limit.

    The square root of the deviance is almost linear in the value.

    Parameters
    ----------
    inside_value, outside_value : float
        Values on either side of the limit.
    deviance_inside, deviance_outside : float
        Deviances at these values.
    """
    root_inside, root_outside = (
        math.sqrt(max(deviance_inside, 0.0)),
        math.sqrt(max(deviance_outside, 0.0)),
    )
    crossing_fraction = (math.sqrt(CHI_SQUARE_95) - root_inside) / (root_outside - root_inside)
    return inside_value + crossing_fraction * (outside_value - inside_value)


def orders_outside_known_range(
    known_orders: list[float], value_range: tuple[float, float], spacing: float
) -> list[float]:
    """Return equally spaced values within a span, without those between known values.

    Parameters
    ----------
    known_orders : list of float
        Values at which the profile is known.
    value_range : tuple of float
        First and last value of the span.
    spacing : float
        Distance between neighbouring values.
    """
    spaced_values = np.arange(value_range[0] + spacing / 2, value_range[1], spacing).tolist()
    smallest_known, largest_known = min(known_orders), max(known_orders)
    return [
        spaced_value
        for spaced_value in spaced_values
        if spaced_value < smallest_known - spacing / 4 or spaced_value > largest_known + spacing / 4
    ]


def values_at_local_minima(height_by_value: dict[float, float]) -> list[float]:
    """Return the positions of the local minima of a sampled curve, including its ends."""
    sorted_values = sorted(height_by_value)
    curve_heights = [
        math.inf,
        *(height_by_value[curve_value] for curve_value in sorted_values),
        math.inf,
    ]
    return [
        curve_value
        for curve_value, (left_height, own_height, right_height) in zip(
            sorted_values,
            zip(curve_heights, curve_heights[1:], curve_heights[2:], strict=False),
            strict=True,
        )
        if own_height <= left_height and own_height <= right_height
    ]


def _limit_crossing_between(
    order_values: NDArray[np.float64],
    deviances: NDArray[np.float64],
    inside_index: int,
    outside_index: int,
) -> float:
    """Return the order value at which the deviance crosses the 95 % limit.

    It is interpolated between one index within the limit and one outside.
    """
    return order_at_deviance_limit(
        float(order_values[inside_index]),
        float(order_values[outside_index]),
        float(deviances[inside_index]),
        float(deviances[outside_index]),
    )
