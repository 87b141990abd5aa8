"""The antenna in 3D: its motor and the turning and bending beam, seen from behind the motor.

The deflection is computed from the measured angle and the exact model, because no sensor measures
it.

Lengths are drawn in beam lengths, so that every antenna fills the same space. The beam points along
x, and the motor turns it about z. Motor angle and deflection are enlarged by the same factor, so
that vibration nodes are drawn at their true positions and a tip at rest is drawn at rest. In moves
and touch searches, whose angles are large, everything is drawn to scale.
"""

import collections
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping, DeflectionFilter, undamped_frequencies_rad_s
from rigd.units import with_interval
from rigd.view.plots import GREY, ORANGE, SKY_BLUE, TIMELINE, VERMILION, Color, Drawing

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

    from rigd.view._session_info import SessionDescription

Records = npt.NDArray[Any]
"""Structured array of samples, shape (n,)."""
RealArray = npt.NDArray[np.float64]
"""Array of real numbers."""
_TimedLines = tuple[int, npt.NDArray[np.float32]]
"""Time since the start of the session in ns, and the drawn lines at that time, (n, points, 3)."""

ANTENNA_ENTITY: Final = "/antenna"
"""Entity path in Rerun of the 3D drawing of the antenna."""
BEAM_ENTITY: Final = f"{ANTENNA_ENTITY}/beam"
"""Entity path in Rerun of the beam's lines."""
TRAIL_ENTITY: Final = f"{ANTENNA_ENTITY}/trail"
"""Entity path in Rerun of the trail of past beam lines."""
LABEL_ENTITY: Final = f"{ANTENNA_ENTITY}/label"
"""Entity path in Rerun of the label with the tip's deflection."""
TOUCH_ENTITY: Final = f"{ANTENNA_ENTITY}/touch"
"""Entity path in Rerun of the drawings of touches."""

DRAWING_ENLARGEMENT: Final = 2.0
"""Factor by which the motor angle and the beam's deflection are enlarged in the drawing.

The default chirp turns the motor by 25 mrad, and at the first resonance the tip swings by
a third of the beam's length. With this factor the motor's motion is visible, and the tip's motion
stays inside the drawing."""
_EXCITATIONS_DRAWN_TO_SCALE: Final = ("move", "touch")
"""Kinds of excitation (moves and touch searches) that are drawn without enlargement."""
VIEW_TITLE: Final = "Antenna"
"""Title of the 3D view in Rerun's window."""

BEAM_DRAWING_RATE_HZ: Final = 20.0
"""Rate at which the beam is drawn, in hertz."""
TRAIL_DURATION_S: Final = 0.5
"""Time for which each drawn beam line stays visible, so that the lines show the range of motion."""

_SHAPE_RATE_HZ: Final = 100.0
"""Rate at which the beam's deflection is computed, in hertz.

It is higher than the rate of drawing, so that the largest deflection of the tip is not missed."""
_LABEL_RATE_HZ: Final = 4.0
"""Rate at which the label with the tip's deflection, and the trail of past lines, are sent."""
_MAX_INTERPOLATED_GAP_S: Final = 10.0
"""Longest gap between samples over which the motor angle is interpolated."""
_ASSUMED_DAMPING_RATIO: Final = 2e-3
"""Damping ratio of the first mode that is assumed if the profile states no damping.

It is twice the lowest damping ratio in the reference paper."""

_LINE_STORAGE_S: Final = 30.0
"""Time for which drawn beam lines are stored: a touch is estimated later than it happens."""
_ARROW_LENGTH_PER_N: Final = 0.2
"""Length of the arrow of a contact force per newton, in beam lengths."""
_MAX_ARROW_LENGTH: Final = 0.4
"""Largest length of a contact force's arrow, in beam lengths."""

_HOUSING_COLOR: Color = (105, 110, 120)
"""Colour of the motor's housing."""
_METAL_COLOR: Color = (140, 145, 155)
"""Colour of the motor's mount, shaft and hub."""
_TRAIL_COLOR: Color = (70, 115, 145)
"""Colour of the past beam lines in the trail."""


