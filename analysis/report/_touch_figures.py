"""Figures of touches: a map of all contact points from above, and the evidence of each touch."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.report import _style as style
from analysis.report._style import Illustration
from analysis.statistics import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.touch import SessionTouches, Touch
    from rigd.touch import TouchEstimate

_SHOWN_BEFORE_TOUCH_MS: Final = 25.0
"""Time that is shown before a touch, in milliseconds."""
_SHOWN_AFTER_TOUCH_MS: Final = 100.0
"""Time that is shown after a touch, in milliseconds."""
_MIN_LOG_LIKELIHOOD_RANGE: Final = 40.0
"""Least range of the log-likelihood's axis."""
_LINEAR_RANGE_STD: Final = 5.0
"""Number of standard deviations up to which the axis of innovations is linear, not logarithmic."""
_MAX_DETAIL_FRACTION: Final = 0.25
"""Largest extent of all contact points, relative to the antenna, for which a detail is drawn."""
_SESSION_COLORS: Final = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE)
"""Colours of the sessions in the map."""


def touch_illustrations(sessions: Sequence[SessionTouches]) -> Iterator[Illustration]:
    """Yield a map of all contacts and a figure of each touch."""
    if any(touch.contact_point_m is not None for session in sessions for touch in session.touches):
        yield Illustration(
            "map",
            partial(contact_map_figure, sessions),
            "Points of contact as seen from above, with their 95 % intervals (hollow: kind of "
            "contact not identifiable); the antenna (grey) as it was bent at each touch, from the "
            "motor's axis (black). The angle is zero along x.",
        )
    touch_number = 0
    for session in sessions:
        for touch in session.touches:
            if touch.estimate is None:
                continue
            touch_number += 1
            yield Illustration(
                f"touch_{touch_number}",
                partial(touch_figure, touch, touch.estimate),
                f"Touch {touch.number} of {session.path.name}: log-likelihood of each point "
                "whatever the force, with the estimate and its 95 % interval; innovations of "
                "torque and base shear, linear up to 5 standard deviations; contact force of the "
                "best fit.",
            )


def touch_figure(touch: Touch, estimate: TouchEstimate) -> Figure:
    """Draw the likelihood of the contact point, and innovations and contact force of a touch."""
    channel_count = estimate.channels
    figure = style.new_figure(9.0, 4.6)
    grid = figure.add_gridspec(1, 2, left=0.075, right=0.985, top=0.94, bottom=0.1, wspace=0.2)
    left_grid = grid[0].subgridspec(2, 1, hspace=0.42)
    right_grid = grid[1].subgridspec(channel_count, 1, hspace=0.28)
    _draw_likelihood(figure.add_subplot(left_grid[0]), estimate)
    touch_time_s = touch.detection_time_s if estimate.time_s is None else estimate.time_s.value
    _draw_force(figure.add_subplot(left_grid[1]), estimate, touch_time_s)
    for row, channel_name in zip(range(channel_count), ("Torque", "Base shear"), strict=False):
        panel_axes = figure.add_subplot(right_grid[row])
        _draw_innovations(panel_axes, estimate, row, channel_name, touch_time_s)
        if row == channel_count - 1:
            panel_axes.set_xlabel("Time from the touch (ms)", labelpad=1)
    return figure


def _draw_likelihood(axes: Axes, estimate: TouchEstimate) -> None:
    """Draw the relative log-likelihood of the contact point along the beam."""
    relative_log_likelihood = estimate.log_likelihood - estimate.log_likelihood.max()
    axes.plot(estimate.positions_m, relative_log_likelihood, color=style.BLUE)
    if estimate.x_m is not None:
        lower_m, upper_m = estimate.x_m.interval_95
        axes.axvspan(lower_m, upper_m, color=style.SHADE_COLOR, linewidth=0, zorder=0)
        axes.axvline(estimate.x_m.value, color=style.VERMILION, linewidth=0.9)
    axes.set_xlim(0.0, float(estimate.positions_m[-1]))
    axes.set_ylim(
        -max(_MIN_LOG_LIKELIHOOD_RANGE, float(np.quantile(-relative_log_likelihood, 0.75))), 2.0
    )
    axes.set_title("Point of contact")
    axes.set_ylabel("Relative log-likelihood")
    axes.set_xlabel("Distance from the axis (m)", labelpad=1)


def _draw_force(axes: Axes, estimate: TouchEstimate, touch_time_s: float) -> None:
    """Draw the contact force over time."""
    times_ms = 1e3 * (estimate.force_times_s - touch_time_s)
    axes.plot(times_ms, estimate.force_history_n, color=style.VERMILION)
    if not estimate.force_history_n.size:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=style.GREY)
    axes.set_xlim(-_SHOWN_BEFORE_TOUCH_MS, _SHOWN_AFTER_TOUCH_MS)
    axes.set_ylim(bottom=0.0)
    axes.set_title("Contact force")
    axes.set_ylabel("Magnitude (N)")
    axes.set_xlabel("Time from the touch (ms)", labelpad=1)


