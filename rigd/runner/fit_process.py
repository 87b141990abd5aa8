"""The fit process, which fits the record of a running session and plans the next excitation.

The process reads the ring buffer of samples like the live publisher, so that it neither delays the
control loop nor takes samples from the recorder. The analyser's `OnlineEstimator` makes the
estimates in a thread, so that samples are read meanwhile. The estimates are sent to the supervisor.
If the session lasts until a precision is reached, each estimate is also used to plan the next
segment of the reference (`ExcitationPlanner`).
"""

import json
import os
import pkgutil
import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rigd.engine import RingObserver
from rigd.engine.channels import Channels, attach_channels
from rigd.engine.messages import FileHeader, FitJob, FitReady, FitReport, ProcessFailed, RecordEnded
from rigd.engine.processes import SupervisorConnection
from rigd.engine.realtime import pin_off_loop_core
from rigd.engine.reference import ReferenceWriter
from rigd.engine.shared_state import StateField
from rigd.engine.workers import ONLINE_ESTIMATOR
from rigd.runner._precision_search import ExcitationPlanner
from rigd.runtime import ignore_end_signals as ignore_signals
from rigd.session.layout import decode_samples
from rigd.session.online_fit import estimate_lines

_MAX_BLOCK_SAMPLES: Final = 500
"""Maximum number of samples that are read from the ring at once."""
_IDLE_WAIT_S: Final = 0.005
"""Time in seconds to wait for a message if there are no new samples."""
_FIT_INTERVAL_S: Final = 1.0
"""Time in seconds between two fits of a session whose excitation is planned before its start."""
_PERIODIC_NICENESS: Final = 19
"""Niceness of the thread that makes estimates at intervals, for which nobody waits. With SCHED_IDLE
instead, the thread could hold the interpreter lock while a busy computer does not run it."""
_TICK_AFTER_ALL_SAMPLES: Final = 1 << 32
"""Tick after the last tick of any session, to request an estimate from all samples."""
_FIRST_REQUEST_ID: Final = 1_000_000_000
"""First identification number of requested estimates; periodic estimates are numbered from 0."""


class EstimationError(Exception):
    """Raised if the analyser's estimator has failed; the message states the reason."""


@dataclass(frozen=True, slots=True)
class EstimateRequest:
    """Request to estimate the beam's parameters from the samples read so far."""

    id: int
    """Identification number, which the estimate repeats."""
    tick: int
    """First tick whose sample is not used for the estimate."""
    whole: bool
    """Whether all damping structures are fitted, as by `analyze`, or only the one with the most
    parameters."""
    from_last: bool = False
    """Whether the fit may start from the previous estimate, which takes a third of the time."""


class _OnlineEstimate(Protocol):
    """Estimate that the analyser has made from the samples of a running session."""

    def as_json(self) -> dict[str, Any]:
        """Return the estimate as a JSON document (docs/online_fit.md)."""


class _OnlineEstimator(Protocol):
    """The analyser's estimator of a running session."""

    def feed(self, new_samples: NDArray[np.void]) -> None:
        """Append the next samples of the session."""

    def estimate(self, up_to_tick: int | None, *, whole: bool, from_last: bool) -> _OnlineEstimate:
        """Return the estimate from the samples before a tick."""


def main() -> None:
    """Run the fit process of one session; called by ``python -m rigd.runner.fit_process``."""
    ignore_signals()
    parent = SupervisorConnection()
    job: FitJob = parent.receive_job()
    if job.realtime is not None:
        pin_off_loop_core(job.realtime.cpu)
    exit_code = 0
    try:
        _SessionFit(job, parent, attach_channels(job.channels)).run()
    except EstimationError as error:
        parent.send(ProcessFailed(str(error)))
        exit_code = 1
    # Without the interpreter's clean-up, which would wait for a running fit.
    os._exit(exit_code)


