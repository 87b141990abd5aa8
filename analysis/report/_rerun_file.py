"""A session with its fits as a file for Rerun's viewer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report._shown_model import ShownModel
from analysis.report._text import analysis_tables, as_text, damping_sentences, record_tables
from analysis.report.folder import OutputError, OutputExistsError
from rigd.session import read_session, read_timings
from rigd.view import chart_page, chart_view
from rigd.view.chart import Chart, Key, Thinning
from rigd.view.frequency_charts import (
    COHERENCE_AXIS,
    COHERENCE_KEY,
    MEASURED_KEY,
    PHASE_AXIS,
    magnitude_axis,
    magnitude_db,
    phase_deg,
    response_chart,
)
from rigd.view.plots import (
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    TIMELINE,
    VERMILION,
    Color,
    send_columns,
)
from rigd.view.rrd_file import RrdFileError, check_new, new_rrd_file

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import rerun.blueprint as rrb
    from numpy.typing import NDArray
    from rerun import RecordingStream

    from analysis.paper import FittedModel, WelchAnalysis
    from analysis.report._signal_figures import TorqueInBand
    from analysis.results import RecordResult, WholeRecord
    from rigd.view.chart import Axis

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

RECORD: Final = "/whole_record"
RECORD_TITLE: Final = "Whole record"
VERDICT: Final = f"{RECORD}/verdict"
VERDICT_PAGE: Final = "Verdict"
TORQUE_PAGE: Final = "Torque"
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
_SCALARS: Final = "Scalars:scalars"
"""Rerun's name of the values of a plot."""
_GROUPS: Final = 400
"""Groups of points along the axis, two drawn per group: enough for the pixels of a view."""


