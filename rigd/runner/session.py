"""One session in the processes of a rig, supervised from its start to its file.

The supervisor moves nothing itself. It has the file opened before the drive is enabled, permits
tick 0 when the recorder is ready, reports the progress, forwards a stop request, checks that every
process is running, and has the file closed with the outcome.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TypeVar

from rigd.engine import Observer
from rigd.engine.messages import (
    Armed,
    Close,
    Closed,
    Connected,
    Ended,
    Failed,
    Finished,
    Opened,
    Ready,
    RecorderJob,
    SessionJob,
)
from rigd.engine.processes import CONTROL, RECORDER, ChildError, Heartbeat
from rigd.engine.realtime import REFUSED
from rigd.engine.reference import is_whole, put_reference
from rigd.engine.shared_state import LogEvent, Phase, StateField, Stop, read_events
from rigd.errors import FailureError
from rigd.runner._live_view import LiveView
from rigd.runner._online_fit import FitSupervisor
from rigd.runner._process_group import ProcessGroup
from rigd.runner._touch_search import TouchEstimates
from rigd.runner.request import Order, another_path, file_header, part_of
from rigd.runtime import StopRequest

_POLL_S = 0.02
"""Longest delay of a message from another process to the operator."""
_PATIENCE_S = 5.0
_SLOW_PATIENCE_S = 30.0
"""Time for enabling or disabling a drive, which may be slow."""
_START_PATIENCE_S = 30.0
"""Time for a recorder to start on a busy computer; nothing moves yet."""
_MOST_NAMES = 100
_TORQUE_PHASES = (Phase.SETTLING, Phase.READY, Phase.RUNNING, Phase.RETURNING)

_COUNTED = {
    "scheduled": StateField.SCHEDULED,
    "missed": StateField.MISSED,
    "late": StateField.LATE,
    "stale_angles": StateField.STALE_ANGLES,
    "stale_wrenches": StateField.STALE_WRENCHES,
}
"""Counters of the control process in the shared state, by their names in the result."""
_NO_TICKS: Final[Mapping[str, int]] = MappingProxyType(dict.fromkeys(_COUNTED, 0))


class SessionFailedError(FailureError):
    """A session could not be run or closed; the message states the reason for the operator.

    Attributes
    ----------
    path
        File of the session, if one was begun.
    saved_path
        Path where the record was saved, if that is not the ``.part`` of the file.
    counts
        Known counts of ticks: ``scheduled``, ``missed``, ``late``,
        ``stale_angles``, ``stale_wrenches``.
    """

    path: Path | None = None
    saved_path: Path | None = None
    counts: Mapping[str, int] = _NO_TICKS
    hardware: bool | None = None

    def result(self) -> "RunResult":
        """Return the result of the session, after its processes have ended."""
        part, whole = self.saved_path, None
        if part is None and self.path is not None:
            try:
                if part_of(self.path).exists():
                    part = part_of(self.path)
                elif self.path.exists():
                    whole = self.path  # the recorder was only slow
            except OSError:
                part = part_of(self.path)  # the folder cannot be read
        return RunResult(
            path=whole,
            outcome="fault",
            reason=str(self),
            recorded=None,
            lost=None,
            fault=True,
            part=part,
            hardware=self.hardware,
            quick_look=None,
            touches=None,
            fit=None,
            **self.counts,
        )


class _NameTakenError(SessionFailedError):
    """A file of this name exists already."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a session."""

    path: Path | None
    """Path of the file; None if the session ended before tick 0 or the file is incomplete."""
    outcome: str
    """``complete``, ``stopped``, ``fault`` or ``unknown``."""
    reason: str
    """Why the session ended early, a sentence; empty if it is complete."""
    scheduled: int
    """Ticks that were due."""
    recorded: int | None
    """Samples in the file; None if this is unknown until the file is recovered."""
    missed: int
    """Ticks that the loop skipped."""
    late: int
    """Ticks that woke late."""
    lost: int | None
    """Samples that were taken but not recorded; None as for `recorded`."""
    fault: bool
    """Whether something failed during or after the record, even if a stop was requested."""
    stale_angles: int = 0
    """Recorded ticks with a stale angle."""
    stale_wrenches: int = 0
    """Recorded ticks with a stale wrench."""
    live_dropped: int = 0
    """Samples that the live view did not receive."""
    part: Path | None = None
    """Path of an incomplete file that could not be completed."""
    hardware: bool | None = None
    """Whether the hardware moved and nothing was simulated; None: not known."""
    quick_look: Path | None = None
    """Path of the quick look at the session; None: there is none yet."""
    touches: tuple[Mapping[str, Any], ...] | None = None
    """Touches in the order of their times; None if the session had no touch search."""
    fit: Mapping[str, Any] | None = None
    """Fit of the record during the session, as in JSON documents; None if not requested."""

    @property
    def went_well(self) -> bool:
        """Whether the session is complete, without any objection."""
        return self.outcome == "complete" and not self.reason

    def as_dict(self) -> dict[str, object]:
        """Return the result for JSON."""
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
    """Number of the last tick."""
    missed: int
    """Ticks missed so far."""
    late: int
    """Ticks that woke late so far."""
    fits: tuple[Mapping[str, Any], ...] = ()
    """Fits of the record since the last call, as in JSON documents."""


