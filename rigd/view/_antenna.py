"""The antenna in 3D: its motor, and the beam as it turns and bends, seen from behind the motor.

The bend is computed from the measured angle and the exact model; no sensor measures it.

Lengths are drawn in beam lengths, so that every antenna fills the same picture. The beam points
along x, and the motor turns it about z. Angle and bend are exaggerated by the same factor: nodes
are drawn at their true positions, and a tip at rest is drawn at rest. In moves and searches, with
their large angles, everything is drawn to scale.
"""

import collections
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping, DeflectionFilter, undamped_frequencies_rad_s
from rigd.units import with_half_width
from rigd.view.plots import GREY, ORANGE, SKY_BLUE, TIMELINE, VERMILION, Color

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

    from rigd.view._scene import Drawing
    from rigd.view._session_info import Subject

Records = npt.NDArray[Any]
Real = npt.NDArray[np.float64]
_Moment = tuple[int, npt.NDArray[np.float32]]
"""Time since the start of the session in ns, and lines (n, points, 3) as they are drawn then."""

ANTENNA: Final = "/antenna"
BEAM: Final = f"{ANTENNA}/beam"
TRAIL: Final = f"{ANTENNA}/trail"
LABEL: Final = f"{ANTENNA}/label"
TOUCH: Final = f"{ANTENNA}/touch"

FACTOR: Final = 2.0
"""Factor by which motion across the beam is exaggerated.

The reference paper's chirp turns the motor by 25 mrad, and at the first resonance the tip swings by
a third of the beam's length: with this factor the former is visible, and the latter in the picture.
"""
_TO_SCALE: Final = ("move", "touch")
TITLE: Final = "Antenna"

DRAWN_HZ: Final = 20.0
TRAIL_S: Final = 0.5
"""Time for which each drawn shape stays visible, so that the shapes show the range of motion."""

_SHAPE_HZ: Final = 100.0
"""Rate at which the deflected shape is computed, for the largest deflection of the tip."""
_LABEL_HZ: Final = 4.0
"""Rate at which the label and the trail are sent."""
_LONGEST_GAP_S: Final = 10.0
"""Longest gap of missing samples that is filled."""
_ASSUMED_DAMPING_RATIO: Final = 2e-3
"""Damping ratio of the first mode if the profile has none; the reference paper's lowest is half."""

_STORED_S: Final = 30.0
"""Time for which shapes are stored, so that a touch can be drawn on them."""
_ARROW_PER_N: Final = 0.2
_LONGEST_ARROW: Final = 0.4
"""Longest arrow of a contact force, in beam lengths."""

_HOUSING: Color = (105, 110, 120)
_METAL: Color = (140, 145, 155)
_PAST: Color = (70, 115, 145)


