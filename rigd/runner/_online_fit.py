"""Client of the fit process, which fits the record during a session."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rigd.engine.messages import (
    FileHeader,
    FitJob,
    FitReport,
    PlannedSegment,
    RecordEnded,
    SearchEnded,
)
from rigd.engine.shared_state import LogEvent, StateField
from rigd.engine.workers import FIT
from rigd.runner._precision_search import (
    TargetEstimate,
    estimates_text,
    target_estimates,
    targets_json,
)
from rigd.runner._worker_client import WorkerClient

if TYPE_CHECKING:
    from rigd.engine.reference import ReferenceSpec
    from rigd.excitation import PrecisionSearch
    from rigd.profile import Profile, RealtimeSettings
    from rigd.runner._process_group import ProcessGroup

_FINAL_FIT_TIMEOUT_S: Final = 60.0
"""Maximum time in seconds to wait for the fit of the whole record after the session."""
_STORED_FIT_KEYS: Final = (
    "tick", "duration_s", "whole", "problem", "doubt", "warnings", "findings", "type", "validity",
    "modes", "parameters",
)  # fmt: skip
"""Keys of the last estimate that are stored in the session file."""


class FitClient(WorkerClient):
    """Client that collects the estimates of one session's fit process.

    A session that lasts until a precision is reached ends with its last planned segment, after the
    fit process has ended the search or has failed. When the search has ended, `segments` contains
    the planned segments. `unmet_reason` states why the whole record does not have the requested
    precision, or why this is unknown; it is empty if the record has the precision.
    """

    worker = FIT

    def __init__(
        self,
        group: "ProcessGroup",
        profile: "Profile",
        reference: "ReferenceSpec",
        search: "PrecisionSearch | None",
        realtime: "RealtimeSettings | None" = None,
    ) -> None:
        super().__init__(group)
        self._shared_state = group.channels.shared_state
        self._search = search
        self._new_estimates: list[Mapping[str, Any]] = []
        self._planned_segments: list[Mapping[str, Any]] = []
        self._last_report: FitReport | None = None
        self._search_end: SearchEnded | None = None
        self._has_begun = False
        self.segments: Mapping[str, tuple[int, int]] = {}
        self.unmet_reason = ""
        first_sample_position = group.channels.samples.written_count
        self._start(
            FitJob(
                group.channels.specs, first_sample_position, profile, reference, search, realtime
            )
        )

    def begin_fits(self, header: FileHeader) -> None:
        """Send the header of the session file to the fit process before the record begins."""
        self._has_begun = True
        self._send(header)

    def take_new_estimates(self) -> list[Mapping[str, Any]]:
        """Return the estimates that were received since the last call."""
        estimates, self._new_estimates = self._new_estimates, []
        return estimates

    def finish(self, record_ticks: int, call_while_waiting: Callable[[], None]) -> dict[str, Any]:
        """Wait for the fit of the whole record; return the last estimate as a JSON dictionary.

        `record_ticks` is the length of the record. `call_while_waiting` is called repeatedly
        meanwhile.
        """
        self._send(RecordEnded(record_ticks))
        if self._has_begun and not self._await_results(
            lambda: self._is_done, _FINAL_FIT_TIMEOUT_S, call_while_waiting
        ):
            self._give_up("The fit of the whole record took too long.")
        last_estimate = {} if self._last_report is None else self._last_report.document
        fit_document = {key: last_estimate[key] for key in _STORED_FIT_KEYS if key in last_estimate}
        if self._search is not None:
            precision_targets = self._search.targets
            target_results = (
                target_estimates(fit_document, precision_targets) if "modes" in fit_document else []
            )
            is_precision_reached, self.unmet_reason = self._assess_precision(target_results)
            fit_document["search"] = {
                "asked": [str(target) for target in precision_targets],
                "targets": targets_json(target_results),
                "reached": is_precision_reached,
                "reason": self.unmet_reason or self._success_sentence,
                "pieces": self._planned_segments,
            }
        return fit_document

    @property
    def _end_reason(self) -> str:
        """Sentence that states why the search ended; empty if the operator stopped the session."""
        return self._search_end.reason if self._search_end is not None else self.failure

    @property
    def _success_sentence(self) -> str:
        """Sentence that states that the requested precision was reached."""
        if self._search_end is not None and self._search_end.reached:
            return self._search_end.reason
        return "Reached by the fit of the whole record."

    def _assess_precision(self, estimates: Sequence[TargetEstimate]) -> tuple[bool | None, str]:
        """Return whether the whole record has the requested precision, and the reason if not.

        The first value is None if the whole record was not fitted, whatever earlier estimates
        stated. The reason is empty if the precision was reached.
        """
        report, search_end = self._last_report, self._search_end
        was_reached_before = search_end is not None and search_end.reached
        unknown_reason = "" if report is None else str(report.document.get("problem") or "")
        if report is None or not report.final:
            unknown_reason = self.failure or (
                "A stop skipped the fit of the whole record."
                if self._has_begun
                else "The whole record was not fitted."
            )
        elif not unknown_reason and not estimates:
            unknown_reason = "Its fit has no modes."
        if unknown_reason:
            search_end_text = (
                "Reached during the session." if was_reached_before else self._end_reason
            )
            sentences = ["" if search_end_text == unknown_reason else search_end_text]
            sentences.append(
                f"Not known whether the whole record has the precision: {unknown_reason}"
            )
            sentences.append(f"Last estimate: {estimates_text(estimates)}." if estimates else "")
            return None, " ".join(filter(None, sentences))
        imprecise_estimates = [
            target_estimate for target_estimate in estimates if not target_estimate.std_ratio <= 1.0
        ]
        if not imprecise_estimates:
            return True, ""
        unmet_reason = self._end_reason
        if was_reached_before:
            unmet_reason = (
                self.failure or "Reached during the session, but not by the whole record."
            )
        return False, f"{unmet_reason} So far: {estimates_text(imprecise_estimates)}.".strip()

    @property
    def search_failure(self) -> str:
        """Sentence that states why the process failed during its search; empty if it did not."""
        return self.failure if self._is_searching else ""

    @property
    def _is_searching(self) -> bool:
        """Whether the process may still append a segment to the reference."""
        return self._search is not None and self._search_end is None

    def _process_message(self, message: object) -> None:
        """Process one message of the fit process."""
        match message:
            case FitReport(document, is_final):
                self._last_report, self._is_done = message, is_final
                self._new_estimates.append(document)
                self._events += [
                    LogEvent(0, "info", text_line, notable=True) for text_line in document["text"]
                ]
            case PlannedSegment(name, document):
                self._planned_segments.append({"name": name, **document})
                self._events.append(LogEvent(0, "info", f"Next: {name}."))
            case SearchEnded(_, reason, segments):
                self._search_end, self.segments = message, segments
                self._shared_state[StateField.LAST_SEGMENT] = 1
                self._events.append(LogEvent(0, "info", reason, notable=True))

    def _give_up(self, reason: str) -> None:
        """Give up the fit process; a session that it plans ends with the last planned segment."""
        super()._give_up(reason)
        if self._is_searching:
            self._shared_state[StateField.LAST_SEGMENT] = 1

    @property
    def _consequence(self) -> str:
        """Sentence that states how the session goes on without the fit process."""
        if self._is_searching:
            return "The session ends with what is planned."
        return super()._consequence
