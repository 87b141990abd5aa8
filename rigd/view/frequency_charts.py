"""Charts over frequency: the growing frequency response with the nominal model, spectrogram."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping, transfer
from rigd.session.layout import Status
from rigd.spectral import RunningEstimate, RunningResponse, segmentation_of
from rigd.view.chart import Axis, Chart, Key, Thinning, decades, steps
from rigd.view.plots import GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.spectral import FrequencyResponse, RunningEstimate
    from rigd.view._session_info import Subject


Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]


# Estimate

_HELD: Final = Status.ANGLE_STALE | Status.WRENCH_STALE


class SweepResponse:
    """Welch estimate of torque over angle, with the default segments of `analyze`.

    Parameters
    ----------
    subject
        The session.
    last_hz
        Highest frequency of the response.
    every
        Divisor of the number of `analyze`'s bins, as far as the segments allow.
    """

    def __init__(self, subject: "Subject", last_hz: float, *, every: int = 1) -> None:
        self._first, end = subject.sweep
        samples = end - self._first
        chosen = segmentation_of(samples, subject.rate_hz)
        chosen = replace(chosen, nfft=max(chosen.nfft // every, chosen.segment_length))
        self._running = RunningResponse(
            subject.rate_hz, samples, last_hz=last_hz, segmentation=chosen
        )
        self._at_rest: list[npt.NDArray[np.float64]] = []
        self._rest_rad: float | None = None

    def feed(self, samples: npt.NDArray[Any]) -> None:
        """Add samples (n,) of ``SAMPLE_DTYPE``, in order; there may be gaps."""
        ticks = samples["tick"].astype(np.int64) - self._first
        before = int(np.searchsorted(ticks, 0))
        if before:
            self._at_rest.append(samples["angle_rad"][:before].copy())
        if before == len(samples):
            return
        # A constant angle causes no torque of the beam, but would leak into the lowest bins.
        if self._rest_rad is None:
            self._rest_rad = float(np.median(np.concatenate(self._at_rest or [np.zeros(1)])))
            self._at_rest = []
        swept = samples[before:]
        # A stale reading is not a measurement: its gap is filled like any other.
        known = np.where(swept["status"] & _HELD, np.nan, 1.0)
        self._running.feed(
            ticks[before:],
            swept["angle_reference_rad"] - self._rest_rad,
            (swept["angle_rad"] - self._rest_rad) * known,
            swept["coupling_torque_nm"],
        )

    def estimate(self) -> RunningEstimate | None:
        """Return the estimate so far; None while there are too few samples."""
        return self._running.estimate()


# Frequency response

FIRST_HZ: Final = 0.5
"""Lowest frequency shown: below it the torque is lower than the sensor's noise."""
LAST_HZ: Final = 60.0
"""Highest frequency shown: above the band of the reference paper's chirp and the third mode."""

OVERVIEW_MAGNITUDE: Final = "/overview/magnitude"
MAGNITUDE: Final = "/frequency_response/magnitude"
PHASE: Final = "/frequency_response/phase"
COHERENCE: Final = "/frequency_response/coherence"
SIZES: Final = {
    OVERVIEW_MAGNITUDE: (690.0, 285.0),
    MAGNITUDE: (1280.0, 374.0),
    PHASE: (640.0, 274.0),
    COHERENCE: (640.0, 274.0),
}
"""Width and height of the canvases, in points."""

MEASURED_KEY: Final = Key("measured", SKY_BLUE)
UNCERTAIN_KEY: Final = Key("low coherence", GREY)
"""Key of the measured response with a coherence below `LOW_COHERENCE`."""
MODEL_KEY: Final = Key("nominal model", ORANGE, width=3.0)
LAST_KEY: Final = Key("last session", PURPLE)
"""Key of the response of the last session of the same specimen."""
COHERENCE_KEY: Final = Key("coherence", GREEN)
NOT_ESTIMATED_KEY: Final = Key("not estimated", GREY, is_area=True)
"""Key of the bands that the reference has not excited so far."""

