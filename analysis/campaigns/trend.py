"""Change of a quantity with time over the sessions of a campaign, or over the blocks of one.

A straight line is fitted to the estimates by weighted least squares. If they scatter about the line
by more than their standard deviations, that of the slope is increased accordingly (Birge ratio).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.statistics import student_t_p_value, student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Sequence

MIN_TREND_SESSIONS: Final = 4
"""Smallest number of sessions for a trend: two more than the unknowns of a straight line."""

_MIN_COVERED_H: Final = 1e-3
"""Shortest time in hours over which a change is estimated."""


@dataclass(frozen=True, slots=True)
class Trend:
    """Straight line through the estimates of one quantity over time.

    Attributes
    ----------
    slope_per_h : float
        Change of the quantity per hour.
    slope_std_per_h : float
        Standard deviation of the slope.
    interval_95_per_h : tuple of float
        95 % interval of the slope.
    p_value : float
        p-value of no change.
    covered_h : float
        Time in hours from the middle of the first session to that of the last.
    centre : tuple of float
        Weighted means of the times in seconds and of the estimates, through which the line passes.
    """

    slope_per_h: float
    slope_std_per_h: float
    interval_95_per_h: tuple[float, float]
    p_value: float
    covered_h: float
    centre: tuple[float, float]

    def value_at(self, time_s: float) -> float:
        """Return the value of the line at a time in seconds."""
        centre_s, centre_value = self.centre
        return centre_value + self.slope_per_h * (time_s - centre_s) / 3600


def linear_trend(
    times_s: Sequence[float | None], estimates: Sequence[float], stds: Sequence[float]
) -> Trend | None:
    """Return the trend of estimates over time.

    Parameters
    ----------
    times_s : sequence of float or None
        Time of each estimate; None if it is unknown.
    estimates, stds : sequence of float
        Estimates, and their standard deviations.

    Returns
    -------
    Trend or None
        None with fewer than four estimates, or if their times are unknown or equal.

    Examples
    --------
    >>> from analysis.campaigns.trend import linear_trend
    >>> trend = linear_trend([0, 3600, 7200, 10800], [1.0, 1.11, 1.19, 1.3], [0.01] * 4)
    >>> print(f"{trend.slope_per_h:.3f} per h in {trend.covered_h:g} h")
    0.098 per h in 3 h
    """
    known_times_s = [time_s for time_s in times_s if time_s is not None]
    if len(known_times_s) < max(len(times_s), MIN_TREND_SESSIONS):
        return None
    times_h = np.array(known_times_s) / 3600
    covered_h = float(np.ptp(times_h))
    if covered_h < _MIN_COVERED_H:
        return None
    weights = 1 / np.array(stds) ** 2
    mean_h = weights @ times_h / weights.sum()
    centred_h = times_h - mean_h
    time_variance = float(weights @ centred_h**2)
    values = np.array(estimates)
    mean = weights @ values / weights.sum()
    slope = float(weights * centred_h @ values) / time_variance
    degrees_of_freedom = len(values) - 2
    residual_chi_square = float(weights @ (values - mean - slope * centred_h) ** 2)
    birge_ratio = math.sqrt(max(residual_chi_square / degrees_of_freedom, 1.0))
    slope_std = birge_ratio / math.sqrt(time_variance)
    half_width = student_t_quantile(0.95, degrees_of_freedom) * slope_std
    return Trend(
        slope,
        slope_std,
        (slope - half_width, slope + half_width),
        student_t_p_value(slope / slope_std, degrees_of_freedom),
        covered_h,
        (3600 * float(mean_h), float(mean)),
    )
