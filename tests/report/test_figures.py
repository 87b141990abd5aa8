"""Each figure as pixels: it is there, filled, in the colours that carry its meaning."""

import os
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from cases import further
from matplotlib.text import Text
from PIL import Image

from analysis.models import WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from analysis.report import _style as style
from analysis.report import frf_figure, illustrations
from analysis.report._record_figures import set_plain_logarithmic_axis
from analysis.report._signal_figures import (
    best_model,
    paper_signals_figure,
    resonance_intervals,
    torque_figure,
    torque_in_band,
)
from analysis.report.folder import OutputExistsError


def pixels(figure, path):
    style.save_figure(figure, path)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def count(image, colour):
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(image - wanted).max(axis=2) <= 12).sum())


@pytest.mark.fit
@pytest.mark.parametrize(
    ("draw", "colours"),
    [
        (paper_signals_figure, (style.ORANGE, style.BLUE, style.GREEN)),
        further(frf_figure, (style.BLUE, style.VERMILION, style.GREY)),
        further(torque_figure, (style.BLUE, style.VERMILION, style.GREY)),
    ],
)
def test_a_figure_shows_its_lines(paper_analysis, tmp_path, draw, colours):
    with style.figure_style():
        image = pixels(draw(paper_analysis), tmp_path / "a.png")
    height, width, _ = image.shape
    assert 1000 <= width <= 3000
    assert 600 <= height <= 2500
    for colour in colours:
        assert count(image, colour) > 1500, colour
    ink = (image.min(axis=2) < 250).mean()
    assert 0.02 < ink < 0.5
    # Nothing is drawn over the edge.
    assert image[[0, -1]].min() == 255
    assert image[:, [0, -1]].min() == 255


@pytest.mark.fit
def test_colours_match_their_meaning(paper_analysis, tmp_path):
    """Without the fits with omega weights, no dashed line of their colour is left."""
    fits = tuple(m for m in paper_analysis.models if m.fit.weighting == "const")
    alone = replace(
        paper_analysis,
        models=fits,
        settings=replace(paper_analysis.settings, weightings=("const",)),
    )
    with style.figure_style():
        image = pixels(frf_figure(alone), tmp_path / "a.png")
    assert count(image, style.BLUE) > 1500
    assert count(image, style.VERMILION) == 0


@pytest.mark.fit
def test_one_panel_per_type(paper_analysis):
    with style.figure_style():
        figure = frf_figure(paper_analysis)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    panels = [t.split()[:3] for t in titles if "Type" in t]
    assert panels == [["(a)", "Type", "I"], ["(b)", "Type", "III"], ["(c)", "Type", "VI"]]
    assert titles[-1] == "Coherence"
    # Noise about 180° must not jump to the other edge of the panel.
    phase_deg = np.concatenate([dots.get_path().vertices[:, 1] for dots in figure.axes[1].patches])
    assert phase_deg.max() > 180.0
    assert phase_deg.min() > -90.0
    lines = figure.axes[0].get_lines()
    assert [len(line.get_xdata()) > 100 for line in lines[:4]] == [True] * 4


@pytest.mark.fit
@pytest.mark.parametrize(
    ("types", "weightings", "estimator"),
    [
        (("I", "III"), ("const",), "fft"),
        further(("VI",), ("omega^-2",), "h1"),
        further(("I", "II", "III", "IV", "V", "VI", "VII"), ("const", "omega^0.5"), "hv"),
    ],
)
def test_any_choice_of_types_and_weightings_can_be_drawn(
    request, write_session, short_signals, tmp_path, types, weightings, estimator
):
    settings = WelchSettings(estimator=estimator, types=types, weightings=weightings)
    if estimator == "fft":
        path = write_session(tmp_path / "short.mcap", short_signals)
    else:
        path = request.getfixturevalue("paper_file")
    with style.figure_style():
        figure = frf_figure(analyse(load_record(path), settings))
    assert pixels(figure, tmp_path / "a.png").std() > 10
    assert len(figure.legends[0].get_texts()) == len(weightings) + (1 if estimator == "fft" else 2)


@pytest.mark.fit
def test_true_structure_follows_the_torque(paper_analysis):
    assert best_model(paper_analysis).fit.structure.name == "VI"
    with style.figure_style():
        figure = torque_figure(paper_analysis)
    measured, modelled = (line.get_ydata() for line in figure.axes[0].get_lines()[:2])
    assert np.abs(measured).max() == pytest.approx(np.abs(modelled).max(), rel=0.1)
    residual = figure.axes[1].get_lines()[0].get_ydata()
    assert np.abs(residual).max() < 0.15 * np.abs(measured).max()


@pytest.mark.fit
@pytest.mark.parametrize(
    "draw", [further(paper_signals_figure), frf_figure, further(torque_figure)]
)
def test_figure_texts_contain_no_file_name(paper_analysis, draw):
    with style.figure_style():
        figure = draw(paper_analysis)
    words = [text.get_text() for text in figure.findobj(Text)]
    assert not [each for each in words if paper_analysis.record.path.stem in each]
    assert any("Hz" in each for each in words)


