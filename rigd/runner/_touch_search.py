"""Search for an obstacle: settings of the touch detector, and client of the touch process.

The control loop detects a touch and reacts to it. Meanwhile the touch process estimates position
and force. If the touch process fails, the session continues without estimates.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rigd.devices.parameters import RigParameters
from rigd.engine.messages import TouchJob, TouchOrder, TouchReport
from rigd.engine.shared_state import LogEvent
from rigd.engine.workers import TOUCH
from rigd.excitation import Excitation, TouchExcitation
from rigd.profile import Profile
from rigd.runner._worker_client import WorkerClient
from rigd.runner.planning import RefusedError
from rigd.session.touches import packed_touches, touch_line

if TYPE_CHECKING:
    from rigd.profile import RealtimeSettings
    from rigd.runner._process_group import ProcessGroup
    from rigd.touch import ChannelNoise, SensorFilter, TouchModel

_ROUNDING_STD_PER_STEP: Final = 1 / sqrt(12)
"""Standard deviation of the rounding error, as a fraction of the quantisation step."""
_FINAL_ESTIMATES_TIMEOUT_S: Final = 120.0
"""Maximum time in seconds to wait for the final estimates after the end of a record. They take
seconds, but more than half a minute if five programs compete for each processor."""
_WAIT_ANNOUNCED_AFTER_S: Final = 2.0
"""Time in seconds after which the wait for the final estimates is announced."""


@dataclass(frozen=True, slots=True)
class TouchSearch:
    """Settings of the search for an obstacle in a session."""

    order: TouchOrder
    """Settings with which the control loop detects a touch and reacts to it."""
    model: "TouchModel"
    """Model of beam and sensor with which the touch process estimates touches."""


def touch_search(profile: Profile, excitation: Excitation) -> TouchSearch | None:
    """Return the settings of the search for an obstacle, or None if there is no search.

    Raise `RefusedError` if the profile states a mass at the tip, which no model of touches has.
    """
    if not isinstance(excitation, TouchExcitation):
        return None
    if profile.tip_mass_kg:
        beam_file_path = profile.path if profile.specimen is None else profile.specimen.path
        raise RefusedError(
            f"{beam_file_path}: beam.tip_mass_kg = {profile.tip_mass_kg:.4g} kg: a search for "
            "touches does not take a mass at the tip into account; take it off, and remove the "
            "key."
        )
    from rigd.touch import DetectorSettings, TouchModel, detector_model

    rig = profile.rig
    sensor = rig.sensor
    sensor_filter = _sensor_filter(rig)
    analysis_path = str(excitation.parameters["file"])
    if analysis_path:
        touch_model = TouchModel.from_analysis(
            analysis_path, profile.plant, rig.encoder.delay_s, sensor_filter
        )
    else:
        touch_model = TouchModel.with_assumed_uncertainty(
            profile.plant, rig.encoder.delay_s, sensor_filter
        )
    beam_prediction = detector_model(touch_model, rig.rate_hz, _reading_noise(profile))
    shear_projection = sensor.shear_projection if any(sensor.shear_projection) else None
    return TouchSearch(
        TouchOrder(beam_prediction, DetectorSettings(), excitation.approach, shear_projection),
        touch_model,
    )


def _sensor_filter(rig: RigParameters) -> "SensorFilter":
    """Return the low-pass filters in the sensor's signal path that a profile states."""
    from rigd.touch import SensorFilter

    low_pass_hz_and_order = rig.sensor.filter_hz, rig.sensor.filter_order
    serial_settings = rig.ati_serial
    if serial_settings is None:
        return SensorFilter(*low_pass_hz_and_order)
    records_per_tick = serial_settings.records_per_tick(rig.rate_hz)
    return SensorFilter.for_records(
        *low_pass_hz_and_order,
        serial_settings.filter,
        records_per_tick,
        1 / serial_settings.stream_hz,
    )


