"""Charts whose horizontal axis is not time, drawn on a canvas.

Rerun plots over time only, but its two-dimensional view shows a canvas of any size with a fixed
aspect ratio. The canvas of a chart has the size in points that its view has in a window of
1280 × 800, and is scaled with the view. The size of text does not change with the scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rigd.view.plots import GREY, Color

if TYPE_CHECKING:
    from rerun import RecordingStream

RealArray = npt.NDArray[np.float64]
"""Array of real numbers."""


# Chart

_LEFT_MARGIN_PT, _TOP_MARGIN_PT, _BOTTOM_MARGIN_PT = 62.0, 44.0, 54.0
"""Margins for tick labels and titles left of, above and below the frame, in points."""
_RIGHT_MARGIN_PT = 24.0
"""Margin on the right of the frame, in points."""
_TITLE_DISTANCE_PT = 27.0
"""Distance of the middle of titles and legend above the frame, in points."""

LABEL_DROP_PT = 12.0
"""Distance by which Rerun draws the middle of a label below its position, in points."""
_MEAN_CHARACTER_WIDTH_PT = 6.7
"""Mean width of a character in a label, in points."""
_GRID_DOT_SPACING_PT = 6.0
"""Distance between the dots of a grid line, in points."""
_CURVE_DOT_RADIUS_PT = 1.0
"""Radius of the dots of a dotted curve, in points."""
_SHADE_OPACITY = 0.18
"""Opacity of shaded areas, from 0 to 1."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Axis of a chart: its title, range, ticks and grid lines.

    Attributes
    ----------
    title
        Title with its unit.
    start_value, end_value
        Values at the lower (or left) end and at the upper (or right) end.
    ticks
        Values with a tick label and a grid line.
    grid_lines
        Values with a grid line but without a tick label.
    is_logarithmic
        Whether the axis is logarithmic.
    """

    title: str
    start_value: float
    end_value: float
    ticks: tuple[float, ...]
    grid_lines: tuple[float, ...] = ()
    is_logarithmic: bool = False

    def fractions_along(self, axis_values: npt.ArrayLike) -> RealArray:
        """Return the positions of values on the axis, from 0 (first) to 1 (last), clipped."""
        axis_positions, axis_start, axis_end = (
            np.asarray(axis_values, dtype=np.float64),
            self.start_value,
            self.end_value,
        )
        if self.is_logarithmic:
            axis_positions, axis_start, axis_end = (
                np.log(np.maximum(axis_positions, axis_start)),
                np.log(axis_start),
                np.log(axis_end),
            )
        return np.clip((axis_positions - axis_start) / (axis_end - axis_start), 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class LegendEntry:
    """Entry of a chart's legend: label and style of a curve or a shaded area.

    Attributes
    ----------
    label
        Name of the curve or area.
    color, width
        Colour and width of the line, in points.
    is_area
        Whether the entry is a shaded area instead of a line.
    """

    label: str
    color: Color
    width: float = 1.5
    is_area: bool = False


@dataclass(frozen=True, slots=True)
class Chart:
    """Frame with two axes and a legend on a canvas.

    Attributes
    ----------
    entity
        Entity path of the chart in Rerun.
    width, height
        Size of the canvas, in points.
    x, y
        Horizontal and vertical axis.
    legend
        Entries of the legend, in reading order.
    left_margin, right_margin
        Margins left and right of the frame, in points.
    """

    entity: str
    width: float
    height: float
    x: Axis
    y: Axis
    legend: tuple[LegendEntry, ...] = ()
    left_margin: float = _LEFT_MARGIN_PT
    right_margin: float = _RIGHT_MARGIN_PT

    @property
    def frame_edges(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the frame on the canvas.

        As in all of Rerun's canvases, the vertical coordinate increases downwards.
        """
        return (
            self.left_margin,
            _TOP_MARGIN_PT,
            self.width - self.right_margin,
            self.height - _BOTTOM_MARGIN_PT,
        )

    def to_canvas(self, x: npt.ArrayLike, y: npt.ArrayLike) -> RealArray:
        """Return the canvas coordinates (n, 2) of points with given values on the axes.

        Values beyond an axis are clipped to its ends.

        Parameters
        ----------
        x, y
            Values on the horizontal and on the vertical axis, shape (n,).
        """
        frame_left, frame_top, frame_right, frame_bottom = self.frame_edges
        x_fraction, y_fraction = np.broadcast_arrays(
            self.x.fractions_along(x), self.y.fractions_along(y)
        )
        return np.stack(
            [
                frame_left + (frame_right - frame_left) * x_fraction,
                frame_bottom - (frame_bottom - frame_top) * y_fraction,
            ],
            axis=-1,
        )

    def draw_frame(self, stream: "RecordingStream") -> None:
        """Send the static parts of the chart: frame, grid, tick labels, titles and legend."""
        import rerun as rr

        frame_left, frame_top, frame_right, frame_bottom = self.frame_edges
        frame_corners = [
            [frame_left, frame_top],
            [frame_right, frame_top],
            [frame_right, frame_bottom],
            [frame_left, frame_bottom],
            [frame_left, frame_top],
        ]
        stream.log(
            f"{self.entity}/frame",
            rr.LineStrips2D(
                [frame_corners], colors=[GREY], radii=rr.Radius.ui_points(0.5), draw_order=1.0
            ),
            static=True,
        )
        self._draw_grid(stream)
        self._draw_labels(stream)
        self._draw_legend(stream)

    def tick_labels(self) -> list[tuple[str, float, float]]:
        """Return the text of each tick label and the canvas coordinates of its middle."""
        frame_left, _, _, frame_bottom = self.frame_edges
        return [
            (
                tick_text(tick_value),
                float(self.to_canvas(tick_value, self.y.start_value)[0]),
                frame_bottom + 14.0,
            )
            for tick_value in self.x.ticks
        ] + [
            (
                tick_text(tick_value),
                frame_left - 26.0,
                float(self.to_canvas(self.x.start_value, tick_value)[1]),
            )
            for tick_value in self.y.ticks
        ]

    def draw_curve(
        self,
        stream: "RecordingStream",
        curve_name: str,
        strips: Sequence[RealArray],
        legend_entry: LegendEntry,
        *,
        static: bool = False,
        dotted: bool = False,
        curve_order: int = 0,
    ) -> None:
        """Draw a curve that may have gaps: one line through the points (n, 2) of each strip.

        Parameters
        ----------
        stream, curve_name, strips, legend_entry
            Recording to draw into, name of the curve under the chart's entity path, points of each
            strip, and style of the curve.
        static
            Whether the curve never changes. Static curves lie beneath all others.
        dotted
            Whether to draw points only, because a line between them would have no meaning.
        curve_order
            Position in the stack of static curves or of other curves; higher numbers lie above.
        """
        import rerun as rr

        canvas_strips = [
            self.to_canvas(curve_strip[:, 0], curve_strip[:, 1]) for curve_strip in strips
        ]
        draw_order = (20.0 if static else 30.0) + curve_order
        drawn_curve = (
            rr.Points2D(
                np.concatenate(canvas_strips or [np.zeros((0, 2))]),
                colors=[legend_entry.color],
                radii=rr.Radius.ui_points(_CURVE_DOT_RADIUS_PT),
                draw_order=draw_order,
            )
            if dotted
            else rr.LineStrips2D(
                canvas_strips,
                colors=[legend_entry.color],
                radii=rr.Radius.ui_points(legend_entry.width / 2),
                draw_order=draw_order,
            )
        )
        stream.log(f"{self.entity}/{curve_name}", drawn_curve, static=static)

    def draw_note(self, stream: "RecordingStream", note_text: str, text_color: Color) -> None:
        """Write a text into the middle of the frame; an empty text removes the previous text.

        Parameters
        ----------
        stream
            Recording to draw into.
        note_text
            Text to show.
        text_color
            Colour of the text.
        """
        import rerun as rr

        frame_left, frame_top, frame_right, frame_bottom = self.frame_edges
        frame_middle = [
            (frame_left + frame_right) / 2,
            (frame_top + frame_bottom) / 2 - LABEL_DROP_PT,
        ]
        stream.log(
            f"{self.entity}/note",
            rr.Points2D(
                [frame_middle] if note_text else [],
                labels=[note_text] if note_text else [],
                colors=[text_color],
                radii=0.0,
                show_labels=True,
                draw_order=40.0,
            ),
        )

    def draw_shade(self, stream: "RecordingStream", shade_name: str) -> None:
        """Send the image of a shaded area, which `move_shade` then moves to its position.

        It is an image, because Rerun's views fill no other shapes.

        Parameters
        ----------
        stream
            Recording to draw into.
        shade_name
            Name of the shaded area under the chart's entity path.
        """
        import rerun as rr

        grey_pixel = np.array([[GREY]], dtype=np.uint8)
        stream.log(
            f"{self.entity}/{shade_name}",
            # Rerun supports opacity for images only.
            rr.Image(
                bytes=grey_pixel.tobytes(),
                width=1,
                height=1,
                color_model="RGB",
                datatype=np.uint8,
                opacity=_SHADE_OPACITY,
            ),
            static=True,
        )

    def move_shade(
        self, stream: "RecordingStream", shade_name: str, first_x: float, last_x: float
    ) -> None:
        """Move a shaded area between two values of the horizontal axis.

        Parameters
        ----------
        stream
            Recording to draw into.
        shade_name
            Name of the shaded area under the chart's entity path.
        first_x, last_x
            Values of the horizontal axis at the left and right end of the area.
        """
        _, frame_top, _, frame_bottom = self.frame_edges
        shade_left, shade_right = self.to_canvas([first_x, last_x], self.y.start_value)[:, 0]
        self._position_shade(stream, shade_name, (shade_left, frame_top, shade_right, frame_bottom))

    def _draw_labels(self, stream: "RecordingStream") -> None:
        """Draw the tick labels, the titles of the axes and the labels of the legend."""
        import rerun as rr

        frame_left, frame_top, frame_right, frame_bottom = self.frame_edges
        frame_middle = (frame_left + frame_right) / 2
        labels_with_positions = [
            *self.tick_labels(),
            (
                self.y.title,
                frame_left - 44.0 + _label_width(self.y.title) / 2,
                frame_top - _TITLE_DISTANCE_PT,
            ),
        ]
        if self.x.title:
            labels_with_positions.append((self.x.title, frame_middle, frame_bottom + 40.0))
        labels_with_positions += [
            (key.label, x + _label_width(key.label) / 2, y)
            for key, x, y in self._legend_positions()
        ]
        stream.log(
            f"{self.entity}/labels",
            rr.Points2D(
                [[x, y - LABEL_DROP_PT] for _, x, y in labels_with_positions],
                labels=[label_text for label_text, _, _ in labels_with_positions],
                colors=[GREY] * (len(labels_with_positions) - len(self.legend))
                + [key.color for key in self.legend],
                radii=0.0,
                show_labels=True,
            ),
            static=True,
        )

    def _draw_grid(self, stream: "RecordingStream") -> None:
        """Draw dotted grid lines, since solid lines are opaque and distract from the curves."""
        import rerun as rr

        frame_left, frame_top, frame_right, frame_bottom = self.frame_edges
        vertical_line_x = self.to_canvas([*self.x.ticks, *self.x.grid_lines], self.y.start_value)[
            :, 0
        ]
        horizontal_line_y = self.to_canvas(self.x.start_value, [*self.y.ticks, *self.y.grid_lines])[
            :, 1
        ]
        dot_positions = [
            *(
                [x, y]
                for x in vertical_line_x
                for y in np.arange(frame_bottom, frame_top, -_GRID_DOT_SPACING_PT)
            ),
            *(
                [x, y]
                for y in horizontal_line_y
                for x in np.arange(frame_left, frame_right, _GRID_DOT_SPACING_PT)
            ),
        ]
        stream.log(
            f"{self.entity}/grid",
            rr.Points2D(
                dot_positions, colors=[GREY], radii=rr.Radius.ui_points(0.5), draw_order=0.5
            ),
            static=True,
        )

    def _draw_legend(self, stream: "RecordingStream") -> None:
        """Draw the lines and shaded areas of the legend."""
        import rerun as rr

        line_entries = [
            legend_entry for legend_entry in self._legend_positions() if not legend_entry[0].is_area
        ]
        if line_entries:
            stream.log(
                f"{self.entity}/legend",
                rr.LineStrips2D(
                    [[[x - 28.0, y], [x - 10.0, y]] for _, x, y in line_entries],
                    colors=[key.color for key, _, _ in line_entries],
                    radii=rr.Radius.ui_points([key.width / 2 for key, _, _ in line_entries]),
                ),
                static=True,
            )
        for key, x, y in self._legend_positions():
            if key.is_area:
                shade_name = f"legend/{key.label.replace(' ', '_')}"
                self.draw_shade(stream, shade_name)
                self._position_shade(
                    stream, shade_name, (x - 28.0, y - 7.0, x - 10.0, y + 7.0), static=True
                )

    def _position_shade(
        self,
        stream: "RecordingStream",
        shade_name: str,
        rectangle_edges: tuple[float, float, float, float],
        *,
        static: bool = False,
    ) -> None:
        """Move a shaded area to the rectangle (left, top, right, bottom) on the canvas."""
        import rerun as rr

        left_edge, top_edge, right_edge, bottom_edge = rectangle_edges
        stream.log(
            f"{self.entity}/{shade_name}",
            rr.Transform3D.from_fields(
                translation=[left_edge, top_edge, 0.0],
                scale=[right_edge - left_edge, bottom_edge - top_edge, 1.0],
            ),
            static=static,
        )

    def _legend_positions(self) -> list[tuple[LegendEntry, float, float]]:
        """Return the legend's entries with positions (x, y) above the frame, right-aligned."""
        _, frame_top, right_edge, _ = self.frame_edges
        entries_with_positions = []
        x = right_edge
        for key in reversed(self.legend):
            x -= _label_width(key.label)
            entries_with_positions.append((key, x, frame_top - _TITLE_DISTANCE_PT))
            x -= 46.0
        return entries_with_positions[::-1]


