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
    COHERENCE_AXIS,
    COHERENCE_KEY,
    GREEN,
    GREY,
    MEASURED_KEY,
    ORANGE,
    PHASE_AXIS,
    PURPLE,
    VERMILION,
    Chart,
    Color,
    Key,
    RrdFileError,
    Thinning,
    chart_page,
    chart_view,
    check_new,
    magnitude_axis,
    magnitude_db,
    new_rrd_file,
    phase_deg,
    response_chart,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import rerun.blueprint as rrb
    from numpy.typing import NDArray
    from rerun import RecordingStream

    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.results import RecordResult
    from rigd.view import Axis

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

FITS: Final = "/fits"
TITLE: Final = "Fits"
TABLES: Final = f"{FITS}/tables"
MEASURED_PAGE: Final = "Measured"
TABLES_PAGE: Final = "Tables"

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
"""Groups of points along the axis, two kept per group: enough for the pixels of a view."""


@dataclass(frozen=True, slots=True)
class Curve:
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
    curves: tuple[Curve, ...]


@dataclass(frozen=True, slots=True)
class Page:
    """Charts that are seen together: a wide one over two narrow ones."""

    title: str
    graphs: tuple[Graph, Graph, Graph]


def pages(analysis: WelchAnalysis) -> tuple[Page, ...]:
    """Return the measured response with its coherence, and each model type with its residuals."""
    magnitude = _magnitude_axis(analysis)
    looks = line_keys(analysis.settings.weightings)
    return (
        _measured_page(analysis, magnitude),
        *(_type_page(analysis, name, magnitude, looks) for name in analysis.settings.types),
    )


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

    thinning = Thinning.logarithmic(
        analysis.response.frequency_hz, *analysis.settings.band_hz, _GROUPS
    )
    for graph in (graph for page in pages(analysis) for graph in page.graphs):
        graph.chart.draw_frame(stream)
        for order, curve in enumerate(graph.curves):
            strips = thinning.strips(curve.values)
            graph.chart.draw_curve(
                stream, curve.name, strips, curve.key, static=True, dotted=curve.dotted, order=order
            )
    stream.log(
        TABLES,
        rr.TextDocument(f"```\n{tables}\n```", media_type=rr.MediaType.MARKDOWN),
        static=True,
    )


def tab(analysis: WelchAnalysis) -> rrb.Container:
    """Return the tab of the fits, with a tab in it for each page and for the tables."""
    import rerun.blueprint as rrb

    def view(graph: Graph) -> rrb.Spatial2DView:
        chart = graph.chart
        return chart_view(graph.title, chart.entity, (chart.width, chart.height))

    contents = [chart_page(*map(view, page.graphs), name=page.title) for page in pages(analysis)]
    tables = rrb.TextDocumentView(name=TABLES_PAGE, origin=TABLES)
    return rrb.Tabs(*contents, tables, name=TITLE)


def _measured_page(analysis: WelchAnalysis, magnitude: Axis) -> Page:
    response, band_hz = analysis.response, analysis.settings.band_hz
    coherence = response.coherence
    if coherence is None:
        coherence = np.full(response.frequency_hz.shape, np.nan)
    entity = f"{FITS}/measured"
    return Page(
        MEASURED_PAGE,
        (
            Graph(
                "Magnitude of torque over angle, as estimated for the fits",
                response_chart(f"{entity}/magnitude", _WIDE, band_hz, magnitude, MEASURED_KEY),
                (Curve("measured", MEASURED_KEY, magnitude_db(response.response)),),
            ),
            Graph(
                "Phase of torque over angle",
                response_chart(f"{entity}/phase", _HALF, band_hz, PHASE_AXIS, MEASURED_KEY),
                (Curve("measured", MEASURED_KEY, phase_deg(response.response), dotted=True),),
            ),
            Graph(
                "Coherence of angle and torque",
                response_chart(
                    f"{entity}/coherence", _HALF, band_hz, COHERENCE_AXIS, COHERENCE_KEY
                ),
                (Curve("coherence", COHERENCE_KEY, coherence),),
            ),
        ),
    )


