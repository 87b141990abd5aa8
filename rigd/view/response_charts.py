"""The frequency response as it grows: magnitude, phase and coherence, with the nominal model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Damping, transfer
from rigd.view.chart import Axis, Chart, Key, decades, steps
from rigd.view.palette import GREEN, GREY, ORANGE, SKY_BLUE
from rigd.view.plots import TIMELINE
from rigd.view.thinning import Thinning

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.spectral import FrequencyResponse, RunningEstimate
    from rigd.view.subject import Subject

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

FIRST_HZ: Final = 0.5
"""Below, the torque that moves an antenna is lost in the sensor's noise."""
LAST_HZ: Final = 60.0
"""Beyond what the paper's chirp excites, and its third mode."""

OVERVIEW_MAGNITUDE: Final = "/overview/magnitude"
MAGNITUDE: Final = "/frequency_response/magnitude"
PHASE: Final = "/frequency_response/phase"
COHERENCE: Final = "/frequency_response/coherence"
SIZES: Final = {
    OVERVIEW_MAGNITUDE: (690.0, 340.0),
    MAGNITUDE: (1280.0, 374.0),
    PHASE: (640.0, 274.0),
    COHERENCE: (640.0, 274.0),
}
"""Width and height of the canvases, in points."""

MEASURED_KEY: Final = Key("measured", SKY_BLUE)
MODEL_KEY: Final = Key("nominal model", ORANGE, width=3.0)
COHERENCE_KEY: Final = Key("coherence", GREEN)
NOT_ESTIMATED_KEY: Final = Key("not estimated", GREY, is_area=True)
"""Where the reference has not been, as far as the estimate has used it."""

NO_COHERENCE_YET: Final = "Coherence begins with the second segment"
NO_COHERENCE: Final = "Of a single segment there is no coherence"

_SHADES: Final = ("not_estimated_below", "not_estimated_above")
_GROUPS: Final = 200
"""Of points along the axis, two kept of each: enough for the pixels of a view."""
_PHASE_FROM_DEG: Final = -90.0
"""Phases lie about 0 and 180 degrees; cut here, they do not jump from end to end."""
_MODEL_STEP_HZ: Final = 0.01
_FAINT: Final = Damping(zeta=3e-4)
"""To know how high a magnitude may rise where the damping is not known."""
_DEEPEST_DB: Final = 140.0
"""Below the highest magnitude, what an axis shows at the most."""


@dataclass(frozen=True, slots=True)
class _Graph:
    chart: Chart
    key: Key
    values: Callable[["FrequencyResponse"], Real]


