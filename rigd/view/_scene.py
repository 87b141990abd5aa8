"""Scene of a session, which turns records, events and health into functions that draw in Rerun."""

import collections
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.gauges import Gauge, Gauges
from rigd.spectral import RunningSpectrogram
from rigd.sweep_response import HIGHEST_SHOWN_HZ, SweepResponse
from rigd.view import banner
from rigd.view._antenna import Antenna
from rigd.view._fits import fit_record, fit_source, send_table
from rigd.view._layout import TIME_VIEWS, AxisTickPoints, blueprint, fit_views
from rigd.view._session_info import (
    Health,
    Note,
    SessionDescription,
    health_record,
    send_note,
    send_recent_notes,
    send_summary,
)
from rigd.view.banner import BannerState, preparing_state
from rigd.view.frequency_charts import (
    LastResponse,
    ResponseCharts,
    SpectrogramChart,
)
from rigd.view.plots import HEALTH, READINGS, SIGNALS, Drawing, PlotSource, send_columns

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from rigd.view._session_info import Health, Note, SessionDescription

Records = npt.NDArray[Any]
"""Structured array of samples, timings or other records of a session, shape (n,)."""

_MIN_BUFFERED_BLOCK_S: Final = 0.1
"""Least duration of a block of records that is drawn at once.

The computation time for a block hardly depends on its size, so few large blocks are cheaper."""
_CHART_UPDATE_PERIOD_S: Final = 1.0
"""Session time between two updates of the charts; each update computes a frequency response."""
_SPECTROGRAM_STEP_S: Final = 0.5
"""Time between adjacent columns of the spectrogram."""
_MAX_STORED_NOTES: Final = 200
"""Largest number of log lines that are stored and sent again to a new connection."""