class Antenna:
    """Motor and antenna (a flexible beam) of one session, which are drawn as they move."""

    def __init__(self, session: "SessionDescription") -> None:
        damping = session.damping or _assumed_damping(session.beam)
        self._filter = DeflectionFilter(session.beam, damping, session.rate_hz)
        self._rate_hz = session.rate_hz
        self._length_m = session.beam.length_m
        self._shape_ticks = max(1, round(session.rate_hz / _SHAPE_RATE_HZ))
        shape_rate_hz = session.rate_hz / self._shape_ticks
        self._shapes_per_drawing = math.ceil(shape_rate_hz / BEAM_DRAWING_RATE_HZ)
        self._shapes_per_label = math.ceil(shape_rate_hz / _LABEL_RATE_HZ)
        self._shape_count = 0
        trail_shape_count = max(1, round(shape_rate_hz * TRAIL_DURATION_S))
        self._tips_m: collections.deque[float] = collections.deque(maxlen=trail_shape_count)
        self._is_to_scale = session.excitation in _EXCITATIONS_DRAWN_TO_SCALE
        self._newest: tuple[int, RealArray] | None = (
            None  # tick, time and angle of the newest sample
        )
        self._waiting: RealArray = np.zeros((0, 2))  # times and angles since the last shape
        self._trail: list[_TimedLines] = []  # lines that are not sent yet
        self._shapes: collections.deque[_TimedLines] = collections.deque(
            maxlen=round(_LINE_STORAGE_S * BEAM_DRAWING_RATE_HZ)
        )

    def initial_drawings(self) -> list[Drawing]:
        """Return functions that draw the motor and set the style of the beam's lines."""
        return static_drawings()

    def sample_drawings(self, samples: Records) -> list[Drawing]:
        """Return functions that draw the bent beam for new samples (n,) of ``SAMPLE_DTYPE``.

        The samples are in order of time. The beam is drawn 20 times per second. Across gaps
        between samples the motor angle is interpolated.
        """
        if len(samples) == 0:
            return []
        samples = np.concatenate([self._waiting, self._interpolate_to_ticks(samples)])
        shape_count = len(samples) // self._shape_ticks
        self._waiting = samples[shape_count * self._shape_ticks :]
        timed_lines: list[_TimedLines] = []
        label_drawings: list[Drawing] = []
        for shape_samples in samples[: shape_count * self._shape_ticks].reshape(
            shape_count, self._shape_ticks, 2
        ):
            deflection_m = self._filter.feed(shape_samples[:, 1])
            self._tips_m.append(abs(float(deflection_m[-1])))
            self._shape_count += 1
            t_ns, angle_rad = int(shape_samples[-1, 0]), float(shape_samples[-1, 1])
            if self._shape_count % self._shapes_per_drawing == 0:
                relative_deflection = deflection_m / self._length_m
                drawn_lines = (lines_to_scale if self._is_to_scale else enlarged_lines)(
                    angle_rad, relative_deflection
                )
                timed_lines.append((t_ns, drawn_lines))
            if self._shape_count % self._shapes_per_label == 0:
                label_text = tip_label(max(self._tips_m), is_to_scale=self._is_to_scale)
                label_drawings.append(partial(_draw_label, t_ns=t_ns, label_text=label_text))
        self._trail += [(t_ns, both_lines[1:]) for t_ns, both_lines in timed_lines]
        self._shapes += timed_lines
        drawings: list[Drawing] = []
        if timed_lines:
            drawings.append(partial(_draw_lines, entity=BEAM_ENTITY, timed_lines=timed_lines))
        if label_drawings and self._trail:
            drawings.append(partial(_draw_lines, entity=TRAIL_ENTITY, timed_lines=self._trail))
            self._trail = []
        return drawings + label_drawings

    def touch_drawings(self, touch: Mapping[str, Any]) -> list[Drawing]:
        """Return the function that draws a touch: contact point with uncertainty, and force.

        The result is empty if point or time of the touch are unknown, or if the beam line at that
        time is not stored.
        """
        touch_position, touch_time = touch.get("x_m"), touch.get("time_s")
        stored_lines = list(self._shapes)
        if touch_position is None or touch_time is None or len(stored_lines) < 2:
            return []
        t_ns = round(1e9 * touch_time["value"])
        later_index = next(
            (i for i in range(1, len(stored_lines)) if stored_lines[i][0] >= t_ns),
            len(stored_lines) - 1,
        )
        (earlier_ns, earlier_lines), (later_ns, later_lines) = (
            stored_lines[later_index - 1],
            stored_lines[later_index],
        )
        if t_ns < earlier_ns:
            return []  # the shape of that time is no longer stored
        time_fraction = min((t_ns - earlier_ns) / (later_ns - earlier_ns), 1.0)
        beam_line = (1 - time_fraction) * earlier_lines[1] + time_fraction * later_lines[1]
        interval_displacement = later_lines[1] - earlier_lines[1]
        beam_positions = np.linspace(0.0, 1.0, len(beam_line))
        relative_positions = (
            np.array([touch_position["value"], *touch_position["interval_95"]]) / self._length_m
        )
        touch_points, displacements = (
            np.column_stack(
                [
                    np.interp(relative_positions, beam_positions, coordinate)
                    for coordinate in lines.T
                ]
            )
            for lines in (beam_line, interval_displacement)
        )
        touch_force = touch.get("force_n")
        arrow_length = (
            0.0
            if touch_force is None
            else min(_ARROW_LENGTH_PER_N * abs(touch_force["value"]), _MAX_ARROW_LENGTH)
        )
        # An obstacle pushes against the motion.
        displacement_norm = float(np.linalg.norm(displacements[0]))
        arrow_vector = (
            -arrow_length / displacement_norm * displacements[0]
            if displacement_norm > 0
            else np.zeros(3)
        )
        return [
            partial(
                _draw_touch,
                touch_number=int(touch["number"]),
                t_ns=t_ns,
                touch_points=touch_points,
                force_arrow=arrow_vector,
                label_text=touch_label(touch),
            )
        ]

    def _interpolate_to_ticks(self, samples: Records) -> RealArray:
        """Return time (ns) and motor angle (rad) of all new ticks, shape (n, 2).

        The new ticks are those after the last sample of the previous call, to the last sample.
        Ticks without a sample have interpolated values.
        """
        ticks = samples["tick"].astype(np.int64)
        times_and_angles = np.column_stack([samples["t_ns"], samples["angle_rad"]])
        last_tick, last_values = self._newest or (int(ticks[0]) - 1, times_and_angles[0])
        self._newest = int(ticks[-1]), times_and_angles[-1]
        tick_steps = np.minimum(
            np.diff(ticks, prepend=last_tick), round(_MAX_INTERPOLATED_GAP_S * self._rate_hz)
        )
        if np.all(tick_steps == 1):
            return times_and_angles
        tick_offsets, times_and_angles = (
            np.cumsum(np.append(0, tick_steps)),
            np.vstack([last_values, times_and_angles]),
        )
        all_tick_offsets = np.arange(1, tick_offsets[-1] + 1)
        return np.column_stack(
            [
                np.interp(all_tick_offsets, tick_offsets, value_column)
                for value_column in times_and_angles.T
            ]
        )


