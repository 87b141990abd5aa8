"""The one layout of Rerun's window: which views there are, and how each curve is drawn.

Rerun's plots have no axis titles: the unit stands in the title of the view and in the legend.
"""

from typing import TYPE_CHECKING

from rigd.view.samples import (
    ANGLE,
    COUPLING_TORQUE,
    LOOP_LATENESS,
    TIMELINE,
    TORQUE_COMMAND,
    TRACKING_ERROR,
    Plot,
)

if TYPE_CHECKING:
    import rerun.blueprint as rrb

APPLICATION_ID = "rigd"
"""Rerun keeps one layout for each application."""

WINDOW_S = 10.0
"""Time shown up to the cursor; a viewer's load grows with it, not with the session."""


def blueprint() -> "rrb.Blueprint":
    """Return the layout, which follows the newest sample."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(_view(ANGLE), _view(COUPLING_TORQUE)),
            rrb.Horizontal(_view(TRACKING_ERROR), _view(TORQUE_COMMAND)),
            _view(LOOP_LATENESS),
            row_shares=[3, 3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _view(plot: Plot) -> "rrb.TimeSeriesView":
    import rerun as rr
    import rerun.blueprint as rrb

    lines = rr.SeriesLines(
        names=[curve.label for curve in plot.curves],
        colors=[curve.color for curve in plot.curves],
        widths=[curve.width for curve in plot.curves],
        # The default averages what falls on one pixel, and so understates peaks.
        aggregation_policy="MinMax",
    )
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=plot.entity,
        overrides={plot.entity: lines},
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=True),
        time_ranges=rrb.VisibleTimeRange(
            TIMELINE,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        ),
    )
