"""Bridging, decimation and the noise's spectrum, each on signals whose answer is known."""

import numpy as np
import pytest

from analysis.decimation import Decimation, fast_fft_length, fast_fft_length_below, interpolate_gaps
from analysis.identify.noise import (
    estimate_noise,
    noise_power_with_peaks,
    smooth_power,
)


def test_gaps_of_a_band_limited_signal_are_closed():
    t = np.arange(2000) / 1000
    signal = 0.02 * np.sin(2 * np.pi * 0.7 * t + 0.3) + 2e-3 * np.sin(2 * np.pi * 50 * t)
    known = np.ones(t.size, dtype=bool)
    known[[5, 300, 302, 303, 304]] = False
    known[900:905] = False
    known[-1] = False
    spoilt = np.where(known, signal, np.nan)
    closed = interpolate_gaps(spoilt, known, 0.05)
    assert (closed[known] == signal[known]).all()
    assert np.abs(closed - signal)[:-1].max() < 2e-3 * 2e-3
    line = np.interp(t, t[known], signal[known])
    assert np.abs(line - signal)[:-1].max() > 0.2 * 2e-3
    assert closed[-1] == pytest.approx(signal[-1], abs=2e-3)


def test_signal_without_gaps_is_unchanged():
    values = np.random.default_rng(2).normal(size=50)
    assert (interpolate_gaps(values, np.ones(50, dtype=bool), 0.05) == values).all()


@pytest.mark.parametrize(
    ("reach_s", "rate_hz"), [(1.0, 125.0), (0.27, 125.0), (0.15, 250.0), (0.02, 500.0), (0, 125.0)]
)
def test_short_filters_need_a_higher_rate(reach_s, rate_hz):
    """The lowest rate if no filter is short enough."""
    decimation = Decimation.with_half_length(1000.0, 50.0, reach_s)
    assert decimation.rate_hz == rate_hz
    if reach_s:
        assert decimation.half_length_samples / rate_hz <= reach_s


@pytest.mark.parametrize(
    ("rate_hz", "highest_hz", "factor"), [(1000, 50, 8), (1000, 20, 20), (250, 80, 1)]
)
def test_decimation_passes_only_the_band(rate_hz, highest_hz, factor):
    decimation = Decimation.to_band(rate_hz, highest_hz)
    assert decimation.downsampling_factor == factor
    n = 20_000
    t = np.arange(n) / rate_hz
    for hz in (0.0, 0.3 * highest_hz, highest_hz):
        decimated = decimation.apply(np.cos(2 * np.pi * hz * t + 0.4))
        inside = decimation.samples_inside_record(n)
        at = (np.arange(decimated.size) - decimation.half_length_samples) / decimation.rate_hz
        expected = np.cos(2 * np.pi * hz * at + 0.4)
        assert np.abs(decimated - expected)[inside].max() < 2e-5
    beyond_hz = 1.01 * decimation.rate_hz / 2
    if beyond_hz < rate_hz / 2:
        decimated = decimation.apply(np.cos(2 * np.pi * beyond_hz * t))
        assert np.abs(decimated[decimation.samples_inside_record(n)]).max() < 2e-5


def test_inside_excludes_edge_effects():
    decimation = Decimation.to_band(1000.0, 50.0)
    n = 5001
    decimated = decimation.apply(np.ones(n))
    inside = decimation.samples_inside_record(n)
    assert decimated[inside] == pytest.approx(1.0, abs=1e-12)
    assert decimated[inside.start - 1] != pytest.approx(1.0, abs=1e-12)
    assert decimated[inside.stop] != pytest.approx(1.0, abs=1e-12)


def test_fast_lengths():
    assert (fast_fft_length(13), fast_fft_length_below(13), fast_fft_length(1024)) == (14, 12, 1024)


def noise(shape, seed):
    rng = np.random.default_rng(seed)
    return shape * (rng.normal(size=shape.size) + 1j * rng.normal(size=shape.size)) / np.sqrt(2)


def test_coloured_noise_without_lines_and_modes():
    n = 6800
    shape = np.linspace(3.0, 1.0, n) / (1 + np.arange(n) / 300)
    residual = noise(shape, 4)
    with_more = residual.copy()
    with_more[2180:2195] += 500  # a mode that the model misses
    with_more[5000] += 1e4  # a hum
    for spectrum in (residual, with_more):
        found = smooth_power(spectrum)
        assert found == pytest.approx(shape**2, rel=0.5)
        assert np.mean(found / shape**2) == pytest.approx(1.0, abs=0.05)


def test_few_bins_are_one_level():
    residual = noise(np.ones(60), 5)
    found = smooth_power(residual)
    assert np.ptp(found) == 0
    assert found[0] == pytest.approx(1.0, rel=0.5)