def view() -> "rrb.Spatial3DView":
    """Return the 3D view of the antenna, for the layout of Rerun's window."""
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(
        name=VIEW_TITLE,
        origin=ANTENNA_ENTITY,
        line_grid=rrb.LineGrid3D(spacing=0.1, color=(*GREY, 16)),
        # From above and behind the motor: positive angles turn to the left.
        eye_controls=rrb.EyeControls3D(
            position=(-0.30, 0.0, 1.05), look_target=(0.45, 0.0, -0.03), eye_up=(0.0, 0.0, 1.0)
        ),
        overrides={
            TRAIL_ENTITY: rrb.VisibleTimeRanges(
                timeline=TIMELINE,
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_DURATION_S),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
        },
    )


def static_drawings() -> list[Drawing]:
    """Return functions that draw the motor and set the style of the beam's lines."""
    return [_draw_motor, _draw_direction, _draw_styles]


def enlarged_lines(angle_rad: float, deflection_per_length: RealArray) -> npt.NDArray[np.float32]:
    """Return the coordinates of the undeformed and of the bent beam, enlarged by `ENLARGEMENT`.

    They are in beam lengths, shape (2, points, 3), as is the deflection relative to the undeformed
    beam at evenly spaced points.
    """
    x = np.linspace(0.0, 1.0, deflection_per_length.size)
    line_coordinates = np.zeros((2, x.size, 3), dtype=np.float32)
    line_coordinates[:, :, 0] = x
    line_coordinates[0, :, 1] = DRAWING_ENLARGEMENT * angle_rad * x
    line_coordinates[1, :, 1] = DRAWING_ENLARGEMENT * (angle_rad * x + deflection_per_length)
    return line_coordinates


