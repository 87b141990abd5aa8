"""The stretches that figures enlarge lie where each mode rings, and are marked as such."""

import numpy as np
import pytest

from analysis.report import _style as style
from analysis.report._signal_figures import paper_signals_figure as signals_figure
from analysis.report._signal_figures import resonance_moments, torque_figure

MODES_HZ = np.array([2.5537, 16.003, 44.810])


def test_each_mode_has_a_stretch_round_the_moment_the_chirp_passes_it(paper_analysis):
    record = paper_analysis.record
    moments = resonance_moments(record, 3)
    assert [moment.name for moment in moments] == [
        "Mode 1, 2.55 Hz", "Mode 2, 16 Hz", "Mode 3, 44.8 Hz"
    ]  # fmt: skip
    passes_s = 1.0 + 120.0 * (MODES_HZ - 0.05) / (50.0 - 0.05)
    for moment, frequency_hz, passed_s in zip(moments, MODES_HZ, passes_s, strict=True):
        middle_s = (moment.first_s + moment.last_s) / 2
        # A resonance rings on for a while after the chirp has passed it.
        assert passed_s - 0.2 < middle_s < passed_s + 2.0
        assert moment.last_s - moment.first_s == pytest.approx(
            max(12 / frequency_hz, 0.3), abs=0.01
        )
        times_s = record.time_s[moment.samples]
        assert (times_s[0], times_s[-1]) == (moment.first_s, moment.last_s)


@pytest.mark.parametrize("draw", [signals_figure, torque_figure])
def test_marks_have_the_numbers_and_the_extent_of_the_enlargements(paper_analysis, draw):
    with style.styled():
        figure = draw(paper_analysis)
    whole = figure.axes[0]
    assert [text.get_text() for text in whole.texts] == ["1", "2", "3"]
    details = [axes for axes in figure.axes if axes.get_title(loc="left")[:1].isdigit()]
    for number, shade in enumerate(whole.patches, start=1):
        shown = [axes for axes in details if axes.get_title(loc="left").startswith(f"{number}  ")]
        assert shown
        for axes in shown:
            assert axes.get_xlim() == pytest.approx(
                (shade.get_x(), shade.get_x() + shade.get_width())
            )
    assert len(whole.patches) == 3