def _reading_noise(profile: Profile) -> "ChannelNoise":
    """Return the standard deviations of torque, shear force and angle readings.

    Only the ratios are used, because the touch detector measures the level of the noise at rest.
    """
    from rigd.touch import ChannelNoise

    rig = profile.rig
    axis_noise = np.array(rig.sensor.resolution)
    if rig.simulation is not None:
        axis_noise = np.repeat([rig.simulation.force_noise_n, rig.simulation.torque_noise_nm], 3)
    torque_std_nm, shear_std_n = (
        float(np.linalg.norm(np.array(projection) * axis_noise))
        for projection in (rig.sensor.projection, rig.sensor.shear_projection)
    )
    return ChannelNoise(
        torque_std_nm, shear_std_n or None, _ROUNDING_STD_PER_STEP * rig.encoder.resolution_rad
    )


class TouchClient(WorkerClient):
    """Client that collects the estimates of one session's touch process."""

    worker = TOUCH

    def __init__(
        self,
        group: "ProcessGroup",
        search: TouchSearch,
        rate_hz: float,
        realtime: "RealtimeSettings | None" = None,
    ) -> None:
        super().__init__(group)
        self._rate_hz = rate_hz
        self._new_estimates: list[dict[str, Any]] = []
        self._reports: dict[int, TouchReport] = {}
        self._start(
            TouchJob(
                group.channels.specs,
                group.channels.samples.written_count,
                rate_hz,
                search.model,
                search.order.shear_projection,
                realtime,
            )
        )

    def finish(
        self, touch_count: int, call_while_waiting: Callable[[], None]
    ) -> list[dict[str, Any]]:
        """Wait for the final estimates of all detected touches; return a JSON dictionary for each.

        `touch_count` is the number of detected touches. The dictionary of a touch without an
        estimate contains its number only. If only the less accurate first estimate is known,
        ``final`` is False. `call_while_waiting` is called repeatedly meanwhile.
        """
        announce_time_s = time.monotonic() + _WAIT_ANNOUNCED_AFTER_S
        is_announced = False

        def are_touches_final() -> bool:
            final_count = sum(touch_report.final for touch_report in self._reports.values())
            return final_count >= touch_count

        def announce_and_report() -> None:
            nonlocal is_announced
            if (
                not (is_announced or self._is_stop_requested)
                and time.monotonic() >= announce_time_s
            ):
                is_announced = True
                wait_text = "Waiting for the estimates of the touches; a stop skips them."
                self._events.append(LogEvent(0, "info", wait_text, notable=True))
            call_while_waiting()

        self._await_results(are_touches_final, _FINAL_ESTIMATES_TIMEOUT_S, announce_and_report)
        return [
            _touch_document(touch_number, self._reports.get(touch_number))
            for touch_number in range(1, touch_count + 1)
        ]

    def encoded_touches(self) -> bytes:
        """Return the latest estimate of each touch as encoded messages for the session file."""
        ticks_and_documents = [
            (touch_report.tick, touch_report.document)
            for _, touch_report in sorted(self._reports.items())
        ]
        return packed_touches(ticks_and_documents, self._rate_hz)

    def take_new_estimates(self) -> list[dict[str, Any]]:
        """Return the estimates that were received since the last call."""
        estimates, self._new_estimates = self._new_estimates, []
        return estimates

    def _process_message(self, message: object) -> None:
        """Store the estimate that a message of the touch process reports, and add an event."""
        if isinstance(message, TouchReport):
            self._reports[message.number] = message
            touch_document = _touch_document(message.number, message)
            self._new_estimates.append(touch_document)
            self._events.append(LogEvent(0, "info", touch_line(touch_document), notable=True))


def _touch_document(touch_number: int, touch_report: TouchReport | None) -> dict[str, Any]:
    """Return a touch as a dictionary for JSON: its number, and its estimate if there is one."""
    if touch_report is None:
        return {"number": touch_number}
    # A first estimate may be the only one.
    return {
        "number": touch_number,
        **touch_report.document,
        **({} if touch_report.final else {"final": False}),
    }
