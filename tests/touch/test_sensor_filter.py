"""Estimates of touches from filtered samples."""

from dataclasses import replace

import numpy as np
import pytest
from struck_beam import OBSTACLES, cut
from touch_records import SHEAR_NOISE_N, TORQUE_NOISE_NM, Slew, simulate

from rigd.touch import SensorFilter, TouchEstimator


@pytest.fixture(scope="module")
def averaged_record():
    """Return a record whose torque and shear are means over the last three ticks."""
    (unfiltered,) = simulate(
        [OBSTACLES["middle"]], [Slew(1.0)], duration_s=0.8, steps=40, modes=20, noise=0.0
    )
    rng = np.random.default_rng(3)

    def averaged(values, noise):
        mean = np.convolve(values, np.full(3, 1 / 3))[: values.size]
        return mean + rng.normal(0, noise, values.size)

    return replace(
        unfiltered,
        torque_nm=averaged(unfiltered.torque_nm, TORQUE_NOISE_NM),
        shear_n=averaged(unfiltered.shear_n, SHEAR_NOISE_N),
    )


@pytest.mark.further  # as without a filter
def test_estimate_from_averaged_samples(averaged_record, model):
    sensor_filter = SensorFilter(weights=(1 / 3,) * 3, spacing_s=1e-3)
    assert sensor_filter.weights_delay_s == 1e-3
    delayed_model = replace(model, plant=replace(model.plant, delay_s=1e-3))
    record = cut(averaged_record, 60)
    estimate = TouchEstimator(replace(delayed_model, sensor_filter=sensor_filter), 1000.0).estimate(
        record
    )
    assert estimate.kind == "rigid"
    assert estimate.x_m.value == pytest.approx(OBSTACLES["middle"].x_m, abs=3e-3)
    low, high = estimate.x_m.interval_95
    assert low < OBSTACLES["middle"].x_m < high
    assert estimate.chi2_per_degree < 1.3
    without_filter = TouchEstimator(delayed_model, 1000.0).estimate(record)
    assert without_filter.chi2_per_degree > 1.5 * estimate.chi2_per_degree
