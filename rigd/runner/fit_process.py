"""The fit process, which fits the record of a running session and plans the next excitation.

The process reads the ring buffer of samples like the live publisher, so that it neither delays the
control loop nor takes samples from the recorder. It passes the samples to the analyser's fit
program (``python -m analysis.online``), and the program's estimates to the supervisor. If the
session lasts until a precision is reached, each estimate is also used to plan the next segment of
the reference (`ExcitationPlanner`).
"""

import contextlib
import json
import os
import queue
import subprocess
import threading
from typing import Any, BinaryIO, Final, Self, cast

from rigd.engine import Observer
from rigd.engine.channels import Channels, attach_channels
from rigd.engine.messages import Failed, FileHeader, FitJob, FitReady, FitReport, RecordEnded
from rigd.engine.processes import Parent
from rigd.engine.realtime import pin_off_loop_core
from rigd.engine.reference import ReferenceWriter
from rigd.engine.shared_state import StateField
from rigd.runner._precision_search import ExcitationPlanner
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED
from rigd.runtime import ignore as ignore_signals
from rigd.session.layout import SAMPLE_SIZE, decode_samples
from rigd.session.online_fit import (
    EstimateRequest,
    StreamStart,
    estimate_lines,
    write_request,
    write_samples,
    write_start,
)

_FIT_MODULE: Final = "analysis.online"
_MAX_BLOCK_SAMPLES: Final = 500
"""Maximum number of samples that are passed to the fit program at once."""
_IDLE_WAIT_S: Final = 0.005
"""Time in seconds to wait for a message if there are no new samples."""
_FIT_INTERVAL_S: Final = 1.0
"""Time in seconds between two fits of a session whose excitation is planned before its start."""
_END_TIMEOUT_S: Final = 1.0
"""Time in seconds that the fit program has to end before it is killed."""
_FIRST_REQUEST_ID: Final = 1_000_000_000
"""First identification number of requested estimates; those of periodic estimates start at 0."""


class FitProgramError(Exception):
    """Raised if the fit program ended unexpectedly; the message states how it ended."""


def main() -> None:
    """Run the fit process of one session; called by ``python -m rigd.runner.fit_process``."""
    ignore_signals()
    parent = Parent()
    job: FitJob = parent.receive_job()
    if job.realtime is not None:
        pin_off_loop_core(job.realtime.cpu)
    try:
        with FitProgram() as program:
            session_fit = _SessionFit(job, parent, program, attach_channels(job.channels))
            try:
                session_fit.run()
            except BrokenPipeError:
                raise program.end_error() from None
    except FitProgramError as error:
        parent.send(Failed(str(error)))
        raise SystemExit(1) from None


