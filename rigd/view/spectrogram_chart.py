"""The spectrogram of the coupling torque, as an image that grows along its time axis."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.view.chart import Axis, Chart, steps
from rigd.view.plots import TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.view.subject import Subject

Real = npt.NDArray[np.float64]

SPECTROGRAM: Final = "/spectrogram"
SIZE: Final = (1280.0, 677.0)
"""Width and height of the canvas, in points."""

LOWEST_DB, HIGHEST_DB = -80.0, 0.0
"""Levels, in dB re 1 N·m, at the two ends of the colours."""
MOST_COLUMNS: Final = 300
"""Of the image: more than that many columns are merged, the highest level kept."""

_BAR = 28.0
"""Width of the bar of colours, in points."""
_BESIDE = 120.0
"""Room for the bar and its labels."""


class SpectrogramChart:
    """The chart of one session's spectrogram.

    Parameters
    ----------
    subject
        The session.
    frequency_hz
        (m,) of the columns' levels, evenly spaced from 0.
    step_s
        Time between columns.

    Attributes
    ----------
    chart
        Where it is drawn.
    """

    def __init__(self, subject: "Subject", frequency_hz: Real, step_s: float) -> None:
        duration_s = max(subject.ticks / subject.rate_hz, step_s)
        self._slot_s = max(step_s, duration_s / MOST_COLUMNS)
        slots = int(np.ceil(duration_s / self._slot_s))
        end_s = slots * self._slot_s
        half_row_hz = float(frequency_hz[1] - frequency_hz[0]) / 2
        end_hz = float(frequency_hz[-1]) + half_row_hz
        self._lowest_hz = float(frequency_hz[1]) - half_row_hz
        width, height = SIZE
        self.chart = Chart(
            SPECTROGRAM,
            width,
            height,
            Axis("Time since the start of the session (s)", 0.0, end_s, steps(0.0, end_s, 15)),
            Axis("Frequency (Hz)", 0.0, end_hz, steps(0.0, end_hz, 8)),
            right=_BESIDE,
        )
        self._bar = Chart(
            f"{SPECTROGRAM}/bar",
            width,
            height,
            Axis("", 0.0, 1.0, ()),
            Axis("dB re 1 N·m", LOWEST_DB, HIGHEST_DB, steps(LOWEST_DB, HIGHEST_DB, 8)),
            left=width - _BAR - 24.0,
        )
        # Row 0 is on top. Without the mean of the torque, which is no motion.
        self._image = np.zeros((frequency_hz.size - 1, slots), np.uint8)
        self._filled = 0
        self._t_ns = 0

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """Levels that have been taken, 0–255, (frequencies from the highest down, times)."""
        return self._image[:, : self._filled]

    def draw_frame(self, stream: "RecordingStream") -> None:
        """Draw what stays as it is: the axes, and the bar that tells what the colours mean."""
        corners = self.chart.place([0.0, self.chart.x.last], [self._lowest_hz, self.chart.y.last])
        _place_image(stream, f"{SPECTROGRAM}/levels", corners, self._image.shape)
        corners = self._bar.place([0.0, 1.0], [LOWEST_DB, HIGHEST_DB])
        bar = np.arange(255, -1, -1, dtype=np.uint8)[:, None]
        _place_image(stream, f"{SPECTROGRAM}/colors", corners, bar.shape)
        _send_image(stream, f"{SPECTROGRAM}/colors", bar, static=True)
        self.chart.draw_frame(stream)
        self._bar.draw_frame(stream)

    def update(self, t_ns: int, columns: Sequence[tuple[float, Real]]) -> None:
        """Take columns: the middle of their window in s, and their levels (m,) in dB re 1 N·m."""
        self._t_ns = t_ns
        for time_s, level_db in columns:
            slot = min(max(int(time_s / self._slot_s), 0), self._image.shape[1] - 1)
            share = (level_db[:0:-1] - LOWEST_DB) / (HIGHEST_DB - LOWEST_DB)
            column = (255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
            np.maximum(self._image[:, slot], column, out=self._image[:, slot])
            self._filled = max(self._filled, slot + 1)

    def draw(self, stream: "RecordingStream") -> None:
        """Draw what has been taken so far."""
        if self._filled:
            stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
            _send_image(stream, f"{SPECTROGRAM}/levels", self.image)


def _place_image(
    stream: "RecordingStream", entity: str, corners: Real, shape: tuple[int, ...]
) -> None:
    """Say where an image of levels (0–255) lies, and in which colours.

    Parameters
    ----------
    stream, entity
        Where to say it.
    corners
        Bottom left and top right on the canvas, (2, 2).
    shape
        Rows and columns of the image.
    """
    import rerun as rr

    (left, bottom), (right, top) = corners
    rows, columns = shape
    stream.log(
        entity,
        rr.DepthImage.from_fields(
            colormap=rr.components.Colormap.Viridis, depth_range=(0.0, 255.0), draw_order=0.0
        ),
        rr.Transform3D(
            translation=[left, top, 0.0],
            scale=[(right - left) / columns, (bottom - top) / rows, 1.0],
        ),
        static=True,
    )


def _send_image(
    stream: "RecordingStream", entity: str, levels: npt.NDArray[np.uint8], *, static: bool = False
) -> None:
    import rerun as rr

    rows, columns = levels.shape
    stream.log(
        entity,
        rr.DepthImage.from_fields(
            buffer=levels.tobytes(),
            format=rr.components.ImageFormat(
                width=columns, height=rows, channel_datatype=rr.ChannelDatatype.U8
            ),
        ),
        static=static,
    )
