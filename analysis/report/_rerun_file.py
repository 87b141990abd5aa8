"""Rerun file of a session with its fits: the live view's tabs, preceded by the results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report._shown_model import ShownModel
from analysis.report._text import analysis_tables, as_text, damping_sentences, record_tables
from analysis.report.folder import OutputError, OutputExistsError
from rigd.session import read_session, read_timings
from rigd.spectral import CurveDecimation, magnitude_db, phase_deg
from rigd.view import chart_page, chart_view
from rigd.view.chart import Chart, LegendEntry
from rigd.view.frequency_charts import (
    COHERENCE_AXIS,
    COHERENCE_ENTRY,
    MEASURED_ENTRY,
    PHASE_AXIS,
    magnitude_axis,
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
from rigd.view.rrd_file import RrdFileError, check_new_rrd_file, new_rrd_file

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import rerun.blueprint as rrb
    from numpy.typing import NDArray
    from rerun import RecordingStream

    from analysis.paper.welch_analysis import FittedModel, WelchAnalysis
    from analysis.report._signal_figures import TorqueInBand
    from analysis.results import RecordResult, WholeRecord
    from rigd.view.chart import Axis

    # Array of real numbers.
    RealArray = NDArray[np.float64]
    # Array of complex numbers.
    ComplexArray = NDArray[np.complex128]

RECORD_ENTITY: Final = "/whole_record"
"""Entity path in Rerun of the whole record's results."""
RECORD_TITLE: Final = "Whole record"
"""Title of the tab with the whole record's results."""
VERDICT_ENTITY: Final = f"{RECORD_ENTITY}/verdict"
"""Entity path in Rerun of the verdict."""
VERDICT_TITLE: Final = "Verdict"
"""Title of the tab with the verdict."""
TORQUE_TITLE: Final = "Torque"
"""Title of the tab with the torque over time."""
FITS_ENTITY: Final = "/fits"
"""Entity path in Rerun of the Welch fits."""
FITS_TITLE: Final = "Fits"
"""Title of the tab with the Welch fits."""
TABLES_ENTITY: Final = f"{FITS_ENTITY}/tables"
"""Entity path in Rerun of the tables of the Welch fits."""
MEASURED_TITLE: Final = "Measured"
"""Title of the tab with the measured response."""
TABLES_TITLE: Final = "Tables"
"""Title of the tab with the tables of the Welch fits."""

_MEASURED_MAGNITUDE_ENTRY: Final = LegendEntry("|measured|", GREY)
"""Legend entry of the measured magnitude in the charts of residuals."""
_WIDE_CHART_SIZE: Final = (1280.0, 350.0)
"""Width and height of a page's wide chart, in points, for a window of 1280 × 800."""
_NARROW_CHART_SIZE: Final = (640.0, 262.0)
"""Width and height of a page's narrow charts, in points, for a window of 1280 × 800."""

_LINE_STYLE_BY_WEIGHTING: Final[dict[str, tuple[Color, float]]] = {
    "const": (ORANGE, 3.0),
    "omega": (VERMILION, 1.5),
}
"""Colour and width of a model's line by its weighting.

The narrower line lies over the wider one, because the two models are often alike."""
_FURTHER_LINE_STYLES: Final = ((PURPLE, 1.5), (GREEN, 1.5), (ORANGE, 1.5))
"""Colours and widths of the lines for further weightings."""
_MAX_MODELS_WITH_LONG_LABEL: Final = 2
"""Largest number of models for which the legend of a narrow chart contains the word "weights"."""
_SCALARS_COMPONENT: Final = "Scalars:scalars"
"""Rerun's name for the values of a plot over time."""
_FREQUENCY_GROUPS: Final = 400
"""Number of groups of points along the frequency axis, each drawn as two points.

This is enough for the pixels of a view."""


