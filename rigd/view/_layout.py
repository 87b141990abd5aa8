"""Layout of Rerun's window: its views, the style of each curve, and axis labels.

Rerun's plots have no axis titles: the title of the view and the legend state the unit.

Rerun fits an axis to its values, and labels multiples of a power of ten that are far enough apart.
So ±0.06 would have a single label, 0. In such a case `AxisTickPoints` adds the next multiple to the
values as an invisible point, which extends the axis a little. The point has the time of an extreme
value and leaves the plot with it. Invisible points also extend an axis to the minimum length of its
plot.
"""

import collections
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.view import _antenna as antenna
from rigd.view import banner, plots
from rigd.view._fits import FIT_TABLE_ENTITY, fit_source
from rigd.view._session_info import EVENTS_ENTITY, RECENT_EVENTS_ENTITY, SUMMARY_ENTITY
from rigd.view.frequency_charts import (
    CHART_SIZES,
    COHERENCE_ENTITY,
    MAGNITUDE_ENTITY,
    OVERVIEW_MAGNITUDE_ENTITY,
    PHASE_ENTITY,
    SPECTROGRAM_CANVAS_SIZE,
    SPECTROGRAM_ENTITY,
)
from rigd.view.plots import TIMELINE, Drawing, Plot, PlotSource, Values, send_columns

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import VisualizerComponentMapping
    from rerun.datatypes import EntityPath


PLOT_WINDOW_S = 10.0
"""Time range before the cursor that most plots show, in seconds.

The viewer's load grows with this range, not with the length of the session."""

CLOSE_UP_WINDOW_S = 2.0
"""Time range before the cursor in the tab Signals: short enough to resolve the oscillations."""

HISTORY_WINDOW_S = 60.0
"""Time range before the cursor that plots of slow values show: a few values arrive per second."""

WHOLE_SESSION_WINDOW_S = 86_400.0
"""Time range of plots that show the whole session: longer than any session.

Their values arrive at most once per second."""


@dataclass(frozen=True, slots=True)
class TimeView:
    """View of a plot over time in a tab of the window: its time range and height.

    Attributes
    ----------
    source, plot
        Source of the plotted values, and the plot to show.
    window_s
        Time range before the cursor that the plot shows.
    height_pt
        Height of the vertical axis, in points, in a window of 1280 × 800.
    """

    source: PlotSource
    plot: Plot
    window_s: float
    height_pt: float

    @property
    def tick_component(self) -> str:
        """Component name in Rerun of the invisible points that extend the plot's vertical axis."""
        return f"{self.plot.component}_ticks_{self.window_s:g}_s"


_OVERVIEW_PLOT_HEIGHT_PT: Final = 228.0
"""Height of each plot in the tab Overview, in points."""
_THREE_ROW_PLOT_HEIGHT_PT: Final = 189.0
"""Height of each plot in a tab with three rows of plots, in points."""
_FOUR_ROW_PLOT_HEIGHT_PT: Final = 131.0
"""Height of each plot in a tab with four rows of plots, in points."""

OVERVIEW_VIEWS: Final = tuple(
    TimeView(plots.SIGNALS, plot, PLOT_WINDOW_S, _OVERVIEW_PLOT_HEIGHT_PT)
    for plot in (plots.ANGLE, plots.COUPLING_TORQUE)
)
"""Plots of the tab Overview."""
SIGNAL_VIEWS: Final = tuple(
    TimeView(plots.SIGNALS, plot, CLOSE_UP_WINDOW_S, _THREE_ROW_PLOT_HEIGHT_PT)
    for plot in (
        plots.ANGLE,
        plots.TRACKING_ERROR,
        plots.COUPLING_TORQUE,
        plots.TORQUE_COMMAND,
        plots.FORCES,
        plots.TORQUES,
    )
)
"""Plots of the tab Signals."""
HEALTH_VIEWS: Final = (
    TimeView(plots.SIGNALS, plots.LOOP, PLOT_WINDOW_S, _FOUR_ROW_PLOT_HEIGHT_PT),
    TimeView(plots.READINGS, plots.AGES, PLOT_WINDOW_S, _FOUR_ROW_PLOT_HEIGHT_PT),
    *(
        TimeView(plots.HEALTH, plot, HISTORY_WINDOW_S, _FOUR_ROW_PLOT_HEIGHT_PT)
        for plot in plots.HEALTH.plots
    ),
)
"""Plots of the tab Health."""
_MIN_PLOTS_FOR_TWO_COLUMNS: Final = 4
"""Least number of plots in the tab Health for which they are arranged in two columns."""
TIME_VIEWS: Final = (*OVERVIEW_VIEWS, *SIGNAL_VIEWS, *HEALTH_VIEWS)
"""All plots over time of the window, without those of the tab Fit."""

