"""Search for an obstacle: settings of detector and estimator, and the estimates of the touches.

The control loop detects a touch and reacts by itself. The touch process estimates position and
force at the same time. A session continues without the touch process if it is lost.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rigd.devices.parameters import RigParameters
from rigd.engine.messages import TouchJob, TouchOrder, TouchReady, TouchReport
from rigd.engine.processes import TOUCH, ChildError
from rigd.engine.shared_state import LogEvent
from rigd.excitation import Excitation
from rigd.profile import Profile
from rigd.runner._process_group import await_ready
from rigd.session.touches import packed_touches, touch_line

if TYPE_CHECKING:
    from rigd.profile import RealtimeSettings
    from rigd.runner._process_group import ProcessGroup
    from rigd.touch import ChannelNoise, SensorFilter, TouchModel

_STEP_STD: Final = 1 / sqrt(12)
"""Standard deviation of the rounding error for steps of 1."""
_LAST_PATIENCE_S: Final = 30.0
"""Time for the last estimate after the end of a record; a later estimate is not reported."""
_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class TouchSearch:
    """Settings of the search for an obstacle."""

    order: TouchOrder
    """Settings of the control loop."""
    model: "TouchModel"
    """Model of the estimator."""


def touch_search(profile: Profile, excitation: Excitation) -> TouchSearch | None:
    """Return the touch search of an excitation; None for an excitation without an approach."""
    if excitation.approach is None:
        return None
    from rigd.touch import DetectorSettings, TouchModel, watched_beam

    rig = profile.rig
    sensor = rig.sensor
    stated: dict[str, Any] = {
        "angle_delay_s": rig.encoder.delay_s,
        "torque_delay_s": sensor.delay_s,
        "tool_inertia_kg_m2": sensor.tool_inertia_kg_m2,
        "sensor_filter": _sensor_filter(rig),
    }
    path = str(excitation.parameters["file"])
    if path:
        model = TouchModel.from_analysis(path, length_m=rig.beam.length_m, **stated)
    else:
        model = TouchModel.assumed(rig.beam, rig.damping, **stated)
    beam = watched_beam(model, rig.rate_hz, _noise(profile))
    shear = sensor.shear_projection if any(sensor.shear_projection) else None
    return TouchSearch(TouchOrder(beam, DetectorSettings(), excitation.approach, shear), model)


def _sensor_filter(rig: RigParameters) -> "SensorFilter":
    """Return the sensor filters that a profile states."""
    from rigd.touch import SensorFilter

    low_pass = rig.sensor.filter_hz, rig.sensor.filter_order
    serial = rig.ati_serial
    if serial is None:
        return SensorFilter(*low_pass)
    records = serial.records_per_tick(rig.rate_hz)
    return SensorFilter.of_records(*low_pass, serial.filter, records, 1 / serial.stream_hz)


def _noise(profile: Profile) -> "ChannelNoise":
    """Return the noise of the readings; only the ratio matters, its size is measured at rest."""
    from rigd.touch import ChannelNoise

    rig = profile.rig
    axes = np.array(rig.sensor.resolution)
    if rig.simulation is not None:
        axes = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
    torque_nm, shear_n = (
        float(np.linalg.norm(np.array(projection) * axes))
        for projection in (rig.sensor.projection, rig.sensor.shear_projection)
    )
    return ChannelNoise(torque_nm, shear_n or None, _STEP_STD * rig.encoder.resolution_rad)


class TouchEstimates:
    """Supervise the touch process of one session and collect its estimates."""

    def __init__(
        self,
        group: "ProcessGroup",
        search: TouchSearch,
        rate_hz: float,
        realtime: "RealtimeSettings | None" = None,
    ) -> None:
        self._group = group
        self._rate_hz = rate_hz
        self._events: list[LogEvent] = []
        self._news: list[dict[str, Any]] = []
        self._lost = ""
        self._ready = False
        self._reports: dict[int, TouchReport] = {}
        job = TouchJob(
            group.channels.specs,
            group.channels.samples.written,
            rate_hz,
            search.model,
            search.order.shear_projection,
            realtime,
        )
        try:
            group.fresh(TOUCH).start(job)
        except ChildError as error:
            self._lose(str(error))

    def await_ready(self, meanwhile: Callable[[], bool]) -> None:
        """Wait until the process is ready or lost, as long as `meanwhile` returns True."""
        late = await_ready(lambda: self._ready or bool(self._lost), self._listen, meanwhile)
        if late:
            self._lose(f"The touch process was {late}.")

    def listen(self, patience_s: float) -> bool:
        """Wait for an estimate for at most `patience_s`; return whether the process is running."""
        self._listen(patience_s)
        return not self._lost

    def poll(self) -> list[LogEvent]:
        """Read the received messages, and return the events for the operator."""
        self._listen(0.0)
        events, self._events = self._events, []
        return events

    def finish(self, touches: int, meanwhile: Callable[[], None]) -> list[dict[str, Any]]:
        """Wait for the last estimates of all detected touches; return each touch for JSON.

        A touch without an estimate has its number alone. ``final`` is false for a first estimate
        without a better one.
        """
        deadline_s = time.monotonic() + _LAST_PATIENCE_S

        def missing() -> bool:
            final = [report for report in self._reports.values() if report.final]
            return len(final) < touches and not self._lost and time.monotonic() < deadline_s

        while missing():
            self._listen(_POLL_S)
            meanwhile()
        return [_document(number, self._reports.get(number)) for number in range(1, touches + 1)]

    def packed(self) -> bytes:
        """Return the last estimates as messages for the session file."""
        touches = [(report.tick, report.document) for _, report in sorted(self._reports.items())]
        return packed_touches(touches, self._rate_hz)

    def news(self) -> list[dict[str, Any]]:
        """Return the estimates received since the last call, for the live view."""
        news, self._news = self._news, []
        return news

    def _listen(self, patience_s: float) -> None:
        if self._lost:
            return
        try:
            for message in self._group[TOUCH].messages(patience_s):
                if isinstance(message, TouchReady):
                    self._ready = True
                elif isinstance(message, TouchReport):
                    self._reports[message.number] = message
                    self._note(message)
        except ChildError as error:
            self._lose(str(error))

    def _note(self, report: TouchReport) -> None:
        touch = _document(report.number, report)
        self._news.append(touch)
        self._events.append(LogEvent(0, "info", touch_line(touch), notable=True))

    def _lose(self, why: str) -> None:
        self._lost = why
        text = f"{why} Touches are detected but not estimated; the session continues."
        self._events.append(LogEvent(0, "warning", text))


def _document(number: int, report: TouchReport | None) -> dict[str, Any]:
    if report is None:
        return {"number": number}
    # A first estimate may be the only one.
    return {"number": number, **report.document, **({} if report.final else {"final": False})}
