"""Causal transform against closed forms: responses, padding, oversampling, limited bands."""

import numpy as np
import pytest

from rigd.beam import CausalTransform, fast_transform_length

RATE_HZ = 200.0
N = 1500
T_S = np.arange(N) / RATE_HZ
WAVE = np.exp(-((T_S - 3) ** 2) / 0.05)
DECAY_PER_S, OMEGA = 0.01, 5.0


@pytest.fixture(scope="module")
def transform():
    return CausalTransform.for_record(N, RATE_HZ)


def test_the_inverse_gives_back_the_signals(transform):
    both = np.stack([WAVE, T_S * WAVE])
    assert transform.length >= 1.1 * N
    assert transform.inverse(transform.forward(both), N) == pytest.approx(both, abs=1e-12)
    part = transform.inverse(transform.forward(both), slice(300, 900))
    assert part == pytest.approx(both[:, 300:900], abs=1e-12)


def test_the_response_of_an_oscillator_does_not_wrap_round(transform):
    """It still rings with 95 % at the end; without exponential damping this would wrap round."""
    s = transform.s
    response = transform.convolve(WAVE, OMEGA / ((s + DECAY_PER_S) ** 2 + OMEGA**2))
    impulse_response = np.exp(-DECAY_PER_S * T_S) * np.sin(OMEGA * T_S)
    direct = np.convolve(WAVE, impulse_response)[:N] / RATE_HZ
    assert np.abs(direct[-200:]).max() > 0.9 * np.abs(direct).max()
    assert response == pytest.approx(direct, abs=2e-3 * np.abs(direct).max())


def test_held_signal_continues_its_last_value():
    transform = CausalTransform(4 * N, RATE_HZ, 9.0)
    moved = transform.inverse(transform.forward(T_S, holds_last_value=True), 3 * N)
    assert moved[:N] == pytest.approx(T_S, abs=1e-9)
    assert moved[N:] == pytest.approx(T_S[-1], abs=1e-9)


def test_subsample_values_are_exact(transform):
    fine_s = np.arange(3 * N) / (3 * RATE_HZ)
    fine_wave = np.exp(-((fine_s - 3) ** 2) / 0.05)
    spectrum = transform.forward(WAVE)
    assert transform.inverse(spectrum, 3 * N, oversampling=3) == pytest.approx(fine_wave, abs=1e-9)
    fine_spectrum = transform.forward(fine_wave, oversampling=3)
    assert fine_spectrum == pytest.approx(spectrum, abs=1e-9 * np.abs(spectrum).max())
    indices = np.array([1, 1000, 1801, 4499])
    at = transform.inverse_at(spectrum[None], indices, 3)
    assert at == pytest.approx(fine_wave[None, indices], abs=1e-9)


def test_a_limited_band_has_no_values_above_it(transform):
    limited = CausalTransform(transform.length, RATE_HZ, 6.6, highest_hz=20.05)
    assert limited.s.imag[-1] < 2 * np.pi * 20.05 < transform.s.imag[limited.s.size]
    assert limited.forward(WAVE) == pytest.approx(transform.forward(WAVE)[: limited.s.size])
    assert limited.inverse(limited.forward(WAVE), N) == pytest.approx(WAVE, abs=1e-9)


def test_fast_lengths_are_at_most_an_eighth_more():
    lengths = np.array([fast_transform_length(n) for n in range(1, 5000)])
    assert np.all(lengths >= np.arange(1, 5000))
    assert np.all(lengths <= 1.125 * np.arange(1, 5000) + 1)
    assert max(fast_transform_length(n) // (n & -n) for n in (4096, 5120)) <= 5
