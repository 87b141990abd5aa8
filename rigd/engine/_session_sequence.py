"""Sequence of a session: tare, enable, hold, record, damp, return, disable, check the tare.

The record extends from tick 0 to the last tick of the excitation. Everything else uses the same
cycle and writes its results to the metadata.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigd.control.damper import VibrationDamper
from rigd.devices.contracts import DeviceError
from rigd.engine._publish import Display, SampleLog
from rigd.engine.channels import Channels
from rigd.engine.cycle import Cycle, Rest, Standstill, observe_rest
from rigd.engine.messages import Ending
from rigd.engine.processes import Parent
from rigd.engine.realtime import page_faults
from rigd.engine.reference import ReferenceReader
from rigd.engine.shared_state import Level, LogEvent, Phase, StateField, Stop, write_event
from rigd.engine.timing import SIGN_OF_LIFE_S, SUSPENDED_S, Clock, SuspendWatch, TickScheduler
from rigd.excitation.moves import quintic, still_path
from rigd.profile import Profile
from rigd.runtime import StopRequest
from rigd.safety import SLOW_CHECK_TICKS
from rigd.safety.limits import BY_NAME, OVERLOADED

if TYPE_CHECKING:
    from rigd.engine._touch_watch import TouchWatch

_SETTLE_S = 0.5
_GO_POLL_S = 0.0002
_GO_PATIENCE_S = 10.0
_SUPERVISOR_PATIENCE_S = 2.0
"""Only time in which this process ran counts: a stalled computer is not the supervisor's fault."""
_MOTION_CHANNELS = tuple(BY_NAME[name].channel for name in ("angle", "velocity", "tracking error"))
_ENCODER_CHANNELS = tuple(
    BY_NAME[name].channel
    for name in ("encoder jump", "frozen encoder", "stopped encoder", "repeated angle")
)
_AGAINST_TORQUE = (
    "The shaft accelerates against the torque: angle and torque have opposite signs. "
    "Check the drive's polarity (object 607E), cia402.direction and the wiring of motor and "
    "encoder; a lower amplitude does not help."
)
_ENCODER_TESTED = (
    "The beam pulled at a shaft that stood still, so the encoder was tested: it works."
)
_SWINGING = 2.0
"""Ratio of the torque's spread after a session to the one before, above which the beam vibrates."""
_DAMPING_S = 5.0
"""Longest active damping: twice the time for a vibration with the sensor's full range."""
_SPREAD_WINDOW_S = 0.4
"""Time over which the spread of the torque is computed: a period of a first mode at 2.5 Hz."""
_SPREAD_CHECK_TICKS = 50
"""Ticks between two checks of the spread."""
_DAMPED = 1.25
"""Ratio of the torque's spread to that at rest, up to which the beam counts as damped: the
vibration is then less than the noise, and the spread over so short a time scatters by 4 %."""
_MAX_YIELD_RAD = 0.1
"""Largest angle by which active damping moves the motor."""
_SHAPED_S = 5.0
"""Longest return whose path is shaped: a slower one excites no vibration."""


class SessionEnd(Exception):
    """Early end of a session, with outcome and reason.

    Attributes
    ----------
    outcome, reason
        Outcome and reason, for the file and the operator.
    device_failed
        Whether a device failed, so that it must be reconnected.
    """

    def __init__(self, outcome: str, reason: str, *, device_failed: bool = False) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.reason = reason
        self.device_failed = device_failed


