"""Steps of a session: tare, enable, hold, record, damp, return, disable, check the tare.

The record extends from tick 0 to the last tick of the excitation. The other steps use the same
cycle (`rigd.engine.cycle.Cycle`) and write their results to the metadata of the session file.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigd.control.contracts import ControllerError
from rigd.control.damper import VibrationDamper
from rigd.devices.contracts import DeviceError
from rigd.devices.kinds import failure_of_device
from rigd.engine._publish import ReadingPublisher, SampleLog
from rigd.engine.channels import Channels
from rigd.engine.cycle import Cycle, RestReadings, StandstillMonitor, observe_rest
from rigd.engine.messages import PostRecordPlan
from rigd.engine.processes import SupervisorConnection
from rigd.engine.realtime import page_faults
from rigd.engine.reference import ReferenceReader
from rigd.engine.shared_state import Level, LogEvent, Phase, StateField, StopReason, write_event
from rigd.engine.timing import (
    MAX_VIRTUAL_PAUSE_S,
    MIN_SUSPENSION_S,
    Clock,
    SuspendMonitor,
    TickScheduler,
)
from rigd.excitation.moves import quintic, vibration_free_path
from rigd.profile import Profile
from rigd.runtime import StopRequest
from rigd.safety import SLOW_CHECK_TICKS
from rigd.safety.limits import INTERLOCKS_BY_NAME, OVERLOADED_ADVICE

if TYPE_CHECKING:
    from rigd.engine._touch_monitor import TouchMonitor

_SETTLING_S = 0.5
"""Time in s to hold the motor before tick 0, and to wait before the tare after the record."""
_VIRTUAL_POLL_S = 0.0002
"""Pause in s between two polls of the shared state while virtual time does not advance."""
_START_TIMEOUT_S = 10.0
"""Longest time in s that the control process waits for the supervisor to start the record."""
_SUPERVISOR_TIMEOUT_S = 2.0
"""Longest time in s without a heartbeat of the supervisor. Only time in which this process ran
counts, because the supervisor cannot run either while the computer is stalled."""
_WRONG_SIGN_CHANNELS = tuple(
    INTERLOCKS_BY_NAME[name].channel for name in ("angle", "velocity", "tracking error")
)
"""Channels of the limits that a wrong sign of angle or torque violates."""
_ENCODER_CHANNELS = tuple(
    INTERLOCKS_BY_NAME[name].channel
    for name in ("encoder jump", "frozen encoder", "stopped encoder", "repeated angle")
)
"""Channels of the interlocks that detect a failed encoder."""
_WRONG_SIGN_REMEDY = (
    "The shaft accelerates against the torque: angle and torque have opposite signs. "
    "Check the drive's polarity (object 607E), cia402.direction and the wiring of motor and "
    "encoder; a lower amplitude does not help."
)
"""Advice for the operator if the sign of angle or torque is wrong."""
_ENCODER_TESTED_MESSAGE = "The beam pulled on a shaft at rest, so the encoder was tested: it works."
_VIBRATING_TORQUE_SPREAD_RATIO = 2.0
"""Ratio of the coupling torque's standard deviation after a session to its value before the
session, above which the beam counts as vibrating."""
_LONGEST_DAMPING_S = 5.0
"""Longest duration of active damping in s, which is twice the time needed to damp a vibration with
the sensor's full range."""
_TORQUE_SPREAD_WINDOW_S = 0.4
"""Window in s over which the standard deviation of the coupling torque is computed. It is one
period of a first mode at 2.5 Hz."""
_TORQUE_SPREAD_CHECK_TICKS = 50
"""Number of ticks between two checks of the coupling torque's standard deviation."""
_DAMPED_TORQUE_SPREAD_RATIO = 1.25
"""Largest ratio of the coupling torque's standard deviation to its value at rest with which the
beam counts as damped. The vibration is then less than the noise, and the standard deviation over
so short a time scatters by 4 %."""
_MAX_DAMPING_ANGLE_RAD = 0.1
"""Largest angle in rad by which active damping moves the motor."""
_LONGEST_SHAPED_RETURN_S = 5.0
"""Longest duration in s of a return to the start angle whose path is shaped to excite no vibration.
A slower return excites none in any case."""


