"""Sequence of a session: tare, enable, hold, record, damp, return, disable, check the tare.

The record is what lies between tick 0 and the last tick of the excitation; everything else runs
through the same cycle and leaves its results in the metadata.
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
from rigd.engine.reference import PieceReader
from rigd.engine.shared_state import Event, Level, Phase, Stop, Word, write_event
from rigd.engine.timing import SIGN_OF_LIFE_S, SUSPENDED_S, Clock, SuspendWatch, TickScheduler
from rigd.excitation.moves import quintic, still_path
from rigd.profile import Profile
from rigd.runtime import StopRequest
from rigd.safety import LOOK_EVERY
from rigd.safety.limits import BY_NAME, OVERLOADED

if TYPE_CHECKING:
    from rigd.engine._touch_watch import TouchWatch

_SETTLE_S = 0.5
_GO_POLL_S = 0.0002
_GO_PATIENCE_S = 10.0
_SUPERVISOR_PATIENCE_S = 2.0
"""Counts the time that this process has run: a stalled computer is not the supervisor's fault."""
_OF_MOTION = tuple(BY_NAME[name].channel for name in ("angle", "velocity", "tracking error"))
_OF_ENCODER = tuple(
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
"""Spread of the torque after a session, over that before it, from which on the beam is swinging."""
_DAMPING_S = 5.0
"""Longest active damping: what a beam that vibrates with the sensor's whole range needs twice."""
_JUDGED_S = 0.4
"""Time over which the torque is judged: a period of a first mode at 2.5 Hz."""
_JUDGED_TICKS = 50
"""Ticks from one judgement to the next."""
_DAMPED = 1.25
"""Spread of the torque, over that at rest, up to which the beam counts as damped: what vibrates
then is less than the noise, and the spread of so short a time scatters by 4 %."""
_MOST_YIELDED_RAD = 0.1
"""Farthest that active damping moves the motor."""
_SHAPED_S = 5.0
"""A return that takes longer leaves no vibration whatever its shape."""


class SessionEnd(Exception):
    """A session ends early; carries the outcome and the reason.

    Attributes
    ----------
    outcome, reason
        Outcome and reason, for the file and the operator.
    device_failed
        A device did not do what it was asked: it must be reconnected.
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
        Profile that the operator chose.
    reference_rad
        Angle a tick, relative to the one at the start.
    cycle, clock, metronome
        Work of a tick, and its schedule.
    standstill
        Monitor of every angle that is read without torque.
    channels
        Rings for samples, the controller's terms and events.
    display
        Publishes the readings.
    parent
        The supervisor.
    stop
        The signals that this process received itself.
    ending
        What follows the record.
    touch
        Watches the record for a touch; None: nobody does.
    pieces
        The reference where it grows during the record; None: all of it is there.
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
        pieces: PieceReader | None = None,
    ) -> None:
        self._touch = touch
        self._pieces = pieces
        self._display = display
        self._profile = profile
        self._cycle = cycle
        self._clock = clock
        self._channels = channels
        self._board = channels.board
        self._parent = parent
        self._stop = stop
        self._rate_hz = profile.rig.rate_hz
        self._metronome = metronome
        self._standstill = standstill
        self._suspends = SuspendWatch()
        self._page_faults = 0
        self._doubts_told: set[str] = set()
        self._looks_unanswered = 0
        self._supervisor_beat = -1
        late_ns = int(profile.realtime.late_us * 1000)
        self._log = SampleLog(cycle, self._metronome, clock, channels, late_ns)
        self._relative_reference = reference_rad
        # Of one that grows, each piece is planned with the start angle.
        planned_rad = np.asarray(reference_rad)
        self._farthest_rad = float(planned_rad.min()), float(planned_rad.max())
        self._ending = ending
        self._return_path = _return_path(profile, ending)
        self._end_angle_rad = 0.0
        self._start_angle_rad = 0.0
        self._rest_spread_nm = 0.0
        self._recording = False
        self._encoder_tests = 0
        self.counts = self._log.counts
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
            If the rig does not come to rest in time, or stands where the record would leave the
            limits.
        """
        self._cycle.watch.reset(0.0)  # what the last session left counts no more
        rest = self._wait_for_rest()
        self._start_angle_rad = float(np.mean(rest.angles_rad))
        limit_rad = self._profile.limits.angle_rad
        if abs(self._start_angle_rad) > limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, outside "
                f"limits.angle_rad = {limit_rad:g} rad; turn it back and start again.",
            )
        goal_rad = max((self._start_angle_rad + part for part in self._farthest_rad), key=abs)
        if abs(goal_rad) > limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor is at {self._start_angle_rad:.4g} rad, from where the reference goes "
                f"to {goal_rad:.4g} rad, outside limits.angle_rad = {limit_rad:g} rad. Move it "
                "back first (rigd run move 0; rigd start move 0 with a daemon), or lower the "
                "amplitude.",
            )
        failed = self._cycle.sensor_watch.judge()
        self._say_what_is_near()
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
            self._say_what_is_near()
            if violation is not None:
                raise SessionEnd(
                    "fault", f"{violation} If nothing is wrong, run rigd tare to set a new zero."
                )
        watch.tared_nm = zero_nm

    def _wait_for_rest(self) -> Rest:
        """Return the first stretch of readings in which neither the motor nor the beam moves."""
        settings = self._profile.session
        self._board[Word.PHASE] = Phase.TARING
        patience_s = settings.rest_timeout_s
        while True:
            self._cycle.sensor_watch.learn()
            rest = self._rest(settings.tare_s)
            moving = self._what_moves(rest)
            if not moving:
                return rest
            patience_s -= rest.duration_s
            if patience_s <= 0.0:
                raise SessionEnd(
                    "fault",
                    f"{moving} It did not come to rest within session.rest_timeout_s = "
                    f"{settings.rest_timeout_s:g} s; wait until it is at rest and start again.",
                )
            if self._board[Word.PHASE] != Phase.WAITING:
                self._board[Word.PHASE] = Phase.WAITING
                self._say("info", f"Waiting until the rig is at rest. {moving}")

    def _what_moves(self, rest: Rest) -> str:
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
        """Hold the motor where it stands; the drive has just been enabled."""
        self._board[Word.PHASE] = Phase.SETTLING
        self._standstill.forget()
        # The angle of the last reading, not the mean: the controller must start without a step.
        self._start_angle_rad = self._cycle.angle_rad
        self._cycle.start(self._rest_spread_nm)
        for number in range(round(_SETTLE_S * self._rate_hz)):
            # Enabling, right before the first, takes its time.
            self._tick(self._start_angle_rad, excused=number == 0)

    def wait_for_go(self) -> None:
        """Go on holding until the recorder is ready; virtual time stands still meanwhile.

        Raises
        ------
        SessionEnd
            If this is not reported in time: the supervisor may be there and yet do nothing.
        """
        self._board[Word.PHASE] = Phase.READY
        deadline = time.monotonic() + _GO_PATIENCE_S
        while not self._board[Word.GO]:
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
            If it ends early. The last sample is then one with the torque off, unless the record
            ends in ticks that were missed or lost.
        """
        reference, start_rad = self._relative_reference, self._start_angle_rad
        total = len(reference)
        metronome, cycle, log, board = self._metronome, self._cycle, self._log, self._board
        counts, virtual, signals = self.counts, self._clock.virtual, self._stop
        touch, pieces = self._touch, self._pieces
        stop, scheduled = board.word(Word.STOP), board.word(Word.SCHEDULED)
        metronome.restart()
        self._recording = True
        self._page_faults = page_faults()
        wall_ns, before_ns = time.time_ns(), time.monotonic_ns()
        # Under the real clock tick 0 is still ahead, or up to one period behind.
        ahead_ns = 0 if virtual else metronome.start_ns - before_ns
        board[Word.START_UTC_NS] = wall_ns + ahead_ns
        board[Word.PHASE] = Phase.RUNNING
        self._say("info", f"Record starts: {total} ticks at {self._rate_hz:g} Hz.")
        last = -1
        first_ns = last_ns = 0
        reference_rad = start_rad
        end: SessionEnd | None = None
        while end is None and last < total - 1:
            if pieces is not None:
                if virtual:
                    self._await_piece(pieces, last + 1)
                if pieces.over(last + 1):
                    break
            missed = metronome.wait()
            tick = metronome.tick
            if missed:
                missed = min(tick, total) - last - 1
                counts.missed += missed
                board[Word.MISSED] = counts.missed
                end = self._missed_too_many(missed, min(tick, total))
                if tick >= total:
                    last, reference_rad = total - 1, start_rad + reference[-1]
                    break
            if end is None and cycle.stale:  # in the tick before
                end = self._stale_too_many(tick)
            if end is None and (
                stop[0] or counts.lost or signals.requested or tick % LOOK_EVERY == 0
            ):
                end = self._look()
            reference_rad = start_rad + (reference[tick] if pieces is None else pieces.at(tick))
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
            self._say("warning", count)
        self._take_stock(wall_ns, before_ns, last_ns - first_ns)
        if end is not None:
            raise end

    def _await_piece(self, pieces: PieceReader, tick: int) -> None:
        """Let virtual time stand still until a tick has its reference.

        Where there are lines it does not for long: a tick now and then holds the last angle.
        """
        on_lines = self._cycle.devices.on_lines
        begun_s = time.monotonic()
        while pieces.waits(tick) and self._stop_reason() is None:
            if on_lines and time.monotonic() - begun_s > SIGN_OF_LIFE_S:
                return
            self._display.show(self._cycle, self._metronome.due_ns)
            time.sleep(_GO_POLL_S)

    def _watch_touch(self, touch: "TouchWatch", tick: int, missed: int) -> SessionEnd | None:
        """Look for a touch in the tick that was just run; the watch changes the reference."""
        contact = touch.step(tick, missed)
        if contact is None:
            return None
        if contact.detected:
            self._board[Word.TOUCHES] += 1
        if contact.ends:
            self._cycle.torque_off()  # before this tick's sample is written
            return SessionEnd(contact.ends, contact.message)
        self._say("info", contact.message)
        return None

    def damp(self) -> None:
        """Hold the motor where the record ended, yielding until the beam has come to rest."""
        self._board[Word.PHASE] = Phase.RETURNING
        end_rad = self._end_angle_rad
        if self._ending.damper is None:
            return
        damper = VibrationDamper(self._ending.damper, self._rate_hz)
        cycle = self._cycle
        # Not past the limit of the angle, where the record may have ended.
        limit_rad = self._profile.limits.angle_rad
        least_rad = min(0.0, max(-_MOST_YIELDED_RAD, -limit_rad - end_rad))
        most_rad = max(0.0, min(_MOST_YIELDED_RAD, limit_rad - end_rad))
        torques_nm = np.zeros(round(_JUDGED_S * self._rate_hz))
        for tick in range(round(_DAMPING_S * self._rate_hz)):
            yielded_rad = damper.step(cycle.coupling_torque_nm)
            self._end_angle_rad = end_rad + min(max(yielded_rad, least_rad), most_rad)
            self._tick(self._end_angle_rad)
            torques_nm[tick % torques_nm.size] = cycle.coupling_torque_nm
            if (
                tick % _JUDGED_TICKS == 0
                and tick >= torques_nm.size
                and float(torques_nm.std()) <= _DAMPED * self._rest_spread_nm
            ):
                return

    def go_back(self) -> None:
        """Return to the start angle, or to where a move ended, without leaving a vibration."""
        goal_rad = self._start_angle_rad
        if self._ending.stays:
            goal_rad += self._relative_reference[-1]
        distance_rad = goal_rad - self._end_angle_rad
        for part in self._return_path:
            self._tick(self._end_angle_rad + distance_rad * part)

    def check_tare(self) -> None:
        """Average the sensor again, the drive disabled, to see how far its zero has moved."""
        self._rest(_SETTLE_S)
        rest = self._rest(self._profile.session.tare_s)
        if rest.torque_spread_nm > _SWINGING * self._rest_spread_nm:
            self._say(
                "info", "The beam still vibrates: the zero of the coupling torque was not checked."
            )
            return
        zero_nm = np.dot(self._cycle.tare, self._profile.rig.sensor.projection)
        drift_nm = float(rest.torques_nm.mean() - zero_nm)
        self.results["tare_drift_nm"] = repr(drift_nm)
        violation = self._cycle.watch.check_tare(drift_nm)
        self._say_what_is_near()
        if violation is not None:
            raise SessionEnd("fault", str(violation))

    def _tick(self, reference_rad: float, *, excused: bool = False) -> None:
        """Run one tick outside the record; missed ticks are not counted there, but limited."""
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
        """Control one tick; where that ends the session, the torque is off."""
        try:
            violation = self._cycle.step(self._metronome.due_ns, reference_rad)
        except (DeviceError, OSError) as error:
            self._cycle.lose_readings()
            # A drive whose host stood still ends by its own watchdog.
            reason = f"{error} {self._cycle.watch.after_missed}".strip()
            return SessionEnd("fault", reason, device_failed=True)
        if violation is None:
            return None
        if violation.channel in _OF_MOTION and self._turns_against_torque():
            violation = replace(violation, remedy=_AGAINST_TORQUE)
        violation = self._cycle.with_cause(violation)
        # The zero is void then, and with it the limits of every further session.
        failed = violation.channel in _OF_ENCODER
        return SessionEnd("fault", str(violation), device_failed=failed)

    def _turns_against_torque(self) -> bool:
        rig = self._profile.rig
        return self._cycle.turns_against_torque(
            rig.motor.inertia_kg_m2, rig.rate_hz, rig.encoder.resolution_rad
        )

    def _switch_off_and_observe(self) -> None:
        """Switch off, and read once more for the last sample if the devices still answer."""
        self._cycle.torque_off()
        try:
            self._cycle.observe(self._metronome.due_ns)
        except (DeviceError, OSError):
            self._cycle.lose_readings()

    def _rest(self, duration_s: float) -> Rest:
        """Read without torque."""
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

    def stop_asked(self) -> bool:
        """Whether the session is to end, for what takes its time between two ticks."""
        return self._stop_reason() is not None

    def _stale_too_many(self, scheduled: int) -> SessionEnd | None:
        counts = self.counts
        reason = self._cycle.watch.check_stale_share(
            counts.stale_angles, counts.stale_wrenches, scheduled
        )
        return None if reason is None else SessionEnd("fault", str(self._cycle.with_cause(reason)))

    def _stop_reason(self) -> SessionEnd | None:
        stop = self._board[Word.STOP]
        if self._stop.requested or stop == Stop.OPERATOR:
            return SessionEnd("stopped", "Stopped by the operator.")
        if stop == Stop.NO_RECORDER:
            return SessionEnd("fault", "The recorder process ended during the session.")
        if self.counts.lost:
            # A record with a lost sample can never be complete: no reason to move on.
            return SessionEnd("fault", "The recorder cannot keep up: a sample was lost.")
        if not self._parent.alive():
            return SessionEnd("fault", "The supervising process ended during the session.")
        return None

    def _look(self) -> SessionEnd | None:
        """Give this process's heartbeat and readings; check limits, supervisor and its stop.

        The supervisor asks for a stop when the recorder has died (`rigd.runner`).
        """
        self._show()
        violation = self._cycle.look(
            self._metronome.due_ns,
            # Under the virtual clock the loop waits for the recorder.
            0.0 if self._clock.virtual else self._channels.samples.waiting / self._rate_hz,
            self._board[Word.DISK_FREE_MB] or inf,
        )
        self._say_what_is_near()
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
            beat = self._board[Word.SUPERVISOR_BEAT]
            self._looks_unanswered = (
                self._looks_unanswered + 1 if beat == self._supervisor_beat else 0
            )
            self._supervisor_beat = beat
            if self._looks_unanswered * LOOK_EVERY > _SUPERVISOR_PATIENCE_S * self._rate_hz:
                return SessionEnd(
                    "fault",
                    f"Supervisor watchdog timeout ({_SUPERVISOR_PATIENCE_S:g} s); session aborted. "
                    "Check CPU load.",
                )
        return self._stop_reason()

    def _switch_off_if_stopped(self) -> None:
        looking = self._metronome.tick % LOOK_EVERY == 0
        end = self._look() if looking else self._stop_reason()
        if end is not None:
            self._cycle.torque_off()
            raise end

    def _take_stock(self, wall_ns: int, before_ns: int, executed_ns: int) -> None:
        """Compare the two clocks over the record, and the rate with what it should have been."""
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
        """Show what is read, and tell once why it may be older than it is said to be."""
        self._display.show(self._cycle, self._metronome.due_ns)
        for doubt in self._display.doubts:
            if doubt not in self._doubts_told:
                self._doubts_told.add(doubt)
                self._say("warning", doubt)

    def _say_what_is_near(self) -> None:
        cycle = self._cycle
        for notice in cycle.watch.take_notices() + cycle.sensor_watch.take_notices():
            self._say("warning", notice)
        tests = 0 if cycle.encoder_watch is None else cycle.encoder_watch.tests
        if tests > self._encoder_tests:
            self.results["encoder_tests"] = str(tests)
            if not self._encoder_tests:
                self._say("info", _ENCODER_TESTED)
            self._encoder_tests = tests

    def _say(self, level: Level, message: str) -> None:
        # What comes before tick 0 has no time in the file yet.
        t_ns = self._clock.now_ns() - self._metronome.start_ns if self._recording else 0
        write_event(self._channels.events, Event(t_ns, level, message))


def _return_path(profile: Profile, ending: Ending) -> list[float]:
    """Return the way back, tick by tick from 0 to 1; made before anything moves."""
    duration_s, rate_hz = profile.session.return_s, profile.rig.rate_hz
    if ending.poles_rad_s and duration_s <= _SHAPED_S:
        path = still_path(duration_s, rate_hz, np.array(ending.poles_rad_s))
    else:
        path = quintic(duration_s, rate_hz)
    parts: list[float] = path.tolist()
    return parts
