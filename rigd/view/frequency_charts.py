"""Charts of a session's frequency response so far, with the nominal model, and spectrogram."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Damping
from rigd.spectral import PHASE_START_DEG, CurveDecimation, magnitude_db, phase_deg
from rigd.sweep_response import (
    HIGHEST_SHOWN_HZ,
    LOW_COHERENCE,
    LOWEST_SHOWN_HZ,
    nominal_response,
    response_decimation,
)
from rigd.view.chart import Axis, Chart, LegendEntry, decade_ticks, round_ticks
from rigd.view.plots import GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.spectral import FrequencyResponse, RunningEstimate
    from rigd.view._session_info import SessionDescription


RealArray = npt.NDArray[np.float64]
"""Array of real numbers."""
ComplexArray = npt.NDArray[np.complex128]
"""Array of complex numbers."""


# Frequency response

OVERVIEW_MAGNITUDE_ENTITY: Final = "/overview/magnitude"
"""Entity path in Rerun of the magnitude's chart in the tab Overview."""
MAGNITUDE_ENTITY: Final = "/frequency_response/magnitude"
"""Entity path in Rerun of the magnitude's chart."""
PHASE_ENTITY: Final = "/frequency_response/phase"
"""Entity path in Rerun of the phase's chart."""
COHERENCE_ENTITY: Final = "/frequency_response/coherence"
"""Entity path in Rerun of the coherence's chart."""
CHART_SIZES: Final = {
    OVERVIEW_MAGNITUDE_ENTITY: (690.0, 285.0),
    MAGNITUDE_ENTITY: (1280.0, 374.0),
    PHASE_ENTITY: (640.0, 274.0),
    COHERENCE_ENTITY: (640.0, 274.0),
}
"""Width and height of each chart's canvas in points, by entity path."""

MEASURED_ENTRY: Final = LegendEntry("measured", SKY_BLUE)
"""Legend entry of the measured response."""
UNCERTAIN_ENTRY: Final = LegendEntry("low coherence", GREY)
"""Legend entry of the measured response with a coherence below `LOW_COHERENCE`."""
MODEL_ENTRY: Final = LegendEntry("nominal model", ORANGE, width=3.0)
"""Legend entry of the response of the nominal model."""
LAST_SESSION_ENTRY: Final = LegendEntry("last session", PURPLE)
"""Legend entry of the response of the last session of the same specimen."""
COHERENCE_ENTRY: Final = LegendEntry("coherence", GREEN)
"""Legend entry of the coherence."""
NOT_ESTIMATED_ENTRY: Final = LegendEntry("not estimated", GREY, is_area=True)
"""Legend entry of the frequency bands that the reference has not excited so far."""

NO_COHERENCE_YET_TEXT: Final = "Coherence begins with the second segment"
"""Text in the coherence chart of a running session before the end of the second segment."""
NO_COHERENCE_TEXT: Final = "A single segment gives no coherence"
"""Text in the coherence chart of a finished response from a single segment."""

_MAX_FOUR_ENTRY_CHART_WIDTH_PT: Final = 700.0
"""Width in points above which a chart's legend has room for a fifth entry."""
_SHADE_NAMES: Final = ("not_estimated_below", "not_estimated_above")
"""Names of the shaded areas over the bands that are not estimated."""
PHASE_AXIS: Final = Axis(
    "Phase (degrees)",
    PHASE_START_DEG,
    PHASE_START_DEG + 360.0,
    (-90.0, 0.0, 90.0, 180.0, 270.0),
)
"""Vertical axis of the phase."""
COHERENCE_AXIS: Final = Axis("Coherence (1)", 0.0, 1.0, (0.0, 0.2, 0.4, 0.6, 0.8, 1.0))
"""Vertical axis of the coherence."""
_MAGNITUDE_TICK_STEP_DB: Final = 20.0
"""Distance between ticks of a magnitude axis, in dB."""
_ASSUMED_DAMPING: Final = Damping(zeta=3e-4)
"""Damping from which the magnitude axis is computed if the beam's damping is unknown."""
_MAX_MAGNITUDE_RANGE_DB: Final = 140.0
"""Largest range of a magnitude axis, in dB."""


