"""Client of a worker process that a session uses but does not depend on."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Final

from rigd.engine.messages import ProcessFailed
from rigd.engine.processes import ChildError
from rigd.engine.shared_state import Level, LogEvent, StateField, StopReason

if TYPE_CHECKING:
    from rigd.engine.workers import Worker
    from rigd.runner._process_group import ProcessGroup

_POLL_INTERVAL_S: Final = 0.05
"""Maximum time in seconds of a single wait for a message."""
_STOPPED_RESULTS_TIMEOUT_S: Final = 5.0
"""Maximum time in seconds to wait for the results after the record if a stop is requested."""


class WorkerClient(ABC):
    """Client of a worker process; if the process is lost, the session continues without it.

    A subclass names the worker, sends its job with `_start`, and processes its messages.

    Attributes
    ----------
    worker
        Description of the process.
    failure
        Sentence that states why the process was lost; empty while the process is in use.
    """

    worker: ClassVar["Worker"]

    def __init__(self, group: "ProcessGroup") -> None:
        self.failure = ""
        self._group = group
        self._is_ready = self._is_done = False
        self._restart_count = 0
        self._events: list[LogEvent] = []

    @abstractmethod
    def _process_message(self, message: object) -> None:
        """Process one message of the worker."""

    def await_ready(self, call_while_waiting: Callable[[], bool]) -> str:
        """Wait until the worker is ready; return why it is not, or an empty text.

        The wait ends early if `call_while_waiting`, which is called repeatedly, returns False.
        """
        start_timeout_s = self.worker.start_timeout_s
        if not self._wait(lambda: self._is_ready, start_timeout_s, call_while_waiting):
            self._restart_or_give_up(
                f"The {self.worker.name} process was not ready within {start_timeout_s:g} s."
            )
        return self.failure

    def poll(self) -> list[LogEvent]:
        """Process the received messages, and return the new events for the operator."""
        self.check_heartbeat()
        events, self._events = self._events, []
        return events

    def check_heartbeat(self) -> None:
        """Process the received messages; restart a hung worker, or give it up."""
        if self.process_messages(0.0) and self.worker.max_silence_s is not None:
            silence_limit_s = (
                self.worker.max_silence_s if self._is_ready else self.worker.start_timeout_s
            )
            if self._group.stalled_s(self.worker) > silence_limit_s:
                self._group[self.worker].kill()
                self._restart_or_give_up(
                    f"The {self.worker.name} process was killed: no response for "
                    f"{silence_limit_s:g} s."
                )

    def process_messages(self, timeout_s: float) -> bool:
        """Process messages, waiting up to `timeout_s`; return whether the worker is in use."""
        if not (self.failure or self._is_done):
            try:
                for message in self._group[self.worker].messages(timeout_s):
                    self._is_ready |= type(message).__name__ == self.worker.sent_messages[0]
                    if isinstance(message, ProcessFailed):
                        self._process_failure(message.reason)
                    else:
                        self._process_message(message)
                    if self._is_done:  # the worker may end now
                        break
            except ChildError as error:
                self._restart_or_give_up(str(error))
        return not (self.failure or self._is_done)

    def _start(self, *messages: object) -> None:
        """Send messages, such as the job, to a new process or to one that has no job yet."""
        self.failure, self._is_ready = "", False
        try:
            self._group.idle_process(self.worker)
        except ChildError as error:
            self._process_failure(str(error))
        for message in messages:
            self._send(message)

    def _send(self, message: object) -> None:
        """Send a message to the worker, unless it is lost."""
        if not self.failure:
            try:
                self._group[self.worker].send(message)
            except ChildError as error:
                self._restart_or_give_up(str(error))

    def _wait(
        self,
        is_condition_met: Callable[[], bool],
        timeout_s: float,
        call_while_waiting: Callable[[], bool | None],
    ) -> bool:
        """Process messages until a condition is met or the worker is lost; False on a timeout.

        The wait ends early if `call_while_waiting`, which is called repeatedly, returns False.
        """
        deadline_s = time.monotonic() + timeout_s
        while not (is_condition_met() or self.failure):
            self.process_messages(_POLL_INTERVAL_S)
            if call_while_waiting() is False:
                break
            if time.monotonic() > deadline_s:
                return is_condition_met() or bool(self.failure)
        return True

    def _await_results(
        self,
        are_complete: Callable[[], bool],
        timeout_s: float,
        call_while_waiting: Callable[[], None],
    ) -> bool:
        """Wait for the results after the record, after a stop for 5 s only; False on a timeout."""
        stop_deadline_s = time.monotonic() + _STOPPED_RESULTS_TIMEOUT_S

        def is_worth_waiting() -> bool:
            call_while_waiting()
            return not self._is_stop_requested or time.monotonic() <= stop_deadline_s

        return self._wait(are_complete, timeout_s, is_worth_waiting)

    @property
    def _is_stop_requested(self) -> bool:
        """Whether a stop of the session is requested."""
        shared_state = self._group.channels.shared_state
        return shared_state[StateField.STOP_REASON] != StopReason.NONE

    def _restart_or_give_up(self, reason: str) -> None:
        """Restart the lost process, or give it up if its number of restarts is used up."""
        self._restart_count += 1
        if self._restart_count > self.worker.restarts:
            self._give_up(reason)
            return
        self._add_event("warning", f"{reason} It is restarted; the session continues.")
        self._group[self.worker].kill()
        self._restart()

    def _restart(self) -> None:
        """Start the process again with its job."""
        raise NotImplementedError  # unless the table permits restarts

    def _process_failure(self, reason: str) -> None:
        """Continue without a worker that cannot be started or that reports its own failure."""
        self._give_up(reason)

    def _give_up(self, reason: str) -> None:
        """Continue without the worker, and add an event that states why, and the consequence."""
        self.failure = reason
        self._add_event("warning", f"{reason} {self._consequence}")

    @property
    def _consequence(self) -> str:
        """Sentence that states how the session goes on without the worker."""
        return self.worker.consequence

    def _add_event(self, level: Level, message: str) -> None:
        """Add an event for the operator."""
        self._events.append(LogEvent(0, level, message))