@pytest.mark.parametrize(
    ("kind", "start"), [("png", b"\x89PNG"), further("svg", b"<?xml"), further("pdf", b"%PDF-1.")]
)
def test_a_figure_is_the_same_each_time_in_every_format(tmp_path, kind, start):
    def drawn(name):
        with style.figure_style():
            figure = style.new_figure(4.0, 3.0, "Title µ ζ", "and more")
            figure.add_subplot().plot([1.0, 2.0])
            return style.save_figure(figure, tmp_path / f"{name}.{kind}")

    content = drawn("a")
    assert content.startswith(start)
    assert content == drawn("b") == (tmp_path / f"b.{kind}").read_bytes()
    if kind == "pdf":
        # Type 3 fonts, which journals refuse, are not in it.
        assert b"/FontFile2" in content
        assert b"/Type3" not in content


def lines(*values):
    """Illustrations of a line each; their names have dots, as those of files may."""

    def drawn(value):
        figure = style.new_figure(4.0, 3.0)
        figure.add_subplot().plot([0.0, value])
        return figure

    return [style.Illustration(f"v1.{value}", partial(drawn, value), "A line.") for value in values]


def test_figure_is_written_in_the_requested_formats(tmp_path):
    (picture,) = style.save_pictures(lines(1), tmp_path, ("pdf",))
    assert [path.name for path in tmp_path.iterdir()] == ["v1.1.pdf"]
    assert picture.name == "v1.1"
    assert picture.image.startswith(b"<?xml")


@pytest.mark.parametrize(
    ("formats", "svg_bytes", "shown"),
    [
        (("svg",), 3, "svg+xml;base64,c3Zn"),
        (("png",), 3, "png;base64,cG5n"),
        (("png", "svg"), 3, "svg+xml;base64,c3Zn"),
        (("pdf",), 3, "svg+xml;base64,c3Zn"),
        (("svg",), 2_000_000, "png;base64,cG5n"),
    ],
)
def test_page_shows_a_written_format_and_no_huge_svg(
    monkeypatch, tmp_path, formats, svg_bytes, shown
):
    drawn = []

    def render(_figure, file_format):
        drawn.append(file_format)
        return file_format.encode().ljust(svg_bytes if file_format == "svg" else 3)

    monkeypatch.setattr(style, "render_figure", render)
    (picture,) = style.save_pictures(lines(1), tmp_path, formats)
    assert picture.source == f"data:image/{shown}"
    assert len(drawn) == len({*formats, picture.file_format, *(("svg",) if svg_bytes > 3 else ())})


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="COPY NOT TESTED: not Linux")
@pytest.mark.parametrize("copy", ["draws", "fails", further("none")])
def test_figures_do_not_depend_on_the_process(monkeypatch, tmp_path, copy):
    own_pid, drawn_here, done = os.getpid(), [], []

    def render(figure, file_format, rendered=style.render_figure):
        if os.getpid() == own_pid:
            drawn_here.append(file_format)
        elif copy == "fails":
            raise MemoryError
        return rendered(figure, file_format)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0} if copy == "none" else {0, 1})
    monkeypatch.setattr(style, "render_figure", render)
    pictures = style.save_pictures(lines(1, 2, 3), tmp_path, ("svg",), done.append)
    assert len(drawn_here) == (2 if copy == "draws" else 3)
    assert [picture.name for picture in pictures] == ["v1.1", "v1.2", "v1.3"]
    assert sorted(done) == ["figure v1.1", "figure v1.2", "figure v1.3"]
    for value, picture in enumerate(pictures, start=1):
        assert picture.image == (tmp_path / f"v1.{value}.svg").read_bytes()
        (alone,) = style.save_pictures(lines(value), tmp_path / f"{value}", ("svg",))
        assert picture.image == alone.image


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="COPY NOT TESTED: not Linux")
def test_failed_drawing_leaves_no_copy(monkeypatch, tmp_path):
    def fail():
        raise ZeroDivisionError

    def fork(fork=os.fork):
        copies.append(fork())
        return copies[-1]

    copies = []
    monkeypatch.setattr(os, "fork", fork)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    with pytest.raises(ZeroDivisionError):
        style.save_pictures([style.Illustration("a", fail, ""), *lines(1)], tmp_path, ("svg",))
    (copy,) = copies
    with pytest.raises(ChildProcessError):
        os.waitpid(copy, os.WNOHANG)


