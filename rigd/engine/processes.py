"""The processes of a rig: their table, their start, and both ends of their pipes.

The table `PROCESSES` defines how each process is started, watched and ended. Every process counts
up its heartbeat in the `SharedState` several times a second. The supervisor notices a dead process
at once and a hung process by its heartbeat. The table states the consequence.

A child is ``python -m MODULE``. It receives its job and then messages on standard input, whose end
means that the supervisor is gone. It sends its answers on standard output (`messages`).
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
from rigd.engine.shared_state import StateField
from rigd.errors import FailureError
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, signal_when_orphaned, signals_blocked

_WRITE_PATIENCE_S = 5.0
"""Longest time in s that a child may take to read a message."""
_EXIT_GRACE_S = 1.0
"""Longest time in s from the end of a child's output to the end of its process."""
_KILLED_GRACE_S = 2.0
"""Longest time in s to wait for a killed child to end."""


# Both ends


class ChildError(FailureError):
    """Error of a child process: it cannot be started, has ended or sent no valid message."""


class Child:
    """Child process that the supervisor starts, with the supervisor's end of its pipes.

    Parameters
    ----------
    name
        Name of the process in messages to the operator.
    module
        Module that is run as ``python -m module``. It starts its imports at once and waits for its
        job.
    descriptors
        Descriptors that the child inherits.
    cores
        Cores that the child may use; empty: those of this process.

    Raises
    ------
    ChildError
        If the system does not start the process.
    """

    def __init__(
        self, name: str, module: str, descriptors: Sequence[int], cores: Collection[int] = ()
    ) -> None:
        self.name = name
        try:
            with signals_blocked():
                self._process = subprocess.Popen(
                    [*OWN_PYTHON, "-m", module, str(os.getpid())],
                    bufsize=0,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    pass_fds=descriptors,
                    env=os.environ | SINGLE_THREADED,
                )
        except OSError as error:
            raise ChildError(
                f"The {name} process cannot be started ({error.strerror}); check the load of this "
                "computer and its limits (ulimit -a)."
            ) from None
        if cores:
            with contextlib.suppress(OSError):  # it has ended already, which poll() reports
                os.sched_setaffinity(self._process.pid, cores)
        os.set_blocking(self._stdin_fd, False)
        self._messages = MessageReader(self._stdout_fd)

    def start(self, job: object) -> None:
        """Send the child its job, which is the first message."""
        self.send(job)

    def send(self, message: object) -> None:
        """Send one message to the child.

        If the child has ended, nothing is raised here, but by the next `poll`.

        Raises
        ------
        ChildError
            If the child does not read the message in time.
        """
        self._write(encode(message))

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the child process still runs."""
        return self._process.poll() is None

    def poll(self, timeout_s: float) -> object | None:
        """Return the child's next message, or None if none arrives within `timeout_s`.

        Raises
        ------
        ChildError
            If the child has ended, or sent something that is no message.
        """
        try:
            return self._messages.next(timeout_s)
        except EOFError:
            exit_code = self._process.wait()
            end_text = (
                f"killed by signal {-exit_code}"
                if exit_code < 0
                else f"ended with exit code {exit_code}"
            )
            raise ChildError(f"The {self.name} process was {end_text}.") from None
        except ValueError as error:
            raise ChildError(f"The {self.name} process sent {error}.") from None

    def messages(self, timeout_s: float) -> Iterator[object]:
        """Yield the child's available messages; wait up to `timeout_s` for the first message only.

        Raises
        ------
        ChildError
            If the child has ended.
        """
        while (message := self.poll(timeout_s)) is not None:
            yield message
            timeout_s = 0.0

    def wake(self) -> None:
        """Resume the child if it is suspended, so that it can finish its work."""
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the child process at once; the next :meth:`poll` then raises `ChildError`."""
        self._process.kill()

    def stop(self, grace_s: float) -> None:
        """End the child: close its input, terminate it after `grace_s` seconds, then kill it.

        Calling this again has no effect.
        """
        if self._process.stdout is None or self._process.stdout.closed:
            return
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it had ended already
                self._process.stdin.close()
        self.wake()
        for terminate_or_kill in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(_EXIT_GRACE_S if self._wait_for_output_end(grace_s) else 0.0)
                break
            except subprocess.TimeoutExpired:
                terminate_or_kill()
        with contextlib.suppress(
            subprocess.TimeoutExpired
        ):  # stuck in a call, on a disk that hangs
            self._process.wait(_KILLED_GRACE_S)
        self._process.stdout.close()

    def _wait_for_output_end(self, patience_s: float) -> bool:
        """Wait until the child's output ends, and return whether it ends within `patience_s`."""
        deadline_s = time.monotonic() + patience_s
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            if is_ready(self._stdout_fd, select.POLLIN, remaining_s) and not os.read(
                self._stdout_fd, 65536
            ):
                return True
        return False

    @property
    def _stdout_fd(self) -> int:
        """File descriptor from which the child's messages are read."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    @property
    def _stdin_fd(self) -> int:
        """File descriptor to which messages for the child are written."""
        assert self._process.stdin is not None
        return self._process.stdin.fileno()

    def _write(self, message_bytes: bytes) -> None:
        """Write bytes to the child's input; raise `ChildError` if it does not read them in time."""
        unsent_bytes = memoryview(message_bytes)
        deadline_s = time.monotonic() + _WRITE_PATIENCE_S
        while unsent_bytes:
            patience_s = max(0.0, deadline_s - time.monotonic())
            if not is_ready(self._stdin_fd, select.POLLOUT, patience_s):
                raise ChildError(f"The {self.name} process does not listen.")
            try:
                unsent_bytes = unsent_bytes[os.write(self._stdin_fd, unsent_bytes) :]
            except BrokenPipeError:
                return  # poll() reports how it ended


