"""Supervision of one session, from its start to the closed session file.

The supervisor moves nothing itself. It makes the recorder open the file before the drive is
enabled, permits tick 0 when the recorder is ready, reports the progress, forwards a stop request,
checks that every process is running, and makes the recorder close the file with the outcome.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TypeVar

from rigd.engine import RingObserver
from rigd.engine.messages import (
    CloseFile,
    ControlEnded,
    DevicesConnected,
    FileClosed,
    FileOpened,
    ProcessFailed,
    ReadyToRecord,
    RecorderJob,
    RecorderReady,
    SessionFinished,
    SessionJob,
)
from rigd.engine.processes import ChildError
from rigd.engine.realtime import REFUSED_PREFIX
from rigd.engine.reference import covers_reference, write_reference
from rigd.engine.shared_state import LogEvent, Phase, StateField, StopReason, read_events
from rigd.engine.workers import CONTROL, RECORDER
from rigd.errors import FailureError
from rigd.runner._live_view import LiveViewClient
from rigd.runner._online_fit import FitClient
from rigd.runner._process_group import ProcessGroup
from rigd.runner._touch_search import TouchClient
from rigd.runner.request import SessionOrder, file_header, next_free_path, part_path
from rigd.runtime import StopRequest

_POLL_INTERVAL_S = 0.02
"""Time in seconds between two checks of the other processes for messages and heartbeats."""
_REPLY_TIMEOUT_S = 5.0
"""Maximum time in seconds for a reply of the recorder, and for the control process to stop."""
_DRIVE_TIMEOUT_S = 30.0
"""Maximum time in seconds for enabling or disabling a drive, which may be slow."""
_RECORDER_START_TIMEOUT_S = 30.0
"""Maximum time in seconds for the recorder to start on a busy computer, before any motion."""
_MAX_FILE_NAME_ATTEMPTS = 100
"""Maximum number of names that are tried for a session file."""
_TORQUE_PHASES = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)

_COUNTER_FIELDS = {
    "scheduled": StateField.SCHEDULED_TICKS,
    "missed": StateField.MISSED_TICKS,
    "late": StateField.LATE_TICKS,
    "stale_angles": StateField.STALE_ANGLES,
    "stale_wrenches": StateField.STALE_WRENCHES,
}
"""Name of a tick count in the result → field of the shared state with the counter."""
_ZERO_COUNTS: Final[Mapping[str, int]] = MappingProxyType(dict.fromkeys(_COUNTER_FIELDS, 0))
WITHOUT_HEARTBEAT_TEXT: Final = (
    "Without its heartbeat, the watchdog of the drive must switch the torque off, which nothing "
    "confirms: press the wired stop (STO) before anybody approaches."
)
"""Sentence for the operator after the control process has ended and left the drive enabled."""


class SessionFailedError(FailureError):
    """Raised if a session could not be run, or if its file could not be closed.

    Attributes
    ----------
    path
        Path of the session file, or None if no file was begun.
    saved_path
        Path to which the record was saved, if that is not the ``.part`` file.
    counts
        Counts of ticks: ``scheduled``, ``missed``, ``late``, ``stale_angles``,
        ``stale_wrenches``.
    hardware
        Whether the hardware moved, or None if unknown.
    """

    path: Path | None = None
    saved_path: Path | None = None
    counts: Mapping[str, int] = _ZERO_COUNTS
    hardware: bool | None = None

    def result(self) -> "SessionResult":
        """Return the failed session's result; call this after its processes have ended."""
        partial_path, complete_path = self.saved_path, None
        if partial_path is None and self.path is not None:
            try:
                if part_path(self.path).exists():
                    partial_path = part_path(self.path)
                elif self.path.exists():
                    complete_path = self.path  # the recorder was only slow, and completed the file
            except OSError:
                partial_path = part_path(self.path)  # the folder cannot be read
        return SessionResult(
            path=complete_path,
            outcome="fault",
            reason=str(self),
            recorded=None,
            lost=None,
            fault=True,
            part=partial_path,
            hardware=self.hardware,
            quick_look=None,
            touches=None,
            fit=None,
            **self.counts,
        )


