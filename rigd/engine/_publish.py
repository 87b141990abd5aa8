"""Output of a tick's results to shared memory, for supervisor, recorder and live view."""

import time
from dataclasses import dataclass
from math import isfinite

from rigd.devices.contracts import Devices, LineHealth
from rigd.engine._ring import Ring
from rigd.engine.channels import CONTROL, Channels
from rigd.engine.cycle import Cycle
from rigd.engine.processes import Heartbeat
from rigd.engine.shared_state import UNKNOWN_VALUE, SharedState, StateField
from rigd.engine.timing import Clock, TickScheduler
from rigd.session.layout import Status, pack_control_into, pack_sample_into, pack_timing_into


class ReadingPublisher:
    """Writer of the latest readings to the shared state, called several times a second.

    Bus and serial line of the devices are monitored.

    Attributes
    ----------
    doubts
        Sentences for the operator that state why the age of a reading is doubtful. Each call of
        `publish` replaces them.
    doubt_counts
        Sentences with the number of doubtful readings since the devices were connected.
    """

    def __init__(self, shared_state: SharedState, devices: Devices) -> None:
        self._shared_state = shared_state
        self._devices = devices
        self.doubts: list[str] = []
        self.doubt_counts: list[str] = []
        self._last_bits: tuple[int, tuple[int, ...]] | None = None

    def publish(self, cycle: Cycle, now_ns: int) -> None:
        """Write the control process's heartbeat and last readings to the shared state.

        `now_ns` is the present time of the loop's clock. The load of a line is averaged over the
        time since the last call.
        """
        shared_state = self._shared_state
        shared_state.beat(StateField.CONTROL_BEAT)
        for field, field_value in (
            (StateField.ANGLE_NRAD, cycle.angle_rad),
            (StateField.COUPLING_TORQUE_NNM, cycle.coupling_torque_nm),
            (StateField.TORQUE_COMMAND_NNM, cycle.torque_command_nm),
        ):
            if isfinite(field_value):
                shared_state[field] = round(field_value * 1e9)
        drive_health, sensor_health = self._devices.drive.health(), self._devices.sensor.health()
        self.doubts = [
            line_health.doubt for line_health in (drive_health, sensor_health) if line_health.doubt
        ]
        self.doubt_counts = [
            line_health.doubt_count
            for line_health in (drive_health, sensor_health)
            if line_health.doubt_count
        ]
        error_counts = [
            line_health.errors
            for line_health in (drive_health, sensor_health)
            if line_health.errors is not None
        ]
        shared_state[StateField.BUS_ERRORS] = sum(error_counts) if error_counts else UNKNOWN_VALUE
        shared_state[StateField.SENSOR_STATUS] = (
            UNKNOWN_VALUE if sensor_health.status is None else sensor_health.status
        )
        self._publish_bus_load((drive_health, sensor_health), now_ns)

    def _publish_bus_load(self, line_healths: tuple[LineHealth, ...], now_ns: int) -> None:
        """Write the load in ppm of the busiest bus or serial line to the shared state.

        The load is averaged over the time since the last call.
        """
        line_bits = tuple(line_health.bits or 0 for line_health in line_healths)
        if self._last_bits is None:
            self._shared_state[StateField.BUS_LOAD_PPM] = UNKNOWN_VALUE
        else:
            previous_ns, previous_bits = self._last_bits
            if now_ns <= previous_ns:
                return  # virtual time has not advanced
            elapsed_megaseconds = 1e-15 * (now_ns - previous_ns)  # 1e-9 s, 1e-6
            loads_ppm = [
                (present_bits - last_bits) / (line_health.bit_rate_bit_s * elapsed_megaseconds)
                for line_health, present_bits, last_bits in zip(
                    line_healths, line_bits, previous_bits, strict=True
                )
                if line_health.bit_rate_bit_s
            ]
            self._shared_state[StateField.BUS_LOAD_PPM] = (
                round(max(loads_ppm)) if loads_ppm else UNKNOWN_VALUE
            )
        self._last_bits = now_ns, line_bits


# Samples of a record

_AFTER_MISSED = int(Status.AFTER_MISSED)
_AFTER_LOST = int(Status.AFTER_LOST)
_LATE = int(Status.LATE)
_ANGLE_STALE = int(Status.ANGLE_STALE)
_WRENCH_STALE = int(Status.WRENCH_STALE)
_STALE_FLAGS = _ANGLE_STALE | _WRENCH_STALE

_CONTROLLER_TERMS_INTERVAL_TICKS = CONTROL.tick_interval
"""Number of ticks from one record of the controller's terms to the next."""
_FREE_SLOT_TIMEOUT_S = 2.0
"""Longest time in s to wait for free space in the ring while the recorder reads nothing."""
_FREE_SLOT_POLL_S = 0.0002
"""Pause in s between two checks for free space in the ring."""


@dataclass(slots=True)
class TickCounts:
    """Counts of a record's ticks, where scheduled = recorded + missed + lost.

    `late` is the number of recorded ticks with a late wake-up. `stale_angles` and `stale_wrenches`
    are the numbers of recorded ticks whose angle or wrench reading is older than the tick.
    """

    scheduled: int = 0
    missed: int = 0
    late: int = 0
    lost: int = 0
    stale_angles: int = 0
    stale_wrenches: int = 0