TAB_TITLES = ("Overview", "Signals", "Frequency response", "Spectrogram", "Health", "Events")
"""Titles of the tabs that every session has, in the window's order."""
FIT_TAB_TITLE = "Fit"
"""Title of the second tab, which exists if the session's record is fitted."""
_FIT_TAB_HEIGHT_PT: Final = 640.0
"""Total height of the plots in the tab Fit, in points."""
_FIT_PLOT_MARGIN_PT: Final = 50.0
"""Height that each plot of the tab Fit needs outside its axes, in points."""


def fit_views(fit_plots: PlotSource) -> tuple[TimeView, ...]:
    """Return the plots of the tab Fit, two for each mode; their height depends on the number."""
    row_count = max(1, len(fit_plots.plots) // 2)
    plot_height_pt = _FIT_TAB_HEIGHT_PT / row_count - _FIT_PLOT_MARGIN_PT
    return tuple(
        TimeView(fit_plots, plot, WHOLE_SESSION_WINDOW_S, plot_height_pt)
        for plot in fit_plots.plots
    )


def blueprint(
    *,
    absent_components: Collection[str] = (),
    fitted_mode_count: int | None = None,
    with_target_std: bool = False,
) -> "rrb.Blueprint":
    """Return the layout of the live window, which follows the newest sample.

    Plots of `absent_components` are omitted, because the session has no values for them.
    `fitted_mode_count` is the number of modes whose fits are plotted over time: with 0, the tab Fit
    has only a table of the last fit; with None, there is no such tab. `with_target_std` adds the
    limits of a requested precision to these plots.
    """
    import rerun.blueprint as rrb

    tab_contents = [
        _overview_tab(),
        _signals_tab(),
        _frequency_response_tab(),
        _spectrogram_tab(),
        _health_tab(absent_components),
        _events_tab(),
    ]
    tab_names = list(TAB_TITLES)
    if fitted_mode_count is not None:
        tab_contents.insert(1, _fit_tab(fitted_mode_count, with_target_std=with_target_std))
        tab_names.insert(1, FIT_TAB_TITLE)
    for tab, name in zip(tab_contents, tab_names, strict=True):
        tab.name = name
    return rrb.Blueprint(
        rrb.Tabs(*tab_contents, active_tab=0),
        rrb.TimePanel(timeline=TIMELINE, play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _overview_tab() -> "rrb.Container":
    """Return the contents of the tab Overview: state, gauges, antenna, plots and response."""
    import rerun.blueprint as rrb

    state_view, gauges_view = banner.state_and_gauge_views()
    return rrb.Vertical(
        rrb.Horizontal(state_view, gauges_view, column_shares=[6, 7]),
        rrb.Horizontal(
            rrb.Vertical(*map(_time_series_view, OVERVIEW_VIEWS)),
            rrb.Vertical(
                chart_view(
                    "Frequency response: magnitude of torque over angle",
                    OVERVIEW_MAGNITUDE_ENTITY,
                    CHART_SIZES[OVERVIEW_MAGNITUDE_ENTITY],
                ),
                rrb.Horizontal(antenna.view(), _recent_events()),
                row_shares=[6, 5],
            ),
            column_shares=[6, 7],
        ),
        row_shares=[2, 7],
    )


def _signals_tab() -> "rrb.Container":
    """Return the contents of the tab Signals: plots of the samples of the last 2 s."""
    import rerun.blueprint as rrb

    return rrb.Grid(*map(_time_series_view, SIGNAL_VIEWS), grid_columns=2)


def _frequency_response_tab() -> "rrb.Container":
    """Return the contents of the tab with magnitude, phase and coherence."""
    return chart_page(
        chart_view(
            "Magnitude of torque over angle", MAGNITUDE_ENTITY, CHART_SIZES[MAGNITUDE_ENTITY]
        ),
        chart_view("Phase of torque over angle", PHASE_ENTITY, CHART_SIZES[PHASE_ENTITY]),
        chart_view(
            "Coherence of angle and torque", COHERENCE_ENTITY, CHART_SIZES[COHERENCE_ENTITY]
        ),
    )


def _spectrogram_tab() -> "rrb.Container":
    """Return the contents of the tab with the spectrogram."""
    import rerun.blueprint as rrb

    return rrb.Vertical(
        chart_view(
            "Spectrogram of the coupling torque", SPECTROGRAM_ENTITY, SPECTROGRAM_CANVAS_SIZE
        )
    )


def _health_tab(absent_components: Collection[str]) -> "rrb.Container":
    """Return the contents of the tab Health: plots of loop, bus and recorder, and a summary."""
    import rerun.blueprint as rrb

    shown_views = [
        time_view for time_view in HEALTH_VIEWS if time_view.plot.component not in absent_components
    ]
    return rrb.Horizontal(
        rrb.Grid(
            *map(_time_series_view, shown_views),
            grid_columns=1 if len(shown_views) < _MIN_PLOTS_FOR_TWO_COLUMNS else 2,
        ),
        _summary(),
        column_shares=[7, 2],
    )


def _fit_tab(mode_count: int, *, with_target_std: bool) -> "rrb.Container":
    """Return the contents of the tab Fit: modes over time, and the table of the last fit."""
    import rerun.blueprint as rrb

    table_view = rrb.TextDocumentView(name="Fit of the record", origin=FIT_TABLE_ENTITY)
    if mode_count == 0:
        return rrb.Vertical(table_view)
    return rrb.Horizontal(
        rrb.Grid(
            *map(
                _time_series_view,
                fit_views(fit_source(mode_count, with_target_std=with_target_std)),
            ),
            grid_columns=2,
        ),
        table_view,
        column_shares=[7, 4],
    )


def _events_tab() -> "rrb.Container":
    """Return the contents of the tab Events: the log of the session."""
    import rerun.blueprint as rrb

    return rrb.Vertical(_log())


def _time_series_view(time_view: TimeView) -> "rrb.TimeSeriesView":
    """Return Rerun's view of a plot over time, with the style of each curve."""
    import rerun as rr
    import rerun.blueprint as rrb

    plot = time_view.plot
    line_style = rr.SeriesLines(
        names=[curve.label for curve in plot.curves],
        colors=[curve.color for curve in plot.curves],
        widths=[curve.width for curve in plot.curves],
        # The default averages the values of a pixel, which understates peaks.
        aggregation_policy="MinMax",
    )
    # The points are invisible, but extend the axis. Curves with the same name have one entry in the
    # legend.
    tick_style = rr.SeriesPoints(
        names=[plot.curves[0].label], colors=[plot.curves[0].color], marker_sizes=[0.0]
    )
    visualizers: dict[EntityPath | str, rrb.Visualizer] = {
        time_view.source.entity: line_style.visualizer(mappings=[_values_mapping(plot.component)])
    }
    if plot.fixed_axis_range is None:
        visualizers[time_view.source.tick_entity] = tick_style.visualizer(
            mappings=[_values_mapping(time_view.tick_component)]
        )
    start_boundary = (
        rrb.TimeRangeBoundary.absolute(seconds=0.0)
        if time_view.window_s == WHOLE_SESSION_WINDOW_S
        else rrb.TimeRangeBoundary.cursor_relative(seconds=-time_view.window_s)
    )
    end_boundary = rrb.TimeRangeBoundary.cursor_relative()
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=time_view.source.entity,
        contents=[str(entity_path) for entity_path in visualizers],
        overrides=visualizers,
        # A single curve needs no legend. Intervals of fits are wide at first.
        plot_legend=rrb.PlotLegend(
            corner="RightTop" if time_view.window_s == WHOLE_SESSION_WINDOW_S else "LeftTop",
            visible=len(plot.curves) > 1,
        ),
        # The default is a minute around the cursor, half of it in the future.
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start_boundary, end=end_boundary)),
        axis_y=None
        if plot.fixed_axis_range is None
        else rrb.ScalarAxis(range=plot.fixed_axis_range),
        time_ranges=rrb.VisibleTimeRange(TIMELINE, start=start_boundary, end=end_boundary),
    )