@dataclass(frozen=True, slots=True)
class ChartCurve:
    """Curve of a chart: name, style and values.

    Attributes
    ----------
    name
        Name of the curve under the chart's entity path in Rerun.
    key
        Label and style of the curve.
    values
        Values at the frequencies of the page, shape (n,).
    dotted
        Whether the values are drawn as points. A line would jump wherever noise takes the phase
        from one end of its axis to the other.
    """

    name: str
    legend_entry: LegendEntry
    curve_values: RealArray
    dotted: bool = False


@dataclass(frozen=True, slots=True)
class Graph:
    """Chart of a page with its title and its curves, in the order in which they are drawn."""

    title: str
    chart: Chart
    curves: tuple[ChartCurve, ...]


@dataclass(frozen=True, slots=True)
class ChartPage:
    """Three charts that are displayed together: a wide one above two narrow ones.

    Attributes
    ----------
    title
        Title of the tab.
    graphs
        Charts, the wide one first.
    frequency_hz
        Frequencies of all curves, shape (n,).
    band_hz
        Lowest and highest frequency of the axes.
    """

    title: str
    graphs: tuple[Graph, Graph, Graph]
    frequency_hz: RealArray
    band_hz: tuple[float, float]


# Welch fits


def welch_pages(analysis: WelchAnalysis) -> tuple[ChartPage, ...]:
    """Return the charts of the Welch fits: a page for the measured response, and one per type."""
    magnitude_axis = _magnitude_axis(analysis)
    entry_by_weighting = model_legend_entries(analysis.settings.weightings)
    return (
        _measured_page(analysis, magnitude_axis),
        *(
            _type_page(analysis, type_name, magnitude_axis, entry_by_weighting)
            for type_name in analysis.settings.types
        ),
    )


def model_legend_entries(weightings: tuple[str, ...]) -> dict[str, LegendEntry]:
    """Return the legend entry (label and line style) of fitted models, by their weighting."""
    further_line_styles = cycle(_FURTHER_LINE_STYLES)
    line_style_by_weighting = {
        weighting_name: _LINE_STYLE_BY_WEIGHTING.get(weighting_name) or next(further_line_styles)
        for weighting_name in weightings
    }
    return {
        weighting_name: LegendEntry(f"model, weights {weighting_name}", line_color, line_width)
        for weighting_name, (line_color, line_width) in line_style_by_weighting.items()
    }


def draw_welch_fits(analysis: WelchAnalysis, tables_markdown: str, stream: RecordingStream) -> None:
    """Send the charts and tables of the Welch fits to Rerun, visible at any time of the session.

    The tables are plain text.
    """
    for fit_page in welch_pages(analysis):
        _draw_page(fit_page, stream)
    _draw_text(TABLES_ENTITY, f"```\n{tables_markdown}\n```", stream)


def welch_fits_tab(analysis: WelchAnalysis) -> rrb.Container:
    """Return the tab of the Welch fits, with one inner tab for each page and one for the tables."""
    import rerun.blueprint as rrb

    tables_view = rrb.TextDocumentView(name=TABLES_TITLE, origin=TABLES_ENTITY)
    return rrb.Tabs(*map(_page_view, welch_pages(analysis)), tables_view, name=FITS_TITLE)


def _draw_page(fit_page: ChartPage, stream: RecordingStream) -> None:
    """Send the three charts of a page to Rerun, with curves decimated for the screen."""
    decimation = CurveDecimation.with_logarithmic_groups(
        fit_page.frequency_hz, *fit_page.band_hz, _FREQUENCY_GROUPS
    )
    for graph in fit_page.graphs:
        graph.chart.draw_frame(stream)
        for curve_order, curve in enumerate(graph.curves):
            curve_strips = decimation.curve_strips(curve.curve_values)
            graph.chart.draw_curve(
                stream,
                curve.name,
                curve_strips,
                curve.legend_entry,
                static=True,
                dotted=curve.dotted,
                curve_order=curve_order,
            )


def _draw_text(entity_path: str, markdown_text: str, stream: RecordingStream) -> None:
    """Send a Markdown text to Rerun, visible at any time of the session."""
    import rerun as rr

    text_document = rr.TextDocument(markdown_text, media_type=rr.MediaType.MARKDOWN)
    stream.log(entity_path, text_document, static=True)


