"""Curves of a response: a decimated curve preserves every peak at its frequency; phases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral import CurveDecimation, phase_deg

GRID = np.arange(9601) / 160.0


@given(
    seed=st.integers(0, 2**32 - 1),
    groups=st.integers(1, 300),
    unknown=st.floats(0.0, 1.0),
)
def test_decimation_preserves_extremes(seed, groups, unknown):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=GRID.size)
    values[rng.random(GRID.size) < unknown] = np.nan
    thinning = CurveDecimation.with_logarithmic_groups(GRID, 0.5, 60.0, groups)
    strips = thinning.curve_strips(values)
    points = np.concatenate(strips) if strips else np.empty((0, 2))
    assert len(points) <= 2 * groups
    inside = (GRID >= 0.5) & (GRID <= 60.0) & np.isfinite(values)
    if inside.any():
        assert points[:, 1].max() == values[inside].max()
        assert points[:, 1].min() == values[inside].min()
    # Every point is one of the curve, and they go one way.
    index = np.rint(points[:, 0] * 160.0).astype(int)
    assert (thinning.extreme_indices(values) == index).all()
    assert points[:, 1] == pytest.approx(values[index], abs=0.0)
    assert np.all(np.diff(points[:, 0]) > 0)


def test_every_local_peak_wider_than_a_group_survives():
    peaks_hz = np.geomspace(0.6, 55.0, 12)
    values = sum(np.exp(-(((GRID - peak) / (0.02 * peak)) ** 2)) for peak in peaks_hz)
    points = np.concatenate(
        CurveDecimation.with_logarithmic_groups(GRID, 0.5, 60.0, 200).curve_strips(values)
    )
    for peak_hz in peaks_hz:
        near = abs(points[:, 0] - peak_hz) < 0.02 * peak_hz
        near_all = abs(GRID - peak_hz) < 0.02 * peak_hz
        assert points[near, 1].max() == values[near_all].max()


def test_curve_is_interrupted_at_unknown_values():
    values = np.zeros(GRID.size)
    values[(GRID > 5.0) & (GRID < 10.0)] = np.nan
    below, above = CurveDecimation.with_logarithmic_groups(GRID, 0.5, 60.0, 200).curve_strips(
        values
    )
    assert below[-1, 0] <= 5.0
    assert above[0, 0] >= 10.0
    thinning = CurveDecimation.with_logarithmic_groups(GRID, 0.5, 60.0, 200)
    assert thinning.curve_strips(np.full(GRID.size, np.nan)) == []
    first, last = GRID[thinning.gap_edge_indices(values)]
    assert np.isnan(values[thinning.gap_edge_indices(values)]).all()
    assert 5.0 < first < 5.4
    assert 9.5 < last < 10.0
    # Nothing is between the known values and the unknown end of a curve.
    assert thinning.gap_edge_indices(np.where(GRID > 5.0, np.nan, 0.0)).size == 0
    assert thinning.gap_edge_indices(np.full(GRID.size, np.nan)).size == 0


@pytest.mark.parametrize("grid", [[], [0.1, 0.2]])
def test_curve_outside_the_band_is_empty(grid):
    grid = np.array(grid)
    thinning = CurveDecimation.with_logarithmic_groups(grid, 0.5, 60.0, 200)
    assert thinning.extreme_indices(np.ones(grid.size)).size == 0
    assert thinning.curve_strips(np.ones(grid.size)) == []


def test_phases_about_zero_and_half_a_turn_do_not_jump():
    noise = np.exp(1j * np.radians([-10.0, 0.0, 10.0]))
    assert phase_deg(noise) == pytest.approx([-10.0, 0.0, 10.0])
    assert phase_deg(-noise) == pytest.approx([170.0, 180.0, 190.0])