def test_title_with_invalid_text_is_drawn(tmp_path):
    with style.figure_style():
        style.save_figure(style.new_figure(6.0, 4.0, "caf\udce9.mcap", "—"), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_long_names_and_texts_fit(tmp_path):
    with style.figure_style():
        image = pixels(style.new_figure(10, 3, "name" * 60, "many words " * 30), tmp_path / "a.png")
    assert image[:, :20].min() == image[:, -20:].min() == 255
    assert (image[:100, 20:-20].min(axis=(0, 2)) < 200).mean() > 0.6


def test_envelope_preserves_extremes_and_limits_points():
    x = np.linspace(0.0, 10.0, 100_001)
    y = np.sin(2 * np.pi * 50 * x)
    y[[12_345, 60_000]] = 7.0, -9.0
    few_x, few_y = style.envelope(x, y, 500)
    assert len(few_x) == len(few_y) == 1000
    assert (few_y.max(), few_y.min()) == (7.0, -9.0)
    assert abs(few_x[np.argmax(few_y)] - x[12_345]) <= 10.0 / 500
    assert (np.diff(few_x) >= 0).all()
    log_x, _ = style.envelope(x[1:], y[1:], 300, logarithmic=True)
    assert len(log_x) <= 600
    same_x, same_y = style.envelope(x[:50], y[:50], 500)
    assert same_x is not None
    assert len(same_y) == 50


@pytest.mark.fit
def test_a_picture_is_never_overwritten(paper_analysis, tmp_path):
    target = tmp_path / "a.png"
    target.write_bytes(b"mine")
    with style.figure_style(), pytest.raises(OutputExistsError):
        style.save_figure(style.new_figure(4, 3, "a", "b"), target)
    assert target.read_bytes() == b"mine"


@pytest.mark.parametrize("span", [8.0, 150.0, 900.0, 1e4])
@pytest.mark.parametrize("height_in", [0.5, 3.0])
def test_labels_of_a_logarithmic_axis_do_not_overlap(span, height_in):
    """The width of a band is drawn in half an inch, where 1, 2 and 5 of two decades overlap."""
    with style.figure_style():
        figure = style.new_figure(8.0, 4.0)
        axes = figure.add_axes((0.1, 0.1, 0.8, height_in / 4.0))
        set_plain_logarithmic_axis(axes, 0.3, 0.3 * span)
        figure.canvas.draw()
        low, high = axes.get_ylim()
        boxes = sorted(
            (
                label.get_window_extent()
                for value, label in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
                if low <= value <= high
            ),
            key=lambda box: box.y0,
        )
    assert boxes
    assert all(below.y1 <= above.y0 for below, above in pairwise(boxes))


# Enlarged stretches: where each mode rings, marked as such

MODES_HZ = np.array([2.5537, 16.003, 44.810])


@pytest.mark.fit
def test_each_mode_has_an_enlargement_at_its_passage(paper_analysis):
    record = paper_analysis.record
    moments = resonance_intervals(record, 3)
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


@pytest.mark.fit
@pytest.mark.parametrize("draw", [further(paper_signals_figure), torque_figure])
def test_marks_match_the_enlargements(paper_analysis, draw):
    with style.figure_style():
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


@pytest.mark.fit
def test_the_fit_in_per_cent_is_that_of_the_torque_in_time(record_result):
    """The same number from signals: measured against predicted torque, without their means."""
    whole = record_result.whole
    torque = torque_in_band(whole.record, whole.fit.plant, whole.band_hz[1])
    measured = torque.measured_nm - torque.measured_nm.mean()
    expected = 100 * (1 - np.linalg.norm(torque.residual_nm) / np.linalg.norm(measured))
    found = whole.analysis.fit_percent(whole.fit)
    assert found == pytest.approx(expected, abs=0.3)
    assert 50 < found < 100


@pytest.mark.fit
def test_model_torque_is_continuous_at_a_nonzero_end(record_result):
    """A motor that is held where the sweep ended does not return after the record."""
    whole = record_result.whole
    record = whole.record
    way = np.linspace(0.0, 1.0, record.angle_rad.size)
    held_off_zero = replace(record, angle_rad=record.angle_rad - 0.008 * way**2 * (3 - 2 * way))
    torque = torque_in_band(held_off_zero, whole.fit.plant, whole.band_hz[1])
    last = slice(-round(0.5 * record.rate_hz), None)
    assert np.abs(torque.modelled_nm[last]).max() < 0.1 * np.abs(torque.measured_nm).max()


@pytest.mark.fit
@pytest.mark.parametrize("factor", [further(1.0), 0.01])
def test_labels_of_the_uniformity_figure_are_whole(modal_result, with_selection, factor):
    """A frequency that is known to a ten thousandth of a per cent has long numbers at its axis."""
    headline = modal_result.whole.headline
    test = headline.uniform_beam
    predicted = test.measured_constants + factor * (
        test.predicted_constants - test.measured_constants
    )
    test = replace(test, predicted_constants=predicted, constant_stds=factor * test.constant_stds)
    result = with_selection(modal_result, headline=replace(headline, uniform_beam=test))
    (drawn,) = (each for each in illustrations(result.whole) if each.name == "uniform_beam")
    with style.figure_style():
        figure = drawn.draw()
        figure.canvas.draw()
        for axes in figure.axes:
            for label in (axes.xaxis.label, axes.yaxis.label, axes.title):
                box = label.get_window_extent()
                assert box.x0 >= 0
                assert box.y0 >= 0
                assert box.x1 <= figure.bbox.x1
                assert box.y1 <= figure.bbox.y1