class Antenna:
    """Drawing of the beam during one session.

    Parameters
    ----------
    subject
        The session.
    """

    def __init__(self, subject: "Subject") -> None:
        damping = subject.damping or _small_damping(subject.beam)
        self._filter = DeflectionFilter(subject.beam, damping, subject.rate_hz)
        self._rate_hz = subject.rate_hz
        self._length_m = subject.beam.length_m
        self._shape_ticks = max(1, round(subject.rate_hz / _SHAPE_HZ))
        shape_hz = subject.rate_hz / self._shape_ticks
        self._shapes_per_drawing = math.ceil(shape_hz / DRAWN_HZ)
        self._shapes_per_label = math.ceil(shape_hz / _LABEL_HZ)
        self._shape_count = 0
        trail_shapes = max(1, round(shape_hz * TRAIL_S))
        self._tips_m: collections.deque[float] = collections.deque(maxlen=trail_shapes)
        self._to_scale = subject.excitation in _TO_SCALE
        self._newest: tuple[int, Real] | None = None  # tick; time and angle
        self._waiting: Real = np.zeros((0, 2))  # times and angles since the last shape
        self._trail: list[_Moment] = []  # not yet sent
        self._shapes: collections.deque[_Moment] = collections.deque(
            maxlen=round(_STORED_S * DRAWN_HZ)
        )

    def frame(self) -> list["Drawing"]:
        """Return the static drawings."""
        return static_drawings()

    def samples(self, samples: Records) -> list["Drawing"]:
        """Return the drawings of samples (n,) of ``SAMPLE_DTYPE``, in order.

        They draw the beam 20 times per second. Across gaps the angle is interpolated.
        """
        if len(samples) == 0:
            return []
        samples = np.concatenate([self._waiting, self._at_every_tick(samples)])
        count = len(samples) // self._shape_ticks
        self._waiting = samples[count * self._shape_ticks :]
        moments: list[_Moment] = []
        labels: list[Drawing] = []
        for step in samples[: count * self._shape_ticks].reshape(count, self._shape_ticks, 2):
            deflection_m = self._filter.feed(step[:, 1])
            self._tips_m.append(abs(float(deflection_m[-1])))
            self._shape_count += 1
            t_ns, angle_rad = int(step[-1, 0]), float(step[-1, 1])
            if self._shape_count % self._shapes_per_drawing == 0:
                deflection = deflection_m / self._length_m
                drawn = (to_scale if self._to_scale else lines)(angle_rad, deflection)
                moments.append((t_ns, drawn))
            if self._shape_count % self._shapes_per_label == 0:
                text = label(max(self._tips_m), to_scale=self._to_scale)
                labels.append(partial(_draw_label, t_ns=t_ns, text=text))
        self._trail += [(t_ns, beam_and_line[1:]) for t_ns, beam_and_line in moments]
        self._shapes += moments
        drawings: list[Drawing] = []
        if moments:
            drawings.append(partial(_draw_lines, entity=BEAM, moments=moments))
        if labels and self._trail:
            drawings.append(partial(_draw_lines, entity=TRAIL, moments=self._trail))
            self._trail = []
        return drawings + labels

    def touch(self, touch: Mapping[str, Any]) -> list["Drawing"]:
        """Return the drawing of a touch: point, interval and force on the beam at that time.

        Parameters
        ----------
        touch
            Touch as in JSON documents. It is not drawn without point and time, or without the
            shape at that time.
        """
        point, time = touch.get("x_m"), touch.get("time_s")
        shapes = list(self._shapes)
        if point is None or time is None or len(shapes) < 2:
            return []
        t_ns = round(1e9 * time["value"])
        after = next((i for i in range(1, len(shapes)) if shapes[i][0] >= t_ns), len(shapes) - 1)
        (earlier_ns, earlier), (later_ns, later) = shapes[after - 1], shapes[after]
        if t_ns < earlier_ns:
            return []  # the shape of that time is no longer stored
        fraction = min((t_ns - earlier_ns) / (later_ns - earlier_ns), 1.0)
        beam = (1 - fraction) * earlier[1] + fraction * later[1]
        moved = later[1] - earlier[1]
        along = np.linspace(0.0, 1.0, len(beam))
        x = np.array([point["value"], *point["interval_95"]]) / self._length_m
        points, ahead = (
            np.column_stack([np.interp(x, along, axis) for axis in each.T])
            for each in (beam, moved)
        )
        force = touch.get("force_n")
        size = 0.0 if force is None else min(_ARROW_PER_N * abs(force["value"]), _LONGEST_ARROW)
        # An obstacle pushes against the motion.
        way = float(np.linalg.norm(ahead[0]))
        arrow = -size / way * ahead[0] if way > 0 else np.zeros(3)
        return [
            partial(
                _draw_touch,
                number=int(touch["number"]),
                t_ns=t_ns,
                points=points,
                arrow=arrow,
                text=touch_label(touch),
            )
        ]

    def _at_every_tick(self, samples: Records) -> Real:
        """Return times in ns and angles in rad, (n, 2), after the last sample, with gaps filled."""
        ticks = samples["tick"].astype(np.int64)
        values = np.column_stack([samples["t_ns"], samples["angle_rad"]])
        tick, value = self._newest or (int(ticks[0]) - 1, values[0])
        self._newest = int(ticks[-1]), values[-1]
        steps = np.minimum(np.diff(ticks, prepend=tick), round(_LONGEST_GAP_S * self._rate_hz))
        if np.all(steps == 1):
            return values
        points, values = np.cumsum(np.append(0, steps)), np.vstack([value, values])
        every = np.arange(1, points[-1] + 1)
        return np.column_stack([np.interp(every, points, column) for column in values.T])


