"""Control of a rig: connect its devices, run sessions, tare, set the zero, report its status."""

import contextlib
import gc
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from rigd.devices import ActuationTarget, describe_unknown_values
from rigd.devices.contracts import DeviceError
from rigd.engine.messages import (
    ControlEnded,
    ControlJob,
    DevicesConnected,
    MeasurementRefused,
    MeasurementResult,
    ProbeOrder,
    TareOrder,
    ZeroOrder,
)
from rigd.engine.processes import ChildError
from rigd.engine.realtime import RaisedPriority
from rigd.engine.shared_state import SharedState, StateField, StopReason
from rigd.engine.workers import CONTROL, LIVE
from rigd.errors import FailureError
from rigd.profile import Profile
from rigd.runner._live_view import LiveViewClient
from rigd.runner._process_group import ProcessGroup
from rigd.runner.request import SessionOrder
from rigd.runner.session import (
    WITHOUT_HEARTBEAT_TEXT,
    ProgressCallback,
    SessionFailedError,
    SessionResult,
    SessionSupervisor,
    can_always_receive_stop,
)
from rigd.runner.signal_blocks import SignalBlock, SignalBlockReader
from rigd.runner.status import RigStatus, StatusReader
from rigd.runtime import StopRequest

_POLL_INTERVAL_S = 0.05
"""Time in seconds between two checks for a message of the control process."""
_CONNECT_TIMEOUT_S = 30.0
"""Maximum time in seconds for connecting the devices."""
_VIRTUAL_CLOCK_HEARTBEAT_TIMEOUT_S = 30.0
"""Maximum time in seconds between heartbeats under the virtual clock, whose ticks may wait."""
_ENABLE_TIMEOUT_S = 5.0
"""Maximum time in seconds for enabling a drive, during which there is no heartbeat."""
_PROBE_TIMEOUT_S = 60.0
"""Maximum time in seconds for a probing move, in addition to the wait for rest before it."""
_MEASUREMENT_TIMEOUT_S = 10.0
"""Maximum time in seconds to wait for a tare or a new zero, in addition to the measuring time."""


class RigError(FailureError):
    """Raised if the rig cannot execute a request or its connection is lost; it states why."""


class RigStoppedError(RigError):
    """Raised if a stop signal, such as that of Ctrl-C, has ended the control process."""

    def __init__(self) -> None:
        super().__init__("The control process was asked to end.")