@dataclass(frozen=True, slots=True, eq=False)
class LastResponse:
    """Frequency response of an earlier session of the specimen.

    Attributes
    ----------
    session, specimen
        Name of the earlier session and name of its specimen.
    frequency_hz
        Increasing frequencies, shape (n,).
    response
        Torque over angle in N·m/rad, complex, shape (n,); NaN if not estimated.
    """

    session: str
    specimen: str
    frequency_hz: RealArray
    response: ComplexArray


@dataclass(frozen=True, slots=True)
class _ResponseCurve:
    """Measured magnitude, phase or coherence over frequency, and the chart that contains it."""

    chart: Chart
    """Chart that contains the curve."""
    legend_entry: LegendEntry
    """Label and style of the curve."""
    values_of_response: Callable[["FrequencyResponse"], RealArray]
    """Function that returns the curve's values for an estimated response."""
    values_of_complex: Callable[[ComplexArray], RealArray] | None = None
    """Function that returns the curve's values for a complex response; None for the coherence."""


class ResponseCharts:
    """Charts of a session's frequency response: magnitude, phase and coherence.

    Parameters
    ----------
    session
        The session.
    last_response
        Response of the last session of the specimen, which is drawn beneath the present one; None
        if there is none.
    """

    def __init__(
        self, session: "SessionDescription", last_response: LastResponse | None = None
    ) -> None:
        frequency_hz, model_response = nominal_response(
            session.beam, session.damping or _ASSUMED_DAMPING, session.tool_inertia_kg_m2
        )
        model_magnitude_db = magnitude_db(model_response)
        magnitude_chart_axis = magnitude_axis(
            model_magnitude_db.min() - 3.0, model_magnitude_db.max() + 6.0
        )
        is_damping_known = session.damping is not None
        optional_entries = ((MODEL_ENTRY,) if is_damping_known else ()) + (
            (LAST_SESSION_ENTRY,) if last_response else ()
        )
        legend_entries = (MEASURED_ENTRY, UNCERTAIN_ENTRY, *optional_entries)
        # The title of the view names the quantity.
        axis_with_short_title = replace(magnitude_chart_axis, title="dB re 1 N·m/rad")
        self._response_curves = (
            *(
                _ResponseCurve(
                    _response_chart(entity_path, vertical_axis, *legend_entries),
                    MEASURED_ENTRY,
                    _magnitude_db,
                    magnitude_db,
                )
                for entity_path, vertical_axis in (
                    (OVERVIEW_MAGNITUDE_ENTITY, axis_with_short_title),
                    (MAGNITUDE_ENTITY, magnitude_chart_axis),
                )
            ),
            _ResponseCurve(
                _response_chart(PHASE_ENTITY, PHASE_AXIS, *legend_entries),
                MEASURED_ENTRY,
                _phase_deg,
                phase_deg,
            ),
            _ResponseCurve(
                _response_chart(COHERENCE_ENTITY, COHERENCE_AXIS, COHERENCE_ENTRY),
                COHERENCE_ENTRY,
                _coherence,
            ),
        )
        self._delays_s = {
            "input_delay_s": session.angle_delay_s,
            "output_delay_s": session.torque_delay_s,
        }
        decimation = response_decimation(frequency_hz)
        magnitude_strips = decimation.curve_strips(model_magnitude_db)
        self._models = (
            {
                OVERVIEW_MAGNITUDE_ENTITY: magnitude_strips,
                MAGNITUDE_ENTITY: magnitude_strips,
                PHASE_ENTITY: decimation.curve_strips(phase_deg(model_response)),
            }
            if is_damping_known
            else {}
        )
        self._last_curves = (
            {}
            if last_response is None
            else _last_response_curves(last_response, self._response_curves)
        )
        self._thinning: CurveDecimation | None = None
        self._t_ns = 0
        self._last_update: tuple[RealArray, ComplexArray] | None = None
        self._curves: dict[str, Sequence[RealArray]] = {}
        self._uncertain: dict[str, Sequence[RealArray]] = {}
        self._excited_hz = (HIGHEST_SHOWN_HZ, HIGHEST_SHOWN_HZ)
        self._note = NO_COHERENCE_YET_TEXT

    def chart(self, entity_path: str) -> Chart:
        """Return the chart with a given entity path in Rerun."""
        return next(
            response_curve.chart
            for response_curve in self._response_curves
            if response_curve.chart.entity == entity_path
        )

    def draw_frames(self, stream: "RecordingStream") -> None:
        """Send the static parts: frames, nominal model and the last session's response."""
        for response_curve in self._response_curves:
            response_curve.chart.draw_frame(stream)
            for curve_name in _SHADE_NAMES:
                response_curve.chart.draw_shade(stream, curve_name)
            if response_curve.chart.entity in self._models:
                response_curve.chart.draw_curve(
                    stream,
                    "model",
                    self._models[response_curve.chart.entity],
                    MODEL_ENTRY,
                    static=True,
                )
            if response_curve.chart.entity in self._last_curves:
                response_curve.chart.draw_curve(
                    stream,
                    "last",
                    self._last_curves[response_curve.chart.entity],
                    LAST_SESSION_ENTRY,
                    static=True,
                    curve_order=1,
                )

    def update(self, t_ns: int, estimate: "RunningEstimate") -> None:
        """Compute the curves of a new estimate, which `draw` then sends.

        Parameters
        ----------
        t_ns
            Time since the start of the session.
        estimate
            Response estimated so far.
        """
        corrected_response = estimate.response.without_delays(**self._delays_s)
        frequency_hz = corrected_response.frequency_hz
        if self._thinning is None or self._thinning.grid.size != frequency_hz.size:
            self._thinning = response_decimation(frequency_hz)
        is_excited = estimate.is_excited
        self._t_ns = t_ns
        self._last_update = frequency_hz, np.where(is_excited, corrected_response.response, np.nan)
        is_coherent = is_excited
        if corrected_response.coherence is not None:
            is_coherent = is_excited & (corrected_response.coherence >= LOW_COHERENCE)
        decimate_to_strips = self._thinning.curve_strips
        self._curves, self._uncertain = {}, {}
        for response_curve in self._response_curves:
            curve_values, entity_path = (
                response_curve.values_of_response(corrected_response),
                response_curve.chart.entity,
            )
            # The coherence itself is always reliable.
            is_reliable = is_coherent if response_curve.values_of_complex else is_excited
            self._curves[entity_path] = decimate_to_strips(
                np.where(is_reliable, curve_values, np.nan)
            )
            if response_curve.values_of_complex:
                self._uncertain[entity_path] = decimate_to_strips(
                    np.where(is_excited, curve_values, np.nan)
                )
        excited_ends_hz = (
            frequency_hz[is_excited][[0, -1]]
            if is_excited.any()
            else (HIGHEST_SHOWN_HZ, HIGHEST_SHOWN_HZ)
        )
        self._excited_hz = float(excited_ends_hz[0]), float(excited_ends_hz[1])
        no_coherence_text = NO_COHERENCE_TEXT if estimate.is_final else NO_COHERENCE_YET_TEXT
        self._note = no_coherence_text if corrected_response.coherence is None else ""

    def draw(self, stream: "RecordingStream") -> None:
        """Send the curves that the last `update` computed to Rerun, at their session time."""
        stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
        for response_curve in self._response_curves:
            chart = response_curve.chart
            if response_curve.values_of_complex:
                # The whole curve lies beneath, so that there is no gap at a change of colour.
                uncertain_strips = self._uncertain.get(chart.entity, ())
                chart.draw_curve(stream, "uncertain", uncertain_strips, UNCERTAIN_ENTRY)
            measured_strips = self._curves.get(chart.entity, ())
            chart.draw_curve(
                stream, "measured", measured_strips, response_curve.legend_entry, curve_order=1
            )
            unexcited_band_ends_hz = (LOWEST_SHOWN_HZ, *self._excited_hz, HIGHEST_SHOWN_HZ)
            for name, first_hz, last_hz in zip(
                _SHADE_NAMES, unexcited_band_ends_hz[::2], unexcited_band_ends_hz[1::2], strict=True
            ):
                chart.move_shade(stream, name, first_hz, last_hz)
        self.chart(COHERENCE_ENTITY).draw_note(stream, self._note, COHERENCE_ENTRY.color)

    def as_last_response(self, session: "SessionDescription") -> LastResponse | None:
        """Return the newest frequency response, for comparison with a later session.

        The result is None before the first estimate.

        Parameters
        ----------
        session
            Session of these charts.
        """
        if self._last_update is None:
            return None
        return LastResponse(session.name, session.specimen, *self._last_update)


