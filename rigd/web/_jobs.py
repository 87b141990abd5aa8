"""Queue of the page's jobs: runs of `analyze` for reports, campaigns and exports, at idle priority.

Jobs are suspended while a session runs. They end with the page's process, even if it is killed.
"""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rigd.engine.processes import ChildError, ChildProcess
from rigd.engine.workers import REPORT

Document = dict[str, Any]

MAX_WAITING_JOBS: Final = 16
"""Largest number of waiting jobs."""
_POLL_PERIOD_S: Final = 0.2
"""Interval in seconds at which waiting jobs are polled."""
_RUNNING_POLL_PERIOD_S: Final = 0.05
"""Interval in seconds at which the running job is polled."""
_MAX_STDERR_BYTES: Final = 1000
"""Number of bytes at the end of a failed job's standard error that are reported."""
_MAX_STDERR_LINES: Final = 3
"""Number of lines at the end of a failed job's standard error that are reported."""


class JobError(Exception):
    """Raised if a job is refused or has failed; the message is for the operator."""


@dataclass(slots=True)
class AnalysisJob:
    """Run of `analyze` that the page has requested, with its state."""

    number: int
    """Number of the job, from 1."""
    job_kind: str
    """Kind of the job: ``report``, ``campaign`` or ``export``."""
    analyze_arguments: Sequence[str]
    """Arguments of `analyze`."""
    session_name: str = ""
    """Name of the job's session, or "" for several sessions."""
    result_url: str = ""
    """URL path at which this server provides the result; "" for an export."""
    state: str = "waiting"
    """State of the job: ``waiting``, ``running``, ``done`` or ``failed``."""
    error: str = ""
    """Message for the operator if the job failed."""
    is_dropped: bool = False
    """Whether the job was dropped because a session has begun."""
    end_event: asyncio.Event = field(default_factory=asyncio.Event)
    """Event that is set when the job has ended."""

    def as_document(self) -> Document:
        """Return the state of the job as a message to the open pages."""
        return {
            "type": "job",
            "number": self.number,
            "kind": self.job_kind,
            "id": self.session_name,
            "state": self.state,
            "error": self.error,
            "address": self.result_url if self.state == "done" else "",
        }


class JobQueue:
    """Runs queued jobs one after the other, without disturbing a session.

    Jobs work in the folder of the sessions and are `paused` while a session runs. `publish` is
    called with the state of a job after each change.
    """

    def __init__(self, folder: Path, publish: Callable[[Document], None]) -> None:
        self.paused = True  # until the daemon reports that no session runs
        self._folder = folder
        self._publish = publish
        self._queue: asyncio.Queue[AnalysisJob] = asyncio.Queue(MAX_WAITING_JOBS)
        self._unfinished: dict[int, AnalysisJob] = {}
        self._count = 0

    @property
    def result_urls(self) -> set[str]:
        """URL paths of the results of waiting and running jobs."""
        return {job.result_url for job in self._unfinished.values()}

    def add_job(
        self,
        job_kind: str,
        analyze_arguments: Sequence[str],
        session_name: str = "",
        result_url: str = "",
    ) -> AnalysisJob:
        """Queue a run of the program `analyze`, and return it as a job.

        Arguments are as in `AnalysisJob`. Raise `JobError` if too many jobs are waiting.
        """
        self._count += 1
        job = AnalysisJob(self._count, job_kind, analyze_arguments, session_name, result_url)
        try:
            self._queue.put_nowait(job)
        except asyncio.QueueFull:
            raise JobError(
                f"{MAX_WAITING_JOBS} jobs are waiting already; try again later."
            ) from None
        self._unfinished[job.number] = job
        self._publish_state(job)
        return job

    async def await_or_drop(self, job: AnalysisJob) -> None:
        """Wait for the end of a job; if a session begins, drop the job and set `is_dropped`."""
        while not job.end_event.is_set():
            if self.paused:
                job.is_dropped = True
                if job.state == "waiting":
                    return
            with suppress(TimeoutError):
                await asyncio.wait_for(job.end_event.wait(), _POLL_PERIOD_S)

    async def run(self) -> None:
        """Run the queued jobs one after the other until this task is cancelled."""
        while True:
            job = await self._queue.get()
            while self.paused:
                await asyncio.sleep(_POLL_PERIOD_S)
            if not job.is_dropped:
                job.state = "running"
                self._publish_state(job)
                try:
                    await self._run_process(job)
                    job.state = "done"
                except (JobError, ChildError) as error:
                    job.state, job.error = "failed", str(error)
                job.end_event.set()
                self._publish_state(job)
            del self._unfinished[job.number]

    def _publish_state(self, job: AnalysisJob) -> None:
        """Send a job's state to the open pages, unless the job exports a session for a download."""
        if job.job_kind != "export":
            self._publish(job.as_document())

    async def _run_process(self, job: AnalysisJob) -> None:
        """Run a job's process to its end, or raise JobError if it is dropped or fails."""
        child_process = ChildProcess(REPORT, *job.analyze_arguments, folder=self._folder)
        is_process_suspended = False
        try:
            while child_process.running:
                if job.is_dropped:
                    raise JobError("A session has begun.")
                if self.paused is not is_process_suspended:
                    is_process_suspended = self.paused
                    (child_process.suspend if is_process_suspended else child_process.resume)()
                await asyncio.sleep(_RUNNING_POLL_PERIOD_S)
            error_text = child_process.error_text()
        finally:
            await asyncio.to_thread(child_process.stop)
        if child_process.exit_code != 0:
            last_error_lines = error_text[-_MAX_STDERR_BYTES:].splitlines()[-_MAX_STDERR_LINES:]
            failure_reason = " ".join(last_error_lines) or f"exit code {child_process.exit_code}"
            raise JobError(f"The {job.job_kind} was not made: {failure_reason}")
