"""Live view of a rig: starts the publisher process, watches it, and restarts it if it is lost."""

import math
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rigd.beam import undamped_frequencies_rad_s
from rigd.engine.messages import Failed
from rigd.engine.processes import LIVE, ChildError, Heartbeat
from rigd.engine.shared_state import Level, LogEvent, StateField
from rigd.live.address import LiveAddress
from rigd.live.messages import LiveEnd, LiveFit, LiveJob, LiveSession, LiveShown, LiveTouches
from rigd.profile import Profile
from rigd.runner._process_group import ProcessGroup
from rigd.runner.request import Order
from rigd.runtime import StopRequest
from rigd.view import Subject, band_of, sweep_of
from rigd.view.plots import OF_A_BUS, OF_REAL_TIME

_PATIENCE_S = 10.0
"""Longest time for which a session waits for the start of the live view."""
_START_PATIENCE_S = 60.0
"""Time after which a starting publisher counts as hung, also on a busy computer."""
_BEGIN_PATIENCE_S = 1.0
_FIT_BAND_HZ = 50.0
"""Upper end of the band assumed for an excitation without a band."""
_MOST_FIT_MODES = 4
"""Largest number of modes whose fits are plotted; more plots would be too small to read."""
_MOST_RESTARTS = 3
"""Largest number of restarts in one session."""


class LiveView:
    """Publisher process of a rig; a session continues without it if it is lost."""

    def __init__(self, group: ProcessGroup, rig: str, *, fast: bool = False) -> None:
        self._fast = fast
        self.address: LiveAddress | None = None
        self._group = group
        self._job = LiveJob(rig, group.channels.specs)
        self._session: LiveSession | None = None
        self._unreported: list[LogEvent] = []
        self._restarts = 0
        self._lost = ""
        self._shown = False
        self._start()

    def show(self, order: Order, stop: StopRequest) -> str:
        """Show the next session; return the address of the view, or why there is none."""
        self._restarts = 0
        if self._lost:  # a new attempt for the new session
            self._start()
        self._await(lambda: self._answered, _PATIENCE_S, stop)
        begins = tuple(ring.written for ring in self._group.channels.rings)
        self._session = LiveSession(
            subject_of(order, fast=self._fast), str(uuid.uuid4()), begins, order.path.parent
        )
        self._shown = False
        self._send(self._session)
        # The view then has all samples from the first one; the session does not depend on it.
        self._await(lambda: self._shown, _BEGIN_PATIENCE_S, stop)
        if self._lost:
            return f"No live view: {self._lost} The session continues without it."
        if self.address is None:
            return "The live view is still starting; open it with rigd live."
        return f"Live view: {self.address.viewer_url}"

    def check(self) -> None:
        """Check whether the publisher is running; restart it if it died or hangs."""
        if not self._lost:
            self._listen(0.0)
        if not self._lost:
            self._feel_pulse()

    def poll(self) -> list[LogEvent]:
        """Check the publisher, and return the events for the operator."""
        self.check()
        events, self._unreported = self._unreported, []
        return events

    def touched(self, touches: Sequence[Mapping[str, Any]]) -> None:
        """Show touches of the session, as in JSON documents."""
        if touches and self._session is not None:
            self._send(LiveTouches(tuple(touches)))

    def fitted(self, fits: Sequence[Mapping[str, Any]]) -> None:
        """Show the latest fit of the record, as in JSON documents."""
        if fits and self._session is not None:
            self._send(LiveFit(fits[-1]))

    def finish(self, outcome: str, reason: str) -> None:
        """Show the end of the current session; its outcome may be unknown."""
        if self._session is not None:
            self._session = None
            ends = tuple(ring.written for ring in self._group.channels.rings)
            self._send(LiveEnd(ends, outcome, reason))

    def _await(self, met: Callable[[], bool], patience_s: float, stop: StopRequest) -> None:
        """Listen until a condition is met, the publisher is lost, or the time is over."""
        deadline = time.monotonic() + patience_s
        while not (met() or self._lost or stop.requested) and time.monotonic() < deadline:
            self._listen(0.1)

    def _start(self) -> None:
        """Start a new process."""
        self._answered = False
        self._lost = ""
        self._pulse = Heartbeat()
        try:
            self._group.fresh(LIVE)
        except ChildError as error:
            self._lost, self.address = str(error), None
            return
        self._send(self._job)
        if self._session is not None:
            self._send(self._session)

    def _send(self, message: object) -> None:
        if self._lost:
            return
        try:
            self._group[LIVE].send(message)
        except ChildError as error:
            self._restart(str(error))

    def _listen(self, patience_s: float) -> None:
        try:
            answer = self._group[LIVE].poll(patience_s)
        except ChildError as error:
            self._restart(str(error))
        else:
            if answer is not None:
                self._understand(answer)

    def _understand(self, answer: object) -> None:
        match answer:
            case LiveShown():
                self._shown = True
            case LiveAddress():
                before, self.address = self.address, answer
                self._answered = True
                if before is not None and before.viewer_url != answer.viewer_url:
                    self._note("info", f"Live view: {answer.viewer_url}")
            case _:
                self._lost = answer.reason if isinstance(answer, Failed) else str(answer)
                self.address = None
                if self._session is not None:
                    self._note("warning", f"No live view: {self._lost} The session continues.")

    def _feel_pulse(self) -> None:
        assert LIVE.hung_after_s is not None
        patience_s = LIVE.hung_after_s if self._answered else _START_PATIENCE_S
        beat = self._group.channels.shared_state[StateField.LIVE_BEAT]
        if self._pulse.stalled_for(beat, time.monotonic()) > patience_s:
            self._restart(f"The live process was killed: no response for {patience_s:g} s.")

    def _restart(self, why: str) -> None:
        self._restarts += 1
        if self._restarts > _MOST_RESTARTS:
            self._lost, self.address = why, None
            self._note("warning", f"{why} It is not restarted; the session continues.")
            return
        self._note("warning", f"{why} It is restarted; the session continues.")
        self._group[LIVE].kill()
        self._start()

    def _note(self, level: Level, message: str) -> None:
        self._unreported.append(LogEvent(0, level, message))


