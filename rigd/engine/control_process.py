"""The control process, which alone talks to the devices, and never leaves the torque on.

It connects the devices, observes them at the rig's rate with the torque off, and runs the sessions
that the supervisor requests, one after the other. It ends when a device fails, because the operator
decides when to reconnect.
"""

import gc
import time
from collections.abc import Callable
from dataclasses import asdict

from rigd.control.contracts import ControllerError
from rigd.control.kinds import make_controller
from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError, Devices, StatedDrive
from rigd.devices.kinds import failure_of_device
from rigd.engine._control_names import CONNECTING_NAME, IDLE_NAME, SESSION_NAME
from rigd.engine._publish import ReadingPublisher
from rigd.engine._session_sequence import SessionEnd, SessionSequence
from rigd.engine.channels import Channels, attach_channels
from rigd.engine.cycle import (
    Cycle,
    RestReadings,
    StandstillMonitor,
    make_limit_monitor,
    make_reading_monitors,
    observe_rest,
    store_motor_heat,
    stored_motor_heat_nm2,
)
from rigd.engine.messages import (
    ControlEnded,
    ControlJob,
    DevicesConnected,
    MeasurementRefused,
    MeasurementResult,
    ProbeOrder,
    ReadyToRecord,
    SessionFinished,
    SessionJob,
    TareOrder,
    ZeroOrder,
)
from rigd.engine.processes import SupervisorConnection
from rigd.engine.realtime import REFUSED_PREFIX, apply_realtime, disable_garbage_collection
from rigd.engine.reference import ReferenceReader, map_reference
from rigd.engine.shared_state import LogEvent, Phase, StateField, write_event
from rigd.engine.timing import MAX_VIRTUAL_PAUSE_S, Clock, RealClock, TickScheduler, VirtualClock
from rigd.errors import RigdError
from rigd.plugins import PluginError
from rigd.profile import Profile
from rigd.runtime import StopRequest
from rigd.runtime.processes import name_this_process
from rigd.safety import SLOW_CHECK_TICKS
from rigd.session.layout import WRENCH_FIELDS

_MAX_DEVICE_SILENCE_S = 1.0
"""Longest time in s for which a device may send no reading between sessions."""
_ORDER_POLL_S = 0.05
"""Longest single wait in s for an order of the supervisor while virtual time is stopped."""
_ZERO_READING_S = 0.2
"""Duration in s of the readings whose last angle becomes the rig's zero."""
_PROCESS_NAME_VISIBLE_S = 0.5
"""Time in s after a stopped session for which the process name shows ``rigd stop`` that the drive
is off; on an overloaded computer, ``rigd stop`` reads it only a few times a second."""
_STANDSTILL_TICKS = 2
"""Number of ticks after which the motor's angle and speed are known."""


def main() -> None:
    """Run the control process, started as ``python -m rigd.engine.control_process``."""
    stop_request = StopRequest()
    stop_request.catch_signals()
    parent = SupervisorConnection()
    job: ControlJob = parent.receive_job()
    channels = attach_channels(job.channels)
    realtime_settings = job.profile.realtime
    if job.fast:
        realtime_results = {"clock": "virtual", "garbage_collector": disable_garbage_collection()}
    else:
        realtime_results = {"clock": "real"} | apply_realtime(
            priority=realtime_settings.priority, cpu=realtime_settings.cpu
        )
    try:
        devices = open_devices(job.profile.rig, job.announced_target)
        # Imports a package and designs its controller before a connected drive expects SYNCs.
        make_controller(job.profile.controlled_rig())
    except RigdError as error:  # of a device, a controller, or a beam that cannot be simulated
        parent.send(ControlEnded(str(error)))
        return
    clock: Clock = VirtualClock() if job.fast else RealClock(int(realtime_settings.spin_us * 1000))
    run_control(job.profile, devices, clock, channels, parent, stop_request, realtime_results)