def view() -> "rrb.Spatial3DView":
    """Return the view, for the layout."""
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(
        name=TITLE,
        origin=ANTENNA,
        line_grid=rrb.LineGrid3D(spacing=0.1, color=(*GREY, 16)),
        # From above and behind the motor: positive angles turn to the left.
        eye_controls=rrb.EyeControls3D(
            position=(-0.30, 0.0, 1.05), look_target=(0.45, 0.0, -0.03), eye_up=(0.0, 0.0, 1.0)
        ),
        overrides={
            TRAIL: rrb.VisibleTimeRanges(
                timeline=TIMELINE,
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
        },
    )


def static_drawings() -> list["Drawing"]:
    """Return the static drawings: the motor, and the styles of the moving parts."""
    return [_draw_motor, _draw_direction, _draw_styles]


def lines(angle_rad: float, deflection: Real) -> npt.NDArray[np.float32]:
    """Return the undeformed line and the beam for drawing, in beam lengths.

    Parameters
    ----------
    angle_rad
        Angle of the motor.
    deflection
        Deflection at evenly spaced points of the beam, shape (points,), relative to the undeformed
        line, in beam lengths.

    Returns
    -------
    lines
        Coordinates x, y, z of the line and of the beam, shape (2, points, 3).
    """
    x = np.linspace(0.0, 1.0, deflection.size)
    drawn = np.zeros((2, x.size, 3), dtype=np.float32)
    drawn[:, :, 0] = x
    drawn[0, :, 1] = FACTOR * angle_rad * x
    drawn[1, :, 1] = FACTOR * (angle_rad * x + deflection)
    return drawn


def to_scale(angle_rad: float, deflection: Real) -> npt.NDArray[np.float32]:
    """Return the same as `lines`, but to scale.

    Parameters
    ----------
    angle_rad, deflection
        As for `lines`.
    """
    along = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    line = np.linspace(0.0, 1.0, deflection.size)[:, None] * along
    return np.stack([line, line + deflection[:, None] * across]).astype(np.float32)


def label(tip_m: float, *, to_scale: bool = False) -> str:
    """Return the text of the tip's deflection, with two significant digits or to 0.1 mm."""
    tip_mm = 1e3 * tip_m
    text = f"{tip_mm:.1f}" if tip_mm < 10 else f"{float(f'{tip_mm:.1e}'):.0f}"
    return f"tip deflection ± {text} mm, drawn {'to scale' if to_scale else f'× {FACTOR:g}'}"


def touch_label(touch: Mapping[str, Any]) -> str:
    """Return the label of a touch: its number and point.

    Parameters
    ----------
    touch
        Touch as in JSON documents.
    """
    point = touch["x_m"]
    return f"touch {touch['number']}: {with_half_width(point['value'], point['interval_95'])} m"


def _small_damping(beam: Beam) -> Damping:
    first_rad_s = float(undamped_frequencies_rad_s(beam, 1)[0])
    return Damping(zeta=2 * _ASSUMED_DAMPING_RATIO / first_rad_s)


def _draw_motor(stream: "RecordingStream") -> None:
    """Draw mount, housing, shaft, and the hub that clamps the beam."""
    import rerun as rr

    stream.log(
        f"{ANTENNA}/mount",
        rr.Boxes3D(
            centers=[(0, 0, -0.2)],
            half_sizes=[(0.1, 0.1, 0.01)],
            colors=[_METAL],
            fill_mode="solid",
        ),
        static=True,
    )
    stream.log(
        f"{ANTENNA}/motor",
        rr.Cylinders3D(
            centers=[(0, 0, -0.12), (0, 0, -0.035), (0, 0, 0)],
            lengths=[0.14, 0.05, 0.03],
            radii=[0.075, 0.025, 0.04],
            colors=[_HOUSING, _METAL, ORANGE],
            fill_mode="solid",
        ),
        static=True,
    )
    axis = [(0, 0, -0.3), (0, 0, 0.2)]
    stream.log(
        f"{ANTENNA}/axis",
        rr.LineStrips3D([axis], colors=[GREY], radii=rr.Radius.ui_points(0.5)),
        static=True,
    )


def _draw_direction(stream: "RecordingStream") -> None:
    """Draw an arrow in the direction of positive angles."""
    import rerun as rr

    angle = np.linspace(0.35, 1.05, 15)
    arc = 0.2 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)])
    end = arc[-1]
    back, out = 0.15 * np.array([end[1], -end[0], 0.0]), 0.075 * end
    stream.log(
        f"{ANTENNA}/positive",
        rr.LineStrips3D(
            [arc, [end + back + out, end, end + back - out]],
            colors=[GREY],
            radii=rr.Radius.ui_points(0.75),
        ),
        static=True,
    )
    stream.log(
        f"{ANTENNA}/positive/sign",
        rr.Points3D([1.25 * end], radii=[0.0], colors=[GREY], labels=["+"], show_labels=True),
        static=True,
    )