@dataclass(frozen=True, slots=True)
class ChartCurve:
    """A curve of a chart.

    Attributes
    ----------
    name
        Its entity in Rerun, under the chart.
    key
        Its style.
    values
        Shape (n,), at the frequencies that were fitted.
    dotted
        Whether the values are drawn as points: a line would run up and down wherever noise takes a
        phase from one end of its axis to the other.
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
    curves: tuple[ChartCurve, ...]


@dataclass(frozen=True, slots=True)
class ChartPage:
    """Charts that are seen together: a wide one over two narrow ones.

    Attributes
    ----------
    title
        Title of the tab.
    graphs
        Charts, the wide one first.
    frequency_hz
        Frequencies of all curves, shape (n,).
    band_hz
        Ends of the axes.
    """

    title: str
    graphs: tuple[Graph, Graph, Graph]
    frequency_hz: Real
    band_hz: tuple[float, float]


# Welch fits


def pages(analysis: WelchAnalysis) -> tuple[ChartPage, ...]:
    """Return the measured response with its coherence, and each model type with its residuals."""
    magnitude = _magnitude_axis(analysis)
    keys_by_weighting = line_keys(analysis.settings.weightings)
    return (
        _measured_page(analysis, magnitude),
        *(
            _type_page(analysis, name, magnitude, keys_by_weighting)
            for name in analysis.settings.types
        ),
    )


def line_keys(weightings: tuple[str, ...]) -> dict[str, Key]:
    """Return how the models of each weighting are drawn."""
    others = cycle(_MORE_LINES)
    keys_by_weighting = {name: _LINES.get(name) or next(others) for name in weightings}
    return {
        name: Key(f"model, weights {name}", color, width)
        for name, (color, width) in keys_by_weighting.items()
    }


def draw(analysis: WelchAnalysis, tables: str, stream: RecordingStream) -> None:
    """Draw all pages of the Welch fits, which are the same at any time of the session.

    Parameters
    ----------
    analysis
        Whose fits are drawn.
    tables
        The same in numbers, as plain text.
    stream
        Receives the drawings.
    """
    for page in pages(analysis):
        _draw_page(page, stream)
    _draw_text(TABLES, f"```\n{tables}\n```", stream)


def tab(analysis: WelchAnalysis) -> rrb.Container:
    """Return the tab of the Welch fits, with a tab in it for each page and for the tables."""
    import rerun.blueprint as rrb

    tables = rrb.TextDocumentView(name=TABLES_PAGE, origin=TABLES)
    return rrb.Tabs(*map(_page_view, pages(analysis)), tables, name=TITLE)


def _draw_page(page: ChartPage, stream: RecordingStream) -> None:
    thinning = Thinning.logarithmic(page.frequency_hz, *page.band_hz, _GROUPS)
    for graph in page.graphs:
        graph.chart.draw_frame(stream)
        for order, curve in enumerate(graph.curves):
            strips = thinning.strips(curve.values)
            graph.chart.draw_curve(
                stream, curve.name, strips, curve.key, static=True, dotted=curve.dotted, order=order
            )


def _draw_text(entity: str, text: str, stream: RecordingStream) -> None:
    import rerun as rr

    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    stream.log(entity, document, static=True)


def _page_view(page: ChartPage) -> rrb.Container:
    def view(graph: Graph) -> rrb.Spatial2DView:
        chart = graph.chart
        return chart_view(graph.title, chart.entity, (chart.width, chart.height))

    return chart_page(*map(view, page.graphs), name=page.title)


def _measured_page(analysis: WelchAnalysis, magnitude: Axis) -> ChartPage:
    response, band_hz = analysis.response, analysis.settings.band_hz
    coherence = response.coherence
    if coherence is None:
        coherence = np.full(response.frequency_hz.shape, np.nan)
    entity = f"{FITS}/measured"
    return ChartPage(
        MEASURED_PAGE,
        (
            Graph(
                "Magnitude of torque over angle, as estimated for the fits",
                response_chart(f"{entity}/magnitude", _WIDE, band_hz, magnitude, MEASURED_KEY),
                (ChartCurve("measured", MEASURED_KEY, magnitude_db(response.response)),),
            ),
            Graph(
                "Phase of torque over angle",
                response_chart(f"{entity}/phase", _HALF, band_hz, PHASE_AXIS, MEASURED_KEY),
                (ChartCurve("measured", MEASURED_KEY, phase_deg(response.response), dotted=True),),
            ),
            Graph(
                "Coherence of angle and torque",
                response_chart(
                    f"{entity}/coherence", _HALF, band_hz, COHERENCE_AXIS, COHERENCE_KEY
                ),
                (ChartCurve("coherence", COHERENCE_KEY, coherence),),
            ),
        ),
        response.frequency_hz,
        band_hz,
    )


def _type_page(
    analysis: WelchAnalysis, name: str, magnitude: Axis, keys_by_weighting: dict[str, Key]
) -> ChartPage:
    models = [model for model in analysis.models if model.fit.structure.name == name]
    keys = [keys_by_weighting[model.fit.weighting] for model in models]
    # Shorter on the narrow charts: in full they would run into the title of the axis.
    form = "weights {}" if len(models) <= _MOST_IN_WORDS else "{}"
    short = [
        replace(key, label=form.format(model.fit.weighting))
        for key, model in zip(keys, models, strict=True)
    ]
    measured, band_hz = analysis.response.response, analysis.settings.band_hz
    entity = f"{FITS}/type_{name}"

    def of_models(values: Callable[[FittedModel], Real]) -> list[ChartCurve]:
        return [
            ChartCurve(_plain(model.fit.weighting), key, values(model))
            for key, model in zip(keys, models, strict=True)
        ]

    scores = "; ".join(
        f"{model.fit.weighting}: MSE {model.indices.mse:.3g}, WMSE {model.indices.wmse:.3g}"
        for model in models
    )
    return ChartPage(
        f"Type {name}",
        (
            Graph(
                f"Magnitude, type {name} ({scores})",
                response_chart(
                    f"{entity}/magnitude", _WIDE, band_hz, magnitude, MEASURED_KEY, *keys
                ),
                (
                    ChartCurve("measured", MEASURED_KEY, magnitude_db(measured)),
                    *of_models(lambda model: magnitude_db(model.response)),
                ),
            ),
            Graph(
                "Phase",
                response_chart(f"{entity}/phase", _HALF, band_hz, PHASE_AXIS, MEASURED_KEY, *short),
                (
                    ChartCurve("measured", MEASURED_KEY, phase_deg(measured), dotted=True),
                    *of_models(lambda model: phase_deg(model.response)),
                ),
            ),
            Graph(
                "Residual, measured − model",
                response_chart(f"{entity}/residual", _HALF, band_hz, magnitude, _SIZE_DB, *short),
                (
                    ChartCurve("measured", _SIZE_DB, magnitude_db(measured)),
                    *of_models(lambda model: magnitude_db(measured - model.response)),
                ),
            ),
        ),
        analysis.response.frequency_hz,
        band_hz,
    )


def _magnitude_axis(analysis: WelchAnalysis) -> Axis:
    """Return the axis that holds the peaks of all responses, and the residuals of the better ones.

    It is the same on all pages, so that types can be compared at a glance.
    """
    return _axis_of(analysis.response.response, [model.response for model in analysis.models])


def _axis_of(measured: Complex, models: Sequence[Complex]) -> Axis:
    responses = [measured, *models]
    shown = [measured, *(measured - model for model in models)]
    return magnitude_axis(
        min(float(np.nanquantile(magnitude_db(values), 0.02)) for values in shown),
        max(float(np.nanmax(magnitude_db(values))) for values in responses) + 3.0,
    )


def _plain(weighting: str) -> str:
    """Return the name of a weighting as a part of an entity's path."""
    return "model_" + "".join(c if c.isalnum() else "_" for c in weighting)