def run_control(
    profile: Profile,
    devices: Devices,
    clock: Clock,
    channels: Channels,
    parent: SupervisorConnection,
    stop_request: StopRequest,
    realtime_results: dict[str, str],
) -> None:
    """Connect the devices, execute the supervisor's orders, and always close the devices.

    Parameters
    ----------
    profile
        Profile of the rig.
    devices
        Devices, not yet connected.
    clock, channels, parent, stop_request
        As for :class:`rigd.engine._session_sequence.SessionSequence`.
    realtime_results
        Real-time settings that were granted, for the file.
    """
    end_reason_text = ""
    server = None
    name_this_process(CONNECTING_NAME)
    try:
        # The drive last: an operational drive expects a SYNC every period.
        devices.sensor.connect()
        drive = devices.drive
        drive.connect()
        _publish_drive_off_if_certain(channels, devices)
        server = _ControlServer(
            profile, devices, clock, channels, parent, stop_request, realtime_results
        )
        server.observe_standstill()
        parent.send(
            DevicesConnected(
                calibration=devices.sensor.calibration(),
                drive=drive.statement() if isinstance(drive, StatedDrive) else {},
                realtime=realtime_results,
                simulated=devices.simulated,
            )
        )
        server.serve()
    except PluginError as error:
        end_reason_text = str(error)
    except Exception as error:
        end_reason_text = failure_of_device(error, profile.rig.devices)
    finally:
        devices.drive.disable()
        if channels.shared_state[StateField.PHASE] != Phase.PREPARING:  # it was connected
            _publish_drive_off_if_certain(channels, devices)
        devices.drive.close()
        devices.sensor.close()
    if server is not None:
        server.wait_while_name_visible()
    parent.send(ControlEnded(f"{end_reason_text} {devices.drive.off_doubt}".strip()))


def _publish_drive_off_if_certain(channels: Channels, devices: Devices) -> None:
    """Publish that the disabled drive is off, unless it has not shown this.

    Displays claim that the torque is off in this phase, and ``rigd stop`` by this process name.
    """
    if not devices.drive.off_doubt:
        channels.shared_state[StateField.PHASE] = Phase.OFF
        name_this_process(IDLE_NAME)