class SessionEnd(Exception):
    """Exception that ends a session early, with its outcome and the reason.

    Attributes
    ----------
    outcome, reason
        How and why the session ended, for the file and the operator.
    device_failed
        Whether a device failed, so that it must be reconnected.
    """

    def __init__(self, outcome: str, reason: str, *, device_failed: bool = False) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.reason = reason
        self.device_failed = device_failed


class SessionSequence:
    """Steps of one session on connected devices, from the tare to the check for drift of the tare.

    `reference_rad` is the angle per tick, relative to the start angle. `reference_reader` reads a
    reference that grows during the record; None if the reference is complete. `standstill` monitors
    the angles that are read while the torque is off. `channels` are the rings for samples, the
    controller's terms and events. `parent` is the connection to the supervisor process, and
    `stop_request` has the stop requests that reached this process as signals. `ending` plans the
    steps after the record. `touch` is None if the session does not search for an obstacle.
    """

    def __init__(
        self,
        profile: Profile,
        reference_rad: Sequence[float],
        cycle: Cycle,
        clock: Clock,
        scheduler: TickScheduler,
        standstill: StandstillMonitor,
        channels: Channels,
        reading_publisher: ReadingPublisher,
        parent: SupervisorConnection,
        stop_request: StopRequest,
        ending: PostRecordPlan,
        touch: "TouchMonitor | None" = None,
        reference_reader: ReferenceReader | None = None,
    ) -> None:
        self._touch = touch
        self._reader = reference_reader
        self._reading_publisher = reading_publisher
        self._profile = profile
        self._cycle = cycle
        self._clock = clock
        self._channels = channels
        self._shared_state = channels.shared_state
        self._parent = parent
        self._stop = stop_request
        self._rate_hz = profile.rig.rate_hz
        self._scheduler = scheduler
        self._standstill = standstill
        self._suspend_monitor = SuspendMonitor()
        self._page_faults = 0
        self._doubts_reported: set[str] = set()
        self._polls_without_heartbeat = 0
        self._supervisor_beat = -1
        late_limit_ns = int(profile.realtime.late_us * 1000)
        self._sample_log = SampleLog(cycle, self._scheduler, clock, channels, late_limit_ns)
        self._relative_reference = reference_rad
        # Each segment of a growing reference is planned with the start angle.
        planned_rad = np.asarray(reference_rad)
        self._reference_range_rad = float(planned_rad.min()), float(planned_rad.max())
        self._ending = ending
        self._return_path = _return_path(profile, ending)
        self._end_angle_rad = 0.0
        self._start_angle_rad = 0.0
        self._rest_spread_nm = 0.0
        self._recording = False
        self._encoder_tests = 0
        self.counts = self._sample_log.counts
        self.results: dict[str, str] = {}
        """Results for the metadata ``outcome`` of the file, in addition to the counts."""

    def measure_tare(self) -> dict[str, str]:
        """Tare the sensor at rest before the drive is enabled; return the tare as metadata.

        The metadata are the mean and the standard deviation of each axis in N and N·m, and the
        start angle. Raise `SessionEnd` if the rig does not come to rest in time, or the reference,
        started at the present angle, would exceed the angle limit.
        """
        self._cycle.limit_monitor.reset(0.0)  # the counts of the last session no longer apply
        rest_readings = self._wait_for_rest()
        self._start_angle_rad = float(np.mean(rest_readings.angles_rad))
        angle_limit_rad = self._profile.limits.angle_rad
        if abs(self._start_angle_rad) > angle_limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, outside "
                f"limits.angle_rad = {angle_limit_rad:g} rad; turn it back and start again.",
            )
        goal_rad = max(
            (self._start_angle_rad + extreme_rad for extreme_rad in self._reference_range_rad),
            key=abs,
        )
        if abs(goal_rad) > angle_limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, from where the reference goes "
                f"to {goal_rad:.4g} rad, outside limits.angle_rad = {angle_limit_rad:g} rad. "
                "Move it back first (rigd run move 0; rigd start move 0 with a daemon), or "
                "lower the amplitude.",
            )
        sensor_violation = self._cycle.sensor_monitor.finish_learning()
        self._report_warnings()
        if sensor_violation is not None:
            raise SessionEnd("fault", str(sensor_violation))
        self._rest_spread_nm = rest_readings.torque_spread_nm
        self._compare_with_previous_tare(float(rest_readings.torques_nm.mean()))
        self._cycle.tare = rest_readings.mean_wrench
        return rest_readings.as_metadata() | {"start_angle_rad": repr(self._start_angle_rad)}

    def _compare_with_previous_tare(self, tare_torque_nm: float) -> None:
        """Raise `SessionEnd` if the torque at rest differs too much from the previous tare.

        `tare_torque_nm` is the coupling torque at rest in N·m, stored for the next comparison.
        """
        limit_monitor = self._cycle.limit_monitor
        if limit_monitor.tared_nm is not None:
            violation = limit_monitor.check_tare(tare_torque_nm - limit_monitor.tared_nm)
            self._report_warnings()
            if violation is not None:
                raise SessionEnd(
                    "fault", f"{violation} If nothing is wrong, run rigd tare to set a new zero."
                )
        limit_monitor.tared_nm = tare_torque_nm

    def _wait_for_rest(self) -> RestReadings:
        """Wait until motor and beam are at rest, and return the readings of the interval at rest.

        Raise `SessionEnd` if the rig does not come to rest within ``session.rest_timeout_s``.
        """
        session_settings = self._profile.session
        self._shared_state[StateField.PHASE] = Phase.TARING
        remaining_s = session_settings.rest_timeout_s
        while True:
            self._cycle.sensor_monitor.start_learning()
            rest_readings = self._read_rest(session_settings.tare_s)
            motion_text = self._describe_motion(rest_readings)
            if not motion_text:
                return rest_readings
            remaining_s -= rest_readings.duration_s
            if remaining_s <= 0.0:
                raise SessionEnd(
                    "fault",
                    f"{motion_text} It did not come to rest within session.rest_timeout_s = "
                    f"{session_settings.rest_timeout_s:g} s; wait until it is at rest and "
                    "start again.",
                )
            if self._shared_state[StateField.PHASE] != Phase.WAITING:
                self._shared_state[StateField.PHASE] = Phase.WAITING
                self._log_event("info", f"Waiting until the rig is at rest. {motion_text}")

    def _describe_motion(self, rest_readings: RestReadings) -> str:
        """Return a sentence that says how motor or beam moves, or an empty text if both rest."""
        settings = self._profile.session
        if rest_readings.speed_rad_s > settings.rest_velocity_rad_s:
            return (
                f"The motor is not at rest: it moves by {rest_readings.speed_rad_s:.2g} rad/s, "
                f"more than session.rest_velocity_rad_s = {settings.rest_velocity_rad_s:g} rad/s."
            )
        if rest_readings.torque_spread_nm > settings.rest_torque_nm:
            return (
                f"The beam is not at rest: the coupling torque varies by "
                f"{rest_readings.torque_spread_nm:.2g} N·m, more than session.rest_torque_nm = "
                f"{settings.rest_torque_nm:g} N·m."
            )
        return ""

    def hold_start_angle(self) -> None:
        """Hold the motor at its present angle for 0.5 s after the drive has been enabled."""
        self._shared_state[StateField.PHASE] = Phase.SETTLING
        self._standstill.reset()
        # The last reading, not the mean: the controller must start without a step.
        self._start_angle_rad = self._cycle.angle_rad
        self._cycle.start_control(self._rest_spread_nm)
        for tick_number in range(round(_SETTLING_S * self._rate_hz)):
            # Enabling the drive before the first tick takes longer than a tick.
            self._run_tick(self._start_angle_rad, may_miss_ticks=tick_number == 0)

    def wait_for_go(self) -> None:
        """Hold the motor until the supervisor requests the start of the record.

        Virtual time does not advance meanwhile. Raise `SessionEnd` if the supervisor does not start
        the record within 10 s.
        """
        self._shared_state[StateField.PHASE] = Phase.READY
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while not self._shared_state[StateField.RECORD_MAY_START]:
            if time.monotonic() > deadline_s:
                raise SessionEnd(
                    "fault",
                    f"The supervisor did not start the record within {_START_TIMEOUT_S:g} s. "
                    "Check CPU load.",
                )
            if self._clock.virtual:
                self._reading_publisher.publish(self._cycle, self._scheduler.due_ns)
                self._switch_off_if_stopped()
                time.sleep(_VIRTUAL_POLL_S)
            else:
                self._run_tick(self._start_angle_rad)

    def run_record(self) -> None:
        """Run the excitation and log a sample of every tick.

        Every tick of the record counts as recorded, missed or lost. Raise `SessionEnd` if the
        record ends early. The last sample then has the torque off, unless the last ticks of the
        record were missed or lost.
        """
        relative_reference_rad, start_rad = self._relative_reference, self._start_angle_rad
        total_ticks = len(relative_reference_rad)
        scheduler, cycle, log, shared_state = (
            self._scheduler,
            self._cycle,
            self._sample_log,
            self._shared_state,
        )
        counts, is_virtual, stop_request = self.counts, self._clock.virtual, self._stop
        touch_monitor, reader = self._touch, self._reader
        stop_field, scheduled_field = (
            shared_state.field_view(StateField.STOP_REASON),
            shared_state.field_view(StateField.SCHEDULED_TICKS),
        )
        scheduler.restart()
        self._recording = True
        self._page_faults = page_faults()
        start_utc_ns, start_monotonic_ns = time.time_ns(), time.monotonic_ns()
        # With the real clock tick 0 is still ahead, or up to one period in the past.
        time_until_start_ns = 0 if is_virtual else scheduler.start_ns - start_monotonic_ns
        shared_state[StateField.START_UTC_NS] = start_utc_ns + time_until_start_ns
        shared_state[StateField.PHASE] = Phase.RUNNING
        self._log_event("info", f"Record starts: {total_ticks} ticks at {self._rate_hz:g} Hz.")
        last_tick = -1
        first_tick_ns = last_tick_ns = 0
        reference_rad = start_rad
        session_end: SessionEnd | None = None
        while session_end is None and last_tick < total_ticks - 1:
            if reader is not None:
                if is_virtual:
                    self._await_segment(reader, last_tick + 1)
                if reader.is_after_end(last_tick + 1):
                    break
            missed_ticks = scheduler.wait()
            tick_number = scheduler.tick
            if missed_ticks:
                missed_ticks = min(tick_number, total_ticks) - last_tick - 1
                counts.missed += missed_ticks
                shared_state[StateField.MISSED_TICKS] = counts.missed
                session_end = self._check_missed_ticks(missed_ticks, min(tick_number, total_ticks))
                if tick_number >= total_ticks:
                    last_tick, reference_rad = (
                        total_ticks - 1,
                        start_rad + relative_reference_rad[-1],
                    )
                    break
            if session_end is None and cycle.has_stale_reading:  # in the tick before
                session_end = self._check_stale_readings(tick_number)
            if session_end is None and (
                stop_field[0]
                or counts.lost
                or stop_request.requested
                or tick_number % SLOW_CHECK_TICKS == 0
            ):
                session_end = self._check_for_session_end()
            reference_rad = start_rad + (
                relative_reference_rad[tick_number]
                if reader is None
                else reader.reference_at(tick_number)
            )
            if session_end is None:
                session_end = self._control_tick(reference_rad)
                if touch_monitor is not None and session_end is None:
                    session_end = self._monitor_touch(touch_monitor, tick_number, missed_ticks)
            else:
                self._switch_off_and_observe()
            wait_for_slot = is_virtual or session_end is not None
            log.write_sample(tick_number, reference_rad, missed_ticks, wait_for_slot=wait_for_slot)
            scheduled_field[0] = tick_number + 1
            last_tick_ns = scheduler.t_ns + scheduler.lateness_ns
            if last_tick < 0:
                first_tick_ns = last_tick_ns
            last_tick = tick_number
        self._end_angle_rad = reference_rad
        counts.scheduled = scheduled_field[0] = last_tick + 1
        if counts.lost and session_end is None:
            session_end = self._stop_reason()
        if session_end is not None:
            cycle.switch_torque_off()
        self._publish_readings()
        for doubt_count_text in self._reading_publisher.doubt_counts:
            self._log_event("warning", doubt_count_text)
        self._record_clock_results(start_utc_ns, start_monotonic_ns, last_tick_ns - first_tick_ns)
        if session_end is not None:
            raise session_end

    def _await_segment(self, reference_reader: ReferenceReader, tick: int) -> None:
        """Wait, without advancing virtual time, until the fit process has planned a tick.

        With devices on a bus or serial line, return after at most 1 s: the tick then holds the last
        angle, so that the devices do not treat the silent host as failed.
        """
        uses_line = self._cycle.devices.uses_line
        wait_start_s = time.monotonic()
        while reference_reader.must_wait(tick) and self._stop_reason() is None:
            if uses_line and time.monotonic() - wait_start_s > MAX_VIRTUAL_PAUSE_S:
                return
            self._reading_publisher.publish(self._cycle, self._scheduler.due_ns)
            time.sleep(_VIRTUAL_POLL_S)

    def _monitor_touch(
        self, touch_monitor: "TouchMonitor", tick: int, missed_ticks: int
    ) -> SessionEnd | None:
        """Check the last tick for a touch of an obstacle, to which the touch monitor reacts.

        Return the error with which the session ends, or None if the session continues.
        """
        contact = touch_monitor.step(tick, missed_ticks)
        if contact is None:
            return None
        if contact.is_touch:
            self._shared_state[StateField.TOUCHES] += 1
        if contact.session_outcome:
            self._cycle.switch_torque_off()  # before this tick's sample is written
            return SessionEnd(contact.session_outcome, contact.message)
        self._log_event("info", contact.message)
        return None

    def damp_vibration(self) -> None:
        """Damp the beam's vibration by small motor movements around the record's final angle."""
        self._shared_state[StateField.PHASE] = Phase.RETURNING
        record_end_angle_rad = self._end_angle_rad
        if self._ending.damper is None:
            return
        damper = VibrationDamper(self._ending.damper, self._rate_hz)
        cycle = self._cycle
        # The record may have ended at the limit of the angle.
        angle_limit_rad = self._profile.limits.angle_rad
        min_displacement_rad = min(
            0.0, max(-_MAX_DAMPING_ANGLE_RAD, -angle_limit_rad - record_end_angle_rad)
        )
        max_displacement_rad = max(
            0.0, min(_MAX_DAMPING_ANGLE_RAD, angle_limit_rad - record_end_angle_rad)
        )
        torques_nm = np.zeros(round(_TORQUE_SPREAD_WINDOW_S * self._rate_hz))
        for tick_number in range(round(_LONGEST_DAMPING_S * self._rate_hz)):
            damping_angle_rad = damper.step(cycle.coupling_torque_nm)
            self._end_angle_rad = record_end_angle_rad + min(
                max(damping_angle_rad, min_displacement_rad), max_displacement_rad
            )
            self._run_tick(self._end_angle_rad)
            torques_nm[tick_number % torques_nm.size] = cycle.coupling_torque_nm
            if (
                tick_number % _TORQUE_SPREAD_CHECK_TICKS == 0
                and tick_number >= torques_nm.size
                and float(torques_nm.std()) <= _DAMPED_TORQUE_SPREAD_RATIO * self._rest_spread_nm
            ):
                return

    def return_to_start(self) -> None:
        """Move the motor back to the start angle without exciting a vibration.

        If the session is a move (``ending.stays``), go to the last angle of the reference instead.
        """
        goal_rad = self._start_angle_rad
        if self._ending.stays:
            goal_rad += self._relative_reference[-1]
        distance_rad = goal_rad - self._end_angle_rad
        for path_fraction in self._return_path:
            self._run_tick(self._end_angle_rad + distance_rad * path_fraction)

    def check_tare(self) -> None:
        """Measure the torque at rest after the record; raise `SessionEnd` if it has drifted."""
        self._read_rest(_SETTLING_S)
        rest_readings = self._read_rest(self._profile.session.tare_s)
        if rest_readings.torque_spread_nm > _VIBRATING_TORQUE_SPREAD_RATIO * self._rest_spread_nm:
            self._log_event(
                "info", "The beam still vibrates: the zero of the coupling torque was not checked."
            )
            return
        tare_torque_nm = np.dot(self._cycle.tare, self._profile.rig.sensor.projection)
        drift_nm = float(rest_readings.torques_nm.mean() - tare_torque_nm)
        self.results["tare_drift_nm"] = repr(drift_nm)
        violation = self._cycle.limit_monitor.check_tare(drift_nm)
        self._report_warnings()
        if violation is not None:
            raise SessionEnd("fault", str(violation))

    def _run_tick(self, reference_rad: float, *, may_miss_ticks: bool = False) -> None:
        """Run one tick outside the record, where missed ticks are limited but not counted.

        Set `may_miss_ticks` to permit any number of missed ticks before this tick, which other
        work, such as enabling the drive, delays.
        """
        missed_ticks = self._scheduler.wait()
        self._cycle.skip(missed_ticks)
        if missed_ticks > self._profile.limits.missed_ticks_in_a_row and not may_miss_ticks:
            raise SessionEnd(
                "fault",
                f"The loop stalled for {missed_ticks} ticks with the torque held, more than "
                "limits.missed_ticks_in_a_row = "
                f"{self._profile.limits.missed_ticks_in_a_row}. {OVERLOADED_ADVICE}",
            )
        self._switch_off_if_stopped()
        session_end = self._control_tick(reference_rad)
        if session_end is not None:
            raise session_end

    def _control_tick(self, reference_rad: float) -> SessionEnd | None:
        """Run one tick of control; return the error that ends the session, or None.

        The torque is off if an error is returned.
        """
        try:
            violation = self._cycle.step(self._scheduler.due_ns, reference_rad)
        except ControllerError as error:
            self._cycle.switch_torque_off()
            return SessionEnd("fault", str(error))
        except Exception as error:
            device_failure = failure_of_device(error, self._profile.rig.devices)
            self._cycle.mark_readings_stale()
            # A drive whose host stalled switches itself off by its own watchdog.
            violation_text = (
                f"{device_failure} {self._cycle.limit_monitor.missed_ticks_text}".strip()
            )
            return SessionEnd("fault", violation_text, device_failed=True)
        if violation is None:
            return None
        if violation.channel in _WRONG_SIGN_CHANNELS and self._accelerates_against_torque():
            violation = replace(violation, remedy=_WRONG_SIGN_REMEDY)
        violation = self._cycle.with_reported_cause(violation)
        # The zero is then invalid, and with it the limits of all further sessions.
        encoder_failed = violation.channel in _ENCODER_CHANNELS
        return SessionEnd("fault", str(violation), device_failed=encoder_failed)

    def _accelerates_against_torque(self) -> bool:
        """Return whether the shaft has just accelerated against the torque on it."""
        rig = self._profile.rig
        return self._cycle.accelerates_against_torque(
            rig.motor.inertia_kg_m2, rig.rate_hz, rig.encoder.resolution_rad
        )

    def _switch_off_and_observe(self) -> None:
        """Switch the torque off, and read the devices once more for the record's last sample.

        Mark the readings as stale if a device no longer responds.
        """
        self._cycle.switch_torque_off()
        try:
            self._cycle.read_devices(self._scheduler.due_ns)
        except (DeviceError, OSError):
            self._cycle.mark_readings_stale()

    def _read_rest(self, duration_s: float) -> RestReadings:
        """Return the sensor and encoder readings of `duration_s` seconds without torque."""
        return observe_rest(
            self._cycle,
            self._scheduler,
            rate_hz=self._rate_hz,
            duration_s=duration_s,
            projection=self._profile.rig.sensor.projection,
            check_reading=self._check_reading,
        )

    def _check_reading(self) -> None:
        """Raise `SessionEnd` if encoder or sensor have failed, or a stop is requested."""
        self._switch_off_if_stopped()
        self._cycle.check_encoder(self._standstill, self._scheduler.due_ns)
        reading_violation = self._cycle.check_stale() or self._cycle.check_sensor()
        if reading_violation is not None:
            raise SessionEnd("fault", str(self._cycle.with_reported_cause(reading_violation)))

    def _check_missed_ticks(self, new_missed_ticks: int, tick: int) -> SessionEnd | None:
        """Return the error that ends the session if too many ticks were missed, otherwise None."""
        if not new_missed_ticks:
            return None
        self._cycle.skip_encoder(new_missed_ticks)
        violation = self._cycle.limit_monitor.check_missed(
            new_missed_ticks, self.counts.missed, tick + 1
        )
        return None if violation is None else SessionEnd("fault", str(violation))

    def stop_requested(self) -> bool:
        """Return whether the session must end; steps that last longer than a tick check this."""
        return self._stop_reason() is not None

    def _check_stale_readings(self, scheduled_ticks: int) -> SessionEnd | None:
        """Return the error that ends the session if too many readings were stale, else None."""
        tick_counts = self.counts
        violation = self._cycle.limit_monitor.check_stale_fraction(
            tick_counts.stale_angles, tick_counts.stale_wrenches, scheduled_ticks
        )
        return (
            None
            if violation is None
            else SessionEnd("fault", str(self._cycle.with_reported_cause(violation)))
        )

    def _stop_reason(self) -> SessionEnd | None:
        """Return the error that ends the session if a stop is requested or a process died."""
        stop_reason = self._shared_state[StateField.STOP_REASON]
        if self._stop.requested or stop_reason == StopReason.OPERATOR:
            return SessionEnd("stopped", "Stopped by the operator.")
        if stop_reason == StopReason.NO_RECORDER:
            return SessionEnd("fault", "The recorder process ended during the session.")
        if self.counts.lost:
            # A record with a lost sample can never be complete.
            return SessionEnd("fault", "The recorder cannot keep up: a sample was lost.")
        if not self._parent.alive():
            return SessionEnd("fault", "The supervising process ended during the session.")
        return None

    def _check_for_session_end(self) -> SessionEnd | None:
        """Publish heartbeat and readings; return the error that ends the session, or None.

        This checks the slow limits, a suspended computer, the supervisor's heartbeat, and stop
        requests. The supervisor also requests a stop when the recorder has died (`rigd.runner`).
        """
        self._publish_readings()
        violation = self._cycle.check_slow_limits(
            self._scheduler.due_ns,
            # With the virtual clock the loop waits for the recorder.
            0.0 if self._clock.virtual else self._channels.samples.waiting_count / self._rate_hz,
            self._shared_state[StateField.DISK_FREE_MB] or inf,
        )
        self._report_warnings()
        if violation is not None:
            return SessionEnd("fault", str(violation))
        if not self._clock.virtual:
            suspended_s = self._suspend_monitor.suspended_s()
            if suspended_s > MIN_SUSPENSION_S:
                return SessionEnd(
                    "fault",
                    f"The computer was suspended for {suspended_s:.1f} s and the motor was not "
                    "controlled; disable its power management.",
                )
            supervisor_beat = self._shared_state[StateField.SUPERVISOR_BEAT]
            self._polls_without_heartbeat = (
                self._polls_without_heartbeat + 1 if supervisor_beat == self._supervisor_beat else 0
            )
            self._supervisor_beat = supervisor_beat
            if (
                self._polls_without_heartbeat * SLOW_CHECK_TICKS
                > _SUPERVISOR_TIMEOUT_S * self._rate_hz
            ):
                return SessionEnd(
                    "fault",
                    f"Supervisor watchdog timeout ({_SUPERVISOR_TIMEOUT_S:g} s); session aborted. "
                    "Check CPU load.",
                )
        return self._stop_reason()

    def _switch_off_if_stopped(self) -> None:
        """Switch the torque off and raise `SessionEnd` if a stop is requested or a check fails."""
        is_poll_due = self._scheduler.tick % SLOW_CHECK_TICKS == 0
        session_end = self._check_for_session_end() if is_poll_due else self._stop_reason()
        if session_end is not None:
            self._cycle.switch_torque_off()
            raise session_end

    def _record_clock_results(
        self, start_utc_ns: int, start_monotonic_ns: int, execution_span_ns: int
    ) -> None:
        """Store end time, wall clock drift, page faults and true tick rate of the record.

        `results` contains them for the file's metadata.
        """
        end_utc_ns = time.time_ns()
        self.results["end_utc_ns"] = str(end_utc_ns)
        if self._clock.virtual:
            return
        self.results["page_faults"] = str(page_faults() - self._page_faults)
        elapsed_ns = time.monotonic_ns() - start_monotonic_ns
        self.results["wall_clock_drift_ppm"] = repr(
            ((end_utc_ns - start_utc_ns) / elapsed_ns - 1) * 1e6
        )
        interval_count = self.counts.scheduled - self.counts.missed - 1
        if execution_span_ns > 0:
            self.results["true_rate_hz"] = repr(interval_count / (execution_span_ns * 1e-9))

    def _publish_readings(self) -> None:
        """Write the readings to the shared state, and log each doubt about their age once."""
        self._reading_publisher.publish(self._cycle, self._scheduler.due_ns)
        for doubt in self._reading_publisher.doubts:
            if doubt not in self._doubts_reported:
                self._doubts_reported.add(doubt)
                self._log_event("warning", doubt)

    def _report_warnings(self) -> None:
        """Log new warnings of the limit, sensor and encoder monitors."""
        cycle = self._cycle
        for warning_text in (
            cycle.limit_monitor.take_notices() + cycle.sensor_monitor.take_notices()
        ):
            self._log_event("warning", warning_text)
        encoder_tests = 0 if cycle.encoder_monitor is None else cycle.encoder_monitor.tests
        if encoder_tests > self._encoder_tests:
            self.results["encoder_tests"] = str(encoder_tests)
            if not self._encoder_tests:
                self._log_event("info", _ENCODER_TESTED_MESSAGE)
            self._encoder_tests = encoder_tests

    def _log_event(self, level: Level, message: str) -> None:
        """Write a line of the session's log for the operator and the file."""
        # Events before tick 0 have no time in the file yet.
        t_ns = self._clock.now_ns() - self._scheduler.start_ns if self._recording else 0
        write_event(self._channels.events, LogEvent(t_ns, level, message))


def _return_path(profile: Profile, ending: PostRecordPlan) -> list[float]:
    """Return the path of the motor's return: for each tick the fraction of the way, from 0 to 1.

    The path is computed before the drive is enabled, because the loop has no time for it.
    """
    duration_s, rate_hz = profile.session.return_s, profile.rig.rate_hz
    if ending.poles_rad_s and duration_s <= _LONGEST_SHAPED_RETURN_S:
        path_fractions = vibration_free_path(duration_s, rate_hz, np.array(ending.poles_rad_s))
    else:
        path_fractions = quintic(duration_s, rate_hz)
    path_list: list[float] = path_fractions.tolist()
    return path_list
