"""Quick looks, the short reports that a separate program makes of each session after its end.

One program runs at a time. It is suspended during a session, and killed if its run time (without
waits for a processor) is too long. It ends with the process that started it.
"""

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rigd.engine.processes import ChildError, ChildProcess
from rigd.engine.workers import QUICK_LOOK
from rigd.printable import printable
from rigd.runner.session import SessionResult
from rigd.runtime.background import processor_use
from rigd.session.quick_look import quick_look_path, read_quick_look

_MAX_RUN_TIME_S: Final = 60.0
"""Maximum run time of a quick look in seconds, without suspensions and waits for a processor."""
_MAX_WAITING_SESSIONS: Final = 3
"""Maximum number of waiting quick looks, above which the oldest waiting quick look is skipped."""
_MAX_ERROR_CHARACTERS: Final = 500
"""Maximum number of characters of an error message that are shown."""


@dataclass(frozen=True, slots=True)
class QuickLook:
    """Quick look at one session, or the reason why it failed."""

    session_path: Path
    """Path of the session file."""
    path: Path | None
    """Path of the quick look's file, or None if the quick look failed."""
    report_content: dict[str, Any] | None
    """Content of the quick look's file, or None if the quick look failed."""
    error: str
    """Sentence that states why the quick look failed; empty if it did not."""

    @classmethod
    def failed(cls, session_path: Path, error: str) -> "QuickLook":
        """Return a quick look that failed.

        Parameters
        ----------
        session_path
            Path of the session file.
        error
            Sentence that states why the quick look failed.
        """
        return cls(session_path, None, None, error)

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> "QuickLook":
        """Return the quick look that an event of the daemon reports."""
        session_path, report_content = Path(event["path"]), event["look"]
        return cls(
            session_path,
            None if report_content is None else quick_look_path(session_path),
            report_content,
            event["error"],
        )

    @property
    def lines(self) -> list[str]:
        """Lines of text that report the quick look on a terminal."""
        if self.report_content is None:
            return [f"No quick look at {self.session_path.name}: {self.error}"]
        return [printable(str(text_line)) for text_line in self.report_content["text"]]

    def add_path_to_results(self, results: list[SessionResult]) -> None:
        """Add the path of the quick look to the result of its session in a list of results."""
        for result_index, run_result in enumerate(results):
            if run_result.path == self.session_path:
                results[result_index] = replace(run_result, quick_look=self.path)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the daemon's event that reports the quick look."""
        return {"path": str(self.session_path), "look": self.report_content, "error": self.error}


