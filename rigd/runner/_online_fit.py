"""Fits of a running session: supervision of the fit process and use of its estimates."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rigd.engine.messages import (
    Failed,
    FileHeader,
    FitJob,
    FitReady,
    FitReport,
    PlannedSegment,
    RecordEnded,
    SearchEnded,
)
from rigd.engine.processes import FIT, ChildError, Heartbeat
from rigd.engine.shared_state import LogEvent, StateField, Stop
from rigd.runner._precision_search import TargetEstimate, in_words, target_estimates, targets_json
from rigd.runner._process_group import await_ready

if TYPE_CHECKING:
    from rigd.engine.reference import ReferenceSpec
    from rigd.excitation import PrecisionSearch
    from rigd.profile import Profile, RealtimeSettings
    from rigd.runner._process_group import ProcessGroup

_LAST_PATIENCE_S: Final = 60.0
"""Time for the fit of the whole record, with the torque off; a stop skips it."""
_STOP_PATIENCE_S: Final = 5.0
_POLL_S: Final = 0.05
_STORED_KEYS: Final = (
    "tick", "duration_s", "whole", "problem", "doubt", "warnings", "findings", "type", "validity",
    "modes", "parameters",
)  # fmt: skip
"""Keys of the last estimate that are stored in the file."""


class FitSupervisor:
    """Supervise the fit process of one session and collect its estimates.

    A session with a precision search ends with its last segment, when the process reports the end
    of the search or when the process is lost. `segments` holds the planned segments after the end
    of the search. `shortcoming` states why the whole record does not have the requested precision,
    or why this is not known; it is empty if the record has the precision.
    """

    def __init__(
        self,
        group: "ProcessGroup",
        profile: "Profile",
        reference: "ReferenceSpec",
        search: "PrecisionSearch | None",
        realtime: "RealtimeSettings | None" = None,
    ) -> None:
        self._group = group
        self._shared_state = group.channels.shared_state
        self._search = search
        self._events: list[LogEvent] = []
        self._news: list[Mapping[str, Any]] = []
        self._planned: list[Mapping[str, Any]] = []
        self._last_report: FitReport | None = None
        self._ended: SearchEnded | None = None
        self._ready = self._begun = False
        self._lost = ""
        self._skipped = ""
        self._pulse = Heartbeat()
        self.segments: Mapping[str, tuple[int, int]] = {}
        self.shortcoming = ""
        first = group.channels.samples.written
        job = FitJob(group.channels.specs, first, profile, reference, search, realtime)
        try:
            group.fresh(FIT).start(job)
        except ChildError as error:
            self._lose(str(error))

    def await_ready(self, meanwhile: Callable[[], bool]) -> str:
        """Wait until the process is ready; return why it is not, else an empty text."""
        late = await_ready(lambda: self._ready or bool(self._lost), self._listen, meanwhile)
        if late:
            self._lose(f"The fit process was {late}.")
        return self._lost

    def begin(self, header: FileHeader) -> None:
        """Send the header of the session file to the process, before the record begins."""
        self._begun = True
        self._send(header)

    def poll(self) -> list[LogEvent]:
        """Read the received messages, and return the events for the operator."""
        self._listen(0.0)
        if self._ready and not self._lost:
            self._feel_pulse()
        events, self._events = self._events, []
        return events

    def _feel_pulse(self) -> None:
        """End the process if it hangs."""
        assert FIT.hung_after_s is not None
        still_s = self._pulse.stalled_for(self._shared_state[StateField.FIT_BEAT], time.monotonic())
        if still_s > FIT.hung_after_s:
            self._group[FIT].kill()
            self._lose(f"The fit process hung for {FIT.hung_after_s:g} s and was ended.")

    def news(self) -> list[Mapping[str, Any]]:
        """Return the estimates received since the last call, for the live view."""
        news, self._news = self._news, []
        return news

    def finish(self, ticks: int, meanwhile: Callable[[], None]) -> dict[str, Any]:
        """Wait for the fit of the whole record of `ticks` ticks; return the result for JSON."""
        self._send(RecordEnded(ticks))
        begun_s = time.monotonic()
        while self._begun and not (
            self._lost or (self._last_report is not None and self._last_report.final)
        ):
            self._listen(_POLL_S)
            meanwhile()
            if (
                self._shared_state[StateField.STOP] != Stop.NO
                and time.monotonic() > begun_s + _STOP_PATIENCE_S
            ):
                self._skipped = "A stop skipped the fit of the whole record."
                break
            if time.monotonic() > begun_s + _LAST_PATIENCE_S:
                self._lose("The fit of the whole record took too long.")
        estimate = {} if self._last_report is None else self._last_report.document
        document = {key: estimate[key] for key in _STORED_KEYS if key in estimate}
        if self._search is not None:
            targets = self._search.targets
            found = target_estimates(document, targets) if "modes" in document else []
            reached, self.shortcoming = self._assess(found)
            document["search"] = {
                "asked": [str(target) for target in targets],
                "targets": targets_json(found),
                "reached": reached,
                "reason": self.shortcoming or self._success,
                "pieces": self._planned,
            }
        return document

    @property
    def _reason(self) -> str:
        """Reason for the end of the search as a sentence; empty if it was stopped."""
        return self._ended.reason if self._ended is not None else self._lost

    @property
    def _success(self) -> str:
        """Statement that the requested precision was reached, as a sentence."""
        if self._ended is not None and self._ended.reached:
            return self._ended.reason
        return "Reached by the fit of the whole record."

    def _assess(self, found: Sequence[TargetEstimate]) -> tuple[bool | None, str]:
        """Return whether the whole record has the requested precision, and the shortcoming.

        Without a fit of the whole record this is not known, whatever earlier estimates stated.
        """
        report, ended = self._last_report, self._ended
        on_the_way = ended is not None and ended.reached
        unknown = "" if report is None else str(report.document.get("problem") or "")
        if report is None or not report.final:
            unknown = self._lost or self._skipped or "The whole record was not fitted."
        elif not unknown and not found:
            unknown = "Its fit has no modes."
        if unknown:
            way = "Reached on the way." if on_the_way else self._reason
            parts = ["" if way == unknown else way]
            parts.append(f"Not known whether the whole record has the precision: {unknown}")
            parts.append(f"Last estimate: {in_words(found)}." if found else "")
            return None, " ".join(filter(None, parts))
        short = [each for each in found if not each.ratio <= 1.0]
        if not short:
            return True, ""
        reason = self._reason
        if on_the_way:
            reason = self._lost or "Reached on the way, but not by the whole record."
        return False, f"{reason} So far: {in_words(short)}.".strip()

    @property
    def failure(self) -> str:
        """Reason for a loss of the process before the end of its search; else empty."""
        return self._lost if self._search is not None and self._ended is None else ""

    def _send(self, message: object) -> None:
        if self._lost:
            return
        try:
            self._group[FIT].send(message)
        except ChildError as error:
            self._lose(str(error))

    def _listen(self, patience_s: float) -> None:
        if self._lost:
            return
        try:
            for message in self._group[FIT].messages(patience_s):
                self._take(message)
        except ChildError as error:
            self._lose(str(error))

    def _take(self, message: object) -> None:
        match message:
            case FitReady():
                self._ready = True
            case FitReport(document):
                self._last_report = message
                self._news.append(document)
                self._events += [
                    LogEvent(0, "info", line, notable=True) for line in document["text"]
                ]
            case PlannedSegment(name, document):
                self._planned.append({"name": name, **document})
                self._events.append(LogEvent(0, "info", f"Next: {name}."))
            case SearchEnded(_, reason, segments):
                self._ended, self.segments = message, segments
                self._shared_state[StateField.LAST_SEGMENT] = 1
                self._events.append(LogEvent(0, "info", reason, notable=True))
            case Failed(reason):
                self._lose(reason)

    def _lose(self, why: str) -> None:
        """Continue without the process; a planned reference ends with its last segment."""
        self._lost = why
        follows = "The session continues without fits."
        if self._search is not None and self._ended is None:
            self._shared_state[StateField.LAST_SEGMENT] = 1
            follows = "The session ends with what is planned."
        self._events.append(LogEvent(0, "warning", f"{why} {follows}"))