def _values_mapping(component_name: str) -> "VisualizerComponentMapping":
    """Return the mapping that makes Rerun plot the values of a component."""
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    return VisualizerComponentMapping(
        "Scalars:scalars", ComponentSourceKind.SourceComponent, source_component=component_name
    )


def chart_view(
    view_title: str, entity_path: str, chart_size: tuple[float, float]
) -> "rrb.Spatial2DView":
    """Return Rerun's view of a chart whose horizontal axis is not time.

    Parameters
    ----------
    view_title
        Title of the view.
    entity_path
        Entity path of the chart.
    chart_size
        Width and height of its canvas, in points.
    """
    import rerun.blueprint as rrb

    width, height = chart_size
    return rrb.Spatial2DView(
        name=view_title,
        origin=entity_path,
        visual_bounds=rrb.VisualBounds2D(x_range=[0.0, width], y_range=[0.0, height]),
    )


def chart_page(
    wide_view: "rrb.Spatial2DView", *narrow_views: "rrb.Spatial2DView", tab_title: str | None = None
) -> "rrb.Vertical":
    """Return the contents of a tab: a wide chart above a row of narrow charts.

    Parameters
    ----------
    wide_view
        View at the top, with four sevenths of the height.
    *narrow_views
        Views below it, from left to right.
    tab_title
        Title of the tab; None: no title.
    """
    import rerun.blueprint as rrb

    return rrb.Vertical(wide_view, rrb.Horizontal(*narrow_views), row_shares=[4, 3], name=tab_title)