def tick_text(tick_value: float) -> str:
    """Return a number as the text of a tick label, with a minus sign instead of a hyphen."""
    return f"{tick_value + 0.0:.9g}".replace("-", "−")  # adding turns −0 into 0


def _label_width(label_text: str) -> float:
    """Return the approximate width of a text in a label, in points."""
    return _MEAN_CHARACTER_WIDTH_PT * len(label_text)


def decade_ticks(
    first_value: float, last_value: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return ticks (1, 2 and 5 in each decade) and further grid lines of a logarithmic axis.

    Parameters
    ----------
    first_value, last_value
        Values at both ends of the axis, above 0.

    Examples
    --------
    >>> from rigd.view.chart import decade_ticks
    >>> decade_ticks(0.5, 20.0)[0]
    (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
    """
    decade_exponents = range(
        int(np.floor(np.log10(first_value))), int(np.ceil(np.log10(last_value))) + 1
    )
    digit_multiples = [
        (digit, float(f"{digit}e{exponent}"))
        for exponent in decade_exponents
        for digit in range(1, 10)
    ]
    multiples_in_range = [
        (digit, multiple)
        for digit, multiple in digit_multiples
        if first_value <= multiple <= last_value
    ]
    return (
        tuple(multiple for digit, multiple in multiples_in_range if digit in (1, 2, 5)),
        tuple(multiple for digit, multiple in multiples_in_range if digit not in (1, 2, 5)),
    )


def round_ticks(first_value: float, last_value: float, max_ticks: int) -> tuple[float, ...]:
    """Return at most `max_ticks` evenly spaced round values within a range, for axis ticks.

    Parameters
    ----------
    first_value, last_value
        Values at both ends of the axis.
    max_ticks
        Largest number of values.

    Examples
    --------
    >>> from rigd.view.chart import round_ticks
    >>> round_ticks(1.0, 47.0, 6)
    (10.0, 20.0, 30.0, 40.0)
    """
    least_tick_step = (last_value - first_value) / max_ticks
    power_of_ten = 10.0 ** np.floor(np.log10(least_tick_step))
    tick_step = next(
        leading_digit * power_of_ten
        for leading_digit in (1.0, 2.0, 5.0, 10.0)
        if leading_digit * power_of_ten >= least_tick_step
    )
    first_index, last_index = (
        np.ceil(first_value / tick_step - 1e-9),
        np.floor(last_value / tick_step + 1e-9),
    )
    tick_values = tick_step * np.arange(first_index, last_index + 1) + 0.0  # adding turns −0 into 0
    return tuple(float(f"{step_value:.9g}") for step_value in tick_values)