LOW_COHERENCE: Final = 0.8
"""Coherence below which a response is drawn grey: the random error of its magnitude is then above
0.35/√n, with n averages (J. S. Bendat and A. G. Piersol, Random Data, 4th ed., Table 9.6)."""
NO_COHERENCE_YET: Final = "Coherence begins with the second segment"
NO_COHERENCE: Final = "Of a single segment there is no coherence"

_NARROW: Final = 700.0
"""Width up to which a chart cannot hold a legend of five entries, in points."""
_SHADES: Final = ("not_estimated_below", "not_estimated_above")
_GROUPS: Final = 200
"""Groups of points along the axis, each drawn as two points: enough for the pixels of a view."""
_PHASE_FROM_DEG: Final = -90.0
"""Start of the phase axis: phases near 0 and 180 degrees do not wrap here."""
PHASE_AXIS: Final = Axis(
    "Phase (degrees)",
    _PHASE_FROM_DEG,
    _PHASE_FROM_DEG + 360.0,
    (-90.0, 0.0, 90.0, 180.0, 270.0),
)
COHERENCE_AXIS: Final = Axis("Coherence (1)", 0.0, 1.0, (0.0, 0.2, 0.4, 0.6, 0.8, 1.0))
_STEP_DB: Final = 20.0
_MODEL_STEP_HZ: Final = 0.01
_FAINT: Final = Damping(zeta=3e-4)
"""Damping for the upper end of the magnitude axis if the beam's is unknown."""
_DEEPEST_DB: Final = 140.0
"""Largest range of a magnitude axis."""


@dataclass(frozen=True, slots=True, eq=False)
class LastResponse:
    """Response of an earlier session.

    Attributes
    ----------
    session, specimen
        Names of that session and of its specimen.
    frequency_hz
        Increasing frequencies, shape (n,).
    response
        Torque over angle in N·m/rad, complex, shape (n,); NaN if not estimated.
    """

    session: str
    specimen: str
    frequency_hz: Real
    response: Complex


@dataclass(frozen=True, slots=True)
class _Graph:
    chart: Chart
    key: Key
    values: Callable[["FrequencyResponse"], Real]
    of_response: Callable[[Complex], Real] | None = None