def _summary() -> "rrb.TextDocumentView":
    """Return the view of the session's summary."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(name="Health", origin=SUMMARY_ENTITY)


def _recent_events() -> "rrb.TextDocumentView":
    """Return the view of the newest events: a document, because a log does not wrap its lines."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(name="Events, newest first", origin=RECENT_EVENTS_ENTITY)


def _log() -> "rrb.TextLogView":
    """Return the view of the session's log."""
    import rerun.blueprint as rrb

    return rrb.TextLogView(
        name="Events",
        origin=EVENTS_ENTITY,
        columns=rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"]
        ),
    )


# Axis labels

MIN_LABEL_SPACING_PT: Final = 24.0
"""Least distance between axis labels, in points.

Rerun omits labels nearer than 20 points, and fades those at 21."""
AXIS_TO_RANGE_RATIO: Final = 1.1
"""Ratio of an axis's length to the range of the plotted values: Rerun leaves a margin at both ends.
"""

_EXTREMES_INTERVAL_NS: Final = 100_000_000
"""Length of the intervals, in nanoseconds, over which the extremes of the values are computed."""
_MAX_VALUE_TO_AXIS_RATIO: Final = 1e9
"""Ratio of the largest value to the least axis length above which that length is ignored."""
_MIN_LABEL_SPACING, _MAX_LABEL_SPACING = 1e-300, 1e300
"""Smallest and largest distance between axis labels, in the unit of the values, for which points
are added.

Outside these bounds Rerun alone chooses the axis."""
_CurvePoint = tuple[int, float]
"""Point of a curve: time since the start of the session in ns, and value."""


