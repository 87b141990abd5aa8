"""The charts' mapping: a value, its tick label and its curve are at one position."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.view.chart import Axis, Chart, LegendEntry, decade_ticks, round_ticks, tick_text
from rigd.view.plots import SKY_BLUE, TIMELINE

AXIS_ENDS = st.tuples(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.integers(1, 12))


def axes(logarithmic: bool):
    """Axes as the charts make them, with ticks of `decade_ticks` or `round_ticks`."""
    if logarithmic:
        return st.tuples(st.floats(1e-3, 1e3), st.floats(1.5, 1e5)).map(
            lambda ends: Axis(
                "Frequency (Hz)",
                ends[0],
                ends[0] * ends[1],
                *decade_ticks(ends[0], ends[0] * ends[1]),
                is_logarithmic=True,
            )
        )
    return AXIS_ENDS.map(
        lambda ends: Axis(
            "Level (dB)",
            ends[0],
            ends[0] + ends[1],
            round_ticks(ends[0], ends[0] + ends[1], ends[2]),
        )
    )


@given(
    x=st.one_of(axes(True), axes(False)),
    y=st.one_of(axes(True), axes(False)),
    width=st.floats(300.0, 2000.0),
    height=st.floats(200.0, 1200.0),
)
def test_tick_labels_are_at_their_values(x, y, width, height):
    chart = Chart("/chart", width, height, x, y)
    left, top, right, bottom = chart.frame_edges
    labels = chart.tick_labels()
    assert len(labels) == len(x.ticks) + len(y.ticks)
    for text, across, down in labels[: len(x.ticks)]:
        value = float(text.replace("−", "-"))
        assert chart.to_canvas(value, y.start_value)[0] == pytest.approx(across, abs=0.01 * width)
        assert left - 1e-6 <= across <= right + 1e-6
        assert down > bottom
    for text, across, down in labels[len(x.ticks) :]:
        value = float(text.replace("−", "-"))
        assert chart.to_canvas(x.start_value, value)[1] == pytest.approx(down, abs=0.01 * height)
        assert top - 1e-6 <= down <= bottom + 1e-6
        assert across < left


@given(axes(True), st.lists(st.floats(0.0, 1.0), min_size=2, max_size=9))
def test_equal_ratios_have_equal_lengths(axis, fractions):
    values = axis.start_value * (axis.end_value / axis.start_value) ** np.array(fractions)
    assert axis.fractions_along(values) == pytest.approx(fractions, abs=1e-9)


def test_vertical_axis_points_upwards():
    chart = Chart("/c", 800.0, 400.0, Axis("", 0.0, 10.0, ()), Axis("", -1.0, 1.0, ()))
    left, top, right, bottom = chart.frame_edges
    assert chart.to_canvas([0.0, 10.0, 5.0], [-1.0, 1.0, 0.0]) == pytest.approx(
        np.array([[left, bottom], [right, top], [(left + right) / 2, (top + bottom) / 2]])
    )
    # Values beyond are drawn on the edge.
    assert chart.to_canvas([-5.0, 99.0], [-9.0, 9.0]) == pytest.approx(
        np.array([[left, bottom], [right, top]])
    )


def test_ticks_are_round():
    assert decade_ticks(0.5, 60.0)[0] == (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
    assert round_ticks(0.0, 136.0, 15) == tuple(range(0, 140, 10))
    assert str(round_ticks(0.0, 136.0, 15)[0]) == "0.0"  # which equals -0.0
    assert round_ticks(-60.0, 40.0, 5) == (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)
    assert tick_text(-0.0) == "0"
    assert tick_text(-20.0) == "−20"


def test_curves_are_at_their_stated_positions(shown):
    axis = Axis("Frequency (Hz)", 1.0, 100.0, (1.0, 10.0, 100.0), is_logarithmic=True)
    key = LegendEntry("measured", SKY_BLUE, width=3.0)
    chart = Chart("/c", 800.0, 400.0, axis, Axis("Level (dB)", 0.0, 1.0, (0.0, 1.0)), (key,))
    left, top, right, bottom = chart.frame_edges
    curve = np.array([[1.0, 0.0], [10.0, 1.0], [100.0, 0.5]])
    found = shown(
        [
            chart.draw_frame,
            lambda stream: stream.set_time(TIMELINE, duration=3.0),
            lambda stream: chart.draw_curve(stream, "curve", [curve], key),
            lambda stream: chart.move_shade(stream, "beyond", 10.0, 100.0),
        ]
    )
    ((strip,),) = found["/c/curve"].values["LineStrips2D:strips"]
    middle = (left + right) / 2
    assert strip == [
        pytest.approx([left, bottom]),
        pytest.approx([middle, top]),
        pytest.approx([right, (top + bottom) / 2]),
    ]
    (texts,) = found["/c/labels"].values["Points2D:labels"]
    assert {"1", "10", "100", "0", "Frequency (Hz)", "Level (dB)", "measured"} == set(texts)
    corner = found["/c/beyond"].last("Transform3D:translation")
    size = found["/c/beyond"].last("Transform3D:scale")
    assert corner[:2] == pytest.approx([middle, top])
    assert size[:2] == pytest.approx([right - middle, bottom - top])
    # The frame stays for later connections; a curve belongs to its time.
    assert found["/c/frame"].times_ns["LineStrips2D:strips"] == [None]
    assert found["/c/curve"].times_ns["LineStrips2D:strips"] == [3_000_000_000]
