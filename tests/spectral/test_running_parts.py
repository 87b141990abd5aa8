"""Parts of a running estimate: low bins against the whole transform, segments against the record.

The lowest bins of a padded transform, and blocks with missing ticks cut into segments as they come.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.spectral._running import LowBinTransform, Segments, bins_up_to

LENGTH, HOP, LONGEST_GAP = 40, 30, 5


def cut(ticks, values, edges, end=None):
    segments = Segments(len(values), LENGTH, HOP, longest_gap_ticks=LONGEST_GAP, end_tick=end)
    found = [
        (first, segment.copy())
        for start, stop in zip([0, *edges], [*edges, len(ticks)], strict=True)
        for first, segment in segments.feed(ticks[start:stop], values[:, start:stop])
    ]
    return segments, found


def expected(ticks, values, end):
    """On its own grid: short gaps interpolated, segments with anything unknown left out."""
    known = np.isfinite(values).all(axis=0)
    ticks, values = ticks[known], values[:, known]
    grid = np.arange(end)
    full = np.stack([np.interp(grid, ticks, channel) for channel in values])
    unknown = (grid < ticks[0]) & (ticks[0] > LONGEST_GAP) | (grid > ticks[-1])
    for before, after in pairwise(ticks):
        if after - before - 1 > LONGEST_GAP:
            unknown |= (grid > before) & (grid < after)
    starts = range(0, end - LENGTH + 1, HOP)
    return [(k, full[:, k : k + LENGTH]) for k in starts if not unknown[k : k + LENGTH].any()]


@given(data=st.data())
def test_segments_do_not_depend_on_blocks(data):
    samples = data.draw(st.integers(1, 400))
    seed = data.draw(st.integers(0, 10**6))
    rng = np.random.default_rng(seed)
    steps = np.where(rng.random(samples) < 0.05, rng.integers(1, 12, samples), 1)
    ticks = np.cumsum(steps) + data.draw(st.integers(-20, 20))
    values = rng.normal(size=(2, samples))
    values[1, rng.random(samples) < data.draw(st.sampled_from([0.0, 0.02]))] = np.nan
    end = data.draw(st.integers(1, 450))
    edges = sorted(data.draw(st.lists(st.integers(0, samples), max_size=8)))
    segments, found = cut(ticks, values, edges, end)
    known = np.isfinite(values).all(axis=0)
    if not known.any():
        assert found == []
        return
    wanted = expected(ticks, values, end)
    assert [first for first, _ in found] == [first for first, _ in wanted]
    for (_, ours), (_, theirs) in zip(found, wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)
    assert segments.over == (ticks[known][-1] >= end - 1)


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_the_newest_samples_reach_back_to_the_last_long_gap(block):
    ticks = np.concatenate((np.arange(100), np.arange(120, 130), np.arange(133, 150)))
    values = 2.0 * ticks[np.newaxis]
    segments, _ = cut(ticks, values, list(range(block, ticks.size, block)))
    assert segments.end == 150
    np.testing.assert_allclose(
        segments.newest_samples(1000)[0], 2.0 * np.arange(120, 150), rtol=1e-14
    )
    np.testing.assert_allclose(
        segments.newest_samples(12)[0], 2.0 * np.arange(138, 150), rtol=1e-14
    )


def test_only_a_short_initial_gap_is_held():
    for missing, value in ((LONGEST_GAP, 3.0), (LONGEST_GAP + 1, None)):
        ticks = np.arange(missing, 60)
        _, found = cut(ticks, np.full((1, ticks.size), 3.0), [])
        assert [first for first, _ in found] == ([0] if value else [])
        assert all((segment == value).all() for _, segment in found)


@given(data=st.data())
def test_equals_the_whole_transform(data):
    length = data.draw(st.integers(1, 300))
    nfft = data.draw(st.integers(length, 1000))
    bins = data.draw(st.integers(1, nfft // 2 + 1))
    transform = LowBinTransform(length, nfft, bins)
    rng = np.random.default_rng(length)
    # The shorter one after the longer: nothing of that may be left.
    for samples in (length, data.draw(st.integers(1, length))):
        x = rng.normal(size=samples)
        whole = np.fft.rfft(x, nfft)
        np.testing.assert_allclose(
            transform(x), whole[:bins], rtol=0, atol=1e-13 * np.abs(whole).max()
        )


def test_equals_the_papers_transform():
    x = np.random.default_rng(5).normal(size=17_266) * np.hamming(17_266)
    whole = np.fft.rfft(x, 160_000)[:9601]
    np.testing.assert_allclose(LowBinTransform(17_266, 160_000, 9601)(x), whole, rtol=1e-10)


@pytest.mark.parametrize(
    ("last_hz", "nfft", "rate_hz", "bins"),
    [
        (60.0, 160_000, 1000.0, 9601),
        (0.1 + 0.2, 100, 10.0, 4),
        (0.3, 100, 10.0, 4),
        (0.2999, 100, 10.0, 3),
        (1e6, 100, 10.0, 51),
        (0.0, 100, 10.0, 1),
    ],
)
def test_bins_up_to_a_frequency(last_hz, nfft, rate_hz, bins):
    assert bins_up_to(last_hz, nfft, rate_hz) == bins
