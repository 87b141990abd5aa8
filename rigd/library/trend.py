"""Changes of a specimen's modes over its sessions, with a test of their significance."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import log
from typing import Any, Final

from rigd.estimates import Change, Estimate, change_between
from rigd.library._row import SessionRow

_MAX_LOG_FREQUENCY_RATIO: Final = log(1.25)
"""Largest logarithm of the ratio of a mode's frequencies in two sessions.

Different modes of a beam are further apart."""


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """Frequency and damping ratio of a mode in one session, and their changes."""

    row: SessionRow
    """Session in the library."""
    frequency_hz: Estimate
    """Natural frequency of the mode."""
    damping_ratio: Estimate
    """Damping ratio of the mode."""
    frequency_change: Change | None
    """Change of the frequency since the mode's first session; None for that session."""
    damping_change: Change | None
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
                    "frequency_hz": point.frequency_hz.as_json(),
                    "damping_ratio": point.damping_ratio.as_json(),
                    "validity": point.row.validity,
                    "frequency_change": point.frequency_change and point.frequency_change.as_json(),
                    "damping_change": point.damping_change and point.damping_change.as_json(),
                }
                for point in self.points
            ]
        }


def mode_trends(session_rows: Iterable[SessionRow]) -> list[ModeTrend]:
    """Return the trends of the modes of one specimen over its sessions.

    Parameters
    ----------
    session_rows
        Sessions of the specimen in any order. Sessions without modes are ignored.

    Returns
    -------
    list of ModeTrend
        Trends in the order of frequency. Modes of two sessions count as the same mode if their
        frequencies are nearest to each other, within a factor of 1.25. Changes are relative to the
        first session that has the mode.
    """
    trends: list[list[TrendPoint]] = []
    for row in sorted(session_rows, key=lambda row: (row.start_utc_ns or 0, row.id)):
        assigned_trend_indices: set[int] = set()
        for mode in row.modes:
            log_frequency_distances = {
                trend_index: abs(log(mode.frequency_hz.value / points[-1].frequency_hz.value))
                for trend_index, points in enumerate(trends)
                if trend_index not in assigned_trend_indices
            }
            nearest_trend_index = min(
                log_frequency_distances, key=log_frequency_distances.__getitem__, default=None
            )
            if (
                nearest_trend_index is None
                or log_frequency_distances[nearest_trend_index] > _MAX_LOG_FREQUENCY_RATIO
            ):
                nearest_trend_index = len(trends)
                trends.append([])
            assigned_trend_indices.add(nearest_trend_index)
            points = trends[nearest_trend_index]
            frequency_and_damping_change: tuple[Change | None, Change | None] = (None, None)
            if points:
                first_point = points[0]
                frequency_and_damping_change = (
                    change_between(first_point.frequency_hz, mode.frequency_hz),
                    change_between(first_point.damping_ratio, mode.damping_ratio),
                )
            points.append(
                TrendPoint(
                    row, mode.frequency_hz, mode.damping_ratio, *frequency_and_damping_change
                )
            )
    trends.sort(key=lambda points: points[0].frequency_hz.value)
    return [ModeTrend(tuple(points)) for points in trends]