def lines_to_scale(angle_rad: float, deflection_per_length: RealArray) -> npt.NDArray[np.float32]:
    """Return the coordinates of the undeformed and of the bent beam, true to scale.

    Arguments and result are those of `enlarged_lines`.
    """
    along_beam_direction = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    across_beam_direction = np.array([-along_beam_direction[1], along_beam_direction[0], 0.0])
    straight_line = (
        np.linspace(0.0, 1.0, deflection_per_length.size)[:, None] * along_beam_direction
    )
    return np.stack(
        [straight_line, straight_line + deflection_per_length[:, None] * across_beam_direction]
    ).astype(np.float32)


def tip_label(tip_m: float, *, is_to_scale: bool = False) -> str:
    """Return a label such as "tip deflection ± 4.2 mm, drawn × 2".

    The deflection is rounded to 0.1 mm, from 10 mm on to two significant digits. `is_to_scale`
    means that the drawing is true to scale.
    """
    tip_mm = 1e3 * tip_m
    mm_text = f"{tip_mm:.1f}" if tip_mm < 10 else f"{float(f'{tip_mm:.1e}'):.0f}"
    return (
        f"tip deflection ± {mm_text} mm, drawn "
        f"{'to scale' if is_to_scale else f'× {DRAWING_ENLARGEMENT:g}'}"
    )


def touch_label(touch: Mapping[str, Any]) -> str:
    """Return the label of a touch in the drawing: its number and its position on the beam in m."""
    touch_position = touch["x_m"]
    return (
        f"touch {touch['number']}: "
        f"{with_interval(touch_position['value'], touch_position['interval_95'])} m"
    )


def _assumed_damping(beam: Beam) -> Damping:
    """Return the small viscous damping with which a beam of unknown damping is drawn."""
    first_mode_rad_s = float(undamped_frequencies_rad_s(beam, 1)[0])
    return Damping(zeta=2 * _ASSUMED_DAMPING_RATIO / first_mode_rad_s)


def _draw_motor(stream: "RecordingStream") -> None:
    """Draw the motor's mount, housing and shaft, and the hub that clamps the beam."""
    import rerun as rr

    stream.log(
        f"{ANTENNA_ENTITY}/mount",
        rr.Boxes3D(
            centers=[(0, 0, -0.2)],
            half_sizes=[(0.1, 0.1, 0.01)],
            colors=[_METAL_COLOR],
            fill_mode="solid",
        ),
        static=True,
    )
    stream.log(
        f"{ANTENNA_ENTITY}/motor",
        rr.Cylinders3D(
            centers=[(0, 0, -0.12), (0, 0, -0.035), (0, 0, 0)],
            lengths=[0.14, 0.05, 0.03],
            radii=[0.075, 0.025, 0.04],
            colors=[_HOUSING_COLOR, _METAL_COLOR, ORANGE],
            fill_mode="solid",
        ),
        static=True,
    )
    shaft_axis = [(0, 0, -0.3), (0, 0, 0.2)]
    stream.log(
        f"{ANTENNA_ENTITY}/axis",
        rr.LineStrips3D([shaft_axis], colors=[GREY], radii=rr.Radius.ui_points(0.5)),
        static=True,
    )