class ResponseCharts:
    """The charts of one session's frequency response.

    Parameters
    ----------
    subject
        The session.
    """

    def __init__(self, subject: "Subject") -> None:
        frequency_hz = np.arange(FIRST_HZ, LAST_HZ, _MODEL_STEP_HZ)
        model = _measured_model(subject, frequency_hz, subject.damping or _FAINT)
        magnitude = _magnitude_axis(magnitude_db(model))
        phase = Axis(
            "Phase (degrees)",
            _PHASE_FROM_DEG,
            _PHASE_FROM_DEG + 360.0,
            (-90.0, 0.0, 90.0, 180.0, 270.0),
        )
        coherence = Axis("Coherence (1)", 0.0, 1.0, (0.0, 0.2, 0.4, 0.6, 0.8, 1.0))
        known = subject.damping is not None
        of_model = (MODEL_KEY,) if known else ()
        self._graphs = (
            *(
                _Graph(
                    _chart(entity, magnitude, MEASURED_KEY, *of_model), MEASURED_KEY, _magnitude_db
                )
                for entity in (OVERVIEW_MAGNITUDE, MAGNITUDE)
            ),
            _Graph(_chart(PHASE, phase, MEASURED_KEY, *of_model), MEASURED_KEY, _phase_deg),
            _Graph(_chart(COHERENCE, coherence, COHERENCE_KEY), COHERENCE_KEY, _coherence),
        )
        self._delays_s = {
            "input_delay_s": subject.angle_delay_s,
            "output_delay_s": subject.torque_delay_s,
        }
        thinning = Thinning.logarithmic(frequency_hz, FIRST_HZ, LAST_HZ, _GROUPS)
        of_magnitude = thinning.strips(magnitude_db(model))
        self._models = (
            {
                OVERVIEW_MAGNITUDE: of_magnitude,
                MAGNITUDE: of_magnitude,
                PHASE: thinning.strips(phase_deg(model)),
            }
            if known
            else {}
        )
        self._thinning: Thinning | None = None
        self._t_ns = 0
        self._curves: dict[str, Sequence[Real]] = {}
        self._excited_hz = (LAST_HZ, LAST_HZ)
        self._note = NO_COHERENCE_YET

    def chart(self, entity: str) -> Chart:
        """Return the chart that Rerun keeps at a place."""
        return next(graph.chart for graph in self._graphs if graph.chart.entity == entity)

    def draw_frames(self, stream: "RecordingStream") -> None:
        """Draw what stays as it is."""
        for graph in self._graphs:
            graph.chart.draw_frame(stream)
            for name in _SHADES:
                graph.chart.draw_shade(stream, name)
            if graph.chart.entity in self._models:
                graph.chart.draw_curve(
                    stream, "model", self._models[graph.chart.entity], MODEL_KEY, static=True
                )

    def update(self, t_ns: int, estimate: "RunningEstimate") -> None:
        """Take what is known of the response at a time of the session."""
        response = estimate.response.without_delays(**self._delays_s)
        grid = response.frequency_hz
        if self._thinning is None or self._thinning.grid.size != grid.size:
            self._thinning = Thinning.logarithmic(grid, FIRST_HZ, LAST_HZ, _GROUPS)
        excited = estimate.excited
        self._t_ns = t_ns
        self._curves = {
            graph.chart.entity: self._thinning.strips(
                np.where(excited, graph.values(response), np.nan)
            )
            for graph in self._graphs
        }
        ends = grid[excited][[0, -1]] if excited.any() else (LAST_HZ, LAST_HZ)
        self._excited_hz = float(ends[0]), float(ends[1])
        missing = NO_COHERENCE if estimate.final else NO_COHERENCE_YET
        self._note = missing if response.coherence is None else ""

    def draw(self, stream: "RecordingStream") -> None:
        """Draw what was last taken, at its time."""
        stream.set_time(TIMELINE, duration=1e-9 * self._t_ns)
        for graph in self._graphs:
            chart = graph.chart
            chart.draw_curve(stream, "measured", self._curves.get(chart.entity, ()), graph.key)
            ends_hz = (FIRST_HZ, *self._excited_hz, LAST_HZ)
            for name, first_hz, last_hz in zip(_SHADES, ends_hz[::2], ends_hz[1::2], strict=True):
                chart.move_shade(stream, name, first_hz, last_hz)
        self.chart(COHERENCE).draw_note(stream, self._note, COHERENCE_KEY.color)


def magnitude_db(response: Complex) -> Real:
    """Magnitude in dB re 1 N·m/rad."""
    with np.errstate(divide="ignore"):
        magnitude: Real = 20.0 * np.log10(np.abs(response))
    return magnitude


def phase_deg(response: Complex) -> Real:
    """Phase in degrees, from −90 to below 270."""
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


def _measured_model(subject: "Subject", frequency_hz: Real, damping: Damping) -> Complex:
    """Return what the sensor measures per angle of a beam so damped, in N·m/rad, (n,)."""
    s = 2j * np.pi * frequency_hz
    model: Complex = transfer(s, subject.beam, damping) + subject.tool_inertia_kg_m2 * s * s
    return model


def _magnitude_axis(model_db: Real) -> Axis:
    step_db = 20.0
    last = step_db * np.ceil((model_db.max() + 6.0) / step_db)
    first = step_db * np.floor((model_db.min() - 3.0) / step_db)
    first = max(first, last - _DEEPEST_DB)
    ticks = steps(first, last, round((last - first) / step_db))
    return Axis("Magnitude (dB re 1 N·m/rad)", float(first), float(last), ticks)


def _chart(entity: str, y: Axis, *keys: Key) -> Chart:
    ticks, lines = decades(FIRST_HZ, LAST_HZ)
    frequency = Axis("Frequency (Hz)", FIRST_HZ, LAST_HZ, ticks, lines, logarithmic=True)
    width, height = SIZES[entity]
    return Chart(entity, width, height, frequency, y, (*keys, NOT_ESTIMATED_KEY))