Watcher = Callable[[SessionProgress, list[LogEvent]], None]
T = TypeVar("T")


class SessionRun:
    """Run of one session; :meth:`run` may be called once.

    Parameters
    ----------
    order
        Session to run.
    group
        Processes of the rig; its control process is connected and idle.
    connected
        Message of the control process after its connection.
    live
        Live view to supervise, or None.
    watcher
        Called about fifty times a second with the progress and the events since the last call.
    listens
        Whether this process can receive a stop request. If it cannot, its heartbeat ends, so that
        the control process takes it for hung.

    Attributes
    ----------
    device_failed
        Whether a device failed, so that the control process has closed all devices.
    """

    def __init__(
        self,
        order: Order,
        group: ProcessGroup,
        connected: Connected,
        live: LiveView | None,
        watcher: Watcher,
        listens: Callable[[], bool],
    ) -> None:
        self._order = order
        self._group = group
        self._connected = connected
        self._live = live
        self._shared_state = group.channels.shared_state
        self._events = Observer(group.channels.events)
        self._watcher = watcher
        self._listens = listens
        self._virtual = connected.realtime["clock"] == "virtual"
        self._pulse = Heartbeat()
        self._recorder_lost: str | None = None
        self._control_at_work = False
        # The drive is off until it is enabled; afterwards only the control process can confirm it.
        self._drive_at_end = "The drive is disabled."
        self._opened: Path | None = None
        self._saved_path: Path | None = None
        self._touches: TouchEstimates | None = None
        self._fit: FitSupervisor | None = None
        self.device_failed = False

    def run(self, stop: StopRequest) -> RunResult:
        """Run the session to its end.

        Raises
        ------
        SessionFailedError
            If the file cannot be opened or written, or the recorder died or hangs.
        """
        stop.on_request = self._stop
        if stop.requested:
            self._stop()
        try:
            return self._run()
        except (ChildError, SessionFailedError) as error:
            self._recorder_lost = self._recorder_lost or str(error)
            if self._control_at_work:
                self._shared_state[StateField.STOP] = Stop.NO_RECORDER
                self._listen_to_control()
            failure = SessionFailedError(f"{self._recorder_lost} {self._drive_at_end}")
            failure.path, failure.saved_path = self._opened, self._saved_path
            failure.counts = self._counts()
            raise failure from None
        finally:
            stop.on_request = _nothing

    def _stop(self) -> None:
        self._shared_state[StateField.STOP] = Stop.OPERATOR

    def _run(self) -> RunResult:
        group, search = self._group, self._order.excitation.search
        try:
            reference = put_reference(
                group.channels.reference_fd,
                self._order.excitation.reference_rad,
                None if search is None else search.planned_ticks,
            )
        except OSError as error:
            raise SessionFailedError(
                f"No shared memory for a session this long ({error.strerror}); check the "
                "limits of open files (ulimit -n) and of shared memory (/dev/shm)."
            ) from None
        order = self._order
        profile = order.profile
        realtime = None if self._virtual else profile.realtime
        if order.touch is not None:
            self._touches = TouchEstimates(group, order.touch, profile.rig.rate_hz, realtime)
            self._touches.await_ready(self._reports)
        if search is not None or order.watch_fit:
            self._fit = FitSupervisor(group, profile, reference, search, realtime)
            lost = self._fit.await_ready(self._reports)
            if lost and search is not None:
                raise SessionFailedError(lost)
        self._open_file()
        order = self._order
        self._control_at_work = True
        touch = None if order.touch is None else order.touch.order
        job = SessionJob(
            order.profile,
            reference,
            self._refused_to_supervision(),
            order.ending,
            touch,
            order.seed,
            tuple(f"{each.name}: {each.text}" for each in order.accepted),
        )
        group.control.send(job)
        answer = self._listen_to_control()
        if isinstance(answer, Ready):
            header = file_header(order, self._connected, answer.tare)
            group.recorder.send(header)
            if self._fit is not None:
                self._fit.begin(header)
            self._ask_recorder(Armed)
            self._shared_state[StateField.GO] = 1
            answer = self._listen_to_control()
        if self._recorder_lost is not None:
            raise SessionFailedError(self._recorder_lost)
        assert isinstance(answer, Finished)
        return self._close(answer)

    def _reports(self) -> bool:
        """Report before any motion; return whether the session is still requested."""
        self._report()
        return self._shared_state[StateField.STOP] == Stop.NO

    def _open_file(self) -> None:
        """Have the file created, under another name if the chosen name is already taken."""
        group = self._group
        realtime = None if self._virtual else self._order.profile.realtime
        for _ in range(_MOST_NAMES):
            job = RecorderJob(self._order.path, group.channels.specs, realtime)
            group.fresh(RECORDER).start(job)
            try:
                opened = self._ask_recorder(Opened, _START_PATIENCE_S)
            except _NameTakenError as error:
                taken = error
                self._order = replace(self._order, path=another_path(self._order.path))
            else:
                self._opened = self._order.path
                granted = {f"recorder_{name}": text for name, text in opened.realtime.items()}
                before = self._connected.realtime
                self._connected = replace(self._connected, realtime={**before, **granted})
                return
        raise taken

    def _refused_to_supervision(self) -> dict[str, str]:
        """Return the real-time settings refused to supervisor and recorder, with the reasons."""
        return {
            name: text
            for name, text in self._connected.realtime.items()
            if name.startswith(("supervisor_", "recorder_")) and text.startswith(REFUSED)
        }

    def _listen_to_control(self) -> Ready | Finished:
        """Wait for the next message of the control process while supervising all processes."""
        deadline, phase = 0.0, -1
        while True:
            # An estimate of a touch is more urgent than a message of the control process.
            waited = self._touches is not None and self._touches.listen(_POLL_S)
            try:
                answer = self._group.control.poll(0.0 if waited else _POLL_S)
            except ChildError as error:
                return self._control_died(str(error))
            self._report()
            now_s = time.monotonic()
            # In lock-step with a simulated rig, a tick may wait for missing replies.
            torque = self._shared_state[StateField.PHASE] in _TORQUE_PHASES and not self._virtual
            if (
                self._shared_state[StateField.STOP] == Stop.NO
                or self._shared_state[StateField.PHASE] != phase
            ):
                phase = self._shared_state[StateField.PHASE]
                patience_s = _PATIENCE_S if torque else _SLOW_PATIENCE_S
                deadline = now_s + patience_s
            elif answer is None and now_s > deadline:
                return self._kill_control(f"did not stop within {patience_s:g} s")
            assert CONTROL.hung_after_s is not None
            hung_after_s = CONTROL.hung_after_s if torque else _SLOW_PATIENCE_S
            still_s = self._pulse.stalled_for(self._shared_state[StateField.CONTROL_BEAT], now_s)
            if answer is None and still_s > hung_after_s:
                return self._kill_control(f"hung for {hung_after_s:g} s (check CPU load)")
            if answer is not None:
                return self._understood(answer)
            if self._recorder_lost is None:
                self._recorder_lost = self._recorder_trouble()
                if self._recorder_lost is not None:
                    self._shared_state[StateField.STOP] = Stop.NO_RECORDER

    def _understood(self, answer: object) -> Ready | Finished:
        match answer:
            case Ended(reason):  # before the session began
                finished = self._control_died(reason)
                if reason:
                    return finished
                # A stop signal reached the control process between two sessions.
                return replace(
                    finished, outcome="stopped", reason="Stopped by the operator.", fault=False
                )
            case Finished():
                self._control_at_work = False
                if answer.device_failed:
                    self.device_failed = True
                    self._drive_at_end = answer.reason
                return answer
            case Ready():
                return answer
        raise SessionFailedError(f"The control process answers {answer}.")

    def _kill_control(self, why: str) -> Finished:
        """End a hung control process; the watchdog of the drive switches the torque off."""
        self._group.control.kill()
        return self._control_died(
            f"The control process {why} and was killed: without its heartbeat the drive switches "
            "itself off. Check that it is off."
        )

    def _control_died(self, reason: str) -> Finished:
        self._control_at_work = False
        self.device_failed = True
        self._drive_at_end = reason
        return self._as_finished(reason)

    def _as_finished(self, reason: str) -> Finished:
        """Construct the result of a dead control process from the shared state."""
        counts = self._counts()
        whole = is_whole(
            self._shared_state, counts["scheduled"], self._order.excitation.reference_rad.size
        )
        return Finished(
            outcome="complete" if whole else "fault",
            reason=f"After the record: {reason}" if whole else reason,
            fault=True,
            counts=counts,
        )

    def _counts(self) -> dict[str, int]:
        shared_state = self._shared_state
        # Before the record of this session the counters are those of the previous one.
        return {
            name: shared_state[word] if shared_state[StateField.GO] else 0
            for name, word in _COUNTED.items()
        }

    def _recorder_trouble(self) -> str | None:
        try:
            message = self._group.recorder.poll(0.0)
        except ChildError as error:
            return str(error)
        if isinstance(message, Failed):
            self._saved_path = message.saved_path
            return message.reason
        return None if message is None else str(message)

    def _ask_recorder(self, expected: type[T], patience_s: float = _PATIENCE_S) -> T:
        """Wait for an answer of the recorder while supervising: the motor may be held."""
        deadline = time.monotonic() + patience_s
        message = None
        while message is None and time.monotonic() < deadline:
            message = self._group.recorder.poll(_POLL_S)
            self._report()
        if message is None:
            raise SessionFailedError(
                f"The recorder process does not answer within {patience_s:g} s. Check CPU load and "
                "disk."
            )
        if isinstance(message, Failed):
            self._saved_path = message.saved_path
            raise (_NameTakenError if message.taken else SessionFailedError)(message.reason)
        if not isinstance(message, expected):
            raise SessionFailedError(f"The recorder process answers {message}.")
        return message

    def _report(self) -> None:
        shared_state = self._shared_state
        if self._listens():
            shared_state.beat(StateField.SUPERVISOR_BEAT)
        events = read_events(self._events.take(16))
        if self._live is not None:
            events += self._live.poll()
        if self._touches is not None:
            events += self._touches.poll()
            if self._live is not None:
                self._live.touched(self._touches.news())
        fits: Sequence[Mapping[str, Any]] = ()
        if self._fit is not None:
            events += self._fit.poll()
            fits = self._fit.news()
            if self._live is not None:
                self._live.fitted(fits)
        self._watcher(
            SessionProgress(
                Phase(shared_state[StateField.PHASE]),
                shared_state[StateField.SCHEDULED],
                shared_state[StateField.MISSED],
                shared_state[StateField.LATE],
                tuple(fits),
            ),
            events,
        )

    def _close(self, finished: Finished) -> RunResult:
        self._report()
        touches = None
        outcome = {
            "outcome": finished.outcome,
            "reason": finished.reason,
            **{name: str(count) for name, count in finished.counts.items()},
            **finished.results,
        }
        if self._touches is not None:
            touches = self._touches.finish(self._shared_state[StateField.TOUCHES], self._report)
            outcome["touches"] = json.dumps(touches)
            self._report()
        fit: dict[str, Any] | None = None
        segments: Mapping[str, tuple[int, int]] = {}
        if self._fit is not None:
            fit = self._fit.finish(finished.counts["scheduled"], self._report)
            segments = self._fit.segments
            self._report()
            outcome["fit"] = json.dumps(fit)
            if finished.outcome == "complete" and not finished.reason:
                outcome["reason"] = self._fit.shortcoming
            elif self._fit.failure:
                # This failure ends the session, even if a stop was requested before.
                outcome["reason"] = f"{self._fit.failure} {finished.reason}"
        self._group.recorder.wake()
        packed = b"" if self._touches is None else self._touches.packed()
        self._group.recorder.send(Close(outcome, packed, segments))
        # A disk may stall at the end of a record as long as during it.
        stall_s = self._order.profile.limits.recorder_lag_s
        closed = self._ask_recorder(Closed, stall_s + 2 * _PATIENCE_S)
        # The count of the recorder takes precedence.
        counts = {**_NO_TICKS, **finished.counts, **closed.counts}
        ended, reason = finished.outcome, outcome["reason"]
        if closed.path is not None:
            ended, reason = closed.outcome, closed.reason
        return RunResult(
            path=closed.path,
            outcome=ended,
            reason=reason,
            scheduled=counts["scheduled"],
            recorded=counts.get("recorded", 0),
            missed=counts["missed"],
            late=counts["late"],
            lost=counts.get("lost", 0),
            stale_angles=counts["stale_angles"],
            stale_wrenches=counts["stale_wrenches"],
            fault=finished.fault
            or ended == "fault"
            or (self._fit is not None and bool(self._fit.failure)),
            live_dropped=self._shared_state[StateField.LIVE_DROPPED],
            touches=None if touches is None else tuple(touches),
            fit=fit,
        )


def results_document(results: Sequence[RunResult]) -> dict[str, Any]:
    """Return the results of a series as a JSON document.

    Parameters
    ----------
    results
        Results of its sessions.
    """
    found = [result.touches for result in results if result.touches is not None]
    touches = {"touches": [touch for each in found for touch in each]} if found else {}
    return {"sessions": [result.as_dict() for result in results], **touches}


def always() -> bool:
    """Return True: a stop always arrives, because it is a signal."""
    return True


def _nothing() -> None:
    """Do nothing at a stop request between two sessions: its flag is enough."""
