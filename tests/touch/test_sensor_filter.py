"""Filters of the sensor: touches seen through them."""

from dataclasses import replace

import numpy as np
import pytest
from struck_beam import OBSTACLES, cut
from touch_records import SHEAR_NOISE_N, TORQUE_NOISE_NM, Slew, simulate

from rigd.touch import SensorFilter, TouchEstimator


@pytest.fixture(scope="module")
def averaged():
    """Return a record whose torque and shear are means over the last three ticks."""
    (struck,) = simulate(
        [OBSTACLES["middle"]], [Slew(1.0)], duration_s=0.8, steps=40, modes=20, noise=0.0
    )
    rng = np.random.default_rng(3)

    def seen(values, noise):
        mean = np.convolve(values, np.full(3, 1 / 3))[: values.size]
        return mean + rng.normal(0, noise, values.size)

    return replace(
        struck,
        torque_nm=seen(struck.torque_nm, TORQUE_NOISE_NM),
        shear_n=seen(struck.shear_n, SHEAR_NOISE_N),
    )


@pytest.mark.further  # as one without a filter is
def test_a_touch_seen_through_a_mean_is_told_right(averaged, model):
    sensor_filter = SensorFilter(weights=(1 / 3,) * 3, spacing_s=1e-3)
    assert sensor_filter.weights_delay_s == 1e-3
    stated = replace(model, plant=replace(model.plant, delay_s=1e-3))
    record = cut(averaged, 60)
    told = TouchEstimator(replace(stated, sensor_filter=sensor_filter), 1000.0).estimate(record)
    assert told.kind == "rigid"
    assert told.x_m.value == pytest.approx(OBSTACLES["middle"].x_m, abs=3e-3)
    low, high = told.x_m.interval_95
    assert low < OBSTACLES["middle"].x_m < high
    assert told.chi2_per_degree < 1.3
    blind = TouchEstimator(stated, 1000.0).estimate(record)
    assert blind.chi2_per_degree > 1.5 * told.chi2_per_degree
