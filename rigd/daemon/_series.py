"""Series of sessions that the daemon runs: its progress, and reports on it to log and clients."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rigd.daemon import _protocol as protocol
from rigd.daemon._log import LOGGER_NAME
from rigd.daemon._states import DaemonState, Document, fit_document
from rigd.engine.shared_state import LogEvent
from rigd.runner import RigError, Series, result_line
from rigd.runner.session import SessionProgress, SessionResult
from rigd.runtime import StopRequest

_LOGGING_LEVELS = {
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}
"""Level of an event → level with which the event is logged."""

PublishEvent = Callable[[Document], None]
"""Function that sends an event to the clients that have subscribed."""

_log = logging.getLogger(LOGGER_NAME)


@dataclass(slots=True)
class ServedSeries:
    """Series of sessions that a client requested, and its progress."""

    series_number: int
    """Number of the series since the daemon was started."""
    request: protocol.StartRequest
    """Request of the client."""
    stop_request: StopRequest = field(default_factory=StopRequest)
    """Flag that states whether a stop of the series was requested."""
    planned_series: Series | None = None
    """Planned series, or None before the planning is complete."""
    session_number: int = 0
    """Number of the present session, from 1."""
    session_path: Path | None = None
    """Path of the present session's file."""
    last_fit: Document | None = None
    """Last fit of the present session's record."""
    session_results: list[SessionResult] = field(default_factory=list)
    """Results of the sessions so far, including a failed session."""
    end_reason: str = ""
    """Sentence that states why the series ended early; empty if it did not."""
    is_running: bool = False
    """Whether the series is being planned or run."""
    has_failed: bool = False
    """Whether the series failed, so that sessions are missing or incomplete."""

    @property
    def session_key(self) -> tuple[int, int]:
        """Numbers of the series and of its present session, which identify the session."""
        return self.series_number, self.session_number

    @property
    def description(self) -> str:
        """Description of the series' sessions for the operator, such as "chirp"."""
        return _EXCITATION_DESCRIPTIONS.get(self.request.excitation, self.request.excitation)

    def as_document(self) -> Document:
        """Return the series and its progress as a dictionary for JSON."""
        return {
            "series": self.series_number,
            "excitation": self.request.excitation,
            "session": self.session_number,
            "repeat": self.request.repeat,
            "notes": self.request.notes.model_dump(exclude_defaults=True),
            "plan": None if self.planned_series is None else self.planned_series.plan_document(),
            "path": None if self.session_path is None else str(self.session_path),
            "running": self.is_running,
            "stopped": self.stop_request.requested,
            "failed": self.has_failed,
            "reason": self.end_reason,
            "fit": self.last_fit,
            # The fits are left out, because they would double the size of the document.
            "sessions": [replace(result, fit=None).as_dict() for result in self.session_results],
        }

    def state_after(self, fault_reason: str) -> tuple[DaemonState, str]:
        """Return the state of the daemon after the end of this series, and the reason.

        `fault_reason` is empty if the rig is ready.
        """
        if fault_reason:
            return DaemonState.FAULT, fault_reason
        if self.stop_request.requested:
            return DaemonState.READY, f"{self.description} was stopped"
        if self.end_reason:
            return DaemonState.READY, self.end_reason
        return DaemonState.READY, f"{self.description} is complete"


_EXCITATION_DESCRIPTIONS: Final = {
    "file": "session from a file",
    "modes": "session of narrow sweeps",
    "touch": "search for an obstacle",
    "until": "search for a precision",
}
"""Kind of excitation → description for the operator, if the name alone is unclear."""

_OUTCOME_LEVELS: Final = {"complete": "info", "stopped": "warning"}
"""Outcome of a session → level of the event that reports it; ``error`` for other outcomes."""


class SeriesReporter:
    """Observer of a running series, which stores, logs and publishes the progress to clients.

    Its methods are called in the worker thread.
    """

    def __init__(
        self,
        series: ServedSeries,
        publish: PublishEvent,
        can_receive_stop: Callable[[], bool],
        reset_session_counts: Callable[[], None],
    ) -> None:
        self._series = series
        self._publish = publish
        self._can_receive_stop = can_receive_stop
        self._reset_session_counts = reset_session_counts

    def on_start(self, session_number: int, session_path: Path) -> None:
        if not self._can_receive_stop():
            raise RigError(
                "The daemon does not respond to requests: no further session is started."
            )
        self._reset_session_counts()  # first: a status with this number is of this session
        self._series.session_number, self._series.session_path = session_number, session_path
        self._series.last_fit = None

    def on_message(self, level: str, message_text: str) -> None:
        self._report(level, message_text, is_notable=True)

    def on_live_view(self, live_view_text: str) -> None:
        self._report("info", live_view_text)

    def on_progress(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        for event in events:
            if event.level in _LOGGING_LEVELS:
                self._report(event.level, event.message, is_notable=event.notable)
        for fit in progress.fits:
            self._report_fit(fit)

    def on_result(self, result: SessionResult, *, look_follows: bool) -> None:
        series = self._series
        series.session_results.append(result)
        fit_entry = {}
        if result.fit is not None:
            # The result's fit lacks temporary data, such as the text for the operator.
            series.last_fit = (series.last_fit or {}) | fit_document(result.fit)
            fit_entry = {"fit": series.last_fit}
        outcome_line = result_line(result.as_dict())
        _log.log(
            logging.INFO if result.is_successful else logging.WARNING,
            "series %d: session %d of %d, %s: %s",
            series.series_number,
            series.session_number,
            series.request.repeat,
            result.path or result.part or "no file",
            outcome_line,
        )
        # This event has the text of the terminal, for clients that list events.
        event_level = _OUTCOME_LEVELS.get(result.outcome, "error")
        log_message = {"level": event_level, "text": outcome_line, "session": series.session_number}
        self._publish({"event": "message", **log_message})
        result_document = result.as_dict() | fit_entry | {"look_follows": look_follows}
        self._publish({"event": "session", "number": series.session_number, **result_document})

    def _report(self, event_level: str, message_text: str, *, is_notable: bool = False) -> None:
        """Log a message on the series, and publish it as an event."""
        _log.log(
            _LOGGING_LEVELS[event_level], "series %d: %s", self._series.series_number, message_text
        )
        log_message = {"level": event_level, "text": message_text, "notable": is_notable}
        self._publish({"event": "message", **log_message})

    def _report_fit(self, fit: Mapping[str, Any]) -> None:
        """Store a fit of the present record, and publish it as an event."""
        published_fit = self._series.last_fit = fit_document(fit)
        self._publish({"event": "fit", "session": self._series.session_number, **published_fit})