# Whole record

_MOST_LABELS: Final = 5
"""On either side of 0, in half the height of a window."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Curves over the session's time, in one view.

    Attributes
    ----------
    entity
        Their entity in Rerun.
    title
        Title of the view, with the unit.
    names, colors, widths
        Style of each line, from the lowest to the topmost.
    values
        Computes the lines' values (n, lines) from the torque.
    """

    entity: str
    title: str
    names: tuple[str, ...]
    colors: tuple[Color, ...]
    widths: tuple[float, ...]
    values: Callable[[TorqueInBand], Real]


_OVER_TIME: Final = (
    Lines(
        f"{RECORD}/torque",
        "Coupling torque in the band of the fit (N·m)",
        ("measured (N·m)", "model (N·m)"),
        (SKY_BLUE, ORANGE),
        (2.5, 1.0),
        lambda torque: np.column_stack((torque.measured, torque.modelled)),
    ),
    Lines(
        f"{RECORD}/residual",
        "Residual, measured − model (mN·m)",
        ("residual (mN·m)",),
        (VERMILION,),
        (1.0,),
        lambda torque: 1e3 * torque.residual[:, None],
    ),
)


def record_page(whole: WholeRecord) -> ChartPage:
    """Return response and residual of the fit that the numbers are of.

    Measured is the ratio of the whole record's transforms, without the model's delay.
    """
    from analysis.report._record_figures import measured_response

    found, shown = measured_response(whole), ShownModel.of(whole.headline, whole.record)
    grid_hz = found.frequency_hz
    turned = np.exp(2j * np.pi * shown.delay_s * grid_hz)
    measured, model = found.response * turned, shown.band(grid_hz).response
    band_hz = float(grid_hz[0]), float(grid_hz[-1])
    magnitude = _axis_of(measured, [model])
    key, name = Key(shown.name.removeprefix("the "), ORANGE, 2.0), "model"
    short = replace(key, label="model")
    entity = f"{RECORD}/response"
    return ChartPage(
        "Response",
        (
            Graph(
                f"Magnitude of torque over angle, whole record, {shown.name.removeprefix('the ')}",
                response_chart(f"{entity}/magnitude", _WIDE, band_hz, magnitude, MEASURED_KEY, key),
                (
                    ChartCurve("measured", MEASURED_KEY, magnitude_db(measured)),
                    ChartCurve(name, key, magnitude_db(model)),
                ),
            ),
            Graph(
                "Phase",
                response_chart(f"{entity}/phase", _HALF, band_hz, PHASE_AXIS, MEASURED_KEY, short),
                (
                    ChartCurve("measured", MEASURED_KEY, phase_deg(measured), dotted=True),
                    ChartCurve(name, key, phase_deg(model)),
                ),
            ),
            Graph(
                "Residual, measured − model",
                response_chart(f"{entity}/residual", _HALF, band_hz, magnitude, _SIZE_DB, short),
                (
                    ChartCurve("measured", _SIZE_DB, magnitude_db(measured)),
                    ChartCurve(name, key, magnitude_db(measured - model)),
                ),
            ),
        ),
        grid_hz,
        band_hz,
    )


