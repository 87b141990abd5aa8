"""The one layout of Rerun's window: which views there are, and how each curve is drawn.

Rerun's plots have no axis titles: the unit stands in the title of the view and in the legend.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rigd.view import antenna, plots
from rigd.view.log import EVENTS
from rigd.view.plots import TIMELINE, Plot, Source
from rigd.view.response_charts import COHERENCE, MAGNITUDE, OVERVIEW_MAGNITUDE, PHASE, SIZES
from rigd.view.spectrogram_chart import SIZE as SPECTROGRAM_SIZE
from rigd.view.spectrogram_chart import SPECTROGRAM
from rigd.view.summary import SUMMARY

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import VisualizerComponentMapping
    from rerun.datatypes import EntityPath

WINDOW_S = 10.0
"""Time shown up to the cursor; a viewer's load grows with it, not with the session."""

CLOSE_UP_S = 2.0
"""Time shown of the signals where they are all that is shown: one sees the oscillations."""

HISTORY_S = 60.0
"""Time shown of what comes a few times a second only."""


@dataclass(frozen=True, slots=True)
class TimeView:
    """A plot over time in one of the tabs.

    Attributes
    ----------
    source, plot
        What it shows.
    window_s
        Time shown up to the cursor.
    height
        Of what its axes enclose, in points, in a window of 1280 × 800.
    """

    source: Source
    plot: Plot
    window_s: float
    height: float

    @property
    def ticks(self) -> str:
        """What Rerun calls the values that stand beside the axis and are to be in the picture."""
        return f"{self.plot.component}_ticks_{self.window_s:g}_s"


_THREE_ROWS: Final = 189.0
_FOUR_ROWS: Final = 131.0
"""Heights of the plots of a tab."""

OVERVIEW: Final = tuple(
    TimeView(plots.SIGNALS, plot, WINDOW_S, _THREE_ROWS)
    for plot in (plots.ANGLE, plots.COUPLING_TORQUE, plots.TRACKING_ERROR)
)
SIGNALS: Final = tuple(
    TimeView(plots.SIGNALS, plot, CLOSE_UP_S, _THREE_ROWS)
    for plot in (
        plots.ANGLE,
        plots.TRACKING_ERROR,
        plots.COUPLING_TORQUE,
        plots.TORQUE_COMMAND,
        plots.FORCES,
        plots.TORQUES,
    )
)
HEALTH: Final = (
    TimeView(plots.SIGNALS, plots.LOOP, WINDOW_S, _FOUR_ROWS),
    TimeView(plots.READINGS, plots.AGES, WINDOW_S, _FOUR_ROWS),
    *(TimeView(plots.HEALTH, plot, HISTORY_S, _FOUR_ROWS) for plot in plots.HEALTH.plots),
)
TIME_VIEWS: Final = (*OVERVIEW, *SIGNALS, *HEALTH)

TABS = ("Overview", "Signals", "Frequency response", "Spectrogram", "Health", "Events")


def blueprint(active_tab: str = TABS[0]) -> "rrb.Blueprint":
    """Return the layout, which follows the newest sample, with one of its tabs in front."""
    import rerun.blueprint as rrb

    contents = (
        _overview(),
        _signals(),
        _frequency_response(),
        _spectrogram(),
        _health(),
        _events(),
    )
    for tab, name in zip(contents, TABS, strict=True):
        tab.name = name
    return rrb.Blueprint(
        rrb.Tabs(*contents, active_tab=TABS.index(active_tab)),
        rrb.TimePanel(timeline=TIMELINE, play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _overview() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Horizontal(
        rrb.Vertical(*map(_plot, OVERVIEW)),
        rrb.Vertical(
            _chart(
                "Frequency response, torque over angle",
                OVERVIEW_MAGNITUDE,
                SIZES[OVERVIEW_MAGNITUDE],
            ),
            rrb.Horizontal(
                antenna.view(),
                _log(),
            ),
        ),
        column_shares=[6, 7],
    )


def _signals() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Grid(*map(_plot, SIGNALS), grid_columns=2)


def _frequency_response() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Vertical(
        _chart("Magnitude of torque over angle", MAGNITUDE, SIZES[MAGNITUDE]),
        rrb.Horizontal(
            _chart("Phase of torque over angle", PHASE, SIZES[PHASE]),
            _chart("Coherence of angle and torque", COHERENCE, SIZES[COHERENCE]),
        ),
        row_shares=[4, 3],
    )


def _spectrogram() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Vertical(_chart("Spectrogram of the coupling torque", SPECTROGRAM, SPECTROGRAM_SIZE))


def _health() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Horizontal(
        rrb.Grid(*map(_plot, HEALTH), grid_columns=2),
        _summary(),
        column_shares=[7, 2],
    )


def _events() -> "rrb.Container":
    import rerun.blueprint as rrb

    return rrb.Vertical(_log())


def _plot(view: TimeView) -> "rrb.TimeSeriesView":
    import rerun as rr
    import rerun.blueprint as rrb

    plot = view.plot
    lines = rr.SeriesLines(
        names=[curve.label for curve in plot.curves],
        colors=[curve.color for curve in plot.curves],
        widths=[curve.width for curve in plot.curves],
        # The default averages what falls on one pixel, and so understates peaks.
        aggregation_policy="MinMax",
    )
    # Not seen, but within the axis. The legend has one entry for all that is called the same.
    ticks = rr.SeriesPoints(
        names=[plot.curves[0].label], colors=[plot.curves[0].color], marker_sizes=[0.0]
    )
    visualizers: dict[EntityPath | str, rrb.Visualizer] = {
        view.source.entity: lines.visualizer(mappings=[_values(plot.component)])
    }
    if plot.span is None:
        visualizers[view.source.ticks] = ticks.visualizer(mappings=[_values(view.ticks)])
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-view.window_s)
    end = rrb.TimeRangeBoundary.cursor_relative()
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=view.source.entity,
        contents=[str(entity) for entity in visualizers],
        overrides=visualizers,
        # The title says it all where there is but one curve.
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=len(plot.curves) > 1),
        # Left to itself it shows a minute round the cursor, half of it yet to come.
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=None if plot.span is None else rrb.ScalarAxis(range=plot.span),
        time_ranges=rrb.VisibleTimeRange(TIMELINE, start=start, end=end),
    )


def _values(component: str) -> "VisualizerComponentMapping":
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    return VisualizerComponentMapping(
        "Scalars:scalars", ComponentSourceKind.SourceComponent, source_component=component
    )


def _chart(name: str, entity: str, size: tuple[float, float]) -> "rrb.Spatial2DView":
    import rerun.blueprint as rrb

    width, height = size
    return rrb.Spatial2DView(
        name=name,
        origin=entity,
        visual_bounds=rrb.VisualBounds2D(x_range=[0.0, width], y_range=[0.0, height]),
    )


def _summary() -> "rrb.TextDocumentView":
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(name="State", origin=SUMMARY)


def _log() -> "rrb.TextLogView":
    import rerun.blueprint as rrb

    return rrb.TextLogView(
        name="Events",
        origin=EVENTS,
        columns=rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"]
        ),
    )