class Scene:
    """Display of one session: receives its data, and returns functions that draw them in Rerun.

    The scene itself sends nothing, so that a stalled viewer cannot disturb its computations.

    Parameters
    ----------
    session
        The session.
    make_layout
        Function that returns the layout of the window; None: the layout of the live view.
    last_response
        Response of the last session of the same specimen, which is drawn for comparison.
    """

    def __init__(
        self,
        session: SessionDescription,
        make_layout: "Callable[[], rrb.Blueprint] | None" = None,
        last_response: LastResponse | None = None,
    ) -> None:
        self._session = session
        with_target_std = session.excitation == "until"
        self._layout = make_layout or partial(
            blueprint,
            absent_components=session.absent_components,
            fitted_mode_count=session.fitted_mode_count,
            with_target_std=with_target_std,
        )
        highest_response_hz = min(HIGHEST_SHOWN_HZ, session.rate_hz / 2)
        self._antenna = Antenna(session)
        self._response = SweepResponse(session.sweep, session.rate_hz, highest_response_hz)
        self.response_charts = ResponseCharts(session, last_response)
        self._response_is_final = False
        self._spectrogram = RunningSpectrogram(
            session.rate_hz, step_s=_SPECTROGRAM_STEP_S, last_hz=highest_response_hz
        )
        self._spectrogram_chart = SpectrogramChart(
            session, self._spectrogram.frequency_hz, _SPECTROGRAM_STEP_S
        )
        self._columns: list[tuple[float, npt.NDArray[Any]]] = []
        self._notes: collections.deque[Note] = collections.deque(maxlen=_MAX_STORED_NOTES)
        self._touches: dict[int, list[Drawing]] = {}
        self._charts_due = _SessionTimer(_CHART_UPDATE_PERIOD_S)
        self._samples = _BlockBuffer(session.rate_hz)
        self._timings = _BlockBuffer(session.rate_hz)
        self._axis_tick_points = {
            record_source: AxisTickPoints(record_source, TIME_VIEWS)
            for record_source in (SIGNALS, READINGS, HEALTH)
        }
        # An empty record first: a view reports missing components as errors.
        self._fits = [fit_record(None, session.fitted_mode_count or 0)]
        self._fit: Mapping[str, Any] | None = None
        self._fit_source: PlotSource | None = None
        if session.fitted_mode_count:
            record_source = self._fit_source = fit_source(
                session.fitted_mode_count, with_target_std=with_target_std
            )
            self._axis_tick_points[record_source] = AxisTickPoints(
                record_source, fit_views(record_source)
            )
        self._gauges = Gauges(session.rate_hz, session.limits, session.thermal_time_constant_s)
        self._peaks: dict[str, Gauge] = {}
        self._peaks_are_drawn = False
        self._state, self._health, self._health_ns = preparing_state(), Health(), 0
        self._t_ns = 0

    @property
    def last_response(self) -> LastResponse | None:
        """Frequency response of this session so far, for comparison with a later one, or None."""
        return self.response_charts.as_last_response(self._session)

    def initial_drawings(self) -> list[Drawing]:
        """Return functions that draw the whole window for a newly connected viewer."""
        session_name = self._session.name
        return [
            lambda stream: stream.send_recording_name(session_name),
            lambda stream: stream.send_blueprint(self._layout()),
            *(
                drawing
                for tick_points in self._axis_tick_points.values()
                for drawing in tick_points.initial_drawings()
            ),
            self.response_charts.draw_frames,
            self.response_charts.draw,
            self._spectrogram_chart.draw_frame,
            self._spectrogram_chart.draw,
            *self._antenna.initial_drawings(),
            *(drawing for drawings in self._touches.values() for drawing in drawings),
            *self._draw_fits(np.concatenate(self._fits)),
            *(partial(send_note, note=note) for note in self._notes),
            self._draw_recent_events(self._t_ns),
            *self._draw_banner(),
        ]

    def sample_drawings(self, samples: Records) -> list[Drawing]:
        """Return functions that draw new samples (n,) of ``SAMPLE_DTYPE`` in all views.

        The samples are in order of time, and may have gaps.
        """
        return self._draw_samples(self._samples.add(samples))

    def timing_drawings(self, tick_timings: Records) -> list[Drawing]:
        """Return functions that plot the ages of the devices' readings (n,) of ``TIMING_DTYPE``."""
        return self._draw_timings(self._timings.add(tick_timings))

    def event_drawings(self, session_notes: Sequence[Note]) -> list[Drawing]:
        """Return functions that add events to the log in the window."""
        if not session_notes:
            return []
        self._notes.extend(session_notes)
        return [
            *(partial(send_note, note=note) for note in session_notes),
            self._draw_recent_events(max(self._t_ns, session_notes[-1].t_ns)),
        ]

    def touch_drawings(self, touch_documents: Sequence[Mapping[str, Any]]) -> list[Drawing]:
        """Return functions that draw estimated touches of the beam, given as JSON objects.

        An estimate replaces an earlier one of the touch with the same number.
        """
        drawings_of_touches = {
            touch_document["number"]: self._antenna.touch_drawings(touch_document)
            for touch_document in touch_documents
        }
        self._touches |= drawings_of_touches
        return [
            touch_drawing for drawings in drawings_of_touches.values() for touch_drawing in drawings
        ]

    def fit_drawings(self, fit_document: Mapping[str, Any]) -> list[Drawing]:
        """Return functions that draw a fit of the record so far, given as a JSON object."""
        self._fit = fit_document
        self._fits.append(fit_record(fit_document, self._session.fitted_mode_count or 0))
        return self._draw_fits(self._fits[-1])

    def state_drawings(self, t_ns: int, banner_state: BannerState) -> list[Drawing]:
        """Return functions that draw a new state of the session; none if it is unchanged.

        Parameters
        ----------
        t_ns
            Time since the session's start.
        banner_state
            State of the session.
        """
        if banner_state == self._state:
            return []
        self._state, self._health_ns = banner_state, max(self._health_ns, t_ns)
        return self._draw_banner()

    def health_drawings(self, t_ns: int, health_reading: Health) -> list[Drawing]:
        """Return functions that draw the health of loop, recorder, disk and bus at a time.

        Parameters
        ----------
        t_ns
            Time since the session's start.
        health_reading
            Health reading, which arrives a few times per second.
        """
        self._health, self._health_ns = health_reading, t_ns
        drawings: list[Drawing] = [
            *self._plot_records(HEALTH, health_record(t_ns, health_reading)),
            partial(send_summary, session=self._session, t_ns=t_ns, health=health_reading),
            *self._draw_banner(),
        ]
        self._peaks_are_drawn = True
        return drawings

    def final_drawings(self) -> list[Drawing]:
        """Return functions that draw the samples still in the buffer, and the final charts."""
        return [
            *self._draw_samples(self._samples.take_remaining()),
            *self._draw_timings(self._timings.take_remaining()),
            *self._draw_charts(),
        ]

    def _draw_fits(self, fit_records: Records) -> list[Drawing]:
        """Return functions that plot the fits over time and show the table of the last one."""
        if self._session.fitted_mode_count is None:
            return []
        record_source = self._fit_source
        plot_drawings = (
            [] if record_source is None else self._plot_records(record_source, fit_records)
        )
        return [*plot_drawings, partial(send_table, fit=self._fit)]

    def _draw_samples(self, samples: Records | None) -> list[Drawing]:
        """Return functions that draw a block of samples; none if `samples` is None."""
        if samples is None:
            return []
        self._t_ns = int(samples["t_ns"][-1])
        self._update_peaks(samples)
        self._response.feed(samples)
        self._columns += self._spectrogram.feed(samples["tick"], samples["coupling_torque_nm"])
        drawings = [*self._plot_records(SIGNALS, samples), *self._antenna.sample_drawings(samples)]
        if self._charts_due(self._t_ns):
            drawings += self._draw_charts()
        return drawings

    def _update_peaks(self, samples: Records) -> None:
        """Update the largest magnitude of each signal since the gauges were last drawn."""
        largest_magnitudes = self._gauges.gauges_of_block(samples)
        if not self._peaks_are_drawn:
            largest_magnitudes = {
                signal_name: _gauge_with_larger_value(gauge, self._peaks.get(signal_name))
                for signal_name, gauge in largest_magnitudes.items()
            }
        self._peaks, self._peaks_are_drawn = largest_magnitudes, False

    def _draw_banner(self) -> list[Drawing]:
        """Return functions that draw the session's state and its gauges."""
        session, t_ns, health_reading = self._session, self._health_ns, self._health
        gauge_of_missed_ticks = banner.missed_ticks_gauge(session, t_ns, health_reading)
        return [
            partial(
                banner.send_banner,
                session=session,
                state=self._state,
                t_ns=t_ns,
                health=health_reading,
            ),
            partial(
                banner.send_gauges,
                state=self._state,
                t_ns=t_ns,
                gauges={**self._peaks, "missed": gauge_of_missed_ticks},
            ),
        ]

    def _draw_recent_events(self, t_ns: int) -> Drawing:
        """Return the function that draws the newest events as a document."""
        return partial(send_recent_notes, t_ns=t_ns, notes=tuple(self._notes))

    def _draw_timings(self, tick_timings: Records | None) -> list[Drawing]:
        """Return functions that plot the ages of readings; none if `tick_timings` is None."""
        return [] if tick_timings is None else self._plot_records(READINGS, tick_timings)

    def _plot_records(self, record_source: PlotSource, records: Records) -> list[Drawing]:
        """Return functions that plot the records of a source over time."""
        t_ns, plot_values = (
            records["t_ns"].astype(np.int64),
            record_source.values_by_component(records),
        )
        return [
            partial(send_columns, entity=record_source.entity, t_ns=t_ns, columns=plot_values),
            *self._axis_tick_points[record_source].tick_drawings(t_ns, plot_values),
        ]

    def _draw_charts(self) -> list[Drawing]:
        """Return functions that draw the frequency response and the spectrogram so far."""
        drawings: list[Drawing] = []
        if (
            not self._response_is_final
            and (response_estimate := self._response.estimate()) is not None
        ):
            self.response_charts.update(self._t_ns, response_estimate)
            self._response_is_final = response_estimate.is_final
        # Drawn again even if final: the last drawing may have been dropped.
        drawings.append(self.response_charts.draw)
        if self._columns:
            self._spectrogram_chart.update(self._t_ns, self._columns)
            self._columns = []
            drawings.append(self._spectrogram_chart.draw)
        return drawings