def _last_response_curves(
    last_response: LastResponse, response_curves: "Sequence[_ResponseCurve]"
) -> dict[str, Sequence[RealArray]]:
    """Return the curves of an earlier session's response: entity path of the chart → strips."""
    decimation = response_decimation(last_response.frequency_hz)
    return {
        response_curve.chart.entity: decimation.curve_strips(
            response_curve.values_of_complex(last_response.response)
        )
        for response_curve in response_curves
        if response_curve.values_of_complex
    }


def _magnitude_db(response: "FrequencyResponse") -> RealArray:
    """Return the magnitude of an estimated response, in dB re 1 N·m/rad."""
    return magnitude_db(response.response)


def _phase_deg(response: "FrequencyResponse") -> RealArray:
    """Return the phase of an estimated response, in degrees."""
    return phase_deg(response.response)


def _coherence(response: "FrequencyResponse") -> RealArray:
    """Return the coherence of an estimated response; NaN if it comes from a single segment."""
    if response.coherence is None:
        return np.full(response.frequency_hz.shape, np.nan)
    return response.coherence


def magnitude_axis(lowest_db: float, highest_db: float) -> Axis:
    """Return the axis of magnitudes in dB, with ticks every 20 dB and at most 140 dB long.

    Parameters
    ----------
    lowest_db, highest_db
        Range of the magnitudes, in dB re 1 N·m/rad. If the range is larger than the axis, the axis
        begins above the lowest magnitude.
    """
    axis_end_db = _MAGNITUDE_TICK_STEP_DB * np.ceil(highest_db / _MAGNITUDE_TICK_STEP_DB)
    axis_start_db = max(
        _MAGNITUDE_TICK_STEP_DB * np.floor(lowest_db / _MAGNITUDE_TICK_STEP_DB),
        axis_end_db - _MAX_MAGNITUDE_RANGE_DB,
    )
    tick_levels_db = round_ticks(
        axis_start_db,
        axis_end_db,
        max(1, round((axis_end_db - axis_start_db) / _MAGNITUDE_TICK_STEP_DB)),
    )
    return Axis(
        "Magnitude (dB re 1 N·m/rad)", float(axis_start_db), float(axis_end_db), tick_levels_db
    )


