"""Series of sessions that the daemon runs: its progress, and the reports on it."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rigd.daemon import _protocol as protocol
from rigd.daemon._log import NAME
from rigd.daemon._states import DaemonState, Document, fit_document
from rigd.engine.shared_state import LogEvent
from rigd.runner import RigError, Series, result_line
from rigd.runner.session import RunResult, SessionProgress
from rigd.runtime import StopRequest

_LOGGED = {
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}
"""Log level of each level of reported events."""

Publish = Callable[[Document], None]

_log = logging.getLogger(NAME)


@dataclass(slots=True)
class ServedSeries:
    """Sessions of one request, and their progress."""

    number: int
    request: protocol.StartRequest
    stop: StopRequest = field(default_factory=StopRequest)
    planned: Series | None = None
    session: int = 0
    """Number of the present session, from 1."""
    path: Path | None = None
    fit: Document | None = None
    """Last fit of that session's record."""
    results: list[RunResult] = field(default_factory=list)
    """Results of the sessions so far, including a failed one."""
    reason: str = ""
    """Reason for an early end."""
    running: bool = False
    failed: bool = False
    """Whether something failed, so that sessions are missing or incomplete."""

    @property
    def words(self) -> str:
        """Description for the operator."""
        return _WORDS.get(self.request.excitation, self.request.excitation)

    def as_document(self) -> Document:
        """Return the series and its progress as a JSON document."""
        return {
            "series": self.number,
            "excitation": self.request.excitation,
            "session": self.session,
            "repeat": self.request.repeat,
            "notes": self.request.notes.model_dump(exclude_defaults=True),
            "plan": None if self.planned is None else self.planned.plan_document(),
            "path": None if self.path is None else str(self.path),
            "running": self.running,
            "stopped": self.stop.requested,
            "failed": self.failed,
            "reason": self.reason,
            "fit": self.fit,
            # Without their fits, which would double the size of the document.
            "sessions": [replace(result, fit=None).as_dict() for result in self.results],
        }

    def state_after(self, fault: str) -> tuple[DaemonState, str]:
        """Return the state of the daemon after this series, and the reason.

        Parameters
        ----------
        fault
            Fault of the rig; empty if the rig is ready.
        """
        if fault:
            return DaemonState.FAULT, fault
        if self.stop.requested:
            return DaemonState.READY, f"{self.words} was stopped"
        if self.reason:
            return DaemonState.READY, self.reason
        return DaemonState.READY, f"{self.words} is complete"


_WORDS: Final = {
    "file": "session from a file",
    "modes": "session of narrow sweeps",
    "touch": "search for an obstacle",
    "until": "search for a precision",
}
"""Descriptions of excitations whose names do not explain themselves."""

_LEVELS: Final = {"complete": "info", "stopped": "warning"}
"""Event levels of the outcomes; ``error`` for all others."""


class SeriesReporter:
    """Reporter that stores, logs and publishes the events of a series, in the worker thread."""

    def __init__(self, series: ServedSeries, publish: Publish, listens: Callable[[], bool]) -> None:
        self._series = series
        self._publish = publish
        self._listens = listens

    def begins(self, number: int, path: Path) -> None:
        if not self._listens():
            raise RigError(
                "The daemon does not respond to requests: no further session is started."
            )
        self._series.session, self._series.path = number, path
        self._series.fit = None

    def says(self, level: str, text: str) -> None:
        self._report(level, text, notable=True)

    def shown(self, where: str) -> None:
        self._report("info", where)

    def update(self, progress: SessionProgress, events: list[LogEvent]) -> None:
        for event in events:
            if event.level in _LOGGED:
                self._report(event.level, event.message, notable=event.notable)
        for fit in progress.fits:
            self._report_fit(fit)

    def ended(self, result: RunResult, *, look_follows: bool) -> None:
        series = self._series
        series.results.append(result)
        fit = {}
        if result.fit is not None:
            # The result lacks temporary data, such as the text for the operator.
            series.fit = (series.fit or {}) | fit_document(result.fit)
            fit = {"fit": series.fit}
        line = result_line(result.as_dict())
        _log.log(
            logging.INFO if result.went_well else logging.WARNING,
            "series %d: session %d of %d, %s: %s",
            series.number,
            series.session,
            series.request.repeat,
            result.path or result.part or "no file",
            line,
        )
        # For event lists, with the text of the terminal.
        level = _LEVELS.get(result.outcome, "error")
        message = {"level": level, "text": line, "session": series.session}
        self._publish({"event": "message", **message})
        document = result.as_dict() | fit | {"look_follows": look_follows}
        self._publish({"event": "session", "number": series.session, **document})

    def _report(self, level: str, text: str, *, notable: bool = False) -> None:
        _log.log(_LOGGED[level], "series %d: %s", self._series.number, text)
        message = {"level": level, "text": text, "notable": notable}
        self._publish({"event": "message", **message})

    def _report_fit(self, fit: Mapping[str, Any]) -> None:
        document = self._series.fit = fit_document(fit)
        self._publish({"event": "fit", "session": self._series.session, **document})
