"""A session with its fits as a file for Rerun's viewer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report._folder import OutputError, OutputExistsError
from analysis.report._text import tables_text
from rigd.session import read_session, read_timings
from rigd.view import (
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILION,
    Axis,
    Chart,
    Color,
    Key,
    RrdFileError,
    Thinning,
    check_new,
    decades,
    magnitude_db,
    new_rrd_file,
    phase_deg,
    steps,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import rerun.blueprint as rrb
    from numpy.typing import NDArray
    from rerun import RecordingStream

    from analysis.paper import FittedModel, WelchAnalysis

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]
    from pathlib import Path

FITS: Final = "/fits"
TITLE: Final = "Fits"
TABLES: Final = f"{FITS}/tables"
MEASURED_PAGE: Final = "Measured"
TABLES_PAGE: Final = "Tables"

MEASURED: Final = Key("measured", SKY_BLUE)
COHERENCE: Final = Key("coherence", GREEN)
_SIZE_DB: Final = Key("|measured|", GREY)
_WIDE: Final = (1280.0, 350.0)
_HALF: Final = (640.0, 262.0)
"""Width and height of the canvases, in points, as they fit a window of 1280 × 800."""

_LINES: Final[dict[str, tuple[Color, float]]] = {"const": (ORANGE, 3.0), "omega": (VERMILION, 1.5)}
"""Colour and width; the narrower lies over the wider, for the two are often alike."""
_MORE_LINES: Final = ((PURPLE, 1.5), (GREEN, 1.5), (ORANGE, 1.5))
_MOST_IN_WORDS: Final = 2
"""Models whose keys on a narrow chart say that what they name are weights."""
_GROUPS: Final = 400
"""Groups of points along the axis, two kept of each: enough for the pixels of a view."""
_DOT: Final = 1.0
"""Radius of a dot, in points."""
_STEP_DB: Final = 20.0
_PHASES_DEG: Final = (-90.0, 0.0, 90.0, 180.0, 270.0)
_COHERENCES: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True, slots=True)
class Line:
    """A curve of a chart.

    Attributes
    ----------
    name
        Where Rerun keeps it, under the chart.
    key
        How it looks.
    values
        Shape (n,), at the frequencies that were fitted.
    dotted
        Whether the values stand for themselves: a line would run up and down wherever noise takes
        a phase from one end of its axis to the other.
    """

    name: str
    key: Key
    values: Real
    dotted: bool = False


@dataclass(frozen=True, slots=True)
class Graph:
    """A chart with its curves, from the lowest to the topmost."""

    title: str
    chart: Chart
    lines: tuple[Line, ...]


@dataclass(frozen=True, slots=True)
class Page:
    """Charts that are seen together: a wide one over two narrow ones."""

    title: str
    wide: Graph
    narrow: tuple[Graph, Graph]

    @property
    def graphs(self) -> tuple[Graph, ...]:
        """All of them."""
        return (self.wide, *self.narrow)


def pages(analysis: WelchAnalysis) -> tuple[Page, ...]:
    """Return the measured response with its coherence, and each model type with its residuals."""
    lines = line_keys(analysis.settings.weightings)
    by_type = [
        _type_page(
            analysis, name, [m for m in analysis.models if m.fit.structure.name == name], lines
        )
        for name in analysis.settings.types
    ]
    return (_measured_page(analysis), *by_type)


def line_keys(weightings: tuple[str, ...]) -> dict[str, Key]:
    """Return how the models of each weighting are drawn."""
    others = cycle(_MORE_LINES)
    looks = {name: _LINES.get(name) or next(others) for name in weightings}
    return {
        name: Key(f"model, weights {name}", color, width) for name, (color, width) in looks.items()
    }


def draw(analysis: WelchAnalysis, tables: str, stream: RecordingStream) -> None:
    """Draw all pages, which are the same at any time of the session.

    Parameters
    ----------
    analysis
        Whose fits are drawn.
    tables
        The same in numbers, as plain text.
    stream
        Takes the drawings.
    """
    import rerun as rr

    first_hz, last_hz = analysis.settings.band_hz
    grid = analysis.response.frequency_hz
    thinning = Thinning.logarithmic(grid, first_hz, last_hz, _GROUPS)
    for page in pages(analysis):
        for graph in page.graphs:
            graph.chart.draw_frame(stream)
            for order, line in enumerate(graph.lines):
                strips = thinning.strips(line.values)
                curve = [graph.chart.place(strip[:, 0], strip[:, 1]) for strip in strips]
                shape = (
                    rr.Points2D(
                        np.concatenate(curve or [np.zeros((0, 2))]),
                        colors=[line.key.color],
                        radii=rr.Radius.ui_points(_DOT),
                        draw_order=20.0 + order,
                    )
                    if line.dotted
                    else rr.LineStrips2D(
                        curve,
                        colors=[line.key.color],
                        radii=rr.Radius.ui_points(line.key.width / 2),
                        draw_order=20.0 + order,
                    )
                )
                stream.log(f"{graph.chart.entity}/{line.name}", shape, static=True)
    stream.log(
        TABLES,
        rr.TextDocument(f"```\n{tables}\n```", media_type=rr.MediaType.MARKDOWN),
        static=True,
    )


def tab(analysis: WelchAnalysis) -> rrb.Container:
    """Return the tab of the fits, with a tab in it for each page and for the tables."""
    import rerun.blueprint as rrb

    contents = [
        rrb.Vertical(
            _view(page.wide),
            rrb.Horizontal(*map(_view, page.narrow)),
            row_shares=[4, 3],
            name=page.title,
        )
        for page in pages(analysis)
    ]
    tables = rrb.TextDocumentView(name=TABLES_PAGE, origin=TABLES)
    return rrb.Tabs(*contents, tables, name=TITLE)


def _view(graph: Graph) -> rrb.Spatial2DView:
    import rerun.blueprint as rrb

    chart = graph.chart
    return rrb.Spatial2DView(
        name=graph.title,
        origin=chart.entity,
        visual_bounds=rrb.VisualBounds2D(x_range=[0.0, chart.width], y_range=[0.0, chart.height]),
    )


def _measured_page(analysis: WelchAnalysis) -> Page:
    response = analysis.response
    coherence = response.coherence
    if coherence is None:
        coherence = np.full(response.frequency_hz.shape, np.nan)
    entity = f"{FITS}/measured"
    magnitude = Line("measured", MEASURED, magnitude_db(response.response))
    phase = Line("measured", MEASURED, phase_deg(response.response), dotted=True)
    return Page(
        MEASURED_PAGE,
        Graph(
            "Magnitude of torque over angle, as estimated for the fits",
            _chart(analysis, f"{entity}/magnitude", _WIDE, _decibels(analysis), MEASURED),
            (magnitude,),
        ),
        (
            Graph(
                "Phase of torque over angle",
                _chart(analysis, f"{entity}/phase", _HALF, _PHASE, MEASURED),
                (phase,),
            ),
            Graph(
                "Coherence of angle and torque",
                _chart(analysis, f"{entity}/coherence", _HALF, _COHERENCE, COHERENCE),
                (Line("coherence", COHERENCE, coherence),),
            ),
        ),
    )


def _type_page(
    analysis: WelchAnalysis, name: str, models: list[FittedModel], keys: dict[str, Key]
) -> Page:
    measured = analysis.response.response
    entity = f"{FITS}/type_{name}"

    def lines(values: Callable[[Complex], Real], *, dotted: bool = False) -> Iterator[Line]:
        yield Line("measured", MEASURED, values(measured), dotted)
        for model in models:
            yield Line(
                _plain(model.fit.weighting), keys[model.fit.weighting], values(model.response)
            )

    used = [keys[model.fit.weighting] for model in models]
    # Shorter on the narrow charts: in full they would run into the title of the axis.
    form = "weights {}" if len(models) <= _MOST_IN_WORDS else "{}"
    short = [
        replace(keys[model.fit.weighting], label=form.format(model.fit.weighting))
        for model in models
    ]
    residuals = [
        Line(
            _plain(model.fit.weighting),
            keys[model.fit.weighting],
            magnitude_db(measured - model.response),
        )
        for model in models
    ]
    magnitudes = _chart(
        analysis, f"{entity}/magnitude", _WIDE, _decibels(analysis), MEASURED, *used
    )
    scores = "; ".join(
        f"{model.fit.weighting}: MSE {model.indices.mse:.3g}, WMSE {model.indices.wmse:.3g}"
        for model in models
    )
    return Page(
        f"Type {name}",
        Graph(f"Magnitude, type {name} ({scores})", magnitudes, tuple(lines(magnitude_db))),
        (
            Graph(
                "Phase",
                _chart(analysis, f"{entity}/phase", _HALF, _PHASE, MEASURED, *short),
                tuple(lines(phase_deg, dotted=True)),
            ),
            Graph(
                "Residual, measured − model",
                _chart(
                    analysis, f"{entity}/residual", _HALF, _decibels(analysis), _SIZE_DB, *short
                ),
                (Line("measured", _SIZE_DB, magnitude_db(measured)), *residuals),
            ),
        ),
    )


_PHASE: Final = Axis("Phase (degrees)", _PHASES_DEG[0], _PHASES_DEG[-1], _PHASES_DEG)
_COHERENCE: Final = Axis("Coherence (1)", 0.0, 1.0, _COHERENCES)


def _chart(
    analysis: WelchAnalysis, entity: str, size: tuple[float, float], y: Axis, *legend: Key
) -> Chart:
    first_hz, last_hz = analysis.settings.band_hz
    ticks, lines = decades(first_hz, last_hz)
    frequency = Axis("Frequency (Hz)", first_hz, last_hz, ticks, lines, logarithmic=True)
    width, height = size
    return Chart(entity, width, height, frequency, y, legend)


def _decibels(analysis: WelchAnalysis) -> Axis:
    """Return the axis that holds the peaks of all responses, and the residuals of the better ones.

    It is the same on all pages, so that types can be compared at a glance.
    """
    measured = analysis.response.response
    responses = [measured, *(model.response for model in analysis.models)]
    residuals = [measured - model.response for model in analysis.models]
    last = max(float(np.nanmax(magnitude_db(response))) for response in responses)
    first = min(
        float(np.nanquantile(magnitude_db(values), 0.02)) for values in (measured, *residuals)
    )
    last = _STEP_DB * np.ceil((last + 3.0) / _STEP_DB)
    first = _STEP_DB * np.floor(first / _STEP_DB)
    count = max(1, round((last - first) / _STEP_DB))
    return Axis("Magnitude (dB re 1 N·m/rad)", float(first), float(last), steps(first, last, count))


def _plain(weighting: str) -> str:
    """Return the name of a weighting as a part of an entity's path."""
    return "model_" + "".join(c if c.isalnum() else "_" for c in weighting)


def check_rerun_file(path: Path) -> None:
    """Raise OutputExistsError if a path is taken, or is no name of such a file."""
    try:
        check_new(path)
    except RrdFileError as error:
        raise OutputExistsError(f"--rerun {error}") from None


def write_rerun_file(analysis: WelchAnalysis, path: Path) -> None:
    """Write the session in the layout of the live view, and its fits in front of it.

    Parameters
    ----------
    analysis : WelchAnalysis
    path : Path
        A new file, ``….rrd``.

    Raises
    ------
    OutputError
        If it cannot be written, or has appeared meanwhile.
    rigd.session.SessionError
        If the session file cannot be read any more.
    """
    from rigd.view import draw_session, recorded_blueprint

    session = read_session(analysis.record.path)
    timings = read_timings(analysis.record.path)
    try:
        with new_rrd_file(path) as stream:
            layout = recorded_blueprint([tab(analysis)])
            draw_session(stream, session, timings, layout=layout)
            draw(analysis, tables_text(analysis), stream)
    except RrdFileError as error:
        raise OutputError(str(error)) from None