class SampleLog:
    """Log of a record in shared memory, from which the recorder writes the session file.

    It contains a sample and the ages of the readings for each tick, and the controller's terms for
    every tenth tick. A tick that is more than `late_limit_ns` late is flagged.

    Attributes
    ----------
    counts
        Counts of late ticks, stale readings and lost samples.
    """

    def __init__(
        self,
        cycle: Cycle,
        scheduler: TickScheduler,
        clock: Clock,
        channels: Channels,
        late_limit_ns: int,
    ) -> None:
        self._cycle = cycle
        self._scheduler = scheduler
        self._clock = clock
        self._ring = channels.samples
        self._buffer = channels.samples.buffer
        self._terms_ring = channels.controls
        # Under the virtual clock no reading has an age.
        self._timing_ring = None if clock.virtual else channels.timings
        self._shared_state = channels.shared_state
        self._late_limit_ns = late_limit_ns
        self.counts = TickCounts()

    def write_sample(
        self, tick: int, reference_rad: float, missed_ticks: int, *, wait_for_slot: bool
    ) -> None:
        """Write the sample of the last tick to the ring that the recorder reads.

        `tick` is the number of the tick in the record, and `missed_ticks` the number of ticks that
        were missed directly before it. With `wait_for_slot`, wait for free space if the ring is
        full, which is harmless if nothing moves or time is virtual. Otherwise the sample is lost.
        """
        cycle, scheduler, ring = self._cycle, self._scheduler, self._ring
        lateness_ns = scheduler.lateness_ns
        status_flags = cycle.flags
        if missed_ticks:
            status_flags |= _AFTER_MISSED
        if self.counts.lost:
            status_flags |= _AFTER_LOST
        slot_offset = ring.next_slot()
        if slot_offset < 0 and (
            not wait_for_slot or (slot_offset := self._wait_for_free_slot()) < 0
        ):
            self.counts.lost += 1
            self._shared_state[StateField.LOST_SAMPLES] = self.counts.lost
            return
        if lateness_ns > self._late_limit_ns:
            status_flags |= _LATE
            self.counts.late += 1
            self._shared_state[StateField.LATE_TICKS] = self.counts.late
        if status_flags & _STALE_FLAGS:
            self._count_stale_readings(status_flags)
        t_ns = scheduler.t_ns
        fx, fy, fz, tx, ty, tz = cycle.wrench
        pack_sample_into(
            self._buffer,
            slot_offset,
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
            status_flags,
            lateness_ns,
            self._clock.now_ns() - scheduler.due_ns - lateness_ns,
        )
        ring.publish()
        if self._timing_ring is not None:
            self._write_reading_ages(self._timing_ring, tick, t_ns)
        if tick % _CONTROLLER_TERMS_INTERVAL_TICKS == 0:
            self._write_controller_terms(tick, t_ns)

    def _count_stale_readings(self, status_flags: int) -> None:
        """Count a tick with a stale angle or wrench, and write the counts to the shared state."""
        counts, shared_state = self.counts, self._shared_state
        if status_flags & _ANGLE_STALE:
            counts.stale_angles += 1
            shared_state[StateField.STALE_ANGLES] = counts.stale_angles
        if status_flags & _WRENCH_STALE:
            counts.stale_wrenches += 1
            shared_state[StateField.STALE_WRENCHES] = counts.stale_wrenches

    def _write_reading_ages(self, ring: Ring, tick: int, t_ns: int) -> None:
        """Write the ages of a tick's angle and wrench to a ring, unless the ring is full."""
        slot_offset = ring.next_slot()
        if slot_offset < 0:
            return  # dropped, like the terms
        due_ns, devices = self._scheduler.due_ns, self._cycle.devices
        pack_timing_into(
            ring.buffer,
            slot_offset,
            t_ns,
            tick,
            (due_ns - devices.drive.angle_time_ns) * 1e-9,
            (due_ns - devices.sensor.wrench_time_ns) * 1e-9,
        )
        ring.publish()

    def _write_controller_terms(self, tick: int, t_ns: int) -> None:
        """Write the controller's terms of a tick to their ring, unless the ring is full."""
        terms_ring, controller = self._terms_ring, self._cycle.controller
        slot_offset = terms_ring.next_slot()
        if slot_offset < 0:
            return  # dropped: the terms explain a record, but no analysis needs them
        pack_control_into(
            terms_ring.buffer,
            slot_offset,
            t_ns,
            tick,
            *controller.terms_nm,
            controller.unlimited_torque_nm,
        )
        terms_ring.publish()

    def _wait_for_free_slot(self) -> int:
        """Wait for free space in the ring of samples; return the byte offset of the next sample.

        Return -1 if the recorder has stopped reading.
        """
        ring, recorder_heartbeat = self._ring, Heartbeat()
        while (slot_offset := ring.next_slot()) < 0:
            if (
                recorder_heartbeat.stalled_for(ring.read_count, time.monotonic())
                > _FREE_SLOT_TIMEOUT_S
            ):
                break
            time.sleep(_FREE_SLOT_POLL_S)
        return slot_offset