def _page_view(fit_page: ChartPage) -> rrb.Container:
    """Return the tab with the three charts of `fit_page`: a wide one above two narrow ones."""

    def graph_view(graph: Graph) -> rrb.Spatial2DView:
        graph_chart = graph.chart
        return chart_view(graph.title, graph_chart.entity, (graph_chart.width, graph_chart.height))

    return chart_page(*map(graph_view, fit_page.graphs), tab_title=fit_page.title)


def _measured_page(analysis: WelchAnalysis, magnitude_axis: Axis) -> ChartPage:
    """Return the charts of the measured response for one tab: magnitude, phase and coherence."""
    response, band_hz = analysis.response, analysis.settings.band_hz
    coherence = response.coherence
    if coherence is None:
        coherence = np.full(response.frequency_hz.shape, np.nan)
    page_entity = f"{FITS_ENTITY}/measured"
    return ChartPage(
        MEASURED_TITLE,
        (
            Graph(
                "Magnitude of torque over angle, as estimated for the fits",
                response_chart(
                    f"{page_entity}/magnitude",
                    _WIDE_CHART_SIZE,
                    band_hz,
                    magnitude_axis,
                    MEASURED_ENTRY,
                ),
                (ChartCurve("measured", MEASURED_ENTRY, magnitude_db(response.response)),),
            ),
            Graph(
                "Phase of torque over angle",
                response_chart(
                    f"{page_entity}/phase", _NARROW_CHART_SIZE, band_hz, PHASE_AXIS, MEASURED_ENTRY
                ),
                (
                    ChartCurve(
                        "measured", MEASURED_ENTRY, phase_deg(response.response), dotted=True
                    ),
                ),
            ),
            Graph(
                "Coherence of angle and torque",
                response_chart(
                    f"{page_entity}/coherence",
                    _NARROW_CHART_SIZE,
                    band_hz,
                    COHERENCE_AXIS,
                    COHERENCE_ENTRY,
                ),
                (ChartCurve("coherence", COHERENCE_ENTRY, coherence),),
            ),
        ),
        response.frequency_hz,
        band_hz,
    )


def _type_page(
    analysis: WelchAnalysis,
    type_name: str,
    magnitude_axis: Axis,
    entry_by_weighting: dict[str, LegendEntry],
) -> ChartPage:
    """Return the charts of one damping type for one tab: magnitude, phase and residuals."""
    models = [model for model in analysis.models if model.fit.structure.name == type_name]
    legend_entries = [entry_by_weighting[model.fit.weighting] for model in models]
    # Short labels on the narrow charts, because long ones would overlap the axis title.
    label_format = "weights {}" if len(models) <= _MAX_MODELS_WITH_LONG_LABEL else "{}"
    short_legend_entries = [
        replace(key, label=label_format.format(model.fit.weighting))
        for key, model in zip(legend_entries, models, strict=True)
    ]
    measured_frf, band_hz = analysis.response.response, analysis.settings.band_hz
    page_entity = f"{FITS_ENTITY}/type_{type_name}"

    def model_curves(values_of_model: Callable[[FittedModel], RealArray]) -> list[ChartCurve]:
        return [
            ChartCurve(_entity_name(model.fit.weighting), legend_entry, values_of_model(model))
            for legend_entry, model in zip(legend_entries, models, strict=True)
        ]

    fit_error_text = "; ".join(
        f"{model.fit.weighting}: MSE {model.indices.mse:.3g}, WMSE {model.indices.wmse:.3g}"
        for model in models
    )
    return ChartPage(
        f"Type {type_name}",
        (
            Graph(
                f"Magnitude, type {type_name} ({fit_error_text})",
                response_chart(
                    f"{page_entity}/magnitude",
                    _WIDE_CHART_SIZE,
                    band_hz,
                    magnitude_axis,
                    MEASURED_ENTRY,
                    *legend_entries,
                ),
                (
                    ChartCurve("measured", MEASURED_ENTRY, magnitude_db(measured_frf)),
                    *model_curves(lambda model: magnitude_db(model.response)),
                ),
            ),
            Graph(
                "Phase",
                response_chart(
                    f"{page_entity}/phase",
                    _NARROW_CHART_SIZE,
                    band_hz,
                    PHASE_AXIS,
                    MEASURED_ENTRY,
                    *short_legend_entries,
                ),
                (
                    ChartCurve("measured", MEASURED_ENTRY, phase_deg(measured_frf), dotted=True),
                    *model_curves(lambda model: phase_deg(model.response)),
                ),
            ),
            Graph(
                "Residual, measured − model",
                response_chart(
                    f"{page_entity}/residual",
                    _NARROW_CHART_SIZE,
                    band_hz,
                    magnitude_axis,
                    _MEASURED_MAGNITUDE_ENTRY,
                    *short_legend_entries,
                ),
                (
                    ChartCurve("measured", _MEASURED_MAGNITUDE_ENTRY, magnitude_db(measured_frf)),
                    *model_curves(lambda model: magnitude_db(measured_frf - model.response)),
                ),
            ),
        ),
        analysis.response.frequency_hz,
        band_hz,
    )