def response_chart(
    entity_path: str,
    chart_size: tuple[float, float],
    band_hz: tuple[float, float],
    vertical_axis: Axis,
    *legend_entries: LegendEntry,
) -> Chart:
    """Return a chart with a logarithmic frequency axis.

    Parameters
    ----------
    entity_path
        Entity path of the chart in Rerun.
    chart_size
        Width and height of the canvas, in points.
    band_hz
        Lowest and highest frequency of the axis, above 0.
    vertical_axis
        Vertical axis.
    *legend_entries
        Entries of the legend, in reading order.
    """
    tick_values, grid_lines = decade_ticks(*band_hz)
    frequency_axis = Axis("Frequency (Hz)", *band_hz, tick_values, grid_lines, is_logarithmic=True)
    return Chart(entity_path, *chart_size, frequency_axis, vertical_axis, legend_entries)


def _response_chart(entity_path: str, vertical_axis: Axis, *legend_entries: LegendEntry) -> Chart:
    """Return a chart of the frequency response, with "not estimated" in the legend if it fits."""
    chart_size = CHART_SIZES[entity_path]
    if (
        LAST_SESSION_ENTRY not in legend_entries or chart_size[0] > _MAX_FOUR_ENTRY_CHART_WIDTH_PT
    ):  # there is room for another entry
        legend_entries = (*legend_entries, NOT_ESTIMATED_ENTRY)
    return response_chart(
        entity_path, chart_size, (LOWEST_SHOWN_HZ, HIGHEST_SHOWN_HZ), vertical_axis, *legend_entries
    )