def _draw_innovations(
    axes: Axes, estimate: TouchEstimate, channel_row: int, channel_name: str, touch_time_s: float
) -> None:
    """Draw one channel's deviations from the prediction (innovations), in standard deviations."""
    times_ms = 1e3 * (estimate.innovation_times_s - touch_time_s)
    axes.axhspan(-NORMAL_95, NORMAL_95, color=style.SHADE_COLOR, linewidth=0, zorder=0)
    axes.axvline(0.0, color=style.GREY, linewidth=0.8)
    axes.plot(
        times_ms,
        estimate.innovations[channel_row],
        ".-",
        color=style.BLUE,
        linewidth=0.7,
        markersize=2.5,
    )
    axes.set_yscale("symlog", linthresh=_LINEAR_RANGE_STD)
    axis_limit = max(
        2 * _LINEAR_RANGE_STD, 1.2 * float(np.abs(estimate.innovations[channel_row]).max())
    )
    axes.set_ylim(-axis_limit, axis_limit)
    axes.yaxis.set_major_formatter(lambda value, _position: f"{value:g}".replace("-", "−"))
    axes.set_xlim(-_SHOWN_BEFORE_TOUCH_MS, _SHOWN_AFTER_TOUCH_MS)
    axes.set_title(f"{channel_name}: innovations")
    axes.set_ylabel("Standard deviations")


# Map


def contact_map_figure(session_touches: Sequence[SessionTouches]) -> Figure:
    """Draw the points of contact of all sessions as seen from above.

    Each session has at least one contact point.
    """
    contact_points_m = np.array(
        [
            t.contact_point_m
            for session in session_touches
            for t in session.touches
            if t.contact_point_m is not None
        ]
    )
    length_m = max(session.model.plant.beam.length_m for session in session_touches)
    contact_spread_m = float(np.ptp(contact_points_m, axis=0).max())
    has_detail = contact_spread_m < _MAX_DETAIL_FRACTION * length_m
    figure = style.new_figure(9.0, 4.6)
    grid = figure.add_gridspec(
        1, 1 + has_detail, left=0.075, right=0.97, top=0.93, bottom=0.1, wspace=0.22
    )
    overview_axes = figure.add_subplot(grid[0])
    _draw_contact_map(overview_axes, session_touches, with_numbers=not has_detail)
    overview_axes.plot(0.0, 0.0, "o", color=style.INK, markersize=7)
    overview_axes.set_aspect("equal", adjustable="datalim")
    overview_axes.set_title("Seen from above")
    if has_detail:
        detail_axes = figure.add_subplot(grid[1])
        _draw_contact_map(detail_axes, session_touches, with_numbers=True)
        interval_ends_m = np.concatenate(
            [
                t.interval_ends_m
                for session in session_touches
                for t in session.touches
                if t.interval_ends_m is not None
            ]
        )
        map_centre_m = (interval_ends_m.min(axis=0) + interval_ends_m.max(axis=0)) / 2
        half_width_m = 0.75 * max(float(np.ptp(interval_ends_m, axis=0).max()), 0.005 * length_m)
        detail_axes.set_xlim(map_centre_m[0] - half_width_m, map_centre_m[0] + half_width_m)
        detail_axes.set_ylim(map_centre_m[1] - half_width_m, map_centre_m[1] + half_width_m)
        detail_axes.set_aspect("equal", adjustable="box")
        detail_axes.set_title("Detail: points and 95 % intervals")
        overview_axes.indicate_inset_zoom(detail_axes, edgecolor=style.GREY)
    for axes in figure.axes:
        axes.set_xlabel("x (m)", labelpad=1)
    overview_axes.set_ylabel("y (m)")
    if len(session_touches) > 1:
        overview_axes.legend(loc="upper left", fontsize=7.5)
    return figure


def _draw_contact_map(
    axes: Axes, sessions: Sequence[SessionTouches], *, with_numbers: bool
) -> None:
    """Draw the contact points of sessions with their intervals, and the bent antenna."""
    for session_number, session in enumerate(sessions):
        session_color = _SESSION_COLORS[session_number % len(_SESSION_COLORS)]
        session_label: str | None = session.path.stem
        for touch in session.touches:
            if touch.antenna_points_m is not None:
                axes.plot(
                    *touch.antenna_points_m.T, color=style.LIGHT_GREY, linewidth=1.0, zorder=1
                )
            if touch.contact_point_m is None or touch.interval_ends_m is None:
                continue
            axes.plot(
                *touch.interval_ends_m.T, color=session_color, linewidth=2.4, alpha=0.5, zorder=2
            )
            kind_is_known = touch.estimate is not None and touch.estimate.kind != "unknown"
            axes.plot(
                *touch.contact_point_m, "o", color=session_color, markersize=4, zorder=3,
                label=session_label,
                markerfacecolor=session_color if kind_is_known else "white",
            )  # fmt: skip
            session_label = None
            if with_numbers:
                axes.annotate(
                    str(touch.number), tuple(touch.contact_point_m), xytext=(5, 4),
                    textcoords="offset points", fontsize=7.5, color=session_color, clip_on=True,
                )  # fmt: skip