class Rig:
    """The devices of one profile, operated by separate processes.

    All methods except :meth:`status` and :meth:`signals` must be called from one thread.

    Parameters
    ----------
    profile
        Profile of the rig.
    uses_virtual_clock
        Run sessions under the virtual clock, faster than real time.
    with_live_view
        Show each session in a live view.
    group
        Processes that are already started and are used for the first connection.

    Attributes
    ----------
    connected
        Whether the control process is connected to the devices.
    zero_lost
        Whether the zero was lost with the connection to the devices: the zero that the operator had
        set, or on hardware also the angle at the previous connection.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        uses_virtual_clock: bool = False,
        with_live_view: bool = False,
        group: ProcessGroup | None = None,
    ) -> None:
        self._profile = profile
        self._uses_virtual_clock = uses_virtual_clock
        self._with_live_view = with_live_view
        self._group = group
        self._connection: DevicesConnected | None = None
        self._view: LiveViewClient | None = None
        self._has_zero_to_lose = False
        self._raised_priority: RaisedPriority | None = None
        self._status_lock = threading.Lock()
        self._status_reader = StatusReader(profile.rig.rate_hz)
        self._signal_reader = SignalBlockReader(profile)
        self.connected = False
        self.zero_lost = False

    @property
    def is_simulated(self) -> bool:
        """Whether the rig is simulated; False before the first connection."""
        return self._connection is not None and self._connection.simulated

    @property
    def angle_rad(self) -> float:
        """Motor angle relative to the rig's zero.

        Raises
        ------
        RigError
            If the rig is not connected.
        """
        return self._connected_group().channels.shared_state[StateField.ANGLE_NRAD] * 1e-9

    @property
    def calibration(self) -> Mapping[str, Any] | None:
        """Identity and calibration of the connected sensor, or None while not connected."""
        return (
            None if self._connection is None or not self.connected else self._connection.calibration
        )

    @property
    def drive_statement(self) -> Mapping[str, str]:
        """Settings that the connected drive reports, as metadata; empty while not connected."""
        return {} if self._connection is None or not self.connected else self._connection.drive

    def connect(self, target: ActuationTarget | None = None, *, reset_fault: bool = False) -> None:
        """Start the processes and connect the devices, while the torque stays off.

        Parameters
        ----------
        target
            Actuation target that was announced to the operator; any other target is refused.
        reset_fault
            Reset a fault of the drive first, as the operator has decided.

        Raises
        ------
        RigError
            If the connection fails, or a value of the profile is unknown. All processes and devices
            are closed then.
        """
        if unknown_values_text := describe_unknown_values(self._profile.rig):
            raise RigError(
                f"{unknown_values_text}\nThen start the daemon again, which reads the profile once."
            )
        if self.connected:
            self.disconnect()
        try:
            # For processes that are started here, it is not yet known which sessions follow.
            may_be_observed = self._group is None
            group = self._group = self._group or ProcessGroup(with_live_view=self._with_live_view)
            granted_settings = self._raise_priority(group)
            if reset_fault:
                self._reset_fault(target)
            _allocate_shared_memory(
                group,
                self._profile.rig.rate_hz,
                uses_virtual_clock=self._uses_virtual_clock,
                may_be_observed=may_be_observed,
            )
            control_job = ControlJob(
                self._profile, target, group.channels.specs, self._uses_virtual_clock
            )
            group.idle_process(CONTROL).start(control_job)
            connection = self._await_message(_CONNECT_TIMEOUT_S)
            assert isinstance(connection, DevicesConnected)
            self._connection = replace(
                connection, realtime={**connection.realtime, **granted_settings}
            )
        except (RigError, ChildError, OSError) as error:
            self.disconnect()
            raise RigError(str(error)) from None
        if LIVE in group:
            self._view = LiveViewClient(
                group, self._profile.name, uses_virtual_clock=self._uses_virtual_clock
            )
        self.connected = True
        self.zero_lost |= self._has_zero_to_lose
        # The angle of this connection is the zero now. Only on hardware can the next one differ.
        self._has_zero_to_lose = not connection.simulated

    def run(
        self,
        session_order: SessionOrder,
        stop: StopRequest,
        on_progress: ProgressCallback,
        can_receive_stop: Callable[[], bool] = can_always_receive_stop,
    ) -> SessionResult:
        """Run one session to its end, and return its result.

        Parameters
        ----------
        session_order
            Session to run.
        stop
            Stop request of the operator, which ends the session.
        on_progress, can_receive_stop
            See :class:`rigd.runner.session.SessionSupervisor`.

        Raises
        ------
        RigError
            If the rig is not connected, or its zero was lost.
        SessionFailedError
            If the file cannot be written, or the recorder ended.
        """
        group = self._connected_group()
        assert self._connection is not None
        if self.zero_lost:
            raise RigError(
                "The zero of the angle was lost with the connection, and the limits with it; move "
                "the motor to mid-travel and run rigd zero."
            )
        if self._raised_priority is not None:
            self._raised_priority.raise_priority_of_new_threads()
        _reset_session_fields(group.channels.shared_state)
        group.channels.discard_records()
        session_run = SessionSupervisor(
            session_order, group, self._connection, self._view, on_progress, can_receive_stop
        )
        end_outcome = end_reason = ""
        try:
            run_result = replace(session_run.run(stop), hardware=not self.is_simulated)
            end_outcome, end_reason = run_result.outcome, run_result.reason
            return run_result
        except SessionFailedError as error:
            error.hardware = not self.is_simulated
            end_outcome, end_reason = "fault", str(error)
            raise
        finally:
            if self._view is not None:
                self._view.finish(end_outcome, end_reason)
            if session_run.device_failed:
                self._await_closed_devices()
            # Collected between sessions: remaining objects of a session would fragment the memory,
            # and a long series would take 4 kB more for each session.
            gc.collect()

    def reset_session_counts(self) -> None:
        """Reset what :meth:`status` states on the previous session; do this before the next one."""
        if self._group is not None and self.connected:
            _reset_session_fields(self._group.channels.shared_state)

    def show_session(self, session_order: SessionOrder, stop: StopRequest) -> str:
        """Prepare the live view for the next session, and return its address.

        Parameters
        ----------
        session_order, stop
            As for :meth:`run`.

        Returns
        -------
        str
            Text for the operator: address of the live view, or why there is none.
        """
        group = self._connected_group()
        if self._view is None:
            return "No live view was requested."
        _reset_session_fields(group.channels.shared_state)
        return self._view.show_session(session_order, stop)

    def tare(self) -> dict[str, Any]:
        """Tare the force-torque sensor: average its readings at rest.

        Returns
        -------
        dict
            ``mean`` and ``std`` of each axis (N, N·m), and ``torque_std_nm``.

        Raises
        ------
        RigError
            If the tare fails.
        """
        return self._measure(TareOrder(), self._profile.session.tare_s)

    def zero(self) -> dict[str, Any]:
        """Set the present motor angle as the rig's zero, to which the limits are relative.

        Returns
        -------
        dict
            ``moved_rad``: the new zero relative to the previous zero.

        Raises
        ------
        RigError
            If the motor moves.
        """
        zero_reply = self._measure(ZeroOrder(), 0.0)
        self._has_zero_to_lose, self.zero_lost = True, False
        return zero_reply

    def probe(self, profile: Profile, stop: StopRequest) -> dict[str, Any]:
        """Make the probing move, which estimates friction and the scales of motor and sensors.

        Parameters
        ----------
        profile
            Profile of the rig, possibly with another beam.
        stop
            Stop request of the operator, which ends the move.

        Returns
        -------
        dict
            ``end``, the name of a `rigd.safety.probing_move.ProbeEnd` that states why the move
            ended, and the fields of a `rigd.safety.probe_estimate.ProbeEstimate`.

        Raises
        ------
        RigError
            If the move is stopped, an interlock ends it, or the connection is lost.
        """
        group = self._connected_group()
        shared_state = group.channels.shared_state
        if self._raised_priority is not None:
            self._raised_priority.raise_priority_of_new_threads()
        _reset_session_fields(shared_state)

        def request_stop() -> None:
            shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

        stop.on_request = request_stop
        if stop.requested:
            request_stop()
        try:
            try:
                group.control.send(ProbeOrder(profile))
                probe_reply = self._await_probe(group, profile)
            finally:  # before `disconnect` releases the memory
                stop.on_request = _do_nothing_on_stop
                _reset_session_fields(shared_state)
        except ChildError as error:
            self.disconnect()
            raise RigError(f"{error} {WITHOUT_HEARTBEAT_TEXT}") from None
        except RigError:
            self.disconnect()
            raise
        if isinstance(probe_reply, MeasurementRefused):
            raise RigError(probe_reply.reason)
        assert isinstance(probe_reply, MeasurementResult)
        return probe_reply.values

    def _await_probe(self, group: ProcessGroup, profile: Profile) -> object:
        """Monitor the control process during a probing move, and return its reply.

        A hung control process is killed.
        """
        shared_state = group.channels.shared_state
        assert CONTROL.max_silence_s is not None
        max_silence_s = (
            _VIRTUAL_CLOCK_HEARTBEAT_TIMEOUT_S
            if self._uses_virtual_clock
            else CONTROL.max_silence_s + _ENABLE_TIMEOUT_S
        )
        deadline_s = time.monotonic() + profile.session.rest_timeout_s + _PROBE_TIMEOUT_S
        while True:
            probe_reply = group.control.poll(_POLL_INTERVAL_S)
            shared_state.beat(StateField.SUPERVISOR_BEAT)
            if isinstance(probe_reply, ControlEnded):
                raise _control_end_error(probe_reply)
            if probe_reply is not None:
                return probe_reply
            now_s = time.monotonic()
            if group.stalled_s(CONTROL) > max_silence_s or now_s > deadline_s:
                group.control.kill()
                raise RigError(
                    "The control process did not end the probing move and was killed. "
                    f"{WITHOUT_HEARTBEAT_TEXT} Check CPU load."
                )

    def check_control_process(self) -> None:
        """Check that the control process is running; call this often while no session runs.

        Raises
        ------
        RigError
            If the control process reported a fault, ended or hangs. All processes and devices are
            closed then.
        """
        group = self._connected_group()
        if self._view is not None:
            self._view.check_heartbeat()
        try:
            control_message = group.control.poll(0.0)
        except ChildError as error:
            control_message = ControlEnded(str(error))
        shared_state = group.channels.shared_state
        shared_state.beat(StateField.SUPERVISOR_BEAT)
        assert CONTROL.max_silence_s is not None
        stalled_s = group.stalled_s(CONTROL)
        if control_message is None and stalled_s > CONTROL.max_silence_s:
            group.control.kill()
            control_message = ControlEnded(
                f"The control process has not responded for {stalled_s:.1f} s. Check CPU load."
            )
        if control_message is not None:
            self.disconnect()
            raise _control_end_error(control_message)

    def status(self) -> RigStatus | None:
        """Return the rig's present status, or None without connection; any thread may call this."""
        with self._status_lock:
            group, live_view = self._group, self._view
            if group is None or not group.has_memory:
                return None
            view_address = None if live_view is None else live_view.address
            return replace(self._status_reader.read(group), live_view=view_address)

    def signals(self) -> list[SignalBlock]:
        """Return the signals that were recorded since the last call; any thread may call this.

        The first call, and a call more than 1 s after the previous one, return no earlier signals.
        """
        with self._status_lock:
            group = self._group
            if group is None or not group.has_memory:
                return []
            return self._signal_reader.take(group.channels)

    def disconnect(self) -> None:
        """Disable the drive, close the devices and end the processes; may be called repeatedly."""
        with self._status_lock:
            group, self._group = self._group, None
            self._view = None
            self.connected = False
        if group is not None:
            group.end()
        if self._raised_priority is not None:
            self._raised_priority.restore_priority()
            self._raised_priority = None

    def _raise_priority(self, group: ProcessGroup) -> dict[str, str]:
        """Raise the priority of this process, and return the granted settings as metadata."""
        if self._uses_virtual_clock:
            return {}
        realtime_settings = self._profile.realtime
        self._raised_priority = RaisedPriority(
            realtime_settings.supervision_priority, realtime_settings.cpu
        )
        group.cores = self._raised_priority.cores_before
        return {
            f"supervisor_{setting_name}": setting_text
            for setting_name, setting_text in self._raised_priority.request_priority().items()
        }

    def _reset_fault(self, target: ActuationTarget | None) -> None:
        """Reset the fault of the drive; raise RigError if that fails."""
        try:
            # Late: loads the drivers, needed only here.
            from rigd.devices import ResetUnsupportedError, reset_drive

            # A drive whose driver cannot reset a fault reports the fault when it is connected.
            with contextlib.suppress(ResetUnsupportedError):
                reset_drive(self._profile.rig, target)
        except (DeviceError, OSError) as error:
            raise RigError(str(error)) from None

    def _connected_group(self) -> ProcessGroup:
        """Return the processes of the rig; raise RigError if it is not connected."""
        if self._group is None or not self.connected:
            raise RigError("The rig is not connected.")
        return self._group

    def _measure(
        self, measurement_order: TareOrder | ZeroOrder, duration_s: float
    ) -> dict[str, Any]:
        """Make the control process tare the sensor or set the zero; return the result.

        `duration_s` is the measuring time.
        """
        group = self._connected_group()
        try:
            group.control.send(measurement_order)
            measurement_reply = self._await_message(_MEASUREMENT_TIMEOUT_S + duration_s)
        except (ChildError, RigError) as error:
            self.disconnect()
            raise RigError(str(error)) from None
        if isinstance(measurement_reply, MeasurementRefused):
            raise RigError(measurement_reply.reason)
        assert isinstance(measurement_reply, MeasurementResult)
        return measurement_reply.values

    def _await_message(self, timeout_s: float) -> object:
        """Wait for a message of the control process, and return it.

        Raises RigError if the process ends regularly or sends nothing in time, and ChildError if it
        died.
        """
        assert self._group is not None
        control_message = self._group.control.poll(timeout_s)
        if control_message is None:
            raise RigError(
                f"The control process does not answer within {timeout_s:g} s; check that the "
                "devices are on, and check CPU load."
            )
        if isinstance(control_message, ControlEnded):
            raise _control_end_error(control_message)
        return control_message

    def _await_closed_devices(self) -> None:
        """Wait until the control process has closed all devices after a failure; disconnect."""
        assert self._group is not None
        with contextlib.suppress(ChildError):
            self._group.control.poll(_MEASUREMENT_TIMEOUT_S)
        self.disconnect()


