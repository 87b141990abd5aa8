"""The tests of a residual, each on signals with a known answer."""

import numpy as np
import pytest
from cases import further

from analysis.identify.noise import smooth_power
from analysis.identify.residual_tests import (
    cumulative_periodogram,
    harmonics,
    input_relation,
    whiteness,
)

BINS = 4000
HZ = np.arange(1, BINS + 1) / 80
"""Bins of a record of 80 s, to 50 Hz."""


def noise(seed, count=BINS):
    parts = np.random.default_rng(seed).normal(size=(2, count))
    return parts[0] + 1j * parts[1]


def test_noise_is_white_within_its_band():
    found = [whiteness(noise(seed), HZ) for seed in range(300)]
    outside = np.mean([test.distance > test.band for test in found])
    assert 0.01 < outside < 0.10
    assert np.mean([test.is_white for test in found]) > 0.98
    assert not any(test.loud for test in found)


@pytest.mark.parametrize("draws", [200, further(1000)])
def test_noise_with_estimated_spectrum_is_not_loud(draws):
    """The spectrum is estimated from the noise itself, as the modal fit does it."""
    drawn = (noise(seed) for seed in range(draws))
    found = [
        whiteness(each * np.sqrt(2 / smooth_power(each, has_narrow_blocks=True)), HZ)
        for each in drawn
    ]
    assert not any(test.loud for test in found)


def test_cumulative_periodogram_is_a_fraction_of_power():
    residual = noise(1)
    fraction = cumulative_periodogram(residual)
    third = np.abs(residual[: BINS // 3]) ** 2
    assert fraction[BINS // 3 - 1] == pytest.approx(third.sum() / np.sum(np.abs(residual) ** 2))
    assert fraction[-1] == pytest.approx(1.0)


def test_a_tilted_spectrum_is_not_white():
    found = whiteness(noise(2) * np.linspace(1.3, 0.7, BINS), HZ)
    assert not found.is_white
    assert found.distance > 2 * found.band


def test_loud_band_is_located():
    residual = noise(3)
    residual[1600:1616] *= 4
    found = whiteness(residual, HZ)
    assert found.loud
    assert not found.is_white
    low, high = found.loudest_hz
    assert low < HZ[1616]
    assert high > HZ[1600]
    assert high - low < 0.5


def in_time(residual, samples):
    """A signal of variance 1 were it white throughout."""
    return np.fft.irfft(np.append(0, residual), samples) * np.sqrt(samples / 2)


def sweep():
    """Angle, its frequency and time: 0.05-50 Hz in 80 s at 125 Hz."""
    t = np.arange(10_000) / 125
    phase = 2 * np.pi * (0.05 * t + 49.95 * t**2 / 160)
    return np.sin(phase), phase, t


def test_linear_residual_is_distinguished_from_noise_and_hum():
    angle = np.fft.rfft(sweep()[0])[1 : BINS + 1]
    assert not any(input_relation(noise(seed), angle, HZ).related for seed in range(40))
    resonance = 1 / (1 - (HZ / 20) ** 2 + 0.01j * HZ / 20)
    left = 8 * angle / np.abs(angle).max() * resonance / np.abs(resonance).max()
    found = input_relation(noise(5) + left, angle, HZ)
    assert found.related
    assert found.local
    assert found.at_hz == pytest.approx(20.0, abs=0.4)
    hum = noise(6)
    hum[3200:3203] += 300
    assert not input_relation(hum, angle, HZ).related


def test_noise_fed_back_by_the_loop_is_no_dynamics():
    """Between the lines of a multisine the motor only follows the noise of the torque."""
    for seed in range(20):
        residual = noise(seed)
        angle = 0.1 * residual * np.exp(2j * np.pi * HZ * 0.01) + 0.3 * noise(seed + 100)
        angle[::16] += 50 * noise(seed + 200)[::16]
        assert not input_relation(residual, angle, HZ).related
    driven = angle[::16]
    residual[::16] += driven / np.abs(driven) * 0.8
    assert input_relation(residual, angle, HZ).related


def test_an_echo_is_found_with_its_lag():
    angle = np.fft.rfft(sweep()[0])[1 : BINS + 1]
    echo = 0.4 * angle / np.abs(angle) * np.exp(-2j * np.pi * HZ * 0.3)
    found = input_relation(noise(7) + echo, angle, HZ)
    assert found.related
    assert found.lag_s == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("multiple", [2, 3])
def test_only_harmonics_of_the_sweep_are_found(multiple):
    angle, phase, t = sweep()
    residual = in_time(noise(8), t.size)
    assert residual.std() == pytest.approx(0.8**0.5, rel=0.03)  # of the band to 62.5 Hz
    drive_hz = 0.05 + 49.95 * t / 80
    extra = np.where((drive_hz > 6) & (drive_hz < 9), np.sin(multiple * phase + 0.4), 0.0)
    found = {one.multiple: one for one in harmonics(angle, residual + extra, 125.0, (0.0, 50.0))}
    assert found[multiple].present
    assert 5.5 < found[multiple].drive_hz < 9.5
    assert not found[5 - multiple].present


def test_noise_ringing_and_the_drive_itself_are_no_harmonic():
    angle, _, t = sweep()
    for seed in range(20):
        residual = in_time(noise(seed), t.size)
        residual += np.where(t > 4, 5 * np.sin(16 * t) * np.exp(-(t - 4)), 0.0)
        residual += 2 * angle
        assert not any(one.present for one in harmonics(angle, residual, 125.0, (0.0, 50.0)))


def test_no_harmonics_without_a_sweep():
    angle = np.random.default_rng(9).normal(size=10_000)
    assert harmonics(angle, angle, 125.0, (0.0, 50.0)) == ()