def _draw_styles(stream: "RecordingStream") -> None:
    """Send the constant properties once: colours, widths and the position of the label."""
    import rerun as rr

    for entity, colors, widths in ((BEAM, [GREY, SKY_BLUE], [1.0, 2.5]), (TRAIL, [_PAST], [0.6])):
        style = rr.LineStrips3D.from_fields(colors=colors, radii=rr.Radius.ui_points(widths))
        stream.log(entity, style, static=True)
    beyond_the_tip = [(1.25, 0.0, 0.0)]
    stream.log(
        LABEL,
        rr.Points3D.from_fields(
            positions=beyond_the_tip, radii=[0.0], colors=[SKY_BLUE], show_labels=True
        ),
        static=True,
    )


def _draw_lines(stream: "RecordingStream", entity: str, moments: Sequence[_Moment]) -> None:
    import rerun as rr

    t_ns = np.array([t_ns for t_ns, _ in moments])
    strips = np.concatenate([strips for _, strips in moments])
    count = len(strips) // len(moments)
    # Built here, because Rerun's own function for columns takes three times as long.
    column = rr.ComponentColumn(
        rr.LineStrips3D.descriptor_strips(),
        rr.components.LineStrip3DBatch(strips),
        offsets=np.arange(0, len(strips) + 1, count, dtype=np.int32),
    )
    time = rr.TimeColumn(TIMELINE, duration=t_ns.astype("timedelta64[ns]"))
    stream.send_columns(entity, [time], [column], strict=True)


def _draw_label(stream: "RecordingStream", t_ns: int, text: str) -> None:
    """Label the true deflection of the tip."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    stream.log(LABEL, rr.Points3D.from_fields(labels=[text]))


def _draw_touch(
    stream: "RecordingStream", number: int, t_ns: int, points: Real, arrow: Real, text: str
) -> None:
    """Draw a touch from its time on: point, interval along the beam, and force."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    point, ends = points[:1], points[1:]
    entity = f"{TOUCH}/{number}"
    stream.log(
        f"{entity}/interval",
        rr.LineStrips3D([ends], colors=[VERMILION], radii=rr.Radius.ui_points(4.0)),
    )
    stream.log(
        f"{entity}/point",
        rr.Points3D(point, radii=rr.Radius.ui_points(5.0), colors=[VERMILION]),
    )
    # Only the label of the last touch: labels of several passes would overlap.
    stream.log(
        f"{TOUCH}/label",
        rr.Points3D(point, radii=[0.0], colors=[VERMILION], labels=[text], show_labels=True),
    )
    stream.log(
        f"{entity}/force",
        rr.Arrows3D(
            origins=point - arrow,
            vectors=[arrow],
            colors=[VERMILION],
            radii=rr.Radius.ui_points(2.0),
        ),
    )
