"""Curves of a frequency response: magnitude, phase, and decimation that preserves peaks."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

RealArray = npt.NDArray[np.float64]
"""Array of real numbers."""
ComplexArray = npt.NDArray[np.complex128]
"""Array of complex numbers."""

PHASE_START_DEG: Final = -90.0
"""Smallest phase in degrees, chosen so that phases near 0 and 180 degrees do not wrap."""


def magnitude_db(response: ComplexArray) -> RealArray:
    """Return the magnitude of complex responses, in dB re 1 N·m/rad."""
    with np.errstate(divide="ignore"):
        level_db: RealArray = 20.0 * np.log10(np.abs(response))
    return level_db


def phase_deg(response: ComplexArray) -> RealArray:
    """Return the phase of complex responses in degrees, from −90 to below 270.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.spectral import phase_deg
    >>> print(phase_deg(np.array([1.0, 1j, -1.0, -1j])))
    [  0.  90. 180. -90.]
    """
    phase_from_start: RealArray = np.mod(np.degrees(np.angle(response)) - PHASE_START_DEG, 360.0)
    return phase_from_start + PHASE_START_DEG


@dataclass(frozen=True, slots=True, eq=False)
class CurveDecimation:
    """Decimation of a curve that retains the least and greatest value of each group of points.

    Attributes
    ----------
    grid
        Increasing values on the horizontal axis of the curve's points, shape (n,).
    groups
        Indices of the points in each group, shape (k, m). Smaller groups are padded with their
        first index.
    """

    grid: RealArray
    groups: npt.NDArray[np.intp]

    @classmethod
    def with_logarithmic_groups(
        cls, grid: RealArray, first_hz: float, last_hz: float, max_groups: int
    ) -> "CurveDecimation":
        """Return the decimation of a curve over frequency, in groups of equal frequency ratio.

        Groups without points are omitted.

        Parameters
        ----------
        grid
            Frequencies of the points, increasing, shape (n,).
        first_hz, last_hz
            Lowest and highest frequency. Points outside are dropped.
        max_groups
            Largest number of groups.
        """
        group_edges = np.geomspace(first_hz, last_hz, max_groups + 1)
        # A point at the very end belongs to the last group.
        group_edges[-1] = np.nextafter(last_hz, np.inf)
        group_bounds = np.unique(np.searchsorted(grid, group_edges))
        group_starts, group_sizes = group_bounds[:-1], np.diff(group_bounds)
        index_offsets = np.arange(group_sizes.max(initial=1))  # 1 if there is no group
        return cls(
            grid,
            group_starts[:, None]
            + np.where(index_offsets < group_sizes[:, None], index_offsets, 0),
        )

    def curve_strips(self, curve_values: RealArray) -> list[RealArray]:
        """Return the decimated curve as strips (p, 2) of grid value and curve value.

        Each strip contains the least and the greatest value of every group. A new strip begins
        after each gap of NaN.

        Parameters
        ----------
        curve_values
            Values of the curve on the grid, shape (n,); NaN if unknown.
        """
        group_indices, extreme_indices = self._group_extremes(curve_values)
        if group_indices.size == 0:
            return []
        strip_starts = np.flatnonzero(np.diff(group_indices) > 1) + 1
        return [
            np.column_stack([self.grid[strip_indices], curve_values[strip_indices]])
            for strip_indices in map(np.unique, np.split(extreme_indices, strip_starts))
        ]

    def extreme_indices(self, curve_values: RealArray) -> npt.NDArray[np.intp]:
        """Return the increasing grid indices of the least and greatest value of every group.

        Parameters
        ----------
        curve_values
            Values on the grid, shape (n,); NaN if unknown.
        """
        return np.unique(self._group_extremes(curve_values)[1])

    def gap_edge_indices(self, curve_values: RealArray) -> npt.NDArray[np.intp]:
        """Return the increasing grid indices of the known values on both sides of each gap.

        Parameters
        ----------
        curve_values
            Values on the grid, shape (n,); NaN if unknown.
        """
        group_indices, _ = self._group_extremes(curve_values)
        groups_before_gaps = np.flatnonzero(np.diff(group_indices) > 1)
        first_indices = self.groups[group_indices[groups_before_gaps] + 1, 0]
        last_indices = self.groups[group_indices[groups_before_gaps + 1] - 1].max(axis=1)
        return np.unique(np.concatenate([first_indices, last_indices]))

    def _group_extremes(
        self, curve_values: RealArray
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Return the indices of groups with known values, and the grid indices of their extremes.

        The extremes are the least and the greatest value, shape (groups, 2).
        """
        grouped_values = curve_values[self.groups]
        is_unknown = np.isnan(grouped_values)
        group_indices = np.flatnonzero(~is_unknown.all(axis=1))
        grouped_values, is_unknown = grouped_values[group_indices], is_unknown[group_indices]
        min_columns = np.where(is_unknown, np.inf, grouped_values).argmin(axis=1)
        max_columns = np.where(is_unknown, -np.inf, grouped_values).argmax(axis=1)
        extreme_columns = np.stack([min_columns, max_columns], axis=1)
        return group_indices, np.take_along_axis(
            self.groups[group_indices], extreme_columns, axis=1
        )