def _control_end_error(control_message: object) -> RigError:
    """Return the error that states why the control process has ended, from its last message."""
    if isinstance(control_message, ControlEnded) and control_message.reason:
        return RigError(control_message.reason)
    return RigStoppedError()


def _do_nothing_on_stop() -> None:
    """Do nothing when a stop is requested, because its flag is read later."""


def _reset_session_fields(shared_state: SharedState) -> None:
    """Reset the fields of the shared state that belong to a single session.

    The control process, which writes the counts of the record, must be idle.
    """
    shared_state[StateField.STOP_REASON] = StopReason.NONE
    for state_field in (
        StateField.RECORD_MAY_START,
        StateField.START_UTC_NS,
        StateField.SCHEDULED_TICKS,
        StateField.MISSED_TICKS,
        StateField.LATE_TICKS,
        StateField.LOST_SAMPLES,
        StateField.LIVE_SAMPLES_DROPPED,
        StateField.STALE_ANGLES,
        StateField.STALE_WRENCHES,
        StateField.TOUCHES,
        StateField.HELD_TICKS,
        StateField.HELD_TICKS_BEFORE_SEGMENT,
        StateField.BEGUN_REFERENCE_TICKS,
        StateField.PLANNED_TICKS,
        StateField.LAST_SEGMENT,
    ):
        shared_state[state_field] = 0


def _allocate_shared_memory(
    group: ProcessGroup, rate_hz: float, *, uses_virtual_clock: bool, may_be_observed: bool
) -> None:
    """Allocate the shared memory of the processes; raise RigError if that fails."""
    try:
        group.allocate_memory(
            rate_hz, uses_virtual_clock=uses_virtual_clock, may_be_observed=may_be_observed
        )
    except OSError as error:
        raise RigError(
            f"No shared memory for the session processes ({error.strerror}); check the "
            "limits of open files (ulimit -n) and of shared memory (/dev/shm)."
        ) from error