def _magnitude_axis(analysis: WelchAnalysis) -> Axis:
    """Return the common magnitude axis of all pages of the Welch fits.

    Its range contains the peaks of all responses and the residuals of the better models. All types
    have the same axis, so that they can be compared.
    """
    return _axis_of_responses(
        analysis.response.response, [model.response for model in analysis.models]
    )


def _axis_of_responses(measured_frf: ComplexArray, modelled_frf: Sequence[ComplexArray]) -> Axis:
    """Return a magnitude axis for measured and modelled responses, and for their residuals."""
    responses = [measured_frf, *modelled_frf]
    measured_and_residuals = [measured_frf, *(measured_frf - model for model in modelled_frf)]
    return magnitude_axis(
        min(
            float(np.nanquantile(magnitude_db(frf_values), 0.02))
            for frf_values in measured_and_residuals
        ),
        max(float(np.nanmax(magnitude_db(frf_values))) for frf_values in responses) + 3.0,
    )


def _entity_name(weighting: str) -> str:
    """Return a weighting's name in a form that is valid in Rerun's entity paths."""
    return "model_" + "".join(c if c.isalnum() else "_" for c in weighting)


# Whole record

_MAX_LABELS_PER_SIDE: Final = 5
"""Largest number of axis labels on either side of 0 that half the height of a window can hold."""


@dataclass(frozen=True, slots=True)
class PlotOverTime:
    """Plot of several curves over the session's time: title, and names and styles of the curves.

    Attributes
    ----------
    entity
        Entity path of the curves in Rerun.
    title
        Title of the plot, with the unit.
    names, colors, widths
        Name, colour and width of each line, from the lowest to the topmost.
    compute_values
        Function that returns the lines' values, shape (n, lines), for the torque of a record.
    """

    entity: str
    title: str
    curve_names: tuple[str, ...]
    curve_colors: tuple[Color, ...]
    curve_widths: tuple[float, ...]
    compute_values: Callable[[TorqueInBand], RealArray]


_PLOTS_OVER_TIME: Final = (
    PlotOverTime(
        f"{RECORD_ENTITY}/torque",
        "Coupling torque in the band of the fit (N·m)",
        ("measured (N·m)", "model (N·m)"),
        (SKY_BLUE, ORANGE),
        (2.5, 1.0),
        lambda torque: np.column_stack((torque.measured_nm, torque.modelled_nm)),
    ),
    PlotOverTime(
        f"{RECORD_ENTITY}/residual",
        "Residual, measured − model (mN·m)",
        ("residual (mN·m)",),
        (VERMILION,),
        (1.0,),
        lambda torque: 1e3 * torque.residual_nm[:, None],
    ),
)
"""Plots over time: torque, measured and modelled, and residual."""