class FitProgram:
    """The analyser's fit program, run in a child process that ends with the context."""

    def __init__(self) -> None:
        try:
            self._process = subprocess.Popen(
                [*OWN_PYTHON, "-m", _FIT_MODULE, "--parent", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | SINGLE_THREADED,
            )
        except OSError as error:
            raise FitProgramError(
                f"The fit program cannot be started ({error.strerror})."
            ) from None
        self.input = cast("BinaryIO", self._process.stdin)
        """Standard input of the program, in the format of `rigd.session.online_fit`."""
        self._estimates: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read_estimates, daemon=True).start()

    def next_estimate(self) -> dict[str, Any] | None:
        """Return the program's next estimate, or None if there is no new one.

        Raises
        ------
        FitProgramError
            If the program has ended.
        """
        try:
            estimate = self._estimates.get_nowait()
        except queue.Empty:
            return None
        if estimate is None:
            raise self.end_error()
        return estimate

    def end_error(self) -> FitProgramError:
        """Return the error that states how the program ended, after waiting for its end."""
        exit_code = self._process.wait()
        end_text = (
            f"was killed by signal {-exit_code}"
            if exit_code < 0
            else f"ended with exit code {exit_code}"
        )
        return FitProgramError(f"The fit program {end_text}.")

    def _read_estimates(self) -> None:
        """Read the program's estimates into a queue until it ends; run in a thread."""
        assert self._process.stdout is not None
        with contextlib.suppress(ValueError):  # incomplete line: the program ended while writing
            for output_line in self._process.stdout:
                self._estimates.put(json.loads(output_line))
        self._estimates.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self.input.close()
        try:
            self._process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class _SessionFit:
    """Passes the samples of one session to the fit program, and its estimates to the supervisor."""

    def __init__(
        self, job: FitJob, parent: Parent, program: FitProgram, channels: Channels
    ) -> None:
        self._parent = parent
        self._program = program
        self._shared_state = channels.shared_state
        self._reader = Observer(channels.samples, job.first)
        self._job = job
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
            estimate = self._program.next_estimate()
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
                        held_ticks_before, begun_until_tick = (
                            self._shared_state[StateField.HELD_BEFORE],
                            self._shared_state[StateField.BEGUN],
                        )
                        self._parent.send(
                            self._search.end_of_record(ticks, held_ticks_before, begun_until_tick)
                        )

    def _start_fits(self, header: FileHeader) -> None:
        """Send the header of the session file to the fit program, and prepare the planning."""
        job = self._job
        if job.search is not None:
            reference_writer = ReferenceWriter(job.reference, self._shared_state)
            start_rad = float(header.metadata["start_angle_rad"])
            self._search = ExcitationPlanner(
                job.search, job.profile, reference_writer, start_rad=start_rad
            )
        fit_interval_s = _FIT_INTERVAL_S if job.search is None else None
        stream_start = StreamStart(dict(header.metadata), dict(header.segments), fit_interval_s)
        write_start(self._program.input, stream_start)

    def _pass_samples(self) -> bool:
        """Pass new samples to the fit program; return whether there were any."""
        sample_bytes = self._reader.take(_MAX_BLOCK_SAMPLES)
        if not sample_bytes:
            return False
        write_samples(self._program.input, sample_bytes)
        self._passed_ticks = int(decode_samples(sample_bytes[-SAMPLE_SIZE:])["tick"][0]) + 1
        return True

    def _request_if_possible(self, *, is_drained: bool) -> None:
        """Request the next estimate if the samples for it have been passed to the fit program.

        `is_drained` states that all samples in the ring buffer have been passed.
        """
        if self._pending is not None:
            return
        excitation_planner = self._search
        if self._record_ticks is not None:
            if is_drained:
                self._request_estimate(self._record_ticks, whole=True)
        elif (
            excitation_planner is not None
            and excitation_planner.due_tick is not None
            and excitation_planner.has_last_segment_begun(self._shared_state[StateField.BEGUN])
        ):
            # The count of held ticks is read after the samples, because the loop increases it
            # before it publishes the sample.
            request_tick = excitation_planner.due_tick + self._shared_state[StateField.HELD]
            if self._passed_ticks >= request_tick:
                self._request_estimate(
                    request_tick, whole=excitation_planner.may_be_last, from_last=True
                )

    def _request_estimate(self, tick: int, *, whole: bool, from_last: bool = False) -> None:
        """Request an estimate from the samples before a tick; see `EstimateRequest`."""
        self._request_count += 1
        self._pending = EstimateRequest(
            _FIRST_REQUEST_ID + self._request_count, tick, whole, from_last
        )
        write_request(self._program.input, self._pending)

    def _process_estimate(self, estimate: dict[str, Any]) -> bool:
        """Report an estimate or plan the next segment with it.

        Returns whether the estimate is the final one, of the whole record.
        """
        pending_request, excitation_planner = self._pending, self._search
        if pending_request is not None and pending_request.id != estimate["id"]:
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
                self._plan_next_segment(excitation_planner, pending_request, estimate)
            return False
        estimate["text"] = estimate_lines(estimate, self._previous_estimate)
        if excitation_planner is None:
            self._previous_estimate = estimate
        else:
            estimate["search"] = excitation_planner.targets_document(estimate)
        self._parent.send(FitReport(estimate, final=is_final))
        return is_final

    def _plan_next_segment(
        self,
        excitation_planner: ExcitationPlanner,
        request: EstimateRequest,
        estimate: dict[str, Any],
    ) -> None:
        """Plan the next segment from an estimate, and send the plan to the supervisor."""
        held_ticks, held_ticks_before = (
            self._shared_state[StateField.HELD],
            self._shared_state[StateField.HELD_BEFORE],
        )
        for planner_message in excitation_planner.plan_next(
            estimate, held_ticks, held_ticks_before
        ):
            self._parent.send(planner_message)
        if excitation_planner.needs_early_fit:
            # This fit of all structures provides start values for the check of the whole record.
            self._request_estimate(request.tick, whole=True, from_last=True)
            self._is_early_fit_pending = True


if __name__ == "__main__":
    main()
