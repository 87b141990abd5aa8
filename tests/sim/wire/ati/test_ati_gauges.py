"""The gauges of the simulated ATI sensor."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.profile import load_profile
from rigd.sim.wire._ati_gauges import AtiGauges

SENSOR = load_profile("sim").rig.sensor
GAUGES = AtiGauges(SENSOR)
UNLOADED = [612, -1043, 385, 871, -724, 198]
RANGE = np.array(SENSOR.range)

within_range = st.tuples(*(st.floats(-r, r) for r in SENSOR.range))


def test_the_matrix_is_full_not_symmetric_and_well_conditioned():
    matrix = GAUGES.matrix
    assert matrix.dtype == np.float32
    assert matrix.shape == (6, 6)
    assert np.all(matrix != 0)
    assert not np.allclose(matrix, matrix.T)
    assert np.linalg.cond(matrix / RANGE[:, None]) < 4


def test_the_matrix_is_as_large_as_those_of_real_sensors():
    """1e2 to 8e3 are printed for a SI-130-10 at a million counts; ours has 20 N and 1 N·m."""
    largest = np.abs(GAUGES.matrix).max(axis=1)
    assert np.all(largest[:3] > 1e2 * 20 / 130)
    assert np.all(largest[:3] < 8e3)
    assert np.all(largest[3:] > 1e2 * 1 / 10)
    assert np.all(largest[3:] < 8e3 * 1 / 10)


def test_unloaded_gauges_are_not_zero():
    assert GAUGES.read([(0.0,) * 6]).tolist() == [UNLOADED]


def test_the_bias_looks_like_a_small_load():
    load = GAUGES.matrix.astype(float) @ np.array(UNLOADED) / 1e6
    assert np.all(np.abs(load) < 0.15 * RANGE)


def test_the_full_range_in_every_direction_uses_the_gauges_and_saturates_none():
    corners = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1).T * RANGE
    gauges = GAUGES.read([tuple(corner) for corner in corners]) - np.array(UNLOADED)
    assert np.all(np.abs(gauges).max(axis=0) > 23_500)
    assert np.all(np.abs(gauges).max(axis=0) < 28_000)


def test_rounding_stays_below_half_the_resolution_and_so_does_one_count():
    resolution = np.array(SENSOR.resolution)
    assert np.all(GAUGES.quantisation < 0.5 * resolution)
    assert np.all(np.abs(GAUGES.matrix).max(axis=1) / 1e6 < 0.5 * resolution)


@given(within_range)
@settings(max_examples=200)
def test_a_wrench_comes_back_from_its_gauges(wrench):
    gauges = GAUGES.read([wrench])[0].astype(float) - UNLOADED
    back = GAUGES.matrix.astype(float) @ gauges / 1e6
    assert np.all(np.abs(back - wrench) <= GAUGES.quantisation * (1 + 1e-9))


def test_the_quantisation_stated_is_nearly_reached():
    """It is a bound on all wrenches, and no idle one."""
    wrenches = np.random.default_rng(3).uniform(-1, 1, (20_000, 6)) * RANGE
    gauges = GAUGES.read([tuple(w) for w in wrenches]).astype(float) - UNLOADED
    error = np.abs(gauges @ GAUGES.matrix.astype(float).T / 1e6 - wrenches).max(axis=0)
    assert np.all(error > 0.7 * GAUGES.quantisation)


def test_other_counts_scale_the_matrix_and_leave_the_gauges():
    other = AtiGauges(SENSOR, (250_000, 4_000_000))
    scale = np.repeat([0.25, 4.0], 3)
    assert other.matrix == pytest.approx(GAUGES.matrix * scale[:, None], rel=1e-6)
    wrench = (3.0, -2.0, 11.0, 0.2, -0.1, 0.4)
    assert np.abs(other.read([wrench]) - GAUGES.read([wrench])).max() <= 1


def test_another_range_keeps_the_gauges_in_use():
    small = AtiGauges(replace(SENSOR, range=tuple(0.1 * RANGE)))
    gauges = small.read([tuple(0.1 * RANGE)])
    assert np.abs(gauges - GAUGES.read([tuple(RANGE)])).max() <= 1


def test_beyond_sixteen_bits_a_gauge_saturates():
    ((*high,), (*low,)) = GAUGES.read([(0, 0, 0, 0, 0, 5.0), (0, 0, 0, 0, 0, -5.0)]).tolist()
    assert [high[0], high[2], high[4]] == [32767] * 3
    assert [low[0], low[2], low[4]] == [-32768] * 3


@pytest.mark.parametrize(("gauge", "value"), [(0, 32767), (1, -32767), (4, -32767), (5, 32767)])
def test_a_gauge_can_be_made_to_saturate_alone(gauge, value):
    gauges = GAUGES.read([(0.0,) * 6] * 2, gauge).tolist()
    expected = [value if n == gauge else UNLOADED[n] for n in range(6)]
    assert gauges == [expected, expected]
