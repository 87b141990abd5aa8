"""Both ends of a child process: its client, and its connection to the process that started it.

`ChildProcess` starts the process that a row of `rigd.engine.workers` describes, exchanges messages
with it, and suspends, resumes and ends it. A worker that sends messages is run as ``python -m
MODULE PID`` with the process id of its supervisor. It receives its job and then messages on
standard input, whose end means that the supervisor is gone, and sends its answers on standard
output (`messages`). In the worker, `SupervisorConnection` handles these pipes. Any other worker is
a program with arguments, which the system kills when its supervisor ends.
"""

import contextlib
import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from rigd.engine._ring import shared_memory_fd
from rigd.engine.messages import MessageReader, encode, is_ready
from rigd.engine.workers import Worker
from rigd.errors import FailureError
from rigd.runtime import signal_when_orphaned, signals_blocked
from rigd.runtime.background import (
    OWN_PYTHON,
    RUN_PROGRAM,
    SINGLE_THREADED,
    prefer_oom_kill,
    set_idle_priority,
)

_WRITE_TIMEOUT_S = 5.0
"""Longest time in s that a child may take to read a message."""
_EXIT_TIMEOUT_S = 1.0
"""Longest time in s to wait for a child to exit after it has closed its output."""
_KILL_TIMEOUT_S = 2.0
"""Longest time in s to wait for a killed child to end."""
_MAX_ERROR_BYTES = 65_536
"""Number of bytes at the end of a child's standard error that are read."""


class ChildError(FailureError):
    """Raised if a child process cannot be started, has ended, or sent an invalid message."""

    system_reason = ""
    """Text of the system that states why the process cannot be started; else empty."""


