"""Modes of a specimen over time: their course through its sessions, and which changes are real."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import hypot, log
from typing import Any, Final

from rigd.library._row import SessionRow

_SAME_MODE: Final = log(1.25)
"""Largest ratio of two frequencies that may be one mode's; a beam's modes are further apart."""

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
    """Whether it is larger than three standard deviations; None if that cannot be told: an interval
    is not known, or a quantity is flagged."""


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
    """Change since the mode's first session; None of that one."""
    damping_change: ModeChange | None
    """Likewise of the damping ratio."""


@dataclass(frozen=True, slots=True)
class ModeTrend:
    """A mode through the sessions of a specimen."""

    points: tuple[TrendPoint, ...]
    """Its sessions, the oldest first."""

    def as_dict(self) -> dict[str, Any]:
        """Return it as a document of JSON types."""
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
    """Compare a quantity of two sessions.

    Parameters
    ----------
    before, after
        The quantity in the earlier and in the later session.

    Returns
    -------
    Change

    Notes
    -----
    Both errors are independent, so that the difference has a 95 % interval whose half-width is
    the root of the sum of the squared half-widths; of each interval that half counts which faces
    the other value. A change is significant beyond three standard deviations, 1.53 times that: two
    sessions have six such changes and a trend many more, and 95 % would call one in twenty real.

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
    """Follow the modes of one specimen through its sessions.

    Parameters
    ----------
    rows
        Sessions of the specimen in any order; those without modes are left out.

    Returns
    -------
    list of ModeTrend
        By frequency. A mode is that of another session whose frequency is the nearest, by a factor
        of 1.25 at most; changes are those since the mode's first session.
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