class AxisTickPoints:
    """Extreme values of a source's plots, and invisible points that give each axis two labels.

    Plots of other sources and plots with fixed axes are ignored.
    """

    def __init__(self, source: "PlotSource", views: "Sequence[TimeView]") -> None:
        self._entity = source.tick_entity
        self._axes = [
            _AxisExtremes(time_view)
            for time_view in views
            if time_view.source is source and time_view.plot.fixed_axis_range is None
        ]

    def initial_drawings(self) -> list[Drawing]:
        """Return the function that sends an empty first value of each axis's invisible points.

        Without any value Rerun reports an error.
        """
        empty_values = {axis.view.tick_component: np.array([[np.nan]]) for axis in self._axes}
        start_ns = np.array([0])
        return [partial(send_columns, entity=self._entity, t_ns=start_ns, columns=empty_values)]

    def tick_drawings(
        self, t_ns: npt.NDArray[np.int64], plot_values: Mapping[str, Values]
    ) -> list[Drawing]:
        """Return functions that send invisible points, which extend axes until each has two labels.

        `plot_values` has the values of each plot at the times `t_ns` (n,): component name → values
        (n, curves). Values that are not finite are ignored, as in Rerun.
        """
        interval_indices = (t_ns - t_ns[0]) // _EXTREMES_INTERVAL_NS
        interval_start_indices = np.append(0, np.flatnonzero(np.diff(interval_indices)) + 1)
        times_ns = t_ns[np.append(interval_start_indices[1:], len(t_ns)) - 1].tolist()
        least_values, greatest_values = (
            {
                component_name: extreme_function.reduceat(
                    component_values.ravel(), interval_start_indices * component_values.shape[1]
                ).tolist()
                for component_name, component_values in plot_values.items()
            }
            for extreme_function in (np.fmin, np.fmax)
        )
        drawings: list[Drawing] = []
        for axis_extremes in self._axes:
            component_name = axis_extremes.view.plot.component
            tick_points = [
                tick_point
                for interval_extremes in zip(
                    times_ns,
                    least_values[component_name],
                    greatest_values[component_name],
                    strict=True,
                )
                for tick_point in axis_extremes.add(*interval_extremes)
            ]
            if tick_points:
                drawings.append(
                    self._tick_points_drawing(axis_extremes.view.tick_component, tick_points)
                )
        return drawings

    def _tick_points_drawing(
        self, component_name: str, tick_points: Sequence[_CurvePoint]
    ) -> Drawing:
        """Return the function that sends the invisible points (time, value) of one axis."""
        times_ns, tick_values = zip(*tick_points, strict=True)
        point_columns = {component_name: np.array(tick_values)[:, None]}
        return partial(
            send_columns, entity=self._entity, t_ns=np.array(times_ns), columns=point_columns
        )


class _AxisExtremes:
    """Extremes of a plot in its time window, and the invisible points that were sent last."""

    def __init__(self, time_view: "TimeView") -> None:
        self.view = time_view
        self._window_ns = round(1e9 * time_view.window_s)
        self._greatest, self._least = (
            _RunningMaximum(self._window_ns),
            _RunningMaximum(self._window_ns),
        )
        self._below: _CurvePoint | None = None
        self._above: _CurvePoint | None = None

    def add(self, t_ns: int, least_value: float, greatest_value: float) -> list[_CurvePoint]:
        """Add the least and greatest value of a time interval, and return new invisible points.

        A point (time, value) extends the axis until it has two labels.
        """
        if not (math.isfinite(least_value) and math.isfinite(greatest_value)):
            return []
        high_ns, greatest_value = self._greatest.add(t_ns, greatest_value)
        low_ns, minus_low = self._least.add(t_ns, -least_value)
        value_below, value_above = missing_tick_values(
            -minus_low, greatest_value, self.view.height_pt, self.view.plot.min_span
        )
        # When either extreme leaves the window, the missing points are computed again.
        first_extreme_ns = min(low_ns, high_ns)
        new_tick_points = []
        if value_above is not None and self._must_send(self._above, value_above, t_ns):
            self._above = first_extreme_ns, value_above
            new_tick_points.append(self._above)
        if value_below is not None and self._must_send(self._below, value_below, t_ns):
            self._below = first_extreme_ns, value_below
            new_tick_points.append(self._below)
        return new_tick_points

    def _must_send(self, last_point: _CurvePoint | None, tick_value: float, t_ns: int) -> bool:
        """Return whether an invisible point is new, has changed or is leaving the window."""
        return (
            last_point is None
            or last_point[1] != tick_value
            or last_point[0] <= t_ns - self._window_ns + _EXTREMES_INTERVAL_NS
        )