class EstimatorThread:
    """Thread that fits the samples of a session, on request or at intervals.

    Samples may be passed with `feed` before `begin` states the session.
    """

    def __init__(self) -> None:
        self._inputs: queue.SimpleQueue[NDArray[np.void] | EstimateRequest] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[dict[str, Any] | Exception] = queue.SimpleQueue()

    def begin(
        self,
        metadata: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]],
        interval_s: float | None,
    ) -> None:
        """Start the thread for a session.

        Parameters
        ----------
        metadata
            Metadata of the session.
        segments
            First tick and end of the planned segments, by name.
        interval_s
            Time between two estimates without a request, or None for requested estimates only.
        """
        threading.Thread(
            target=self._run, args=(metadata, segments, interval_s), daemon=True
        ).start()

    def feed(self, new_samples: NDArray[np.void]) -> None:
        """Pass the next samples of the session to the estimator."""
        self._inputs.put(new_samples)

    def request(self, request: EstimateRequest) -> None:
        """Request an estimate from the samples passed to the estimator so far."""
        self._inputs.put(request)

    def next_estimate(self) -> dict[str, Any] | None:
        """Return the next estimate as a JSON document, or None if there is no new one.

        Raises
        ------
        EstimationError
            If the estimator has failed.
        """
        try:
            result_or_error = self._results.get_nowait()
        except queue.Empty:
            return None
        if isinstance(result_or_error, Exception):
            raise EstimationError(f"The fit has failed ({result_or_error!r}).") from result_or_error
        return result_or_error

    def _run(
        self,
        metadata: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]],
        interval_s: float | None,
    ) -> None:
        """Make estimates until the process ends; an error is returned instead of an estimate."""
        try:
            if interval_s is not None:
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _PERIODIC_NICENESS)
            estimator: _OnlineEstimator = pkgutil.resolve_name(ONLINE_ESTIMATOR)(metadata, segments)
            next_fit_due_s = None if interval_s is None else time.monotonic() + interval_s
            periodic_count = 0
            while True:
                try:
                    next_input = self._inputs.get(
                        timeout=None
                        if next_fit_due_s is None
                        else max(next_fit_due_s - time.monotonic(), 0)
                    )
                except queue.Empty:
                    # All samples read so far are in the estimate.
                    assert interval_s is not None
                    next_fit_due_s = time.monotonic() + interval_s
                    next_input = EstimateRequest(
                        periodic_count, _TICK_AFTER_ALL_SAMPLES, whole=False
                    )
                    periodic_count += 1
                if isinstance(next_input, EstimateRequest):
                    self._results.put(_estimate_document(estimator, next_input))
                else:
                    estimator.feed(next_input)
        except Exception as error:  # whatever fails in the analyser ends the fits only
            self._results.put(error)


def _estimate_document(estimator: _OnlineEstimator, request: EstimateRequest) -> dict[str, Any]:
    """Return the requested estimate as a JSON document of plain Python objects."""
    online_estimate = estimator.estimate(
        request.tick, whole=request.whole, from_last=request.from_last
    )
    document = {"id": request.id, **online_estimate.as_json()}
    json_document: dict[str, Any] = json.loads(json.dumps(document, allow_nan=False))
    return json_document


