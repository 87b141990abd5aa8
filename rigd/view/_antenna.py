"""The antenna in 3D: its motor, and the beam as it turns and bends, seen from behind the motor.

The bend is computed, from the measured angle and the exact model; no sensor sees it.

Lengths are drawn in beam lengths, so that every antenna fills the same picture. The beam points
along x and the motor turns it about z. What moves it across is drawn larger than it is, angle and
bend by the same factor: so nodes stay where they are, and a tip that rests is drawn at rest. Where
the motor goes far, in moves and searches, all is drawn to scale.
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
"""How many times larger than it is motion across the beam is drawn.

The paper's chirp turns the motor by 25 mrad, and when it passes the first resonance the tip swings
by a third of the beam's length: the one is still seen, the other still in the picture.
"""
_TO_SCALE: Final = ("move", "touch")
TITLE: Final = "Antenna"

DRAWN_HZ: Final = 20.0
TRAIL_S: Final = 0.5
"""Time that each drawn shape stays visible: the shapes show where the beam swings."""

_LOOKS_HZ: Final = 100.0
"""How often the tip is looked at for its largest deflection."""
_SELDOM_HZ: Final = 4.0
"""Rate at which slow items are sent: the label, and the trail."""
_LONGEST_GAP_S: Final = 10.0
"""Longest gap of missing samples that is filled."""
_ASSUMED_DAMPING_RATIO: Final = 2e-3
"""First mode's, where the profile has no damping; the least of the paper's fits has half."""

_REMEMBERED_S: Final = 30.0
"""For so long the shapes are kept on which a touch can be drawn."""
_ARROW_PER_N: Final = 0.2
_LONGEST_ARROW: Final = 0.4
"""Arrow of a contact force, in beam lengths."""

_HOUSING: Color = (105, 110, 120)
_METAL: Color = (140, 145, 155)
_PAST: Color = (70, 115, 145)


class Antenna:
    """Follows the beam of one session and draws it.

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
        self._look_ticks = max(1, round(subject.rate_hz / _LOOKS_HZ))
        looks_hz = subject.rate_hz / self._look_ticks
        self._looks_a_drawing = math.ceil(looks_hz / DRAWN_HZ)
        self._seldom_looks = math.ceil(looks_hz / _SELDOM_HZ)
        self._looks = 0
        lately = max(1, round(looks_hz * TRAIL_S))
        self._tips_m: collections.deque[float] = collections.deque(maxlen=lately)
        self._to_scale = subject.excitation in _TO_SCALE
        self._newest: tuple[int, Real] | None = None  # tick; time and angle
        self._waiting: Real = np.zeros((0, 2))  # times and angles since the last look
        self._trail: list[_Moment] = []  # not yet sent
        self._shapes: collections.deque[_Moment] = collections.deque(
            maxlen=round(_REMEMBERED_S * DRAWN_HZ)
        )

    def frame(self) -> list["Drawing"]:
        """Return the static drawings."""
        return static_drawings()

    def samples(self, samples: Records) -> list["Drawing"]:
        """Take samples (n,) of ``SAMPLE_DTYPE``, in order; across gaps the angle is interpolated.

        What comes back draws the beam at 20 moments a second.
        """
        if len(samples) == 0:
            return []
        samples = np.concatenate([self._waiting, self._at_every_tick(samples)])
        looks = len(samples) // self._look_ticks
        self._waiting = samples[looks * self._look_ticks :]
        moments: list[_Moment] = []
        labels: list[Drawing] = []
        for look in samples[: looks * self._look_ticks].reshape(looks, self._look_ticks, 2):
            deflection_m = self._filter.feed(look[:, 1])
            self._tips_m.append(abs(float(deflection_m[-1])))
            self._looks += 1
            t_ns, angle_rad = int(look[-1, 0]), float(look[-1, 1])
            if self._looks % self._looks_a_drawing == 0:
                deflection = deflection_m / self._length_m
                drawn = (to_scale if self._to_scale else lines)(angle_rad, deflection)
                moments.append((t_ns, drawn))
            if self._looks % self._seldom_looks == 0:
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
        """Draw the point of a touch, its interval and the force on the beam as it was then.

        Parameters
        ----------
        touch
            As in JSON documents. Without point and time, and without the shape of that time,
            nothing is drawn.
        """
        point, time = touch.get("x_m"), touch.get("time_s")
        shapes = list(self._shapes)
        if point is None or time is None or len(shapes) < 2:
            return []
        t_ns = round(1e9 * time["value"])
        after = next((i for i in range(1, len(shapes)) if shapes[i][0] >= t_ns), len(shapes) - 1)
        (earlier_ns, earlier), (later_ns, later) = shapes[after - 1], shapes[after]
        if t_ns < earlier_ns:
            return []  # no shape of that time is left
        share = min((t_ns - earlier_ns) / (later_ns - earlier_ns), 1.0)
        beam = (1 - share) * earlier[1] + share * later[1]
        moved = later[1] - earlier[1]
        along = np.linspace(0.0, 1.0, len(beam))
        x = np.array([point["value"], *point["interval_95"]]) / self._length_m
        places, ahead = (
            np.column_stack([np.interp(x, along, axis) for axis in each.T])
            for each in (beam, moved)
        )
        force = touch.get("force_n")
        size = 0.0 if force is None else min(_ARROW_PER_N * abs(force["value"]), _LONGEST_ARROW)
        # An obstacle pushes against the motion that met it.
        way = float(np.linalg.norm(ahead[0]))
        arrow = -size / way * ahead[0] if way > 0 else np.zeros(3)
        return [
            partial(
                _draw_touch,
                number=int(touch["number"]),
                t_ns=t_ns,
                places=places,
                arrow=arrow,
                text=touch_label(touch),
            )
        ]

    def _at_every_tick(self, samples: Records) -> Real:
        """Fill gaps; return times in ns and angles in rad since the sample before, (n, 2)."""
        ticks = samples["tick"].astype(np.int64)
        values = np.column_stack([samples["t_ns"], samples["angle_rad"]])
        tick, value = self._newest or (int(ticks[0]) - 1, values[0])
        self._newest = int(ticks[-1]), values[-1]
        steps = np.minimum(np.diff(ticks, prepend=tick), round(_LONGEST_GAP_S * self._rate_hz))
        if np.all(steps == 1):
            return values
        places, values = np.cumsum(np.append(0, steps)), np.vstack([value, values])
        every = np.arange(1, places[-1] + 1)
        return np.column_stack([np.interp(every, places, column) for column in values.T])


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
    """Return what stays as it is: the motor, and how that looks which moves."""
    return [_draw_motor, _draw_direction, _draw_styles]


