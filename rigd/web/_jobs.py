"""Jobs of the page: reports, campaigns and exports by `analyze`, at idle priority.

They are suspended while a session runs, and end with the page's process, however that ends.
"""

import asyncio
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, give_way

Document = dict[str, Any]

MOST_JOBS: Final = 16
"""Limit of the waiting jobs."""
_PROGRAM: Final = (*OWN_PYTHON, "-m", "analysis")
_DIE_WITH_PAGE: Final = """
import os, signal, sys
from rigd.runtime import die_with_parent, prefer_oom_kill

die_with_parent(int(sys.argv[1]))
prefer_oom_kill()
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which the page ignores
os.execv(sys.argv[2], sys.argv[2:])
"""
"""Program that executes another one, which ends with the process of its first argument, and first
of all if memory runs out."""
_POLL_S: Final = 0.2
_MOST_STDERR_BYTES: Final = 1000
_MOST_LINES: Final = 3


class JobError(Exception):
    """A job is refused or failed; the message is for the operator."""


@dataclass(slots=True)
class AnalysisJob:
    """One job of `analyze`."""

    number: int
    kind: str
    """``report``, ``campaign`` or ``export``."""
    arguments: Sequence[str]
    """Command line of `analyze`."""
    id: str = ""
    """Session of the job; empty for several sessions."""
    address: str = ""
    """Path at which the result is served."""
    state: str = "waiting"
    error: str = ""
    dropped: bool = False
    """Whether it was dropped because a session has begun."""
    done: asyncio.Event = field(default_factory=asyncio.Event)

    def document(self) -> Document:
        """Return the state of the job as a message for the page."""
        return {
            "type": "job",
            "number": self.number,
            "kind": self.kind,
            "id": self.id,
            "state": self.state,
            "error": self.error,
            "address": self.address if self.state == "done" else "",
        }


class Jobs:
    """Queue of jobs, which run one after the other without disturbing a session.

    Parameters
    ----------
    folder
        Folder of the sessions and working directory of the jobs.
    publish
        Called with each change of a job.

    Attributes
    ----------
    paused
        Whether a session runs.
    """

    def __init__(self, folder: Path, publish: Callable[[Document], None]) -> None:
        self.paused = True  # until the daemon reports that no session runs
        self._folder = folder
        self._publish = publish
        self._waiting: asyncio.Queue[AnalysisJob] = asyncio.Queue(MOST_JOBS)
        self._unfinished: dict[int, AnalysisJob] = {}
        self._count = 0

    @property
    def addresses(self) -> set[str]:
        """Paths of the results of waiting and running jobs."""
        return {job.address for job in self._unfinished.values()}

    def put(
        self, kind: str, arguments: Sequence[str], session: str = "", address: str = ""
    ) -> AnalysisJob:
        """Queue a job.

        Parameters
        ----------
        kind, arguments, session, address
            See `AnalysisJob`.

        Raises
        ------
        JobError
            If too many jobs wait.
        """
        self._count += 1
        job = AnalysisJob(self._count, kind, arguments, session, address)
        try:
            self._waiting.put_nowait(job)
        except asyncio.QueueFull:
            raise JobError(f"{MOST_JOBS} jobs are waiting already; try again later.") from None
        self._unfinished[job.number] = job
        self._publish_state(job)
        return job

    async def await_or_drop(self, job: AnalysisJob) -> None:
        """Wait for the end of a job; drop it if a session begins.

        Parameters
        ----------
        job
            Queued job, whose ``dropped`` is true if it was dropped.
        """
        while not job.done.is_set():
            if self.paused:
                job.dropped = True
                if job.state == "waiting":
                    return
            with suppress(TimeoutError):
                await asyncio.wait_for(job.done.wait(), _POLL_S)

    async def run(self) -> None:
        """Run the queued jobs until cancelled."""
        while True:
            job = await self._waiting.get()
            while self.paused:
                await asyncio.sleep(_POLL_S)
            if not job.dropped:
                job.state = "running"
                self._publish_state(job)
                try:
                    await self._perform(job)
                    job.state = "done"
                except (JobError, OSError) as error:
                    job.state, job.error = "failed", str(error)
                job.done.set()
                self._publish_state(job)
            del self._unfinished[job.number]

    def _publish_state(self, job: AnalysisJob) -> None:
        """Publish the state of a job, except of an export, whose request waits for it."""
        if job.kind != "export":
            self._publish(job.document())

    async def _perform(self, job: AnalysisJob) -> None:
        process = await asyncio.create_subprocess_exec(
            *(*OWN_PYTHON, "-c", _DIE_WITH_PAGE, str(os.getpid())),
            *(*_PROGRAM, *job.arguments),
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | SINGLE_THREADED,
            # A group, so that it is suspended and killed together with its workers. In the page's
            # session, because when the page ends the system resumes and ends (SIGHUP) suspended
            # groups of the same session only.
            process_group=0,
        )
        give_way(process.pid)
        ending = asyncio.create_task(process.communicate())
        stopped = False
        try:
            while not ending.done():
                if job.dropped:
                    raise JobError("A session has begun.")
                if self.paused is not stopped:
                    stopped = self.paused
                    _signal(process.pid, signal.SIGSTOP if stopped else signal.SIGCONT)
                await asyncio.wait((ending,), timeout=_POLL_S)
            _, stderr = ending.result()
        finally:
            if process.returncode is None:
                _signal(process.pid, signal.SIGKILL)
                await asyncio.wait((ending,))
        if process.returncode != 0:
            words = (
                stderr.decode(errors="replace")
                .strip()[-_MOST_STDERR_BYTES:]
                .splitlines()[-_MOST_LINES:]
            )
            why = " ".join(words) or f"exit code {process.returncode}"
            raise JobError(f"The {job.kind} was not made: {why}")


def _signal(group: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, number)