class ChildProcess:
    """Child process that a supervisor starts, exchanges messages with, and ends.

    Parameters
    ----------
    worker
        Description of the process.
    arguments
        Command-line arguments, for a worker that is a program.
    descriptors
        File descriptors that the child inherits.
    cores
        Cores that the child may use; empty: the same cores as this process.
    folder
        Working folder of the child; None: the same folder as this process.

    Raises
    ------
    ChildError
        If the system does not start the process.
    """

    def __init__(
        self,
        worker: Worker,
        *arguments: str,
        descriptors: Sequence[int] = (),
        cores: Collection[int] = (),
        folder: Path | None = None,
    ) -> None:
        self._worker = worker
        is_program = not worker.sent_messages
        command = [*OWN_PYTHON, "-m", worker.module, *arguments]
        own_pid = str(os.getpid())
        self._errors_fd: int | None = None
        try:
            if worker.captures_stderr:
                self._errors_fd = shared_memory_fd()  # a pipe would have to be read meanwhile
            # A program has its own group, which is suspended and killed with its workers.
            with contextlib.nullcontext() if is_program else signals_blocked():
                self._process = subprocess.Popen(
                    [*RUN_PROGRAM, own_pid, *command] if is_program else [*command, own_pid],
                    bufsize=0,
                    stdin=subprocess.DEVNULL if is_program else subprocess.PIPE,
                    stdout=subprocess.DEVNULL if is_program else subprocess.PIPE,
                    stderr=self._errors_fd,
                    cwd=folder,
                    pass_fds=descriptors,
                    env=os.environ | SINGLE_THREADED,
                    process_group=0 if is_program else None,
                )
        except OSError as error:
            self._close_errors()
            child_error = ChildError(
                f"The {worker.name} process cannot be started ({error.strerror}); check the load "
                "of this computer and its limits (ulimit -a)."
            )
            child_error.system_reason = str(error.strerror)
            raise child_error from None
        self._apply_limits(cores)
        if not is_program:
            os.set_blocking(self._stdin_fd, False)
            self._messages = MessageReader(self._stdout_fd)

    def _apply_limits(self, cores: Collection[int]) -> None:
        """Set the cores, the priority and the memory limit of the new process."""
        worker, pid = self._worker, self.pid
        with contextlib.suppress(OSError):  # it has ended already, which poll() reports
            if cores:
                os.sched_setaffinity(pid, cores)
            if worker.memory is not None:
                limit_bytes = worker.memory.bytes_now()
                resource.prlimit(pid, resource.RLIMIT_AS, (limit_bytes, limit_bytes))
            if worker.niceness:
                raised_niceness = os.getpriority(os.PRIO_PROCESS, pid) + worker.niceness
                os.setpriority(os.PRIO_PROCESS, pid, raised_niceness)
        if worker.niceness is None:
            set_idle_priority(pid)
        if worker.prefers_oom_kill:
            prefer_oom_kill(pid)

    def start(self, job: object) -> None:
        """Send the child its job, which is the first message."""
        self.send(job)

    def send(self, message: object) -> None:
        """Send one message to the child.

        If the child has ended, the next `poll` raises the error instead.

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
        return self.exit_code is None

    @property
    def exit_code(self) -> int | None:
        """Exit code of the child; −N if signal N ended the child; None while it runs."""
        return self._process.poll()

    def poll(self, timeout_s: float | None) -> object | None:
        """Return the child's next message, or None if none arrives within `timeout_s`.

        A timeout of None waits forever.

        Raises
        ------
        ChildError
            If the child has ended, or sent anything but a message of its kind of worker.
        """
        process_text = f"The {self._worker.name} process"
        try:
            message = self._messages.next_message(timeout_s)
        except EOFError:
            exit_code = self._process.wait()
            end_text = (
                f"killed by signal {-exit_code}"
                if exit_code < 0
                else f"ended with exit code {exit_code}"
            )
            raise ChildError(f"{process_text} was {end_text}.") from None
        except ValueError as error:
            raise ChildError(f"{process_text} sent {error}.") from None
        if message is not None and type(message).__name__ not in self._worker.sent_messages:
            raise ChildError(f"{process_text} sent {message}.")
        return message

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

    async def receive(self) -> object:
        """Wait for the child's next message, and return it; other tasks run meanwhile.

        Raises
        ------
        ChildError
            If the child has ended, or sent anything but a message of its kind of worker.
        """
        import asyncio  # late: the processes of a rig do not need it

        event_loop, readable = asyncio.get_running_loop(), asyncio.Event()
        event_loop.add_reader(self._stdout_fd, readable.set)
        try:
            while (message := self.poll(0.0)) is None:
                readable.clear()
                await readable.wait()
        finally:
            event_loop.remove_reader(self._stdout_fd)
        return message

    def error_text(self) -> str:
        """Return the last text that the child wrote to standard error, for `captures_stderr`."""
        assert self._errors_fd is not None
        first_byte = max(0, os.fstat(self._errors_fd).st_size - _MAX_ERROR_BYTES)
        return (
            os.pread(self._errors_fd, _MAX_ERROR_BYTES, first_byte).decode(errors="replace").strip()
        )

    def suspend(self) -> None:
        """Suspend the child until it is resumed."""
        self._send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Resume the child if it is suspended, so that it can finish its work."""
        self._send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the child process at once; the next :meth:`poll` then raises `ChildError`."""
        self._send_signal(signal.SIGKILL)

    def _send_signal(self, signal_number: signal.Signals) -> None:
        """Send a signal to the child; if it is a program, also to the processes it has started."""
        if self._worker.sent_messages:
            self._process.send_signal(signal_number)
        elif self.running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal_number)

    def close_input(self) -> None:
        """Ask the child process to exit by closing its standard input."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it had ended already
                self._process.stdin.close()

    def stop(self) -> None:
        """End the child: close its input, terminate it if it does not exit in time, then kill it.

        A program is killed at once. Calling this again has no effect.
        """
        if self._process.stdout is None:
            self.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it ends late at low priority
                self._process.wait(self._worker.end_timeout_s)
        elif not self._process.stdout.closed:
            self.close_input()
            self.resume()
            for terminate_or_kill in (self._process.terminate, self._process.kill):
                has_ended = self._wait_for_output_end(self._worker.end_timeout_s)
                try:
                    self._process.wait(_EXIT_TIMEOUT_S if has_ended else 0.0)
                    break
                except subprocess.TimeoutExpired:
                    terminate_or_kill()
            with contextlib.suppress(
                subprocess.TimeoutExpired
            ):  # stuck in a call, on a disk that hangs
                self._process.wait(_KILL_TIMEOUT_S)
            self._process.stdout.close()
        self._close_errors()

    def _close_errors(self) -> None:
        """Close the file with the child's standard error, if there is one."""
        if self._errors_fd is not None:
            os.close(self._errors_fd)
            self._errors_fd = None

    def _wait_for_output_end(self, timeout_s: float) -> bool:
        """Wait until the child closes its output; return False if it does not in `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
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
        deadline_s = time.monotonic() + _WRITE_TIMEOUT_S
        while unsent_bytes:
            remaining_s = max(0.0, deadline_s - time.monotonic())
            if not is_ready(self._stdin_fd, select.POLLOUT, remaining_s):
                raise ChildError(f"The {self._worker.name} process does not listen.")
            try:
                unsent_bytes = unsent_bytes[os.write(self._stdin_fd, unsent_bytes) :]
            except BrokenPipeError:
                return  # poll() reports how it ended


class SupervisorConnection:
    """Connection of this child process to its supervisor.

    The supervisor's process id is the child's only command-line argument. ``os.getppid`` would
    return another id if the supervisor died before the child called it.
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
        return self._messages.next_message(timeout_s)

    def send(self, message: object) -> None:
        """Send one message to the supervisor; nothing happens if the supervisor has ended."""
        unsent_bytes = memoryview(encode(message))
        with contextlib.suppress(BrokenPipeError):
            while unsent_bytes:
                unsent_bytes = unsent_bytes[os.write(self._messages_fd, unsent_bytes) :]

    def alive(self) -> bool:
        """Return whether the supervisor is running; fast enough for the control loop."""
        return os.getppid() == self._pid


class Heartbeat:
    """Detector of a hung process, whose heartbeat count another process polls.

    Only time in which the polling process itself runs is counted. A computer that stalls for a
    second therefore does not make the polled process appear hung.
    """

    _MAX_COUNTED_STEP_S = 0.2
    """Maximum time in s that is counted from one poll to the next."""

    def __init__(self) -> None:
        self._beat = -1
        self._last_poll_s = 0.0
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
        elapsed_s = min(now_s - self._last_poll_s, self._MAX_COUNTED_STEP_S)
        self.still_s = self.still_s + elapsed_s if beat_count == self._beat else 0.0
        self._beat, self._last_poll_s = beat_count, now_s
        return self.still_s
