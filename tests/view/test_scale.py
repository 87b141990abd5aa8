"""A plot over time has two labels at its axis, and is no longer than that requires."""

import math

import numpy as np
import pytest

from rigd.view._layout import (
    CLOSE_UP_WINDOW_S,
    TIME_VIEWS,
    AxisTickPoints,
    TimeView,
    missing_tick_values,
)
from rigd.view.plots import COUPLING_TORQUE, HEALTH, LOOP, READINGS, SIGNALS, Plot

RATE_HZ = 1000
BLOCK = 100


def labels(low: float, high: float, height: float) -> int:
    """Count the labels that Rerun shows of an axis that must hold two values.

    It adds a twentieth at either end, and labels multiples of a power of ten at least 20 points
    apart; a label is cut if less than half of its 12 points fits above its value.
    """
    if low == high:
        low, high = low - 1.0, high + 1.0
    points_per_unit = height / (1.1 * (high - low))
    step = 10.0 ** math.ceil(math.log10(20.0 / points_per_unit))
    rim = 0.05 * (high - low) - 4.0 / points_per_unit
    first, last = math.ceil((low - rim) / step), math.floor((high + rim) / step)
    return last - first + 1


@pytest.mark.parametrize("height", sorted({view.height_pt for view in TIME_VIEWS}))
@pytest.mark.parametrize("middle", [0.0, 0.3, -1.0, 59.2481])
def test_two_values_are_labelled_at_any_amplitude(middle, height):
    fills = []
    lacking = 0
    for amplitude in np.geomspace(1e-3, 1e3, 2000):
        low, high = middle - amplitude, middle + amplitude
        lacking += labels(low, high, height) < 2
        ticks = [tick for tick in missing_tick_values(low, high, height) if tick is not None]
        assert labels(min(low, *ticks, high), max(low, *ticks, high), height) >= 2, amplitude
        fills.append((high - low) / (max(high, *ticks, low) - min(low, *ticks, high)))
    assert lacking > 100  # so it is not in vain
    # Mostly nothing is added; and where it is, the signal still fills a good part of the plot.
    assert np.mean(np.array(fills) == 1.0) > 0.38
    assert min(fills) > (0.45 if middle == 0.0 and height > 150 else 0.33)


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.0, 0.0), (59.25, 59.25), (0.0, 5e-324), (-1.7e308, 1.7e308), (1e300, 1e308)],
)
def test_single_and_absurd_values_need_nothing(low, high):
    assert missing_tick_values(low, high, 131.0) == (None, None)


def view_of(plot: Plot, window_s: float) -> TimeView:
    (view,) = [v for v in TIME_VIEWS if v.plot is plot and v.window_s == window_s]
    return view


def test_axes_always_hold_two_labels(make_samples, shown):
    n = 30 * RATE_HZ
    t_s = np.arange(n) / RATE_HZ
    # Through all amplitudes in turn, as in a chirp that passes a resonance.
    torque_nm = 0.03 * 10 ** (2.5 * np.sin(np.pi * t_s / 30)) * np.sin(2 * np.pi * 5 * t_s)
    samples = make_samples(n, coupling_torque_nm=torque_nm)
    scale = AxisTickPoints(SIGNALS, TIME_VIEWS)
    drawings = scale.initial_drawings()
    for i in range(0, n, BLOCK):
        block = samples[i : i + BLOCK]
        drawings += scale.tick_drawings(block["t_ns"], SIGNALS.values_by_component(block))
    view = view_of(COUPLING_TORQUE, CLOSE_UP_WINDOW_S)
    ticks = shown(drawings)[SIGNALS.tick_entity]
    tick_ns = np.array(ticks.times_ns[view.tick_component])
    tick_values = np.array(ticks.values[view.tick_component])[:, 0]
    fills, free = [], []
    for end in range(2 * RATE_HZ, n + 1, BLOCK):
        now_ns = samples["t_ns"][end - 1]
        window = torque_nm[end - 2 * RATE_HZ : end]
        low, high = window.min(), window.max()
        seen = (tick_ns > now_ns - 2_000_000_000) & (tick_ns <= now_ns) & ~np.isnan(tick_values)
        least = min(low, *tick_values[seen], high)
        greatest = max(high, *tick_values[seen], low)
        assert labels(least, greatest, view.height_pt) >= 2, end
        free.append(high - low > view.plot.min_span)
        fills.append(max(high - low, view.plot.min_span) / (greatest - least))
    assert min(fills) > 0.3
    assert np.mean(free) > 0.3
    assert np.mean(np.array(fills)[free] > 0.99) > 0.3


@pytest.mark.parametrize("view", [view for view in TIME_VIEWS if view.plot.min_span])
def test_single_steps_and_noise_do_not_fill_an_axis(view):
    least = view.plot.min_span
    for middle in (0.0, 7.0 * least, -0.3 * least):
        for span in (0.0, 0.01 * least, 0.4 * least):
            low, high = middle - span / 2, middle + span / 2
            below, above = missing_tick_values(low, high, view.height_pt, least)
            first = low if below is None else below
            last = high if above is None else above
            assert first <= low <= high <= last
            assert least <= last - first <= 6.0 * least
            assert labels(first, last, view.height_pt) >= 2


def test_scale_does_not_depend_on_blocks(make_samples, shown):
    samples = make_samples(5000, coupling_torque_nm=0.06 * np.sin(np.arange(5000) / 30.0))

    def ticks(block: int):
        scale = AxisTickPoints(SIGNALS, TIME_VIEWS)
        drawings = []
        for i in range(0, len(samples), block):
            part = samples[i : i + block]
            drawings += scale.tick_drawings(part["t_ns"], SIGNALS.values_by_component(part))
        name = view_of(COUPLING_TORQUE, CLOSE_UP_WINDOW_S).tick_component
        found = shown(drawings)[SIGNALS.tick_entity]
        return found.times_ns[name], found.values[name]

    assert ticks(100) == ticks(1000)
    assert ticks(100)[1][0] == [0.1]


def test_every_view_gets_its_ticks_immediately(shown):
    drawings = [
        d
        for s in (SIGNALS, READINGS, HEALTH)
        for d in AxisTickPoints(s, TIME_VIEWS).initial_drawings()
    ]
    found = shown(drawings)
    for view in TIME_VIEWS:
        assert (view.tick_component in found[view.source.tick_entity].values) == (
            view.plot.fixed_axis_range is None
        )


def test_invalid_values_are_skipped(make_samples):
    scale = AxisTickPoints(SIGNALS, TIME_VIEWS)
    for value in (np.nan, np.inf, 1.7e308, -1.7e308):
        samples = make_samples(200, coupling_torque_nm=value)
        scale.tick_drawings(samples["t_ns"], SIGNALS.values_by_component(samples))
    loop = make_samples(300, first_tick=200, work_ns=60_000)
    loop["t_ns"][150:] += 2**61  # another program's file
    loop["work_ns"][-1] = 0
    assert scale.tick_drawings(loop["t_ns"], SIGNALS.values_by_component(loop))
    assert view_of(LOOP, 10.0).height_pt < 150
