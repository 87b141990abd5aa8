"""Process group of a rig: control, recorder and live publisher, and their shared memory.

This module is quick to import, so that the processes are started first: they import their modules
while the supervisor reads the profile and plans.
"""

import contextlib
import os
import time
from collections.abc import Callable, Collection
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rigd.engine import shared_memory_fd
from rigd.engine.processes import CONTROL, LIVE, PROCESSES, RECORDER, Child, ChildError, Process

if TYPE_CHECKING:
    from rigd.engine.channels import Channels

_DESCRIPTORS = 6
_PREPARING_S = 20.0
"""Time for a process of one session to get ready on a busy computer; nothing moves yet."""
_POLL_S = 0.05


def await_ready(
    settled: Callable[[], bool], listen: Callable[[float], None], meanwhile: Callable[[], bool]
) -> str:
    """Wait until a process is `settled`: ready or lost; return how late it is, or an empty text.

    `listen` receives its messages for at most the given time in s. The wait ends early if
    `meanwhile` returns False.
    """
    deadline_s = time.monotonic() + _PREPARING_S
    while not settled() and meanwhile():
        listen(_POLL_S)
        if not settled() and time.monotonic() > deadline_s:
            return f"not ready within {_PREPARING_S:g} s"
    return ""


class ProcessGroup:
    """Control process, recorder and optional live publisher of a rig.

    Leaving the context ends all processes, the control process first.

    Parameters
    ----------
    live
        Start the live publisher too.
    also
        Further processes to start now; others are started when they are needed.

    Raises
    ------
    ChildError
        If a process cannot be started.
    OSError
        If there is no shared memory.

    Attributes
    ----------
    live
        Whether the live publisher is started too.
    cores
        Cores of the processes that are started later; empty: those of this process.
    """

    def __init__(self, *, live: bool, also: Collection[Process] = ()) -> None:
        self.live = live
        self._also = frozenset(also)
        self.cores: frozenset[int] = frozenset()
        self._fds: list[int] = []
        self._channels: Channels | None = None
        self._used: set[Process] = set()
        self._children: dict[Process, Child] = {}
        try:
            while len(self._fds) < _DESCRIPTORS:
                self._fds.append(shared_memory_fd())
            wanted = {CONTROL, RECORDER, *self._also} | ({LIVE} if live else set())
            for process in (process for process in PROCESSES if process in wanted):
                self._start(process)
        except (OSError, ChildError):
            self.end()
            raise

    def __getitem__(self, process: Process) -> Child:
        return self._children[process]

    def __contains__(self, process: Process) -> bool:
        return process in self._children

    @property
    def control(self) -> Child:
        """The process that communicates with the devices."""
        return self._children[CONTROL]

    @property
    def recorder(self) -> Child:
        """The process that writes the file."""
        return self._children[RECORDER]

    def fresh(self, process: Process) -> Child:
        """Return a new process that replaces one with a job.

        Raises
        ------
        ChildError
            If the process cannot be started.
        """
        if process in self._used or process not in self._children:
            if process in self._children:  # the previous one may not have been started
                self._children.pop(process).stop(process.grace_s)
            self._start(process)
        self._used.add(process)
        return self._children[process]

    def has_job(self, process: Process) -> bool:
        """Return whether a process has received its job."""
        return process in self._used

    @property
    def laid_out(self) -> bool:
        """Whether the shared memory has its size."""
        return self._channels is not None

    @property
    def channels(self) -> "Channels":
        """The channels in shared memory."""
        assert self._channels is not None
        return self._channels

    def lay_out(self, rate_hz: float, *, fast: bool = False, watched: bool = False) -> None:
        """Set the size of the shared memory for sessions at a rate.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        fast
            The sessions run under the virtual clock.
        watched
            Observers of samples may be started later.

        Raises
        ------
        OSError
            If there is not enough shared memory.
        """
        from rigd.engine.channels import VIRTUAL_BUFFERED_S, create_channels
        from rigd.safety.limits import BUFFERED_S

        # Observers of samples, such as a live view or a fit, are slower than the virtual clock.
        hurried = fast and (self.live or self._also or watched)
        buffered_s = VIRTUAL_BUFFERED_S if hurried else BUFFERED_S
        self._channels = create_channels(rate_hz, self._fds, buffered_s)

    def _start(self, process: Process) -> None:
        self._children[process] = Child(process.name, process.module, self._fds, self.cores)
        self._used.discard(process)

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
        """End all processes and release the memory; repeated calls do nothing."""
        if self._channels is not None:
            self._channels.ask_to_stop()
        with contextlib.ExitStack() as ending:  # continues after an error of one of them
            for process in reversed(PROCESSES):
                if process in self._children:
                    ending.callback(self._children.pop(process).stop, process.grace_s)
        if self._channels is not None:
            self._channels.close()
            self._channels = None
        while self._fds:
            os.close(self._fds.pop())