def _draw_direction(stream: "RecordingStream") -> None:
    """Draw an arrow that shows the direction of positive motor angles."""
    import rerun as rr

    arc_angles_rad = np.linspace(0.35, 1.05, 15)
    arc_points = 0.2 * np.column_stack(
        [np.cos(arc_angles_rad), np.sin(arc_angles_rad), np.zeros(arc_angles_rad.size)]
    )
    arc_end = arc_points[-1]
    tangent, outward_vector = 0.15 * np.array([arc_end[1], -arc_end[0], 0.0]), 0.075 * arc_end
    stream.log(
        f"{ANTENNA_ENTITY}/positive",
        rr.LineStrips3D(
            [
                arc_points,
                [arc_end + tangent + outward_vector, arc_end, arc_end + tangent - outward_vector],
            ],
            colors=[GREY],
            radii=rr.Radius.ui_points(0.75),
        ),
        static=True,
    )
    stream.log(
        f"{ANTENNA_ENTITY}/positive/sign",
        rr.Points3D([1.25 * arc_end], radii=[0.0], colors=[GREY], labels=["+"], show_labels=True),
        static=True,
    )


def _draw_styles(stream: "RecordingStream") -> None:
    """Send the constants of the drawing: colours and widths of the lines, position of the label."""
    import rerun as rr

    for entity, line_colors, line_widths in (
        (BEAM_ENTITY, [GREY, SKY_BLUE], [1.0, 2.5]),
        (TRAIL_ENTITY, [_TRAIL_COLOR], [0.6]),
    ):
        line_style = rr.LineStrips3D.from_fields(
            colors=line_colors, radii=rr.Radius.ui_points(line_widths)
        )
        stream.log(entity, line_style, static=True)
    label_position = [(1.25, 0.0, 0.0)]
    stream.log(
        LABEL_ENTITY,
        rr.Points3D.from_fields(
            positions=label_position, radii=[0.0], colors=[SKY_BLUE], show_labels=True
        ),
        static=True,
    )


def _draw_lines(stream: "RecordingStream", entity: str, timed_lines: Sequence[_TimedLines]) -> None:
    """Send the beam's lines at several times to a Rerun entity."""
    import rerun as rr

    t_ns = np.array([t_ns for t_ns, _ in timed_lines])
    line_strips = np.concatenate([line_strips for _, line_strips in timed_lines])
    lines_per_time = len(line_strips) // len(timed_lines)
    # Built here, because Rerun's own function for columns takes three times as long.
    strip_column = rr.ComponentColumn(
        rr.LineStrips3D.descriptor_strips(),
        rr.components.LineStrip3DBatch(line_strips),
        offsets=np.arange(0, len(line_strips) + 1, lines_per_time, dtype=np.int32),
    )
    time_column = rr.TimeColumn(TIMELINE, duration=t_ns.astype("timedelta64[ns]"))
    stream.send_columns(entity, [time_column], [strip_column], strict=True)


def _draw_label(stream: "RecordingStream", t_ns: int, label_text: str) -> None:
    """Send the label with the deflection of the beam's tip to Rerun, at the time `t_ns`."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    stream.log(LABEL_ENTITY, rr.Points3D.from_fields(labels=[label_text]))


def _draw_touch(
    stream: "RecordingStream",
    touch_number: int,
    t_ns: int,
    touch_points: RealArray,
    force_arrow: RealArray,
    label_text: str,
) -> None:
    """Draw a touch from its time on: contact point, its uncertainty along the beam, and force."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    contact_point, interval_ends = touch_points[:1], touch_points[1:]
    entity = f"{TOUCH_ENTITY}/{touch_number}"
    stream.log(
        f"{entity}/interval",
        rr.LineStrips3D([interval_ends], colors=[VERMILION], radii=rr.Radius.ui_points(4.0)),
    )
    stream.log(
        f"{entity}/point",
        rr.Points3D(contact_point, radii=rr.Radius.ui_points(5.0), colors=[VERMILION]),
    )
    # Only the label of the last touch: labels of several passes would overlap.
    stream.log(
        f"{TOUCH_ENTITY}/label",
        rr.Points3D(
            contact_point, radii=[0.0], colors=[VERMILION], labels=[label_text], show_labels=True
        ),
    )
    stream.log(
        f"{entity}/force",
        rr.Arrows3D(
            origins=contact_point - force_arrow,
            vectors=[force_arrow],
            colors=[VERMILION],
            radii=rr.Radius.ui_points(2.0),
        ),
    )