def record_page(whole_record: WholeRecord) -> ChartPage:
    """Return the charts that compare the displayed model's response with the measured one.

    The measured response is the ratio of the whole record's transforms, without the model's delay.
    """
    from analysis.report._record_figures import measured_response

    measured_with_delay, shown_model = (
        measured_response(whole_record),
        ShownModel.from_headline(whole_record.headline, whole_record.record),
    )
    grid_hz = measured_with_delay.frequency_hz
    delay_phasor = np.exp(2j * np.pi * shown_model.delay_s * grid_hz)
    measured_frf, model_response = (
        measured_with_delay.response * delay_phasor,
        shown_model.band(grid_hz).response,
    )
    band_hz = float(grid_hz[0]), float(grid_hz[-1])
    magnitude_axis = _axis_of_responses(measured_frf, [model_response])
    legend_entry, curve_name = (
        LegendEntry(shown_model.name.removeprefix("the "), ORANGE, 2.0),
        "model",
    )
    short_legend_entry = replace(legend_entry, label="model")
    page_entity = f"{RECORD_ENTITY}/response"
    return ChartPage(
        "Response",
        (
            Graph(
                "Magnitude of torque over angle, whole record, "
                f"{shown_model.name.removeprefix('the ')}",
                response_chart(
                    f"{page_entity}/magnitude",
                    _WIDE_CHART_SIZE,
                    band_hz,
                    magnitude_axis,
                    MEASURED_ENTRY,
                    legend_entry,
                ),
                (
                    ChartCurve("measured", MEASURED_ENTRY, magnitude_db(measured_frf)),
                    ChartCurve(curve_name, legend_entry, magnitude_db(model_response)),
                ),
            ),
            Graph(
                "Phase",
                response_chart(
                    f"{page_entity}/phase",
                    _NARROW_CHART_SIZE,
                    band_hz,
                    PHASE_AXIS,
                    MEASURED_ENTRY,
                    short_legend_entry,
                ),
                (
                    ChartCurve("measured", MEASURED_ENTRY, phase_deg(measured_frf), dotted=True),
                    ChartCurve(curve_name, legend_entry, phase_deg(model_response)),
                ),
            ),
            Graph(
                "Residual, measured − model",
                response_chart(
                    f"{page_entity}/residual",
                    _NARROW_CHART_SIZE,
                    band_hz,
                    magnitude_axis,
                    _MEASURED_MAGNITUDE_ENTRY,
                    short_legend_entry,
                ),
                (
                    ChartCurve("measured", _MEASURED_MAGNITUDE_ENTRY, magnitude_db(measured_frf)),
                    ChartCurve(
                        curve_name, legend_entry, magnitude_db(measured_frf - model_response)
                    ),
                ),
            ),
        ),
        grid_hz,
        band_hz,
    )


def draw_record(
    whole_record: WholeRecord, torque: TorqueInBand, tables_markdown: str, stream: RecordingStream
) -> None:
    """Send the results of the whole record to Rerun: verdict, response, and torque over time.

    `torque` is the measured torque and that of the displayed model. The tables are plain text.
    """
    verdict_sentences = [
        *(f"**{sentence}**" for sentence in damping_sentences(whole_record.headline)),
        *whole_record.verdict.sentences,
        *(f"* {advice}" for advice in whole_record.verdict.experiments),
    ]
    _draw_text(
        VERDICT_ENTITY, "\n\n".join((*verdict_sentences, f"```\n{tables_markdown}\n```")), stream
    )
    _draw_page(record_page(whole_record), stream)
    t_ns = np.round(1e9 * whole_record.record.time_s).astype(np.int64)
    for time_plot in _PLOTS_OVER_TIME:
        send_columns(
            stream, time_plot.entity, t_ns, {_SCALARS_COMPONENT: time_plot.compute_values(torque)}
        )


