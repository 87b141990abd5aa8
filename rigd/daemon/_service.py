"""Service of the daemon, which controls a rig, executes requests and publishes events.

It is independent of sockets. Everything runs in the event loop's thread, except for slow calls of
the rig, which run one after another in a worker thread. A stop does not wait for the worker thread.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from math import inf
from pathlib import Path
from typing import TypeVar

from rigd.checks import run_offline_checks
from rigd.daemon import _protocol as protocol
from rigd.daemon import background
from rigd.daemon._log import LOGGER_NAME
from rigd.daemon._protocol import CommandError
from rigd.daemon._series import PublishEvent, SeriesReporter, ServedSeries
from rigd.daemon._states import (
    DaemonState,
    DaemonStateMachine,
    Document,
    Peer,
    Transition,
    daemon_document,
    peer_document,
    progress_document,
    rig_document,
    signals_document,
    transition_document,
    transition_documents,
)
from rigd.devices import ActuationTarget, describe_actuation_target
from rigd.errors import UserError
from rigd.profile import Profile
from rigd.runner import ProbeFailedError, Rig, RigError, RigStoppedError, Series
from rigd.runner.quick_looks import QuickLook, QuickLookQueue
from rigd.runner.request import remaining_file_text
from rigd.runner.session import SessionFailedError
from rigd.runner.status import RigStatus

POLL_INTERVAL_S = 0.2
"""Time in seconds between two checks of the rig."""
_SIGNALS_INTERVAL_S = 0.05
"""Time in seconds between two blocks of signals that are sent to clients during a session."""
_MAX_PREDICTIONS = 4
"""Maximum number of predictions that are running or waiting; only one is running at a time."""
_UNRESPONSIVE_AFTER_S = 1.5
"""Time in seconds without a poll after which the event loop is assumed to receive no stop."""
_RATE_WINDOW_POLLS = 10
"""Number of polls over which message rates are measured."""
SHUTTING_DOWN_MESSAGE = "The daemon is being shut down."
"""Reason with which requests are refused while the daemon ends."""
_STOPPED_MESSAGE = "It was stopped before it began."
"""Reason with which a command is refused that was stopped, or whose client has gone, before it
began."""
_NO_QUICK_LOOK_REASON = "the daemon ended; python -m analysis.quick_look FILE makes it."
"""Reason why there is no quick look that was not complete when the daemon ended."""

ReturnType = TypeVar("ReturnType")

_log = logging.getLogger(LOGGER_NAME)


class Service:
    """Service that controls a rig for clients; its methods run in the event loop's thread.

    The rig is not connected yet and was created with the options `uses_virtual_clock` and
    `with_live_view`; its slow calls run in the single thread of `rig_executor`. `publish` sends an
    event to the clients that have subscribed, `find_actuation_target` returns what would move if
    the rig were connected now. `controller` is the client that controls the rig, or None.
    """

    def __init__(
        self,
        rig: Rig,
        profile: Profile,
        session_folder: Path,
        rig_executor: Executor,
        publish: PublishEvent,
        find_actuation_target: Callable[[], ActuationTarget],
        *,
        uses_virtual_clock: bool = False,
        with_live_view: bool = False,
        makes_quick_looks: bool = False,
    ) -> None:
        self._rig = rig
        self._profile = profile
        self._session_folder = session_folder
        self._rig_executor = rig_executor
        self._publish = publish
        self._find_actuation_target = find_actuation_target
        self._announced_target = find_actuation_target()
        self._failed_checks = [
            asdict(failed_check) for failed_check in run_offline_checks(profile).failed
        ]
        self._uses_virtual_clock = uses_virtual_clock
        self._with_live_view = with_live_view
        self._state_machine = DaemonStateMachine(self._report_transition)
        self._began_utc_ns = time.time_ns()
        self._fault_reason = ""
        """Reason of the last fault, to which failed attempts to reset it are not added."""
        self._current_command = ""
        self._first_connection_tried = asyncio.Event()
        """Event that is set after the first attempt to connect the rig."""
        self._stop_count = 0
        """Number of stops that were requested so far."""
        self._is_closing = False
        self._series: ServedSeries | None = None
        self._quick_looks = QuickLookQueue(self._report_quick_look) if makes_quick_looks else None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._series_count = 0
        self._last_poll_s = inf
        self._rig_status: RigStatus | None = None
        self._polled_session: tuple[int, int] | None = None
        """Session that was present at the last poll of the status."""
        self._timed_message_counts: deque[tuple[float, dict[str, int]]] = deque(
            maxlen=_RATE_WINDOW_POLLS + 1
        )
        self._signal_watchers: set[Peer] = set()
        self._prediction_count = 0
        self._prediction_lock = asyncio.Lock()
        self._last_check: Document | None = None
        self.controller: Peer | None = None
        self._page_address: str | None = None

    @property
    def state(self) -> DaemonState:
        """Present state of the daemon."""
        return self._state_machine.state

    async def open(self) -> None:
        """Connect the rig for the first time; if that fails, enter a fault, which can be reset."""
        self._current_command = "connecting"
        self._loop = asyncio.get_running_loop()
        try:
            await self._connect(reset_fault=False)
        except CommandError:
            pass  # the reason of the fault states the error
        finally:
            self._current_command = ""
            self._first_connection_tried.set()

    async def run(self) -> None:
        """Poll the rig and publish its progress several times a second, until cancelled."""
        while True:
            await asyncio.sleep(POLL_INTERVAL_S)
            self._last_poll_s = time.monotonic()
            self.poll_status()
            if self._quick_looks is not None:
                self._quick_looks.poll()
            # This returns at once while the worker thread is busy, so that the polls continue.
            await self.check_connection()

    async def stream_signals(self) -> None:
        """Publish signals to subscribed clients until cancelled."""
        while True:
            is_session_running = self.state in (DaemonState.RUNNING, DaemonState.STOPPING)
            await asyncio.sleep(_SIGNALS_INTERVAL_S if is_session_running else POLL_INTERVAL_S)
            self._publish_signals()

    def _publish_signals(self) -> None:
        """Publish the rig's signals since the last call, if a client has subscribed to them."""
        if not self._signal_watchers:
            return
        served_series = self._series
        planned_series = (
            served_series.planned_series
            if served_series is not None and served_series.is_running
            else None
        )
        for signal_block in self._rig.signals():
            self._publish(
                signals_document(
                    signal_block,
                    self._profile.rig.rate_hz,
                    None
                    if planned_series is None
                    else planned_series.frequency_hz(signal_block.last_tick),
                )
            )

    async def close(self, reason: str) -> None:
        """End a running session safely, and disconnect the rig."""
        self._is_closing = True
        self.stop(reason)
        if self._task is not None:
            await asyncio.wait([self._task])
        if self._quick_looks is not None:
            self._quick_looks.close(_NO_QUICK_LOOK_REASON)
        await self._call_in_worker(self._rig.disconnect)
        if self.state is DaemonState.READY:
            self._state_machine.change_to(DaemonState.IDLE, reason)

    def set_page_address(self, page_address: str | None) -> None:
        """Store the address of the operator's page for the status; any thread may call this."""
        self._page_address = page_address

    def release_control(self, peer: Peer) -> None:
        """End the subscriptions and the control of a disconnected client; its sessions continue."""
        self._signal_watchers.discard(peer)
        if self.controller == peer:
            self.controller = None
            _log.info("control: released by %s", peer)

    async def execute(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Execute a request of a client, and return the reply.

        Raise `CommandError` if the request is refused or fails.
        """
        match request:
            case protocol.StatusRequest():
                return self.status()
            case protocol.WatchRequest():
                if request.signals:
                    self._signal_watchers.add(peer)
                return {}
            case protocol.PredictRequest():
                return await self._predict(request)
        _log.info("%s: requested by %s", request.command, peer)
        try:
            return await self._execute_command(request, peer)
        except CommandError as error:
            _log.warning("%s: refused: %s", request.command, error)
            raise

    async def _execute_command(self, request: protocol.AnyRequest, peer: Peer) -> Document:
        """Execute a request that may change the rig, and return the reply."""
        if request.is_controlling:
            self._take_control(peer)
            await self._await_first_connection(peer)
        if isinstance(request, protocol.StartRequest):
            return await self._start(request, peer)
        if isinstance(request, protocol.StopSessionRequest):
            return self.stop(f"stop requested by {peer}")
        if isinstance(request, protocol.CheckRequest):
            return await self._check_rig()
        if isinstance(request, protocol.TareRequest):
            return await self._measure("tare", self._rig.tare)
        if isinstance(request, protocol.ZeroRequest):
            return await self._measure("zero", self._rig.zero)
        return await self._reset()

    def status(self) -> Document:
        """Return the status of daemon, rig and session as a dictionary for JSON."""
        served_series = self._series
        if served_series is not None and served_series.session_key != self._polled_session:
            self.poll_status()  # the last status shows the counts of the previous session
        rig_status = self._rig_status if self._rig.connected else None
        return {
            "daemon": daemon_document(
                self._profile.name,
                str(self._session_folder),
                moving_target=self._announced_target.value,
                moves_hardware=self._announced_target is ActuationTarget.HARDWARE,
                target_description=describe_actuation_target(
                    self._profile.rig, self._announced_target
                ),
                uses_virtual_clock=self._uses_virtual_clock,
                with_live_view=self._with_live_view,
                page_address=self._page_address,
                calibration=self._rig.calibration,
                makes_quick_looks=self._quick_looks is not None,
                failed_checks=self._failed_checks,
                began_utc_ns=self._began_utc_ns,
            ),
            "state": self.state.value,
            "since_utc_ns": self._state_machine.since_utc_ns,
            "reason": self._state_machine.reason,
            "doing": self._current_command,
            "zero_lost": self._rig.zero_lost,
            "controller": peer_document(self.controller),
            "series": None if served_series is None else served_series.as_document(),
            "progress": self._progress_document(),
            "rig": None if rig_status is None else rig_document(rig_status, self._message_rates()),
            "last_check": self._last_check,
            "history": transition_documents(self._state_machine.history),
        }

    def stop(self, reason: str) -> Document:
        """Request the end of the running series; the reply states whether a series was running."""
        self._stop_count += 1
        series = self._series
        if series is None or not series.is_running:
            return {"stopping": False}
        if not series.stop_request.requested:
            series.stop_request.request()
            if self.state is DaemonState.RUNNING:
                self._state_machine.change_to(DaemonState.STOPPING, reason)
        return {"stopping": True}

    def poll_status(self) -> None:
        """Read the rig's status, and publish the progress of a running session."""
        self._polled_session = None if self._series is None else self._series.session_key
        self._rig_status = rig_status = self._rig.status()
        if rig_status is None:
            self._timed_message_counts.clear()
            return
        self._timed_message_counts.append(
            (time.monotonic(), {t.name: t.written for t in rig_status.topics})
        )
        progress_event = self._progress_document()
        if progress_event is not None:
            self._publish({"event": "progress", **progress_event})

    async def check_connection(self) -> None:
        """Check between sessions that the rig is still connected; enter a fault if it is not."""
        # The command `check` does not use the worker thread, so the rig is checked meanwhile.
        is_busy = self._current_command not in ("", "check")
        if (
            is_busy
            or not self._rig.connected
            or self.state not in (DaemonState.READY, DaemonState.FAULT)
        ):
            return
        try:
            await self._call_in_worker(self._rig.check_control_process)
        except RigError as error:
            if not self._is_closing and self.state is DaemonState.READY:
                self._state_machine.change_to(DaemonState.FAULT, str(error))

    # Commands

    def _take_control(self, peer: Peer) -> None:
        """Give a client the control of the rig; raise CommandError if another client has it."""
        if self.controller is not None and self.controller != peer:
            raise CommandError(
                f"The rig is controlled by {self.controller}, until it is done; watch with rigd "
                "status, and stop with rigd stop."
            )
        if self.controller is None:
            self.controller = peer
            _log.info("control: taken by %s", peer)

    async def _await_first_connection(self, peer: Peer) -> None:
        """Wait for the end of the first attempt to connect the rig, if it has not ended yet.

        Raises CommandError if a stop was requested, or the client was disconnected, meanwhile.
        """
        if self._current_command != "connecting":
            return
        previous_stop_count = self._stop_count
        await self._first_connection_tried.wait()
        if self._stop_count > previous_stop_count or self.controller != peer:
            raise CommandError(_STOPPED_MESSAGE)

    def _require_command_allowed(self, command: str) -> None:
        """Raise CommandError if the state forbids a command, or if the rig is busy."""
        if self._is_closing:
            raise CommandError(SHUTTING_DOWN_MESSAGE)
        refusal_text = self._state_machine.refusal_text(command)
        if refusal_text:
            raise CommandError(refusal_text)
        self._require_not_busy()

    def _require_not_busy(self) -> None:
        """Raise CommandError if the rig is executing another command."""
        if self._current_command:
            raise CommandError(f"The rig is busy ({self._current_command}); try again in a moment.")

    async def _predict(self, request: protocol.PredictRequest) -> Document:
        """Predict a session in a background process, so that other requests are not delayed."""
        if self._prediction_count >= _MAX_PREDICTIONS:
            raise CommandError("Several predictions are running; try again in a moment.")
        prediction_job = background.PredictionJob(
            self._profile,
            request.excitation,
            request.parameters,
            request.force,
            request.notes.specimen,
            self._start_angle_rad(),
            tuple(request.accept),
            request.tip_slope_rad,
        )
        self._prediction_count += 1
        try:
            async with self._prediction_lock:
                return await background.perform(prediction_job)
        finally:
            self._prediction_count -= 1

    async def _check_rig(self) -> Document:
        """Check the rig in a background process, and return the results, also for the status."""
        if self.state in (DaemonState.RUNNING, DaemonState.STOPPING):
            raise CommandError(
                "check needs a rig without a running session: wait for the session to end, or end "
                "it with rigd stop."
            )
        self._require_not_busy()
        self._current_command = "check"
        try:
            check_reply = await background.perform(
                background.CheckJob(self._profile, self._rig.calibration)
            )
        finally:
            self._current_command = ""
        self._last_check = {"utc_ns": time.time_ns(), "verdict": check_reply["verdict"]}
        return check_reply

    async def _start(self, request: protocol.StartRequest, peer: Peer) -> Document:
        """Plan a series of sessions, and start to run it; the reply contains the plan.

        Raises CommandError if a stop was requested, or the client was disconnected, meanwhile.
        """
        self._require_command_allowed("start")
        if self._rig.zero_lost:
            raise CommandError(
                "The zero of the angle was lost with the connection, and the limits with it; move "
                "the motor to mid-travel and run rigd zero."
            )
        self._series_count += 1
        previous_series = self._series
        served_series = self._series = ServedSeries(self._series_count, request, is_running=True)
        self._current_command = "planning"
        try:
            plan_job = background.PlanJob(
                self._profile, request, self._session_folder, self._start_angle_rad()
            )
            planned_series = await (
                background.perform(plan_job)
                if plan_job.is_heavy
                else self._call_in_worker(plan_job.perform)
            )
            await self._call_in_worker(self._rig.reset_session_counts)
            if served_series.stop_request.requested or self._is_closing or self.controller != peer:
                raise CommandError(_STOPPED_MESSAGE)
            refusal_text = self._state_machine.refusal_text("start")
            if refusal_text:
                raise CommandError(refusal_text)
        except Exception:
            self._series = previous_series
            raise
        finally:
            self._current_command = ""
        for plan_warning in planned_series.plan.warnings:
            _log.warning("series %d: %s", served_series.series_number, plan_warning)
        served_series.planned_series = planned_series
        repeat_text = f", {request.repeat} sessions" if request.repeat > 1 else ""
        self._state_machine.change_to(
            DaemonState.RUNNING, f"{served_series.description} was started{repeat_text}"
        )
        self._task = asyncio.create_task(self._run_series_to_end(served_series, planned_series))
        return {"series": served_series.series_number, "plan": planned_series.plan_document()}

    async def _measure(self, command_name: str, measure_rig: Callable[[], Document]) -> Document:
        """Tare the sensor or set the motor's zero in the worker thread, and return the result."""
        self._require_command_allowed(command_name)
        self._current_command = command_name
        try:
            return await self._call_in_worker(measure_rig)
        except RigError as error:
            if not self._rig.connected and self.state is DaemonState.READY:
                self._state_machine.change_to(DaemonState.FAULT, str(error))
            raise CommandError(str(error)) from None
        finally:
            self._current_command = ""

    async def _reset(self) -> Document:
        """Reset a fault, and connect the rig again if it is disconnected."""
        self._require_command_allowed("reset")
        self._current_command = "reset"
        try:
            if self._rig.connected:
                try:
                    await self._call_in_worker(self._rig.check_control_process)
                except RigError:
                    pass  # the rig was disconnected, and is connected again below
                else:
                    self._state_machine.change_to(DaemonState.READY, "reset by the operator")
                    return {"zero_lost": self._rig.zero_lost}
            if self._is_closing:
                raise CommandError(SHUTTING_DOWN_MESSAGE)
            fault_reason = self._fault_reason
            self._state_machine.change_to(DaemonState.IDLE, "reset by the operator")
            await self._connect(reset_fault=True, earlier_fault=fault_reason)
        finally:
            self._current_command = ""
        return {"zero_lost": self._rig.zero_lost}

    async def _connect(self, *, reset_fault: bool, earlier_fault: str = "") -> None:
        """Connect the rig, and enter the state ready, or a fault if that fails.

        `earlier_fault` is the reason of the fault that is being reset, or empty.
        """
        try:
            actuation_target = self._find_actuation_target()
            if actuation_target is not self._announced_target:
                raise RigError(
                    f"{actuation_target.value.capitalize()} would move now, but the daemon was "
                    f"started for {self._announced_target.value}; restart the daemon if that is "
                    "intended."
                )
            await self._call_in_worker(
                partial(self._rig.connect, actuation_target, reset_fault=reset_fault)
            )
        except RigError as error:
            self._enter_fault(str(error), earlier_fault)
            raise CommandError(str(error)) from None
        except Exception as error:
            _log.exception("unexpected error while the rig was being connected")
            await self._disconnect_safely()
            failure_reason = f"The rig could not be connected: unexpected error ({error!r})."
            self._enter_fault(failure_reason, earlier_fault)
            raise CommandError(failure_reason) from None
        if self._is_closing:
            await self._call_in_worker(self._rig.disconnect)
            raise CommandError(SHUTTING_DOWN_MESSAGE)
        self._state_machine.change_to(DaemonState.READY, f"{actuation_target.value} is connected")

    def _enter_fault(self, reason: str, earlier_fault: str) -> None:
        """Enter the state of fault for a reason.

        `earlier_fault` is the reason of an earlier fault that could not be reset, or empty.
        """
        is_same_fault = not earlier_fault or earlier_fault == reason
        self._state_machine.change_to(
            DaemonState.FAULT, reason if is_same_fault else f"{reason} Not reset: {earlier_fault}"
        )
        self._fault_reason = earlier_fault or reason

    # Series

    def _start_angle_rad(self) -> float:
        """Return the motor angle relative to the rig's zero in rad, or 0 if unknown."""
        rig_status = self._rig.status()
        return 0.0 if rig_status is None else rig_status.angle_rad

    async def _run_series_to_end(self, series: ServedSeries, planned_series: Series) -> None:
        """Run a series to its end in the worker thread, and enter the state that follows."""
        fault_reason = ""
        event_loop = asyncio.get_running_loop()
        try:
            await self._call_in_worker(
                partial(self._run_series, series, planned_series, event_loop)
            )
        except (UserError, RigError, ProbeFailedError, SessionFailedError) as error:
            series.end_reason = str(error)
            if isinstance(error, SessionFailedError):
                series.end_reason = f"{error} {remaining_file_text(error.path)}"
            if not error.wrong_use:
                fault_reason = series.end_reason
        except Exception as error:
            # After an unexpected error the rig is disconnected, because nothing else may switch it
            # off.
            _log.exception("unexpected error in a session")
            fault_reason = series.end_reason = f"The session failed: unexpected error ({error!r})."
            await self._disconnect_safely()
        else:
            last_result = series.session_results[-1] if series.session_results else None
            session_count = len(series.session_results)
            if last_result is not None and not last_result.is_successful:
                series.end_reason = last_result.reason
                if last_result.fault:
                    fault_reason = last_result.reason
                elif last_result.outcome == "stopped":
                    series.stop_request.request()  # a signal may have stopped the control process
            elif series.stop_request.requested and session_count < series.request.repeat:
                series.end_reason = (
                    f"Stopped after {session_count} of {series.request.repeat} sessions."
                    if session_count
                    else _STOPPED_MESSAGE
                )
        series.has_failed = bool(
            fault_reason or (series.end_reason and not series.stop_request.requested)
        )
        if not (self._rig.connected or self._is_closing or fault_reason):
            fault_reason = str(RigStoppedError())
        try:
            self._publish_signals()  # the last signals are sent before the report of the end
        except Exception:
            _log.exception("the last signals could not be sent")
        series.is_running = False
        self._state_machine.change_to(*series.state_after(fault_reason))
        self._publish({"event": "series", **series.as_document()})

    async def _disconnect_safely(self) -> None:
        """Disconnect the rig, and log an error instead of raising it."""
        try:
            await self._call_in_worker(self._rig.disconnect)
        except Exception:
            _log.exception("the rig could not be disconnected")

    def _run_series(
        self, series: ServedSeries, planned_series: Series, event_loop: asyncio.AbstractEventLoop
    ) -> None:
        """Run the sessions of a series one after another; called in the worker thread."""

        def publish(event: Document) -> None:
            event_loop.call_soon_threadsafe(self._publish, event)

        series_reporter = SeriesReporter(
            series, publish, self._can_receive_stop, self._rig.reset_session_counts
        )
        try:
            planned_series.run(
                self._rig,
                series.stop_request,
                series_reporter,
                with_live_view=self._with_live_view,
                can_receive_stop=self._can_receive_stop,
                quick_looks=self._quick_looks,
            )
        except SessionFailedError as error:
            series_reporter.on_result(error.result(), look_follows=False)
            raise

    def _can_receive_stop(self) -> bool:
        """Return whether the event loop can receive a stop; called in the worker thread.

        If it cannot, the worker stops the supervisor's heartbeat, and the session ends.
        """
        return time.monotonic() - self._last_poll_s < _UNRESPONSIVE_AFTER_S

    # Reports

    def _progress_document(self) -> Document | None:
        """Return the progress of the running session for JSON, or None if none is running."""
        series, rig_status = self._series, self._rig_status
        if (
            series is None
            or not series.is_running
            or series.planned_series is None
            or rig_status is None
        ):
            return None
        rate_hz = None if self._uses_virtual_clock else self._profile.rig.rate_hz
        progress_event = progress_document(rig_status, series.planned_series.record_ticks, rate_hz)
        return {"session": series.session_number, "repeat": series.request.repeat, **progress_event}

    def _message_rates(self) -> dict[str, float | None]:
        """Return the measured message rate of each topic, in messages per second."""
        if len(self._timed_message_counts) < 2:
            return {}
        (earlier_s, earlier_counts), (latest_s, latest_counts) = (
            self._timed_message_counts[0],
            self._timed_message_counts[-1],
        )
        return {
            topic_name: max(0, message_count - earlier_counts.get(topic_name, 0))
            / (latest_s - earlier_s)
            for topic_name, message_count in latest_counts.items()
        }

    def _report_transition(self, transition: Transition) -> None:
        """Log and publish a change of the daemon's state."""
        if transition.new_state is DaemonState.FAULT:
            self._fault_reason = transition.reason
        logging_level = logging.ERROR if transition.new_state is DaemonState.FAULT else logging.INFO
        _log.log(
            logging_level,
            "state: %s -> %s: %s",
            transition.old_state,
            transition.new_state,
            transition.reason,
        )
        self._publish({"event": "state", **transition_document(transition)})

    def _report_quick_look(self, quick_look: QuickLook) -> None:
        """Log and publish a quick look at a session; any thread may call this."""
        if self._series is not None:
            quick_look.add_path_to_results(self._series.session_results)
        for report_line in quick_look.lines:
            _log.info("%s", report_line)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(
                self._publish, {"event": "quick_look", **quick_look.as_dict()}
            )

    async def _call_in_worker(self, rig_function: Callable[[], ReturnType]) -> ReturnType:
        """Call a function in the worker thread, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._rig_executor, rig_function)
