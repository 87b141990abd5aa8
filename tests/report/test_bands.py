"""Bands by linearisation against draws of the parameters through the exact model."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.report.bands import loss_factors, response_band
from rigd.beam import LOGARITHMIC_PARAMETERS, Beam, Damping, transfer

pytestmark = pytest.mark.fit

FREQUENCY_HZ = np.array([1.0, 2.5, 2.57, 8.0, 11.3, 16.01, 30.0, 44.8])


@pytest.fixture(scope="module")
def fit(record_result):
    return record_result.whole.fits["VI"]


def drawn(fit, draws):
    """Parameters drawn from the covariance, by name, shape (draws,) each."""
    mean = [
        np.log(fit.parameters[name]) if name in LOGARITHMIC_PARAMETERS else fit.parameters[name]
        for name in fit.determined
    ]
    found = np.random.default_rng(1).multivariate_normal(mean, fit.covariance, draws).T
    return {name: np.full(draws, value) for name, value in fit.parameters.items()} | {
        name: np.exp(values) if name in LOGARITHMIC_PARAMETERS else values
        for name, values in zip(fit.determined, found, strict=True)
    }


def test_response_band_matches_scatter_of_draws(fit):
    draws = 3000
    s = 2j * np.pi * FREQUENCY_HZ
    values = drawn(fit, draws)
    responses = np.empty((draws, s.size), dtype=complex)
    for i in range(draws):
        at = {name: each[i] for name, each in values.items()}
        stiffness = at["bending_stiffness_n_m2"]
        beam = Beam(fit.plant.beam.length_m, at["density_over_stiffness"] * stiffness, stiffness)
        damping = Damping(at["zeta"], at["alpha"], at["gamma"], at["lambda"])
        responses[i] = transfer(s, beam, damping) + at["tool_inertia_kg_m2"] * s**2
    band = response_band(fit, FREQUENCY_HZ)
    deviation = np.log(responses / band.response)
    # Of 3000 draws, a standard deviation is known to 1.3 %, a fraction of 95 % to 0.4 %.
    np.testing.assert_allclose(band.log_magnitude_std, deviation.real.std(axis=0), rtol=0.05)
    np.testing.assert_allclose(band.phase_std_rad, deviation.imag.std(axis=0), rtol=0.05)
    low, high = band.magnitude_limits()
    inside = (np.abs(responses) > low) & (np.abs(responses) < high)
    np.testing.assert_allclose(inside.mean(axis=0), 0.95, atol=0.016)


@pytest.mark.further  # as the response's
def test_loss_factor_bands_match_scatter_of_draws(fit):
    factors = loss_factors(fit, FREQUENCY_HZ)
    s = 2j * np.pi * FREQUENCY_HZ
    values = {name: each[:, np.newaxis] for name, each in drawn(fit, 50_000).items()}
    elastic = 1 + values["zeta"] * s ** values["alpha"]
    inertial = values["density_over_stiffness"] * s**2 + values["gamma"] * s ** values["lambda"]
    internal, external = elastic.imag / elastic.real, inertial.imag / -inertial.real
    for factor, found in (
        (factors.internal, internal),
        (factors.external, external),
        (factors.total, internal + external),
    ):
        np.testing.assert_allclose(factor.value, np.median(found, axis=0), rtol=1e-3)
        np.testing.assert_allclose(factor.log_std, np.log(found).std(axis=0), rtol=0.015)
        low, high = factor.limits()
        inside = (found > low) & (found < high)
        np.testing.assert_allclose(inside.mean(axis=0), 0.95, atol=0.004)


def test_total_at_a_mode_is_twice_the_damping_ratio(record_result):
    for name in ("III", "VI", "VII"):
        fit = record_result.whole.fits[name]
        at_hz = np.array([mode.frequency_hz for mode in fit.modes])
        total = loss_factors(fit, at_hz).total
        ratios = np.array([mode.damping_ratio for mode in fit.modes])
        stds = np.array([mode.damping_ratio_std for mode in fit.modes])
        # But for squares of the loss factor: on the way to the pole, the orders count too.
        assert np.all(np.abs(total.value / (2 * ratios) - 1) < total.value)
        # The loss factor is taken at a fixed frequency, the ratio at that of the mode.
        np.testing.assert_allclose(total.value * total.log_std, 2 * stds, rtol=0.04)


def test_absent_damping_has_no_loss_factor(record_result):
    only_internal = loss_factors(record_result.whole.fits["I"], FREQUENCY_HZ)
    assert only_internal.external is None
    np.testing.assert_array_equal(only_internal.total.value, only_internal.internal.value)
    assert np.all(only_internal.total.log_std > 0)


def test_band_excludes_the_delay(fit):
    band = response_band(fit, FREQUENCY_HZ)
    undelayed = replace(fit, plant=replace(fit.plant, delay_s=0.0))
    np.testing.assert_array_equal(
        response_band(undelayed, band.frequency_hz).response, band.response
    )


def test_undetermined_parameters_count_as_known(fit):
    nothing = replace(fit, determined=(), covariance=np.zeros((0, 0)))
    assert not response_band(nothing, FREQUENCY_HZ).log_magnitude_std.any()
    assert not loss_factors(nothing, FREQUENCY_HZ).total.log_std.any()