class _FileExistsError(SessionFailedError):
    """Raised if a file with the name of the session file exists already."""


@dataclass(frozen=True, slots=True)
class SessionResult:
    """Result of a session: how it ended, its file, and counts of ticks."""

    path: Path | None
    """Path of the session file; None if there is none or only the incomplete ``.part`` file."""
    outcome: str
    """How the session ended: ``complete``, ``stopped``, ``fault`` or ``unknown``."""
    reason: str
    """Sentence that states why the session ended early; empty if it is complete."""
    scheduled: int
    """Number of ticks that were due."""
    recorded: int | None
    """Number of samples in the file; None if it is unknown until the file is recovered."""
    missed: int
    """Number of ticks that the control loop missed."""
    late: int
    """Number of ticks for which the control loop woke up late."""
    lost: int | None
    """Number of samples that were measured but not recorded; None if it is unknown."""
    fault: bool
    """Whether something failed during or after the record, even if a stop was requested."""
    stale_angles: int = 0
    """Number of recorded ticks without a new angle."""
    stale_wrenches: int = 0
    """Number of recorded ticks without a new wrench."""
    live_dropped: int = 0
    """Number of samples that the live view did not receive."""
    part: Path | None = None
    """Path of the incomplete ``.part`` file, or None if the file was completed."""
    hardware: bool | None = None
    """Whether the session moved the hardware (not a simulated rig), or None if unknown."""
    quick_look: Path | None = None
    """Path of the quick look at the session, or None if it is not made yet."""
    touches: tuple[Mapping[str, Any], ...] | None = None
    """Estimated touches, ordered by time, or None if the session searched for no obstacle."""
    fit: Mapping[str, Any] | None = None
    """Result of the fit during the session, as in JSON documents; None if not requested."""

    @property
    def is_successful(self) -> bool:
        """Whether the session is complete and no reason for an early end is stated."""
        return self.outcome == "complete" and not self.reason

    def as_dict(self) -> dict[str, object]:
        """Return the session's result as a dictionary for JSON."""
        touches = {} if self.touches is None else {"touches": list(self.touches)}
        fit = {} if self.fit is None else {"fit": dict(self.fit)}
        return {
            "path": None if self.path is None else str(self.path),
            "part": None if self.part is None else str(self.part),
            "outcome": self.outcome,
            "reason": self.reason,
            "scheduled": self.scheduled,
            "recorded": self.recorded,
            "missed": self.missed,
            "late": self.late,
            "lost": self.lost,
            "stale_angles": self.stale_angles,
            "stale_wrenches": self.stale_wrenches,
            "hardware": self.hardware,
            "look": None if self.quick_look is None else str(self.quick_look),
            **touches,
            **fit,
        }


@dataclass(frozen=True, slots=True)
class SessionProgress:
    """Progress of a running session."""

    phase: Phase
    """Phase of the session."""
    tick: int
    """Number of ticks that were due so far."""
    missed: int
    """Number of ticks missed so far."""
    late: int
    """Number of ticks so far for which the control loop woke up late."""
    fits: tuple[Mapping[str, Any], ...] = ()
    """Fits of the record that were made since the last report, as in JSON documents."""


ProgressCallback = Callable[[SessionProgress, list[LogEvent]], None]
"""Callback for the progress of a session and its events since the last call."""
MessageType = TypeVar("MessageType")


