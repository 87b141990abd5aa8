"""Client of a rig's live view, and the data of a session that the view shows."""

import math
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rigd.beam import undamped_frequencies_rad_s
from rigd.engine.workers import LIVE
from rigd.live.address import LiveAddress
from rigd.live.messages import (
    LiveFit,
    LiveJob,
    LiveSession,
    LiveSessionEnded,
    LiveSessionShown,
    LiveTouches,
)
from rigd.profile import Profile
from rigd.runner._process_group import ProcessGroup
from rigd.runner._worker_client import WorkerClient
from rigd.runner.request import SessionOrder
from rigd.runtime import StopRequest
from rigd.session import linear_sweep_band_hz
from rigd.sweep_response import sweep_ticks
from rigd.view import SessionDescription
from rigd.view.plots import BUS_PLOT_COMPONENTS, REAL_TIME_PLOT_COMPONENTS

_ADDRESS_TIMEOUT_S = 10.0
"""Maximum time in seconds that a session waits for the address of the live view."""
_SHOW_TIMEOUT_S = 1.0
"""Maximum time in seconds that a session waits until the live view shows the session."""
_DEFAULT_FIT_BAND_HZ = 50.0
"""Upper frequency in Hz that is assumed for an excitation without start and stop frequencies."""
_MAX_FIT_MODES = 4
"""Maximum number of modes whose fits are plotted; more plots would be too small to read."""


class LiveViewClient(WorkerClient):
    """Client of the publisher process, which serves the live view."""

    worker = LIVE

    def __init__(
        self, group: ProcessGroup, rig_name: str, *, uses_virtual_clock: bool = False
    ) -> None:
        super().__init__(group)
        self._uses_virtual_clock = uses_virtual_clock
        self.address: LiveAddress | None = None
        self._job = LiveJob(rig_name, group.channels.specs)
        self._session: LiveSession | None = None
        self._is_session_shown = False
        self._restart()

    def show_session(self, session_order: SessionOrder, stop: StopRequest) -> str:
        """Prepare the view for the next session; return its address, or text on why it has none."""

        def is_not_stopped() -> bool:
            return not stop.requested

        self._restart_count = 0
        if self.failure:  # a new attempt for the new session
            self._restart()
        self._wait(lambda: self._is_ready, _ADDRESS_TIMEOUT_S, is_not_stopped)
        start_ring_positions = tuple(ring.written_count for ring in self._group.channels.rings)
        self._session = LiveSession(
            describe_planned_session(session_order, uses_virtual_clock=self._uses_virtual_clock),
            str(uuid.uuid4()),
            start_ring_positions,
            session_order.path.parent,
        )
        self._is_session_shown = False
        self._send(self._session)
        # The view then has all samples from the first one; the session does not depend on it.
        self._wait(lambda: self._is_session_shown, _SHOW_TIMEOUT_S, is_not_stopped)
        if self.failure:
            return f"No live view: {self.failure} The session continues without it."
        if self.address is None:
            return "The live view is still starting; open it with rigd live."
        return f"Live view: {self.address.viewer_url}"

    def show_touches(self, touches: Sequence[Mapping[str, Any]]) -> None:
        """Show estimated touches of the session, given as in JSON documents."""
        if touches and self._session is not None:
            self._send(LiveTouches(tuple(touches)))

    def show_fits(self, fits: Sequence[Mapping[str, Any]]) -> None:
        """Show the latest fit of the record, given as in JSON documents."""
        if fits and self._session is not None:
            self._send(LiveFit(fits[-1]))

    def finish(self, outcome: str, reason: str) -> None:
        """Show how the current session ended; pass empty texts if that is unknown."""
        if self._session is not None:
            self._session = None
            end_ring_positions = tuple(ring.written_count for ring in self._group.channels.rings)
            self._send(LiveSessionEnded(end_ring_positions, outcome, reason))

    def _restart(self) -> None:
        """Start a publisher process, and send it the rig and the current session."""
        self._start(self._job, *([] if self._session is None else [self._session]))

    def _process_message(self, message: object) -> None:
        """Process a message of the publisher: its address, or that the session is shown."""
        match message:
            case LiveSessionShown():
                self._is_session_shown = True
            case LiveAddress():
                previous_address, self.address = self.address, message
                if (
                    previous_address is not None
                    and previous_address.viewer_url != message.viewer_url
                ):
                    self._add_event("info", f"Live view: {message.viewer_url}")

    def _process_failure(self, reason: str) -> None:
        """Continue this session without the view, which the next session tries to start again."""
        self.failure, self.address = reason, None
        if self._session is not None:
            self._add_event("warning", f"No live view: {reason} The session continues.")

    def _give_up(self, reason: str) -> None:
        """Continue without the view when no restart is left, and add an event with the reason."""
        super()._give_up(reason)
        self.address = None