class _SessionFit:
    """Fit of one session: passes samples to the estimator, and estimates to the supervisor."""

    def __init__(self, fit_job: FitJob, parent: SupervisorConnection, channels: Channels) -> None:
        self._parent = parent
        self._estimator = EstimatorThread()
        self._shared_state = channels.shared_state
        self._reader = RingObserver(channels.samples, fit_job.first_index)
        self._job = fit_job
        self._search: ExcitationPlanner | None = None
        self._pending: EstimateRequest | None = None  # request without an estimate so far
        self._is_early_fit_pending = False  # whether it only provides start values for the next fit
        self._previous_estimate: dict[str, Any] | None = None  # previous estimate
        self._passed_ticks = self._request_count = 0
        self._record_ticks: int | None = None  # ticks of the whole record

    def run(self) -> None:
        """Pass samples and estimates on until the whole record is fitted or the supervisor ends."""
        self._parent.send(FitReady())
        while True:
            self._shared_state.beat(StateField.FIT_BEAT)
            has_passed_samples = self._pass_samples()
            estimate = self._estimator.next_estimate()
            if estimate is not None and self._process_estimate(estimate):
                return
            self._request_if_possible(is_drained=not has_passed_samples)
            try:
                supervisor_message = self._parent.poll(0.0 if has_passed_samples else _IDLE_WAIT_S)
            except EOFError:
                return
            match supervisor_message:
                case FileHeader():
                    self._start_fits(supervisor_message)
                case RecordEnded(ticks):
                    self._record_ticks = ticks
                    if self._search is not None and self._search.due_tick is not None:
                        held_ticks_before, begun_segment_end = (
                            self._shared_state[StateField.HELD_TICKS_BEFORE_SEGMENT],
                            self._shared_state[StateField.BEGUN_REFERENCE_TICKS],
                        )
                        self._parent.send(
                            self._search.record_end_message(
                                ticks, held_ticks_before, begun_segment_end
                            )
                        )

    def _start_fits(self, header: FileHeader) -> None:
        """Start the estimates, and the planning of segments, for the session of a file header."""
        job = self._job
        if job.search is not None:
            reference_writer = ReferenceWriter(job.reference, self._shared_state)
            start_rad = float(header.metadata["start_angle_rad"])
            self._search = ExcitationPlanner(
                job.search, job.profile, reference_writer, start_angle_rad=start_rad
            )
        fit_interval_s = _FIT_INTERVAL_S if job.search is None else None
        self._estimator.begin(header.metadata, header.segments, fit_interval_s)

    def _pass_samples(self) -> bool:
        """Pass new samples to the estimator; return whether there were any."""
        sample_bytes = self._reader.take(_MAX_BLOCK_SAMPLES)
        if not sample_bytes:
            return False
        new_samples = decode_samples(sample_bytes)
        self._estimator.feed(new_samples)
        self._passed_ticks = int(new_samples["tick"][-1]) + 1
        return True

    def _request_if_possible(self, *, is_drained: bool) -> None:
        """Request the next estimate if the samples for it have been passed to the estimator.

        `is_drained` states that all samples in the ring buffer have been passed.
        """
        if self._pending is not None:
            return
        excitation_planner = self._search
        if self._record_ticks is not None:
            if is_drained:
                self._request_estimate(self._record_ticks, fits_all_structures=True)
        elif (
            excitation_planner is not None
            and excitation_planner.due_tick is not None
            and excitation_planner.has_last_segment_begun(
                self._shared_state[StateField.BEGUN_REFERENCE_TICKS]
            )
        ):
            # The count of held ticks is read after the samples, because the loop increases it
            # before it publishes the sample.
            request_tick = excitation_planner.due_tick + self._shared_state[StateField.HELD_TICKS]
            if self._passed_ticks >= request_tick:
                self._request_estimate(
                    request_tick,
                    fits_all_structures=excitation_planner.may_be_last,
                    starts_from_previous=True,
                )

    def _request_estimate(
        self, end_tick: int, *, fits_all_structures: bool, starts_from_previous: bool = False
    ) -> None:
        """Request an estimate from the samples before a tick; see `EstimateRequest`."""
        self._request_count += 1
        self._pending = EstimateRequest(
            _FIRST_REQUEST_ID + self._request_count,
            end_tick,
            fits_all_structures,
            starts_from_previous,
        )
        self._estimator.request(self._pending)

    def _process_estimate(self, estimate_document: dict[str, Any]) -> bool:
        """Report an estimate to the supervisor, or plan the next segment with the estimate.

        Returns whether this was the final estimate, from the whole record.
        """
        pending_request, excitation_planner = self._pending, self._search
        if pending_request is not None and pending_request.id != estimate_document["id"]:
            pending_request = None
        # Only the last estimate is requested without start values from the previous one.
        is_final = (
            pending_request is not None
            and pending_request.tick == self._record_ticks
            and not pending_request.from_last
        )
        was_early_fit = self._is_early_fit_pending
        if pending_request is not None:
            self._pending, self._is_early_fit_pending = None, False
        if excitation_planner is not None and not is_final:
            if pending_request is not None and self._record_ticks is None and not was_early_fit:
                self._plan_next_segment(excitation_planner, pending_request, estimate_document)
            return False
        estimate_document["text"] = estimate_lines(estimate_document, self._previous_estimate)
        if excitation_planner is None:
            self._previous_estimate = estimate_document
        else:
            estimate_document["search"] = excitation_planner.targets_document(estimate_document)
        self._parent.send(FitReport(estimate_document, final=is_final))
        return is_final

    def _plan_next_segment(
        self,
        excitation_planner: ExcitationPlanner,
        estimate_request: EstimateRequest,
        estimate_document: dict[str, Any],
    ) -> None:
        """Plan the next segment from an estimate, and send the plan to the supervisor."""
        held_ticks, held_ticks_before = (
            self._shared_state[StateField.HELD_TICKS],
            self._shared_state[StateField.HELD_TICKS_BEFORE_SEGMENT],
        )
        for planner_message in excitation_planner.plan_next_segment(
            estimate_document, held_ticks, held_ticks_before
        ):
            self._parent.send(planner_message)
        if excitation_planner.needs_early_fit:
            # This fit of all structures provides start values for the check of the whole record.
            self._request_estimate(
                estimate_request.tick, fits_all_structures=True, starts_from_previous=True
            )
            self._is_early_fit_pending = True


if __name__ == "__main__":
    main()
