"""The rig: connect, run sessions, tare, zero, status, disconnect."""

import contextlib
import gc
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from rigd.devices import ActuationTarget, describe_unknown_values
from rigd.devices.contracts import DeviceError
from rigd.engine.messages import Connected, ControlJob, Ended, Measured, Probe, Refused, Tare, Zero
from rigd.engine.processes import CONTROL, LIVE, ChildError, Heartbeat
from rigd.engine.realtime import Precedence
from rigd.engine.shared_state import SharedState, StateField, Stop
from rigd.errors import FailureError
from rigd.profile import Profile
from rigd.runner._live_view import LiveView
from rigd.runner._process_group import ProcessGroup
from rigd.runner.request import Order
from rigd.runner.session import RunResult, SessionFailedError, SessionRun, Watcher, always
from rigd.runner.signal_blocks import SignalBlock, SignalReader
from rigd.runner.status import RigStatus, StatusWatch
from rigd.runtime import StopRequest

_POLL_S = 0.05
_CONNECT_PATIENCE_S = 30.0
_SLOW_PATIENCE_S = 30.0
"""Longest time between heartbeats under the virtual clock, whose ticks may wait for replies."""
_ENABLE_PATIENCE_S = 5.0
"""Time for enabling a drive, during which there is no heartbeat."""
_PROBE_PATIENCE_S = 60.0
_ANSWER_PATIENCE_S = 10.0
"""Time to wait for an answer, in addition to the measuring time."""


class RigError(FailureError):
    """The rig cannot carry out a request, or is lost; the message is for the operator."""