def _gauge_with_larger_value(gauge: Gauge, earlier_gauge: Gauge | None) -> Gauge:
    """Return the gauge with the larger value; an unknown value counts as the smallest."""
    if earlier_gauge is None or earlier_gauge.value is None:
        return gauge
    return earlier_gauge if gauge.value is None or earlier_gauge.value > gauge.value else gauge


class _SessionTimer:
    """Timer in session time: a call with the present time in ns returns True once per period."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(1e9 * period_s)
        self._due_ns = 0

    def __call__(self, t_ns: int) -> bool:
        if t_ns < self._due_ns:
            return False
        self._due_ns = t_ns + self._period_ns
        return True


class _BlockBuffer:
    """Buffer that combines small blocks of samples or timings into larger blocks."""

    def __init__(self, rate_hz: float) -> None:
        self._ticks = max(1, round(_MIN_BUFFERED_BLOCK_S * rate_hz))
        self._parts: list[Records] = []

    def add(self, new_records: Records) -> Records | None:
        """Add records (n,); return all buffered records once they span a block, otherwise None."""
        if len(new_records) == 0:
            return None
        self._parts.append(new_records)
        span_ticks = int(new_records["tick"][-1]) - int(self._parts[0]["tick"][0]) + 1
        return self.take_remaining() if span_ticks >= self._ticks else None

    def take_remaining(self) -> Records | None:
        """Return and remove the records that are still in the buffer; None if there are none."""
        stored_blocks, self._parts = self._parts, []
        return np.concatenate(stored_blocks) if stored_blocks else None