SAMPLES = 17_000
FREQUENCY_HZ = np.fft.rfftfreq(SAMPLES, 1 / 125)[1:6801]
TIME_S = np.arange(SAMPLES) / 125
NOWHERE = np.zeros(FREQUENCY_HZ.size, dtype=bool)


def spectrum(signal):
    return np.fft.rfft(signal)[1:6801]


def white(seed):
    return np.random.default_rng(seed).normal(scale=4e-3, size=SAMPLES)


@pytest.mark.parametrize(("hz", "amplitude"), [(49.97, 0.02), (16.7, 5e-3), (30.0, 0.2)])
def test_a_hum_is_a_line(hz, amplitude):
    wander = 0.01 * np.sin(2 * np.pi * TIME_S / 40)
    hum = amplitude * np.sin(2 * np.pi * (hz * TIME_S + wander) + 1)
    noise = estimate_noise(spectrum(white(6) + hum), FREQUENCY_HZ, SAMPLES, is_near_mode=NOWHERE)
    (line,) = noise.lines
    assert line.frequency_hz == pytest.approx(hz, abs=0.003)
    assert line.amplitude_nm == pytest.approx(amplitude, rel=0.06)
    assert np.count_nonzero(~noise.is_compared) < 400
    assert (noise.weight[~noise.is_compared] == 0).all()
    assert not noise.is_compared[np.argmin(np.abs(FREQUENCY_HZ - hz))]
    rest = spectrum(white(6) + hum) * noise.weight
    assert np.sum(np.abs(rest) ** 2) == pytest.approx(2 * np.sum(noise.is_compared), rel=0.05)


def test_intermittent_signal_is_no_line():
    decay = np.where(TIME_S > 40, np.exp(-0.5 * np.maximum(TIME_S - 40, 0)), 0)
    passing = decay * np.sin(2 * np.pi * 16 * TIME_S)
    noise = estimate_noise(
        spectrum(white(7) + 0.2 * passing), FREQUENCY_HZ, SAMPLES, is_near_mode=NOWHERE
    )
    assert noise.lines == ()
    assert noise.is_compared.all()
    assert np.abs(spectrum(0.2 * passing)).max() ** 2 > 100 * np.median(noise.power)


def test_white_noise_has_no_lines():
    for seed in range(20):
        noise = estimate_noise(spectrum(white(seed)), FREQUENCY_HZ, SAMPLES, is_near_mode=NOWHERE)
        assert noise.lines == ()
        assert np.mean(noise.power) == pytest.approx(SAMPLES * 4e-3**2, rel=0.06)


def test_unknown_samples_do_not_lower_the_noise():
    half = np.where(np.arange(SAMPLES) % 2 == 0, white(3), 0)
    noise = estimate_noise(spectrum(half), FREQUENCY_HZ, SAMPLES, known_torque_fraction=0.5)
    assert np.mean(noise.power) == pytest.approx(SAMPLES * 4e-3**2, rel=0.06)


def test_a_resonance_is_never_left_out():
    hum = spectrum(white(6) + 0.02 * np.sin(2 * np.pi * 16.7 * TIME_S))
    for near_mode in (None, np.abs(FREQUENCY_HZ - 16.6) < 0.2):
        noise = estimate_noise(hum, FREQUENCY_HZ, SAMPLES, is_near_mode=near_mode)
        assert noise.lines == ()
        assert noise.is_compared.all()


def test_noise_peak_continues_but_does_not_begin_at_a_mode():
    bins = 4000
    parts = np.random.default_rng(3).normal(size=(2, bins))
    residual = parts[0] + 1j * parts[1]
    residual[1000:1100] *= 4  # begins next to the mode, and reaches into its surroundings
    residual[1150:1160] *= 8  # of the mode itself
    residual[1210:1230] *= 4  # within its surroundings alone
    level = np.full(bins, 2.0)
    bin_number = np.arange(bins)
    surroundings, resonance = abs(bin_number - 1155) < 120, abs(bin_number - 1155) < 40
    found = noise_power_with_peaks(residual, level, ~surroundings, ~resonance)
    outside, within = found[1006:1034], found[1042:1094]  # of the surroundings
    assert outside.mean() == pytest.approx(32, rel=0.6)
    assert within.mean() == pytest.approx(32, rel=0.4)
    assert (found[1150:1160] == 2).all()
    assert (found[1210:1230] == 2).all()
    alone = noise_power_with_peaks(residual, level, ~surroundings)
    assert (alone[surroundings] == 2).all()
    assert (alone[~surroundings] == found[~surroundings]).all()
