"""Quick looks: a separate program analyses each session after its end.

The program is ``python -m analysis.quick_look``, a process at low priority. One runs at a time. It
is suspended during a session. It is killed if it takes too long, and ends with the process that
started it. Time in which it waits for a processor does not count.
"""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rigd.printable import printable
from rigd.runner.session import RunResult
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, processor_use
from rigd.session.quick_look import quick_look_path, read_quick_look

_PROGRAM: Final = "analysis.quick_look"
_LONGEST_S: Final = 60.0
"""Longest run time of a quick look, without suspensions and waits for a processor."""
_END_S: Final = 0.5
"""Longest wait for a killed quick look at the end of this process."""
_MOST_WAITING: Final = 3
"""Largest number of waiting quick looks; the oldest one beyond it is skipped."""
_LONGEST_ERROR: Final = 500


@dataclass(frozen=True, slots=True)
class QuickLook:
    """Result of the quick look at one session."""

    session: Path
    """Path of the session file."""
    path: Path | None
    """Path of the file of the quick look; None if it failed."""
    content: dict[str, Any] | None
    """Content of that file; None if it failed."""
    error: str
    """Why it failed, a sentence; else empty."""

    @classmethod
    def failed(cls, session: Path, error: str) -> "QuickLook":
        """Return a failed quick look.

        Parameters
        ----------
        session
            Path of the session file.
        error
            Why, a sentence.
        """
        return cls(session, None, None, error)

    @classmethod
    def of_event(cls, event: Mapping[str, Any]) -> "QuickLook":
        """Return the quick look of an event of the daemon."""
        session, content = Path(event["path"]), event["look"]
        return cls(
            session, None if content is None else quick_look_path(session), content, event["error"]
        )

    @property
    def lines(self) -> list[str]:
        """Lines of text for a terminal."""
        if self.content is None:
            return [f"No quick look at {self.session.name}: {self.error}"]
        return [printable(str(line)) for line in self.content["text"]]

    def note(self, results: list[RunResult]) -> None:
        """Add the path of the file to the result of its session, if it is in the list."""
        for index, result in enumerate(results):
            if result.path == self.session:
                results[index] = replace(result, quick_look=self.path)

    def as_dict(self) -> dict[str, Any]:
        """Return the event of the daemon."""
        return {"path": str(self.session), "look": self.content, "error": self.error}


class QuickLooks:
    """Make quick looks at sessions, one at a time, while no session runs.

    Parameters
    ----------
    on_result
        Called with the result of each quick look, in the thread that calls :meth:`poll`.
    """

    def __init__(self, on_result: Callable[[QuickLook], None]) -> None:
        self._on_result = on_result
        self._lock = threading.Lock()
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[str] | None = None
        self._session = Path()
        self._held = False
        self._spent_s = 0.0
        """Run time of the present quick look at `_counted_s`."""
        self._counted_s = 0.0
        self._processor_s = 0.0
        """Processor time that it had used at `_counted_s`."""

    @property
    def busy(self) -> bool:
        """Whether a quick look is running or waiting."""
        return self._process is not None or bool(self._waiting)

    @property
    def spent_s(self) -> float:
        """Run time of the present quick look, without waits for a processor."""
        return self._spent_s

    def begin(self, session: Path) -> None:
        """Request a quick look at a session."""
        with self._lock:
            self._waiting.append(session)
        self.poll()

    def poll(self) -> None:
        """Check progress and report results; call this several times a second between sessions."""
        with self._lock:
            ended = [*self._see(), *self._go_on()]
        for each in ended:
            self._on_result(each)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Suspend quick looks during a session."""
        with self._lock:
            self._held = True
            self._signal(signal.SIGSTOP)
        try:
            yield
        finally:
            with self._lock:
                self._held = False
                self._counted_s = time.monotonic()
                self._signal(signal.SIGCONT)

    def close(self) -> None:
        """End the running quick look and cancel those that wait."""
        with self._lock:
            self._held = True
            self._waiting.clear()
            if self._process is not None:
                self._process.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.communicate(timeout=_END_S)
                self._process = None

    def _see(self) -> Iterator[QuickLook]:
        """Check the running process; yield its result after its end."""
        if self._process is None or self._held:
            return
        self._count(self._process.pid)
        slow = self._spent_s >= _LONGEST_S
        if self._process.poll() is None:
            if slow:
                # Not awaited: at low priority it may end late.
                self._process.kill()
            return
        errors = self._process.communicate()[1]
        code, self._process = self._process.returncode, None
        if slow and code == -signal.SIGKILL:
            yield QuickLook.failed(self._session, f"it took longer than {_LONGEST_S:g} s.")
        elif code != 0:
            words = errors.strip().rpartition("\n")[2].removeprefix("Error: ")[:_LONGEST_ERROR]
            yield QuickLook.failed(
                self._session, words or f"its program ended with exit code {code}."
            )
        else:
            yield self._done()

    def _count(self, pid: int) -> None:
        """Add the run time since the last call."""
        now_s = time.monotonic()
        passed_s, self._counted_s = now_s - self._counted_s, now_s
        if (found := processor_use(pid)) is not None:
            wants, processor_s = found
            used_s, self._processor_s = processor_s - self._processor_s, processor_s
            if wants:
                passed_s = min(passed_s, used_s)
        self._spent_s += passed_s

    def _go_on(self) -> Iterator[QuickLook]:
        """Start the next quick look; yield those that are skipped or cannot be started."""
        while len(self._waiting) > _MOST_WAITING:
            yield QuickLook.failed(self._waiting.popleft(), "skipped in favour of later sessions.")
        if self._held or self._process is not None or not self._waiting:
            return
        self._session = self._waiting.popleft()
        self._spent_s, self._processor_s, self._counted_s = 0.0, 0.0, time.monotonic()
        try:
            self._process = subprocess.Popen(
                [
                    *(*OWN_PYTHON, "-m", _PROGRAM),
                    *(str(self._session), "--parent", str(os.getpid())),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                env=os.environ | SINGLE_THREADED,
                start_new_session=True,  # so that Ctrl-C does not reach it
            )
        except OSError as error:
            yield QuickLook.failed(
                self._session, f"its program cannot be started ({error.strerror})."
            )

    def _done(self) -> QuickLook:
        path = quick_look_path(self._session)
        content = read_quick_look(path)
        if content is None:
            return QuickLook.failed(self._session, f"{path} cannot be read.")
        return QuickLook(self._session, path, content, "")

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(number)
