"""Filters of the sensor: their responses, and touches seen through them."""

from dataclasses import replace
from math import pi, sqrt

import numpy as np
import pytest
from struck_beam import OBSTACLES, cut
from touch_records import DAMPED, LINK, SHEAR_NOISE_N, TORQUE_NOISE_NM, Slew, simulate

from rigd.touch import SensorFilter, TouchEstimator
from rigd.touch._kernels import contact_kernels

STEP_S = 1 / 8000
PLACE = np.array([0.62])


@pytest.fixture(scope="module")
def kernels():
    return contact_kernels(LINK, DAMPED, PLACE, STEP_S, 400)


def test_a_mean_of_records_is_the_mean_of_late_kernels(kernels):
    mean = SensorFilter(weights=(0.25,) * 4, spacing_s=2 * STEP_S)
    seen = contact_kernels(LINK, DAMPED, PLACE, STEP_S, 400, mean)
    for name in ("torque", "shear"):
        plain = getattr(kernels, name)[0]
        late = [np.concatenate([np.zeros(2 * i), plain[: 400 - 2 * i]]) for i in range(4)]
        assert getattr(seen, name)[0] == pytest.approx(
            np.mean(late, axis=0), abs=2e-3 * np.abs(plain).max()
        )
    # The obstacle feels the beam, not the sensor.
    assert np.array_equal(seen.displacement, kernels.displacement)
    assert mean.weights_delay_s == 3 * STEP_S


@pytest.mark.parametrize("order", [1, 2])
def test_a_low_pass_filter_is_the_one_of_the_books(kernels, order):
    corner = 2 * pi * 150.0
    low_pass = SensorFilter(corner_hz=150.0, order=order)
    seen = contact_kernels(LINK, DAMPED, PLACE, STEP_S, 400, low_pass)
    u = np.array([1 / corner, 1.0])
    from scipy.signal import TransferFunction, lsim  # half a second for every worker

    system = TransferFunction([1.0], u if order == 1 else [u[0] ** 2, sqrt(2) * u[0], 1.0])
    _, told, _ = lsim(system, kernels.shear[0], np.arange(400) * STEP_S)
    assert seen.shear[0] == pytest.approx(told, abs=1e-2 * np.abs(told).max())
    assert abs(low_pass.response(1j * corner)) == pytest.approx(sqrt(0.5))


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
    stated = replace(model, torque_delay_s=1e-3)
    record = cut(averaged, 60)
    told = TouchEstimator(replace(stated, sensor_filter=sensor_filter), 1000.0).estimate(record)
    assert told.kind == "rigid"
    assert told.x_m.value == pytest.approx(OBSTACLES["middle"].x_m, abs=3e-3)
    low, high = told.x_m.interval_95
    assert low < OBSTACLES["middle"].x_m < high
    assert told.chi2_per_degree < 1.3
    blind = TouchEstimator(stated, 1000.0).estimate(record)
    assert blind.chi2_per_degree > 1.5 * told.chi2_per_degree
