"""Modes of a specimen over time: their course through its sessions and significant changes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import hypot, log
from typing import Any, Final

from rigd.library._row import SessionRow

_SAME_MODE: Final = log(1.25)
"""Largest frequency ratio of the same mode in two sessions; modes of a beam are further apart."""

_SIGNIFICANT: Final = 3.0 / 1.96
"""Half-widths of a 95 % interval in three standard deviations."""

Quantity = Mapping[str, Any]
"""Number of a mode: ``value``, ``std``, ``interval_95``, ``flag``."""


@dataclass(frozen=True, slots=True)
class ModeChange:
    """Difference of a quantity between two sessions."""

    difference: float
    """Later less earlier, in the unit of the quantity."""
    significant: bool | None
    """Whether the difference exceeds three standard deviations; None if this is not known: an
    interval is missing, or a quantity is flagged."""


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """A mode in one session."""

    row: SessionRow
    """The session."""
    frequency_hz: Quantity
    """Natural frequency."""
    damping_ratio: Quantity
    """Damping ratio."""
    frequency_change: ModeChange | None
    """Change since the mode's first session; None for that session."""
    damping_change: ModeChange | None
    """Change of the damping ratio, likewise."""


@dataclass(frozen=True, slots=True)
class ModeTrend:
    """A mode through the sessions of a specimen."""

    points: tuple[TrendPoint, ...]
    """The mode in its sessions, the oldest first."""

    def as_dict(self) -> dict[str, Any]:
        """Return the trend for JSON."""
        return {
            "points": [
                {
                    "id": point.row.id,
                    "path": str(point.row.path),
                    "start_utc_ns": point.row.start_utc_ns,
                    "frequency_hz": point.frequency_hz,
                    "damping_ratio": point.damping_ratio,
                    "validity": point.row.validity,
                    "frequency_change": _document(point.frequency_change),
                    "damping_change": _document(point.damping_change),
                }
                for point in self.points
            ]
        }


def change_between(before: Quantity, after: Quantity) -> ModeChange:
    """Return the change of a quantity between two sessions.

    Parameters
    ----------
    before, after
        The quantity in the earlier and in the later session.

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
    difference = after["value"] - before["value"]
    if any(each.get("interval_95") is None or each.get("flag") for each in (before, after)):
        return ModeChange(difference, None)
    low, high = (before, after) if difference >= 0 else (after, before)
    allowed = hypot(low["interval_95"][1] - low["value"], high["value"] - high["interval_95"][0])
    return ModeChange(difference, abs(difference) > _SIGNIFICANT * allowed > 0.0)


def mode_trends(rows: Iterable[SessionRow]) -> list[ModeTrend]:
    """Return the trends of the modes of one specimen through its sessions.

    Parameters
    ----------
    rows
        Sessions of the specimen in any order; those without modes are ignored.

    Returns
    -------
    list of ModeTrend
        Trends in the order of frequency. Modes of two sessions are the same if their frequencies
        are the nearest, within a factor of 1.25. Changes are relative to the mode's first session.
    """
    trends: list[list[TrendPoint]] = []
    for row in sorted(rows, key=lambda row: (row.start_utc_ns or 0, row.id)):
        taken: set[int] = set()
        for mode in row.modes:
            frequency, damping = mode["frequency_hz"], mode["damping_ratio"]
            distances = {
                number: abs(log(frequency["value"] / points[-1].frequency_hz["value"]))
                for number, points in enumerate(trends)
                if number not in taken
            }
            nearest = min(distances, key=distances.__getitem__, default=None)
            if nearest is None or distances[nearest] > _SAME_MODE:
                nearest = len(trends)
                trends.append([])
            taken.add(nearest)
            points = trends[nearest]
            changes: tuple[ModeChange | None, ModeChange | None] = (None, None)
            if points:
                first = points[0]
                changes = (
                    change_between(first.frequency_hz, frequency),
                    change_between(first.damping_ratio, damping),
                )
            points.append(TrendPoint(row, frequency, damping, *changes))
    trends.sort(key=lambda points: float(points[0].frequency_hz["value"]))
    return [ModeTrend(tuple(points)) for points in trends]


def _document(change: ModeChange | None) -> dict[str, Any] | None:
    if change is None:
        return None
    return {"difference": change.difference, "significant": change.significant}
