import re

from analysis.report import _style as style
from analysis.report._html import drawing, svg_text

TEXTS = re.compile(r"<text[^>]*>([^<]*)</text>")


def test_what_is_written_in_a_figure_is_written_in_the_page():
    from matplotlib.figure import Figure

    with style.styled():
        figure = Figure()
        axes = figure.add_subplot()
        axes.plot([0.0, 1.0 / 3.0], [0.00125, 0.00375])
        axes.set_yticks([0.00125, 0.00375], ["0.00125", "0.00375"])
        axes.set_title("γ = 0.05473")
        svg = svg_text(figure)
    shown = drawing(svg, "name", "description")
    assert TEXTS.findall(shown) == TEXTS.findall(svg)
    assert {"0.00125", "0.00375", "γ = 0.05473"} <= set(TEXTS.findall(shown))
    coordinates = re.findall(r'(?: d|points)="([^"]*)"', shown)
    assert coordinates
    assert not any(re.search(r"\d\.\d{3}", path) for path in coordinates)
