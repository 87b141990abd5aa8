"""The gauges of the simulated ATI sensor."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.profile import load_profile

SENSOR = load_profile("sim").rig.sensor
UNLOADED = [612, -1043, 385, 871, -724, 198]
RANGE = np.array(SENSOR.range)


@pytest.fixture
def gauges(make_can_host):
    return make_can_host().node.gauges


def test_the_matrix_is_full_not_symmetric_and_well_conditioned(gauges):
    matrix = gauges.matrix
    assert matrix.dtype == np.float32
    assert matrix.shape == (6, 6)
    assert np.all(matrix != 0)
    assert not np.allclose(matrix, matrix.T)
    assert np.linalg.cond(matrix / RANGE[:, None]) < 4


def test_the_matrix_is_as_large_as_those_of_real_sensors(gauges):
    """1e2 to 8e3 are printed for a SI-130-10 at a million counts; ours has 20 N and 1 N·m."""
    largest = np.abs(gauges.matrix).max(axis=1)
    assert np.all(largest[:3] > 1e2 * 20 / 130)
    assert np.all(largest[:3] < 8e3)
    assert np.all(largest[3:] > 1e2 * 1 / 10)
    assert np.all(largest[3:] < 8e3 * 1 / 10)


def test_unloaded_gauges_are_not_zero(gauges):
    assert gauges.read_counts([(0.0,) * 6]).tolist() == [UNLOADED]


def test_the_bias_resembles_a_small_load(gauges):
    load = gauges.matrix.astype(float) @ np.array(UNLOADED) / 1e6
    assert np.all(np.abs(load) < 0.15 * RANGE)


def test_the_full_range_saturates_no_gauge(gauges):
    corners = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1).T * RANGE
    counts = gauges.read_counts([tuple(corner) for corner in corners]) - np.array(UNLOADED)
    assert np.all(np.abs(counts).max(axis=0) > 23_500)
    assert np.all(np.abs(counts).max(axis=0) < 28_000)


def test_rounding_and_one_count_are_below_half_the_resolution(gauges):
    resolution = np.array(SENSOR.resolution)
    assert np.all(gauges.quantisation < 0.5 * resolution)
    assert np.all(np.abs(gauges.matrix).max(axis=1) / 1e6 < 0.5 * resolution)


def test_the_stated_quantisation_is_nearly_reached(gauges):
    """It is a bound on all wrenches, and nearly reached."""
    wrenches = np.random.default_rng(3).uniform(-1, 1, (20_000, 6)) * RANGE
    counts = gauges.read_counts([tuple(w) for w in wrenches]).astype(float) - UNLOADED
    error = np.abs(counts @ gauges.matrix.astype(float).T / 1e6 - wrenches).max(axis=0)
    assert np.all(error > 0.7 * gauges.quantisation)


def test_another_range_uses_the_gauges_as_well(gauges, make_can_host):
    small = make_can_host(sensor=replace(SENSOR, range=tuple(0.1 * RANGE))).node.gauges
    counts = small.read_counts([tuple(0.1 * RANGE)])
    assert np.abs(counts - gauges.read_counts([tuple(RANGE)])).max() <= 1


def test_a_gauge_saturates_beyond_sixteen_bits(gauges):
    ((*high,), (*low,)) = gauges.read_counts([(0, 0, 0, 0, 0, 5.0), (0, 0, 0, 0, 0, -5.0)]).tolist()
    assert [high[0], high[2], high[4]] == [32767] * 3
    assert [low[0], low[2], low[4]] == [-32768] * 3


@pytest.mark.parametrize(("gauge", "value"), [(0, 32767), (1, -32767), (4, -32767), (5, 32767)])
def test_one_gauge_can_saturate_alone(gauges, gauge, value):
    expected = [value if n == gauge else UNLOADED[n] for n in range(6)]
    assert gauges.read_counts([(0.0,) * 6] * 2, gauge).tolist() == [expected, expected]
