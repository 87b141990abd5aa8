"""A session from rest to rest: tare, enable, hold, record, return, disable, check the tare.

The record is what lies between tick 0 and the last tick of the excitation; everything else runs
through the same cycle and leaves its results in the metadata.
"""

import time

import numpy as np

from rigd.devices.contracts import DeviceError, Wrench
from rigd.engine.board import Phase, Stop, Word
from rigd.engine.channels import Channels
from rigd.engine.clocks import Clock
from rigd.engine.cycle import Cycle
from rigd.engine.events import Event, Level, write_event
from rigd.engine.metronome import Metronome
from rigd.engine.process import Parent
from rigd.engine.sample_log import SampleLog
from rigd.engine.signals import StopRequest
from rigd.excitation import Excitation
from rigd.profile import Profile

_AXES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
_SETTLE_S = 0.5
_LOOK_EVERY = 64
"""Ticks between two looks at whether everybody is still there and keeps up."""
_GO_POLL_S = 0.0002
_GO_PATIENCE_S = 10.0
_SWINGING = 2.0
"""Spread of the torque after a session, over that before it, from which on the beam is swinging."""


class SessionEnd(Exception):
    """A session ends before its time; carries the outcome and the reason."""

    def __init__(self, outcome: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.reason = reason


class Procedure:
    """One session on connected devices.

    Parameters
    ----------
    profile, excitation
        What the operator chose; the excitation's reference is relative to the angle at the start.
    cycle, clock
        What a tick does, and when.
    channels
        Where samples, the controller's terms and events go.
    parent
        The supervisor.
    stop
        The signals that this process received itself.
    """

    def __init__(
        self,
        profile: Profile,
        excitation: Excitation,
        cycle: Cycle,
        clock: Clock,
        channels: Channels,
        parent: Parent,
        stop: StopRequest,
    ) -> None:
        self._profile = profile
        self._excitation = excitation
        self._cycle = cycle
        self._clock = clock
        self._channels = channels
        self._board = channels.board
        self._parent = parent
        self._stop = stop
        self._rate_hz = profile.rig.rate_hz
        self._metronome = Metronome(clock, self._rate_hz)
        late_ns = int(profile.realtime.late_us * 1000)
        self._log = SampleLog(cycle, self._metronome, clock, channels, late_ns)
        # Made a list now: of a long session that takes many periods.
        self._relative_reference: list[float] = excitation.reference_rad.tolist()
        self._start_angle_rad = 0.0
        self._rest_spread_nm = 0.0
        self.counts = self._log.counts
        self.results: dict[str, str] = {}
        """What the record's outcome has to tell beside the counts."""

    def tare(self) -> dict[str, str]:
        """Average the sensor at rest, before the drive is enabled.

        Returns
        -------
        dict
            Metadata: mean and standard deviation of each axis, N and N·m.

        Raises
        ------
        SessionEnd
            If the motor moves, or stands outside the limits.
        """
        self._board[Word.PHASE] = Phase.TARING
        settings = self._profile.session
        wrenches, angles = self._rest(settings.tare_s)
        speed_rad_s = float(np.ptp(angles)) / settings.tare_s
        if speed_rad_s > settings.rest_velocity_rad_s:
            raise SessionEnd(
                "fault",
                f"The motor is not at rest: it moves by {speed_rad_s:.2g} rad/s, more than "
                f"session.rest_velocity_rad_s = {settings.rest_velocity_rad_s:g} rad/s. "
                "Wait until it stands still and start again.",
            )
        self._start_angle_rad = float(np.mean(angles))
        limit_rad = self._profile.limits.angle_rad
        if abs(self._start_angle_rad) > limit_rad:
            raise SessionEnd(
                "fault",
                f"The motor stands at {self._start_angle_rad:.4g} rad, outside "
                f"limits.angle_rad = {limit_rad:g} rad; turn it back and start again.",
            )
        mean = [float(value) for value in wrenches.mean(axis=0)]
        spread = [float(value) for value in wrenches.std(axis=0, ddof=1)]
        self._rest_spread_nm = float(
            np.std(wrenches @ np.array(self._profile.rig.sensor.projection))
        )
        self._cycle.tare = (mean[0], mean[1], mean[2], mean[3], mean[4], mean[5])
        return {"tare_s": repr(settings.tare_s), "start_angle_rad": repr(self._start_angle_rad)} | {
            f"tare_{what}_{axis}": repr(value)
            for what, values in (("mean", mean), ("std", spread))
            for axis, value in zip(_AXES, values, strict=True)
        }

    def hold(self) -> None:
        """Hold the motor where it stands; the drive has just been enabled."""
        self._board[Word.PHASE] = Phase.SETTLING
        # The angle of the last reading, not the mean: the controller must start without a step.
        self._start_angle_rad = self._cycle.angle_rad
        self._cycle.controller.reset(self._start_angle_rad)
        self._cycle.watch.reset(self._start_angle_rad)
        for number in range(round(_SETTLE_S * self._rate_hz)):
            # Enabling, right before the first, takes its time.
            self._tick(self._start_angle_rad, excused=number == 0)

    def wait_for_go(self) -> None:
        """Go on holding until the recorder is ready; virtual time stands still meanwhile.

        Raises
        ------
        SessionEnd
            If nobody says so in time: the supervisor may be there and yet do nothing.
        """
        self._board[Word.PHASE] = Phase.READY
        deadline = time.monotonic() + _GO_PATIENCE_S
        while not self._board[Word.GO]:
            if time.monotonic() > deadline:
                raise SessionEnd(
                    "fault", f"The supervisor did not start the record within {_GO_PATIENCE_S:g} s."
                )
            if self._clock.virtual:
                self._check_stop()
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
        stop, scheduled = board.word(Word.STOP), board.word(Word.SCHEDULED)
        metronome.restart()
        wall_ns, before_ns = time.time_ns(), time.monotonic_ns()
        # Under the real clock tick 0 is still ahead, or up to one period behind.
        ahead_ns = 0 if virtual else metronome.start_ns - before_ns
        board[Word.START_UTC_NS] = wall_ns + ahead_ns
        board[Word.PHASE] = Phase.RUNNING
        self._say("info", f"Record starts: {total} ticks at {self._rate_hz:g} Hz.")
        last = -1
        first_ns = last_ns = 0
        end: SessionEnd | None = None
        while end is None and last < total - 1:
            missed = metronome.wait()
            tick = metronome.tick
            if missed:
                missed = min(tick, total) - last - 1
                counts.missed += missed
                board[Word.MISSED] = counts.missed
                end = self._missed_too_many(missed, min(tick, total))
                if tick >= total:
                    last = total - 1
                    break
            if end is None and (
                stop[0] or counts.lost or signals.requested or tick % _LOOK_EVERY == 0
            ):
                end = self._stop_reason()
            if end is None:
                end = self._step(start_rad + reference[tick])
            else:
                self._observe_switched_off()
            wait = virtual or end is not None
            log.write(tick, start_rad + reference[tick], missed, wait=wait)
            scheduled[0] = tick + 1
            last_ns = metronome.t_ns + metronome.lateness_ns
            if last < 0:
                first_ns = last_ns
            last = tick
        counts.scheduled = scheduled[0] = last + 1
        if counts.lost and end is None:
            end = self._stop_reason()
        if end is not None:
            cycle.torque_off()
        self._take_stock(wall_ns, before_ns, last_ns - first_ns)
        if end is not None:
            raise end

    def go_back(self) -> None:
        """Return to the start angle on a minimum-jerk path."""
        self._board[Word.PHASE] = Phase.RETURNING
        distance_rad = float(self._excitation.reference_rad[-1])
        n = round(self._profile.session.return_s * self._rate_hz)
        u = np.arange(1, n + 1) / n
        path = self._start_angle_rad + distance_rad * (1 - u**3 * (10 - 15 * u + 6 * u**2))
        for reference_rad in path.tolist():
            self._tick(reference_rad)

    def check_tare(self) -> None:
        """Average the sensor again, the drive disabled, to see how far its zero has moved."""
        self._rest(_SETTLE_S)
        wrenches, _ = self._rest(self._profile.session.tare_s)
        torque = wrenches @ np.array(self._profile.rig.sensor.projection)
        if torque.std() > _SWINGING * self._rest_spread_nm:
            self._say(
                "info", "The beam still swings: the zero of the coupling torque was not checked."
            )
            return
        zero_nm = np.dot(self._cycle.tare, self._profile.rig.sensor.projection)
        drift_nm = float(torque.mean() - zero_nm)
        self.results["tare_drift_nm"] = repr(drift_nm)
        limit_nm = self._profile.session.tare_drift_nm
        if abs(drift_nm) > limit_nm:
            self._say(
                "warning",
                f"The zero of the coupling torque moved by {drift_nm:.2g} N·m during the session, "
                f"more than session.tare_drift_nm = {limit_nm:g} N·m.",
            )

    def _tick(self, reference_rad: float, *, excused: bool = False) -> None:
        """One tick outside the record; what is missed there is nobody's loss, but has its limit."""
        missed = self._metronome.wait()
        self._cycle.watch.skip(missed)
        if missed > self._profile.limits.missed_ticks_in_a_row and not excused:
            raise SessionEnd(
                "fault",
                f"The loop stood still for {missed} ticks with the torque held, more than "
                "limits.missed_ticks_in_a_row = "
                f"{self._profile.limits.missed_ticks_in_a_row}; see what else this computer does.",
            )
        self._check_stop()
        end = self._step(reference_rad)
        if end is not None:
            raise end

    def _step(self, reference_rad: float) -> SessionEnd | None:
        """Control one tick; where that ends the session, the torque is off."""
        try:
            violation = self._cycle.step(self._metronome.due_ns, reference_rad)
        except (DeviceError, OSError) as error:
            self._cycle.lose_readings()
            return SessionEnd("fault", str(error))
        return None if violation is None else SessionEnd("fault", str(violation))

    def _observe_switched_off(self) -> None:
        """Switch off, and read once more for the last sample if the devices still answer."""
        self._cycle.torque_off()
        try:
            self._cycle.observe(self._metronome.due_ns)
        except (DeviceError, OSError):
            self._cycle.lose_readings()

    def _rest(self, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Read without torque; raw wrenches (n, 6) and angles (n,)."""
        cycle, metronome = self._cycle, self._metronome
        wrenches: list[Wrench] = []
        angles: list[float] = []
        for _ in range(round(duration_s * self._rate_hz)):
            metronome.wait()
            self._check_stop()
            cycle.observe(metronome.due_ns)
            silent = cycle.check_stale()
            if silent is not None:
                raise SessionEnd("fault", str(silent))
            wrenches.append(cycle.raw_wrench)
            angles.append(cycle.angle_rad)
        return np.array(wrenches), np.array(angles)

    def _missed_too_many(self, missed: int, tick: int) -> SessionEnd | None:
        if not missed:
            return None
        reason = self._cycle.watch.check_missed(missed, self.counts.missed, tick + 1)
        return None if reason is None else SessionEnd("fault", str(reason))

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

    def _check_stop(self) -> None:
        end = self._stop_reason()
        if end is not None:
            self._cycle.torque_off()
            raise end

    def _take_stock(self, wall_ns: int, before_ns: int, executed_ns: int) -> None:
        """Compare the two clocks over the record, and the rate with what it should have been."""
        now_ns = time.time_ns()
        self.results["end_utc_ns"] = str(now_ns)
        if self._clock.virtual:
            return
        elapsed_ns = time.monotonic_ns() - before_ns
        self.results["wall_clock_drift_ppm"] = repr(((now_ns - wall_ns) / elapsed_ns - 1) * 1e6)
        intervals = self.counts.scheduled - self.counts.missed - 1
        if executed_ns > 0:
            self.results["true_rate_hz"] = repr(intervals / (executed_ns * 1e-9))

    def _say(self, level: Level, message: str) -> None:
        t_ns = self._clock.now_ns() - self._metronome.start_ns
        write_event(self._channels.events, Event(t_ns, level, message))