class ResponseCharts:
    """The charts of one session's frequency response.

    Parameters
    ----------
    subject
        The session.
    last
        Response of the last session, drawn beneath the present one.
    """

    def __init__(self, subject: "Subject", last: LastResponse | None = None) -> None:
        frequency_hz, model = nominal_response(
            subject.beam, subject.damping or _FAINT, subject.tool_inertia_kg_m2
        )
        model_db = magnitude_db(model)
        magnitude = magnitude_axis(model_db.min() - 3.0, model_db.max() + 6.0)
        known = subject.damping is not None
        extra_keys = ((MODEL_KEY,) if known else ()) + ((LAST_KEY,) if last else ())
        keys = (MEASURED_KEY, UNCERTAIN_KEY, *extra_keys)
        # The title of the view names the quantity.
        short = replace(magnitude, title="dB re 1 N·m/rad")
        self._graphs = (
            *(
                _Graph(_chart(entity, axis, *keys), MEASURED_KEY, _magnitude_db, magnitude_db)
                for entity, axis in ((OVERVIEW_MAGNITUDE, short), (MAGNITUDE, magnitude))
            ),
            _Graph(_chart(PHASE, PHASE_AXIS, *keys), MEASURED_KEY, _phase_deg, phase_deg),
            _Graph(_chart(COHERENCE, COHERENCE_AXIS, COHERENCE_KEY), COHERENCE_KEY, _coherence),
        )
        self._delays_s = {
            "input_delay_s": subject.angle_delay_s,
            "output_delay_s": subject.torque_delay_s,
        }
        thinning = response_thinning(frequency_hz)
        of_magnitude = thinning.strips(model_db)
        self._models = (
            {
                OVERVIEW_MAGNITUDE: of_magnitude,
                MAGNITUDE: of_magnitude,
                PHASE: thinning.strips(phase_deg(model)),
            }
            if known
            else {}
        )
        self._lasts = {} if last is None else _curves_of(last, self._graphs)
        self._thinning: Thinning | None = None
        self._t_ns = 0
        self._known: tuple[Real, Complex] | None = None
        self._curves: dict[str, Sequence[Real]] = {}
        self._uncertain: dict[str, Sequence[Real]] = {}
        self._excited_hz = (LAST_HZ, LAST_HZ)
        self._note = NO_COHERENCE_YET

    def chart(self, entity: str) -> Chart:
        """Return the chart with an entity path."""
        return next(graph.chart for graph in self._graphs if graph.chart.entity == entity)

    def draw_frames(self, stream: "RecordingStream") -> None:
        """Draw the static parts of the charts."""
        for graph in self._graphs:
            graph.chart.draw_frame(stream)
            for name in _SHADES:
                graph.chart.draw_shade(stream, name)
            if graph.chart.entity in self._models:
                graph.chart.draw_curve(
                    stream, "model", self._models[graph.chart.entity], MODEL_KEY, static=True
                )
            if graph.chart.entity in self._lasts:
                graph.chart.draw_curve(
                    stream,
                    "last",
                    self._lasts[graph.chart.entity],
                    LAST_KEY,
                    static=True,
                    order=1,
                )

    def update(self, t_ns: int, estimate: "RunningEstimate") -> None:
        """Update the charts with the response at a time of the session.

        Parameters
        ----------
        t_ns
            Time since the start of the session.
        estimate
            Response so far.
        """
        response = estimate.response.without_delays(**self._delays_s)
        grid = response.frequency_hz
        if self._thinning is None or self._thinning.grid.size != grid.size:
            self._thinning = response_thinning(grid)
        excited = estimate.excited
        self._t_ns = t_ns
        self._known = grid, np.where(excited, response.response, np.nan)
        trusted = excited
        if response.coherence is not None:
            trusted = excited & (response.coherence >= LOW_COHERENCE)
        strips = self._thinning.strips
        self._curves, self._uncertain = {}, {}
        for graph in self._graphs:
            values, entity = graph.values(response), graph.chart.entity
            # The coherence itself is always reliable.
            reliable = trusted if graph.of_response else excited
            self._curves[entity] = strips(np.where(reliable, values, np.nan))
            if graph.of_response:
                self._uncertain[entity] = strips(np.where(excited, values, np.nan))
        ends = grid[excited][[0, -1]] if excited.any() else (LAST_HZ, LAST_HZ)
        self._excited_hz = float(ends[0]), float(ends[1])
        missing = NO_COHERENCE if estimate.final else NO_COHERENCE_YET
        self._note = missing if response.coherence is None else ""

    def draw(self, stream: "RecordingStream") -> None:
        """Draw the last update, at its time."""
        stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
        for graph in self._graphs:
            chart = graph.chart
            if graph.of_response:
                # The whole curve lies beneath, so that there is no gap at a change of colour.
                below = self._uncertain.get(chart.entity, ())
                chart.draw_curve(stream, "uncertain", below, UNCERTAIN_KEY)
            curve = self._curves.get(chart.entity, ())
            chart.draw_curve(stream, "measured", curve, graph.key, order=1)
            ends_hz = (FIRST_HZ, *self._excited_hz, LAST_HZ)
            for name, first_hz, last_hz in zip(_SHADES, ends_hz[::2], ends_hz[1::2], strict=True):
                chart.move_shade(stream, name, first_hz, last_hz)
        self.chart(COHERENCE).draw_note(stream, self._note, COHERENCE_KEY.color)

    def as_last(self, subject: "Subject") -> LastResponse | None:
        """Return the last update as the response of an earlier session; None without an update.

        Parameters
        ----------
        subject
            Session of these charts.
        """
        if self._known is None:
            return None
        return LastResponse(subject.name, subject.specimen, *self._known)