# Spectrogram

SPECTROGRAM_ENTITY: Final = "/spectrogram"
"""Entity path of the spectrogram in Rerun."""
SPECTROGRAM_CANVAS_SIZE: Final = (1280.0, 677.0)
"""Width and height of the spectrogram's canvas, in points."""

LOWEST_DB, HIGHEST_DB = -80.0, 0.0
"""Levels at the lower and upper end of the colour scale, in dB re 1 N·m."""
MAX_SPECTROGRAM_COLUMNS: Final = 300
"""Largest number of columns of the spectrogram.

In longer sessions, a column shows the highest level of several time windows."""

_COLOR_BAR_WIDTH_PT = 28.0
"""Width of the colour bar, in points."""
_COLOR_BAR_MARGIN_PT = 120.0
"""Margin for the colour bar and its labels, in points."""


class SpectrogramChart:
    """Chart of a session's spectrogram, with its colour bar.

    Parameters
    ----------
    session
        The session.
    frequency_hz
        Frequencies of the rows in Hz, shape (m,), evenly spaced from 0.
    step_s
        Time between adjacent columns.

    Attributes
    ----------
    chart
        Axes of the spectrogram.
    """

    def __init__(
        self, session: "SessionDescription", frequency_hz: RealArray, step_s: float
    ) -> None:
        duration_s = max(session.scheduled_ticks / session.rate_hz, step_s)
        self._column_s = max(step_s, duration_s / MAX_SPECTROGRAM_COLUMNS)
        column_count = int(np.ceil(duration_s / self._column_s))
        time_axis_end_s = column_count * self._column_s
        half_bin_hz = float(frequency_hz[1] - frequency_hz[0]) / 2
        frequency_axis_end_hz = float(frequency_hz[-1]) + half_bin_hz
        self._lowest_hz = float(frequency_hz[1]) - half_bin_hz
        canvas_width, canvas_height = SPECTROGRAM_CANVAS_SIZE
        self.chart = Chart(
            SPECTROGRAM_ENTITY,
            canvas_width,
            canvas_height,
            Axis(
                "Time since the start of the session (s)",
                0.0,
                time_axis_end_s,
                round_ticks(0.0, time_axis_end_s, 15),
            ),
            Axis(
                "Frequency (Hz)",
                0.0,
                frequency_axis_end_hz,
                round_ticks(0.0, frequency_axis_end_hz, 8),
            ),
            right_margin=_COLOR_BAR_MARGIN_PT,
        )
        self._bar = Chart(
            f"{SPECTROGRAM_ENTITY}/bar",
            canvas_width,
            canvas_height,
            Axis("", 0.0, 1.0, ()),
            Axis("dB re 1 N·m", LOWEST_DB, HIGHEST_DB, round_ticks(LOWEST_DB, HIGHEST_DB, 8)),
            left_margin=canvas_width - _COLOR_BAR_WIDTH_PT - 24.0,
        )
        # Row 0 is at the top. The mean torque is omitted, because it is no motion.
        self._image = np.zeros((frequency_hz.size - 1, column_count), np.uint8)
        self._filled_column_count = 0
        self._t_ns = 0

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """Levels of the spectrogram so far as bytes (0–255), shape (frequencies, times).

        The first row belongs to the highest frequency.
        """
        return self._image[:, : self._filled_column_count]

    def draw_frame(self, stream: "RecordingStream") -> None:
        """Send the static parts of the chart: the axes and the colour bar."""
        image_corners = self.chart.to_canvas(
            [0.0, self.chart.x.end_value], [self._lowest_hz, self.chart.y.end_value]
        )
        _position_image(stream, f"{SPECTROGRAM_ENTITY}/levels", image_corners, self._image.shape)
        image_corners = self._bar.to_canvas([0.0, 1.0], [LOWEST_DB, HIGHEST_DB])
        bar_levels = np.arange(255, -1, -1, dtype=np.uint8)[:, None]
        _position_image(stream, f"{SPECTROGRAM_ENTITY}/colors", image_corners, bar_levels.shape)
        _send_image(stream, f"{SPECTROGRAM_ENTITY}/colors", bar_levels, static=True)
        self.chart.draw_frame(stream)
        self._bar.draw_frame(stream)

    def update(self, t_ns: int, level_columns: Sequence[tuple[float, RealArray]]) -> None:
        """Add columns to the spectrogram, which `draw` then sends.

        Parameters
        ----------
        t_ns
            Time since the start of the session.
        level_columns
            Time in s of the middle of each column's window, and the column's levels (m,) in dB re 1
            N·m.
        """
        self._t_ns = t_ns
        for time_s, level_db in level_columns:
            column_index = min(max(int(time_s / self._column_s), 0), self._image.shape[1] - 1)
            level_fractions = (level_db[:0:-1] - LOWEST_DB) / (HIGHEST_DB - LOWEST_DB)
            byte_column = (255.0 * np.clip(level_fractions, 0.0, 1.0)).astype(np.uint8)
            np.maximum(self._image[:, column_index], byte_column, out=self._image[:, column_index])
            self._filled_column_count = max(self._filled_column_count, column_index + 1)

    def draw(self, stream: "RecordingStream") -> None:
        """Send the columns of the spectrogram so far to Rerun."""
        if self._filled_column_count:
            stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
            _send_image(stream, f"{SPECTROGRAM_ENTITY}/levels", self.image)