def lines(angle_rad: float, deflection: Real) -> npt.NDArray[np.float32]:
    """Return the undeformed line and the beam as they are drawn, in beam lengths.

    Parameters
    ----------
    angle_rad
        Angle of the motor.
    deflection
        Shape (points,), evenly along the beam, relative to the line that its root points along; in
        beam lengths.

    Returns
    -------
    lines
        Shape (2, points, 3): the line, the beam; x, y, z of their points.
    """
    x = np.linspace(0.0, 1.0, deflection.size)
    drawn = np.zeros((2, x.size, 3), dtype=np.float32)
    drawn[:, :, 0] = x
    drawn[0, :, 1] = FACTOR * angle_rad * x
    drawn[1, :, 1] = FACTOR * (angle_rad * x + deflection)
    return drawn


def to_scale(angle_rad: float, deflection: Real) -> npt.NDArray[np.float32]:
    """Return the same as `lines`, turned and bent as they are.

    Parameters
    ----------
    angle_rad, deflection
        See `lines`.
    """
    along = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    line = np.linspace(0.0, 1.0, deflection.size)[:, None] * along
    return np.stack([line, line + deflection[:, None] * across]).astype(np.float32)


def label(tip_m: float, *, to_scale: bool = False) -> str:
    """Return the text of the tip's deflection, to two figures or 0.1 mm."""
    tip_mm = 1e3 * tip_m
    text = f"{tip_mm:.1f}" if tip_mm < 10 else f"{float(f'{tip_mm:.1e}'):.0f}"
    return f"tip deflection ± {text} mm, drawn {'to scale' if to_scale else f'× {FACTOR:g}'}"


def touch_label(touch: Mapping[str, Any]) -> str:
    """Return the text at a touch: its number and point.

    Parameters
    ----------
    touch
        As in JSON documents.
    """
    point = touch["x_m"]
    return f"touch {touch['number']}: {with_half_width(point['value'], point['interval_95'])} m"


def _small_damping(beam: Beam) -> Damping:
    first_rad_s = float(undamped_frequencies_rad_s(beam, 1)[0])
    return Damping(zeta=2 * _ASSUMED_DAMPING_RATIO / first_rad_s)


def _draw_motor(stream: "RecordingStream") -> None:
    """Draw, from below, the mount, the housing, the shaft and the hub that clamps the beam."""
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
    """Draw an arrow that turns as positive angles do."""
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
    """Send once what is the same at all moments: colours, widths, where the label stands."""
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
    # Put together by hand: Rerun's own way of making columns takes three times as long.
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
    stream: "RecordingStream", number: int, t_ns: int, places: Real, arrow: Real, text: str
) -> None:
    """Draw from the time of a touch on: point, interval along the beam, and force."""
    import rerun as rr

    stream.set_time(TIMELINE, duration=1e-9 * t_ns)
    point, ends = places[:1], places[1:]
    entity = f"{TOUCH}/{number}"
    stream.log(
        f"{entity}/interval",
        rr.LineStrips3D([ends], colors=[VERMILION], radii=rr.Radius.ui_points(4.0)),
    )
    stream.log(
        f"{entity}/point",
        rr.Points3D(point, radii=rr.Radius.ui_points(5.0), colors=[VERMILION]),
    )
    # Of the last touch alone: those of several passes would stand on one another.
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