def _curves_of(last: LastResponse, graphs: "Sequence[_Graph]") -> dict[str, Sequence[Real]]:
    """Return the curves of a response, by the entities of its charts."""
    thinning = response_thinning(last.frequency_hz)
    return {
        graph.chart.entity: thinning.strips(graph.of_response(last.response))
        for graph in graphs
        if graph.of_response
    }


def magnitude_db(response: Complex) -> Real:
    """Return the magnitude in dB re 1 N·m/rad."""
    with np.errstate(divide="ignore"):
        magnitude: Real = 20.0 * np.log10(np.abs(response))
    return magnitude


def phase_deg(response: Complex) -> Real:
    """Return the phase in degrees, from −90 to below 270.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.view.frequency_charts import phase_deg
    >>> print(phase_deg(np.array([1.0, 1j, -1.0, -1j])))
    [  0.  90. 180. -90.]
    """
    turned: Real = np.mod(np.degrees(np.angle(response)) - _PHASE_FROM_DEG, 360.0)
    return turned + _PHASE_FROM_DEG


def _magnitude_db(response: "FrequencyResponse") -> Real:
    return magnitude_db(response.response)


def _phase_deg(response: "FrequencyResponse") -> Real:
    return phase_deg(response.response)


def _coherence(response: "FrequencyResponse") -> Real:
    if response.coherence is None:
        return np.full(response.frequency_hz.shape, np.nan)
    return response.coherence


def nominal_response(
    beam: Beam, damping: Damping, tool_inertia_kg_m2: float
) -> tuple[Real, Complex]:
    """Return the model response of a beam at the sensor, in the band that is shown.

    Parameters
    ----------
    beam, damping
        Model of the specimen.
    tool_inertia_kg_m2
        Inertia between sensor and beam.

    Returns
    -------
    tuple of two arrays (n,)
        Frequencies in Hz; torque over angle in N·m/rad, complex.
    """
    frequency_hz = np.arange(FIRST_HZ, LAST_HZ, _MODEL_STEP_HZ)
    s = 2j * np.pi * frequency_hz
    return frequency_hz, transfer(s, beam, damping) + tool_inertia_kg_m2 * s * s


def response_thinning(frequency_hz: Real) -> Thinning:
    """Return the decimation of a response for the charts.

    Parameters
    ----------
    frequency_hz
        Increasing frequencies, shape (n,). Those outside the band of the charts are dropped.
    """
    return Thinning.logarithmic(frequency_hz, FIRST_HZ, LAST_HZ, _GROUPS)


def magnitude_axis(lowest_db: float, highest_db: float) -> Axis:
    """Return a magnitude axis in steps of 20 dB, at most 140 dB long.

    Parameters
    ----------
    lowest_db, highest_db
        Range of the values, in dB re 1 N·m/rad. If it is too large, the axis begins above the
        lowest value.
    """
    last = _STEP_DB * np.ceil(highest_db / _STEP_DB)
    first = max(_STEP_DB * np.floor(lowest_db / _STEP_DB), last - _DEEPEST_DB)
    ticks = steps(first, last, max(1, round((last - first) / _STEP_DB)))
    return Axis("Magnitude (dB re 1 N·m/rad)", float(first), float(last), ticks)


def response_chart(
    entity: str, size: tuple[float, float], band_hz: tuple[float, float], y: Axis, *keys: Key
) -> Chart:
    """Return a chart with a logarithmic frequency axis.

    Parameters
    ----------
    entity
        Entity path in Rerun.
    size
        Width and height of the canvas, in points.
    band_hz
        Ends of the frequency axis, above 0.
    y
        Vertical axis.
    *keys
        Entries of the legend, in reading order.
    """
    ticks, lines = decades(*band_hz)
    frequency = Axis("Frequency (Hz)", *band_hz, ticks, lines, logarithmic=True)
    return Chart(entity, *size, frequency, y, keys)


