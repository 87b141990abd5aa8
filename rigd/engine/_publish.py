"""Publishing of a tick's results: to the status (`Display`), and to recorder and live view."""

import time
from dataclasses import dataclass
from math import isfinite

from rigd.devices.contracts import Devices, LineHealth
from rigd.engine._ring import Ring
from rigd.engine.channels import CONTROL, Channels
from rigd.engine.cycle import Cycle
from rigd.engine.processes import Pulse
from rigd.engine.shared_state import UNKNOWN, SharedState, Word
from rigd.engine.timing import Clock, TickScheduler
from rigd.session.layout import Status, pack_control_into, pack_sample_into, pack_timing_into


class Display:
    """Writes the control process's words on the board several times a second.

    Parameters
    ----------
    board
        SharedState to write to.
    devices
        Devices whose line health it reports.

    Attributes
    ----------
    doubts
        About the age of the readings, as of the last call of `show`, for the operator.
    doubt_counts
        How much of it there has been so far, likewise.
    """

    def __init__(self, board: SharedState, devices: Devices) -> None:
        self._board = board
        self._devices = devices
        self.doubts: list[str] = []
        self.doubt_counts: list[str] = []
        self._before: tuple[int, tuple[int, ...]] | None = None

    def show(self, cycle: Cycle, now_ns: int) -> None:
        """Publish the control process's heartbeat and readings.

        Parameters
        ----------
        cycle
            Cycle with the last readings.
        now_ns
            Time on the engine's clock: a line's load is taken from one call to the next.
        """
        board = self._board
        board.beat(Word.CONTROL_BEAT)
        for word, value in (
            (Word.ANGLE_NRAD, cycle.angle_rad),
            (Word.COUPLING_TORQUE_NNM, cycle.coupling_torque_nm),
            (Word.TORQUE_COMMAND_NNM, cycle.torque_command_nm),
        ):
            if isfinite(value):
                board[word] = round(value * 1e9)
        drive, sensor = self._devices.drive.health(), self._devices.sensor.health()
        self.doubts = [line.doubt for line in (drive, sensor) if line.doubt]
        self.doubt_counts = [line.doubt_count for line in (drive, sensor) if line.doubt_count]
        known = [line.errors for line in (drive, sensor) if line.errors is not None]
        board[Word.BUS_ERRORS] = sum(known) if known else UNKNOWN
        board[Word.SENSOR_STATUS] = UNKNOWN if sensor.status is None else sensor.status
        self._show_load((drive, sensor), now_ns)

    def _show_load(self, lines: tuple[LineHealth, ...], now_ns: int) -> None:
        """Show the load of the busiest line since the last call."""
        bits = tuple(line.bits or 0 for line in lines)
        if self._before is None:
            self._board[Word.BUS_LOAD_PPM] = UNKNOWN
        else:
            then_ns, before = self._before
            if now_ns <= then_ns:
                return  # virtual time stands still
            per_ppm = 1e-15 * (now_ns - then_ns)  # 1e-9 s, 1e-6
            loads = [
                (now - then) / (line.bit_rate_bit_s * per_ppm)
                for line, now, then in zip(lines, bits, before, strict=True)
                if line.bit_rate_bit_s
            ]
            self._board[Word.BUS_LOAD_PPM] = round(max(loads)) if loads else UNKNOWN
        self._before = now_ns, bits


# Samples of a record

_AFTER_MISSED = int(Status.AFTER_MISSED)
_AFTER_LOST = int(Status.AFTER_LOST)
_LATE = int(Status.LATE)
_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_STALE = _ANGLE_STALE | _WRENCH_STALE

_TERMS_EVERY = CONTROL.every
_ROOM_PATIENCE_S = 2.0
_ROOM_POLL_S = 0.0002


@dataclass(slots=True)
class Counts:
    """Counts of a record's ticks: scheduled = recorded + missed + lost.

    Among the recorded ticks, `late` woke late, and `stale_angles` and `stale_wrenches` hold a
    reading that is not of their own tick.
    """

    scheduled: int = 0
    missed: int = 0
    late: int = 0
    lost: int = 0
    stale_angles: int = 0
    stale_wrenches: int = 0


