"""Jobs of the page: reports, campaigns and exports by `analyze`, at idle priority.

They stand still while a session runs, and end with the page however that ends.
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
"""Jobs that may wait."""
_PROGRAM: Final = (*OWN_PYTHON, "-m", "analysis")
_MORTAL: Final = """
import os, signal, sys
from rigd.runtime import end_with, killed_first

end_with(int(sys.argv[1]))
killed_first()
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which the page ignores
os.execv(sys.argv[2], sys.argv[2:])
"""
"""Program that becomes another one, which ends with the process that is named first, or if memory
runs out."""
_LOOK_S: Final = 0.2
_MOST_SAID: Final = 1000
_MOST_LINES: Final = 3


class JobError(Exception):
    """A job cannot be taken, or failed; the message is for the operator."""


@dataclass(slots=True)
class AnalysisJob:
    """Something that `analyze` makes."""

    number: int
    kind: str
    """``report``, ``campaign`` or ``export``."""
    arguments: Sequence[str]
    """Command line of `analyze`."""
    id: str = ""
    """Session it is about, if it is one."""
    address: str = ""
    """Where its result is served."""
    state: str = "waiting"
    error: str = ""
    dropped: bool = False
    """A session has begun; its result is no longer waited for."""
    done: asyncio.Event = field(default_factory=asyncio.Event)

    def document(self) -> Document:
        """Tell the page how it stands."""
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
    """One job after the other, none of which disturbs a session.

    Parameters
    ----------
    folder
        Folder of the sessions, in which they are run.
    tell
        Called with each change of a job.

    Attributes
    ----------
    paused
        A session runs.
    """

    def __init__(self, folder: Path, tell: Callable[[Document], None]) -> None:
        self.paused = True  # until the daemon has said that no session runs
        self._folder = folder
        self._tell = tell
        self._waiting: asyncio.Queue[AnalysisJob] = asyncio.Queue(MOST_JOBS)
        self._underway: dict[int, AnalysisJob] = {}
        self._count = 0

    @property
    def addresses(self) -> set[str]:
        """Where results will be served of jobs that wait or run."""
        return {job.address for job in self._underway.values()}

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
            If too many wait already.
        """
        self._count += 1
        job = AnalysisJob(self._count, kind, arguments, session, address)
        try:
            self._waiting.put_nowait(job)
        except asyncio.QueueFull:
            raise JobError(f"{MOST_JOBS} jobs are waiting already; try again later.") from None
        self._underway[job.number] = job
        self._say(job)
        return job

    async def await_or_drop(self, job: AnalysisJob) -> None:
        """Wait for the end of a job; a session that begins ends it.

        Parameters
        ----------
        job
            One that is queued; ``dropped`` says that it was ended.
        """
        while not job.done.is_set():
            if self.paused:
                job.dropped = True
                if job.state == "waiting":
                    return
            with suppress(TimeoutError):
                await asyncio.wait_for(job.done.wait(), _LOOK_S)

    async def run(self) -> None:
        """Do what is queued, until cancelled."""
        while True:
            job = await self._waiting.get()
            while self.paused:
                await asyncio.sleep(_LOOK_S)
            if not job.dropped:
                job.state = "running"
                self._say(job)
                try:
                    await self._perform(job)
                    job.state = "done"
                except (JobError, OSError) as error:
                    job.state, job.error = "failed", str(error)
                job.done.set()
                self._say(job)
            del self._underway[job.number]

    def _say(self, job: AnalysisJob) -> None:
        """Tell how a job stands; who waits for an export is answered."""
        if job.kind != "export":
            self._tell(job.document())

    async def _perform(self, job: AnalysisJob) -> None:
        process = await asyncio.create_subprocess_exec(
            *(*OWN_PYTHON, "-c", _MORTAL, str(os.getpid())),
            *(*_PROGRAM, *job.arguments),
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | SINGLE_THREADED,
            # With its workers it is suspended and ended as one; no session of its own, for if the
            # page ends the system wakes and ends (SIGHUP) suspended groups of the same one only.
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
                await asyncio.wait((ending,), timeout=_LOOK_S)
            _, said = ending.result()
        finally:
            if process.returncode is None:
                _signal(process.pid, signal.SIGKILL)
                await asyncio.wait((ending,))
        if process.returncode != 0:
            words = said.decode(errors="replace").strip()[-_MOST_SAID:].splitlines()[-_MOST_LINES:]
            why = " ".join(words) or f"exit code {process.returncode}"
            raise JobError(f"The {job.kind} was not made: {why}")


def _signal(group: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, number)
