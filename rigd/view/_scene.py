"""Scene of one session, which turns records, events and health into drawings for Rerun."""

import collections
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.spectral import RunningSpectrogram
from rigd.view import banner
from rigd.view._antenna import Antenna
from rigd.view._fits import fit_record, fit_source, send_table
from rigd.view._gauges import Gauge, Gauges
from rigd.view._layout import TIME_VIEWS, Scale, blueprint, fit_views
from rigd.view._session_info import (
    Health,
    Note,
    Subject,
    health_record,
    send_note,
    send_recent,
    send_summary,
)
from rigd.view.banner import BannerState, preparing
from rigd.view.frequency_charts import (
    LAST_HZ,
    LastResponse,
    ResponseCharts,
    SpectrogramChart,
    SweepResponse,
)
from rigd.view.plots import HEALTH, READINGS, SIGNALS, Source, send_columns

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

    from rigd.view._session_info import Health, Note, Subject

Records = npt.NDArray[Any]

Drawing = Callable[["RecordingStream"], None]
"""Function that sends one item to Rerun."""

_BLOCK_S: Final = 0.1
"""Least duration of a block of records: the cost of a block hardly depends on its size."""
_CHARTS_S: Final = 1.0
"""Session time between drawings of the charts, for each of which a response is computed."""
_STEP_S: Final = 0.5
"""Time between columns of the spectrogram."""
_MOST_NOTES: Final = 200
"""Log lines that are sent again to a new connection."""