def _position_image(
    stream: "RecordingStream",
    entity_path: str,
    image_corners: RealArray,
    image_shape: tuple[int, ...],
) -> None:
    """Send the position and the colour map of an image to Rerun.

    `image_corners` contains the bottom left and the top right corner on the canvas, shape (2, 2).
    `image_shape` contains the number of rows and columns.
    """
    import rerun as rr

    (left_edge, bottom_edge), (right_edge, top_edge) = image_corners
    row_count, column_count = image_shape
    stream.log(
        entity_path,
        rr.DepthImage.from_fields(
            colormap=rr.components.Colormap.Viridis, depth_range=(0.0, 255.0), draw_order=0.0
        ),
        rr.Transform3D(
            translation=[left_edge, top_edge, 0.0],
            scale=[
                (right_edge - left_edge) / column_count,
                (bottom_edge - top_edge) / row_count,
                1.0,
            ],
        ),
        static=True,
    )


def _send_image(
    stream: "RecordingStream",
    entity_path: str,
    image_levels: npt.NDArray[np.uint8],
    *,
    static: bool = False,
) -> None:
    """Send an image of levels (0–255) to Rerun."""
    import rerun as rr

    row_count, column_count = image_levels.shape
    stream.log(
        entity_path,
        rr.DepthImage.from_fields(
            buffer=image_levels.tobytes(),
            format=rr.components.ImageFormat(
                width=column_count, height=row_count, channel_datatype=rr.ChannelDatatype.U8
            ),
        ),
        static=static,
    )
