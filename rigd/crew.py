"""The processes of one session, and the memory they share.

This module is quick to import, so that the processes can be started before anything else: they
import what they need while the supervisor reads the profile and plans.
"""

import os
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rigd.engine.process import Child
from rigd.engine.ring import shared_memory_fd

if TYPE_CHECKING:
    from rigd.engine.channels import Channels

_GRACE_S = 5.0
_LIVE_GRACE_S = 2.0
_DESCRIPTORS = 5


class Crew:
    """Control, recorder and, if wanted, live publisher of one session.

    Leaving the context ends them all, the one with the torque first.

    Parameters
    ----------
    live
        Start the live publisher too.
    """

    def __init__(self, *, live: bool) -> None:
        self._fds = [shared_memory_fd() for _ in range(_DESCRIPTORS)]
        self._channels: Channels | None = None
        self.control = Child("control", "rigd.engine.control", self._fds)
        self.recorder = Child("recorder", "rigd.engine.recorder", self._fds)
        self.publisher = Child("live", "rigd.live.publisher", self._fds) if live else None

    @property
    def channels(self) -> "Channels":
        """The shared memory, laid out."""
        assert self._channels is not None
        return self._channels

    def lay_out(self, rate_hz: float) -> None:
        """Size the shared memory for a session at ``rate_hz``.

        Raises
        ------
        OSError
            If there is not enough shared memory.
        """
        from rigd.engine.channels import create_channels

        self._channels = create_channels(rate_hz, self._fds)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._channels is not None:
            self._channels.ask_to_stop()
        self.control.stop(_GRACE_S)
        self.recorder.stop(_GRACE_S)
        if self.publisher is not None:
            self.publisher.stop(_LIVE_GRACE_S)
        if self._channels is not None:
            self._channels.close()
        for fd in self._fds:
            os.close(fd)