def record_tab(whole_record: WholeRecord, torque: TorqueInBand) -> rrb.Container:
    """Return the tab of the whole record, which contains tabs for verdict, response and torque."""
    import rerun.blueprint as rrb

    session_end_s = float(whole_record.record.time_s[-1])
    return rrb.Tabs(
        rrb.TextDocumentView(name=VERDICT_TITLE, origin=VERDICT_ENTITY),
        _page_view(record_page(whole_record)),
        rrb.Vertical(
            *(
                _time_plot_view(
                    time_plot, session_end_s, float(np.abs(time_plot.compute_values(torque)).max())
                )
                for time_plot in _PLOTS_OVER_TIME
            ),
            name=TORQUE_TITLE,
        ),
        name=RECORD_TITLE,
    )


def _time_plot_view(
    time_plot: PlotOverTime, session_end_s: float, largest_value: float
) -> rrb.TimeSeriesView:
    """Return the view of a plot that always shows the whole session, at any current time."""
    import rerun as rr
    import rerun.blueprint as rrb

    start_boundary = rrb.TimeRangeBoundary.absolute(seconds=0.0)
    end_boundary = rrb.TimeRangeBoundary.absolute(seconds=session_end_s)
    series_style = rr.SeriesLines(
        names=time_plot.curve_names,
        colors=time_plot.curve_colors,
        widths=time_plot.curve_widths,
        # The default averages the values of a pixel, which understates peaks.
        aggregation_policy="MinMax",
    )
    return rrb.TimeSeriesView(
        name=time_plot.title,
        origin=time_plot.entity,
        overrides={time_plot.entity: series_style},
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=len(time_plot.curve_names) > 1),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start_boundary, end=end_boundary)),
        axis_y=rrb.ScalarAxis(range=_labelled_axis_range(largest_value)),
        time_ranges=rrb.VisibleTimeRange(TIMELINE, start=start_boundary, end=end_boundary),
    )


def _labelled_axis_range(largest_value: float) -> tuple[float, float]:
    """Return the ends of an axis, symmetric about 0, on which Rerun shows labels other than 0.

    Rerun only labels the multiples of a power of ten if all of them have room.
    """
    label_step = 10.0 ** np.floor(np.log10(max(largest_value, 1e-12)))
    axis_end = (
        1.1 * largest_value
        if largest_value < _MAX_LABELS_PER_SIDE * label_step
        else 11.0 * label_step
    )
    return -axis_end, axis_end


# File


def check_rerun_file(path: Path) -> None:
    """Raise OutputExistsError if a path exists or does not have the suffix of a Rerun file."""
    try:
        check_new_rrd_file(path)
    except RrdFileError as error:
        raise OutputExistsError(f"--rerun {error}") from None


def write_rerun_file(result: RecordResult, path: Path) -> None:
    """Write a Rerun file of the session in the layout of the live view, preceded by its results.

    Parameters
    ----------
    result : RecordResult
        Results of the session's record.
    path : Path
        New file, with the suffix ``.rrd``.

    Raises
    ------
    OutputError
        If the file cannot be written, or was created meanwhile.
    rigd.session.SessionError
        If the session file can no longer be read.
    """
    from rigd.view import draw_session

    whole_record, welch_analysis, result_tabs = result.whole, result.welch, []
    if whole_record is not None:
        from analysis.report._signal_figures import torque_in_band

        torque = torque_in_band(
            whole_record.record,
            ShownModel.from_headline(whole_record.headline, whole_record.record).transfer_function,
            whole_record.band_hz[1],
        )
        result_tabs.append(record_tab(whole_record, torque))
    if welch_analysis is not None:
        result_tabs.append(welch_fits_tab(welch_analysis))
    recorded_session = read_session(result.record.path)
    tick_timings = read_timings(result.record.path)
    try:
        with new_rrd_file(path) as stream:
            draw_session(stream, recorded_session, tick_timings, front_tabs=result_tabs)
            if whole_record is not None:
                draw_record(whole_record, torque, as_text(record_tables(whole_record)), stream)
            if welch_analysis is not None:
                draw_welch_fits(welch_analysis, as_text(analysis_tables(result)), stream)
    except RrdFileError as error:
        raise OutputError(str(error)) from None
