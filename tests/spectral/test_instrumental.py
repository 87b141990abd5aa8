"""Hiv within a discrete control loop whose every part is known."""

import numpy as np
import pytest
import scipy  # whose parts come on first use

from rigd.spectral import SpectralError, instrumental_response, welch_response

RATE_HZ = 200.0
SETTINGS = {"segment_length": 500, "overlap": 250, "nfft": 500}
# Plant y = x delayed and smoothed, and a controller that adds 0.4 of the measured y, a tick late.
PLANT = np.array([0.0, 0.5]), np.array([1.0, -0.7])
FED_BACK = np.array([0.0, 0.4])


def closed_loop(noise_size, samples=100_000, seed=8):
    """Reference, plant's input and measured output, tick by tick in closed form."""
    rng = np.random.default_rng(seed)
    reference = rng.normal(size=samples)
    noise = noise_size * rng.normal(size=samples)
    b, a = PLANT
    # x = r + F (P x + v): x (A - F B) = A r + F A v
    loop = np.append(a, 0.0) - np.convolve(FED_BACK, b)
    x = scipy.signal.lfilter(a, loop, reference) + scipy.signal.lfilter(
        np.convolve(FED_BACK, a), loop, noise
    )
    return reference, x, scipy.signal.lfilter(b, a, x) + noise


def exact(frequency_hz):
    return scipy.signal.freqz(*PLANT, worN=frequency_hz, fs=RATE_HZ)[1]


def test_loop_matches_its_equations():
    reference, x, y = closed_loop(0.5, samples=200)
    np.testing.assert_allclose(x[1:], reference[1:] + 0.4 * y[:-1], atol=1e-12)


def test_feedback_of_noise_is_averaged_out():
    reference, x, y = closed_loop(1.0)
    h1 = welch_response(x, y, RATE_HZ, **SETTINGS).band(1.0, 99.0)
    hiv = instrumental_response(reference, x, y, RATE_HZ, **SETTINGS).band(1.0, 99.0)
    plant = exact(hiv.frequency_hz)
    off_h1, off_hiv = (np.mean((each.response - plant) / np.abs(plant)) for each in (h1, hiv))
    assert abs(off_h1) > 0.2
    assert abs(off_hiv) < 0.02


def test_sign_of_the_phase_is_that_of_h1():
    reference, x, y = closed_loop(0.0)
    h1 = welch_response(x, y, RATE_HZ, **SETTINGS).band(5.0, 95.0)
    hiv = instrumental_response(reference, x, y, RATE_HZ, **SETTINGS).band(5.0, 95.0)
    plant = exact(hiv.frequency_hz)
    assert (plant.imag < -0.05).any()  # a lag
    np.testing.assert_allclose(hiv.response, plant, atol=0.05)
    np.testing.assert_allclose(h1.response, plant, atol=0.05)


def test_open_loop_without_noise_equals_h1():
    rng = np.random.default_rng(5)
    x = rng.normal(size=6000)
    y = scipy.signal.lfilter(*PLANT, x) + 0.2 * rng.normal(size=x.size)
    h1 = welch_response(x, y, RATE_HZ, **SETTINGS)
    hiv = instrumental_response(x, x, y, RATE_HZ, **SETTINGS)
    np.testing.assert_allclose(hiv.response, h1.response, rtol=1e-10)
    np.testing.assert_allclose(hiv.coherence, h1.coherence, rtol=1e-10)
    assert (hiv.estimator, hiv.segments) == ("iv", h1.segments)


def test_unit_and_delay_of_the_reference_cancel():
    reference, x, y = closed_loop(0.1, samples=50_000)
    found = instrumental_response(reference, x, y, RATE_HZ, **SETTINGS).band(2.0, 98.0)
    late = np.roll(reference, 2) * 57.3
    again = instrumental_response(late, x, y, RATE_HZ, **SETTINGS).band(2.0, 98.0)
    np.testing.assert_allclose(again.response, found.response, atol=0.03)


@pytest.mark.parametrize("which", ["input", "output"])
def test_nonfinite_values_are_named(which):
    records = {"reference": np.ones(600), "input": np.ones(600), "output": np.ones(600)}
    records[which] = np.full(600, np.nan)
    with pytest.raises(SpectralError, match=f"of the {which} are NaN"):
        instrumental_response(*records.values(), RATE_HZ, **SETTINGS)


def test_constant_reference_is_refused():
    with pytest.raises(SpectralError, match="reference is zero"):
        instrumental_response(np.zeros(600), np.ones(600), np.ones(600), RATE_HZ, **SETTINGS)
