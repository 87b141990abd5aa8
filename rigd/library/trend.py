"""Changes of a specimen's modes over its sessions, with a test of their significance."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import hypot, log
from typing import Any, Final

from rigd.library._row import SessionRow

_MOST_LOG_FREQUENCY_RATIO: Final = log(1.25)
"""Largest logarithm of the frequency ratio of the same mode in two sessions.

Modes of a beam are further apart."""

_SIGNIFICANCE_HALF_WIDTHS: Final = 3.0 / 1.96
"""Ratio of three standard deviations to the half-width of a 95 % interval."""

Quantity = Mapping[str, Any]
"""Frequency or damping ratio of a mode: ``value``, ``std``, ``interval_95``, ``flag``."""


@dataclass(frozen=True, slots=True)
class ModeChange:
    """Change of a mode's frequency or damping ratio between two sessions, and if significant."""

    difference: float
    """Value in the later session minus value in the earlier one, in the unit of the quantity."""
    significant: bool | None
    """Whether the difference exceeds three standard deviations.

    None if this is unknown, because an interval is missing or a value is flagged."""


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """Frequency and damping ratio of a mode in one session, and their changes."""

    row: SessionRow
    """Session in the library."""
    frequency_hz: Quantity
    """Natural frequency of the mode."""
    damping_ratio: Quantity
    """Damping ratio of the mode."""
    frequency_change: ModeChange | None
    """Change of the frequency since the mode's first session; None for that session."""
    damping_change: ModeChange | None
    """Change of the damping ratio since the mode's first session; None for that session."""


@dataclass(frozen=True, slots=True)
class ModeTrend:
    """Frequency and damping ratio of a mode over the sessions of a specimen."""

    points: tuple[TrendPoint, ...]
    """Values of the mode in each session, the oldest session first."""

    def as_dict(self) -> dict[str, Any]:
        """Return the trend as a dictionary for JSON."""
        return {
            "points": [
                {
                    "id": point.row.id,
                    "path": str(point.row.path),
                    "start_utc_ns": point.row.start_utc_ns,
                    "frequency_hz": point.frequency_hz,
                    "damping_ratio": point.damping_ratio,
                    "validity": point.row.validity,
                    "frequency_change": _change_json(point.frequency_change),
                    "damping_change": _change_json(point.damping_change),
                }
                for point in self.points
            ]
        }


def change_between(earlier_quantity: Quantity, later_quantity: Quantity) -> ModeChange:
    """Return the change of a frequency or damping ratio between two sessions.

    Parameters
    ----------
    earlier_quantity, later_quantity
        Quantity in the earlier and in the later session.

    Returns
    -------
    Change

    Notes
    -----
    Both errors are independent. The half-width of the 95 % interval of the difference is the root
    of the sum of the squared half-widths, each on the side of the other value. A change is
    significant beyond three standard deviations, 1.53 times this half-width, because a trend has
    many changes and one in twenty exceeds a 95 % interval by chance.

    Examples
    --------
    >>> from rigd.library.trend import change_between
    >>> before = {"value": 2.60, "interval_95": [2.59, 2.61]}
    >>> change_between(before, {"value": 2.63, "interval_95": [2.62, 2.64]}).significant
    True
    """
    difference = later_quantity["value"] - earlier_quantity["value"]
    if any(
        quantity.get("interval_95") is None or quantity.get("flag")
        for quantity in (earlier_quantity, later_quantity)
    ):
        return ModeChange(difference, None)
    lower_quantity, higher_quantity = (
        (earlier_quantity, later_quantity)
        if difference >= 0
        else (later_quantity, earlier_quantity)
    )
    half_width_95 = hypot(
        lower_quantity["interval_95"][1] - lower_quantity["value"],
        higher_quantity["value"] - higher_quantity["interval_95"][0],
    )
    return ModeChange(difference, abs(difference) > _SIGNIFICANCE_HALF_WIDTHS * half_width_95 > 0.0)


def mode_trends(session_rows: Iterable[SessionRow]) -> list[ModeTrend]:
    """Return the trends of the modes of one specimen over its sessions.

    Parameters
    ----------
    session_rows
        Sessions of the specimen in any order. Sessions without modes are ignored.

    Returns
    -------
    list of ModeTrend
        Trends in the order of frequency. Modes of two sessions are the same if their frequencies
        are nearest to each other, within a factor of 1.25. Changes are relative to the mode's first
        session.
    """
    trends: list[list[TrendPoint]] = []
    for row in sorted(session_rows, key=lambda row: (row.start_utc_ns or 0, row.id)):
        assigned: set[int] = set()
        for mode in row.modes:
            frequency_estimate, damping_estimate = mode["frequency_hz"], mode["damping_ratio"]
            distances = {
                trend_index: abs(
                    log(frequency_estimate["value"] / points[-1].frequency_hz["value"])
                )
                for trend_index, points in enumerate(trends)
                if trend_index not in assigned
            }
            nearest_trend = min(distances, key=distances.__getitem__, default=None)
            if nearest_trend is None or distances[nearest_trend] > _MOST_LOG_FREQUENCY_RATIO:
                nearest_trend = len(trends)
                trends.append([])
            assigned.add(nearest_trend)
            points = trends[nearest_trend]
            changes: tuple[ModeChange | None, ModeChange | None] = (None, None)
            if points:
                first_point = points[0]
                changes = (
                    change_between(first_point.frequency_hz, frequency_estimate),
                    change_between(first_point.damping_ratio, damping_estimate),
                )
            points.append(TrendPoint(row, frequency_estimate, damping_estimate, *changes))
    trends.sort(key=lambda points: float(points[0].frequency_hz["value"]))
    return [ModeTrend(tuple(points)) for points in trends]


def _change_json(change: ModeChange | None) -> dict[str, Any] | None:
    """Return a change as a dictionary for JSON; None if there is none."""
    if change is None:
        return None
    return {"difference": change.difference, "significant": change.significant}