class _ControlServer:
    """Server that executes the supervisor's orders, such as a session, on connected devices."""

    def __init__(
        self,
        profile: Profile,
        devices: Devices,
        clock: Clock,
        channels: Channels,
        parent: SupervisorConnection,
        stop_request: StopRequest,
        realtime_results: dict[str, str],
    ) -> None:
        self._profile = profile
        self._devices = devices
        self._clock = clock
        self._scheduler = TickScheduler(clock, profile.rig.rate_hz)
        self._channels = channels
        self._shared_state = channels.shared_state
        self._parent = parent
        self._stop = stop_request
        self._realtime_results = realtime_results
        self._zero_rad = 0.0
        self._silent_ticks = 0
        self._last_stop_s = -_PROCESS_NAME_VISIBLE_S
        """Time of the end of the last session that the operator stopped."""
        self._uses_line = devices.uses_line
        # A simulated motor starts cold.
        is_real_motor = not devices.simulated
        self._limit_monitor = make_limit_monitor(
            profile, stored_motor_heat_nm2(profile) if is_real_motor else 0.0
        )
        self._standstill = StandstillMonitor(profile)
        self._reading_publisher = ReadingPublisher(channels.shared_state, devices)
        self._cycle = self._make_cycle(profile)

    def wait_while_name_visible(self) -> None:
        """Wait until ``rigd stop`` has read the name of this process after a stopped session."""
        if not self._clock.virtual:
            time.sleep(max(0.0, self._last_stop_s + _PROCESS_NAME_VISIBLE_S - time.monotonic()))

    def store_real_motor_heat(self) -> None:
        """Store the heat of a real motor in a file for the next connection to the rig."""
        if not self._devices.simulated:
            store_motor_heat(self._profile, self._limit_monitor.heat_nm2)

    def observe_standstill(self) -> None:
        """Read the devices with the torque off until the motor's angle and speed are known.

        Virtual time stops after this. Raise `DeviceError` or `OSError` if a device failed.
        """
        for _ in range(_STANDSTILL_TICKS):
            if not self._standstill.has_speed:
                self._scheduler.wait()
                self._read_at_rest()
        self._publish_readings()

    def serve(self) -> None:
        """Execute the supervisor's orders until the supervisor has ended or a stop is requested.

        Raise `DeviceError` or `OSError` if a device failed.
        """
        while (supervisor_order := self._await_order()) is not None:
            match supervisor_order:
                case SessionJob():
                    try:
                        self._run_session(supervisor_order)
                    finally:
                        self.store_real_motor_heat()
                    self.observe_standstill()
                    gc.collect()  # the torque is off: the only time for it
                case TareOrder():
                    self._send_measurement(self._measure_tare)
                case ZeroOrder():
                    self._send_measurement(self._set_zero)
                case ProbeOrder():
                    self._run_probe(supervisor_order.profile)
                    self.observe_standstill()

    def _await_order(self) -> object | None:
        """Return the supervisor's next order; until then read the devices with the torque off.

        Return None if the supervisor has ended or a stop is requested. Virtual time does not
        advance meanwhile, except for occasional ticks with devices on a bus or serial line.
        """
        last_tick_s = time.monotonic()
        while not self._stop.requested:
            self._publish_readings()
            try:
                supervisor_message = self._parent.poll(
                    _ORDER_POLL_S if self._clock.virtual else 0.0
                )
            except EOFError:
                return None
            if supervisor_message is not None:
                return supervisor_message
            if not self._clock.virtual:
                self._read_idle_devices()
            elif self._uses_line and time.monotonic() - last_tick_s > MAX_VIRTUAL_PAUSE_S:
                last_tick_s = time.monotonic()
                self._scheduler.wait()
                self._read_at_rest()
        return None

    def _read_idle_devices(self) -> None:
        """Read the devices for some ticks with the torque off; raise if a device is silent."""
        cycle = self._cycle
        for _ in range(SLOW_CHECK_TICKS):
            self._scheduler.wait()
            self._read_at_rest()
            self._silent_ticks = self._silent_ticks + 1 if cycle.has_stale_reading else 0
        if self._silent_ticks > _MAX_DEVICE_SILENCE_S * self._profile.rig.rate_hz:
            raise DeviceError(
                f"{cycle.stale_reading_names} has not arrived for {_MAX_DEVICE_SILENCE_S:g} s; "
                "check that the device is on and connected."
            )

    def _read_at_rest(self) -> None:
        """Read the devices for one tick with the torque off."""
        self._cycle.read_devices(self._scheduler.due_ns)
        self._cycle.check_encoder(self._standstill, self._scheduler.due_ns)

    def _run_session(self, session_job: SessionJob) -> None:
        """Run one session, disable the drive in any case, and send `SessionFinished`.

        Raise `DeviceError` if a device failed. `SessionFinished` has been sent nevertheless.
        """
        shared_state, devices = self._shared_state, self._devices
        self._warn_of_refusals(session_job)
        self._log_accepted_checks(session_job)
        cycle = self._cycle = self._make_cycle(session_job.profile)
        reference_rad = map_reference(session_job.reference)
        touch_monitor = None
        if session_job.touch is not None:
            from rigd.engine._touch_monitor import TouchMonitor  # late: few sessions need it

            touch_monitor = TouchMonitor(
                session_job.touch, cycle, reference_rad, session_job.profile.rig.rate_hz
            )
        reference_reader = None
        if session_job.reference.planned_ticks is not None:
            reference_reader = ReferenceReader(
                reference_rad, session_job.reference.planned_ticks, shared_state
            )
        session_sequence = SessionSequence(
            session_job.profile,
            reference_rad,
            cycle,
            self._clock,
            self._scheduler,
            self._standstill,
            self._channels,
            self._reading_publisher,
            self._parent,
            self._stop,
            session_job.ending,
            touch_monitor,
            reference_reader,
        )
        session_outcome, end_reason = "complete", ""
        was_recorded = device_failed = False
        name_this_process(SESSION_NAME)
        try:
            seed_metadata = self._restart_noise(session_job)
            tare_metadata = session_sequence.measure_tare()
            devices.drive.enable(session_sequence.stop_requested)
            session_sequence.hold_start_angle()
            self._parent.send(ReadyToRecord(tare_metadata | seed_metadata))
            session_sequence.wait_for_go()
            session_sequence.run_record()
            was_recorded = True
            session_sequence.damp_vibration()
            session_sequence.return_to_start()
            cycle.switch_torque_off()
            session_sequence.check_tare()
        except SessionEnd as end:
            session_outcome, end_reason, device_failed = end.outcome, end.reason, end.device_failed
        except ControllerError as error:  # of its reset
            session_outcome, end_reason = "fault", str(error)
        except Exception as error:
            session_outcome, device_failed = "fault", True
            end_reason = failure_of_device(error, self._profile.rig.devices)
        finally:
            devices.drive.disable()
            cycle.switch_torque_off()
            _publish_drive_off_if_certain(self._channels, devices)
            self._publish_readings()
        off_doubt = devices.drive.off_doubt
        if off_doubt:
            session_outcome, end_reason, device_failed = (
                "fault",
                f"{end_reason} {off_doubt}".strip(),
                True,
            )
        if session_outcome == "stopped":
            self._last_stop_s = time.monotonic()
        failure_text, is_fault = end_reason, session_outcome == "fault"
        if was_recorded and end_reason:
            # Events after the last tick do not make the record incomplete.
            session_outcome, end_reason = "complete", f"After the record: {end_reason}"
        self._parent.send(
            SessionFinished(
                outcome=session_outcome,
                reason=end_reason,
                fault=is_fault,
                counts=asdict(session_sequence.counts),
                results=session_sequence.results,
                device_failed=device_failed,
            )
        )
        if device_failed:
            raise DeviceError(failure_text)

    def _restart_noise(self, session_job: SessionJob) -> dict[str, str]:
        """Restart the noise of a simulated rig, and return the seed as metadata.

        The metadata are empty for a real rig. Raise `DeviceError` if the simulated rig does not
        answer.
        """
        renew_noise = self._devices.renew_noise
        return (
            {} if renew_noise is None else {"simulation_seed": str(renew_noise(session_job.seed))}
        )

    def _run_probe(self, profile: Profile) -> None:
        """Run the probing move, disable the drive, and send the result to the supervisor.

        Raise `DeviceError` if a device failed.
        """
        from rigd.engine._probe_sequence import ProbeSequence  # late: few connections need it

        cycle = self._cycle = self._make_cycle(profile)
        probe_sequence = ProbeSequence(
            profile,
            cycle,
            self._clock,
            self._scheduler,
            self._standstill,
            self._channels,
            self._reading_publisher,
            self._parent,
            self._stop,
        )
        reply_message: MeasurementResult | MeasurementRefused
        failure_text = ""
        name_this_process(SESSION_NAME)
        try:
            probe_sequence.measure_tare()
            self._devices.drive.enable(probe_sequence.stop_requested)
            reply_message = MeasurementResult(probe_sequence.run_probing_move())
        except SessionEnd as end:
            reply_message = MeasurementRefused(end.reason)
            failure_text = end.reason if end.device_failed else ""
        finally:
            self._devices.drive.disable()
            cycle.switch_torque_off()
            _publish_drive_off_if_certain(self._channels, self._devices)
            self._publish_readings()
        failure_text = f"{failure_text} {self._devices.drive.off_doubt}".strip()
        if failure_text:
            raise DeviceError(failure_text)
        self._parent.send(reply_message)

    def _send_measurement(self, measure_at_rest: Callable[[], dict[str, object]]) -> None:
        """Run a measurement at rest; send its result, or `MeasurementRefused` with the reason."""
        try:
            self._parent.send(MeasurementResult(measure_at_rest()))
        except SessionEnd as end:
            self._parent.send(MeasurementRefused(end.reason))

    def _measure_tare(self) -> dict[str, object]:
        """Tare the sensor at rest; return mean and standard deviation of each axis.

        The returned values are for display, because each session repeats the tare.
        """
        self._cycle.sensor_monitor.start_learning()
        rest_readings = self._read_rest(self._profile.session.tare_s)
        sensor_violation = self._cycle.sensor_monitor.finish_learning()
        if sensor_violation is not None:
            raise SessionEnd("fault", str(sensor_violation))
        self._cycle.tare = rest_readings.mean_wrench
        self._limit_monitor.tared_nm = float(rest_readings.torques_nm.mean())
        return {
            "mean": dict(zip(WRENCH_FIELDS, rest_readings.mean_wrench, strict=True)),
            "std": dict(zip(WRENCH_FIELDS, rest_readings.wrench_std, strict=True)),
            "torque_std_nm": rest_readings.torque_spread_nm,
        }

    def _set_zero(self) -> dict[str, object]:
        """Set the rig's zero, from which the angle limits are measured, to the present angle.

        Return ``moved_rad``, the new zero relative to the previous one. Raise `SessionEnd` if the
        motor moves.
        """
        rest_readings = self._read_rest(_ZERO_READING_S)
        rest_speed_limit_rad_s = self._profile.session.rest_velocity_rad_s
        if rest_readings.speed_rad_s > rest_speed_limit_rad_s:
            raise SessionEnd(
                "fault",
                f"The motor moves by {rest_readings.speed_rad_s:.2g} rad/s, more than "
                f"session.rest_velocity_rad_s = {rest_speed_limit_rad_s:g} rad/s; "
                "wait until it is at rest.",
            )
        zero_shift_rad = self._cycle.angle_rad
        self._zero_rad += zero_shift_rad
        self._cycle.zero_rad = self._zero_rad
        self._cycle.angle_rad = 0.0
        self._publish_readings()
        return {"moved_rad": zero_shift_rad}

    def _publish_readings(self) -> None:
        """Write the last readings of angle and torque to the shared state."""
        self._reading_publisher.publish(self._cycle, self._scheduler.due_ns)

    def _read_rest(self, duration_s: float) -> RestReadings:
        """Return the sensor and encoder readings of `duration_s` seconds without torque."""
        rig = self._profile.rig
        return observe_rest(
            self._cycle,
            self._scheduler,
            rate_hz=rig.rate_hz,
            duration_s=duration_s,
            projection=rig.sensor.projection,
            check_reading=self._check_reading,
        )

    def _check_reading(self) -> None:
        """Raise an error if encoder or sensor failed, or a stop is requested."""
        if self._scheduler.tick % SLOW_CHECK_TICKS == 0:
            self._publish_readings()
        if self._stop.requested or not self._parent.alive():
            raise SessionEnd("stopped", "The rig is being shut down.")
        self._cycle.check_encoder(self._standstill, self._scheduler.due_ns)
        reading_violation = self._cycle.check_stale() or self._cycle.check_sensor()
        if reading_violation is not None:
            raise SessionEnd("fault", str(self._cycle.with_reported_cause(reading_violation)))

    def _make_cycle(self, profile: Profile) -> Cycle:
        """Return a new cycle with the controller and monitors of a profile."""
        rig = profile.rig
        cycle = Cycle(
            self._devices,
            rig.sensor.projection,
            make_controller(profile.controlled_rig()),
            self._limit_monitor,
            make_reading_monitors(profile, self._devices),
        )
        cycle.zero_rad = self._zero_rad
        return cycle

    def _warn_of_refusals(self, session_job: SessionJob) -> None:
        """Log a warning for the real-time settings that the system did not grant."""
        refusals_of_process = {
            setting_name: refusal_text
            for setting_name, refusal_text in self._realtime_results.items()
            if refusal_text.startswith(REFUSED_PREFIX)
        }
        for refused_settings, consequence_text in (
            (refusals_of_process, "more ticks will be late"),
            (
                session_job.refused_settings,
                "a computer that is busy with other programs may end the session",
            ),
        ):
            if refused_settings:
                setting_names = ", ".join(
                    f"{setting_name} ({refusal_text})"
                    for setting_name, refusal_text in refused_settings.items()
                )
                warning_message = f"The system did not grant {setting_names}: {consequence_text}."
                write_event(self._channels.events, LogEvent(0, "warning", warning_message))

    def _log_accepted_checks(self, session_job: SessionJob) -> None:
        """Log a warning for each failed check of ``rigd check`` that the operator accepted."""
        for check_text in session_job.accepted_check_texts:
            warning_message = f"Accepted by the operator, though rigd check fails: {check_text}"
            write_event(self._channels.events, LogEvent(0, "warning", warning_message))


if __name__ == "__main__":
    main()