def subject_of(order: Order, *, fast: bool = False) -> Subject:
    """Return the data of a session that the live view needs."""
    rig, excitation = order.profile.rig, order.excitation
    absent: set[str] = set()
    if rig.devices.drive == rig.devices.sensor == "sim":
        absent |= OF_A_BUS
    if fast:
        absent |= OF_REAL_TIME
    return Subject(
        name=order.path.stem,
        rate_hz=rig.rate_hz,
        ticks=excitation.reference_rad.size,
        sweep=sweep_of(excitation.segments),
        beam=rig.beam,
        damping=rig.damping,
        tool_inertia_kg_m2=rig.sensor.tool_inertia_kg_m2,
        angle_delay_s=rig.encoder.delay_s,
        torque_delay_s=rig.sensor.delay_s,
        excitation=excitation.kind,
        sweep_hz=band_of(excitation.kind, excitation.parameters),
        back=excitation.segments.get("back"),
        specimen=dict(order.notes).get("specimen", ""),
        limits=gauge_limits(order.profile),
        thermal_time_constant_s=rig.motor.thermal_time_constant_s,
        absent=frozenset(absent),
        fit_modes=_fit_modes(order),
    )


def _fit_modes(order: Order) -> int | None:
    """Return the number of modes whose fits are plotted: those expected in the excited band."""
    excitation = order.excitation
    if excitation.search is None and not order.watch_fit:
        return None
    ends = (excitation.parameters.get(name, _FIT_BAND_HZ) for name in ("start_hz", "stop_hz"))
    highest_hz = max(float(end) for end in ends)
    expected_hz = undamped_frequencies_rad_s(order.profile.rig.beam, _MOST_FIT_MODES) / math.tau
    return max(1, int(np.count_nonzero(expected_hz < highest_hz)))


def gauge_limits(profile: Profile) -> dict[str, float]:
    """Return the limits of the gauges by name; the limit of missed ticks is in percent."""
    limits, motor, sensor = profile.limits, profile.rig.motor, profile.rig.sensor
    axes = ("fx", "fy", "fz", "tx", "ty", "tz")
    return {
        "angle": limits.angle_rad,
        "velocity": limits.velocity_rad_s,
        "tracking_error": limits.tracking_error_rad,
        # A torque command beyond this limit is clipped.
        "torque_command": motor.peak_torque_nm,
        "i2t": motor.continuous_torque_nm,
        "missed": limits.missed_percent,
    } | {
        axis: limits.sensor_range_percent / 100.0 * end
        for axis, end in zip(axes, sensor.range, strict=True)
    }