class QuickLookQueue:
    """Queue of sessions for quick looks, which are made one at a time while no session runs.

    Parameters
    ----------
    on_result
        Called with each quick look after its end, in the thread that calls :meth:`poll`.
    """

    def __init__(self, on_result: Callable[[QuickLook], None]) -> None:
        self._on_result = on_result
        self._lock = threading.Lock()
        self._waiting_sessions: deque[Path] = deque()
        self._process: ChildProcess | None = None
        self._session = Path()
        self._is_suspended = False
        self._run_time_s = 0.0
        """Run time of the present quick look in seconds, up to the time `_run_time_updated_s`."""
        self._run_time_updated_s = 0.0
        self._processor_s = 0.0
        """Processor time in seconds that the quick look had used at `_run_time_updated_s`."""

    @property
    def is_busy(self) -> bool:
        """Whether a quick look is running or waiting."""
        return self._process is not None or bool(self._waiting_sessions)

    @property
    def run_time_s(self) -> float:
        """Run time of the present quick look in seconds, without waits for a processor."""
        return self._run_time_s

    def add_session(self, session_path: Path) -> None:
        """Add a session to the queue, and start its quick look if none is running."""
        with self._lock:
            self._waiting_sessions.append(session_path)
        self.poll()

    def poll(self) -> None:
        """Report ended quick looks and start the next one; call this often between sessions."""
        with self._lock:
            ended_reports = [*self._ended_quick_look(), *self._start_next()]
        for quick_look in ended_reports:
            self._on_result(quick_look)

    @contextlib.contextmanager
    def suspended(self) -> Iterator[None]:
        """Suspend the process of the running quick look within the context, during a session."""
        with self._lock:
            self._is_suspended = True
            if self._process is not None:
                self._process.suspend()
        try:
            yield
        finally:
            with self._lock:
                self._is_suspended = False
                self._run_time_updated_s = time.monotonic()
                if self._process is not None:
                    self._process.resume()

    def close(self, reason: str = "") -> None:
        """Kill the running quick look and cancel the waiting quick looks.

        Parameters
        ----------
        reason
            Sentence with which each of them is reported as failed; empty for no report.
        """
        with self._lock:
            self._is_suspended = True
            cancelled_sessions = [*self._waiting_sessions]
            self._waiting_sessions.clear()
            if self._process is not None:
                cancelled_sessions.insert(0, self._session)
                self._process.stop()
                self._process = None
        if reason:
            for session_path in cancelled_sessions:
                self._on_result(QuickLook.failed(session_path, reason))

    def _ended_quick_look(self) -> Iterator[QuickLook]:
        """Yield the result of the running quick look if it has ended; kill it if it is too slow."""
        if self._process is None or self._is_suspended:
            return
        self._update_run_time(self._process.pid)
        is_too_slow = self._run_time_s >= _MAX_RUN_TIME_S
        if (exit_code := self._process.exit_code) is None:
            if is_too_slow:
                # Its end is not awaited, because it may end late at low priority.
                self._process.kill()
            return
        error_output = self._process.error_text()
        self._process.stop()
        self._process = None
        if is_too_slow and exit_code == -signal.SIGKILL:
            yield QuickLook.failed(self._session, f"it took longer than {_MAX_RUN_TIME_S:g} s.")
        elif exit_code != 0:
            error_text = error_output.rpartition("\n")[2].removeprefix("Error: ")[
                :_MAX_ERROR_CHARACTERS
            ]
            yield QuickLook.failed(
                self._session, error_text or f"its program ended with exit code {exit_code}."
            )
        else:
            yield self._read_result()

    def _update_run_time(self, pid: int) -> None:
        """Update the run time of the quick look with the given process id."""
        now_s = time.monotonic()
        elapsed_s, self._run_time_updated_s = now_s - self._run_time_updated_s, now_s
        if (processor_usage := processor_use(pid)) is not None:
            is_waiting_for_processor, processor_s = processor_usage
            used_processor_s, self._processor_s = processor_s - self._processor_s, processor_s
            if is_waiting_for_processor:
                elapsed_s = min(elapsed_s, used_processor_s)
        self._run_time_s += elapsed_s

    def _start_next(self) -> Iterator[QuickLook]:
        """Start the next quick look; yield the quick looks that are skipped or cannot start."""
        while len(self._waiting_sessions) > _MAX_WAITING_SESSIONS:
            yield QuickLook.failed(
                self._waiting_sessions.popleft(), "skipped in favour of later sessions."
            )
        if self._is_suspended or self._process is not None or not self._waiting_sessions:
            return
        self._session = self._waiting_sessions.popleft()
        self._run_time_s, self._processor_s, self._run_time_updated_s = 0.0, 0.0, time.monotonic()
        try:
            self._process = ChildProcess(QUICK_LOOK, str(self._session))
        except ChildError as error:
            yield QuickLook.failed(
                self._session, f"its program cannot be started ({error.system_reason})."
            )

    def _read_result(self) -> QuickLook:
        """Return the quick look that the program has written successfully."""
        report_path = quick_look_path(self._session)
        report_content = read_quick_look(report_path)
        if report_content is None:
            return QuickLook.failed(self._session, f"{report_path} cannot be read.")
        return QuickLook(self._session, report_path, report_content, "")
