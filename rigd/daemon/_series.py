"""Series of sessions that the daemon runs: how far one has come, and who is told of it."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rigd.daemon import _protocol as protocol
from rigd.daemon._log import NAME
from rigd.daemon._states import DaemonState, Document, fit_document
from rigd.engine.shared_state import Event
from rigd.runner import RigError, Series, result_line
from rigd.runner.session import SessionProgress, SessionResult
from rigd.runtime import StopRequest

_LOGGED = {
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}
"""Levels of events that are told, and as what they are logged."""

Publish = Callable[[Document], None]

_log = logging.getLogger(NAME)


@dataclass(slots=True)
class ServedSeries:
    """Sessions that one request asked for, and how far they came."""

    number: int
    request: protocol.StartRequest
    stop: StopRequest = field(default_factory=StopRequest)
    planned: Series | None = None
    session: int = 0
    """The one that is run, from 1 on."""
    path: Path | None = None
    fit: Document | None = None
    """The last one of the record of that session."""
    results: list[SessionResult] = field(default_factory=list)
    """Also of one that failed."""
    reason: str = ""
    """Why it ended before its time."""
    running: bool = False
    failed: bool = False
    """Something went wrong: the sessions are fewer, or not what was asked for."""

    @property
    def words(self) -> str:
        """What runs, for the operator."""
        return _WORDS.get(self.request.excitation, self.request.excitation)

    def as_document(self) -> Document:
        """Tell what it is and how far it came."""
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
            # Without their fits, each of which is as long as everything else together.
            "sessions": [replace(result, fit=None).as_dict() for result in self.results],
        }

    def state_after(self, fault: str) -> tuple[DaemonState, str]:
        """Return the state of the daemon after this series, and the reason.

        Parameters
        ----------
        fault
            What put the rig out of work; empty if it may go on.
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
"""Excitations whose name is no word for what runs."""

_LEVELS: Final = {"complete": "info", "stopped": "warning"}
"""Levels of events that tell how a session ended."""


class SeriesTeller:
    """Notes, logs and publishes what becomes of a series; called in the second thread."""

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
        self._tell(level, text, notable=True)

    def shown(self, where: str) -> None:
        self._tell("info", where)

    def update(self, progress: SessionProgress, events: list[Event]) -> None:
        for event in events:
            if event.level in _LOGGED:
                self._tell(event.level, event.message, notable=event.notable)
        for fit in progress.fits:
            self._tell_fit(fit)

    def ended(self, result: SessionResult, *, look_follows: bool) -> None:
        series = self._series
        series.results.append(result)
        fit = {}
        if result.fit is not None:
            # What is for the moment, such as the lines for people, is not in the result.
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
        # For lists of events, in the words of the terminal.
        level = _LEVELS.get(result.outcome, "error")
        message = {"level": level, "text": line, "session": series.session}
        self._publish({"event": "message", **message})
        document = result.as_dict() | fit | {"look_follows": look_follows}
        self._publish({"event": "session", "number": series.session, **document})

    def _tell(self, level: str, text: str, *, notable: bool = False) -> None:
        _log.log(_LOGGED[level], "series %d: %s", self._series.number, text)
        told = {"level": level, "text": text, "notable": notable}
        self._publish({"event": "message", **told})

    def _tell_fit(self, fit: Mapping[str, Any]) -> None:
        document = self._series.fit = fit_document(fit)
        self._publish({"event": "fit", "session": self._series.session, **document})