class SessionSequence:
    """One session on connected devices.

    Parameters
    ----------
    profile
        Profile of the rig.
    reference_rad
        Angle per tick, relative to the start angle.
    cycle, clock, metronome
        Work of a tick, clock, and schedule of the ticks.
    standstill
        Check of the angles that are read without torque.
    channels
        Rings for samples, the controller's terms and events.
    display
        Publisher of the readings.
    parent
        The supervisor.
    stop
        Stop signals that this process received itself.
    ending
        Steps after the record.
    touch
        Detector of touches; None: none is expected.
    reader
        Reader of a reference that grows during the record; None: the reference is complete.
    """

    def __init__(
        self,
        profile: Profile,
        reference_rad: Sequence[float],
        cycle: Cycle,
        clock: Clock,
        metronome: TickScheduler,
        standstill: Standstill,
        channels: Channels,
        display: Display,
        parent: Parent,
        stop: StopRequest,
        ending: Ending,
        touch: "TouchWatch | None" = None,
        reader: ReferenceReader | None = None,
    ) -> None:
        self._touch = touch
        self._reader = reader
        self._display = display
        self._profile = profile
        self._cycle = cycle
        self._clock = clock
        self._channels = channels
        self._shared_state = channels.shared_state
        self._parent = parent
        self._stop = stop
        self._rate_hz = profile.rig.rate_hz
        self._metronome = metronome
        self._standstill = standstill
        self._suspends = SuspendWatch()
        self._page_faults = 0
        self._doubts_reported: set[str] = set()
        self._unanswered_polls = 0
        self._supervisor_beat = -1
        late_ns = int(profile.realtime.late_us * 1000)
        self._sample_log = SampleLog(cycle, self._metronome, clock, channels, late_ns)
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
        """Results for the record's outcome, in addition to the counts."""

    def tare(self) -> dict[str, str]:
        """Average the sensor at rest, before the drive is enabled.

        Returns
        -------
        dict
            Metadata: mean and standard deviation of each axis, N and N·m.

        Raises
        ------
        SessionEnd
            If the rig does not come to rest in time, or the record would leave the angle limits
            from its present angle.
        """
        self._cycle.watch.reset(0.0)  # the counts of the last session no longer apply
        rest = self._wait_for_rest()
        self._start_angle_rad = float(np.mean(rest.angles_rad))
        limit_rad = self._profile.limits.angle_rad
        if abs(self._start_angle_rad) > limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, outside "
                f"limits.angle_rad = {limit_rad:g} rad; turn it back and start again.",
            )
        goal_rad = max(
            (self._start_angle_rad + part for part in self._reference_range_rad), key=abs
        )
        if abs(goal_rad) > limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, from where the reference goes "
                f"to {goal_rad:.4g} rad, outside limits.angle_rad = {limit_rad:g} rad. Move it "
                "back first (rigd run move 0; rigd start move 0 with a daemon), or lower the "
                "amplitude.",
            )
        failed = self._cycle.sensor_watch.finish_learning()
        self._report_warnings()
        if failed is not None:
            raise SessionEnd("fault", str(failed))
        self._rest_spread_nm = rest.torque_spread_nm
        self._compare_with_tare_before(float(rest.torques_nm.mean()))
        self._cycle.tare = rest.mean
        return rest.as_metadata() | {"start_angle_rad": repr(self._start_angle_rad)}

    def _compare_with_tare_before(self, zero_nm: float) -> None:
        watch = self._cycle.watch
        if watch.tared_nm is not None:
            violation = watch.check_tare(zero_nm - watch.tared_nm)
            self._report_warnings()
            if violation is not None:
                raise SessionEnd(
                    "fault", f"{violation} If nothing is wrong, run rigd tare to set a new zero."
                )
        watch.tared_nm = zero_nm

    def _wait_for_rest(self) -> Rest:
        """Return the first interval of readings in which neither motor nor beam moves."""
        settings = self._profile.session
        self._shared_state[StateField.PHASE] = Phase.TARING
        patience_s = settings.rest_timeout_s
        while True:
            self._cycle.sensor_watch.learn()
            rest = self._rest(settings.tare_s)
            moving = self._motion_reason(rest)
            if not moving:
                return rest
            patience_s -= rest.duration_s
            if patience_s <= 0.0:
                raise SessionEnd(
                    "fault",
                    f"{moving} It did not come to rest within session.rest_timeout_s = "
                    f"{settings.rest_timeout_s:g} s; wait until it is at rest and start again.",
                )
            if self._shared_state[StateField.PHASE] != Phase.WAITING:
                self._shared_state[StateField.PHASE] = Phase.WAITING
                self._log_event("info", f"Waiting until the rig is at rest. {moving}")

    def _motion_reason(self, rest: Rest) -> str:
        settings = self._profile.session
        if rest.speed_rad_s > settings.rest_velocity_rad_s:
            return (
                f"The motor is not at rest: it moves by {rest.speed_rad_s:.2g} rad/s, more than "
                f"session.rest_velocity_rad_s = {settings.rest_velocity_rad_s:g} rad/s."
            )
        if rest.torque_spread_nm > settings.rest_torque_nm:
            return (
                f"The beam is not at rest: the coupling torque varies by "
                f"{rest.torque_spread_nm:.2g} N·m, more than session.rest_torque_nm = "
                f"{settings.rest_torque_nm:g} N·m."
            )
        return ""

    def hold(self) -> None:
        """Hold the motor at its angle after the drive has been enabled."""
        self._shared_state[StateField.PHASE] = Phase.SETTLING
        self._standstill.forget()
        # The last reading, not the mean: the controller must start without a step.
        self._start_angle_rad = self._cycle.angle_rad
        self._cycle.start(self._rest_spread_nm)
        for number in range(round(_SETTLE_S * self._rate_hz)):
            # Enabling the drive before the first tick takes longer than a tick.
            self._tick(self._start_angle_rad, excused=number == 0)

    def wait_for_go(self) -> None:
        """Hold until the recorder is ready; virtual time does not advance meanwhile.

        Raises
        ------
        SessionEnd
            If the supervisor does not report this in time, although its process may exist.
        """
        self._shared_state[StateField.PHASE] = Phase.READY
        deadline = time.monotonic() + _GO_PATIENCE_S
        while not self._shared_state[StateField.GO]:
            if time.monotonic() > deadline:
                raise SessionEnd(
                    "fault",
                    f"The supervisor did not start the record within {_GO_PATIENCE_S:g} s. "
                    "Check CPU load.",
                )
            if self._clock.virtual:
                self._display.show(self._cycle, self._metronome.due_ns)
                self._switch_off_if_stopped()
                time.sleep(_GO_POLL_S)
            else:
                self._tick(self._start_angle_rad)

    def record(self) -> None:
        """Run the excitation; every tick is recorded, missed or lost.

        Raises
        ------
        SessionEnd
            If it ends early. The torque is off in the last sample, unless the record ends in
            missed or lost ticks.
        """
        reference, start_rad = self._relative_reference, self._start_angle_rad
        total = len(reference)
        metronome, cycle, log, shared_state = (
            self._metronome,
            self._cycle,
            self._sample_log,
            self._shared_state,
        )
        counts, virtual, signals = self.counts, self._clock.virtual, self._stop
        touch, reader = self._touch, self._reader
        stop, scheduled = (
            shared_state.view(StateField.STOP),
            shared_state.view(StateField.SCHEDULED),
        )
        metronome.restart()
        self._recording = True
        self._page_faults = page_faults()
        wall_ns, before_ns = time.time_ns(), time.monotonic_ns()
        # With the real clock tick 0 is still ahead, or up to one period in the past.
        ahead_ns = 0 if virtual else metronome.start_ns - before_ns
        shared_state[StateField.START_UTC_NS] = wall_ns + ahead_ns
        shared_state[StateField.PHASE] = Phase.RUNNING
        self._log_event("info", f"Record starts: {total} ticks at {self._rate_hz:g} Hz.")
        last = -1
        first_ns = last_ns = 0
        reference_rad = start_rad
        end: SessionEnd | None = None
        while end is None and last < total - 1:
            if reader is not None:
                if virtual:
                    self._await_segment(reader, last + 1)
                if reader.over(last + 1):
                    break
            missed = metronome.wait()
            tick = metronome.tick
            if missed:
                missed = min(tick, total) - last - 1
                counts.missed += missed
                shared_state[StateField.MISSED] = counts.missed
                end = self._missed_too_many(missed, min(tick, total))
                if tick >= total:
                    last, reference_rad = total - 1, start_rad + reference[-1]
                    break
            if end is None and cycle.stale:  # in the tick before
                end = self._stale_too_many(tick)
            if end is None and (
                stop[0] or counts.lost or signals.requested or tick % SLOW_CHECK_TICKS == 0
            ):
                end = self._poll()
            reference_rad = start_rad + (reference[tick] if reader is None else reader.at(tick))
            if end is None:
                end = self._step(reference_rad)
                if touch is not None and end is None:
                    end = self._watch_touch(touch, tick, missed)
            else:
                self._switch_off_and_observe()
            wait = virtual or end is not None
            log.write(tick, reference_rad, missed, wait=wait)
            scheduled[0] = tick + 1
            last_ns = metronome.t_ns + metronome.lateness_ns
            if last < 0:
                first_ns = last_ns
            last = tick
        self._end_angle_rad = reference_rad
        counts.scheduled = scheduled[0] = last + 1
        if counts.lost and end is None:
            end = self._stop_reason()
        if end is not None:
            cycle.torque_off()
        self._show()
        for count in self._display.doubt_counts:
            self._log_event("warning", count)
        self._record_clock_results(wall_ns, before_ns, last_ns - first_ns)
        if end is not None:
            raise end

    def _await_segment(self, reader: ReferenceReader, tick: int) -> None:
        """Stop virtual time until a tick has its reference.

        With devices on lines, a tick now and then holds the last angle and shows a sign of life.
        """
        on_lines = self._cycle.devices.on_lines
        begun_s = time.monotonic()
        while reader.waits(tick) and self._stop_reason() is None:
            if on_lines and time.monotonic() - begun_s > SIGN_OF_LIFE_S:
                return
            self._display.show(self._cycle, self._metronome.due_ns)
            time.sleep(_GO_POLL_S)

    def _watch_touch(self, touch: "TouchWatch", tick: int, missed: int) -> SessionEnd | None:
        """Check the last tick for a touch; after one, the watch changes the reference."""
        contact = touch.step(tick, missed)
        if contact is None:
            return None
        if contact.detected:
            self._shared_state[StateField.TOUCHES] += 1
        if contact.ends:
            self._cycle.torque_off()  # before this tick's sample is written
            return SessionEnd(contact.ends, contact.message)
        self._log_event("info", contact.message)
        return None

    def damp(self) -> None:
        """Damp the beam actively around the final angle of the record."""
        self._shared_state[StateField.PHASE] = Phase.RETURNING
        end_rad = self._end_angle_rad
        if self._ending.damper is None:
            return
        damper = VibrationDamper(self._ending.damper, self._rate_hz)
        cycle = self._cycle
        # The record may have ended at the limit of the angle.
        limit_rad = self._profile.limits.angle_rad
        least_rad = min(0.0, max(-_MAX_YIELD_RAD, -limit_rad - end_rad))
        most_rad = max(0.0, min(_MAX_YIELD_RAD, limit_rad - end_rad))
        torques_nm = np.zeros(round(_SPREAD_WINDOW_S * self._rate_hz))
        for tick in range(round(_DAMPING_S * self._rate_hz)):
            yielded_rad = damper.step(cycle.coupling_torque_nm)
            self._end_angle_rad = end_rad + min(max(yielded_rad, least_rad), most_rad)
            self._tick(self._end_angle_rad)
            torques_nm[tick % torques_nm.size] = cycle.coupling_torque_nm
            if (
                tick % _SPREAD_CHECK_TICKS == 0
                and tick >= torques_nm.size
                and float(torques_nm.std()) <= _DAMPED * self._rest_spread_nm
            ):
                return

    def go_back(self) -> None:
        """Return to the start angle, or to the end of a move, without exciting a vibration."""
        goal_rad = self._start_angle_rad
        if self._ending.stays:
            goal_rad += self._relative_reference[-1]
        distance_rad = goal_rad - self._end_angle_rad
        for part in self._return_path:
            self._tick(self._end_angle_rad + distance_rad * part)

    def check_tare(self) -> None:
        """Average the sensor again with the drive disabled, and check the drift of its zero."""
        self._rest(_SETTLE_S)
        rest = self._rest(self._profile.session.tare_s)
        if rest.torque_spread_nm > _SWINGING * self._rest_spread_nm:
            self._log_event(
                "info", "The beam still vibrates: the zero of the coupling torque was not checked."
            )
            return
        zero_nm = np.dot(self._cycle.tare, self._profile.rig.sensor.projection)
        drift_nm = float(rest.torques_nm.mean() - zero_nm)
        self.results["tare_drift_nm"] = repr(drift_nm)
        violation = self._cycle.watch.check_tare(drift_nm)
        self._report_warnings()
        if violation is not None:
            raise SessionEnd("fault", str(violation))

    def _tick(self, reference_rad: float, *, excused: bool = False) -> None:
        """Run one tick outside the record, where missed ticks are limited but not counted."""
        missed = self._metronome.wait()
        self._cycle.skip(missed)
        if missed > self._profile.limits.missed_ticks_in_a_row and not excused:
            raise SessionEnd(
                "fault",
                f"The loop stalled for {missed} ticks with the torque held, more than "
                "limits.missed_ticks_in_a_row = "
                f"{self._profile.limits.missed_ticks_in_a_row}. {OVERLOADED}",
            )
        self._switch_off_if_stopped()
        end = self._step(reference_rad)
        if end is not None:
            raise end

    def _step(self, reference_rad: float) -> SessionEnd | None:
        """Control one tick; if this ends the session, the torque is off."""
        try:
            violation = self._cycle.step(self._metronome.due_ns, reference_rad)
        except (DeviceError, OSError) as error:
            self._cycle.mark_readings_stale()
            # A drive whose host stalled switches itself off by its own watchdog.
            reason = f"{error} {self._cycle.watch.after_missed}".strip()
            return SessionEnd("fault", reason, device_failed=True)
        if violation is None:
            return None
        if violation.channel in _MOTION_CHANNELS and self._against_torque():
            violation = replace(violation, remedy=_AGAINST_TORQUE)
        violation = self._cycle.with_cause(violation)
        # The zero is then invalid, and with it the limits of all further sessions.
        failed = violation.channel in _ENCODER_CHANNELS
        return SessionEnd("fault", str(violation), device_failed=failed)

    def _against_torque(self) -> bool:
        rig = self._profile.rig
        return self._cycle.accelerates_against_torque(
            rig.motor.inertia_kg_m2, rig.rate_hz, rig.encoder.resolution_rad
        )

    def _switch_off_and_observe(self) -> None:
        """Switch off, and read the devices once more for the last sample, if they still respond."""
        self._cycle.torque_off()
        try:
            self._cycle.observe(self._metronome.due_ns)
        except (DeviceError, OSError):
            self._cycle.mark_readings_stale()

    def _rest(self, duration_s: float) -> Rest:
        """Return readings without torque."""
        return observe_rest(
            self._cycle,
            self._metronome,
            rate_hz=self._rate_hz,
            duration_s=duration_s,
            projection=self._profile.rig.sensor.projection,
            check=self._check_reading,
        )

    def _check_reading(self) -> None:
        self._switch_off_if_stopped()
        self._cycle.check_encoder(self._standstill, self._metronome.due_ns)
        failed = self._cycle.check_stale() or self._cycle.check_sensor()
        if failed is not None:
            raise SessionEnd("fault", str(self._cycle.with_cause(failed)))

    def _missed_too_many(self, missed: int, tick: int) -> SessionEnd | None:
        if not missed:
            return None
        self._cycle.skip_encoder(missed)
        reason = self._cycle.watch.check_missed(missed, self.counts.missed, tick + 1)
        return None if reason is None else SessionEnd("fault", str(reason))

    def stop_requested(self) -> bool:
        """Return whether the session must end, for steps that take longer than a tick."""
        return self._stop_reason() is not None

    def _stale_too_many(self, scheduled: int) -> SessionEnd | None:
        counts = self.counts
        reason = self._cycle.watch.check_stale_fraction(
            counts.stale_angles, counts.stale_wrenches, scheduled
        )
        return None if reason is None else SessionEnd("fault", str(self._cycle.with_cause(reason)))

    def _stop_reason(self) -> SessionEnd | None:
        stop = self._shared_state[StateField.STOP]
        if self._stop.requested or stop == Stop.OPERATOR:
            return SessionEnd("stopped", "Stopped by the operator.")
        if stop == Stop.NO_RECORDER:
            return SessionEnd("fault", "The recorder process ended during the session.")
        if self.counts.lost:
            # A record with a lost sample can never be complete.
            return SessionEnd("fault", "The recorder cannot keep up: a sample was lost.")
        if not self._parent.alive():
            return SessionEnd("fault", "The supervising process ended during the session.")
        return None

    def _poll(self) -> SessionEnd | None:
        """Publish heartbeat and readings; check slow limits, the supervisor and stop requests.

        The supervisor requests a stop when the recorder has died (`rigd.runner`).
        """
        self._show()
        violation = self._cycle.check_slow_limits(
            self._metronome.due_ns,
            # With the virtual clock the loop waits for the recorder.
            0.0 if self._clock.virtual else self._channels.samples.waiting / self._rate_hz,
            self._shared_state[StateField.DISK_FREE_MB] or inf,
        )
        self._report_warnings()
        if violation is not None:
            return SessionEnd("fault", str(violation))
        if not self._clock.virtual:
            suspended_s = self._suspends.suspended_s()
            if suspended_s > SUSPENDED_S:
                return SessionEnd(
                    "fault",
                    f"The computer was suspended for {suspended_s:.1f} s and the motor was not "
                    "controlled; disable its power management.",
                )
            beat = self._shared_state[StateField.SUPERVISOR_BEAT]
            self._unanswered_polls = (
                self._unanswered_polls + 1 if beat == self._supervisor_beat else 0
            )
            self._supervisor_beat = beat
            if self._unanswered_polls * SLOW_CHECK_TICKS > _SUPERVISOR_PATIENCE_S * self._rate_hz:
                return SessionEnd(
                    "fault",
                    f"Supervisor watchdog timeout ({_SUPERVISOR_PATIENCE_S:g} s); session aborted. "
                    "Check CPU load.",
                )
        return self._stop_reason()

    def _switch_off_if_stopped(self) -> None:
        poll_due = self._metronome.tick % SLOW_CHECK_TICKS == 0
        end = self._poll() if poll_due else self._stop_reason()
        if end is not None:
            self._cycle.torque_off()
            raise end

    def _record_clock_results(self, wall_ns: int, before_ns: int, executed_ns: int) -> None:
        """Store the drift between the two clocks over the record, and the true rate, as results."""
        now_ns = time.time_ns()
        self.results["end_utc_ns"] = str(now_ns)
        if self._clock.virtual:
            return
        self.results["page_faults"] = str(page_faults() - self._page_faults)
        elapsed_ns = time.monotonic_ns() - before_ns
        self.results["wall_clock_drift_ppm"] = repr(((now_ns - wall_ns) / elapsed_ns - 1) * 1e6)
        intervals = self.counts.scheduled - self.counts.missed - 1
        if executed_ns > 0:
            self.results["true_rate_hz"] = repr(intervals / (executed_ns * 1e-9))

    def _show(self) -> None:
        """Publish the readings, and log each doubt about their age once."""
        self._display.show(self._cycle, self._metronome.due_ns)
        for doubt in self._display.doubts:
            if doubt not in self._doubts_reported:
                self._doubts_reported.add(doubt)
                self._log_event("warning", doubt)

    def _report_warnings(self) -> None:
        cycle = self._cycle
        for notice in cycle.watch.take_notices() + cycle.sensor_watch.take_notices():
            self._log_event("warning", notice)
        tests = 0 if cycle.encoder_watch is None else cycle.encoder_watch.tests
        if tests > self._encoder_tests:
            self.results["encoder_tests"] = str(tests)
            if not self._encoder_tests:
                self._log_event("info", _ENCODER_TESTED)
            self._encoder_tests = tests

    def _log_event(self, level: Level, message: str) -> None:
        # Events before tick 0 have no time in the file yet.
        t_ns = self._clock.now_ns() - self._metronome.start_ns if self._recording else 0
        write_event(self._channels.events, LogEvent(t_ns, level, message))


def _return_path(profile: Profile, ending: Ending) -> list[float]:
    """Return the path back, tick by tick from 0 to 1; computed before anything moves."""
    duration_s, rate_hz = profile.session.return_s, profile.rig.rate_hz
    if ending.poles_rad_s and duration_s <= _SHAPED_S:
        path = still_path(duration_s, rate_hz, np.array(ending.poles_rad_s))
    else:
        path = quintic(duration_s, rate_hz)
    parts: list[float] = path.tolist()
    return parts