def describe_planned_session(
    session_order: SessionOrder, *, uses_virtual_clock: bool = False
) -> SessionDescription:
    """Return the data of a session that the live view shows, such as beam, sweep and limits."""
    rig_parameters, excitation = session_order.profile.rig, session_order.excitation
    absent_plots: set[str] = set()
    if rig_parameters.devices.drive == rig_parameters.devices.sensor == "sim":
        absent_plots |= BUS_PLOT_COMPONENTS
    if uses_virtual_clock:
        absent_plots |= REAL_TIME_PLOT_COMPONENTS
    return SessionDescription(
        name=session_order.path.stem,
        rate_hz=rig_parameters.rate_hz,
        scheduled_ticks=excitation.reference_rad.size,
        sweep=sweep_ticks(excitation.segments),
        beam=rig_parameters.beam,
        damping=rig_parameters.damping,
        tool_inertia_kg_m2=rig_parameters.sensor.tool_inertia_kg_m2,
        angle_delay_s=rig_parameters.encoder.delay_s,
        torque_delay_s=rig_parameters.sensor.delay_s,
        excitation=excitation.kind,
        sweep_hz=linear_sweep_band_hz(excitation.kind, excitation.parameters),
        return_sweep=excitation.segments.get("back"),
        specimen=dict(session_order.notes).get("specimen", ""),
        limits=gauge_limits(session_order.profile),
        thermal_time_constant_s=rig_parameters.motor.thermal_time_constant_s,
        absent_components=frozenset(absent_plots),
        fitted_mode_count=_fit_mode_count(session_order),
    )


def _fit_mode_count(session_order: SessionOrder) -> int | None:
    """Return the number of modes expected in the excited band, whose fits are plotted.

    Returns None if the session makes no fits.
    """
    excitation = session_order.excitation
    if not session_order.makes_fits:
        return None
    sweep_limits_hz = (
        excitation.parameters.get(frequency_key, _DEFAULT_FIT_BAND_HZ)
        for frequency_key in ("start_hz", "stop_hz")
    )
    highest_fit_frequency_hz = max(float(end) for end in sweep_limits_hz)
    expected_frequencies_hz = (
        undamped_frequencies_rad_s(session_order.profile.rig.beam, _MAX_FIT_MODES) / math.tau
    )
    return max(1, int(np.count_nonzero(expected_frequencies_hz < highest_fit_frequency_hz)))


def gauge_limits(profile: Profile) -> dict[str, float]:
    """Return the limit of each gauge of the live view: gauge name → limit in SI units.

    The limit of missed ticks is in percent.
    """
    limits, motor_parameters, sensor_parameters = (
        profile.limits,
        profile.rig.motor,
        profile.rig.sensor,
    )
    wrench_axes = ("fx", "fy", "fz", "tx", "ty", "tz")
    return {
        "angle": limits.angle_rad,
        "velocity": limits.velocity_rad_s,
        "tracking_error": limits.tracking_error_rad,
        # A torque command beyond this limit is clipped.
        "torque_command": motor_parameters.peak_torque_nm,
        "i2t": motor_parameters.continuous_torque_nm,
        "missed": limits.missed_percent,
    } | {
        wrench_axis: limits.sensor_range_percent / 100.0 * axis_range
        for wrench_axis, axis_range in zip(wrench_axes, sensor_parameters.range, strict=True)
    }