def _chart(entity: str, y: Axis, *keys: Key) -> Chart:
    size = SIZES[entity]
    if LAST_KEY not in keys or size[0] > _NARROW:  # there is room for another entry
        keys = (*keys, NOT_ESTIMATED_KEY)
    return response_chart(entity, size, (FIRST_HZ, LAST_HZ), y, *keys)


# Spectrogram

SPECTROGRAM: Final = "/spectrogram"
SIZE: Final = (1280.0, 677.0)
"""Width and height of the canvas, in points."""

LOWEST_DB, HIGHEST_DB = -80.0, 0.0
"""Levels in dB re 1 N·m at the two ends of the colour scale."""
MOST_COLUMNS: Final = 300
"""Limit of the image's columns: further ones are merged, with the highest level."""

_BAR = 28.0
"""Width of the colour bar, in points."""
_BAR_MARGIN = 120.0
"""Margin for the colour bar and its labels, in points."""


class SpectrogramChart:
    """The chart of one session's spectrogram.

    Parameters
    ----------
    subject
        The session.
    frequency_hz
        Frequencies of the levels, shape (m,), evenly spaced from 0.
    step_s
        Time between columns.

    Attributes
    ----------
    chart
        Chart of the spectrogram.
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
            right=_BAR_MARGIN,
        )
        self._bar = Chart(
            f"{SPECTROGRAM}/bar",
            width,
            height,
            Axis("", 0.0, 1.0, ()),
            Axis("dB re 1 N·m", LOWEST_DB, HIGHEST_DB, steps(LOWEST_DB, HIGHEST_DB, 8)),
            left=width - _BAR - 24.0,
        )
        # Row 0 is at the top. The mean torque is omitted, because it is no motion.
        self._image = np.zeros((frequency_hz.size - 1, slots), np.uint8)
        self._filled = 0
        self._t_ns = 0

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """Levels so far, 0–255, shape (frequencies, times), from the highest frequency down."""
        return self._image[:, : self._filled]

    def draw_frame(self, stream: "RecordingStream") -> None:
        """Draw the static parts: the axes and the colour bar."""
        corners = self.chart.to_canvas(
            [0.0, self.chart.x.last], [self._lowest_hz, self.chart.y.last]
        )
        _position_image(stream, f"{SPECTROGRAM}/levels", corners, self._image.shape)
        corners = self._bar.to_canvas([0.0, 1.0], [LOWEST_DB, HIGHEST_DB])
        bar = np.arange(255, -1, -1, dtype=np.uint8)[:, None]
        _position_image(stream, f"{SPECTROGRAM}/colors", corners, bar.shape)
        _send_image(stream, f"{SPECTROGRAM}/colors", bar, static=True)
        self.chart.draw_frame(stream)
        self._bar.draw_frame(stream)

    def update(self, t_ns: int, columns: Sequence[tuple[float, Real]]) -> None:
        """Add columns of the spectrogram.

        Parameters
        ----------
        t_ns
            Time since the start of the session.
        columns
            Middle of each column's window in s, with its levels (m,) in dB re 1 N·m.
        """
        self._t_ns = t_ns
        for time_s, level_db in columns:
            slot = min(max(int(time_s / self._slot_s), 0), self._image.shape[1] - 1)
            fraction = (level_db[:0:-1] - LOWEST_DB) / (HIGHEST_DB - LOWEST_DB)
            column = (255.0 * np.clip(fraction, 0.0, 1.0)).astype(np.uint8)
            np.maximum(self._image[:, slot], column, out=self._image[:, slot])
            self._filled = max(self._filled, slot + 1)

    def draw(self, stream: "RecordingStream") -> None:
        """Draw the spectrogram so far."""
        if self._filled:
            stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
            _send_image(stream, f"{SPECTROGRAM}/levels", self.image)


def _position_image(
    stream: "RecordingStream", entity: str, corners: Real, shape: tuple[int, ...]
) -> None:
    """Log position and colour map of an image of levels (0–255).

    `corners` has its bottom left and top right on the canvas, (2, 2); `shape` its rows and columns.
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
