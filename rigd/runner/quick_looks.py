"""Quick looks: a program that looks at each session that has ended, and never while one runs.

The program is ``python -m analysis.quick_look``, a separate process at a low priority. One runs at
a time. It is suspended before a session begins and goes on when that has ended; one that takes too
long is killed, and all end with the process that started them. The time for which it waits for a
processor that others use does not count.
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
from rigd.runner.session import SessionResult
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, processor_use
from rigd.session.quick_look import look_path, read_look

_PROGRAM: Final = "analysis.quick_look"
_LONGEST_S: Final = 60.0
"""Time in which a look has to be done, without that for which it was suspended or waited for a
processor."""
_END_S: Final = 0.5
"""Longest wait, when this process ends, for a look that was killed."""
_MOST_WAITING: Final = 3
"""Looks that wait; of more, the oldest is left out. Only sessions on each other's heels need it."""
_LONGEST_ERROR: Final = 500


@dataclass(frozen=True, slots=True)
class QuickLook:
    """What became of the look at one session."""

    session: Path
    """Path of the session file."""
    path: Path | None
    """Path of the look's own file; None: there is none."""
    look: dict[str, Any] | None
    """Content of that file."""
    error: str
    """Why there is none, a sentence; else empty."""

    @classmethod
    def failed(cls, session: Path, error: str) -> "QuickLook":
        """Return that there is none.

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
        """Return what an event of the daemon tells."""
        session, look = Path(event["path"]), event["look"]
        return cls(session, None if look is None else look_path(session), look, event["error"])

    @property
    def lines(self) -> list[str]:
        """Text of it for a terminal."""
        if self.look is None:
            return [f"No quick look at {self.session.name}: {self.error}"]
        return [printable(str(line)) for line in self.look["text"]]

    def note(self, results: list[SessionResult]) -> None:
        """Note its file in the result of its session, if that is among these."""
        for index, result in enumerate(results):
            if result.path == self.session:
                results[index] = replace(result, look=self.path)

    def as_dict(self) -> dict[str, Any]:
        """Return it as the event of the daemon has it."""
        return {"path": str(self.session), "look": self.look, "error": self.error}


class QuickLooks:
    """Looks at sessions, one after the other, while none runs.

    Parameters
    ----------
    tell
        Called with what became of each look, by the caller of :meth:`attend`.

    """

    def __init__(self, tell: Callable[[QuickLook], None]) -> None:
        self._tell = tell
        self._lock = threading.Lock()
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[str] | None = None
        self._session = Path()
        self._held = False
        self._spent_s = 0.0
        """Time that the running look has taken, at `_counted_s`."""
        self._counted_s = 0.0
        self._processor_s = 0.0
        """Processor time that it had used then."""

    @property
    def busy(self) -> bool:
        """Whether a look is still to be told."""
        return self._process is not None or bool(self._waiting)

    @property
    def spent_s(self) -> float:
        """Time that the present look has taken, without its waits for a processor."""
        return self._spent_s

    def begin(self, session: Path) -> None:
        """Look at a session as soon as that is possible."""
        with self._lock:
            self._waiting.append(session)
        self.attend()

    def attend(self) -> None:
        """See how far the looks are, and tell; call it some times a second between sessions."""
        with self._lock:
            ended = [*self._see(), *self._go_on()]
        for each in ended:
            self._tell(each)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Suspend whatever runs, for the time of a session."""
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
        """Leave out what was not done."""
        with self._lock:
            self._held = True
            self._waiting.clear()
            if self._process is not None:
                self._process.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.communicate(timeout=_END_S)
                self._process = None

    def _see(self) -> Iterator[QuickLook]:
        """Look after the running process; yield what became of it once it has ended."""
        if self._process is None or self._held:
            return
        self._count(self._process.pid)
        slow = self._spent_s >= _LONGEST_S
        if self._process.poll() is None:
            if slow:
                # Not waited for: at a low priority it ends when others leave it the time.
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
        """Count the time that the running look has taken since the last call."""
        now_s = time.monotonic()
        passed_s, self._counted_s = now_s - self._counted_s, now_s
        if (found := processor_use(pid)) is not None:
            wants, processor_s = found
            used_s, self._processor_s = processor_s - self._processor_s, processor_s
            if wants:
                passed_s = min(passed_s, used_s)
        self._spent_s += passed_s

    def _go_on(self) -> Iterator[QuickLook]:
        """Start the next look; yield those that cannot be."""
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
                start_new_session=True,  # Ctrl-C is for the session; it ends with this process
            )
        except OSError as error:
            yield QuickLook.failed(
                self._session, f"its program cannot be started ({error.strerror})."
            )

    def _done(self) -> QuickLook:
        path = look_path(self._session)
        look = read_look(path)
        if look is None:
            return QuickLook.failed(self._session, f"{path} cannot be read.")
        return QuickLook(self._session, path, look, "")

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(number)