class Scene:
    """Scene of one session: it computes continuously and returns drawings.

    It sends nothing itself, so a stalled viewer cannot disturb its computations.

    Parameters
    ----------
    subject
        The session.
    layout
        Returns the layout of the window; None: that of the live view.
    last
        Response of the last session of the same specimen, drawn for comparison.
    """

    def __init__(
        self,
        subject: Subject,
        layout: "Callable[[], rrb.Blueprint] | None" = None,
        last: LastResponse | None = None,
    ) -> None:
        self._subject = subject
        with_targets = subject.excitation == "until"
        self._layout = layout or partial(
            blueprint, absent=subject.absent, fit_modes=subject.fit_modes, fit_targets=with_targets
        )
        last_hz = min(LAST_HZ, subject.rate_hz / 2)
        self._antenna = Antenna(subject)
        self._response = SweepResponse(subject, last_hz)
        self.response_charts = ResponseCharts(subject, last)
        self._response_is_final = False
        self._spectrogram = RunningSpectrogram(subject.rate_hz, step_s=_STEP_S, last_hz=last_hz)
        self._spectrogram_chart = SpectrogramChart(subject, self._spectrogram.frequency_hz, _STEP_S)
        self._columns: list[tuple[float, npt.NDArray[Any]]] = []
        self._notes: collections.deque[Note] = collections.deque(maxlen=_MOST_NOTES)
        self._touches: dict[int, list[Drawing]] = {}
        self._charts_due = _Periodically(_CHARTS_S)
        self._samples = _Gathering(subject.rate_hz)
        self._timings = _Gathering(subject.rate_hz)
        self._scales = {source: Scale(source, TIME_VIEWS) for source in (SIGNALS, READINGS, HEALTH)}
        # An empty record first: a view reports missing components as errors.
        self._fits = [fit_record(None, subject.fit_modes or 0)]
        self._fit: Mapping[str, Any] | None = None
        self._fit_source: Source | None = None
        if subject.fit_modes:
            source = self._fit_source = fit_source(subject.fit_modes, with_targets=with_targets)
            self._scales[source] = Scale(source, fit_views(source))
        self._gauges = Gauges(subject.rate_hz, subject.limits, subject.thermal_time_constant_s)
        self._peaks: dict[str, Gauge] = {}
        self._peaks_shown = False
        self._state, self._health, self._health_ns = preparing(), Health(), 0
        self._t_ns = 0

    @property
    def last_response(self) -> LastResponse | None:
        """Response of this session so far, for the next session of the specimen."""
        return self.response_charts.as_last(self._subject)

    def frame(self) -> list[Drawing]:
        """Return the first drawings of a connection: name, layout, axes, and present contents."""
        name = self._subject.name
        return [
            lambda stream: stream.send_recording_name(name),
            lambda stream: stream.send_blueprint(self._layout()),
            *(drawing for scale in self._scales.values() for drawing in scale.frame()),
            self.response_charts.draw_frames,
            self.response_charts.draw,
            self._spectrogram_chart.draw_frame,
            self._spectrogram_chart.draw,
            *self._antenna.frame(),
            *(drawing for drawings in self._touches.values() for drawing in drawings),
            *self._draw_fits(np.concatenate(self._fits)),
            *(partial(send_note, note=note) for note in self._notes),
            self._recent(self._t_ns),
            *self._banner(),
        ]

    def samples(self, samples: Records) -> list[Drawing]:
        """Return the drawings of samples (n,) of ``SAMPLE_DTYPE``, in order, maybe with gaps."""
        return self._draw_samples(self._samples.add(samples))

    def timings(self, timings: Records) -> list[Drawing]:
        """Return the drawings of ages (n,) of the readings, of ``TIMING_DTYPE``."""
        return self._draw_timings(self._timings.add(timings))

    def events(self, events: Sequence[Note]) -> list[Drawing]:
        """Return the drawings of log events."""
        if not events:
            return []
        self._notes.extend(events)
        return [
            *(partial(send_note, note=note) for note in events),
            self._recent(max(self._t_ns, events[-1].t_ns)),
        ]

    def touches(self, touches: Sequence[Mapping[str, Any]]) -> list[Drawing]:
        """Return the drawings of touches (JSON documents), which replace earlier estimates."""
        drawn = {touch["number"]: self._antenna.touch(touch) for touch in touches}
        self._touches |= drawn
        return [drawing for drawings in drawn.values() for drawing in drawings]

    def fit(self, fit: Mapping[str, Any]) -> list[Drawing]:
        """Return the drawings of a fit of the record so far (a JSON document)."""
        self._fit = fit
        self._fits.append(fit_record(fit, self._subject.fit_modes or 0))
        return self._draw_fits(self._fits[-1])

    def state(self, t_ns: int, state: BannerState) -> list[Drawing]:
        """Return the drawings of a new state of the session; none if it is unchanged.

        Parameters
        ----------
        t_ns
            Time since the session's start.
        state
            State of the session.
        """
        if state == self._state:
            return []
        self._state, self._health_ns = state, max(self._health_ns, t_ns)
        return self._banner()

    def health(self, t_ns: int, health: Health) -> list[Drawing]:
        """Return the drawings of a health reading, which comes a few times per second.

        Parameters
        ----------
        t_ns
            Time since the session's start.
        health
            Health reading.
        """
        self._health, self._health_ns = health, t_ns
        drawings: list[Drawing] = [
            *self._plot(HEALTH, health_record(t_ns, health)),
            partial(send_summary, subject=self._subject, t_ns=t_ns, health=health),
            *self._banner(),
        ]
        self._peaks_shown = True
        return drawings

    def finish(self) -> list[Drawing]:
        """Return the final drawings, such as the final frequency response."""
        return [
            *self._draw_samples(self._samples.rest()),
            *self._draw_timings(self._timings.rest()),
            *self._charts(),
        ]

    def _draw_fits(self, records: Records) -> list[Drawing]:
        if self._subject.fit_modes is None:
            return []
        source = self._fit_source
        plotted = [] if source is None else self._plot(source, records)
        return [*plotted, partial(send_table, fit=self._fit)]

    def _draw_samples(self, samples: Records | None) -> list[Drawing]:
        if samples is None:
            return []
        self._t_ns = int(samples["t_ns"][-1])
        self._take_peaks(samples)
        self._response.feed(samples)
        self._columns += self._spectrogram.feed(samples["tick"], samples["coupling_torque_nm"])
        drawings = [*self._plot(SIGNALS, samples), *self._antenna.samples(samples)]
        if self._charts_due(self._t_ns):
            drawings += self._charts()
        return drawings

    def _take_peaks(self, samples: Records) -> None:
        """Update the peaks since the values were drawn last."""
        peaks = self._gauges.take(samples)
        if not self._peaks_shown:
            peaks = {name: _larger(gauge, self._peaks.get(name)) for name, gauge in peaks.items()}
        self._peaks, self._peaks_shown = peaks, False

    def _banner(self) -> list[Drawing]:
        """Return the drawings of the state, and of the values with their limits."""
        subject, t_ns, health = self._subject, self._health_ns, self._health
        missed = banner.missed_gauge(subject, t_ns, health)
        return [
            partial(
                banner.send_banner, subject=subject, state=self._state, t_ns=t_ns, health=health
            ),
            partial(
                banner.send_values,
                state=self._state,
                t_ns=t_ns,
                gauges={**self._peaks, "missed": missed},
            ),
        ]

    def _recent(self, t_ns: int) -> Drawing:
        return partial(send_recent, t_ns=t_ns, notes=tuple(self._notes))

    def _draw_timings(self, timings: Records | None) -> list[Drawing]:
        return [] if timings is None else self._plot(READINGS, timings)

    def _plot(self, source: Source, records: Records) -> list[Drawing]:
        t_ns, columns = records["t_ns"].astype(np.int64), source.columns(records)
        return [
            partial(send_columns, entity=source.entity, t_ns=t_ns, columns=columns),
            *self._scales[source].draw(t_ns, columns),
        ]

    def _charts(self) -> list[Drawing]:
        drawings: list[Drawing] = []
        if not self._response_is_final and (estimate := self._response.estimate()) is not None:
            self.response_charts.update(self._t_ns, estimate)
            self._response_is_final = estimate.final
        # Drawn again even if final: the last drawing may have been dropped.
        drawings.append(self.response_charts.draw)
        if self._columns:
            self._spectrogram_chart.update(self._t_ns, self._columns)
            self._columns = []
            drawings.append(self._spectrogram_chart.draw)
        return drawings


def _larger(gauge: Gauge, other: Gauge | None) -> Gauge:
    if other is None or other.value is None:
        return gauge
    return other if gauge.value is None or other.value > gauge.value else gauge


class _Periodically:
    """Timer in session time: a call returns whether the period has passed."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(1e9 * period_s)
        self._due_ns = 0

    def __call__(self, t_ns: int) -> bool:
        if t_ns < self._due_ns:
            return False
        self._due_ns = t_ns + self._period_ns
        return True


class _Gathering:
    """Collector that combines small blocks of records with a field ``tick`` into larger ones."""

    def __init__(self, rate_hz: float) -> None:
        self._ticks = max(1, round(_BLOCK_S * rate_hz))
        self._parts: list[Records] = []

    def add(self, records: Records) -> Records | None:
        """Add records (n,); return all of them once they span a block."""
        if len(records) == 0:
            return None
        self._parts.append(records)
        span = int(records["tick"][-1]) - int(self._parts[0]["tick"][0]) + 1
        return self.rest() if span >= self._ticks else None

    def rest(self) -> Records | None:
        """Return the remaining records; None if there are none."""
        parts, self._parts = self._parts, []
        return np.concatenate(parts) if parts else None
