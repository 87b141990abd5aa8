"""Fewer points of a curve without losing a peak of it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Thinning:
    """Points of a grid, gathered in groups of which the extremes are kept.

    Attributes
    ----------
    grid
        (n,) of increasing values.
    groups
        (k, m) indices into the grid, each group filled up with its first one.
    """

    grid: Real
    groups: npt.NDArray[np.intp]

    @classmethod
    def logarithmic(cls, grid: Real, first: float, last: float, groups: int) -> "Thinning":
        """Gather points from `first` to `last` in groups of equal ratio, leaving out empty ones."""
        edges = np.geomspace(first, last, groups + 1)
        # A point at the very end belongs to the last group.
        edges[-1] = np.nextafter(last, np.inf)
        bounds = np.unique(np.searchsorted(grid, edges))
        starts, sizes = bounds[:-1], np.diff(bounds)
        offsets = np.arange(sizes.max(initial=0))
        return cls(grid, starts[:, None] + np.where(offsets < sizes[:, None], offsets, 0))

    def strips(self, values: Real) -> list[Real]:
        """Return the curve as strips (p, 2) of grid point and value, broken where values are NaN.

        Of every group the least and the greatest value are kept, where they are.

        Parameters
        ----------
        values
            (n,) on the grid.
        """
        grouped = values[self.groups]
        unknown = np.isnan(grouped)
        rows = np.flatnonzero(~unknown.all(axis=1))
        if rows.size == 0:
            return []
        grouped, unknown = grouped[rows], unknown[rows]
        least = np.where(unknown, np.inf, grouped).argmin(axis=1)
        greatest = np.where(unknown, -np.inf, grouped).argmax(axis=1)
        pair = np.sort(np.stack([least, greatest], axis=1), axis=1)
        kept = np.take_along_axis(self.groups[rows], pair, axis=1)
        breaks = np.flatnonzero(np.diff(rows) > 1) + 1
        return [
            np.column_stack([self.grid[part], values[part]])
            for part in (_without_repeats(piece.ravel()) for piece in np.split(kept, breaks))
        ]


def _without_repeats(indices: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Leave out what follows itself: where a group has but one point."""
    kept: npt.NDArray[np.intp] = indices[np.insert(np.diff(indices) != 0, 0, True)]
    return kept
