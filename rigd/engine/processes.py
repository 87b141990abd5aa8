"""The processes of a rig: their table, how they are started, and both ends of their pipes.

One table, `PROCESSES`, says how each process is started, watched, and ended. Every process counts
up its word in the `SharedState` several times a second. A dead process is noticed at once, a hung
one by its heartbeat; the table says what happens then.

A child is ``python -m MODULE``. Its standard input brings its job and then messages; the end of it
means that the supervisor is gone. Its standard output brings its answers (`messages`).
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rigd.engine._control_names import CONTROL_MODULE
from rigd.engine.messages import MessageReader, encode, is_ready
from rigd.engine.shared_state import Word
from rigd.errors import FailureError
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, held_back, signal_when_orphaned

_WRITE_PATIENCE_S = 5.0
_SILENT_GRACE_S = 1.0
_KILLED_GRACE_S = 2.0


# Both ends


class ChildError(FailureError):
    """A child process ended, or answered something else than it was asked."""


class Child:
    """A process started by the supervisor.

    Parameters
    ----------
    name
        Name in messages to the operator.
    module
        Run as ``python -m module``; it starts importing at once and waits for its job.
    fds
        Descriptors it inherits.
    cores
        Cores that it may use, where they differ from this process's own.

    Raises
    ------
    ChildError
        If the system does not start it.
    """

    def __init__(
        self, name: str, module: str, fds: Sequence[int], cores: Collection[int] = ()
    ) -> None:
        self.name = name
        try:
            with held_back():
                self._process = subprocess.Popen(
                    [*OWN_PYTHON, "-m", module, str(os.getpid())],
                    bufsize=0,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    pass_fds=fds,
                    env=os.environ | SINGLE_THREADED,
                )
        except OSError as error:
            raise ChildError(
                f"The {name} process cannot be started ({error.strerror}); check the load of this "
                "computer and its limits (ulimit -a)."
            ) from None
        if cores:
            with contextlib.suppress(OSError):  # it has ended already: poll() tells
                os.sched_setaffinity(self._process.pid, cores)
        os.set_blocking(self._stdin_fd, False)
        self._messages = MessageReader(self._stdout_fd)

    def start(self, job: object) -> None:
        """Hand over its job: the first message."""
        self.send(job)

    def send(self, message: object) -> None:
        """Send one message; a child that is gone is noticed when it is next listened to.

        Raises
        ------
        ChildError
            If it does not take it in time.
        """
        self._write(encode(message))

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def poll(self, timeout_s: float) -> object | None:
        """Return its next message, or None if none comes in time.

        Raises
        ------
        ChildError
            If the child has ended, or says what is no message.
        """
        try:
            return self._messages.next(timeout_s)
        except EOFError:
            code = self._process.wait()
            how = f"killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
            raise ChildError(f"The {self.name} process was {how}.") from None
        except ValueError as error:
            raise ChildError(f"The {self.name} process sent {error}.") from None

    def messages(self, timeout_s: float) -> Iterator[object]:
        """Yield the messages that are there, waiting for the first only.

        Raises
        ------
        ChildError
            If the child has ended.
        """
        while (message := self.poll(timeout_s)) is not None:
            yield message
            timeout_s = 0.0

    def wake(self) -> None:
        """Have it go on if somebody suspended it: it may have something to bring to an end."""
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """End it at once; the next :meth:`poll` tells."""
        self._process.kill()

    def stop(self, grace_s: float) -> None:
        """End it: close its input and wait; then terminate; then kill. Harmless when repeated."""
        if self._process.stdout is None or self._process.stdout.closed:
            return
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it was gone already
                self._process.stdin.close()
        self.wake()
        for end in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(_SILENT_GRACE_S if self._falls_silent(grace_s) else 0.0)
                break
            except subprocess.TimeoutExpired:
                end()
        with contextlib.suppress(
            subprocess.TimeoutExpired
        ):  # stuck in a call, on a disk that hangs
            self._process.wait(_KILLED_GRACE_S)
        self._process.stdout.close()

    def _falls_silent(self, patience_s: float) -> bool:
        """Wait until its output ends, which is noticed at once; waiting for a process polls."""
        deadline = time.monotonic() + patience_s
        while (left_s := deadline - time.monotonic()) > 0:
            if is_ready(self._stdout_fd, select.POLLIN, left_s) and not os.read(
                self._stdout_fd, 65536
            ):
                return True
        return False

    @property
    def _stdout_fd(self) -> int:
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    @property
    def _stdin_fd(self) -> int:
        assert self._process.stdin is not None
        return self._process.stdin.fileno()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        deadline = time.monotonic() + _WRITE_PATIENCE_S
        while rest:
            patience_s = max(0.0, deadline - time.monotonic())
            if not is_ready(self._stdin_fd, select.POLLOUT, patience_s):
                raise ChildError(f"The {self.name} process does not listen.")
            try:
                rest = rest[os.write(self._stdin_fd, rest) :]
            except BrokenPipeError:
                return  # poll() tells how it ended


class Parent:
    """The supervisor, as a child sees it; its process id is the child's only argument.

    (Asking for the parent at the start would be too late for one that has died already.)
    """

    def __init__(self) -> None:
        self._messages = MessageReader(sys.stdin.fileno())
        # What a library prints goes to the operator, and does not stand among the messages.
        self._messages_fd = os.dup(sys.stdout.fileno())
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._pid = int(sys.argv[1])
        # A recorder that is suspended has samples to write down, a control process devices to let
        # go of.
        signal_when_orphaned(signal.SIGCONT)

    def receive_job(self) -> Any:  # noqa: ANN401 - the child knows what it was sent
        """Wait for the job; ends the process quietly if the supervisor ends without one."""
        try:
            return self.poll(None)
        except EOFError:
            sys.exit(0)

    def poll(self, timeout_s: float | None) -> object | None:
        """Return the next message, or None if none comes in time (None: wait forever).

        Raises
        ------
        EOFError
            If the supervisor is gone.
        """
        return self._messages.next(timeout_s)

    def send(self, message: object) -> None:
        """Send one short message; there may be no receiver left."""
        with contextlib.suppress(BrokenPipeError):
            os.write(self._messages_fd, encode(message))

    def alive(self) -> bool:
        """Whether the supervisor still runs; cheap enough for the loop."""
        return os.getppid() == self._pid


# Table of processes


@dataclass(frozen=True, slots=True)
class Process:
    """One kind of process."""

    name: str
    """Name in messages to the operator."""
    module: str
    """Run as ``python -m module``; empty: it is the one that starts the others."""
    beat: Word
    """Its word on the board."""
    hung_after_s: float | None
    """Time without a heartbeat; None: judged by what it leaves undone instead."""
    grace_s: float
    """Time in which it has to end when asked to; then it is terminated, then killed."""
    for_one_session: bool
    """A new one is started for each session."""
    loss: str
    """What follows if it dies or hangs."""


CONTROL = Process(
    "control",
    CONTROL_MODULE,
    Word.CONTROL_BEAT,
    hung_after_s=3.0,
    grace_s=5.0,
    for_one_session=False,
    loss="the drive's watchdog switches it off, the session ends as a fault",
)
RECORDER = Process(
    "recorder",
    "rigd.engine.recorder",
    Word.RECORDER_BEAT,
    # A disk may stall for seconds; the samples that wait for it are what counts.
    hung_after_s=None,
    grace_s=5.0,
    for_one_session=True,
    loss="the session ends as a fault",
)
LIVE = Process(
    "live",
    "rigd.live.publisher",
    Word.LIVE_BEAT,
    hung_after_s=5.0,
    grace_s=2.0,
    for_one_session=False,
    loss="it is restarted, the session continues",
)
TOUCH = Process(
    "touch",
    "rigd.engine.touch_estimator",
    Word.TOUCH_BEAT,
    # An estimate takes its time; what it leaves undone is told as such.
    hung_after_s=None,
    grace_s=1.0,
    for_one_session=True,
    loss="touches are detected but not estimated, the session continues",
)
FIT = Process(
    "fit",
    "rigd.runner.fit_process",
    Word.FIT_BEAT,
    # A decision may take its time on a busy computer; the loop holds the angle meanwhile.
    hung_after_s=15.0,
    grace_s=1.0,
    for_one_session=True,
    loss="a session that plans itself ends with what was recorded, any other continues",
)
SUPERVISOR = Process(
    "supervisor",
    "",
    Word.SUPERVISOR_BEAT,
    hung_after_s=2.0,
    grace_s=0.0,
    for_one_session=False,
    loss="the control process ends the session as a fault",
)

PROCESSES = (CONTROL, RECORDER, LIVE, TOUCH, FIT, SUPERVISOR)
"""All processes, in the order in which they are ended: the one with the torque first."""


class Pulse:
    """How long a process has not beaten, as seen by one that looks every so often.

    Only time in which the looking process itself ran is counted: a computer that stands still for a
    second has not made a process hang.
    """

    _MOST_PER_LOOK_S = 0.2

    def __init__(self) -> None:
        self._beat = -1
        self._looked_s = 0.0
        self.still_s = 0.0

    def look(self, beat: int, now_s: float) -> float:
        """Take a look at its beat and return for how long it has not changed, in s.

        Parameters
        ----------
        beat
            Count that the process adds to while it is running.
        now_s
            Time of a monotonic clock.
        """
        passed_s = min(now_s - self._looked_s, self._MOST_PER_LOOK_S)
        self.still_s = self.still_s + passed_s if beat == self._beat else 0.0
        self._beat, self._looked_s = beat, now_s
        return self.still_s
