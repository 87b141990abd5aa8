"""Processes of a rig (control process, recorder and others), and their shared memory.

This module is quick to import, so that the processes are started early. The processes then import
their modules while the supervisor reads the profile and plans the session.
"""

import contextlib
import os
import time
from collections.abc import Collection
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rigd.engine import shared_memory_fd
from rigd.engine.processes import ChildError, ChildProcess, Heartbeat
from rigd.engine.workers import CONTROL, LIVE, PROCESSES, RECORDER, Worker

if TYPE_CHECKING:
    from rigd.engine.channels import Channels

_SHARED_MEMORY_FILE_COUNT = 6
"""Number of shared memory files."""


class ProcessGroup:
    """Control process, recorder and further processes of a rig, with their shared memory.

    All processes are ended when the context is left, the control process first.

    Parameters
    ----------
    with_live_view
        Also start the publisher of the live view.
    extra_processes
        Further processes to start at once. All other processes are started when they are needed.

    Raises
    ------
    ChildError
        If a process cannot be started.
    OSError
        If there is no shared memory.

    Attributes
    ----------
    with_live_view
        Whether the publisher of the live view is started too.
    cores
        Processor cores for processes that are started later; empty for the cores of this process.
    """

    def __init__(self, *, with_live_view: bool, extra_processes: Collection[Worker] = ()) -> None:
        self.with_live_view = with_live_view
        self._extra_processes = frozenset(extra_processes)
        self.cores: frozenset[int] = frozenset()
        self._fds: list[int] = []
        self._channels: Channels | None = None
        self._processes_with_job: set[Worker] = set()
        self._children: dict[Worker, ChildProcess] = {}
        self._heartbeats: dict[Worker, Heartbeat] = {}
        try:
            while len(self._fds) < _SHARED_MEMORY_FILE_COUNT:
                self._fds.append(shared_memory_fd())
            wanted_processes = {CONTROL, RECORDER, *self._extra_processes} | (
                {LIVE} if with_live_view else set()
            )
            for process in (process for process in PROCESSES if process in wanted_processes):
                self._start(process)
        except (OSError, ChildError):
            self.end()
            raise

    def __getitem__(self, process: Worker) -> ChildProcess:
        return self._children[process]

    def __contains__(self, process: Worker) -> bool:
        return process in self._children

    @property
    def control(self) -> ChildProcess:
        """Control process, which communicates with the devices."""
        return self._children[CONTROL]

    @property
    def recorder(self) -> ChildProcess:
        """Recorder process, which writes the session file."""
        return self._children[RECORDER]

    def idle_process(self, process: Worker) -> ChildProcess:
        """Return a started process that has received no job; start a new one if necessary.

        Raises
        ------
        ChildError
            If the process cannot be started.
        """
        if process in self._processes_with_job or process not in self._children:
            if process in self._children:  # the previous one may not have been started
                self._children.pop(process).stop()
            self._start(process)
        self._processes_with_job.add(process)
        self._heartbeats[process] = Heartbeat()
        return self._children[process]

    def stalled_s(self, process: Worker) -> float:
        """Return the time in s since the last heartbeat of a process.

        Call this repeatedly, because a heartbeat is noticed as a change between two calls.
        """
        assert process.beat is not None
        beat_count = self.channels.shared_state[process.beat]
        return self._heartbeats[process].stalled_for(beat_count, time.monotonic())

    def has_job(self, process: Worker) -> bool:
        """Return whether a process has already received a job."""
        return process in self._processes_with_job

    @property
    def has_memory(self) -> bool:
        """Whether the shared memory has been allocated."""
        return self._channels is not None

    @property
    def channels(self) -> "Channels":
        """Ring buffers and shared state, through which the processes exchange data."""
        assert self._channels is not None
        return self._channels

    def allocate_memory(
        self, rate_hz: float, *, uses_virtual_clock: bool = False, may_be_observed: bool = False
    ) -> None:
        """Allocate the shared memory for sessions at a sample rate.

        Parameters
        ----------
        rate_hz
            Sample rate, in ticks per second.
        uses_virtual_clock
            Whether the sessions run under the virtual clock.
        may_be_observed
            Whether processes that read samples, such as a fit, may be started later.

        Raises
        ------
        OSError
            If there is not enough shared memory.
        """
        from rigd.engine.channels import VIRTUAL_CLOCK_BUFFER_S, create_channels
        from rigd.safety.limits import RECORDER_BUFFER_S

        # Readers of samples, such as a live view or a fit, are slower than the virtual clock.
        is_faster_than_observers = uses_virtual_clock and (
            self.with_live_view or self._extra_processes or may_be_observed
        )
        ring_buffer_s = VIRTUAL_CLOCK_BUFFER_S if is_faster_than_observers else RECORDER_BUFFER_S
        self._channels = create_channels(rate_hz, self._fds, ring_buffer_s)

    def _start(self, process: Worker) -> None:
        """Start a process, which waits for its job."""
        self._children[process] = ChildProcess(process, descriptors=self._fds, cores=self.cores)
        self._processes_with_job.discard(process)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.end()

    def end(self) -> None:
        """End all processes and release the shared memory; may be called repeatedly."""
        if self._channels is not None:
            self._channels.request_stop()
        with contextlib.ExitStack() as ending_children:  # continues after an error of one process
            for process in reversed(PROCESSES):
                if process in self._children:
                    ending_children.callback(self._children.pop(process).stop)
        if self._channels is not None:
            self._channels.close()
            self._channels = None
        while self._fds:
            os.close(self._fds.pop())