def draw_record(
    whole: WholeRecord, torque: TorqueInBand, tables: str, stream: RecordingStream
) -> None:
    """Draw the results of the whole record: verdict, response, and torque over time.

    Parameters
    ----------
    whole
        Whose selected fit is drawn.
    torque
        Torque of the record and of that fit.
    tables
        Its tables, as plain text.
    stream
        Receives the drawings.
    """
    sentences = [
        *(f"**{sentence}**" for sentence in damping_sentences(whole.headline)),
        *whole.verdict.sentences,
        *(f"* {advice}" for advice in whole.verdict.experiments),
    ]
    _draw_text(VERDICT, "\n\n".join((*sentences, f"```\n{tables}\n```")), stream)
    _draw_page(record_page(whole), stream)
    t_ns = np.round(1e9 * whole.record.time_s).astype(np.int64)
    for lines in _OVER_TIME:
        send_columns(stream, lines.entity, t_ns, {_SCALARS: lines.values(torque)})


def record_tab(whole: WholeRecord, torque: TorqueInBand) -> rrb.Container:
    """Return the tab of the whole record, with a tab in it for each of these."""
    import rerun.blueprint as rrb

    end_s = float(whole.record.time_s[-1])
    return rrb.Tabs(
        rrb.TextDocumentView(name=VERDICT_PAGE, origin=VERDICT),
        _page_view(record_page(whole)),
        rrb.Vertical(
            *(
                _lines_view(each, end_s, float(np.abs(each.values(torque)).max()))
                for each in _OVER_TIME
            ),
            name=TORQUE_PAGE,
        ),
        name=RECORD_TITLE,
    )


def _lines_view(lines: Lines, end_s: float, largest: float) -> rrb.TimeSeriesView:
    """Return a view of the whole session, independent of the current time."""
    import rerun as rr
    import rerun.blueprint as rrb

    start = rrb.TimeRangeBoundary.absolute(seconds=0.0)
    end = rrb.TimeRangeBoundary.absolute(seconds=end_s)
    series_style = rr.SeriesLines(
        names=lines.names,
        colors=lines.colors,
        widths=lines.widths,
        # The default averages what falls on one pixel, and so understates peaks.
        aggregation_policy="MinMax",
    )
    return rrb.TimeSeriesView(
        name=lines.title,
        origin=lines.entity,
        overrides={lines.entity: series_style},
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=len(lines.names) > 1),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=rrb.ScalarAxis(range=_span(largest)),
        time_ranges=rrb.VisibleTimeRange(TIMELINE, start=start, end=end),
    )


def _span(largest: float) -> tuple[float, float]:
    """Return the ends of an axis about 0 on which Rerun labels more than that.

    It labels multiples of a power of ten, where there is room for all of them.
    """
    step = 10.0 ** np.floor(np.log10(max(largest, 1e-12)))
    end = 1.1 * largest if largest < _MOST_LABELS * step else 11.0 * step
    return -end, end


# File


def check_rerun_file(path: Path) -> None:
    """Raise OutputExistsError if a path is taken, or is not a name of such a file."""
    try:
        check_new(path)
    except RrdFileError as error:
        raise OutputExistsError(f"--rerun {error}") from None


def write_rerun_file(result: RecordResult, path: Path) -> None:
    """Write the session in the layout of the live view, preceded by its results.

    Parameters
    ----------
    result : RecordResult
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

    whole, welch, tabs = result.whole, result.welch, []
    if whole is not None:
        from analysis.report._signal_figures import torque_in_band

        torque = torque_in_band(
            whole.record, ShownModel.of(whole.headline, whole.record).transfer, whole.band_hz[1]
        )
        tabs.append(record_tab(whole, torque))
    if welch is not None:
        tabs.append(tab(welch))
    session = read_session(result.record.path)
    timings = read_timings(result.record.path)
    try:
        with new_rrd_file(path) as stream:
            draw_session(stream, session, timings, front=tabs)
            if whole is not None:
                draw_record(whole, torque, as_text(record_tables(whole)), stream)
            if welch is not None:
                draw(welch, as_text(analysis_tables(result)), stream)
    except RrdFileError as error:
        raise OutputError(str(error)) from None