class SampleLog:
    """Writes sample and ages for each tick, and the controller's terms for every tenth.

    Parameters
    ----------
    cycle, metronome, clock
        Sources of a sample's content.
    channels
        Channels that it writes to.
    late_ns
        Lateness above which a tick is flagged as late.

    Attributes
    ----------
    counts
        Ticks that were late, readings that were stale and samples that were lost are counted here.
    """

    def __init__(
        self,
        cycle: Cycle,
        metronome: TickScheduler,
        clock: Clock,
        channels: Channels,
        late_ns: int,
    ) -> None:
        self._cycle = cycle
        self._metronome = metronome
        self._clock = clock
        self._ring = channels.samples
        self._buffer = channels.samples.buffer
        self._terms_ring = channels.controls
        # Under the virtual clock no reading has an age.
        self._timing_ring = None if clock.virtual else channels.timings
        self._board = channels.board
        self._late_ns = late_ns
        self.counts = Counts()

    def write(self, tick: int, reference_rad: float, missed: int, *, wait: bool) -> None:
        """Log the tick that was just run.

        Parameters
        ----------
        tick
            Number of the tick in the record.
        reference_rad
            Reference angle.
        missed
            Ticks that were missed right before it.
        wait
            Wait for room in the ring, because nothing moves or time stands still; otherwise a
            sample that finds none is lost.
        """
        cycle, metronome, ring = self._cycle, self._metronome, self._ring
        lateness_ns = metronome.lateness_ns
        flags = cycle.flags
        if missed:
            flags |= _AFTER_MISSED
        if self.counts.lost:
            flags |= _AFTER_LOST
        offset = ring.slot()
        if offset < 0 and (not wait or (offset := self._wait_for_room()) < 0):
            self.counts.lost += 1
            self._board[Word.LOST] = self.counts.lost
            return
        if lateness_ns > self._late_ns:
            flags |= _LATE
            self.counts.late += 1
            self._board[Word.LATE] = self.counts.late
        if flags & _STALE:
            self._count_stale(flags)
        t_ns = metronome.t_ns
        fx, fy, fz, tx, ty, tz = cycle.wrench
        pack_sample_into(
            self._buffer,
            offset,
            t_ns,
            tick,
            reference_rad,
            cycle.angle_rad,
            cycle.torque_command_nm,
            cycle.coupling_torque_nm,
            fx,
            fy,
            fz,
            tx,
            ty,
            tz,
            flags,
            lateness_ns,
            self._clock.now_ns() - metronome.due_ns - lateness_ns,
        )
        ring.publish()
        if self._timing_ring is not None:
            self._write_ages(self._timing_ring, tick, t_ns)
        if tick % _TERMS_EVERY == 0:
            self._write_terms(tick, t_ns)

    def _count_stale(self, flags: int) -> None:
        counts, board = self.counts, self._board
        if flags & _ANGLE_STALE:
            counts.stale_angles += 1
            board[Word.STALE_ANGLES] = counts.stale_angles
        if flags & _WRENCH_STALE:
            counts.stale_wrenches += 1
            board[Word.STALE_WRENCHES] = counts.stale_wrenches

    def _write_ages(self, ring: Ring, tick: int, t_ns: int) -> None:
        offset = ring.slot()
        if offset < 0:
            return  # As with the terms.
        due_ns, devices = self._metronome.due_ns, self._cycle.devices
        pack_timing_into(
            ring.buffer,
            offset,
            t_ns,
            tick,
            (due_ns - devices.drive.angle_time_ns) * 1e-9,
            (due_ns - devices.sensor.wrench_time_ns) * 1e-9,
        )
        ring.publish()

    def _write_terms(self, tick: int, t_ns: int) -> None:
        ring, terms = self._terms_ring, self._cycle.controller
        offset = ring.slot()
        if offset < 0:
            return  # The terms explain a record; they are not what it stands on.
        pack_control_into(
            ring.buffer,
            offset,
            t_ns,
            tick,
            terms.proportional_nm,
            terms.integral_nm,
            terms.derivative_nm,
            terms.feedforward_nm,
            terms.friction_nm,
            terms.unlimited_torque_nm,
        )
        ring.publish()

    def _wait_for_room(self) -> int:
        """Wait for the recorder, unless it has not read for long while the computer ran."""
        ring, recorder = self._ring, Pulse()
        while (offset := ring.slot()) < 0:
            if recorder.look(ring.read, time.monotonic()) > _ROOM_PATIENCE_S:
                break
            time.sleep(_ROOM_POLL_S)
        return offset
