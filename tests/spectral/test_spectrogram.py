"""Levels of known signals, in blocks of any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral import RunningSpectrogram

RATE_HZ = 1000.0


def columns(signal, ticks=None, edges=(), **settings):
    spectrogram = RunningSpectrogram(RATE_HZ, **settings)
    ticks = np.arange(signal.size) if ticks is None else ticks
    found = []
    for start, stop in zip([0, *edges], [*edges, signal.size], strict=True):
        found += spectrogram.feed(ticks[start:stop], signal[start:stop])
    return spectrogram, np.array([t for t, _ in found]), np.array([level for _, level in found])


@given(
    amplitude=st.floats(1e-5, 10.0),
    frequency_hz=st.floats(3.0, 58.0),
    phase=st.floats(0.0, 6.3),
)
def test_a_sine_shows_its_amplitude_at_its_frequency(amplitude, frequency_hz, phase):
    t = np.arange(2000) / RATE_HZ
    spectrogram, _, level_db = columns(amplitude * np.sin(2 * np.pi * frequency_hz * t + phase))
    np.testing.assert_allclose(level_db.max(axis=1), 20 * np.log10(amplitude), atol=0.1)
    peak_hz = spectrogram.frequency_hz[level_db.argmax(axis=1)]
    np.testing.assert_allclose(peak_hz, frequency_hz, atol=0.13)
    away = np.abs(spectrogram.frequency_hz - frequency_hz) > 2.5
    assert level_db[:, away].max() < 20 * np.log10(amplitude) - 28


def test_constant_is_at_zero_frequency_and_silence_at_the_floor():
    _, _, level_db = columns(np.full(1500, -0.2))
    np.testing.assert_allclose(level_db[:, 0], 20 * np.log10(0.2), atol=1e-9)
    spectrogram, _, level_db = columns(np.zeros(1500))
    assert (level_db == -200.0).all()
    np.testing.assert_allclose(spectrogram.frequency_hz, np.arange(241) / 4, rtol=1e-14)


def test_columns_follow_a_chirp_in_time():
    t = np.arange(30_000) / RATE_HZ
    spectrogram, time_s, level_db = columns(np.sin(2 * np.pi * (5 * t + t**2 / 2)))
    np.testing.assert_allclose(time_s, 0.4995 + 0.25 * np.arange(time_s.size), atol=1e-9)
    assert time_s.size == 117
    peak_hz = spectrogram.frequency_hz[level_db.argmax(axis=1)]
    np.testing.assert_allclose(peak_hz, 5 + time_s, atol=0.2)


@given(edges=st.lists(st.integers(0, 4000), max_size=12), seed=st.integers(0, 100))
def test_spectrogram_does_not_depend_on_blocks(edges, seed):
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(np.where(rng.random(4000) < 1e-3, rng.integers(1, 200, 4000), 1))
    signal = np.cumsum(rng.normal(size=4000))
    settings = {"window_s": 0.3, "step_s": 0.1, "last_hz": 40.0}
    _, time_s, level_db = columns(signal, ticks, **settings)
    _, same_s, same_db = columns(signal, ticks, sorted(edges), **settings)
    np.testing.assert_array_equal(time_s, same_s)
    np.testing.assert_array_equal(level_db, same_db)


def test_short_gaps_are_bridged_and_long_ones_leave_columns_out():
    ticks = np.arange(10_000)
    signal = np.sin(2 * np.pi * 2 * ticks / RATE_HZ)
    _, whole_s, whole_db = columns(signal)
    short = (ticks < 5000) | (ticks >= 5020)
    _, short_s, short_db = columns(signal[short], ticks[short])
    np.testing.assert_array_equal(short_s, whole_s)
    peak = whole_db.max(axis=1)
    np.testing.assert_allclose(short_db.max(axis=1), peak, atol=0.05)
    long = (ticks < 5000) | (ticks >= 5101)
    _, long_s, long_db = columns(signal[long], ticks[long])
    touched = (whole_s > 4.5) & (whole_s < 5.6)
    np.testing.assert_array_equal(long_s, whole_s[~touched])
    np.testing.assert_array_equal(long_db, whole_db[~touched])


@pytest.mark.parametrize("rate_hz", [100.0, 999.0])
def test_frequencies_end_at_half_the_rate(rate_hz):
    spectrogram = RunningSpectrogram(rate_hz, last_hz=60.0)
    assert spectrogram.frequency_hz[-1] == pytest.approx(min(60.0, rate_hz / 2), abs=0.26)
    signal = np.ones(2 * round(rate_hz))
    levels = spectrogram.feed(np.arange(signal.size), signal)
    assert all(level_db.shape == spectrogram.frequency_hz.shape for _, level_db in levels)
    assert len(levels) >= 4