def _type_page(analysis: WelchAnalysis, name: str, magnitude: Axis, looks: dict[str, Key]) -> Page:
    models = [model for model in analysis.models if model.fit.structure.name == name]
    keys = [looks[model.fit.weighting] for model in models]
    # Shorter on the narrow charts: in full they would run into the title of the axis.
    form = "weights {}" if len(models) <= _MOST_IN_WORDS else "{}"
    short = [
        replace(key, label=form.format(model.fit.weighting))
        for key, model in zip(keys, models, strict=True)
    ]
    measured, band_hz = analysis.response.response, analysis.settings.band_hz
    entity = f"{FITS}/type_{name}"

    def of_models(values: Callable[[FittedModel], Real]) -> list[Curve]:
        return [
            Curve(_plain(model.fit.weighting), key, values(model))
            for key, model in zip(keys, models, strict=True)
        ]

    scores = "; ".join(
        f"{model.fit.weighting}: MSE {model.indices.mse:.3g}, WMSE {model.indices.wmse:.3g}"
        for model in models
    )
    return Page(
        f"Type {name}",
        (
            Graph(
                f"Magnitude, type {name} ({scores})",
                response_chart(
                    f"{entity}/magnitude", _WIDE, band_hz, magnitude, MEASURED_KEY, *keys
                ),
                (
                    Curve("measured", MEASURED_KEY, magnitude_db(measured)),
                    *of_models(lambda model: magnitude_db(model.response)),
                ),
            ),
            Graph(
                "Phase",
                response_chart(f"{entity}/phase", _HALF, band_hz, PHASE_AXIS, MEASURED_KEY, *short),
                (
                    Curve("measured", MEASURED_KEY, phase_deg(measured), dotted=True),
                    *of_models(lambda model: phase_deg(model.response)),
                ),
            ),
            Graph(
                "Residual, measured − model",
                response_chart(f"{entity}/residual", _HALF, band_hz, magnitude, _SIZE_DB, *short),
                (
                    Curve("measured", _SIZE_DB, magnitude_db(measured)),
                    *of_models(lambda model: magnitude_db(measured - model.response)),
                ),
            ),
        ),
    )


def _magnitude_axis(analysis: WelchAnalysis) -> Axis:
    """Return the axis that holds the peaks of all responses, and the residuals of the better ones.

    It is the same on all pages, so that types can be compared at a glance.
    """
    measured = analysis.response.response
    responses = [measured, *(model.response for model in analysis.models)]
    shown = [measured, *(measured - model.response for model in analysis.models)]
    return magnitude_axis(
        min(float(np.nanquantile(magnitude_db(values), 0.02)) for values in shown),
        max(float(np.nanmax(magnitude_db(values))) for values in responses) + 3.0,
    )


def _plain(weighting: str) -> str:
    """Return the name of a weighting as a part of an entity's path."""
    return "model_" + "".join(c if c.isalnum() else "_" for c in weighting)


def check_rerun_file(path: Path) -> None:
    """Raise OutputExistsError if a path is taken, or is no name of such a file."""
    try:
        check_new(path)
    except RrdFileError as error:
        raise OutputExistsError(f"--rerun {error}") from None


def write_rerun_file(result: RecordResult, path: Path) -> None:
    """Write the session in the layout of the live view, and its fits in front of it.

    Parameters
    ----------
    result : RecordResult
        With Welch fits.
    path : Path
        A new file, ``….rrd``.

    Raises
    ------
    OutputError
        If it cannot be written, or has appeared meanwhile.
    rigd.session.SessionError
        If the session file cannot be read any more.
    """
    from rigd.view import draw_session

    analysis = result.welch
    assert analysis is not None
    session = read_session(result.record.path)
    timings = read_timings(result.record.path)
    try:
        with new_rrd_file(path) as stream:
            draw_session(stream, session, timings, front=[tab(analysis)])
            draw(analysis, tables_text(result), stream)
    except RrdFileError as error:
        raise OutputError(str(error)) from None