class Rig:
    """The devices of one profile, in separate processes.

    All methods except :meth:`status` and :meth:`signals` are called from one thread.

    Parameters
    ----------
    profile
        Profile of the rig.
    fast
        Run under the virtual clock.
    live
        Show each session in a live view.
    group
        Processes that are already started, for the first connection.

    Attributes
    ----------
    connected
        Whether the control process owns the devices.
    zero_lost
        Whether a zero set by the operator was lost with its connection.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        fast: bool = False,
        live: bool = False,
        group: ProcessGroup | None = None,
    ) -> None:
        self._profile = profile
        self._fast = fast
        self._live = live
        self._group = group
        self._connection: Connected | None = None
        self._view: LiveView | None = None
        self._zero_set = False
        self._pulse = Heartbeat()
        self._precedence: Precedence | None = None
        self._status_lock = threading.Lock()
        self._statuses = StatusWatch(profile.rig.rate_hz)
        self._signals = SignalReader(profile)
        self.connected = False
        self.zero_lost = False

    @property
    def simulated(self) -> bool:
        """Whether the rig is simulated; False before the first connection."""
        return self._connection is not None and self._connection.simulated

    @property
    def angle_rad(self) -> float:
        """Motor angle from the rig's zero.

        Raises
        ------
        RigError
            If the rig is not connected.
        """
        return self._require().channels.shared_state[StateField.ANGLE_NRAD] * 1e-9

    @property
    def calibration(self) -> Mapping[str, Any] | None:
        """Identity and calibration of the connected sensor; None while not connected."""
        return (
            None if self._connection is None or not self.connected else self._connection.calibration
        )

    @property
    def drive_statement(self) -> Mapping[str, str]:
        """Metadata that the connected drive states; empty while not connected."""
        return {} if self._connection is None or not self.connected else self._connection.drive

    def connect(self, moving: ActuationTarget | None = None, *, reset_fault: bool = False) -> None:
        """Start the processes and connect the devices; the torque stays off.

        Parameters
        ----------
        moving
            Actuation target that was announced to the operator; any other is refused.
        reset_fault
            Reset a fault of the drive first, by decision of the operator.

        Raises
        ------
        RigError
            If the connection fails, or a value of the profile is unknown. Everything is closed
            then.
        """
        if unknown := describe_unknown_values(self._profile.rig):
            raise RigError(f"{unknown}\nThen start the daemon again, which reads the profile once.")
        if self.connected:
            self.disconnect()
        try:
            # The sessions of the processes started here are not yet known.
            any_session = self._group is None
            group = self._group = self._group or ProcessGroup(live=self._live)
            granted = self._take_precedence(group)
            if reset_fault:
                self._reset_fault(moving)
            _lay_out(group, self._profile.rig.rate_hz, fast=self._fast, watched=any_session)
            job = ControlJob(self._profile, moving, group.channels.specs, self._fast)
            group.fresh(CONTROL).start(job)
            connection = self._ask(_CONNECT_PATIENCE_S)
            assert isinstance(connection, Connected)
            self._connection = replace(connection, realtime={**connection.realtime, **granted})
        except (RigError, ChildError, OSError) as error:
            self.disconnect()
            raise RigError(str(error)) from None
        if LIVE in group:
            self._view = LiveView(group, self._profile.name, fast=self._fast)
        self.connected = True
        self.zero_lost |= self._zero_set
        self._zero_set = False

    def run(
        self,
        order: Order,
        stop: StopRequest,
        watcher: Watcher,
        listens: Callable[[], bool] = always,
    ) -> RunResult:
        """Run one session.

        Parameters
        ----------
        order
            Session to run.
        stop
            Stop request of the operator, which ends the session.
        watcher, listens
            See :class:`rigd.runner.session.SessionRun`.

        Raises
        ------
        RigError
            If the rig is not connected, or its zero is lost.
        SessionFailedError
            If the file cannot be written, or the recorder died.
        """
        group = self._require()
        assert self._connection is not None
        if self.zero_lost:
            raise RigError(
                "The zero of the angle was lost with the connection, and the limits with it; move "
                "the motor to mid-travel and run rigd zero."
            )
        if self._precedence is not None:
            self._precedence.cover()
        _wipe(group.channels.shared_state)
        group.channels.clear()
        session = SessionRun(order, group, self._connection, self._view, watcher, listens)
        outcome = reason = ""
        try:
            result = replace(session.run(stop), hardware=not self.simulated)
            outcome, reason = result.outcome, result.reason
            return result
        except SessionFailedError as error:
            error.hardware = not self.simulated
            outcome, reason = "fault", str(error)
            raise
        finally:
            if self._view is not None:
                self._view.finish(outcome, reason)
            if session.device_failed:
                self._await_end()
            # Between sessions: objects of a session would fragment the memory, and a long series
            # would take 4 kB more for each session.
            gc.collect()

    def show(self, order: Order, stop: StopRequest) -> str:
        """Show the next session in the live view.

        Parameters
        ----------
        order, stop
            As for :meth:`run`.

        Returns
        -------
        str
            Address of the view, or why there is none, for the operator.
        """
        group = self._require()
        if self._view is None:
            return "No live view was requested."
        _wipe(group.channels.shared_state)
        return self._view.show(order, stop)

    def tare(self) -> dict[str, Any]:
        """Average the sensor at rest.

        Returns
        -------
        dict
            ``mean`` and ``std`` by axis (N, N·m), and ``torque_std_nm``.

        Raises
        ------
        RigError
            If the tare fails.
        """
        return self._order(Tare(), self._profile.session.tare_s)

    def zero(self) -> dict[str, Any]:
        """Set the present motor angle as zero; the limits are relative to it.

        Returns
        -------
        dict
            ``moved_rad``: the angle before the reset to zero.

        Raises
        ------
        RigError
            If the motor moves.
        """
        answer = self._order(Zero(), 0.0)
        self._zero_set, self.zero_lost = True, False
        return answer

    def probe(self, profile: Profile, stop: StopRequest) -> dict[str, Any]:
        """Make the probing move of a profile.

        Parameters
        ----------
        profile
            Profile of the rig, possibly with another beam.
        stop
            Stop request of the operator, which ends the move.

        Returns
        -------
        dict
            ``end``, the name of a `rigd.safety.probing_move.ProbeEnd`, and the fields of a
            `rigd.safety.probe_estimate.ProbeEstimate`.

        Raises
        ------
        RigError
            If the move is stopped, an interlock ends it, or the rig is lost.
        """
        group = self._require()
        shared_state = group.channels.shared_state
        if self._precedence is not None:
            self._precedence.cover()
        _wipe(shared_state)

        def request_stop() -> None:
            shared_state[StateField.STOP] = Stop.OPERATOR

        stop.on_request = request_stop
        if stop.requested:
            request_stop()
        try:
            group.control.send(Probe(profile))
            answer = self._await_probe(group, profile)
        except (ChildError, RigError) as error:
            self.disconnect()
            raise RigError(str(error)) from None
        finally:
            stop.on_request = _nothing
            _wipe(shared_state)
        if isinstance(answer, Refused):
            raise RigError(answer.reason)
        assert isinstance(answer, Measured)
        return answer.values

    def _await_probe(self, group: ProcessGroup, profile: Profile) -> object:
        """Wait for the result of a probing move while monitoring the control process."""
        shared_state, pulse = group.channels.shared_state, Heartbeat()
        assert CONTROL.hung_after_s is not None
        hung_after_s = _SLOW_PATIENCE_S if self._fast else CONTROL.hung_after_s + _ENABLE_PATIENCE_S
        until_s = time.monotonic() + profile.session.rest_timeout_s + _PROBE_PATIENCE_S
        while True:
            answer = group.control.poll(_POLL_S)
            shared_state.beat(StateField.SUPERVISOR_BEAT)
            if isinstance(answer, Ended):
                raise RigError(answer.reason or "It was stopped.")
            if answer is not None:
                return answer
            now_s = time.monotonic()
            still_s = pulse.stalled_for(shared_state[StateField.CONTROL_BEAT], now_s)
            if still_s > hung_after_s or now_s > until_s:
                group.control.kill()
                raise RigError(
                    "The control process did not end the probing move and was killed: without its "
                    "heartbeat the drive switches off by itself. Check CPU load."
                )

    def watch(self) -> None:
        """Check the control process; call this several times a second between sessions.

        Raises
        ------
        RigError
            If the process reported a fault, died or hangs. Everything is closed then.
        """
        group = self._require()
        if self._view is not None:
            self._view.check()
        try:
            message = group.control.poll(0.0)
        except ChildError as error:
            message = Ended(str(error))
        shared_state = group.channels.shared_state
        shared_state.beat(StateField.SUPERVISOR_BEAT)
        assert CONTROL.hung_after_s is not None
        still_s = self._pulse.stalled_for(shared_state[StateField.CONTROL_BEAT], time.monotonic())
        if message is None and still_s > CONTROL.hung_after_s:
            group.control.kill()
            message = Ended(
                f"The control process has not responded for {still_s:.1f} s. Check CPU load."
            )
        if message is not None:
            self.disconnect()
            reason = message.reason if isinstance(message, Ended) else ""
            raise RigError(reason or "The control process was asked to end.")

    def status(self) -> RigStatus | None:
        """Return the status from shared memory, from any thread; None while there is none."""
        with self._status_lock:
            group, view = self._group, self._view
            if group is None or not group.laid_out:
                return None
            address = None if view is None else view.address
            return replace(self._statuses.read(group), live_view=address)

    def signals(self) -> list[SignalBlock]:
        """Return the signals of the record since the last call, from any thread.

        Reading starts with the first call, and again if the last call was more than 1 s ago.
        """
        with self._status_lock:
            group = self._group
            if group is None or not group.laid_out:
                return []
            return self._signals.take(group.channels)

    def disconnect(self) -> None:
        """Disable the drive, close the devices, end the processes; repeated calls do nothing."""
        with self._status_lock:
            group, self._group = self._group, None
            self._view = None
            self.connected = False
        if group is not None:
            group.end()
        if self._precedence is not None:
            self._precedence.release()
            self._precedence = None

    def _take_precedence(self, group: ProcessGroup) -> dict[str, str]:
        """Raise the priority of this process; return what the system granted."""
        if self._fast:
            return {}
        realtime = self._profile.realtime
        self._precedence = Precedence(realtime.supervision_priority, realtime.cpu)
        group.cores = self._precedence.cores_before
        return {f"supervisor_{name}": text for name, text in self._precedence.take().items()}

    def _reset_fault(self, moving: ActuationTarget | None) -> None:
        try:
            from rigd.devices import reset_drive  # late: loads the drivers, needed only here

            reset_drive(self._profile.rig, moving)
        except (DeviceError, OSError) as error:
            raise RigError(str(error)) from None

    def _require(self) -> ProcessGroup:
        if self._group is None or not self.connected:
            raise RigError("The rig is not connected.")
        return self._group

    def _order(self, order: Tare | Zero, duration_s: float) -> dict[str, Any]:
        """Send a measuring order to the control process between sessions, and return the result."""
        group = self._require()
        try:
            group.control.send(order)
            answer = self._ask(_ANSWER_PATIENCE_S + duration_s)
        except (ChildError, RigError) as error:
            self.disconnect()
            raise RigError(str(error)) from None
        if isinstance(answer, Refused):
            raise RigError(answer.reason)
        assert isinstance(answer, Measured)
        return answer.values

    def _ask(self, patience_s: float) -> object:
        """Wait for an answer of the control process.

        Raises
        ------
        RigError
            If it ends instead, or does not answer in time.
        ChildError
            If it died.
        """
        assert self._group is not None
        answer = self._group.control.poll(patience_s)
        if answer is None:
            raise RigError(
                f"The control process does not answer within {patience_s:g} s; check that the "
                "devices are on, and check CPU load."
            )
        if isinstance(answer, Ended):
            raise RigError(answer.reason or "It was stopped.")
        return answer

    def _await_end(self) -> None:
        """Wait until a control process with a failed device has closed the others."""
        assert self._group is not None
        with contextlib.suppress(ChildError):
            self._group.control.poll(_ANSWER_PATIENCE_S)
        self.disconnect()


def _nothing() -> None:
    """Do nothing: the stop request is polled."""


def _wipe(shared_state: SharedState) -> None:
    """Clear the fields of the shared state that belong to one session."""
    shared_state[StateField.STOP] = Stop.NO
    shared_state[StateField.GO] = 0
    shared_state[StateField.LIVE_DROPPED] = 0
    shared_state[StateField.PLANNED] = 0
    shared_state[StateField.LAST_SEGMENT] = 0


def _lay_out(group: ProcessGroup, rate_hz: float, *, fast: bool, watched: bool) -> None:
    try:
        group.lay_out(rate_hz, fast=fast, watched=watched)
    except OSError as error:
        raise RigError(
            f"No shared memory for the session processes ({error.strerror}); check the "
            "limits of open files (ulimit -n) and of shared memory (/dev/shm)."
        ) from error