class _RunningMaximum:
    """Running maximum of a signal over a time window."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        # Each value is greater than all later ones.
        self._marks: collections.deque[_CurvePoint] = collections.deque()

    def add(self, t_ns: int, newest_value: float) -> _CurvePoint:
        """Add the newest value; return time (ns) and value of the largest one in the window."""
        while self._marks and self._marks[-1][1] <= newest_value:
            self._marks.pop()
        self._marks.append((t_ns, newest_value))
        while self._marks[0][0] <= t_ns - self._window_ns:
            self._marks.popleft()
        return self._marks[0]


def missing_tick_values(
    lowest_value: float, highest_value: float, height_pt: float, min_span: float = 0.0
) -> tuple[float | None, float | None]:
    """Return the values to add to a plot so that its axis has two labels and spans `min_span`.

    They are the values to add below and above the plotted ones, None if none is needed on that
    side.
    """
    if (
        0.0 <= highest_value - lowest_value < min_span
        and max(-lowest_value, highest_value) < _MAX_VALUE_TO_AXIS_RATIO * min_span
    ):
        # The ends are multiples of a step, so that noise does not move the axis.
        tick_step = min_span / 2
        first_multiple, last_multiple = (
            math.floor(lowest_value / tick_step),
            math.ceil(highest_value / tick_step),
        )
        if last_multiple - first_multiple < 2:
            first_multiple, last_multiple = (
                (first_multiple - 1, last_multiple + 1)
                if first_multiple == last_multiple
                else (
                    (first_multiple - 1, last_multiple)
                    if lowest_value - first_multiple * tick_step
                    < last_multiple * tick_step - highest_value
                    else (first_multiple, last_multiple + 1)
                )
            )
        widened_axis_ends = first_multiple * tick_step, last_multiple * tick_step
        widened_axis_ticks = missing_tick_values(*widened_axis_ends, height_pt)
        value_below, value_above = (
            end if widened_axis_tick is None else widened_axis_tick
            for end, widened_axis_tick in zip(widened_axis_ends, widened_axis_ticks, strict=True)
        )
        return (
            value_below if value_below < lowest_value else None,
            value_above if value_above > highest_value else None,
        )
    label_spacing = (
        AXIS_TO_RANGE_RATIO * (highest_value - lowest_value) / height_pt * MIN_LABEL_SPACING_PT
    )
    # Rerun shows a single value with one unit on either side.
    if not _MIN_LABEL_SPACING < label_spacing < _MAX_LABEL_SPACING:
        return None, None
    tick_step = 10.0 ** math.ceil(math.log10(label_spacing))
    first_multiple, last_multiple = (
        math.ceil(lowest_value / tick_step),
        math.floor(highest_value / tick_step),
    )
    if last_multiple > first_multiple:
        return None, None
    value_below, value_above = (first_multiple - 1) * tick_step, (last_multiple + 1) * tick_step
    if last_multiple < first_multiple:
        return value_below, value_above
    # Prefer above: the point stays there while a signal oscillates, and makes room for the legend.
    return (
        (None, value_above)
        if value_above - highest_value <= 2.0 * (lowest_value - value_below)
        else (value_below, None)
    )