class SessionSupervisor:
    """Supervisor of one session, whose :meth:`run` may be called only once.

    Parameters
    ----------
    session_order
        Session to run.
    group
        Processes of the rig. The control process must be connected to the devices and idle.
    connection
        Message that the control process sent after it had connected to the devices.
    live_view
        Live view that shows the session, or None.
    on_progress
        Called about fifty times a second with the progress and the events since the last call.
    can_receive_stop
        Function that returns whether this process can receive a stop request. If it returns False,
        the heartbeat stops, so that the control process treats this process as hung.

    Attributes
    ----------
    device_failed
        Whether a device failed, so that the control process has closed all devices.
    """

    def __init__(
        self,
        session_order: SessionOrder,
        group: ProcessGroup,
        connection: DevicesConnected,
        live_view: LiveViewClient | None,
        on_progress: ProgressCallback,
        can_receive_stop: Callable[[], bool],
    ) -> None:
        self._order = session_order
        self._group = group
        self._connection = connection
        self._live_view = live_view
        self._shared_state = group.channels.shared_state
        self._events = RingObserver(group.channels.events)
        self._on_progress = on_progress
        self._can_receive_stop = can_receive_stop
        self._is_virtual_clock = connection.realtime["clock"] == "virtual"
        self._recorder_failure: str | None = None
        self._is_control_busy = False
        # The drive is off until it is enabled; afterwards only the control process can confirm it.
        self._final_drive_state = "The drive is disabled."
        self._opened_path: Path | None = None
        self._saved_path: Path | None = None
        self._touches: TouchClient | None = None
        self._fit: FitClient | None = None
        self.device_failed = False

    def run(self, stop: StopRequest) -> SessionResult:
        """Run the session to its end, or until a stop is requested, and return its result.

        Raises
        ------
        SessionFailedError
            If the file cannot be opened or written, or if the recorder ended or hangs.
        """
        stop.on_request = self._request_stop
        if stop.requested:
            self._request_stop()
        try:
            return self._run()
        except (ChildError, SessionFailedError) as error:
            self._recorder_failure = self._recorder_failure or str(error)
            if self._is_control_busy:
                self._shared_state[StateField.STOP_REASON] = StopReason.NO_RECORDER
                self._await_control()
            failure_error = SessionFailedError(
                f"{self._recorder_failure} {self._final_drive_state}"
            )
            failure_error.path, failure_error.saved_path = self._opened_path, self._saved_path
            failure_error.counts = self._counts()
            raise failure_error from None
        finally:
            stop.on_request = _ignore_stop_request

    def _request_stop(self) -> None:
        """Request the control process to stop the session."""
        self._shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

    def _run(self) -> SessionResult:
        """Start the processes of the session, supervise them to the end, and close the file."""
        process_group, excitation = self._group, self._order.excitation
        try:
            reference_spec = write_reference(
                process_group.channels.reference_fd,
                excitation.reference_rad,
                excitation.planned_ticks,
            )
        except OSError as error:
            raise SessionFailedError(
                f"No shared memory for a session this long ({error.strerror}); check the "
                "limits of open files (ulimit -n) and of shared memory (/dev/shm)."
            ) from None
        session_order = self._order
        profile = session_order.profile
        realtime_settings = None if self._is_virtual_clock else profile.realtime
        if session_order.touch is not None:
            self._touches = TouchClient(
                process_group, session_order.touch, profile.rig.rate_hz, realtime_settings
            )
            self._touches.await_ready(self._report_and_check_stop)
        if session_order.makes_fits:
            self._fit = FitClient(
                process_group, profile, reference_spec, session_order.search, realtime_settings
            )
            failure_reason = self._fit.await_ready(self._report_and_check_stop)
            if failure_reason and excitation.ends_itself:
                raise SessionFailedError(failure_reason)
        self._open_file()
        session_order = self._order
        self._is_control_busy = True
        touch_order = None if session_order.touch is None else session_order.touch.order
        session_job = SessionJob(
            session_order.profile,
            reference_spec,
            self._refused_realtime_settings(),
            session_order.ending,
            touch_order,
            session_order.seed,
            tuple(
                f"{accepted_check.name}: {accepted_check.text}"
                for accepted_check in session_order.accepted_checks
            ),
        )
        process_group.control.send(session_job)
        control_message = self._await_control()
        if isinstance(control_message, ReadyToRecord):
            file_header_data = file_header(session_order, self._connection, control_message.tare)
            process_group.recorder.send(file_header_data)
            if self._fit is not None:
                self._fit.begin_fits(file_header_data)
            self._await_recorder(RecorderReady)
            self._shared_state[StateField.RECORD_MAY_START] = 1
            control_message = self._await_control()
        if self._recorder_failure is not None:
            raise SessionFailedError(self._recorder_failure)
        assert isinstance(control_message, SessionFinished)
        return self._close(control_message)

    def _report_and_check_stop(self) -> bool:
        """Report progress before any motion; return False if a stop is requested."""
        self._report_progress()
        return self._shared_state[StateField.STOP_REASON] == StopReason.NONE

    def _open_file(self) -> None:
        """Start the recorder, which creates the session file; change the name if it is used."""
        process_group = self._group
        realtime_settings = None if self._is_virtual_clock else self._order.profile.realtime
        for _ in range(_MAX_FILE_NAME_ATTEMPTS):
            recorder_job = RecorderJob(
                self._order.path, process_group.channels.specs, realtime_settings
            )
            process_group.idle_process(RECORDER).start(recorder_job)
            try:
                opened_reply = self._await_recorder(FileOpened, _RECORDER_START_TIMEOUT_S)
            except _FileExistsError as error:
                name_error = error
                self._order = replace(self._order, path=next_free_path(self._order.path))
            else:
                self._opened_path = self._order.path
                recorder_settings = {
                    f"recorder_{setting_name}": setting_text
                    for setting_name, setting_text in opened_reply.realtime.items()
                }
                previous_settings = self._connection.realtime
                self._connection = replace(
                    self._connection, realtime={**previous_settings, **recorder_settings}
                )
                return
        raise name_error

    def _refused_realtime_settings(self) -> dict[str, str]:
        """Return the real-time settings that the system refused: name → reason.

        Only settings of the supervisor and of the recorder are included.
        """
        return {
            setting_name: setting_text
            for setting_name, setting_text in self._connection.realtime.items()
            if setting_name.startswith(("supervisor_", "recorder_"))
            and setting_text.startswith(REFUSED_PREFIX)
        }

    def _await_control(self) -> ReadyToRecord | SessionFinished:
        """Supervise all processes until the control process sends a message; return the message.

        A hung control process is killed.
        """
        deadline_s, last_phase = 0.0, -1
        while True:
            # An estimate of a touch is more urgent than a message from the control process.
            has_waited = self._touches is not None and self._touches.process_messages(
                _POLL_INTERVAL_S
            )
            try:
                control_message = self._group.control.poll(0.0 if has_waited else _POLL_INTERVAL_S)
            except ChildError as error:
                return self._control_died(f"{error} {WITHOUT_HEARTBEAT_TEXT}")
            self._report_progress()
            now_s = time.monotonic()
            # In lock-step with a simulated rig, a tick may wait for missing replies.
            is_torque_on = (
                self._shared_state[StateField.PHASE] in _TORQUE_PHASES
                and not self._is_virtual_clock
            )
            if (
                self._shared_state[StateField.STOP_REASON] == StopReason.NONE
                or self._shared_state[StateField.PHASE] != last_phase
            ):
                last_phase = self._shared_state[StateField.PHASE]
                timeout_s = _REPLY_TIMEOUT_S if is_torque_on else _DRIVE_TIMEOUT_S
                deadline_s = now_s + timeout_s
            elif control_message is None and now_s > deadline_s:
                return self._kill_control(f"did not stop within {timeout_s:g} s")
            assert CONTROL.max_silence_s is not None
            max_silence_s = CONTROL.max_silence_s if is_torque_on else _DRIVE_TIMEOUT_S
            stalled_s = self._group.stalled_s(CONTROL)
            if control_message is None and stalled_s > max_silence_s:
                return self._kill_control(f"hung for {max_silence_s:g} s (check CPU load)")
            if control_message is not None:
                return self._checked_control_message(control_message)
            if self._recorder_failure is None:
                self._recorder_failure = self._recorder_failure_reason()
                if self._recorder_failure is not None:
                    self._shared_state[StateField.STOP_REASON] = StopReason.NO_RECORDER

    def _checked_control_message(self, control_message: object) -> ReadyToRecord | SessionFinished:
        """Return a message of the control process, with ``ControlEnded`` as the session's end."""
        match control_message:
            case ControlEnded(reason):  # before the session began
                session_end = self._control_died(reason)
                if reason:
                    return session_end
                # A stop signal reached the control process between two sessions.
                return replace(
                    session_end, outcome="stopped", reason="Stopped by the operator.", fault=False
                )
            case SessionFinished():
                self._is_control_busy = False
                if control_message.device_failed:
                    self.device_failed = True
                    self._final_drive_state = control_message.reason
                return control_message
            case ReadyToRecord():
                return control_message
        raise SessionFailedError(f"The control process answers {control_message}.")

    def _kill_control(self, failure_predicate: str) -> SessionFinished:
        """Kill a hung control process, and return the message that ends the session.

        The drive's watchdog then switches the torque off.
        """
        self._group.control.kill()
        return self._control_died(
            f"The control process {failure_predicate} and was killed. {WITHOUT_HEARTBEAT_TEXT}"
        )

    def _control_died(self, reason: str) -> SessionFinished:
        """Store that the control process has ended; return the message that ends the session."""
        self._is_control_busy = False
        self.device_failed = True
        self._final_drive_state = reason
        return self._finished_from_shared_state(reason)

    def _finished_from_shared_state(self, reason: str) -> SessionFinished:
        """Return the message that a dead control process would have sent at the session's end."""
        tick_counts = self._counts()
        is_complete = covers_reference(
            self._shared_state, tick_counts["scheduled"], self._order.excitation.reference_rad.size
        )
        return SessionFinished(
            outcome="complete" if is_complete else "fault",
            reason=f"After the record: {reason}" if is_complete else reason,
            fault=True,
            counts=tick_counts,
        )

    def _counts(self) -> dict[str, int]:
        """Return the tick counts of this session from shared memory, or zeros before tick 0."""
        shared_state = self._shared_state
        # Before the record of this session the counters are those of the previous one.
        return {
            count_name: shared_state[state_field]
            if shared_state[StateField.RECORD_MAY_START]
            else 0
            for count_name, state_field in _COUNTER_FIELDS.items()
        }

    def _recorder_failure_reason(self) -> str | None:
        """Return why the recorder failed, or None if it is running."""
        try:
            recorder_message = self._group.recorder.poll(0.0)
        except ChildError as error:
            return str(error)
        if isinstance(recorder_message, ProcessFailed):
            self._saved_path = recorder_message.saved_path
            return recorder_message.reason
        return None if recorder_message is None else str(recorder_message)

    def _await_recorder(
        self, reply_type: type[MessageType], timeout_s: float = _REPLY_TIMEOUT_S
    ) -> MessageType:
        """Wait for a message of a given type from the recorder, and return it.

        Progress is reported meanwhile, because the motor may be held. Raises SessionFailedError if
        the recorder fails or does not reply in time.
        """
        deadline_s = time.monotonic() + timeout_s
        recorder_message = None
        while recorder_message is None and time.monotonic() < deadline_s:
            recorder_message = self._group.recorder.poll(_POLL_INTERVAL_S)
            self._report_progress()
        if recorder_message is None:
            raise SessionFailedError(
                f"The recorder process does not answer within {timeout_s:g} s. Check CPU load and "
                "disk."
            )
        if isinstance(recorder_message, ProcessFailed):
            self._saved_path = recorder_message.saved_path
            raise (_FileExistsError if recorder_message.is_name_taken else SessionFailedError)(
                recorder_message.reason
            )
        if not isinstance(recorder_message, reply_type):
            raise SessionFailedError(f"The recorder process answers {recorder_message}.")
        return recorder_message

    def _report_progress(self) -> None:
        """Increment the supervisor's heartbeat, and report progress, events and fits."""
        shared_state = self._shared_state
        if self._can_receive_stop():
            shared_state.beat(StateField.SUPERVISOR_BEAT)
        new_events = read_events(self._events.take(16))
        if self._live_view is not None:
            new_events += self._live_view.poll()
        if self._touches is not None:
            new_events += self._touches.poll()
            if self._live_view is not None:
                self._live_view.show_touches(self._touches.take_new_estimates())
        new_fits: Sequence[Mapping[str, Any]] = ()
        if self._fit is not None:
            new_events += self._fit.poll()
            new_fits = self._fit.take_new_estimates()
            if self._live_view is not None:
                self._live_view.show_fits(new_fits)
        self._on_progress(
            SessionProgress(
                Phase(shared_state[StateField.PHASE]),
                shared_state[StateField.SCHEDULED_TICKS],
                shared_state[StateField.MISSED_TICKS],
                shared_state[StateField.LATE_TICKS],
                tuple(new_fits),
            ),
            new_events,
        )

    def _close(self, finished_message: SessionFinished) -> SessionResult:
        """Complete touches and fit, make the recorder close the file, and return the result."""
        self._report_progress()
        touch_documents = None
        outcome_record = {
            "outcome": finished_message.outcome,
            "reason": finished_message.reason,
            **{
                count_name: str(tick_count)
                for count_name, tick_count in finished_message.counts.items()
            },
            **finished_message.results,
        }
        if self._touches is not None:
            touch_documents = self._touches.finish(
                self._shared_state[StateField.TOUCHES], self._report_progress
            )
            outcome_record["touches"] = json.dumps(touch_documents)
            self._report_progress()
        fit_document: dict[str, Any] | None = None
        segment_ticks: Mapping[str, tuple[int, int]] = {}
        if self._fit is not None:
            fit_document = self._fit.finish(
                finished_message.counts["scheduled"], self._report_progress
            )
            segment_ticks = self._fit.segments
            self._report_progress()
            outcome_record["fit"] = json.dumps(fit_document)
            if finished_message.outcome == "complete" and not finished_message.reason:
                outcome_record["reason"] = self._fit.unmet_reason
            elif self._fit.search_failure:
                # This failure ends the session, even if a stop was requested before.
                outcome_record["reason"] = f"{self._fit.search_failure} {finished_message.reason}"
        self._group.recorder.resume()
        packed_touches = b"" if self._touches is None else self._touches.encoded_touches()
        self._group.recorder.send(CloseFile(outcome_record, packed_touches, segment_ticks))
        # A disk may stall for as long at the end of a record as during the record.
        max_recorder_lag_s = self._order.profile.limits.recorder_lag_s
        closed_reply = self._await_recorder(FileClosed, max_recorder_lag_s + 2 * _REPLY_TIMEOUT_S)
        # The recorder's counts take precedence over those of the control process.
        tick_counts = {**_ZERO_COUNTS, **finished_message.counts, **closed_reply.counts}
        outcome_text, end_reason = finished_message.outcome, outcome_record["reason"]
        if closed_reply.path is not None:
            outcome_text, end_reason = closed_reply.outcome, closed_reply.reason
        return SessionResult(
            path=closed_reply.path,
            outcome=outcome_text,
            reason=end_reason,
            scheduled=tick_counts["scheduled"],
            recorded=tick_counts.get("recorded", 0),
            missed=tick_counts["missed"],
            late=tick_counts["late"],
            lost=tick_counts.get("lost", 0),
            stale_angles=tick_counts["stale_angles"],
            stale_wrenches=tick_counts["stale_wrenches"],
            fault=finished_message.fault
            or outcome_text == "fault"
            or (self._fit is not None and bool(self._fit.search_failure)),
            live_dropped=self._shared_state[StateField.LIVE_SAMPLES_DROPPED],
            touches=None if touch_documents is None else tuple(touch_documents),
            fit=fit_document,
        )


def results_document(results: Sequence[SessionResult]) -> dict[str, Any]:
    """Return the results of a series of sessions as a dictionary for JSON.

    Parameters
    ----------
    results
        Results of the sessions.
    """
    touch_lists = [run_result.touches for run_result in results if run_result.touches is not None]
    touches_entry = (
        {"touches": [touch for session_touches in touch_lists for touch in session_touches]}
        if touch_lists
        else {}
    )
    return {"sessions": [run_result.as_dict() for run_result in results], **touches_entry}


def can_always_receive_stop() -> bool:
    """Return True: a process that is stopped by signals can always receive a stop request."""
    return True


def _ignore_stop_request() -> None:
    """Do nothing when a stop is requested between two sessions; the request is read later."""