class Parent:
    """A child process's connection to the supervisor, whose process id is its only argument.

    (The parent's id at the start of the child would be wrong if the supervisor has died already.)
    """

    def __init__(self) -> None:
        self._messages = MessageReader(sys.stdin.fileno())
        # Output of libraries goes to the operator instead of between the messages.
        self._messages_fd = os.dup(sys.stdout.fileno())
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._pid = int(sys.argv[1])
        # A suspended recorder must write its samples, and a control process close its devices.
        signal_when_orphaned(signal.SIGCONT)

    def receive_job(self) -> Any:  # noqa: ANN401 - the child knows its type
        """Wait for the supervisor's first message, the job of this process, and return it.

        End this process without an error if the supervisor ends before it has sent a job.
        """
        try:
            return self.poll(None)
        except EOFError:
            sys.exit(0)

    def poll(self, timeout_s: float | None) -> object | None:
        """Return the supervisor's next message, or None if none arrives within `timeout_s`.

        A timeout of None waits forever.

        Raises
        ------
        EOFError
            If the supervisor has ended.
        """
        return self._messages.next(timeout_s)

    def send(self, message: object) -> None:
        """Send one short message to the supervisor; nothing happens if the supervisor has ended."""
        with contextlib.suppress(BrokenPipeError):
            os.write(self._messages_fd, encode(message))

    def alive(self) -> bool:
        """Return whether the supervisor still runs, fast enough for use in the control loop."""
        return os.getppid() == self._pid


# Table of processes


@dataclass(frozen=True, slots=True)
class Process:
    """Description of one process of a rig: how it is started, watched and ended."""

    name: str
    """Name of the process in messages to the operator."""
    module: str
    """Module that is run as ``python -m module``; empty for the supervisor."""
    beat: StateField
    """Field of the process's heartbeat in the shared state."""
    hung_after_s: float | None
    """Longest time in s without a heartbeat; None: the process's results are checked instead."""
    grace_s: float
    """Time in s in which the process must end on request, before it is terminated, then killed."""
    for_one_session: bool
    """Whether each session starts a new process of this kind."""
    loss: str
    """Consequence if the process dies or hangs, for the operator."""


CONTROL = Process(
    "control",
    CONTROL_MODULE,
    StateField.CONTROL_BEAT,
    hung_after_s=3.0,
    grace_s=5.0,
    for_one_session=False,
    loss="the drive's watchdog switches it off, the session ends as a fault",
)
RECORDER = Process(
    "recorder",
    "rigd.engine.recorder",
    StateField.RECORDER_BEAT,
    # A disk may stall for seconds; the number of waiting samples is checked instead.
    hung_after_s=None,
    grace_s=5.0,
    for_one_session=True,
    loss="the session ends as a fault",
)
LIVE = Process(
    "live",
    "rigd.live.publisher",
    StateField.LIVE_BEAT,
    hung_after_s=5.0,
    grace_s=2.0,
    for_one_session=False,
    loss="it is restarted, the session continues",
)
TOUCH = Process(
    "touch",
    "rigd.engine.touch_estimator",
    StateField.TOUCH_BEAT,
    # An estimate may take long; a missing estimate is reported as such.
    hung_after_s=None,
    grace_s=1.0,
    for_one_session=True,
    loss="touches are detected but not estimated, the session continues",
)
FIT = Process(
    "fit",
    "rigd.runner.fit_process",
    StateField.FIT_BEAT,
    # A decision may take long on a busy computer; the loop holds the angle meanwhile.
    hung_after_s=15.0,
    grace_s=1.0,
    for_one_session=True,
    loss="a session that plans itself ends with what was recorded, any other continues",
)
SUPERVISOR = Process(
    "supervisor",
    "",
    StateField.SUPERVISOR_BEAT,
    hung_after_s=2.0,
    grace_s=0.0,
    for_one_session=False,
    loss="the control process ends the session as a fault",
)

PROCESSES = (CONTROL, RECORDER, LIVE, TOUCH, FIT, SUPERVISOR)
"""All processes of a rig in the order in which they are ended: first the control process, which
switches the torque off."""


class Heartbeat:
    """Detector of a hung process by its heartbeat, polled by another process.

    Only time in which the polling process itself ran counts: a computer that stalls for a second
    does not make a process count as hung.
    """

    _MAX_STEP_S = 0.2
    """Longest time in s that counts between two polls."""

    def __init__(self) -> None:
        self._beat = -1
        self._polled_s = 0.0
        self.still_s = 0.0

    def stalled_for(self, beat_count: int, now_s: float) -> float:
        """Return the time in s for which a process's heartbeat count has not changed.

        Parameters
        ----------
        beat_count
            Present count, which the process increments while it runs.
        now_s
            Time of a monotonic clock.
        """
        passed_s = min(now_s - self._polled_s, self._MAX_STEP_S)
        self.still_s = self.still_s + passed_s if beat_count == self._beat else 0.0
        self._beat, self._polled_s = beat_count, now_s
        return self.still_s
