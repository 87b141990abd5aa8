"""Server of the live view: takes what the publisher sends, and passes it on to any viewers.

It is a separate process because a slow or frozen viewer then delays nothing else, and because
the SDK's own server listens on every interface. Viewers connect to it without any authentication,
so it must never be reachable from another machine.
"""

import socket
import time
from contextlib import suppress
from typing import Final

from rigd.live._page import serve_page
from rigd.live._program import RerunError, RerunProgram
from rigd.live.address import LOOPBACK, LiveAddress, announce, withdraw

GRPC_PORT: Final = 9876
"""Rerun's own: where viewers look unless told otherwise, and tunnels can be laid in advance."""
_BACKLOG: Final = "16MiB"
"""Data that a viewer which joins late is sent first: some 80 s."""
_MOST_SESSIONS: Final = 20
"""Each leaves some 300 kB of layout and charts in the server; then another takes its place."""
_START_S: Final = 15.0
"""Time in which a server has to accept connections, on a busy computer."""
_ANSWER_S: Final = 0.1
_PAUSE_S: Final = 1.0
"""Least time between two starts of a server."""


class Outlet:
    """A Rerun server that is replaced when it ends, and how viewers find it.

    Parameters
    ----------
    rig
        The profile's name.

    Attributes
    ----------
    address
        Address of the server that accepts connections now; None while there is none.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run.
    """

    def __init__(self, rig: str) -> None:
        self.address: LiveAddress | None = None
        self._announced: LiveAddress | None = None
        self._rig = rig
        self._grpc_port = free_port(GRPC_PORT)
        self._page = serve_page(lambda: self.address, lambda: self._program.page_port)
        self._start()

    def wait(self) -> LiveAddress:
        """Wait for the first server, and return its address.

        Raises
        ------
        RerunError
            If it ends or does not answer.
        """
        deadline = time.monotonic() + 2 * _START_S
        while not self.attend():
            if not self._program.running:
                if not self._grpc_port:
                    raise RerunError(f"The Rerun server ended: {self._program.last_words}.")
                self._replace()
            if time.monotonic() > deadline:
                self.close()
                raise RerunError(f"The Rerun server does not answer: {self._program.last_words}.")
            time.sleep(0.01)
        assert self.address is not None
        return self.address

    def attend(self) -> bool:
        """Look after the server; say whether one takes connections."""
        program = self._program
        if program.running and program.grpc_port and program.page_port:
            if self.address is None:
                self._tell()
            return True
        self.address = None
        age_s = time.monotonic() - self._started_s
        if age_s > _START_S:
            program.kill()  # it mistook a listener on its port for its like, and serves no one
        if age_s > _PAUSE_S and not program.running:
            self._replace()
        return False

    def answers(self) -> bool:
        """Whether the server takes connections now: the SDK waits 5 s for one that does not."""
        try:
            socket.create_connection((LOOPBACK, self._grpc_port), _ANSWER_S).close()
        except OSError:
            return False
        return True

    def begin_session(self) -> None:
        """Make room for a session: what stays of each, the server never forgets by itself."""
        self._sessions += 1
        if self._sessions > _MOST_SESSIONS:
            self.kill_server()

    def kill_server(self) -> None:
        """End the server, which does not answer any more; another one takes its place."""
        self._program.kill()

    def close(self) -> None:
        """End the server, and what leads to it."""
        self._program.kill()
        self._page.close()
        if self._announced is not None:
            with suppress(OSError):  # who looks there sees that its process has ended
                withdraw(self._announced)

    def _replace(self) -> None:
        """Start another server: on the same port, where viewers and tunnels look for it.

        If the last one never served, it found that port taken.
        """
        if not self._program.grpc_port:
            self._grpc_port = 0
        with suppress(RerunError):  # to be tried again
            self._start()

    def _start(self) -> None:
        self._started_s = time.monotonic()
        self._sessions = 0
        self._program = RerunProgram(
            (
                "--serve-web",
                *("--port", str(self._grpc_port)),
                *("--web-viewer-port", "0"),
                *("--server-memory-limit", _BACKLOG),
            )
        )

    def _tell(self) -> None:
        self._grpc_port = self._program.grpc_port
        self.address = self._announced = LiveAddress.of_this_process(
            self._rig, self._grpc_port, self._page.port, time.time_ns()
        )
        with suppress(OSError):  # the view is there all the same
            announce(self.address)


def free_port(wanted: int) -> int:
    """Return a port if no process listens on it, or 0, which leaves the choice to the system.

    Rerun's program is not to find out: it may take who listens there for its like.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # Connections of a server that has just ended do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, wanted))
        except OSError:
            return 0
    return wanted
